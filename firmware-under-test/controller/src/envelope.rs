//! The plate's envelope as a law may reckon with it: `W' = λW + bV`, `λ = −σ − jΔω`, `b = K1 σ0`.
//!
//! Only λ is unknown: a finger changes σ, a temperature changes the resonance, and b is a constant of the plate (N/m). Over an interval h of constant drive
//!
//! `W(h) = e^z W(0) + b V h φ(z)`, `z = λh`, `φ(z) = (e^z − 1)/z`,
//!
//! which [`Envelope::identify`] solves for λ and [`Envelope::steer`] for V and ω. The exponential is a polynomial with a fixed number of doublings: the same
//! instructions on every target and for every argument, in f32 throughout (`sinf` and `cosf` of `libm` calculate in f64, which a Cortex-M4F has to emulate).

use crate::pi::PiGains;
use core::ops::{Add, Mul, Sub};

/// A complex number.
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

    /// `self · conj(other)`
    fn times_conjugate(self, other: Self) -> Self {
        Self::new(self.re * other.re + self.im * other.im, self.im * other.re - self.re * other.im)
    }

    fn norm_squared(self) -> f32 {
        self.re * self.re + self.im * self.im
    }

    pub(crate) fn norm(self) -> f32 {
        libm::sqrtf(self.norm_squared())
    }

    /// `self / other`, and 0 where that is not finite.
    fn over(self, other: Self) -> Self {
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
struct Growth {
    exp: Complex,
    phi: Complex,
    slope: Complex,
}

impl Growth {
    /// Up to `|z| = 2^(doublings − 1)` as exact as f32 allows.
    fn of(z: Complex, doublings: u32) -> Self {
        // 1/2!, 1/3! … of φ(y) = Σ yⁿ/(n+1)!: at |y| = 0.5 the first term left out is 2e-7.
        const COEFFICIENTS: [f32; 7] = [1.0 / 5040.0, 1.0 / 720.0, 1.0 / 120.0, 1.0 / 24.0, 1.0 / 6.0, 0.5, 1.0];
        let mut y = z.scaled(1.0 / (1_u32 << doublings) as f32);
        let mut phi = Complex::default();
        for coefficient in COEFFICIENTS {
            phi = phi * y + Complex::new(coefficient, 0.0);
        }
        for _ in 0..doublings {
            // φ(2y) = φ(y) (1 + e^y)/2, e^y = 1 + yφ(y)
            phi = phi * (Complex::ONE + (y * phi).scaled(0.5));
            y = y + y;
        }
        let exp = Complex::ONE + z * phi;
        // φ' = (e^z − φ)/z loses digits where z is small, and is 1/2 + z/3 there.
        let slope =
            if z.norm_squared() < 1e-3 { Complex::new(0.5, 0.0) + z.scaled(1.0 / 3.0) } else { (exp - phi).over(z) };
        Self { exp, phi, slope }
    }
}

/// What the plate is like at the moment.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Mode {
    /// σ, 1/s.
    pub(crate) sigma: f32,
    /// The resonance in rad/s above the start frequency.
    pub(crate) resonance: f32,
}

impl Mode {
    fn lambda(self, offset: f32) -> Complex {
        Complex::new(-self.sigma, self.resonance - offset)
    }
}

/// A drive that acts for some time.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(crate) struct Drive {
    pub(crate) vpp: f32,
    /// Excitation in rad/s above the start frequency.
    pub(crate) offset: f32,
}

/// Where a plate is steered to, and by what.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Aim {
    pub(crate) drive: Drive,
    /// Where the plate will be at the end of the period.
    pub(crate) reached: Complex,
}

/// What a drive may be.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Bounds {
    pub(crate) limit_vpp: f32,
    pub(crate) lowest_offset: f32,
    pub(crate) highest_offset: f32,
}

/// Iterations of each solver; the error falls quadratically from a start within a factor of two, and to rounding in four.
const ITERATIONS: u32 = 4;
/// σ is looked for up to this multiple of the nominal one, and down to its inverse: four times is a finger of 4.5 N.
const LARGEST_DAMPING: f32 = 6.0;

/// The nominal plate and the range in which λ is looked for.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Envelope {
    /// b, µm/s per Vpp.
    pub(crate) force: f32,
    /// Untouched, 1/s.
    pub(crate) sigma: f32,
    /// The resonance is looked for within this much of the start frequency, rad/s.
    range: f32,
    doublings: u32,
}

impl Envelope {
    /// `gain` in µm per Vpp, `time_constant` in s, `range` in rad/s, for intervals of up to `period` s.
    pub(crate) fn new(gain: f32, time_constant: f32, range: f32, period: f32) -> Self {
        let sigma = 1.0 / time_constant;
        // The excitation may be at one end of the range and the resonance at the other.
        let largest = Complex::new(LARGEST_DAMPING * sigma, 2.0 * range).norm() * period;
        let doublings = (0..15).find(|&count| largest <= 0.5 * (1_u32 << count) as f32).unwrap_or(15);
        Self { force: gain * sigma, sigma, range, doublings }
    }

    /// The nominal plate, untouched, with its resonance at `resonance`.
    pub(crate) fn nominal(&self, resonance: f32) -> Mode {
        Mode { sigma: self.sigma, resonance }
    }

    /// W after `seconds` of `drive`, and how it changes with λ when `by_lambda` is how it does at the start.
    fn moved(&self, mode: Mode, (w, by_lambda): (Complex, Complex), drive: Drive, seconds: f32) -> (Complex, Complex) {
        let Growth { exp, phi, slope } = Growth::of(mode.lambda(drive.offset).scaled(seconds), self.doublings);
        let push = self.force * drive.vpp * seconds;
        (exp * w + phi.scaled(push), exp * by_lambda + (exp * w + slope.scaled(push)).scaled(seconds))
    }

    /// W after `seconds` of `drive`.
    pub(crate) fn after(&self, mode: Mode, w: Complex, drive: Drive, seconds: f32) -> Complex {
        if seconds > 0.0 { self.moved(mode, (w, Complex::default()), drive, seconds).0 } else { w }
    }

    /// λ from two samples and what was driven in between, one drive after the other: Newton's method from `mode`.
    pub(crate) fn identify(&self, mode: Mode, before: Complex, drives: [(Drive, f32); 2], after: Complex) -> Mode {
        let mut mode = mode;
        for _ in 0..ITERATIONS {
            let mut motion = (before, Complex::default());
            for (drive, seconds) in drives {
                if seconds > 0.0 {
                    motion = self.moved(mode, motion, drive, seconds);
                }
            }
            let step = (after - motion.0).over(motion.1);
            mode = self.clamped(Mode { sigma: mode.sigma - step.re, resonance: mode.resonance + step.im });
        }
        mode
    }

    /// Gains of both loops matched to a plate of damping `sigma`: static gains b/σ (equation 13) and 1/σ (equation 19), one sampled pole.
    pub(crate) fn matched_gains(&self, sigma: f32, closed_loop_pole: f32, period: f32) -> (PiGains, PiGains) {
        let plant_pole = libm::expf(-sigma * period);
        let gains = |gain| PiGains::placing(gain, plant_pole, closed_loop_pole);
        (gains(self.force / sigma), gains(1.0 / sigma))
    }

    /// Within what is looked for.
    pub(crate) fn clamped(&self, mode: Mode) -> Mode {
        Mode {
            sigma: mode.sigma.clamp(self.sigma / LARGEST_DAMPING, self.sigma * LARGEST_DAMPING),
            resonance: mode.resonance.clamp(-self.range, self.range),
        }
    }

    /// The drive that brings W within `seconds` to the real `target`; within `bounds` as close as they allow: first |W|, then its angle.
    pub(crate) fn steer(&self, mode: Mode, w: Complex, target: f32, bounds: &Bounds, seconds: f32) -> Aim {
        let within = |offset: f32| offset.clamp(bounds.lowest_offset, bounds.highest_offset);
        let mut drive = Drive { vpp: 0.0, offset: within(mode.resonance) };
        let mut reached = w;
        for iteration in 0..=ITERATIONS {
            let Growth { exp, phi, slope } = Growth::of(mode.lambda(drive.offset).scaled(seconds), self.doublings);
            let free = exp * w;
            let push = phi.scaled(self.force * seconds);
            drive.vpp = drive_to(free, push, target).clamp(0.0, bounds.limit_vpp);
            reached = free + push.scaled(drive.vpp);
            if iteration < ITERATIONS {
                // d/dω at this drive: −j h (e^z W + b V h φ').
                let turn = free + slope.scaled(self.force * seconds * drive.vpp);
                let by_offset = Complex::new(turn.im, -turn.re).scaled(seconds);
                // arg W falls by Im(dW conj W)/|W|² per rad/s.
                let rate = by_offset.times_conjugate(reached).im;
                let angle = libm::atan2f(reached.im, reached.re);
                let step = angle * reached.norm_squared() / rate;
                if step.is_finite() {
                    drive.offset = within(drive.offset - step);
                }
            }
        }
        Aim { drive, reached }
    }
}

/// The drive V at which `|free + push·V|` is `target`: the larger root. Negative where it is less without a drive already.
fn drive_to(free: Complex, push: Complex, target: f32) -> f32 {
    let squared = push.norm_squared();
    let along = free.times_conjugate(push).re;
    let root = along * along - squared * (free.norm_squared() - target * target);
    let vpp = (libm::sqrtf(root.max(0.0)) - along) / squared;
    if vpp.is_finite() { vpp } else { 0.0 }
}

#[cfg(test)]
pub(crate) mod tests;
