//! Generates scene i from the envelope, the seed and i alone.

use crate::explore::draw;
use crate::explore::draw::EventKind;
use crate::explore::draw::{
    ConfigurationDraw, DETUNING_STEP_HZ, DEVIATION_STEP_PERCENT, EventDraw, FORCE_STEP_N, Gap, LEVEL_STEP_UM,
    LIMIT_STEP_VPP, NOISE_STEP_UM, PERIOD_STEP_MS, SceneDraw, TEMPERATURE_STEP_K, Target, TrialDraw, USUAL_LEVEL_UM,
    USUAL_PERIOD_MS,
};
use crate::explore::draw::{SineOf, Stratum};
use crate::explore::envelope::Envelope;
use crate::explore::limits::ExploredLaw;
use crate::explore::scene::Tuning;
use crate::explore::scene::{Course, PlateChoice, Relation, Scene, SceneTrial};
use platebench_wire::LawId;
use proptest::strategy::{BoxedStrategy, Strategy, ValueTree};
use proptest::test_runner::{Config, RngAlgorithm, TestRng, TestRunner};
use sha2::{Digest, Sha256};
use std::f64::consts::TAU;

/// Largest share of the drive limit that a setpoint may need in steady state. The rest is a reserve
/// for control.
pub(crate) const MAX_STEADY_DRIVE: f64 = 0.8;
/// Like [`MAX_STEADY_DRIVE`], for overloaded trials. Their drive may stay at the limit.
const MAX_OVERLOAD: f64 = 2.0;
/// Steps of [`Target::Near`] for a setpoint (nm), a force (0.01 N) and a temperature (0.01 K).
const NEAR_STEPS: [i32; 3] = [5, 2, 10];
/// Times at which a time counter in a controller may overflow, µs.
const COUNTERS_US: [u32; 2] = [100_000, 1_000_000];
/// Shortest time between two steps of a staircase, in tenths of a control period.
const STAIR_TENTHS: u32 = 7;
const SINE_STEP_TENTHS: u32 = 20;

#[derive(Debug, Clone)]
pub struct Generator<'a> {
    pub envelope: &'a Envelope,
    pub seed: u64,
    pub law: ExploredLaw,
    pub laws: &'a [LawId],
    pub has_endurance: bool,
}

pub struct SceneTree<'a> {
    generator: Generator<'a>,
    stratum: Stratum,
    tree: Box<dyn ValueTree<Value = SceneDraw>>,
}

impl SceneTree<'_> {
    pub fn current(&self) -> Scene {
        self.generator.build(&self.stratum, &self.tree.current())
    }

    /// Returns false if the scene cannot become simpler.
    pub fn simplify(&mut self) -> bool {
        self.tree.simplify()
    }

    /// Reverts a part of the last simplification. Returns false if that is not possible.
    pub fn complicate(&mut self) -> bool {
        self.tree.complicate()
    }
}

impl<'a> Generator<'a> {
    /// The drawn scene of this number, before anything is derived.
    pub(crate) fn draw(&self, index: u64) -> Result<(Stratum, SceneDraw), String> {
        let SceneTree { stratum, tree, .. } = self.tree(index)?;
        Ok((stratum, tree.current()))
    }

    pub fn tree(&self, index: u64) -> Result<SceneTree<'a>, String> {
        let mut hash = Sha256::new_with_prefix(self.envelope.digest);
        hash.update(self.seed.to_le_bytes());
        hash.update(index.to_le_bytes());
        let random = TestRng::from_seed(RngAlgorithm::ChaCha, &hash.finalize());
        let mut runner = TestRunner::new_with_rng(Config::default(), random);
        let stratum = Stratum::of(index, self.has_endurance);
        let strategy: BoxedStrategy<SceneDraw> = draw::scene(self.envelope, &stratum);
        let tree = strategy.new_tree(&mut runner).map_err(|reason| reason.to_string())?;
        Ok(SceneTree { generator: self.clone(), stratum, tree })
    }

    pub(crate) fn build(&self, stratum: &Stratum, draw: &SceneDraw) -> Scene {
        let judged_configuration = self.configuration(&draw.configuration, self.law);
        let mut judged = SceneTrial { law: self.law, ..self.trial(judged_configuration, &draw.judged, stratum, 10) };
        let relation = stratum.relation.filter(|relation| self.can_relate(*relation, &judged, stratum));
        match relation {
            Some(Relation::Delayed) => self.simplify_for_delay(&mut judged),
            Some(Relation::Proportional) if self.law.is_own() => self.simplify_for_proportion(&mut judged),
            _ => {}
        }
        for fault in draw.faults.iter().filter_map(|fault| fault.place(judged.duration_us, judged.period_us)) {
            if judged.faults.iter().all(|other| other.combines_with(&fault, judged.period_us)) {
                judged.faults.push(fault);
            }
        }
        let earlier_stratum = Stratum { sine: None, is_overloaded: stratum.is_overloaded_before, ..stratum.clone() };
        let law = |draw: &ConfigurationDraw| self.laws.get(draw.law % self.laws.len().max(1)).copied();
        let earlier: Vec<_> = draw
            .earlier
            .iter()
            .map(|(own, trial)| {
                let law = own.as_ref().and_then(law).map_or(self.law, ExploredLaw::from);
                let configuration = own.as_ref().map_or(judged_configuration, |own| self.configuration(own, law));
                SceneTrial { law, ..self.trial(configuration, trial, &earlier_stratum, 1) }
            })
            .collect();
        let shifts_time = stratum.shifts_time && !stratum.is_long && judged.plate.noise_pm == 0;
        let count = match (earlier.is_empty() && relation.is_none(), shifts_time) {
            (false, _) => 2,
            (true, true) => 4,
            (true, false) => 1,
        };
        // A seed in a scenario file is less than 2^63.
        let script_seed = stratum.scripts.map(|index| index.wrapping_add(self.seed) & (u64::MAX >> 1));
        Scene { earlier, judged, count, script_seed, relation }
    }

    fn can_relate(&self, relation: Relation, trial: &SceneTrial, stratum: &Stratum) -> bool {
        let is_equal = trial.plate.noise_pm == 0 && trial.faults.is_empty();
        let has_delay = self.envelope.range.loop_delay_periods[1] > 0.0;
        // A law that steers chooses its phase by the measured W, not by the predicted one.
        let compensates =
            trial.law.properties().is_some_and(|properties| properties.compensates_delay && !properties.steers);
        is_equal
            && match relation {
                // An own law may saturate in its own way.
                Relation::Proportional => !(trial.law.is_own() && stratum.is_overloaded),
                // These stay above the resonance, or step up at Wq = 0.
                Relation::Mirrored => !matches!(trial.law.number(), Some(LawId::FrequencyOnly | LawId::BangBang)),
                Relation::Delayed => has_delay && compensates,
            }
    }

    /// The law predicts exactly on the plate that it is configured for, at its resonance.
    fn simplify_for_delay(&self, trial: &mut SceneTrial) {
        let longest_us = f64::from(trial.period_us) * self.envelope.range.loop_delay_periods[1];
        trial.delay_us = if trial.delay_us == 0 { longest_us as u32 } else { trial.delay_us };
        trial.plate = trial.plate.design();
        (trial.force, trial.temperature) = (CourseBuilder::new().finish(), CourseBuilder::new().finish());
    }

    /// An own law may compare the amplitude or the phase with a fixed number, so the proportion holds
    /// at its resonance.
    fn simplify_for_proportion(&self, trial: &mut SceneTrial) {
        trial.temperature = CourseBuilder::new().finish();
        trial.start_frequency_tenths = (trial.mode_at(&self.envelope.plate, 0).omega0 / TAU * 10.0).round() as u32;
    }

    fn configuration(&self, draw: &ConfigurationDraw, law: ExploredLaw) -> Configuration {
        let range = &self.envelope.range;
        let usual_us = (USUAL_PERIOD_MS.clamp(range.period_ms[0], range.period_ms[1]) * 1e3).round();
        let period_us = usual_us as u32;
        let period_us = period_us.saturating_add_signed(draw.period * (PERIOD_STEP_MS * 1e3) as i32);
        let has_delay = law.properties().is_some_and(|properties| properties.compensates_delay);
        let permille = (DEVIATION_STEP_PERCENT * 10.0) as i32;
        Configuration {
            period_us,
            delay_us: if has_delay { (period_us * draw.delay / 20).min(period_us) } else { 0 },
            plate: PlateChoice {
                limit_vpp: range.drive_limit_vpp[1] as u32 - draw.limit * LIMIT_STEP_VPP as u32,
                noise_pm: draw.noise * (NOISE_STEP_UM * 1e6).round() as u32,
                nominal_gain_permille: draw.nominal_gain * permille,
                nominal_time_constant_permille: draw.nominal_time_constant * permille,
                gain_permille: draw.gain * permille,
                time_constant_permille: draw.time_constant * permille,
            },
            tuning: draw.tuning,
        }
    }

    /// `least_tail` is the smallest number of control periods after the last event.
    fn trial(&self, configuration: Configuration, draw: &TrialDraw, stratum: &Stratum, least_tail: u32) -> SceneTrial {
        let Configuration { period_us, delay_us, plate, tuning } = configuration;
        let mut timeline = Timeline::new(self, configuration, draw);
        for event in &draw.events {
            timeline.add(event);
        }
        let tail_us = timeline.gap_us(draw.tail).max(least_tail * period_us);
        let duration_us = timeline.now_us.max(1) + tail_us;
        let Timeline { setpoint, force, temperature, .. } = timeline;
        let mut trial = SceneTrial {
            law: self.law,
            plate,
            period_us,
            delay_us,
            start_frequency_tenths: 0,
            duration_us,
            setpoint: Course::Hold(Vec::new()),
            force: force.finish(),
            temperature: temperature.finish(),
            tuning,
            faults: Vec::new(),
        };
        self.add_sine(&mut trial, draw, stratum.sine);
        let share = if stratum.is_overloaded { MAX_OVERLOAD } else { MAX_STEADY_DRIVE };
        let highest = trial.largest_setpoint_nm(&self.envelope.plate, share);
        trial.setpoint = setpoint.limited(highest).finish();
        let resonance_hz = trial.mode_at(&self.envelope.plate, 0).omega0 / TAU;
        let start_hz = resonance_hz + f64::from(draw.detuning) * DETUNING_STEP_HZ;
        trial.start_frequency_tenths = (start_hz * 10.0).round() as u32;
        trial
    }

    /// Replaces a course by a sine in its range; with the amplitude 0.25 if it is constant.
    fn add_sine(&self, trial: &mut SceneTrial, draw: &TrialDraw, sine: Option<SineOf>) {
        let range = &self.envelope.range;
        let (course, full_rate) = match sine {
            Some(SineOf::Force) => (&mut trial.force, range.force_rate_n_per_s[1]),
            Some(SineOf::Temperature) => (&mut trial.temperature, range.temperature_rate_k_per_s[1]),
            None => return,
        };
        let [low, high] = course.range().map(|value| value / 100.0);
        let amplitude = if high > low { (high - low) / 2.0 } else { 0.25 };
        let mean = f64::midpoint(low, high).max(amplitude);
        // The slope of the sine does not exceed the largest rate. If even 0.1 Hz is too fast, the
        // course stays without a sine.
        let highest_tenths = (full_rate / (TAU * amplitude) * 10.0) as u32;
        if highest_tenths == 0 {
            return;
        }
        let frequency_tenths = (10 + draw.sine * SINE_STEP_TENTHS).min(highest_tenths);
        let [mean, amplitude] = [mean, amplitude].map(|value| (value * 100.0).round() as i32);
        *course = Course::Sine { mean, amplitude, frequency_tenths };
    }
}

#[derive(Debug, Clone, Copy)]
struct Configuration {
    period_us: u32,
    delay_us: u32,
    plate: PlateChoice,
    tuning: Tuning,
}

struct Timeline<'a> {
    envelope: &'a Envelope,
    period_us: u32,
    /// Factor of quiet times. It is larger for long periods and for slow laws.
    stretch: f64,
    now_us: u32,
    setpoint: CourseBuilder,
    force: CourseBuilder,
    temperature: CourseBuilder,
    /// Earlier setpoints, forces and temperatures.
    values: [Vec<i32>; 3],
}

impl<'a> Timeline<'a> {
    fn new(generator: &Generator<'a>, configuration: Configuration, draw: &TrialDraw) -> Self {
        let period_ms = f64::from(configuration.period_us) / 1e3;
        let mut timeline = Self {
            envelope: generator.envelope,
            period_us: configuration.period_us,
            stretch: period_ms.max(1.0) * generator.law.stretch(),
            now_us: 0,
            setpoint: CourseBuilder::new(),
            force: CourseBuilder::new(),
            temperature: CourseBuilder::new(),
            values: [Vec::new(), Vec::new(), Vec::new()],
        };
        let level = timeline.level(draw.level);
        timeline.setpoint.step(0, level);
        let [force, temperature] = [timeline.force(draw.force), timeline.temperature(draw.temperature)];
        timeline.force.step(0, force);
        timeline.temperature.step(0, temperature);
        timeline
    }

    fn resolve(&mut self, kind: usize, target: Target, range: [f64; 2], usual: f64, step: f64, scale: f64) -> i32 {
        let [low, high] = range.map(|value| (value * scale).round() as i32);
        let usual = (usual * scale).round() as i32;
        let usual = usual.clamp(low, high);
        let step = (step * scale).round() as i32;
        let Some((values, near)) = self.values.get_mut(kind).zip(NEAR_STEPS.get(kind)) else { return usual };
        let last = values.last().copied().unwrap_or(usual);
        let value = match target {
            Target::At(offset) => usual + offset * step,
            Target::Near(0) => last,
            Target::Near(offset) => last + offset * near,
            Target::Earlier(count) => {
                values.len().checked_sub(count + 1).and_then(|at| values.get(at)).copied().unwrap_or(last)
            }
            Target::Least => low,
            Target::Most => high,
        };
        let value = value.clamp(low, high);
        values.push(value);
        value
    }

    fn level(&mut self, target: Target) -> i32 {
        self.resolve(0, target, self.envelope.range.setpoint_um, USUAL_LEVEL_UM, LEVEL_STEP_UM, 1e3)
    }

    fn force(&mut self, target: Target) -> i32 {
        self.resolve(1, target, self.envelope.range.finger_force_n, 0.0, FORCE_STEP_N, 100.0)
    }

    fn temperature(&mut self, target: Target) -> i32 {
        self.resolve(2, target, self.envelope.range.temperature_offset_k, 0.0, TEMPERATURE_STEP_K, 100.0)
    }

    fn gap_us(&self, gap: Gap) -> u32 {
        let range = &self.envelope.range;
        match gap {
            Gap::Quiet(tenths) => ((range.quiet_ms[0] * 1e3 + f64::from(tenths) * 100.0) * self.stretch) as u32,
            Gap::Short(tenths) => tenths * 100,
            Gap::Long(ms) => ((range.long_quiet_ms[0] + f64::from(ms)) * 1e3) as u32,
            Gap::AtCounterEnd(periods) => {
                let next = COUNTERS_US.iter().find(|counter| **counter > self.now_us + 3 * self.period_us);
                let until = next.copied().unwrap_or(self.now_us + 10 * self.period_us);
                until.saturating_add_signed(periods * self.period_us.cast_signed()) - self.now_us
            }
            Gap::UntilSample(sample) => (sample * self.period_us).saturating_sub(self.now_us),
        }
    }

    fn add(&mut self, event: &EventDraw) {
        let mut at = self.now_us + self.gap_us(event.gap).max(100);
        if event.is_aligned || matches!(event.gap, Gap::AtCounterEnd(_)) {
            at = at.div_ceil(self.period_us) * self.period_us;
        } else if at.is_multiple_of(self.period_us) {
            at += self.period_us / 3;
        }
        self.now_us = match event.kind {
            EventKind::Step => {
                let level = self.level(event.level);
                self.setpoint.step(at, level);
                at
            }
            EventKind::Staircase => self.add_staircase(event, at),
            EventKind::Rest => {
                let end = at + self.gap_us(event.gap).max(2 * self.period_us);
                let level = self.level(event.level);
                self.setpoint.step(at, 0);
                self.setpoint.step(end, level);
                end
            }
            EventKind::Ramp => self.ramp_setpoint(event, at),
            EventKind::Touch => {
                let force = self.force(event.force);
                self.force.step(at, force);
                at
            }
            EventKind::Shock => {
                let temperature = self.temperature(event.temperature);
                self.temperature.step(at, temperature);
                at
            }
            EventKind::Press => self.press(event, at),
            EventKind::Heat => self.heat(event, at),
            EventKind::Both => self.press(event, at).max(self.heat(event, at)),
        };
    }

    fn add_staircase(&mut self, event: &EventDraw, at: u32) -> u32 {
        let from = self.values.first().and_then(|levels| levels.last()).copied().unwrap_or(0);
        let to = self.level(event.level);
        let step_us = self.period_us * (STAIR_TENTHS + event.slowness / 4) / 10;
        let count = event.steps.cast_signed();
        let mut end = at;
        for step in 1..=count {
            end = at + step_us * (step - 1) as u32;
            self.setpoint.step(end, from + (to - from) * step / count);
        }
        end
    }

    /// A slow ramp ends before its level is reached.
    fn ramp_setpoint(&mut self, event: &EventDraw, at: u32) -> u32 {
        let from = self.setpoint.last();
        let rate = rate(self.envelope.range.setpoint_rate_um_per_s, event.slowness) * 1e3;
        let reach = (rate * MAX_SETPOINT_RAMP_S) as i32;
        let to = self.level(event.level).clamp(from - reach, from + reach);
        if let Some(last) = self.values[0].last_mut() {
            *last = to;
        }
        let duration = ramp_us(f64::from((to - from).abs()) / rate);
        self.setpoint.ramp(at, duration, to)
    }

    fn press(&mut self, event: &EventDraw, at: u32) -> u32 {
        let to = self.force(event.force);
        let rates = self.envelope.range.force_rate_n_per_s;
        let duration = disturbance_us(to - self.force.last(), rates, event.slowness);
        self.force.ramp(at, duration, to)
    }

    fn heat(&mut self, event: &EventDraw, at: u32) -> u32 {
        let to = self.temperature(event.temperature);
        let rates = self.envelope.range.temperature_rate_k_per_s;
        let duration = disturbance_us(to - self.temperature.last(), rates, event.slowness);
        self.temperature.ramp(at, duration, to)
    }
}

/// Longest duration of a ramp of force or temperature. A ramp that would take longer gets a higher
/// rate.
const MAX_RAMP_S: f64 = 0.1;
const MAX_SETPOINT_RAMP_S: f64 = 0.3;

/// [`EventDraw`] defines `slowness`.
fn rate([slowest, fastest]: [f64; 2], slowness: u32) -> f64 {
    fastest * (slowest / fastest).powf(f64::from(slowness) / 100.0)
}

/// Duration of a ramp of force or temperature by `change` hundredths, µs.
fn disturbance_us(change: i32, rates: [f64; 2], slowness: u32) -> u32 {
    let rate = rate(rates, slowness) * 100.0;
    ramp_us((f64::from(change.abs()) / rate).min(MAX_RAMP_S))
}

/// Duration of a ramp, µs, a multiple of 0.1 ms.
fn ramp_us(seconds: f64) -> u32 {
    ((seconds * 1e4).ceil() as u32).max(1) * 100
}

/// If a course has ramps, it is linear between its points. A step in it then becomes a ramp of this
/// duration, µs.
pub(crate) const EDGE_US: u32 = 10;

pub(crate) struct CourseBuilder {
    start: i32,
    /// Start µs, end µs and final value of each move, in order of time.
    moves: Vec<(u32, u32, i32)>,
}

impl CourseBuilder {
    pub(crate) const fn new() -> Self {
        Self { start: 0, moves: Vec::new() }
    }

    pub(crate) fn last(&self) -> i32 {
        self.moves.last().map_or(self.start, |(_, _, value)| *value)
    }

    /// A step at 0 µs sets the start value.
    pub(crate) fn step(&mut self, at_us: u32, value: i32) {
        if at_us == 0 {
            self.start = value;
        } else if value != self.last() {
            self.moves.push((at_us, at_us, value));
        }
    }

    /// Returns the end of the ramp, µs.
    pub(crate) fn ramp(&mut self, at_us: u32, duration_us: u32, value: i32) -> u32 {
        if value == self.last() {
            return at_us;
        }
        self.moves.push((at_us, at_us + duration_us, value));
        at_us + duration_us
    }

    /// The course with no value above `highest`.
    fn limited(mut self, highest: i32) -> Self {
        self.start = self.start.min(highest);
        let mut last = self.start;
        self.moves.retain_mut(|(_, _, value)| {
            *value = (*value).min(highest);
            std::mem::replace(&mut last, *value) != *value
        });
        self
    }

    pub(crate) fn finish(self) -> Course {
        let has_ramps = self.moves.iter().any(|(from, to, _)| from < to);
        let mut points = vec![(0, self.start)];
        let mut last = self.start;
        for (from, to, value) in self.moves {
            if has_ramps {
                points.extend([(from, last), (to.max(from + EDGE_US), value)]);
            } else {
                points.push((from, value));
            }
            last = value;
        }
        if has_ramps { Course::Linear(points) } else { Course::Hold(points) }
    }
}
