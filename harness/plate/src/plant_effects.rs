//! Advances a plate with optional effects: second mode, amplifier, self-heating, sensor latency.
//!
//! A step ends at each command, at each point of a profile and at the end of the amplifier's ramp.
//! While the modes are constant, a step of any length is exact. If the conditions or the
//! self-heating change the modes, σ and ω0 follow parabolas as in `varying.rs`. The self-heating is
//! first computed from the closed form of |W|², including its ripple, with the modes of the middle
//! of the step. This |W|² has a relative error of up to `|λ'|h²/8`; Simpson's rule corrects it.

use crate::amplifier::Forcing;
use crate::crossing::{BandMonitor, Crossing};
use crate::effects::Effects;
use crate::mode::{Drive, Mode};
use crate::motion::{FrozenMotion, ModeMotion, Motion, PerMode};
use crate::plant::{Plant, VARYING_ERROR, max_frozen_substep, split_interval};
use crate::tier::Tier;
use crate::time::Time;
use crate::varying::VaryingFlow;
use num_complex::Complex64;
use std::f64::consts::PI;

/// Step relative to the substep of `plant.rs`. The error has order four, so it is a sixteenth.
const SUBSTEP_FACTOR: f64 = 0.5;
/// Largest step with self-heating relative to 1/|λ|; the temperature is then nearly a parabola.
const HEATING_SUBSTEP_FACTOR: f64 = 0.25;

struct Step {
    motion: Motion,
    frozen: Option<FrozenMotion>,
    /// Self-heating at the middle and at the end of the step, K.
    heat_k: [f64; 2],
}

impl Plant {
    pub(crate) fn advance_effects(
        &mut self,
        effects: &mut Effects,
        end: Time,
        monitors: &[BandMonitor],
        crossings: &mut Vec<Crossing>,
    ) {
        while self.time < end {
            while let Some(drive) = effects.take_due_command(self.time) {
                self.apply_drive(drive);
            }
            let amplifier = &self.plate.amplifier;
            let (forcing, span) = amplifier.segment(effects.output_vpp, amplifier.converter_output(self.drive.vpp));
            let interval = self.smooth_interval();
            let ends = [effects.next_command(), span.map(|span| self.time + span), Some(interval.end)];
            let piece_end = ends.into_iter().flatten().fold(end, Time::min);
            let rate = self.effects_rate(effects, interval.rate, (piece_end - self.time).seconds());
            let frequency = self.scene.angular_frequency();
            let is_fast = rate > self.max_pole_rate || frequency > self.plate.omega0 / 10.0;
            let longest = if rate == 0.0 {
                f64::INFINITY
            } else if is_fast {
                let rate = rate * 1.0_f64.hypot(frequency / (2.0 * self.plate.sigma0));
                max_frozen_substep(rate).min(0.75 * PI / self.plate.omega0)
            } else {
                self.longest_step(effects, &forcing, rate, frequency)
            };
            let step_end = Time::from_seconds(longest).map_or(piece_end, |step| (self.time + step).min(piece_end));
            let varies = rate > 0.0 && !is_fast && (step_end - self.time).as_nanos() >= 3;
            let step = self.effects_step(effects, &forcing, step_end, varies);
            self.finish_effects(effects, &forcing, &step, step_end, rate, monitors, crossings);
        }
    }

    fn modes_at(&self, time: Time, heat_k: f64) -> PerMode<Mode> {
        let mut conditions = self.scene.at(time);
        conditions.temperature_offset_k += heat_k;
        PerMode { first: self.plate.mode(&conditions), second: self.plate.second_mode(&conditions) }
    }

    /// Upper bound on |λ'| of both modes within the next `seconds`, rad/s². `rate` is the bound for
    /// the first mode without self-heating.
    fn effects_rate(&self, effects: &Effects, rate: f64, seconds: f64) -> f64 {
        let plate = &self.plate;
        let heating = plate.heating.map_or(0.0, |heating| {
            // Per mode the amplitude rises by at most b V t = K1 σ0 V t. A t of at least 1 ms keeps
            // the steps independent of the distance between rows of the trace.
            let second = plate.second_mode.map_or(0.0, |second| second.gain.abs());
            let rise = (plate.gain + second) * (plate.drive_limit_vpp + plate.amplifier.offset_vpp.abs());
            let largest = self.state.w.norm() + rise.min(rise * plate.sigma0 * seconds.max(1e-3));
            let slope = heating.rate * (heating.rise_k_per_um2 * largest * largest + effects.heat_k.abs());
            plate.omega0_per_k.abs() * slope
        });
        let scale = plate
            .second_mode
            .map_or(1.0, |second| (second.omega0 / plate.omega0).max(second.sigma0 / plate.sigma0).max(1.0));
        scale * (rate + heating)
    }

    /// Longest step for `varying.rs`, s. A ramp of the drive over the whole step adds the error
    /// `|λ||λ'|h³/240`.
    fn longest_step(&self, effects: &Effects, forcing: &Forcing, rate: f64, frequency: f64) -> f64 {
        let modes = self.modes_at(self.time, effects.heat_k);
        let poles = modes.map(|mode| mode.sigma.hypot(mode.omega0 - self.drive.omega));
        let pole = poles.second.map_or(poles.first, |second| poles.first.max(second));
        let mut longest = SUBSTEP_FACTOR * self.max_varying_substep(rate, frequency, pole);
        if forcing.slope != 0.0 {
            longest = longest.min(SUBSTEP_FACTOR * (240.0 * VARYING_ERROR / (pole * rate)).cbrt());
        }
        if self.plate.heating.is_some() {
            longest = longest.min(HEATING_SUBSTEP_FACTOR / pole);
        }
        longest
    }

    fn effects_step(&self, effects: &Effects, forcing: &Forcing, end: Time, varies: bool) -> Step {
        let (start, omega) = (self.time, self.drive.omega);
        let (middle, seconds) = (start.midpoint(end), (end - start).seconds());
        let frozen_with = |heat_k| FrozenMotion::new(self.modes_at(middle, heat_k), omega, forcing, effects.states);
        let mut heat_k = [effects.heat_k; 2];
        let mut frozen = frozen_with(effects.heat_k);
        if let Some(heating) = &self.plate.heating {
            // The second pass uses the modes at the temperature that the first pass found.
            for _ in 0..2 {
                let terms = frozen.terms();
                heat_k = [(middle - start).seconds(), seconds].map(|t| heating.after(effects.heat_k, &terms, t));
                frozen = frozen_with(heat_k[0]);
            }
        }
        if !varies {
            return Step { motion: frozen.map(ModeMotion::Constant), frozen: Some(frozen), heat_k };
        }
        let varying_with = |heat_k: [f64; 2]| {
            // A `hold` profile may jump at `end`, so the last point is 1 ns earlier.
            let last = end - Time::from_nanos(1);
            let instants = [(start, effects.heat_k), (middle, heat_k[0]), (last, heat_k[1])];
            let [first, second, third] = instants.map(|(time, heat)| self.modes_at(time, heat));
            let [middle, last] = [middle, last].map(|time| (time - start).seconds());
            first.zip(second).zip(third).zip(effects.states).map(|(((first, second), third), state)| {
                let drive = Drive { vpp: forcing.constant, omega };
                let flow = VaryingFlow::new(Tier::Modal, &first, (middle, second), (last, third), &drive, &state);
                ModeMotion::Varying(flow, *forcing)
            })
        };
        let mut motion = varying_with(heat_k);
        if let Some(heating) = &self.plate.heating {
            let frozen = frozen.map(ModeMotion::Constant);
            let error = |share: f64| {
                let [moving, frozen] =
                    [&motion, &frozen].map(|motion| motion.after(share * seconds).sum().w.norm_sqr());
                moving - frozen
            };
            // Simpson's rule for the error of |W|² (0 at the start) to the middle and to the end.
            let [quarter, half, whole] = [0.25, 0.5, 1.0].map(error);
            let scale = heating.rate * heating.rise_k_per_um2 * seconds / 6.0;
            heat_k[0] += scale / 2.0 * (4.0 * quarter + half);
            heat_k[1] += scale * (4.0 * half + whole);
            motion = varying_with(heat_k);
        }
        Step { motion, frozen: None, heat_k }
    }

    #[expect(clippy::too_many_arguments, reason = "one call; the arguments are the step's input and output")]
    fn finish_effects(
        &mut self,
        effects: &mut Effects,
        forcing: &Forcing,
        step: &Step,
        end: Time,
        rate: f64,
        monitors: &[BandMonitor],
        crossings: &mut Vec<Crossing>,
    ) {
        let (start, motion) = (self.time, &step.motion);
        let seconds = (end - start).seconds();
        if !monitors.is_empty() {
            let bound = step.frozen.map(|frozen| frozen.excursion_bound());
            let seconds_within = |_, distance| bound.map_or(0.0, |bound| bound.seconds_within(distance));
            self.find_crossings(end, |seconds| motion.after(seconds).sum(), seconds_within, monitors, crossings);
        }
        if let Some(mut demodulator) = self.demodulator.take() {
            let omega = self.drive.omega;
            let mut advance = |frozen: &FrozenMotion, from: Time, to: Time| {
                let phase = self.phase.after(from - start, self.rate);
                demodulator.advance(Complex64::ZERO, frozen.terms(), from, to, phase, omega);
            };
            if let Some(frozen) = &step.frozen {
                advance(frozen, start, end);
            } else {
                let mut from = start;
                for to in split_interval(start, end, max_frozen_substep(rate)) {
                    let (since, states) = ((from - start).seconds(), motion.after((from - start).seconds()));
                    let modes = self.modes_at(from.midpoint(to), step.heat_k[0]);
                    advance(&FrozenMotion::new(modes, omega, &forcing.from(since), states), from, to);
                    from = to;
                }
            }
            self.demodulator = Some(demodulator);
        }
        if let Some(history) = &mut effects.history {
            history.push(start, motion);
        }
        effects.states = motion.after(seconds);
        effects.output_vpp = forcing.at(seconds) - self.plate.amplifier.offset_vpp;
        effects.heat_k = step.heat_k[1];
        self.finish_step(end, effects.states.sum());
    }

    pub(crate) fn command_drive(&mut self, effects: &mut Effects, drive: Drive) {
        if let Some(drive) = effects.command(drive, self.time, self.plate.amplifier.dead_time) {
            self.apply_drive(drive);
        }
    }
}
