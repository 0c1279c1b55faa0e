//! Draws scenes as whole numbers. Each number is an offset from a usual value, so shrinking the
//! numbers to 0 gives simple scenes. The number of a scene determines its stratum, so that few scenes
//! cover event kinds, periods, limits and histories.

use crate::explore::envelope::Envelope;
use crate::explore::scene::Tuning;
use crate::explore::scene::{LineFaultDraw, Relation};
use proptest::collection::vec;
use proptest::prelude::{BoxedStrategy, Just, Strategy, any};
use proptest::{bool as flags, prop_oneof};
use std::ops::RangeInclusive;

/// A value relative to the usual value or to earlier values of its quantity.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Target {
    /// Offset from the usual value, in grid steps.
    At(i32),
    /// Offset from the last value, in small steps.
    Near(i32),
    /// The value that is this many values before the last one.
    Earlier(usize),
    Least,
    Most,
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Gap {
    /// The shortest quiet time of the envelope plus this many times 0.1 ms.
    Quiet(u32),
    /// This many times 0.1 ms.
    Short(u32),
    /// The shortest long quiet time of the envelope plus this many ms.
    Long(u32),
    /// Until 100 ms or 1 s after the start (a counter overflows), plus this many control periods.
    AtCounterEnd(i32),
    /// Until this many control periods after the start.
    UntilSample(u32),
}

#[derive(Debug, Clone)]
pub(crate) struct EventDraw {
    pub(crate) kind: EventKind,
    pub(crate) gap: Gap,
    /// True if the event is at a control instant.
    pub(crate) is_aligned: bool,
    pub(crate) level: Target,
    pub(crate) force: Target,
    pub(crate) temperature: Target,
    /// Position in the logarithmic range of rates, percent: 0 is the fastest.
    pub(crate) slowness: u32,
    pub(crate) steps: u32,
}

#[derive(Debug, Clone)]
pub(crate) struct ConfigurationDraw {
    pub(crate) law: usize,
    /// Offset from the usual period, in grid steps.
    pub(crate) period: i32,
    pub(crate) delay: u32,
    /// Distance below the largest drive limit, in grid steps.
    pub(crate) limit: u32,
    pub(crate) noise: u32,
    pub(crate) nominal_gain: i32,
    pub(crate) nominal_time_constant: i32,
    pub(crate) gain: i32,
    pub(crate) time_constant: i32,
    pub(crate) tuning: Tuning,
}

#[derive(Debug, Clone)]
pub(crate) struct TrialDraw {
    pub(crate) detuning: i32,
    pub(crate) level: Target,
    pub(crate) force: Target,
    pub(crate) temperature: Target,
    pub(crate) events: Vec<EventDraw>,
    pub(crate) tail: Gap,
    /// Frequency of the sine above 1 Hz, in steps of 2 Hz.
    pub(crate) sine: u32,
}

#[derive(Debug, Clone)]
pub(crate) struct SceneDraw {
    /// Earlier trials. Without its own configuration, a trial uses that of the judged trial.
    pub(crate) earlier: Vec<(Option<ConfigurationDraw>, TrialDraw)>,
    pub(crate) configuration: ConfigurationDraw,
    pub(crate) judged: TrialDraw,
    pub(crate) faults: Vec<LineFaultDraw>,
}

pub(crate) const LEVEL_STEP_UM: f64 = 0.005;
pub(crate) const FORCE_STEP_N: f64 = 0.05;
pub(crate) const TEMPERATURE_STEP_K: f64 = 0.25;
pub(crate) const PERIOD_STEP_MS: f64 = 0.05;
pub(crate) const LIMIT_STEP_VPP: f64 = 10.0;
pub(crate) const NOISE_STEP_UM: f64 = 0.0005;
pub(crate) const DEVIATION_STEP_PERCENT: f64 = 0.5;
pub(crate) const DETUNING_STEP_HZ: f64 = 1.0;
pub(crate) const USUAL_LEVEL_UM: f64 = 1.0;
pub(crate) const USUAL_PERIOD_MS: f64 = 1.0;
pub(crate) const MAX_LAWS: usize = 8;

/// Offsets, in grid steps, from `usual` that stay in the range. `usual` is limited to the range.
pub(crate) fn grid([low, high]: [f64; 2], usual: f64, step: f64) -> RangeInclusive<i32> {
    let usual = usual.clamp(low, high);
    // The addition of 1e-9 keeps the end of the range if rounding lowers the quotient.
    let steps = |distance: f64| (distance / step + 1e-9).floor() as i32;
    -steps(usual - low)..=steps(high - usual)
}

/// Draws 0 with the weight `usual`, any grid point with 6, and each end with 1.
fn spread(grid: RangeInclusive<i32>, usual: u32) -> BoxedStrategy<i32> {
    let (low, high) = (*grid.start(), *grid.end());
    prop_oneof![usual => Just(0), 6 => grid, 1 => Just(low), 1 => Just(high)].boxed()
}

fn target(grid: RangeInclusive<i32>) -> BoxedStrategy<Target> {
    prop_oneof![
        6 => grid.prop_map(Target::At),
        2 => (-4..=4).prop_map(Target::Near),
        1 => (1_usize..=3).prop_map(Target::Earlier),
        1 => Just(Target::Least),
        1 => Just(Target::Most),
    ]
    .boxed()
}

fn gap(envelope: &Envelope, is_long: bool) -> BoxedStrategy<Gap> {
    let [low, high] = envelope.range.quiet_ms;
    let [long_low, long_high] = envelope.range.long_quiet_ms;
    let quiet = (0..=((high - low) * 10.0) as u32).prop_map(Gap::Quiet);
    let long = (0..=(long_high - long_low) as u32).prop_map(Gap::Long);
    let weight = u32::from(is_long);
    prop_oneof![
        16 => quiet,
        5 => (1_u32..=50).prop_map(Gap::Short),
        1 + weight => (-2..=2).prop_map(Gap::AtCounterEnd),
        1 + 9 * weight => long,
    ]
    .boxed()
}

fn kind() -> BoxedStrategy<EventKind> {
    (0..EventKind::ALL.len()).prop_map(|index| EventKind::ALL.get(index).copied().unwrap_or(EventKind::Step)).boxed()
}

fn event(envelope: &Envelope, kind: BoxedStrategy<EventKind>, gap: BoxedStrategy<Gap>) -> BoxedStrategy<EventDraw> {
    let range = &envelope.range;
    let fields = (
        kind,
        gap,
        any::<bool>(),
        target(grid(range.setpoint_um, USUAL_LEVEL_UM, LEVEL_STEP_UM)),
        target(grid(range.finger_force_n, 0.0, FORCE_STEP_N)),
        target(grid(range.temperature_offset_k, 0.0, TEMPERATURE_STEP_K)),
        0..=100_u32,
        prop_oneof![7 => 2..=8_u32, 1 => 20..=40_u32],
    );
    fields
        .prop_map(|(kind, gap, is_aligned, level, force, temperature, slowness, steps)| EventDraw {
            kind,
            gap,
            is_aligned,
            level,
            force,
            temperature,
            slowness,
            steps,
        })
        .boxed()
}

fn configuration(envelope: &Envelope, stratum: &Stratum, has_law: bool) -> BoxedStrategy<ConfigurationDraw> {
    let range = &envelope.range;
    let period_grid = grid(range.period_ms, USUAL_PERIOD_MS, PERIOD_STEP_MS);
    let period = match stratum.period {
        0 => Just(0).boxed(),
        1 => Just(*period_grid.start()).boxed(),
        2 => Just(*period_grid.end()).boxed(),
        _ => period_grid.boxed(),
    };
    let limit_grid = 0..=((range.drive_limit_vpp[1] - range.drive_limit_vpp[0]) / LIMIT_STEP_VPP) as u32;
    let limit = match stratum.limit {
        0 => Just(0).boxed(),
        1 => Just(*limit_grid.end()).boxed(),
        _ => limit_grid.boxed(),
    };
    let [delay_low, delay_high] = range.loop_delay_periods.map(|periods| (periods * 20.0) as u32);
    let noise_high = (range.noise_um_rms[1] / NOISE_STEP_UM) as u32;
    let deviation = |range: [f64; 2]| {
        let grid = grid(range, 0.0, DEVIATION_STEP_PERCENT);
        prop_oneof![6 => Just(0), 4 => grid].boxed()
    };
    let fields = (
        if has_law { (0..MAX_LAWS).boxed() } else { Just(0).boxed() },
        period,
        prop_oneof![6 => Just(delay_low), 4 => delay_low..=delay_high],
        limit,
        if stratum.has_noise { (0..=noise_high).boxed() } else { Just(0).boxed() },
        deviation(range.plate_gain_percent),
        deviation(range.plate_time_constant_percent),
        deviation(range.gain_deviation_percent),
        deviation(range.time_constant_deviation_percent),
        Tuning::strategy(range, stratum.is_tuned),
    );
    fields
        .prop_map(|fields| {
            let (law, period, delay, limit, noise, nominal_gain, nominal_time_constant, gain, time_constant, tuning) =
                fields;
            ConfigurationDraw {
                law,
                period,
                delay,
                limit,
                noise,
                nominal_gain,
                nominal_time_constant,
                gain,
                time_constant,
                tuning,
            }
        })
        .boxed()
}

/// `fixed` are the kinds of the first events and the time before each.
fn trial(
    envelope: &Envelope,
    fixed: Vec<(EventKind, BoxedStrategy<Gap>)>,
    events: [u32; 2],
) -> BoxedStrategy<TrialDraw> {
    let range = &envelope.range;
    let [fewest, most] = events.map(|count| count as usize);
    let fixed: Vec<_> = fixed.into_iter().map(|(kind, gap)| event(envelope, Just(kind).boxed(), gap)).collect();
    let further = fewest.saturating_sub(fixed.len())..=most.saturating_sub(fixed.len());
    // The stratum requires each of these events, but shrinking may remove it.
    let fixed: Vec<_> = fixed.into_iter().map(|event| (flags::weighted(1.0), event)).collect();
    let fields = (
        spread(grid(range.start_frequency_offset_hz, 0.0, DETUNING_STEP_HZ), 4),
        target(grid(range.setpoint_um, USUAL_LEVEL_UM, LEVEL_STEP_UM)),
        prop_oneof![4 => Just(Target::At(0)), 3 => target(grid(range.finger_force_n, 0.0, FORCE_STEP_N))],
        prop_oneof![4 => Just(Target::At(0)), 3 => target(grid(range.temperature_offset_k, 0.0, TEMPERATURE_STEP_K))],
        fixed,
        vec(event(envelope, kind(), gap(envelope, false)), further),
        gap(envelope, false),
        0..=40_u32,
    );
    fields
        .prop_map(|(detuning, level, force, temperature, fixed, further, tail, sine)| {
            let kept = fixed.into_iter().filter(|(is_kept, _)| *is_kept).map(|(_, event)| event);
            let events = kept.chain(further).collect();
            TrialDraw { detuning, level, force, temperature, events, tail, sine }
        })
        .boxed()
}

pub(crate) fn scene(envelope: &Envelope, stratum: &Stratum) -> BoxedStrategy<SceneDraw> {
    let earlier = if stratum.has_history {
        let own = (configuration(envelope, &Stratum::any_configuration(stratum), true), flags::ANY);
        let own = own.prop_map(|(configuration, is_own)| is_own.then_some(configuration));
        let [fewest, most] = envelope.count.earlier_trials.map(|count| count as usize);
        vec((own, trial(envelope, Vec::new(), [1, 2])), fewest..=most).boxed()
    } else {
        Just(Vec::new()).boxed()
    };
    let judged = if stratum.is_endurance {
        let fixed = [(EventKind::Rest, Gap::Long(ENDURANCE_REST_MS)), (EventKind::Step, Gap::UntilSample(ENDURANCE))];
        trial(envelope, fixed.map(|(kind, gap)| (kind, Just(gap).boxed())).to_vec(), [2, 3])
    } else {
        let fixed = stratum.kinds.iter().map(|kind| (*kind, gap(envelope, stratum.is_long)));
        trial(envelope, fixed.collect(), envelope.count.events)
    };
    let faults =
        if stratum.has_fault { vec(LineFaultDraw::strategy(), 1..=2).boxed() } else { Just(Vec::new()).boxed() };
    (earlier, configuration(envelope, stratum, false), judged, faults)
        .prop_map(|(earlier, configuration, judged, faults)| SceneDraw { earlier, configuration, judged, faults })
        .boxed()
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum EventKind {
    Step,
    /// The setpoint changes in several steps.
    Staircase,
    /// The setpoint is 0 for some time.
    Rest,
    /// The setpoint changes at a constant rate.
    Ramp,
    Touch,
    Press,
    Shock,
    Heat,
    /// Force and temperature ramp together.
    Both,
}

impl EventKind {
    pub(crate) const ALL: [Self; 9] = [
        Self::Step,
        Self::Staircase,
        Self::Rest,
        Self::Touch,
        Self::Press,
        Self::Shock,
        Self::Heat,
        Self::Both,
        Self::Ramp,
    ];
}

/// Properties of a scene that its number determines. All other properties are drawn.
#[derive(Debug, Clone, PartialEq, Default)]
#[allow(clippy::struct_excessive_bools, reason = "independent choices")]
pub(crate) struct Stratum {
    /// Choice of the control period. 0: usual; 1: shortest; 2: longest; larger numbers: drawn.
    pub(crate) period: u64,
    /// Choice of the drive limit. 0: largest; 1: smallest; larger numbers: drawn.
    pub(crate) limit: u64,
    /// Kinds of the first two events.
    pub(crate) kinds: Vec<EventKind>,
    pub(crate) has_history: bool,
    pub(crate) has_noise: bool,
    /// True if the configuration has its own response time, gains, frequency range or slew limit.
    pub(crate) is_tuned: bool,
    pub(crate) has_fault: bool,
    /// True if setpoints of the judged trial may exceed the reach of the drive limit.
    pub(crate) is_overloaded: bool,
    /// True if setpoints of the earlier trials may exceed the reach of the drive limit.
    pub(crate) is_overloaded_before: bool,
    pub(crate) is_long: bool,
    /// True if the trial has a rest of seconds and takes more than a minute.
    pub(crate) is_endurance: bool,
    pub(crate) sine: Option<SineOf>,
    /// True if time stamps of later plays pass 2^16 ms, 2^31 µs and 2^32 µs (counter overflows).
    pub(crate) shifts_time: bool,
    pub(crate) relation: Option<Relation>,
    /// Number of the scene, if scripts of messages precede the trial. This is rare, because the
    /// scripts take as long as a hundred scenes.
    pub(crate) scripts: Option<u64>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum SineOf {
    Force,
    Temperature,
}

const PAIRS: u64 = (EventKind::ALL.len() * EventKind::ALL.len()) as u64;
/// Has no common divisor with [`PAIRS`], so as many scenes contain all pairs of event kinds.
const PAIR_STRIDE: u64 = 37;
const LONG_EVERY: u64 = 41;
const SINE_EVERY: u64 = 17;
const SCRIPTS_EVERY: u64 = 512;
/// One scene in this many, in the first round at this place, is a long trial.
const ENDURANCE_EVERY: u64 = 512;
const ENDURANCE_AT: u64 = 59;
/// Control periods until the step of a long trial: more than 2^16, and at the usual period more than
/// 2^16 ms and 2^26 µs.
const ENDURANCE: u32 = 68_000;
const ENDURANCE_REST_MS: u32 = 4_000;
/// Scenes with a history or other time stamps have other remainders.
const RELATION_EVERY: u64 = 3;

fn in_turn(number: u64) -> Relation {
    let relations = Relation::ALL;
    relations.get(number as usize % relations.len()).copied().unwrap_or(Relation::Proportional)
}

impl Stratum {
    /// Without `has_endurance` no trial is long.
    pub(crate) fn of(index: u64, has_endurance: bool) -> Self {
        if has_endurance && index % ENDURANCE_EVERY == ENDURANCE_AT {
            return Self { is_endurance: true, ..Self::default() };
        }
        let pair = index.wrapping_mul(PAIR_STRIDE) % PAIRS;
        let kinds = EventKind::ALL.len() as u64;
        let kind = |number: u64| EventKind::ALL.get(number as usize).copied();
        Self {
            period: index % 5,
            limit: index % 4,
            kinds: [kind(pair / kinds), kind(pair % kinds)].into_iter().flatten().collect(),
            has_history: index % 3 == 1,
            has_noise: index % 7 == 5,
            is_tuned: index % 5 == 3,
            has_fault: index % 9 == 7,
            is_overloaded: index % 13 == 6,
            is_overloaded_before: index % 5 == 2,
            is_long: index % LONG_EVERY == 11,
            is_endurance: false,
            sine: match index % (2 * SINE_EVERY) {
                4 => Some(SineOf::Force),
                21 => Some(SineOf::Temperature),
                _ => None,
            },
            shifts_time: index % 6 == 2,
            relation: index.is_multiple_of(RELATION_EVERY).then(|| in_turn(index / RELATION_EVERY)),
            scripts: index.is_multiple_of(SCRIPTS_EVERY).then_some(index),
        }
    }

    /// Stratum of the configuration of an earlier trial.
    pub(crate) fn any_configuration(&self) -> Self {
        Self { period: u64::MAX, limit: u64::MAX, is_tuned: true, ..self.clone() }
    }
}
