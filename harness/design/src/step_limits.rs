//! Finds the largest step with which the plate without drive decays under an integration method,
//! and compares it with theory.
//!
//! A step of length h is a linear map of the state. For `x' = A x` it is R(hA) with the stability
//! function R of the method (Hairer, Wanner: Solving ODEs II, IV.2 and IV.3). Repeated squaring
//! gives its spectral radius.

use nalgebra::{DMatrix, DVector};
use platebench_document::{Column, Table};
use platebench_plate::{Complex64, Conditions, Drive, Flow, Mode, Model, Plate, State};

const STEP_RANGE_S: [f64; 2] = [1e-9, 1.0];
/// Tolerance for the rounding error of a spectral radius of 1.
const ROUNDING: f64 = 1e-11;
const GROWTH_STEPS: u32 = 4_000;
/// Detuning in rad/s of an excitation at the resonance of 33 °C on a plate at 24 °C.
const DETUNING: f64 = -545.0;

pub(crate) const NOTE: &str = "With steps up to this limit the plate without drive decays under the method. The limit \
    is measured by bisection on the spectral radius of a step, and predicted by theory. The bench itself uses the \
    exact forms, which have no limit.";

#[derive(Debug, Clone, Copy, PartialEq)]
pub enum StepLimit {
    Never,
    /// Largest stable step, s.
    Step(f64),
    Always,
}

#[derive(Debug, Clone, PartialEq)]
pub struct StepLimitRow {
    pub method: &'static str,
    pub problem: &'static str,
    pub measured: StepLimit,
    pub predicted: StepLimit,
    pub source: &'static str,
    pub in_usual_unit: String,
    /// Growth in decades over 4 000 steps of 99 % and 101 % of the limit. `None` if not measurable.
    pub growth_decades: Option<[f64; 2]>,
}

impl StepLimitRow {
    pub fn deviation(&self) -> Option<f64> {
        match (self.measured, self.predicted) {
            (StepLimit::Step(measured), StepLimit::Step(predicted)) => Some(measured / predicted - 1.0),
            _ => None,
        }
    }
}

/// Contains all digits, for `methods.csv`.
pub fn limits_csv(rows: &[StepLimitRow]) -> String {
    let mut table = Table::new([
        "method",
        "problem",
        "measured_step_s",
        "predicted_step_s",
        "deviation_percent",
        "in_usual_unit",
        "decades_at_99_percent",
        "decades_at_101_percent",
        "source",
    ]);
    let limit = |limit: StepLimit| match limit {
        StepLimit::Never => "never".to_owned(),
        StepLimit::Step(step) => format!("{step:e}"),
        StepLimit::Always => "always".to_owned(),
    };
    table.extend(rows.iter().map(|row| {
        let [below, above] =
            row.growth_decades.map_or_else(Default::default, |both| both.map(|decades| format!("{decades:.2}")));
        [
            row.method.to_owned(),
            row.problem.to_owned(),
            limit(row.measured),
            limit(row.predicted),
            row.deviation().map_or_else(String::new, |share| format!("{:.4}", share * 100.0)),
            row.in_usual_unit.clone(),
            below,
            above,
            row.source.to_owned(),
        ]
    }));
    table.csv()
}

pub(crate) fn limits_table(rows: &[StepLimitRow]) -> Table {
    let mut table = Table::new([
        Column::from("method"),
        Column::from("problem"),
        Column::number("measured", ""),
        Column::number("theory", ""),
        Column::number("difference", ""),
        Column::from("in the usual unit"),
    ]);
    table.extend(rows.iter().map(|row| {
        // Rounds to 0.01 % and replaces −0 by 0.
        let hundredths = |share: f64| (share * 1e4).round() as i64 as f64 / 100.0;
        let difference = row.deviation().map_or_else(|| "–".to_owned(), |share| format!("{:.2} %", hundredths(share)));
        let [measured, predicted] = [row.measured, row.predicted].map(format_limit);
        [row.method.to_owned(), row.problem.to_owned(), measured, predicted, difference, row.in_usual_unit.clone()]
    }));
    table
}

fn format_limit(limit: StepLimit) -> String {
    match limit {
        StepLimit::Never => "none".to_owned(),
        StepLimit::Always => "no limit".to_owned(),
        StepLimit::Step(seconds) if seconds < 1e-6 => format!("{:.3} ns", seconds * 1e9),
        StepLimit::Step(seconds) if seconds < 1e-3 => format!("{:.3} µs", seconds * 1e6),
        StepLimit::Step(seconds) => format!("{:.3} ms", seconds * 1e3),
    }
}

/// The linear map of a step of the given length in s.
type StepMap<'a> = &'a dyn Fn(f64) -> DMatrix<f64>;

#[derive(Debug, Clone, Copy)]
enum Method {
    Euler,
    RungeKutta4,
    Midpoint,
}

impl Method {
    const fn name(self) -> &'static str {
        match self {
            Self::Euler => "explicit Euler",
            Self::RungeKutta4 => "RK4",
            Self::Midpoint => "implicit midpoint",
        }
    }

    /// R(hA). Not a number if the implicit equation has no solution.
    fn step(self, matrix: &DMatrix<f64>, seconds: f64) -> DMatrix<f64> {
        let z = matrix * seconds;
        let one = DMatrix::identity(z.nrows(), z.nrows());
        match self {
            Self::Euler => one + z,
            // Horner's form of 1 + z + z²/2 + z³/6 + z⁴/24.
            Self::RungeKutta4 => [4.0, 3.0, 2.0, 1.0].iter().fold(one.clone(), |sum, n| &one + &z * sum / *n),
            Self::Midpoint => {
                let explicit = &one + &z * 0.5;
                (&one - z * 0.5).lu().solve(&explicit).unwrap_or_else(|| one * f64::NAN)
            }
        }
    }

    fn limit(
        self,
        matrix: &DMatrix<f64>,
        problem: &'static str,
        predicted: StepLimit,
        source: &'static str,
        format_limit: impl Fn(f64) -> String,
    ) -> StepLimitRow {
        limit_row([self.name(), problem, source], predicted, &|step| self.step(matrix, step), format_limit)
    }
}

pub fn step_limits(plate: &Plate) -> Vec<StepLimitRow> {
    use Method::{Euler, Midpoint, RungeKutta4};
    let free = plate.mode(&Conditions::default());
    let pressed = plate.mode(&Conditions { finger_force_n: 2.0, ..Conditions::default() });
    let turning = free.omega0 + free.omega0;
    let euler = |sigma: f64, frequency: f64| StepLimit::Step(2.0 * sigma / sigma.mul_add(sigma, frequency * frequency));
    let none = |_: f64| String::new();
    let ms = |step: f64| format!("{:.3} ms", step * 1e3);
    let fast = |step: f64| format!("h·2ω0 = {:.3}", step * turning);
    let slow = |step: f64| format!("h·ω0 = {:.3}", step * free.omega0);
    let points = |step: f64| format!("{:.3} points per period", std::f64::consts::TAU / (free.omega0 * step));
    let circle = "|1 + hλ| = 1: h = 2σ/|λ|²";
    let real = "RK4 on the real axis: h|λ| = 2.7853 (Hairer, Wanner: Solving ODEs II, IV.2)";
    let imaginary = "RK4 on the imaginary axis: h|λ| = 2√2 (Hairer, Wanner: Solving ODEs II, IV.2)";
    let a_stable = "A-stable: no limit (Hairer, Wanner: Solving ODEs II, IV.3)";
    let verlet = "hω0 = 2: π points per period (Hairer, Lubich, Wanner: Geometric Numerical Integration, I.1)";
    let turn = (free.omega0.powi(2) - free.sigma.powi(2)).sqrt();
    let rk4 = |limit: f64, rate: f64| StepLimit::Step(limit / rate);
    let (resonant, off, pressed_off) = (envelope(&free, 0.0), envelope(&free, DETUNING), envelope(&pressed, DETUNING));
    let (modal, free_carrier) = (modal(&free), carrier(&free));
    let undamped = carrier(&Mode { sigma: 0.0, ..free });
    vec![
        Euler.limit(&resonant, "envelope, resonant", euler(free.sigma, 0.0), circle, ms),
        Euler.limit(&off, "envelope, 545 rad/s off", euler(free.sigma, DETUNING), circle, ms),
        Euler.limit(&pressed_off, "envelope, 2 N, 545 rad/s off", euler(pressed.sigma, DETUNING), circle, ms),
        closed_loop_limit(&free, &pressed, ms),
        Euler.limit(&modal, "modal, resonant", euler(free.sigma, turning), circle, fast),
        Euler.limit(&free_carrier, "carrier", euler(free.sigma, turn), circle, slow),
        Euler.limit(&undamped, "carrier, undamped", StepLimit::Never, circle, none),
        RungeKutta4.limit(&resonant, "envelope, resonant", rk4(2.785_293_563_405_282, free.sigma), real, ms),
        RungeKutta4.limit(&modal, "modal, resonant", rk4(8.0_f64.sqrt(), turning), imaginary, fast),
        RungeKutta4.limit(&free_carrier, "carrier", rk4(8.0_f64.sqrt(), free.omega0), imaginary, slow),
        limit_row(
            ["Störmer-Verlet", "carrier", verlet],
            StepLimit::Step(2.0 / free.omega0),
            &|step| verlet_step(&free, step),
            points,
        ),
        Midpoint.limit(&resonant, "envelope, resonant", StepLimit::Always, a_stable, none),
        Midpoint.limit(&modal, "modal, resonant", StepLimit::Always, a_stable, none),
        Midpoint.limit(&undamped, "carrier, undamped", StepLimit::Always, a_stable, none),
        exact_form_limit(Model::Envelope, "envelope, 545 rad/s off", &free),
        exact_form_limit(Model::Modal, "modal, 545 rad/s off", &free),
    ]
}

fn dynamic<const N: usize>(rows: [[f64; N]; N]) -> DMatrix<f64> {
    DMatrix::from_row_iterator(N, N, rows.into_iter().flatten())
}

/// A of `W' = −σW − jΔω W` for the state `[Re W, Im W]`.
fn envelope(mode: &Mode, detuning: f64) -> DMatrix<f64> {
    dynamic([[-mode.sigma, detuning], [-detuning, -mode.sigma]])
}

/// A of `W' = U − jωW`, `U' = −jωU − 2σU − ω0²W` at ω = ω0 for the state `[Re W, Im W, Re U/ω0,
/// Im U/ω0]`.
fn modal(mode: &Mode) -> DMatrix<f64> {
    let (omega, damping) = (mode.omega0, 2.0 * mode.sigma);
    dynamic([
        [0.0, omega, omega, 0.0],
        [-omega, 0.0, 0.0, omega],
        [-omega, 0.0, -damping, omega],
        [0.0, -omega, -omega, -damping],
    ])
}

/// A of `y'' + 2σy' + ω0²y = 0` for the state `[y, y'/ω0]`.
fn carrier(mode: &Mode) -> DMatrix<f64> {
    dynamic([[0.0, mode.omega0], [-mode.omega0, -2.0 * mode.sigma]])
}

/// Kick-drift-kick with the damping at the middle:
/// `(y₊ − 2y + y₋)/h² + 2σ(y₊ − y₋)/2h + ω0²y = 0`.
fn verlet_step(mode: &Mode, seconds: f64) -> DMatrix<f64> {
    let (half, share) = (0.5 * seconds * mode.omega0, mode.sigma * seconds);
    let middle = [-half / (1.0 + share), 1.0 / (1.0 + share)];
    let after = [1.0 + 2.0 * half * middle[0], 2.0 * half * middle[1]];
    let end = [0, 1].map(|n| middle[n] * (1.0 - share) - half * after[n]);
    dynamic([after, end])
}

/// Measures the limit of a method.
fn limit_row(
    [method, problem, source]: [&'static str; 3],
    predicted: StepLimit,
    step: StepMap<'_>,
    format_limit: impl Fn(f64) -> String,
) -> StepLimitRow {
    let radius = |seconds: f64| spectral_radius(step(seconds));
    let measured = find_step_limit(radius);
    let (in_usual_unit, growth_decades) = match measured {
        StepLimit::Step(limit) => {
            let run = |share: f64| measure_growth_decades(&step(limit * share));
            (format_limit(limit), is_growth_measurable(radius(limit * 1.01)).then(|| [0.99, 1.01].map(run)))
        }
        StepLimit::Never | StepLimit::Always => (String::new(), None),
    };
    StepLimitRow { method, problem, measured, predicted, source, in_usual_unit, growth_decades }
}

fn exact_form_limit(model: Model, problem: &'static str, mode: &Mode) -> StepLimitRow {
    let drive = Drive { vpp: 0.0, omega: mode.omega0 + DETUNING };
    let column = |number: usize, seconds: f64| {
        let unit = if number.is_multiple_of(2) { Complex64::ONE } else { Complex64::I };
        let (w, u) = if number < 2 { (unit, Complex64::ZERO) } else { (Complex64::ZERO, unit * mode.omega0) };
        let State { w, u } = Flow::new(model, mode, &drive, &State { w, u }).after(seconds);
        DVector::from_vec(vec![w.re, w.im, u.re / mode.omega0, u.im / mode.omega0])
    };
    let step = |seconds| DMatrix::from_columns(&[0, 1, 2, 3].map(|number| column(number, seconds)));
    limit_row(["exact", problem, "closed form: its step is e^{λh}"], StepLimit::Always, &step, |_| String::new())
}

/// True if the growth over [`GROWTH_STEPS`] steps exceeds a decade. Beats hide smaller growth.
fn is_growth_measurable(factor: f64) -> bool {
    f64::from(GROWTH_STEPS) * factor.log10() > 1.0
}

/// Explicit Euler integrates the plate under 2 N, with the amplitude loop closed and setpoint 0.
/// The PI is matched to the zero-order hold of the untouched plate (`docs/mathematics.md`).
fn closed_loop_limit(free: &Mode, pressed: &Mode, format_limit: impl Fn(f64) -> String) -> StepLimitRow {
    /// 5 % settling time of the design, s.
    const RESPONSE: f64 = 1.9e-3;
    // Proportional gain and zero of the PI. The zero is at the pole of the untouched plate.
    let pi = |period: f64| {
        let zero = (-free.sigma * period).exp();
        let pole = (-3.0 * period / RESPONSE).exp();
        ((1.0 - pole) / (free.envelope_constant / free.sigma * (1.0 - zero)), zero)
    };
    // Jury criterion: `(z − α)(z − 1) + g (z − a) > 0` at z = −1. α is 1 − σh, g is b h Kp, and a
    // is the zero of the PI.
    let predicted = find_step_limit(|period| {
        let (kp, zero) = pi(period);
        let gain = pressed.envelope_constant * period * kp;
        let at_minus_one = 2.0 * (2.0 - pressed.sigma * period) - gain * (1.0 + zero);
        if at_minus_one >= 0.0 { 0.0 } else { 2.0 }
    });
    // The state is Wd, µm, and the integral, Vpp.
    let step = |period: f64| {
        let ((kp, zero), gain) = (pi(period), pressed.envelope_constant * period);
        dynamic([[1.0 - pressed.sigma * period - gain * kp, gain], [-kp * (1.0 - zero), 1.0]])
    };
    let names = [
        Method::Euler.name(),
        "envelope, 2 N, amplitude loop closed",
        "Jury at z = −1 for the matched PI of 1.9 ms, one step per period",
    ];
    limit_row(names, predicted, &step, format_limit)
}

fn find_step_limit(radius: impl Fn(f64) -> f64) -> StepLimit {
    let is_stable = |step: f64| radius(step) <= 1.0 + ROUNDING;
    let [mut low, longest] = STEP_RANGE_S;
    if !is_stable(low) {
        return StepLimit::Never;
    }
    let mut high = low;
    while is_stable(high) {
        if high >= longest {
            return StepLimit::Always;
        }
        (low, high) = (high, high * 1.25);
    }
    while high - low > 1e-9 * low {
        let middle = 0.5 * (low + high);
        if is_stable(middle) { low = middle } else { high = middle }
    }
    StepLimit::Step(low)
}

/// Spectral radius by repeated squaring. Infinite if the matrix is not finite.
fn spectral_radius(mut power: DMatrix<f64>) -> f64 {
    let (mut share, mut logarithm) = (1.0, 0.0);
    for _ in 0..48 {
        if power.iter().any(|value| !value.is_finite()) {
            return f64::INFINITY;
        }
        let largest = power.amax();
        if largest == 0.0 {
            return 0.0;
        }
        logarithm += share * largest.ln();
        share *= 0.5;
        power /= largest;
        power = &power * &power;
    }
    logarithm.exp()
}

fn measure_growth_decades(step: &DMatrix<f64>) -> f64 {
    let mut x = DVector::from_fn(step.nrows(), |component, _| 1.0 / (1.0 + component as f64));
    let mut decades = 0.0;
    for _ in 0..GROWTH_STEPS {
        x = step * x;
        let size = x.amax();
        if size == 0.0 || !size.is_finite() {
            break;
        }
        decades += size.log10();
        x /= size;
    }
    decades
}
