use super::*;
use std::fs;
use tempfile::TempDir;

const PLATE: &str = include_str!("../../../../../scenarios/plates/aluminium-198x138.toml");
const SCENARIO: &str = "title = \"x\"\nplate = \"plate.toml\"\nduration_ms = 20.0\n[profile]\n\
                        setpoint_um = { hold = [[0.0, 0.0], [1.0, 2.0]] }\n\
                        [[expect]]\nmetric = \"settling_time_ms\"\nat_most = 2.0\n";

fn template(folder: &TempDir) -> ScenarioTemplate {
    fs::write(folder.path().join("plate.toml"), PLATE).unwrap();
    let path = folder.path().join("scenario.toml");
    fs::write(&path, SCENARIO).unwrap();
    crate::scenario::load::load_template(&path, "scenario.toml", |_| {}).unwrap()
}

fn load(template: &ScenarioTemplate, key: &str, value: impl Into<Value>) -> Result<Scenario, String> {
    let tables = template.tables([(key, value.into())])?;
    template.check(&tables).map_err(|faults| faults[0].message.clone())
}

#[test]
fn changes_a_value_of_a_missing_table() {
    let folder = tempfile::tempdir().unwrap();
    let scenario = load(&template(&folder), "controller.loop_delay_ms", 0.3).unwrap();
    assert_eq!(scenario.controller.loop_delay.ms(), 0.3);
    assert!(scenario.controller.design_plate.is_none());
}

#[test]
fn changes_a_point_of_a_profile() {
    let folder = tempfile::tempdir().unwrap();
    let scenario = load(&template(&folder), "profile.setpoint_um.hold.1.1", 1.5).unwrap();
    assert_eq!(scenario.setpoint.at(platebench_plate::Time::from_ms(2.0).unwrap()), 1.5);
}

#[test]
fn a_changed_plate_is_played_and_the_own_plate_configured() {
    let folder = tempfile::tempdir().unwrap();
    let scenario = load(&template(&folder), "plate.mode.gain_um_per_vpp", 0.008).unwrap();
    assert_eq!((scenario.plate.gain, scenario.design_plate().gain), (0.008, 0.00698));
}

/// A scenario whose own values are replaced is read from its table.
#[test]
fn a_changed_plate_and_seed_give_the_scenario_of_the_table() {
    let folder = tempfile::tempdir().unwrap();
    let template = template(&folder);
    let changes = [("plate.mode.gain_um_per_vpp", Value::Float(0.008)), ("trials.seed", Value::Integer(7))];
    let same_title = ("title", Value::String("x".to_owned()));
    let [short, whole] = [changes.to_vec(), [changes.to_vec(), vec![same_title]].concat()].map(|changes| {
        let tables = template.tables(changes).unwrap();
        (format!("{:?}", template.check(&tables).unwrap()), template.scenario_table(&tables))
    });
    assert_eq!(short, whole);
    assert!(short.0.contains("seed: 7"), "{}", short.0);
    assert_eq!(short.1["trials"]["seed"], Value::Integer(7));
}

#[test]
fn names_a_wrong_key_and_a_wrong_value() {
    let folder = tempfile::tempdir().unwrap();
    let template = template(&folder);
    for (key, value, expected) in [
        ("controller.loop_delay_us", Value::Float(1.0), "did you mean `loop_delay_ms`, in ms?"),
        ("controller.law", Value::Float(1.0), "expected a string"),
        ("plate.mode.gain", Value::Float(1.0), "unknown key `gain`"),
        ("plate.mode.gain_um_per_vpp", Value::Float(-1.0), "gain_um_per_vpp"),
        ("profile.setpoint_um.hold.2.1", Value::Float(1.0), "`hold` has no element 2, expected 0 to 1"),
        ("duration_ms.x", Value::Float(1.0), "`duration_ms` is a float and has no key `x`"),
    ] {
        let message = load(&template, key, value).unwrap_err();
        assert!(message.contains(expected), "{key}: {message}");
    }
}
