//! Tests order, stability and tolerance of the methods.

use platebench_charts::integration::FixedStepMethod;
use platebench_charts::integration::problem::{CarrierProblem, EnvelopeProblem, ModalProblem, ProblemParameters};
use platebench_charts::integration::sweep::cheapest_from_a_crate;
use platebench_charts::integration::{
    AdaptiveMethod, EquationForm, IntegrationMethod, MethodReplay, MethodResult, ReplaySpec, Solver, SolverStatus,
    SweepConfig, sweep,
};
use platebench_plate::{Complex64, ConditionProfiles, Conditions, Drive, Mode, Model, Profile, State, Time};
use platebench_test_kit::paper_plate;
use rstest::rstest;
use std::time::Duration;

pub(crate) fn ms(ms: f64) -> Time {
    Time::from_ms(ms).unwrap()
}

pub(crate) fn constant_scene() -> ConditionProfiles {
    ConditionProfiles { temperature_offset_k: Profile::constant(0.0), finger_force_n: Profile::constant(0.5) }
}

pub(crate) fn replay_from_rest(scene: &ConditionProfiles, periods: u32) -> MethodReplay {
    let plate = paper_plate();
    let drive = |vpp: f64, detuning: f64| Drive { vpp, omega: plate.omega0 + detuning };
    let drives = [(ms(0.0), drive(500.0, -545.0)), (ms(1.0), drive(200.0, -200.0)), (ms(2.4), drive(290.0, 30.0))];
    let course = ReplaySpec {
        plate: &plate,
        scene,
        drives: &drives,
        period: ms(1.0),
        end: ms(f64::from(periods)),
        setpoint_um: 2.0,
    };
    MethodReplay::new(&course)
}

fn integrate_replay(
    passage: &MethodReplay,
    frame: EquationForm,
    method: IntegrationMethod,
    setting: f64,
) -> MethodResult {
    let mut outcome = MethodResult::default();
    passage.integrate(frame, method, setting, &mut outcome);
    outcome
}

fn integration_error(
    passage: &MethodReplay,
    frame: EquationForm,
    method: IntegrationMethod,
    setting: f64,
    truth: &[Complex64],
) -> f64 {
    let outcome = integrate_replay(passage, frame, method, setting);
    assert_eq!(outcome.failure, None);
    passage.relative_error(&outcome.samples, truth)
}

/// With a varying matrix, methods with a step matrix have order 2, because they use the matrix at
/// mid-step.
fn order(method: FixedStepMethod) -> u32 {
    match method {
        FixedStepMethod::Euler => 1,
        FixedStepMethod::Midpoint | FixedStepMethod::Verlet | FixedStepMethod::Splitting => 2,
        FixedStepMethod::RungeKutta4 | FixedStepMethod::Gauss4 => 4,
        FixedStepMethod::Gauss6 => 6,
        // Their error does not depend on the step.
        FixedStepMethod::Exponential | FixedStepMethod::KeptExponential => 0,
    }
}

#[rstest]
#[case(EquationForm::Envelope, FixedStepMethod::Euler, 6)]
#[case(EquationForm::Envelope, FixedStepMethod::RungeKutta4, 3)]
#[case(EquationForm::Envelope, FixedStepMethod::Midpoint, 5)]
#[case(EquationForm::Envelope, FixedStepMethod::Gauss4, 1)]
#[case(EquationForm::Envelope, FixedStepMethod::Gauss6, 0)]
#[case(EquationForm::Modal, FixedStepMethod::RungeKutta4, 12)]
#[case(EquationForm::Modal, FixedStepMethod::Midpoint, 13)]
#[case(EquationForm::Modal, FixedStepMethod::Gauss4, 11)]
#[case(EquationForm::Modal, FixedStepMethod::Gauss6, 10)]
#[case(EquationForm::Carrier, FixedStepMethod::RungeKutta4, 12)]
#[case(EquationForm::Carrier, FixedStepMethod::Midpoint, 13)]
#[case(EquationForm::Carrier, FixedStepMethod::Verlet, 13)]
#[case(EquationForm::Envelope, FixedStepMethod::Splitting, 5)]
#[case(EquationForm::Modal, FixedStepMethod::Splitting, 13)]
#[case(EquationForm::Carrier, FixedStepMethod::Splitting, 13)]
fn each_method_converges_with_its_order(
    #[case] frame: EquationForm,
    #[case] method: FixedStepMethod,
    #[case] power: i32,
) {
    let passage = replay_from_rest(&constant_scene(), 3);
    let truth = passage.exact_samples(frame);
    let error = |power: i32| {
        integration_error(&passage, frame, IntegrationMethod::Fixed(method), 1e-3 * 0.5_f64.powi(power), &truth)
    };
    let slope = (error(power) / error(power + 1)).log2();
    assert!((slope - f64::from(order(method))).abs() < 0.12, "{slope}");
}

#[rstest]
#[case(EquationForm::Envelope, FixedStepMethod::RungeKutta4, 3)]
#[case(EquationForm::Envelope, FixedStepMethod::Midpoint, 5)]
#[case(EquationForm::Modal, FixedStepMethod::RungeKutta4, 12)]
#[case(EquationForm::Carrier, FixedStepMethod::Verlet, 13)]
#[case(EquationForm::Envelope, FixedStepMethod::Splitting, 5)]
#[case(EquationForm::Modal, FixedStepMethod::Splitting, 13)]
#[case(EquationForm::Carrier, FixedStepMethod::Splitting, 13)]
fn a_varying_mode_keeps_the_order(#[case] frame: EquationForm, #[case] method: FixedStepMethod, #[case] power: i32) {
    let passage = replay_from_rest(&varying_scene(), 2);
    assert!(passage.is_time_varying());
    let truth = integrate_replay(&passage, frame, IntegrationMethod::Adaptive(AdaptiveMethod::Dop853), 1e-13).samples;
    let error = |power: i32| {
        integration_error(&passage, frame, IntegrationMethod::Fixed(method), 1e-3 * 0.5_f64.powi(power), &truth)
    };
    let slope = (error(power) / error(power + 1)).log2();
    assert!((slope - f64::from(order(method))).abs() < 0.15, "{slope}");
}

#[test]
fn splitting_without_damping_does_not_drift() {
    let plate = paper_plate();
    let mode = Mode { sigma: 0.0, ..plate.mode(&Conditions::default()) };
    let free = ProblemParameters::constant(mode, Drive { vpp: 0.0, omega: mode.omega0 + 545.0 });
    let scale = mode.omega0;
    // Start of the slow motion: W turns with ω0 − ω, so U = jω0 W.
    let w = Complex64::new(2.0, 0.0);
    let state = State { w, u: Complex64::I * mode.omega0 * w };
    let splitting = FixedStepMethod::Splitting;
    let envelope =
        splitting.advance(&EnvelopeProblem::new(&free), EnvelopeProblem::pack(&state), 4.0, 4_000, &mut None).unwrap();
    let modal = splitting
        .advance(&ModalProblem::new(&free, scale), ModalProblem::pack(&state, scale), 4.0, 4_000, &mut None)
        .unwrap();
    let carrier = CarrierProblem::new(&free, 0.0, scale);
    let last = splitting.advance(&carrier, CarrierProblem::pack(&state, 0.0, scale), 4.0, 4_000, &mut None).unwrap();
    let amplitudes = [
        EnvelopeProblem::unpack(&envelope).w.norm(),
        ModalProblem::unpack(&modal, scale).w.norm(),
        last[0].hypot(last[1]),
    ];
    assert!(amplitudes.iter().all(|amplitude| (amplitude / 2.0 - 1.0).abs() < 1e-11), "{amplitudes:?}");
}

#[rstest]
fn the_matrix_exponential_is_exact_to_rounding(
    #[values(EquationForm::Envelope, EquationForm::Modal)] frame: EquationForm,
    #[values(FixedStepMethod::Exponential, FixedStepMethod::KeptExponential)] method: FixedStepMethod,
) {
    let passage = replay_from_rest(&constant_scene(), 40);
    let method = IntegrationMethod::Fixed(method);
    let error = integration_error(&passage, frame, method, 1e-3, &passage.exact_samples(frame));
    assert!(error < 1e-10, "{error:e}");
}

/// The force rises to 1 N in 5 ms, twenty times as fast as the finger in the paper.
pub(crate) fn varying_scene() -> ConditionProfiles {
    let line = toml::from_str::<Document>("p = { linear = [[0.0, 0.0], [5.0, 1.0]] }").unwrap().p;
    ConditionProfiles {
        temperature_offset_k: Profile::constant(0.0),
        finger_force_n: line.check(&[], platebench_plate::Time::ZERO).unwrap(),
    }
}

#[derive(serde::Deserialize)]
struct Document {
    p: platebench_plate::RawProfile,
}

/// The bound is 200 times the tolerance, because errors add up over 65 oscillations per ms.
#[rstest]
fn crates_reach_their_tolerance(
    #[values(EquationForm::Envelope, EquationForm::Modal, EquationForm::Carrier)] frame: EquationForm,
    #[values(AdaptiveMethod::Dopri5, AdaptiveMethod::Dop853)] method: AdaptiveMethod,
) {
    reaches_its_tolerance(frame, method);
}

fn reaches_its_tolerance(frame: EquationForm, method: AdaptiveMethod) {
    let passage = replay_from_rest(&constant_scene(), 3);
    let truth = passage.exact_samples(frame);
    let error = |tolerance| integration_error(&passage, frame, IntegrationMethod::Adaptive(method), tolerance, &truth);
    let [coarse, fine] = [1e-7, 1e-10].map(error);
    assert!(fine < 200.0 * 1e-10, "{fine:e}");
    // With the dense output of `ode_solvers`, a smaller tolerance would not reduce the error.
    assert!(fine < 0.01 * coarse || coarse < 1e-9, "{coarse:e} {fine:e}");
}

#[rstest]
fn optional_crates_reach_their_tolerance(
    #[values(EquationForm::Envelope, EquationForm::Modal, EquationForm::Carrier)] frame: EquationForm,
    #[values(AdaptiveMethod::DeDop853, AdaptiveMethod::DeVerner98)] method: AdaptiveMethod,
) {
    reaches_its_tolerance(frame, method);
}

/// The bound exceeds the tolerance, because low-order methods take thousands of small steps.
#[cfg(feature = "diffsol")]
#[rstest]
fn a_tighter_tolerance_reduces_the_error_of_diffsol(
    #[values(EquationForm::Envelope, EquationForm::Modal, EquationForm::Carrier)] frame: EquationForm,
    #[values(AdaptiveMethod::DiffsolBdf, AdaptiveMethod::DiffsolEsdirk34, AdaptiveMethod::DiffsolTsit45)]
    method: AdaptiveMethod,
) {
    let passage = replay_from_rest(&constant_scene(), 3);
    let truth = passage.exact_samples(frame);
    let error = |tolerance| integration_error(&passage, frame, IntegrationMethod::Adaptive(method), tolerance, &truth);
    let [coarse, fine] = [1e-7, 1e-10].map(error);
    assert!(fine < 0.1 * coarse && fine < 1e-5, "{coarse:e} {fine:e}");
}

#[test]
fn closed_form_and_integrator_agree_on_a_varying_mode() {
    let passage = replay_from_rest(&varying_scene(), 3);
    for frame in EquationForm::ALL {
        let tight =
            integrate_replay(&passage, frame, IntegrationMethod::Adaptive(AdaptiveMethod::Dop853), 1e-13).samples;
        // `docs/mathematics.md` derives the error bound for a varying mode.
        let error = passage.relative_error(&passage.exact_samples(frame), &tight);
        assert!(error < 8.4e-7, "{frame:?} {error:e}");
    }
}

#[test]
fn failures_are_reported() {
    let passage = replay_from_rest(&constant_scene(), 3);
    let failed = |frame, method, setting| {
        integrate_replay(&passage, frame, method, setting).failure.map(|failure| failure.to_string())
    };
    assert_eq!(
        failed(EquationForm::Modal, IntegrationMethod::Fixed(FixedStepMethod::RungeKutta4), 7.1e-6).as_deref(),
        Some("diverged")
    );
    assert_eq!(failed(EquationForm::Modal, IntegrationMethod::Fixed(FixedStepMethod::RungeKutta4), 6.9e-6), None);
    assert_eq!(
        failed(EquationForm::Envelope, IntegrationMethod::Fixed(FixedStepMethod::Verlet), 1e-3).as_deref(),
        Some("unsupported form of problem")
    );
    assert!(failed(EquationForm::Modal, IntegrationMethod::Adaptive(AdaptiveMethod::Dop853), 1e-30).is_some());
    let stuck =
        integrate_replay(&passage, EquationForm::Modal, IntegrationMethod::Fixed(FixedStepMethod::RungeKutta4), 7.1e-6);
    assert!(
        stuck.samples.len() < 3
            && passage.relative_error(&stuck.samples, &passage.exact_samples(EquationForm::Modal)).is_infinite()
    );
}

#[test]
fn a_sweep_covers_every_problem_and_marks_failures() {
    let passage = replay_from_rest(&constant_scene(), 3);
    let measured = sweep(&passage, &SweepConfig { rounds: 1, batch: Duration::ZERO, setting_stride: 4 });
    for model in Model::ALL {
        let exact = measured.iter().find(|row| row.solver == Solver::Exact(model)).unwrap();
        assert!(exact.numerical_error < 1e-9 && exact.status == SolverStatus::Ok, "{exact:?}");
    }
    for row in &measured {
        assert!(row.ns_per_ms > 0.0 && row.ns_per_ms.is_finite(), "{row:?}");
        assert_eq!(
            row.status == SolverStatus::Ok,
            row.numerical_error.is_finite() && row.numerical_error < 2.0,
            "{row:?}"
        );
        assert!(
            row.total_error <= row.numerical_error + row.model_error + 1e-9 || row.total_error.is_infinite(),
            "{row:?}"
        );
    }
    assert!(measured.iter().any(|row| row.status == SolverStatus::Diverged));
    let peer = cheapest_from_a_crate(&measured, "modal", 1e-6).unwrap();
    assert!(peer.solver.is_from_a_crate() && peer.numerical_error <= 1e-6);
    assert!(cheapest_from_a_crate(&measured, "modal", 0.0).is_none());
}

#[test]
fn only_varying_conditions_make_a_mode_vary() {
    let mode = paper_plate().mode(&Conditions::default());
    let still = ProblemParameters::constant(mode, Drive::default());
    assert!(
        !still.is_time_varying()
            && ProblemParameters { sigma_rate: 1.0, ..still }.is_time_varying()
            && ProblemParameters { omega0_rate: -1.0, ..still }.is_time_varying()
    );
}
