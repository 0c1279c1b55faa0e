//! Checks the sensor's converter and lock-in demodulator.

use crate::plate_error::{PlateError, check, positive};
use crate::raw_plate::RawSensor;

/// Largest window of the lock-in in samples, if the excitation is at the plate's resonance.
pub(crate) const MAX_WINDOW_SAMPLES: f64 = 1e6;
/// Constant 1.5 · 2⁵². Adding and subtracting it rounds to the nearest integer, ties to even.
const ROUNDING_OFFSET: f64 = 6_755_399_441_055_744.0;

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ConverterResolution {
    /// Number of bits from 2 to 32, including the sign bit.
    pub bits: u32,
    /// Largest peak-to-peak amplitude that the converter does not clip.
    pub range_um: f64,
}

impl ConverterResolution {
    pub(crate) fn check(raw: &RawSensor) -> Result<Option<Self>, PlateError> {
        const BITS: &str = "sensor.converter_bits";
        const RANGE: &str = "sensor.converter_range_um";
        let missing = |key, expected| Err(PlateError { key, value: "missing".to_owned(), expected });
        match (raw.converter_bits, raw.converter_range_um) {
            (None, None) => Ok(None),
            (Some(_), None) => missing(RANGE, "the full scale, since `converter_bits` is given"),
            (None, Some(_)) => missing(BITS, "the resolution, since `converter_range_um` is given"),
            (Some(bits), Some(range)) => {
                check((2..=32).contains(&bits), BITS, &bits, "a whole number of bits from 2 to 32")?;
                Ok(Some(Self { bits: bits as u32, range_um: positive(RANGE, range)? }))
            }
        }
    }

    pub(crate) fn convert(&self, y: f64) -> f64 {
        let (step, codes) = (self.step_um(), f64::from(1_u32 << (self.bits - 1)));
        let code = (y / step).clamp(-codes, codes - 1.0);
        ((code + ROUNDING_OFFSET) - ROUNDING_OFFSET) * step
    }

    pub fn step_um(&self) -> f64 {
        self.range_um / f64::from(1_u32 << (self.bits - 1))
    }
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Lockin {
    pub converter_hz: f64,
    /// Window length in carrier periods.
    pub periods: u32,
    /// `None` if the converter neither rounds nor clips.
    pub resolution: Option<ConverterResolution>,
}

impl Lockin {
    pub(crate) fn check(raw: &RawSensor, resonance_hz: f64) -> Result<Option<Self>, PlateError> {
        const PERIODS: &str = "sensor.demodulator_periods";
        const RATE: &str = "sensor.converter_hz";
        let missing = |key, expected| PlateError { key, value: "missing".to_owned(), expected };
        let Some(periods) = raw.demodulator_periods else {
            let rate = raw.converter_hz;
            check(rate.is_none(), RATE, &rate.unwrap_or(0.0), "the key `demodulator_periods` as well")?;
            return Ok(None);
        };
        check((1..=10_000).contains(&periods), PERIODS, &periods, "a whole number of carrier periods from 1 to 10000")?;
        let converter_hz = raw
            .converter_hz
            .ok_or_else(|| missing(RATE, "the converter's rate, since `demodulator_periods` is given"))?;
        positive(RATE, converter_hz)?;
        check(
            converter_hz > 4.0 * resonance_hz,
            RATE,
            &converter_hz,
            "more than 4 samples per period of mode.resonance_hz",
        )?;
        check(converter_hz <= 1e9, RATE, &converter_hz, "at most 1e9, a sample per nanosecond")?;
        let window = periods as f64 * converter_hz / resonance_hz;
        check(window <= MAX_WINDOW_SAMPLES, PERIODS, &periods, "a window of at most 1e6 samples of the converter")?;
        let resolution = ConverterResolution::check(raw)?;
        Ok(Some(Self { converter_hz, periods: periods as u32, resolution }))
    }

    pub(crate) fn convert(&self, y: f64) -> f64 {
        self.resolution.as_ref().map_or(y, |resolution| resolution.convert(y))
    }
}
