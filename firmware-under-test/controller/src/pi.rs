//! Implements a proportional-integral controller with anti-windup.
//!
//! Output `u[k] = Kp e[k] + x[k]`, integral `x[k+1] = x[k] + Ki·Ts e[k] + c (sat(u[k]) − u[k])`
//! (forward Euler; Åström and Hägglund's back-calculation with tracking constant `c`).

use crate::design::PiGains;

/// Tracking constant c at the lower and the upper limit, as a fraction of `Ki·Ts/Kp`. With 1
/// (conditioning technique) the loop leaves saturation with the closed-loop pole of the design.
/// With 0 there is no anti-windup.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Tracking {
    pub low: f32,
    pub high: f32,
}

impl Tracking {
    pub const CONDITIONED: Self = Self { low: 1.0, high: 1.0 };
}

fn tracking_gain(gains: PiGains, share: f32) -> f32 {
    // Without a proportional gain, c is `share`. With 1, the integral stays at the limit.
    let ratio = if gains.proportional > 0.0 { gains.integral_per_period / gains.proportional } else { 1.0 };
    (share * ratio).min(1.0)
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pi {
    gains: PiGains,
    tracking: Tracking,
    integral: f32,
}

impl Pi {
    pub fn new(gains: PiGains, tracking: Tracking) -> Self {
        Self { gains, tracking, integral: 0.0 }
    }

    pub fn set_gains(&mut self, gains: PiGains) {
        self.gains = gains;
    }

    pub fn seed(&mut self, integral: f32) {
        self.integral = integral;
    }

    pub fn step(&mut self, error: f32, low: f32, high: f32) -> f32 {
        let unlimited = self.gains.proportional * error + self.integral;
        let output = unlimited.clamp(low, high);
        self.integral += self.gains.integral_per_period * error;
        if output != unlimited {
            let share = if output < unlimited { self.tracking.high } else { self.tracking.low };
            self.integral += tracking_gain(self.gains, share) * (output - unlimited);
        }
        output
    }

    pub fn integral(&self) -> f32 {
        self.integral
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const K1: f32 = 0.00698;
    const TAU: f32 = 1.88e-3;

    #[test]
    fn equation_24_gives_the_paper_s_gains() {
        let gains = PiGains::as_printed(K1, TAU, 2e-3, 1e-3);
        // 3 · 1.88 / (0.00698 · 2) = 404.01 Vpp/µm, and 404.01 / 1.88 per ms.
        assert!((gains.proportional - 404.011).abs() < 1e-3);
        assert!((gains.integral_per_period - 214.900).abs() < 1e-3);
    }

    #[test]
    fn the_matched_loop_contracts_the_error_by_its_pole() {
        let gains = PiGains::zero_order_hold_matched(K1, TAU, 2e-3, 1e-3);
        let (a, p) = (libm::expf(-1.0 / 1.88), libm::expf(-1.5));
        let mut pi = Pi::new(gains, Tracking::CONDITIONED);
        let mut w = 0.0_f32;
        for period in 0..8 {
            let v = pi.step(2.0 - w, 0.0, f32::MAX);
            if period == 0 {
                assert!((v - 539.6).abs() < 0.1, "peak drive {v}");
            }
            w = a * w + K1 * (1.0 - a) * v;
            let expected = 2.0 * (1.0 - libm::powf(p, period as f32 + 1.0));
            assert!((w - expected).abs() < 2e-6, "period {period}: {w} instead of {expected}");
        }
    }

    #[test]
    fn a_saturated_integral_stays_recoverable() {
        let mut pi = Pi::new(PiGains::zero_order_hold_matched(K1, TAU, 2e-3, 1e-3), Tracking { low: 1.0, high: 0.5 });
        for _ in 0..1000 {
            pi.step(0.5, 0.0, 400.0);
        }
        assert_eq!(pi.step(0.5, 0.0, 400.0), 400.0);
        // In equilibrium Ki·Ts e = c (u − sat u) with c = 0.5 Ki·Ts/Kp: an excess of Kp e / 0.5.
        assert!(pi.integral() < 400.0 + 270.0 * 0.5 / 0.5);
    }

    #[test]
    fn an_integral_alone_saturates_without_windup() {
        let mut pi = Pi::new(PiGains { proportional: 0.0, integral_per_period: 100.0 }, Tracking::CONDITIONED);
        for _ in 0..20 {
            pi.step(2.0, 0.0, 400.0);
        }
        assert_eq!(pi.step(-1.0, 0.0, 400.0), 400.0);
        assert!(pi.step(-1.0, 0.0, 400.0) < 400.0);
    }
}
