//! Ends tools that run the bench, and checks in the controller's log that the bench requests 0 V.

use crate::campaign_engines::Slurm;
use crate::safe_exit::log_lines;
use crate::test_folder::{ChildGuard, PROGRAM, SLOW_REAL_TIME, TestFolder, controller_rig, wait_until, workspace_root};
use platebench_test_kit::{command_with_default_signals, skip_without};
use rstest::rstest;
use serde_json::Value;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

const READERS: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../target/test-readers/bin");

/// A step of one minute whose controller keeps a log.
struct Drive {
    folder: TestFolder,
    log: PathBuf,
}

impl Drive {
    fn new() -> Self {
        let folder = TestFolder::with_minute();
        let log = folder.join("controller.log");
        Self { folder, log }
    }

    /// Starts a program of `target/test-readers` with the Python package of the sources.
    fn tool(&self, name: &str) -> Option<Command> {
        let program = Path::new(READERS).join(name);
        if !program.exists() {
            skip_without(&program.display().to_string());
            return None;
        }
        Some(self.command(&program.display().to_string()))
    }

    fn command(&self, program: &str) -> Command {
        let mut command = command_with_default_signals(program);
        command.current_dir(self.folder.path()).env("PYTHONPATH", workspace_root().join("ci/python"));
        command.env("PLATEBENCH", PROGRAM).env("RIG", self.rig()).stdin(Stdio::null());
        command.stdout(Stdio::null()).stderr(Stdio::null());
        command
    }

    fn rig(&self) -> String {
        controller_rig(Some(&self.log))
    }

    fn lines(&self) -> Vec<Value> {
        log_lines(&self.log)
    }

    fn has_driven(&self) -> bool {
        self.lines().iter().any(|line| line["state"] == "running" && line["drive_vpp"].as_f64() > Some(0.0))
    }

    fn wait_for_drive(&self) {
        wait_until("the controller never drove the plate", || self.has_driven());
    }

    /// The controller ends when the bench closes the line. Without a request for 0 V, it reports the
    /// fault of its watchdog and no safe state.
    #[track_caller]
    fn assert_requested_0_v(&self) {
        wait_until("the bench drives on", || self.lines().last().is_some_and(|line| line["event"] == "end"));
        let lines = self.lines();
        let stopped = lines.iter().position(|line| line["state"] == "safe").expect("the bench requested 0 V");
        assert!(lines[stopped..].iter().all(|line| line["drive_vpp"] == 0.0), "{lines:#?}");
    }
}

fn start_pytest(drive: &Drive, options: &[&str]) -> Option<ChildGuard> {
    let arguments = SLOW_REAL_TIME.join(" ");
    let mut pytest = drive.tool("python")?;
    pytest.args(["-m", "pytest", "-p", "platebench.pytest_plugin", "scenarios/s.toml"]).args(options);
    pytest.args(["--platebench-rig", &drive.rig(), "--platebench-args", &arguments]);
    Some(ChildGuard(pytest.spawn().unwrap()))
}

/// pytest has no handler of SIGTERM; the package lets it act after the bench has ended.
#[rstest]
#[case::interrupt("INT", true)]
#[case::terminate("TERM", true)]
#[case::hang_up("HUP", true)]
#[case::kill("KILL", false)]
fn a_signal_to_pytest_ends_the_drive(#[case] signal: &str, #[case] waits: bool) {
    let drive = Drive::new();
    let Some(mut pytest) = start_pytest(&drive, &[]) else { return };
    drive.wait_for_drive();
    pytest.signal(signal);
    wait_until("pytest does not end", || pytest.has_ended());
    if waits {
        let lines = drive.lines();
        assert_eq!(lines.last().unwrap()["event"], "end", "pytest ended before the bench: {lines:#?}");
    }
    drive.assert_requested_0_v();
}

/// Plays with longer limits until the controller has driven the plate before the limit.
fn play_until_driven(mut play: impl FnMut(&Drive, u32) -> Option<()>) {
    for limit_s in [3, 12, 48] {
        let drive = Drive::new();
        if play(&drive, limit_s).is_none() {
            return;
        }
        if drive.has_driven() {
            return drive.assert_requested_0_v();
        }
        println!("the controller did not drive within {limit_s} s; trying again");
    }
    panic!("the controller never drove the plate");
}

#[rstest]
#[case::signal("signal")]
#[case::thread("thread")]
fn a_time_out_of_pytest_ends_the_drive(#[case] method: &str) {
    play_until_driven(|drive, limit_s| {
        let limit = format!("--timeout={limit_s}");
        let mut pytest = start_pytest(drive, &[&limit, "--timeout-method", method])?;
        wait_until("pytest does not end", || pytest.has_ended());
        Some(())
    });
}

/// Slurm sends SIGTERM to every process of the job, so to the controller as well.
#[test]
fn scancel_ends_the_drive_with_a_confirmed_0_v() {
    let Some(slurm) = Slurm::start() else { return };
    let drive = Drive::new();
    let options = SLOW_REAL_TIME.map(|word| format!("'{word}'")).join(" ");
    let script = format!("#!/bin/sh\nexec '{PROGRAM}' run --rig \"$RIG\" --out run {options}\n");
    drive.folder.write("job.sh", &script);
    let mut submit = slurm.command("sbatch");
    submit.args(["--parsable", "job.sh"]).current_dir(drive.folder.path()).env("RIG", drive.rig());
    let job = String::from_utf8(submit.output().unwrap().stdout).unwrap();
    drive.wait_for_drive();
    let cancel = slurm.command("scancel").args([job.trim()]).status().unwrap();
    assert!(cancel.success());
    drive.assert_requested_0_v();
    wait_until("the run has no end", || drive.folder.record("run").safe_confirmed.is_some());
    assert_eq!(drive.folder.record("run").safe_confirmed, Some(true));
}
