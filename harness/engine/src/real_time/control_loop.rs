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
            return Err(RigError::NoAnswer { expected: "command" }.into());
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
        timing.lost_rows = self.plant.into_rows().lost();
        let telemetry = Telemetry {
            not_finite,
            loop_delay_us: timing.loop_delay_us.map(|quantiles| quantiles.max),
            rig_delay_us: timing.loop_delay_us.map(|_| self.timing.longest_rig_delay.as_secs_f64() * 1e6),
            timing: Some(Box::new(timing)),
            ..self.controller.telemetry(self.session, lost.as_ref())
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
mod tests {
    use super::*;
    use crate::live_tap::LiveTap;
    use crate::plant_simulation::collect_rows;
    use crate::trial::{TrialResult, configure, wire_faults};
    use allocation_counter::{AllocationInfo, measure, opt_out};
    use platebench_model::scenario::load;
    use platebench_rig::{HostedLink, LinkError, PtyLink, RealTimeLine, SerialLink, WallClockLink};
    use platebench_wire::{LawId, PacketReader};
    use std::path::Path;
    use std::thread;

    const PERIOD: Time = Time::from_nanos(1_000_000);

    #[test]
    fn measures_lateness_against_punctual_ticks() {
        let start = Instant::now();
        let mut ticks = TickTracker::default();
        let mut tick = |number: u32, late_us: u64| {
            let at = start + Duration::from_micros(u64::from(number) * 1_000 + 100 + late_us);
            let target = (f64::from(number) * 1_000.0 * (1.0 - 50e-6)) as u32;
            ticks.record(at, 0xFFFF_0000_u32.wrapping_add(target), PERIOD).0.as_micros()
        };
        assert_eq!(tick(0, 0), 0);
        assert!((299..=301).contains(&tick(1, 300)));
        assert!(tick(2, 0) <= 1);
        for number in 3..5_000 {
            let lateness = tick(number, 0);
            assert!(lateness <= 60, "tick {number}: drift of two intervals at most, not {lateness}");
        }
        let lateness = tick(5_000, 400);
        assert!((400..=460).contains(&lateness), "{lateness}");
    }

    #[test]
    fn a_late_first_tick_shows_in_the_second() {
        let start = Instant::now();
        let mut ticks = TickTracker::default();
        let mut tick = |number: u32, late_us: u64| {
            let at = start + Duration::from_micros(u64::from(number) * 1_000 + late_us);
            ticks.record(at, number * 1_000, PERIOD).0.as_micros()
        };
        assert_eq!([tick(0, 900), tick(1, 500), tick(2, 0), tick(3, 0), tick(4, 10)], [0, 400, 500, 0, 10]);
    }

    #[test]
    fn counts_missing_ticks_across_the_wrap() {
        let mut ticks = TickTracker::default();
        let start = 0xFFFF_FF00_u32;
        let mut missing = |target_us: u32| ticks.record(Instant::now(), start.wrapping_add(target_us), PERIOD).1;
        assert_eq!([0, 1_000, 1_990, 3_000, 7_000, 8_499, 10_000].map(&mut missing), [0, 0, 0, 0, 3, 0, 1]);
        assert_eq!([9_000, 10_000].map(&mut missing), [0, 0], "the counter does not go back");
    }

    #[test]
    fn a_target_that_handles_its_tick_late_is_late() {
        let start = Instant::now();
        let mut ticks = TickTracker::default();
        let mut tick = |number: u32, late_us: u32| {
            let target_us = number * 1_000 + late_us;
            ticks.record(start + Duration::from_micros(target_us.into()), target_us, PERIOD).0.as_micros()
        };
        assert_eq!([tick(0, 0), tick(1, 220), tick(2, 0), tick(3, 450)], [0, 220, 0, 450]);
    }

    struct UncountedLink(HostedLink);

    impl Link for UncountedLink {
        fn exchange(&mut self, now: Duration, bytes: &[u8], answer: &mut Vec<u8>) -> Result<Duration, LinkError> {
            let mut outcome = Ok(Duration::ZERO);
            opt_out(|| outcome = self.0.exchange(now, bytes, answer));
            outcome
        }

        fn advance_to(&mut self, now: Duration, received: &mut Vec<u8>) -> Result<(), LinkError> {
            let mut outcome = Ok(());
            opt_out(|| outcome = self.0.advance_to(now, received));
            outcome
        }

        fn restart(&mut self) -> Result<bool, LinkError> {
            self.0.restart()
        }
    }

    fn scenario(name: &str) -> Scenario {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../scenarios").join(name);
        load(&path, name).unwrap_or_else(|fault| panic!("{fault}"))
    }

    fn count_allocations<L: Link>(
        scenario: &Scenario,
        session: &mut Session<FaultInjector<L>>,
        pacing: Pacing,
    ) -> (AllocationInfo, u64) {
        let (live_tap, mut tap_reader) = LiveTap::new();
        let mut guard = live_tap.acquire(0, 0);
        let law = crate::trial::law(scenario).unwrap();
        let trial = Trial { own_clock: true, ..Trial::new(scenario, law, 0) };
        let time_base = TimeBase { time_scale: 1.0, pacing };
        let (queue, consumer) = RowQueue::new();
        let collector = thread::spawn(|| collect_rows(consumer, 0));
        let plant = PlantSimulation::new(scenario, 0, queue, guard.tap());
        session.link_mut().set_faults(&wire_faults(scenario, 0));
        let configuration = time_base.with_target_timing(configure(scenario, law));
        session.start_line().unwrap();
        let gains = session.start_trial(&configuration).unwrap();
        let mut control_loop = RealTimeLoop::new(session, &trial, time_base, plant, None);
        let mut outcome = Ok(());
        let allocated = measure(|| outcome = control_loop.run(&configuration, &gains));
        assert!(outcome.is_ok(), "the trial did not end normally");
        let periods = control_loop.timing.counts.periods;
        drop(control_loop);
        let rows = collector.join().unwrap();
        assert!(rows.len() as u64 > periods);
        let seen = std::iter::from_fn(|| tap_reader.next_row()).map(|tap_row| tap_row.row).collect::<Vec<_>>();
        assert!(!seen.is_empty() && rows.starts_with(&seen), "the live view gets the rows of the record");
        (allocated, periods)
    }

    /// Repeats the trial until it had more than 10 periods, because a busy host skips some. Prints how
    /// often.
    fn assert_no_allocations<L: Link>(name: &str, session: &mut Session<FaultInjector<L>>, pacing: Pacing) {
        let scenario = scenario(name);
        let mut periods = 0;
        for trials in 1..=100 {
            let (allocated, played) = count_allocations(&scenario, session, pacing);
            assert_eq!(allocated, AllocationInfo::default(), "{name}, paced by {}", pacing.name());
            periods += played;
            if periods > 10 {
                println!("{name}, paced by {}: {trials} trials", pacing.name());
                return;
            }
        }
        panic!("{name}: {periods} periods in 100 trials");
    }

    #[test]
    fn the_loop_allocates_nothing_in_process() {
        for (name, pacing) in [
            ("paper/fig13-closed-loop.toml", Pacing::Bench),
            ("paper/fig13-closed-loop.toml", Pacing::Target),
            ("faults/disconnect-and-reconnect.toml", Pacing::Bench),
            ("faults/noise-storm.toml", Pacing::Bench),
            ("faults/late-commands.toml", Pacing::Bench),
        ] {
            let mut session =
                Session::open(FaultInjector::new(WallClockLink::in_simulated_time(UncountedLink(HostedLink::new()))))
                    .unwrap();
            assert_no_allocations(name, &mut session, pacing);
        }
    }

    fn run_controller(mut port: SerialLink) {
        let start = Instant::now();
        let mut device = HostedLink::new();
        let (mut bytes, mut answer) = (Vec::new(), Vec::new());
        loop {
            let soon = Instant::now() + Duration::from_micros(250);
            let Ok(arrived) = port.real_time_line().unwrap().receive(soon, &mut bytes) else { return };
            if arrived.is_some() {
                device.exchange(start.elapsed(), &bytes, &mut answer).unwrap();
                bytes.clear();
            }
            device.advance_to(start.elapsed(), &mut answer).unwrap();
            if port.real_time_line().unwrap().send(&answer).is_err() {
                return;
            }
            answer.clear();
        }
    }

    #[test]
    fn the_loop_allocates_nothing_over_a_terminal() {
        let mut terminal = PtyLink::open().unwrap();
        let port = SerialLink::open(Path::new(terminal.path()), 1_000_000).unwrap();
        let board = thread::spawn(|| run_controller(port));
        // On a busy host, the controller may miss the first requests.
        let opened = (0..100).find_map(|_| Session::open(FaultInjector::new(&mut terminal)).ok().map(|_| ()));
        assert!(opened.is_some(), "the controller does not send its identity");
        let mut session = Session::open(FaultInjector::new(terminal)).unwrap();
        assert_no_allocations("paper/fig13-closed-loop.toml", &mut session, Pacing::Bench);
        drop(session);
        board.join().unwrap();
    }

    struct SilentAtLastSample {
        inner: HostedLink,
        last_us: u32,
    }

    impl Link for SilentAtLastSample {
        fn exchange(&mut self, now: Duration, bytes: &[u8], answer: &mut Vec<u8>) -> Result<Duration, LinkError> {
            let is_last = PacketReader::new()
                .packets(bytes)
                .flatten()
                .any(|packet| matches!(packet.message, Message::Sample(sample) if sample.time_us == self.last_us));
            let before = answer.len();
            let took = self.inner.exchange(now, bytes, answer);
            if is_last {
                answer.truncate(before);
            }
            took
        }

        fn advance_to(&mut self, now: Duration, received: &mut Vec<u8>) -> Result<(), LinkError> {
            self.inner.advance_to(now, received)
        }

        fn restart(&mut self) -> Result<bool, LinkError> {
            self.inner.restart()
        }
    }

    #[test]
    fn a_last_sample_without_an_answer_is_a_missing_answer() {
        let scenario = scenario("paper/fig13-closed-loop.toml");
        let link = SilentAtLastSample { inner: HostedLink::new(), last_us: 59_000 };
        let result = play(&scenario, WallClockLink::in_simulated_time(link));
        let last = result.trace_rows.last().unwrap();
        let timing = result.telemetry.timing.unwrap();
        assert!(last.flags.contains(Flags::LINK_LOST) && result.link_error.is_none(), "{last:?} {timing:?}");
        assert_eq!((timing.missed_replies, timing.overruns), (1, 0), "{timing:?}");
    }

    /// Drops the messages of the controller from the tenth sample on, for 25 samples.
    struct SilentLink {
        inner: HostedLink,
        samples: u32,
    }

    impl SilentLink {
        fn is_silent(&self) -> bool {
            (10..35).contains(&self.samples)
        }
    }

    impl Link for SilentLink {
        fn exchange(&mut self, now: Duration, bytes: &[u8], answer: &mut Vec<u8>) -> Result<Duration, LinkError> {
            let mut packets = PacketReader::new();
            if packets.packets(bytes).flatten().any(|packet| matches!(packet.message, Message::Sample(_))) {
                self.samples += 1;
            }
            let before = answer.len();
            let took = self.inner.exchange(now, bytes, answer);
            answer.truncate(if self.is_silent() { before } else { answer.len() });
            took
        }

        fn advance_to(&mut self, now: Duration, received: &mut Vec<u8>) -> Result<(), LinkError> {
            let before = received.len();
            let advanced = self.inner.advance_to(now, received);
            received.truncate(if self.is_silent() { before } else { received.len() });
            advanced
        }

        fn restart(&mut self) -> Result<bool, LinkError> {
            self.inner.restart()
        }
    }

    /// Stalls the bench while it sends the tenth sample.
    struct StalledLink {
        inner: WallClockLink<SilentLink>,
        samples: u32,
        stall: Duration,
    }

    impl Link for StalledLink {
        fn exchange(&mut self, now: Duration, bytes: &[u8], answer: &mut Vec<u8>) -> Result<Duration, LinkError> {
            self.inner.exchange(now, bytes, answer)
        }

        fn advance_to(&mut self, now: Duration, received: &mut Vec<u8>) -> Result<(), LinkError> {
            self.inner.advance_to(now, received)
        }

        fn real_time_line(&mut self) -> Option<&mut dyn RealTimeLine> {
            Some(self)
        }
    }

    impl StalledLink {
        fn past_stall(&self) -> Duration {
            if self.samples < 10 { Duration::ZERO } else { self.stall }
        }
    }

    impl RealTimeLine for StalledLink {
        fn now(&mut self) -> Instant {
            self.inner.now() + self.past_stall()
        }

        fn send(&mut self, bytes: &[u8]) -> Result<(), LinkError> {
            self.samples += 1;
            self.inner.send(bytes)
        }

        fn receive(&mut self, until: Instant, bytes: &mut Vec<u8>) -> Result<Option<Instant>, LinkError> {
            let stall = self.past_stall();
            let arrived = self.inner.receive(until.checked_sub(stall).unwrap(), bytes)?;
            Ok(arrived.map(|at| at + stall))
        }
    }

    fn play<L: Link>(scenario: &Scenario, link: L) -> TrialResult {
        let mut session = Session::open(FaultInjector::new(link)).unwrap();
        let trial = Trial { own_clock: true, ..Trial::new(scenario, LawId::DqPi, 0) };
        let time_base = TimeBase { time_scale: 1.0, pacing: Pacing::Bench };
        crate::real_time::play(&mut session, trial, time_base).unwrap()
    }

    #[test]
    fn a_stall_of_the_bench_is_no_silence_of_the_controller() {
        let mut scenario = scenario("paper/fig13-closed-loop.toml");
        scenario.duration = Time::from_nanos(700_000_000);
        let inner = WallClockLink::in_simulated_time(SilentLink { inner: HostedLink::new(), samples: 0 });
        let result = play(&scenario, StalledLink { inner, samples: 0, stall: Duration::from_millis(400) });
        assert!(result.link_error.is_none(), "{:?}", result.link_error);
        let timing = result.telemetry.timing.unwrap();
        // The sample at 9 ms is sent before the stall, and the one at 409 ms is the first after it.
        assert_eq!((timing.skipped, timing.missed_replies), (399, 25), "{timing:?}");
    }
}
