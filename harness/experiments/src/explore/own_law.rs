//! Measures how fast a law of the controller's own is. The limits of its scenes follow from it,
//! because the bench does not know its design.

use crate::explore::envelope::Envelope;
use crate::explore::limits::{BAND, ExploredLaw, OwnLaw, OwnSteps};
use crate::explore::player::ExploreError;
use crate::explore::scenario_file::ScenarioBuilder;
use crate::explore::scene::{Course, PlateChoice, Scene, SceneTrial, Tuning};
use platebench_engine::plan::LinkFactory;
use platebench_engine::{Executor, ExecutorSettings, SafeEnds, law};
use platebench_model::trace::Row;
use platebench_rig::{CancelToken, Link};
use std::f64::consts::TAU;

/// Usual setpoint of the measured steps, nm.
const LEVEL_NM: i32 = 1_000;
/// Time at the setpoint, and the same time at rest, µs.
const HALF_US: u32 = 250_000;
/// Time after each further change, µs.
const STEP_US: u32 = 100_000;
/// Further setpoints, nm. The law then knows the plate.
const KNOWN_NM: [i32; 3] = [LEVEL_NM, 2 * LEVEL_NM, LEVEL_NM];
/// A steady amplitude and frequency are this near to the setpoint, relative, and to the resonance, Hz.
const STEADY_ERROR: f64 = 3e-3;
const STEADY_HZ: f64 = 0.5;
/// Largest drive at rest, Vpp.
const REST_VPP: f64 = 0.5;
/// Start of the changes on a known plate, s.
const KNOWN_S: f64 = 2.0 * HALF_US as f64 * 1e-6;
/// Time, µs, of what no trial reaches. The scenes then show that the law does not reach it.
const NEVER_REACHED_US: u32 = 30_000;

/// Plays steps at each end of the envelope on a new controller. `None` after a cancellation.
pub fn measure_own_law<L: Link>(
    envelope: &Envelope,
    connect: &LinkFactory<'_, L>,
    own_clock: bool,
    cancel: &CancelToken,
    ends: &SafeEnds,
) -> Result<Option<OwnLaw>, ExploreError> {
    let settings = ExecutorSettings { own_clock, shares_controller: true, ..ExecutorSettings::lockstep(cancel) };
    let mut executor = Executor::new(connect, settings, ends);
    let mut largest = [None::<u32>; 3];
    let mut steps: Vec<OwnSteps> = Vec::new();
    for trial in trials(envelope) {
        let (period_us, changes) = (trial.period_us, known_changes(&trial));
        let builder = ScenarioBuilder { base: &envelope.plate, title: "Steps", source: "measured", plate_prefix: "" };
        let scene = Scene { earlier: Vec::new(), judged: trial, count: 1, script_seed: None, relation: None };
        let scenario = builder.build(&scene, &[]).check()?;
        let law = law(&scenario).map_err(|unknown| ExploreError::Generated(Box::new(unknown)))?;
        let Some(played) = executor.play(&scenario, law, 0, None)? else { return Ok(None) };
        let (first, later) = played.trace_rows.split_at(played.trace_rows.partition_point(|row| row.t_s < KNOWN_S));
        for (time, largest) in times(first, HALF_US).into_iter().zip(&mut largest) {
            *largest = (*largest).max(time);
        }
        if steps.last().is_none_or(|last| last.period_us != period_us) {
            steps.push(OwnSteps { period_us, ..OwnSteps::default() });
        }
        let Some(steps) = steps.last_mut() else { continue };
        for (from_us, is_touch, has_finger) in changes {
            let [from_s, to_s] = [from_us, from_us + STEP_US].map(|us| f64::from(us) * 1e-6);
            let rows: Vec<&Row> = later.iter().filter(|row| (from_s..to_s).contains(&row.t_s)).collect();
            let time = time_of_last(&rows, from_s, |row| error(row) > BAND).unwrap_or(u32::MAX);
            let longest = if is_touch { &mut steps.touch_us } else { &mut steps.known_us[usize::from(has_finger)] };
            *longest = (*longest).max(time);
        }
    }
    let [settling_us, steady_us, rest_us] = largest.map(|time| time.unwrap_or(NEVER_REACHED_US));
    steps.sort_by_key(|steps| steps.period_us);
    let longest = steps.last().copied().unwrap_or_default();
    let steps = [0, 1, 2].map(|number| steps.get(number).copied().unwrap_or(longest));
    Ok(Some(OwnLaw { settling_us, steady_us, rest_us, steps }))
}

/// Instants of the changes on a known plate, µs; whether the force changes, and whether the finger is
/// on the plate at setpoint steps.
fn known_changes(trial: &SceneTrial) -> Vec<(u32, bool, bool)> {
    let steps = (0..KNOWN_NM.len()).map(|number| (known_us(number), false, trial.force.at(0) > 0.0));
    let touches = trial.force.moves().into_iter().map(|[at, _]| (at, true, false));
    steps.chain(touches).collect()
}

fn known_us(number: usize) -> u32 {
    2 * HALF_US + number as u32 * STEP_US
}

fn trials(envelope: &Envelope) -> Vec<SceneTrial> {
    let range = &envelope.range;
    let [lowest_hz, highest_hz] = range.start_frequency_offset_hz;
    let largest_force = (range.finger_force_n[1] * 100.0) as i32;
    let mut periods = range.period_ms.map(|ms| (ms * 1e3) as u32).to_vec();
    periods.push(1_000.clamp(periods[0], periods[1]));
    periods.sort_unstable();
    periods.dedup();
    let conditions = [(0.0, 0), (lowest_hz, 0), (highest_hz, largest_force), (0.0, largest_force)];
    let touch_us = known_us(KNOWN_NM.len());
    let known = (0..).zip(KNOWN_NM).map(|(number, level)| (known_us(number), level));
    let setpoints: Vec<_> = [(0, LEVEL_NM), (HALF_US, 0)].into_iter().chain(known).collect();
    let trial = |(period_us, (offset_hz, force)): (u32, (f64, i32))| {
        let mut trial = SceneTrial {
            law: ExploredLaw::Own(OwnLaw::default()),
            plate: PlateChoice { limit_vpp: envelope.usual_limit_vpp() as u32, ..PlateChoice::default() },
            period_us,
            delay_us: 0,
            start_frequency_tenths: 0,
            duration_us: touch_us + 2 * STEP_US,
            setpoint: Course::Hold(setpoints.clone()),
            // A finger that was on the plate leaves, and comes back.
            force: Course::Hold(vec![(0, force), (touch_us, largest_force - force), (touch_us + STEP_US, force)]),
            temperature: Course::Hold(vec![(0, 0)]),
            tuning: Tuning::default(),
            faults: Vec::new(),
        };
        let start_hz = trial.mode_at(&envelope.plate, 0).omega0 / TAU + offset_hz;
        trial.start_frequency_tenths = (start_hz * 10.0).round() as u32;
        trial
    };
    periods.into_iter().flat_map(|period| conditions.map(|condition| (period, condition))).map(trial).collect()
}

/// Time, µs, until amplitude, steady state and rest are reached for good; `None` if they are not.
fn times(rows: &[Row], rest_us: u32) -> [Option<u32>; 3] {
    let rest_s = f64::from(rest_us) * 1e-6;
    let (driven, rest): (Vec<&Row>, Vec<&Row>) = rows.iter().partition(|row| row.t_s < rest_s);
    let is_unsteady = |row: &Row| error(row) > STEADY_ERROR || (row.frequency_hz - row.resonance_hz).abs() > STEADY_HZ;
    [
        time_of_last(&driven, 0.0, |row| error(row) > BAND),
        time_of_last(&driven, 0.0, is_unsteady),
        time_of_last(&rest, rest_s, |row| row.drive_vpp > REST_VPP),
    ]
}

/// Relative error of the amplitude.
fn error(row: &Row) -> f64 {
    (row.amplitude_um / row.setpoint_um - 1.0).abs()
}

/// Time from `start_s` to the last row with `is_outside`, µs. `None` if that is the last of all.
fn time_of_last(rows: &[&Row], start_s: f64, is_outside: impl Fn(&Row) -> bool) -> Option<u32> {
    let last = rows.iter().rposition(|row| is_outside(row));
    let next = rows.get(last.map_or(0, |last| last + 1))?;
    Some(((next.t_s - start_s) * 1e6).ceil() as u32)
}
