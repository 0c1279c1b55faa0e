//! Tests stored runs that are judged or reported again, interrupted, or changed.

use crate::test_folder::{FAILED_SETTLING, SETTLING, TestFolder, run_bench, step_scenario, step_text, workspace_root};
use platebench_engine::rejudge;
use platebench_model::record::{Cause, RunRecord, Verdict};
use std::fs;

#[test]
fn judging_again_gives_identical_results() {
    let folder = tempfile::tempdir().unwrap();
    for (part, rig) in [("paper", "hosted"), ("limits", "hosted"), ("faults", "emulated")] {
        let scenarios = workspace_root().join("scenarios").join(part);
        run_bench(folder.path(), ["run", scenarios.to_str().unwrap(), "--rig", rig, "--out", part]);
        let live = RunRecord::read(&folder.path().join(part)).unwrap();
        assert!(live.complete && live.scenarios.len() >= 4);
        assert_eq!(live, rejudge(&folder.path().join(part), None).unwrap());
    }
}

/// 4 trials cannot tell a sensor error of 1 % from one of 0.8 %, so a verdict needs 8 or 16 trials.
fn sequential_scenario() -> String {
    let expect = "metric = \"static_error_percent\"\nat_most = 1.4\n\
                  [[expect]]\nmetric = \"settling_time_ms\"\nat_most = 6.0\nover = \"quantile\"\nquantile = 0.6\n\
                  [[expect]]\nmetric = \"settling_time_ms\"\nat_most = 6.0\nsignal = \"sensed_wd_um\"";
    step_scenario("aluminium-198x138-noisy", "", "", expect)
        + "[trials]\ncount = 4\nmax_count = 100\nseed = 3\n[trials.spread]\nsensor_gain_percent = 1.0\n"
}

#[test]
fn rejudging_repeats_the_sequential_decision() {
    let folder = TestFolder::with_scenario(&sequential_scenario());
    let run = |out: &str, jobs: &str| {
        folder.bench(["run", "--rig", "hosted", "--out", out, "--jobs", jobs]);
        folder.record(out)
    };
    let (one, five) = (run("one", "1"), run("five", "5"));
    let results = |record: &RunRecord| (record.scenarios[0].expectations.clone(), record.scenarios[0].trials.len());
    assert_eq!(results(&one), results(&five));
    let (expectations, trials) = results(&one);
    let [number, planned] = expectations[0].evidence.look.unwrap();
    assert!(1 < number && number < planned && trials == 4 << (number - 1), "{number} of {planned}: {trials} trials");
    assert_eq!(one.verdict, Verdict::Pass, "{expectations:?}");
    for (live, out) in [(one, "one"), (five, "five")] {
        assert_eq!(live, rejudge(&folder.join(out), None).unwrap());
    }
    let stricter =
        folder.write_scenario("stricter.toml", &sequential_scenario().replace("at_most = 1.4", "at_most = 0.8"));
    let stricter = rejudge(&folder.join("one"), Some(&stricter)).unwrap();
    let result = &stricter.scenarios[0].expectations[0];
    assert_eq!((result.verdict, result.cause), (Verdict::Inconclusive, Some(Cause::Evidence)), "{result:?}");
}

#[test]
fn a_run_killed_between_interim_analyses_is_inconclusive() {
    let folder = TestFolder::with_scenario(&sequential_scenario());
    folder.run_hosted("run");
    let run = folder.join("run");
    assert!(folder.record("run").scenarios[0].trials.len() > 4);
    folder.interrupt("run", 4);
    let again = rejudge(&run, None).unwrap();
    assert_eq!(again.scenarios[0].trials.len(), 4);
    assert!(again.scenarios[0].expectations.iter().all(|it| it.cause == Some(Cause::Bench)));
}

#[test]
fn an_interrupted_run_can_be_judged_and_reported() {
    let expect = "metric = \"settling_time_ms\"\nat_most = 4.0";
    let trials = "[trials]\ncount = 3\n[trials.spread]\nsensor_gain_percent = 1.0\n";
    let folder = TestFolder::with_scenario(&(step_scenario("aluminium-198x138-noisy", "", "", expect) + trials));
    folder.run_hosted("run");
    let run = folder.join("run");
    assert_eq!(folder.record("run").verdict, Verdict::Pass);
    folder.interrupt("run", 2);
    fs::remove_file(run.join("report.html")).unwrap();

    let again = rejudge(&run, None).unwrap();
    assert_eq!(again.verdict, Verdict::Inconclusive);
    assert_eq!(again.scenarios[0].trials.len(), 2);
    assert_eq!(again.scenarios[0].expectations[0].cause, Some(Cause::Bench));
    folder.bench(["report", "run", "--rejudge"]).assert_exit(3);
    folder.bench(["report", "run"]).assert_exit(0);
    assert!(folder.read("run/report.html").contains("inconclusive"));
}

#[test]
fn the_report_dates_a_failure_from_earlier_runs() {
    let folder = TestFolder::with_step("metric = \"settling_time_ms\"\nat_most = 0.1");
    for out in ["runs/one", "runs/two"] {
        folder.run_hosted(out).assert_exit(1);
    }
    // Two runs may start in the same second, so the first one gets an earlier time.
    let mut record = folder.record("runs/one");
    record.started = "2020-01-01T00:00:00Z".to_owned();
    record.write(&folder.join("runs/one")).unwrap();
    folder.bench(["report", "runs/two"]).assert_exit(0);
    assert!(folder.read("runs/two/report.html").contains("Since one (2020-01-01T00:00:00Z) or before"));
    folder.bench(["report", "runs/two", "--against", "runs/one"]).assert_exit(0);
    let page = folder.read("runs/two/comparison.html");
    assert!(page.contains("Comparison with the run of 2020-01-01T00:00:00Z") && page.contains("No verdict differs."));
    folder.bench(["report", "runs/two", "--against", "runs/nowhere"]).assert_exit(2);
}

#[test]
fn a_tampered_trace_is_named_and_not_drawn() {
    const NOTICE: &str = "traces/s/000.csv: changed after the run";
    let folder = TestFolder::with_step(SETTLING);
    folder.write_scenario("t.toml", &step_text(SETTLING));
    folder.run_hosted("run");
    let report = || {
        let stderr = folder.bench(["report", "run"]).assert_exit(0).stderr;
        (folder.read("run/report.html"), stderr)
    };
    let (clean, _) = report();
    let drawings = |page: &str| page.matches("Amplitude |W|</figcaption>").count();
    assert!(!clean.contains("changed after") && drawings(&clean) >= 2);
    folder.tamper_with_trace();
    let (page, _) = report();
    assert!(page.contains(NOTICE) && page.contains("1 trace changed after the run"));
    assert_eq!(drawings(&page) * 2, drawings(&clean), "of t.toml only");

    folder.interrupt("run", 2);
    let (page, stderr) = report();
    assert!(stderr.contains("000.csv: SHA-256"), "{stderr}");
    assert!(page.contains(NOTICE) && page.contains("was not finished") && drawings(&page) * 2 <= drawings(&clean));
}

#[test]
fn without_kept_traces_the_verdicts_are_the_same() {
    let folder = TestFolder::new();
    folder.write_scenario("a.toml", &step_text(SETTLING));
    folder.write_scenario("b.toml", &step_text(FAILED_SETTLING));
    let run = |out: &str, more: &[&str]| {
        folder.bench(["run", "--rig", "hosted", "--out", out].iter().chain(more)).assert_exit(1);
        let record = folder.record(out);
        record.scenarios.into_iter().map(|scenario| scenario.expectations).collect::<Vec<_>>()
    };
    assert_eq!(run("none", &["--keep-traces", "none"]), run("all", &[]));
    assert!(!folder.join("none/traces").exists());
    // Without traces, the report draws the rows that the run kept in memory.
    let curves = |out: &str| {
        let page = fs::read_to_string(folder.join(out).join("report.html")).unwrap();
        page.split("<script class=\"curves\"")
            .skip(1)
            .map(|part| part.split_once("</script>").unwrap().0.to_owned())
            .collect()
    };
    let [none, all]: [Vec<String>; 2] = ["none", "all"].map(curves);
    assert_eq!((none.len(), &none), (2, &all));
}

#[test]
fn keeps_the_traces_of_failing_or_worst_trials() {
    let folder = TestFolder::new();
    folder.write_scenario("a.toml", &step_text(SETTLING));
    folder.write_scenario("b.toml", &step_text(FAILED_SETTLING));
    let stored = |which: &str, out: &str| {
        let arguments = ["run", "--rig", "hosted", "--trials", "3", "--keep-traces", which, "--out", out];
        folder.bench(arguments).assert_exit(1);
        let scenarios = folder.record(out).scenarios;
        let counts = scenarios.iter().map(|scenario| {
            let files = scenario.trials.iter().filter(|trial| folder.join(out).join(&trial.trace).is_file()).count();
            let hashes = scenario.trials.iter().filter(|trial| trial.sha256.is_some()).count();
            assert_eq!(files, hashes, "{out}: {}", scenario.file);
            files
        });
        counts.collect::<Vec<_>>()
    };
    assert_eq!(stored("failing", "failing"), [0, 3]);
    assert_eq!(stored("worst:2", "worst"), [2, 2]);
}
