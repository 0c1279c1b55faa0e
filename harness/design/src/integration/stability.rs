//! Finds the largest step with which the plate without drive decays under a method, and compares it
//! with theory. A step of the plate without drive is a linear map. Unit vectors give its matrix,
//! and repeated squaring gives the spectral radius.

use crate::integration::fixed::FixedStepMethod::{self, Euler, Midpoint, RungeKutta4, Verlet};
use crate::integration::problem::{CarrierProblem, EnvelopeProblem, ModalProblem, Problem, ProblemParameters};
use platebench_plate::{Conditions, Drive, Flow, Mode, Plate, Tier};
use std::array::from_fn;
use std::fmt::Write as _;

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

pub fn step_limits(plate: &Plate) -> Vec<StepLimitRow> {
    let free = plate.mode(&Conditions::default());
    let pressed = plate.mode(&Conditions { finger_force_n: 2.0, ..Conditions::default() });
    let undamped = Mode { sigma: 0.0, ..free };
    let at = |mode: Mode, detuning: f64| {
        ProblemParameters::constant(mode, Drive { vpp: 0.0, omega: mode.omega0 + detuning })
    };
    let scale = free.omega0;
    let envelope = |mode, detuning| EnvelopeProblem::new(&at(mode, detuning));
    let modal = ModalProblem::new(&at(free, 0.0), scale);
    let carrier = |mode| CarrierProblem::new(&at(mode, 0.0), 0.0, scale);
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
    let [resonant, off, pressed_off] =
        [envelope(free, 0.0), envelope(free, DETUNING), envelope(pressed, DETUNING)].map(UndrivenProblem);
    let (modal, carrier, undamped) =
        (UndrivenProblem(modal), UndrivenProblem(carrier(free)), UndrivenProblem(carrier(undamped)));
    vec![
        resonant.limit(Euler, "envelope, resonant", euler(free.sigma, 0.0), circle, ms),
        off.limit(Euler, "envelope, 545 rad/s off", euler(free.sigma, DETUNING), circle, ms),
        pressed_off.limit(Euler, "envelope, 2 N, 545 rad/s off", euler(pressed.sigma, DETUNING), circle, ms),
        closed_loop_limit(&free, &pressed, ms),
        modal.limit(Euler, "modal, resonant", euler(free.sigma, turning), circle, fast),
        carrier.limit(Euler, "carrier", euler(free.sigma, turn), circle, slow),
        undamped.limit(Euler, "carrier, undamped", StepLimit::Never, circle, none),
        resonant.limit(RungeKutta4, "envelope, resonant", rk4(2.785_293_563_405_282, free.sigma), real, ms),
        modal.limit(RungeKutta4, "modal, resonant", rk4(8.0_f64.sqrt(), turning), imaginary, fast),
        carrier.limit(RungeKutta4, "carrier", rk4(8.0_f64.sqrt(), free.omega0), imaginary, slow),
        carrier.limit(Verlet, "carrier", StepLimit::Step(2.0 / free.omega0), verlet, points),
        resonant.limit(Midpoint, "envelope, resonant", StepLimit::Always, a_stable, none),
        modal.limit(Midpoint, "modal, resonant", StepLimit::Always, a_stable, none),
        undamped.limit(Midpoint, "carrier, undamped", StepLimit::Always, a_stable, none),
        exact_form_limit(Tier::Envelope, "envelope, 545 rad/s off", &free),
        exact_form_limit(Tier::Modal, "modal, 545 rad/s off", &free),
    ]
}

pub fn to_csv(rows: &[StepLimitRow]) -> String {
    let mut text = "method,problem,measured_step_s,predicted_step_s,deviation_percent,in_usual_unit,\
                    decades_at_99_percent,decades_at_101_percent,source\n"
        .to_owned();
    let quoted = |field: &str| format!("\"{}\"", field.replace('"', "\"\""));
    let limit = |limit: StepLimit| match limit {
        StepLimit::Never => "never".to_owned(),
        StepLimit::Step(step) => format!("{step:e}"),
        StepLimit::Always => "always".to_owned(),
    };
    for row in rows {
        let deviation = row.deviation().map_or_else(String::new, |share| format!("{:.4}", share * 100.0));
        let [below, above] =
            row.growth_decades.map_or_else(Default::default, |both| both.map(|decades| format!("{decades:.2}")));
        let _ = writeln!(
            text,
            "{},{},{},{},{deviation},{},{below},{above},{}",
            quoted(row.method),
            quoted(row.problem),
            limit(row.measured),
            limit(row.predicted),
            quoted(&row.in_usual_unit),
            quoted(row.source)
        );
    }
    text
}

pub(crate) fn limits_table(rows: &[StepLimitRow]) -> String {
    let mut text = format!(
        "Methods: the largest stable step\n\n{:<20} {:<38} {:>10} {:>10} {:>11}  in the usual unit\n",
        "method", "problem", "measured", "theory", "difference"
    );
    for row in rows {
        // Rounds to 0.01 % and replaces −0 by 0.
        let hundredths = |share: f64| (share * 1e4).round() as i64 as f64 / 100.0;
        let difference = row.deviation().map_or_else(|| "–".to_owned(), |share| format!("{:.2} %", hundredths(share)));
        let _ = writeln!(
            text,
            "{:<20} {:<38} {:>10} {:>10} {difference:>11}  {}",
            row.method,
            row.problem,
            format_limit(row.measured),
            format_limit(row.predicted),
            row.in_usual_unit
        );
    }
    text
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

/// Measures the limit of `step`, which advances a state by one step of the given length in s.
fn limit_row<const N: usize>(
    [method, problem, source]: [&'static str; 3],
    predicted: StepLimit,
    step: impl Fn([f64; N], f64) -> [f64; N],
    format_limit: impl Fn(f64) -> String,
) -> StepLimitRow {
    let radius = |seconds: f64| spectral_radius(&matrix_of(|x| step(x, seconds)));
    let measured = find_step_limit(radius);
    let (in_usual_unit, growth_decades) = match measured {
        StepLimit::Step(limit) => {
            let run = |share: f64| measure_growth_decades(|x| step(x, limit * share));
            (format_limit(limit), is_growth_measurable(radius(limit * 1.01)).then(|| [0.99, 1.01].map(run)))
        }
        StepLimit::Never | StepLimit::Always => (String::new(), None),
    };
    StepLimitRow { method, problem, measured, predicted, source, in_usual_unit, growth_decades }
}

struct UndrivenProblem<P>(P);

impl<P> UndrivenProblem<P> {
    fn limit<const N: usize>(
        &self,
        method: FixedStepMethod,
        problem: &'static str,
        predicted: StepLimit,
        source: &'static str,
        format_limit: impl Fn(f64) -> String,
    ) -> StepLimitRow
    where
        P: Problem<N>,
    {
        let names = [method.into_str(), problem, source];
        limit_row(names, predicted, |x, step| free_step(method, &self.0, x, step), format_limit)
    }
}

fn exact_form_limit(tier: Tier, problem: &'static str, mode: &Mode) -> StepLimitRow {
    let drive = Drive { vpp: 0.0, omega: mode.omega0 + DETUNING };
    let scale = mode.omega0;
    let step = |x: [f64; 4], step: f64| {
        ModalProblem::pack(&Flow::new(tier, mode, &drive, &ModalProblem::unpack(&x, scale)).after(step), scale)
    };
    limit_row(["exact", problem, "closed form: its step is e^{λh}"], StepLimit::Always, step, |_| String::new())
}

/// True if the growth over [`GROWTH_STEPS`] steps exceeds a decade. Beats hide smaller growth.
fn is_growth_measurable(factor: f64) -> bool {
    f64::from(GROWTH_STEPS) * factor.log10() > 1.0
}

fn free_step<const N: usize, P: Problem<N>>(
    method: FixedStepMethod,
    problem: &P,
    mut x: [f64; N],
    step: f64,
) -> [f64; N] {
    let reset = |x: &mut [f64; N]| {
        if let Some(clock) = P::CLOCK.and_then(|clock| x.get_mut(clock)) {
            *clock = 0.0;
        }
    };
    reset(&mut x);
    let mut after = method.advance(problem, x, step, 1, &mut None).unwrap_or([f64::NAN; N]);
    reset(&mut after);
    after
}

/// Explicit Euler integrates the plate under 2 N. The loop is designed for the untouched plate.
fn closed_loop_limit(free: &Mode, pressed: &Mode, format_limit: impl Fn(f64) -> String) -> StepLimitRow {
    // Jury criterion: `(z − α)(z − 1) + g (z − a) > 0` at z = −1. α is 1 − σh, g is b h Kp, and a
    // is the zero of the PI.
    let predicted = find_step_limit(|period| {
        let pi = MatchedPiLoop::new(free, period);
        let gain = pressed.envelope_constant * period * pi.kp;
        let at_minus_one = 2.0 * (2.0 - pressed.sigma * period) - gain * (1.0 + pi.zero);
        if at_minus_one >= 0.0 { 0.0 } else { 2.0 }
    });
    let names = [
        FixedStepMethod::Euler.into_str(),
        "envelope, 2 N, amplitude loop closed",
        "Jury at z = −1 for the matched PI of 1.9 ms, one step per period",
    ];
    let step = |x, period| MatchedPiLoop::new(free, period).step(pressed, x);
    limit_row(names, predicted, step, format_limit)
}

/// Amplitude loop with setpoint 0 and a PI matched to zero-order hold (`docs/mathematics.md`).
#[derive(Debug, Clone, Copy)]
struct MatchedPiLoop {
    period: f64,
    kp: f64,
    /// Zero of the PI, at the pole of the untouched plate.
    zero: f64,
}

impl MatchedPiLoop {
    /// 5 % settling time of the design, s.
    const RESPONSE: f64 = 1.9e-3;

    fn new(free: &Mode, period: f64) -> Self {
        let zero = (-free.sigma * period).exp();
        let pole = (-3.0 * period / Self::RESPONSE).exp();
        let gain = free.envelope_constant / free.sigma;
        Self { period, kp: (1.0 - pole) / (gain * (1.0 - zero)), zero }
    }

    /// Advances Wd, µm, and the integral, Vpp, by one period.
    fn step(&self, mode: &Mode, [w, integral]: [f64; 2]) -> [f64; 2] {
        let drive = Drive { vpp: integral - self.kp * w, omega: mode.omega0 };
        let problem = EnvelopeProblem::new(&ProblemParameters::constant(*mode, drive));
        let [after, _] =
            FixedStepMethod::Euler.advance(&problem, [w, 0.0], self.period, 1, &mut None).unwrap_or([f64::NAN; 2]);
        [after, integral - self.kp * (1.0 - self.zero) * w]
    }
}

fn matrix_of<const N: usize>(mut map: impl FnMut([f64; N]) -> [f64; N]) -> [[f64; N]; N] {
    let columns: [[f64; N]; N] = from_fn(|column| map(from_fn(|row| if row == column { 1.0 } else { 0.0 })));
    from_fn(|row| from_fn(|column| columns[column][row]))
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

/// Spectral radius by repeated squaring. Infinite if `matrix` is not finite.
fn spectral_radius<const N: usize>(matrix: &[[f64; N]; N]) -> f64 {
    let (mut power, mut share, mut logarithm) = (*matrix, 1.0, 0.0);
    for _ in 0..48 {
        let largest = power
            .iter()
            .flatten()
            .fold(0.0_f64, |largest, value| if value.is_nan() { f64::INFINITY } else { largest.max(value.abs()) });
        if largest == 0.0 || largest.is_infinite() {
            return largest;
        }
        logarithm += share * largest.ln();
        share *= 0.5;
        let scaled = power.map(|row| row.map(|value| value / largest));
        power = from_fn(|row| from_fn(|column| (0..N).map(|k| scaled[row][k] * scaled[k][column]).sum()));
    }
    logarithm.exp()
}

fn measure_growth_decades<const N: usize>(mut step: impl FnMut([f64; N]) -> [f64; N]) -> f64 {
    let mut x: [f64; N] = from_fn(|component| 1.0 / (1.0 + component as f64));
    let mut decades = 0.0;
    for _ in 0..GROWTH_STEPS {
        x = step(x);
        let size = x.iter().fold(0.0_f64, |largest, value| largest.max(value.abs()));
        if size == 0.0 || !size.is_finite() {
            break;
        }
        decades += size.log10();
        x = x.map(|value| value / size);
    }
    decades
}
