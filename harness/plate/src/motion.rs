//! Combines the modes of a plate over a step, and stores past steps for a sensor with latency.

use crate::amplifier::Forcing;
use crate::flow::{ExcursionBound, State};
use crate::forced_flow::ForcedFlow;
use crate::mode::Mode;
use crate::time::Time;
use crate::varying::VaryingFlow;
use num_complex::Complex64;
use std::collections::VecDeque;

/// Number of terms: one steady state, and slow pole, fast pole and amplifier of each of two modes.
const TERMS: usize = 7;

#[derive(Debug, Clone, Copy)]
pub(crate) enum ModeMotion {
    Constant(ForcedFlow),
    /// The flow under the constant part of the drive, and the whole drive.
    Varying(VaryingFlow, Forcing),
}

impl ModeMotion {
    fn after(&self, seconds: f64) -> State {
        match self {
            Self::Constant(flow) => flow.after(seconds),
            Self::Varying(flow, forcing) => {
                let constant = flow.after(seconds);
                if forcing.slope == 0.0 && forcing.decaying == 0.0 {
                    return constant;
                }
                let State { w, u } = flow.response_to(forcing, seconds);
                State { w: constant.w + w, u: constant.u + u }
            }
        }
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(crate) struct PerMode<T> {
    pub(crate) first: T,
    pub(crate) second: Option<T>,
}

impl<T: Copy> PerMode<T> {
    pub(crate) fn map<R>(self, of: impl Fn(T) -> R) -> PerMode<R> {
        PerMode { first: of(self.first), second: self.second.map(of) }
    }

    pub(crate) fn zip<U: Copy>(self, other: PerMode<U>) -> PerMode<(T, U)> {
        PerMode { first: (self.first, other.first), second: self.second.zip(other.second) }
    }
}

impl PerMode<State> {
    pub(crate) fn sum(&self) -> State {
        let State { w, u } = self.second.unwrap_or_default();
        State { w: self.first.w + w, u: self.first.u + u }
    }
}

pub(crate) type Motion = PerMode<ModeMotion>;

/// Motion while the modes are constant.
pub(crate) type FrozenMotion = PerMode<ForcedFlow>;

impl Motion {
    pub(crate) fn after(&self, seconds: f64) -> PerMode<State> {
        self.map(|motion| motion.after(seconds))
    }
}

impl FrozenMotion {
    pub(crate) fn new(modes: PerMode<Mode>, omega: f64, forcing: &Forcing, states: PerMode<State>) -> Self {
        modes.zip(states).map(|(mode, state)| ForcedFlow::new(&mode, omega, forcing, &state))
    }

    pub(crate) fn excursion_bound(&self) -> ExcursionBound {
        let first = self.first.excursion_bound();
        self.second.map_or(first, |second| first.plus(&second.excursion_bound()))
    }

    /// Pairs (amplitude in µm, pole in 1/s) of `W = Σ amplitude e^{pole t}`. The first pair is the
    /// steady state with pole 0.
    pub(crate) fn terms(&self) -> [(Complex64, Complex64); TERMS] {
        let (rest, [slow, fast, amplifier]) = self.first.terms();
        let (second_rest, second) = self.second.map_or_else(Default::default, |flow| flow.terms());
        let [second_slow, second_fast, second_amplifier] = second;
        let rest = (rest + second_rest, Complex64::ZERO);
        [rest, slow, fast, amplifier, second_slow, second_fast, second_amplifier]
    }
}

#[derive(Debug, Clone)]
pub(crate) struct MotionHistory {
    latency: Time,
    /// Start time and motion of each step that is needed for the last `latency`.
    motions: VecDeque<(Time, Motion)>,
}

impl MotionHistory {
    pub(crate) fn new(latency: Time) -> Self {
        Self { latency, motions: VecDeque::with_capacity(1024) }
    }

    pub(crate) fn push(&mut self, start: Time, motion: &Motion) {
        while self.motions.get(1).is_some_and(|(next, _)| *next + self.latency <= start) {
            self.motions.pop_front();
        }
        self.motions.push_back((start, *motion));
    }

    /// W at `now` minus the latency; 0 if this is before the start of the trial.
    pub(crate) fn read(&self, now: Time) -> Complex64 {
        if now < self.latency {
            return Complex64::ZERO;
        }
        let then = now - self.latency;
        let motion = self.motions.iter().rev().find(|(start, _)| *start <= then);
        motion.map_or(Complex64::ZERO, |(start, motion)| motion.after((then - *start).seconds()).sum().w)
    }
}
