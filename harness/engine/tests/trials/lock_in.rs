//! Tests samples behind a lock-in: its output in the carrier model, W in the other models.

use crate::fixtures::{LOCKSTEP, plan, run_hosted};
use platebench_test_kit::{PLATE, write_scenario};
use std::fs;

const LOCKIN: &str = "[sensor]\ndemodulator_periods = 8\nconverter_hz = 1e6";

/// Returns Wd and the sample of Wd at each control instant, µm.
fn play(model: &str, sensor: &str) -> Vec<[f64; 2]> {
    assert!(PLATE.contains("[sensor]"));
    let text = format!(
        "title = \"step\"\nplate = \"plate.toml\"\nduration_ms = 10.0\nmodel = \"{model}\"\n\
         [controller]\nlaw = \"open-loop\"\n[profile]\nsetpoint_um = 2.0\n\
         [[expect]]\nmetric = \"overshoot_percent\"\nat_most = 1e6\n"
    );
    let folder = tempfile::tempdir().unwrap();
    let scenario = write_scenario(folder.path(), &text, &PLATE.replace("[sensor]", sensor));
    let out = folder.path().join("run");
    let record = run_hosted(&plan(vec![scenario], LOCKSTEP), &out);
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
fn the_carrier_model_samples_the_delayed_lock_in() {
    let samples = play("carrier", LOCKIN);
    assert!(samples.len() >= 10);
    // At 286 Vpp, Wd rises to 2 µm with the time constant τ. Eight periods delay it by 124 µs.
    let tau = 1.88e-3_f64;
    for (period, [wd, sensed]) in samples.iter().enumerate().take(5).skip(1) {
        let slope = (2.0 - wd) / tau;
        let late = (wd - sensed) / slope;
        assert!((late / 123.3e-6 - 1.0).abs() < 0.15, "period {period}: {wd} µm, sampled {sensed} µm, {late:e} s late");
    }
}

#[test]
fn other_models_and_plates_without_a_lock_in_sample_w() {
    let carrier = play("carrier", "[sensor]");
    assert_eq!(carrier, play("modal", LOCKIN));
    for [wd, sensed] in carrier.into_iter().chain(play("envelope", LOCKIN)) {
        assert_eq!(f64::from(wd as f32), sensed);
    }
}
