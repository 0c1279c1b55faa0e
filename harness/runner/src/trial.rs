//! One trial in lockstep: the plate waits while a sample travels, the controller computes and the command returns.
//!
//! Events, in this order where they fall together: control instant, actuation, row.

use crate::configure::configure;
use crate::fault::{reconfigures, wire_faults};
use crate::observed::{Observed, stop_reason};
use crate::stage::{Stage, expected_rows};
use crate::watch::Tap;
use platebench_plate::Time;
use platebench_rig::{Faulty, Link, LinkError, RigError, Session};
use platebench_scenario::Scenario;
use platebench_trace::{Flags, Row};
use platebench_verdict::Telemetry;
use platebench_wire::{Command, Configure, LawId, State as Mode, StateCause};
use std::collections::VecDeque;
use std::time::{Duration, Instant};

/// After this many periods without any answer the controller is taken to be gone: time for its own time-out, which takes five, and for more than one repeat.
const MISSES_UNTIL_LOST: u32 = 20;
/// A controller with a clock of its own gets its samples whenever the bench comes to it; after this long without one the bench is gone.
const OWN_CLOCK_PATIENCE_MS: u16 = 1_000;
/// A controller that stopped for want of a sample was left alone by the bench where that was away for so much of its patience.
const AWAY: Duration = Duration::from_millis(OWN_CLOCK_PATIENCE_MS as u64 / 2);

/// What is to be played.
#[derive(Debug, Clone, Copy)]
pub struct Order<'a> {
    /// The scenario.
    pub scenario: &'a Scenario,
    /// The law that it asks for.
    pub law: LawId,
    /// Number of the trial, counted from 0.
    pub index: u32,
    /// True where the time that the rig takes acts on the plate as loop delay.
    pub wire_time: bool,
    /// True where the controller's clock does not wait while the plate does.
    pub own_clock: bool,
}

/// How a trial came to its end.
#[derive(Debug)]
pub struct Played {
    /// Everything that happened.
    pub rows: Vec<Row>,
    /// What the rig told beside it.
    pub telemetry: Telemetry,
    /// Why the controller was no longer there, if it was not; the plate then rests at 0 V.
    pub lost: Option<RigError>,
}

/// Asked between events; a trial that should not go on is given up.
pub trait Patience {
    /// True where the trial is to be given up.
    fn is_over(&self) -> bool;
}

/// Plays a trial. `None` where it was given up.
pub fn play<L: Link>(session: &mut Session<Faulty<L>>, order: &Order<'_>, patience: &impl Patience) -> Option<Played> {
    play_watched(session, order, patience, None)
}

/// As [`play`], while somebody may look on.
pub fn play_watched<L: Link>(
    session: &mut Session<Faulty<L>>,
    order: &Order<'_>,
    patience: &impl Patience,
    tap: Option<&mut Tap>,
) -> Option<Played> {
    session.link_mut().arm(&wire_faults(order.scenario, order.index));
    let mut trial = Trial::new(session, order, tap);
    let configure = trial.configure();
    if let Err(error) = trial.session.begin(&configure) {
        trial.lose(error);
    }
    while !trial.step() {
        if patience.is_over() {
            trial.session.safe();
            return None;
        }
    }
    let ended = trial.lost.as_ref().map(ToString::to_string);
    let faults = trial.session.link().counts().map(|(kind, count)| (kind.to_owned(), count)).collect();
    let not_finite = trial.stage.not_finite();
    let contradictions = trial.session.contradictions();
    let patience_ms = order.own_clock.then_some(OWN_CLOCK_PATIENCE_MS);
    let told = trial.observed.telemetry();
    let telemetry = Telemetry { ended, faults, not_finite, contradictions, patience_ms, ..told };
    Some(Played { telemetry, rows: trial.stage.into_rows(), lost: trial.lost })
}

/// An actuation on its way to the plate.
struct Pending {
    at: Time,
    command: Command,
}

struct Trial<'a, L: Link> {
    session: &'a mut Session<Faulty<L>>,
    scenario: &'a Scenario,
    law: LawId,
    wire_time: bool,
    own_clock: bool,
    observed: Observed,
    stage: Stage<'a, Vec<Row>>,
    next_control: Time,
    /// In order of their instants.
    pending: VecDeque<Pending>,
    /// Control instants in a row that no answer came to.
    misses: u32,
    /// The last control instant and its row, while its sample has no answer.
    unanswered: Option<(Time, usize)>,
    /// When the controller said that it does not run, while it does not.
    stopped: Option<Time>,
    /// When the last sample left, on the wall.
    turned: Instant,
    lost: Option<RigError>,
}

impl<'a, L: Link> Trial<'a, L> {
    fn new(session: &'a mut Session<Faulty<L>>, order: &Order<'a>, tap: Option<&'a mut Tap>) -> Self {
        let Order { scenario, index, law, .. } = *order;
        Self {
            session,
            scenario,
            law,
            wire_time: order.wire_time,
            own_clock: order.own_clock,
            observed: Observed::default(),
            stage: Stage::new(scenario, index, Vec::with_capacity(expected_rows(scenario)), tap),
            next_control: Time::ZERO,
            pending: VecDeque::new(),
            misses: 0,
            unanswered: None,
            stopped: None,
            turned: Instant::now(),
            lost: None,
        }
    }

    /// Everything that happens at this instant, and the way to the next one. True at the end of the scenario.
    fn step(&mut self) -> bool {
        let now = self.stage.time();
        let mut flags = Flags::empty();
        if self.lost.is_none() && (self.unanswered.is_some() || self.misses > 0) {
            self.listen(now);
        }
        if now == self.next_control || self.stage.is_over() {
            self.note_miss();
        }
        if now == self.next_control && !self.stage.is_over() {
            self.next_control = now + self.scenario.controller.period;
            if self.lost.is_none() {
                self.reconfigure(now);
            }
            if self.lost.is_none() {
                flags |= self.control(now);
            }
        }
        while self.pending.front().is_some_and(|pending| pending.at <= now) {
            if let Some(Pending { command, .. }) = self.pending.pop_front() {
                self.stage.actuate(&command);
            }
        }
        if self.lost.as_ref().is_some_and(|error| !is_the_controllers_doing(error)) {
            flags |= Flags::LINK_LOST;
        }
        self.stage.push_row(0.0, flags);
        if self.stage.is_over() {
            return true;
        }
        self.stage.advance(self.next_event(now));
        false
    }

    fn control(&mut self, now: Time) -> Flags {
        let sample = self.stage.sense();
        // From sample to sample, as the controller counts.
        let was_away = self.own_clock && self.turned.elapsed() >= AWAY;
        self.turned = Instant::now();
        let answer = self.session.sample(duration(now), &sample);
        self.note_given();
        self.stage.tell(0, self.session.refused());
        let mut flags = Flags::CONTROL;
        match answer {
            // Idle after its configuration: it has forgotten it.
            Ok(Some(reply)) if reply.command.state == Mode::Idle => self.lose(RigError::Restarted),
            Ok(Some(reply)) => {
                // A computer that stood still for a while leaves a controller that did as it was told.
                flags.set(Flags::OVERRUN, was_away && reply.command.cause == StateCause::SampleTimeout);
                self.misses = 0;
                let rig_delay = Time::from_nanos(reply.delay.as_nanos() as u64);
                let acting = if self.wire_time { rig_delay } else { Time::ZERO };
                let delay = self.scenario.controller.loop_delay + acting;
                self.observed.take(&reply, delay);
                self.take(now, now + delay, reply.command);
            }
            Ok(None) => {
                // It may still come before the next control instant; the row of this one is not there yet.
                self.unanswered = Some((now, self.stage.rows_so_far()));
                self.listen(now);
            }
            Err(error) => self.lose(error),
        }
        flags
    }

    /// What the controller says late or of its own accord acts from when it is heard.
    fn listen(&mut self, now: Time) {
        let said = self.session.pass(duration(now));
        self.note_given();
        match said {
            Ok(Some(command)) => {
                self.misses = 0;
                let loop_delay = self.scenario.controller.loop_delay;
                if let Some((sampled, _)) = self.unanswered.take_if(|_| self.session.is_answered()) {
                    self.observed.late_answers += 1;
                    self.observed.longest_delay = self.observed.longest_delay.max(now - sampled + loop_delay);
                }
                self.take(now, now + loop_delay, command);
            }
            Ok(None) => {}
            Err(error) => self.lose(error),
        }
    }

    /// A command that was heard `now` and acts on the plate from `at` on.
    fn take(&mut self, now: Time, at: Time, command: Command) {
        if command.state == Mode::Running {
            self.stopped = None;
        } else {
            self.stopped.get_or_insert(now);
            self.observed.stopped.get_or_insert_with(|| stop_reason(command.cause).to_owned());
        }
        // A controller that answers faster than before does not overtake itself.
        let at = self.pending.back().map_or(at, |last| last.at.max(at));
        self.pending.push_back(Pending { at, command });
    }

    /// The last control instant has had its time for an answer.
    fn note_miss(&mut self) {
        let Some((sampled, index)) = self.unanswered.take() else { return };
        self.stage.flag(index, Flags::LINK_LOST);
        self.stage.tell(1, self.session.refused());
        // A line that is planned to come back is waited for.
        if self.scenario.explains(sampled) {
            return;
        }
        self.misses += 1;
        if self.misses >= MISSES_UNTIL_LOST && self.lost.is_none() {
            self.lose(RigError::NoAnswer { expected: "command" });
        }
    }

    /// What a line operator does once a fault is over that stopped the controller.
    fn reconfigure(&mut self, now: Time) {
        if !self.stopped.is_some_and(|stopped| reconfigures(self.scenario, stopped, now)) {
            return;
        }
        let configure = self.configure();
        match self.session.configure(duration(now), &configure) {
            Ok(_) => self.stopped = None,
            Err(error) => self.lose(error),
        }
    }

    /// The trace tells what the controller was given, which faults may have changed.
    fn note_given(&mut self) {
        if let Some(given) = self.session.link().given() {
            self.stage.given(given);
        }
    }

    /// The controller is gone: what is left of the trial is played at 0 V.
    fn lose(&mut self, error: RigError) {
        self.pending.clear();
        self.stage.rest();
        self.lost = Some(error);
    }

    fn next_event(&self, now: Time) -> Time {
        let actuation = self.pending.front().map(|pending| pending.at);
        let control = Some(self.next_control).filter(|control| *control > now);
        let due = self.session.link().due().map(|due| Time::from_nanos(due.as_nanos() as u64));
        let held = due.filter(|due| *due > now && self.lost.is_none());
        actuation.into_iter().chain(control).chain(held).fold(self.stage.next_fixed(), Time::min)
    }

    /// What the controller is told before the trial, and again where it is configured anew.
    fn configure(&self) -> Configure {
        let patience_ms = if self.own_clock { OWN_CLOCK_PATIENCE_MS } else { 0 };
        Configure { patience_ms, ..configure(self.scenario, self.law) }
    }
}

/// True where the controller itself came to grief, which fails a trial; a line that went dead only leaves it undecided.
pub(crate) fn is_the_controllers_doing(error: &RigError) -> bool {
    match error {
        RigError::Trapped(_) | RigError::Link(LinkError::Target(_)) => true,
        RigError::Link(LinkError::Disconnected(_))
        | RigError::NoAnswer { .. }
        | RigError::Refused(_)
        | RigError::Restarted
        | RigError::NotLive => false,
    }
}

fn duration(time: Time) -> Duration {
    Duration::from_nanos(time.as_nanos())
}
