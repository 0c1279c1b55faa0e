//! Combines the modes of a plate with optional effects over a step.

use crate::flow::{ExcursionBound, ExponentialSum, ForcedFlow, Forcing, State, Term};
use crate::mode::Mode;
use crate::varying::VaryingFlow;
use num_complex::Complex64;

/// Number of terms: one steady state, and slow pole, fast pole and amplifier of each of two modes.
const TERMS: usize = 7;

#[derive(Debug, Clone, Copy)]
pub(crate) enum ModeMotion {
    Constant(ForcedFlow),
    /// The flow under the constant part of the drive, and the whole drive.
    Varying(VaryingFlow, Forcing),
}

impl ModeMotion {
    /// State from which a motion with the constant `mode` has the same amplitudes of both poles.
    pub(crate) fn start_in(&self, mode: &Mode) -> State {
        match self {
            Self::Constant(flow) => flow.after(0.0),
            Self::Varying(flow, _) => flow.start_in(mode),
        }
    }

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
}

/// The first term is the steady state with pole 0.
impl ExponentialSum<TERMS> for FrozenMotion {
    fn after(&self, seconds: f64) -> State {
        self.map(|flow| flow.after(seconds)).sum()
    }

    fn excursion_bound(&self) -> ExcursionBound {
        let first = self.first.excursion_bound();
        self.second.map_or(first, |second| first.plus(&second.excursion_bound()))
    }

    fn terms(&self) -> (Complex64, [Term; TERMS]) {
        let (rest, [slow, fast, amplifier]) = self.first.terms();
        let (second_rest, second) = self.second.map_or_else(Default::default, |flow| flow.terms());
        let [second_slow, second_fast, second_amplifier] = second;
        let rest = (rest + second_rest, Complex64::ZERO);
        (Complex64::ZERO, [rest, slow, fast, amplifier, second_slow, second_fast, second_amplifier])
    }
}
