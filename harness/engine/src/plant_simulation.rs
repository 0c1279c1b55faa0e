//! Simulates plate, sensor and drive of a trial, in lockstep and in real time. Passes its rows out
//! of a loop that must not wait, and manual inputs into it.

use crate::live_tap::TapWriter;
use crate::trial::start_frequency_mhz;
use platebench_model::record::NonFiniteDrive;
use platebench_model::scenario::{LoopInsertion, Scenario, Variation};
use platebench_model::trace::{Flags, Row};
use platebench_plate::{BandMonitor, BandSignal, Conditions, Crossing, Drive, Plant, Sensor, State, Time};
use platebench_wire::{Command, ControllerState as Mode, Sample};
use rtrb::{Consumer, Producer, RingBuffer};
use std::f64::consts::TAU;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Mutex, PoisonError};
use std::thread;
use std::time::Duration;

/// Share of the drive limit at which the drive is saturated. The wire rounds the limit to f32.
pub(crate) const SATURATION_THRESHOLD: f64 = 1.0 - 1e-6;

pub(crate) trait RowSink {
    /// The last row, which events at the same instant may still change.
    fn last_mut(&mut self) -> Option<&mut Row>;

    /// Must not wait, because the real-time loop calls it.
    fn push(&mut self, row: Row);
}

impl RowSink for Vec<Row> {
    #[inline]
    fn last_mut(&mut self) -> Option<&mut Row> {
        self.as_mut_slice().last_mut()
    }

    #[inline]
    fn push(&mut self, row: Row) {
        Self::push(self, row);
    }
}

/// Estimates the number of rows: one per trace step and two per control period.
pub(crate) fn expected_rows(scenario: &Scenario) -> usize {
    let of = |span: Time| (scenario.duration.seconds() / span.seconds()) as usize;
    of(scenario.trace_step) + 2 * of(scenario.controller.period) + 64
}

#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct ManualInputs {
    pub setpoint_um: f64,
    pub temperature_offset_k: f64,
    pub finger_force_n: f64,
}

pub(crate) struct PlantSimulation<'a, R> {
    scenario: &'a Scenario,
    plant: Plant,
    sensor: Sensor,
    sink: R,
    tap: Option<&'a mut TapWriter>,
    crossings: Vec<Crossing>,
    bands: Vec<BandMonitor>,
    bands_setpoint_um: Option<f64>,
    /// The bands are those of the intervals that end by this time.
    bands_end: Time,
    manual_setpoint_um: Option<f64>,
    /// Setpoint in µm from the first to before the second time.
    constant_setpoint: Option<(Time, Time, f64)>,
    /// First point of a profile after the present time.
    next_point: Time,
    clock_start_us: u32,
    frequency_hz: f64,
    sensed: [f64; 2],
    safe: bool,
    not_finite: Option<NonFiniteDrive>,
    inserted: Option<InsertedGains>,
}

/// Gains of a [`LoopInsertion`].
struct InsertedGains {
    insertion: LoopInsertion,
    averaged_from: Time,
    /// Sums of drive and frequency over the commands before the insertion, and their number.
    sums: [f64; 2],
    count: f64,
    /// Drive in Vpp and frequency in Hz if there are no commands before the insertion.
    start: [f64; 2],
}

impl InsertedGains {
    fn new(scenario: &Scenario) -> Option<Self> {
        let insertion = scenario.controller.insertion?;
        let averaged = scenario.controller.period.times(LoopInsertion::AVERAGED_PERIODS);
        let start = [0.0, f64::from(start_frequency_mhz(scenario)) / 1e3];
        Some(Self { insertion, averaged_from: insertion.from - averaged, sums: [0.0; 2], count: 0.0, start })
    }

    /// Returns drive and frequency of the plate for those of a command at `now`.
    fn apply(&mut self, now: Time, command: [f64; 2]) -> [f64; 2] {
        if now < self.insertion.from {
            if now >= self.averaged_from {
                self.count += 1.0;
                self.sums = [self.sums[0] + command[0], self.sums[1] + command[1]];
            }
            return command;
        }
        let reference = if self.count > 0.0 { self.sums.map(|sum| sum / self.count) } else { self.start };
        let changed = |gain: f64, n: usize| reference[n] + gain * (command[n] - reference[n]);
        [changed(self.insertion.drive_gain, 0), changed(self.insertion.frequency_gain, 1)]
    }
}

impl<'a, R: RowSink> PlantSimulation<'a, R> {
    pub(crate) fn new(scenario: &'a Scenario, index: u32, rows: R, tap: Option<&'a mut TapWriter>) -> Self {
        let variation = Variation::of_trial(scenario, index);
        let mut plant = variation.plant(scenario);
        let frequency_hz = f64::from(start_frequency_mhz(scenario)) / 1e3;
        plant.set_drive(Drive { vpp: 0.0, omega: TAU * frequency_hz });
        let mut simulation = Self {
            scenario,
            plant,
            sensor: variation.sensor(scenario),
            sink: rows,
            tap,
            crossings: Vec::with_capacity(64),
            bands: Vec::with_capacity(scenario.expectations.len()),
            bands_setpoint_um: None,
            bands_end: Time::ZERO,
            manual_setpoint_um: None,
            constant_setpoint: None,
            next_point: Time::ZERO,
            clock_start_us: clock_start_us(scenario, index),
            frequency_hz,
            sensed: [0.0; 2],
            safe: false,
            not_finite: None,
            inserted: InsertedGains::new(scenario),
        };
        simulation.find_next_point();
        simulation
    }

    /// Finds the next point of a profile, and the setpoint until then if it is constant.
    fn find_next_point(&mut self) {
        let (now, profile) = (self.time(), &self.scenario.setpoint);
        let points = [self.plant.next_point_after(now), profile.next_point_after(now)];
        let next = points.into_iter().flatten().fold(Time::from_nanos(u64::MAX), Time::min);
        self.next_point = next;
        self.constant_setpoint = (profile.max_slope_after(now) == 0.0).then(|| (now, next, profile.at(now)));
    }

    pub(crate) fn time(&self) -> Time {
        self.plant.time()
    }

    pub(crate) fn is_finished(&self) -> bool {
        self.time() >= self.scenario.duration
    }

    pub(crate) fn into_rows(mut self) -> R {
        show_last_row(&mut self.tap, &mut self.sink);
        self.sink
    }

    /// Replaces the scenario's profiles by constant inputs. Allocates memory.
    pub(crate) fn set_manual_inputs(&mut self, held: &ManualInputs) {
        let ManualInputs { setpoint_um, temperature_offset_k, finger_force_n } = *held;
        self.manual_setpoint_um = Some(setpoint_um);
        self.plant.hold_conditions(Conditions { temperature_offset_k, finger_force_n });
        self.find_next_point();
    }

    fn setpoint_at(&self, time: Time) -> f64 {
        let constant = self.constant_setpoint.filter(|(from, to, _)| *from <= time && time < *to);
        let planned = || constant.map_or_else(|| self.scenario.setpoint.at(time), |(.., setpoint)| setpoint);
        self.manual_setpoint_um.unwrap_or_else(planned)
    }

    pub(crate) fn sense(&mut self) -> Sample {
        let now = self.time();
        let sensed = self.sensor.measure(self.plant.sensor_reading());
        let sample = Sample {
            time_us: self.clock_start_us.wrapping_add(now.wrapping_micros()),
            setpoint_um: self.setpoint_at(now) as f32,
            wd_um: to_wire(sensed.re),
            wq_um: to_wire(sensed.im),
        };
        self.sensed = [f64::from(sample.wd_um), f64::from(sample.wq_um)];
        sample
    }

    /// A drive that is NaN or infinite becomes 0 V and is counted.
    pub(crate) fn actuate(&mut self, command: &Command) {
        self.safe = command.state != Mode::Running;
        let commanded = f64::from(command.drive_vpp);
        let limit = self.scenario.plate.drive_limit_vpp;
        let mut vpp = if commanded.is_finite() {
            commanded.clamp(0.0, limit)
        } else {
            let first = NonFiniteDrive { at_s: self.time().seconds(), count: 0 };
            self.not_finite.get_or_insert(first).count += 1;
            0.0
        };
        self.frequency_hz = f64::from(command.frequency_mhz) / 1e3;
        if let Some(inserted) = self.inserted.as_mut().filter(|_| !self.safe) {
            let now = self.plant.time();
            [vpp, self.frequency_hz] = inserted.apply(now, [vpp, self.frequency_hz]);
            vpp = vpp.clamp(0.0, limit);
        }
        self.plant.set_drive(Drive { vpp, omega: TAU * self.frequency_hz });
    }

    pub(crate) fn not_finite(&self) -> Option<NonFiniteDrive> {
        self.not_finite
    }

    pub(crate) fn stop_drive(&mut self) {
        self.safe = true;
        self.plant.set_drive(Drive { vpp: 0.0, ..self.plant.drive() });
    }

    pub(crate) fn next_scheduled_row(&self) -> Time {
        self.scenario.trace_step.next_multiple_after(self.time()).min(self.scenario.duration).min(self.next_point)
    }

    /// Simulates until `end`. Adds a row before and after each crossing of an expectation's band, or
    /// of the limit of an overshoot or a peak deviation.
    /// No scheduled row may lie before `end`.
    pub(crate) fn advance(&mut self, end: Time, flags: Flags) {
        self.update_bands(end);
        self.plant.advance(end, &self.bands, &mut self.crossings);
        if self.time() >= self.next_point {
            self.find_next_point();
        }
        if !self.crossings.is_empty() {
            self.push_crossings(end, flags);
        }
    }

    /// Adds the rows of the crossings before `end`.
    #[cold]
    fn push_crossings(&mut self, end: Time, flags: Flags) {
        let mut crossings = std::mem::take(&mut self.crossings);
        for crossing in crossings.drain(..) {
            let last = Time::from_nanos(crossing.time.as_nanos().saturating_sub(1));
            let instants = [(last, crossing.before), (crossing.time, crossing.state)];
            for ((time, state), rise_k) in instants.into_iter().zip(crossing.temperature_rise_k) {
                // The instants at both ends of the interval have rows of their own.
                if self.sink.last_mut().is_none_or(|last| last.t_s < time.seconds()) && time < end {
                    self.push(time, &state, rise_k, 0.0, flags);
                }
            }
        }
        self.crossings = crossings;
    }

    /// Simulates until `end` and adds every scheduled row before it, with `flags`.
    pub(crate) fn advance_through(&mut self, end: Time, flags: Flags) {
        let end = end.min(self.scenario.duration);
        while self.time() < end {
            self.advance_on_grid(end, flags);
            let next = self.next_scheduled_row().min(end);
            self.advance(next, flags);
            if next < end {
                self.push_row(0.0, flags);
            }
        }
    }

    /// Simulates until the last multiple of the trace step before `end`, and adds its rows, if nothing
    /// but the state of the plate changes until then. Otherwise it stops earlier.
    fn advance_on_grid(&mut self, end: Time, flags: Flags) {
        let (step, now) = (self.scenario.trace_step, self.time());
        let first = step.next_multiple_after(now);
        let has_setpoint = self.manual_setpoint_um.is_some() || self.constant_setpoint.is_some();
        if first >= end || !has_setpoint {
            return;
        }
        self.update_bands(first);
        let end = end.min(self.next_point).min(self.bands_end);
        let rise_k = self.plant.self_heating_k();
        let Some(row) = self.row(now, &self.plant.state(), rise_k, 0.0, flags) else { return };
        let held = &row;
        self.plant.advance_in_steps(step, end, &self.bands, |time, state| {
            show_last_row(&mut self.tap, &mut self.sink);
            self.sink.push(with_state(Row { t_s: time.seconds(), ..*held }, state));
        });
    }

    /// Records the sample that the controller got. A fault of the line may have changed it.
    pub(crate) fn set_delivered_sample(&mut self, sensed: [f32; 2]) {
        self.sensed = sensed.map(|value| f64::from(to_wire(value.into())));
    }

    /// Adds a row for the present instant, or changes the last row if it has this instant.
    pub(crate) fn push_row(&mut self, lateness_us: f64, flags: Flags) {
        let (now, state, rise_k) = (self.time(), self.plant.state(), self.plant.self_heating_k());
        self.push(now, &state, rise_k, lateness_us, flags);
    }

    fn push(&mut self, time: Time, state: &State, rise_k: f64, lateness_us: f64, flags: Flags) {
        // If the simulation has overflowed, the trace ends, so the judge excludes the trial.
        let Some(row) = self.row(time, state, rise_k, lateness_us, flags) else { return };
        match self.sink.last_mut() {
            // A row has the state after the last event of its instant and all flags of the instant.
            Some(last) if last.t_s == row.t_s => {
                let happened = last.flags & (Flags::CONTROL | Flags::OVERRUN | Flags::LINK_LOST);
                *last = Row { lateness_us: row.lateness_us.max(last.lateness_us), flags: row.flags | happened, ..row };
            }
            _ => {
                show_last_row(&mut self.tap, &mut self.sink);
                self.sink.push(row);
            }
        }
    }

    /// `None` if the state or the resonance is not finite.
    fn row(&self, time: Time, state: &State, rise_k: f64, lateness_us: f64, flags: Flags) -> Option<Row> {
        let drive = self.plant.drive();
        let conditions = self.plant.conditions_at(time);
        let resonance_hz = self.plant.mode_with_rise(time, rise_k).omega0 / TAU;
        let saturated = drive.vpp >= self.scenario.plate.drive_limit_vpp * SATURATION_THRESHOLD;
        let also = [(saturated, Flags::SATURATED), (self.safe, Flags::SAFE)];
        let row = Row {
            t_s: time.seconds(),
            setpoint_um: self.setpoint_at(time),
            drive_vpp: drive.vpp,
            frequency_hz: self.frequency_hz,
            resonance_hz,
            temperature_offset_k: conditions.temperature_offset_k,
            finger_force_n: conditions.finger_force_n,
            sensed_wd_um: self.sensed[0],
            sensed_wq_um: self.sensed[1],
            lateness_us,
            flags: also.into_iter().filter(|(holds, _)| *holds).fold(flags, |flags, (_, flag)| flags | flag),
            ..Row::default()
        };
        (state.is_finite() && resonance_hz.is_finite()).then(|| with_state(row, state))
    }

    pub(crate) fn report_counts(&mut self, missed: u64, refused: u64) {
        if let Some(tap) = &mut self.tap {
            tap.count_missed_replies(missed);
            tap.set_rejected_frames(refused);
        }
    }

    /// Selects the bands of the interval from now to `end`.
    fn update_bands(&mut self, end: Time) {
        let (now, setpoint) = (self.time(), self.setpoint_at(self.time()));
        if self.bands_setpoint_um.replace(setpoint) == Some(setpoint) && end <= self.bands_end {
            return;
        }
        self.bands.clear();
        self.bands_end = self.next_point;
        // A search along a moving mode evaluates it every microsecond.
        let has_constant_mode = self.plant.has_constant_modes();
        for expectation in &self.scenario.expectations {
            let Some(signal) = BandSignal::from_column(expectation.signal) else { continue };
            let mut add = |(low, high)| {
                let band = BandMonitor { signal, low, high };
                if !self.bands.contains(&band) {
                    self.bands.push(band);
                }
            };
            if expectation.metric.has_band() && setpoint > 0.0 {
                add(expectation.band(setpoint));
            }
            for window in expectation.windows.iter().filter(|_| has_constant_mode) {
                let Some(limits) = expectation.limit_band(&self.scenario.setpoint, window, setpoint) else { continue };
                // A row outside the window decides nothing.
                if window.from < end && now < window.to {
                    add(limits);
                }
                let change = if window.from < end { window.to } else { window.from };
                if now < change {
                    self.bands_end = self.bands_end.min(change);
                }
            }
        }
    }
}

#[inline]
fn with_state(row: Row, state: &State) -> Row {
    Row { wd_um: state.w.re, wq_um: state.w.im, amplitude_um: state.amplitude(), ..row }
}

/// Passes the last row, which does not change any more, to the live view.
#[inline]
fn show_last_row(tap: &mut Option<&mut TapWriter>, sink: &mut impl RowSink) {
    if let (Some(tap), Some(last)) = (tap, sink.last_mut()) {
        tap.push(last);
    }
}

/// Returns the start of the sample clock: 0, or just before 2^16 ms, 2^31 µs or 2^32 µs. Counters
/// of these widths then overflow within the trial.
fn clock_start_us(scenario: &Scenario, index: u32) -> u32 {
    let before_us = (scenario.duration.wrapping_micros() / 2).min(20_000);
    match index % 4 {
        1 => (1 << 16) * 1_000 - before_us,
        2 => (1 << 31) - before_us,
        3 => before_us.wrapping_neg(),
        _ => 0,
    }
}

/// Clamps to the range of f32, the number format of the wire.
fn to_wire(value: f64) -> f32 {
    value.clamp(f32::MIN.into(), f32::MAX.into()) as f32
}

impl PlantSimulation<'_, Vec<Row>> {
    /// Excludes the row of the present instant, which the loop adds later.
    pub(crate) fn row_count(&self) -> usize {
        self.sink.len()
    }

    pub(crate) fn add_flags(&mut self, number: usize, flags: Flags) {
        if let Some(row) = self.sink.get_mut(number) {
            row.flags |= flags;
        }
    }
}

/// Number of rows, more than 1 s at a trace step of 0.05 ms and a control period of 1 ms.
const CAPACITY: usize = 1 << 15;
/// Time between two reads. To fill the queue takes hundreds of times longer.
const POLL_INTERVAL: Duration = Duration::from_millis(2);

pub(crate) struct RowQueue {
    producer: Producer<Row>,
    /// Not in the queue yet.
    last: Option<Row>,
    lost_rows: u64,
}

impl RowQueue {
    pub(crate) fn new() -> (Self, Consumer<Row>) {
        Self::with_capacity(CAPACITY)
    }

    fn with_capacity(capacity: usize) -> (Self, Consumer<Row>) {
        let (producer, consumer) = RingBuffer::new(capacity);
        (Self { producer, last: None, lost_rows: 0 }, consumer)
    }

    /// Passes the last row on and returns the number of lost rows.
    pub(crate) fn finish(mut self) -> u64 {
        self.send_last();
        self.lost_rows
    }

    fn send_last(&mut self) {
        if let Some(row) = self.last.take() {
            self.lost_rows += u64::from(self.producer.push(row).is_err());
        }
    }
}

impl RowSink for RowQueue {
    fn last_mut(&mut self) -> Option<&mut Row> {
        self.last.as_mut()
    }

    fn push(&mut self, row: Row) {
        self.send_last();
        self.last = Some(row);
    }
}

/// Collects rows until the producer is dropped. Allocates memory for `expected` rows at the start.
pub(crate) fn collect_rows(consumer: Consumer<Row>, expected: usize) -> Vec<Row> {
    watch_rows(consumer, Vec::with_capacity(expected), POLL_INTERVAL, |_| {})
}

/// Appends to `rows` until the producer is dropped. Calls `watch` with all rows after each read.
pub(crate) fn watch_rows(
    mut consumer: Consumer<Row>,
    mut rows: Vec<Row>,
    interval: Duration,
    mut watch: impl FnMut(&[Row]),
) -> Vec<Row> {
    loop {
        // Checked before the queue is emptied. Otherwise rows that arrive in between would be lost.
        let is_over = consumer.is_abandoned();
        while let Ok(row) = consumer.pop() {
            rows.push(row);
        }
        watch(&rows);
        if is_over {
            return rows;
        }
        thread::sleep(interval);
    }
}

#[derive(Debug, Default)]
pub struct ManualControl {
    change_count: AtomicU64,
    inputs: Mutex<ManualInputs>,
}

impl ManualControl {
    pub fn set(&self, inputs: ManualInputs) {
        *self.inputs.lock().unwrap_or_else(PoisonError::into_inner) = inputs;
        self.change_count.fetch_add(1, Ordering::Release);
    }

    /// Returns changed inputs without a wait. Inputs that are being written follow one period
    /// later.
    pub(crate) fn changed_inputs(&self, seen: &mut u64) -> Option<ManualInputs> {
        let changes = self.change_count.load(Ordering::Acquire);
        if changes == *seen {
            return None;
        }
        let inputs = *self.inputs.try_lock().ok()?;
        *seen = changes;
        Some(inputs)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn time_stamps_overflow_within_some_trials() {
        let scenario = platebench_test_kit::load_scenario("paper/fig13-closed-loop.toml");
        let stamps = [0, 1, 2, 3, 4].map(|index| {
            let mut plant = PlantSimulation::new(&scenario, index, Vec::new(), None);
            let first = plant.sense().time_us;
            plant.advance_through(Time::from_nanos(30_000_000), Flags::empty());
            (first, plant.sense().time_us)
        });
        let expected = [
            (0, 30_000),
            (65_516_000, 65_546_000),
            (2_147_463_648, 2_147_493_648),
            (4_294_947_296, 10_000),
            (0, 30_000),
        ];
        assert_eq!(stamps, expected);
    }

    fn row(t_s: f64) -> Row {
        Row { t_s, ..Row::default() }
    }

    #[test]
    fn returns_all_rows_in_order() {
        let (mut queue, consumer) = RowQueue::new();
        let collector = thread::spawn(|| collect_rows(consumer, 10));
        for number in 0..100_000_u32 {
            while queue.producer.is_full() {
                thread::yield_now();
            }
            queue.push(row(f64::from(number)));
        }
        assert_eq!(queue.finish(), 0);
        let rows = collector.join().unwrap();
        assert_eq!(rows.len(), 100_000);
        assert!(rows.windows(2).all(|pair| pair[1].t_s == pair[0].t_s + 1.0));
    }

    #[test]
    fn a_full_queue_counts_the_rows_it_loses() {
        let (mut queue, consumer) = RowQueue::with_capacity(4);
        (0..7_u32).for_each(|number| queue.push(row(f64::from(number))));
        assert_eq!(queue.finish(), 3);
        assert_eq!(collect_rows(consumer, 0).len(), 4);
    }

    #[test]
    fn returns_each_change_once() {
        let control = ManualControl::default();
        let mut seen = 0;
        assert_eq!(control.changed_inputs(&mut seen), None);
        let inputs = ManualInputs { finger_force_n: 1.5, ..ManualInputs::default() };
        control.set(inputs);
        assert_eq!(control.changed_inputs(&mut seen), Some(inputs));
        assert_eq!(control.changed_inputs(&mut seen), None);
    }
}
