//! Measures the delay boundary of the firmware's f32 controller on the exact plate. The loop
//! reaches its steady state without delay. Then its commands act late, one sample is perturbed, and
//! the perturbation decays or grows. The drive limit does not act. `deadbeat` starts without delay
//! and compensates none.

use crate::loops::case::LoopCase;
use platebench_engine::delay_boundary::{DelayBoundary, DelayedLoop, search_boundary};
use platebench_plate::{Complex64, Tier, Time};
use platebench_wire::LawId;

/// Periods without delay until the steady state. [`AVERAGED_PERIODS`] at their end are averaged.
const WARM_UP: u32 = 700;
const AVERAGED_PERIODS: u32 = 100;
/// Largest spread of |W| over the averaged periods, as a share of the setpoint.
const STEADY_TOLERANCE: f64 = 1e-4;
/// Perturbation of one sample as a share of the setpoint.
const PERTURBATION: f64 = 3e-2;
/// Smaller, because laws that identify the plate must treat the perturbation as noise.
const PERTURBATION_OF_ADAPTIVE_LAWS: f64 = 3e-3;
const DIVERGENCE_FACTOR: f64 = 8.0;
/// Resolution of the frequency (1 mHz) and of f32, as a share of the setpoint.
const RESOLUTION: f64 = 5e-5;
/// Periods until the slowest pole dominates. Then two windows of [`WINDOW`] periods are compared.
const TRANSIENT_PERIODS: usize = 40;
const WINDOW: usize = 160;
/// A hunting loop (limit cycle of `bang-bang`) is stable if |W| stays within this share of the
/// setpoint for the last [`HUNT_WINDOW`] periods.
const HUNT_BAND: f64 = 0.05;
const HUNT_PERIODS: usize = 3_000;
const HUNT_WINDOW: usize = 300;
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum LoopMotion {
    /// The perturbation decays or grows by this factor per period.
    Factor(f64),
    Decayed,
    BoundedHunting,
    UnboundedHunting,
}

impl LoopMotion {
    pub fn is_stable(self) -> bool {
        match self {
            Self::Factor(factor) => factor < 1.0,
            Self::Decayed | Self::BoundedHunting => true,
            Self::UnboundedHunting => false,
        }
    }
}

#[derive(Debug, Clone)]
pub struct LoopSimulation {
    delayed_loop: DelayedLoop,
    is_hunting_law: bool,
    perturbation: f64,
    steady: Complex64,
}

/// `None` if the firmware rejects the configuration.
pub fn loop_at_rest(case: &LoopCase<'_>) -> Option<DelayedLoop> {
    DelayedLoop::new(&case.configure(), case.plate, case.condition.conditions(), Tier::Modal, case.setpoint())
}

impl LoopSimulation {
    /// `None` if there is no steady state without delay.
    pub fn in_steady_state(case: &LoopCase<'_>) -> Option<Self> {
        let mut delayed_loop = loop_at_rest(case)?;
        let mut steady = Complex64::ZERO;
        let (mut lowest, mut highest) = (f64::INFINITY, f64::NEG_INFINITY);
        for period in 0..WARM_UP {
            let w = delayed_loop.step(Time::ZERO, 0.0)?;
            if period >= WARM_UP - AVERAGED_PERIODS {
                steady += w / f64::from(AVERAGED_PERIODS);
                (lowest, highest) = (lowest.min(w.norm()), highest.max(w.norm()));
            }
        }
        let perturbation = match case.law {
            LawId::DqPi | LawId::Deadbeat => PERTURBATION_OF_ADAPTIVE_LAWS,
            _ => PERTURBATION,
        };
        let is_hunting_law = case.law == LawId::BangBang;
        let spread = (highest - lowest) / case.setpoint();
        let perturbation = case.setpoint() * perturbation;
        (spread < if is_hunting_law { HUNT_BAND } else { STEADY_TOLERANCE }).then_some(Self {
            delayed_loop,
            is_hunting_law,
            perturbation,
            steady,
        })
    }

    pub fn perturbed_motion(mut self, delay: Time) -> LoopMotion {
        if self.is_hunting_law {
            return self.hunting_motion(delay);
        }
        let mut windows = [0.0_f64; 2];
        for number in 0..TRANSIENT_PERIODS + 2 * WINDOW {
            let perturbation = if number == 0 { self.perturbation } else { 0.0 };
            let Some(w) = self.delayed_loop.step(delay, perturbation) else { return LoopMotion::Factor(f64::INFINITY) };
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
            [_, late] if late < RESOLUTION * self.delayed_loop.setpoint() / self.perturbation => LoopMotion::Decayed,
            [early, late] => LoopMotion::Factor((late / early).powf(1.0 / WINDOW as f64)),
        }
    }

    /// Applies no perturbation, because a hunting loop oscillates by itself.
    fn hunting_motion(mut self, delay: Time) -> LoopMotion {
        for number in 0..HUNT_PERIODS {
            let Some(w) = self.delayed_loop.step(delay, 0.0) else { return LoopMotion::UnboundedHunting };
            let share = (w.norm() / self.delayed_loop.setpoint() - 1.0).abs();
            if share > HUNT_BAND && number >= HUNT_PERIODS - HUNT_WINDOW {
                return LoopMotion::UnboundedHunting;
            }
        }
        LoopMotion::BoundedHunting
    }
}

/// Longest delay, up to `longest` s, with a stable steady state. `None` without steady state.
pub fn measure_delay_boundary(case: &LoopCase<'_>, longest: f64) -> Option<DelayBoundary> {
    let simulation = LoopSimulation::in_steady_state(case)?;
    Some(search_boundary(case.period(), longest, |delay| simulation.clone().perturbed_motion(delay).is_stable()))
}

/// Longest delay, up to `longest` s, with which |W| reaches and keeps the 5 % band from rest.
pub fn measure_delay_boundary_from_rest(case: &LoopCase<'_>, longest: f64) -> DelayBoundary {
    loop_at_rest(case).map_or(DelayBoundary::Unstable, |at_rest| at_rest.settling_boundary(longest))
}
