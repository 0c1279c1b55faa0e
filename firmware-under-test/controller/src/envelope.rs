//! Models the plate's envelope for the laws: `W' = λW + bV`, `λ = −σ − jΔω`, `b = K1 σ0`.
//!
//! Only λ is unknown. A finger changes σ, the temperature changes the resonance and with it Δω. b
//! does not change, because N/m is a constant of the plate. Over an interval h of constant drive
//!
//! `W(h) = e^z W(0) + b V h φ(z)`, `z = λh`, `φ(z) = (e^z − 1)/z`.
//!
//! [`EnvelopeModel::identify`] solves this equation for λ, [`EnvelopeModel::steer`] for V and ω.
//! The exponential is a polynomial with a fixed number of doublings, so the number of instructions
//! does not depend on the argument. `sinf` and `cosf` of `libm` are not used, because they
//! calculate in f64, which a Cortex-M4F must emulate.

use crate::design::PiGains;
use core::ops::{Add, Mul, Sub};

#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(crate) struct Complex {
    pub(crate) re: f32,
    pub(crate) im: f32,
}

impl Complex {
    const ONE: Self = Self { re: 1.0, im: 0.0 };

    pub(crate) const fn new(re: f32, im: f32) -> Self {
        Self { re, im }
    }

    fn scaled(self, by: f32) -> Self {
        Self::new(self.re * by, self.im * by)
    }

    fn times_conjugate(self, other: Self) -> Self {
        Self::new(self.re * other.re + self.im * other.im, self.im * other.re - self.re * other.im)
    }

    fn norm_squared(self) -> f32 {
        self.re * self.re + self.im * self.im
    }

    pub(crate) fn norm(self) -> f32 {
        libm::sqrtf(self.norm_squared())
    }

    /// `self / other`; 0 if the quotient is not finite.
    fn divided_by(self, other: Self) -> Self {
        let quotient = self.times_conjugate(other).scaled(1.0 / other.norm_squared());
        if quotient.re.is_finite() && quotient.im.is_finite() { quotient } else { Self::default() }
    }
}

impl Add for Complex {
    type Output = Self;
    fn add(self, other: Self) -> Self {
        Self::new(self.re + other.re, self.im + other.im)
    }
}

impl Sub for Complex {
    type Output = Self;
    fn sub(self, other: Self) -> Self {
        Self::new(self.re - other.re, self.im - other.im)
    }
}

impl Mul for Complex {
    type Output = Self;
    fn mul(self, other: Self) -> Self {
        Self::new(self.re * other.re - self.im * other.im, self.re * other.im + self.im * other.re)
    }
}

/// `e^z`, `φ(z)` and `φ'(z)`.
#[derive(Debug, Clone, Copy)]
struct Exponentials {
    exp: Complex,
    phi: Complex,
    slope: Complex,
}

impl Exponentials {
    /// Exact to f32 rounding if `|z|` is at most `2^(doublings − 1)`.
    fn of(z: Complex, doublings: u32) -> Self {
        // Coefficients 1/(n+1)! of φ(y) = Σ yⁿ/(n+1)!. The first omitted term is 2e-7 at |y| = 0.5.
        const COEFFICIENTS: [f32; 7] = [1.0 / 5040.0, 1.0 / 720.0, 1.0 / 120.0, 1.0 / 24.0, 1.0 / 6.0, 0.5, 1.0];
        let mut half_y = z.scaled(0.5 / (1_u32 << doublings) as f32);
        let y = half_y + half_y;
        let mut phi = Complex::default();
        for coefficient in COEFFICIENTS {
            phi = phi * y + Complex::new(coefficient, 0.0);
        }
        for _ in 0..doublings {
            // φ(2y) = φ(y) (1 + e^y)/2, e^y = 1 + yφ(y)
            phi = phi * (Complex::ONE + half_y * phi);
            half_y = half_y + half_y;
        }
        let exp = Complex::ONE + z * phi;
        // φ' = (e^z − φ)/z loses digits for small z. The series is φ' ≈ 1/2 + z/3.
        let slope = if z.norm_squared() < 1e-3 {
            Complex::new(0.5, 0.0) + z.scaled(1.0 / 3.0)
        } else {
            (exp - phi).divided_by(z)
        };
        Self { exp, phi, slope }
    }
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct PlateMode {
    /// σ, 1/s.
    pub(crate) sigma: f32,
    /// Resonance relative to the start frequency, rad/s.
    pub(crate) resonance: f32,
}

impl PlateMode {
    fn lambda(self, offset: f32) -> Complex {
        Complex::new(-self.sigma, self.resonance - offset)
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(crate) struct Drive {
    pub(crate) vpp: f32,
    /// Excitation frequency relative to the start frequency, rad/s.
    pub(crate) offset: f32,
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct SteeringStep {
    pub(crate) drive: Drive,
    /// W at the end of the period.
    pub(crate) end: Complex,
}

#[derive(Debug, Clone, Copy)]
pub(crate) struct DriveBounds {
    pub(crate) limit_vpp: f32,
    pub(crate) lowest_offset: f32,
    pub(crate) highest_offset: f32,
}

/// Newton iterations. Four suffice from a start within a factor of two (quadratic convergence).
const ITERATIONS: u32 = 4;
/// The identified σ is limited to the untouched plate's σ times and divided by this factor. A
/// finger of 4.5 N raises σ by a factor of 4.
const LARGEST_DAMPING: f32 = 6.0;

#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct EnvelopeModel {
    /// b, µm/s per Vpp.
    pub(crate) force: f32,
    /// σ of the untouched plate, 1/s.
    pub(crate) sigma: f32,
    /// Largest distance of the resonance from the start frequency, rad/s.
    range: f32,
    doublings: u32,
}

impl EnvelopeModel {
    /// `gain` in µm per Vpp, `time_constant` and `period` in s, `range` in rad/s.
    pub(crate) fn new(gain: f32, time_constant: f32, range: f32, period: f32) -> Self {
        let sigma = 1.0 / time_constant;
        // In the worst case, excitation and resonance are at opposite ends of the range.
        let largest = Complex::new(LARGEST_DAMPING * sigma, 2.0 * range).norm() * period;
        let doublings = (0..15).find(|&count| largest <= 0.5 * (1_u32 << count) as f32).unwrap_or(15);
        Self { force: gain * sigma, sigma, range, doublings }
    }

    pub(crate) fn nominal(&self, resonance: f32) -> PlateMode {
        PlateMode { sigma: self.sigma, resonance }
    }

    /// W and dW/dλ after `seconds` of `drive`, from the pair at the start.
    fn propagate_with_derivative(
        &self,
        mode: PlateMode,
        (w, by_lambda): (Complex, Complex),
        drive: Drive,
        seconds: f32,
    ) -> (Complex, Complex) {
        let Exponentials { exp, phi, slope } =
            Exponentials::of(mode.lambda(drive.offset).scaled(seconds), self.doublings);
        let push = self.force * drive.vpp * seconds;
        (exp * w + phi.scaled(push), exp * by_lambda + (exp * w + slope.scaled(push)).scaled(seconds))
    }

    pub(crate) fn propagate(&self, mode: PlateMode, w: Complex, drive: Drive, seconds: f32) -> Complex {
        if seconds > 0.0 { self.propagate_with_derivative(mode, (w, Complex::default()), drive, seconds).0 } else { w }
    }

    /// Fits λ by Newton's method, starting at `mode`. `drives` act one after the other between the
    /// samples `before` and `after`, each for its duration in s.
    pub(crate) fn identify(
        &self,
        mode: PlateMode,
        before: Complex,
        drives: [(Drive, f32); 2],
        after: Complex,
    ) -> PlateMode {
        let mut mode = mode;
        for _ in 0..ITERATIONS {
            let next = self.newton_step(mode, before, drives, after);
            let is_final = next == mode;
            mode = next;
            // Further iterations give the same mode. A board executes them nevertheless, so that
            // the time of a step is constant.
            if cfg!(not(target_os = "none")) && is_final {
                break;
            }
        }
        mode
    }

    fn newton_step(&self, mode: PlateMode, before: Complex, drives: [(Drive, f32); 2], after: Complex) -> PlateMode {
        let mut motion = (before, Complex::default());
        for (drive, seconds) in drives {
            if seconds > 0.0 {
                motion = self.propagate_with_derivative(mode, motion, drive, seconds);
            }
        }
        let step = (after - motion.0).divided_by(motion.1);
        self.clamped(PlateMode { sigma: mode.sigma - step.re, resonance: mode.resonance + step.im })
    }

    /// Gains of both loops. The static gains of their plants are b/σ and 1/σ (equations 13, 19).
    pub(crate) fn matched_gains(&self, sigma: f32, closed_loop_pole: f32, period: f32) -> (PiGains, PiGains) {
        let plant_pole = libm::expf(-sigma * period);
        let gains = |gain| PiGains::from_poles(gain, plant_pole, closed_loop_pole);
        (gains(self.force / sigma), gains(1.0 / sigma))
    }

    pub(crate) fn clamped(&self, mode: PlateMode) -> PlateMode {
        PlateMode {
            sigma: mode.sigma.clamp(self.sigma / LARGEST_DAMPING, self.sigma * LARGEST_DAMPING),
            resonance: mode.resonance.clamp(-self.range, self.range),
        }
    }

    /// Drive that brings W to the real `target` within `seconds`. If `bounds` prevent this, |W| has
    /// priority over its angle.
    pub(crate) fn steer(
        &self,
        mode: PlateMode,
        w: Complex,
        target: f32,
        bounds: &DriveBounds,
        seconds: f32,
    ) -> SteeringStep {
        let within = |offset: f32| offset.clamp(bounds.lowest_offset, bounds.highest_offset);
        let mut drive = Drive { vpp: 0.0, offset: within(mode.resonance) };
        let mut reached = w;
        for iteration in 0..=ITERATIONS {
            let Exponentials { exp, phi, slope } =
                Exponentials::of(mode.lambda(drive.offset).scaled(seconds), self.doublings);
            let free = exp * w;
            let push = phi.scaled(self.force * seconds);
            drive.vpp = drive_to(free, push, target).clamp(0.0, bounds.limit_vpp);
            reached = free + push.scaled(drive.vpp);
            if iteration < ITERATIONS {
                // Derivative of the end W by ω at this drive: −j h (e^z W + b V h φ').
                let turn = free + slope.scaled(self.force * seconds * drive.vpp);
                let by_offset = Complex::new(turn.im, -turn.re).scaled(seconds);
                // One rad/s turns arg W by −Im(dW conj W)/|W|², with dW = `by_offset`.
                let rate = by_offset.times_conjugate(reached).im;
                let angle = libm::atan2f(reached.im, reached.re);
                let step = angle * reached.norm_squared() / rate;
                if step.is_finite() {
                    drive.offset = within(drive.offset - step);
                }
            }
        }
        SteeringStep { drive, end: reached }
    }
}

/// The larger root V of `|free + push·V| = target`. Negative if |free| already exceeds `target`.
fn drive_to(free: Complex, push: Complex, target: f32) -> f32 {
    let squared = push.norm_squared();
    let along = free.times_conjugate(push).re;
    let root = along * along - squared * (free.norm_squared() - target * target);
    let vpp = (libm::sqrtf(root.max(0.0)) - along) / squared;
    if vpp.is_finite() { vpp } else { 0.0 }
}

#[cfg(test)]
pub(crate) mod tests;
