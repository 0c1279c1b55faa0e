//! Models the amplifier: converter, dead time, slew rate, bandwidth, offset. The dead time delays
//! amplitude and frequency of a command; the other effects change the amplitude only.
//!
//! Without limits the output v equals the input u. With the bandwidth p and the slew rate S,
//! `v' = p (u − v)` with `|v'| ≤ S`. v is a ramp while `|u − v| > S/p` and then an exponential. u
//! is constant between commands, so each part has the closed form `c + s t + a e^{−pt}`. The ramp
//! ends on a whole nanosecond; the remaining change of v, below S · 1 ns, becomes a step. The
//! integral of v then has an error of at most S · (1 ns)²/2.

use crate::effect::{ActiveEffect, Effect, MAX_DELAY_US, PlateError, Step, check, converter, delay, finite, positive};
use crate::flow::Forcing;
use crate::mode::Drive;
use crate::time::Time;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::collections::VecDeque;
use std::f64::consts::TAU;

/// Smallest distance between output and input, Vpp. A smaller one becomes 0, as in `flow.rs`.
const NEGLIGIBLE_VPP: f64 = 1e-150;

/// `[drive]`
#[derive(Debug, Clone, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
#[schemars(extend("dependentRequired" = {
    "converter_bits": ["converter_range_vpp"],
    "converter_range_vpp": ["converter_bits"],
}))]
pub struct RawDrive {
    /// Highest drive of the amplifier, Vpp.
    #[schemars(extend("exclusiveMinimum" = 0))]
    pub limit_vpp: f64,
    /// Bits of the converter that sets the drive's amplitude. Drives are not rounded without this
    /// key.
    #[schemars(range(min = 2, max = 32))]
    pub converter_bits: Option<i64>,
    /// Amplitude of the converter's highest code, at least `limit_vpp`, Vpp.
    #[schemars(extend("exclusiveMinimum" = 0))]
    pub converter_range_vpp: Option<f64>,
    /// First-order bandwidth (−3 dB) of the drive's amplitude, Hz; unlimited by default.
    #[schemars(extend("exclusiveMinimum" = 0), range(max = 1e9))]
    pub bandwidth_hz: Option<f64>,
    /// Largest change of the drive's amplitude, Vpp/ms; unlimited by default.
    #[schemars(extend("exclusiveMinimum" = 0))]
    pub slew_rate_vpp_per_ms: Option<f64>,
    /// Delay of a command (amplitude and frequency) on its way to the amplifier, µs.
    #[serde(default)]
    #[schemars(range(min = 0.0, max = MAX_DELAY_US))]
    pub dead_time_us: f64,
    /// Constant amplitude that the amplifier adds to every drive, also to 0 Vpp, Vpp.
    #[serde(default)]
    pub offset_vpp: f64,
}

/// Converter of the drive's amplitude: 2^bits codes from 0 to `range_vpp`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DriveConverter {
    pub bits: u32,
    pub range_vpp: f64,
}

impl DriveConverter {
    pub fn step_vpp(&self) -> f64 {
        self.range_vpp / (2.0_f64.powi(self.bits.cast_signed()) - 1.0)
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Amplifier {
    pub converter: Option<DriveConverter>,
    pub dead_time: Time,
    /// Pole p = 2π · bandwidth, 1/s.
    pub pole: Option<f64>,
    /// Slew rate S, Vpp/s.
    pub slew_rate: Option<f64>,
    pub offset_vpp: f64,
}

#[derive(Debug, Clone)]
struct ActiveAmplifier {
    amplifier: Amplifier,
    /// Last command, which may be in `pending`.
    command: Drive,
    /// Commands in the dead time, each with the time at which it acts.
    pending: VecDeque<(Time, Drive)>,
    /// Output without offset.
    output_vpp: f64,
}

impl Effect for Amplifier {
    type Table = RawDrive;

    fn check(table: &RawDrive) -> Result<Self, PlateError> {
        const OFFSET: &str = "drive.offset_vpp";
        const BANDWIDTH: &str = "drive.bandwidth_hz";
        const RANGE: &str = "drive.converter_range_vpp";
        let dead_time = delay("drive.dead_time_us", table.dead_time_us)?;
        let offset_vpp = finite(OFFSET, table.offset_vpp)?;
        check(offset_vpp.abs() <= table.limit_vpp, OFFSET, &offset_vpp, "at most drive.limit_vpp, with either sign")?;
        let bandwidth = table.bandwidth_hz.map(|hz| positive(BANDWIDTH, hz)).transpose()?;
        if let Some(hz) = bandwidth {
            check(hz <= 1e9, BANDWIDTH, &hz, "at most 1e9")?;
        }
        let slew_rate =
            table.slew_rate_vpp_per_ms.map(|rate| positive("drive.slew_rate_vpp_per_ms", rate)).transpose()?;
        let converter = converter(["drive.converter_bits", RANGE], table.converter_bits, table.converter_range_vpp)?;
        let converter = converter.map(|(bits, range_vpp)| DriveConverter { bits, range_vpp });
        if let Some(DriveConverter { range_vpp, .. }) = converter {
            let reaches = range_vpp >= table.limit_vpp;
            check(reaches, RANGE, &range_vpp, "at least drive.limit_vpp; lower the limit if the converter has less")?;
        }
        let pole = bandwidth.map(|hz| TAU * hz);
        Ok(Self { converter, dead_time, pole, slew_rate: slew_rate.map(|rate| 1e3 * rate), offset_vpp })
    }

    fn key(&self) -> Option<&'static str> {
        let Self { converter, dead_time, pole, slew_rate, offset_vpp } = *self;
        let keys = [
            ("drive.converter_bits", converter.is_some()),
            ("drive.bandwidth_hz", pole.is_some()),
            ("drive.slew_rate_vpp_per_ms", slew_rate.is_some()),
            ("drive.dead_time_us", dead_time > Time::ZERO),
            ("drive.offset_vpp", offset_vpp != 0.0),
        ];
        keys.into_iter().find(|(_, given)| *given).map(|(key, _)| key)
    }

    fn start(&self) -> Option<Box<dyn ActiveEffect>> {
        let pending = VecDeque::with_capacity(64);
        Some(Box::new(ActiveAmplifier { amplifier: *self, command: Drive::default(), pending, output_vpp: 0.0 }))
    }
}

impl ActiveEffect for ActiveAmplifier {
    /// The first command acts at once.
    fn receive(&mut self, drive: Drive, now: Time) -> Option<Drive> {
        let is_first = self.command == Drive::default();
        self.command = drive;
        if is_first || self.amplifier.dead_time == Time::ZERO {
            return Some(drive);
        }
        let at = now + self.amplifier.dead_time;
        match self.pending.back_mut() {
            Some(last) if last.0 == at => last.1 = drive,
            _ => self.pending.push_back((at, drive)),
        }
        None
    }

    fn release(&mut self, now: Time) -> Option<Drive> {
        self.pending.pop_front_if(|(at, _)| *at <= now).map(|(_, drive)| drive)
    }

    fn shape(&self, input: Forcing, now: Time) -> (Forcing, Option<Time>) {
        let (output, span) = self.amplifier.segment(self.output_vpp, self.amplifier.converter_output(input.constant));
        let ends = [self.pending.front().map(|(at, _)| *at), span.map(|span| now + span)];
        (output, ends.into_iter().flatten().min())
    }

    fn finish(&mut self, step: &Step<'_>) {
        self.output_vpp = step.forcing.at(step.seconds) - self.amplifier.offset_vpp;
    }
}

impl Amplifier {
    fn converter_output(&self, vpp: f64) -> f64 {
        let Some(converter) = &self.converter else { return vpp };
        let step = converter.step_vpp();
        (vpp.clamp(0.0, converter.range_vpp) / step).round() * step
    }

    /// Output from the amplitude `vpp` (without offset) towards `input`. The time is the duration
    /// of this segment; `None` if no other segment follows.
    fn segment(&self, vpp: f64, input: f64) -> (Forcing, Option<Time>) {
        let distance = input - vpp;
        let settled = Forcing { constant: input + self.offset_vpp, ..Forcing::default() };
        if let Some(slew_rate) = self.slew_rate {
            let exponential_below = self.pole.map_or(0.0, |pole| slew_rate / pole);
            let nanos = ((distance.abs() - exponential_below) / slew_rate * 1e9) as u64;
            if nanos > 0 {
                let slope = slew_rate.copysign(distance);
                let ramp = Forcing { constant: vpp + self.offset_vpp, slope, ..Forcing::default() };
                return (ramp, Some(Time::from_nanos(nanos)));
            }
        }
        match self.pole {
            Some(rate) if distance.abs() > NEGLIGIBLE_VPP => (Forcing { decaying: -distance, rate, ..settled }, None),
            _ => (settled, None),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn output(amplifier: &Amplifier, mut vpp: f64, input: f64, seconds: f64) -> f64 {
        let mut left = Time::from_seconds(seconds).unwrap();
        loop {
            let (forcing, span) = amplifier.segment(vpp, input);
            match span {
                Some(span) if span < left => {
                    vpp = forcing.at(span.seconds()) - amplifier.offset_vpp;
                    left = left - span;
                }
                _ => return forcing.at(left.seconds()),
            }
        }
    }

    #[test]
    fn a_slew_rate_and_a_bandwidth_follow_each_other() {
        let (slew_rate, pole) = (1e6, 1e4);
        let amplifier = Amplifier { pole: Some(pole), slew_rate: Some(slew_rate), ..Amplifier::default() };
        // A step of 300 Vpp: a ramp of 200 µs to a distance of 100 Vpp, then e^{−t/100 µs}.
        for (us, expected) in [(100.0, 100.0), (200.0, 200.0), (300.0, 300.0 - 100.0 / 1.0_f64.exp())] {
            let found = output(&amplifier, 0.0, 300.0, us * 1e-6);
            assert!((found - expected).abs() < 1e-9, "{us} µs: {found}");
            let falling = output(&amplifier, 300.0, 0.0, us * 1e-6);
            assert!((300.0 - falling - expected).abs() < 1e-9, "{us} µs: {falling}");
        }
    }

    #[test]
    fn an_offset_is_added_to_every_output() {
        let amplifier = Amplifier { slew_rate: Some(1e6), offset_vpp: -3.0, ..Amplifier::default() };
        assert_eq!(output(&amplifier, 0.0, 100.0, 50e-6), 47.0);
        assert_eq!(output(&amplifier, 0.0, 100.0, 1.0), 97.0);
        assert_eq!(output(&amplifier, 0.0, 0.0, 1.0), -3.0);
    }

    #[test]
    fn a_converter_rounds_to_its_codes_and_reaches_its_range() {
        let converter = Some(DriveConverter { bits: 10, range_vpp: 1023.0 });
        let amplifier = Amplifier { converter, ..Amplifier::default() };
        for (vpp, code) in [(0.0, 0.0), (0.49, 0.0), (0.51, 1.0), (286.5, 287.0), (1023.0, 1023.0), (2e3, 1023.0)] {
            assert_eq!(amplifier.converter_output(vpp), code);
        }
    }
}
