//! Defines the interface of an optional effect of the plate: its table in the plate file, and its
//! functions during a trial. Each has a default without an effect.

use crate::flow::{Forcing, Term};
use crate::mode::Drive;
use crate::motion::Motion;
use crate::time::Time;
use num_complex::Complex64;
use std::f64::consts::TAU;
use std::fmt::Debug;

/// Largest resonance. The protocol encodes the frequency in mHz with 32 bits, at most 4.3 MHz. The
/// rest is for a frequency range above the resonance.
pub(crate) const HIGHEST_RESONANCE_HZ: f64 = 2.5e6;
/// Limit for the dead time of the amplifier and for the latency of the sensor, µs.
pub(crate) const MAX_DELAY_US: f64 = 1e5;

/// An effect with the numbers of the plate file, in the units of the equations.
pub(crate) trait Effect {
    /// Table of the plate file.
    type Table
    where
        Self: Sized;

    fn check(table: &Self::Table) -> Result<Self, PlateError>
    where
        Self: Sized;

    /// First key of the plate file that causes the effect; `None` without effect.
    fn key(&self) -> Option<&'static str>;

    /// Start of a trial with this effect; `None` if no function of [`ActiveEffect`] differs from its
    /// default.
    fn start(&self) -> Option<Box<dyn ActiveEffect>> {
        None
    }
}

impl<E: Effect> Effect for Option<E> {
    type Table = Option<E::Table>;

    fn check(table: &Self::Table) -> Result<Self, PlateError> {
        table.as_ref().map(E::check).transpose()
    }

    fn key(&self) -> Option<&'static str> {
        self.as_ref().and_then(Effect::key)
    }

    fn start(&self) -> Option<Box<dyn ActiveEffect>> {
        self.as_ref().and_then(Effect::start)
    }
}

/// A step whose motion is known.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Step<'a> {
    pub(crate) start: Time,
    pub(crate) seconds: f64,
    pub(crate) forcing: &'a Forcing,
    pub(crate) motion: &'a Motion,
}

/// An effect during a trial. A step ends at each command and where [`Self::shape`] ends it.
pub(crate) trait ActiveEffect: BoxedClone + Debug + Send + Sync {
    /// Receives a command of the controller; `None` if it does not act yet.
    fn receive(&mut self, drive: Drive, _now: Time) -> Option<Drive> {
        Some(drive)
    }

    /// Returns a received command that acts from `now` on.
    fn release(&mut self, _now: Time) -> Option<Drive> {
        None
    }

    /// Changes the amplitude of the drive from `now` on. The time is its end, if it has one.
    fn shape(&self, input: Forcing, _now: Time) -> (Forcing, Option<Time>) {
        (input, None)
    }

    /// Amount that the effect adds to the temperature offset at start, middle and end of the
    /// present step, K. Between two steps, all three are the present amount.
    fn temperature_rise_k(&self) -> [f64; 3] {
        [0.0; 3]
    }

    /// Upper bound on the change of the temperature rise while |W| is at most `amplitude` µm, K/s.
    fn max_warming(&self, _amplitude: f64) -> f64 {
        0.0
    }

    /// Computes the temperature rise at the middle and at the end of a step, in s from its start.
    /// `terms` are W with the modes of the middle, in the frame of `omega`.
    fn predict(&mut self, _terms: &[Term], _omega: f64, _middle: f64, _end: f64) {}

    /// Corrects the prediction by the errors of |W|² at a quarter, the half and the end of a step.
    fn correct(&mut self, _errors: [f64; 3], _seconds: f64) {}

    fn finish(&mut self, _step: &Step<'_>) {}

    /// Reading of the sensor at `now`; `w` without this effect.
    fn read(&self, w: Complex64, _now: Time) -> Complex64 {
        w
    }
}

/// `Clone` for trait objects.
pub(crate) trait BoxedClone {
    fn boxed_clone(&self) -> Box<dyn ActiveEffect>;
}

impl<E: ActiveEffect + Clone + 'static> BoxedClone for E {
    fn boxed_clone(&self) -> Box<dyn ActiveEffect> {
        Box::new(self.clone())
    }
}

impl Clone for Box<dyn ActiveEffect> {
    fn clone(&self) -> Self {
        self.boxed_clone()
    }
}

/// An invalid number of a plate file.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("`{key}` is {value}, expected {expected}")]
pub struct PlateError {
    pub key: &'static str,
    pub value: String,
    pub expected: &'static str,
}

pub(crate) fn check(
    holds: bool,
    key: &'static str,
    value: &impl ToString,
    expected: &'static str,
) -> Result<(), PlateError> {
    if holds { Ok(()) } else { Err(PlateError { key, value: value.to_string(), expected }) }
}

pub(crate) fn positive(key: &'static str, value: f64) -> Result<f64, PlateError> {
    check(value.is_finite() && value > 0.0, key, &value, "a finite number above 0").map(|()| value)
}

pub(crate) fn finite(key: &'static str, value: f64) -> Result<f64, PlateError> {
    check(value.is_finite(), key, &value, "a finite number").map(|()| value)
}

pub(crate) fn missing(key: &'static str, expected: &'static str) -> PlateError {
    PlateError { key, value: "missing".to_owned(), expected }
}

/// A delay of at most [`MAX_DELAY_US`] with the unit µs.
pub(crate) fn delay(key: &'static str, micros: f64) -> Result<Time, PlateError> {
    finite(key, micros)?;
    check((0.0..=MAX_DELAY_US).contains(&micros), key, &micros, "0 to 1e5 µs")?;
    Ok(Time::from_ms(micros / 1e3).unwrap_or_default())
}

/// Resonance ω0 in rad/s and damping σ0 in 1/s of a mode with an oscillation.
pub(crate) fn resonance(
    [hz_key, ms_key]: [&'static str; 2],
    resonance_hz: f64,
    time_constant_ms: f64,
) -> Result<(f64, f64), PlateError> {
    positive(hz_key, resonance_hz)?;
    check(
        resonance_hz <= HIGHEST_RESONANCE_HZ,
        hz_key,
        &resonance_hz,
        "at most 2.5e6: the wire carries the excitation frequency in millihertz",
    )?;
    let omega0 = resonance_hz * TAU;
    let sigma0 = 1e3 / positive(ms_key, time_constant_ms)?;
    let oscillates = omega0 / (2.0 * sigma0) > 1.0;
    check(oscillates, ms_key, &time_constant_ms, "a time constant with Q = π · resonance_hz · τ above 1")?;
    Ok((omega0, sigma0))
}

/// Bits and range of a converter; both keys or none are given.
pub(crate) fn converter(
    [bits_key, range_key]: [&'static str; 2],
    bits: Option<i64>,
    range: Option<f64>,
) -> Result<Option<(u32, f64)>, PlateError> {
    match (bits, range) {
        (None, None) => Ok(None),
        (Some(_), None) => Err(missing(range_key, "the converter's range, since `converter_bits` is given")),
        (None, Some(_)) => Err(missing(bits_key, "the converter's resolution, since its range is given")),
        (Some(bits), Some(range)) => {
            check((2..=32).contains(&bits), bits_key, &bits, "a whole number of bits from 2 to 32")?;
            Ok(Some((bits as u32, positive(range_key, range)?)))
        }
    }
}
