//! The same boundary, measured: the firmware's own controller, f32 and all, on the exact plate.
//!
//! The loop is brought to its steady state without delay. From there on its commands act late, one sample is shown a little off, and the loop says
//! by itself whether that dies out. What the drive's limit does is no part of it. `deadbeat` starts without delay, so it holds with loops that know of none.
//!
//! [`from_rest`] asks the other question: whether the law gets to its setpoint at all when the delay is there from the start.

use crate::case::Case;
use platebench_controller::Machine;
use platebench_plate::{Complex64, Drive, Plant, Profile, Scene, Tier, Time};
use platebench_wire::{LawId, Sample, State};
use std::collections::VecDeque;
use std::f64::consts::TAU;

/// Periods in which a loop without delay has come to its steady state, and over how many of them that is averaged.
const WARM_UP: u32 = 700;
const AVERAGED: u32 = 100;
/// A loop whose last periods differ by more than this share of the setpoint has no steady state.
const STEADY: f64 = 1e-4;
/// What one sample is shown off, as a share of the setpoint …
const KICK: f64 = 3e-2;
/// … and to laws that learn the plate from each sample, which should take it for noise.
const KICK_OF_LEARNERS: f64 = 3e-3;
/// A motion that grows to so many times what was shown has left the small ones.
const LEFT: f64 = 8.0;
/// A motion this small is at the grain of the wire's millihertz and the controller's f32.
const GRAIN: f64 = 5e-5;
/// Periods that a motion is given to find its slowest pole, and the length of the two windows that are compared.
const LEAD: usize = 40;
const WINDOW: usize = 160;
/// A loop that hunts never comes to rest. It holds where |W| stays within this share of the setpoint in the last of so many periods.
const HUNT: f64 = 0.05;
const HUNT_PERIODS: usize = 3_000;
const HUNT_WINDOW: usize = 300;
/// Delays are looked for in steps of this share of a period and then halved so often.
const SCAN: f64 = 0.25;
const BISECTIONS: u32 = 8;
/// The last periods of a start from rest that have to be within 5 %, and how many there are.
const REST_PERIODS: u32 = 400;
const REST_WINDOW: u32 = 40;
const REST_BAND: f64 = 0.05;

/// What a loop does at a delay.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Motion {
    /// It dies out or grows by this factor per period.
    Factor(f64),
    /// It died out before it could be told how fast.
    DiedOut,
    /// It hunts and stays within bounds.
    Hunts,
    /// It hunts and does not.
    Leaves,
}

impl Motion {
    /// True where it dies out or stays within bounds.
    pub fn is_stable(self) -> bool {
        match self {
            Self::Factor(factor) => factor < 1.0,
            Self::DiedOut | Self::Hunts => true,
            Self::Leaves => false,
        }
    }
}

/// A controller and a plate in lockstep.
#[derive(Debug, Clone)]
pub struct Bench {
    machine: Machine,
    plant: Plant,
    hunts: bool,
    /// What a sample may be shown off, µm.
    kick: f64,
    setpoint: f64,
    period: Time,
    /// In order of their instants.
    pending: VecDeque<(Time, Drive)>,
    steady: Complex64,
}

impl Bench {
    /// The case, at rest. `None` where the firmware refuses its configuration.
    pub fn at_rest(case: &Case<'_>) -> Option<Self> {
        let mut machine = Machine::new();
        machine.configure(&case.configure()).outcome.ok()?;
        let surroundings = case.condition.surroundings();
        let scene = Scene {
            temperature_offset_k: Profile::constant(surroundings.temperature_offset_k),
            finger_force_n: Profile::constant(surroundings.finger_force_n),
        };
        let mut plant = Plant::new(case.plate.clone(), scene, Tier::Modal);
        plant.set_drive(Drive { vpp: 0.0, omega: case.condition.start(case.plate) });
        let kick = match case.law {
            LawId::DqPi | LawId::Deadbeat => KICK_OF_LEARNERS,
            _ => KICK,
        };
        Some(Self {
            machine,
            plant,
            kick: case.setpoint() * kick,
            hunts: case.law == LawId::BangBang,
            setpoint: case.setpoint(),
            period: Time::from_nanos(u64::from(case.period_us) * 1_000),
            pending: VecDeque::new(),
            steady: Complex64::ZERO,
        })
    }

    /// The case in its steady state. `None` where it does not come to one without delay.
    pub fn in_steady_state(case: &Case<'_>) -> Option<Self> {
        let mut bench = Self::at_rest(case)?;
        let mut mean = Complex64::ZERO;
        let (mut lowest, mut highest) = (f64::INFINITY, f64::NEG_INFINITY);
        for period in 0..WARM_UP {
            let w = bench.period(Time::ZERO, 0.0)?;
            if period >= WARM_UP - AVERAGED {
                mean += w / f64::from(AVERAGED);
                (lowest, highest) = (lowest.min(w.norm()), highest.max(w.norm()));
            }
        }
        let spread = (highest - lowest) / bench.setpoint;
        bench.steady = mean;
        (spread < if bench.hunts { HUNT } else { STEADY }).then_some(bench)
    }

    /// W at the next control instant, µm, from which it goes on with the commands acting `delay` later; `shown_off` is added to what is seen of both
    /// components. `None` where the controller has stopped or the plate is nowhere.
    pub fn period(&mut self, delay: Time, shown_off: f64) -> Option<Complex64> {
        let (now, w) = (self.plant.time(), self.plant.state().w);
        let time_us = (now.as_nanos() / 1_000) as u32;
        let sample = Sample {
            time_us,
            setpoint_um: self.setpoint as f32,
            wd_um: (w.re + shown_off) as f32,
            wq_um: (w.im + shown_off) as f32,
        };
        let command = self.machine.sample(&sample, time_us);
        if command.state != State::Running || !w.is_finite() {
            return None;
        }
        let drive = Drive { vpp: f64::from(command.drive_vpp), omega: f64::from(command.frequency_mhz) * 1e-3 * TAU };
        self.pending.push_back((now + delay, drive));
        let end = now + self.period;
        while let Some(&(at, drive)) = self.pending.front() {
            if at >= end {
                break;
            }
            self.plant.advance(at, &[], &mut Vec::new());
            self.plant.set_drive(drive);
            self.pending.pop_front();
        }
        self.plant.advance(end, &[], &mut Vec::new());
        Some(w)
    }

    /// What becomes of one wrong sample when commands act `delay` later.
    pub fn motion(mut self, delay: Time) -> Motion {
        if self.hunts {
            return self.hunt(delay);
        }
        let mut windows = [0.0_f64; 2];
        for number in 0..LEAD + 2 * WINDOW {
            let shown_off = if number == 0 { self.kick } else { 0.0 };
            let Some(w) = self.period(delay, shown_off) else { return Motion::Factor(f64::INFINITY) };
            let share = (w - self.steady).norm() / self.kick;
            if share > LEFT && number > LEAD {
                return Motion::Factor(share.powf(1.0 / number as f64));
            }
            if let Some(window) = number.checked_sub(LEAD).and_then(|since| windows.get_mut(since / WINDOW)) {
                *window = window.max(share);
            }
        }
        match windows {
            [_, late] if late < GRAIN * self.setpoint / self.kick => Motion::DiedOut,
            [early, late] => Motion::Factor((late / early).powf(1.0 / WINDOW as f64)),
        }
    }

    /// The same for a loop that never rests: its hunt is what stirs it.
    fn hunt(mut self, delay: Time) -> Motion {
        for number in 0..HUNT_PERIODS {
            let Some(w) = self.period(delay, 0.0) else { return Motion::Leaves };
            let share = (w.norm() / self.setpoint - 1.0).abs();
            if share > HUNT && number >= HUNT_PERIODS - HUNT_WINDOW {
                return Motion::Leaves;
            }
        }
        Motion::Hunts
    }
}

/// Where a loop that was measured ends to be stable.
pub type Measured = crate::margins::DelayBoundary;

/// The longest delay, up to `longest` s, at which the controller still holds its steady state. `None` where it has none without delay.
pub fn boundary(case: &Case<'_>, longest: f64) -> Option<Measured> {
    let bench = Bench::in_steady_state(case)?;
    Some(search(case.period(), longest, |delay| bench.clone().motion(delay).is_stable()))
}

/// The longest delay, up to `longest` s, with which the controller still brings the plate from rest into 5 % of its setpoint and stays there.
pub fn from_rest(case: &Case<'_>, longest: f64) -> Measured {
    search(case.period(), longest, |delay| {
        let Some(mut bench) = Bench::at_rest(case) else { return false };
        let setpoint = bench.setpoint;
        (0..REST_PERIODS).all(|number| {
            let early = number < REST_PERIODS - REST_WINDOW;
            let w = bench.period(delay, 0.0);
            w.is_some_and(|w| early || (w.norm() / setpoint - 1.0).abs() <= REST_BAND)
        })
    })
}

fn search(period: f64, longest: f64, holds: impl Fn(Time) -> bool) -> Measured {
    let at = |seconds: f64| Time::from_seconds(seconds).is_some_and(&holds);
    if !at(0.0) {
        return Measured::Never;
    }
    let mut low = 0.0;
    let steps = (longest / (SCAN * period)).ceil() as u32;
    for step in 1..=steps {
        let mut high = (f64::from(step) * SCAN * period).min(longest);
        if !at(high) {
            for _ in 0..BISECTIONS {
                let middle = f64::midpoint(low, high);
                *(if at(middle) { &mut low } else { &mut high }) = middle;
            }
            return Measured::At(f64::midpoint(low, high));
        }
        low = high;
    }
    Measured::Beyond(longest)
}
