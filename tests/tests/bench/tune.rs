//! Tests `platebench tune`: predictions against the firmware, and gains written into scenarios.

use crate::test_folder::{PLATE, ProgramOutput, SETTLING, TestFolder, step_scenario, step_text, workspace_root};
use platebench_model::record::Verdict;
use rstest::rstest;
use serde_json::Value;
use std::fs;

#[track_caller]
fn run_tune(folder: &TestFolder, arguments: &[&str]) -> ProgramOutput {
    folder.bench(["tune", "--plate", PLATE, "--samples", "8"].iter().chain(arguments))
}

#[track_caller]
fn json_number(json: &Value, pointer: &str) -> f64 {
    json.pointer(pointer).and_then(Value::as_f64).unwrap_or_else(|| panic!("no number at {pointer} of {json:#}"))
}

fn scaled_plate_folder(gain: f64, time_constant: f64, limit: f64) -> TestFolder {
    let folder = TestFolder::new();
    folder.replace(PLATE, "gain_um_per_vpp = 0.00698", &format!("gain_um_per_vpp = {}", 0.006_98 * gain));
    folder.replace(PLATE, "time_constant_ms = 1.88", &format!("time_constant_ms = {}", 1.88 * time_constant));
    folder.replace(PLATE, "limit_vpp = 900.0", &format!("limit_vpp = {limit:?}"));
    folder
}

fn controller_with_gains(tuning: &Value, law: &str) -> String {
    let gain = |name: &str| format!("{name} = {:?}\n", json_number(tuning, &format!("/gains/{name}")));
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
    let folder = scaled_plate_folder(1.0, 1.0, limit);
    let arguments = [arguments, &["--send", "hosted", "--out", "run", "--format", "json"]].concat();
    let tuning = run_tune(&folder, &arguments).assert_exit(0).json();
    let pairs = ["settling_ms", "overshoot_percent", "peak_drive_vpp"].map(|name| {
        (
            json_number(&tuning, &format!("/tuning/chosen/plate/{name}")),
            json_number(&tuning, &format!("/measured/{name}")),
        )
    });
    let [(settling, measured_settling), (overshoot, measured_overshoot), (peak, measured_peak)] = pairs;
    assert!((measured_settling / settling - 1.0).abs() < 0.005, "settling: {measured_settling} instead of {settling}");
    assert!((measured_overshoot - overshoot).abs() < 0.1, "overshoot: {measured_overshoot} instead of {overshoot}");
    assert!((measured_peak / peak - 1.0).abs() < 0.001, "peak drive: {measured_peak} instead of {peak}");
    assert!(measured_peak <= 1.000_001 * limit);
    folder.bench(["report", "run", "--rejudge"]).assert_exit(0);
}

#[test]
fn the_firmware_behaves_as_predicted_at_every_corner() {
    let folder = TestFolder::new();
    let tuning = run_tune(&folder, &["--format", "json"]).json();
    let corners = tuning.pointer("/tuning/sensitivity/corners").and_then(Value::as_array).unwrap();
    assert_eq!(corners.len(), 8);
    let controller = controller_with_gains(&tuning, "dq-pi");
    let text = |profile: &str| step_scenario("aluminium-198x138", &controller, profile, SETTLING);
    for corner in corners {
        let factor = |name: &str| 1.0 + json_number(corner, name) / 100.0;
        let plate = scaled_plate_folder(factor("/gain_percent"), factor("/time_constant_percent"), 900.0);
        let (predicted, measured) = (json_number(corner, "/plate/settling_ms"), plate.first_value(&text("")).unwrap());
        assert!((measured / predicted - 1.0).abs() < 0.02, "{corner:#}: {measured}");
    }
    let predicted = json_number(&tuning, "/tuning/sensitivity/other_finger/plate/settling_ms");
    let measured = folder.first_value(&text("finger_force_n = 2.0")).unwrap();
    assert!((measured / predicted - 1.0).abs() < 0.02, "{measured} instead of {predicted}");
}

#[test]
fn the_firmware_behaves_as_predicted_for_every_reading() {
    let folder = TestFolder::new();
    let tuning = run_tune(&folder, &["--format", "json"]).json();
    for (reading, in_ms) in [(0, 2.893), (1, 14.02), (2, 2.032)] {
        let figures = tuning.pointer(&format!("/tuning/readings/{reading}")).unwrap();
        let of = |name: &str| json_number(figures, name);
        let gains = format!(
            "[controller.gains]\namplitude_kp = {:?}\namplitude_ki = {:?}\nfrequency_kp = {:?}\nfrequency_ki = {:?}\n",
            of("/amplitude/kp"),
            of("/amplitude/ki_per_s"),
            of("/frequency/kp"),
            of("/frequency/ki_per_s"),
        );
        let measured = folder.first_value(&step_scenario("aluminium-198x138", &gains, "", SETTLING)).unwrap();
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
#[case::too_fast_over_a_line(&["--delay-ms", "0.52"], 900.0, 1, "discretisation")]
fn an_unmet_demand_is_neither_written_nor_sent(
    #[case] arguments: &[&str],
    #[case] limit: f64,
    #[case] expected: i32,
    #[case] kind: &str,
) {
    let folder = scaled_plate_folder(1.0, 1.0, limit);
    let text = step_text(SETTLING);
    folder.write_scenario("mine.toml", &text);
    let more = ["--format", "json", "--write", "scenarios/mine.toml", "--send", "hosted", "--out", "run"];
    let tuning = run_tune(&folder, &[arguments, &more].concat()).assert_exit(expected).json();
    let obstacles = tuning["tuning"]["obstacles"].as_array().unwrap();
    assert_eq!(obstacles.iter().any(|obstacle| obstacle["kind"] == kind), expected == 1, "{obstacles:?}");
    assert_eq!(folder.read("scenarios/mine.toml") == text, expected == 1);
    assert_eq!(folder.exists("run"), expected == 0);
    run_tune(&folder, arguments).assert_exit(expected);
}

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
#[case::takes_them(["", ""], 0, "accepted the gains")]
#[case::keeps_its_own(["tuple(gains) if bits & 1 else ()", "()"], 2, ", expected those sent: ")]
#[case::confirms_and_uses_1_05_of_them(
    ["Loop(kp_a, ki_a", "Loop(1.05 * kp_a, 1.05 * ki_a"],
    0,
    "accepted the gains"
)]
#[case::confirms_and_uses_1_2_of_them(
    ["Loop(kp_a, ki_a", "Loop(1.2 * kp_a, 1.2 * ki_a"],
    1,
    "fail: drive_peak_vpp: "
)]
fn a_controller_that_ignores_the_gains_is_an_error(
    #[case] change: [&str; 2],
    #[case] expected: i32,
    #[case] message: &str,
) {
    let folder = TestFolder::new();
    fs::copy(workspace_root().join("docs/examples/controller.py"), folder.join("mine.py")).unwrap();
    if !change[0].is_empty() {
        folder.replace("mine.py", change[0], change[1]);
    }
    folder.write("serial.py", SERIAL);
    run_tune(&folder, &["--send", "exec:python3 mine.py {port}", "--out", "run"]).assert_text(expected, &[message]);
    assert_eq!(folder.exists("run"), expected != 2);
    if expected != 2 {
        assert_eq!(folder.record("run").verdict == Verdict::Pass, expected == 0);
    }
}

fn commented_scenario(controller: &str) -> String {
    format!(
        "# Mine.\ntitle = \"step\" # a title\nplate   = \"plates/aluminium-198x138.toml\"\nduration_ms = 60.0\n\
         {controller}\n\n[profile] # a step\nsetpoint_um = 2.0\n\n\
         [[expect]]\nmetric = \"settling_time_ms\"\nat_most = 2.0"
    )
}

#[rstest]
#[case::a_table("\n[controller] # which\nlaw = \"dq-pi\" # mine\n")]
#[case::gains_there(
    "\n[controller]\nlaw = \"dq-pi\"\n\n[controller.gains]\namplitude_kp = 1.0 # loud\nfrequency_ki = 4.0\n\
     amplitude_ki = 2.0\nfrequency_kp = 3.0 # last"
)]
#[case::gains_alone("[controller.gains]\namplitude_kp = 1\namplitude_ki = 2\nfrequency_kp = 3\nfrequency_ki = 4")]
#[case::dotted(
    "[controller]\ngains.amplitude_kp = 1.0\ngains.amplitude_ki = 2.0\n\
     gains.frequency_kp = 3.0\ngains.frequency_ki = 4.0"
)]
#[case::dotted_from_the_top("controller.law = \"dq-pi-fixed\"")]
#[case::inline("controller = { law = \"dq-pi\" }")]
#[case::inline_gains(
    "[controller]\ngains = { amplitude_kp = 1.0, amplitude_ki = 2.0, frequency_kp = 3.0, frequency_ki = 4.0 }"
)]
#[case::nothing("")]
fn writing_gains_keeps_the_rest_of_the_scenario(#[case] controller: &str) {
    let text = commented_scenario(controller);
    let folder = TestFolder::new();
    let path = folder.write_scenario("mine.toml", &text);
    let tuning = run_tune(&folder, &["--write", "scenarios/mine.toml", "--format", "json"]).assert_exit(0).json();
    let written = fs::read_to_string(&path).unwrap();
    // All lines without gains, and all comments, are still there in their order.
    let mut rest = written.as_str();
    for line in text.lines().filter(|line| !line.contains("gains") && !line.contains("_k")) {
        let line = line.trim_end_matches(" }");
        let at = rest.find(line).unwrap_or_else(|| panic!("{line} is not in\n{written}"));
        rest = &rest[at + line.len()..];
    }
    for comment in text.split('#').skip(1).map(|rest| rest.lines().next().unwrap()) {
        assert!(written.contains(comment), "{comment} is not in\n{written}");
    }
    for (key, comment) in [("amplitude_kp", "# loud"), ("frequency_kp", "# last")] {
        let has_comment = |text: &str| text.lines().any(|line| line.contains(key) && line.contains(comment));
        assert_eq!(has_comment(&written), has_comment(&text), "{written}");
    }
    let (record, _) = folder.run_scenario(&written);
    let settling = record.scenarios[0].expectations[0].value.unwrap();
    let predicted = json_number(&tuning, "/tuning/chosen/plate/settling_ms");
    assert!((settling - predicted).abs() < 0.002, "{settling}\n{written}");
    let scenario = platebench_model::scenario::load(&path, "mine.toml").unwrap();
    assert_eq!(scenario.controller.gains.unwrap().amplitude_ki, json_number(&tuning, "/gains/amplitude_ki"));
    run_tune(&folder, &["--write", "scenarios/mine.toml"]).assert_message(0, &["already"]);
    assert_eq!(fs::read_to_string(&path).unwrap(), written);
    let names = fs::read_dir(path.parent().unwrap()).unwrap().count();
    assert_eq!(names, ["plates", "mine.toml"].len() + usize::from(path.with_file_name("value.toml").exists()));
}

#[cfg(unix)]
#[test]
fn a_written_file_keeps_its_permissions_and_its_link() {
    use std::os::unix::fs::{PermissionsExt, symlink};
    let folder = TestFolder::new();
    let path = folder.write_scenario("mine.toml", &commented_scenario(""));
    fs::set_permissions(&path, fs::Permissions::from_mode(0o640)).unwrap();
    let link = folder.join("link.toml");
    symlink(&path, &link).unwrap();
    run_tune(&folder, &["--write", "link.toml"]).assert_exit(0);
    assert!(fs::symlink_metadata(&link).unwrap().is_symlink());
    assert!(fs::read_to_string(&path).unwrap().contains("amplitude_kp"));
    assert_eq!(fs::metadata(&path).unwrap().permissions().mode() & 0o777, 0o640);
}
