//! Generates scene i from the envelope, the seed and i alone. The number of a scene determines its
//! stratum, so that few scenes cover event kinds, periods, limits and histories.

use crate::explore::choices::{Choice, Choices, DrawLists, Drawn, Part, uniform, weighted};
use crate::explore::envelope::Envelope;
use crate::explore::limits::ExploredLaw;
use crate::explore::scene::{Course, LineFault, PlateChoice, Relation, Scene, SceneTrial, Settings, Tuning};
use crate::explore::timeline::{ENDURANCE_CHANGES, ENDURANCE_REST_MS, EventKind, GapKind, Timeline};
use platebench_wire::LawId;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use sha2::{Digest, Sha256};
use std::f64::consts::TAU;
use std::ops::RangeInclusive;

const PERIOD_STEP_US: i32 = 50;
const LIMIT_STEP_VPP: i32 = 10;
const NOISE_STEP_PM: i32 = 500;
const DEVIATION_STEP_PERMILLE: i32 = 5;
const DETUNING_STEP_HZ: f64 = 1.0;
const SINE_STEP_TENTHS: u32 = 20;
/// Largest share of the drive limit that a setpoint may need in steady state. The rest is a reserve
/// for control.
pub(crate) const MAX_STEADY_DRIVE: f64 = 0.8;
/// Like [`MAX_STEADY_DRIVE`], for overloaded trials. Their drive may stay at the limit.
const MAX_OVERLOAD: f64 = 2.0;
/// Fewest control periods after the last event of a judged and of an earlier trial.
const TAIL_PERIODS: [u32; 2] = [10, 1];
/// Smallest setpoint of an own law with a relation, nm. It may calculate in steps of a fixed size, and
/// identifies the plate worse from smaller amplitudes.
const OWN_RELATION_NM: i32 = 100;
/// Number of events of an earlier trial.
const EARLIER_EVENTS: [u32; 2] = [1, 2];

/// Properties of a scene that its number determines. All other properties are drawn.
#[derive(Debug, Clone, PartialEq, Default)]
#[allow(clippy::struct_excessive_bools, reason = "independent choices")]
pub(crate) struct Stratum {
    /// Choice of the control period. 0: usual; 1: shortest; 2: longest; larger numbers: drawn.
    period: u64,
    /// Choice of the drive limit. 0: that of the plate; 1: smallest; 2: largest; larger numbers: drawn.
    limit: u64,
    /// Kinds of the first events, and the time before each if it is not drawn.
    pub(crate) kinds: Vec<EventKind>,
    pub(crate) gaps: Vec<(GapKind, i32)>,
    has_history: bool,
    has_noise: bool,
    /// Settings that the configuration may have.
    settings: Settings,
    has_fault: bool,
    /// True if setpoints of the judged trial may exceed the reach of the drive limit.
    is_overloaded: bool,
    /// True if setpoints of the earlier trials may exceed the reach of the drive limit.
    is_overloaded_before: bool,
    pub(crate) is_long: bool,
    /// 0: none; 1: sine of the force; 2: sine of the temperature.
    sine: i32,
    /// True if time stamps of later plays pass 2^16 ms, 2^31 µs and 2^32 µs (counter overflows).
    shifts_time: bool,
    /// 0: none; otherwise the number of the relation.
    relation: i32,
    /// 0: none; otherwise the number of the scripts of messages before the trial. They are rare, because
    /// they take as long as a hundred scenes.
    scripts: i32,
}

const PAIRS: u64 = (EventKind::ALL.len() * EventKind::ALL.len()) as u64;
/// Has no common divisor with [`PAIRS`], so as many scenes contain all pairs of event kinds.
const PAIR_STRIDE: u64 = 37;
const LONG_EVERY: u64 = 41;
const LONG_AT: u64 = 11;
const SINE_EVERY: u64 = 17;
const SCRIPTS_EVERY: u64 = 512;
/// One scene in this many, in the first round at this place, takes more than a minute.
const ENDURANCE_EVERY: u64 = 512;
const ENDURANCE_AT: u64 = 59;
/// Scenes with a history or other time stamps have other remainders.
const RELATION_EVERY: u64 = 3;

impl Stratum {
    /// Without `has_endurance` no trial is long.
    fn of(index: u64, has_endurance: bool) -> Self {
        if has_endurance && index % ENDURANCE_EVERY == ENDURANCE_AT {
            let later = ENDURANCE_CHANGES.map(|(kind, sample)| (kind, (GapKind::Sample, sample)));
            let rest = (EventKind::Rest, (GapKind::Long, ENDURANCE_REST_MS));
            let (kinds, gaps) = [rest].into_iter().chain(later).unzip();
            return Self { kinds, gaps, ..Self::default() };
        }
        let pair = index.wrapping_mul(PAIR_STRIDE) % PAIRS;
        let kinds = EventKind::ALL.len() as u64;
        let is_overloaded = index % 11 == 6;
        let kind = |number: u64| EventKind::ALL.get(number as usize).copied();
        Self {
            period: index % 5,
            // Few setpoints need the largest limits.
            limit: if is_overloaded { 1 } else { index % 4 },
            // A step shows how a law leaves its drive limit.
            kinds: [kind(if is_overloaded { 0 } else { pair / kinds }), kind(pair % kinds)]
                .into_iter()
                .flatten()
                .collect(),
            gaps: Vec::new(),
            has_history: index % 3 == 1,
            has_noise: index % 7 == 5,
            settings: match index % 10 {
                3 => Settings::All,
                0 | 8 => Settings::FrequencyLimits,
                _ => Settings::None,
            },
            has_fault: index % 9 == 7,
            is_overloaded,
            is_overloaded_before: index % 5 == 2,
            is_long: index % LONG_EVERY == LONG_AT,
            sine: match index % (2 * SINE_EVERY) {
                4 => 1,
                21 => 2,
                _ => 0,
            },
            shifts_time: index % 6 == 2 && index % LONG_EVERY != LONG_AT,
            relation: if index.is_multiple_of(RELATION_EVERY) { 1 + (index / RELATION_EVERY % 3) as i32 } else { 0 },
            scripts: if index.is_multiple_of(SCRIPTS_EVERY) { 1 + (index / SCRIPTS_EVERY) as i32 } else { 0 },
        }
    }

    /// The stratum of the trials before the judged one.
    fn of_earlier_trials(&self) -> Self {
        let Self { has_noise, is_overloaded_before, .. } = *self;
        let is_overloaded = is_overloaded_before;
        let settings = Settings::All;
        Self { period: u64::MAX, limit: u64::MAX, settings, has_noise, is_overloaded, ..Self::default() }
    }
}

#[derive(Debug, Clone)]
pub struct Generator<'a> {
    pub envelope: &'a Envelope,
    pub seed: u64,
    pub law: ExploredLaw,
    pub laws: &'a [LawId],
    pub has_endurance: bool,
}

impl Generator<'_> {
    /// The drawn scene of this number, before anything is derived.
    pub fn scene(&self, index: u64) -> Drawn<Scene> {
        let mut hash = Sha256::new_with_prefix(self.envelope.digest);
        hash.update(self.seed.to_le_bytes());
        hash.update(index.to_le_bytes());
        self.draw(Choices::new(ChaCha8Rng::from_seed(hash.finalize().into()), index))
    }

    /// The scene of recorded choices.
    pub fn replay(&self, choices: &[Choice]) -> Drawn<Scene> {
        self.draw(Choices::replay(choices))
    }

    fn draw(&self, mut choices: Choices) -> Drawn<Scene> {
        let stratum = Stratum::of(choices.index(), self.has_endurance);
        let scripts = choices.given(Some(stratum.scripts), 0..=i32::MAX);
        let relation = choices.given(Some(stratum.relation), 0..=3);
        let relation = (relation as usize).checked_sub(1).and_then(|number| Relation::ALL.get(number)).copied();
        let shifts_time = choices.given(Some(stratum.shifts_time.into()), 0..=1) == 1;
        choices.begin(Part::Trial);
        let mut judged = self.trial(&mut choices, &stratum, None);
        choices.end();
        let mut earlier = Vec::new();
        let before = stratum.of_earlier_trials();
        choices.list(Part::Trial, counts(stratum.has_history, self.envelope.count.earlier_trials), |choices, _| {
            earlier.push(self.trial(choices, &before, Some(&judged)));
        });
        choices.list(Part::Fault, counts(stratum.has_fault, [1, 2]), |choices, _| {
            let fault = LineFault::draw(choices, judged.duration_us, judged.period_us);
            let is_apart =
                |fault: &LineFault| judged.faults.iter().all(|other| other.combines_with(fault, judged.period_us));
            judged.faults.extend(fault.filter(is_apart));
        });
        let relation = relation.filter(|relation| self.can_relate(*relation, &judged));
        match relation {
            Some(Relation::Delayed) => self.simplify_for_delay(&mut judged),
            Some(Relation::Proportional) if self.law.is_own() => self.simplify_for_proportion(&mut judged),
            _ => {}
        }
        let count = match (earlier.is_empty() && relation.is_none(), shifts_time && judged.plate.noise_pm == 0) {
            (false, _) => 2,
            (true, true) => 4,
            (true, false) => 1,
        };
        // A seed in a scenario file is less than 2^63.
        let seed = |number: u64| self.seed.wrapping_add((number - 1).wrapping_mul(SCRIPTS_EVERY)) & (u64::MAX >> 1);
        let script_seed = (scripts > 0).then(|| seed(u64::from(scripts.unsigned_abs())));
        choices.finish(Scene { earlier, judged, count, script_seed, relation })
    }

    fn can_relate(&self, relation: Relation, trial: &SceneTrial) -> bool {
        let is_equal = trial.plate.noise_pm == 0 && trial.faults.is_empty();
        let has_delay = self.envelope.range.loop_delay_periods[1] > 0.0;
        let reach = trial.largest_setpoint_nm(&self.envelope.plate, MAX_STEADY_DRIVE);
        // A law that steers chooses its phase by the measured W, not by the predicted one.
        let compensates =
            trial.law.properties().is_some_and(|properties| properties.compensates_delay && !properties.steers);
        let levels = trial.setpoint.points().iter().map(|(_, level)| *level);
        let is_resolved = levels.filter(|level| *level > 0).all(|level| level >= OWN_RELATION_NM);
        is_equal
            && (is_resolved || !trial.law.is_own())
            && match relation {
                // An own law may saturate in its own way.
                Relation::Proportional => !trial.law.is_own() || trial.setpoint.range()[1] <= reach.into(),
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
        (trial.force, trial.temperature) = (Course::zero(), Course::zero());
    }

    /// An own law may compare the amplitude or the phase with a fixed number, so the proportion holds
    /// at its resonance.
    fn simplify_for_proportion(&self, trial: &mut SceneTrial) {
        trial.temperature = Course::zero();
        trial.start_frequency_tenths = (trial.mode_at(&self.envelope.plate, 0).omega0 / TAU * 10.0).round() as u32;
    }

    /// Draws a configuration, as a trial without inputs. Only an earlier trial may have another law.
    fn configuration(&self, choices: &mut Choices, stratum: &Stratum, is_judged: bool) -> SceneTrial {
        let range = &self.envelope.range;
        let own = self.laws.iter().position(|law| Some(*law) == self.law.number()).unwrap_or(0) as u32;
        let last_law = self.laws.len().saturating_sub(1) as u32;
        let law = choices.given(is_judged.then_some(own.cast_signed()), 0..=last_law.cast_signed());
        let law = self.laws.get(law as usize).filter(|_| !is_judged).map_or(self.law, |law| (*law).into());
        let usual_us = (1e3_f64.min(range.period_ms[1] * 1e3).max(range.period_ms[0] * 1e3)).round();
        let period_grid = grid(range.period_ms.map(|ms| ms * 1e3), usual_us, PERIOD_STEP_US.into());
        let period = [0, *period_grid.start(), *period_grid.end()].get(stratum.period as usize).copied();
        let period = choices.given(period, period_grid);
        let period_us = (usual_us as u32).saturating_add_signed(period * PERIOD_STEP_US);
        let [delay_low, delay_high] = range.loop_delay_periods.map(|periods| (periods * 20.0) as i32);
        let delay = choices.mostly(delay_low, [6, 4], delay_low..=delay_high).unsigned_abs();
        let has_delay = law.properties().is_some_and(|properties| properties.compensates_delay);
        let usual_limit = self.envelope.usual_limit_vpp();
        let limits = grid(range.drive_limit_vpp, usual_limit, LIMIT_STEP_VPP.into());
        let limit = [0, *limits.start(), *limits.end()].get(stratum.limit as usize).copied();
        let [lowest, highest] = range.drive_limit_vpp;
        let limit = choices.number(limits, |random| {
            let mut drawn = || lowest * (highest / lowest).powf(f64::from(uniform(random, &(0..=100))) / 100.0);
            limit.unwrap_or_else(|| ((drawn() - usual_limit) / f64::from(LIMIT_STEP_VPP)).round() as i32)
        });
        let most_noise = (range.noise_um_rms[1] * 1e6 / f64::from(NOISE_STEP_PM) + ROUNDING) as i32;
        let noise = choices.given((!stratum.has_noise).then_some(0), 0..=most_noise);
        let mut deviation = |range: [f64; 2]| {
            let grid = grid(range.map(|percent| percent * 10.0), 0.0, DEVIATION_STEP_PERMILLE.into());
            choices.mostly(0, [6, 4], grid) * DEVIATION_STEP_PERMILLE
        };
        let plate = PlateChoice {
            limit_vpp: (usual_limit as u32).saturating_add_signed(limit * LIMIT_STEP_VPP),
            noise_pm: (noise * NOISE_STEP_PM).unsigned_abs(),
            nominal_gain_permille: deviation(range.plate_gain_percent),
            nominal_time_constant_permille: deviation(range.plate_time_constant_percent),
            gain_permille: deviation(range.gain_deviation_percent),
            time_constant_permille: deviation(range.time_constant_deviation_percent),
        };
        SceneTrial {
            law,
            plate,
            period_us,
            delay_us: if has_delay { (period_us * delay / 20).min(period_us) } else { 0 },
            start_frequency_tenths: 0,
            duration_us: 0,
            setpoint: Course::zero(),
            force: Course::zero(),
            temperature: Course::zero(),
            tuning: Tuning::draw(choices, range, stratum.settings),
            faults: Vec::new(),
        }
    }

    /// Draws the judged trial, or an earlier one, which has its own configuration or that of `judged`.
    fn trial(&self, choices: &mut Choices, stratum: &Stratum, judged: Option<&SceneTrial>) -> SceneTrial {
        let has_own = choices.given(judged.is_none().then_some(1), 0..=1) == 1;
        let mut trial = if let Some(judged) = judged.filter(|_| !has_own) {
            SceneTrial { faults: Vec::new(), ..judged.clone() }
        } else {
            choices.begin(Part::Configuration);
            let configuration = self.configuration(choices, stratum, judged.is_none());
            choices.end();
            configuration
        };
        let is_overloaded = choices.given(Some(stratum.is_overloaded.into()), 0..=1) == 1;
        let sine = choices.given(Some(stratum.sine), 0..=2);
        let sine_tenths = 10 + choices.integer(0..=40).unsigned_abs() * SINE_STEP_TENTHS;
        let detunings = grid(self.envelope.range.start_frequency_offset_hz, 0.0, DETUNING_STEP_HZ);
        let ends = [*detunings.start(), *detunings.end()];
        // The frequency moves in scenes with limits of the frequency.
        let parts = if stratum.settings == Settings::FrequencyLimits { [1, 4, 3, 3] } else { [4, 6, 1, 1] };
        let detuning = choices.number(detunings.clone(), |random| match weighted(random, &parts) {
            0 => 0,
            1 => uniform(random, &detunings),
            end => ends[usize::from(end == 3)],
        });
        let least_tail = TAIL_PERIODS[usize::from(judged.is_some())];
        let events = match judged {
            Some(_) => EARLIER_EVENTS,
            None if stratum.gaps.is_empty() => self.envelope.count.events,
            None => [0, 0],
        };
        let mut timeline = Timeline::draw(self.envelope, choices, &trial, stratum, events);
        trial.duration_us = timeline.now_us.max(1) + timeline.tail_us().max(least_tail * trial.period_us);
        [trial.force, trial.temperature] = timeline.force_and_temperature();
        let range = &self.envelope.range;
        match sine {
            1 => add_sine(&mut trial.force, range.force_rate_n_per_s[1], sine_tenths),
            2 => add_sine(&mut trial.temperature, range.temperature_rate_k_per_s[1], sine_tenths),
            _ => {}
        }
        let share = if is_overloaded { MAX_OVERLOAD } else { MAX_STEADY_DRIVE };
        trial.setpoint = timeline.setpoint(trial.largest_setpoint_nm(&self.envelope.plate, share));
        let resonance_hz = trial.mode_at(&self.envelope.plate, 0).omega0 / TAU;
        let start_hz = resonance_hz + f64::from(detuning) * DETUNING_STEP_HZ;
        trial.start_frequency_tenths = (start_hz * 10.0).round() as u32;
        trial
    }
}

fn counts(has_parts: bool, [fewest, most]: [u32; 2]) -> RangeInclusive<u32> {
    if has_parts { fewest..=most } else { 0..=0 }
}

/// Keeps the end of a range if rounding lowers a quotient.
const ROUNDING: f64 = 1e-9;

/// Offsets, in grid steps, from `usual` that stay in the range. `usual` is limited to the range.
fn grid([low, high]: [f64; 2], usual: f64, step: f64) -> RangeInclusive<i32> {
    let usual = usual.clamp(low, high);
    let steps = |distance: f64| (distance / step + ROUNDING).floor() as i32;
    -steps(usual - low)..=steps(high - usual)
}

/// Replaces a course by a sine in its range; with the amplitude 0.25 if it is constant.
fn add_sine(course: &mut Course, full_rate: f64, frequency_tenths: u32) {
    let [low, high] = course.range().map(|value| value / 100.0);
    let amplitude = if high > low { ((high - low) * 50.0).round() / 100.0 } else { 0.25 };
    let mean = f64::midpoint(low, high).max(amplitude);
    // The slope of the sine does not exceed the largest rate. If even 0.1 Hz is too fast, the course
    // stays without a sine.
    let highest_tenths = (full_rate / (TAU * amplitude) * 10.0) as u32;
    if highest_tenths == 0 {
        return;
    }
    let [mean, amplitude] = [mean, amplitude].map(|value| (value * 100.0).round() as i32);
    *course = Course::Sine { mean, amplitude, frequency_tenths: frequency_tenths.min(highest_tenths) };
}
