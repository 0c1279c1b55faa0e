//! Plays one trial in lockstep: plate time stands still while a sample travels, the controller
//! computes and the command returns. At one instant the order is sample, actuation, row.

use crate::controller_log::{ControllerLog, MAX_MISSED_REPLIES, is_controller_failure};
use crate::fault::{WATCHDOG_PERIODS, chip_fault_plan, planned_stops, wire_faults};
use crate::live_tap::TapWriter;
use crate::loop_delay::LoopDelay;
use crate::plant_simulation::{PlantSimulation, expected_rows};
use crate::reply_stats::ReplyStats;
use platebench_model::record::Telemetry;
use platebench_model::scenario::{Metric, Scenario};
use platebench_model::trace::{Flags, Row};
use platebench_plate::Time;
use platebench_rig::target_error::TargetError;
use platebench_rig::{CancelToken, ChipFaultPlan, FaultInjector, HostedLink, Link, LinkError, RigError, Session};
use platebench_wire::{Command, Configure, ControllerState as Mode, LawId, StateCause};
use std::collections::VecDeque;
use std::thread;
use std::time::{Duration, Instant};

/// Watchdog time-out of a controller with its own clock. The bench sets the pace, so the time-out
/// is longer than a stall of the host.
pub(crate) const OWN_CLOCK_WATCHDOG_TIMEOUT_MS: u16 = 10_000;
/// Watchdog time-out if a planned silence must trigger the watchdog. It is shorter, because the
/// bench waits for it in wall time.
const SILENCE_WATCHDOG_TIMEOUT_MS: u16 = 1_000;
const WATCHDOG_MARGIN: Duration = Duration::from_millis(100);

#[derive(Debug, Clone, Copy)]
pub struct TrialSpec<'a> {
    pub scenario: &'a Scenario,
    pub law: LawId,
    pub index: u32,
    pub wire_time: bool,
    /// True if the controller's clock runs while the plate waits.
    pub own_clock: bool,
    /// True if the target continues after the trial before it without a restart.
    pub continues: bool,
}

impl<'a> TrialSpec<'a> {
    pub const fn new(scenario: &'a Scenario, law: LawId, index: u32) -> Self {
        Self { scenario, law, index, wire_time: false, own_clock: false, continues: false }
    }
}

#[derive(Debug)]
pub struct TrialResult {
    pub trace_rows: Vec<Row>,
    pub telemetry: Telemetry,
    /// Error that ended the exchange with the controller. The rest of the trial has 0 V.
    pub link_error: Option<RigError>,
    /// True if the controller confirmed 0 V at the end of the trial.
    pub safe_confirmed: bool,
}

/// `None` if the trial was cancelled.
pub fn play<L: Link>(
    session: &mut Session<FaultInjector<L>>,
    spec: &TrialSpec<'_>,
    cancel: &CancelToken,
    tap: Option<&mut TapWriter>,
) -> Option<TrialResult> {
    let mut trial = Trial::start(session, spec, tap);
    while !trial.step() {
        if cancel.is_cancelled() {
            trial.session.request_safe_state();
            return None;
        }
    }
    Some(trial.finish())
}

/// Fails if the hosted firmware does not answer before the trial.
pub fn play_hosted(scenario: &Scenario, law: LawId, index: u32) -> Result<TrialResult, RigError> {
    let mut session = Session::open(FaultInjector::new(HostedLink::new()))?;
    let spec = TrialSpec::new(scenario, law, index);
    let mut trial = Trial::start(&mut session, &spec, None);
    while !trial.step() {}
    Ok(trial.finish())
}

struct PendingActuation {
    at: Time,
    command: Command,
}

struct Trial<'a, L: Link> {
    session: &'a mut Session<FaultInjector<L>>,
    scenario: &'a Scenario,
    chip_faults: ChipFaultPlan,
    wire_time: bool,
    own_clock: bool,
    controller: ControllerLog<'a>,
    replies: ReplyStats,
    loop_delay: LoopDelay,
    plant: PlantSimulation<'a, Vec<Row>>,
    next_control: Time,
    pending: VecDeque<PendingActuation>,
    /// Control instant and row index of the last sample, if this sample has no reply yet.
    unanswered: Option<(Time, usize)>,
    last_sample_sent: Instant,
    watchdog_timeout_ms: u16,
    planned_stops: Vec<Time>,
    link_error: Option<RigError>,
    /// Error that a planned fault of the chip caused. The rest of the trial has 0 V.
    chip_stop: Option<RigError>,
}

impl<'a, L: Link> Trial<'a, L> {
    fn start(session: &'a mut Session<FaultInjector<L>>, spec: &TrialSpec<'a>, tap: Option<&'a mut TapWriter>) -> Self {
        session.link_mut().set_faults(&wire_faults(spec.scenario, spec.index));
        let chip_faults = chip_fault_plan(spec.scenario, spec.index);
        let planned = session.link_mut().set_chip_faults(&chip_faults);
        let is_compared = spec.scenario.expects(Metric::ReferenceDifference);
        session.link_mut().compare_with_reference(is_compared);
        let mut trial = Self { chip_faults, ..Self::new(session, spec, tap) };
        if let Err(error) = planned {
            let error = TargetError::Emulator(error.to_string());
            trial.end_on_link_error(RigError::Link(LinkError::Target(Box::new(error))));
            return trial;
        }
        let configure = trial.configuration();
        if let Err(error) = trial.controller.check_protocol(trial.session, &configure, spec.own_clock, spec.index) {
            trial.end_on_link_error(error);
            return trial;
        }
        match trial.session.begin_trial(&configure, spec.continues) {
            Ok(gains) => trial.controller.record_configuration(&configure, Some(&gains), Time::ZERO),
            Err(error) => trial.end_on_link_error(error),
        }
        trial
    }

    fn new(session: &'a mut Session<FaultInjector<L>>, spec: &TrialSpec<'a>, tap: Option<&'a mut TapWriter>) -> Self {
        let TrialSpec { scenario, index, law, .. } = *spec;
        let planned_stops = if spec.own_clock { planned_stops(scenario) } else { Vec::new() };
        let watchdog_timeout_ms = match (spec.own_clock, planned_stops.is_empty()) {
            (false, _) => 0,
            (true, true) => OWN_CLOCK_WATCHDOG_TIMEOUT_MS,
            (true, false) => SILENCE_WATCHDOG_TIMEOUT_MS,
        };
        Self {
            session,
            scenario,
            chip_faults: ChipFaultPlan::default(),
            wire_time: spec.wire_time,
            own_clock: spec.own_clock,
            controller: ControllerLog::new(scenario, law),
            replies: ReplyStats::default(),
            loop_delay: LoopDelay::new(scenario, index),
            plant: PlantSimulation::new(scenario, index, Vec::with_capacity(expected_rows(scenario)), tap),
            next_control: Time::ZERO,
            pending: VecDeque::new(),
            unanswered: None,
            last_sample_sent: Instant::now(),
            watchdog_timeout_ms,
            planned_stops,
            link_error: None,
            chip_stop: None,
        }
    }

    /// Returns true at the end of the scenario.
    fn step(&mut self) -> bool {
        let now = self.plant.time();
        let mut flags = Flags::empty();
        if !self.has_ended() && (self.unanswered.is_some() || self.controller.missed_replies() > 0) {
            self.receive_late_commands(now);
        }
        if now == self.next_control || self.plant.is_finished() {
            self.count_missed_reply();
        }
        if now == self.next_control && !self.plant.is_finished() {
            self.next_control = now + self.scenario.controller.period;
            if !self.has_ended() {
                self.wait_for_planned_stop(now);
                self.reconfigure(now);
            }
            if !self.has_ended() {
                flags |= self.exchange_sample(now);
            }
            self.apply_amplifier_enable(now);
        }
        while self.pending.front().is_some_and(|pending| pending.at <= now) {
            if let Some(PendingActuation { command, .. }) = self.pending.pop_front() {
                self.plant.actuate(&command);
            }
        }
        if self.link_error.as_ref().is_some_and(|error| !is_controller_failure(error)) {
            flags |= Flags::LINK_LOST;
        }
        self.plant.push_row(0.0, flags);
        if self.plant.is_finished() {
            return true;
        }
        self.plant.advance(self.next_event(now));
        false
    }

    fn exchange_sample(&mut self, now: Time) -> Flags {
        let sample = self.plant.sense();
        let max_stall = Duration::from_millis(u64::from(self.watchdog_timeout_ms) / 2);
        let host_stalled = self.own_clock && self.last_sample_sent.elapsed() >= max_stall;
        if self.own_clock {
            self.last_sample_sent = Instant::now();
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
                let acting = if self.wire_time { rig_delay } else { Time::ZERO };
                let delay = self.loop_delay.draw() + acting;
                self.replies.record(&reply, delay, now, self.scenario.controller.period);
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
                let loop_delay = self.loop_delay.draw();
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
        // A command never overtakes an earlier one.
        let at = self.pending.back().map_or(at, |last| last.at.max(at));
        self.pending.push_back(PendingActuation { at, command });
    }

    fn count_missed_reply(&mut self) {
        let Some((sampled, row)) = self.unanswered.take() else { return };
        self.plant.report_counts(1, self.session.rejected_frames());
        if self.follows_chip_fault(sampled + self.scenario.controller.period) {
            self.controller.record_missed_reply();
            let is_silent = u64::from(self.controller.missed_replies()) >= WATCHDOG_PERIODS;
            // The firmware has no signal that disables the amplifier, so the bench applies 0 V.
            if is_silent && !self.has_ended() && self.session.link_mut().amplifier_enabled().is_none() {
                self.end_on_link_error(RigError::NoAnswer { expected: "command" });
            }
            return;
        }
        self.plant.add_flags(row, Flags::LINK_LOST);
        // A planned fault causes this silence, so it does not count towards a lost controller.
        if self.scenario.explains_silence(sampled) {
            return;
        }
        self.controller.record_missed_reply();
        if self.controller.missed_replies() >= MAX_MISSED_REPLIES && !self.has_ended() {
            self.end_on_link_error(RigError::NoAnswer { expected: "command" });
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
        if self.planned_stops.pop_if(|stop| *stop <= now).is_some() && !self.controller.is_stopped() {
            let timeout = Duration::from_millis(self.watchdog_timeout_ms.into()) + WATCHDOG_MARGIN;
            thread::sleep(timeout.saturating_sub(self.last_sample_sent.elapsed()));
            self.receive_late_commands(now);
            // This wait must not count as a stall of the host.
            self.last_sample_sent = Instant::now();
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
        self.pending.clear();
        self.plant.stop_drive();
        let is_emulator = matches!(&error, RigError::Link(LinkError::Target(target))
            if matches!(**target, TargetError::Emulator(_)));
        if self.follows_chip_fault(self.plant.time() + self.scenario.controller.period) && !is_emulator {
            self.chip_stop = Some(error);
        } else {
            self.link_error = Some(error);
        }
    }

    /// Applies 0 V if the firmware holds PB0 (amplifier enable) low after a fault of the chip.
    fn apply_amplifier_enable(&mut self, now: Time) {
        if self.follows_chip_fault(now) && self.session.link_mut().amplifier_enabled() == Some(false) {
            self.pending.clear();
            self.plant.stop_drive();
        }
    }

    fn follows_chip_fault(&self, time: Time) -> bool {
        self.chip_faults.faults.first().is_some_and(|fault| fault.at <= Duration::from(time))
    }

    fn has_ended(&self) -> bool {
        self.link_error.is_some() || self.chip_stop.is_some()
    }

    /// Restarts the emulated board, because the request for 0 V needs a board that answers.
    fn restart_after_chip_faults(&mut self) -> Result<(), RigError> {
        let link = self.session.link_mut();
        if !self.chip_faults.faults.is_empty() && link.set_chip_faults(&ChipFaultPlan::default()).is_ok() {
            link.restart()?;
        }
        Ok(())
    }

    fn next_event(&self, now: Time) -> Time {
        let actuation = self.pending.front().map(|pending| pending.at);
        let control = Some(self.next_control).filter(|control| *control > now);
        let due = self.session.link().next_due().map(|due| Time::from_nanos(due.as_nanos() as u64));
        let delivery = due.filter(|due| *due > now && !self.has_ended());
        actuation.into_iter().chain(control).chain(delivery).fold(self.plant.next_scheduled_row(), Time::min)
    }

    fn configuration(&self) -> Configure {
        self.with_watchdog(self.controller.configuration())
    }

    fn with_watchdog(&self, configure: Configure) -> Configure {
        Configure { watchdog_timeout_ms: self.watchdog_timeout_ms, ..configure }
    }

    fn finish(mut self) -> TrialResult {
        let now = self.plant.time();
        if let Err(error) = self.restart_after_chip_faults() {
            self.link_error.get_or_insert(error);
        }
        let safe_confirmed = self.link_error.is_none() && self.session.request_safe_state();
        if safe_confirmed {
            let sample = self.plant.sense();
            self.controller.watch_after_safe(self.session, now, sample);
        } else if self.link_error.is_none() {
            self.link_error = self.session.end_before_safe();
        }
        self.controller.record_session(self.session, now);
        let mut telemetry = Telemetry {
            not_finite: self.plant.not_finite(),
            watchdog_timeout_ms: self.own_clock.then_some(self.watchdog_timeout_ms),
            ..self.controller.telemetry(self.session, self.link_error.as_ref())
        };
        if let Some(error) = &self.chip_stop {
            telemetry.stopped.get_or_insert(error.to_string());
        }
        for fault in &self.chip_faults.faults {
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
