//! Extracts samples and commands from a trace.
//!
//! A row with the flag `control` contains the sample. The last row before the next command acts
//! contains the command for this sample.

use super::error::ReplayError;
use super::input::ReplayInput;
use crate::rejudge::{apply_overrides, load_stored_scenario, read_trial_rows};
use platebench_model::record::{ClockKind, RECORD_FILE, RunRecord, ScenarioRecord, TrialRecord};
use platebench_model::scenario::{Scenario, load};
use platebench_model::trace::{AtPath, Flags, Row, read_trace};
use platebench_plate::Time;
use platebench_verdict::replay::{Recording, RecordingEnd, ReplayCommand, ReplayStep};
use std::path::{Path, PathBuf};

/// Tolerance for the comparison of instants, which are rounded to whole nanoseconds.
const HALF_NANOSECOND_S: f64 = 0.5e-9;
/// Longest distance of two samples, in periods. A sample is missing if they are further apart.
const MAX_SAMPLE_DISTANCE: f64 = 1.5;
/// Shortest distance of two samples, in periods. If closer, the recording has another period.
const MIN_SAMPLE_DISTANCE: f64 = 0.5;

/// `scenario` replaces the scenario that the run folder contains.
pub fn read_recorded_trace(trace: &Path, scenario: Option<&Path>) -> Result<ReplayInput, ReplayError> {
    if trace.is_dir() {
        return Err(ReplayError::Folder(trace.to_owned()));
    }
    let configuration = scenario.map(|path| load(path, &path.display().to_string())).transpose()?;
    let Some(stored) = find_trial(trace)? else {
        let rows = read_trace(trace)?;
        let scenario = configuration.ok_or_else(|| ReplayError::NoRun(trace.to_owned()))?;
        return from_rows(trace, &rows, scenario, ClockKind::Lockstep);
    };
    let StoredTrace { folder, run, scenario, trial } = stored;
    let rows = read_trial_rows(&folder, &trial)?;
    let scenario = if let Some(scenario) = configuration {
        scenario
    } else {
        let mut played = load_stored_scenario(&folder, &scenario)?;
        apply_overrides(&run.overrides, &mut played);
        played
    };
    from_rows(trace, &rows, scenario, run.clock)
}

struct StoredTrace {
    folder: PathBuf,
    run: RunRecord,
    scenario: ScenarioRecord,
    trial: TrialRecord,
}

/// `None` if the trace is in no run folder, or the record of the run does not list it.
fn find_trial(trace: &Path) -> Result<Option<StoredTrace>, ReplayError> {
    let trace = trace.canonicalize().at(trace)?;
    let Some(folder) = trace.ancestors().skip(1).find(|folder| folder.join(RECORD_FILE).is_file()) else {
        return Ok(None);
    };
    let run = RunRecord::read(folder)?;
    let name = trace.strip_prefix(folder).unwrap_or(&trace);
    let found = run.scenarios.iter().find_map(|scenario| {
        let trial = scenario.trials.iter().find(|trial| Path::new(&trial.trace) == name)?;
        Some((scenario.clone(), trial.clone()))
    });
    Ok(found.map(|(scenario, trial)| StoredTrace { folder: folder.to_owned(), run, scenario, trial }))
}

fn from_rows(trace: &Path, rows: &[Row], scenario: Scenario, clock: ClockKind) -> Result<ReplayInput, ReplayError> {
    let samples: Vec<usize> =
        rows.iter().enumerate().filter(|(_, row)| row.flags.contains(Flags::CONTROL)).map(|(index, _)| index).collect();
    let (mut steps, mut end) = (Vec::with_capacity(samples.len()), None);
    let period_s = scenario.controller.period.seconds();
    let mut previous = None;
    for (number, &index) in samples.iter().enumerate() {
        let Some(row) = rows.get(index) else { break };
        let next = samples.get(number + 1).and_then(|&next| rows.get(next));
        let acting = acting_row(rows, index, next.map(|next| next.t_s), &scenario, clock);
        end = recording_end(row, acting, &scenario)
            .or_else(|| previous.and_then(|previous| missing_sample(previous, row.t_s, period_s)));
        if end.is_some() {
            break;
        }
        previous = Some(row.t_s);
        steps.push(ReplayStep {
            t_s: row.t_s,
            setpoint_um: row.setpoint_um,
            wd_um: row.sensed_wd_um,
            wq_um: row.sensed_wq_um,
            command: acting.map(|row| ReplayCommand { drive_vpp: row.drive_vpp, frequency_hz: row.frequency_hz }),
        });
    }
    let recording = Recording { name: trace.display().to_string(), steps, end };
    check_recording(trace, &recording, period_s)?;
    Ok(ReplayInput { recording, scenario })
}

pub(super) fn missing_sample(previous_s: f64, at_s: f64, period_s: f64) -> Option<RecordingEnd> {
    (at_s - previous_s > MAX_SAMPLE_DISTANCE * period_s).then_some(RecordingEnd::MissingSample { at_s })
}

pub(super) fn check_recording(path: &Path, recording: &Recording, period_s: f64) -> Result<(), ReplayError> {
    let other_period = |found_s: f64| ReplayError::OtherPeriod {
        path: path.to_owned(),
        found_ms: found_s * 1e3,
        expected_ms: period_s * 1e3,
    };
    match (&recording.steps[..], recording.end) {
        ([], _) => Err(ReplayError::NoSample(path.to_owned())),
        ([only], Some(RecordingEnd::MissingSample { at_s })) => Err(other_period(at_s - only.t_s)),
        ([first, second, ..], _) if second.t_s - first.t_s < MIN_SAMPLE_DISTANCE * period_s => {
            Err(other_period(second.t_s - first.t_s))
        }
        _ => Ok(()),
    }
}

/// Returns the row with the command for the sample in row `index`. `None` if it never acted.
fn acting_row<'a>(
    rows: &'a [Row],
    index: usize,
    next_s: Option<f64>,
    scenario: &Scenario,
    clock: ClockKind,
) -> Option<&'a Row> {
    let (row, last) = (rows.get(index)?, rows.last()?);
    let controller = &scenario.controller;
    let (delay_s, longest_s) = match clock {
        // Telemetry of a real plate has a sample and its command in one row.
        ClockKind::RealPlate => return Some(row),
        ClockKind::Lockstep => {
            let delay = controller.loop_delay;
            (delay.seconds(), (delay + controller.loop_delay_jitter).seconds())
        }
        // The delay of the line is unknown. It is assumed to be shorter than a control period.
        ClockKind::RealTime => (0.0, controller.period.seconds()),
    };
    if row.t_s + longest_s > last.t_s + HALF_NANOSECOND_S {
        return None;
    }
    let until_s = next_s.map_or(f64::INFINITY, |next_s| next_s + delay_s - HALF_NANOSECOND_S);
    rows.get(rows.partition_point(|row| row.t_s < until_s).checked_sub(1)?)
}

fn recording_end(sample: &Row, acting: Option<&Row>, scenario: &Scenario) -> Option<RecordingEnd> {
    let at_s = sample.t_s;
    let has = |flag| sample.flags.contains(flag) || acting.is_some_and(|row| row.flags.contains(flag));
    let now = Time::from_seconds(at_s).unwrap_or(Time::ZERO);
    if scenario.faults.iter().any(|fault| fault.from <= now) {
        return Some(RecordingEnd::Fault { at_s });
    }
    if has(Flags::LINK_LOST) {
        return Some(RecordingEnd::LostReply { at_s });
    }
    acting.is_some_and(|row| row.flags.contains(Flags::SAFE)).then_some(RecordingEnd::Stopped { at_s })
}
