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
use crate::varying::Varying;
use num_complex::Complex64;
use std::f64::consts::PI;

/// What a substep of a varying mode may cost, as a fraction of the amplitude that the drive would reach at resonance.
///
/// Two terms of the Magnus series, see [`crate::varying`], leave `λ'² bV h⁵/240` of a pole λ that moves at the rate λ', and the plate
/// forgets with σ: at most `λ'² h⁴/240 · bV/σ` in all. A mode that is frozen at the substep's midpoint leaves `|λ'| h²/12 · bV/σ`, the
/// first commutator. `docs/mathematics.md` derives both and what a curved profile adds; the tests hold them against the reference
/// integrator.
const VARYING_ERROR: f64 = 1e-7;
/// Seconds. A line that asks for shorter substeps is over within microseconds, a jump in all but name.
const SHORTEST_SUBSTEP: f64 = 1e-7;
/// Share of Ω³/ω0, Ω the frequency of the free oscillation, that a pole may move per second; one that moves faster is frozen per substep,
/// for the transformation that takes the poles apart asks for a slow change. Some 1e6 rad/s² for the paper's plate, 1 N in 0.35 ms.
const SLOW: f64 = 1.0 / 40_000.0;

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

    /// The higher angular frequency of the two profiles' swings, rad/s.
    fn angular_frequency(&self) -> f64 {
        self.temperature_offset_k.angular_frequency().max(self.finger_force_n.angular_frequency())
    }
}

/// A stretch of time in which no profile jumps or bends, nor the damping curve under the force.
#[derive(Debug, Clone, Copy)]
struct Piece {
    end: Time,
    /// Bound on |λ'|, rad/s².
    rate: f64,
    /// The mode at its beginning, and throughout where `rate` is 0.
    mode: Mode,
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
    /// The largest |λ'| that is not too fast for [`Varying`], rad/s².
    fastest: f64,
    /// What was last found to be so; the next is looked for where it ends.
    piece: Option<Piece>,
}

impl Plant {
    /// A plate at rest and without drive at the start of `scene`. In the carrier tier its sensor is the plate's demodulator, if it
    /// has one.
    pub fn new(plate: Plate, scene: Scene, tier: Tier) -> Self {
        let lockin = plate.lockin.filter(|_| tier == Tier::Carrier);
        Self {
            demodulator: lockin.map(|lockin| Demodulator::new(lockin, plate.omega0)),
            fastest: fastest(&plate, &scene),
            piece: None,
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
        self.piece = None;
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
            let piece = self.piece();
            let piece_end = piece.end.min(end);
            if piece.rate == 0.0 {
                self.advance_frozen(&piece.mode, piece_end, watches, crossings);
                continue;
            }
            let frequency = self.scene.angular_frequency();
            let fast = piece.rate > self.fastest || frequency > self.plate.omega0 / 10.0;
            let longest = if fast {
                // Never so long that the fast pole would be kicked once per turn.
                let rate = piece.rate * 1.0_f64.hypot(frequency / (2.0 * self.plate.sigma0));
                longest_frozen(rate).min(0.75 * PI / self.plate.omega0)
            } else {
                self.longest_varying(piece.rate, frequency)
            };
            for end in cuts(self.time, piece_end, longest) {
                // A step of less than 3 ns has no three instants before its end.
                if fast || (end - self.time).as_nanos() < 3 {
                    let mode = self.mode_at(self.time.midpoint(end));
                    self.advance_frozen(&mode, end, watches, crossings);
                } else {
                    self.advance_varying(end, longest_frozen(piece.rate), watches, crossings);
                }
            }
        }
    }

    /// What begins now, or has begun and goes on.
    fn piece(&mut self) -> Piece {
        if let Some(piece) = self.piece.filter(|piece| self.time < piece.end) {
            return piece;
        }
        let rate = self.pole_rate();
        let bend = if rate == 0.0 { None } else { self.next_bend() };
        let ends = [self.scene.next_point_after(self.time), bend];
        let end = ends.into_iter().flatten().min().unwrap_or(Time::from_nanos(u64::MAX));
        let piece = Piece { end, rate, mode: self.mode_at(self.time) };
        self.piece = Some(piece);
        piece
    }

    /// Longest substep in s for a pole that moves at `rate` rad/s² and swings at ν = `frequency` rad/s: all that is left is of fourth order,
    /// `h⁴ |λ'| (|λ'|/240 + ν|λ|/720 + ν²/240 + ν³/2880σ) bV/σ`.
    fn longest_varying(&self, rate: f64, frequency: f64) -> f64 {
        let mut sum = rate;
        if frequency > 0.0 {
            let mode = self.mode_at(self.time);
            let pole = mode.sigma.hypot(mode.omega0 - self.drive.omega);
            sum += frequency * (pole / 3.0 + frequency * (1.0 + frequency / (12.0 * self.plate.sigma0)));
        }
        (240.0 * VARYING_ERROR / (rate * sum)).sqrt().sqrt()
    }

    /// Bound on |λ'| from now to the next point of a profile, rad/s².
    fn pole_rate(&self) -> f64 {
        let plate = &self.plate;
        let [warming, pressing] = [&self.scene.temperature_offset_k, &self.scene.finger_force_n]
            .map(|profile| profile.slope_after(self.time));
        if warming == 0.0 && pressing == 0.0 {
            return 0.0;
        }
        let damping = plate.sigma0 * plate.steepest_damping() * pressing;
        damping.hypot(plate.omega0_per_k.abs() * warming + plate.omega0_per_n.abs() * pressing)
    }

    /// When the force next passes a point where the damping curve bends.
    fn next_bend(&self) -> Option<Time> {
        // The last segment goes on beyond its end.
        let (_, bends) = self.plate.damping_ratio.split_last()?;
        bends.iter().filter_map(|[force, _]| self.scene.finger_force_n.next_passage(*force, self.time)).min()
    }

    /// Moves on to `end` with a mode that stays.
    fn advance_frozen(&mut self, mode: &Mode, end: Time, watches: &[Watch], crossings: &mut Vec<Crossing>) {
        let seconds = (end - self.time).seconds();
        let flow = Flow::new(self.tier, mode, &self.drive, &self.state);
        let reach = if watches.is_empty() { 0.0 } else { flow.reach(seconds) };
        self.watch(end, reach, |seconds| flow.after(seconds), watches, crossings);
        if let Some(demodulator) = &mut self.demodulator {
            demodulator.advance(&flow, self.time, end, self.phase, self.drive.omega);
        }
        self.arrive(end, flow.after(seconds));
    }

    /// Moves on to `end` with a mode that moves; a demodulator is given pieces of at most `longest` s.
    fn advance_varying(&mut self, end: Time, longest: f64, watches: &[Watch], crossings: &mut Vec<Crossing>) {
        let start = self.time;
        // At the end itself a held profile may have jumped already.
        let last = end - Time::from_nanos(1);
        let [middle, last] = [start.midpoint(last), last].map(|time| ((time - start).seconds(), self.mode_at(time)));
        let varying = Varying::new(self.tier, &self.mode_at(start), middle, last, &self.drive, &self.state);
        let seconds = (end - start).seconds();
        let reach = if watches.is_empty() { 0.0 } else { varying.reach(seconds) };
        self.watch(end, reach, |seconds| varying.after(seconds), watches, crossings);
        if let Some(mut demodulator) = self.demodulator.take() {
            // It moves on by exponentials. Each cut sets out from where the plate is, so that nothing adds up.
            let mut from = start;
            for to in cuts(start, end, longest) {
                let (mode, state) = (self.mode_at(from.midpoint(to)), varying.after((from - start).seconds()));
                let flow = Flow::new(self.tier, &mode, &self.drive, &state);
                let phase = self.phase.after(from - start, self.rate);
                demodulator.advance(&flow, from, to, phase, self.drive.omega);
                from = to;
            }
            self.demodulator = Some(demodulator);
        }
        self.arrive(end, varying.after(seconds));
    }

    /// Looks for crossings up to `end`, where W gets no further than `reach` µm from where it is.
    fn watch(
        &self,
        end: Time,
        reach: f64,
        after: impl Fn(f64) -> State,
        watches: &[Watch],
        crossings: &mut Vec<Crossing>,
    ) {
        let known = crossings.len();
        for watch in watches {
            if watch.distance(&self.state) <= reach {
                find_crossings(watch, &after, &self.state, self.time, end, crossings);
            }
        }
        if watches.len() > 1
            && let Some(new) = crossings.get_mut(known..)
        {
            new.sort_by_key(|crossing| crossing.time);
        }
    }

    fn arrive(&mut self, end: Time, state: State) {
        self.phase = self.phase.after(end - self.time, self.rate);
        self.state = state;
        self.time = end;
    }
}

/// The largest |λ'| in rad/s² that is slow beside the free oscillation, whatever `scene` makes of the mode.
fn fastest(plate: &Plate, scene: &Scene) -> f64 {
    let largest = |profile: &Profile| profile.range().0.abs().max(profile.range().1.abs());
    let shift = plate.omega0_per_k.abs() * largest(&scene.temperature_offset_k)
        + plate.omega0_per_n.abs() * largest(&scene.finger_force_n);
    let (_, damping) = plate.sigma_within(scene.finger_force_n.range());
    let omega0 = plate.omega0 - shift;
    let squared = ((omega0 - damping) * (omega0 + damping)).max(0.0);
    SLOW * squared * squared.sqrt() / plate.omega0
}

/// Longest substep in s for a mode that is frozen at its midpoint while the pole moves at `rate` rad/s².
fn longest_frozen(rate: f64) -> f64 {
    (12.0 * VARYING_ERROR / rate).sqrt().max(SHORTEST_SUBSTEP)
}

/// The ends of equal pieces of at most `longest` s, from `start` to `end`.
fn cuts(start: Time, end: Time, longest: f64) -> impl Iterator<Item = Time> {
    let span = end - start;
    let pieces = ((span.seconds() / longest).ceil().max(1.0) as u64).min(span.as_nanos());
    (1..=pieces).map(move |piece| {
        // Rounded down, and exact at the last, which is mostly the only one and needs no division of 128 bits.
        if piece == pieces {
            end
        } else {
            let nanos = u128::from(span.as_nanos()) * u128::from(piece) / u128::from(pieces);
            start + Time::from_nanos(nanos as u64)
        }
    })
}
