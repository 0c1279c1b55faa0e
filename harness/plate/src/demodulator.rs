//! Models the sensor's electronics in the carrier model: sampling converter and lock-in demodulator.
//!
//! The converter samples `y = Re(W e^{jθ})` at multiples of its own period, clips and rounds it. A
//! reading at the time t contains every sample up to t, and the one at t if there is one. Whole
//! numbers decide which samples these are. The demodulator multiplies each sample by `2 e^{−jθ}`, with the phase θ of the excitation. Its
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
    rate: SampleRate,
    /// Converter period, ns times 2⁶⁴, with the rounding of an f64.
    period: u128,
    spacing: f64,
    /// Number of the next sample. Sample k is at k converter periods after the start.
    next: u64,
    /// Products `2 y e^{−jθ}` of the last samples in a ring; the oldest is at `oldest`.
    products: Box<[Complex64]>,
    oldest: usize,
}

/// The converter's rate as a ratio of whole numbers: `samples/span_ns` per nanosecond.
#[derive(Debug, Clone, Copy)]
struct SampleRate {
    samples: u128,
    span_ns: u128,
}

impl SampleRate {
    /// Exact from 2⁻³⁷ Hz on. The rate is positive and at most 1e9 Hz.
    fn from_hz(hz: f64) -> Self {
        const MANTISSA: u64 = (1 << 52) - 1;
        let mantissa = (hz.to_bits() & MANTISSA) | (1 << 52);
        let shift = 1075_u32.saturating_sub((hz.to_bits() >> 52) as u32);
        // A rate in whole hertz needs no fraction.
        let excess = mantissa.trailing_zeros().min(shift).max(shift.saturating_sub(90));
        let samples = u128::from(mantissa.checked_shr(excess).unwrap_or(0));
        Self { samples, span_ns: 1_000_000_000 << (shift - excess) }
    }

    /// Number of samples after 0 up to and including `time`.
    const fn count_until(self, time: Time) -> u64 {
        (time.as_nanos() as u128 * self.samples / self.span_ns) as u64
    }

    const fn is_due(self, number: u64, time: Time) -> bool {
        number as u128 * self.span_ns <= time.as_nanos() as u128 * self.samples
    }
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
            rate: SampleRate::from_hz(lockin.converter_hz),
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
        if !self.rate.is_due(self.next, end) {
            return;
        }
        let first = u128::from(start.as_nanos()) << 64;
        let turn = Complex64::cis(omega * self.spacing);
        let steps = terms.map(|(_, pole)| (pole * self.spacing).exp());
        let mut left = self.rate.count_until(end) + 1 - self.next;
        while left > 0 {
            let since = (u128::from(self.next) * self.period).saturating_sub(first);
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
    use rstest::rstest;

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

    // 1e9/150 kHz rounds up, 1e9/450 kHz rounds down, 129 230.5 Hz is not a whole number.
    #[rstest]
    fn a_reading_contains_the_sample_at_its_instant(
        #[values(150e3, 180e3, 240e3, 300e3, 450e3, 600e3, 700e3, 900e3, 1e6, 1.2e6, 3e6, 6e6, 7e6, 9e6, 11e6)]
        converter_hz: f64,
        #[values(1, 2, 7)] periods: u32,
    ) {
        let flow = flow(Model::Modal);
        let (rest, terms) = flow.terms();
        let mut demodulator = Demodulator::new(lockin(converter_hz, periods), OMEGA);
        let (rate, mut now) = (PhaseRate::from_omega(OMEGA), Time::ZERO);
        for period in 1..=10_u64 {
            let end = Time::from_nanos(1_000_000 * period);
            // The terms are those of the start of the step.
            let here = terms.map(|(amplitude, pole)| (amplitude * (pole * now.seconds()).exp(), pole));
            demodulator.advance(rest, here, now, end, Phase::default().after(now, rate), OMEGA);
            assert_eq!(demodulator.samples(), period * converter_hz as u64 / 1_000 + 1);
            now = end;
        }
        // The newest sample has the age 0; the oldest counts in part.
        let window = f64::from(periods) * converter_hz * TAU / OMEGA;
        let product = |age: f64| {
            let seconds = now.seconds() - age / converter_hz;
            let carrier = Complex64::cis(OMEGA * seconds);
            2.0 * (flow.after(seconds).w * carrier).re * carrier.conj()
        };
        let whole: Complex64 = (0..window as u32).map(|age| product(f64::from(age))).sum();
        let expected = (whole + product(window.floor()) * window.fract()) / window;
        let apart = (demodulator.read(OMEGA) - expected).norm();
        assert!(apart < 1e-9, "{apart:e}");
    }

    #[rstest]
    #[case(129_230.5, 2_000_000_000, 258_461)]
    #[case(129_230.5, 1_999_999_999, 258_460)]
    #[case(1e9, 7, 7)]
    #[case(1e9, 9_007_199_254_740_992, 9_007_199_254_740_992)]
    #[case(1.0 / 3.0, 3_000_000_000, 0)]
    #[case(1.0 / 3.0, 3_000_000_001, 1)]
    #[case(1e-300, 9_007_199_254_740_992, 0)]
    fn whole_numbers_count_the_samples(#[case] hz: f64, #[case] nanos: u64, #[case] count: u64) {
        let (rate, time) = (SampleRate::from_hz(hz), Time::from_nanos(nanos));
        assert_eq!(rate.count_until(time), count);
        assert!(rate.is_due(count, time) && !rate.is_due(count + 1, time));
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
