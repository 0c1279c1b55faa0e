//! What a controller is given of a plate whose sensor has a demodulator: in the carrier tier what the lock-in shows, in the others W.

#![allow(clippy::unwrap_used, clippy::panic, reason = "helpers of tests")]

use platebench_record::Overrides;
use platebench_record::RunFolder;
use platebench_rig::RigSpec;
use platebench_runner::{Clock, RunHooks, RunPlan};
use platebench_scenario::load;
use std::fs;
use std::path::Path;

const PLATE: &str = "../../scenarios/plates/aluminium-198x138.toml";
const LOCKIN: &str = "[sensor]\ndemodulator_periods = 8\nconverter_hz = 1e6";

/// Wd of the plate and Wd as the controller was given it, at each control instant of 10 ms.
fn play(model: &str, sensor: &str) -> Vec<[f64; 2]> {
    let folder = tempfile::tempdir().unwrap();
    let plate = fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join(PLATE)).unwrap();
    assert!(plate.contains("[sensor]"));
    fs::write(folder.path().join("plate.toml"), plate.replace("[sensor]", sensor)).unwrap();
    let text = format!(
        "title = \"step\"\nplate = \"plate.toml\"\nduration_ms = 10.0\nmodel = \"{model}\"\n[controller]\nlaw = \"open-loop\"\n\
         [profile]\nsetpoint_um = 2.0\n[[expect]]\nmetric = \"overshoot_percent\"\nat_most = 1e6\n"
    );
    let path = folder.path().join("step.toml");
    fs::write(&path, text).unwrap();
    let scenario = load(&path, "step.toml").unwrap_or_else(|fault| panic!("{fault}"));
    let out = folder.path().join("run");
    let run = RunFolder::create(Some(&out)).unwrap();
    let plan = RunPlan {
        scenarios: vec![scenario],
        jobs: 1,
        clock: Clock::Lockstep { wire_time: false },
        own_clock: false,
        rig: "hosted".to_owned(),
        overrides: Overrides::default(),
    };
    let record = platebench_runner::run(&plan, &run, &|| RigSpec::Hosted.connect(), RunHooks::default()).unwrap();
    let trace = fs::read_to_string(out.join(&record.scenarios[0].trials[0].trace)).unwrap();
    let mut lines = trace.lines().map(|line| line.split(',').collect::<Vec<_>>());
    let header = lines.next().unwrap();
    let column = |name: &str| header.iter().position(|column| *column == name).unwrap();
    let (wd, sensed, flags) = (column("wd_um"), column("sensed_wd_um"), column("flags"));
    lines
        .filter(|row| row[flags].contains("control"))
        .map(|row| [row[wd], row[sensed]].map(|value| value.parse().unwrap()))
        .collect()
}

#[test]
fn a_controller_is_given_what_the_lock_in_shows_and_late() {
    let given = play("carrier", LOCKIN);
    assert!(given.len() >= 10);
    // 286 Vpp from rest: Wd rises with τ, and eight periods show what was 124 µs ago.
    let tau = 1.88e-3_f64;
    for (period, [wd, sensed]) in given.iter().enumerate().take(5).skip(1) {
        let slope = (2.0 - wd) / tau;
        let late = (wd - sensed) / slope;
        assert!((late / 123.3e-6 - 1.0).abs() < 0.15, "period {period}: {wd} µm, given {sensed} µm, {late:e} s late");
    }
}

#[test]
fn cheaper_tiers_and_plates_without_a_demodulator_give_w_itself() {
    let carrier = play("carrier", "[sensor]");
    assert_eq!(carrier, play("modal", LOCKIN));
    for [wd, sensed] in carrier.into_iter().chain(play("envelope", LOCKIN)) {
        assert_eq!(f64::from(wd as f32), sensed);
    }
}
