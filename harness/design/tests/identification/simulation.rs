//! Simulates recordings of plates with a period of 1 ms.

use platebench_design::identified_plate::PlateFileDetails;
use platebench_model::recording::{RecordedInput, RecordedSample, Recording};
use platebench_plate::{Complex64, ConditionProfiles, Conditions, Drive, Model, Plant, Plate, Profile, Sensor, Time};

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
    drive: impl FnMut(u32, f64) -> (f64, f64),
) -> Recording {
    simulate_delayed(plate, seed, scene, samples, drive, |_| 0.0)
}

/// The drive acts `delay_ms` of the time in ms later than its row says.
pub(crate) fn simulate_delayed(
    plate: &Plate,
    seed: u64,
    scene: &ConditionProfiles,
    samples: u32,
    mut drive: impl FnMut(u32, f64) -> (f64, f64),
    mut delay_ms: impl FnMut(u32) -> f64,
) -> Recording {
    let mut plant = Plant::new(plate.clone(), scene.clone(), Model::Modal);
    let mut sensor = Sensor::new(1.0, plate.noise_um_rms, seed);
    let (mut inputs, mut outputs) = (Vec::new(), Vec::new());
    for ms in 0..samples {
        let time = Time::from_ms(f64::from(ms)).unwrap();
        plant.advance(time, &[], &mut Vec::new());
        let w = sensor.measure(plant.state().w);
        let (vpp, omega) = drive(ms, w.re);
        plant.advance(Time::from_ms(f64::from(ms) + delay_ms(ms)).unwrap(), &[], &mut Vec::new());
        plant.set_drive(Drive { vpp, omega });
        inputs.push(RecordedInput { t: time.seconds(), vpp, omega, conditions: scene.at(time) });
        outputs.push(RecordedSample { t: time.seconds(), w });
    }
    Recording::new(format!("recording {seed}"), inputs, outputs).unwrap()
}

/// One row of a log.
#[derive(Debug, Clone, Copy)]
pub(crate) struct LogRow {
    pub t: f64,
    pub vpp: f64,
    pub omega: f64,
    pub conditions: Conditions,
    pub w: Complex64,
}

pub(crate) fn rows_of(recording: &Recording) -> Vec<LogRow> {
    let rows = recording.inputs_at_samples().into_iter().zip(&recording.outputs);
    rows.map(|(input, output)| LogRow {
        t: output.t,
        vpp: input.vpp,
        omega: input.omega,
        conditions: input.conditions,
        w: output.w,
    })
    .collect()
}

pub(crate) fn recording_of(name: &str, rows: &[LogRow]) -> Recording {
    let input = |row: &LogRow| RecordedInput { t: row.t, vpp: row.vpp, omega: row.omega, conditions: row.conditions };
    let outputs = rows.iter().map(|row| RecordedSample { t: row.t, w: row.w }).collect();
    Recording::new(name.to_owned(), rows.iter().map(input).collect(), outputs).unwrap()
}

/// Changes the rows of a recording.
pub(crate) fn relog(recording: &Recording, change: impl FnOnce(&mut Vec<LogRow>)) -> Recording {
    let mut rows = rows_of(recording);
    change(&mut rows);
    recording_of(&recording.name, &rows)
}

/// Moves a column by whole rows: positive rows log a value later than it acts.
pub(crate) fn move_column<T: Copy>(rows: &mut [LogRow], late: i64, of: impl Fn(&mut LogRow) -> &mut T) {
    let last = i64::try_from(rows.len()).unwrap() - 1;
    let values: Vec<T> = rows.iter_mut().map(|row| *of(row)).collect();
    for (number, row) in (0..).zip(rows) {
        *of(row) = values[(number - late).clamp(0, last) as usize];
    }
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
