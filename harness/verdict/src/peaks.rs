//! Finds the extremes of the motion between the rows of a trace. One interval contains all rows with
//! the same command and the same mode, because only the largest value between rows counts.
//!
//! Between two commands W is the sum of a slow part S and of the ripple F of the fast pole,
//! `S' = (s₊ − jω) S + g` and `F' = (s₋ − jω) F − g` with `g = (N/m) V/2ω_d`
//! (`docs/mathematics.md`, exact propagation). F follows from the drives of the rows alone, and S is
//! the W of a row minus F. So the closed form between two rows needs no state that a trace lacks.
//! A plate with optional effects or with the model `linear` has more states, and moving modes have no
//! such form: these plates are simulated again with the commands of the rows.

use crate::metrics::measure_with_extremes;
use crate::uncertainty::has_moving_modes;
use platebench_model::record::Telemetry;
use platebench_model::scenario::{Expectation, Metric, Scenario, Variation, Window};
use platebench_model::trace::Row;
use platebench_plate::{BandSignal, Complex64, Conditions, Drive, Mode, Model, Plant, Plate, State, Time};
use std::f64::consts::{PI, TAU};

/// Number of points per period of the ripple at which an extreme is searched.
const POINTS_PER_PERIOD: f64 = 16.0;
/// Smaller excesses over the rows are rounding errors, µm.
const ROUNDING_UM: f64 = 1e-12;
/// Parabolas through three points with the top of the last one in the middle. The first points are a
/// sixteenth of a period apart, those of each next one a sixteenth of that.
const PARABOLAS: u32 = 2;

/// The closed form over more rows would have rounding errors.
const MAX_INTERVAL_ROWS: usize = 64;

/// Share of the largest |W'| of earlier rows that bounds the next one. The slow oscillation of a
/// second mode may have W' = 0 at a row.
const SPEED_MEMORY: f64 = 0.8;

/// Difference between the value of an expectation and its value with the extremes between the rows
/// of the trace, in its unit. `present` is the value of the rows. `None` if the metric is not an
/// extreme of the motion, or if the trial has no value.
pub fn missed_between_rows(
    scenario: &Scenario,
    index: u32,
    expectation: &Expectation,
    rows: &[Row],
    telemetry: &Telemetry,
    present: f64,
) -> Option<f64> {
    use Metric::{Overshoot, PeakDeviation, Ripple, RipplePercent};
    if !matches!(expectation.metric, Overshoot | PeakDeviation | Ripple | RipplePercent) {
        return None;
    }
    let extremes = find_extremes(scenario, index, expectation, rows)?;
    if extremes.is_empty() {
        return Some(0.0);
    }
    let exact = measure_with_extremes(expectation, rows, &extremes, telemetry).value()?;
    Some((exact - present).abs())
}

/// Rows at extremes of the signal that exceed all rows with the same setpoint in the same windows, in
/// the order of time. The largest ones are always among them. `None` for a sensed signal, which has
/// no values between the control instants.
fn find_extremes(scenario: &Scenario, index: u32, expectation: &Expectation, rows: &[Row]) -> Option<Vec<Row>> {
    let scenario = scenario.of_trial(index);
    let signal = BandSignal::from_column(expectation.signal)?;
    let ranges = Ranges::new(setpoint_ranges(rows, signal, &expectation.windows));
    let variation = Variation::of_trial(scenario, index);
    if scenario.model == Model::Linear || scenario.plate.first_effect().is_some() || has_moving_modes(scenario) {
        let mut plant = variation.plant(&without_sensor(scenario));
        let start_hz = (scenario.controller.start_frequency_hz * 1e3).round() / 1e3;
        plant.set_drive(Drive { vpp: 0.0, omega: TAU * start_hz });
        return Some(simulated_extremes(plant, scenario.model, signal, rows, ranges));
    }
    let intervals = intervals_with_extremes(scenario.model, &variation.plate(&scenario.plate), signal, rows, ranges);
    let of_range = intervals.chunk_by(|one, other| one.range.first == other.range.first);
    let mut extremes: Vec<Row> = of_range
        .flat_map(|intervals| [1.0, -1.0].map(|sign| largest_extreme(intervals, signal, sign, rows)))
        .flatten()
        .collect();
    extremes.sort_by(|one, other| one.t_s.total_cmp(&other.t_s));
    Some(extremes)
}

/// Rows with the same command and the same mode.
struct Interval {
    /// Number of the first row.
    first: usize,
    motion: Motion,
    seconds: f64,
    /// Slow part of W at both ends.
    ends: [Complex64; 2],
    /// Bounds of the signal and of its negative.
    bounds: [f64; 2],
    range: SetpointRange,
}

/// Intervals with a bound that exceeds the rows of their range.
fn intervals_with_extremes(
    model: Model,
    plate: &Plate,
    signal: BandSignal,
    rows: &[Row],
    mut ranges: Ranges<impl Iterator<Item = SetpointRange>>,
) -> Vec<Interval> {
    let mut intervals = Vec::new();
    let mut conditions = Conditions::default();
    let mut poles = Poles::new(model, &plate.mode(&conditions));
    let mut command = [0.0; 2];
    let mut driven = Driven::new(&poles, command);
    let (mut fast, mut last) = (Complex64::ZERO, LastStep::default());
    let mut number = 0;
    while let Some([row, next @ ..]) = rows.get(number..).filter(|rest| rest.len() > 1) {
        let w = Complex64::new(row.wd_um, row.wq_um);
        let present = Conditions { temperature_offset_k: row.temperature_offset_k, finger_force_n: row.finger_force_n };
        let commanded = [row.frequency_hz, row.drive_vpp];
        if present != conditions {
            conditions = present;
            let changed = Poles::new(model, &plate.mode(&conditions));
            fast = poles.fast_part_in(&changed, w, fast);
            (poles, driven) = (changed, Driven::new(&changed, commanded));
        } else if commanded != command {
            driven = Driven::new(&poles, commanded);
        }
        command = commanded;
        let range = ranges.at(number).copied();
        let rows_in_range = range.map_or(1, |range| range.last - number);
        let same =
            next.iter().take(rows_in_range.min(MAX_INTERVAL_ROWS) - 1).take_while(|next| has_motion_of(row, next));
        let length = 1 + same.count();
        let Some(end) = rows.get(number + length) else { break };
        let motion = Motion { driven, slow: w - fast - driven.slow_rest, fast: fast - driven.fast_rest };
        let seconds = end.t_s - row.t_s;
        let end_fast = last.fast_after(&motion, seconds);
        if let Some(range) = range {
            let end_w = Complex64::new(end.wd_um, end.wq_um);
            let ends = [w - fast, end_w - end_fast].map(|slow| slow + driven.fast_rest);
            let bounds = motion.bounds(signal, 0.0, seconds, ends);
            if exceeds(bounds[0], range.limit(1.0)) || exceeds(bounds[1], range.limit(-1.0)) {
                intervals.push(Interval { first: number, motion, seconds, ends, bounds, range });
            }
        }
        fast = end_fast;
        number += length;
    }
    intervals
}

/// The row at the largest value of `sign` times the signal in the intervals of a range; `None` if no
/// value exceeds the rows. The larger bound first, so that most intervals are not searched.
fn largest_extreme(intervals: &[Interval], signal: BandSignal, sign: f64, rows: &[Row]) -> Option<Row> {
    let bound = |interval: &Interval| interval.bounds[usize::from(sign < 0.0)];
    let mut largest = intervals.first()?.range.limit(sign);
    let mut ordered: Vec<&Interval> = intervals.iter().filter(|interval| exceeds(bound(interval), largest)).collect();
    ordered.sort_by(|one, other| bound(other).total_cmp(&bound(one)));
    let mut found = None;
    for interval in ordered {
        if !exceeds(bound(interval), largest) {
            break;
        }
        let mut search = Search { motion: &interval.motion, signal, sign, largest, at: None };
        search.visit(0.0, interval.seconds, interval.ends);
        largest = search.largest;
        found = search.at.map(|t| (interval, t)).or(found);
    }
    let (interval, t) = found?;
    let later = rows.get(interval.first..)?;
    let at = later.first()?.t_s + t;
    let before = later.get(later.partition_point(|row| row.t_s <= at).saturating_sub(1))?;
    Some(row_at(before, at, interval.motion.after(t)))
}

/// True if the difference is more than a rounding error.
fn exceeds(value: f64, largest: f64) -> bool {
    value > largest + ROUNDING_UM
}

/// True if drive, frequency and mode are the same from `row` on and from `next` on.
fn has_motion_of(row: &Row, next: &Row) -> bool {
    row.drive_vpp == next.drive_vpp
        && row.frequency_hz == next.frequency_hz
        && row.temperature_offset_k == next.temperature_offset_k
        && row.finger_force_n == next.finger_force_n
}

/// The scenario for a plate without the demodulator, which does not act on the motion.
fn without_sensor(scenario: &Scenario) -> Scenario {
    let model = if scenario.model == Model::Carrier { Model::Modal } else { scenario.model };
    let plate = Plate { lockin: None, ..scenario.plate.clone() };
    Scenario { model, plate, other_trials: None, ..scenario.clone() }
}

/// Simulates `plant` with the commands of `rows` and searches the extremes between the rows.
fn simulated_extremes(
    mut plant: Plant,
    model: Model,
    signal: BandSignal,
    rows: &[Row],
    mut ranges: Ranges<impl Iterator<Item = SetpointRange>>,
) -> Vec<Row> {
    let mut extremes = Vec::new();
    let first = plant.plate().omega0;
    let second = plant.plate().effects.second_mode.map_or(first, |second| second.omega0);
    let (slowest, fastest) = (first.min(second), first.max(second));
    let time_of = |row: &Row| Time::from_seconds(row.t_s).unwrap_or_default();
    let mut speed = 0.0_f64;
    for (number, [row, next]) in rows.array_windows().enumerate() {
        let (start, end) = (time_of(row), time_of(next));
        plant.advance(start, &[], &mut Vec::new());
        let drive = Drive { vpp: row.drive_vpp, omega: TAU * row.frequency_hz };
        if drive != plant.drive() {
            plant.set_drive(drive);
        }
        let [w, next_w] = [row, next].map(|row| Complex64::new(row.wd_um, row.wq_um));
        let seconds = next.t_s - row.t_s;
        let state = plant.state();
        let momentary =
            if model.has_both_poles() { state.u - Complex64::I * drive.omega * state.w } else { Complex64::ZERO };
        speed = (SPEED_MEMORY * speed).max(momentary.norm()).max((next_w - w).norm() / seconds);
        let Some(range) = ranges.at(number) else { continue };
        // Half the distance of the slow part between the rows, and the ripple 2|B| with |W'| = (ω + ω0)|B|.
        let bound = speed * (seconds / 2.0 + 2.0 / (drive.omega + slowest));
        let ends = [w, next_w].map(|w| value_of(signal, w));
        let mut found = Vec::new();
        for sign in [1.0, -1.0] {
            let limit = range.limit(sign);
            if (sign * ends[0]).max(sign * ends[1]) + bound <= limit {
                continue;
            }
            let step = PI / (fastest * POINTS_PER_PERIOD);
            let (at, coarse) = largest_of(&plant, signal, sign, [start, end], step);
            let span = Time::from_seconds(step).unwrap_or_default();
            let around = [start.max(at - span.min(at)), end.min(at + span)];
            let (at, fine) = largest_of(&plant, signal, sign, around, step / POINTS_PER_PERIOD);
            let state = if sign * signal.value(&fine) > sign * signal.value(&coarse) { fine } else { coarse };
            let largest = sign * signal.value(&state);
            if exceeds(largest, limit) {
                range.raise(sign, largest);
                found.push((at, state.w));
            }
        }
        found.sort_by_key(|(at, _)| *at);
        extremes.extend(found.into_iter().map(|(at, w)| row_at(row, at.seconds(), w)));
    }
    extremes
}

/// Instant and state of the largest value at points that are `step` s apart.
fn largest_of(plant: &Plant, signal: BandSignal, sign: f64, [start, end]: [Time; 2], step: f64) -> (Time, State) {
    let mut plant = plant.clone();
    plant.advance(start, &[], &mut Vec::new());
    let mut best = (start, plant.state());
    let step = Time::from_nanos(((step * 1e9) as u64).max(1));
    let mut time = start;
    while time < end {
        plant.advance(time, &[], &mut Vec::new());
        if sign * signal.value(&plant.state()) > sign * signal.value(&best.1) {
            best = (time, plant.state());
        }
        time = time + step;
    }
    best
}

fn row_at(row: &Row, t_s: f64, w: Complex64) -> Row {
    Row { t_s, wd_um: w.re, wq_um: w.im, amplitude_um: w.norm(), ..*row }
}

/// Rows `first` to `last` with one setpoint, and the extremes of their values and of what was found
/// between them.
#[derive(Debug, Clone, Copy)]
struct SetpointRange {
    first: usize,
    last: usize,
    lowest: f64,
    highest: f64,
}

impl SetpointRange {
    /// The value that `sign` times the signal must exceed.
    fn limit(&self, sign: f64) -> f64 {
        if sign > 0.0 { self.highest } else { -self.lowest }
    }

    /// Later extremes must exceed this one.
    fn raise(&mut self, sign: f64, largest: f64) {
        let limit = if sign > 0.0 { &mut self.highest } else { &mut self.lowest };
        *limit = sign * largest;
    }
}

/// The ranges in the order of the rows, and the present one.
struct Ranges<I> {
    ranges: I,
    present: Option<SetpointRange>,
}

impl<I: Iterator<Item = SetpointRange>> Ranges<I> {
    fn new(mut ranges: I) -> Self {
        Self { present: ranges.next(), ranges }
    }

    /// The range that contains row `number` and the next one. `number` must not decrease.
    fn at(&mut self, number: usize) -> Option<&mut SetpointRange> {
        while self.present.is_some_and(|range| range.last <= number) {
            self.present = self.ranges.next();
        }
        self.present.as_mut().filter(|range| range.first <= number)
    }
}

/// A range ends if the setpoint or the windows that contain the rows change.
fn setpoint_ranges<'a>(
    rows: &'a [Row],
    signal: BandSignal,
    windows: &'a [Window],
) -> impl Iterator<Item = SetpointRange> + 'a {
    let is_inside = |window: &Window, row: &Row| window.from.seconds() <= row.t_s && row.t_s < window.to.seconds();
    let is_in_window = move |row: &Row| windows.iter().any(|window| is_inside(window, row));
    let mut next = 0;
    std::iter::from_fn(move || {
        let first = next + rows.get(next..)?.iter().position(is_in_window)?;
        let start = rows.get(first)?;
        let edges = windows.iter().flat_map(|window| [window.from, window.to]).map(Time::seconds);
        let edge_s = edges.filter(|edge_s| *edge_s > start.t_s).fold(f64::INFINITY, f64::min);
        let belongs = |row: &&Row| row.setpoint_um == start.setpoint_um && row.t_s < edge_s;
        let inside = rows.get(first..)?.iter().take_while(belongs);
        let empty = SetpointRange { first, last: first, lowest: f64::INFINITY, highest: f64::NEG_INFINITY };
        let range = inside.enumerate().fold(empty, |range, (place, row)| {
            let value = match signal {
                BandSignal::Amplitude => row.amplitude_um,
                BandSignal::InPhase => row.wd_um,
                BandSignal::Quadrature => row.wq_um,
            };
            let (lowest, highest) = (range.lowest.min(value), range.highest.max(value));
            SetpointRange { last: first + place, lowest, highest, ..range }
        });
        next = range.last + 1;
        Some(range)
    })
}

fn value_of(signal: BandSignal, w: Complex64) -> f64 {
    signal.value(&State { w, u: Complex64::ZERO })
}

/// The poles in the fixed frame, and the force per volt of both parts.
#[derive(Debug, Clone, Copy)]
struct Poles {
    slow: Complex64,
    /// `None` in the envelope model.
    fast: Option<Complex64>,
    force: f64,
}

impl Poles {
    fn new(model: Model, mode: &Mode) -> Self {
        let Mode { sigma, omega0, force_constant, envelope_constant } = *mode;
        if !model.has_both_poles() {
            return Self { slow: Complex64::new(-sigma, omega0), fast: None, force: envelope_constant };
        }
        let damped = ((omega0 - sigma) * (omega0 + sigma)).sqrt();
        Self {
            slow: Complex64::new(-sigma, damped),
            fast: Some(Complex64::new(-sigma, -damped)),
            force: force_constant / (2.0 * damped),
        }
    }

    /// Part of the fast pole after a change of the mode. W and U are continuous.
    fn fast_part_in(&self, other: &Self, w: Complex64, fast: Complex64) -> Complex64 {
        let (Some(minus), Some(new_minus)) = (self.fast, other.fast) else { return Complex64::ZERO };
        let u = self.slow * (w - fast) + minus * fast;
        (other.slow * w - u) / (other.slow - new_minus)
    }
}

/// Rests and poles of both parts in the rotating frame. They are constant while drive and mode are.
#[derive(Debug, Clone, Copy)]
struct Driven {
    slow_rest: Complex64,
    fast_rest: Complex64,
    /// 1/s
    slow_pole: Complex64,
    /// 1/s; 0 in the envelope model.
    fast_pole: Complex64,
    /// Period of the fastest oscillation, s.
    shortest_period: f64,
}

impl Driven {
    /// `command` is the frequency in Hz and the drive in Vpp.
    fn new(poles: &Poles, [frequency_hz, vpp]: [f64; 2]) -> Self {
        let frame = Complex64::new(0.0, TAU * frequency_hz);
        let force = poles.force * vpp;
        let slow_pole = poles.slow - frame;
        let fast_pole = poles.fast.map_or(Complex64::ZERO, |pole| pole - frame);
        Self {
            slow_rest: -force / slow_pole,
            fast_rest: if poles.fast.is_some() { force / fast_pole } else { Complex64::ZERO },
            slow_pole,
            fast_pole,
            shortest_period: TAU / fast_pole.im.abs().max(slow_pole.norm()),
        }
    }
}

/// `W = rests + Σ amplitude e^{pole t}` from a row on, with the amplitude of both parts.
#[derive(Debug, Clone, Copy)]
struct Motion {
    driven: Driven,
    slow: Complex64,
    fast: Complex64,
}

impl Motion {
    fn rest(&self) -> Complex64 {
        self.driven.slow_rest + self.driven.fast_rest
    }

    fn after(&self, seconds: f64) -> Complex64 {
        self.slow_after(seconds) + self.fast * (self.driven.fast_pole * seconds).exp()
    }

    /// W without the fast part that decays.
    fn slow_after(&self, seconds: f64) -> Complex64 {
        self.rest() + self.slow * (self.driven.slow_pole * seconds).exp()
    }

    /// Bounds of the signal from `t` on for `seconds`, and of its negative: those of the chord of the
    /// slow part from `start` to `end`, its distance from the chord, `t²|W''|/8`, and the fast part.
    fn bounds(&self, signal: BandSignal, t: f64, seconds: f64, [start, end]: [Complex64; 2]) -> [f64; 2] {
        let pole = self.driven.slow_pole;
        // Both parts decay.
        let decay = if t == 0.0 { 1.0 } else { (pole.re * t).exp() };
        let [slow, fast] = [self.slow, self.fast].map(size);
        let reach = decay * (seconds * seconds * pole.norm_sqr() / 8.0 * slow + fast);
        let (ends, lowest) = if signal == BandSignal::Amplitude {
            let ends = [start, end].map(size);
            // The distances of a point of the chord from both ends sum up to its length.
            (ends, f64::midpoint(ends[0], ends[1]) - size(end - start) / 2.0)
        } else {
            let ends = [start, end].map(|w| value_of(signal, w));
            (ends, ends[0].min(ends[1]))
        };
        [ends[0].max(ends[1]) + reach, reach - lowest]
    }
}

/// Searches the largest value of `sign` times the signal in an interval, by bisection. Parts whose
/// bound does not exceed the largest value so far are not searched.
struct Search<'a> {
    motion: &'a Motion,
    signal: BandSignal,
    sign: f64,
    largest: f64,
    /// Instant of `largest` after the start, s; `None` if no value exceeds the first one.
    at: Option<f64>,
}

impl Search<'_> {
    /// `ends` are the slow part at `from` and at `to`.
    fn visit(&mut self, from: f64, to: f64, ends: [Complex64; 2]) {
        if to - from <= self.motion.driven.shortest_period {
            let t = self.largest_between(from, to);
            let largest = self.sign * value_of(self.signal, self.motion.after(t));
            if exceeds(largest, self.largest) {
                (self.largest, self.at) = (largest, Some(t));
            }
            return;
        }
        let middle = f64::midpoint(from, to);
        let [start, end] = ends;
        let centre = self.motion.slow_after(middle);
        let sign = usize::from(self.sign < 0.0);
        let mut parts = [(from, middle, [start, centre]), (middle, to, [centre, end])]
            .map(|(from, to, ends)| (from, to, ends, self.motion.bounds(self.signal, from, to - from, ends)[sign]));
        // The larger bound first, so that the other part is probably not searched.
        parts.sort_by(|one, other| other.3.total_cmp(&one.3));
        for (from, to, ends, bound) in parts {
            if exceeds(bound, self.largest) {
                self.visit(from, to, ends);
            }
        }
    }

    /// Instant of the largest value, by a scan and by parabolas. The value has at most one period
    /// between `from` and `to`.
    fn largest_between(&self, from: f64, to: f64) -> f64 {
        let Motion { driven, slow, fast } = *self.motion;
        let step = (to - from) / POINTS_PER_PERIOD;
        let (mut slow, mut fast) = (slow * (driven.slow_pole * from).exp(), fast * (driven.fast_pole * from).exp());
        let factors = [driven.slow_pole, driven.fast_pole].map(|pole| (pole * step).exp());
        let mut best = (from, f64::NEG_INFINITY);
        for number in 0..=POINTS_PER_PERIOD as u32 {
            let here = self.rank(self.motion.rest() + slow + fast);
            if here > best.1 {
                best = (from + f64::from(number) * step, here);
            }
            (slow, fast) = (slow * factors[0], fast * factors[1]);
        }
        let (mut t, mut span) = (best.0, step);
        for _ in 0..PARABOLAS {
            let [before, here, after] = [t - span, t, t + span].map(|t| self.rank(self.motion.after(t)));
            let curvature = before - 2.0 * here + after;
            let top = if curvature < 0.0 { (before - after) / (2.0 * curvature) } else { 0.0 };
            t = (t + span * top.clamp(-1.0, 1.0)).clamp(from, to);
            span /= POINTS_PER_PERIOD;
        }
        if self.rank(self.motion.after(t)) > best.1 { t } else { best.0 }
    }

    /// Largest where `sign` times the signal is. |W|² is smooth where |W| is 0.
    fn rank(&self, w: Complex64) -> f64 {
        match self.signal {
            BandSignal::Amplitude => self.sign * w.norm_sqr(),
            _ => self.sign * value_of(self.signal, w),
        }
    }
}

/// |W| within a rounding error, faster than [`Complex64::norm`].
fn size(w: Complex64) -> f64 {
    w.norm_sqr().sqrt()
}

/// Exponential of the fast pole over the last step. Most steps have the same length and pole.
#[derive(Debug, Clone, Copy, Default)]
struct LastStep {
    pole: Complex64,
    seconds: f64,
    decay: Complex64,
}

impl LastStep {
    /// Fast part after `seconds`.
    fn fast_after(&mut self, motion: &Motion, seconds: f64) -> Complex64 {
        let pole = motion.driven.fast_pole;
        // Instants of rows have rounding errors of 1e-17 s.
        let is_same = self.pole == pole && (self.seconds - seconds).abs() < 1e-16;
        if !is_same {
            *self = Self { pole, seconds, decay: (pole * seconds).exp() };
        }
        motion.driven.fast_rest + motion.fast * self.decay
    }
}
