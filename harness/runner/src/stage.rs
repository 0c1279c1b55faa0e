//! The plate of a trial with its sensor, its drive and its rows: what both clocks have in common.
//!
//! Between events nothing changes, so that nothing is smeared over a step; where a profile varies the plant cuts the interval itself.

use crate::configure::start_frequency_mhz;
use crate::watch::Tap;
use platebench_plate::plant::Signal;
use platebench_plate::{Conditions, Crossing, Drive, Plant, Sensor, State, Time, Watch};
use platebench_scenario::{Metric, Scenario};
use platebench_trace::{Flags, Row};
use platebench_verdict::record::NotFinite;
use platebench_wire::{Command, Sample, State as Mode};
use std::f64::consts::TAU;

/// The amplifier counts as saturated from here on, as a fraction of its limit: the wire carries the limit as f32.
const SATURATED_FROM: f64 = 1.0 - 1e-6;

/// Where rows go.
pub(crate) trait Rows {
    /// Takes a row; must not wait.
    fn push(&mut self, row: Row);
}

impl Rows for Vec<Row> {
    fn push(&mut self, row: Row) {
        Self::push(self, row);
    }
}

/// How many rows a trial of `scenario` has at about: one per step of the trace and some per control instant.
pub(crate) fn expected_rows(scenario: &Scenario) -> usize {
    let of = |span: Time| (scenario.duration.seconds() / span.seconds()) as usize;
    of(scenario.trace_step) + 2 * of(scenario.controller.period) + 64
}

/// What somebody at the plate can change.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Held {
    /// Wished amplitude, µm.
    pub setpoint_um: f64,
    /// Kelvin above the plate's reference temperature.
    pub temperature_offset_k: f64,
    /// Normal force of the finger, N.
    pub finger_force_n: f64,
}

pub(crate) struct Stage<'a, R> {
    scenario: &'a Scenario,
    plant: Plant,
    sensor: Sensor,
    rows: R,
    /// Whoever looks on gets the same rows, as far as there is room.
    tap: Option<&'a mut Tap>,
    /// The last row, until time has moved on: further events of its instant are put into it.
    held: Option<Row>,
    crossings: Vec<Crossing>,
    watches: Vec<Watch>,
    /// The setpoint that the watches were made for.
    watched_um: Option<f64>,
    /// Instead of the scenario's.
    setpoint_um: Option<f64>,
    frequency_hz: f64,
    sensed: [f64; 2],
    safe: bool,
    not_finite: Option<NotFinite>,
}

impl<'a, R: Rows> Stage<'a, R> {
    pub(crate) fn new(scenario: &'a Scenario, index: u32, rows: R, tap: Option<&'a mut Tap>) -> Self {
        let variation = scenario.variation(index);
        let mut plant = variation.plant(scenario);
        let frequency_hz = f64::from(start_frequency_mhz(scenario)) / 1e3;
        plant.set_drive(Drive { vpp: 0.0, omega: TAU * frequency_hz });
        Self {
            scenario,
            plant,
            sensor: variation.sensor(scenario),
            rows,
            tap,
            held: None,
            crossings: Vec::with_capacity(64),
            watches: Vec::with_capacity(scenario.expectations.len()),
            watched_um: None,
            setpoint_um: None,
            frequency_hz,
            sensed: [0.0; 2],
            safe: false,
            not_finite: None,
        }
    }

    pub(crate) fn time(&self) -> Time {
        self.plant.time()
    }

    pub(crate) fn is_over(&self) -> bool {
        self.time() >= self.scenario.duration
    }

    pub(crate) fn into_rows(mut self) -> R {
        if let Some(last) = self.held.take() {
            self.give(last);
        }
        self.rows
    }

    /// From now on setpoint and surroundings are these, whatever the scenario says. Allocates.
    pub(crate) fn hold(&mut self, held: &Held) {
        let Held { setpoint_um, temperature_offset_k, finger_force_n } = *held;
        self.setpoint_um = Some(setpoint_um);
        self.plant.hold(Conditions { temperature_offset_k, finger_force_n });
    }

    fn setpoint_at(&self, time: Time) -> f64 {
        self.setpoint_um.unwrap_or_else(|| self.scenario.setpoint.at(time))
    }

    /// What the controller is given now.
    pub(crate) fn sense(&mut self) -> Sample {
        let now = self.time();
        let sensed = self.sensor.sense(self.plant.seen());
        let sample = Sample {
            time_us: now.wrapping_micros(),
            setpoint_um: self.setpoint_at(now) as f32,
            wd_um: on_the_wire(sensed.re),
            wq_um: on_the_wire(sensed.im),
        };
        self.sensed = [f64::from(sample.wd_um), f64::from(sample.wq_um)];
        sample
    }

    /// The controller's command acts on the plate from now on. A drive that is no number is 0 V, and noted: no trace can show it.
    pub(crate) fn actuate(&mut self, command: &Command) {
        self.safe = command.state != Mode::Running;
        let asked = f64::from(command.drive_vpp);
        let vpp = if asked.is_finite() {
            asked.clamp(0.0, self.scenario.plate.drive_limit_vpp)
        } else {
            let first = NotFinite { at_s: self.time().seconds(), count: 0 };
            self.not_finite.get_or_insert(first).count += 1;
            0.0
        };
        self.frequency_hz = f64::from(command.frequency_mhz) / 1e3;
        self.plant.set_drive(Drive { vpp, omega: TAU * self.frequency_hz });
    }

    /// The commands so far whose drive was no number.
    pub(crate) fn not_finite(&self) -> Option<NotFinite> {
        self.not_finite
    }

    /// Nobody drives the plate any more.
    pub(crate) fn rest(&mut self) {
        self.safe = true;
        self.plant.set_drive(Drive { vpp: 0.0, ..self.plant.drive() });
    }

    /// The next instant at which the scenario itself wants a row, after now.
    pub(crate) fn next_fixed(&self) -> Time {
        let now = self.time();
        let points = [self.plant.next_point_after(now), self.scenario.setpoint.next_point_after(now)];
        let step = self.scenario.trace_step.next_multiple_after(now).min(self.scenario.duration);
        points.into_iter().flatten().fold(step, Time::min)
    }

    /// Moves the plate on to `end`, with a row on either side of each crossing of a band that an expectation looks at. Nothing the scenario wants a row
    /// for lies between.
    pub(crate) fn advance(&mut self, end: Time) {
        self.watch();
        self.plant.advance(end, &self.watches, &mut self.crossings);
        let mut crossings = std::mem::take(&mut self.crossings);
        for crossing in crossings.drain(..) {
            let last = Time::from_nanos(crossing.time.as_nanos().saturating_sub(1));
            for (time, state) in [(last, crossing.before), (crossing.time, crossing.state)] {
                // The rows at both ends of the interval are there anyway.
                if self.held.is_none_or(|last| last.t_s < time.seconds()) && time < end {
                    self.push(time, &state, 0.0, Flags::empty());
                }
            }
        }
        self.crossings = crossings;
    }

    /// Moves the plate on to `end`, however far that is, with every row that the scenario wants before it.
    pub(crate) fn advance_through(&mut self, end: Time) {
        let end = end.min(self.scenario.duration);
        while self.time() < end {
            let next = self.next_fixed().min(end);
            self.advance(next);
            if next < end {
                self.push_row(0.0, Flags::empty());
            }
        }
    }

    /// What the controller was given instead of what was sensed.
    pub(crate) fn given(&mut self, sensed: [f32; 2]) {
        self.sensed = sensed.map(|value| f64::from(on_the_wire(value.into())));
    }

    /// A row for now, or what else happened at the instant of the last one.
    pub(crate) fn push_row(&mut self, lateness_us: f64, flags: Flags) {
        let (now, state) = (self.time(), self.plant.state());
        self.push(now, &state, lateness_us, flags);
    }

    fn push(&mut self, time: Time, state: &State, lateness_us: f64, flags: Flags) {
        let drive = self.plant.drive();
        let conditions = self.plant.conditions_at(time);
        let resonance_hz = self.plant.mode_at(time).omega0 / TAU;
        if !state.is_finite() || !resonance_hz.is_finite() {
            // A plate that cannot be computed is the bench's fault: its trace ends here, and a trace that ends early does not count.
            return;
        }
        let saturated = drive.vpp >= self.scenario.plate.drive_limit_vpp * SATURATED_FROM;
        let also = [(saturated, Flags::SATURATED), (self.safe, Flags::SAFE)];
        let row = Row {
            t_s: time.seconds(),
            setpoint_um: self.setpoint_at(time),
            wd_um: state.w.re,
            wq_um: state.w.im,
            amplitude_um: state.amplitude(),
            drive_vpp: drive.vpp,
            frequency_hz: self.frequency_hz,
            resonance_hz,
            temperature_offset_k: conditions.temperature_offset_k,
            finger_force_n: conditions.finger_force_n,
            sensed_wd_um: self.sensed[0],
            sensed_wq_um: self.sensed[1],
            lateness_us,
            flags: also.into_iter().filter(|(holds, _)| *holds).fold(flags, |flags, (_, flag)| flags | flag),
        };
        match &mut self.held {
            // Several events at one instant: what holds from here on, and everything that happened.
            Some(last) if last.t_s == row.t_s => {
                let happened = last.flags & (Flags::CONTROL | Flags::OVERRUN | Flags::LINK_LOST);
                *last = Row { lateness_us: row.lateness_us.max(last.lateness_us), flags: row.flags | happened, ..row };
            }
            held => {
                if let Some(last) = held.replace(row) {
                    self.give(last);
                }
            }
        }
    }

    /// A row that nothing is added to any more.
    fn give(&mut self, row: Row) {
        if let Some(tap) = &mut self.tap {
            tap.push(&row);
        }
        self.rows.push(row);
    }

    /// Tells whoever looks on of samples without an answer, and how many frames could not be read so far.
    pub(crate) fn tell(&mut self, missed: u64, refused: u64) {
        if let Some(tap) = &mut self.tap {
            tap.miss(missed);
            tap.refused(refused);
        }
    }

    /// The bands that the scenario's expectations look at, around the setpoint of now.
    fn watch(&mut self) {
        let setpoint = self.setpoint_at(self.time());
        if self.watched_um.replace(setpoint) == Some(setpoint) {
            return;
        }
        self.watches.clear();
        for expectation in &self.scenario.expectations {
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
            if setpoint > 0.0 && !self.watches.contains(&watch) {
                self.watches.push(watch);
            }
        }
    }
}

/// A sensor that is beyond what the wire carries shows the largest number that it carries.
fn on_the_wire(value: f64) -> f32 {
    value.clamp(f32::MIN.into(), f32::MAX.into()) as f32
}

impl Stage<'_, Vec<Row>> {
    /// Rows up to now, without the one that this instant will have: its number.
    pub(crate) fn rows_so_far(&self) -> usize {
        self.rows.len() + usize::from(self.held.is_some())
    }

    /// Adds to the flags of the row with this number.
    pub(crate) fn flag(&mut self, number: usize, flags: Flags) {
        let row = if number == self.rows.len() { self.held.as_mut() } else { self.rows.get_mut(number) };
        if let Some(row) = row {
            row.flags |= flags;
        }
    }
}
