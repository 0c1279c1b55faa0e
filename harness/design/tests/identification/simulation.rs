//! Simulates recordings of plates with a period of 1 ms.

use platebench_design::identified_plate::PlateFileDetails;
use platebench_model::recording::{RecordedInput, RecordedSample, Recording};
use platebench_plate::{ConditionProfiles, Drive, Model, Plant, Plate, Profile, Sensor, Time};

pub(crate) fn hold_profile(points: &[(f64, f64)]) -> Profile {
    Profile::Hold(points.iter().map(|(ms, value)| (Time::from_ms(*ms).unwrap(), *value)).collect())
}

/// Temperature in K and force in N, each as points (time in ms, value).
pub(crate) fn scene(temperature: &[(f64, f64)], force: &[(f64, f64)]) -> ConditionProfiles {
    ConditionProfiles { temperature_offset_k: hold_profile(temperature), finger_force_n: hold_profile(force) }
}

pub(crate) const STILL: &[(f64, f64)] = &[(0.0, 0.0)];

/// The sensor has the noise of the plate, drawn from `seed`. `drive` computes Vpp and rad/s from
/// the time in ms and Wd.
pub(crate) fn simulate(
    plate: &Plate,
    seed: u64,
    scene: &ConditionProfiles,
    samples: u32,
    mut drive: impl FnMut(u32, f64) -> (f64, f64),
) -> Recording {
    let mut plant = Plant::new(plate.clone(), scene.clone(), Model::Modal);
    let mut sensor = Sensor::new(1.0, plate.noise_um_rms, seed);
    let (mut inputs, mut outputs) = (Vec::new(), Vec::new());
    for ms in 0..samples {
        let time = Time::from_ms(f64::from(ms)).unwrap();
        plant.advance(time, &[], &mut Vec::new());
        let w = sensor.measure(plant.state().w);
        let (vpp, omega) = drive(ms, w.re);
        plant.set_drive(Drive { vpp, omega });
        inputs.push(RecordedInput { t: time.seconds(), vpp, omega, conditions: scene.at(time) });
        outputs.push(RecordedSample { t: time.seconds(), w });
    }
    Recording::new(format!("recording {seed}"), inputs, outputs).unwrap()
}

pub(crate) fn details(name: &str) -> PlateFileDetails {
    PlateFileDetails {
        name: name.to_owned(),
        source: "a test".to_owned(),
        reference_temperature_c: 24.0,
        limit_vpp: None,
        slope_hz_per_k: None,
    }
}
