//! Replays the drives of a part of a trial with any model or integration method.

use crate::integration::failure::MethodFailure;
use crate::integration::method::IntegrationMethod;
use crate::integration::problem::{
    CarrierProblem, ConstantMode, EnvelopeProblem, ModalProblem, ProblemParameters, TimeVarying, with_clock,
};
use platebench_plate::{Complex64, ConditionProfiles, Drive, Model, Plant, Plate, State, Time};
use std::f64::consts::TAU;

#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, strum::IntoStaticStr)]
#[strum(const_into_str, serialize_all = "lowercase")]
pub enum EquationForm {
    Envelope,
    Modal,
    Carrier,
}

impl EquationForm {
    pub const ALL: [Self; 3] = [Self::Envelope, Self::Modal, Self::Carrier];

    pub const fn name(self) -> &'static str {
        self.into_str()
    }

    pub const fn model(self) -> Model {
        match self {
            Self::Envelope => Model::Envelope,
            Self::Modal | Self::Carrier => Model::Modal,
        }
    }
}

#[derive(Debug, Clone, Copy)]
pub(crate) struct ReplayInterval {
    pub(crate) end: Time,
    seconds: f64,
    pub(crate) situation: ProblemParameters,
    /// Phase of the excitation at the start, rad.
    theta: f64,
    ends_at_control: bool,
}

impl ReplayInterval {
    fn end_theta(&self) -> f64 {
        self.theta + self.situation.drive.omega * self.seconds
    }
}

#[derive(Debug, Clone, Copy)]
pub struct ReplaySpec<'a> {
    pub plate: &'a Plate,
    pub scene: &'a ConditionProfiles,
    /// Drives and the times from which they act, in order of time.
    pub drives: &'a [(Time, Drive)],
    pub period: Time,
    pub end: Time,
    pub setpoint_um: f64,
}

#[derive(Debug, Clone)]
pub struct MethodReplay {
    plate: Plate,
    scene: ConditionProfiles,
    intervals: Vec<ReplayInterval>,
    setpoint_um: f64,
    scale: f64,
}

#[derive(Debug, Clone, PartialEq, Default)]
pub struct MethodResult {
    /// W at the control instants, µm. For the carrier equations it is the phasor of y and y'.
    pub samples: Vec<Complex64>,
    pub seconds: f64,
    pub failure: Option<MethodFailure>,
}

impl MethodReplay {
    /// Splits the trial at every control instant, drive change and profile point. Assumes that σ
    /// and ω0 are linear between these instants, as with most profiles and damping curves.
    pub fn new(course: &ReplaySpec<'_>) -> Self {
        let ReplaySpec { plate, scene, drives, period, end, setpoint_um } = *course;
        let mut drives = drives.iter().copied().peekable();
        let (mut now, mut drive, mut theta) = (Time::ZERO, Drive::default(), 0.0);
        let mut pieces = Vec::new();
        while now < end {
            while let Some((_, next)) = drives.next_if(|(from, _)| *from <= now) {
                drive = next;
            }
            let control = period.next_multiple_after(now);
            let also = [drives.peek().map(|(from, _)| *from), scene.next_point_after(now)];
            let until = also.into_iter().flatten().fold(control.min(end), Time::min);
            let seconds = (until - now).seconds();
            // The rate is measured up to the middle, because a profile may jump at `until`.
            let (from, to) = (plate.mode(&scene.at(now)), plate.mode(&scene.at(now.midpoint(until))));
            let rate = |from: f64, to: f64| 2.0 * (to - from) / seconds;
            let situation = ProblemParameters {
                mode: from,
                sigma_rate: rate(from.sigma, to.sigma),
                omega0_rate: rate(from.omega0, to.omega0),
                drive,
            };
            let piece = ReplayInterval { end: until, seconds, situation, theta, ends_at_control: until == control };
            theta = piece.end_theta() % TAU;
            pieces.push(piece);
            now = until;
        }
        Self { plate: plate.clone(), scene: scene.clone(), intervals: pieces, setpoint_um, scale: plate.omega0 }
    }

    /// True if a profile changes σ or ω0 in an interval. The exact propagation then uses substeps.
    pub fn is_time_varying(&self) -> bool {
        self.intervals.iter().any(|piece| piece.situation.is_time_varying())
    }

    pub fn seconds(&self) -> f64 {
        self.intervals.iter().map(|piece| piece.seconds).sum()
    }

    pub(crate) fn intervals(&self) -> &[ReplayInterval] {
        &self.intervals
    }

    /// Angular frequency by which the equations divide velocities, rad/s.
    pub(crate) const fn scale(&self) -> f64 {
        self.scale
    }

    pub fn plant(&self, model: Model) -> Plant {
        Plant::new(self.plate.clone(), self.scene.clone(), model)
    }

    /// Calls `see` with the state at each control instant.
    pub fn advance_plant(&self, plant: &mut Plant, mut see: impl FnMut(State)) {
        let mut crossings = Vec::new();
        for piece in &self.intervals {
            plant.set_drive(piece.situation.drive);
            plant.advance(piece.end, &[], &mut crossings);
            if piece.ends_at_control {
                see(plant.state());
            }
        }
    }

    pub fn exact_samples(&self, frame: EquationForm) -> Vec<Complex64> {
        self.samples(frame.model(), frame)
    }

    /// Samples of the exact propagation with `model`, in the form of `frame`.
    pub(crate) fn samples(&self, model: Model, frame: EquationForm) -> Vec<Complex64> {
        let mut states = Vec::new();
        self.advance_plant(&mut self.plant(model), |state| states.push(state));
        let ends = self.intervals.iter().filter(|piece| piece.ends_at_control);
        let seen = |(state, piece): (State, &ReplayInterval)| match frame {
            EquationForm::Envelope | EquationForm::Modal => state.w,
            EquationForm::Carrier => {
                let theta = piece.end_theta();
                let problem = CarrierProblem::new(&piece.situation, theta, self.scale);
                problem.phasor(&CarrierProblem::pack(&state, theta, self.scale))
            }
        };
        states.into_iter().zip(ends).map(seen).collect()
    }

    /// [`IntegrationMethod::advance`] defines `setting`. Reuses the memory of `outcome`.
    pub fn integrate(&self, frame: EquationForm, method: IntegrationMethod, setting: f64, outcome: &mut MethodResult) {
        outcome.samples.clear();
        (outcome.seconds, outcome.failure) = (0.0, None);
        let played = match frame {
            EquationForm::Envelope => self.integrate_phasors::<_, 2, 3>(
                method,
                setting,
                outcome,
                EnvelopeProblem::new,
                EnvelopeProblem::unpack,
            ),
            EquationForm::Modal => self.integrate_phasors::<_, 4, 5>(
                method,
                setting,
                outcome,
                |situation| ModalProblem::new(situation, self.scale),
                |x| ModalProblem::unpack(x, self.scale),
            ),
            EquationForm::Carrier => self.integrate_carrier(method, setting, outcome),
        };
        outcome.failure = played.err();
    }

    /// Integrates N components in the rotating frame. If σ or ω0 varies, adds the clock: M = N + 1.
    fn integrate_phasors<P: ConstantMode<N>, const N: usize, const M: usize>(
        &self,
        method: IntegrationMethod,
        setting: f64,
        outcome: &mut MethodResult,
        problem: impl Fn(&ProblemParameters) -> P,
        unpack: impl Fn(&[f64; N]) -> State,
    ) -> Result<(), MethodFailure> {
        let (mut x, mut kept) = ([0.0; N], None);
        for ReplayInterval { seconds, situation, ends_at_control, .. } in &self.intervals {
            outcome.seconds += seconds;
            let problem = problem(situation);
            if situation.is_time_varying() {
                let varying = TimeVarying::new(problem, situation);
                let start: [f64; M] = with_clock(x, 0.0);
                x.copy_from_slice(&method.advance(&varying, start, *seconds, setting, &mut None)?[..N]);
            } else {
                x = method.advance(&problem, x, *seconds, setting, &mut kept)?;
            }
            if *ends_at_control {
                outcome.samples.push(unpack(&x).w);
            }
        }
        Ok(())
    }

    fn integrate_carrier(
        &self,
        method: IntegrationMethod,
        setting: f64,
        outcome: &mut MethodResult,
    ) -> Result<(), MethodFailure> {
        let mut x = [0.0; 3];
        for ReplayInterval { seconds, situation, theta, ends_at_control, .. } in &self.intervals {
            outcome.seconds += seconds;
            let problem = CarrierProblem::new(situation, *theta, self.scale);
            x = method.advance(&problem, x, *seconds, setting, &mut None)?;
            if *ends_at_control {
                outcome.samples.push(problem.phasor(&x));
            }
            x[2] = 0.0;
        }
        Ok(())
    }

    /// max |ΔW|/setpoint over all samples. Infinite if `samples` is shorter than `truth`.
    pub fn relative_error(&self, samples: &[Complex64], truth: &[Complex64]) -> f64 {
        if samples.len() < truth.len() {
            return f64::INFINITY;
        }
        let largest = samples.iter().zip(truth).map(|(a, b)| (a - b).norm()).fold(0.0, f64::max);
        largest / self.setpoint_um
    }
}
