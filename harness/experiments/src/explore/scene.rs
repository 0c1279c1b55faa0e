//! Defines a scene: one or several plays of a judged trial, with other trials in between, on one
//! controller.
//!
//! Times and values are multiples of a small unit, so scenario files contain short numbers.

use crate::explore::choices::{Choices, uniform, weighted};
use crate::explore::envelope::Ranges;
use crate::explore::limits::ExploredLaw;
use crate::explore::properties::Property;
use platebench_controller::design::{PiGains, default_response_time_s};
use platebench_model::scenario::raw::{RawController, RawFault};
use platebench_model::scenario::{Direction, FaultKind, ScenarioGains};
use platebench_plate::{Mode, Plate, Time};
use platebench_wire::LawId;
use std::f64::consts::TAU;
use std::ops::RangeInclusive;

#[derive(Debug, Clone, PartialEq)]
pub struct Scene {
    /// Trials between two plays of the judged trial.
    pub earlier: Vec<SceneTrial>,
    pub judged: SceneTrial,
    /// Number of plays of the judged trial. Each starts at another time stamp.
    pub count: u32,
    /// Seed of the scripts of messages before the judged trial. `None`: no scripts.
    pub script_seed: Option<u64>,
    /// If present, the second play differs from the first one.
    pub relation: Option<Relation>,
}

/// Time of a judged trial that only rare scenes have, µs.
const RARE_US: u32 = 60_000_000;

impl Scene {
    /// True if the scene takes long, so that no other one is derived from it.
    pub(crate) const fn is_rare(&self) -> bool {
        self.script_seed.is_some() || self.judged.duration_us >= RARE_US
    }
}

/// How the second play of a trial differs from the first one, and with it its expected response.
#[derive(Debug, Clone, Copy, PartialEq, Eq, strum::VariantArray)]
pub enum Relation {
    /// Setpoint and drive limit are half as large, and so is the response.
    Proportional,
    /// The resonance is on the other side of the start frequency. The amplitude is equal.
    Mirrored,
    /// The loop has a delay, which the law compensates. The response is later by this delay.
    Delayed,
}

impl Relation {
    pub(crate) const ALL: &[Self] = <Self as strum::VariantArray>::VARIANTS;
    pub(crate) const FACTOR: f64 = 0.5;

    pub(crate) const fn property(self) -> Property {
        match self {
            Self::Proportional => Property::ProportionalResponse,
            Self::Mirrored => Property::MirroredResponse,
            Self::Delayed => Property::DelayedResponse,
        }
    }

    /// True for relations of the envelope, which the fast pole of the plate violates slightly.
    pub(crate) const fn needs_envelope(self) -> bool {
        !matches!(self, Self::Proportional)
    }
}

#[derive(Debug, Clone, PartialEq)]
pub struct SceneTrial {
    pub law: ExploredLaw,
    /// Differences from the plate of the envelope.
    pub plate: PlateChoice,
    pub period_us: u32,
    /// Loop delay, µs. The law is configured with it.
    pub delay_us: u32,
    /// Excitation frequency at the start, 0.1 Hz.
    pub start_frequency_tenths: u32,
    pub duration_us: u32,
    /// Setpoint, nm.
    pub setpoint: Course,
    /// Finger force, 0.01 N.
    pub force: Course,
    /// Temperature offset, 0.01 K.
    pub temperature: Course,
    pub tuning: Tuning,
    /// Empty in trials that are not judged.
    pub faults: Vec<LineFault>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Default)]
pub struct PlateChoice {
    pub limit_vpp: u32,
    pub noise_pm: u32,
    /// Change of the gain from the envelope's plate, 0.1 %. The controller is configured with it.
    pub nominal_gain_permille: i32,
    /// Change of the time constant from the envelope's plate, 0.1 %; also configured in the
    /// controller.
    pub nominal_time_constant_permille: i32,
    /// Deviation of the gain from the configured gain, 0.1 %.
    pub gain_permille: i32,
    /// Deviation of the time constant from the configured one, 0.1 %.
    pub time_constant_permille: i32,
}

impl PlateChoice {
    /// The plate that the controller is configured for.
    #[must_use]
    pub const fn design(self) -> Self {
        Self { gain_permille: 0, time_constant_permille: 0, ..self }
    }

    pub fn apply(self, base: &Plate) -> Plate {
        let factor = |permille: i32| 1.0 + f64::from(permille) * 1e-3;
        Plate {
            gain: base.gain * factor(self.nominal_gain_permille) * factor(self.gain_permille),
            sigma0: base.sigma0 / (factor(self.nominal_time_constant_permille) * factor(self.time_constant_permille)),
            drive_limit_vpp: self.limit_vpp.into(),
            noise_um_rms: f64::from(self.noise_pm) * 1e-6,
            ..base.clone()
        }
    }
}

/// A setpoint, force or temperature over time. The unit of all values is 1 nm, 0.01 N or 0.01 K.
#[derive(Debug, Clone, PartialEq)]
pub enum Course {
    /// Instants, µs, and values that hold until the next one. The first instant is 0.
    Hold(Vec<(u32, i32)>),
    /// Instants, µs, and values, linear in between. The first instant is 0.
    Linear(Vec<(u32, i32)>),
    /// `mean + amplitude · sin(2π f t)` with f in 0.1 Hz.
    Sine { mean: i32, amplitude: i32, frequency_tenths: u32 },
}

impl Course {
    /// Always 0.
    pub(crate) fn zero() -> Self {
        Self::Hold(vec![(0, 0)])
    }

    /// Instants and values, none for a sine.
    pub fn points(&self) -> &[(u32, i32)] {
        match self {
            Self::Hold(points) | Self::Linear(points) => points,
            Self::Sine { .. } => &[],
        }
    }

    /// At the instant of a step it is the value after the step.
    pub fn at(&self, time_us: u32) -> f64 {
        match self {
            Self::Hold(points) => {
                let index = points.partition_point(|(at, _)| *at <= time_us).saturating_sub(1);
                points.get(index).map_or(0.0, |(_, value)| f64::from(*value))
            }
            Self::Linear(points) => {
                let next = points.partition_point(|(at, _)| *at <= time_us);
                let value = |index: usize| points.get(index).map(|(at, value)| (f64::from(*at), f64::from(*value)));
                match (value(next.saturating_sub(1)), value(next)) {
                    (Some((from, low)), Some((to, high))) => {
                        low + (high - low) * (f64::from(time_us) - from) / (to - from)
                    }
                    (Some((_, last)), None) => last,
                    (None, _) => 0.0,
                }
            }
            Self::Sine { mean, amplitude, frequency_tenths } => {
                let phase = TAU * f64::from(*frequency_tenths) * 0.1 * f64::from(time_us) * 1e-6;
                f64::from(*mean) + f64::from(*amplitude) * phase.sin()
            }
        }
    }

    pub fn range(&self) -> [f64; 2] {
        match self {
            Self::Hold(points) | Self::Linear(points) => {
                let values = points.iter().map(|(_, value)| f64::from(*value));
                [values.clone().fold(f64::INFINITY, f64::min), values.fold(f64::NEG_INFINITY, f64::max)]
            }
            Self::Sine { mean, amplitude, .. } => [mean - amplitude.abs(), mean + amplitude.abs()].map(f64::from),
        }
    }

    /// Intervals, µs, in which the value changes. Start and end of a step are equal.
    pub fn moves(&self) -> Vec<[u32; 2]> {
        match self {
            Self::Hold(points) => {
                points.array_windows().filter(|[a, b]| a.1 != b.1).map(|[_, (at, _)]| [*at; 2]).collect()
            }
            Self::Linear(points) => {
                points.array_windows().filter(|[a, b]| a.1 != b.1).map(|[from, to]| [from.0, to.0]).collect()
            }
            Self::Sine { amplitude: 0, .. } => Vec::new(),
            Self::Sine { .. } => vec![[0, u32::MAX]],
        }
    }
}

impl SceneTrial {
    /// In µm.
    pub fn setpoint_at(&self, time_us: u32) -> f64 {
        self.setpoint.at(time_us) / 1e3
    }

    /// In N.
    pub fn force_at(&self, time_us: u32) -> f64 {
        self.force.at(time_us) / 100.0
    }

    pub fn largest_force(&self) -> f64 {
        self.force.range()[1] / 100.0
    }

    /// In K.
    pub fn temperature_at(&self, time_us: u32) -> f64 {
        self.temperature.at(time_us) / 100.0
    }

    pub fn mode_at(&self, base: &Plate, time_us: u32) -> Mode {
        let conditions = platebench_plate::Conditions {
            temperature_offset_k: self.temperature_at(time_us),
            finger_force_n: self.force_at(time_us),
        };
        self.plate.apply(base).mode(&conditions)
    }

    /// Length of a play, µs. With a delay, the response to the last control instant belongs to it.
    pub(crate) fn played_us(&self, relation: Option<Relation>) -> u32 {
        match relation {
            Some(Relation::Delayed) => self.duration_us.div_ceil(self.period_us) * self.period_us,
            _ => self.duration_us,
        }
    }

    /// Largest setpoint, nm, that needs at most `share` of the drive limit under the largest force.
    pub fn largest_setpoint_nm(&self, base: &Plate, share: f64) -> i32 {
        let plate = self.plate.apply(base);
        let ratio = plate.damping_ratio_at(self.largest_force());
        (share * plate.drive_limit_vpp * plate.gain / ratio * 1e3) as i32
    }
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LineFault {
    pub kind: FaultKind,
    pub direction: Direction,
    /// Start of the window, µs. It is a control instant.
    pub from_us: u32,
    pub until_us: u32,
    /// The fault applies to each n-th message of the direction in the window.
    pub every: u32,
}

/// Length, in control periods, of a window in which every second frame is damaged. A rejected frame
/// adds 2 to the controller's error counter, a sample subtracts 1, and the controller stops at 10
/// (docs/wire-protocol.md), here in period 18. If every third frame is damaged, it never stops.
const UNTIL_STOP: RangeInclusive<i32> = 14..=24;
const LONG_WINDOW: RangeInclusive<i32> = 3..=24;
/// Number of consecutive damaged messages that cannot stop the controller. Each may split its frame
/// in two, so they add at most 8 to the error counter.
const FEW_FLIPS: i32 = 2;
/// Control periods between faults that lose messages. Closer ones could trigger the watchdog.
const PERIODS_BETWEEN: u32 = 5;
/// Shortest time after a fault, control periods, so that a stopped controller runs again at the
/// end.
const MIN_PERIODS_AFTER: u32 = 8;
/// Control periods after a fault in which no limits apply, because the law measures the plate
/// again.
const RECOVERY_PERIODS: u32 = 60;

impl LineFault {
    /// Draws a fault in a trial. `None` if the trial is too short for it.
    pub(crate) fn draw(choices: &mut Choices, duration_us: u32, period_us: u32) -> Option<Self> {
        let (kind, every, length) = match choices.weighted(&[6, 2, 4, 2, 2, 1, 1, 1, 2, 2, 2]) {
            // A fourth lost message in sequence would trigger the watchdog.
            0 => (FaultKind::Drop, 1..=1, 1..=3),
            1 => (FaultKind::Drop, 2..=3, LONG_WINDOW),
            2 => (FaultKind::Duplicate, 1..=2, 2..=8),
            3 => (FaultKind::Flip, 1..=1, 1..=FEW_FLIPS),
            4 => (FaultKind::Flip, 2..=2, UNTIL_STOP),
            5 => (FaultKind::Flip, 3..=3, LONG_WINDOW),
            6 => (FaultKind::Truncate, 1..=1, 1..=1),
            7 => (FaultKind::Truncate, 3..=3, LONG_WINDOW),
            8 => (FaultKind::Delay(Time::ZERO), 1..=1, 1..=4),
            // These two faults stop the controller, through its error counter or its watchdog.
            9 => (FaultKind::Babble, 1..=1, 3..=4),
            _ => (FaultKind::Disconnect, 1..=1, 6..=9),
        };
        let [every, length] = [every, length].map(|range| choices.integer(range).unsigned_abs());
        let delay_percent = choices.integer(20..=150).unsigned_abs();
        let direction = if choices.integer(0..=1) == 0 { Direction::ToController } else { Direction::FromController };
        let before_percent = choices.integer(0..=90).unsigned_abs();
        let kind = match kind {
            FaultKind::Delay(_) => FaultKind::Delay(Time::from_nanos(u64::from(period_us * delay_percent) * 10)),
            kind => kind,
        };
        let from_us = (duration_us / 100 * before_percent).div_ceil(period_us) * period_us;
        let until_us = from_us + length * period_us;
        let is_in_trial = until_us + MIN_PERIODS_AFTER * period_us <= duration_us;
        is_in_trial.then_some(Self { kind, direction, from_us, until_us, every })
    }

    /// Instant from which limits apply again, µs.
    pub(crate) const fn recovered_us(&self, period_us: u32) -> u32 {
        self.until_us + RECOVERY_PERIODS * period_us
    }

    /// True if the controller may stop. It is then configured again.
    pub(crate) const fn may_stop(&self) -> bool {
        matches!(self.kind, FaultKind::Disconnect | FaultKind::Babble | FaultKind::Flip)
    }

    /// True if the time of a stop depends on the controller's clock or on the bytes of messages.
    pub(crate) fn may_stop_differently(&self, period_us: u32) -> bool {
        match self.kind {
            FaultKind::Disconnect => true,
            FaultKind::Flip => self.until_us - self.from_us > FEW_FLIPS.unsigned_abs() * period_us,
            _ => false,
        }
    }

    /// True if both faults can be in one trial without a stop that neither fault causes alone.
    pub(crate) fn combines_with(&self, other: &Self, period_us: u32) -> bool {
        let gap_us = PERIODS_BETWEEN * period_us;
        let are_apart = self.until_us + gap_us <= other.from_us || other.until_us + gap_us <= self.from_us;
        are_apart || [self.kind, other.kind].contains(&FaultKind::Duplicate)
    }

    /// Largest number of control periods without an answer, until the controller is configured
    /// again.
    pub(crate) const fn longest_silence(&self, period_us: u32) -> u32 {
        (self.until_us - self.from_us) / period_us + 3
    }

    pub(crate) fn raw(&self) -> RawFault {
        let [from_ms, until_ms] = [self.from_us, self.until_us].map(|us| Some(f64::from(us) / 1e3));
        let delay_ms = match self.kind {
            FaultKind::Delay(delay) => Some(delay.seconds() * 1e3),
            _ => None,
        };
        RawFault {
            kind: self.kind.name().to_owned(),
            from_ms,
            until_ms,
            direction: Some(self.direction.name().to_owned()),
            every: (self.every > 1).then_some(self.every.into()),
            delay_ms,
            seed: matches!(self.kind, FaultKind::Flip).then_some(1),
            reconfigure: self.may_stop() || matches!(self.kind, FaultKind::Truncate),
            ..RawFault::default()
        }
    }
}

/// In each field, `None` means the default of the law or of the scenario.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Tuning {
    /// Design value of the response time, 0.1 ms.
    pub response_tenths: Option<u32>,
    /// Gains of the amplitude loop and the frequency loop, percent of the law's own design.
    pub gains_percent: Option<[u32; 2]>,
    /// Largest deviation of the excitation frequency from the start frequency, 0.1 Hz.
    pub range_tenths: Option<u32>,
    /// Largest change of the excitation frequency per control period, 0.1 Hz.
    pub slew_tenths: Option<u32>,
}

/// Settings that a configuration may have.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(crate) enum Settings {
    #[default]
    None,
    All,
    /// Range and slew limit of the frequency.
    FrequencyLimits,
}

/// A setting is present in the second of these parts of the scenes, if all settings may be present.
const SETTING_PARTS: [u32; 2] = [6, 4];
/// As [`SETTING_PARTS`], for range, slew limit and other settings, if only the first two may be present.
const RANGE_PARTS: [u32; 2] = [2, 1];
const SLEW_PARTS: [u32; 2] = [0, 1];
const OTHER_PARTS: [u32; 2] = [1, 0];

impl Tuning {
    pub(crate) fn draw(choices: &mut Choices, ranges: &Ranges, settings: Settings) -> Self {
        // 0: no setting; otherwise 1 more than the distance from the end of the range.
        let mut setting = |[low, high]: [f64; 2], scale: f64, power: i32, frequency_parts: [u32; 2]| {
            let parts = match settings {
                Settings::All => Some(SETTING_PARTS),
                Settings::FrequencyLimits => Some(frequency_parts),
                Settings::None => None,
            };
            let [low, high] = [low, high].map(|end| (end * scale) as i32);
            let value = choices.number(0..=high - low + 1, |random| {
                if parts.is_none_or(|parts| weighted(random, &parts) == 0) {
                    return 0;
                }
                // Tight limits of the frequency have the largest effect.
                let share = (f64::from(uniform(random, &(0..=1_000))) / 1e3).powi(power);
                1 + (f64::from(high - low) * share).round() as i32
            });
            (value > 0).then_some((low + value - 1).unsigned_abs())
        };
        let response_tenths = setting(ranges.response_time_ms, 10.0, 1, OTHER_PARTS);
        let range_tenths = setting(ranges.frequency_range_hz, 10.0, 2, RANGE_PARTS);
        let slew_tenths = setting(ranges.frequency_slew_hz, 10.0, 5, SLEW_PARTS);
        let amplitude = setting(ranges.configured_gains_percent, 1.0, 1, OTHER_PARTS);
        let [low, high] = ranges.configured_gains_percent.map(|percent| percent as i32);
        let gains_percent = amplitude.map(|amplitude| [amplitude, choices.integer(low..=high).unsigned_abs()]);
        Self { response_tenths, gains_percent, range_tenths, slew_tenths }
    }

    /// Time in which the slew limit permits a change of the frequency by `hz`, s.
    pub(crate) fn slew_time_s(&self, hz: f64, period_us: u32) -> f64 {
        self.slew_tenths.map_or(0.0, |tenths| (hz * 10.0 / f64::from(tenths)).ceil() * f64::from(period_us) * 1e-6)
    }

    /// `controller` with these settings. `design` is the configured plate.
    pub(crate) fn apply(
        &self,
        controller: RawController,
        law: ExploredLaw,
        design: &Plate,
        period_us: u32,
    ) -> RawController {
        // An own law uses configured gains or ignores them.
        let law = law.number().unwrap_or(LawId::DqPiFixed);
        let tenths = |value: Option<u32>| value.map(|tenths| f64::from(tenths) / 10.0);
        let gains = self.gains_percent.map(|[amplitude, frequency]| {
            let period = f64::from(period_us) * 1e-6;
            let (tau, response) = (1.0 / design.sigma0, default_response_time_s(law));
            let scaled = |plant_gain: f64, percent: u32| {
                let PiGains { proportional, integral_per_period } =
                    PiGains::of_law(law, plant_gain, tau, response, period);
                [proportional, integral_per_period / period].map(|gain| rounded(gain * f64::from(percent) / 100.0, 4))
            };
            let ([amplitude_kp, amplitude_ki], [frequency_kp, frequency_ki]) =
                (scaled(design.gain, amplitude), scaled(tau, frequency));
            ScenarioGains { amplitude_kp, amplitude_ki, frequency_kp, frequency_ki }
        });
        RawController {
            response_time_ms: tenths(self.response_tenths),
            frequency_range_hz: tenths(self.range_tenths),
            frequency_slew_hz: tenths(self.slew_tenths),
            gains,
            ..controller
        }
    }
}

/// Rounds to `decimals` + 1 significant digits.
pub(crate) fn rounded(value: f64, decimals: usize) -> f64 {
    format!("{value:.decimals$e}").parse().unwrap_or(value)
}
