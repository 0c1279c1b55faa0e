//! Model problems and the reference: equation 1 on the carrier.

use ode_solvers::dop_shared::OutputType;
use ode_solvers::{Dop853, System, Vector5};
use platebench_plate::RawPlate;
use platebench_plate::{Complex64, ConditionProfiles, Drive, Plant, Plate, Profile, State, Tier, Time};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use rand_distr::{Distribution, Uniform};
use std::f64::consts::TAU;

/// µm, peak to peak: what errors are relative to.
pub(crate) const SETPOINT: f64 = 2.0;
/// The drive that holds [`SETPOINT`] at resonance, Vpp.
pub(crate) const HOLDING_DRIVE_VPP: f64 = SETPOINT / 0.006_98;

/// The paper's plate.
pub(crate) fn paper_plate() -> Plate {
    let text = include_str!("../../../../scenarios/plates/aluminium-198x138.toml");
    toml::from_str::<RawPlate>(text).unwrap().check().unwrap()
}

/// Nothing touches the plate and nothing warms it.
pub(crate) fn constant_conditions() -> ConditionProfiles {
    conditions(0.0, 0.0)
}

/// The same offset in K and force in N throughout.
pub(crate) fn conditions(offset_k: f64, force_n: f64) -> ConditionProfiles {
    ConditionProfiles { temperature_offset_k: Profile::constant(offset_k), finger_force_n: Profile::constant(force_n) }
}

/// A plant that `drive` acts on from the start.
pub(crate) fn driven_plant(plate: &Plate, scene: &ConditionProfiles, tier: Tier, drive: Drive) -> Plant {
    let mut plant = Plant::new(plate.clone(), scene.clone(), tier);
    plant.set_drive(drive);
    plant
}

/// Where `plant` is at `ms`.
pub(crate) fn state_at(plant: &mut Plant, ms: f64) -> State {
    plant.advance(Time::from_ms(ms).unwrap(), &[], &mut Vec::new());
    plant.state()
}

/// Distance of two states relative to the setpoint, the velocity scaled by the carrier.
pub(crate) fn distance(a: &State, b: &State, omega: f64) -> f64 {
    (a.w - b.w).norm().max((a.u - b.u).norm() / omega) / SETPOINT
}

/// The same numbers on every machine.
pub(crate) struct Random(ChaCha8Rng);

impl Random {
    pub(crate) fn new(seed: u64) -> Self {
        Self(ChaCha8Rng::seed_from_u64(seed))
    }

    /// Even between `low` and `high`.
    pub(crate) fn in_range(&mut self, low: f64, high: f64) -> f64 {
        Uniform::new(low, high).unwrap().sample(&mut self.0)
    }
}

/// `z'' + 2σ(t) z' + ω0(t)² z = (N/m) jV e^{jθ}`: its real part is equation 1, its imaginary part
/// the same a quarter period on.
///
/// Nothing here knows of a rotating frame: θ is accumulated, and only reading a state turns back by
/// it.
pub(crate) struct ReferencePlate {
    time: f64,
    theta: f64,
    /// Re z, Re z'/scale, Im z, Im z'/scale, seconds into the interval.
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

/// Autonomous, with time as the fifth component: `ode_solvers` 0.6.2 gives the twelfth stage of
/// DOP853 the node 0 in place of 1, which costs seven digits wherever a right-hand side reads the
/// integrator's own time.
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
    /// At rest at time 0; `scale` is an angular frequency near the carrier's, so that z and
    /// z'/scale are alike.
    pub(crate) fn at_rest(scale: f64) -> Self {
        Self { time: 0.0, theta: 0.0, z: Vector5::zeros(), scale }
    }

    /// On through `seconds` under a constant drive.
    pub(crate) fn advance(&mut self, seconds: f64, force_constant: f64, drive: &Drive, mode: ModeOverTime<'_>) {
        let (theta, omega, scale) = (self.theta, drive.omega, self.scale);
        let equation = Equation1 { mode, start: self.time, theta, omega, force: force_constant * drive.vpp, scale };
        // No step beyond a fortieth of a carrier period, so that a small state cannot hide a bend
        // of the drive.
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

    /// W and U seen from the rotating frame.
    pub(crate) fn state(&self) -> State {
        let back = Complex64::cis(-self.theta);
        State {
            w: Complex64::new(self.z[0], self.z[2]) * back,
            u: Complex64::new(self.z[1], self.z[3]) * self.scale * back,
        }
    }

    /// y and y'/ω of equation 1: the real carrier.
    pub(crate) fn waveform(&self) -> [f64; 2] {
        [self.z[0], self.z[1]]
    }

    /// What a state in the rotating frame says that the waveform is.
    pub(crate) fn waveform_of(&self, state: &State) -> [f64; 2] {
        let ahead = Complex64::cis(self.theta);
        [(state.w * ahead).re, (state.u * ahead).re / self.scale]
    }
}
