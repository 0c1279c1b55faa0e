//! Tests which scenarios are listed, selected and skipped.

use crate::test_folder::{FAILED_SETTLING, SETTLING, TestFolder, run_bench, step_text};
use Verdict::{Fail, Inconclusive, Pass};
use platebench_model::record::{Cause, RunRecord, ScenarioRecord, Verdict};
use rstest::rstest;
use serde_json::{Value, json};
use std::fs;

fn tagged(tags: &str, expect: &str) -> String {
    format!("tags = [{tags}]\n{}", step_text(expect))
}

fn tagged_folder() -> TestFolder {
    let folder = TestFolder::new();
    folder.write_scenario("a.toml", &tagged("\"paper\", \"acceptance\"", SETTLING));
    folder.write_scenario("b.toml", &tagged("\"paper\"", FAILED_SETTLING));
    folder.write_scenario("c.toml", &tagged("\"laws\"", SETTLING));
    folder.write_scenario("d.toml", &step_text(SETTLING));
    folder
}

fn listed_files(folder: &TestFolder, arguments: &[&str]) -> Vec<String> {
    let list = folder.bench(["run", "--list", "--format", "json"].iter().chain(arguments)).assert_exit(0).json();
    let files = list["scenarios"].as_array().unwrap().iter().map(|scenario| scenario["file"].as_str().unwrap());
    files.map(str::to_owned).collect()
}

#[rstest]
#[case::all(&[], &["a.toml", "b.toml", "c.toml", "d.toml"])]
#[case::one(&["--tag", "acceptance"], &["a.toml"])]
#[case::any(&["--tag", "acceptance", "--tag", "laws"], &["a.toml", "c.toml"])]
#[case::without(&["--not-tag", "paper"], &["c.toml", "d.toml"])]
#[case::without_wins(&["--tag", "paper", "--not-tag", "acceptance"], &["b.toml"])]
#[case::text(&["-k", "B.TOML"], &["b.toml"])]
#[case::any_text(&["-k", "a.", "-k", "c."], &["a.toml", "c.toml"])]
#[case::text_and_tag(&["-k", ".toml", "--tag", "laws"], &["c.toml"])]
#[case::name(&["b.toml"], &["b.toml"])]
#[case::shard_of_selected(&["--tag", "paper", "--shard", "2/2"], &["b.toml"])]
fn tags_select_scenarios(#[case] arguments: &[&str], #[case] expected: &[&str]) {
    assert_eq!(listed_files(&tagged_folder(), arguments), expected);
}

#[test]
fn only_selected_scenarios_are_played() {
    let folder = tagged_folder();
    folder.bench(["run", "--rig", "hosted", "--out", "run", "--not-tag", "paper"]).assert_exit(0);
    let files: Vec<_> = folder.record("run").scenarios.into_iter().map(|scenario| scenario.file).collect();
    assert_eq!(files, ["c.toml", "d.toml"]);
}

#[rstest]
#[case::run(&["run", "--rig", "hosted", "--out", "run"])]
#[case::list(&["run", "--list"])]
#[case::check(&["check"])]
#[case::trust(&["suite", "trust"])]
fn nothing_selected_is_nothing_to_run(#[case] command: &[&str]) {
    let folder = tagged_folder();
    folder.bench(command.iter().chain(&["--tag", "papers"])).assert_message(4, &["there is nothing to"]);
    assert!(!folder.exists("run"));
}

#[test]
fn an_unknown_tag_is_reported() {
    let folder = tagged_folder();
    let near = "no scenario has the tag `papers`; did you mean `paper`?";
    folder.bench(["run", "--list", "--tag", "papers", "--tag", "laws"]).assert_message(0, &[near]);
    let far = "no scenario has the tag `x`; known tags: acceptance, laws, paper";
    folder.bench(["run", "--list", "--not-tag", "x"]).assert_message(0, &[far]);
}

#[test]
fn an_unknown_text_of_a_name_is_reported() {
    let folder = TestFolder::new();
    folder.write_scenario("ramp-slow.toml", &step_text(SETTLING));
    let message = "no scenario name contains `ramp-slw`; did you mean `ramp-slow`?";
    folder.bench(["run", "--list", "-k", "ramp-slw"]).assert_exit(4).assert_stderr(&[message]);
}

#[test]
fn the_names_of_messages_are_arguments_from_any_folder() {
    let folder = tagged_folder();
    fs::create_dir_all(folder.join("docs/notes")).unwrap();
    let run = |arguments: &[&str]| run_bench(&folder.join("docs/notes"), arguments);
    let list = |arguments: &[&str]| run(&[&["run", "--list", "-q"], arguments].concat()).assert_exit(0).stdout;
    assert_eq!(list(&[]), "a.toml\nb.toml\nc.toml\nd.toml\n");
    assert_eq!(list(&["b.toml"]), "b.toml\n");
    assert_eq!(list(&["scenarios/b.toml", "c"]), "b.toml\nc.toml\n");
    run(&["check", "b.toml"]).assert_exit(0).assert_stdout(&["no faults in 1 scenario"]);
    run(&["check", "plates/aluminium-198x138.toml"]).assert_exit(0).assert_stdout(&["no faults in 1 plate"]);
    folder.write_scenario("fig13.toml", &step_text(SETTLING));
    run(&["run", "fig31.toml"])
        .assert_exit(2)
        .assert_stderr(&["fig31.toml: cannot be read", "did you mean `fig13.toml`?"]);
}

#[test]
fn last_failed_selects_what_did_not_pass_in_the_newest_run() {
    let folder = tagged_folder();
    let list = ["run", "--list", "-q", "--last-failed"];
    folder.bench(list).assert_exit(2).assert_stderr(&["--last-failed: runs contains no run"]);
    folder.bench(["run", "--rig", "hosted"]).assert_exit(1);
    assert_eq!(folder.bench(list).assert_exit(0).stdout, "b.toml\n");
    folder.replace("scenarios/b.toml", FAILED_SETTLING, SETTLING);
    folder.bench(["run", "--rig", "hosted", "--last-failed", "--runs", "runs"]).assert_exit(0);
    folder.bench(list).assert_exit_in(&[0, 4]);
}

#[test]
fn last_failed_selects_named_scenarios_and_reports_missing_ones() {
    let folder = TestFolder::new();
    folder.write_scenario("limit.toml", &format!("only_if_named = \"known limit\"\n{}", step_text(FAILED_SETTLING)));
    folder.write_scenario("gone.toml", &step_text(FAILED_SETTLING));
    folder.bench(["run", "--rig", "hosted", "--runs", "other", "limit.toml", "gone.toml"]).assert_exit(1);
    fs::remove_file(folder.join("scenarios/gone.toml")).unwrap();
    let list = folder.bench(["run", "--list", "-q", "--last-failed", "--runs", "other"]).assert_exit(0);
    assert_eq!(list.stdout, "limit.toml\n");
    assert!(list.stderr.starts_with("gone.toml did not pass in other/"), "{}", list.stderr);
}

#[test]
fn last_failed_has_nothing_to_run_after_a_pass() {
    let folder = TestFolder::with_step(SETTLING);
    folder.bench(["run", "--rig", "hosted"]).assert_exit(0);
    let message = "passed, so there is nothing to run";
    folder.bench(["run", "--rig", "hosted", "--last-failed"]).assert_exit(4).assert_stderr(&[message]);
}

#[test]
fn check_reads_selected_scenarios_only() {
    let folder = tagged_folder();
    let output = folder.bench(["check", "--tag", "paper"]).assert_exit(0);
    assert_eq!(output.stdout, "no faults in 2 scenarios\n");
    folder.write_scenario("e.toml", "title = 3");
    folder.bench(["check", "--tag", "paper"]).assert_message(2, &["e.toml"]);
}

#[test]
fn a_list_shows_limits_and_windows_without_playing() {
    let folder = TestFolder::new();
    let about = "metric = \"final_amplitude_um\"\nabout = 2.0\nfrom_ms = 30.0\nrequirement = \"ACC-1\"";
    folder.write_scenario("a.toml", &tagged("\"paper\"", &format!("{SETTLING}\n[[expect]]\n{about}")));
    let list = || folder.bench(["run", "--list", "--rig", "exec:false {port}"]).assert_exit(0).stdout;
    assert_eq!(
        list(),
        "a.toml  (law dq-pi, 1 trial)  [paper]\nstep\n\n\
         metric              limit      unit  window\n\
         settling_time_ms    ≤ 2        ms    0 … 60 ms\n\
         final_amplitude_um  ≈ 2 ± 5 %  µm    30 … 60 ms\n\n1 scenario, 2 expectations\n"
    );
    let json = folder.bench(["run", "--list", "--trials", "3", "--format", "json"]).assert_exit(0).json();
    let scenario = &json["scenarios"][0];
    assert_eq!((&scenario["trials"], &scenario["tags"]), (&Value::from(3), &json!(["paper"])));
    assert_eq!(
        scenario["expectations"][1],
        json!({
            "name": "final_amplitude_um", "metric": "final_amplitude_um", "limit": { "about": 2.0 },
            "tolerance_percent": 5.0, "windows_ms": [[30.0, 60.0]], "requirement": "ACC-1",
        })
    );
    assert!(!folder.exists("runs"));
}

fn verdicts(record: &RunRecord) -> Vec<(Verdict, usize)> {
    record.scenarios.iter().map(|scenario| (scenario.verdict, scenario.trials.len())).collect()
}

#[test]
fn fail_fast_plays_nothing_after_a_failure() {
    let folder = TestFolder::new();
    folder.write_scenario("a.toml", &step_text(SETTLING));
    folder.write_scenario("b.toml", &step_text(FAILED_SETTLING));
    folder.write_scenario("c.toml", &step_text(SETTLING));
    let run = |out: &str, more: &[&str]| {
        folder.bench(["run", "--rig", "hosted", "--jobs", "1", "--out", out].iter().chain(more)).assert_exit(1);
        folder.record(out)
    };
    assert_eq!(verdicts(&run("all", &[])), [(Pass, 1), (Fail, 1), (Pass, 1)]);
    let record = run("run", &["--fail-fast"]);
    assert_eq!(verdicts(&record), [(Pass, 1), (Fail, 1), (Inconclusive, 0)]);
    assert!(record.complete && record.verdict == Fail);
    assert!(!folder.join("run/traces/c/000.csv").exists());
    let expectation = &record.scenarios[2].expectations[0];
    assert_eq!(expectation.cause, Some(Cause::Evidence));
    assert_eq!(expectation.reason.as_ref().unwrap().to_string(), "0 of 1 trials were played");
    assert_judged_again(&folder, &record.scenarios);
}

#[test]
fn fail_fast_keeps_the_trials_of_an_undecided_scenario() {
    let folder = TestFolder::new();
    let repeatability = step_text("metric = \"repeatability_percent\"\nat_most = 1.5").replace("60.0", "80.0");
    let spread = "[trials]\ncount = 3\nmax_count = 40\n[trials.spread]\nsensor_gain_percent = 1.0\n";
    folder.write_scenario("undecided.toml", &format!("{repeatability}{spread}"));
    folder.write_scenario("fails.toml", &step_text(FAILED_SETTLING));
    folder.bench(["run", "--rig", "hosted", "--jobs", "1", "--out", "run", "--fail-fast"]).assert_exit(1);
    let record = folder.record("run");
    assert_eq!(verdicts(&record), [(Verdict::Fail, 1), (Verdict::Inconclusive, 3)]);
    assert_judged_again(&folder, &record.scenarios);
}

#[track_caller]
fn assert_judged_again(folder: &TestFolder, expected: &[ScenarioRecord]) {
    let judged = folder.bench(["report", "run", "--rejudge", "--format", "json"]).assert_exit(1).json();
    for (scenario, expected) in judged["scenarios"].as_array().unwrap().iter().zip(expected) {
        assert_eq!(scenario["expectations"], serde_json::to_value(&expected.expectations).unwrap());
    }
}

#[test]
fn the_name_of_a_folder_does_not_hide_scenarios() {
    let folder = TestFolder::new();
    let names = ["baselines", "hardware", "identify", "plans", "plates"];
    for name in names {
        fs::create_dir_all(folder.join("scenarios").join(name)).unwrap();
        folder.write_scenario(&format!("{name}/mine.toml"), &step_text(SETTLING).replace("\"plates/", "\"../plates/"));
    }
    assert_eq!(listed_files(&folder, &[]), names.map(|name| format!("{name}/mine.toml")));
    folder.run_hosted("run").assert_exit(0);
    assert_eq!(folder.record("run").scenarios.len(), 5);
    folder.bench(["check"]).assert_exit(0).assert_stdout(&["5 scenarios"]);
}

#[rstest]
#[case::run(&["run", "--rig", "hosted", "--out", "run"])]
#[case::list(&["run", "--list"])]
#[case::check(&["check"])]
#[case::trust(&["suite", "trust"])]
fn a_faulty_or_unknown_file_is_an_error(#[case] command: &[&str]) {
    let folder = TestFolder::with_step(SETTLING);
    folder.write_scenario("plates/broken.toml", "[mode\n");
    folder.bench(command).assert_message(2, &["plates/broken.toml:1:6"]);
    fs::remove_file(folder.join("scenarios/plates/broken.toml")).unwrap();
    folder.write_scenario("notes.toml", "[package]\n");
    folder.bench(command).assert_message(2, &["notes.toml", "is a file of no known kind, expected "]);
}

#[test]
fn scenarios_with_only_if_named_are_counted_with_their_reasons() {
    let folder = TestFolder::with_step(SETTLING);
    fs::create_dir(folder.join("scenarios/extra")).unwrap();
    for (name, reason) in [("a", "known limit"), ("b", "assumed hardware"), ("c", "known limit")] {
        let text = step_text(SETTLING).replace("\"plates/", "\"../plates/");
        folder.write_scenario(&format!("extra/{name}.toml"), &format!("only_if_named = \"{reason}\"\n{text}"));
    }
    let list = |arguments: &[&str]| folder.bench(["run", "--list"].iter().chain(arguments)).assert_exit(0);
    let note = "3 scenarios with `only_if_named` skipped (known limit 2, assumed hardware 1); name a file or its folder \
                to play it";
    list(&[]).assert_stderr(&[&format!("{note}; -v lists them\n")]);
    list(&["-v"]).assert_stderr(&[&format!("{note}: extra/a.toml, extra/b.toml, extra/c.toml\n")]);
    assert_eq!(list(&["-q"]).stderr, "");
    assert_eq!(listed_files(&folder, &[]), ["s.toml"]);
    assert_eq!(listed_files(&folder, &["scenarios/extra/b.toml"]), ["extra/b.toml"]);
    assert_eq!(listed_files(&folder, &["scenarios/extra"]).len(), 3);
    folder.write_scenario("bad.toml", &format!("only_if_named = \"\"\n{}", step_text(SETTLING)));
    folder.bench(["check"]).assert_message(2, &["bad.toml:1", "expected one line of text"]);
}
