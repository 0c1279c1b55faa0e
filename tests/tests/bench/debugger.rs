//! Tests `run --gdb` with the debugger GDB and the firmware of the C starter.

use crate::starter_c::{build_starter, has_cross_compiler};
use crate::test_folder::{TestFolder, run_bench, workspace_root};
use platebench_test_kit::skip_without;
use std::fs;
use std::net::TcpListener;
use std::path::Path;
use std::process::{Command, Stdio};
use std::thread;

const SCENARIO: &str = "scenarios/paper/fig13-closed-loop.toml";
const TRACE: &str = "traces/paper/fig13-closed-loop/000.csv";
const GDB: &str = "gdb-multiarch";

fn free_port() -> u16 {
    TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port()
}

fn debug(elf: &Path, port: u16) -> String {
    let commands = [
        "set pagination off",
        "set tcp connect-timeout 120",
        &format!("target remote :{port}"),
        "break law_step",
        "continue",
        "continue",
        "print law->amplitude.integral",
        "stepi",
        "next",
        "info breakpoints",
        "delete",
        "detach",
    ];
    let mut gdb = Command::new(GDB);
    gdb.args(["-q", "-nx", "-batch"]).args(commands.iter().flat_map(|command| ["-ex", *command])).arg(elf);
    let output = gdb.stdin(Stdio::null()).output().unwrap();
    String::from_utf8_lossy(&output.stdout).into_owned() + &String::from_utf8_lossy(&output.stderr)
}

#[test]
fn a_debugged_trial_gives_the_same_trace() {
    let has_gdb = Command::new(GDB).arg("--version").output().is_ok_and(|output| output.status.success());
    if !has_gdb || !has_cross_compiler() {
        return skip_without("gdb-multiarch, make, arm-none-eabi-gcc or newlib");
    }
    let folder = TestFolder::new();
    let elf = build_starter(&folder.join("build"));
    let rig = format!("emulated:{}", elf.display());
    let port = free_port();
    let gdb = thread::spawn(move || debug(&elf, port));
    let play = |out: &str, more: &[&str]| {
        let out = folder.join(out);
        let arguments = ["run", SCENARIO, "--trials", "1", "--rig", &rig, "--out", out.to_str().unwrap()];
        run_bench(&workspace_root(), arguments.iter().chain(more)).assert_exit(0);
        fs::read_to_string(out.join(TRACE)).unwrap()
    };
    let debugged = play("debugged", &["--gdb", &port.to_string()]);
    let shown = gdb.join().unwrap();
    for expected in ["Breakpoint 1, law_step", "$1 = ", "breakpoint already hit 2 times", "detached"] {
        assert!(shown.contains(expected), "no `{expected}` in:\n{shown}");
    }
    assert_eq!(debugged, play("alone", &[]));
}

#[test]
fn refuses_a_debugger_that_cannot_be_served() {
    let folder = TestFolder::new();
    let taken = TcpListener::bind("127.0.0.1:0").unwrap();
    let port = taken.local_addr().unwrap().port().to_string();
    let out = folder.join("run");
    for (rig, expected) in [
        (&["--rig", "hosted"][..], "--gdb: expected --rig emulated[:ELF] and --clock lockstep"),
        (&["--clock", "real-time"], "--gdb: expected --rig emulated[:ELF] and --clock lockstep"),
        (&[], "expected a free port for the debugger"),
    ] {
        let arguments = ["run", SCENARIO, "--gdb", &port, "--out", out.to_str().unwrap()];
        run_bench(&workspace_root(), arguments.iter().chain(rig)).assert_message(2, &[expected]);
        assert!(!out.exists());
    }
}
