use crate::fixtures::{FIG13, LOCKSTEP, plan, run_hosted};
use platebench_engine::{RejudgeError, RunPlan, law, lockstep, rejudge};
use platebench_model::record::{Overrides, RunRecord};
use platebench_model::scenario::Scenario;
use platebench_model::trace::{Flags, Row};
use platebench_plate::Model;
use platebench_test_kit::{PLATE, load_scenario, write_scenario};
use std::fs;
use std::path::Path;

fn rows(scenario: &Scenario, model: Model) -> Vec<Row> {
    let scenario = Scenario { model, ..scenario.clone() };
    lockstep::play_hosted(&scenario, law(&scenario).unwrap(), 0).unwrap().trace_rows
}

fn max_deviation(left: &[Row], right: &[Row]) -> (f64, usize) {
    let common = left.iter().filter_map(|row| Some((row, right.iter().find(|other| other.t_s == row.t_s)?)));
    common.fold((0.0, 0), |(worst, count), (a, b)| {
        let deviation = (a.wd_um - b.wd_um).hypot(a.wq_um - b.wq_um) / a.setpoint_um;
        (f64::max(worst, deviation), count + 1)
    })
}

#[test]
fn every_model_has_a_row_at_every_control_instant() {
    let scenario = load_scenario(FIG13);
    let [carrier, exact, cheap] = [Model::Carrier, Model::Modal, Model::Envelope].map(|model| rows(&scenario, model));
    let controls = |rows: &[Row]| rows.iter().filter(|row| row.flags.contains(Flags::CONTROL)).count();
    assert_eq!(controls(&exact), controls(&cheap));
    let (error, compared) = max_deviation(&exact, &cheap);
    assert!(compared > 10);
    // The closed loop at resonance has a measured deviation of 4.8e-3 of the setpoint.
    assert!((4e-3..6e-3).contains(&error), "{error:e}");
    assert_eq!(max_deviation(&carrier, &exact), (0.0, carrier.len()));
}

const STEP: &str = "title = \"step\"\nplate = \"plate.toml\"\nduration_ms = 30.0\n[controller]\nlaw = \"open-loop\"\n\
    [profile]\nsetpoint_um = 2.0\n[[expect]]\nmetric = \"final_amplitude_um\"\nwithin = [1.8, 2.2]\n";

fn run_step(folder: &Path, model: Option<&str>) -> RunRecord {
    let mut scenario = write_scenario(folder, STEP, PLATE);
    let overrides = Overrides { model: model.map(ToOwned::to_owned), ..Overrides::default() };
    rejudge::apply_overrides(&overrides, &mut scenario);
    run_hosted(&RunPlan { overrides, ..plan(vec![scenario], LOCKSTEP) }, &folder.join("run"))
}

#[test]
fn the_record_names_the_model() {
    for (option, model) in
        [(None, "modal"), (Some("auto"), "modal"), (Some("carrier"), "carrier"), (Some("envelope"), "envelope")]
    {
        let folder = tempfile::tempdir().unwrap();
        let record = run_step(folder.path(), option);
        assert_eq!(record.scenarios[0].model, model);
        let judged = rejudge(&folder.path().join("run"), None).unwrap();
        assert_eq!(judged.scenarios[0].model, model);
        assert_eq!(judged.scenarios[0].expectations, record.scenarios[0].expectations);
    }
}

#[test]
fn rejects_a_scenario_with_another_model() {
    let folder = tempfile::tempdir().unwrap();
    run_step(folder.path(), None);
    let path = folder.path().join("s.toml");
    for (model, is_same) in [("auto", true), ("modal", true), ("envelope", false), ("carrier", false)] {
        fs::write(&path, format!("model = \"{model}\"\n{STEP}")).unwrap();
        match rejudge(&folder.path().join("run"), Some(&path)) {
            Ok(_) => assert!(is_same, "{model}"),
            Err(RejudgeError::DifferentExperiment { what, .. }) => assert!(!is_same && what == "model", "{what}"),
            Err(other) => panic!("{other}"),
        }
    }
}
