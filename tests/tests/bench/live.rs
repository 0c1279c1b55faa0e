//! The live view, seen as its user sees it: through a terminal.

mod terminal;

use crate::real_time::read_traces;
use crate::test_folder::{
    ChildGuard, TestFolder, controller_rig, exit_code, run_bench, send_signal, step_scenario, wait_until,
};
use rstest::rstest;
use std::fs;
use std::process::Command;
use terminal::{LARGE, SMALL, TestTerminal};

const EXPECT: &str = "metric = \"overshoot_percent\"\nat_most = 100.0";
/// A plate that is so slow that a busy machine does not stop its controller: it is patient for a quarter of a second.
const SLOW: [&str; 4] = ["--clock", "real-time", "--time-scale", "0.02"];

fn long_run_folder(duration_ms: &str) -> TestFolder {
    let workshop = TestFolder::new();
    let text = step_scenario("aluminium-198x138", "", "", EXPECT);
    workshop.write_scenario("s.toml", &text.replace("duration_ms = 60.0", &format!("duration_ms = {duration_ms}")));
    workshop
}

fn start_live_run(workshop: &TestFolder, size: [u16; 2], rig: &str, more: &[&str]) -> TestTerminal {
    let arguments = ["run", "--live", "--out", "run", "--rig", rig];
    TestTerminal::start(workshop.path(), size, arguments.iter().chain(&SLOW).chain(more), &[])
}

#[rstest]
#[case::small(SMALL)]
#[case::large(LARGE)]
fn a_live_run_is_shown_and_the_terminal_restored(#[case] size: [u16; 2]) {
    let workshop = long_run_folder("60.0");
    let mut seen = start_live_run(&workshop, size, &controller_rig(None), &[]);
    seen.wait_for_view_text("trial 1 of 1");
    seen.wait_for_view_text("in band");
    for text in ["s.toml", "5 % band", "Wd in µm", "frequency", "resonance", "lateness", "CRC errors 0", "overruns"] {
        seen.wait_for_view_text(text);
    }
    println!("{}", seen.text());
    assert!(seen.is_alternate());
    seen.wait_for_exit(&[0, 3]);
    let after = seen.text();
    assert!(after.contains("run folder: run"), "{after}");
    assert!(!after.contains("5 % band"), "{after}");
}

#[rstest]
#[case::hang_up("HUP", 129)]
#[case::interrupt("INT", 130)]
#[case::terminate("TERM", 143)]
fn a_signal_restores_the_terminal(#[case] name: &str, #[case] expected: i32) {
    let workshop = long_run_folder("60000.0");
    let mut seen = start_live_run(&workshop, SMALL, &controller_rig(None), &[]);
    seen.wait_for_view_text("trial 1 of 1");
    send_signal(&seen.child.0, name);
    seen.wait_for_exit(&[expected]);
    assert!(seen.text().contains("the run was cancelled"), "{}", seen.text());
}

#[rstest]
#[case::quit("q")]
#[case::interrupt("\u{3}")]
fn keys_end_a_run_as_ctrl_c_does(#[case] key: &str) {
    let workshop = long_run_folder("60000.0");
    let log = workshop.path().join("controller.log");
    let mut seen = start_live_run(&workshop, SMALL, &controller_rig(Some(&log)), &[]);
    seen.wait_for_view_text("trial 1 of 1");
    seen.type_keys(key);
    seen.wait_for_exit(&[130]);
    let record = platebench_record::RunRecord::read(&workshop.path().join("run")).unwrap();
    assert_eq!(record.safe_confirmed, Some(true), "{}", fs::read_to_string(&log).unwrap());
}

#[test]
fn a_closed_terminal_ends_the_run() {
    let workshop = long_run_folder("60000.0");
    let mut seen = start_live_run(&workshop, SMALL, &controller_rig(None), &[]);
    seen.wait_for_view_text("trial 1 of 1");
    let mut child = seen.close();
    wait_until("it does not end", || child.0.try_wait().unwrap().is_some());
    assert_eq!(child.0.wait().unwrap().code(), Some(129));
    let record = platebench_record::RunRecord::read(&workshop.path().join("run")).unwrap();
    assert_eq!(record.safe_confirmed, Some(true));
}

#[test]
fn a_failed_run_restores_the_terminal() {
    let workshop = long_run_folder("60.0");
    let mut seen = start_live_run(&workshop, SMALL, "exec:false {port}", &[]);
    seen.wait_for_exit(&[5]);
    assert!(seen.text().contains("exit status 1"), "{}", seen.text());
}

#[test]
fn a_terminal_may_change_its_size() {
    let workshop = long_run_folder("60000.0");
    let mut seen = start_live_run(&workshop, LARGE, &controller_rig(None), &[]);
    seen.wait_for_view_text("excitation in Hz");
    for (size, shown) in [([40, 10], "40 x 10 is too small"), ([79, 24], "79 x 24 is too small"), (SMALL, "5 % band")] {
        seen.resize(size);
        seen.wait_for_view_text(shown);
    }
    seen.type_keys("q");
    seen.wait_for_exit(&[130]);
}

#[test]
fn stderr_of_a_controller_is_printed_after_the_view() {
    let workshop = long_run_folder("60.0");
    let quiet = controller_rig(None);
    let noisy = quiet.replacen("exec:", "exec:sh -c 'echo NOISE >&2; exec \"$0\" \"$@\"' ", 1);
    let mut seen = start_live_run(&workshop, SMALL, &noisy, &[]);
    seen.wait_for_view_text("trial 1 of 1");
    let at = seen.text().lines().position(|line| line.trim() == "NOISE");
    assert_eq!(at, Some(22), "the line above the keys:\n{}", seen.text());
    seen.wait_for_exit(&[0, 3]);
    assert!(seen.text().contains("NOISE"), "{}", seen.text());
}

#[test]
fn no_color_means_no_colour() {
    let workshop = long_run_folder("60000.0");
    for (environment, expected) in [(vec![], true), (vec![("NO_COLOR", "1")], false)] {
        let arguments = ["run", "--live", "--rig", "hosted"];
        let mut seen = TestTerminal::start(workshop.path(), SMALL, arguments.iter().chain(&SLOW), &environment);
        seen.wait_for_view_text("in band");
        assert_eq!(seen.has_colour(), expected, "{environment:?}");
        seen.type_keys("q");
        seen.wait_for_exit(&[130]);
    }
}

#[test]
fn the_live_view_does_not_change_traces() {
    let folder = tempfile::tempdir().unwrap();
    let paper = crate::test_folder::workspace_root().join("scenarios/paper");
    let arguments = ["run", paper.to_str().unwrap(), "--rig", "hosted", "--jobs", "2", "--out"];
    assert_eq!(exit_code(&run_bench(folder.path(), arguments.iter().chain(&["plain"]))), 0);
    let mut seen = TestTerminal::start(folder.path(), SMALL, arguments.iter().chain(&["watched", "--live"]), &[]);
    seen.wait_for_exit(&[0]);
    let [plain, watched] = ["plain", "watched"].map(|out| read_traces(&folder.path().join(out)));
    assert!(plain.len() > 20 && plain == watched);
}

#[rstest]
#[case::run(&["run", "--rig", "hosted"], 0)]
#[case::emulate(&["emulate", "--port", "pty", "--scenario", "scenarios/s.toml", "--seconds", "0.1"], 0)]
fn without_a_terminal_the_run_has_no_view(#[case] arguments: &[&str], #[case] expected: i32) {
    let workshop = long_run_folder("60.0");
    let output = run_bench(workshop.path(), arguments.iter().chain(&["--live"]));
    let error = String::from_utf8_lossy(&output.stderr);
    assert_eq!(exit_code(&output), expected, "{error}");
    assert!(error.contains("no live view: standard output is not a terminal"), "{error}");
    assert!(!output.stdout.is_empty() && !output.stdout.contains(&0x1b));
}

#[test]
fn a_dumb_terminal_is_left_alone() {
    let workshop = long_run_folder("60.0");
    let arguments = ["run", "--rig", "hosted", "--live"];
    let mut seen = TestTerminal::start(workshop.path(), SMALL, arguments, &[("TERM", "dumb")]);
    seen.wait_for_exit(&[0]);
    assert!(seen.text().contains("TERM=dumb"), "{}", seen.text());
}

#[test]
fn the_plate_alone_is_shown_and_pressed() {
    let workshop = long_run_folder("60.0");
    let arguments = ["emulate", "--live", "--port", "pty", "--scenario", "scenarios/s.toml"];
    let mut seen = TestTerminal::start(workshop.path(), SMALL, arguments, &[]);
    seen.wait_for_view_text("waiting for a controller");
    seen.wait_for_view_text("/dev/pts/");
    let text = seen.text();
    let port = text.split_whitespace().find(|word| word.starts_with("/dev/pts/")).unwrap();
    let controller = Command::new(env!("CARGO_BIN_EXE_controller-under-test")).arg(port).spawn().unwrap();
    let _controller = ChildGuard(controller);
    seen.wait_for_view_text("emulate   scenarios/s.toml");
    for (key, shown) in [("F", "finger 0.25 N"), ("T", "plate +1.0 K"), ("r", "finger 0.00 N, plate +0.0 K")] {
        seen.type_keys(key);
        seen.wait_for_view_text(shown);
    }
    println!("{}", seen.text());
    seen.type_keys("q");
    seen.wait_for_exit(&[0]);
}

#[test]
fn a_session_restores_the_terminal_for_its_questions() {
    let workshop = long_run_folder("20.0");
    let plan = "title = \"A tiny acceptance\"\nrepetitions = 3\n[[requirement]]\nid = \"R-1\"\ntext = \"It settles.\"\n\
                [[ask]]\nid = \"safe\"\nquestion = \"Is nobody near the plate?\"\n[[scenario]]\nfile = \"scenarios/s.toml\"\n\
                [bench]\ntiming_trials = 1\nclean_runs = 2\n";
    fs::write(workshop.path().join("plan.toml"), plan).unwrap();
    let text = fs::read_to_string(workshop.path().join("scenarios/s.toml")).unwrap();
    workshop.write_scenario("s.toml", &format!("{text}requirement = \"R-1\"\n"));
    let who = ["--operator", "A. Tester", "--place", "Lab 2", "--notes", "none"];
    let arguments = ["accept", "--live", "--plan", "plan.toml", "--out", "record", "--rig", "hosted"];
    let mut seen = TestTerminal::start(workshop.path(), SMALL, arguments.iter().chain(&who).chain(&SLOW), &[]);
    seen.wait_for_terminal_text("near the plate?");
    seen.type_keys("yes\n");
    seen.wait_for_view_text("accept   trial 2 of 3   s.toml");
    seen.wait_for_exit(&[0, 3]);
    let after = seen.text();
    assert!(after.contains("record: record/") && after.contains("near the plate? [yes/no] yes"), "{after}");
}
