//! The carrier's phase θ, accumulated over intervals without an error that grows.
//!
//! θ is kept in turns, as a fixed-point fraction of 128 bits that wraps by itself, and ω as turns per nanosecond in the same
//! format. Time is whole nanoseconds, so an interval adds an integer product: no interval rounds, intervals may be split at will,
//! and whole turns drop out. What is left is the rounding of ω to 2⁻¹²⁸ turns/ns, below 1e-22 turns in the 104 days a [`Time`]
//! may last. A sum of `ω Δt` in doubles, wrapped after each interval, is 2e-7 rad off after 1e9 periods; one that is not wrapped,
//! 8e-7 rad.

use crate::time::Time;
use num_complex::Complex64;
use std::f64::consts::TAU;

/// `2¹⁶⁰ / (2π 10⁹)`, rounded: turns per nanosecond at 1 rad/s.
const TURNS_PER_RADIAN: u128 = 0xaefe_2247_4831_3b7d_3bb6_a907_47cd_2459;

/// θ in turns, times 2¹²⁸.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Phase(u128);

/// ω in turns per nanosecond, times 2¹²⁸.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Rate(u128);

impl Phase {
    /// The phase after `span` at `rate`.
    #[must_use]
    pub const fn after(self, span: Time, rate: Rate) -> Self {
        Self(self.0.wrapping_add(rate.0.wrapping_mul(span.as_nanos() as u128)))
    }

    /// θ between −π and π, to the last bit of a double.
    pub const fn radians(self) -> f64 {
        const TURN: f64 = 18_446_744_073_709_551_616.0;
        ((self.0 >> 64) as u64).cast_signed() as f64 * (TAU / TURN)
    }

    /// `e^{jθ}`.
    pub fn rotation(self) -> Complex64 {
        Complex64::cis(self.radians())
    }
}

impl Rate {
    /// The rate of `omega` rad/s, exact to 2⁻¹²⁸ turns/ns. Zero where ω is not a number, is infinite or beyond 2⁸⁵ rad/s, where a
    /// double no longer tells turns apart.
    pub const fn of(omega: f64) -> Self {
        const MANTISSA: u64 = (1 << 52) - 1;
        let bits = omega.abs().to_bits();
        let exponent = (bits >> 52) as i32 - 1075;
        let mantissa = ((bits & MANTISSA) | (1 << 52)) as u128;
        // Subnormal numbers come out as zero, which they are.
        let shift = 32 - exponent;
        let high = mantissa * (TURNS_PER_RADIAN >> 64);
        let low = mantissa * (TURNS_PER_RADIAN as u64 as u128);
        let upper = high + (low >> 64);
        let rate = match shift {
            0..64 => (upper << (64 - shift)) | ((low as u64) >> shift) as u128,
            64..192 => upper >> (shift - 64),
            _ => 0,
        };
        Self(if omega < 0.0 { rate.wrapping_neg() } else { rate })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn turns_of(phase: Phase) -> f64 {
        (phase.radians() / TAU).rem_euclid(1.0)
    }

    /// Expected: the fraction of ωt/2π, computed in decimal with 120 digits from the doubles as they are.
    #[test]
    fn after_a_billion_periods_the_phase_is_that_of_the_closed_form() {
        for (omega, nanos, turns) in [
            // 1 001 537 387 periods and a bit.
            (202_995.0, 31_000_000_000_000, 0.861_118_104_216_541_3),
            (202_995.3, 30_954_321_987_654, 0.235_069_502_160_185_88),
            // 2.25e13 periods: the fastest carrier for as long as time lasts.
            (15_707_500.0, 9_007_199_254_740_991, 0.975_168_623_413_995_6),
            (202_450.0, 1, 3.222_091_822_895_421e-5),
        ] {
            let phase = Phase::default().after(Time::from_nanos(nanos), Rate::of(omega));
            assert!((turns_of(phase) - turns).abs() < 4e-16, "{omega} rad/s: {}", turns_of(phase));
            let back = phase.after(Time::from_nanos(nanos), Rate::of(-omega));
            assert_eq!(back, Phase::default());
        }
    }

    #[test]
    fn a_billion_periods_in_a_million_pieces_are_the_same_bits() {
        let rate = Rate::of(202_995.3);
        let mut phase = Phase::default();
        let (mut left, mut piece) = (31_000_000_000_000_u64, 1_u64);
        let mut summed = 0.0_f64;
        while left > 0 {
            // Pieces of 1 ns to 62 ms, without a pattern.
            piece = piece.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            let span = ((piece >> 38) + 1).min(left);
            phase = phase.after(Time::from_nanos(span), rate);
            summed = (summed + 202_995.3 * span as f64 / 1e9) % TAU;
            left -= span;
        }
        let whole = Phase::default().after(Time::from_nanos(31_000_000_000_000), rate);
        assert_eq!(phase, whole);
        let naive = (summed - whole.radians()).rem_euclid(TAU);
        println!("1e9 periods summed in doubles: {:.1e} rad off", naive.min(TAU - naive));
        println!(
            "    unwrapped: one step of the sum is {:.1e} rad",
            (202_995.3_f64 * 31e3).next_up() - 202_995.3 * 31e3
        );
    }

    #[test]
    fn what_is_no_frequency_turns_nothing() {
        for omega in [0.0, f64::NAN, f64::INFINITY, f64::NEG_INFINITY, 1e-310, 1e-60, 1e30] {
            assert_eq!(Rate::of(omega), Rate::default(), "{omega}");
        }
        // The last that counts: 2⁸⁵ rad/s.
        assert_ne!(Rate::of(f64::from_bits(((1023 + 84) << 52) | 1)), Rate::default());
    }

    proptest! {
        #[test]
        fn over_one_interval_the_phase_is_omega_t(omega in 0.0..2.5e7_f64, nanos in 0_u64..1_000_000) {
            let radians = omega * Time::from_nanos(nanos).seconds();
            let phase = Phase::default().after(Time::from_nanos(nanos), Rate::of(omega));
            let apart = (Complex64::cis(radians) - phase.rotation()).norm();
            prop_assert!(apart <= 4e-16 * radians.max(1.0), "{apart:e}");
        }

        #[test]
        fn rates_add(a in 1.0..1e9_f64, b in 1.0..1e9_f64) {
            // Exact sums of doubles: whole numbers.
            let (a, b) = (a.round(), b.round());
            let apart = Rate::of(a).0 + Rate::of(b).0;
            prop_assert!(Rate::of(a + b).0.abs_diff(apart) <= 2);
        }
    }
}
