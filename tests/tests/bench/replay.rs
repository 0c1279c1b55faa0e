//! Tests `platebench replay`, which sends recorded samples to another firmware.

use crate::test_folder::{PLATE, SETTLING, TestFolder, controller_rig, step_scenario, step_text};
use rstest::rstest;
use serde_json::Value;

const TRACE: &str = "run/traces/s/000.csv";

fn recorded(scenario: &str) -> TestFolder {
    let folder = TestFolder::with_scenario(scenario);
    folder.bench(["run", "--rig", "hosted", "--out", "run"]).assert_exit_in(&[0, 1]);
    assert!(folder.join(TRACE).is_file());
    folder
}

fn step_recording() -> TestFolder {
    recorded(&step_text(SETTLING))
}

fn replay_json(folder: &TestFolder, rig: &str, further: &[&str], exit: i32) -> Value {
    let arguments = [&["replay", TRACE, "--rig", rig, "--format", "json"], further].concat();
    folder.bench(arguments).assert_exit(exit).json()
}

fn assert_identical(result: &Value, compared: u64) {
    assert_eq!((&result["verdict"], &result["open_loop"]), (&"pass".into(), &true.into()), "{result}");
    assert_eq!((&result["compared"], &result["identical"]), (&compared.into(), &compared.into()), "{result}");
    for difference in result["differences"].as_array().unwrap() {
        assert_eq!(difference["largest"], 0.0, "{result}");
    }
    assert_eq!(result["safe_confirmed"], true);
}

#[test]
fn the_same_law_repeats_every_command_bit_for_bit() {
    let folder = step_recording();
    let rig = controller_rig(None);
    for rig in ["hosted", "emulated", &rig] {
        assert_identical(&replay_json(&folder, rig, &[], 0), 60);
    }
    let text = folder.bench(["replay", TRACE]).assert_exit(0).stdout;
    assert!(text.contains("open loop: the samples are recorded"), "{text}");
}

/// A delay separates a command from its sample in the trace. Jitter makes the delay random.
#[rstest]
#[case::delay("loop_delay_ms = 0.4\n", 60)]
#[case::jitter("loop_delay_ms = 0.2\nloop_delay_jitter_ms = 0.3\n", 60)]
#[case::period("loop_delay_ms = 1.0\n", 60)]
fn finds_the_command_of_a_delayed_loop(#[case] keys: &str, #[case] compared: u64) {
    let scenario = step_scenario("aluminium-198x138-noisy", keys, "", SETTLING);
    assert_identical(&replay_json(&recorded(&scenario), "hosted", &[], 0), compared);
}

#[test]
fn another_law_or_other_gains_fail() {
    let folder = step_recording();
    let result = replay_json(&folder, "hosted", &["--law", "voltage-only"], 1);
    // `voltage-only` keeps the frequency fixed, so the frequency leaves the tube.
    assert!(!result["differences"][1]["exceedance"].is_null(), "{result}");
    let gains = "[controller.gains]\namplitude_kp = 60.0\namplitude_ki = 90000.0\nfrequency_kp = 100.0\n\
                 frequency_ki = 9e4\n[profile]";
    let text = step_text(SETTLING).replace("plates/", "scenarios/plates/").replace("[profile]", gains);
    folder.write("gains.toml", &text);
    let result = replay_json(&folder, "hosted", &["--scenario", "gains.toml"], 1);
    assert!(result["identical"].as_u64().unwrap() < 60, "{result}");
}

#[test]
fn an_absent_rig_ends_with_5_and_a_crash_with_1() {
    let folder = step_recording();
    folder.bench(["replay", TRACE, "--rig", "exec:false {port}"]).assert_exit(5);
    // The replay takes longer than the second after which the controller is killed.
    let long = step_text(SETTLING).replace("duration_ms = 60.0", "duration_ms = 60000.0");
    let folder = recorded(&long);
    let rig = controller_rig(None).replacen("exec:", "exec:timeout -s KILL 1 ", 1);
    let output = folder.bench(["replay", TRACE, "--rig", &rig]).assert_exit(1);
    assert!(output.text().contains("ended before 0 V was confirmed"), "{}", output.text());
}

#[test]
fn stops_where_a_planned_fault_acts() {
    let fault = "[[fault]]\nkind = \"drop\"\nfrom_ms = 40.0\nuntil_ms = 42.0\n";
    let folder = recorded(&(step_text(SETTLING) + fault));
    let result = replay_json(&folder, "hosted", &[], 3);
    assert_eq!((&result["samples"], &result["identical"]), (&40.into(), &40.into()), "{result}");
    assert_eq!(result["recording_end"]["fault"]["at_s"], 0.04);
}

#[test]
fn replays_a_table_of_telemetry() {
    let folder = step_recording();
    let trace = platebench_model::trace::read_trace(&folder.join(TRACE)).unwrap();
    let mut table = "ms,W,d,q,V,f\n".to_owned();
    for row in trace.iter().filter(|row| row.flags.contains(platebench_model::trace::Flags::CONTROL)) {
        let numbers = [
            row.t_s * 1e3 + 7.0,
            row.setpoint_um,
            row.sensed_wd_um,
            row.sensed_wq_um,
            row.drive_vpp / 2.0,
            row.frequency_hz,
        ];
        table += &(numbers.map(|number| number.to_string()).join(",") + "\n");
    }
    folder.write("telemetry.csv", &table);
    folder.write("s.toml", &step_text(SETTLING).replace("plates/", "scenarios/plates/"));
    let replay = |columns: &str| {
        let arguments = ["replay", "telemetry.csv", "--columns", columns, "--scenario", "s.toml", "--format", "json"];
        folder.bench(arguments)
    };
    let columns = "time=ms:ms,drive=V:V,frequency=f:Hz,wd=d:um,wq=q:um";
    for columns in [columns.to_owned(), format!("{columns},setpoint=W:um")] {
        let result = replay(&columns).assert_exit(0).json();
        assert_eq!((&result["compared"], &result["verdict"]), (&60.into(), &"pass".into()), "{result}");
        assert!(result["differences"][1]["largest"].as_f64().unwrap() < 1e-3, "{result}");
    }
    replay("time=ms:us,drive=V:V,frequency=f:Hz,wd=d:um,wq=q:um").assert_message(2, &["expected the period"]);
    replay(&format!("{columns},setpoint=X:um")).assert_message(2, &["no column `X`"]);
    assert!(folder.join(PLATE).is_file());
}
