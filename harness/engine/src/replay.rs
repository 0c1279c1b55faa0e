//! Replays recorded samples to a controller in open loop: no plate reacts to its commands. A
//! recording is a trace or a table of telemetry.
//!
//! A row of a trace with the flag `control` contains the sample. The last row before the next
//! command acts contains the command for this sample.

use crate::applicability::missing_capability;
use crate::controller_log::{ControllerLog, MAX_MISSED_REPLIES, drive_violation, is_controller_failure};
use crate::lockstep::OWN_CLOCK_WATCHDOG_TIMEOUT_MS;
use crate::plan::{LinkFactory, RigSession, RunError};
use crate::rejudge::{RejudgeError, apply_overrides, load_stored_scenario, read_trial_rows};
use crate::trial::{TrialAbort, check_configuration, configure, law, law_number};
use platebench_model::external_csv::{ColumnMapping, Dialect, ExternalCsvError, TelemetryTable, read_rows};
use platebench_model::record::{ClockKind, RECORD_FILE, RecordError, RunRecord, ScenarioRecord, TrialRecord};
use platebench_model::scenario::{Diagnostic, OWN_LAW, Scenario, load};
use platebench_model::trace::{
    AtPath as _, FileError, Flags, MAX_TABLE_BYTES, Row, TraceError, open_regular_file, read_trace,
};
use platebench_plate::Time;
use platebench_rig::{CancelToken, FaultInjector, RigError, SafeEnd};
use platebench_verdict::replay::{RecordedCommands, RecordingEnd, Replay, ReplayCommand, ReplayResult, ReplayStep};
use platebench_wire::{Command, Configure, ControllerState, LawId, Sample};
use std::borrow::Cow;
use std::f64::consts::TAU;
use std::path::{Path, PathBuf};
use std::time::Duration;

/// `own_clock` is true if the controller's clock runs while the bench waits.
pub fn replay(
    input: &ReplayInput,
    rig: &str,
    own_clock: bool,
    connect: &LinkFactory<'_>,
    cancel: &CancelToken,
) -> Result<ReplayResult, ReplayError> {
    let law = law(&input.scenario).map_err(|unknown| ReplayError::Scenario(Box::new(unknown)))?;
    let link = connect().map_err(RunError::from)?;
    let session = RigSession::open_cancellable(FaultInjector::new(link), cancel).map_err(RunError::from)?;
    let mut scenario = Cow::Borrowed(&input.scenario);
    // As in a run, a controller that announces no law has one of its own.
    if session.identity().laws == 0 && !input.has_requested_law {
        scenario.to_mut().set_law(OWN_LAW);
    }
    let scenario = &*scenario;
    if let Some(reason) = missing_capability(scenario, law, session.identity()) {
        return Err(ReplayError::NotApplicable(reason));
    }
    let law = law_number(scenario, law, session.identity());
    let firmware = session.firmware_name();
    let mut player = RecordingPlayer {
        session,
        controller: ControllerLog::new(scenario, law),
        scenario,
        replies: Vec::with_capacity(input.recording.steps.len()),
        last: Time::ZERO,
    };
    let lost = match player.play(&input.recording.steps, law, own_clock, cancel) {
        Ok(()) => None,
        Err(TrialAbort::Cancelled) => return Err(RunError::Cancelled.into()),
        Err(TrialAbort::Lost(error)) => {
            if matches!(error, RigError::ConfigurationRejected(_)) {
                check_configuration(scenario, law)?;
            }
            Some(error)
        }
    };
    let replay = player.finish(rig, firmware, law, lost.as_ref());
    Ok(ReplayResult::new(&input.recording, replay))
}

struct RecordingPlayer<'a> {
    session: RigSession,
    controller: ControllerLog<'a>,
    scenario: &'a Scenario,
    replies: Vec<Option<ReplayCommand>>,
    last: Time,
}

impl RecordingPlayer<'_> {
    /// If the replay is cancelled, the drop of the session requests 0 V.
    fn play(
        &mut self,
        steps: &[ReplayStep],
        law: LawId,
        own_clock: bool,
        cancel: &CancelToken,
    ) -> Result<(), TrialAbort> {
        let watchdog_timeout_ms = if own_clock { OWN_CLOCK_WATCHDOG_TIMEOUT_MS } else { 0 };
        let configure = Configure { watchdog_timeout_ms, ..configure(self.scenario, law) };
        let gains = self.session.start_trial(&configure)?;
        self.controller.record_configuration(&configure, Some(&gains), Time::ZERO);
        let first_s = steps.first().map_or(0.0, |step| step.t_s);
        for step in steps {
            if cancel.is_cancelled() {
                return Err(TrialAbort::Cancelled);
            }
            self.last = Time::from_seconds(step.t_s - first_s).unwrap_or(self.last);
            let reply = self.exchange(&sample(step, self.last))?;
            self.replies.push(reply);
            if self.controller.is_stopped() {
                break;
            }
        }
        Ok(())
    }

    fn exchange(&mut self, sample: &Sample) -> Result<Option<ReplayCommand>, RigError> {
        let now = Duration::from(self.last);
        self.controller.record_sample();
        let reply = match self.session.send_sample(now, sample)? {
            Some(reply) => Some(reply.command),
            None => self.session.advance_to(now)?.filter(|_| self.session.last_sample_answered()),
        };
        if self.session.wrong_sequences() > 0 {
            return Err(RigError::WrongSequence);
        }
        let Some(command) = reply else {
            self.controller.record_missed_reply();
            return if self.controller.missed_replies() < MAX_MISSED_REPLIES {
                Ok(None)
            } else {
                Err(RigError::NoAnswer { expected: "command" })
            };
        };
        if command.state == ControllerState::Idle {
            return Err(RigError::Restarted);
        }
        self.controller.record_command(&command, self.session.newer_messages(), self.last);
        Ok(Some(self.within_range(&command)))
    }

    /// Clips the drive to the amplifier's range, because the drive in a trace is clipped too.
    fn within_range(&self, command: &Command) -> ReplayCommand {
        let drive = f64::from(command.drive_vpp);
        let drive_vpp =
            if drive.is_finite() { drive.clamp(0.0, self.scenario.plate.drive_limit_vpp) } else { f64::NAN };
        ReplayCommand { drive_vpp, frequency_hz: f64::from(command.frequency_mhz) / 1e3 }
    }

    fn finish(mut self, rig: &str, firmware: String, law: LawId, lost: Option<&RigError>) -> Replay {
        let now = self.last + self.scenario.controller.period;
        if lost.is_none() && self.session.request_safe_state() {
            let rest = Sample { time_us: now.wrapping_micros(), setpoint_um: 0.0, wd_um: 0.0, wq_um: 0.0 };
            self.controller.watch_after_safe(&mut self.session, now, rest);
        } else if self.session.has_driven_after_safe() {
            self.controller.observe_safe_state(&mut self.session, now);
        }
        self.controller.record_session(&self.session, now);
        let mut telemetry = self.controller.telemetry(&mut self.session, lost, None);
        let end = self.session.close();
        if let SafeEnd::Driven(drives) = end {
            telemetry.violations.push(drive_violation(drives, now));
        }
        Replay {
            rig: rig.to_owned(),
            firmware,
            law: if self.scenario.has_own_law() { OWN_LAW } else { law.name() },
            replies: self.replies,
            telemetry,
            rig_lost: lost.is_some_and(|error| !is_controller_failure(error)),
            safe_confirmed: end == SafeEnd::Confirmed,
        }
    }
}

fn sample(step: &ReplayStep, now: Time) -> Sample {
    Sample {
        time_us: now.wrapping_micros(),
        setpoint_um: step.setpoint_um as f32,
        wd_um: step.wd_um as f32,
        wq_um: step.wq_um as f32,
    }
}

#[derive(Debug)]
pub struct ReplayInput {
    pub recording: RecordedCommands,
    pub scenario: Scenario,
    /// Form of the table. `None` for a trace.
    pub dialect: Option<Dialect>,
    /// True if the user and not the recording selected the law.
    pub has_requested_law: bool,
}

impl ReplayInput {
    #[must_use]
    pub fn with_law(mut self, law: Option<&str>) -> Self {
        if let Some(name) = law {
            self.scenario.set_law(name);
            self.has_requested_law = true;
        }
        self
    }
}

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
        played.of_trial(trial.index).clone()
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
    let recording = RecordedCommands { name: trace.display().to_string(), steps, end };
    check_recording(trace, &recording, period_s)?;
    Ok(ReplayInput { recording, scenario, dialect: None, has_requested_law: false })
}

pub(super) fn missing_sample(previous_s: f64, at_s: f64, period_s: f64) -> Option<RecordingEnd> {
    (at_s - previous_s > MAX_SAMPLE_DISTANCE * period_s).then_some(RecordingEnd::MissingSample { at_s })
}

pub(super) fn check_recording(path: &Path, recording: &RecordedCommands, period_s: f64) -> Result<(), ReplayError> {
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

/// Setpoints come from the table, or from the scenario's profile if the table has none.
pub fn read_telemetry_table(
    table: &Path,
    columns: &ColumnMapping,
    scenario: &Path,
) -> Result<ReplayInput, ReplayError> {
    let scenario = load(scenario, &scenario.display().to_string())?;
    let name = table.display().to_string();
    let file = open_regular_file(table, MAX_TABLE_BYTES).at(table)?;
    let TelemetryTable { rows, dialect } = read_rows(&name, file, columns)?;
    let first_s = rows.first().map_or(0.0, |row| row.t);
    let period_s = scenario.controller.period.seconds();
    let (mut steps, mut end, mut previous) = (Vec::with_capacity(rows.len()), None, None);
    for row in rows {
        let t_s = row.t - first_s;
        end = previous.and_then(|previous| missing_sample(previous, t_s, period_s));
        if end.is_some() {
            break;
        }
        previous = Some(t_s);
        let profile = || {
            let time = Time::from_seconds(t_s).filter(|time| *time <= scenario.duration);
            time.map(|time| scenario.setpoint.at(time))
        };
        let setpoint_um = row.setpoint_um.or_else(profile).ok_or_else(|| ReplayError::NoSetpoint {
            path: table.to_owned(),
            duration_s: scenario.duration.seconds(),
            at_s: t_s,
        })?;
        let command = Some(ReplayCommand { drive_vpp: row.vpp, frequency_hz: row.omega / TAU });
        steps.push(ReplayStep { t_s, setpoint_um, wd_um: row.w.re, wq_um: row.w.im, command });
    }
    let recording = RecordedCommands { name, steps, end };
    check_recording(table, &recording, period_s)?;
    Ok(ReplayInput { recording, scenario, dialect: Some(dialect), has_requested_law: false })
}

#[derive(Debug, thiserror::Error)]
pub enum ReplayError {
    #[error("{0}")]
    Scenario(Box<Diagnostic>),
    #[error(transparent)]
    Record(#[from] RecordError),
    #[error(transparent)]
    Stored(#[from] RejudgeError),
    #[error(transparent)]
    Trace(#[from] TraceError),
    #[error(transparent)]
    Telemetry(#[from] ExternalCsvError),
    #[error(transparent)]
    File(#[from] FileError),
    #[error("{}: expected a trace, such as RUN/traces/SCENARIO/000.csv; this is a folder", .0.display())]
    Folder(PathBuf),
    #[error(
        "{}: no run folder contains this trace, expected --scenario FILE with its law and configuration",
        .0.display()
    )]
    NoRun(PathBuf),
    #[error("{}: no row is a sample that the controller answered, expected at least one", .0.display())]
    NoSample(PathBuf),
    #[error(
        "{}: the first two samples are {found_ms:.3} ms apart, expected the period of the scenario, {expected_ms:.3} \
         ms",
        path.display()
    )]
    OtherPeriod { path: PathBuf, found_ms: f64, expected_ms: f64 },
    #[error(
        "{}: no setpoint at {at_s} s, because the scenario ends at {duration_s} s; expected a column setpoint",
        path.display()
    )]
    NoSetpoint { path: PathBuf, duration_s: f64, at_s: f64 },
    #[error("this controller cannot play the recording: {0}")]
    NotApplicable(String),
    #[error(transparent)]
    Run(#[from] RunError),
}

impl From<Diagnostic> for ReplayError {
    fn from(diagnostic: Diagnostic) -> Self {
        Self::Scenario(Box::new(diagnostic))
    }
}
