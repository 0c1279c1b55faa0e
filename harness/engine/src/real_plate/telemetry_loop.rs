//! Exchanges setpoints and telemetry with a controller that drives its own plate.
//!
//! The loop runs on one thread and does not allocate after the first setpoint. Setpoints follow the
//! scenario's profile at the time of the controller's clock. The loop repeats unchanged setpoints
//! to keep the controller's watchdog from expiring. It ends with a request for 0 V.

use crate::controller_log::{drive_violation, is_controller_failure, stop_reason};
use crate::plant_simulation::{RowQueue, RowSink as _, SATURATION_THRESHOLD};
use crate::timing::{ClockDrift, DurationHistogram};
use crate::trial::{Trial, TrialAbort, configure};
use platebench_model::record::{RealPlateRecord, Violation};
use platebench_model::scenario::Scenario;
use platebench_model::trace::{Flags, Row};
use platebench_plate::Time;
use platebench_rig::{CANCEL_POLL_INTERVAL, CancelToken, FaultInjector, Link, RigError, Session};
use platebench_wire::{Command, Configure, ControllerState, LawId, Message, Setpoint, StateCause, Telemetry};
use std::time::{Duration, Instant};

/// The controller goes to 0 V if it gets no setpoint for this time.
const WATCHDOG_TIMEOUT_MS: u16 = 250;
const KEEP_ALIVE_INTERVAL: Duration = Duration::from_millis(50);
/// If this time has passed since the last setpoint, the next one is an overrun of the bench.
const LATE_SETPOINT: Duration = Duration::from_millis(200);
const ACKNOWLEDGE_TIMEOUT: Duration = Duration::from_millis(100);
/// The controller is lost if it sends no telemetry for this time.
const SILENCE_TIMEOUT: Duration = Duration::from_millis(500);

pub(super) struct TelemetryLoopResult {
    pub(super) abort: Option<TrialAbort>,
    pub(super) stop_reason: Option<&'static str>,
    pub(super) real_plate: RealPlateRecord,
    pub(super) violation: Option<Violation>,
}

#[derive(Clone, Copy)]
struct PendingSetpoint {
    sent_at: Instant,
    /// Trial time of the last telemetry before the setpoint.
    telemetry_time: Time,
}

pub(super) struct TelemetryLoop<'a, L: Link> {
    session: &'a mut Session<FaultInjector<L>>,
    scenario: &'a Scenario,
    law: LawId,
    cancel: CancelToken,
    telemetry: TelemetryRows,
    queue: RowQueue,
    next_flags: Flags,
    last_telemetry: Instant,
    last_setpoint: Option<(f32, Instant)>,
    /// Setpoints without acknowledgement, indexed by sequence number.
    pending_setpoints: [Option<PendingSetpoint>; 256],
    acknowledge_time: DurationHistogram,
    setpoints: u64,
    unacknowledged: u64,
    drift: ClockDrift,
    first_telemetry: Option<Instant>,
    stop_reason: Option<&'static str>,
}

impl<'a, L: Link> TelemetryLoop<'a, L> {
    pub(super) fn new(session: &'a mut Session<FaultInjector<L>>, trial: &Trial<'a>, queue: RowQueue) -> Self {
        let scenario = trial.scenario;
        Self {
            session,
            scenario,
            law: trial.law,
            cancel: trial.cancel.clone(),
            telemetry: TelemetryRows::new(scenario.controller.period.wrapping_micros(), scenario.plate.drive_limit_vpp),
            queue,
            next_flags: Flags::empty(),
            last_telemetry: Instant::now(),
            last_setpoint: None,
            pending_setpoints: [None; 256],
            acknowledge_time: DurationHistogram::default(),
            setpoints: 0,
            unacknowledged: 0,
            drift: ClockDrift::default(),
            first_telemetry: None,
            stop_reason: None,
        }
    }

    pub(super) fn run(mut self) -> TelemetryLoopResult {
        let ended = self.exchange_until_end().err();
        let safe_confirmed = self.session.request_safe_state();
        let is_observed = safe_confirmed || self.session.has_driven_after_safe();
        let drives = if is_observed { self.session.observe_safe_state() } else { None };
        let violation = drives.map(|drives| drive_violation(drives, self.telemetry.time().unwrap_or(Time::ZERO)));
        let controller_failed = matches!(&ended, Some(TrialAbort::Lost(error)) if is_controller_failure(error));
        if let Some(TrialAbort::Lost(RigError::ConfigurationRejected(_))) = &ended {
            self.queue.push(self.row_at_rest());
        } else if (self.stop_reason.is_some() || controller_failed)
            && let Some(row) = self.telemetry.stop_row()
        {
            self.queue.push(row);
        }
        let real_plate = RealPlateRecord {
            periods: self.telemetry.received,
            missing: self.telemetry.missing,
            setpoints: self.setpoints,
            unacknowledged: self.unacknowledged,
            acknowledged_us: self.acknowledge_time.quantiles_us(),
            rejected_frames: self.session.rejected_frames(),
            lost_rows: self.queue.finish(),
            clock_ppm: self.drift.ppm().map(|(ppm, error)| [ppm, error]),
            force_measured: self.telemetry.force_measured,
            safe_confirmed,
            ..RealPlateRecord::default()
        };
        TelemetryLoopResult { abort: ended, stop_reason: self.stop_reason, real_plate, violation }
    }

    fn exchange_until_end(&mut self) -> Result<(), TrialAbort> {
        let configure = configure(self.scenario, self.law);
        self.session.start_trial(&Configure {
            drives_own_plate: true,
            watchdog_timeout_ms: WATCHDOG_TIMEOUT_MS,
            ..configure
        })?;
        self.last_telemetry = Instant::now();
        loop {
            if self.cancel.is_cancelled() {
                return Err(TrialAbort::Cancelled);
            }
            let now = Instant::now();
            self.count_unacknowledged(now);
            self.send_setpoint(now)?;
            let received = self.session.receive(self.next_instant(now))?;
            if let Some(received) = &received {
                self.handle_message(received.sequence, &received.message, received.received_at)?;
            }
            if self.telemetry.time().is_some_and(|time| time >= self.scenario.duration) {
                return Ok(());
            }
            // Silence counts only if all messages are read, because they may contain telemetry.
            if received.is_none() && self.last_telemetry.elapsed() > SILENCE_TIMEOUT {
                // A stopped controller may send nothing more.
                let silent = self.session.no_answer("telemetry");
                return if self.stop_reason.is_some() { Ok(()) } else { Err(silent.into()) };
            }
        }
    }

    /// Row of a controller that refused its configuration and so sends no telemetry.
    fn row_at_rest(&self) -> Row {
        Row {
            t_s: 0.0,
            setpoint_um: self.scenario.setpoint.at(Time::ZERO),
            wd_um: 0.0,
            wq_um: 0.0,
            amplitude_um: 0.0,
            drive_vpp: 0.0,
            frequency_hz: self.scenario.controller.start_frequency_hz,
            resonance_hz: f64::NAN,
            temperature_offset_k: f64::NAN,
            finger_force_n: f64::NAN,
            sensed_wd_um: 0.0,
            sensed_wq_um: 0.0,
            lateness_us: 0.0,
            flags: Flags::SENSED | Flags::SAFE,
        }
    }

    fn trial_time(&self, now: Instant) -> Time {
        let since = now.saturating_duration_since(self.last_telemetry).as_nanos();
        self.telemetry.time().map_or(Time::ZERO, |last| last + Time::from_nanos(since as u64))
    }

    fn next_instant(&self, now: Instant) -> Instant {
        let trial = self.trial_time(now);
        let point = self.scenario.setpoint.next_point_after(trial).filter(|_| self.telemetry.time().is_some());
        let to_point = point.map_or(CANCEL_POLL_INTERVAL, |point| point.since(trial).into());
        now + to_point.min(CANCEL_POLL_INTERVAL)
    }

    fn send_setpoint(&mut self, now: Instant) -> Result<(), TrialAbort> {
        let setpoint_um = self.scenario.setpoint.at(self.trial_time(now)) as f32;
        let since = self.last_setpoint.map(|(_, sent)| now.saturating_duration_since(sent));
        let has_moved = self.last_setpoint.is_none_or(|(last, _)| last != setpoint_um);
        if !has_moved && since.is_some_and(|since| since < KEEP_ALIVE_INTERVAL) {
            return Ok(());
        }
        if since.is_some_and(|since| since > LATE_SETPOINT) {
            self.next_flags |= Flags::OVERRUN;
        }
        let sequence = self.session.send(Message::Setpoint(Setpoint { setpoint_um }))?;
        self.setpoints += 1;
        self.last_setpoint = Some((setpoint_um, now));
        if let Some(open) = self.pending_setpoints.get_mut(usize::from(sequence)) {
            *open = Some(PendingSetpoint { sent_at: now, telemetry_time: self.telemetry.time().unwrap_or(Time::ZERO) });
        }
        Ok(())
    }

    /// Counts setpoints without acknowledgement. Telemetry must be newer by the whole time-out,
    /// because this shows that the bench has read the line.
    fn count_unacknowledged(&mut self, now: Instant) {
        let within = Time::from_nanos(ACKNOWLEDGE_TIMEOUT.as_nanos() as u64);
        let last = self.telemetry.time().unwrap_or(Time::ZERO);
        let is_missed = |open: &mut PendingSetpoint| {
            now.saturating_duration_since(open.sent_at) > ACKNOWLEDGE_TIMEOUT
                && last.since(open.telemetry_time) > within
        };
        for open in &mut self.pending_setpoints {
            if open.take_if(is_missed).is_some() {
                self.unacknowledged += 1;
                self.next_flags |= Flags::LINK_LOST;
            }
        }
    }

    fn handle_message(&mut self, sequence: u8, message: &Message, at: Instant) -> Result<(), TrialAbort> {
        match message {
            Message::Telemetry(telemetry) => {
                let Some(row) = self.telemetry.accept(telemetry) else { return Ok(()) };
                self.last_telemetry = at;
                let since = at.saturating_duration_since(*self.first_telemetry.get_or_insert(at));
                self.drift.record(since, telemetry.target_time_us);
                if telemetry.state != ControllerState::Running {
                    self.stop_reason.get_or_insert(setpoint_stop_reason(telemetry.cause));
                }
                let flags = row.flags | std::mem::take(&mut self.next_flags);
                self.queue.push(platebench_model::trace::Row { flags, ..row });
                Ok(())
            }
            Message::Command(command) => self.handle_acknowledgement(sequence, command, at),
            _ => Ok(()),
        }
    }

    fn handle_acknowledgement(&mut self, sequence: u8, command: &Command, at: Instant) -> Result<(), TrialAbort> {
        let sent = self.pending_setpoints.get_mut(usize::from(sequence)).and_then(Option::take);
        if let Some(sent) = sent {
            self.acknowledge_time.record(at.saturating_duration_since(sent.sent_at));
        }
        match command.state {
            // A controller that is idle after its configuration has restarted.
            ControllerState::Idle if sent.is_some() => Err(RigError::Restarted.into()),
            ControllerState::Fault | ControllerState::Safe => {
                self.stop_reason.get_or_insert(setpoint_stop_reason(command.cause));
                Ok(())
            }
            ControllerState::Idle | ControllerState::Running => Ok(()),
        }
    }
}

const fn setpoint_stop_reason(cause: StateCause) -> &'static str {
    match cause {
        StateCause::SampleTimeout => "no setpoint before its watchdog expired",
        StateCause::LineNoise | StateCause::NonFinite | StateCause::None => stop_reason(cause),
    }
}

/// Converts telemetry in the order of the target's clock. The trial starts with period 0.
pub(super) struct TelemetryRows {
    period_us: u32,
    limit_vpp: f64,
    last: Option<LastPeriod>,
    pub(super) received: u64,
    pub(super) missing: u64,
    pub(super) force_measured: bool,
}

#[derive(Clone, Copy)]
struct LastPeriod {
    period: u32,
    target_time_us: u32,
    since_start_us: u64,
    row: Row,
}

impl TelemetryRows {
    pub(super) fn new(period_us: u32, limit_vpp: f64) -> Self {
        Self { period_us, limit_vpp, last: None, received: 0, missing: 0, force_measured: false }
    }

    pub(super) fn time(&self) -> Option<Time> {
        self.last.map(|last| Time::from_nanos(last.since_start_us * 1_000))
    }

    /// Returns `None` for a duplicate, an older period, or a value that is not finite.
    pub(super) fn accept(&mut self, telemetry: &Telemetry) -> Option<Row> {
        let numbers = [telemetry.setpoint_um, telemetry.wd_um, telemetry.wq_um, telemetry.drive_vpp];
        if !numbers.iter().all(|number| number.is_finite()) {
            return None;
        }
        let since_start_us = match self.last {
            // Periods before the first telemetry belong to the trial.
            None => u64::from(telemetry.period) * u64::from(self.period_us),
            Some(last) => {
                let (periods, span) = (
                    telemetry.period.wrapping_sub(last.period),
                    telemetry.target_time_us.wrapping_sub(last.target_time_us),
                );
                // The counters wrap, so a step of more than half their range is a step back.
                if periods == 0 || span == 0 || periods > u32::MAX / 2 || span > u32::MAX / 2 {
                    return None;
                }
                self.missing += u64::from(periods - 1);
                last.since_start_us + u64::from(span)
            }
        };
        if self.last.is_none() {
            self.missing += u64::from(telemetry.period);
        }
        self.received += 1;
        let force = telemetry.force_n.filter(|force| force.is_finite());
        self.force_measured |= force.is_some();
        let [setpoint_um, wd_um, wq_um, drive_vpp] = numbers.map(f64::from);
        let mut flags = Flags::CONTROL | Flags::SENSED;
        flags.set(Flags::SATURATED, drive_vpp >= self.limit_vpp * SATURATION_THRESHOLD);
        flags.set(Flags::SAFE, telemetry.state != ControllerState::Running);
        let row = Row {
            t_s: since_start_us as f64 / 1e6,
            setpoint_um,
            wd_um,
            wq_um,
            amplitude_um: wd_um.hypot(wq_um),
            drive_vpp,
            frequency_hz: f64::from(telemetry.frequency_mhz) / 1e3,
            resonance_hz: f64::NAN,
            temperature_offset_k: f64::NAN,
            finger_force_n: force.map_or(f64::NAN, f64::from),
            sensed_wd_um: wd_um,
            sensed_wq_um: wq_um,
            lateness_us: 0.0,
            flags,
        };
        let Telemetry { period, target_time_us, .. } = *telemetry;
        self.last = Some(LastPeriod { period, target_time_us, since_start_us, row });
        Some(row)
    }

    /// Row with 0 V one period after the last telemetry. `None` if this telemetry shows the stop.
    pub(super) fn stop_row(&self) -> Option<Row> {
        let last = self.last.filter(|last| !last.row.flags.contains(Flags::SAFE))?;
        let t_s = (last.since_start_us + u64::from(self.period_us)) as f64 / 1e6;
        Some(Row { t_s, drive_vpp: 0.0, flags: Flags::SENSED | Flags::SAFE, ..last.row })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use platebench_wire::StateCause;

    fn telemetry(period: u32, target_time_us: u32) -> Telemetry {
        Telemetry {
            period,
            target_time_us,
            setpoint_um: 2.0,
            wd_um: 1.5,
            wq_um: -2.0,
            drive_vpp: 400.0,
            frequency_mhz: 32_307_600,
            force_n: None,
            state: ControllerState::Running,
            cause: StateCause::None,
            flags: 0,
        }
    }

    #[test]
    fn uses_the_target_s_clock_from_period_0() {
        let mut rows = TelemetryRows::new(1_000, 900.0);
        let first = rows.accept(&telemetry(0, u32::MAX - 499)).unwrap();
        assert_eq!((first.t_s, first.amplitude_um, first.flags), (0.0, 2.5, Flags::CONTROL | Flags::SENSED));
        assert!(first.finger_force_n.is_nan() && first.resonance_hz.is_nan());
        assert_eq!(rows.accept(&telemetry(1, 510)).unwrap().t_s, 0.001_010);
        assert!(rows.accept(&telemetry(1, 510)).is_none() && rows.accept(&telemetry(0, u32::MAX - 499)).is_none());
        assert!(rows.accept(&Telemetry { wd_um: f32::NAN, ..telemetry(2, 1_500) }).is_none());
        assert_eq!(rows.accept(&telemetry(4, 3_500)).unwrap().t_s, 0.004);
        assert_eq!((rows.received, rows.missing), (3, 2));
    }

    #[test]
    fn counts_periods_before_the_first_as_missing() {
        let mut rows = TelemetryRows::new(1_000, 900.0);
        assert_eq!(rows.accept(&telemetry(3, 77)).unwrap().t_s, 0.003);
        assert_eq!(rows.missing, 3);
    }

    #[test]
    fn records_force_and_saturation() {
        let mut rows = TelemetryRows::new(1_000, 900.0);
        let at_limit = Telemetry { drive_vpp: 900.0, force_n: Some(0.5), ..telemetry(0, 0) };
        let seen = rows.accept(&at_limit).unwrap();
        assert_eq!(seen.finger_force_n, 0.5);
        assert!(seen.flags.contains(Flags::SATURATED) && rows.force_measured);
        let broken = Telemetry { force_n: Some(f32::NAN), ..telemetry(1, 1_000) };
        assert!(rows.accept(&broken).unwrap().finger_force_n.is_nan());
        let stopped = rows.stop_row().unwrap();
        assert_eq!((stopped.t_s, stopped.drive_vpp), (0.002, 0.0));
        assert_eq!(stopped.flags, Flags::SENSED | Flags::SAFE);
        let fault = Telemetry { state: ControllerState::Fault, drive_vpp: 0.0, ..telemetry(2, 2_000) };
        assert!(rows.accept(&fault).unwrap().flags.contains(Flags::SAFE));
        assert!(rows.stop_row().is_none(), "its telemetry has that row");
    }
}
