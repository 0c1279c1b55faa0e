//! Runs the loop of a trial in real time, paced by the bench or by the ticks of the target.

use crate::controller_log::{ControllerLog, MAX_MISSED_REPLIES, is_controller_failure};
use crate::plant_simulation::{ManualControl, PlantSimulation, RowQueue};
use crate::timing::{Pacing, ThreadScheduling, TimeBase, TimingStats};
use crate::trial::{Trial, TrialAbort};
use platebench_model::record::Telemetry;
use platebench_model::scenario::Scenario;
use platebench_model::trace::Flags;
use platebench_plate::Time;
use platebench_rig::{CANCEL_POLL_INTERVAL, CancelToken, FaultInjector, Link, ReceivedMessage, RigError, Session};
use platebench_wire::{Configure, Configured, ControllerState, Gains, Message, StateCause};
use std::time::{Duration, Instant};

/// The thread polls for this time before a deadline, because a timer would wake it some 10 µs late.
const SPIN_TIME: Duration = Duration::from_micros(80);
/// A sample is an overrun of the bench if it is later than this share of the control period.
const OVERRUN_SHARE: f64 = 0.25;
/// A controller is lost only after this silence, because a shared host may stall for some 10 ms.
const MIN_SILENT_TIME: Duration = Duration::from_millis(250);
/// Time from the configuration to the first control instant.
const START_DELAY: Duration = Duration::from_millis(2);

pub(super) struct RealTimeLoop<'a, L: Link> {
    session: &'a mut Session<FaultInjector<L>>,
    scenario: &'a Scenario,
    cancel: CancelToken,
    controller: ControllerLog<'a>,
    plant: PlantSimulation<'a, RowQueue>,
    /// Manual inputs, and the number of their changes that the plate has received.
    manual_control: Option<(&'a ManualControl, u64)>,
    time_base: TimeBase,
    period: Time,
    duration: Time,
    start: Instant,
    next_control: Time,
    /// Control instants of the samples that have no reply yet, indexed by sequence number.
    unanswered: [Option<Time>; 256],
    last_sent: Option<u8>,
    last_received: Instant,
    timing: TimingStats,
}

impl<'a, L: Link> RealTimeLoop<'a, L> {
    pub(super) fn new(
        session: &'a mut Session<FaultInjector<L>>,
        trial: &Trial<'a>,
        time_base: TimeBase,
        plant: PlantSimulation<'a, RowQueue>,
        manual: Option<&'a ManualControl>,
    ) -> Self {
        let now = session.line_time();
        Self {
            session,
            scenario: trial.scenario,
            cancel: trial.cancel.clone(),
            controller: ControllerLog::new(trial.scenario, trial.law),
            plant,
            manual_control: manual.map(|manual| (manual, 0)),
            time_base,
            period: trial.scenario.controller.period,
            duration: trial.scenario.duration,
            start: now + START_DELAY,
            next_control: Time::ZERO,
            unanswered: [None; 256],
            last_sent: None,
            last_received: now,
            timing: TimingStats::default(),
        }
    }

    pub(super) fn run(&mut self, configuration: &Configure, gains: &Gains) -> Result<(), TrialAbort> {
        self.controller.record_configuration(configuration, Some(gains), Time::ZERO);
        match self.time_base.pacing {
            Pacing::Bench => self.run_bench_paced(),
            Pacing::Target => self.run_target_paced(),
        }
    }

    fn wall_instant(&self, plate: Time) -> Instant {
        self.start + self.time_base.wall_duration(plate)
    }

    fn plate_time(&self, at: Instant) -> Time {
        self.time_base.plate_time(at.saturating_duration_since(self.start))
    }

    fn run_bench_paced(&mut self) -> Result<(), TrialAbort> {
        self.session.link_mut().start_real_time(self.start, self.time_base.time_scale);
        while self.next_control < self.duration {
            if self.is_emulation_stopped() {
                return Ok(());
            }
            if self.cancel.is_cancelled() {
                return Err(TrialAbort::Cancelled);
            }
            let deadline = self.wall_instant(self.next_control);
            let now = self.session.line_time();
            if now >= deadline {
                self.control_at_deadline(now)?;
                continue;
            }
            let until =
                deadline.checked_sub(SPIN_TIME).map_or(now, |until| until.max(now)).min(now + CANCEL_POLL_INTERVAL);
            if let Some(received) = self.session.receive(until)? {
                while self.next_control < self.duration && self.wall_instant(self.next_control) <= received.received_at
                {
                    self.control_at_deadline(received.received_at)?;
                }
                self.handle_message(&received)?;
            }
        }
        self.receive_until_end()
    }

    fn control_at_deadline(&mut self, now: Instant) -> Result<(), TrialAbort> {
        let due = self.next_control;
        self.next_control = due + self.period;
        let lateness = now.saturating_duration_since(self.wall_instant(due));
        self.plant.advance_through(due, Flags::empty());
        if now >= self.wall_instant(self.next_control) {
            // Skips this sample, because it would delay the next one, which is already due.
            self.timing.counts.periods += 1;
            self.timing.counts.overruns += 1;
            self.timing.counts.skipped += 1;
            // The bench stood still. This time is no silence of the controller.
            self.last_received += self.time_base.wall_duration(self.period);
            self.timing.lateness.record(lateness);
            self.plant.push_row(to_micros(lateness), Flags::OVERRUN);
            return Ok(());
        }
        self.send_sample(lateness, 0)
    }

    /// Each tick of the target is a control instant. The trial starts with the first tick.
    fn run_target_paced(&mut self) -> Result<(), TrialAbort> {
        let mut ticks = TickTracker::default();
        let first = self.session.line_time() + MIN_SILENT_TIME;
        let mut last_tick = Time::ZERO;
        while !self.is_finished() {
            if self.is_emulation_stopped() {
                return Ok(());
            }
            if self.cancel.is_cancelled() {
                return Err(TrialAbort::Cancelled);
            }
            let until = self.session.line_time() + self.time_base.wall_duration(self.period).min(CANCEL_POLL_INTERVAL);
            let until = if ticks.has_ticks() { until.min(self.wall_instant(self.duration)) } else { until };
            let Some(received) = self.session.receive(until)? else {
                if self.session.line_time()
                    >= if ticks.has_ticks() { self.last_received + MIN_SILENT_TIME } else { first }
                {
                    return Err(RigError::NoAnswer { expected: "tick" }.into());
                }
                continue;
            };
            let Message::Tick(tick) = received.message else {
                self.handle_message(&received)?;
                continue;
            };
            if !ticks.has_ticks() {
                self.start = received.received_at;
                self.session.link_mut().start_real_time(self.start, self.time_base.time_scale);
            }
            self.last_received = received.received_at;
            let instant = self.plate_time(received.received_at);
            if instant >= self.duration {
                break;
            }
            self.plant.advance_through(instant, Flags::empty());
            last_tick = instant;
            let (lateness, missing) = ticks.record(received.received_at, tick.target_time_us, self.period);
            self.send_sample(lateness, missing)?;
        }
        self.receive_until_end()?;
        self.count_missed_ticks(last_tick);
        Ok(())
    }

    /// Counts the ticks that are missing at the end, unless a reported stop explains them. A sample
    /// time-out explains nothing, because missing ticks cause it.
    fn count_missed_ticks(&mut self, last_tick: Time) {
        let periods = (self.duration - last_tick).as_nanos() / self.period.as_nanos().max(1);
        let has_stopped = self.controller.stop_cause().is_some_and(|cause| cause != StateCause::SampleTimeout);
        let missing = periods.saturating_sub(2);
        if missing > 0 && !has_stopped {
            self.timing.counts.missed_replies += missing;
            self.plant.report_counts(missing, self.session.rejected_frames());
            self.plant.push_row(0.0, Flags::LINK_LOST);
        }
    }

    fn is_finished(&mut self) -> bool {
        self.session.line_time() >= self.wall_instant(self.duration)
    }

    /// The plate must be at the control instant. `missing` counts earlier instants without a tick.
    fn send_sample(&mut self, lateness: Duration, missing: u64) -> Result<(), TrialAbort> {
        let now = self.plant.time();
        if let Some(inputs) = self.manual_control.as_mut().and_then(|(manual, seen)| manual.changed_inputs(seen)) {
            self.plant.set_manual_inputs(&inputs);
        }
        let sample = self.plant.sense();
        let sent = self.session.line_time();
        if let Some(configure) = self.controller.reconfiguration(now) {
            self.session.send(Message::Configure(self.time_base.with_target_timing(configure)))?;
            self.controller.record_configuration(&configure, None, now);
        }
        let outcome = self.session.send(Message::Sample(sample));
        if let Some(sample) = self.session.link().delivered_sample() {
            self.plant.set_delivered_sample(sample);
        }
        let overrun = lateness.as_secs_f64() > OVERRUN_SHARE * self.time_base.wall_duration(self.period).as_secs_f64();
        let missed =
            self.last_sent.is_some_and(|last| self.unanswered.get(usize::from(last)).is_some_and(Option::is_some));
        self.timing.counts.periods += 1;
        self.timing.counts.overruns += u64::from(overrun);
        let misses = u64::from(missed) + missing;
        self.timing.counts.missed_replies += misses;
        self.plant.report_counts(misses, self.session.rejected_frames());
        self.timing.lateness.record(lateness);
        self.controller.record_missed_reply();
        self.controller.record_sample();
        let mut flags = Flags::CONTROL;
        flags.set(Flags::OVERRUN, overrun);
        flags.set(Flags::LINK_LOST, misses > 0);
        self.plant.push_row(to_micros(lateness), flags);
        let sequence = outcome?;
        if let Some(unanswered) = self.unanswered.get_mut(usize::from(sequence)) {
            // Sequence numbers repeat: a later reply to the older sample would match this one.
            self.timing.counts.lost_replies += u64::from(unanswered.replace(now).is_some());
        }
        self.last_sent = Some(sequence);
        if self.scenario.explains_silence(now) {
            // A planned fault causes the silence, so it does not show that the controller is lost.
            self.last_received = sent;
            self.controller.reset_missed_replies();
        }
        let silence = sent.saturating_duration_since(self.last_received);
        if self.controller.missed_replies() >= MAX_MISSED_REPLIES && silence > MIN_SILENT_TIME {
            return Err(self.session.no_answer("command").into());
        }
        Ok(())
    }

    fn handle_message(&mut self, received: &ReceivedMessage) -> Result<(), TrialAbort> {
        let command = match received.message {
            Message::Command(command) => command,
            Message::Configured(Configured { outcome: Err(rejection) }) => {
                return Err(RigError::ConfigurationRejected(rejection).into());
            }
            _ => return Ok(()),
        };
        self.last_received = received.received_at;
        self.controller.reset_missed_replies();
        let sampled = self.unanswered.get_mut(usize::from(received.sequence)).and_then(Option::take);
        // A second reply to a sample is a duplicated frame, unless it reports a stop.
        if sampled.is_none() && command.state == ControllerState::Running {
            return Ok(());
        }
        // A controller that is idle after its configuration has restarted.
        if sampled.is_some() && command.state == ControllerState::Idle {
            return Err(RigError::Restarted.into());
        }
        // The plate may already be at a later control instant. The command then acts there.
        let instant = self.plate_time(received.received_at).max(self.plant.time()).min(self.duration);
        self.plant.advance_through(instant, Flags::empty());
        if let Some(sampled) = sampled {
            self.timing.loop_delay.record(instant.since(sampled).into());
            let wall_delay = received.received_at.saturating_duration_since(self.wall_instant(sampled));
            self.timing.longest_rig_delay = self.timing.longest_rig_delay.max(wall_delay);
            let bench = self.wall_instant(sampled).saturating_duration_since(self.start);
            self.timing.drift.record(bench, command.target_time_us);
        }
        let newer_samples = self.last_sent.map_or(0, |last| last.wrapping_sub(received.sequence));
        self.controller.record_command(&command, newer_samples, instant);
        self.plant.actuate(&command);
        if !self.plant.is_finished() {
            self.plant.push_row(0.0, Flags::empty());
        }
        Ok(())
    }

    fn is_emulation_stopped(&self) -> bool {
        self.controller.is_stopped() && self.manual_control.is_some()
    }

    fn receive_until_end(&mut self) -> Result<(), TrialAbort> {
        let end = self.wall_instant(self.duration);
        while self.session.line_time() < end {
            if self.cancel.is_cancelled() {
                return Err(TrialAbort::Cancelled);
            }
            let soon = self.session.line_time() + CANCEL_POLL_INTERVAL;
            if let Some(received) = self.session.receive(soon.min(end))? {
                self.handle_message(&received)?;
            }
        }
        // The number of reads is bounded, because a faulty controller may never stop sending.
        for _ in 0..self.unanswered.len() {
            let now = self.session.line_time();
            let Some(received) = self.session.receive(now)? else { break };
            self.handle_message(&received)?;
        }
        self.plant.advance_through(self.duration, Flags::empty());
        let missed = u64::from(self.is_last_reply_missing());
        self.timing.counts.missed_replies += missed;
        self.plant.report_counts(missed, self.session.rejected_frames());
        self.plant.push_row(0.0, if missed > 0 { Flags::LINK_LOST } else { Flags::empty() });
        Ok(())
    }

    /// True if the last sample has no reply. No later control instant notices this.
    fn is_last_reply_missing(&self) -> bool {
        let sampled = self.last_sent.and_then(|last| self.unanswered.get(usize::from(last)).copied().flatten());
        sampled.is_some_and(|sampled| self.duration.since(sampled) >= self.period)
    }

    /// Requests 0 V and returns the results. `None` if the trial was cancelled.
    pub(super) fn finish(
        mut self,
        abort: Option<TrialAbort>,
        scheduling: &ThreadScheduling,
    ) -> Option<(Telemetry, Option<RigError>)> {
        let safe_confirmed = self.session.request_safe_state();
        if safe_confirmed || self.session.has_driven_after_safe() {
            self.controller.observe_safe_state(self.session, self.plant.time());
        }
        self.controller.record_session(self.session, self.plant.time());
        let lost = match abort {
            None => None,
            Some(TrialAbort::Cancelled) => return None,
            Some(TrialAbort::Lost(error)) => Some(error),
        };
        if let Some(error) = &lost {
            // Simulates the rest of the trial at 0 V, without a wait for wall time.
            let flags = if is_controller_failure(error) { Flags::empty() } else { Flags::LINK_LOST };
            self.plant.stop_drive();
            self.plant.push_row(0.0, flags);
            self.plant.advance_through(self.duration, Flags::empty());
            self.plant.push_row(0.0, flags);
        }
        let lost = lost.or_else(|| self.session.end_before_safe());
        self.timing.counts.lost_replies += self.unanswered.iter().flatten().count() as u64;
        self.plant.report_counts(0, self.session.rejected_frames());
        let mut timing = self.timing.timing();
        timing.time_scale = self.time_base.time_scale;
        self.time_base.pacing.name().clone_into(&mut timing.pacing);
        scheduling.scheduling.clone_into(&mut timing.scheduling);
        timing.memory_locked = scheduling.memory_locked;
        timing.rejected_frames = self.session.rejected_frames();
        timing.safe_confirmed = safe_confirmed;
        let not_finite = self.plant.not_finite();
        timing.lost_rows = self.plant.into_rows().finish();
        let telemetry = Telemetry {
            not_finite,
            loop_delay_us: timing.loop_delay_us.map(|quantiles| quantiles.max),
            rig_delay_us: timing.loop_delay_us.map(|_| self.timing.longest_rig_delay.as_secs_f64() * 1e6),
            timing: Some(Box::new(timing)),
            ..self.controller.telemetry(self.session, lost.as_ref(), None)
        };
        Some((telemetry, lost))
    }
}

fn to_micros(span: Duration) -> f64 {
    span.as_secs_f64() * 1e6
}

/// Measures lateness against the earliest recent tick, which counts as punctual. The time stamp of
/// a tick does not show lateness, because the target sets it when it handles the tick.
#[derive(Debug, Default)]
pub(super) struct TickTracker {
    first: Option<Instant>,
    last_us: u32,
    /// Time of the target since the first tick, without wrap, µs.
    target_us: u64,
    period: u64,
    /// Least delay of a tick after its period starts, µs, in this and the last `DRIFT_INTERVAL`.
    earliest: [Option<f64>; 2],
    interval: u64,
}

impl TickTracker {
    /// Two clocks drift apart by at most about 0.1 µs per ms, so by 50 µs in this interval.
    const DRIFT_INTERVAL: Duration = Duration::from_millis(500);

    pub(super) fn has_ticks(&self) -> bool {
        self.first.is_some()
    }

    /// Returns the lateness of the tick and the number of periods without a tick before it. If this
    /// tick is the earliest, the ticks before it were late, and their lateness is returned.
    pub(super) fn record(&mut self, at: Instant, target_us: u32, period: Time) -> (Duration, u64) {
        if self.first.is_none() {
            self.last_us = target_us;
        }
        let since = at.saturating_duration_since(*self.first.get_or_insert(at));
        let step = target_us.wrapping_sub(std::mem::replace(&mut self.last_us, target_us));
        // The counter wraps, so a step back looks like a step of more than half its range.
        self.target_us += if step > u32::MAX / 2 { 0 } else { u64::from(step) };
        let period_us = period.seconds() * 1e6;
        let number = (self.target_us as f64 / period_us).round();
        let before = std::mem::replace(&mut self.period, number as u64);
        let missing = self.period.saturating_sub(before + 1);

        let behind = since.as_secs_f64() * 1e6 - number * period_us;
        let interval = (since.as_nanos() / Self::DRIFT_INTERVAL.as_nanos()) as u64;
        if interval != self.interval {
            self.interval = interval;
            self.earliest = [None, self.earliest[0]];
        }
        let earliest = self.earliest.iter().flatten().copied().reduce(f64::min).unwrap_or(behind);
        self.earliest[0] = Some(self.earliest[0].map_or(behind, |least| least.min(behind)));
        (Duration::from_secs_f64((behind - earliest).abs() / 1e6), missing)
    }
}

#[cfg(test)]
mod tests;
