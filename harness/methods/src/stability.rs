//! The largest step with which a method's own free motion dies out, found by bisection, beside what theory says.
//!
//! The free motion of a step is a linear map; its matrix is read off the method itself, by stepping unit vectors, and its spectral radius is found by squaring.

use crate::fixed::Fixed::{self, Euler, Midpoint, RungeKutta4, Verlet};
use crate::problem::{Carrier, Envelope, Modal, Problem, Situation};
use platebench_plate::{Conditions, Drive, Flow, Mode, Plate, Tier};
use std::array::from_fn;
use std::fmt::Write as _;

/// No step of interest is shorter or longer, s.
const STEPS: [f64; 2] = [1e-9, 1.0];
/// What rounding may add to a spectral radius of 1.
const ROUNDING: f64 = 1e-11;
/// Steps that are really run on either side of a limit.
const RUN: u32 = 4_000;
/// rad/s: tuned for 33 °C, at 24 °C.
const DETUNING: f64 = -545.0;

/// With which steps a method is stable.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Limit {
    /// With none.
    Never,
    /// With those up to this one, s.
    Step(f64),
    /// With all.
    Always,
}

/// A method's limit on a problem.
#[derive(Debug, Clone, PartialEq)]
pub struct LimitRow {
    /// The method.
    pub method: &'static str,
    /// The problem.
    pub problem: String,
    /// Found by bisection on the method's own steps.
    pub measured: Limit,
    /// Said by theory.
    pub predicted: Limit,
    /// Where the prediction comes from.
    pub source: &'static str,
    /// The same limit in the unit in which it is usually told.
    pub told: String,
    /// How much the motion grew in 4 000 steps of 99 and 101 % of the limit, as a power of ten; none where that is too few to tell.
    pub decades: Option<[f64; 2]>,
}

impl LimitRow {
    /// measured/predicted − 1 where both are steps.
    pub fn deviation(&self) -> Option<f64> {
        match (self.measured, self.predicted) {
            (Limit::Step(measured), Limit::Step(predicted)) => Some(measured / predicted - 1.0),
            _ => None,
        }
    }
}

/// Where each method's stability ends on `plate`.
pub fn limits(plate: &Plate) -> Vec<LimitRow> {
    let free = plate.mode(&Conditions::default());
    let pressed = plate.mode(&Conditions { finger_force_n: 2.0, ..Conditions::default() });
    let undamped = Mode { sigma: 0.0, ..free };
    let at = |mode: Mode, detuning: f64| Situation::constant(mode, Drive { vpp: 0.0, omega: mode.omega0 + detuning });
    let scale = free.omega0;
    let envelope = |mode, detuning| Envelope::new(&at(mode, detuning));
    let modal = Modal::new(&at(free, 0.0), scale);
    let carrier = |mode| Carrier::new(&at(mode, 0.0), 0.0, scale);
    let turning = free.omega0 + free.omega0;
    let euler = |sigma: f64, frequency: f64| Limit::Step(2.0 * sigma / sigma.mul_add(sigma, frequency * frequency));
    let none = |_: f64| String::new();
    let ms = |step: f64| format!("{:.3} ms", step * 1e3);
    let fast = |step: f64| format!("h·2ω0 = {:.3}", step * turning);
    let slow = |step: f64| format!("h·ω0 = {:.3}", step * free.omega0);
    let points = |step: f64| format!("{:.3} points per period", std::f64::consts::TAU / (free.omega0 * step));
    let circle = "|1 + hλ| = 1: h = 2σ/|λ|²";
    let imaginary = "RK4 on the imaginary axis: h|λ| = 2√2 (Hairer, Wanner: Solving ODEs II, IV.2)";
    let a_stable = "A-stable: no limit (Hairer, Wanner: Solving ODEs II, IV.3)";
    let mut rows = vec![
        row(Euler, "envelope, resonant", &envelope(free, 0.0), euler(free.sigma, 0.0), circle, ms),
        row(Euler, "envelope, 545 rad/s off", &envelope(free, DETUNING), euler(free.sigma, DETUNING), circle, ms),
        row(
            Euler,
            "envelope, 2 N, 545 rad/s off",
            &envelope(pressed, DETUNING),
            euler(pressed.sigma, DETUNING),
            circle,
            ms,
        ),
        closed_loop(&free, &pressed),
        row(Euler, "modal, resonant", &modal, euler(free.sigma, turning), circle, fast),
        row(
            Euler,
            "carrier",
            &carrier(free),
            euler(free.sigma, (free.omega0.powi(2) - free.sigma.powi(2)).sqrt()),
            circle,
            slow,
        ),
        row(Euler, "carrier, undamped", &carrier(undamped), Limit::Never, circle, none),
        row(
            RungeKutta4,
            "envelope, resonant",
            &envelope(free, 0.0),
            Limit::Step(2.785_293_563_405_282 / free.sigma),
            "RK4 on the real axis: h|λ| = 2.7853 (Hairer, Wanner: Solving ODEs II, IV.2)",
            ms,
        ),
        row(RungeKutta4, "modal, resonant", &modal, Limit::Step(8.0_f64.sqrt() / turning), imaginary, fast),
        row(RungeKutta4, "carrier", &carrier(free), Limit::Step(8.0_f64.sqrt() / free.omega0), imaginary, slow),
        row(
            Verlet,
            "carrier",
            &carrier(free),
            Limit::Step(2.0 / free.omega0),
            "hω0 = 2: π points per period (Hairer, Lubich, Wanner: Geometric Numerical Integration, I.1)",
            points,
        ),
        row(Midpoint, "envelope, resonant", &envelope(free, 0.0), Limit::Always, a_stable, none),
        row(Midpoint, "modal, resonant", &modal, Limit::Always, a_stable, none),
        row(Midpoint, "carrier, undamped", &carrier(undamped), Limit::Always, a_stable, none),
    ];
    rows.extend([Tier::Envelope, Tier::Modal].map(|tier| exact(tier, &free)));
    rows
}

/// The rows as CSV, with a header; steps in s.
pub fn to_csv(rows: &[LimitRow]) -> String {
    let mut text = "method,problem,measured_step_s,predicted_step_s,deviation_percent,told_as,decades_at_99_percent,decades_at_101_percent,source\n".to_owned();
    let quoted = |field: &str| format!("\"{}\"", field.replace('"', "\"\""));
    let limit = |limit: Limit| match limit {
        Limit::Never => "never".to_owned(),
        Limit::Step(step) => format!("{step:e}"),
        Limit::Always => "always".to_owned(),
    };
    for row in rows {
        let deviation = row.deviation().map_or_else(String::new, |share| format!("{:.4}", share * 100.0));
        let [below, above] =
            row.decades.map_or_else(Default::default, |both| both.map(|decades| format!("{decades:.2}")));
        // Writing into a string does not fail.
        let _ = writeln!(
            text,
            "{},{},{},{},{deviation},{},{below},{above},{}",
            quoted(row.method),
            quoted(&row.problem),
            limit(row.measured),
            limit(row.predicted),
            quoted(&row.told),
            quoted(row.source)
        );
    }
    text
}

fn row<const N: usize, P: Problem<N>>(
    method: Fixed,
    name: &str,
    problem: &P,
    predicted: Limit,
    source: &'static str,
    told: impl Fn(f64) -> String,
) -> LimitRow {
    let measured = limit(|step| radius(&matrix_of(|x| free_step(method, problem, x, step))));
    let (told, decades) = match measured {
        Limit::Step(limit) => {
            let run = |share: f64| growth(|x| free_step(method, problem, x, limit * share));
            let slowest = radius(&matrix_of(|x| free_step(method, problem, x, limit * 1.01)));
            (told(limit), visible(slowest).then(|| [0.99, 1.01].map(run)))
        }
        Limit::Never | Limit::Always => (String::new(), None),
    };
    let method = crate::method::Method::Fixed(method).name();
    LimitRow { method, problem: name.to_owned(), measured, predicted, source, told, decades }
}

/// The exact form's step is a step like any other.
fn exact(tier: Tier, mode: &Mode) -> LimitRow {
    let drive = Drive { vpp: 0.0, omega: mode.omega0 + DETUNING };
    let scale = mode.omega0;
    let step = |x: [f64; 4], step: f64| {
        Modal::pack(&Flow::new(tier, mode, &drive, &Modal::unpack(&x, scale)).after(step), scale)
    };
    let problem = match tier {
        Tier::Linear | Tier::Envelope => "envelope, 545 rad/s off",
        Tier::Modal | Tier::Carrier => "modal, 545 rad/s off",
    };
    let measured = limit(|seconds| radius(&matrix_of(|x| step(x, seconds))));
    LimitRow {
        method: "exact",
        problem: problem.to_owned(),
        measured,
        predicted: Limit::Always,
        source: "closed form: its step is e^{λh}",
        told: String::new(),
        decades: None,
    }
}

/// True where a motion that grows by `factor` per step grows enough in [`RUN`] steps to be told from the beat of its components.
fn visible(factor: f64) -> bool {
    f64::from(RUN) * factor.log10() > 1.0
}

/// One step of `method` from `x`, whatever its clock says; the clock's component is 0 afterwards.
fn free_step<const N: usize, P: Problem<N>>(method: Fixed, problem: &P, mut x: [f64; N], step: f64) -> [f64; N] {
    let reset = |x: &mut [f64; N]| {
        if let Some(clock) = P::CLOCK.and_then(|clock| x.get_mut(clock)) {
            *clock = 0.0;
        }
    };
    reset(&mut x);
    let mut after = method.advance(problem, x, step, 1).unwrap_or([f64::NAN; N]);
    reset(&mut after);
    after
}

/// The explicit Euler plate under a finger of 2 N with the matched amplitude loop around it, tuned for the untouched plate; a step is a period.
fn closed_loop(free: &Mode, pressed: &Mode) -> LimitRow {
    let limit_of = |stable: &dyn Fn(f64) -> f64| limit(stable);
    let measured = limit_of(&|period| radius(&matrix_of(|x| Loop::new(free, period).step(pressed, x))));
    // Jury: the characteristic polynomial (z − α)(z − 1) + g(z − a) is positive at −1, α = 1 − σh, g = b h Kp.
    let predicted = limit_of(&|period| {
        let pi = Loop::new(free, period);
        let gain = pressed.envelope_constant * period * pi.kp;
        let at_minus_one = 2.0 * (2.0 - pressed.sigma * period) - gain * (1.0 + pi.zero);
        if at_minus_one >= 0.0 { 0.0 } else { 2.0 }
    });
    let (told, decades) = match measured {
        Limit::Step(limit) => {
            let run = |share: f64| growth(|x| Loop::new(free, limit * share).step(pressed, x));
            (format!("{:.3} ms", limit * 1e3), Some([0.99, 1.01].map(run)))
        }
        Limit::Never | Limit::Always => (String::new(), None),
    };
    LimitRow {
        method: crate::method::Method::Fixed(Fixed::Euler).name(),
        problem: "envelope, 2 N, amplitude loop closed".to_owned(),
        measured,
        predicted,
        source: "Jury at z = −1 for the matched PI of 1.9 ms, one step per period",
        told,
        decades,
    }
}

/// A PI matched to the zero-order hold (`docs/mathematics.md`), with setpoint 0.
#[derive(Debug, Clone, Copy)]
struct Loop {
    period: f64,
    kp: f64,
    /// Where its zero is: on the untouched plate's pole.
    zero: f64,
}

impl Loop {
    /// s: 5 % settling that the loop is designed for.
    const RESPONSE: f64 = 1.9e-3;

    fn new(free: &Mode, period: f64) -> Self {
        let zero = (-free.sigma * period).exp();
        let pole = (-3.0 * period / Self::RESPONSE).exp();
        let gain = free.envelope_constant / free.sigma;
        Self { period, kp: (1.0 - pole) / (gain * (1.0 - zero)), zero }
    }

    /// One period: Wd in µm and the integral in Vpp.
    fn step(&self, mode: &Mode, [w, integral]: [f64; 2]) -> [f64; 2] {
        let drive = Drive { vpp: integral - self.kp * w, omega: mode.omega0 };
        let problem = Envelope::new(&Situation::constant(*mode, drive));
        let [after, _] = Fixed::Euler.advance(&problem, [w, 0.0], self.period, 1).unwrap_or([f64::NAN; 2]);
        [after, integral - self.kp * (1.0 - self.zero) * w]
    }
}

/// The matrix of a linear map, from what it makes of the unit vectors.
fn matrix_of<const N: usize>(mut map: impl FnMut([f64; N]) -> [f64; N]) -> [[f64; N]; N] {
    let columns: [[f64; N]; N] = from_fn(|column| map(from_fn(|row| if row == column { 1.0 } else { 0.0 })));
    from_fn(|row| from_fn(|column| columns[column][row]))
}

/// The step at which `radius` passes 1, to a part in 10⁹: doubled until it does, then bisected.
fn limit(radius: impl Fn(f64) -> f64) -> Limit {
    let is_stable = |step: f64| radius(step) <= 1.0 + ROUNDING;
    let [mut low, longest] = STEPS;
    if !is_stable(low) {
        return Limit::Never;
    }
    let mut high = low;
    while is_stable(high) {
        if high >= longest {
            return Limit::Always;
        }
        (low, high) = (high, high * 1.25);
    }
    while high - low > 1e-9 * low {
        let middle = 0.5 * (low + high);
        if is_stable(middle) { low = middle } else { high = middle }
    }
    Limit::Step(low)
}

/// The spectral radius, as the growth of ever higher powers; infinite where the matrix is not finite.
fn radius<const N: usize>(matrix: &[[f64; N]; N]) -> f64 {
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

/// How much a motion grows in [`RUN`] steps that are really run, as a power of ten.
fn growth<const N: usize>(mut step: impl FnMut([f64; N]) -> [f64; N]) -> f64 {
    let mut x: [f64; N] = from_fn(|component| 1.0 / (1.0 + component as f64));
    let mut decades = 0.0;
    for _ in 0..RUN {
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
