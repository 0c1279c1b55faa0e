//! Checks that every command plays the same trials: the traces of `soak`, `accept` and
//! `tune --send` equal those of `run`, byte for byte. Ways of playing without a trace are compared
//! by their samples in `harness/experiments/tests/explore/ways_of_playing.rs`.

use crate::boards::inventory;
use crate::test_folder::{PLATE, TestFolder, read_traces, step_scenario};
use std::collections::BTreeMap;
use std::fs;
use std::path::PathBuf;

/// Noise, a spread of the plate, a fault of the line and a scene between trials: each must be the
/// same in every way of playing.
fn folder_with_noisy_scenario() -> TestFolder {
    let expect = "metric = \"settling_time_ms\"\nat_most = 4.0\nrequirement = \"R-1\"\n\
                  [trials]\ncount = 3\n[trials.spread]\ngain_percent = 1.0\n\
                  [[fault]]\nkind = \"drop\"\ndirection = \"from-controller\"\nfrom_ms = 20.0\nuntil_ms = 21.0\n\
                  [[between]]\nduration_ms = 5.0\nprofile = { setpoint_um = 1.0 }";
    TestFolder::with_scenario(&step_scenario("aluminium-198x138-noisy", "", "", expect))
}

fn traces_of_run(folder: &TestFolder) -> BTreeMap<PathBuf, Vec<u8>> {
    folder.bench(["run", "--rig", "hosted", "--out", "run"]).assert_exit_in(&[0, 1]);
    let traces = read_traces(&folder.join("run"));
    assert!(!traces.is_empty());
    traces
}

#[test]
fn soak_plays_the_trials_of_run() {
    let folder = folder_with_noisy_scenario();
    folder.write("boards.toml", &inventory(&[("left", "rig = \"hosted\"".to_owned())]));
    folder.bench(["board", "soak", "--board", "left", "--hours", "0.0000001", "--out", "soak"]).assert_exit_in(&[0, 1]);
    let first = fs::read_dir(folder.join("soak/runs")).unwrap().next().unwrap().unwrap();
    assert!(read_traces(&first.path()) == traces_of_run(&folder));
}

#[test]
fn an_acceptance_session_plays_the_trials_of_run() {
    let folder = folder_with_noisy_scenario();
    let plan = "title = \"A session\"\nrepetitions = 3\n[[requirement]]\nid = \"R-1\"\ntext = \"It settles.\"\n\
                [[scenario]]\nfile = \"scenarios/s.toml\"\n[bench]\ntiming_trials = 1\nclean_runs = 2\n";
    folder.write("plan.toml", plan);
    folder.bench(["acceptance", "run", "--plan", "plan.toml", "--out", "record", "--rig", "hosted", "--yes"]);
    let step = fs::read_dir(folder.join("record/steps")).unwrap().map(|entry| entry.unwrap().path());
    let step = step.filter(|step| step.join("traces/s").exists()).collect::<Vec<_>>();
    assert_eq!(step.len(), 1, "{step:?}");
    assert!(read_traces(&step[0]) == traces_of_run(&folder));
}

#[test]
fn tune_verifies_with_the_trial_of_run() {
    let folder = TestFolder::new();
    folder.bench(["tune", "--plate", PLATE, "--samples", "0", "--send", "hosted", "--out", "step"]).assert_exit(0);
    let sent = folder.record("step").scenarios.remove(0);
    let scenario = &sent.inputs[0].file;
    folder.bench(["run", "--rig", "hosted", "--out", "run", &format!("step/{scenario}")]).assert_exit(0);
    let [tuned, run] = ["step", "run"].map(|run| read_traces(&folder.join(run)).into_values().collect::<Vec<_>>());
    assert_eq!(tuned.len(), 1);
    assert!(tuned == run);
}
