//! One trial in lockstep: the plate waits while a sample travels, the controller computes and the command returns.
//!
//! Events, in this order where they fall together: control instant, actuation, row. Between events nothing changes, so that nothing is smeared over a
//! step; where a profile varies the plant cuts the interval itself.

use crate::configure::{configure, start_frequency_mhz};
use platebench_plate::plant::Signal;
use platebench_plate::{Crossing, Drive, Plant, Sensor, State, Time, Watch};
use platebench_rig::{Link, LinkError, Reply, RigError, Session};
use platebench_scenario::{Metric, Scenario};
use platebench_trace::{Flags, Row};
use platebench_verdict::Telemetry;
use platebench_wire::{Command, LawId, Sample, State as Mode};
use std::collections::VecDeque;
use std::f64::consts::TAU;
use std::time::Duration;

/// After this many samples without an answer the controller is taken to be gone.
const MISSES_UNTIL_LOST: u32 = 5;
/// The amplifier counts as saturated from here on, as a fraction of its limit: the wire carries the limit as f32.
const SATURATED_FROM: f64 = 1.0 - 1e-6;

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
    if let Err(error) = trial.session.begin(&configure(order.scenario, order.law)) {
        trial.lose(error);
    }
    while !trial.step() {
        if patience.is_over() {
            trial.session.safe();
            return None;
        }
    }
    let ended = trial.lost.as_ref().map(ToString::to_string);
    Some(Played { telemetry: Telemetry { ended, ..trial.observed.telemetry() }, rows: trial.rows, lost: trial.lost })
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
            ended: None,
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
    observed: Observed,
    plant: Plant,
    sensor: Sensor,
    rows: Vec<Row>,
    crossings: Vec<Crossing>,
    next_control: Time,
    /// In order of their instants.
    pending: VecDeque<Pending>,
    frequency_hz: f64,
    sensed: [f64; 2],
    misses: u32,
    safe: bool,
    lost: Option<RigError>,
}

impl<'a, L: Link> Trial<'a, L> {
    fn new(session: &'a mut Session<L>, order: &Order<'a>) -> Self {
        let Order { scenario, index, .. } = *order;
        let variation = scenario.variation(index);
        let mut plant = variation.plant(scenario);
        let frequency_hz = f64::from(start_frequency_mhz(scenario)) / 1e3;
        plant.set_drive(Drive { vpp: 0.0, omega: TAU * frequency_hz });
        let rows = scenario.duration.seconds() / scenario.trace_step.seconds();
        Self {
            session,
            scenario,
            wire_time: order.wire_time,
            observed: Observed::default(),
            plant,
            sensor: variation.sensor(scenario),
            rows: Vec::with_capacity(rows as usize + 64),
            crossings: Vec::new(),
            next_control: Time::ZERO,
            pending: VecDeque::new(),
            frequency_hz,
            sensed: [0.0; 2],
            misses: 0,
            safe: false,
            lost: None,
        }
    }

    /// Everything that happens at this instant, and the way to the next one. True at the end of the scenario.
    fn step(&mut self) -> bool {
        let now = self.plant.time();
        let mut flags = Flags::empty();
        if now == self.next_control && now < self.scenario.duration {
            self.next_control = now + self.scenario.controller.period;
            if self.lost.is_none() {
                flags |= self.control(now);
            }
        }
        while self.pending.front().is_some_and(|pending| pending.at <= now) {
            if let Some(Pending { command, .. }) = self.pending.pop_front() {
                self.actuate(&command);
            }
        }
        if self.lost.as_ref().is_some_and(|error| !is_the_controllers_doing(error)) {
            flags |= Flags::LINK_LOST;
        }
        self.push_row(now, &self.plant.state(), flags);
        if now >= self.scenario.duration {
            return true;
        }
        self.advance(self.next_event(now));
        false
    }

    fn control(&mut self, now: Time) -> Flags {
        let sensed = self.sensor.sense(self.plant.state().w);
        let sample = Sample {
            time_us: now.wrapping_micros(),
            setpoint_um: self.scenario.setpoint.at(now) as f32,
            wd_um: sensed.re as f32,
            wq_um: sensed.im as f32,
        };
        self.sensed = [f64::from(sample.wd_um), f64::from(sample.wq_um)];
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

    fn actuate(&mut self, command: &Command) {
        self.safe = command.state != Mode::Running;
        let asked = f64::from(command.drive_vpp);
        let vpp = if asked.is_finite() { asked.clamp(0.0, self.scenario.plate.drive_limit_vpp) } else { 0.0 };
        self.frequency_hz = f64::from(command.frequency_mhz) / 1e3;
        self.plant.set_drive(Drive { vpp, omega: TAU * self.frequency_hz });
    }

    /// The controller is gone: what is left of the trial is played at 0 V.
    fn lose(&mut self, error: RigError) {
        self.safe = true;
        self.pending.clear();
        self.plant.set_drive(Drive { vpp: 0.0, ..self.plant.drive() });
        self.lost = Some(error);
    }

    fn next_event(&self, now: Time) -> Time {
        let points = [self.plant.next_point_after(now), self.scenario.setpoint.next_point_after(now)];
        let actuation = self.pending.front().map(|pending| pending.at);
        let control = Some(self.next_control).filter(|control| *control > now);
        let fixed = self.scenario.trace_step.next_multiple_after(now).min(self.scenario.duration);
        points.into_iter().flatten().chain(actuation).chain(control).fold(fixed, Time::min)
    }

    /// Moves the plate on to `end`, with a row on either side of each crossing of a band that an expectation looks at.
    fn advance(&mut self, end: Time) {
        let watches = watches(self.scenario, self.plant.time());
        self.plant.advance(end, &watches, &mut self.crossings);
        let mut crossings = std::mem::take(&mut self.crossings);
        for crossing in crossings.drain(..) {
            let last = Time::from_nanos(crossing.time.as_nanos().saturating_sub(1));
            for (time, state) in [(last, crossing.before), (crossing.time, crossing.state)] {
                // The rows at both ends of the interval are there anyway.
                if self.rows.last().is_none_or(|row| row.t_s < time.seconds()) && time < end {
                    self.push_row(time, &state, Flags::empty());
                }
            }
        }
        self.crossings = crossings;
    }

    fn push_row(&mut self, time: Time, state: &State, flags: Flags) {
        let drive = self.plant.drive();
        let conditions = self.plant.conditions_at(time);
        let saturated = drive.vpp >= self.scenario.plate.drive_limit_vpp * SATURATED_FROM;
        let also = [(saturated, Flags::SATURATED), (self.safe, Flags::SAFE)];
        self.rows.push(Row {
            t_s: time.seconds(),
            setpoint_um: self.scenario.setpoint.at(time),
            wd_um: state.w.re,
            wq_um: state.w.im,
            amplitude_um: state.amplitude(),
            drive_vpp: drive.vpp,
            frequency_hz: self.frequency_hz,
            resonance_hz: self.plant.mode_at(time).omega0 / TAU,
            temperature_offset_k: conditions.temperature_offset_k,
            finger_force_n: conditions.finger_force_n,
            sensed_wd_um: self.sensed[0],
            sensed_wq_um: self.sensed[1],
            lateness_us: 0.0,
            flags: also.into_iter().filter(|(holds, _)| *holds).fold(flags, |flags, (_, flag)| flags | flag),
        });
    }
}

/// True where the controller itself came to grief, which fails a trial; a line that went dead only leaves it undecided.
fn is_the_controllers_doing(error: &RigError) -> bool {
    match error {
        RigError::Trapped(_) | RigError::Link(LinkError::Target(_)) => true,
        RigError::Link(LinkError::Disconnected(_)) | RigError::NoAnswer { .. } | RigError::Refused(_) => false,
    }
}

/// The bands that the scenario's expectations look at, around the setpoint of `now`.
fn watches(scenario: &Scenario, now: Time) -> Vec<Watch> {
    let setpoint = scenario.setpoint.at(now);
    let mut watches: Vec<Watch> = Vec::new();
    for expectation in &scenario.expectations {
        let signal = match expectation.signal {
            "wd_um" => Signal::InPhase,
            "wq_um" => Signal::Quadrature,
            "amplitude_um" => Signal::Amplitude,
            _ => continue,
        };
        if !matches!(expectation.metric, Metric::SettlingTime | Metric::RecoveryTime | Metric::PeakDeviation) {
            continue;
        }
        let (low, high) = expectation.band(setpoint);
        let watch = Watch { signal, low, high };
        if setpoint > 0.0 && !watches.contains(&watch) {
            watches.push(watch);
        }
    }
    watches
}
