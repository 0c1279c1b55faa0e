use platebench_engine::{Clock, LiveTap, RunPlan};
use platebench_model::record::Overrides;
use platebench_report::live::{LiveView, RunDescription};
use rustix::fs::{Mode, OFlags, open};
use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};
use rustix::termios::{Winsize, tcgetattr, tcsetwinsize};
use std::fs::File;
use std::io::Read;
use std::process::{Command, Stdio};
use std::sync::Arc;
use std::thread;

const MESSAGE: &str = "a panic on purpose";

/// This is not a test. The test below starts it as a process in a terminal.
#[test]
#[ignore = "started by the other one"]
fn panics_on_purpose() {
    let subject = RunDescription {
        command: "run",
        key_help: "",
        plan: Arc::new(RunPlan::new(
            &"hosted".parse().unwrap(),
            Clock::Lockstep { wire_time: false },
            1,
            Vec::new(),
            Overrides::default(),
        )),
        has_end: true,
    };
    let (_live_tap, tap_reader) = LiveTap::new();
    let _view = LiveView::open(subject, tap_reader).unwrap();
    panic!("{MESSAGE}");
}

#[test]
fn a_panic_restores_the_terminal_before_its_message() {
    let master = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY | OpenptFlags::CLOEXEC).unwrap();
    grantpt(&master).unwrap();
    unlockpt(&master).unwrap();
    let path = ptsname(&master, Vec::new()).unwrap();
    let line = File::from(open(&path, OFlags::RDWR | OFlags::NOCTTY | OFlags::CLOEXEC, Mode::empty()).unwrap());
    tcsetwinsize(&line, Winsize { ws_row: 24, ws_col: 80, ws_xpixel: 0, ws_ypixel: 0 }).unwrap();
    let before = tcgetattr(&line).unwrap();
    let end = || Stdio::from(line.try_clone().unwrap());
    let mut command = Command::new(std::env::current_exe().unwrap());
    command.args(["--exact", "panics_on_purpose", "--ignored", "--nocapture"]).env("TERM", "xterm-256color");
    let mut child = command.stdin(Stdio::null()).stdout(end()).stderr(end()).spawn().unwrap();
    drop(command);
    let mut output = File::from(master);
    let reader = thread::spawn(move || {
        let (mut all, mut bytes) = (Vec::new(), [0; 4096]);
        while let Ok(count @ 1..) = output.read(&mut bytes) {
            all.extend_from_slice(&bytes[..count]);
        }
        String::from_utf8_lossy(&all).into_owned()
    });
    assert!(!child.wait().unwrap().success());
    let after = tcgetattr(&line).unwrap();
    drop(line);
    let captured = reader.join().unwrap();
    let at = |text: &str| captured.find(text).unwrap_or_else(|| panic!("{text:?} is not in {captured:?}"));
    let [entered, left, printed] = ["\u{1b}[?1049h", "\u{1b}[?1049l", MESSAGE].map(at);
    assert!(entered < left && left < printed, "{captured:?}");
    assert!(at("waiting") < left, "{captured:?}");
    assert_eq!((after.local_modes, after.input_modes), (before.local_modes, before.input_modes));
}
