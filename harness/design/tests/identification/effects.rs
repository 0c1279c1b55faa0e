//! Identifies plates with a second mode or self-heating.

use crate::simulation::{STILL, details, scene, simulate};
use platebench_design::identified_plate::{PlateFileDetails, document, plate_file};
use platebench_design::identify::{Identification, identify};
use platebench_model::recording::Recording;
use platebench_plate::{Effects, Heating, Plate, RawPlate, SecondMode};
use platebench_test_kit::paper_plate;
use std::f64::consts::TAU;

const NOISE_UM: f64 = 0.002;

fn quiet_plate() -> Plate {
    Plate { noise_um_rms: NOISE_UM, ..paper_plate() }
}

/// Excites the plate 60 rad/s above the resonance.
fn record(plate: &Plate, seed: u64, samples: u32, level: impl Fn(u32) -> f64) -> Recording {
    simulate(plate, seed, &scene(STILL, STILL), samples, |ms, _| (level(ms), plate.omega0 + 60.0))
}

/// Drives of 20 ms, each after 20 ms at 0 V.
fn steps(sample: u32) -> f64 {
    if sample % 40 < 20 { 0.0 } else { [208.0, 312.0, 370.0][(sample / 40) as usize % 3] }
}

fn written_plate(found: &Identification, slope_hz_per_k: Option<f64>) -> Plate {
    let details = PlateFileDetails { limit_vpp: Some(900.0), slope_hz_per_k, ..details("found") };
    toml::from_str::<RawPlate>(&plate_file(found, &details).unwrap()).unwrap().check().unwrap()
}

#[test]
fn finds_a_second_mode_and_writes_it() {
    let second = SecondMode { omega0: TAU * 32_607.6, sigma0: 1e3 / 1.5, gain: 0.0021 };
    let plate = Plate { effects: Effects { second_mode: Some(second), ..Effects::default() }, ..quiet_plate() };
    let recordings: Vec<Recording> = (0..3).map(|seed| record(&plate, seed, 120, steps)).collect();
    let (found, fits) = identify(&recordings, None).unwrap();
    let mode = found.second_mode.unwrap();
    println!("{mode:?}");
    assert!((mode.resonance_hz.value - 32_607.6).abs() < 5.0, "{mode:?}");
    assert!((mode.time_constant_s.value / 1.5e-3 - 1.0).abs() < 0.05, "{mode:?}");
    assert!((mode.gain_um_per_vpp.value / 0.0021 - 1.0).abs() < 0.05, "{mode:?}");
    assert!(found.heating.is_none() && found.inconsistencies.is_empty(), "{:?}", found.inconsistencies);
    assert!((found.gain_um_per_vpp.unwrap().value / plate.gain - 1.0).abs() < 0.01);
    assert!((found.resonance_hz.unwrap().value - 32_307.6).abs() < 1.0);
    assert!(fits.iter().all(|fit| fit.effect.is_some()));
    let written = written_plate(&found, None).effects.second_mode.unwrap();
    assert!((written.omega0 / second.omega0 - 1.0).abs() < 1e-3);
    assert!(document("plate", &found, &[]).to_markdown().contains("second mode: resonance"));
}

#[test]
fn finds_self_heating_and_writes_it() {
    let heating = Heating { rise_k_per_um2: 0.8, rate: 1.0 / 0.15 };
    let plate = Plate { effects: Effects { heating: Some(heating), ..Effects::default() }, ..quiet_plate() };
    let level = |sample: u32| if (20..400).contains(&sample) { 370.0 } else { 0.0 };
    let recordings: Vec<Recording> = (0..2).map(|seed| record(&plate, seed, 500, level)).collect();
    let (found, _) = identify(&recordings, None).unwrap();
    let node = found.heating.unwrap();
    println!("{node:?}");
    let shift = heating.rise_k_per_um2 * plate.omega0_per_k / TAU;
    assert!((node.shift_hz_per_um2.value / shift - 1.0).abs() < 0.05, "{node:?}, expected {shift}");
    assert!((node.time_constant_s.value / 0.15 - 1.0).abs() < 0.05, "{node:?}");
    assert!(found.second_mode.is_none() && found.inconsistencies.is_empty(), "{:?}", found.inconsistencies);
    let written = written_plate(&found, Some(-9.638)).effects.heating.unwrap();
    assert!((written.rise_k_per_um2 / 0.8 - 1.0).abs() < 0.05);
    assert_eq!(written_plate(&found, None).effects.heating, None);
}

#[test]
fn finds_no_effect_on_a_plate_of_one_mode() {
    let plate = quiet_plate();
    for first in 0..6 {
        let recordings: Vec<Recording> =
            (0..4).map(|number| record(&plate, 100 + 4 * first + number, 120, steps)).collect();
        let (found, _) = identify(&recordings, None).unwrap();
        assert_eq!((found.second_mode, found.heating), (None, None));
    }
}
