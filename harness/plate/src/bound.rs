//! How far a tier can be from the exact plate, from what is known before a run.
//!
//! Derived in `docs/mathematics.md`, "The cheapest plate that is good enough". Split W of the modal plate over its poles, `W = P + Q`. Then
//! `P' = (−σ + j(ωd − ω))P + b'V` and `Q' = (−σ − j(ωd + ω))Q − b'V` with `b' = b ω0(reference)/ωd`, and both jump by
//! `|δs₊|/2ωd · |W|` where the mode does, in opposite directions. The envelope is P with ω0 in place of ωd and b in place of b'.
//! What is bounded is the distance for one and the same sequence of drives; what a loop makes of it is its own matter.

use crate::file::Plate;
use crate::profile::Profile;
use crate::tier::Tier;
use crate::time::Time;

/// Varying parameters, relative to what the drive would reach at resonance: three times `VARYING_ERROR` of the plant, which a mode that is frozen takes up.
const VARYING: f64 = 3e-7;
/// Rounding of an exact tier; 6.3e-12 was measured over 40 periods.
const ROUNDING: f64 = 1e-10;
/// Q∞ is `b'V/|σ + j(ωd + ω)|`: what ω and the mode may move it by as long as they stay within a percent of the reference.
const RIPPLE_MARGIN: f64 = 1.02;

/// What is known of a trial before it is played.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Beforehand {
    /// Lowest and highest σ, 1/s.
    pub sigma: (f64, f64),
    /// Lowest and highest ω0, rad/s.
    pub omega0: (f64, f64),
    /// ω0 at the reference temperature, rad/s.
    pub reference_omega0: f64,
    /// `b = K1 σ0`, µm/s per Vpp.
    pub envelope_constant: f64,
    /// Largest |ω − ω0| that the excitation may have, rad/s.
    pub detuning: f64,
    /// Largest |W|, µm.
    pub amplitude_um: f64,
    /// Largest `∫ b V(s) e^{−σ(t−s)} ds`, µm: where the drive alone would push a plate at resonance.
    pub push_um: f64,
    /// Highest drive, Vpp.
    pub drive_vpp: f64,
    /// Largest sum of the drive's changes so far, each decayed with σ since, Vpp.
    pub drive_swing_vpp: f64,
    /// Largest sum of the pole's changes so far, each decayed with σ since, rad/s.
    pub pole_swing: f64,
    /// True where a profile moves on its own between its points.
    pub varies: bool,
    /// Mean age of what the sensor shows, s: half of what a demodulator averages over; 0 where the sensor shows W at once.
    pub sensor_latency_s: f64,
    /// What else the sensor's electronics may add to W, µm.
    pub sensor_error_um: f64,
}

impl Beforehand {
    /// Bound on |ΔW| in µm between `tier` and the exact plate under the same drives, or on what its sensor shows at the control instants.
    pub fn error(&self, tier: Tier) -> f64 {
        let exact = numerical(self.varies) * self.push_um;
        match tier {
            Tier::Carrier => exact,
            Tier::Modal => exact + self.demodulator(),
            Tier::Envelope => exact + self.demodulator() + self.envelope(),
            Tier::Linear => exact + self.demodulator() + self.envelope() + self.decoupling(),
        }
    }

    /// What a sensor that shows W at once leaves out. P moves on with at most its steepest slope until it is shown, and by as much in 1/2ω passes the
    /// demodulator at twice the carrier. Of Q nothing passes as itself, and as much at twice the carrier, where it stands still.
    fn demodulator(&self) -> f64 {
        if self.sensor_latency_s == 0.0 {
            return self.sensor_error_um;
        }
        let pole = self.sigma.1.hypot(self.detuning);
        let slope = self.envelope_constant * self.drive_vpp + pole * self.amplitude_um;
        let late = self.sensor_latency_s + 1.0 / (2.0 * self.lowest_damped());
        slope * late + 3.0 * self.ripple() + self.sensor_error_um
    }

    /// Envelope against modal.
    fn envelope(&self) -> f64 {
        let (slowest, fastest) = self.sigma;
        let damped = self.lowest_damped();
        // ω0 in place of ωd turns P, b in place of b' scales it; both for as long as the plate remembers.
        let turned =
            (self.omega0.1 - (self.omega0.1.powi(2) - fastest * fastest).max(0.0).sqrt()) * self.push_um / slowest;
        let scaled = [self.omega0.0, self.omega0.1]
            .map(|omega0| (1.0 - self.reference_omega0 / (omega0 * omega0 - fastest * fastest).max(1.0).sqrt()).abs());
        let scaled = scaled[0].max(scaled[1]) * self.push_um;
        // A change of the mode moves P and Q, once each.
        let moved = 2.0 * self.pole_swing / (2.0 * damped) * self.amplitude_um;
        turned + scaled + self.ripple() + moved
    }

    /// Largest |Q|: where the fast pole rests, and what is left of its ripples.
    fn ripple(&self) -> f64 {
        let damped = self.lowest_damped();
        let constant = self.envelope_constant * self.reference_omega0 / damped;
        RIPPLE_MARGIN * constant * (self.drive_vpp + self.drive_swing_vpp) / (2.0 * damped)
    }

    /// Linear against envelope: `Wd(1 + jr)` satisfies the envelope's equation but for `−Δω r Wd + j r Wd'`, and |r| stays below |Δω|/σ.
    fn decoupling(&self) -> f64 {
        let (slowest, fastest) = self.sigma;
        let ratio = self.detuning / slowest;
        let slope = self.envelope_constant * self.drive_vpp * fastest / slowest;
        ratio * (self.detuning * self.push_um + slope) / slowest
    }

    fn lowest_damped(&self) -> f64 {
        (self.omega0.0.powi(2) - self.sigma.1.powi(2)).max(1.0).sqrt()
    }
}

/// Bound on the numerical error of an exact tier, relative to what the drive would reach at resonance; `varies` where parameters move between points.
pub fn numerical(varies: bool) -> f64 {
    if varies { VARYING } else { ROUNDING }
}

impl Plate {
    /// How fast the pole −σ + jω0 moves per newton and per kelvin at most, rad/s.
    pub fn pole_sensitivity(&self) -> (f64, f64) {
        ((self.sigma0 * self.steepest_damping()).hypot(self.omega0_per_n), self.omega0_per_k.abs())
    }

    /// Lowest and highest σ while the force is between `low` and `high` N.
    pub fn sigma_within(&self, (low, high): (f64, f64)) -> (f64, f64) {
        let bends = self.damping_ratio.iter().map(|point| point[0]).filter(|force| (low..=high).contains(force));
        let ratios = bends.chain([low, high]).map(|force| self.damping_ratio_at(force));
        let (least, most) = ratios.fold((f64::INFINITY, 0.0_f64), |(a, b), ratio| (a.min(ratio), b.max(ratio)));
        (self.sigma0 * least, self.sigma0 * most)
    }
}

impl Profile {
    /// The largest sum of all changes so far, each decayed with `sigma` 1/s since; the first value counts as one where `from_rest`.
    pub fn decayed_variation(&self, sigma: f64, from_rest: bool) -> f64 {
        let first = if from_rest { self.at(Time::ZERO).abs() } else { 0.0 };
        let (points, jumps) = match self {
            Self::Hold(points) => (points, true),
            Self::Linear(points) => (points, false),
            Self::Sine { amplitude, omega, .. } => return first + (amplitude * omega).abs() / sigma,
        };
        let (mut sum, mut largest) = (first, first);
        for pair in points.windows(2) {
            let [(from, before), (to, after)] = pair else { continue };
            let seconds = (*to - *from).seconds();
            let (left, change) = ((-sigma * seconds).exp(), (after - before).abs());
            // On a line it comes bit by bit, and the first of it is partly forgotten at the end.
            sum = sum * left + if jumps { change } else { change / seconds * (1.0 - left) / sigma };
            largest = largest.max(sum);
        }
        largest
    }

    /// True where it moves between its points.
    pub fn varies(&self) -> bool {
        match self {
            Self::Hold(_) => false,
            Self::Linear(points) => points.windows(2).any(|pair| matches!(pair, [a, b] if a.1 != b.1)),
            Self::Sine { amplitude, .. } => *amplitude != 0.0,
        }
    }
}
