//! Advances a plate in time under its drive, its temperature profile and its force profile.
//!
//! A step ends at each command, at each point of a profile and if an effect changes the drive. While
//! the modes are constant, a step of any length is exact. If the conditions or an effect change the
//! modes, σ and ω0 follow parabolas as in `varying.rs`. A temperature rise that depends on |W| is
//! first computed with the modes of the middle of the step, and then corrected. The length of a step
//! depends on the state of the plate at its start, not on the rows of the trace.

use crate::crossing::{BandMonitor, BandSearch, Crossing, time_without_crossing};
use crate::demodulator::Demodulator;
use crate::effect::Step;
use crate::effects::ActiveEffects;
use crate::flow::{ExponentialSum, Flow, Forcing, LastExponentials, Model, State};
use crate::mode::{ConditionProfiles, Conditions, Drive, Mode};
use crate::motion::{FrozenMotion, ModeMotion, Motion, PerMode};
use crate::phase::{Phase, PhaseRate};
use crate::plate::Plate;
use crate::profile::Profile;
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
const VARYING_ERROR: f64 = 1e-7;
/// Shortest substep, s. A profile that would need a shorter one changes only for microseconds.
const MIN_SUBSTEP: f64 = 1e-8;
/// Largest rate of a pole for `varying.rs`, as a fraction of Ω³/ω0 (Ω: frequency of the free
/// oscillation). The equations there require a slow change; a faster mode is frozen per substep.
/// For the paper's plate the limit is about 1e6 rad/s², which is 1 N in 0.35 ms.
const SLOW_POLE_SHARE: f64 = 1.0 / 40_000.0;
/// Step of a plate with effects relative to one without. The error has order four, so it is a
/// sixteenth.
const EFFECTS_SUBSTEP: f64 = 0.5;
/// Largest step with a temperature rise by an effect, relative to 1/|λ|; the temperature is then
/// nearly a parabola.
const WARMING_SUBSTEP: f64 = 0.25;
/// Step with a temperature rise by an effect, relative to that of a sine that changes as fast. The
/// error is an eighth.
const WARMING_SHARE: f64 = 0.6;
/// Largest rate κ of a temperature rise by an effect, 1/s: the inverse of the shortest time constant.
const MAX_WARMING_RATE: f64 = 100.0;

/// Interval without a jump or a bend of a profile or of the damping curve.
#[derive(Debug, Clone, Copy)]
struct SmoothInterval {
    start: Time,
    end: Time,
    /// Upper bound on |λ'|, rad/s².
    rate: f64,
    /// Mode at the start of the interval; without effects it is constant if `rate` is 0.
    mode: Mode,
    /// Conditions of the whole interval; `None` if they change in it.
    conditions: Option<Conditions>,
}

#[derive(Debug, Clone)]
pub struct Plant {
    plate: Plate,
    scene: ConditionProfiles,
    model: Model,
    time: Time,
    state: State,
    /// Drive at the amplifier's input.
    drive: Drive,
    phase: Phase,
    rate: PhaseRate,
    demodulator: Option<Demodulator>,
    max_pole_rate: f64,
    interval: Option<SmoothInterval>,
    exponentials: LastExponentials,
    /// `None` in the models `linear` and `envelope`, and for a plate without optional effects.
    effects: Option<Box<ActiveEffects>>,
}

impl Plant {
    /// The plate starts at rest without drive. In the carrier model the lock-in demodulator is the
    /// sensor, if the plate has one.
    pub fn new(plate: Plate, scene: ConditionProfiles, model: Model) -> Self {
        let lockin = plate.lockin.filter(|_| model == Model::Carrier);
        Self {
            demodulator: lockin.map(|lockin| Demodulator::new(lockin, plate.omega0)),
            max_pole_rate: max_slow_pole_rate(&plate, &scene),
            interval: None,
            exponentials: LastExponentials::default(),
            effects: (model.has_both_poles() && plate.first_effect().is_some())
                .then(|| Box::new(ActiveEffects::start(&plate.effects))),
            plate,
            scene,
            model,
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
        self.effects.as_ref().map_or(w, |effects| effects.list.iter().fold(w, |w, effect| effect.read(w, self.time)))
    }

    /// Last command of the controller; the amplifier's output may differ.
    pub fn drive(&self) -> Drive {
        self.effects.as_ref().map_or(self.drive, |effects| effects.command)
    }

    pub fn self_heating_k(&self) -> f64 {
        self.effects.as_ref().map_or(0.0, |effects| effects.temperature_rise_k()[0])
    }

    pub fn plate(&self) -> &Plate {
        &self.plate
    }

    pub fn conditions_at(&self, time: Time) -> Conditions {
        let known = self.interval_at(time).and_then(|interval| interval.conditions);
        known.unwrap_or_else(|| self.scene.at(time))
    }

    /// The last smooth interval, if it contains `time`.
    fn interval_at(&self, time: Time) -> Option<&SmoothInterval> {
        self.interval.as_ref().filter(|interval| interval.start <= time && time < interval.end)
    }

    /// First mode at the conditions of `time` and the present self-heating.
    pub fn mode_at(&self, time: Time) -> Mode {
        self.mode_with_rise(time, self.self_heating_k())
    }

    /// First mode at the conditions of `time` and a self-heating of `rise_k`.
    pub fn mode_with_rise(&self, time: Time, rise_k: f64) -> Mode {
        let mut conditions = match self.interval_at(time) {
            Some(interval) if interval.rate == 0.0 && self.effects.is_none() => return interval.mode,
            _ => self.scene.at(time),
        };
        if self.effects.is_some() {
            conditions.temperature_offset_k += rise_k;
        }
        self.plate.mode(&conditions)
    }

    pub fn next_point_after(&self, time: Time) -> Option<Time> {
        self.scene.next_point_after(time)
    }

    /// True if the modes are constant until the next point of a profile.
    pub fn has_constant_modes(&self) -> bool {
        self.max_slopes() == [0.0; 2] && self.plate.effects.heating.is_none()
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
        let Some(effects) = &mut self.effects else { return };
        effects.command = drive;
        let received = effects.list.iter_mut().try_fold(drive, |drive, effect| effect.receive(drive, self.time));
        if let Some(drive) = received {
            self.apply_drive(drive);
        }
    }

    #[inline]
    fn apply_drive(&mut self, drive: Drive) {
        self.rate = PhaseRate::from_omega(drive.omega);
        self.drive = drive;
    }

    /// Moves the plate to `end`; no effect if `end` has passed. Appends to `crossings` in order of
    /// time. Excursions below 1 µs may be missed.
    pub fn advance(&mut self, end: Time, monitors: &[BandMonitor], crossings: &mut Vec<Crossing>) {
        let mut bands = BandSearch { monitors, found: crossings };
        while self.time < end {
            let known = self.interval_at(self.time).map(|interval| (interval.end, interval.rate, interval.mode));
            let (interval_end, rate, mode) = known.unwrap_or_else(|| self.find_smooth_interval());
            let interval_end = interval_end.min(end);
            if self.effects.is_some() {
                self.advance_with_effects(rate, interval_end, &mut bands);
            } else if rate == 0.0 {
                self.advance_frozen(&mode, interval_end, &mut bands);
            } else {
                self.advance_changing(rate, interval_end, &mut bands);
            }
        }
    }

    /// Moves the plate to each multiple of `step` before `end` and calls `each` there. Stops earlier if
    /// the mode or the conditions change, if the plate has effects or a demodulator, or if a monitored
    /// signal could reach an edge. Time and states are those of [`Self::advance`] to each multiple, bit
    /// for bit.
    pub fn advance_in_steps(
        &mut self,
        step: Time,
        end: Time,
        monitors: &[BandMonitor],
        mut each: impl FnMut(Time, &State),
    ) {
        let known =
            self.interval_at(self.time).filter(|interval| interval.rate == 0.0 && interval.conditions.is_some());
        let (Some(SmoothInterval { end: interval_end, mode, .. }), None, None) =
            (known, &self.effects, &self.demodulator)
        else {
            return;
        };
        let mut flow = Flow::new(self.model, mode, &self.drive, &self.state);
        let mut end = end.min(*interval_end);
        if !monitors.is_empty() {
            let bound = flow.excursion_bound();
            let span = time_without_crossing(monitors, &self.state, |distance| bound.seconds_within(distance));
            end = end.min(self.time + span);
        }
        let (start, mut state) = (self.time, self.state);
        let mut next = step.next_multiple_after(start);
        let mut decays = flow.decays_with(&mut self.exponentials, (next - start).seconds());
        while next < end {
            state = flow.state_with(decays);
            if self.time == start {
                // Only the first step may be shorter.
                decays = flow.decays_with(&mut self.exponentials, step.seconds());
            }
            self.time = next;
            each(next, &state);
            flow.start_from(&state);
            next = next + step;
        }
        self.state = state;
        self.phase = self.phase.after(self.time - start, self.rate);
    }

    /// Advances by substeps while the conditions change the mode.
    fn advance_changing(&mut self, rate: f64, end: Time, bands: &mut BandSearch<'_>) {
        let (longest, is_fast) = self
            .longest_substep(rate, |frequency| self.max_varying_substep(rate, frequency, self.pole_norm(frequency)));
        for end in split_interval(self.time, end, longest) {
            // A parabola needs three different instants; less than 3 ns do not contain them.
            if is_fast || (end - self.time).as_nanos() < 3 {
                let mode = self.plate.mode(&self.conditions_in(self.time, end));
                self.advance_frozen(&mode, end, bands);
            } else {
                self.advance_varying(end, max_frozen_substep(rate), bands);
            }
        }
    }

    /// Finds the interval of the present time. Returns its end, its rate and its mode.
    #[cold]
    fn find_smooth_interval(&mut self) -> (Time, f64, Mode) {
        let mode = self.mode_at(self.time);
        let rate = self.pole_rate_bound();
        let bend = if rate == 0.0 { None } else { self.next_bend() };
        let ends = [self.scene.next_point_after(self.time), bend];
        let end = ends.into_iter().flatten().min().unwrap_or(Time::from_nanos(u64::MAX));
        let conditions = (self.max_slopes() == [0.0; 2]).then(|| self.scene.at(self.time));
        self.interval = Some(SmoothInterval { start: self.time, end, rate, mode, conditions });
        (end, rate, mode)
    }

    /// |λ|, 1/s. 0 if no profile is a sine, because only the error bound of a sine uses |λ|.
    fn pole_norm(&self, frequency: f64) -> f64 {
        if frequency == 0.0 {
            return 0.0;
        }
        let mode = self.mode_at(self.time);
        mode.sigma.hypot(mode.omega0 - self.drive.omega)
    }

    /// Longest substep in s, and true if the mode is frozen in it, because it changes too fast for
    /// `varying.rs`. `varying` computes the length without this; its argument is ν in rad/s.
    fn longest_substep(&self, rate: f64, varying: impl FnOnce(f64) -> f64) -> (f64, bool) {
        let frequency = self.scene.bandwidth();
        if rate <= self.max_pole_rate && frequency <= self.plate.omega0 / 10.0 {
            return (varying(frequency), false);
        }
        // Substeps of a turn of the fast pole or more would excite this pole.
        let rate = rate * 1.0_f64.hypot(frequency / (2.0 * self.plate.sigma0));
        (max_frozen_substep(rate).min(0.75 * PI / self.plate.omega0), true)
    }

    /// Longest substep in s. `pole` is |λ| in 1/s, `rate` is |λ'| in rad/s², `frequency` is ν of a
    /// sine profile in rad/s. The error is
    /// `h⁴ |λ'| (|λ'|/240 + ν|λ|/720 + ν²/240 + ν³/2880σ) bV/σ`.
    fn max_varying_substep(&self, rate: f64, frequency: f64, pole: f64) -> f64 {
        let mut sum = rate;
        if frequency > 0.0 {
            sum += frequency * (pole / 3.0 + frequency * (1.0 + frequency / (12.0 * self.plate.sigma0)));
        }
        (240.0 * VARYING_ERROR / (rate * sum)).sqrt().sqrt()
    }

    /// Upper bounds on the slopes of temperature and force until the next point of their profile.
    fn max_slopes(&self) -> [f64; 2] {
        let ConditionProfiles { temperature_offset_k, finger_force_n } = &self.scene;
        [temperature_offset_k, finger_force_n].map(|profile| profile.max_slope_after(self.time))
    }

    /// Upper bound on |λ'| until the next point of a profile, rad/s².
    fn pole_rate_bound(&self) -> f64 {
        let plate = &self.plate;
        let [warming, pressing] = self.max_slopes();
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

    fn advance_frozen(&mut self, mode: &Mode, end: Time, bands: &mut BandSearch<'_>) {
        let flow = Flow::new(self.model, mode, &self.drive, &self.state);
        self.observe_frozen(&flow, end, bands);
        let decays = flow.decays_with(&mut self.exponentials, (end - self.time).seconds());
        let state = flow.state_with(decays);
        self.finish_step(end, state);
    }

    /// Advances with varying modes; the demodulator advances in pieces of at most `longest` s.
    fn advance_varying(&mut self, end: Time, longest: f64, bands: &mut BandSearch<'_>) {
        let start = self.time;
        // A `hold` profile may jump at `end`, so the last point is 1 ns earlier.
        let last = end - Time::from_nanos(1);
        let middle = start.midpoint(last);
        let modes = self.scene.at_each([start, middle, last]).map(|conditions| self.plate.mode(&conditions));
        let [middle, last] = [middle, last].map(|time| (time - start).seconds());
        let varying = VaryingFlow::new(self.model, modes, [middle, last], &self.drive, &self.state);
        let seconds = (end - start).seconds();
        if !bands.monitors.is_empty() {
            let reach = varying.max_excursion(seconds);
            bands.find(|seconds| varying.after(seconds), reach, |_| 0.0, &self.state, (start, end));
        }
        self.demodulate_pieces(end, longest, |plant, from, to| {
            let (mode, state) = (plant.mode_at(from.midpoint(to)), varying.after((from - start).seconds()));
            Flow::new(plant.model, &mode, &plant.drive, &state)
        });
        self.finish_step(end, varying.after(seconds));
    }

    /// Advances by one step with the optional effects. `rate` is the bound on |λ'| by the conditions.
    #[cold]
    fn advance_with_effects(&mut self, rate: f64, interval_end: Time, bands: &mut BandSearch<'_>) {
        let Some(mut effects) = self.effects.take() else { return };
        for effect in &mut effects.list {
            while let Some(drive) = effect.release(self.time) {
                self.apply_drive(drive);
            }
        }
        let (forcing, forcing_end) = effects.shape(self.drive.vpp, self.time);
        let piece_end = forcing_end.map_or(interval_end, |end| end.min(interval_end));
        let warming = if self.plate.effects.heating.is_some() {
            // A step with self-heating is not longer.
            let longest = WARMING_SUBSTEP / self.modes_at(self.time, effects.temperature_rise_k()[0]).first.sigma;
            let amplitude = self.plate.max_amplitude(self.state.w.norm(), longest);
            effects.list.iter().map(|effect| effect.max_warming(amplitude)).sum::<f64>()
        } else {
            0.0
        };
        let is_warming = warming > 0.0;
        let rate = self.plate.max_mode_scale() * (rate + self.plate.omega0_per_k.abs() * warming);
        let (longest, is_fast) = if rate == 0.0 {
            (f64::INFINITY, false)
        } else {
            self.longest_substep(rate, |frequency| {
                self.max_substep_with_effects(&effects, &forcing, is_warming, rate, frequency)
            })
        };
        let end = Time::from_seconds(longest).map_or(piece_end, |step| (self.time + step).min(piece_end));
        let (start, omega) = (self.time, self.drive.omega);
        let (middle, seconds) = (start.midpoint(end), (end - start).seconds());
        let is_varying = rate > 0.0 && !is_fast && (end - start).as_nanos() >= 3;
        let frozen_with = |plant: &Self, effects: &ActiveEffects| {
            let [_, rise_k, _] = effects.temperature_rise_k();
            let modes = plant.modes_with(plant.conditions_in(start, end), rise_k);
            FrozenMotion::new(modes, omega, &forcing, effects.states)
        };
        let mut frozen = frozen_with(self, &effects);
        if is_warming {
            // The second pass uses the modes at the temperature that the first pass found.
            for _ in 0..if is_varying { 1 } else { 2 } {
                effects.predict(&frozen, omega, middle - start, seconds);
                frozen = frozen_with(self, &effects);
            }
        }
        let known = bands.found.len();
        let motion = if is_varying {
            let motion = self.varying_motion(&mut effects, &forcing, end, is_warming);
            let reach = f64::INFINITY;
            bands.find(|seconds| motion.after(seconds).sum(), reach, |_| 0.0, &self.state, (start, end));
            self.demodulate_pieces(end, max_frozen_substep(rate), |plant, from, to| {
                let since = (from - start).seconds();
                let middle = from.midpoint(to);
                let modes = plant.modes_at(middle, effects.rise_k_after(middle - start, end - start));
                FrozenMotion::new(modes, omega, &forcing.from(since), motion.after(since))
            });
            motion
        } else {
            self.observe_frozen(&frozen, end, bands);
            frozen.map(ModeMotion::Constant)
        };
        for crossing in bands.found.iter_mut().skip(known) {
            let at = crossing.time - start;
            crossing.temperature_rise_k =
                [at - Time::from_nanos(1), at].map(|since| effects.rise_k_after(since, end - start));
        }
        let step = Step { start, seconds, forcing: &forcing, motion: &motion };
        effects.list.iter_mut().for_each(|effect| effect.finish(&step));
        effects.states = motion.after(seconds);
        self.finish_step(end, effects.states.sum());
        self.effects = Some(effects);
    }

    /// Motion to `end` while the modes vary. The temperature rise in `effects` is a prediction.
    fn varying_motion(&self, effects: &mut ActiveEffects, forcing: &Forcing, end: Time, is_warming: bool) -> Motion {
        let (start, states) = (self.time, effects.states);
        let (span, middle) = (end - start, start.midpoint(end));
        let varying = |effects: &ActiveEffects| {
            // A `hold` profile may jump at `end`, so the last point is 1 ns earlier.
            let times = [start, middle, end - Time::from_nanos(1)];
            let [first, second, third] =
                times.map(|time| self.modes_at(time, effects.rise_k_after(time - start, span)));
            let [_, middle, last] = times.map(|time| (time - start).seconds());
            first.zip(second).zip(third).zip(states).map(|(((first, second), third), state)| {
                let drive = Drive { vpp: forcing.constant, omega: self.drive.omega };
                let flow = VaryingFlow::new(Model::Modal, [first, second, third], [middle, last], &drive, &state);
                ModeMotion::Varying(flow, *forcing)
            })
        };
        let motion = varying(effects);
        if !is_warming {
            return motion;
        }
        // With the amplitudes of the poles of the moving mode, the frozen motion has no ripple that
        // the moving one does not have, and Simpson's rule can integrate the difference.
        let modes = self.modes_at(middle, effects.temperature_rise_k()[1]);
        let matched = motion.zip(modes).map(|(motion, mode)| motion.start_in(&mode));
        let frozen = FrozenMotion::new(modes, self.drive.omega, forcing, matched);
        let seconds = span.seconds();
        effects.predict(&frozen, self.drive.omega, middle - start, seconds);
        let errors = [0.25, 0.5, 1.0].map(|share| {
            let at = share * seconds;
            motion.after(at).sum().w.norm_sqr() - frozen.after(at).w.norm_sqr()
        });
        effects.list.iter_mut().for_each(|effect| effect.correct(errors, seconds));
        varying(effects)
    }

    /// Finds the crossings of a step with constant modes and takes its samples.
    fn observe_frozen<const N: usize>(
        &mut self,
        motion: &impl ExponentialSum<N>,
        end: Time,
        bands: &mut BandSearch<'_>,
    ) {
        if !bands.monitors.is_empty() {
            let (bound, interval) = (motion.excursion_bound(), (self.time, end));
            let reach = bound.reach((end - self.time).seconds());
            let seconds_within = |distance| bound.seconds_within(distance);
            bands.find(|seconds| motion.after(seconds), reach, seconds_within, &self.state, interval);
        }
        if let Some(demodulator) = &mut self.demodulator {
            let (rest, terms) = motion.terms();
            demodulator.advance(rest, terms, self.time, end, self.phase, self.drive.omega);
        }
    }

    /// Takes the samples of a step with varying modes. The demodulator requires exponentials, so the
    /// modes are frozen for pieces of at most `longest` s. Each piece starts at the exact state, so
    /// errors do not accumulate.
    fn demodulate_pieces<const N: usize, M: ExponentialSum<N>>(
        &mut self,
        end: Time,
        longest: f64,
        motion_between: impl Fn(&Self, Time, Time) -> M,
    ) {
        let Some(mut demodulator) = self.demodulator.take() else { return };
        let (start, mut from) = (self.time, self.time);
        for to in split_interval(start, end, longest) {
            let (rest, terms) = motion_between(self, from, to).terms();
            let phase = self.phase.after(from - start, self.rate);
            demodulator.advance(rest, terms, from, to, phase, self.drive.omega);
            from = to;
        }
        self.demodulator = Some(demodulator);
    }

    /// Conditions in the middle of `start` to `end`, without its rounding to 1 ns: a substep of a fast
    /// change takes some 100 ns, and half a nanosecond in each would add up.
    fn conditions_in(&self, start: Time, end: Time) -> Conditions {
        let (middle, nanos) = (start.midpoint(end), (end - start).as_nanos());
        let before = self.scene.at(middle);
        if nanos % 2 == 0 || nanos == 1 {
            return before;
        }
        let after = self.scene.at(middle + Time::from_nanos(1));
        Conditions {
            temperature_offset_k: f64::midpoint(before.temperature_offset_k, after.temperature_offset_k),
            finger_force_n: f64::midpoint(before.finger_force_n, after.finger_force_n),
        }
    }

    fn modes_at(&self, time: Time, temperature_rise_k: f64) -> PerMode<Mode> {
        self.modes_with(self.scene.at(time), temperature_rise_k)
    }

    fn modes_with(&self, mut conditions: Conditions, temperature_rise_k: f64) -> PerMode<Mode> {
        conditions.temperature_offset_k += temperature_rise_k;
        PerMode { first: self.plate.mode(&conditions), second: self.plate.second_mode(&conditions) }
    }

    /// Longest step in s for `varying.rs`. A ramp of the drive over the whole step adds the error
    /// `|λ||λ'|h³/240`. A temperature rise follows |W|², which changes with up to 2|λ|.
    fn max_substep_with_effects(
        &self,
        effects: &ActiveEffects,
        forcing: &Forcing,
        is_warming: bool,
        rate: f64,
        frequency: f64,
    ) -> f64 {
        let modes = self.modes_at(self.time, effects.temperature_rise_k()[0]);
        let poles = modes.map(|mode| mode.sigma.hypot(mode.omega0 - self.drive.omega));
        let pole = poles.second.map_or(poles.first, |second| poles.first.max(second));
        let mut longest = EFFECTS_SUBSTEP * self.max_varying_substep(rate, frequency, pole);
        if forcing.slope != 0.0 {
            longest = longest.min(EFFECTS_SUBSTEP * (240.0 * VARYING_ERROR / (pole * rate)).cbrt());
        }
        if is_warming {
            let frequency = frequency.max(2.0 * pole + MAX_WARMING_RATE);
            let smooth = WARMING_SHARE * self.max_varying_substep(rate, frequency, pole);
            longest = longest.min(smooth).min(WARMING_SUBSTEP / pole);
        }
        longest
    }

    fn finish_step(&mut self, end: Time, state: State) {
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
fn max_frozen_substep(rate: f64) -> f64 {
    (12.0 * VARYING_ERROR / rate).sqrt().max(MIN_SUBSTEP)
}

/// Splits `start` to `end` into equal pieces of at most `longest` s; yields the end of each.
#[inline]
fn split_interval(start: Time, end: Time, longest: f64) -> impl Iterator<Item = Time> {
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
