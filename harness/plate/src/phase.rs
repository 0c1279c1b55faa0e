//! Accumulates the carrier's phase θ over intervals without a growing error.
//!
//! θ is in turns, as a fixed-point fraction of 128 bits that wraps. ω is in turns per nanosecond in
//! the same format, and time is an integer of nanoseconds. An interval therefore adds an integer
//! product without rounding, and intervals may be split anywhere. The only error is the rounding of
//! ω to 2⁻¹²⁸ turns/ns, below 1e-22 turns in 104 days, the range of [`Time`]. A sum of `ω Δt` in
//! f64 that wraps after each interval has an error of 2e-7 rad after 1e9 periods.

use crate::time::Time;
use num_complex::Complex64;
use std::f64::consts::TAU;

/// Turns per nanosecond at 1 rad/s, times 2¹⁶⁰: `2¹⁶⁰ / (2π 10⁹)`, rounded.
const TURNS_PER_RADIAN: u128 = 0xaefe_2247_4831_3b7d_3bb6_a907_47cd_2459;

/// θ in turns, times 2¹²⁸.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Phase(u128);

/// ω in turns per nanosecond, times 2¹²⁸.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct PhaseRate(u128);

impl Phase {
    #[must_use]
    pub const fn after(self, span: Time, rate: PhaseRate) -> Self {
        Self(self.0.wrapping_add(rate.0.wrapping_mul(span.as_nanos() as u128)))
    }

    /// θ between −π and π, exact to the last bit of an f64.
    pub const fn radians(self) -> f64 {
        const TURN: f64 = 18_446_744_073_709_551_616.0;
        ((self.0 >> 64) as u64).cast_signed() as f64 * (TAU / TURN)
    }

    /// `e^{jθ}`.
    pub fn rotation(self) -> Complex64 {
        Complex64::cis(self.radians())
    }
}

impl PhaseRate {
    /// Rate of `omega` rad/s, exact to 2⁻¹²⁸ turns/ns. 0 for NaN, for infinity and from 2⁸⁵ rad/s
    /// on, because an f64 of this size does not resolve one turn.
    pub const fn from_omega(omega: f64) -> Self {
        const MANTISSA: u64 = (1 << 52) - 1;
        let bits = omega.abs().to_bits();
        let exponent = (bits >> 52) as i32 - 1075;
        let mantissa = ((bits & MANTISSA) | (1 << 52)) as u128;
        // Subnormal numbers get a shift above 191 and become 0.
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

    /// Expected is the fraction of ωt/2π, computed from the f64 values with 120 decimal digits.
    #[test]
    fn the_phase_is_exact_after_a_billion_periods() {
        for (omega, nanos, turns) in [
            // This is after 1 001 537 387 periods.
            (202_995.0, 31_000_000_000_000, 0.861_118_104_216_541_3),
            (202_995.3, 30_954_321_987_654, 0.235_069_502_160_185_88),
            // This is the highest carrier frequency over the longest time, 2.25e13 periods.
            (15_707_500.0, 9_007_199_254_740_991, 0.975_168_623_413_995_6),
            (202_450.0, 1, 3.222_091_822_895_421e-5),
        ] {
            let phase = Phase::default().after(Time::from_nanos(nanos), PhaseRate::from_omega(omega));
            assert!((turns_of(phase) - turns).abs() < 4e-16, "{omega} rad/s: {}", turns_of(phase));
            let back = phase.after(Time::from_nanos(nanos), PhaseRate::from_omega(-omega));
            assert_eq!(back, Phase::default());
        }
    }

    #[test]
    fn a_million_intervals_give_the_same_bits_as_one() {
        let rate = PhaseRate::from_omega(202_995.3);
        let mut phase = Phase::default();
        let (mut left, mut piece) = (31_000_000_000_000_u64, 1_u64);
        let mut summed = 0.0_f64;
        while left > 0 {
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
    fn an_invalid_frequency_has_rate_zero() {
        for omega in [0.0, f64::NAN, f64::INFINITY, f64::NEG_INFINITY, 1e-310, 1e-60, 1e30] {
            assert_eq!(PhaseRate::from_omega(omega), PhaseRate::default(), "{omega}");
        }
        // The largest valid exponent: from 2⁸⁴ to below 2⁸⁵ rad/s.
        assert_ne!(PhaseRate::from_omega(f64::from_bits(((1023 + 84) << 52) | 1)), PhaseRate::default());
    }

    proptest! {
        #[test]
        fn the_phase_of_one_interval_is_omega_t(omega in 0.0..2.5e7_f64, nanos in 0_u64..1_000_000) {
            let radians = omega * Time::from_nanos(nanos).seconds();
            let phase = Phase::default().after(Time::from_nanos(nanos), PhaseRate::from_omega(omega));
            let apart = (Complex64::cis(radians) - phase.rotation()).norm();
            prop_assert!(apart <= 4e-16 * radians.max(1.0), "{apart:e}");
        }

        #[test]
        fn rates_add(a in 1.0..1e9_f64, b in 1.0..1e9_f64) {
            let (a, b) = (a.round(), b.round());
            let apart = PhaseRate::from_omega(a).0 + PhaseRate::from_omega(b).0;
            prop_assert!(PhaseRate::from_omega(a + b).0.abs_diff(apart) <= 2);
        }
    }
}
