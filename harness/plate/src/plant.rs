//! Advances a plate in time under its drive, its temperature profile and its force profile.

use crate::crossing::{BandMonitor, Crossing};

use crate::crossing::find_crossings;
use crate::demodulator::Demodulator;
use crate::effects::Effects;
use crate::flow::{Flow, State};
use crate::mode::{Conditions, Drive, Mode};
use crate::phase::{Phase, PhaseRate};
use crate::plate::Plate;
use crate::profile::Profile;
use crate::tier::Tier;
use crate::time::Time;
use crate::varying::VaryingFlow;
use num_complex::Complex64;
use std::f64::consts::PI;

/// Allowed error of a varying mode relative to its amplitude at resonance (`docs/mathematics.md`).
///
/// λ is a pole and λ' its rate. Two terms of the Magnus series (`varying.rs`) leave the error
/// `λ'² bV h⁵/240` in a substep h. The error decays with σ, so its sum is at most
/// `λ'² h⁴/240 · bV/σ`. A mode that is frozen at its midpoint leaves `|λ'| h²/12 · bV/σ`, the first
/// commutator.
pub(crate) const VARYING_ERROR: f64 = 1e-7;
/// Shortest substep, s. A profile that would need a shorter one changes only for microseconds.
const MIN_SUBSTEP: f64 = 1e-7;
/// Largest rate of a pole for `varying.rs`, as a fraction of Ω³/ω0 (Ω: frequency of the free
/// oscillation). The equations there require a slow change; a faster mode is frozen per substep.
/// For the paper's plate the limit is about 1e6 rad/s², which is 1 N in 0.35 ms.
const SLOW_POLE_SHARE: f64 = 1.0 / 40_000.0;

#[derive(Debug, Clone, PartialEq)]
pub struct ConditionProfiles {
    pub temperature_offset_k: Profile,
    pub finger_force_n: Profile,
}

impl ConditionProfiles {
    pub fn at(&self, time: Time) -> Conditions {
        Conditions {
            temperature_offset_k: self.temperature_offset_k.at(time),
            finger_force_n: self.finger_force_n.at(time),
        }
    }

    pub fn next_point_after(&self, time: Time) -> Option<Time> {
        let points = [&self.temperature_offset_k, &self.finger_force_n].map(|profile| profile.next_point_after(time));
        points.into_iter().flatten().min()
    }

    pub(crate) fn angular_frequency(&self) -> f64 {
        self.temperature_offset_k.angular_frequency().max(self.finger_force_n.angular_frequency())
    }
}

/// Interval without a jump or a bend of a profile or of the damping curve.
#[derive(Debug, Clone, Copy)]
pub(crate) struct SmoothInterval {
    pub(crate) end: Time,
    /// Upper bound on |λ'|, rad/s².
    pub(crate) rate: f64,
    /// Mode at the start of the interval; it is constant if `rate` is 0.
    mode: Mode,
}

#[derive(Debug, Clone)]
pub struct Plant {
    pub(crate) plate: Plate,
    pub(crate) scene: ConditionProfiles,
    tier: Tier,
    pub(crate) time: Time,
    pub(crate) state: State,
    /// Drive at the amplifier's input.
    pub(crate) drive: Drive,
    pub(crate) phase: Phase,
    pub(crate) rate: PhaseRate,
    pub(crate) demodulator: Option<Demodulator>,
    pub(crate) max_pole_rate: f64,
    interval: Option<SmoothInterval>,
    /// `None` in the tiers `linear` and `envelope`, and for a plate without optional effects.
    effects: Option<Box<Effects>>,
}

impl Plant {
    /// The plate starts at rest without drive. In the carrier tier the lock-in demodulator is the
    /// sensor, if the plate has one.
    pub fn new(plate: Plate, scene: ConditionProfiles, tier: Tier) -> Self {
        let lockin = plate.lockin.filter(|_| tier == Tier::Carrier);
        Self {
            demodulator: lockin.map(|lockin| Demodulator::new(lockin, plate.omega0)),
            max_pole_rate: max_slow_pole_rate(&plate, &scene),
            interval: None,
            effects: Effects::new(&plate).filter(|_| tier.has_both_poles()),
            plate,
            scene,
            tier,
            time: Time::ZERO,
            state: State::default(),
            drive: Drive::default(),
            phase: Phase::default(),
            rate: PhaseRate::default(),
        }
    }

    pub fn time(&self) -> Time {
        self.time
    }

    pub fn state(&self) -> State {
        self.state
    }

    pub fn phase(&self) -> Phase {
        self.phase
    }

    /// `y = Re(W e^{jθ})`, µm.
    pub fn waveform(&self) -> f64 {
        (self.state.w * self.phase.rotation()).re
    }

    /// Output of the sensor in µm: W or the demodulator's output, with latency and drift.
    pub fn sensor_reading(&self) -> Complex64 {
        let w = self.demodulator.as_ref().map_or(self.state.w, |demodulator| demodulator.read(self.drive.omega));
        self.effects.as_ref().map_or(w, |effects| effects.sensor_reading(w, self.time))
    }

    /// Last command of the controller; the amplifier's output may differ.
    pub fn drive(&self) -> Drive {
        self.effects.as_ref().map_or(self.drive, |effects| effects.commanded)
    }

    pub fn self_heating_k(&self) -> f64 {
        self.effects.as_ref().map_or(0.0, |effects| effects.heat_k)
    }

    pub fn plate(&self) -> &Plate {
        &self.plate
    }

    pub fn conditions_at(&self, time: Time) -> Conditions {
        self.scene.at(time)
    }

    /// First mode at the conditions of `time` and the present self-heating.
    pub fn mode_at(&self, time: Time) -> Mode {
        let mut conditions = self.scene.at(time);
        if let Some(effects) = &self.effects {
            conditions.temperature_offset_k += effects.heat_k;
        }
        self.plate.mode(&conditions)
    }

    pub fn next_point_after(&self, time: Time) -> Option<Time> {
        self.scene.next_point_after(time)
    }

    pub fn hold_conditions(&mut self, conditions: Conditions) {
        self.scene = ConditionProfiles {
            temperature_offset_k: Profile::constant(conditions.temperature_offset_k),
            finger_force_n: Profile::constant(conditions.finger_force_n),
        };
        self.interval = None;
    }

    /// Changes the command; W, U and θ are continuous.
    pub fn set_drive(&mut self, drive: Drive) {
        if self.effects.is_some() {
            self.set_drive_with_effects(drive);
        } else {
            self.apply_drive(drive);
        }
    }

    #[cold]
    fn set_drive_with_effects(&mut self, drive: Drive) {
        if let Some(mut effects) = self.effects.take() {
            self.command_drive(&mut effects, drive);
            self.effects = Some(effects);
        }
    }

    #[cold]
    fn advance_with_effects(&mut self, end: Time, monitors: &[BandMonitor], crossings: &mut Vec<Crossing>) {
        if let Some(mut effects) = self.effects.take() {
            self.advance_effects(&mut effects, end, monitors, crossings);
            self.effects = Some(effects);
        }
    }

    #[inline]
    pub(crate) fn apply_drive(&mut self, drive: Drive) {
        self.rate = PhaseRate::from_omega(drive.omega);
        self.drive = drive;
    }

    /// Moves the plate to `end`; no effect if `end` has passed. Appends to `crossings` in order of
    /// time. Excursions below 1 µs may be missed.
    pub fn advance(&mut self, end: Time, monitors: &[BandMonitor], crossings: &mut Vec<Crossing>) {
        if self.effects.is_some() {
            return self.advance_with_effects(end, monitors, crossings);
        }
        while self.time < end {
            let interval = self.smooth_interval();
            let interval_end = interval.end.min(end);
            if interval.rate == 0.0 {
                self.advance_frozen(&interval.mode, interval_end, monitors, crossings);
                continue;
            }
            let frequency = self.scene.angular_frequency();
            let fast = interval.rate > self.max_pole_rate || frequency > self.plate.omega0 / 10.0;
            let longest = if fast {
                // Substeps of a turn of the fast pole or more would excite this pole.
                let rate = interval.rate * 1.0_f64.hypot(frequency / (2.0 * self.plate.sigma0));
                max_frozen_substep(rate).min(0.75 * PI / self.plate.omega0)
            } else {
                self.max_varying_substep(interval.rate, frequency, self.pole_norm(frequency))
            };
            for end in split_interval(self.time, interval_end, longest) {
                // A parabola needs three different instants; less than 3 ns do not contain them.
                if fast || (end - self.time).as_nanos() < 3 {
                    let mode = self.mode_at(self.time.midpoint(end));
                    self.advance_frozen(&mode, end, monitors, crossings);
                } else {
                    self.advance_varying(end, max_frozen_substep(interval.rate), monitors, crossings);
                }
            }
        }
    }

    #[expect(clippy::inline_always, reason = "ci/counts: 4 % of a step")]
    #[inline(always)]
    pub(crate) fn smooth_interval(&mut self) -> SmoothInterval {
        if let Some(interval) = self.interval.filter(|interval| self.time < interval.end) {
            return interval;
        }
        let rate = self.pole_rate_bound();
        let bend = if rate == 0.0 { None } else { self.next_bend() };
        let ends = [self.scene.next_point_after(self.time), bend];
        let end = ends.into_iter().flatten().min().unwrap_or(Time::from_nanos(u64::MAX));
        let interval = SmoothInterval { end, rate, mode: self.mode_at(self.time) };
        self.interval = Some(interval);
        interval
    }

    /// |λ|, 1/s. 0 if no profile is a sine, because only the error bound of a sine uses |λ|.
    fn pole_norm(&self, frequency: f64) -> f64 {
        if frequency == 0.0 {
            return 0.0;
        }
        let mode = self.mode_at(self.time);
        mode.sigma.hypot(mode.omega0 - self.drive.omega)
    }

    /// Longest substep in s. `pole` is |λ| in 1/s, `rate` is |λ'| in rad/s², `frequency` is ν of a
    /// sine profile in rad/s. The error is
    /// `h⁴ |λ'| (|λ'|/240 + ν|λ|/720 + ν²/240 + ν³/2880σ) bV/σ`.
    pub(crate) fn max_varying_substep(&self, rate: f64, frequency: f64, pole: f64) -> f64 {
        let mut sum = rate;
        if frequency > 0.0 {
            sum += frequency * (pole / 3.0 + frequency * (1.0 + frequency / (12.0 * self.plate.sigma0)));
        }
        (240.0 * VARYING_ERROR / (rate * sum)).sqrt().sqrt()
    }

    /// Upper bound on |λ'| until the next point of a profile, rad/s².
    fn pole_rate_bound(&self) -> f64 {
        let plate = &self.plate;
        let [warming, pressing] = [&self.scene.temperature_offset_k, &self.scene.finger_force_n]
            .map(|profile| profile.max_slope_after(self.time));
        if warming == 0.0 && pressing == 0.0 {
            return 0.0;
        }
        let damping = plate.sigma0 * plate.max_damping_slope() * pressing;
        damping.hypot(plate.omega0_per_k.abs() * warming + plate.omega0_per_n.abs() * pressing)
    }

    fn next_bend(&self) -> Option<Time> {
        // The last segment of the damping curve is extended, so its end is not a bend.
        let (_, bends) = self.plate.damping_ratio.split_last()?;
        bends.iter().filter_map(|[force, _]| self.scene.finger_force_n.next_crossing(*force, self.time)).min()
    }

    fn advance_frozen(&mut self, mode: &Mode, end: Time, monitors: &[BandMonitor], crossings: &mut Vec<Crossing>) {
        let seconds = (end - self.time).seconds();
        let flow = Flow::new(self.tier, mode, &self.drive, &self.state);
        if !monitors.is_empty() {
            let bound = flow.excursion_bound();
            let seconds_within = |_, distance| bound.seconds_within(distance);
            self.find_crossings(end, |seconds| flow.after(seconds), seconds_within, monitors, crossings);
        }
        if let Some(demodulator) = &mut self.demodulator {
            let (rest, terms) = flow.terms();
            demodulator.advance(rest, terms, self.time, end, self.phase, self.drive.omega);
        }
        self.finish_step(end, flow.after(seconds));
    }

    /// Advances with varying modes; the demodulator advances in pieces of at most `longest` s.
    fn advance_varying(&mut self, end: Time, longest: f64, monitors: &[BandMonitor], crossings: &mut Vec<Crossing>) {
        let start = self.time;
        // A `hold` profile may jump at `end`, so the last point is 1 ns earlier.
        let last = end - Time::from_nanos(1);
        let [middle, last] = [start.midpoint(last), last].map(|time| ((time - start).seconds(), self.mode_at(time)));
        let varying = VaryingFlow::new(self.tier, &self.mode_at(start), middle, last, &self.drive, &self.state);
        let seconds = (end - start).seconds();
        if !monitors.is_empty() {
            // The bound is valid only from the start of the interval.
            let reach = varying.max_excursion(seconds);
            let seconds_within = |from, distance| if from == 0.0 && reach < distance { seconds } else { 0.0 };
            self.find_crossings(end, |seconds| varying.after(seconds), seconds_within, monitors, crossings);
        }
        if let Some(mut demodulator) = self.demodulator.take() {
            // The demodulator requires exponentials, so the mode is frozen for each piece. Each
            // piece starts at the exact state, so errors do not accumulate.
            let mut from = start;
            for to in split_interval(start, end, longest) {
                let (mode, state) = (self.mode_at(from.midpoint(to)), varying.after((from - start).seconds()));
                let flow = Flow::new(self.tier, &mode, &self.drive, &state);
                let phase = self.phase.after(from - start, self.rate);
                let (rest, terms) = flow.terms();
                demodulator.advance(rest, terms, from, to, phase, self.drive.omega);
                from = to;
            }
            self.demodulator = Some(demodulator);
        }
        self.finish_step(end, varying.after(seconds));
    }

    #[inline]
    pub(crate) fn find_crossings(
        &self,
        end: Time,
        after: impl Fn(f64) -> State,
        seconds_within: impl Fn(f64, f64) -> f64,
        monitors: &[BandMonitor],
        crossings: &mut Vec<Crossing>,
    ) {
        let known = crossings.len();
        for monitor in monitors {
            find_crossings(monitor, &after, &seconds_within, &self.state, self.time, end, crossings);
        }
        if monitors.len() > 1
            && let Some(new) = crossings.get_mut(known..)
        {
            new.sort_by_key(|crossing| crossing.time);
        }
    }

    #[expect(clippy::inline_always, reason = "ci/counts: 4 % of a step")]
    #[inline(always)]
    pub(crate) fn finish_step(&mut self, end: Time, state: State) {
        self.phase = self.phase.after(end - self.time, self.rate);
        self.state = state;
        self.time = end;
    }
}

/// Largest |λ'| for which [`VaryingFlow`] is used under every condition of `scene`, rad/s².
fn max_slow_pole_rate(plate: &Plate, scene: &ConditionProfiles) -> f64 {
    let largest = |profile: &Profile| profile.range().0.abs().max(profile.range().1.abs());
    let shift = plate.omega0_per_k.abs() * largest(&scene.temperature_offset_k)
        + plate.omega0_per_n.abs() * largest(&scene.finger_force_n);
    let damping = plate.max_sigma(scene.finger_force_n.range());
    let omega0 = plate.omega0 - shift;
    let squared = ((omega0 - damping) * (omega0 + damping)).max(0.0);
    SLOW_POLE_SHARE * squared * squared.sqrt() / plate.omega0
}

/// Longest substep in s for a frozen mode whose pole changes at `rate` rad/s².
#[inline]
pub(crate) fn max_frozen_substep(rate: f64) -> f64 {
    (12.0 * VARYING_ERROR / rate).sqrt().max(MIN_SUBSTEP)
}

/// Splits `start` to `end` into equal pieces of at most `longest` s; yields the end of each.
#[inline]
pub(crate) fn split_interval(start: Time, end: Time, longest: f64) -> impl Iterator<Item = Time> {
    let span = end - start;
    let pieces = ((span.seconds() / longest).ceil().max(1.0) as u64).min(span.as_nanos());
    (1..=pieces).map(move |piece| {
        // The last end is exactly `end`. Usually it is the only one: no 128-bit division.
        if piece == pieces {
            end
        } else {
            let nanos = u128::from(span.as_nanos()) * u128::from(piece) / u128::from(pieces);
            start + Time::from_nanos(nanos as u64)
        }
    })
}
