//! Measures the delay boundary of the firmware's f32 controller on the exact plate.
//!
//! The loop reaches its steady state without delay. Then its commands act late, one sample is
//! perturbed, and the perturbation decays or grows. The drive limit does not act. `deadbeat` starts
//! without delay, so its holding loops know of none.
//!
//! [`measure_delay_boundary_from_rest`] measures whether the law reaches its setpoint if the delay
//! acts from the start.

use crate::loops::case::LoopCase;
use crate::loops::margins::DelayBoundary;
use platebench_controller::StateMachine;
use platebench_plate::{Complex64, ConditionProfiles, Drive, Plant, Profile, Tier, Time};
use platebench_wire::{ControllerState, LawId, Sample};
use std::collections::VecDeque;
use std::f64::consts::TAU;

/// Periods until the steady state without delay, and the number of them that is averaged.
const WARM_UP: u32 = 700;
const AVERAGED_PERIODS: u32 = 100;
/// Largest spread of the last periods in a steady state, as a share of the setpoint.
const STEADY_TOLERANCE: f64 = 1e-4;
/// Perturbation of one sample as a share of the setpoint.
const PERTURBATION: f64 = 3e-2;
/// The same for laws that identify the plate from each sample, which must treat it as noise.
const PERTURBATION_OF_ADAPTIVE_LAWS: f64 = 3e-3;
/// Growth beyond which a motion is no small one.
const DIVERGENCE_FACTOR: f64 = 8.0;
/// Resolution of the frequency in mHz and of f32, as a share of the setpoint.
const RESOLUTION: f64 = 5e-5;
/// Periods until the slowest pole dominates, and the length of the two compared windows.
const TRANSIENT_PERIODS: usize = 40;
const WINDOW: usize = 160;
/// A hunting loop never rests. It is stable if |W| stays within this share of the setpoint in the
/// last periods.
const HUNT_BAND: f64 = 0.05;
const HUNT_PERIODS: usize = 3_000;
const HUNT_WINDOW: usize = 300;
/// Step of the delay scan as a share of a period, and bisections after it.
const SCAN_STEP: f64 = 0.25;
const BISECTIONS: u32 = 8;
/// Periods of a start from rest, and the number of last periods that must be within 5 %.
const REST_PERIODS: u32 = 400;
const REST_WINDOW: u32 = 40;
const REST_BAND: f64 = 0.05;

/// Motion of a loop at a delay.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum LoopMotion {
    /// Decays or grows by this factor per period.
    Factor(f64),
    /// Decayed too fast to measure the factor.
    Decayed,
    /// Hunts within bounds.
    BoundedHunting,
    /// Hunts beyond bounds.
    UnboundedHunting,
}

impl LoopMotion {
    /// True if it decays or stays within bounds.
    pub fn is_stable(self) -> bool {
        match self {
            Self::Factor(factor) => factor < 1.0,
            Self::Decayed | Self::BoundedHunting => true,
            Self::UnboundedHunting => false,
        }
    }
}

/// A controller and a plate in lockstep.
#[derive(Debug, Clone)]
pub struct LoopSimulation {
    machine: StateMachine,
    plant: Plant,
    is_hunting_law: bool,
    /// µm.
    perturbation: f64,
    setpoint: f64,
    step: Time,
    /// Drives with the time from which they act, in order.
    pending: VecDeque<(Time, Drive)>,
    steady: Complex64,
}

impl LoopSimulation {
    /// The case at rest; `None` if the firmware rejects its configuration.
    pub fn at_rest(case: &LoopCase<'_>) -> Option<Self> {
        let mut machine = StateMachine::new();
        machine.configure(&case.configure()).outcome.ok()?;
        let conditions = case.condition.conditions();
        let scene = ConditionProfiles {
            temperature_offset_k: Profile::constant(conditions.temperature_offset_k),
            finger_force_n: Profile::constant(conditions.finger_force_n),
        };
        let mut plant = Plant::new(case.plate.clone(), scene, Tier::Modal);
        plant.set_drive(Drive { vpp: 0.0, omega: case.condition.start_omega(case.plate) });
        let perturbation = match case.law {
            LawId::DqPi | LawId::Deadbeat => PERTURBATION_OF_ADAPTIVE_LAWS,
            _ => PERTURBATION,
        };
        Some(Self {
            machine,
            plant,
            perturbation: case.setpoint() * perturbation,
            is_hunting_law: case.law == LawId::BangBang,
            setpoint: case.setpoint(),
            step: Time::from_nanos(u64::from(case.period_us) * 1_000),
            pending: VecDeque::new(),
            steady: Complex64::ZERO,
        })
    }

    /// The case in its steady state; `None` if it has none without delay.
    pub fn in_steady_state(case: &LoopCase<'_>) -> Option<Self> {
        let mut simulation = Self::at_rest(case)?;
        let mut mean = Complex64::ZERO;
        let (mut lowest, mut highest) = (f64::INFINITY, f64::NEG_INFINITY);
        for period in 0..WARM_UP {
            let w = simulation.period(Time::ZERO, 0.0)?;
            if period >= WARM_UP - AVERAGED_PERIODS {
                mean += w / f64::from(AVERAGED_PERIODS);
                (lowest, highest) = (lowest.min(w.norm()), highest.max(w.norm()));
            }
        }
        let spread = (highest - lowest) / simulation.setpoint;
        simulation.steady = mean;
        (spread < if simulation.is_hunting_law { HUNT_BAND } else { STEADY_TOLERANCE }).then_some(simulation)
    }

    /// Advances one period; returns W at its start, µm. The command acts after `delay`;
    /// `perturbation` is added to both measured components. `None` if the controller has stopped or
    /// W is not finite.
    pub fn period(&mut self, delay: Time, perturbation: f64) -> Option<Complex64> {
        let (now, w) = (self.plant.time(), self.plant.state().w);
        let time_us = (now.as_nanos() / 1_000) as u32;
        let sample = Sample {
            time_us,
            setpoint_um: self.setpoint as f32,
            wd_um: (w.re + perturbation) as f32,
            wq_um: (w.im + perturbation) as f32,
        };
        let command = self.machine.sample(&sample, time_us);
        if command.state != ControllerState::Running || !w.is_finite() {
            return None;
        }
        let drive = Drive { vpp: f64::from(command.drive_vpp), omega: f64::from(command.frequency_mhz) * 1e-3 * TAU };
        self.pending.push_back((now + delay, drive));
        let end = now + self.step;
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

    /// Motion after one perturbed sample if commands act after `delay`.
    pub fn perturbed_motion(mut self, delay: Time) -> LoopMotion {
        if self.is_hunting_law {
            return self.hunting_motion(delay);
        }
        let mut windows = [0.0_f64; 2];
        for number in 0..TRANSIENT_PERIODS + 2 * WINDOW {
            let perturbation = if number == 0 { self.perturbation } else { 0.0 };
            let Some(w) = self.period(delay, perturbation) else { return LoopMotion::Factor(f64::INFINITY) };
            let share = (w - self.steady).norm() / self.perturbation;
            if share > DIVERGENCE_FACTOR && number > TRANSIENT_PERIODS {
                return LoopMotion::Factor(share.powf(1.0 / number as f64));
            }
            if let Some(window) =
                number.checked_sub(TRANSIENT_PERIODS).and_then(|since| windows.get_mut(since / WINDOW))
            {
                *window = window.max(share);
            }
        }
        match windows {
            [_, late] if late < RESOLUTION * self.setpoint / self.perturbation => LoopMotion::Decayed,
            [early, late] => LoopMotion::Factor((late / early).powf(1.0 / WINDOW as f64)),
        }
    }

    /// Motion of a hunting loop, which needs no perturbation.
    fn hunting_motion(mut self, delay: Time) -> LoopMotion {
        for number in 0..HUNT_PERIODS {
            let Some(w) = self.period(delay, 0.0) else { return LoopMotion::UnboundedHunting };
            let share = (w.norm() / self.setpoint - 1.0).abs();
            if share > HUNT_BAND && number >= HUNT_PERIODS - HUNT_WINDOW {
                return LoopMotion::UnboundedHunting;
            }
        }
        LoopMotion::BoundedHunting
    }
}

/// The longest delay, up to `longest` s, at which the controller holds its steady state. `None`
/// without a steady state.
pub fn measure_delay_boundary(case: &LoopCase<'_>, longest: f64) -> Option<DelayBoundary> {
    let simulation = LoopSimulation::in_steady_state(case)?;
    Some(search_boundary(case.period(), longest, |delay| simulation.clone().perturbed_motion(delay).is_stable()))
}

/// The longest delay, up to `longest` s, with which the controller reaches 5 % of its setpoint from
/// rest and stays there.
pub fn measure_delay_boundary_from_rest(case: &LoopCase<'_>, longest: f64) -> DelayBoundary {
    search_boundary(case.period(), longest, |delay| {
        let Some(mut simulation) = LoopSimulation::at_rest(case) else { return false };
        let setpoint = simulation.setpoint;
        (0..REST_PERIODS).all(|number| {
            let early = number < REST_PERIODS - REST_WINDOW;
            let w = simulation.period(delay, 0.0);
            w.is_some_and(|w| early || (w.norm() / setpoint - 1.0).abs() <= REST_BAND)
        })
    })
}

fn search_boundary(period: f64, longest: f64, is_stable: impl Fn(Time) -> bool) -> DelayBoundary {
    let at = |seconds: f64| Time::from_seconds(seconds).is_some_and(&is_stable);
    if !at(0.0) {
        return DelayBoundary::Unstable;
    }
    let mut low = 0.0;
    let steps = (longest / (SCAN_STEP * period)).ceil() as u32;
    for step in 1..=steps {
        let mut high = (f64::from(step) * SCAN_STEP * period).min(longest);
        if !at(high) {
            for _ in 0..BISECTIONS {
                let middle = f64::midpoint(low, high);
                *(if at(middle) { &mut low } else { &mut high }) = middle;
            }
            return DelayBoundary::At(f64::midpoint(low, high));
        }
        low = high;
    }
    DelayBoundary::Beyond(longest)
}
