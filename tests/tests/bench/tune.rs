//! `platebench tune`: predicted beside what the firmware's own law does with the gains, and gains into files.

use crate::test_folder::{TestFolder, controller_rig, exit_code, run_bench, step_scenario, workspace_root};
use rstest::rstest;
use serde_json::Value;
use std::fs;
use std::process::Output;

const PLATE: &str = "scenarios/plates/aluminium-198x138.toml";
const SETTLING: &str = "metric = \"settling_time_ms\"\nat_most = 2.0";

fn run_tune(workshop: &TestFolder, arguments: &[&str]) -> Output {
    run_bench(workshop.path(), ["tune", "--plate", PLATE, "--samples", "8"].iter().chain(arguments))
}

#[track_caller]
fn output_json(output: &Output) -> Value {
    serde_json::from_slice(&output.stdout).unwrap_or_else(|error| {
        panic!("{error}: {}{}", String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr))
    })
}

#[track_caller]
fn json_number(told: &Value, pointer: &str) -> f64 {
    told.pointer(pointer).and_then(Value::as_f64).unwrap_or_else(|| panic!("no number at {pointer} of {told:#}"))
}

/// Writes the paper's plate with another gain, time constant (factors) or limit to where every scenario of the workshop has it.
fn write_scaled_plate(workshop: &TestFolder, gain: f64, time_constant: f64, limit: f64) {
    let path = workshop.path().join(PLATE);
    let text = fs::read_to_string(&path).unwrap();
    let text = text
        .replace("gain_um_per_vpp = 0.00698", &format!("gain_um_per_vpp = {}", 0.006_98 * gain))
        .replace("time_constant_ms = 1.88", &format!("time_constant_ms = {}", 1.88 * time_constant))
        .replace("limit_vpp = 900.0", &format!("limit_vpp = {limit:?}"));
    fs::write(&path, text).unwrap();
}

fn controller_with_gains(told: &Value, law: &str) -> String {
    let gain = |name: &str| format!("{name} = {:?}\n", json_number(told, &format!("/gains/{name}")));
    let gains = ["amplitude_kp", "amplitude_ki", "frequency_kp", "frequency_ki"].map(gain).concat();
    format!("law = \"{law}\"\n[controller.gains]\n{gains}")
}

#[rstest]
#[case::as_the_paper(&[], 900.0)]
#[case::another_law(&["--law", "dq-pi-fixed"], 900.0)]
#[case::as_printed(&["--law", "dq-pi-euler", "--response-ms", "3"], 900.0)]
#[case::at_the_drive_limit(&[], 416.0)]
#[case::a_slow_line(&["--delay-ms", "0.52", "--response-ms", "4"], 900.0)]
#[case::more_than_a_period(&["--delay-ms", "1.3", "--response-ms", "8"], 900.0)]
#[case::under_a_finger(&["--force-n", "2"], 900.0)]
#[case::half_a_millisecond(&["--period-ms", "0.5"], 900.0)]
#[case::a_small_setpoint(&["--setpoint-um", "0.3", "--response-ms", "2.5"], 900.0)]
fn the_firmware_behaves_as_predicted(#[case] arguments: &[&str], #[case] limit: f64) {
    let workshop = TestFolder::new();
    write_scaled_plate(&workshop, 1.0, 1.0, limit);
    let sent = [arguments, &["--send", "hosted", "--out", "run", "--format", "json"]].concat();
    let output = run_tune(&workshop, &sent);
    let told = output_json(&output);
    assert_eq!(exit_code(&output), 0, "{told:#}");
    let pairs = ["settling_ms", "overshoot_percent", "peak_drive_vpp"].map(|name| {
        (json_number(&told, &format!("/tuning/chosen/plate/{name}")), json_number(&told, &format!("/measured/{name}")))
    });
    let [(settling, measured_settling), (overshoot, measured_overshoot), (peak, measured_peak)] = pairs;
    assert!((measured_settling / settling - 1.0).abs() < 0.005, "settling: {measured_settling} instead of {settling}");
    assert!((measured_overshoot - overshoot).abs() < 0.1, "overshoot: {measured_overshoot} instead of {overshoot}");
    assert!((measured_peak / peak - 1.0).abs() < 0.001, "peak drive: {measured_peak} instead of {peak}");
    assert!(measured_peak <= 1.000_001 * limit);
    // What was played is a run like any other.
    assert_eq!(exit_code(&run_bench(workshop.path(), ["judge", "run"])), 0);
}

#[test]
fn the_firmware_behaves_as_predicted_at_every_corner() {
    let workshop = TestFolder::new();
    let told = output_json(&run_tune(&workshop, &["--format", "json"]));
    let corners = told.pointer("/tuning/sensitivity/corners").and_then(Value::as_array).unwrap();
    assert_eq!(corners.len(), 8);
    let text = step_scenario("aluminium-198x138", &controller_with_gains(&told, "dq-pi"), "", SETTLING);
    for corner in corners {
        let there = TestFolder::new();
        let factor = |name: &str| 1.0 + json_number(corner, name) / 100.0;
        write_scaled_plate(&there, factor("/gain_percent"), factor("/time_constant_percent"), 900.0);
        let (predicted, measured) = (json_number(corner, "/plate/settling_ms"), there.first_value(&text).unwrap());
        assert!((measured / predicted - 1.0).abs() < 0.02, "{corner:#}: {measured}");
    }
    let finger = "finger_force_n = 2.0";
    let predicted = json_number(&told, "/tuning/sensitivity/other_finger/plate/settling_ms");
    let measured = workshop.first_value(&step_scenario(
        "aluminium-198x138",
        &controller_with_gains(&told, "dq-pi"),
        finger,
        SETTLING,
    ));
    assert!((measured.unwrap() / predicted - 1.0).abs() < 0.02, "{measured:?} instead of {predicted}");
}

#[test]
fn the_firmware_behaves_as_predicted_for_every_reading() {
    let workshop = TestFolder::new();
    let told = output_json(&run_tune(&workshop, &["--format", "json"]));
    for (reading, in_ms) in [(0, 2.893), (1, 14.02), (2, 2.032)] {
        let figures = told.pointer(&format!("/tuning/readings/{reading}")).unwrap();
        let of = |name: &str| json_number(figures, name);
        let gains = format!(
            "[controller.gains]\namplitude_kp = {:?}\namplitude_ki = {:?}\nfrequency_kp = {:?}\nfrequency_ki = {:?}\n",
            of("/amplitude/kp"),
            of("/amplitude/ki_per_s"),
            of("/frequency/kp"),
            of("/frequency/ki_per_s"),
        );
        let measured = workshop.first_value(&step_scenario("aluminium-198x138", &gains, "", SETTLING)).unwrap();
        let predicted = of("/plate/settling_ms");
        assert!((measured / predicted - 1.0).abs() < 0.02, "reading {reading}: {measured} instead of {predicted}");
        assert!((predicted - in_ms).abs() < 0.01, "reading {reading}: {predicted}");
    }
}

#[rstest]
#[case::drive_just_not(&[], 415.0, 1, "drive-floor")]
#[case::drive_just(&[], 416.0, 0, "")]
#[case::delay(&["--delay-ms", "1.7"], 900.0, 1, "delay")]
#[case::period(&["--response-ms", "0.5"], 900.0, 1, "period")]
#[case::phase(&["--phase-margin-deg", "70"], 900.0, 1, "phase-margin")]
#[case::out_of_reach(&["--setpoint-um", "7"], 900.0, 1, "out-of-reach")]
#[case::too_fast_over_a_line(&["--delay-ms", "0.52"], 900.0, 1, "reading")]
fn an_unmet_demand_is_neither_written_nor_sent(
    #[case] arguments: &[&str],
    #[case] limit: f64,
    #[case] expected: i32,
    #[case] kind: &str,
) {
    let workshop = TestFolder::new();
    write_scaled_plate(&workshop, 1.0, 1.0, limit);
    let text = step_scenario("aluminium-198x138", "", "", SETTLING);
    let scenario = workshop.write_scenario("mine.toml", &text);
    let more = ["--format", "json", "--write", "scenarios/mine.toml", "--send", "hosted", "--out", "run"];
    let output = run_tune(&workshop, &[arguments, &more].concat());
    let told = output_json(&output);
    assert_eq!(exit_code(&output), expected, "{told:#}");
    let kinds: Vec<_> = told["tuning"]["obstacles"].as_array().unwrap().iter().map(|told| &told["kind"]).collect();
    assert_eq!(kinds.iter().any(|told| **told == kind), expected == 1, "{kinds:?}");
    assert_eq!(fs::read_to_string(&scenario).unwrap() == text, expected == 1);
    assert_eq!(workshop.path().join("run").exists(), expected == 0);
    // The same in words, with the same end.
    assert_eq!(exit_code(&run_tune(&workshop, arguments)), expected);
}

#[test]
fn gains_are_sent_and_confirmed() {
    let workshop = TestFolder::new();
    let output = run_tune(&workshop, &["--send", &controller_rig(None), "--out", "run"]);
    let text = String::from_utf8_lossy(&output.stdout);
    assert_eq!(exit_code(&output), 0, "{text}{}", String::from_utf8_lossy(&output.stderr));
    assert!(text.contains("accepted the gains") && text.contains("measured"), "{text}");
}

/// What the example needs of pyserial, so that the test needs none.
const SERIAL: &str = r#"
import os, select, tty

class SerialException(OSError):
    pass

class Serial:
    in_waiting = 0

    def __init__(self, path, baud, timeout, write_timeout):
        self.port = os.open(path, os.O_RDWR | os.O_NOCTTY)
        tty.setraw(self.port)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        os.close(self.port)

    def read(self, count):
        ready, _, _ = select.select([self.port], [], [], 0.001)
        return os.read(self.port, 4096) if ready else b""

    def write(self, data):
        os.write(self.port, data)
"#;

#[rstest]
#[case::takes_them("tuple(gains) if bits & 1 else None", 0, "accepted the gains")]
#[case::keeps_its_own("None", 2, "reports other gains than those sent")]
fn a_controller_that_ignores_the_gains_is_an_error(#[case] gains: &str, #[case] expected: i32, #[case] said: &str) {
    let workshop = TestFolder::new();
    let example = fs::read_to_string(workspace_root().join("docs/examples/controller.py")).unwrap();
    let used = "tuple(gains) if bits & 1 else None";
    assert!(example.contains(used));
    fs::write(workshop.path().join("mine.py"), example.replace(used, gains)).unwrap();
    fs::write(workshop.path().join("serial.py"), SERIAL).unwrap();
    let output = run_tune(&workshop, &["--send", "exec:python3 mine.py {port}", "--out", "run"]);
    let text = [output.stdout.clone(), output.stderr.clone()].concat();
    let text = String::from_utf8_lossy(&text);
    assert_eq!(exit_code(&output), expected, "{text}");
    assert!(text.contains(said), "{text}");
    assert_eq!(workshop.path().join("run").exists(), expected == 0);
}

#[rstest]
#[case::no_one_there("exec:true {port}", 5)]
#[case::no_such_port("serial:/dev/no-such-port", 5)]
fn an_absent_rig_is_not_a_failed_tuning(#[case] rig: &str, #[case] expected: i32) {
    let workshop = TestFolder::new();
    let output = run_tune(&workshop, &["--send", rig, "--out", "run"]);
    assert_eq!(exit_code(&output), expected, "{}", String::from_utf8_lossy(&output.stderr));
    assert!(!workshop.path().join("run").exists());
}

/// A scenario whose controller is written as `controller`, with comments that have to stay.
fn commented_scenario(controller: &str) -> String {
    format!(
        "# Mine.\ntitle = \"step\" # a title\nplate   = \"plates/aluminium-198x138.toml\"\nduration_ms = 60.0\n{controller}\n\n[profile] # what is played\nsetpoint_um = 2.0\n\n[[expect]]\nmetric = \"settling_time_ms\"\nat_most = 2.0"
    )
}

#[rstest]
#[case::a_table("\n[controller] # which\nlaw = \"dq-pi\" # mine\n")]
#[case::gains_there(
    "\n[controller]\nlaw = \"dq-pi\"\n\n[controller.gains]\namplitude_kp = 1.0 # loud\nfrequency_ki = 4.0\namplitude_ki = 2.0\nfrequency_kp = 3.0 # last"
)]
#[case::gains_alone("[controller.gains]\namplitude_kp = 1\namplitude_ki = 2\nfrequency_kp = 3\nfrequency_ki = 4")]
#[case::dotted(
    "[controller]\ngains.amplitude_kp = 1.0\ngains.amplitude_ki = 2.0\ngains.frequency_kp = 3.0\ngains.frequency_ki = 4.0"
)]
#[case::dotted_from_the_top("controller.law = \"dq-pi-fixed\"")]
#[case::inline("controller = { law = \"dq-pi\" }")]
#[case::inline_gains(
    "[controller]\ngains = { amplitude_kp = 1.0, amplitude_ki = 2.0, frequency_kp = 3.0, frequency_ki = 4.0 }"
)]
#[case::nothing("")]
fn writing_gains_keeps_the_rest_of_the_scenario(#[case] controller: &str) {
    let workshop = TestFolder::new();
    let text = commented_scenario(controller);
    let path = workshop.write_scenario("mine.toml", &text);
    let output = run_tune(&workshop, &["--write", "scenarios/mine.toml", "--format", "json"]);
    let said = String::from_utf8_lossy(&output.stderr);
    assert_eq!(exit_code(&output), 0, "{said}");
    let written = fs::read_to_string(&path).unwrap();
    // Every comment and every line that says nothing of gains is still there, in its order.
    let mut rest = written.as_str();
    for line in text.lines().filter(|line| !line.contains("gains") && !line.contains("_k")) {
        // A table in braces has got the gains into its own line.
        let line = line.trim_end_matches(" }");
        let at = rest.find(line).unwrap_or_else(|| panic!("{line} is not in\n{written}"));
        rest = &rest[at + line.len()..];
    }
    for comment in text.split('#').skip(1).map(|rest| rest.lines().next().unwrap()) {
        assert!(written.contains(comment), "{comment} is not in\n{written}");
    }
    // What is said behind a number stays behind it.
    for (key, comment) in [("amplitude_kp", "# loud"), ("frequency_kp", "# last")] {
        let line = text.lines().find(|line| line.contains(key) && line.contains(comment));
        let stays = written.lines().any(|line| line.contains(key) && line.contains(comment));
        assert_eq!(stays, line.is_some(), "{written}");
    }
    let told = output_json(&output);
    let (record, _) = workshop.run_scenario(&written);
    let settling = record.scenarios[0].expectations[0].value.unwrap();
    assert!((settling - json_number(&told, "/tuning/chosen/plate/settling_ms")).abs() < 0.002, "{settling}\n{written}");
    let scenario = platebench_scenario::load(&path, "mine.toml").unwrap();
    assert_eq!(scenario.controller.gains.unwrap().amplitude_ki, json_number(&told, "/gains/amplitude_ki"));
    // A second time there is nothing to do.
    let again = run_tune(&workshop, &["--write", "scenarios/mine.toml"]);
    assert_eq!(exit_code(&again), 0);
    assert!(String::from_utf8_lossy(&again.stderr).contains("already"));
    assert_eq!(fs::read_to_string(&path).unwrap(), written);
    // Nothing is left beside the file.
    let names = fs::read_dir(path.parent().unwrap()).unwrap().count();
    assert_eq!(names, ["plates", "mine.toml"].len() + usize::from(path.with_file_name("played.toml").exists()));
}

#[rstest]
#[case::another_plate(("aluminium-198x138.toml", "aluminium-198x138-400vpp.toml"), "mine.toml:3:")]
#[case::another_period(("law = \"dq-pi\"", "period_ms = 0.5"), "mine.toml:6:")]
#[case::a_law_without_such_gains(("law = \"dq-pi\"", "law = \"frequency-only\""), "mine.toml:6:")]
#[case::a_told_delay(("law = \"dq-pi\"", "law = \"dq-pi\"\ndesign_delay_ms = 0.5"), "mine.toml:7:")]
#[case::no_scenario(("duration_ms", "duration"), "mine.toml:4:1")]
#[case::no_toml(("[profile]", "[profile"), "mine.toml:8:")]
fn an_unsuitable_scenario_is_not_written(#[case] (good, bad): (&str, &str), #[case] pointer: &str) {
    let workshop = TestFolder::new();
    let text = commented_scenario("[controller]\nlaw = \"dq-pi\"");
    assert!(text.contains(good));
    let text = text.replace(good, bad);
    let path = workshop.write_scenario("mine.toml", &text);
    let output = run_tune(&workshop, &["--write", "scenarios/mine.toml", "--send", "hosted", "--out", "run"]);
    let said = String::from_utf8_lossy(&output.stderr);
    assert_eq!(exit_code(&output), 2, "{said}");
    assert!(said.contains(pointer), "{said}");
    assert_eq!(fs::read_to_string(&path).unwrap(), text);
    assert!(!workshop.path().join("run").exists());
}

#[cfg(unix)]
#[test]
fn a_written_file_keeps_its_permissions_and_a_link_stays_a_link() {
    use std::os::unix::fs::{PermissionsExt, symlink};
    let workshop = TestFolder::new();
    let path = workshop.write_scenario("mine.toml", &commented_scenario(""));
    fs::set_permissions(&path, fs::Permissions::from_mode(0o640)).unwrap();
    let link = workshop.path().join("link.toml");
    symlink(&path, &link).unwrap();
    assert_eq!(exit_code(&run_tune(&workshop, &["--write", "link.toml"])), 0);
    assert!(fs::symlink_metadata(&link).unwrap().is_symlink());
    assert!(fs::read_to_string(&path).unwrap().contains("amplitude_kp"));
    assert_eq!(fs::metadata(&path).unwrap().permissions().mode() & 0o777, 0o640);
}

#[rstest]
#[case::no_plate(&["--plate", "nowhere.toml"], "nowhere.toml")]
#[case::response(&["--plate", PLATE, "--response-ms", "0"], "response-ms")]
#[case::tiny_response(&["--plate", PLATE, "--response-ms", "1e-300"], "response-ms")]
#[case::long_response(&["--plate", PLATE, "--response-ms", "1000", "--period-ms", "0.999"], "response-ms")]
#[case::period(&["--plate", PLATE, "--period-ms", "1.0005"], "microseconds")]
#[case::short_period(&["--plate", PLATE, "--period-ms", "0.019"], "microseconds")]
#[case::delay(&["--plate", PLATE, "--delay-ms=-0.1"], "delay-ms")]
#[case::long_delay(&["--plate", PLATE, "--delay-ms", "20.001"], "delay-ms")]
#[case::setpoint(&["--plate", PLATE, "--setpoint-um", "NaN"], "setpoint-um")]
#[case::phase(&["--plate", PLATE, "--phase-margin-deg", "90"], "phase-margin-deg")]
#[case::spread(&["--plate", PLATE, "--gain-spread-percent", "50.1"], "gain-spread-percent")]
#[case::law(&["--plate", PLATE, "--law", "deadbeat"], "deadbeat")]
#[case::rig(&["--plate", PLATE, "--send", "can:0"], "can:0")]
#[case::out_without_rig(&["--plate", PLATE, "--out", "run"], "--send")]
fn wrong_usage_names_the_argument(#[case] arguments: &[&str], #[case] named: &str) {
    let workshop = TestFolder::new();
    let output = run_bench(workshop.path(), std::iter::once(&"tune").chain(arguments));
    let said = String::from_utf8_lossy(&output.stderr);
    assert_eq!(exit_code(&output), 2, "{said}");
    assert!(said.contains(named) && !said.contains("panicked"), "{said}");
}

#[test]
fn a_plate_file_error_is_reported_with_its_line() {
    let workshop = TestFolder::new();
    let path = workshop.path().join(PLATE);
    let text = fs::read_to_string(&path).unwrap();
    for (good, bad) in [("time_constant_ms = 1.88", "time_constant_ms = -1.0"), ("[drive]", "[drives]")] {
        fs::write(&path, text.replace(good, bad)).unwrap();
        let output = run_tune(&workshop, &[]);
        let said = String::from_utf8_lossy(&output.stderr);
        let line = text.lines().position(|line| line.contains(good)).unwrap() + 1;
        assert_eq!(exit_code(&output), 2, "{said}");
        assert!(said.contains(&format!("aluminium-198x138.toml:{line}:")), "{said}");
    }
}

#[rstest]
#[case::nothing_said("", &[], 5.0, 6.0)]
#[case::the_file_says("gain_percent = 1.7\ntime_constant_percent = 0.0\n", &[], 1.7, 0.0)]
#[case::one_of_them("time_constant_percent = 50.0\n", &[], 5.0, 50.0)]
#[case::the_command_line_counts("gain_percent = 90.0\n", &["--gain-spread-percent", "3"], 3.0, 6.0)]
fn the_spread_defaults_to_the_plate_s_uncertainty(
    #[case] keys: &str,
    #[case] arguments: &[&str],
    #[case] gain: f64,
    #[case] time_constant: f64,
) {
    let workshop = TestFolder::new();
    write_plate_uncertainty(&workshop, keys);
    let told = output_json(&run_tune(&workshop, &[&["--format", "json"], arguments].concat()));
    assert_eq!(
        (json_number(&told, "/spread/gain_percent"), json_number(&told, "/spread/time_constant_percent")),
        (gain, time_constant)
    );
}

#[test]
fn a_too_large_plate_uncertainty_is_rejected() {
    let workshop = TestFolder::new();
    write_plate_uncertainty(&workshop, "gain_percent = 50.01\n");
    let output = run_tune(&workshop, &[]);
    let said = String::from_utf8_lossy(&output.stderr);
    assert_eq!(exit_code(&output), 2, "{said}");
    let text = fs::read_to_string(workshop.path().join(PLATE)).unwrap();
    let line = text.lines().position(|line| line.starts_with("gain_percent")).unwrap() + 1;
    assert!(said.contains(&format!("aluminium-198x138.toml:{line}:")) && said.contains("at most 50"), "{said}");
}

/// Lets the plate file say how well it is known.
fn write_plate_uncertainty(workshop: &TestFolder, keys: &str) {
    let path = workshop.path().join(PLATE);
    let text = fs::read_to_string(&path).unwrap();
    fs::write(&path, format!("{text}\n[uncertainty]\n{keys}")).unwrap();
}
