//! One trial in lockstep: the plate waits while a sample travels, the controller computes and the command returns.
//!
//! Events, in this order where they fall together: control instant, actuation, row.

use crate::configure::configure;
use crate::stage::{Stage, expected_rows};
use platebench_plate::Time;
use platebench_rig::{Link, LinkError, Reply, RigError, Session};
use platebench_scenario::Scenario;
use platebench_trace::{Flags, Row};
use platebench_verdict::Telemetry;
use platebench_wire::{Command, Configure, LawId};
use std::collections::VecDeque;
use std::time::Duration;

/// After this many samples without an answer the controller is taken to be gone.
const MISSES_UNTIL_LOST: u32 = 5;

/// A controller with a clock of its own gets its samples whenever the bench comes to it; after this long without one the bench is gone.
const OWN_CLOCK_PATIENCE_MS: u16 = 1_000;

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
pub fn play<L: Link>(session: &mut Session<L>, order: &Order<'_>, patience: &impl Patience) -> Option<Played> {
    let mut trial = Trial::new(session, order);
    let patience_ms = if order.own_clock { OWN_CLOCK_PATIENCE_MS } else { 0 };
    let configure = Configure { patience_ms, ..configure(order.scenario, order.law) };
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
    Some(Played {
        telemetry: Telemetry { ended, ..trial.observed.telemetry() },
        rows: trial.stage.into_rows(),
        lost: trial.lost,
    })
}

/// What the rig tells with each answer.
#[derive(Debug, Default)]
struct Observed {
    longest_delay: Time,
    longest_rig_delay: Duration,
    answers: u64,
    instructions: Option<(u64, u64)>,
}

impl Observed {
    fn take(&mut self, reply: &Reply, delay: Time) {
        self.answers += 1;
        self.longest_delay = self.longest_delay.max(delay);
        self.longest_rig_delay = self.longest_rig_delay.max(reply.delay);
        if let Some(count) = reply.instructions {
            let (sum, worst) = self.instructions.unwrap_or_default();
            self.instructions = Some((sum + count, worst.max(count)));
        }
    }

    fn telemetry(&self) -> Telemetry {
        if self.answers == 0 {
            return Telemetry::default();
        }
        Telemetry {
            loop_delay_us: Some(self.longest_delay.seconds() * 1e6),
            rig_delay_us: Some(self.longest_rig_delay.as_secs_f64() * 1e6),
            instructions_mean: self.instructions.map(|(sum, _)| sum as f64 / self.answers as f64),
            instructions_worst: self.instructions.map(|(_, worst)| worst as f64),
            ..Telemetry::default()
        }
    }
}

/// An actuation on its way to the plate.
struct Pending {
    at: Time,
    command: Command,
}

struct Trial<'a, L: Link> {
    session: &'a mut Session<L>,
    scenario: &'a Scenario,
    wire_time: bool,
    stage: Stage<'a, Vec<Row>>,
    observed: Observed,
    next_control: Time,
    /// In order of their instants.
    pending: VecDeque<Pending>,
    misses: u32,
    lost: Option<RigError>,
}

impl<'a, L: Link> Trial<'a, L> {
    fn new(session: &'a mut Session<L>, order: &Order<'a>) -> Self {
        let Order { scenario, index, .. } = *order;
        Self {
            session,
            scenario,
            wire_time: order.wire_time,
            stage: Stage::new(scenario, index, Vec::with_capacity(expected_rows(scenario))),
            observed: Observed::default(),
            next_control: Time::ZERO,
            pending: VecDeque::new(),
            misses: 0,
            lost: None,
        }
    }

    /// Everything that happens at this instant, and the way to the next one. True at the end of the scenario.
    fn step(&mut self) -> bool {
        let now = self.stage.time();
        let mut flags = Flags::empty();
        if now == self.next_control && !self.stage.is_over() {
            self.next_control = now + self.scenario.controller.period;
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
        match self.session.sample(Duration::from_nanos(now.as_nanos()), &sample) {
            Ok(Some(reply)) => {
                self.misses = 0;
                let rig_delay = Time::from_nanos(reply.delay.as_nanos() as u64);
                let acting = if self.wire_time { rig_delay } else { Time::ZERO };
                let delay = self.scenario.controller.loop_delay + acting;
                self.observed.take(&reply, delay);
                let at = now + delay;
                // A controller that answers faster than before does not overtake itself.
                let at = self.pending.back().map_or(at, |last| last.at.max(at));
                self.pending.push_back(Pending { at, command: reply.command });
                Flags::CONTROL
            }
            Ok(None) => {
                self.misses += 1;
                if self.misses >= MISSES_UNTIL_LOST {
                    self.lose(RigError::NoAnswer { expected: "command" });
                }
                Flags::CONTROL | Flags::LINK_LOST
            }
            Err(error) => {
                self.lose(error);
                Flags::CONTROL
            }
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
        actuation.into_iter().chain(control).fold(self.stage.next_fixed(), Time::min)
    }
}

/// True where the controller itself came to grief, which fails a trial; a line that went dead only leaves it undecided.
pub(crate) fn is_the_controllers_doing(error: &RigError) -> bool {
    match error {
        RigError::Trapped(_) | RigError::Link(LinkError::Target(_)) => true,
        RigError::Link(LinkError::Disconnected(_))
        | RigError::NoAnswer { .. }
        | RigError::NotLive
        | RigError::Refused(_) => false,
    }
}
