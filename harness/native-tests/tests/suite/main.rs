#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "a failed fixture fails the test")]

use platebench_engine::{Clock, RunHooks, RunPlan};
use platebench_model::record::{Overrides, RunFolder};
use platebench_model::scenario::load;
use platebench_rig::RigSpec;
use platebench_test_kit::PLATE;
use rstest::rstest;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use tempfile::TempDir;

struct SuiteProject(TempDir);

impl SuiteProject {
    fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let plates = folder.path().join("scenarios/plates");
        fs::create_dir_all(&plates).unwrap();
        fs::create_dir_all(folder.path().join("scenarios/limits")).unwrap();
        fs::write(plates.join("weak.toml"), PLATE.replace("limit_vpp = 900.0", "limit_vpp = 400.0")).unwrap();
        fs::write(plates.join("plate.toml"), PLATE).unwrap();
        Self(folder)
    }

    fn path(&self) -> &Path {
        self.0.path()
    }

    fn run_folder(&self, name: &str) -> PathBuf {
        self.path().join("out").join(name)
    }

    /// Writes a step to 2 µm under 2 N. `at_most` is the limit of the settling time, ms.
    fn write_scenario(&self, name: &str, first: &str, at_most: f64) {
        let plate =
            self.path().join("scenarios/plates").join(if first.contains("weak") { "weak.toml" } else { "plate.toml" });
        let text = format!(
            "{first}\ntitle = \"step\"\nplate = \"{}\"\nduration_ms = 30.0\n[profile]\nsetpoint_um = 2.0\n\
             finger_force_n = 2.0\n[[expect]]\nmetric = \"settling_time_ms\"\nat_most = {at_most}\n",
            plate.display()
        );
        fs::write(self.path().join("scenarios").join(name), text).unwrap();
    }

    fn start(&self, arguments: &[&str], rig: Option<&str>) -> Output {
        self.start_in("scenarios", arguments, rig)
    }

    fn start_in(&self, folder: &str, arguments: &[&str], rig: Option<&str>) -> Output {
        let mut command = Command::new(env!("CARGO_BIN_EXE_suite-under-test"));
        command.env("SUITE", folder).env("OUT", "out").env_remove("PLATEBENCH_RIG").current_dir(self.path());
        command.args(arguments).envs(rig.map(|rig| ("PLATEBENCH_RIG", rig))).output().unwrap()
    }

    fn run_tests(&self, arguments: &[&str]) -> (i32, String) {
        exit_code_and_output(&self.start(arguments, None))
    }
}

fn exit_code_and_output(output: &Output) -> (i32, String) {
    let text = [&output.stdout[..], &output.stderr[..]].map(String::from_utf8_lossy).concat();
    (output.status.code().expect("an exit code"), text)
}

const LIMIT: &str = "only_if_named = \"known limit\"";

fn project_with_mixed_results() -> SuiteProject {
    let project = SuiteProject::new();
    project.write_scenario("good.toml", "", 20.0);
    project.write_scenario("slow.toml", "", 0.5);
    project.write_scenario("limits/slow.toml", &format!("{LIMIT}\nexpected_exit = 1"), 0.5);
    project
}

#[test]
fn lists_tests_in_the_format_of_nextest() {
    let project = project_with_mixed_results();
    let list = |arguments: &[&str]| project.run_tests(arguments);
    assert_eq!(list(&["--list", "--format", "terse"]), (0, "good: test\nlimits/slow: test\nslow: test\n".to_owned()));
    assert_eq!(list(&["--list", "--format", "terse", "--ignored"]), (0, "limits/slow: test\n".to_owned()));
    assert!(!project.path().join("out").exists(), "a list runs nothing");
}

#[test]
fn runs_one_test_by_its_exact_name() {
    let project = project_with_mixed_results();
    let (code, output) = project.run_tests(&["good", "--exact", "--nocapture"]);
    assert_eq!(code, 0, "{output}");
    assert!(output.contains("1 passed; 0 failed; 0 ignored; 0 measured; 2 filtered out"), "{output}");
    for file in ["run.json", "junit.xml", "report.html", "traceability.csv", "traces/good/000.csv"] {
        assert!(project.run_folder("good").join(file).exists(), "{file}");
    }
    assert!(!project.run_folder("slow").exists());
}

#[test]
fn a_test_plays_the_trial_of_run() {
    let project = project_with_mixed_results();
    assert_eq!(project.run_tests(&["good", "--exact"]).0, 0);
    let scenario = load(&project.path().join("scenarios/good.toml"), "good.toml").unwrap();
    let plan =
        RunPlan::new(&RigSpec::hosted(), Clock::Lockstep { wire_time: false }, 1, vec![scenario], Overrides::default());
    let folder = RunFolder::create(Some(&project.path().join("run"))).unwrap();
    platebench_engine::run(&plan, &folder, &|| RigSpec::hosted().connect(), RunHooks::default()).unwrap();
    let trace = "traces/good/000.csv";
    let [test, run] =
        [project.run_folder("good"), folder.path().to_owned()].map(|run| fs::read(run.join(trace)).unwrap());
    assert!(test == run);
}

#[test]
fn a_failure_names_the_expectation_and_the_run_folder() {
    let project = project_with_mixed_results();
    let (code, output) = project.run_tests(&[]);
    assert_eq!(code, 101, "{output}");
    assert!(output.contains("1 passed; 1 failed; 1 ignored"), "{output}");
    assert!(
        output.contains("the scenario ends with a failure (exit code 1), expected a pass (exit code 0)"),
        "{output}"
    );
    assert!(output.contains("settling_time_ms") && output.contains("run folder: out/slow"), "{output}");
    assert!(project.run_folder("slow/report.html").exists());
}

/// No controller can hold the setpoint under 2 N with 400 Vpp.
#[test]
fn an_inconclusive_scenario_does_not_pass() {
    let project = SuiteProject::new();
    project.write_scenario("weak.toml", "# weak", 2.0);
    let (code, output) = project.run_tests(&[]);
    assert_eq!(code, 101, "{output}");
    assert!(
        output.contains("the scenario ends with an inconclusive verdict (exit code 3)")
            && output.contains("infeasible"),
        "{output}"
    );
}

#[test]
fn a_limit_scenario_runs_on_request_and_ends_as_expected() {
    let project = project_with_mixed_results();
    let (code, output) = project.run_tests(&["--ignored"]);
    assert_eq!(code, 0, "{output}");
    assert!(project.run_folder("limits/slow/run.json").exists(), "a run folder with the same name");
    project.write_scenario("limits/slow.toml", &format!("{LIMIT}\nexpected_exit = 1"), 20.0);
    let (code, output) = project.run_tests(&["--include-ignored", "limits"]);
    assert_eq!(code, 101);
    assert!(
        output.contains("the scenario ends with a pass (exit code 0), expected a failure (exit code 1)"),
        "{output}"
    );
    project.write_scenario("limits/slow.toml", &format!("{LIMIT}\nexpected_exit = 3"), 0.5);
    assert_eq!(project.run_tests(&["--include-ignored", "limits"]).0, 101);
}

#[test]
fn a_limit_keeps_its_name_in_a_folder_of_any_name() {
    let project = project_with_mixed_results();
    fs::rename(project.path().join("scenarios/plates"), project.path().join("plates")).unwrap();
    fs::rename(project.path().join("scenarios"), project.path().join("checks")).unwrap();
    for file in ["good.toml", "slow.toml", "limits/slow.toml"] {
        let path = project.path().join("checks").join(file);
        let text = fs::read_to_string(&path).unwrap();
        fs::write(path, text.replace("/scenarios/plates", "/plates")).unwrap();
    }
    let list = ["--list", "--format", "terse", "--ignored"];
    assert_eq!(exit_code_and_output(&project.start_in("checks", &list, None)), (0, "limits/slow: test\n".to_owned()));
    let (code, output) = exit_code_and_output(&project.start_in("checks", &["--ignored"], None));
    assert_eq!(code, 0, "{output}");
    assert!(project.run_folder("limits/slow/run.json").exists());
}

#[rstest]
#[case(&["good", "--exact"])]
#[case(&["--list", "--format", "terse"])]
fn an_invalid_scenario_stops_the_whole_suite(#[case] arguments: &[&str]) {
    let project = project_with_mixed_results();
    project.write_scenario("broken.toml", "titel = \"step\"", 2.0);
    project.write_scenario("limits/slow.toml", "expected_exit = 9", 2.0);
    let (code, output) = project.run_tests(arguments);
    assert_eq!(code, 2, "{output}");
    assert!(output.contains("broken.toml:1") && output.contains("unknown key `titel`"), "{output}");
    assert!(output.contains("limits/slow.toml:1"), "{output}");
    assert!(!project.path().join("out").exists());
}

#[test]
fn an_empty_folder_is_an_error() {
    let project = SuiteProject::new();
    let (code, output) = project.run_tests(&[]);
    assert_eq!((code, &*output), (4, "error: scenarios: no scenario was found below this folder\n"));
}

#[rstest]
#[case("hosted", 0, "1 passed")]
#[case("robot", 2, "robot")]
#[case("exec:", 2, "error: ")]
#[case("serial:/dev/not-there", 101, "/dev/not-there")]
fn the_environment_variable_overrides_the_rig(#[case] rig: &str, #[case] code: i32, #[case] message: &str) {
    let project = project_with_mixed_results();
    let (exit, output) = exit_code_and_output(&project.start(&["good", "--exact"], Some(rig)));
    assert_eq!(exit, code, "{output}");
    assert!(output.contains(message), "{output}");
}

#[test]
fn a_run_replaces_only_an_earlier_run_folder() {
    let project = project_with_mixed_results();
    assert_eq!(project.run_tests(&["good", "--exact"]).0, 0);
    fs::write(project.run_folder("good/old-file"), "").unwrap();
    assert_eq!(project.run_tests(&["good", "--exact"]).0, 0);
    assert!(!project.run_folder("good/old-file").exists());
    assert!(project.run_folder("good/run.json").exists());
    fs::remove_file(project.run_folder("good/run.json")).unwrap();
    let (code, output) = project.run_tests(&["good", "--exact"]);
    assert_eq!(code, 101, "{output}");
    assert!(output.contains("out/good: "), "{output}");
    assert!(project.run_folder("good/report.html").exists());
    let count = fs::read_dir(project.path().join("out")).unwrap().count();
    assert_eq!(count, 1, "no temporary folder remains");
}
