//! The sensor's electronics in the carrier tier: a sampling converter and a lock-in demodulator.
//!
//! The converter takes `y = Re(W e^{jθ})` at multiples of its own period, clips and rounds it. The demodulator multiplies each
//! sample by `2 e^{−jθ}` at once, with the phase that the excitation then has, and shows the mean of these products over the last N
//! carrier periods: W, late by half of that window. Before the start the plate was at rest.
//!
//! The window is N periods of the excitation at the instant of reading, L samples. Where L is no whole number, the oldest sample
//! counts in part, which leaves `πN/2L²` of |W| of the product at twice the carrier at most; a window cut to whole samples would
//! leave up to `1/2L`.

use crate::file::{PlateError, RawSensor, check, positive};
use crate::flow::Flow;
use crate::phase::Phase;
use crate::time::Time;
use num_complex::Complex64;
use std::f64::consts::TAU;

/// Samples from one direct evaluation to the next. Between two the converter's waveform moves on by complex multiplication, some
/// 2e-16 off per sample.
const REFRESH: u32 = 64;
/// Largest window, samples at the plate's resonance.
const LARGEST_WINDOW: f64 = 1e6;
/// Components smaller than this, in µm, are left out; see [`crate::flow`].
const NEGLIGIBLE: f64 = 1e-150;

/// What the converter's codes stand for.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Resolution {
    /// Bits of the converter, sign included, 2 to 32.
    pub bits: u32,
    /// The largest amplitude that is not clipped, µm peak to peak as all amplitudes.
    pub range_um: f64,
}

impl Resolution {
    /// The step between two codes, µm: 2^bits of them over twice the range.
    pub fn step_um(&self) -> f64 {
        self.range_um / f64::from(1_u32 << (self.bits - 1))
    }
}

/// A converter and a lock-in demodulator, as a plate file describes them.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Lockin {
    /// Samples per second.
    pub converter_hz: f64,
    /// Carrier periods in the window.
    pub periods: u32,
    /// `None`: the converter neither rounds nor clips.
    pub resolution: Option<Resolution>,
}

impl Lockin {
    /// The demodulator of `[sensor]`; `None` where there is none.
    pub(crate) fn check(raw: &RawSensor, resonance_hz: f64) -> Result<Option<Self>, PlateError> {
        const PERIODS: &str = "sensor.demodulator_periods";
        const RATE: &str = "sensor.converter_hz";
        const BITS: &str = "sensor.converter_bits";
        const RANGE: &str = "sensor.converter_range_um";
        let missing = |key, expected| PlateError { key, value: "missing".to_owned(), expected };
        let Some(periods) = raw.demodulator_periods else {
            check(
                raw.converter_hz.is_none(),
                RATE,
                &raw.converter_hz.unwrap_or(0.0),
                "`demodulator_periods` beside it",
            )?;
            check(
                raw.converter_bits.is_none(),
                BITS,
                &raw.converter_bits.unwrap_or(0),
                "`demodulator_periods` beside it",
            )?;
            let range = raw.converter_range_um;
            check(range.is_none(), RANGE, &range.unwrap_or(0.0), "`demodulator_periods` beside it")?;
            return Ok(None);
        };
        check((1..=10_000).contains(&periods), PERIODS, &periods, "a whole number of carrier periods from 1 to 10000")?;
        let converter_hz =
            raw.converter_hz.ok_or_else(|| missing(RATE, "the converter's rate beside `demodulator_periods`"))?;
        positive(RATE, converter_hz)?;
        check(
            converter_hz > 4.0 * resonance_hz,
            RATE,
            &converter_hz,
            "more than 4 samples per period of mode.resonance_hz",
        )?;
        check(converter_hz <= 1e9, RATE, &converter_hz, "at most 1e9, a sample per nanosecond")?;
        let window = periods as f64 * converter_hz / resonance_hz;
        check(window <= LARGEST_WINDOW, PERIODS, &periods, "a window of at most 1e6 samples of the converter")?;
        let resolution = match (raw.converter_bits, raw.converter_range_um) {
            (None, None) => None,
            (Some(_), None) => return Err(missing(RANGE, "the full scale beside `converter_bits`")),
            (None, Some(_)) => return Err(missing(BITS, "the resolution beside `converter_range_um`")),
            (Some(bits), Some(range)) => {
                check((2..=32).contains(&bits), BITS, &bits, "a whole number of bits from 2 to 32")?;
                Some(Resolution { bits: bits as u32, range_um: positive(RANGE, range)? })
            }
        };
        Ok(Some(Self { converter_hz, periods: periods as u32, resolution }))
    }

    /// How late W is seen at an excitation of `omega` rad/s, s: the mean age of the window's samples, the newest taken just now.
    pub fn latency(&self, omega: f64) -> f64 {
        (f64::from(self.periods) * TAU / omega - 1.0 / self.converter_hz) / 2.0
    }
}

/// A lock-in demodulator at work.
#[derive(Debug, Clone)]
pub struct Demodulator {
    lockin: Lockin,
    /// Converter period, ns times 2⁶⁴.
    period: u128,
    /// The same, s.
    spacing: f64,
    /// Number of the next sample; number k is taken k periods after the start.
    next: u64,
    /// `2 y e^{−jθ}` of the last samples, the oldest at `oldest`.
    products: Box<[Complex64]>,
    oldest: usize,
}

/// The waveform from a sample on, to be moved on sample by sample.
struct Wave {
    rest: Complex64,
    parts: [Complex64; 2],
    carrier: Complex64,
}

impl Wave {
    fn at(flow: &Flow, phase: Phase, omega: f64, seconds: f64) -> Self {
        let (rest, terms) = flow.parts();
        let parts = terms.map(|(amplitude, pole)| {
            let part = amplitude * (pole * seconds).exp();
            if part.norm() < NEGLIGIBLE { Complex64::ZERO } else { part }
        });
        Self { rest, parts, carrier: phase.rotation() * Complex64::cis(omega * seconds) }
    }

    /// y now.
    fn value(&self) -> f64 {
        let w = self.rest + self.parts[0] + self.parts[1];
        w.re * self.carrier.re - w.im * self.carrier.im
    }
}

impl Demodulator {
    /// The demodulator `lockin` on a plate that has been at rest, with room for carriers down to half of `omega` rad/s; below that
    /// the window no longer grows. The only allocation.
    pub fn new(lockin: Lockin, omega: f64) -> Self {
        let longest = 2.0 * f64::from(lockin.periods) * lockin.converter_hz * TAU / omega;
        let period = 1e9 / lockin.converter_hz;
        Self {
            lockin,
            period: (period * 2.0_f64.powi(64)) as u128,
            spacing: period / 1e9,
            next: 0,
            products: vec![Complex64::ZERO; (longest.clamp(1.0, 4.0 * LARGEST_WINDOW) as usize) + 2].into(),
            oldest: 0,
        }
    }

    /// How many samples have been taken.
    pub fn samples(&self) -> u64 {
        self.next
    }

    /// Takes the samples up to and at `end` of a plate that moves along `flow` from `start` on, where the carrier had `phase` and
    /// goes on with `omega` rad/s.
    pub fn advance(&mut self, flow: &Flow, start: Time, end: Time, phase: Phase, omega: f64) {
        let period = self.period;
        let instant = |number: u64| u128::from(number) * period;
        let (first, last) = (u128::from(start.as_nanos()) << 64, u128::from(end.as_nanos()) << 64);
        if instant(self.next) > last {
            return;
        }
        let (_, terms) = flow.parts();
        let turn = Complex64::cis(omega * self.spacing);
        let steps = terms.map(|(_, pole)| (pole * self.spacing).exp());
        let mut left = ((last - instant(self.next)) / self.period) as u64 + 1;
        while left > 0 {
            let since = instant(self.next).saturating_sub(first);
            let seconds = since as f64 / (1e9 * 2.0_f64.powi(64));
            let mut wave = Wave::at(flow, phase, omega, seconds);
            let count = left.min(u64::from(REFRESH));
            for _ in 0..count {
                let product = 2.0 * self.lockin.convert(wave.value()) * wave.carrier.conj();
                self.push(product);
                wave.carrier *= turn;
                wave.parts[0] *= steps[0];
                wave.parts[1] *= steps[1];
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

    /// W as the demodulator shows it while the excitation is `omega` rad/s, µm.
    pub fn read(&self, omega: f64) -> Complex64 {
        let window = f64::from(self.lockin.periods) * self.lockin.converter_hz * TAU / omega.abs();
        // A window without end, at ω = 0, is as long as there is room; one shorter than a sample is a sample.
        let window = if window.is_nan() { 1.0 } else { window.clamp(1.0, (self.products.len() - 1) as f64) };
        let whole = window as usize;
        let (newer, older) = self.products.split_at(self.oldest.min(self.products.len()));
        let mut newest_first = newer.iter().rev().chain(older.iter().rev());
        let sum: Complex64 = newest_first.by_ref().take(whole).sum();
        let partly = newest_first.next().map_or(Complex64::ZERO, |oldest| oldest * window.fract());
        (sum + partly) / window
    }
}

impl Lockin {
    fn convert(&self, y: f64) -> f64 {
        // Adding it leaves no room for a fraction: rounds to the nearest whole number, halves to even.
        const WHOLE: f64 = 6_755_399_441_055_744.0;
        let Some(resolution) = &self.resolution else { return y };
        let (step, codes) = (resolution.step_um(), f64::from(1_u32 << (resolution.bits - 1)));
        let code = (y / step).clamp(-codes, codes - 1.0);
        ((code + WHOLE) - WHOLE) * step
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::flow::State;
    use crate::mode::{Drive, Mode};
    use crate::phase::Rate;
    use crate::tier::Tier;

    const OMEGA: f64 = 203_540.0;

    fn flow(tier: Tier) -> Flow {
        let mode = Mode { sigma: 532.0, omega0: 202_995.0, force_constant: 1.5e6, envelope_constant: 3.71 };
        let u = if tier == Tier::Linear { 0.5 } else { 3e5 };
        let state = State { w: Complex64::new(1.0, 0.5), u: u.into() };
        Flow::new(tier, &mode, &Drive { vpp: 300.0, omega: OMEGA }, &state)
    }

    fn lockin(converter_hz: f64, periods: u32) -> Lockin {
        Lockin { converter_hz, periods, resolution: None }
    }

    /// In pieces of many lengths; each product against `2 Re(W e^{jθ}) e^{−jθ}` of the flow and the phase themselves.
    #[test]
    fn every_sample_is_the_closed_form() {
        // Samples on whole nanoseconds, so that the phase at each is known exactly.
        let converter_hz = 1.25e6;
        for tier in Tier::ALL {
            let flow = flow(tier);
            let (_, [slow, other]) = flow.parts();
            assert!(tier == Tier::Envelope || other.0 != Complex64::ZERO);
            assert!(slow.1.re < 0.0);
            // A window that holds them all.
            let mut demodulator = Demodulator::new(lockin(converter_hz, 2_000), OMEGA);
            let rate = Rate::of(OMEGA);
            let (mut now, end) = (Time::ZERO, Time::from_nanos(20_000_000));
            let mut piece = 1;
            let start_phase = Phase::default().after(Time::from_nanos(77), rate);
            while now < end {
                let next = (now + Time::from_nanos(piece)).min(end);
                let so_far = start_phase.after(now, rate);
                let state = flow.after(now.seconds());
                let mode = Mode { sigma: 532.0, omega0: 202_995.0, force_constant: 1.5e6, envelope_constant: 3.71 };
                let from_here = Flow::new(tier, &mode, &Drive { vpp: 300.0, omega: OMEGA }, &state);
                demodulator.advance(&from_here, now, next, so_far, OMEGA);
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
            println!("{}: 25 001 samples in pieces against the closed form: {worst:.1e} µm", tier.name());
            assert!(worst < 4e-12, "{}: {worst:e}", tier.name());
        }
    }
}
