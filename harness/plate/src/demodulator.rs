//! Models the sensor's electronics in the carrier model: sampling converter and lock-in demodulator.
//!
//! The converter samples `y = Re(W e^{jθ})` at multiples of its own period, clips and rounds it.
//! The demodulator multiplies each sample by `2 e^{−jθ}`, with the phase θ of the excitation. Its
//! output is the mean of these products over the last N carrier periods, which is W delayed by half
//! of this window. Before the start the plate is at rest.
//!
//! The window is N periods of the present excitation, L samples. If L is not an integer, the oldest
//! sample has a fractional weight. The error at twice the carrier frequency is then at most
//! `πN/2L²` of |W|; with whole samples it would be up to `1/2L`.

use crate::effect::{PlateError, check, missing, positive};
use crate::effects::{ConverterResolution, RawSensor};
use crate::flow::Term;
use crate::phase::Phase;
use crate::time::Time;
use num_complex::Complex64;
use std::array;
use std::f64::consts::TAU;

/// Number of samples after which the wave is evaluated directly. In between it is multiplied from
/// sample to sample, with an error of about 2e-16 per sample.
const REFRESH_INTERVAL: u32 = 64;
/// Largest window of the lock-in in samples, if the excitation is at the plate's resonance.
const MAX_WINDOW_SAMPLES: f64 = 1e6;
/// Smaller terms of W, in µm, become 0 as in `flow.rs`.
const NEGLIGIBLE: f64 = 1e-150;

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Lockin {
    pub converter_hz: f64,
    /// Window length in carrier periods.
    pub periods: u32,
    /// `None` if the converter neither rounds nor clips.
    pub resolution: Option<ConverterResolution>,
}

impl Lockin {
    pub(crate) fn check(table: &RawSensor, resonance_hz: f64) -> Result<Option<Self>, PlateError> {
        const PERIODS: &str = "sensor.demodulator_periods";
        const RATE: &str = "sensor.converter_hz";
        let Some(periods) = table.demodulator_periods else {
            let rate = table.converter_hz;
            check(rate.is_none(), RATE, &rate.unwrap_or(0.0), "the key `demodulator_periods` as well")?;
            return Ok(None);
        };
        check((1..=10_000).contains(&periods), PERIODS, &periods, "a whole number of carrier periods from 1 to 10000")?;
        let converter_hz = table
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
        let resolution = ConverterResolution::check(table)?;
        Ok(Some(Self { converter_hz, periods: periods as u32, resolution }))
    }

    fn convert(&self, y: f64) -> f64 {
        self.resolution.as_ref().map_or(y, |resolution| resolution.convert(y))
    }
}

#[derive(Debug, Clone)]
pub struct Demodulator {
    lockin: Lockin,
    /// Converter period, ns times 2⁶⁴.
    period: u128,
    spacing: f64,
    /// Number of the next sample. Sample k is at k converter periods after the start.
    next: u64,
    /// Products `2 y e^{−jθ}` of the last samples in a ring; the oldest is at `oldest`.
    products: Box<[Complex64]>,
    oldest: usize,
}

struct Wave<const N: usize> {
    rest: Complex64,
    parts: [Complex64; N],
    carrier: Complex64,
}

impl<const N: usize> Wave<N> {
    fn at(rest: Complex64, terms: [Term; N], phase: Phase, omega: f64, seconds: f64) -> Self {
        let parts = terms.map(|(amplitude, pole)| {
            let part = amplitude * (pole * seconds).exp();
            if part.norm() < NEGLIGIBLE { Complex64::ZERO } else { part }
        });
        Self { rest, parts, carrier: phase.rotation() * Complex64::cis(omega * seconds) }
    }

    fn value(&self) -> f64 {
        let w = self.parts.iter().fold(self.rest, |w, part| w + part);
        w.re * self.carrier.re - w.im * self.carrier.im
    }
}

impl Demodulator {
    /// Allocates a buffer for excitation frequencies of at least `omega`/2 rad/s. The other
    /// functions do not allocate.
    pub fn new(lockin: Lockin, omega: f64) -> Self {
        let longest = 2.0 * f64::from(lockin.periods) * lockin.converter_hz * TAU / omega;
        let period = 1e9 / lockin.converter_hz;
        Self {
            lockin,
            period: (period * 2.0_f64.powi(64)) as u128,
            spacing: period / 1e9,
            next: 0,
            products: vec![Complex64::ZERO; (longest.clamp(1.0, 4.0 * MAX_WINDOW_SAMPLES) as usize) + 2].into(),
            oldest: 0,
        }
    }

    pub fn samples(&self) -> u64 {
        self.next
    }

    /// Takes the samples up to and including `end`. From `start` on, W is
    /// `rest + Σ amplitude e^{pole t}`; `phase` is the carrier's phase at `start`.
    pub fn advance<const N: usize>(
        &mut self,
        rest: Complex64,
        terms: [Term; N],
        start: Time,
        end: Time,
        phase: Phase,
        omega: f64,
    ) {
        let period = self.period;
        let instant = |number: u64| u128::from(number) * period;
        let (first, last) = (u128::from(start.as_nanos()) << 64, u128::from(end.as_nanos()) << 64);
        if instant(self.next) > last {
            return;
        }
        let turn = Complex64::cis(omega * self.spacing);
        let steps = terms.map(|(_, pole)| (pole * self.spacing).exp());
        let mut left = ((last - instant(self.next)) / self.period) as u64 + 1;
        while left > 0 {
            let since = instant(self.next).saturating_sub(first);
            let seconds = since as f64 / (1e9 * 2.0_f64.powi(64));
            let mut wave = Wave::at(rest, terms, phase, omega, seconds);
            let count = left.min(u64::from(REFRESH_INTERVAL));
            for _ in 0..count {
                let product = 2.0 * self.lockin.convert(wave.value()) * wave.carrier.conj();
                self.push(product);
                wave.carrier *= turn;
                wave.parts = array::from_fn(|number| wave.parts[number] * steps[number]);
            }
            self.next += count;
            left -= count;
        }
    }

    fn push(&mut self, product: Complex64) {
        if let Some(place) = self.products.get_mut(self.oldest) {
            *place = product;
        }
        self.oldest += 1;
        if self.oldest == self.products.len() {
            self.oldest = 0;
        }
    }

    pub fn read(&self, omega: f64) -> Complex64 {
        let window = f64::from(self.lockin.periods) * self.lockin.converter_hz * TAU / omega.abs();
        // At least one sample, at most the whole buffer, also at ω = 0 (infinite window).
        let window = if window.is_nan() { 1.0 } else { window.clamp(1.0, (self.products.len() - 1) as f64) };
        let whole = window as usize;
        let (newer, older) = self.products.split_at(self.oldest.min(self.products.len()));
        let from_newer = whole.min(newer.len());
        let (before_newer, newer) = newer.split_at(newer.len() - from_newer);
        let (before_older, older) = older.split_at(older.len().saturating_sub(whole - from_newer));
        let sum: Complex64 = newer.iter().rev().chain(older.iter().rev()).sum();
        let next = before_newer.last().or(before_older.last());
        let partly = next.map_or(Complex64::ZERO, |sample| sample * window.fract());
        (sum + partly) / window
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::flow::{ExponentialSum, Flow, Model, State};
    use crate::mode::{Drive, Mode};
    use crate::phase::PhaseRate;

    const OMEGA: f64 = 203_540.0;

    fn flow(model: Model) -> Flow {
        let mode = Mode { sigma: 532.0, omega0: 202_995.0, force_constant: 1.5e6, envelope_constant: 3.71 };
        let u = if model == Model::Linear { 0.5 } else { 3e5 };
        let state = State { w: Complex64::new(1.0, 0.5), u: u.into() };
        Flow::new(model, &mode, &Drive { vpp: 300.0, omega: OMEGA }, &state)
    }

    fn lockin(converter_hz: f64, periods: u32) -> Lockin {
        Lockin { converter_hz, periods, resolution: None }
    }

    #[test]
    fn every_sample_equals_the_closed_form() {
        // The samples are at whole nanoseconds, so that the phase of each is exact.
        let converter_hz = 1.25e6;
        for model in Model::ALL {
            let flow = flow(model);
            let (_, [slow, other]) = flow.terms();
            assert!(model == Model::Envelope || other.0 != Complex64::ZERO);
            assert!(slow.1.re < 0.0);
            let mut demodulator = Demodulator::new(lockin(converter_hz, 2_000), OMEGA);
            let rate = PhaseRate::from_omega(OMEGA);
            let (mut now, end) = (Time::ZERO, Time::from_nanos(20_000_000));
            let mut piece = 1;
            let start_phase = Phase::default().after(Time::from_nanos(77), rate);
            while now < end {
                let next = (now + Time::from_nanos(piece)).min(end);
                let so_far = start_phase.after(now, rate);
                let state = flow.after(now.seconds());
                let mode = Mode { sigma: 532.0, omega0: 202_995.0, force_constant: 1.5e6, envelope_constant: 3.71 };
                let from_here = Flow::new(model, &mode, &Drive { vpp: 300.0, omega: OMEGA }, &state);
                let (rest, terms) = from_here.terms();
                demodulator.advance(rest, terms, now, next, so_far, OMEGA);
                (now, piece) = (next, piece * 3 % 2_345_678 + 1);
            }
            assert_eq!(demodulator.samples(), 25_001);
            let mut worst = 0.0_f64;
            for number in 0..25_001_u32 {
                let instant = Time::from_nanos(800 * u64::from(number));
                let theta = start_phase.after(instant, rate).rotation();
                let expected = 2.0 * (flow.after(instant.seconds()).w * theta).re * theta.conj();
                worst = worst.max((demodulator.products[number as usize] - expected).norm());
            }
            println!("{}: 25 001 samples in pieces against the closed form: {worst:.1e} µm", model.name());
            assert!(worst < 4e-12, "{}: {worst:e}", model.name());
        }
    }
}
