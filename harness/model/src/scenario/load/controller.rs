//! Checks the controller and its timing.

use super::checker::{Checker, Diagnostics};
use crate::scenario::bounds::MAX_DELAY_PERIODS;
use crate::scenario::definition::{Controller, Gains};
use crate::scenario::diagnostic::Diagnostic;
use crate::scenario::raw::{
    DEFAULT_FREQUENCY_RANGE_HZ, DEFAULT_FREQUENCY_SLEW_HZ, DEFAULT_LAW, DEFAULT_PERIOD_MS, RawController,
};
use platebench_plate::{Plate, Time};
use std::f64::consts::TAU;

impl Checker<'_> {
    pub(super) fn controller(
        &self,
        raw: &RawController,
        plate: Option<&Plate>,
        design_plate: Option<Plate>,
        faults: &mut Diagnostics,
    ) -> Option<Controller> {
        let period = faults.record_error(self.period(raw));
        let delays = period.and_then(|period| {
            let loop_delay = faults.record_error(self.loop_delay(raw, period));
            loop_delay.zip(faults.record_error(self.design_delay(raw, period)))
        });
        let start_frequency_hz = plate
            .map(|plate| design_plate.as_ref().unwrap_or(plate))
            .and_then(|plate| faults.record_error(self.start_frequency(raw, plate)));
        let optional = |key: &str, value: Option<f64>| value.map(|value| self.f32_range(key, value)).transpose();
        let key = "controller.frequency_range_hz";
        let range = faults.record_error(optional(key, raw.frequency_range_hz));
        let slew = faults.record_error(optional("controller.frequency_slew_hz", raw.frequency_slew_hz));
        if let (Some(Some(range)), Some(start_frequency_hz)) = (range, start_frequency_hz) {
            faults.record_error(self.require(range < start_frequency_hz, key, || {
                format!("{range} Hz, expected less than the start frequency of {start_frequency_hz:.1} Hz")
            }));
        }
        let law = raw.law.clone().unwrap_or_else(|| DEFAULT_LAW.to_owned());
        let is_named = !law.trim().is_empty();
        faults.record_error(self.require(is_named, "controller.law", || "an empty name, expected a control law"));
        let response_time_ms = faults.record_error(optional("controller.response_time_ms", raw.response_time_ms));
        let gains = faults.record_error(raw.gains.map(|gains| self.gains(gains)).transpose());
        let ([loop_delay, loop_delay_jitter], design_delay) = delays?;
        Some(Controller {
            law,
            period: period?,
            start_frequency_hz: start_frequency_hz?,
            loop_delay,
            loop_delay_jitter,
            design_delay,
            response_time_ms: response_time_ms?,
            frequency_range_hz: range?.unwrap_or(DEFAULT_FREQUENCY_RANGE_HZ),
            frequency_slew_hz: slew?.unwrap_or(DEFAULT_FREQUENCY_SLEW_HZ),
            gains: gains?,
            design_plate,
        })
    }

    fn period(&self, raw: &RawController) -> Result<Time, Diagnostic> {
        let period_ms = raw.period_ms.unwrap_or(DEFAULT_PERIOD_MS);
        let key = "controller.period_ms";
        let period = self.time_from_ms(key, period_ms)?;
        self.require(period.as_nanos() > 0 && period.as_nanos().is_multiple_of(1_000), key, || {
            format!("{period_ms} ms, expected whole microseconds: the wire carries no finer period")
        })?;
        Ok(period)
    }

    fn loop_delay(&self, raw: &RawController, period: Time) -> Result<[Time; 2], Diagnostic> {
        let key = "controller.loop_delay_ms";
        let loop_delay = self.time_from_ms(key, raw.loop_delay_ms)?;
        self.require(loop_delay <= period.times(MAX_DELAY_PERIODS), key, || {
            format!("{} ms, expected at most {MAX_DELAY_PERIODS} control periods", raw.loop_delay_ms)
        })?;
        let key = "controller.loop_delay_jitter_ms";
        let jitter = self.time_from_ms(key, raw.loop_delay_jitter_ms)?;
        self.require(loop_delay + jitter <= period.times(MAX_DELAY_PERIODS), key, || {
            let jitter = raw.loop_delay_jitter_ms;
            format!("{jitter} ms, expected at most {MAX_DELAY_PERIODS} control periods together with loop_delay_ms")
        })?;
        Ok([loop_delay, jitter])
    }

    fn design_delay(&self, raw: &RawController, period: Time) -> Result<Time, Diagnostic> {
        let key = "controller.design_delay_ms";
        let design_delay = self.time_from_ms(key, raw.design_delay_ms)?;
        self.require(design_delay <= period, key, || {
            format!("{} ms, expected at most one control period of {period}", raw.design_delay_ms)
        })?;
        self.require(design_delay.as_nanos().is_multiple_of(1_000), key, || {
            format!("{} ms, expected whole microseconds: the wire carries no finer delay", raw.design_delay_ms)
        })?;
        Ok(design_delay)
    }

    fn start_frequency(&self, raw: &RawController, plate: &Plate) -> Result<f64, Diagnostic> {
        let resonance_hz = plate.omega0 / TAU;
        let key = "controller.start_frequency_hz";
        let start_frequency_hz = raw.start_frequency_hz.unwrap_or(resonance_hz);
        let share = start_frequency_hz / resonance_hz;
        self.require((0.5..=1.5).contains(&share), key, || {
            format!(
                "{start_frequency_hz} Hz, expected between 0.5 and 1.5 times the plate's resonance of \
                 {resonance_hz:.1} Hz"
            )
        })?;
        Ok(start_frequency_hz)
    }

    fn gains(&self, gains: Gains) -> Result<Gains, Diagnostic> {
        for (name, value) in [
            ("amplitude_kp", gains.amplitude_kp),
            ("amplitude_ki", gains.amplitude_ki),
            ("frequency_kp", gains.frequency_kp),
            ("frequency_ki", gains.frequency_ki),
        ] {
            let key = format!("controller.gains.{name}");
            self.f32_range(&key, value)?;
        }
        Ok(gains)
    }
}
