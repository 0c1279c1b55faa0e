//! Checks which model of the plate a run plays, records and judges.

#![allow(clippy::unwrap_used, clippy::panic, reason = "helpers of tests")]

use platebench_plate::Tier;
use platebench_record::{Overrides, RunFolder, RunRecord};
use platebench_rig::RigSpec;
use platebench_runner::fidelity;
use platebench_runner::{CancelToken, Clock, RejudgeError, RunHooks, RunPlan, rejudge};
use platebench_scenario::load;
use platebench_trace::{Flags, Row};
use std::path::{Path, PathBuf};

fn scenarios() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../scenarios")
}

#[test]
fn every_model_has_a_row_at_every_control_instant() {
    let scenario = load(&scenarios().join("paper/fig13-closed-loop.toml"), "fig13.toml").unwrap();
    let [exact, cheap] =
        [Tier::Modal, Tier::Envelope].map(|tier| fidelity::rows(&scenario, tier, &CancelToken::default()).unwrap());
    let controls = |rows: &[Row]| rows.iter().filter(|row| row.flags.contains(Flags::CONTROL)).count();
    assert_eq!(controls(&exact), controls(&cheap));
    let (error, compared) = fidelity::max_deviation(&exact, &cheap, &|_| true);
    assert!(compared > 10);
    // Closed loop at resonance: 4.8e-3 of the setpoint.
    assert!((4e-3..6e-3).contains(&error), "{error:e}");
}

const STEP: &str = "title = \"step\"\nplate = \"plate.toml\"\nduration_ms = 30.0\n[controller]\nlaw = \"open-loop\"\n\
    [profile]\nsetpoint_um = 2.0\n[[expect]]\nmetric = \"final_amplitude_um\"\nwithin = [1.8, 2.2]\n";

/// Plays [`STEP`] with `--model`.
fn run_step(folder: &Path, model: Option<&str>) -> RunRecord {
    std::fs::copy(scenarios().join("plates/aluminium-198x138.toml"), folder.join("plate.toml")).unwrap();
    let path = folder.join("step.toml");
    std::fs::write(&path, STEP).unwrap();
    let mut scenario = load(&path, "step.toml").unwrap_or_else(|error| panic!("{error}"));
    let overrides = Overrides { model: model.map(ToOwned::to_owned), ..Overrides::default() };
    platebench_runner::rejudge::apply_overrides(&overrides, &mut scenario);
    let plan = RunPlan {
        scenarios: vec![scenario],
        jobs: 1,
        clock: Clock::Lockstep { wire_time: false },
        own_clock: false,
        rig: "hosted".to_owned(),
        overrides,
    };
    let run = RunFolder::create(Some(&folder.join("run"))).unwrap();
    platebench_runner::run(&plan, &run, &|| RigSpec::Hosted.connect(), RunHooks::default()).unwrap()
}

#[test]
fn the_record_names_the_model() {
    for (asked, model) in
        [(None, "modal"), (Some("auto"), "modal"), (Some("carrier"), "carrier"), (Some("envelope"), "envelope")]
    {
        let folder = tempfile::tempdir().unwrap();
        let record = run_step(folder.path(), asked);
        assert_eq!(record.scenarios[0].model, model);
        let judged = rejudge(&folder.path().join("run"), None).unwrap();
        assert_eq!(judged.scenarios[0].model, model);
        assert_eq!(judged.scenarios[0].expectations, record.scenarios[0].expectations);
    }
}

#[test]
fn refuses_to_judge_by_a_scenario_with_another_model() {
    let folder = tempfile::tempdir().unwrap();
    run_step(folder.path(), None);
    let path = folder.path().join("step.toml");
    for (model, good) in [("auto", true), ("modal", true), ("envelope", false), ("carrier", false)] {
        std::fs::write(&path, format!("model = \"{model}\"\n{STEP}")).unwrap();
        match rejudge(&folder.path().join("run"), Some(&path)) {
            Ok(_) => assert!(good, "{model}"),
            Err(RejudgeError::DifferentExperiment { what, .. }) => assert!(!good && what == "model", "{what}"),
            Err(other) => panic!("{other}"),
        }
    }
}
