//! Tests watched runs.

use crate::test_folder::{
    ChildGuard, PLATE, SETTLING, TestFolder, bench_command, step_text, wait_until, workspace_root,
};
use serde_json::Value;
use std::fs;
use std::path::Path;
use std::process::Stdio;

fn scenarios_of_runs(folder: &Path) -> Vec<Vec<String>> {
    let entries = fs::read_dir(folder.join("runs")).into_iter().flatten().flatten();
    let mut records: Vec<_> = entries
        .filter_map(|entry| {
            let text = fs::read_to_string(entry.path().join("run.json")).ok()?;
            let record: Value = serde_json::from_str(&text).ok()?;
            // `traceability.csv` is the last file that a run writes, so its time orders the runs.
            let written = fs::metadata(entry.path().join("traceability.csv")).ok()?.modified().ok()?;
            let names = record["scenarios"].as_array()?.iter();
            Some((written, names.map(|scenario| scenario["file"].as_str().unwrap().to_owned()).collect()))
        })
        .collect();
    records.sort();
    records.into_iter().map(|(_, names)| names).collect()
}

struct WatchedRun<'a> {
    folder: &'a TestFolder,
    child: ChildGuard,
    expected: Vec<Vec<&'static str>>,
}

impl<'a> WatchedRun<'a> {
    fn start(folder: &'a TestFolder, rig: &str) -> Self {
        let stderr = fs::File::create(folder.join("stderr")).unwrap();
        let mut run = bench_command(folder.path());
        let run = run.args(["run", "--rig", rig, "--watch", "--quiet"]).stdout(Stdio::null()).stderr(stderr);
        Self { folder, child: ChildGuard(run.spawn().unwrap()), expected: Vec::new() }
    }

    #[track_caller]
    fn expect_run(&mut self, names: &[&'static str]) {
        self.expected.push(names.to_vec());
        wait_until("no further run", || scenarios_of_runs(self.folder.path()).len() >= self.expected.len());
        assert_eq!(scenarios_of_runs(self.folder.path()), self.expected);
    }

    #[track_caller]
    fn wait_for_messages(&self, parts: &[&str]) {
        wait_until("no message", || parts.iter().all(|part| self.folder.read("stderr").contains(part)));
    }

    #[track_caller]
    fn interrupt(mut self) {
        self.child.signal("INT");
        self.child.wait_for_exit(&[130]);
    }
}

#[test]
fn a_watched_run_repeats_changed_scenarios() {
    let folder = TestFolder::new();
    let text = step_text(SETTLING);
    folder.write_scenario("a.toml", &text);
    folder.write_scenario("b.toml", &text);
    folder.write_scenario("c.toml", &text.replace("aluminium-198x138", "aluminium-198x138-600vpp"));
    let write_b = |duration: &str| folder.write_scenario("b.toml", &text.replace("duration_ms = 60.0", duration));
    let mut run = WatchedRun::start(&folder, "hosted");
    run.expect_run(&["a.toml", "b.toml", "c.toml"]);
    write_b("duration_ms = 61.0");
    run.expect_run(&["b.toml"]);
    write_b("duration_s = 0.06");
    run.wait_for_messages(&["did you mean `duration_ms`"]);
    write_b("duration_ms = 62.0");
    run.expect_run(&["b.toml"]);
    folder.write(PLATE, &(folder.read(PLATE) + "# another one\n"));
    run.expect_run(&["a.toml", "b.toml"]);
    folder.write_scenario("d.toml", &text);
    run.expect_run(&["d.toml"]);
    run.interrupt();
}

#[test]
fn a_watched_run_repeats_after_a_firmware_change() {
    let folder = TestFolder::new();
    let text = step_text(SETTLING);
    folder.write_scenario("a.toml", &text);
    folder.write_scenario("b.toml", &text);
    let image = folder.join("mine.elf");
    let built = fs::read(workspace_root().join("firmware-under-test/images/platebench-stm32f4.elf")).unwrap();
    fs::write(&image, &built).unwrap();
    let mut run = WatchedRun::start(&folder, "emulated:mine.elf");
    run.expect_run(&["a.toml", "b.toml"]);
    // A build deletes the old image first, so the image is missing for a while.
    fs::remove_file(&image).unwrap();
    run.wait_for_messages(&["mine.elf", "cannot be read"]);
    // Bytes after the last section change the file but not the program.
    fs::write(&image, [&built[..], b"built anew"].concat()).unwrap();
    run.expect_run(&["a.toml", "b.toml"]);
    folder.write_scenario("b.toml", &text.replace("duration_ms = 60.0", "duration_ms = 61.0"));
    run.expect_run(&["b.toml"]);
    run.interrupt();
}
