//! A plate playing its profiles: the only thing that moves a [`State`] through time.

pub use crate::crossing::{Crossing, Signal, Watch};

use crate::crossing::find_crossings;
use crate::demodulator::Demodulator;
use crate::file::Plate;
use crate::flow::{Flow, State};
use crate::mode::{Conditions, Drive, Mode};
use crate::phase::{Phase, Rate};
use crate::profile::Profile;
use crate::tier::Tier;
use crate::time::Time;
use num_complex::Complex64;
use std::f64::consts::TAU;

/// What freezing a varying mode per substep may cost, as a fraction of the amplitude that the drive would reach at resonance.
///
/// A pole λ that moves at the rate λ' and is frozen at its midpoint over a substep h leaves an error of `λ' bV h³/12` (the first
/// commutator of the Magnus series; the free motion comes out right), and the plate forgets with σ: at most `|λ'| h²/12 · bV/σ`
/// in all. The fast pole adds up to 1.9 times as much, see `kicks_in_step`; where the damping curve bends, `|λ'| h²/4 · |W|`
/// comes on top once. `docs/mathematics.md` derives all three; the tests hold them against the reference integrator.
const FREEZING_ERROR: f64 = 1e-7;
/// Seconds. A line that asks for shorter substeps is over within microseconds, a jump in all but name.
const SHORTEST_SUBSTEP: f64 = 1e-7;

/// What surrounds a plate during a trial.
#[derive(Debug, Clone, PartialEq)]
pub struct Scene {
    /// Kelvin above the reference temperature.
    pub temperature_offset_k: Profile,
    /// Normal force, N.
    pub finger_force_n: Profile,
}

impl Scene {
    /// The surroundings at `time`.
    pub fn at(&self, time: Time) -> Conditions {
        Conditions {
            temperature_offset_k: self.temperature_offset_k.at(time),
            finger_force_n: self.finger_force_n.at(time),
        }
    }

    /// The next point of either profile after `time`.
    pub fn next_point_after(&self, time: Time) -> Option<Time> {
        let points = [&self.temperature_offset_k, &self.finger_force_n].map(|profile| profile.next_point_after(time));
        points.into_iter().flatten().min()
    }
}

/// A plate in motion.
#[derive(Debug, Clone)]
pub struct Plant {
    plate: Plate,
    scene: Scene,
    tier: Tier,
    time: Time,
    state: State,
    drive: Drive,
    /// θ, and how fast it turns.
    phase: Phase,
    rate: Rate,
    demodulator: Option<Demodulator>,
}

impl Plant {
    /// A plate at rest and without drive at the start of `scene`. In the carrier tier its sensor is the plate's demodulator, if it
    /// has one.
    pub fn new(plate: Plate, scene: Scene, tier: Tier) -> Self {
        let lockin = plate.lockin.filter(|_| tier == Tier::Carrier);
        Self {
            demodulator: lockin.map(|lockin| Demodulator::new(lockin, plate.omega0)),
            plate,
            scene,
            tier,
            time: Time::ZERO,
            state: State::default(),
            drive: Drive::default(),
            phase: Phase::default(),
            rate: Rate::default(),
        }
    }

    /// Now.
    pub fn time(&self) -> Time {
        self.time
    }

    /// The state now.
    pub fn state(&self) -> State {
        self.state
    }

    /// The carrier's phase θ now, in every tier.
    pub fn phase(&self) -> Phase {
        self.phase
    }

    /// `y = Re(W e^{jθ})` now, µm: the plate's displacement itself.
    pub fn waveform(&self) -> f64 {
        (self.state.w * self.phase.rotation()).re
    }

    /// W as the sensor's electronics show it now, µm: W itself, or what the demodulator makes of the last carrier periods.
    pub fn seen(&self) -> Complex64 {
        self.demodulator.as_ref().map_or(self.state.w, |demodulator| demodulator.read(self.drive.omega))
    }

    /// The drive from now on.
    pub fn drive(&self) -> Drive {
        self.drive
    }

    /// The plate that moves.
    pub fn plate(&self) -> &Plate {
        &self.plate
    }

    /// The surroundings at `time`.
    pub fn conditions_at(&self, time: Time) -> Conditions {
        self.scene.at(time)
    }

    /// The mode at `time`.
    pub fn mode_at(&self, time: Time) -> Mode {
        self.plate.mode(&self.scene.at(time))
    }

    /// The next point of a profile after `time`.
    pub fn next_point_after(&self, time: Time) -> Option<Time> {
        self.scene.next_point_after(time)
    }

    /// Whatever its profiles say, the surroundings are `conditions` from now on: somebody has put a hand on the plate.
    pub fn hold(&mut self, conditions: Conditions) {
        self.scene = Scene {
            temperature_offset_k: Profile::constant(conditions.temperature_offset_k),
            finger_force_n: Profile::constant(conditions.finger_force_n),
        };
    }

    /// Actuates: the drive applies from now on. W, U and θ are continuous.
    pub fn set_drive(&mut self, drive: Drive) {
        self.rate = Rate::of(drive.omega);
        self.drive = drive;
    }

    /// Moves on to `end`; an earlier one changes nothing. Crossings of the watched bands on the way are put into `crossings` in
    /// order of time; an excursion shorter than a microsecond may go unseen.
    pub fn advance(&mut self, end: Time, watches: &[Watch], crossings: &mut Vec<Crossing>) {
        while self.time < end {
            let piece_end = self.scene.next_point_after(self.time).map_or(end, |point| point.min(end));
            let substeps = self.substeps(piece_end);
            let (start, span) = (self.time.as_nanos(), (piece_end - self.time).as_nanos());
            for substep in 1..=substeps {
                // Rounded down, and exact at the last, which is mostly the only one and needs no division of 128 bits.
                let end = if substep == substeps {
                    piece_end
                } else {
                    Time::from_nanos(start + (u128::from(span) * u128::from(substep) / u128::from(substeps)) as u64)
                };
                self.advance_frozen(end, watches, crossings);
            }
        }
    }

    /// Into how many substeps the interval from now to `end` has to be cut so that freezing the mode stays within
    /// [`FREEZING_ERROR`]. No profile has a point in between.
    fn substeps(&self, end: Time) -> u64 {
        let rate = self.pole_rate();
        if rate == 0.0 {
            return 1;
        }
        let span = end - self.time;
        let longest = (12.0 * FREEZING_ERROR / rate).sqrt().max(SHORTEST_SUBSTEP);
        let mut substeps = (span.seconds() / longest).ceil().max(1.0);
        if self.tier.has_both_poles() {
            let turns = (self.mode_at(self.time).omega0 + self.drive.omega) * span.seconds() / TAU;
            while kicks_in_step(turns / substeps) {
                substeps += 1.0;
            }
        }
        (substeps as u64).min(span.as_nanos())
    }

    /// Bound on |λ'| from now to the next point of a profile, rad/s².
    fn pole_rate(&self) -> f64 {
        let plate = &self.plate;
        let [warming, pressing] = [&self.scene.temperature_offset_k, &self.scene.finger_force_n]
            .map(|profile| profile.slope_after(self.time, 1.0 / plate.sigma0));
        if warming == 0.0 && pressing == 0.0 {
            return 0.0;
        }
        let damping = plate.sigma0 * plate.steepest_damping() * pressing;
        damping.hypot(plate.omega0_per_k.abs() * warming + plate.omega0_per_n.abs() * pressing)
    }

    fn advance_frozen(&mut self, end: Time, watches: &[Watch], crossings: &mut Vec<Crossing>) {
        let start = self.time;
        let mode = self.mode_at(start.midpoint(end));
        let flow = Flow::new(self.tier, &mode, &self.drive, &self.state);
        let seconds = (end - start).seconds();
        let reach = if watches.is_empty() { 0.0 } else { flow.reach(seconds) };
        let known = crossings.len();
        for watch in watches {
            if watch.distance(&self.state) <= reach {
                find_crossings(watch, &flow, &self.state, start, end, crossings);
            }
        }
        if watches.len() > 1
            && let Some(new) = crossings.get_mut(known..)
        {
            new.sort_by_key(|crossing| crossing.time);
        }
        if let Some(demodulator) = &mut self.demodulator {
            demodulator.advance(&flow, start, end, self.phase, self.drive.omega);
        }
        self.phase = self.phase.after(end - start, self.rate);
        self.state = flow.after(seconds);
        self.time = end;
    }
}

/// True where the fast pole makes nearly whole turns per substep: the steps between frozen modes would then kick it in phase, up
/// to `|λ'|/(2ω0σ)` of |W| however short the substeps.
fn kicks_in_step(turns: f64) -> bool {
    turns > 0.75 && !(0.25..=0.75).contains(&turns.fract())
}
