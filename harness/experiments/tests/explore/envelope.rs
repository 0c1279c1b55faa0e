//! Checks the errors of envelope files.

use crate::fixtures::envelope_path;
use platebench_experiments::explore::Envelope;
use rstest::rstest;
use std::fs;

#[rstest]
#[case("setpoint_um = [0.02, 5.0]", "setpoint_um = [5.0, 0.02]", "with low not above high")]
#[case("setpoint_um = [0.02, 5.0]", "setpoint_um = [0.0, 5.0]", "`setpoint_um`: 0 µm, expected 0.01 to 100")]
#[case("setpoint_um = [0.02, 5.0]", "setpoint_um = [nan, 5.0]", "NaN µm, expected 0.01 to 100")]
#[case("events = [1, 5]", "events = [0, 5]", "`events`: 0, expected 1 to 20")]
#[case("period_ms = [", "period_s = [", "unknown key `period_s`")]
fn points_at_a_wrong_range(#[case] right: &str, #[case] wrong: &str, #[case] message: &str) {
    let folder = tempfile::tempdir().unwrap();
    let text = fs::read_to_string(envelope_path()).unwrap();
    let plate = envelope_path().with_file_name("plates/aluminium-198x138.toml");
    let text = text.replace("plates/aluminium-198x138.toml", &plate.display().to_string());
    assert!(text.contains(right), "{right}");
    let path = folder.path().join("envelope.toml");
    fs::write(&path, text.replace(right, wrong)).unwrap();
    let faults = Envelope::load(&path).unwrap_err();
    let line = text.lines().position(|line| line.contains(right)).unwrap() + 1;
    let fault = faults.iter().find(|fault| fault.message.contains(message)).unwrap_or_else(|| panic!("{faults:?}"));
    assert_eq!(fault.position().0, line, "{faults:?}");
}

#[test]
fn the_committed_envelope_is_valid() {
    Envelope::load(&envelope_path()).unwrap();
}
