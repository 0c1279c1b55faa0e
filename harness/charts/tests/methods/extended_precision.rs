//! Measures the error of the exact propagation, which is the reference of the sweep, against a
//! solution with about 31 decimal digits.

use platebench_charts::integration::{
    AdaptiveMethod, EquationForm, IntegrationMethod, MethodReplay, MethodResult, ReplaySpec,
};
use platebench_plate::{Complex64, ConditionProfiles, Drive, Mode, Profile, Time};
use platebench_test_kit::paper_plate;
use rstest::rstest;
use std::array::from_fn;
use twofloat::TwoFloat;

const PERIODS: u32 = 40;
const SETPOINT_UM: f64 = 2.0;

type Matrix<const N: usize> = [[TwoFloat; N]; N];

fn exact(value: f64) -> TwoFloat {
    TwoFloat::from(value)
}

fn product<const N: usize>(left: &Matrix<N>, right: &Matrix<N>) -> Matrix<N> {
    from_fn(|row| from_fn(|column| (0..N).fold(exact(0.0), |sum, inner| sum + left[row][inner] * right[inner][column])))
}

fn identity<const N: usize>() -> Matrix<N> {
    from_fn(|row| from_fn(|column| exact(f64::from(u8::from(row == column)))))
}

/// e^(Ah): a Taylor series of 24 terms at a norm of at most 0.5, then repeated squaring.
fn exponential<const N: usize>(matrix: &Matrix<N>, seconds: TwoFloat) -> Matrix<N> {
    let norm = |a: &Matrix<N>| a.iter().map(|row| row.iter().map(|x| x.hi().abs()).sum()).fold(0.0_f64, f64::max);
    let mut a: Matrix<N> = matrix.map(|row| row.map(|value| value * seconds));
    let mut squarings = 0;
    while norm(&a) > 0.5 {
        a = a.map(|row| row.map(|value| value * exact(0.5)));
        squarings += 1;
    }
    let (mut sum, mut term) = (identity::<N>(), identity::<N>());
    for n in 1..=24 {
        term = product(&term, &a).map(|row| row.map(|value| value / exact(f64::from(n))));
        sum = from_fn(|row| from_fn(|column| sum[row][column] + term[row][column]));
    }
    (0..squarings).fold(sum, |power, _| product(&power, &power))
}

/// W after every interval, from rest. The last component of the state is the constant 1, which
/// multiplies the drive.
fn samples<const N: usize>(intervals: &[(Mode, Drive)], matrix: impl Fn(&Mode, &Drive) -> Matrix<N>) -> Vec<Complex64> {
    let period = exact(1.0) / exact(1_000.0);
    let mut x: [TwoFloat; N] = from_fn(|row| exact(f64::from(u8::from(row == N - 1))));
    let step = |(mode, drive): &(Mode, Drive)| {
        let propagator = exponential(&matrix(mode, drive), period);
        x = from_fn(|row| (0..N).fold(exact(0.0), |sum, column| sum + propagator[row][column] * x[column]));
        Complex64::new(x[0].hi(), x[1].hi())
    };
    intervals.iter().map(step).collect()
}

/// `W' = −σW − j(ω − ω0)W + bV`. The state is `[Re W, Im W, 1]`.
fn envelope(mode: &Mode, drive: &Drive) -> Matrix<3> {
    let zero = exact(0.0);
    let sigma = exact(mode.sigma);
    let detuning = exact(drive.omega) - exact(mode.omega0);
    let force = exact(mode.envelope_constant) * exact(drive.vpp);
    [[-sigma, detuning, force], [-detuning, -sigma, zero], [zero; 3]]
}

/// `W' = U − jωW`, `U' = −jωU − 2σU − ω0²W + j(N/m)V`. The state is `[Re W, Im W, Re U/ω0, Im U/ω0,
/// 1]`.
fn modal(mode: &Mode, drive: &Drive) -> Matrix<5> {
    let zero = exact(0.0);
    let (damping, omega, omega0) = (exact(2.0) * exact(mode.sigma), exact(drive.omega), exact(mode.omega0));
    let force = exact(mode.force_constant) * exact(drive.vpp) / omega0;
    [
        [zero, omega, omega0, zero, zero],
        [-omega, zero, zero, omega0, zero],
        [-omega0, zero, -damping, omega, zero],
        [zero, -omega0, -omega, -damping, force],
        [zero; 5],
    ]
}

/// A replay under 0.5 N whose excitation changes in every period, as with a controller.
fn case() -> (MethodReplay, Vec<(Mode, Drive)>) {
    let plate = paper_plate();
    let scene =
        ConditionProfiles { temperature_offset_k: Profile::constant(0.0), finger_force_n: Profile::constant(0.5) };
    let drive = |k: u32| Drive {
        vpp: 500.0 - 5.3 * f64::from(k),
        omega: plate.omega0 - 545.0 * (1.0 - f64::from(k) / f64::from(PERIODS)),
    };
    let start = |k: u32| Time::from_ms(f64::from(k)).unwrap();
    let drives: Vec<(Time, Drive)> = (0..PERIODS).map(|k| (start(k), drive(k))).collect();
    let mode = plate.mode(&scene.at(Time::ZERO));
    let intervals = drives.iter().map(|(_, drive)| (mode, *drive)).collect();
    let replay = MethodReplay::new(&ReplaySpec {
        plate: &plate,
        scene: &scene,
        drives: &drives,
        period: start(1),
        end: start(PERIODS),
        setpoint_um: SETPOINT_UM,
    });
    (replay, intervals)
}

#[rstest]
#[case(EquationForm::Envelope, 1e-15, 1e-12)]
#[case(EquationForm::Modal, 1e-13, 1e-10)]
fn the_exact_propagation_is_exact_to_rounding(
    #[case] form: EquationForm,
    #[case] reference_limit: f64,
    #[case] integration_limit: f64,
) {
    let (replay, intervals) = case();
    let truth = match form {
        EquationForm::Envelope => samples(&intervals, envelope),
        EquationForm::Modal | EquationForm::Carrier => samples(&intervals, modal),
    };
    assert_eq!(truth.len(), PERIODS as usize);
    let reference = replay.relative_error(&replay.exact_samples(form), &truth);
    let mut integrated = MethodResult::default();
    let dop853 = IntegrationMethod::Adaptive(AdaptiveMethod::Dop853);
    replay.integrate(form, dop853, 1e-13, &mut integrated);
    let integrated = replay.relative_error(&integrated.samples, &truth);
    println!("{}: exact propagation {reference:.1e}, DOP853 at 1e-13 {integrated:.1e}", form.name());
    assert!(reference < reference_limit, "{reference:e}");
    assert!(integrated < integration_limit, "{integrated:e}");
    // An error of 0 would mean that the truth repeats the exact propagation, which proves nothing.
    assert!(reference > 0.0 && integrated > reference, "{reference:e} {integrated:e}");
}
