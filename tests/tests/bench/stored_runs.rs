//! Stored runs: judged again, reported again, cut off, doctored.

use crate::test_folder::{TestFolder, exit_code, run_bench, step_scenario, workspace_root};
use platebench_record::{Cause, RunRecord, Verdict};
use platebench_runner::rejudge;
use rstest::rstest;
use std::fs;

const GOOD: &str = "metric = \"settling_time_ms\"\nat_most = 2.0";

fn three_trial_scenario() -> String {
    step_scenario("aluminium-198x138-noisy", "", "", "metric = \"settling_time_ms\"\nat_most = 4.0")
        + "[trials]\ncount = 3\n[trials.spread]\nsensor_gain_percent = 1.0\n"
}

#[test]
fn judging_again_gives_identical_results() {
    let folder = tempfile::tempdir().unwrap();
    for (part, out) in [("scenarios/paper", "paper"), ("scenarios/limits", "limits"), ("scenarios/faults", "faults")] {
        run_bench(folder.path(), ["run", workspace_root().join(part).to_str().unwrap(), "--out", out]);
        let live = RunRecord::read(&folder.path().join(out)).unwrap();
        let again = rejudge(&folder.path().join(out), None).unwrap();
        assert!(live.complete && live.scenarios.len() >= 4);
        assert_eq!(live, again);
    }
}

/// Goes on from 4 to 8 to 16 trials: the mean error of a sensor that is 1 % off is not told from 0.8 % any earlier.
fn sequential_scenario() -> String {
    let expect = "metric = \"static_error_percent\"\nat_most = 1.4\n[[expect]]\nmetric = \"settling_time_ms\"\nat_most = 6.0\n\
                  over = \"quantile\"\nquantile = 0.6\n[[expect]]\nmetric = \"settling_time_ms\"\nat_most = 6.0\nsignal = \"sensed_wd_um\"";
    step_scenario("aluminium-198x138-noisy", "", "", expect)
        + "[trials]\ncount = 4\nmax_count = 100\nseed = 3\n[trials.spread]\nsensor_gain_percent = 1.0\n"
}

#[test]
fn rejudging_repeats_the_sequential_decision() {
    let workshop = TestFolder::new();
    workshop.write_scenario("s.toml", &sequential_scenario());
    let read = |out: &str| RunRecord::read(&workshop.path().join(out)).unwrap();
    run_bench(workshop.path(), ["run", "--rig", "hosted", "--out", "one", "--jobs", "1"]);
    run_bench(workshop.path(), ["run", "--rig", "hosted", "--out", "five", "--jobs", "5"]);
    let (one, five) = (read("one"), read("five"));
    let of = |record: &RunRecord| (record.scenarios[0].expectations.clone(), record.scenarios[0].trials.len());
    assert_eq!(of(&one), of(&five));
    let (expectations, trials) = of(&one);
    let [number, planned] = expectations[0].evidence.look.unwrap();
    assert!(1 < number && number < planned && trials == 4 << (number - 1), "{number} of {planned}: {trials} trials");
    assert_eq!(one.verdict, Verdict::Pass, "{expectations:?}");
    for (live, out) in [(one, "one"), (five, "five")] {
        assert_eq!(live, rejudge(&workshop.path().join(out), None).unwrap());
    }
    // A stricter demand would have gone on; what was played does not decide it, and nobody is to blame.
    workshop.write_scenario("stricter.toml", &sequential_scenario().replace("at_most = 1.4", "at_most = 0.8"));
    let stricter =
        rejudge(&workshop.path().join("one"), Some(&workshop.path().join("scenarios/stricter.toml"))).unwrap();
    let found = &stricter.scenarios[0].expectations[0];
    assert_eq!((found.verdict, found.cause), (Verdict::Inconclusive, Some(Cause::Evidence)), "{found:?}");
}

#[test]
fn a_run_killed_between_interim_analyses_is_inconclusive() {
    let workshop = TestFolder::new();
    workshop.write_scenario("s.toml", &sequential_scenario());
    run_bench(workshop.path(), ["run", "--rig", "hosted", "--out", "run"]);
    let run = workshop.path().join("run");
    let mut record = RunRecord::read(&run).unwrap();
    assert!(record.scenarios[0].trials.len() > 4);
    record.complete = false;
    for trial in record.scenarios[0].trials.drain(..).skip(4) {
        fs::remove_file(run.join(&trial.trace)).unwrap();
    }
    record.write(&run).unwrap();
    let again = rejudge(&run, None).unwrap();
    assert_eq!(again.scenarios[0].trials.len(), 4);
    assert!(again.scenarios[0].expectations.iter().all(|found| found.cause == Some(Cause::Bench)));
}

#[test]
fn an_interrupted_run_can_be_judged_and_reported() {
    let workshop = TestFolder::new();
    workshop.write_scenario("s.toml", &three_trial_scenario());
    run_bench(workshop.path(), ["run", "--out", "run"]);
    let run = workshop.path().join("run");
    // What a kill leaves behind: a record without verdicts, whole traces and a provisional one.
    let mut record = RunRecord::read(&run).unwrap();
    assert_eq!(record.verdict, Verdict::Pass);
    record.complete = false;
    record.scenarios[0].trials.clear();
    record.scenarios[0].expectations.clear();
    record.write(&run).unwrap();
    fs::rename(run.join("traces/s/002.csv"), run.join("traces/s/002.csv.part")).unwrap();
    fs::remove_file(run.join("report.html")).unwrap();

    let again = rejudge(&run, None).unwrap();
    assert_eq!(again.verdict, Verdict::Inconclusive);
    assert_eq!(again.scenarios[0].trials.len(), 2);
    assert_eq!(again.scenarios[0].expectations[0].cause, Some(Cause::Bench));
    assert_eq!(exit_code(&run_bench(workshop.path(), ["judge", "run"])), 3);
    assert_eq!(exit_code(&run_bench(workshop.path(), ["report", "run"])), 0);
    assert!(fs::read_to_string(run.join("report.html")).unwrap().contains("inconclusive"));
}

/// All trials are whole and good, but nobody has seen the end: not a pass, wherever it is read.
#[test]
fn a_run_killed_after_its_last_trial_does_not_pass() {
    let workshop = TestFolder::new();
    workshop.write_scenario("s.toml", &step_scenario("aluminium-198x138", "", "", GOOD));
    run_bench(workshop.path(), ["run", "--rig", "hosted", "--out", "run"]);
    let run = workshop.path().join("run");
    let mut record = RunRecord::read(&run).unwrap();
    (record.complete, record.safe_confirmed) = (false, None);
    record.write(&run).unwrap();
    let output = run_bench(workshop.path(), ["judge", "run"]);
    let told = String::from_utf8_lossy(&output.stdout);
    assert_eq!(exit_code(&output), 3, "{told}");
    assert!(told.contains("the run was not finished") && told.contains("? inconclusive"), "{told}");
}

#[test]
fn the_report_dates_a_failure_from_earlier_runs() {
    let workshop = TestFolder::new();
    workshop.write_scenario(
        "s.toml",
        &step_scenario("aluminium-198x138", "", "", "metric = \"settling_time_ms\"\nat_most = 0.1"),
    );
    for out in ["runs/one", "runs/two"] {
        assert_eq!(exit_code(&run_bench(workshop.path(), ["run", "--rig", "hosted", "--out", out])), 1);
    }
    // Two runs may start in the same second.
    let one = workshop.path().join("runs/one");
    let mut record = RunRecord::read(&one).unwrap();
    record.started = "2020-01-01T00:00:00Z".to_owned();
    record.write(&one).unwrap();
    assert_eq!(exit_code(&run_bench(workshop.path(), ["report", "runs/two"])), 0);
    let two = workshop.path().join("runs/two");
    assert!(
        fs::read_to_string(two.join("report.html")).unwrap().contains("Since one (2020-01-01T00:00:00Z) or before")
    );
    assert_eq!(exit_code(&run_bench(workshop.path(), ["report", "runs/two", "--against", "runs/one"])), 0);
    let page = fs::read_to_string(two.join("comparison.html")).unwrap();
    assert!(page.contains("Comparison with the run of 2020-01-01T00:00:00Z") && page.contains("No verdict differs."));
    assert_eq!(exit_code(&run_bench(workshop.path(), ["report", "runs/two", "--against", "runs/nowhere"])), 2);
}

#[test]
fn stored_traces_can_be_judged_by_other_expectations() {
    let workshop = TestFolder::new();
    workshop.write_scenario("s.toml", &step_scenario("aluminium-198x138", "", "", GOOD));
    run_bench(workshop.path(), ["run", "--out", "run"]);
    let stricter = step_scenario("aluminium-198x138", "", "", "metric = \"settling_time_ms\"\nat_most = 1.9");
    workshop.write_scenario("stricter.toml", &stricter);
    assert_eq!(exit_code(&run_bench(workshop.path(), ["judge", "run"])), 0);
    assert_eq!(exit_code(&run_bench(workshop.path(), ["judge", "run", "--scenario", "scenarios/stricter.toml"])), 1);
}

#[test]
fn changed_inputs_are_rejected() {
    let workshop = TestFolder::new();
    workshop.write_scenario("s.toml", &step_scenario("aluminium-198x138", "", "", GOOD));
    run_bench(workshop.path(), ["run", "--out", "run"]);
    let stored = workshop.path().join("run/inputs/s.toml");
    let text = fs::read_to_string(&stored).unwrap();
    fs::write(&stored, text.replace("at_most = 2.0", "at_most = 9.0")).unwrap();
    let output = run_bench(workshop.path(), ["judge", "run"]);
    let told = String::from_utf8_lossy(&output.stderr);
    assert_eq!(exit_code(&output), 2, "{told}");
    assert!(told.contains("s.toml") && told.contains("SHA-256"), "{told}");
}

#[test]
fn a_tampered_trace_is_rejected_by_name() {
    let workshop = TestFolder::new();
    workshop.write_scenario("s.toml", &step_scenario("aluminium-198x138", "", "", GOOD));
    run_bench(workshop.path(), ["run", "--out", "run"]);
    let trace = workshop.path().join("run/traces/s/000.csv");
    let text = fs::read_to_string(&trace).unwrap();
    fs::write(&trace, text.replacen("control", "", 1)).unwrap();
    let output = run_bench(workshop.path(), ["judge", "run"]);
    let told = String::from_utf8_lossy(&output.stderr);
    assert_eq!(exit_code(&output), 2, "{told}");
    assert!(told.contains("000.csv") && told.contains("SHA-256"), "{told}");
}

/// A report can still be read; what it would draw is not drawn, of a run that was cut off neither.
#[test]
fn a_tampered_trace_is_named_and_not_drawn() {
    const SAID: &str = "traces/s/000.csv: changed after the run";
    let workshop = TestFolder::new();
    workshop.write_scenario("s.toml", &step_scenario("aluminium-198x138", "", "", GOOD));
    workshop.write_scenario("t.toml", &step_scenario("aluminium-198x138", "", "", GOOD));
    run_bench(workshop.path(), ["run", "--rig", "hosted", "--out", "run"]);
    let run = workshop.path().join("run");
    let report = || {
        let output = run_bench(workshop.path(), ["report", "run"]);
        assert_eq!(exit_code(&output), 0);
        (fs::read_to_string(run.join("report.html")).unwrap(), String::from_utf8_lossy(&output.stderr).into_owned())
    };
    let (clean, _) = report();
    let drawings = |page: &str| page.matches("Amplitude |W|</figcaption>").count();
    assert!(!clean.contains("changed after") && drawings(&clean) >= 2);
    let trace = run.join("traces/s/000.csv");
    let text = fs::read_to_string(&trace).unwrap();
    fs::write(&trace, text.replacen("control", "", 1)).unwrap();
    let (page, _) = report();
    assert!(page.contains(SAID) && page.contains("1 trace changed after the run"));
    assert_eq!(drawings(&page) * 2, drawings(&clean), "of t.toml only");

    let mut record = RunRecord::read(&run).unwrap();
    record.complete = false;
    record.scenarios[1].trials.clear();
    record.scenarios[1].expectations.clear();
    record.write(&run).unwrap();
    let (page, told) = report();
    assert!(told.contains("000.csv: SHA-256"), "{told}");
    assert!(page.contains(SAID) && page.contains("was not finished") && drawings(&page) == 0);
}

#[test]
fn rejects_a_record_of_another_format() {
    let workshop = TestFolder::new();
    fs::create_dir(workshop.path().join("run")).unwrap();
    fs::write(workshop.path().join("run/run.json"), "{\n  \"format\": 2\n}").unwrap();
    let output = run_bench(workshop.path(), ["judge", "run"]);
    assert_eq!(exit_code(&output), 2);
    assert!(String::from_utf8_lossy(&output.stderr).contains("format 2, expected 1"));
}

#[rstest]
#[case::duration("duration_ms = 60.0", "duration_ms = 30.0", "duration_ms")]
#[case::setpoint("setpoint_um = 2.0", "setpoint_um = 1.0", "[profile]")]
#[case::controller("[controller]", "[controller]\nloop_delay_ms = 0.1", "[controller]")]
#[case::trials("[profile]", "[trials]\nseed = 9\n[profile]", "[trials]")]
#[case::plate("aluminium-198x138.toml", "aluminium-198x138-noisy.toml", "the plate")]
fn stored_traces_reject_another_experiment(#[case] good: &str, #[case] other: &str, #[case] named: &str) {
    let workshop = TestFolder::new();
    let text = step_scenario("aluminium-198x138", "", "", GOOD);
    assert!(text.contains(good));
    workshop.write_scenario("s.toml", &text);
    run_bench(workshop.path(), ["run", "--out", "run"]);
    workshop.write_scenario("other.toml", &text.replacen(good, other, 1));
    let output = run_bench(workshop.path(), ["judge", "run", "--scenario", "scenarios/other.toml"]);
    let told = String::from_utf8_lossy(&output.stderr);
    assert_eq!(exit_code(&output), 2, "{told}");
    assert!(told.contains(named) && told.contains("differs from the scenario that was played"), "{told}");
}

#[test]
fn scenarios_inside_a_run_folder_are_not_run() {
    let workshop = TestFolder::new();
    workshop.write_scenario("s.toml", &step_scenario("aluminium-198x138", "", "", GOOD));
    assert_eq!(exit_code(&run_bench(workshop.path(), ["run", "--out", "scenarios/kept"])), 0);
    assert_eq!(exit_code(&run_bench(workshop.path(), ["run", "--out", "again"])), 0);
    assert_eq!(RunRecord::read(&workshop.path().join("again")).unwrap().scenarios.len(), 1);
}

#[test]
fn an_absolute_plate_path_is_judged_by_its_copy() {
    let workshop = TestFolder::new();
    let plate = workshop.path().join("elsewhere.toml");
    let text = fs::read_to_string(workshop.path().join("scenarios/plates/aluminium-198x138.toml")).unwrap();
    fs::write(&plate, &text).unwrap();
    let scenario = step_scenario("aluminium-198x138", "", "", GOOD);
    let absolute = scenario.replace("plates/aluminium-198x138.toml", plate.to_str().unwrap());
    workshop.write_scenario("s.toml", &absolute);
    assert_eq!(exit_code(&run_bench(workshop.path(), ["run", "--rig", "hosted", "--out", "run"])), 0);
    assert_eq!(exit_code(&run_bench(workshop.path(), ["judge", "run"])), 0);
    // What the laboratory does with the original afterwards is nothing to a run that was played.
    fs::write(&plate, text.replace("limit_vpp = 900.0", "limit_vpp = 500.0")).unwrap();
    assert_eq!(exit_code(&run_bench(workshop.path(), ["judge", "run"])), 0);
    fs::remove_file(&plate).unwrap();
    assert_eq!(exit_code(&run_bench(workshop.path(), ["judge", "run"])), 0);
    let copy = workshop.path().join("run/inputs/elsewhere.toml");
    fs::write(&copy, text.replace("limit_vpp = 900.0", "limit_vpp = 500.0")).unwrap();
    let output = run_bench(workshop.path(), ["judge", "run"]);
    let told = String::from_utf8_lossy(&output.stderr);
    assert_eq!(exit_code(&output), 2, "{told}");
    assert!(told.contains("elsewhere.toml") && told.contains("SHA-256"), "{told}");
}

#[test]
fn a_scenario_behind_a_symlink_can_be_judged() {
    let workshop = TestFolder::new();
    let text = step_scenario("aluminium-198x138", "", "", GOOD)
        .replace("plates/", "../plates/")
        .replace("setpoint_um = 2.0", "setpoint_um = { csv = \"../setpoint.csv\" }");
    let at = |name: &str| workshop.path().join(name);
    fs::create_dir_all(at("elsewhere/deep")).unwrap();
    fs::write(at("elsewhere/deep/s.toml"), text).unwrap();
    fs::write(at("elsewhere/setpoint.csv"), "t_ms,value\n0,2\n").unwrap();
    // The name above a link is not the name above what it leads to, and both lead to the same.
    std::os::unix::fs::symlink(at("scenarios/plates"), at("elsewhere/plates")).unwrap();
    std::os::unix::fs::symlink(at("elsewhere/deep"), at("scenarios/linked")).unwrap();
    let run = run_bench(workshop.path(), ["run", "scenarios/linked/s.toml", "--rig", "hosted", "--out", "run"]);
    assert_eq!(exit_code(&run), 0, "{}", String::from_utf8_lossy(&run.stderr));
    let judged = run_bench(workshop.path(), ["judge", "run"]);
    assert_eq!(exit_code(&judged), 0, "{}", String::from_utf8_lossy(&judged.stderr));
}
