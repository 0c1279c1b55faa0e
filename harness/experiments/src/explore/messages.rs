//! Draws single messages of sequences.

use crate::explore::sequence::SequenceDraw;
use platebench_model::scenario::{ConfigurationChange, NonFinite, ScenarioMessage, WireNumber};
use platebench_wire::LawId;
use std::ops::RangeInclusive;

/// Watchdog timeout of trials that do not test it, ms; shorter ones only in simulated time.
const LONG_TIMEOUTS_MS: [u16; 7] = [1_000, 1_023, 1_024, 32_767, 32_768, 40_000, 65_535];
/// Ends of the range, and numbers that `f32` misses, most by more than the tolerance of 5 mHz.
const START_FREQUENCIES_MHZ: [u32; 6] = [1, u32::MAX, (1 << 27) + 8, (1 << 30) + 64, (1 << 26) + 4, 0xaaaa_aaab];
/// Frequency range, Hz, that permits the start frequency only.
const SMALLEST_RANGE_HZ: f32 = 0.001;
/// A usable configuration except for a loop delay of 0 with bit 2.
const ZERO_DELAY: &str = "135a0104 0000e803 000090f9 ec017cb8 e43b556a f63a0000 00000000 61440000 7a430000 \
                          c8420000 00000000 00000000 00000000 00000000 0000";
/// Lengths of garbage, around the longest frame of 70 bytes.
const GARBAGE_BYTES: [usize; 6] = [1, 24, 69, 70, 71, 200];
/// Gains of the usual configurations.
pub(crate) const GAINS: [f32; 4] = [275.0, 110_000.0, 900.0, 400_000.0];
pub(crate) const DAMAGED: ScenarioMessage = ScenarioMessage::Damaged { byte: 5 };

/// No change of the configuration.
pub(crate) const NONE: ConfigurationChange = ConfigurationChange {
    law: None,
    watchdog_timeout_ms: None,
    period_us: None,
    start_frequency_mhz: None,
    gain_um_per_vpp: None,
    time_constant_s: None,
    response_time_s: None,
    drive_limit_vpp: None,
    frequency_range_hz: None,
    frequency_slew_hz: None,
    gains: None,
    loop_delay_us: None,
    paced_by_target: false,
    own_plate: false,
};

pub(crate) const fn configure(change: ConfigurationChange) -> ScenarioMessage {
    ScenarioMessage::Configure(change)
}

pub(crate) fn number(value: f32) -> WireNumber {
    WireNumber::from(value)
}

impl SequenceDraw<'_> {
    pub(crate) fn thousandths(&mut self, range: RangeInclusive<i32>) -> f32 {
        self.choices.integer(range) as f32 / 1e3
    }

    pub(crate) fn sample(&mut self) -> ScenarioMessage {
        let setpoint = self.choices.pick(&[2.0, 0.5, 4.0, 2.0, 0.0], 2.0);
        let scale = f32::max(setpoint, 0.5);
        ScenarioMessage::sample(setpoint, self.thousandths(0..=1_100) * scale, self.thousandths(-400..=400) * scale)
    }

    pub(crate) fn not_finite(&mut self) -> ScenarioMessage {
        let mut values = [2.0, 1.2, -0.2];
        let value = self.choices.pick(&[f32::NAN, f32::INFINITY, f32::NEG_INFINITY], f32::NAN);
        let at = self.choices.below(3);
        values.get_mut(at).into_iter().for_each(|place| *place = value);
        let [setpoint, wd, wq] = values;
        ScenarioMessage::sample(setpoint, wd, wq)
    }

    pub(crate) fn usable(&mut self) -> ConfigurationChange {
        let is_other = self.limits.laws.len() > 1 && self.choices.one_in(4);
        let law = is_other.then(|| self.choices.pick(&self.limits.laws, LawId::OpenLoop) as u8);
        let gains = self.choices.one_in(2).then(|| GAINS.map(number));
        ConfigurationChange { law, gains, ..NONE }
    }

    /// A configuration with an accepted value at a boundary of one field.
    pub(crate) fn at_boundary(&mut self, kind: usize) -> ConfigurationChange {
        let mut change = self.usable();
        match kind {
            0 => change.watchdog_timeout_ms = Some(self.choices.pick(&LONG_TIMEOUTS_MS, 1_000)),
            1 => change.period_us = Some(self.choices.pick(&[255, 256, 300, 4_000, 16_383, 20_000], 300)),
            2 => {
                let start = self.choices.pick(&START_FREQUENCIES_MHZ, 1);
                change.start_frequency_mhz = Some(start);
                // The frequencies of the commands are then known, whatever the law is. At the ends of the
                // field they may leave it.
                let is_end = [1, u32::MAX].contains(&start);
                change.frequency_range_hz = (!is_end).then(|| number(SMALLEST_RANGE_HZ));
            }
            3 => change.drive_limit_vpp = Some(self.one_number(&[0.125, 1.0, 6_553.5, 65_536.25, 1e6])),
            4 => change.frequency_range_hz = Some(self.one_number(&[0.001, 0.05, 3.75, 65.536, 5_000.0])),
            5 => change.frequency_slew_hz = Some(self.one_number(&[0.001, 0.014, 1.6, 65.536, 5_000.0])),
            6 => change.response_time_s = Some(self.one_number(&[0.0, 0.000_9, 0.008])),
            7 => {
                let gains = self.choices.pick(&[[0.0; 4], [275.0, 0.0, -900.0, 0.0]], [0.0; 4]);
                change.gains = Some(gains.map(number));
            }
            _ if self.limits.has_loop_delay => {
                let period = self.choices.pick(&[1_000, 3_000], 1_000);
                let delays = [1, period / 20, period / 12, period, period / 3, period];
                (change.period_us, change.gains) = (Some(period), None);
                change.loop_delay_us = Some(self.choices.pick(&delays, 1));
            }
            _ => change.watchdog_timeout_ms = Some(u16::MAX),
        }
        change
    }

    fn one_number(&mut self, all: &[f32]) -> WireNumber {
        number(self.choices.pick(all, 0.0))
    }

    fn no_positive_number(&mut self) -> WireNumber {
        self.one_number(&[0.0, -0.0, -1.0, f32::NAN, f32::INFINITY, f32::NEG_INFINITY])
    }

    /// A configuration that the controller must answer with 1.
    pub(crate) fn unusable(&mut self) -> ScenarioMessage {
        let mut change = NONE;
        match self.choices.below(11) {
            0 => change.period_us = Some(0),
            1 => change.start_frequency_mhz = Some(0),
            2 => change.gain_um_per_vpp = Some(self.no_positive_number()),
            3 => change.time_constant_s = Some(self.no_positive_number()),
            4 => change.drive_limit_vpp = Some(self.no_positive_number()),
            5 => change.frequency_range_hz = Some(self.no_positive_number()),
            6 => change.frequency_slew_hz = Some(self.no_positive_number()),
            8 if self.limits.has_loop_delay => {
                let period = self.choices.pick(&[1_000, 300, 4_000], 1_000);
                (change.period_us, change.loop_delay_us) = (Some(period), Some(period + 1));
            }
            9 if !self.limits.has_own_plate => change.own_plate = true,
            8..=10 if !self.limits.is_own_law => {
                let mut gains = GAINS.map(number);
                let wrong = [NonFinite::Nan, NonFinite::Infinity, NonFinite::NegativeInfinity];
                let wrong = self.choices.pick(&wrong, NonFinite::Nan);
                let at = self.choices.below(4);
                gains.get_mut(at).into_iter().for_each(|place| *place = WireNumber::NonFinite(wrong));
                change.gains = Some(gains);
            }
            _ => change.response_time_s = Some(self.one_number(&[-0.001, f32::NAN, f32::INFINITY])),
        }
        configure(change)
    }

    /// A frame that the controller rejects.
    pub(crate) fn rejected(&mut self) -> ScenarioMessage {
        let zeros = |first: &str, count: usize| ScenarioMessage::Body { hex: format!("{first}{}", "00".repeat(count)) };
        match self.choices.weighted(&[2, 1, 1, 1, 1, 1, 1, 1, 1]) {
            0 => ScenarioMessage::Damaged { byte: self.choices.integer(0..=22) as u8 },
            1 => {
                let count = self.choices.pick(&GARBAGE_BYTES, 24);
                ScenarioMessage::Bytes { hex: format!("{}00", "07".repeat(count)) }
            }
            2 => zeros(self.choices.pick(&["055a", "255a", "f55a"], "255a"), 16),
            3 => zeros(self.choices.pick(&["105a", "1c5a", "1f5a"], "1c5a"), self.choices.below(18)),
            4 => zeros("155a", self.choices.pick(&[0, 15, 17, 40], 15)),
            5 => zeros("175a", 1),
            6 => zeros("115a", self.choices.pick(&[1, 16], 1)),
            // A law that the page does not list, and an unknown bit.
            7 => {
                let first = self.choices.pick(&["135a09", "135a0010", "135a0080"], "135a09");
                zeros(first, 51 - self.choices.below(2))
            }
            _ => ScenarioMessage::Body { hex: ZERO_DELAY.to_owned() },
        }
    }

    /// A message that does not change the counter of rejected frames.
    pub(crate) fn uncounted(&mut self) -> ScenarioMessage {
        match self.choices.below(4) {
            0 | 1 => ScenarioMessage::Repeat {},
            2 => ScenarioMessage::Hello {},
            _ => self.ignored(),
        }
    }

    /// A valid message that only a controller sends, or a setpoint for a controller without a plate.
    pub(crate) fn ignored(&mut self) -> ScenarioMessage {
        let command = "165ad2040000 0000c843 90f9ec01 01 00 0000";
        let configured = "145a01 00 00000000000000000000000000000000";
        let fault = "185a0200 34120008 01000000 00000000 00000000";
        let setpoint = "1a5a 00000040";
        let all = [command, configured, fault, "195a 04030201", setpoint];
        let count = if self.limits.has_own_plate { all.len() - 1 } else { all.len() };
        let hex = self.choices.pick(all.get(..count).unwrap_or_default(), command).to_owned();
        ScenarioMessage::Body { hex }
    }
}
