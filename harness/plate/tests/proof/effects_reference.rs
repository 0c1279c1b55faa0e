//! Integrates both modes on the carrier, the amplifier and the temperature as one system of
//! differential equations, as the reference for the optional effects.

use ode_solvers::dop_shared::OutputType;
use ode_solvers::{Dop853, SVector, System};
use platebench_plate::{Complex64, ConditionProfiles, Plate, State, Time};
use std::f64::consts::TAU;

/// Components: Re z, Re z'/ω0, Im z, Im z'/ω0 of both modes; amplifier output; temperature; time.
type Vector = SVector<f64, 11>;
const VPP: usize = 8;
const HEAT: usize = 9;
const TIME: usize = 10;

/// The variable z of each mode obeys `z'' + 2σ z' + ω0² z = (N/m) jV e^{jθ}`, as in `reference.rs`.
pub(crate) struct EffectsReference {
    plate: Plate,
    scene: ConditionProfiles,
    time: f64,
    theta: f64,
    x: Vector,
    has_momentary_loss: bool,
}

struct Equations<'a> {
    plate: &'a Plate,
    scene: &'a ConditionProfiles,
    start: f64,
    theta: f64,
    omega: f64,
    start_vpp: f64,
    input_vpp: f64,
    has_momentary_loss: bool,
}

impl Equations<'_> {
    fn modes(&self, t: f64, heat_k: f64) -> [(f64, f64, f64); 2] {
        let plate = self.plate;
        let time = Time::from_seconds((self.start + t).max(0.0)).unwrap();
        let conditions = self.scene.at(time);
        // The profiles are linear here: two points 1 µs apart give values between nanoseconds.
        let after = self.scene.at(time + Time::from_nanos(1_000));
        let share = (self.start + t - time.seconds()) / 1e-6;
        let force = conditions.finger_force_n + share * (after.finger_force_n - conditions.finger_force_n);
        let offset = conditions.temperature_offset_k
            + share * (after.temperature_offset_k - conditions.temperature_offset_k)
            + heat_k;
        let ratio = plate.damping_ratio_at(force);
        let shift = (plate.omega0_per_k * offset + plate.omega0_per_n * force) / plate.omega0;
        let first = (plate.sigma0 * ratio, plate.omega0 * (1.0 + shift), plate.force_constant());
        let second = plate.effects.second_mode.map_or((1.0, plate.omega0, 0.0), |second| {
            (second.sigma0 * ratio, second.omega0 * (1.0 + shift), 2.0 * second.gain * second.sigma0 * second.omega0)
        });
        [first, second]
    }

    /// Amplifier output without offset. With a bandwidth it is a component of the state.
    fn vpp(&self, x: &Vector) -> f64 {
        match (self.plate.effects.amplifier.pole, self.plate.effects.amplifier.slew_rate) {
            (Some(_), _) => x[VPP],
            (None, Some(rate)) => {
                let reach = rate * x[TIME];
                self.start_vpp + (self.input_vpp - self.start_vpp).clamp(-reach, reach)
            }
            (None, None) => self.input_vpp,
        }
    }
}

impl System<f64, Vector> for Equations<'_> {
    fn system(&self, _: f64, x: &Vector, change: &mut Vector) {
        let (plate, t) = (self.plate, x[TIME]);
        let (sin, cos) = (self.theta + self.omega * t).sin_cos();
        let vpp = self.vpp(x) + plate.effects.amplifier.offset_vpp;
        let scale = plate.omega0;
        for (mode, (sigma, omega0, force)) in self.modes(t, x[HEAT]).into_iter().enumerate() {
            let (at, force) = (4 * mode, force * vpp / scale);
            let stiffness = omega0 * omega0 / scale;
            change[at] = scale * x[at + 1];
            change[at + 1] = -force * sin - 2.0 * sigma * x[at + 1] - stiffness * x[at];
            change[at + 2] = scale * x[at + 3];
            change[at + 3] = force * cos - 2.0 * sigma * x[at + 3] - stiffness * x[at + 2];
        }
        let limit = plate.effects.amplifier.slew_rate.unwrap_or(f64::INFINITY);
        let pole = plate.effects.amplifier.pole.unwrap_or(0.0);
        change[VPP] = (pole * (self.input_vpp - x[VPP])).clamp(-limit, limit);
        change[HEAT] = plate.effects.heating.map_or(0.0, |heating| {
            // The momentary loss is proportional to y'², the mean one to |W|²/2.
            let squared = if self.has_momentary_loss {
                2.0 * (x[1] + x[5]).powi(2)
            } else {
                (x[0] + x[4]).powi(2) + (x[2] + x[6]).powi(2)
            };
            heating.rate * (heating.rise_k_per_um2 * squared - x[HEAT])
        });
        change[TIME] = 1.0;
    }
}

impl EffectsReference {
    pub(crate) fn at_rest(plate: &Plate, scene: &ConditionProfiles) -> Self {
        Self {
            plate: plate.clone(),
            scene: scene.clone(),
            time: 0.0,
            theta: 0.0,
            x: Vector::zeros(),
            has_momentary_loss: false,
        }
    }

    pub(crate) fn with_momentary_loss(self) -> Self {
        Self { has_momentary_loss: true, ..self }
    }

    /// Amplitude of y at resonance, from y and y'.
    pub(crate) fn amplitude_of_y(&self) -> f64 {
        (self.x[0] + self.x[4]).hypot(self.x[1] + self.x[5])
    }

    pub(crate) fn advance(&mut self, seconds: f64, input_vpp: f64, omega: f64) {
        let Self { plate, scene, time: start, theta, has_momentary_loss, .. } = &*self;
        let (start, theta, has_momentary_loss) = (*start, *theta, *has_momentary_loss);
        let start_vpp = self.x[VPP];
        let equations = Equations { plate, scene, start, theta, omega, start_vpp, input_vpp, has_momentary_loss };
        let longest = TAU / plate.omega0 / 40.0;
        let out = OutputType::Sparse;
        let mut solver = Dop853::from_param(
            equations, 0.0, seconds, seconds, self.x, 1e-13, 1e-14, 0.9, 0.0, 0.333, 6.0, longest, 0.0, 1_000_000,
            1000, out,
        );
        solver.integrate().unwrap();
        assert_eq!(solver.x_out().last(), Some(&seconds));
        let mut x = *solver.y_out().last().unwrap();
        if plate.effects.amplifier.pole.is_none() {
            let start_vpp = self.x[VPP];
            let reach = plate.effects.amplifier.slew_rate.map_or(f64::INFINITY, |rate| rate * seconds);
            x[VPP] = start_vpp + (input_vpp - start_vpp).clamp(-reach, reach);
        }
        x[TIME] = 0.0;
        self.theta = (self.theta + omega * seconds) % TAU;
        self.time += seconds;
        self.x = x;
    }

    pub(crate) fn heat_k(&self) -> f64 {
        self.x[HEAT]
    }

    pub(crate) fn waveform(&self) -> f64 {
        self.x[0] + self.x[4]
    }

    pub(crate) fn state(&self) -> State {
        let back = Complex64::cis(-self.theta);
        let x = &self.x;
        State {
            w: Complex64::new(x[0] + x[4], x[2] + x[6]) * back,
            u: Complex64::new(x[1] + x[5], x[3] + x[7]) * self.plate.omega0 * back,
        }
    }
}
