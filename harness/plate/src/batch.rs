//! Many envelopes at once, for campaigns: structure of arrays in lanes of fixed width, which the compiler turns into vector
//! instructions. Every plate has its own mode and its own drive, and both may change in every period.
//!
//! The propagator is that of the envelope tier, `W ← W∞ + (W − W∞) e^{λT}`, `W∞ = bV/(σ + jΔω)`. The exponential is a Taylor
//! polynomial of λT/16, squared four times: for `σT ≤ 4` and `|Δω|T ≤ 4` it is within 2e-13 of the exact one relative to the
//! larger of |W| and |W∞|, and within 4e-15 up to 1. A block with a plate beyond that goes through [`Flow`] plate by plate, slower
//! and as exact. Only additions, multiplications and one division: the same bits on every machine.

#![allow(clippy::inline_always, reason = "only what is inlined is compiled for the processor's vector instructions")]
#![allow(clippy::needless_bitwise_bool, reason = "a branch per lane would cost more than the comparison")]

use crate::flow::{Flow, State};
use crate::mode::{Drive, Mode};
use crate::tier::Tier;
use num_complex::Complex64;
use std::array;
use std::ops::{Add, Mul, Sub};

/// Plates in a block.
pub const LANES: usize = 4;
/// Halvings of the exponent before the polynomial, and squarings after it.
const HALVINGS: u32 = 4;
/// Largest σT and |Δω|T for the polynomial.
const LARGEST_EXPONENT: f64 = 4.0;
/// Components smaller than this, in µm, are set to zero; see [`crate::flow`].
const NEGLIGIBLE: f64 = 1e-150;

#[derive(Debug, Clone, Copy)]
struct Lanes([f64; LANES]);

impl Lanes {
    #[inline(always)]
    fn map(self, each: impl Fn(f64) -> f64) -> Self {
        Self(self.0.map(each))
    }

    #[inline(always)]
    fn with(self, other: Self, each: impl Fn(f64, f64) -> f64) -> Self {
        Self(array::from_fn(|lane| each(self.0[lane], other.0[lane])))
    }

    /// `Σ coefficient[k] x^k`.
    #[inline(always)]
    fn polynomial<const N: usize>(self, coefficients: [f64; N]) -> Self {
        coefficients.into_iter().rev().fold(Self([0.0; LANES]), |sum, next| (sum * self).map(|x| x + next))
    }
}

impl Add for Lanes {
    type Output = Self;

    #[inline(always)]
    fn add(self, other: Self) -> Self {
        self.with(other, |a, b| a + b)
    }
}

impl Sub for Lanes {
    type Output = Self;

    #[inline(always)]
    fn sub(self, other: Self) -> Self {
        self.with(other, |a, b| a - b)
    }
}

impl Mul for Lanes {
    type Output = Self;

    #[inline(always)]
    fn mul(self, other: Self) -> Self {
        self.with(other, |a, b| a * b)
    }
}

/// Plates side by side.
#[derive(Debug, Clone, Copy)]
struct Block {
    in_phase: Lanes,
    quadrature: Lanes,
    sigma: Lanes,
    omega0: Lanes,
    constant: Lanes,
    vpp: Lanes,
    omega: Lanes,
}

/// Lanes without a plate: at rest, without drive, with a mode that nothing can be wrong with.
const EMPTY: Block = {
    let (zero, one) = (Lanes([0.0; LANES]), Lanes([1.0; LANES]));
    Block { in_phase: zero, quadrature: zero, sigma: one, omega0: zero, constant: zero, vpp: zero, omega: zero }
};

/// Many envelopes.
#[derive(Debug, Clone)]
pub struct Envelopes {
    blocks: Vec<Block>,
    count: usize,
}

impl Envelopes {
    /// A plate at rest and without drive per mode. The only allocation.
    pub fn new(modes: impl IntoIterator<Item = Mode>) -> Self {
        let mut batch = Self { blocks: Vec::new(), count: 0 };
        for mode in modes {
            if batch.count.is_multiple_of(LANES) {
                batch.blocks.push(EMPTY);
            }
            batch.count += 1;
            batch.set_mode(batch.count - 1, &mode);
        }
        batch
    }

    /// How many plates there are.
    pub fn len(&self) -> usize {
        self.count
    }

    /// True where there is no plate.
    pub fn is_empty(&self) -> bool {
        self.count == 0
    }

    fn place(&mut self, plate: usize) -> Option<(&mut Block, usize)> {
        (plate < self.count).then_some(())?;
        self.blocks.get_mut(plate / LANES).map(|block| (block, plate % LANES))
    }

    /// Plate `plate` has this mode from now on; nothing where there is no such plate. `mode` must be resonant.
    #[inline]
    pub fn set_mode(&mut self, plate: usize, mode: &Mode) {
        if let Some((block, lane)) = self.place(plate) {
            block.sigma.0[lane] = mode.sigma;
            block.omega0.0[lane] = mode.omega0;
            block.constant.0[lane] = mode.envelope_constant;
        }
    }

    /// Plate `plate` is driven so from now on; nothing where there is no such plate.
    #[inline]
    pub fn set_drive(&mut self, plate: usize, drive: &Drive) {
        if let Some((block, lane)) = self.place(plate) {
            block.vpp.0[lane] = drive.vpp;
            block.omega.0[lane] = drive.omega;
        }
    }

    /// W of plate `plate`, µm.
    #[inline]
    pub fn w(&self, plate: usize) -> Option<Complex64> {
        (plate < self.count).then_some(())?;
        let block = self.blocks.get(plate / LANES)?;
        Some(Complex64::new(block.in_phase.0[plate % LANES], block.quadrature.0[plate % LANES]))
    }

    /// Moves every plate on by `seconds`.
    pub fn advance(&mut self, seconds: f64) {
        // The same code compiled for what the processor can do; nothing is fused, so that the bits are the same.
        pulp::Arch::new().dispatch(Advance { blocks: &mut self.blocks, seconds });
    }
}

struct Advance<'a> {
    blocks: &'a mut [Block],
    seconds: f64,
}

impl pulp::WithSimd for Advance<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: pulp::Simd>(self, _: S) {
        for block in self.blocks {
            if block.is_within(self.seconds) {
                block.advance(self.seconds);
            } else {
                block.advance_one_by_one(self.seconds);
            }
        }
    }
}

impl Block {
    #[inline(always)]
    fn is_within(&self, seconds: f64) -> bool {
        let detuning = self.omega0 - self.omega;
        let lanes = self.sigma.with(detuning, |sigma, detuning| sigma.abs().max(detuning.abs()) * seconds);
        // Written so that what is no number is not within.
        lanes.0.into_iter().fold(true, |all, exponent| all & (exponent <= LARGEST_EXPONENT))
    }

    #[inline(always)]
    fn advance(&mut self, seconds: f64) {
        let part = seconds / f64::from(1 << HALVINGS);
        let detuning = self.omega0 - self.omega;
        let (x, y) = (self.sigma.map(|sigma| -sigma * part), detuning.map(|detuning| detuning * part));
        let squared = y * y;
        let decay = x.polynomial(TAYLOR);
        let cos = squared.polynomial([1.0, -TAYLOR[2], TAYLOR[4], -TAYLOR[6], TAYLOR[8], -TAYLOR[10]]);
        let sin = y * squared.polynomial([1.0, -TAYLOR[3], TAYLOR[5], -TAYLOR[7], TAYLOR[9]]);
        let (mut re, mut im) = (decay * cos, decay * sin);
        for _ in 0..HALVINGS {
            (re, im) = ((re - im) * (re + im), (re * im).map(|product| product + product));
        }
        let force = self.constant * self.vpp;
        let scale = force.with(self.sigma * self.sigma + detuning * detuning, |force, square| force / square);
        let (rest_re, rest_im) = (scale * self.sigma, scale * detuning);
        let (off_re, off_im) = (self.in_phase - rest_re, self.quadrature - rest_im);
        let flush = |x: f64| if x.abs() < NEGLIGIBLE { 0.0 } else { x };
        self.in_phase = (rest_re + (off_re * re - off_im * im)).map(flush);
        self.quadrature = (rest_im + (off_re * im + off_im * re)).map(flush);
    }

    #[cold]
    fn advance_one_by_one(&mut self, seconds: f64) {
        for lane in 0..LANES {
            let mode = Mode {
                sigma: self.sigma.0[lane],
                omega0: self.omega0.0[lane],
                force_constant: 0.0,
                envelope_constant: self.constant.0[lane],
            };
            let drive = Drive { vpp: self.vpp.0[lane], omega: self.omega.0[lane] };
            let w = Complex64::new(self.in_phase.0[lane], self.quadrature.0[lane]);
            let state = State { w, u: Complex64::ZERO };
            let w = Flow::new(Tier::Envelope, &mode, &drive, &state).after(seconds).w;
            (self.in_phase.0[lane], self.quadrature.0[lane]) = (w.re, w.im);
        }
    }
}

/// `1/k!`
const TAYLOR: [f64; 11] = [
    1.0,
    1.0,
    1.0 / 2.0,
    1.0 / 6.0,
    1.0 / 24.0,
    1.0 / 120.0,
    1.0 / 720.0,
    1.0 / 5_040.0,
    1.0 / 40_320.0,
    1.0 / 362_880.0,
    1.0 / 3_628_800.0,
];

#[cfg(test)]
mod tests {
    use super::*;

    /// The code as it is compiled for any processor against that for this one.
    #[test]
    fn vector_instructions_change_no_bit() {
        let modes = (0..64).map(|number| {
            let turn = f64::from(number);
            Mode { sigma: 300.0 + 7.3 * turn, omega0: 2e5 - 31.7 * turn, force_constant: 0.0, envelope_constant: 3.71 }
        });
        let mut batch = Envelopes::new(modes);
        let mut blocks = batch.blocks.clone();
        for period in 0..50 {
            for number in 0..64 {
                batch.set_drive(
                    number,
                    &Drive { vpp: 3.1 * (number + period) as f64, omega: 1.99e5 + 17.3 * period as f64 },
                );
            }
            for (block, driven) in blocks.iter_mut().zip(&batch.blocks) {
                (block.vpp, block.omega) = (driven.vpp, driven.omega);
                assert!(block.is_within(1e-3));
                block.advance(1e-3);
            }
            batch.advance(1e-3);
            for (block, other) in blocks.iter().zip(&batch.blocks) {
                assert_eq!(block.in_phase.0.map(f64::to_bits), other.in_phase.0.map(f64::to_bits));
                assert_eq!(block.quadrature.0.map(f64::to_bits), other.quadrature.0.map(f64::to_bits));
            }
        }
        assert!(batch.w(63).is_some_and(|w| w.norm() > 0.1));
    }
}
