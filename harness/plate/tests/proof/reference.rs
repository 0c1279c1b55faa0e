//! Provides the paper's plate, profiles, and the reference: equation 1 integrated on the carrier.

use ode_solvers::dop_shared::OutputType;
use ode_solvers::{Dop853, System, Vector5};
use platebench_plate::{Complex64, ConditionProfiles, Drive, Model, Plant, Plate, Profile, RawPlate, State, Time};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use rand_distr::{Distribution, Uniform};
use std::f64::consts::TAU;

/// Amplitude in µm, peak to peak. Errors are relative to it.
pub(crate) const SETPOINT: f64 = 2.0;
/// Drive that holds [`SETPOINT`] at resonance, Vpp.
pub(crate) const HOLDING_DRIVE_VPP: f64 = SETPOINT / 0.006_98;

pub(crate) fn paper_plate() -> Plate {
    let text = include_str!("../../../../scenarios/plates/aluminium-198x138.toml");
    toml::from_str::<RawPlate>(text).unwrap().check().unwrap()
}

pub(crate) fn constant_conditions() -> ConditionProfiles {
    conditions(0.0, 0.0)
}

pub(crate) fn conditions(offset_k: f64, force_n: f64) -> ConditionProfiles {
    ConditionProfiles { temperature_offset_k: Profile::constant(offset_k), finger_force_n: Profile::constant(force_n) }
}

pub(crate) fn line(from_ms: f64, from: f64, to_ms: f64, to: f64) -> Profile {
    Profile::Linear(vec![(Time::from_ms(from_ms).unwrap(), from), (Time::from_ms(to_ms).unwrap(), to)])
}

pub(crate) fn finger_profile(finger_force_n: Profile) -> ConditionProfiles {
    ConditionProfiles { finger_force_n, ..constant_conditions() }
}

pub(crate) fn temperature_profile(temperature_offset_k: Profile) -> ConditionProfiles {
    ConditionProfiles { temperature_offset_k, ..constant_conditions() }
}

pub(crate) fn holding_plant(plate: &Plate, model: Model, detuning: f64) -> Plant {
    let drive = Drive { vpp: HOLDING_DRIVE_VPP, omega: plate.omega0 + detuning };
    driven_plant(plate, &constant_conditions(), model, drive)
}

pub(crate) fn driven_plant(plate: &Plate, scene: &ConditionProfiles, model: Model, drive: Drive) -> Plant {
    let mut plant = Plant::new(plate.clone(), scene.clone(), model);
    plant.set_drive(drive);
    plant
}

pub(crate) fn state_at(plant: &mut Plant, ms: f64) -> State {
    plant.advance(Time::from_ms(ms).unwrap(), &[], &mut Vec::new());
    plant.state()
}

/// Largest difference of W and of U/ω, relative to the setpoint.
pub(crate) fn distance(a: &State, b: &State, omega: f64) -> f64 {
    (a.w - b.w).norm().max((a.u - b.u).norm() / omega) / SETPOINT
}

pub(crate) struct Random(ChaCha8Rng);

impl Random {
    pub(crate) fn new(seed: u64) -> Self {
        Self(ChaCha8Rng::seed_from_u64(seed))
    }

    pub(crate) fn in_range(&mut self, low: f64, high: f64) -> f64 {
        Uniform::new(low, high).unwrap().sample(&mut self.0)
    }
}

/// Solution of `z'' + 2σ(t) z' + ω0(t)² z = (N/m) jV e^{jθ}`. The real part is equation 1, the
/// imaginary part is the same a quarter period later. Only [`Self::state`] uses a rotating frame.
pub(crate) struct ReferencePlate {
    time: f64,
    theta: f64,
    /// Components: Re z, Re z'/scale, Im z, Im z'/scale, time in the interval in s.
    z: Vector5<f64>,
    scale: f64,
}

/// Damping in 1/s and resonance in rad/s at a time in s.
pub(crate) type ModeOverTime<'a> = &'a dyn Fn(f64) -> (f64, f64);

struct Equation1<'a> {
    mode: ModeOverTime<'a>,
    start: f64,
    theta: f64,
    omega: f64,
    force: f64,
    scale: f64,
}

/// Time is the fifth component, because DOP853 of `ode_solvers` 0.6.2 has a wrong node in the
/// twelfth stage. It costs seven digits if the right-hand side uses the time argument.
impl System<f64, Vector5<f64>> for Equation1<'_> {
    fn system(&self, _: f64, z: &Vector5<f64>, change: &mut Vector5<f64>) {
        let t = z[4];
        let (sigma, omega0) = (self.mode)(self.start + t);
        let (sin, cos) = (self.theta + self.omega * t).sin_cos();
        let stiffness = omega0 * omega0 / self.scale;
        let force = self.force / self.scale;
        change[0] = self.scale * z[1];
        change[1] = -force * sin - 2.0 * sigma * z[1] - stiffness * z[0];
        change[2] = self.scale * z[3];
        change[3] = force * cos - 2.0 * sigma * z[3] - stiffness * z[2];
        change[4] = 1.0;
    }
}

impl ReferencePlate {
    /// `scale` is about the carrier's angular frequency, so that z and z'/scale have similar sizes.
    pub(crate) fn at_rest(scale: f64) -> Self {
        Self { time: 0.0, theta: 0.0, z: Vector5::zeros(), scale }
    }

    pub(crate) fn advance(&mut self, seconds: f64, force_constant: f64, drive: &Drive, mode: ModeOverTime<'_>) {
        let (theta, omega, scale) = (self.theta, drive.omega, self.scale);
        let equation = Equation1 { mode, start: self.time, theta, omega, force: force_constant * drive.vpp, scale };
        // A fortieth of a carrier period: at rest the solver's error estimate ignores the drive.
        let longest = TAU / scale / 40.0;
        let out = OutputType::Sparse;
        let mut solver = Dop853::from_param(
            equation, 0.0, seconds, seconds, self.z, 1e-13, 1e-14, 0.9, 0.0, 0.333, 6.0, longest, 0.0, 1_000_000, 1000,
            out,
        );
        solver.integrate().unwrap();
        assert_eq!(solver.x_out().last(), Some(&seconds));
        self.z = *solver.y_out().last().unwrap();
        self.z[4] = 0.0;
        self.time += seconds;
        self.theta = (theta + omega * seconds) % TAU;
    }

    pub(crate) fn state(&self) -> State {
        let back = Complex64::cis(-self.theta);
        State {
            w: Complex64::new(self.z[0], self.z[2]) * back,
            u: Complex64::new(self.z[1], self.z[3]) * self.scale * back,
        }
    }

    pub(crate) fn waveform(&self) -> [f64; 2] {
        [self.z[0], self.z[1]]
    }

    pub(crate) fn waveform_of(&self, state: &State) -> [f64; 2] {
        let ahead = Complex64::cis(self.theta);
        [(state.w * ahead).re, (state.u * ahead).re / self.scale]
    }
}
