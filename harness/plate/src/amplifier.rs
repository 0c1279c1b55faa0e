//! Models the amplifier: converter, dead time, slew rate, bandwidth, offset. The dead time delays
//! amplitude and frequency of a command; the other effects change the amplitude only.
//!
//! Without limits the output v equals the input u. With the bandwidth p and the slew rate S,
//! `v' = p (u − v)` with `|v'| ≤ S`. v is a ramp while `|u − v| > S/p` and then an exponential. u
//! is constant between commands, so each part has the closed form `c + s t + a e^{−pt}`. The ramp
//! ends on a whole nanosecond; the remaining change of v, below S · 1 ns, becomes a step. The
//! integral of v then has an error of at most S · (1 ns)²/2.

use crate::plate_error::{PlateError, check, finite, positive};
use crate::raw_plate::RawDrive;
use crate::time::Time;
use std::f64::consts::TAU;

/// Limit for the dead time of the amplifier and for the latency of the sensor, µs.
pub(crate) const MAX_DELAY_US: f64 = 1e5;

/// Smallest distance between output and input, Vpp. A smaller one becomes 0, as in `flow.rs`.
const NEGLIGIBLE_VPP: f64 = 1e-150;

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

/// Output of the amplifier, `constant + slope t + decaying e^{−rate t}`. `slope` is in Vpp/s,
/// `rate` in 1/s, the other fields are in Vpp.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(crate) struct Forcing {
    pub(crate) constant: f64,
    pub(crate) slope: f64,
    pub(crate) decaying: f64,
    pub(crate) rate: f64,
}

impl Forcing {
    pub(crate) fn at(&self, seconds: f64) -> f64 {
        self.constant + self.slope * seconds + self.decaying * (-self.rate * seconds).exp()
    }

    /// The same output with its time origin moved to `seconds`.
    pub(crate) fn from(&self, seconds: f64) -> Self {
        Self {
            constant: self.constant + self.slope * seconds,
            decaying: self.decaying * (-self.rate * seconds).exp(),
            ..*self
        }
    }
}

impl Amplifier {
    pub(crate) fn check(raw: &RawDrive) -> Result<Self, PlateError> {
        const DEAD_TIME: &str = "drive.dead_time_us";
        const OFFSET: &str = "drive.offset_vpp";
        const BANDWIDTH: &str = "drive.bandwidth_hz";
        let dead_time_us = finite(DEAD_TIME, raw.dead_time_us)?;
        check((0.0..=MAX_DELAY_US).contains(&dead_time_us), DEAD_TIME, &dead_time_us, "0 to 1e5 µs")?;
        let offset_vpp = finite(OFFSET, raw.offset_vpp)?;
        check(offset_vpp.abs() <= raw.limit_vpp, OFFSET, &offset_vpp, "at most drive.limit_vpp, with either sign")?;
        let bandwidth = raw.bandwidth_hz.map(|hz| positive(BANDWIDTH, hz)).transpose()?;
        if let Some(hz) = bandwidth {
            check(hz <= 1e9, BANDWIDTH, &hz, "at most 1e9")?;
        }
        let slew_rate =
            raw.slew_rate_vpp_per_ms.map(|rate| positive("drive.slew_rate_vpp_per_ms", rate)).transpose()?;
        Ok(Self {
            converter: drive_converter(raw)?,
            dead_time: Time::from_ms(dead_time_us / 1e3).unwrap_or_default(),
            pole: bandwidth.map(|hz| TAU * hz),
            slew_rate: slew_rate.map(|rate| 1e3 * rate),
            offset_vpp,
        })
    }

    pub(crate) fn converter_output(&self, vpp: f64) -> f64 {
        let Some(converter) = &self.converter else { return vpp };
        let step = converter.step_vpp();
        (vpp.clamp(0.0, converter.range_vpp) / step).round() * step
    }

    /// Output from the amplitude `vpp` (without offset) towards `input`. The time is the duration
    /// of this segment; `None` if no other segment follows.
    pub(crate) fn segment(&self, vpp: f64, input: f64) -> (Forcing, Option<Time>) {
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

fn drive_converter(raw: &RawDrive) -> Result<Option<DriveConverter>, PlateError> {
    const BITS: &str = "drive.converter_bits";
    const RANGE: &str = "drive.converter_range_vpp";
    let missing = |key, expected| Err(PlateError { key, value: "missing".to_owned(), expected });
    match (raw.converter_bits, raw.converter_range_vpp) {
        (None, None) => Ok(None),
        (Some(_), None) => missing(RANGE, "the amplitude of the highest code, since `converter_bits` is given"),
        (None, Some(_)) => missing(BITS, "the resolution, since `converter_range_vpp` is given"),
        (Some(bits), Some(range)) => {
            check((2..=32).contains(&bits), BITS, &bits, "a whole number of bits from 2 to 32")?;
            let range_vpp = positive(RANGE, range)?;
            let reaches = range_vpp >= raw.limit_vpp;
            check(reaches, RANGE, &range_vpp, "at least drive.limit_vpp; lower the limit if the converter has less")?;
            Ok(Some(DriveConverter { bits: bits as u32, range_vpp }))
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
