use crate::scenario::find::find;
use crate::scenario::load::{load, load_template, load_with_all_errors};
use crate::scenario::{Diagnostic, Limit, Scenario};
use rstest::rstest;
use std::fs;
use std::path::{Path, PathBuf};
use toml::Value;

const PLATE: &str = include_str!("../../../../../scenarios/plates/aluminium-198x138.toml");
const HEAD: &str = "\
title = \"{law} at {um} µm\"
plate = \"plate.toml\"
duration_ms = 60.0
only_if_named = \"{reason}\"
[controller]
law = \"{law}\"
[profile]
setpoint_um = \"{um}\"
[[expect]]
metric = \"settling_time_ms\"
at_most = \"{settling}\"
[[expect]]
metric = \"static_error_percent\"
within = \"{error}\"
paper = \"{paper}\"
";
const MATRIX: &str = "\
[matrix]
default = { error = [0.0, 1.0], reason = \"-\", paper = \"-\" }
um = [1, 2.5]
[matrix.law]
dq-pi = { settling = 2.0 }
open-loop = { settling = \"-\", reason = \"slow\" }
[matrix.case]
\"2.5-open-loop\" = { error = [30.0, 40.0], paper = 35.0 }
";

fn folder_with(text: &str) -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    fs::write(folder.path().join("plate.toml"), PLATE).unwrap();
    fs::write(folder.path().join("m.toml"), text).unwrap();
    folder
}

fn faults(text: &str) -> Vec<String> {
    let folder = folder_with(text);
    let faults = find(&[folder.path().join("m.toml")]).unwrap_err();
    let shorten = |fault: &Diagnostic| fault.to_string().replace(&folder.path().display().to_string(), ".");
    faults.iter().map(shorten).collect()
}

fn with_matrix(good: &str, bad: &str) -> String {
    assert!(MATRIX.contains(good), "{good}");
    format!("{HEAD}{}", MATRIX.replacen(good, bad, 1))
}

#[test]
fn a_matrix_is_a_scenario_per_combination() {
    let folder = folder_with(&format!("{HEAD}{MATRIX}"));
    let found = find(&[folder.path().to_owned()]).unwrap();
    let cases: Vec<_> = found.scenarios.iter().map(|case| (case.file.as_str(), case.title.as_str())).collect();
    let expected = [
        ("m-1-dq-pi.toml", "dq-pi at 1 µm"),
        ("m-1-open-loop.toml", "open-loop at 1 µm"),
        ("m-2.5-dq-pi.toml", "dq-pi at 2.5 µm"),
        ("m-2.5-open-loop.toml", "open-loop at 2.5 µm"),
    ];
    assert_eq!(cases, expected);
    let [_, _, dq_pi, open_loop] = &found.scenarios[..] else { panic!() };
    assert_eq!((dq_pi.controller.law.as_str(), dq_pi.setpoint.at(dq_pi.duration)), ("dq-pi", 2.5));
    let limits = |case: &Scenario| case.expectations.iter().map(|expectation| expectation.limit).collect::<Vec<_>>();
    assert_eq!(limits(dq_pi), [Limit::AtMost(2.0), Limit::Within(0.0, 1.0)]);
    assert_eq!(limits(open_loop), [Limit::Within(30.0, 40.0)]);
    assert_eq!((dq_pi.expectations[1].paper, open_loop.expectations[0].paper), (None, Some(35.0)));
    assert_eq!((&dq_pi.only_if_named, open_loop.only_if_named.as_deref()), (&None, Some("slow")));
}

#[test]
fn rows_without_axes_are_the_cases() {
    let rows = "\
[matrix.case]
quick = { law = \"deadbeat\", um = 1.0, reason = \"-\", settling = 1.1, error = \"-\", paper = \"-\" }
slow = { law = \"pll\", um = 2.0, reason = \"-\", settling = 7.0, error = \"-\", paper = \"-\" }
";
    let folder = folder_with(&format!("{HEAD}{rows}"));
    let found = find(&[folder.path().join("m.toml")]).unwrap();
    let laws: Vec<_> = found.scenarios.iter().map(|case| (case.name(), case.controller.law.as_str())).collect();
    assert_eq!(laws, [("m-quick", "deadbeat"), ("m-slow", "pll")]);
}

#[test]
fn the_path_of_a_case_is_an_argument() {
    let folder = folder_with(&format!("{HEAD}{MATRIX}"));
    let path = folder.path().join("m-2.5-open-loop.toml");
    let found = find(std::slice::from_ref(&path)).unwrap();
    assert_eq!(found.scenarios.iter().map(Scenario::name).collect::<Vec<_>>(), ["m-2.5-open-loop"]);
    let case = load(&path, "laws/m-2.5-open-loop.toml").unwrap();
    assert_eq!((case.controller.law.as_str(), case.file.as_str()), ("open-loop", "laws/m-2.5-open-loop.toml"));
    // The copy in a run folder has the name of the file, and the record has the name of the case.
    let case = load(&folder.path().join("m.toml"), "m-1-dq-pi.toml").unwrap();
    assert_eq!(case.title, "dq-pi at 1 µm");
    for wrong in ["m-3-dq-pi.toml", "n-1-dq-pi.toml", "m-.toml"] {
        let fault = load(&folder.path().join(wrong), wrong).unwrap_err();
        assert!(fault.message.starts_with("cannot be read"), "{fault}");
    }
    let fault = load(&folder.path().join("m.toml"), "m.toml").unwrap_err();
    assert!(fault.message.contains("expected the name of a case: 1-dq-pi, 1-open-loop, 2.5-dq-pi"), "{fault}");
}

#[test]
fn a_folder_and_a_case_of_it_give_each_case_once() {
    let folder = folder_with(&format!("{HEAD}{MATRIX}"));
    let case = folder.path().join("m-1-dq-pi.toml");
    assert_eq!(find(&[folder.path().to_owned(), case]).unwrap().scenarios.len(), 4);
}

#[test]
fn values_of_a_case_can_be_replaced() {
    let folder = folder_with(&format!("{HEAD}{MATRIX}"));
    let path = folder.path().join("m-1-dq-pi.toml");
    let template = load_template(&path, "m-1-dq-pi.toml", |_| {}).unwrap();
    let tables = template.tables([("profile.setpoint_um", Value::Float(0.5))]).unwrap();
    assert!(!template.scenario_table(&tables).contains_key("matrix"));
    let changed = template.check(&tables).unwrap();
    assert_eq!((changed.controller.law.as_str(), changed.setpoint.at(changed.duration)), ("dq-pi", 0.5));
    let tables = template.tables([("profile.setpoint_um", Value::Float(-1.0))]).unwrap();
    // The value comes from the list of the axis.
    assert_eq!(template.check(&tables).unwrap_err()[0].position(), (18, 7));
}

#[rstest]
#[case::wrong_value(
    "[30.0, 40.0]",
    "[40.0, 30.0]",
    "m.toml:23:29: `within`: expected [low, high] with low not above high"
)]
#[case::wrong_type("settling = 2.0", "settling = \"soon\"", "m.toml:20:22: invalid type: string \"soon\"")]
#[case::out_of_range("um = [1, 2.5]", "um = [1, 2.5, -1]", "m.toml:18:15: `setpoint_um`: a setpoint of -1 µm")]
#[case::missing_value("settling = 2.0", "", "m.toml:11:11: `{settling}` has no value in the case `1-dq-pi`")]
#[case::unknown_case(
    "2.5-open-loop",
    "2.5-openloop",
    "unknown case `2.5-openloop`, expected a combination of the axes; did"
)]
#[case::unused("settling = 2.0", "settling = 2.0, setling = 1.0", "m.toml:20:27: unused value `setling`")]
#[case::no_table("{ settling = 2.0 }", "2.0", "m.toml:20:9: expected values by the name of their placeholder")]
#[case::name("dq-pi = {", "\"dq/pi\" = {", "m.toml:20:1: `dq/pi` is part of the name of a case")]
#[case::same_name("um = [1, 2.5]", "um = [1, 2.5, 2.5]", "`matrix` has several cases `2.5-dq-pi`, expected cases with")]
#[case::no_values("um = [1, 2.5]", "um = []", "`matrix` has 0 cases")]
#[case::list_in_a_text("um = [1, 2.5]", "um = [[1, 2]]", "is part of the name of a case")]
fn rejects_a_wrong_matrix_with_its_position(#[case] good: &str, #[case] bad: &str, #[case] expected: &str) {
    let faults = faults(&with_matrix(good, bad));
    assert!(faults.iter().any(|fault| fault.contains(expected)), "{faults:#?}");
}

#[test]
fn an_error_of_the_common_part_is_reported_once() {
    let text = format!("{HEAD}{MATRIX}").replacen("duration_ms = 60.0", "duration_ms = -1.0", 1);
    assert_eq!(faults(&text), ["./m.toml:3:15: `duration_ms`: -1 ms, expected a finite number above 0"]);
    let text = format!("{HEAD}{MATRIX}").replacen("law = \"{law}\"", "law = \"{laws}\"", 1);
    assert_eq!(
        faults(&text),
        ["./m.toml:6:7: unknown placeholder `{laws}`, expected a name in `[matrix]`; did you mean `law`?"]
    );
}

#[test]
fn braces_in_a_file_without_a_matrix_are_text() {
    let text = "title = \"{law}\"\nplate = \"plate.toml\"\nduration_ms = 9.0\n[profile]\nsetpoint_um = 1.0\n\
                [[expect]]\nmetric = \"drive_peak_vpp\"\nat_most = 900.0\n";
    let folder = folder_with(text);
    let path: PathBuf = folder.path().join("m.toml");
    assert_eq!(load_with_all_errors(Path::new(&path), "m.toml").unwrap().title, "{law}");
}
