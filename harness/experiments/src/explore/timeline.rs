//! Draws the events of a trial, one after the other, and builds the courses of its inputs.

use crate::explore::choices::{Choices, DrawLists, Part, uniform, weighted};
use crate::explore::envelope::Envelope;
use crate::explore::generator::Stratum;
use crate::explore::scene::{Course, SceneTrial};
use std::ops::RangeInclusive;

/// The simplest kind is the first one.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum EventKind {
    Step,
    Touch,
    Shock,
    /// The setpoint is 0 for some time.
    Rest,
    /// The setpoint changes at a constant rate.
    Ramp,
    Press,
    Heat,
    /// The setpoint changes in several steps.
    Staircase,
    /// Force and temperature ramp together.
    Both,
}

impl EventKind {
    pub(crate) const ALL: [Self; 9] = [
        Self::Step,
        Self::Touch,
        Self::Shock,
        Self::Rest,
        Self::Ramp,
        Self::Press,
        Self::Heat,
        Self::Staircase,
        Self::Both,
    ];
}

/// Kinds of the time before an event, the simplest first.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum GapKind {
    /// The shortest quiet time of the envelope plus a number of times 0.1 ms.
    Quiet,
    /// A number of times 0.1 ms.
    Short,
    /// Until 100 ms or 1 s after the start (a counter overflows), plus a number of control periods.
    CounterEnd,
    /// The shortest long quiet time of the envelope plus a number of ms.
    Long,
    /// Until a number of control periods after the start. Only long trials have it.
    Sample,
}

impl GapKind {
    const ALL: [Self; 5] = [Self::Quiet, Self::Short, Self::CounterEnd, Self::Long, Self::Sample];
}

/// Rest of the long trials, ms.
pub(crate) const ENDURANCE_REST_MS: i32 = 4_000;
/// Changes of the long trials after the rest, and the control periods before them. A counter of 16
/// bits, also of the periods without the rest, has every sign and has wrapped.
pub(crate) const ENDURANCE_CHANGES: [(EventKind, i32); 7] = [
    (EventKind::Touch, 12_000),
    (EventKind::Shock, 20_000),
    (EventKind::Touch, 36_000),
    (EventKind::Shock, 44_000),
    (EventKind::Touch, 52_000),
    (EventKind::Shock, 60_000),
    (EventKind::Step, ENDURANCE),
];
const ENDURANCE: i32 = 73_000;
/// Control periods of some rests: more than 11 or 12 bits count.
const LONG_REST: RangeInclusive<i32> = 2_100..=4_200;
/// A rest is as long as the time before it, or in the second of these parts a long one.
const LONG_REST_PARTS: [u32; 2] = [6, 1];
/// Times at which a time counter in a controller may overflow, µs.
const COUNTERS_US: [u32; 2] = [100_000, 1_000_000];
/// Shortest time between two steps of a staircase, in tenths of a control period.
const STAIR_TENTHS: u32 = 7;
/// Longest duration of a ramp of force or temperature. A ramp that would take longer gets a higher
/// rate.
const MAX_RAMP_S: f64 = 0.1;
const MAX_SETPOINT_RAMP_S: f64 = 0.3;
/// Time at the slew limit that doubles the quiet times, s.
const SLEW_STRETCH_S: f64 = 0.03;
/// Weight of no force and no change of temperature against 11 of all other values, at the start of a
/// trial, and later, so that a finger often leaves.
const AT_START: u32 = 15;
const LATER: u32 = 5;

/// A setpoint, force or temperature of a trial.
struct Quantity {
    /// Range and usual value, in the unit of the course.
    range: [i32; 2],
    usual: i32,
    /// Distance of drawn values from each other, and a small step.
    step: i32,
    near: i32,
    /// Weight of the usual value after another one.
    usual_weight: u32,
    /// Weight of values with a uniform logarithm.
    logarithmic_weight: u32,
    values: Vec<i32>,
    course: CourseBuilder,
}

impl Quantity {
    fn new(range: [f64; 2], usual: f64, scale: f64, [step, near]: [i32; 2], weights: [u32; 2]) -> Self {
        let [low, high] = range.map(|value| (value * scale).round() as i32);
        let usual = ((usual * scale).round() as i32).min(high).max(low);
        let course = CourseBuilder::default();
        let [usual_weight, logarithmic_weight] = weights;
        Self { range: [low, high], usual, step, near, usual_weight, logarithmic_weight, values: Vec::new(), course }
    }

    /// Draws a value relative to the usual value or to earlier values. Its choice is the distance from
    /// the usual value.
    fn draw(&mut self, choices: &mut Choices) -> i32 {
        let Self { range: [low, high], usual, step, near, usual_weight, logarithmic_weight, .. } = *self;
        let values = &self.values;
        let last = values.last().copied().unwrap_or(usual);
        let usual_weight = match values.last() {
            None => AT_START * usual_weight.min(1),
            Some(_) => usual_weight * u32::from(last != usual),
        };
        let distance = choices.number(low - usual..=high - usual, |random| {
            let value = match weighted(random, &[usual_weight, 6, 2, 1, 1, 1, logarithmic_weight]) {
                0 => usual,
                1 => usual + step * uniform(random, &(-((usual - low) / step)..=(high - usual) / step)),
                2 => last + near * uniform(random, &(-4..=4)),
                3 => {
                    let at = values.len().checked_sub(uniform(random, &(2..=4)) as usize);
                    at.and_then(|at| values.get(at)).copied().unwrap_or(last)
                }
                4 => low,
                5 => high,
                _ => {
                    let share = f64::from(uniform(random, &(0..=100))) / 100.0;
                    (f64::from(low) * (f64::from(high) / f64::from(low)).powf(share)).round() as i32
                }
            };
            value - usual
        });
        self.values.push(usual + distance);
        usual + distance
    }

    fn step(&mut self, choices: &mut Choices, at_us: u32) -> u32 {
        let value = self.draw(choices);
        self.course.step(at_us, value);
        at_us
    }

    /// Ramps force or temperature. Returns the end of the ramp, µs.
    fn ramp(&mut self, choices: &mut Choices, rates: [f64; 2], at_us: u32) -> u32 {
        let to = self.draw(choices);
        let rate = rate(choices, rates) * 100.0;
        let seconds = f64::from((to - self.course.last()).abs()) / rate;
        self.course.ramp(at_us, ramp_us(seconds.min(MAX_RAMP_S)), to)
    }
}

pub(crate) struct Timeline<'a, 'c> {
    envelope: &'a Envelope,
    choices: &'c mut Choices,
    period_us: u32,
    /// Factor of quiet times. It is larger for long periods and for slow laws.
    stretch: f64,
    pub(crate) now_us: u32,
    /// The time without changes from now on.
    gap: (GapKind, u32),
    setpoint: Quantity,
    force: Quantity,
    temperature: Quantity,
}

impl DrawLists for Timeline<'_, '_> {
    fn choices(&mut self) -> &mut Choices {
        self.choices
    }
}

impl<'a, 'c> Timeline<'a, 'c> {
    /// Draws the values at the start, and the events. `trial` has the configuration. The stratum
    /// determines the first events.
    pub(crate) fn draw(
        envelope: &'a Envelope,
        choices: &'c mut Choices,
        trial: &SceneTrial,
        stratum: &Stratum,
        [fewest, most]: [u32; 2],
    ) -> Self {
        let range = &envelope.range;
        let mut setpoint = Quantity::new(range.setpoint_um, 1.0, 1e3, [5, 5], [0, 3]);
        let mut force = Quantity::new(range.finger_force_n, 0.0, 100.0, [5, 2], [LATER, 0]);
        let mut temperature = Quantity::new(range.temperature_offset_k, 0.0, 100.0, [25, 10], [LATER, 0]);
        for quantity in [&mut setpoint, &mut force, &mut temperature] {
            quantity.step(choices, 0);
        }
        let period_ms = f64::from(trial.period_us) / 1e3;
        let slew_s = trial.tuning.slew_time_s(range.start_frequency_offset_hz[1], trial.period_us);
        let stretch = period_ms.max(1.0) * trial.law.stretch() * (1.0 + slew_s / SLEW_STRETCH_S);
        let (period_us, gap) = (trial.period_us, (GapKind::Quiet, 0));
        let mut timeline = Self { envelope, choices, period_us, stretch, now_us: 0, gap, setpoint, force, temperature };
        timeline.gap = timeline.gap(stratum, 0);
        let given = stratum.kinds.len() as u32;
        timeline.list(Part::Event, fewest.max(given)..=most.max(given), |timeline, number| {
            timeline.add(stratum, number);
            // The time after an event belongs to it, so that shrinking can remove the next event.
            timeline.gap = timeline.gap(stratum, number + 1);
        });
        timeline
    }

    /// The time after the last event, µs.
    pub(crate) const fn tail_us(&self) -> u32 {
        self.gap.1
    }

    /// The courses of force and temperature, once.
    pub(crate) fn force_and_temperature(&mut self) -> [Course; 2] {
        [&mut self.force, &mut self.temperature].map(|quantity| std::mem::take(&mut quantity.course).finish())
    }

    /// The course of the setpoint, in proportion if a value is above `highest`.
    pub(crate) fn setpoint(self, highest: i32) -> Course {
        let lowest = self.setpoint.range[0];
        self.setpoint.course.limited(lowest, highest).finish()
    }

    /// Draws a time without changes, µs, before the event with this number.
    fn gap(&mut self, stratum: &Stratum, event: usize) -> (GapKind, u32) {
        let is_long = stratum.is_long && event < stratum.kinds.len();
        let given = stratum.gaps.get(event).copied();
        let Self { envelope, choices, period_us, now_us, stretch, .. } = self;
        let (period_us, now_us) = (*period_us, *now_us);
        let [low, high] = envelope.range.quiet_ms;
        let [long_low, long_high] = envelope.range.long_quiet_ms;
        let long = u32::from(is_long);
        let number = match given {
            Some((kind, _)) => choices.given(Some(kind as i32), 0..=4) as usize,
            None => choices.weighted(&[16, 5, 1 + long, 1 + 9 * long, 0]),
        };
        let kind = GapKind::ALL.get(number).copied().unwrap_or(GapKind::Quiet);
        let given = given.map(|(_, number)| number);
        let us = match kind {
            GapKind::Quiet => {
                let tenths = choices.given(given, 0..=((high - low) * 10.0) as i32);
                ((low * 1e3 + f64::from(tenths) * 100.0) * *stretch) as u32
            }
            GapKind::Short => choices.given(given, 1..=50).unsigned_abs() * 100,
            GapKind::CounterEnd => {
                let periods = choices.given(given, -2..=2);
                let next = COUNTERS_US.iter().find(|counter| **counter > now_us + 3 * period_us);
                let until = next.copied().unwrap_or(now_us + 10 * period_us);
                until.saturating_add_signed(periods * period_us.cast_signed()) - now_us
            }
            GapKind::Long => {
                let drawn = 0..=(long_high - long_low) as i32;
                let longest = ENDURANCE_REST_MS.max(*drawn.end());
                let ms = choices.number(0..=longest, |random| given.unwrap_or_else(|| uniform(random, &drawn)));
                ((long_low + f64::from(ms)) * 1e3) as u32
            }
            GapKind::Sample => (choices.given(given, 0..=ENDURANCE).unsigned_abs() * period_us).saturating_sub(now_us),
        };
        (kind, us)
    }

    fn add(&mut self, stratum: &Stratum, number: usize) {
        let given = stratum.kinds.get(number).map(|kind| *kind as i32);
        let kind = self.choices.given(given, 0..=8) as usize;
        let kind = EventKind::ALL.get(kind).copied().unwrap_or(EventKind::Step);
        let (gap_kind, gap_us) = self.gap;
        let is_aligned = self.choices.integer(0..=1) == 0;
        let mut at = self.now_us + gap_us.max(100);
        if is_aligned || gap_kind == GapKind::CounterEnd {
            at = at.div_ceil(self.period_us) * self.period_us;
        } else if at.is_multiple_of(self.period_us) {
            at += self.period_us / 3;
        }
        let range = &self.envelope.range;
        let [force_rates, temperature_rates] = [range.force_rate_n_per_s, range.temperature_rate_k_per_s];
        self.now_us = match kind {
            EventKind::Step => self.setpoint.step(self.choices, at),
            EventKind::Touch => self.force.step(self.choices, at),
            EventKind::Shock => self.temperature.step(self.choices, at),
            EventKind::Rest => self.rest(at, gap_us),
            EventKind::Ramp => self.ramp_setpoint(at),
            EventKind::Press => self.force.ramp(self.choices, force_rates, at),
            EventKind::Heat => self.temperature.ramp(self.choices, temperature_rates, at),
            EventKind::Staircase => self.add_staircase(at),
            EventKind::Both => {
                let end = self.force.ramp(self.choices, force_rates, at);
                end.max(self.temperature.ramp(self.choices, temperature_rates, at))
            }
        };
    }

    /// Force and temperature may change during a rest, which the law cannot measure.
    fn rest(&mut self, at: u32, gap_us: u32) -> u32 {
        self.setpoint.course.step(at, 0);
        let periods = self.choices.number(0..=*LONG_REST.end(), |random| match weighted(random, &LONG_REST_PARTS) {
            0 => 0,
            _ => uniform(random, &LONG_REST),
        });
        let rest_us = gap_us.max(self.period_us * periods.max(2).unsigned_abs());
        let changes_at = (at + rest_us / 2).next_multiple_of(100);
        if self.choices.one_in(2) {
            self.temperature.step(self.choices, changes_at);
        }
        if self.choices.one_in(3) {
            self.force.step(self.choices, changes_at);
        }
        self.setpoint.step(self.choices, (at + rest_us).next_multiple_of(100))
    }

    fn add_staircase(&mut self, at: u32) -> u32 {
        let from = self.setpoint.values.last().copied().unwrap_or(0);
        let to = self.setpoint.draw(self.choices);
        let step_us = self.period_us * (STAIR_TENTHS + self.choices.integer(0..=25).unsigned_abs()) / 10;
        let count = self.choices.number(2..=40, |random| match weighted(random, &[7, 1]) {
            0 => uniform(random, &(2..=8)),
            _ => uniform(random, &(20..=40)),
        });
        let mut end = at;
        for step in 1..=count {
            end = at + step_us * (step - 1).unsigned_abs();
            self.setpoint.course.step(end, from + (to - from) * step / count);
        }
        end
    }

    /// A slow ramp ends before its level is reached.
    fn ramp_setpoint(&mut self, at: u32) -> u32 {
        let from = self.setpoint.course.last();
        let level = self.setpoint.draw(self.choices);
        let rate = rate(self.choices, self.envelope.range.setpoint_rate_um_per_s) * 1e3;
        let reach = (rate * MAX_SETPOINT_RAMP_S) as i32;
        let to = level.clamp(from - reach, from + reach);
        if let Some(last) = self.setpoint.values.last_mut() {
            *last = to;
        }
        self.setpoint.course.ramp(at, ramp_us(f64::from((to - from).abs()) / rate), to)
    }
}

/// Draws a rate from the logarithm of its range. The fastest is the simplest.
fn rate(choices: &mut Choices, [slowest, fastest]: [f64; 2]) -> f64 {
    let slowness: RangeInclusive<i32> = 0..=100;
    fastest * (slowest / fastest).powf(f64::from(choices.integer(slowness)) / 100.0)
}

/// Duration of a ramp, µs, a multiple of 0.1 ms.
fn ramp_us(seconds: f64) -> u32 {
    ((seconds * 1e4).ceil() as u32).max(1) * 100
}

/// If a course has ramps, it is linear between its points. A step in it then becomes a ramp of this
/// duration, µs.
pub(crate) const EDGE_US: u32 = 10;

#[derive(Debug, Default)]
pub(crate) struct CourseBuilder {
    start: i32,
    /// Start µs, end µs and final value of each move, in order of time.
    moves: Vec<(u32, u32, i32)>,
}

impl CourseBuilder {
    fn last(&self) -> i32 {
        self.moves.last().map_or(self.start, |(_, _, value)| *value)
    }

    /// A step at 0 µs sets the start value.
    fn step(&mut self, at_us: u32, value: i32) {
        if at_us == 0 {
            self.start = value;
        } else if value != self.last() {
            self.moves.push((at_us, at_us, value));
        }
    }

    /// Returns the end of the ramp, µs.
    fn ramp(&mut self, at_us: u32, duration_us: u32, value: i32) -> u32 {
        if value == self.last() {
            return at_us;
        }
        self.moves.push((at_us, at_us + duration_us, value));
        at_us + duration_us
    }

    /// The course with values above `lowest` in proportion, so that none is above `highest`.
    fn limited(mut self, lowest: i32, highest: i32) -> Self {
        let largest = self.moves.iter().map(|(_, _, value)| *value).fold(self.start, i32::max);
        if largest <= highest {
            return self;
        }
        let share = f64::from(highest - lowest) / f64::from((largest - lowest).max(1));
        let scaled = |value: i32| {
            let above = f64::from((value - lowest).max(0)) * share;
            (value.min(lowest) + above as i32).min(highest)
        };
        self.start = scaled(self.start);
        let mut last = self.start;
        self.moves.retain_mut(|(_, _, value)| {
            *value = scaled(*value);
            std::mem::replace(&mut last, *value) != *value
        });
        self
    }

    fn finish(self) -> Course {
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
