//! Plays one trial in lockstep: plate time stands still while a sample travels, the controller
//! computes and the command returns. At one instant the order is sample, actuation, row.

use crate::controller_log::{ControllerLog, MAX_MISSED_REPLIES, is_controller_failure};
use crate::plant_simulation::{PlantSimulation, expected_rows};
use crate::trial::{Trial, TrialResult, WATCHDOG_PERIODS, chip_fault_plan, planned_stops, set_line_faults};
use platebench_model::record::{StepTime, Telemetry, Transport};
use platebench_model::scenario::{LoopInsertion, Metric, Scenario, Variation};
use platebench_model::trace::{Flags, Row};
use platebench_plate::Time;
use platebench_rig::TargetError;
use platebench_rig::{Chip, ChipFaultPlan, FaultInjector, HostedLink, Link, LinkError, Reply, RigError, Session};
use platebench_wire::{Command, Configure, ControllerState as Mode, LawId, StateCause};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng, SeedableRng};
use std::collections::VecDeque;
use std::time::{Duration, Instant};

/// Watchdog time-out of a controller with its own clock. The bench sets the pace, so the time-out
/// is longer than a stall of the host.
pub(crate) const OWN_CLOCK_WATCHDOG_TIMEOUT_MS: u16 = 10_000;
/// Watchdog time-out if a planned silence must trigger the watchdog. It is shorter, because the
/// bench waits for it in wall time.
const SILENCE_WATCHDOG_TIMEOUT_MS: u16 = 1_000;
const WATCHDOG_MARGIN: Duration = Duration::from_millis(100);
/// One of this many trials is played over both transports of the emulated chip.
const CHECKED_TRIALS: u32 = 10;
/// Random stream of the jitter. Streams 0 and 1 of a seed belong to sensor noise and plate spread.
const JITTER_STREAM: u64 = 2;

/// `None` if the trial was cancelled. The caller then closes the session, which requests 0 V.
pub fn play<L: Link>(session: &mut Session<FaultInjector<L>>, trial: Trial<'_>) -> Option<TrialResult> {
    let mut lockstep = LockstepLoop::start(session, trial);
    while !lockstep.step() {
        if lockstep.trial.cancel.is_cancelled() {
            return None;
        }
    }
    Some(lockstep.finish())
}

/// Fails if the hosted firmware does not answer before the trial.
pub fn play_hosted(scenario: &Scenario, law: LawId, index: u32) -> Result<TrialResult, RigError> {
    let mut session = Session::open(FaultInjector::new(HostedLink::new()))?;
    let mut lockstep = LockstepLoop::start(&mut session, Trial::new(scenario, law, index));
    while !lockstep.step() {}
    Ok(lockstep.finish())
}

/// Transport of a trial that does not depend on the line. The bench checks the shorter way in one of
/// ten trials, chosen from the scenario's name and the trial's number.
fn transport(scenario: &Scenario, index: u32) -> Transport {
    let name = scenario.file.bytes().fold(0_u32, |sum, byte| sum.wrapping_add(byte.into()));
    let is_checked = name.wrapping_add(index).is_multiple_of(CHECKED_TRIALS);
    if is_checked { Transport::BlocksAndWords } else { Transport::Blocks }
}

struct LockstepLoop<'a, L: Link> {
    session: &'a mut Session<FaultInjector<L>>,
    trial: Trial<'a>,
    plant: PlantSimulation<'a, Vec<Row>>,
    controller: ControllerLog<'a>,
    replies: ReplyStats,
    commands: DelayedCommands,
    watchdog: Watchdog,
    chip: ChipState,
    next_control: Time,
    /// Control instant and row index of the last sample, if this sample has no reply yet.
    unanswered: Option<(Time, usize)>,
    link_error: Option<RigError>,
}

/// Watchdog of a controller with its own clock, in wall time.
struct Watchdog {
    /// 0 without an own clock: the controller keeps its default.
    timeout_ms: u16,
    last_sample_sent: Instant,
    /// Instants of the plate at which a planned silence stops the controller, last one first.
    planned_stops: Vec<Time>,
}

impl Watchdog {
    fn new(trial: &Trial<'_>) -> Self {
        let planned_stops = if trial.own_clock { planned_stops(trial.scenario) } else { Vec::new() };
        let timeout_ms = match (trial.own_clock, planned_stops.is_empty()) {
            (false, _) => 0,
            (true, true) => OWN_CLOCK_WATCHDOG_TIMEOUT_MS,
            (true, false) => SILENCE_WATCHDOG_TIMEOUT_MS,
        };
        Self { timeout_ms, last_sample_sent: Instant::now(), planned_stops }
    }
}

/// Planned faults of the chip.
struct ChipState {
    plan: ChipFaultPlan,
    /// Error that a planned fault caused. The rest of the trial has 0 V.
    stop: Option<RigError>,
}

/// Commands that act after the loop delay. The delay is uniform from the scenario's loop delay to
/// the sum of loop delay and jitter.
struct DelayedCommands {
    smallest: Time,
    jitter: Time,
    insertion: Option<LoopInsertion>,
    random: ChaCha8Rng,
    waiting: VecDeque<(Time, Command)>,
}

impl DelayedCommands {
    fn new(scenario: &Scenario, index: u32) -> Self {
        let mut random = ChaCha8Rng::seed_from_u64(Variation::of_trial(scenario, index).seed);
        random.set_stream(JITTER_STREAM);
        let controller = &scenario.controller;
        let (smallest, jitter) = (controller.loop_delay, controller.loop_delay_jitter);
        Self { smallest, jitter, insertion: controller.insertion, random, waiting: VecDeque::new() }
    }

    fn draw_delay(&mut self, now: Time) -> Time {
        let inserted = self.insertion.filter(|insertion| insertion.from <= now).map_or(Time::ZERO, |found| found.delay);
        let smallest = self.smallest + inserted;
        if self.jitter == Time::ZERO {
            return smallest;
        }
        let share = f64::from(self.random.next_u32()) / f64::from(u32::MAX);
        smallest + Time::from_nanos((self.jitter.as_nanos() as f64 * share).round() as u64)
    }

    /// A command never overtakes an earlier one.
    fn push(&mut self, at: Time, command: Command) {
        let at = self.waiting.back().map_or(at, |(last, _)| at.max(*last));
        self.waiting.push_back((at, command));
    }

    fn take_due(&mut self, now: Time) -> Option<Command> {
        self.next_due().filter(|at| *at <= now)?;
        self.waiting.pop_front().map(|(_, command)| command)
    }

    fn next_due(&self) -> Option<Time> {
        self.waiting.front().map(|(at, _)| *at)
    }

    fn clear(&mut self) {
        self.waiting.clear();
    }
}

/// Delays and instruction counts of the replies.
#[derive(Default)]
struct ReplyStats {
    replies: u64,
    late_replies: u64,
    longest_delay: Time,
    longest_rig_delay: Duration,
    /// Instructions: sum over all control steps, and maximum of one step.
    instructions: Option<(u64, u64)>,
    step_time: Option<StepTime>,
}

impl ReplyStats {
    /// `now` is the control instant.
    fn record(&mut self, reply: &Reply, delay: Time, now: Time, period: Time) {
        self.replies += 1;
        self.longest_delay = self.longest_delay.max(delay);
        self.longest_rig_delay = self.longest_rig_delay.max(reply.delay);
        if let Some(count) = reply.instructions {
            let (sum, worst) = self.instructions.unwrap_or_default();
            self.instructions = Some((sum + count, worst.max(count)));
        }
        if let Some(computing) = reply.computing_time {
            let percent = computing.as_secs_f64() / period.seconds() * 100.0;
            self.step_time.get_or_insert_default().record(percent, now.seconds());
        }
    }

    fn record_late(&mut self, delay: Time) {
        self.late_replies += 1;
        self.longest_delay = self.longest_delay.max(delay);
    }

    fn add_to(&self, telemetry: Telemetry) -> Telemetry {
        let has_replies = self.replies > 0;
        Telemetry {
            loop_delay_us: (self.replies + self.late_replies > 0).then(|| self.longest_delay.seconds() * 1e6),
            rig_delay_us: has_replies.then_some(self.longest_rig_delay.as_secs_f64() * 1e6),
            instructions_mean: self.instructions.map(|(sum, _)| sum as f64 / self.replies as f64),
            instructions_worst: self.instructions.map(|(_, worst)| worst as f64),
            step_time: self.step_time,
            ..telemetry
        }
    }
}

impl<'a, L: Link> LockstepLoop<'a, L> {
    fn start(session: &'a mut Session<FaultInjector<L>>, trial: Trial<'a>) -> Self {
        let Trial { scenario, index, continues, .. } = trial;
        set_line_faults(session.link_mut(), scenario, index);
        let chip_faults = chip_fault_plan(scenario, index);
        let needs_words = trial.wire_time || !scenario.faults.is_empty() || !chip_faults.faults.is_empty();
        session.set_transport(if needs_words { Transport::Words } else { transport(scenario, index) });
        let planned = session.link_mut().set_chip_faults(&chip_faults);
        session.link_mut().compare_with_reference(scenario.expects(Metric::ReferenceDifference));
        let mut lockstep = Self::new(session, trial, chip_faults);
        if let Err(error) = planned {
            let error = TargetError::Emulator(error.to_string());
            lockstep.end_on_link_error(RigError::Link(LinkError::Target(Box::new(error))));
            return lockstep;
        }
        let configure = lockstep.configuration();
        let checked = lockstep.controller.check_protocol(lockstep.session, &configure, &lockstep.trial);
        match checked.and_then(|()| lockstep.session.begin_trial(&configure, continues)) {
            Ok(gains) => lockstep.controller.record_configuration(&configure, Some(&gains), Time::ZERO),
            Err(error) => lockstep.end_on_link_error(error),
        }
        lockstep
    }

    fn new(session: &'a mut Session<FaultInjector<L>>, mut trial: Trial<'a>, chip_faults: ChipFaultPlan) -> Self {
        let (scenario, index, tap) = (trial.scenario, trial.index, trial.tap.take());
        Self {
            session,
            plant: PlantSimulation::new(scenario, index, Vec::with_capacity(expected_rows(scenario)), tap),
            controller: ControllerLog::new(scenario, trial.law),
            replies: ReplyStats::default(),
            commands: DelayedCommands::new(scenario, index),
            watchdog: Watchdog::new(&trial),
            chip: ChipState { plan: chip_faults, stop: None },
            next_control: Time::ZERO,
            unanswered: None,
            link_error: None,
            trial,
        }
    }

    /// Returns true at the end of the scenario.
    fn step(&mut self) -> bool {
        let now = self.plant.time();
        let mut flags = Flags::empty();
        if self.may_receive_late_commands() {
            self.receive_late_commands(now);
        }
        if now == self.next_control || self.plant.is_finished() {
            self.count_missed_reply();
        }
        if now == self.next_control && !self.plant.is_finished() {
            self.next_control = now + self.trial.scenario.controller.period;
            if !self.has_ended() {
                self.wait_for_planned_stop(now);
                self.reconfigure(now);
            }
            if !self.has_ended() {
                flags |= self.exchange_sample(now);
            }
            self.apply_amplifier_enable(now);
        }
        while let Some(command) = self.commands.take_due(now) {
            self.plant.actuate(&command);
        }
        let is_lost = self.link_error.as_ref().is_some_and(|error| !is_controller_failure(error));
        let lost = if is_lost { Flags::LINK_LOST } else { Flags::empty() };
        self.plant.push_row(0.0, flags | lost);
        if self.plant.is_finished() {
            return true;
        }
        let next = self.next_event(now);
        if self.may_receive_late_commands() {
            self.plant.advance(next.min(self.plant.next_scheduled_row()), Flags::empty());
        } else {
            self.plant.advance_through(next, lost);
        }
        false
    }

    /// True if the loop asks for a command at every row.
    fn may_receive_late_commands(&self) -> bool {
        !self.has_ended() && (self.unanswered.is_some() || self.controller.missed_replies() > 0)
    }

    fn exchange_sample(&mut self, now: Time) -> Flags {
        let sample = self.plant.sense();
        let max_stall = Duration::from_millis(u64::from(self.watchdog.timeout_ms) / 2);
        let host_stalled = self.trial.own_clock && self.watchdog.last_sample_sent.elapsed() >= max_stall;
        if self.trial.own_clock {
            self.watchdog.last_sample_sent = Instant::now();
        }
        self.controller.record_sample();
        let reply = self.session.send_sample(now.into(), &sample);
        self.record_delivered_sample();
        self.plant.report_counts(0, self.session.rejected_frames());
        let mut flags = Flags::CONTROL;
        match reply {
            // The trial has configured the controller. If it is idle now, it has restarted.
            Ok(Some(reply)) if reply.command.state == Mode::Idle => self.end_on_link_error(RigError::Restarted),
            Ok(Some(reply)) => {
                flags.set(Flags::OVERRUN, host_stalled && reply.command.cause == StateCause::SampleTimeout);
                let rig_delay = Time::from_nanos(reply.delay.as_nanos() as u64);
                let acting = if self.trial.wire_time { rig_delay } else { Time::ZERO };
                let delay = self.commands.draw_delay(now) + acting;
                self.replies.record(&reply, delay, now, self.trial.scenario.controller.period);
                self.schedule_command(now, now + delay, reply.command);
            }
            Ok(None) => {
                // A reply may still arrive before the next control instant.
                self.unanswered = Some((now, self.plant.row_count()));
                self.receive_late_commands(now);
                if self.session.wrong_sequences() > 0 && !self.has_ended() {
                    self.end_on_link_error(RigError::WrongSequence);
                }
            }
            Err(error) => self.end_on_link_error(error),
        }
        flags
    }

    /// A late command acts one loop delay after its reception.
    fn receive_late_commands(&mut self, now: Time) {
        let received = self.session.advance_to(now.into());
        self.record_delivered_sample();
        match received {
            Ok(Some(command)) => {
                let loop_delay = self.commands.draw_delay(now);
                if let Some((sampled, _)) = self.unanswered.take_if(|_| self.session.last_sample_answered()) {
                    self.replies.record_late(now - sampled + loop_delay);
                }
                self.schedule_command(now, now + loop_delay, command);
            }
            Ok(None) => {}
            Err(error) => self.end_on_link_error(error),
        }
    }

    fn schedule_command(&mut self, now: Time, at: Time, command: Command) {
        self.controller.record_command(&command, self.session.newer_messages(), now);
        self.commands.push(at, command);
    }

    fn count_missed_reply(&mut self) {
        let Some((sampled, row)) = self.unanswered.take() else { return };
        self.plant.report_counts(1, self.session.rejected_frames());
        if self.follows_chip_fault(sampled + self.trial.scenario.controller.period) {
            self.controller.record_missed_reply();
            let is_silent = u64::from(self.controller.missed_replies()) >= WATCHDOG_PERIODS;
            // The firmware has no signal that disables the amplifier, so the bench applies 0 V.
            if is_silent && !self.has_ended() && self.amplifier_enabled().is_none() {
                self.end_on_link_error(self.session.no_answer("command"));
            }
            return;
        }
        self.plant.add_flags(row, Flags::LINK_LOST);
        // A planned fault causes this silence, so it does not count towards a lost controller.
        if self.trial.scenario.explains_silence(sampled) {
            return;
        }
        self.controller.record_missed_reply();
        if self.controller.missed_replies() >= MAX_MISSED_REPLIES && !self.has_ended() {
            self.end_on_link_error(self.session.no_answer("command"));
        }
    }

    /// Configures the controller again after a fault that stopped it, as an operator would.
    fn reconfigure(&mut self, now: Time) {
        let Some(configure) = self.controller.reconfiguration(now) else { return };
        let configure = self.with_watchdog(configure);
        match self.session.reconfigure(now.into(), &configure) {
            Ok(gains) => self.controller.record_configuration(&configure, Some(&gains), now),
            Err(error) => self.end_on_link_error(error),
        }
    }

    /// Waits in wall time until the watchdog has stopped the controller. Plate time stands still.
    fn wait_for_planned_stop(&mut self, now: Time) {
        if self.watchdog.planned_stops.pop_if(|stop| *stop <= now).is_some() && !self.controller.is_stopped() {
            let timeout = Duration::from_millis(self.watchdog.timeout_ms.into()) + WATCHDOG_MARGIN;
            self.trial.cancel.sleep(timeout.saturating_sub(self.watchdog.last_sample_sent.elapsed()));
            self.receive_late_commands(now);
            // This wait must not count as a stall of the host.
            self.watchdog.last_sample_sent = Instant::now();
        }
    }

    fn record_delivered_sample(&mut self) {
        if let Some(sample) = self.session.link().delivered_sample() {
            self.plant.set_delivered_sample(sample);
        }
    }

    /// Plays the rest of the trial at 0 V. After a planned fault of the chip, the error counts as a
    /// stop, unless the emulator itself failed.
    fn end_on_link_error(&mut self, error: RigError) {
        self.commands.clear();
        self.plant.stop_drive();
        let is_emulator = matches!(&error, RigError::Link(LinkError::Target(target))
            if matches!(**target, TargetError::Emulator(_)));
        if self.follows_chip_fault(self.plant.time() + self.trial.scenario.controller.period) && !is_emulator {
            self.chip.stop = Some(error);
        } else {
            self.link_error = Some(error);
        }
    }

    /// Applies 0 V if the firmware holds PB0 (amplifier enable) low after a fault of the chip.
    fn apply_amplifier_enable(&mut self, now: Time) {
        if self.follows_chip_fault(now) && self.amplifier_enabled() == Some(false) {
            self.commands.clear();
            self.plant.stop_drive();
        }
    }

    fn amplifier_enabled(&mut self) -> Option<bool> {
        self.session.link_mut().chip()?.amplifier_enabled()
    }

    fn follows_chip_fault(&self, time: Time) -> bool {
        self.chip.plan.faults.first().is_some_and(|fault| fault.at <= Duration::from(time))
    }

    fn has_ended(&self) -> bool {
        self.link_error.is_some() || self.chip.stop.is_some()
    }

    /// Restarts the emulated board, because the request for 0 V needs a board that answers.
    fn restart_after_chip_faults(&mut self) -> Result<(), RigError> {
        let link = self.session.link_mut();
        if !self.chip.plan.faults.is_empty() && link.set_chip_faults(&ChipFaultPlan::default()).is_ok() {
            link.restart()?;
        }
        Ok(())
    }

    fn next_event(&self, now: Time) -> Time {
        let mut next = self.trial.scenario.duration;
        if self.next_control > now {
            next = next.min(self.next_control);
        }
        if let Some(actuation) = self.commands.next_due() {
            next = next.min(actuation);
        }
        let due = self.session.link().next_due().map(|due| Time::from_nanos(due.as_nanos() as u64));
        match due {
            Some(delivery) if delivery > now && !self.has_ended() => next.min(delivery),
            _ => next,
        }
    }

    fn configuration(&self) -> Configure {
        self.with_watchdog(self.controller.configuration())
    }

    fn with_watchdog(&self, configure: Configure) -> Configure {
        Configure { watchdog_timeout_ms: self.watchdog.timeout_ms, ..configure }
    }

    fn finish(mut self) -> TrialResult {
        let now = self.plant.time();
        // The safe state at the end of the trial disables the amplifier, too.
        let enable_pin = self.session.link_mut().chip().map(|chip| chip.enable_pin());
        let is_restarted = !self.chip.plan.faults.is_empty();
        let before_restart = is_restarted.then(|| self.controller.chip_telemetry(self.session));
        if let Err(error) = self.restart_after_chip_faults() {
            self.link_error.get_or_insert(error);
        }
        if self.link_error.is_none()
            && let Some(Err(error)) = self.session.link_mut().chip().map(Chip::check_transport)
        {
            self.end_on_link_error(error.into());
        }
        let safe_confirmed = self.link_error.is_none() && self.session.request_safe_state();
        if safe_confirmed {
            let sample = self.plant.sense();
            self.controller.watch_after_safe(self.session, now, sample);
        } else if self.session.has_driven_after_safe() {
            self.controller.observe_safe_state(self.session, now);
        } else if self.link_error.is_none() {
            self.link_error = self.session.end_before_safe();
        }
        self.controller.record_session(self.session, now);
        let mut telemetry = Telemetry {
            not_finite: self.plant.not_finite(),
            watchdog_timeout_ms: self.trial.own_clock.then_some(self.watchdog.timeout_ms),
            enable_pin,
            ..self.controller.telemetry(self.session, self.link_error.as_ref(), before_restart)
        };
        if let Some(error) = &self.chip.stop {
            telemetry.stopped.get_or_insert(error.to_string());
        }
        for fault in &self.chip.plan.faults {
            *telemetry.faults.entry(fault.kind.name().to_owned()).or_default() += 1;
        }
        TrialResult {
            telemetry: self.replies.add_to(telemetry),
            trace_rows: self.plant.into_rows(),
            link_error: self.link_error,
            safe_confirmed,
        }
    }
}
