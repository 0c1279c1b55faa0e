//! Judges controllers with a law of their own: variants of `docs/examples/controller.py` with two PI
//! loops of constant gains, behind a pseudo-terminal.

use crate::test_folder::{ProgramOutput, run_bench, workspace_root};
use platebench_model::record::{RunRecord, Verdict};
use platebench_test_kit::python_with_pyserial;
use rstest::rstest;
use std::fs;
use std::path::PathBuf;
use tempfile::TempDir;

const LAWS: &str = "laws = 1 << DQ_PI | 1 << DQ_PI_FIXED";
const ANNOUNCES_NONE: (&str, &str) = (LAWS, "laws = 0");
const ANNOUNCES_DQ_PI_FIXED: (&str, &str) = (LAWS, "laws = 1 << DQ_PI_FIXED");
/// Its step with the samples of the bench.
const STEP: &str = "self.law.step(setpoint, wd, wq)";

struct OwnController {
    folder: TempDir,
    rig: String,
}

impl OwnController {
    /// Applies `changes`, pairs of old and new text. `None` if Python lacks pyserial.
    fn new(changes: &[(&str, &str)]) -> Option<Self> {
        let python = python_with_pyserial()?;
        let mut text = fs::read_to_string(workspace_root().join("docs/examples/controller.py")).unwrap();
        // The controller has one law, and ignores the number in the configuration.
        let number = (
            "        self.law, self.number, self.noise = None, None, 0\n",
            "        law = DQ_PI_FIXED if law <= 8 else law\n",
        );
        for (old, new) in [(number.0, &*[number.0, number.1].concat())].iter().chain(changes) {
            assert!(text.contains(old), "{old}");
            text = text.replace(old, new);
        }
        let folder = tempfile::tempdir().unwrap();
        let program = folder.path().join("own.py");
        fs::write(&program, text).unwrap();
        let rig = format!("exec:{python} '{}' {{port}}", program.display());
        Some(Self { folder, rig })
    }

    fn run(&self, arguments: &[&str]) -> ProgramOutput {
        let out = self.run_folder();
        let common = ["run", "--rig", &self.rig, "--out", &out.to_string_lossy()];
        run_bench(&workspace_root(), common.iter().chain(arguments))
    }

    fn run_folder(&self) -> PathBuf {
        self.folder.path().join("run")
    }

    fn record(&self) -> RunRecord {
        RunRecord::read(&self.run_folder()).unwrap()
    }

    fn file(&self, name: &str) -> String {
        fs::read_to_string(self.run_folder().join(name)).unwrap()
    }
}

/// The console wraps its text.
fn unwrapped(output: &ProgramOutput) -> String {
    output.text().split_whitespace().collect::<Vec<_>>().join(" ")
}

/// Of these, the first applies in full, the second in part, the others not at all.
const SCENARIOS: [&str; 4] = [
    "paper/fig13-closed-loop.toml",
    "faults/lost-command.toml",
    "paper/fig13-open-loop.toml",
    "guards/low-setpoints.toml",
];

#[rstest]
#[case::announces_no_law(ANNOUNCES_NONE, &[])]
#[case::announces_another_law(ANNOUNCES_DQ_PI_FIXED, &["--law", "own"])]
fn an_own_law_is_judged_by_the_requirements(#[case] identity: (&str, &str), #[case] options: &[&str]) {
    let Some(controller) = OwnController::new(&[identity]) else { return };
    let output = controller.run(&[&SCENARIOS[..], options].concat()).assert_exit(0);
    let text = unwrapped(&output);
    for part in
        ["not applicable: 2 scenarios and 9 expectations; -v lists the reasons", "5 expectations: 5 passed, 0 failed"]
    {
        assert!(text.contains(part), "{part}\n{text}");
    }
    assert_eq!(text.matches("not applicable").count(), 1, "{text}");
    // Only an option is an override.
    assert_eq!(text.contains("overridden: law = own"), !options.is_empty(), "{text}");
    let record = controller.record();
    let skipped: Vec<_> = record.scenarios.iter().map(|scenario| scenario.not_applicable.len()).collect();
    assert_eq!((record.verdict, record.scenarios[0].law.as_str(), &*skipped), (Verdict::Pass, "own", &[3, 1][..]));
    // Four expectations of played scenarios, and one case for each scenario that was not played.
    assert_eq!(controller.file("junit.xml").matches("<skipped").count(), 6);
    assert!(controller.file("report.html").contains("Not applicable to the controller's own law:"));
    let folder = controller.run_folder();
    run_bench(&workspace_root(), ["report", &folder.to_string_lossy(), "--rejudge"]).assert_exit(0);
    assert_eq!(controller.record().scenarios[0].not_applicable.len(), 3);
}

#[test]
fn an_own_law_is_replayed() {
    let Some(controller) = OwnController::new(&[ANNOUNCES_NONE]) else { return };
    controller.run(&[SCENARIOS[0]]).assert_exit(0);
    let trace = controller.run_folder().join("traces/paper/fig13-closed-loop/000.csv").display().to_string();
    let replay = ["replay", &trace, "--rig", &controller.rig, "--format", "json"];
    let result = run_bench(&workspace_root(), replay).assert_exit(0).json();
    assert_eq!((&result["law"], &result["verdict"]), (&"own".into(), &"pass".into()), "{result}");
    run_bench(&workspace_root(), replay.into_iter().chain(["--law", "dq-pi"])).assert_exit(4);
}

#[rstest]
#[case::correct(STEP, 0)]
#[case::drives_above_the_limit("(1.01 * self.law.limit, 0.0, 0)", 1)]
fn the_rules_of_the_protocol_hold_for_an_own_law(#[case] step: &str, #[case] exit: i32) {
    let Some(controller) = OwnController::new(&[ANNOUNCES_NONE, (STEP, step)]) else { return };
    controller.run(&["reference/protocol.toml"]).assert_exit(exit);
}

#[rstest]
#[case::wrong_sign_of_the_frequency_loop("self.law.step(setpoint, wd, -wq)", "paper/fig14-closed-loop.toml")]
#[case::a_tenth_of_the_gain(
    "(lambda drive, offset, flags: (drive / 10, offset, flags))(*self.law.step(setpoint, wd, wq))",
    "paper/fig14-closed-loop.toml"
)]
#[case::wrong_sign_on_a_warmer_plate("self.law.step(setpoint, wd, abs(wq))", "guards/hot-plate.toml")]
#[case::drives_at_setpoint_0("self.law.step(setpoint or 1.0, wd, wq)", "guards/rest-drive.toml")]
fn a_bad_own_law_fails(#[case] step: &str, #[case] scenario: &str) {
    for (step, exit) in [(STEP, 0), (step, 1)] {
        let Some(controller) = OwnController::new(&[ANNOUNCES_NONE, (STEP, step)]) else { return };
        controller.run(&[scenario]).assert_exit(exit);
    }
}

#[test]
fn a_missing_law_names_the_option() {
    let Some(controller) = OwnController::new(&[ANNOUNCES_DQ_PI_FIXED]) else { return };
    let output = controller.run(&["paper/fig13-closed-loop.toml"]).assert_exit(4);
    assert!(unwrapped(&output).contains("--law own judges the requirements only"), "{}", output.text());
}

#[test]
fn descriptions_of_the_bench_laws_alone_judge_nothing() {
    let Some(controller) = OwnController::new(&[ANNOUNCES_NONE]) else { return };
    let output = controller.run(&["paper/fig13-open-loop.toml"]).assert_exit(4);
    assert!(unwrapped(&output).contains("law open-loop; --law NAME judges it"), "{}", output.text());
}

const CAMPAIGN: &str = "title = \"Laws\"\nscenario = \"step.toml\"\n[vary]\n\
    \"controller.law\" = { each = [\"own\", \"dq-pi\", \"deadbeat\"] }\n\
    [plan]\nmethod = \"grid\"\ntrials = 1\n[judge]\n";

/// Plays a campaign over `laws`. Returns the output and `summary.json`.
fn play_campaign(controller: &OwnController, campaign: &str) -> (ProgramOutput, serde_json::Value) {
    let folder = controller.folder.path();
    let plate = workspace_root().join("scenarios/plates/aluminium-198x138.toml");
    let scenario = format!(
        "title = \"Step\"\nplate = \"{}\"\nduration_ms = 20.0\n[profile]\n\
         setpoint_um = {{ hold = [[0.0, 0.0], [1.0, 2.0]] }}\n\
         [[expect]]\nmetric = \"settling_time_ms\"\nat_most = 15.0\nrequirement = \"R-1\"\n",
        plate.display()
    );
    fs::write(folder.join("step.toml"), scenario).unwrap();
    fs::write(folder.join("campaign.toml"), campaign).unwrap();
    let arguments = ["campaign", "run", "campaign.toml", "--rig", &controller.rig, "--out", "c", "--jobs", "1"];
    let output = run_bench(folder, arguments);
    let summary = fs::read(folder.join("c/summary.json")).unwrap();
    (output, serde_json::from_slice(&summary).unwrap())
}

#[rstest]
#[case::announces_no_law(ANNOUNCES_NONE, ["pass", "not applicable", "not applicable"])]
#[case::announces_dq_pi((LAWS, "laws = 1 << DQ_PI"), ["pass", "pass", "not applicable"])]
fn a_campaign_plays_announced_laws_only(#[case] identity: (&str, &str), #[case] verdicts: [&str; 3]) {
    let Some(controller) = OwnController::new(&[identity]) else { return };
    let (output, summary) = play_campaign(&controller, CAMPAIGN);
    output.assert_exit(0);
    let skipped = verdicts.iter().filter(|verdict| **verdict != "pass").count();
    assert_eq!(summary["overall"]["trials"], 3 - skipped);
    assert_eq!(summary["overall"]["not_applicable"], skipped);
    let results = fs::read_to_string(controller.folder.path().join("c/results.csv")).unwrap();
    for ((line, cell), verdict) in results.lines().skip(1).zip(summary["cells"].as_array().unwrap()).zip(verdicts) {
        assert!(line.contains(&format!(",{verdict},")), "{results}");
        assert_eq!(cell["verdict"].is_null(), verdict != "pass", "{cell}");
    }
}

#[test]
fn a_campaign_without_an_applicable_law_ends_with_4() {
    let Some(controller) = OwnController::new(&[ANNOUNCES_DQ_PI_FIXED]) else { return };
    let (output, summary) =
        play_campaign(&controller, &CAMPAIGN.replace("[\"own\", \"dq-pi\", \"deadbeat\"]", "[\"dq-pi\"]"));
    output.assert_exit(4).assert_stdout(&["1 trials not applicable"]);
    assert_eq!((&summary["verdict"], &summary["overall"]["trials"]), (&"inconclusive".into(), &0.into()));
}

/// At a period of 20 ms the plate follows a drive within a period, so the open loop is 1.9/(z − 1).
#[test]
fn measures_the_gain_margin_of_an_own_integrator() {
    let law = "(lambda law: (setattr(law, 'u', getattr(law, 'u', 0.0) + 1.9 * (setpoint - wd) / 0.00698), \
               (min(max(law.u, 0.0), law.limit), 0.0, 0))[1])(self.law)";
    let Some(controller) = OwnController::new(&[ANNOUNCES_NONE, (STEP, law)]) else { return };
    let only = ["--margin", "drive-gain", "--period-ms", "20", "--requirement", "ACC-2", "--format", "json"];
    // A busy machine stops the controller for longer than 0.5 s.
    let arguments = ["stability", "--rig", &controller.rig, "--reply-timeout", "20000"].into_iter().chain(only);
    let result = run_bench(&workspace_root(), arguments).assert_exit(0).json();
    let case = &result["cases"][0];
    assert_eq!((&case["law"], case["margins"].as_array().unwrap().len()), (&"own".into(), 1));
    let stability = &case["margins"][0]["stability"];
    let [low, high] = ["holds_to", "fails_from"].map(|end| stability[end].as_f64().unwrap());
    assert!(low < 1.0555 && high > 1.05 && high - low < 0.005, "{stability}");
    assert!(case["margins"][0]["predicted"].is_null() && case["instructions_per_step"].is_null(), "{case}");
}
