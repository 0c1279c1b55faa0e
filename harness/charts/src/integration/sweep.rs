//! Measures cost and error of every method on one replay, over its steps or tolerances.

use crate::integration::failure::MethodFailure;
use crate::integration::fixed::FixedStepMethod;
use crate::integration::method::AdaptiveMethod;
use crate::integration::method::IntegrationMethod;
use crate::integration::replay::{EquationForm, MethodReplay, MethodResult};
use crate::measured_run::{median, thread_cpu_time};
use platebench_plate::{Complex64, Model, Plant};
use std::hint::black_box;
use std::time::Duration;

/// Error in setpoints above which a method has diverged. Even a plate at rest has less.
const MAX_USEFUL_ERROR: f64 = 2.0;
/// Method and tolerance that check the exact propagation. If a profile changes the mode, this
/// method is the reference.
const REFERENCE: (IntegrationMethod, f64) = (IntegrationMethod::Adaptive(AdaptiveMethod::Dop853), 1e-13);
const SLOW_REPLAY: Duration = Duration::from_millis(20);
const MAX_PLANTS: u32 = 4_096;

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SweepConfig {
    pub rounds: u32,
    pub batch: Duration,
    pub setting_stride: usize,
}

#[derive(Debug, Clone, PartialEq, Eq)]
pub enum SolverStatus {
    Ok,
    Diverged,
    Failed(String),
}

impl std::fmt::Display for SolverStatus {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Ok => formatter.write_str("ok"),
            Self::Diverged => formatter.write_str("diverged"),
            Self::Failed(why) => write!(formatter, "failed: {why}"),
        }
    }
}

impl From<MethodFailure> for SolverStatus {
    fn from(failure: MethodFailure) -> Self {
        match failure {
            MethodFailure::Diverged => Self::Diverged,
            failure => Self::Failed(failure.to_string()),
        }
    }
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Solver {
    Exact(Model),
    /// The number is the step in s or the tolerance.
    General(EquationForm, IntegrationMethod, f64),
}

impl Solver {
    pub const fn method(&self) -> &'static str {
        match self {
            Self::Exact(_) => "exact",
            Self::General(_, method, _) => method.name(),
        }
    }

    pub const fn problem(&self) -> &'static str {
        match self {
            Self::Exact(model) => model.name(),
            Self::General(frame, ..) => frame.name(),
        }
    }

    pub const fn is_from_a_crate(&self) -> bool {
        matches!(self, Self::General(_, IntegrationMethod::Adaptive(_), _))
    }
}

#[derive(Debug, Clone, PartialEq)]
pub struct SweepResult {
    pub solver: Solver,
    pub status: SolverStatus,
    /// max |ΔW|/setpoint at the control instants, from the exact solution of the same equations.
    pub numerical_error: f64,
    /// max |ΔW|/setpoint between the exact solutions of these and of the modal equations.
    pub model_error: f64,
    /// max |ΔW|/setpoint between the result and the exact solution of the modal equations.
    pub total_error: f64,
    /// Processor time, ns, per simulated ms.
    pub ns_per_ms: f64,
}

struct SolverTimer<'a> {
    passage: &'a MethodReplay,
    solver: Solver,
    repeats: u32,
    is_slow: bool,
    costs: Vec<f64>,
    outcome: MethodResult,
}

impl SolverTimer<'_> {
    fn measure_cost(&mut self) -> f64 {
        let repeats = self.repeats;
        let (elapsed, seconds) = match self.solver {
            Solver::Exact(model) => {
                let mut plants: Vec<Plant> = (0..repeats).map(|_| self.passage.plant(model)).collect();
                let started = thread_cpu_time();
                for plant in &mut plants {
                    self.passage.advance_plant(plant, |state| {
                        black_box(state);
                    });
                }
                (thread_cpu_time().saturating_sub(started), self.passage.seconds())
            }
            Solver::General(frame, method, setting) => {
                let started = thread_cpu_time();
                for _ in 0..repeats {
                    self.passage.integrate(frame, method, black_box(setting), &mut self.outcome);
                    black_box(&self.outcome);
                }
                (thread_cpu_time().saturating_sub(started), self.outcome.seconds)
            }
        };
        elapsed.as_nanos() as f64 / (f64::from(repeats) * seconds * 1e3)
    }

    /// Sets the number of replays per batch from one replay, which is also the warm-up.
    fn calibrate(&mut self, batch: Duration) {
        self.repeats = 1;
        let once = self.measure_cost();
        let simulated = self.passage.seconds() * 1e3;
        self.is_slow = once * simulated > SLOW_REPLAY.as_nanos() as f64;
        self.repeats = (batch.as_nanos() as f64 / (once * simulated)).ceil().clamp(1.0, f64::from(MAX_PLANTS)) as u32;
    }
}

pub fn sweep(passage: &MethodReplay, effort: &SweepConfig) -> Vec<SweepResult> {
    let truths = ReferenceSolutions::new(passage);
    let exact = Model::ALL.map(Solver::Exact);
    let general = EquationForm::ALL.into_iter().flat_map(|frame| {
        IntegrationMethod::all().flat_map(move |method| {
            settings(frame, method)
                .into_iter()
                .step_by(effort.setting_stride.max(1))
                .map(move |setting| Solver::General(frame, method, setting))
        })
    });
    let mut runners: Vec<SolverTimer<'_>> = exact
        .into_iter()
        .chain(general)
        .map(|contender| SolverTimer {
            passage,
            solver: contender,
            repeats: 1,
            is_slow: false,
            costs: Vec::new(),
            outcome: MethodResult::default(),
        })
        .collect();
    for runner in &mut runners {
        runner.calibrate(effort.batch);
    }
    // Measures the solvers in turn, so that other load affects all of them equally.
    for round in 0..effort.rounds.max(1) {
        for runner in runners.iter_mut().filter(|runner| round == 0 || !runner.is_slow) {
            let cost = runner.measure_cost();
            runner.costs.push(cost);
        }
    }
    runners.into_iter().map(|runner| truths.measure_errors(runner)).collect()
}

struct ReferenceSolutions<'a> {
    passage: &'a MethodReplay,
    /// Samples of the exact propagation and of [`REFERENCE`], per form of the equations.
    by_form: Vec<(EquationForm, [Vec<Complex64>; 2])>,
}

impl<'a> ReferenceSolutions<'a> {
    fn new(passage: &'a MethodReplay) -> Self {
        let of_frame = |frame: EquationForm| {
            let mut tight = MethodResult::default();
            let (method, tolerance) = REFERENCE;
            passage.integrate(frame, method, tolerance, &mut tight);
            (frame, [passage.exact_samples(frame), tight.samples])
        };
        Self { passage, by_form: EquationForm::ALL.map(of_frame).into() }
    }

    fn of(&self, frame: EquationForm) -> [&[Complex64]; 2] {
        let found = self.by_form.iter().find(|(known, _)| *known == frame);
        found.map_or([&[], &[]], |(_, [exact, tight])| [exact, tight])
    }

    /// If the mode varies, the exact propagation needs substeps, so [`REFERENCE`] is better.
    fn best(&self, frame: EquationForm) -> &[Complex64] {
        let [exact, tight] = self.of(frame);
        if self.passage.is_time_varying() { tight } else { exact }
    }

    fn measure_errors(&self, runner: SolverTimer<'_>) -> SweepResult {
        let passage = self.passage;
        let (samples, frame, failure) = match runner.solver {
            Solver::Exact(model) => (passage.samples(model, EquationForm::Modal), form_of_model(model), None),
            Solver::General(frame, ..) => (runner.outcome.samples, frame, runner.outcome.failure),
        };
        let own = match runner.solver {
            // No general method solves this model's equations, so their error is all model error.
            Solver::Exact(Model::Linear) => &samples,
            Solver::Exact(_) => self.of(frame)[1],
            Solver::General(..) => self.best(frame),
        };
        // The carrier's phasor differs from W, so its reference is the phasor of the exact motion.
        let truth = match frame {
            EquationForm::Envelope | EquationForm::Modal => EquationForm::Modal,
            EquationForm::Carrier => EquationForm::Carrier,
        };
        let error = |truth| if failure.is_some() { f64::INFINITY } else { passage.relative_error(&samples, truth) };
        let numerical_error = error(own);
        let status = match failure {
            Some(failure) => failure.into(),
            None if numerical_error < MAX_USEFUL_ERROR => SolverStatus::Ok,
            None => SolverStatus::Diverged,
        };
        SweepResult {
            solver: runner.solver,
            status,
            numerical_error,
            model_error: match runner.solver {
                Solver::Exact(Model::Linear) => error(self.best(truth)),
                _ => passage.relative_error(self.best(frame), self.best(truth)),
            },
            total_error: error(self.best(truth)),
            ns_per_ms: median(runner.costs),
        }
    }
}

/// Equations whose W the model computes. The linear model simplifies the envelope equations.
const fn form_of_model(model: Model) -> EquationForm {
    match model {
        Model::Linear | Model::Envelope => EquationForm::Envelope,
        Model::Modal | Model::Carrier => EquationForm::Modal,
    }
}

/// Steps in s or tolerances, from coarse to fine. Empty if the method does not support the form.
fn settings(form: EquationForm, method: IntegrationMethod) -> Vec<f64> {
    use EquationForm::{Carrier, Envelope, Modal};
    use FixedStepMethod::{Euler, Exponential, Gauss4, Gauss6, KeptExponential, Verlet};
    let halved = |powers: &[i32]| powers.iter().map(|power| 1e-3 * 0.5_f64.powi(*power)).collect();
    let decades = |from: i32, to: i32| (from..=to).map(|decade| 10.0_f64.powi(-decade)).collect();
    let method = match method {
        IntegrationMethod::Adaptive(AdaptiveMethod::Dopri5) => return decades(2, 11),
        IntegrationMethod::Adaptive(_) => return decades(2, 12),
        IntegrationMethod::Fixed(method) => method,
    };
    match (method, form) {
        // Verlet needs a real position. A step matrix needs equations that do not depend on time.
        (Verlet, Envelope | Modal) | (Gauss4 | Gauss6 | Exponential | KeptExponential, Carrier) => Vec::new(),
        (Exponential | KeptExponential, Envelope | Modal) => halved(&[0]),
        (_, Envelope) => halved(&[0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 12]),
        // Explicit Euler is stable from 155 000 steps per ms, and on the carrier from 39 000.
        (Euler, Modal) => halved(&[8, 12, 16, 17, 18, 19]),
        (Euler, Carrier) => halved(&[8, 12, 15, 16, 17, 18]),
        (_, Modal | Carrier) => halved(&[5, 6, 7, 8, 9, 10, 11, 12, 13, 14]),
    }
}

/// The closed form is excluded.
pub fn cheapest_method<'a>(measured: &'a [SweepResult], problem: &str, error: f64) -> Option<&'a SweepResult> {
    cheapest(measured, problem, error, |solver| matches!(solver, Solver::General(..)))
}

pub fn cheapest_from_a_crate<'a>(measured: &'a [SweepResult], problem: &str, error: f64) -> Option<&'a SweepResult> {
    cheapest(measured, problem, error, Solver::is_from_a_crate)
}

fn cheapest<'a>(
    measured: &'a [SweepResult],
    problem: &str,
    error: f64,
    is_peer: impl Fn(&Solver) -> bool,
) -> Option<&'a SweepResult> {
    let fits = |candidate: &&SweepResult| {
        is_peer(&candidate.solver)
            && candidate.solver.problem() == problem
            && candidate.status == SolverStatus::Ok
            && candidate.numerical_error <= error
    };
    measured.iter().filter(fits).min_by(|a, b| a.ns_per_ms.total_cmp(&b.ns_per_ms))
}
