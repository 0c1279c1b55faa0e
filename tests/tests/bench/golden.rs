//! Tests baselines: review, acceptance and comparison.

use crate::test_folder::{
    FAILED_SETTLING, ProgramOutput, SETTLING, TestFolder, bench_command, run_bench, step_scenario, step_text,
    workspace_root,
};
use platebench_model::record::RunRecord;
use platebench_verdict::golden::ResponseFeatures;
use rstest::rstest;
use std::fmt::Write as _;
use std::fs;
use std::io::Write as _;
use std::path::Path;
use std::process::Stdio;

const HEAD: &str = "scenarios/baselines/s.toml";
const TABLE: &str = "scenarios/baselines/s.csv";
const TRACE: &str = "run/traces/s/000.csv";

fn run_paper(folder: &Path, more: &[&str]) {
    let paper = workspace_root().join("scenarios/paper");
    run_bench(folder, ["run", paper.to_str().unwrap(), "--rig", "hosted", "--out", "run"].iter().chain(more));
}

fn compare_with_baselines(folder: &Path) -> ProgramOutput {
    let baselines = workspace_root().join("scenarios/baselines").display().to_string();
    run_bench(folder, ["compare", "run", "baseline", "--baselines", &baselines])
}

#[track_caller]
fn compare(folder: &TestFolder, subject: &str, reference: &str) -> ProgramOutput {
    folder.bench(["compare", subject, reference])
}

#[test]
fn the_paper_s_scenarios_match_their_baselines() {
    let folder = tempfile::tempdir().unwrap();
    run_paper(folder.path(), &[]);
    let output = compare_with_baselines(folder.path()).assert_exit(0);
    assert_eq!(output.text().matches("✓ pass  paper/").count(), 11);
    assert!(!folder.path().join("run/comparison").exists(), "no difference to draw");
    insta::assert_snapshot!("features_of_the_paper_s_scenarios", feature_table(&folder.path().join("run")));
}

#[test]
fn another_law_differs_from_every_baseline() {
    let folder = tempfile::tempdir().unwrap();
    run_paper(folder.path(), &["--law", "dq-pi-euler"]);
    let output = compare_with_baselines(folder.path())
        .assert_text(1, &["trial 0: amplitude_um is 2.33 µm at 2 ms, 0.6989 µm outside ± 0.01795 µm around 1.59 µm"]);
    assert_eq!(output.text().matches("✗ fail  paper/").count(), 11, "{}", output.text());
    let svg = fs::read_to_string(folder.path().join("run/comparison/paper/fig13-closed-loop.svg")).unwrap();
    assert!(svg.contains("amplitude_um at 2 ms"));
}

fn feature_table(run: &Path) -> String {
    let mut table = String::new();
    for scenario in RunRecord::read(run).unwrap().scenarios {
        let rows = platebench_model::trace::read_trace(&run.join(&scenario.trials[0].trace)).unwrap();
        let features = ResponseFeatures::of(&rows).by_name().map(|(name, value)| {
            format!("{name} {}", value.map_or_else(|| "none".to_owned(), |value| value.to_string()))
        });
        writeln!(table, "{}: {}", scenario.file, features.join(", ")).unwrap();
    }
    table
}

fn run_folder(text: &str) -> TestFolder {
    let folder = TestFolder::with_scenario(text);
    folder.run_hosted("run");
    folder
}

#[test]
fn an_accepted_baseline_is_listed_and_compared() {
    let folder = run_folder(&step_text(SETTLING));
    compare(&folder, "run", "baseline").assert_text(4, &["nothing was compared", "platebench baseline review run"]);
    let review = folder.bench(["baseline", "diff", "run"]).assert_exit(4);
    assert_eq!(review.stdout, "? new  s.toml\n");
    assert!(!folder.exists(HEAD), "a review writes nothing");
    let accepted = folder.bench(["baseline", "accept", "run"]).assert_exit(0).text();
    assert!(accepted.starts_with("✓ accepted  s.toml  (new, settling_time_ms 1.96,"), "{accepted}");
    assert_eq!(folder.bench(["baseline", "accept", "run"]).text(), "✓ unchanged  s.toml\n");
    for arguments in [&["baseline", "list"][..], &["baseline", "list", "run"]] {
        let list = folder.bench(arguments).assert_exit(0).text();
        assert!(list.starts_with("✓ s.toml: dq-pi, settling_time_ms 1.96"), "{list}");
    }
    for reference in ["baseline", "run", HEAD, TRACE] {
        for subject in ["run", TRACE] {
            compare(&folder, subject, reference).assert_exit(0);
        }
    }
    folder.run_hosted("again");
    assert_eq!(folder.record("again").scenarios.len(), 1);
}

#[test]
fn a_change_is_shown_before_it_is_accepted() {
    let folder = run_folder(&step_text(SETTLING));
    folder.bench(["baseline", "accept", "run"]);
    let before = folder.read(TABLE);
    folder.replace(HEAD, "absolute = 0.01", "absolute = 0.0123");
    folder.write_scenario("s.toml", &step_scenario("aluminium-198x138", "response_time_ms = 1.8", "", SETTLING));
    folder.run_hosted("other");
    folder
        .bench(["baseline", "diff", "other"])
        .assert_text(1, &["✗ fail  s.toml", "trial 0: ", "settling_time_ms: 1.96 → 1.", "drive_peak_vpp: 551 → "]);
    assert_eq!(folder.read(TABLE), before);
    folder.bench(["baseline", "accept", "other"]).assert_output(&["✓ accepted  s.toml\n", "drive_peak_vpp: 551 → "]);
    assert_ne!(folder.read(TABLE), before);
    assert!(folder.read(HEAD).contains("absolute = 0.0123"));
    compare(&folder, "other", "baseline").assert_exit(0);
    compare(&folder, "run", "baseline").assert_exit(1);
    compare(&folder, "run", "other").assert_exit(1);
}

#[test]
fn a_review_draws_each_difference_and_asks() {
    let folder = run_folder(&step_text(SETTLING));
    folder.bench(["baseline", "accept", "run"]);
    let before = folder.read(TABLE);
    folder.write_scenario("s.toml", &step_scenario("aluminium-198x138", "response_time_ms = 1.8", "", SETTLING));
    folder.run_hosted("other");
    let review = |answers: &str| {
        let mut command = bench_command(folder.path());
        command.args(["baseline", "review", "other"]).stdin(Stdio::piped()).stdout(Stdio::piped());
        let mut child = command.stderr(Stdio::piped()).spawn().unwrap();
        child.stdin.take().unwrap().write_all(answers.as_bytes()).unwrap();
        let output = child.wait_with_output().unwrap();
        let [shown, asked] = [output.stdout, output.stderr].map(|bytes| String::from_utf8(bytes).unwrap());
        (output.status.code(), shown, asked.matches("accept, reject, skip? ").count())
    };
    let (code, shown, asked) = review("what\nr\n");
    assert_eq!((code, asked), (Some(1), 2), "{shown}");
    assert!(shown.contains("settling_time_ms: 1.96 → 1.") && shown.contains("# this run   - golden"), "{shown}");
    for signal in ["amplitude_um, µm", "drive_vpp, Vpp"] {
        assert!(shown.contains(&format!("  {signal}   #")), "every signal that differs has a drawing: {shown}");
    }
    assert_eq!(review("").0, Some(1), "no answer accepts nothing");
    assert_eq!(folder.read(TABLE), before);
    assert_eq!(review("a\n").0, Some(0));
    assert_ne!(folder.read(TABLE), before);
    let (code, shown, asked) = review("");
    assert_eq!((code, asked), (Some(0), 0), "no difference is left: {shown}");
}

#[test]
fn a_failed_run_is_not_accepted_as_a_baseline() {
    let folder = run_folder(&step_text(FAILED_SETTLING));
    folder.bench(["baseline", "accept", "run"]).assert_text(1, &["✗ not accepted  s.toml: it did not pass (fail)"]);
    assert!(!folder.exists("scenarios/baselines"));
}

const SPREAD: &str = "[trials]\ncount = 30\n[trials.spread]\nsensor_gain_percent = 0.2\ntime_constant_percent = 1.0\n";

#[test]
fn a_tube_is_learned_from_varying_trials() {
    let expect = "metric = \"settling_time_ms\"\nat_most = 6.0\nover = \"mean\"";
    let folder = run_folder(&(step_scenario("aluminium-198x138-noisy", "", "", expect) + SPREAD));
    folder
        .bench(["baseline", "accept", "run", "--false-alarm-rate", "0.01"])
        .assert_text(2, &["a false-alarm rate of 0.01 needs at least 148 trials, this run has 30"]);
    folder.bench(["baseline", "accept", "run"]).assert_exit(0);
    let head = folder.read(HEAD);
    assert!(head.contains("[learned]\ntrials = 30\nfalse_alarm_rate = 0.05"), "{head}");
    folder.bench(["run", "--rig", "hosted", "--out", "other", "--seed", "1000"]);
    let output = compare(&folder, "other", "baseline");
    assert_ne!(output.exit, 1, "{}", output.text());
    // Only runs with equal seeds have equal noise.
    compare(&folder, "run", "run").assert_exit(0);
    compare(&folder, "other", "run").assert_exit(1);
    folder.bench(["run", "--rig", "hosted", "--out", "few", "--trials", "3"]);
    compare(&folder, "few", "run").assert_exit(0);
    compare(&folder, "run", "few").assert_text(3, &["the reference has no complete trial 3"]);
}

#[rstest]
#[case::no_subject(&["compare", "nowhere", "run"], "nowhere")]
#[case::no_reference(&["compare", "run", "nowhere"], "nowhere")]
#[case::no_against(&["compare", "run"], "<TRACE|RUN|baseline>")]
#[case::no_scenario(&["compare", "loose.csv", "baseline"], "its scenario is unknown")]
#[case::half_a_trace(&["compare", "half.csv", TRACE], "half.csv:1: columns")]
#[case::other_columns(&["compare", "run", "half.csv"], "half.csv:1: columns")]
#[case::rate(&["baseline", "accept", "run", "--false-alarm-rate", "0"], "expected a share")]
#[case::no_run(&["baseline", "diff", "nowhere"], "nowhere")]
#[case::no_folder(&["baseline", "list", "--baselines", "nowhere"], "nowhere")]
#[case::broken(&["compare", "run", "broken.toml"], "broken.toml:1:")]
fn wrong_usage_names_the_argument(#[case] arguments: &[&str], #[case] named: &str) {
    let folder = run_folder(&step_text(SETTLING));
    let trace = folder.read(TRACE);
    folder.write("loose.csv", &trace);
    folder.write("half.csv", &trace.replace("setpoint_um,", ""));
    folder.write("broken.toml", "colour = 1\n");
    folder.write("broken.csv", "t_ms\n");
    folder.bench(arguments).assert_text(2, &[named]);
}

#[test]
fn a_trace_of_another_length_is_inconclusive() {
    let folder = run_folder(&step_text(SETTLING));
    let trace = folder.read(TRACE);
    let count = trace.lines().count();
    let short = trace.split_inclusive('\n').take(count - 10).collect::<String>();
    folder.write("short.csv", &short);
    for [subject, reference] in [["short.csv", "run"], ["run", "short.csv"]] {
        compare(&folder, subject, reference).assert_text(3, &["ms, expected those of the baseline, from 0 to"]);
    }
}

#[test]
fn nothing_compared_does_not_pass() {
    let folder = run_folder(&step_text(SETTLING));
    folder.bench(["baseline", "accept", "run"]).assert_exit(0);
    fs::create_dir(folder.join("empty")).unwrap();
    for (baselines, why) in [("baseline", "baseline is no folder"), ("empty", "empty has no golden trace for run")] {
        let arguments = ["compare", "run", "baseline", "--baselines", baselines];
        folder.bench(arguments).assert_message(4, &["nothing was compared", why]);
        folder.bench(["baseline", "diff", "run", "--baselines", baselines]).assert_exit(4);
    }
    let mut record = folder.record("run");
    record.scenarios.clear();
    fs::create_dir(folder.join("nothing")).unwrap();
    record.write(&folder.join("nothing")).unwrap();
    for arguments in [
        &["report", "nothing", "--rejudge"][..],
        &["report", "--merge", "nothing", "--out", "joined"],
        &["compare", "nothing", "run"],
        &["compare", "run", "nothing"],
        &["baseline", "accept", "nothing"],
    ] {
        folder.bench(arguments).assert_exit(4);
    }
}

#[test]
fn a_comparison_needs_a_time_range_without_holes() {
    let folder = run_folder(&step_text(SETTLING));
    folder.bench(["baseline", "accept", "run"]).assert_exit(0);
    let trace = folder.read(TRACE);
    let keep = |is_kept: &dyn Fn(usize, f64) -> bool| {
        let time_ms = |line: &str| line.split(',').next().unwrap().parse().map_or(0.0, |t_s: f64| t_s * 1e3);
        let lines = trace.split_inclusive('\n').enumerate();
        lines.filter(|(index, line)| is_kept(*index, time_ms(line))).map(|(_, line)| line).collect::<String>()
    };
    folder.write("one.csv", &keep(&|index, _| index <= 1));
    folder.write("other.csv", &keep(&|index, _| index <= 1));
    compare(&folder, "one.csv", "other.csv").assert_text(4, &["fewer than two rows"]);
    compare(&folder, "one.csv", TRACE).assert_exit(3);
    folder.write("hole.csv", &keep(&|_, t_ms| !(30.0..50.0).contains(&t_ms)));
    let gap = |subject: &str, reference: &str, place: &str| {
        compare(&folder, subject, reference).assert_text(1, &[place, "no rows between 29.95 and 50 ms"]);
    };
    for reference in [TRACE, "run", HEAD] {
        gap("hole.csv", reference, "trial 0 has");
    }
    gap(TRACE, "hole.csv", "the reference has");
    gap("run", "hole.csv", "the reference has");
    compare(&folder, "hole.csv", "hole.csv").assert_exit(0);
}

#[test]
fn json_equals_the_text() {
    let folder = run_folder(&step_text(SETTLING));
    let verdicts = folder.bench(["compare", "run", "run", "--format", "json"]).json();
    assert_eq!((&verdicts[0]["scenario"], &verdicts[0]["verdict"]), (&"s.toml".into(), &"pass".into()));
}

#[test]
fn a_tampered_trace_is_neither_accepted_nor_compared() {
    let folder = run_folder(&step_text(SETTLING));
    folder.bench(["baseline", "accept", "run"]).assert_exit(0);
    folder.tamper_with_trace();
    folder.bench(["baseline", "accept", "run"]).assert_text(2, &["000.csv: SHA-256"]);
    compare(&folder, "run", "baseline").assert_text(2, &["000.csv: SHA-256"]);
}

#[test]
fn missing_trials_are_reported() {
    let trials = "[trials]\ncount = 3\n[trials.spread]\nsensor_gain_percent = 1.0\n";
    let folder = run_folder(&(step_scenario("aluminium-198x138-noisy", "", "", SETTLING) + trials));
    folder.bench(["run", "--rig", "hosted", "--out", "few", "--trials", "1"]);
    compare(&folder, "few", "run").assert_text(0, &["s.toml: the run has only 1 of the 3 trials of run"]);
    compare(&folder, "run", "run").assert_output_without("trials of run");
}
