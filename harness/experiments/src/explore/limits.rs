//! Computes limits from plate, drive limit, period and delay, as `docs/exploration.md` derives
//! them. Times are in s. Limits differ between laws only by declared properties (`docs/laws.md`).

use crate::explore::scene::SceneTrial;
use platebench_model::scenario::OWN_LAW;
use platebench_plate::{Complex64, Mode, Plate};
use platebench_wire::LawId;
use schemars::JsonSchema;
use serde::Serialize;
use std::f64::consts::TAU;

/// Half width of the settled band, relative to the setpoint.
pub(crate) const BAND: f64 = 0.05;
/// Required time, s: the error is at most 5 % within 2 ms.
const REQUIRED_S: f64 = 2e-3;
/// Factor applied to the shortest time that the drive limit allows.
const FLOOR_FACTOR: f64 = 1.5;
/// Time constant, s, of the slowest loop that holds the amplitude. It reaches 5 % in 3 ms.
const HOLD_TIME_CONSTANT_S: f64 = 1e-3;

/// Factor on the measured times of an own law, because other steps and plates take longer.
const OWN_LAW_FACTOR: f64 = 2.0;
/// Factor on the shortest time that the slew limit of the frequency permits.
const SLEW_FACTOR: f64 = 1.5;

/// If the damping changes by more than this share, the law adopts it after two control periods.
const MAX_MISMATCH: f64 = 0.3;

/// Smallest distance of the resonance from the end of the configured range, Hz.
const RANGE_RESERVE_HZ: f64 = 2.0;
/// Largest share of the drive limit that a setpoint in reach needs. Scenes use 80 %, and the plate
/// deviates by some percent.
const DRIVE_RESERVE: f64 = 0.88;

/// Control periods in which a law measures a plate that it does not know.
const UNKNOWN_PERIODS: f64 = 7.0;

pub(crate) struct Limits<'a> {
    pub(crate) trial: &'a SceneTrial,
    base: &'a Plate,
    design: Plate,
    pub(crate) properties: LawProperties,
    pub(crate) period_s: f64,
    pub(crate) delay_s: f64,
}

/// What the law knows about damping and resonance when a setpoint steps.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Knowledge {
    /// Damping and resonance are those of the last steady state.
    Settled,
    /// The trial starts, or damping or resonance changed after the last steady state.
    Unknown,
}

impl<'a> Limits<'a> {
    pub(crate) fn new(trial: &'a SceneTrial, base: &'a Plate, properties: LawProperties) -> Self {
        Self {
            trial,
            base,
            design: trial.plate.design().apply(base),
            properties,
            period_s: f64::from(trial.period_us) * 1e-6,
            delay_s: f64::from(trial.delay_us) * 1e-6,
        }
    }

    pub(crate) fn mode(&self, time_us: u32) -> Mode {
        self.trial.mode_at(self.base, time_us)
    }

    fn limit_vpp(&self) -> f64 {
        self.trial.plate.limit_vpp.into()
    }

    /// Standard deviation of each sensed component, µm.
    pub(crate) fn noise_um(&self) -> f64 {
        f64::from(self.trial.plate.noise_pm) * 1e-6
    }

    /// Time from `time_us` to the next control instant.
    fn wait(&self, time_us: u32) -> f64 {
        let period = self.trial.period_us;
        f64::from(time_us.div_ceil(period) * period - time_us) * 1e-6
    }

    /// Largest magnitude of a pole of the closed loop, per control period.
    fn pole(&self, mode: &Mode) -> f64 {
        // An exponential is within 5 % after three time constants.
        let of_own_law = self.properties.own.map(|own| OWN_LAW_FACTOR * seconds(own.settling_us) / 3.0);
        let time_constant = of_own_law.unwrap_or(0.0).max(HOLD_TIME_CONSTANT_S);
        let designed = (-self.period_s / time_constant).exp();
        if self.properties.adapts_to_damping {
            return designed;
        }
        // With gains for the plate without a finger, the poles solve (z − 1)(z − a) + g(z − a0) =
        // 0.
        let (nominal, actual) = (self.design.sigma0, mode.sigma);
        let [a0, a] = [nominal, actual].map(|sigma| (-sigma * self.period_s).exp());
        let gain = mode.envelope_constant / actual;
        let fast = (-3.0 * self.period_s / REQUIRED_S).exp();
        let g = (1.0 - fast) * gain * (1.0 - a) / (self.design.gain * (1.0 - a0));
        let half = (1.0 + a - g) / 2.0;
        let root = Complex64::new(half * half - (a - g * a0), 0.0).sqrt();
        (half + root).norm().max((half - root).norm()).clamp(designed, 0.999)
    }

    /// Time in which the loop reduces an error to `share` of its value, in whole periods.
    fn decay(&self, mode: &Mode, share: f64) -> f64 {
        (share.ln() / self.pole(mode).ln()).ceil() * self.period_s
    }

    /// Shortest time from `from` µm to within 5 % of `to` µm, with the drive at its limit or 0.
    pub(crate) fn floor(&self, mode: &Mode, from: f64, to: f64) -> f64 {
        let strongest = self.limit_vpp() / mode.drive_for(1.0);
        let (low, high) = (to * (1.0 - BAND), to * (1.0 + BAND));
        if from < low {
            ((strongest - from) / (strongest - low)).ln() / mode.sigma
        } else if from > high {
            (from / high).ln() / mode.sigma
        } else {
            0.0
        }
    }

    /// Largest settling time of a step from `from` to `to` µm at `time_us`.
    pub(crate) fn settling(&self, time_us: u32, from: f64, to: f64, knowledge: Knowledge) -> f64 {
        let mode = self.mode(time_us);
        let floor = (self.floor(&mode, from, to) / self.period_s).ceil() * self.period_s;
        let share = Self::share(from, to, BAND);
        let mut designed = self.decay(&mode, share);
        if let (Some(own), Knowledge::Settled) = (self.properties.own, knowledge) {
            let known_us = own.steps_at(self.trial.period_us).known_us[usize::from(self.trial.force_at(time_us) > 0.0)];
            // An exponential is within 5 % after three time constants.
            let time_constant = (OWN_LAW_FACTOR * seconds(known_us) / 3.0).max(HOLD_TIME_CONSTANT_S);
            designed = designed.min((-share.ln() * time_constant / self.period_s).ceil() * self.period_s);
        }
        let designed = designed.max(REQUIRED_S);
        let learning = match knowledge {
            Knowledge::Settled => 1.0,
            Knowledge::Unknown => UNKNOWN_PERIODS,
        };
        let controlled = designed.max(FLOOR_FACTOR * floor) + learning * self.period_s;
        self.wait(time_us) + self.delay_s + controlled
    }

    /// Largest recovery time after the force has changed from `from_us` to `to_us` at a constant
    /// temperature.
    pub(crate) fn recovery_of_force(&self, from_us: u32, to_us: u32, setpoint: f64) -> f64 {
        let usual = self.settling(to_us, setpoint, setpoint, Knowledge::Unknown);
        let Some(own) = self.properties.own.filter(|_| from_us == to_us) else { return usual };
        let touch = OWN_LAW_FACTOR * seconds(own.steps_at(self.trial.period_us).touch_us);
        usual.min(self.wait(to_us) + self.delay_s + touch.max(REQUIRED_S) + UNKNOWN_PERIODS * self.period_s)
    }

    /// Time in which the configured slew limit permits a change of the frequency by `hz`, with a
    /// reserve. 0 with the usual limit, which the measured times of an own law contain.
    pub(crate) fn slew(&self, hz: f64) -> f64 {
        SLEW_FACTOR * self.trial.tuning.slew_time_s(hz, self.trial.period_us)
    }

    /// True if the drive limit has a reserve for the setpoint at `time_us`.
    pub(crate) fn has_drive(&self, time_us: u32) -> bool {
        self.mode(time_us).drive_for(self.trial.setpoint_at(time_us)) <= DRIVE_RESERVE * self.limit_vpp()
    }

    /// True if the resonance at `time_us` is in the configured range of the frequency.
    pub(crate) fn is_in_range(&self, time_us: u32) -> bool {
        let mode = self.mode(time_us);
        let start_hz = f64::from(self.trial.start_frequency_tenths) / 10.0;
        let detuning_hz = (mode.omega0 / TAU - start_hz).abs();
        let range = self.trial.tuning.range_tenths.map(|tenths| f64::from(tenths) / 10.0 - RANGE_RESERVE_HZ);
        range.is_none_or(|range| detuning_hz <= range)
    }

    /// Time after a change until its effect is small compared with the limits of steady state.
    pub(crate) fn steady(&self, time_us: u32, from: f64, to: f64) -> f64 {
        let mode = self.mode(time_us);
        let after = match self.properties.own {
            Some(own) => OWN_LAW_FACTOR * seconds(own.steady_us),
            None => self.decay(&mode, 1.0 / 250.0),
        };
        self.settling(time_us, from, to, Knowledge::Unknown) + after
    }

    /// Time by which the amplitude lags behind a ramp of the setpoint at `time_us`: a period for the
    /// sample, the delay, and the sum of the errors of the slowest pole.
    pub(crate) fn lag(&self, time_us: u32) -> f64 {
        self.period_s + self.delay_s + self.period_s / (1.0 - self.pole(&self.mode(time_us)))
    }

    /// The error `band · to` relative to the height of the step, at most `band`.
    fn share(from: f64, to: f64, band: f64) -> f64 {
        band * (to / (from - to).abs()).min(1.0)
    }

    /// Time at setpoint 0 in which amplitude and integral of the drive decay to a thousandth. The
    /// integral decays with the time constant of the configured plate.
    pub(crate) fn decay_at_rest(&self, time_us: u32) -> f64 {
        let open = 8.0 / self.design.sigma0 + 2.0 * self.period_s + self.delay_s;
        if let Some(own) = self.properties.own {
            return open + OWN_LAW_FACTOR * seconds(own.rest_us);
        }
        // With fixed gains under a finger, the drive rises again, and its slow pole dominates.
        let closed = if self.properties.adapts_to_damping { 0.0 } else { self.decay(&self.mode(time_us), 1e-3) };
        open + closed
    }

    /// Largest proportional gain of an amplitude loop, Vpp per µm.
    pub(crate) fn strongest_gain(&self) -> f64 {
        let heaviest = self.design.damping_ratio_at(self.trial.largest_force());
        let kept = (-self.design.sigma0 * heaviest * self.period_s).exp();
        heaviest / (self.design.gain * (1.0 - kept))
    }

    /// Change of the frequency, Hz, in a period in which the phase is wrong by `angle`, rad. The loop
    /// has the pole p, so its proportional gain is σ (1 − p)/(1 − e^(−σT)).
    pub(crate) fn frequency_of_phase(&self, time_us: u32, angle: f64) -> f64 {
        let sigma = self.mode(time_us).sigma;
        let designed = 1.0 - (-3.0 * self.period_s / REQUIRED_S).exp();
        angle * sigma * designed / (1.0 - (-sigma * self.period_s).exp()) / TAU
    }

    /// Relative error of the damping that the law assumes at the start of the trial.
    pub(crate) fn initial_mismatch(&self) -> f64 {
        let plate = self.trial.plate;
        let deviation = f64::from(plate.gain_permille.abs() + plate.time_constant_permille.abs()) * 1e-3;
        self.bounded_mismatch(deviation + (self.mode(0).sigma / self.design.sigma0 - 1.0).abs())
    }

    /// Relative error of the damping that a change of the force adds.
    pub(crate) fn mismatch_of(&self, from_us: u32, to_us: u32) -> f64 {
        let [before, after] = [from_us.saturating_sub(1), to_us].map(|at| self.mode(at).sigma);
        let ramp = f64::from(to_us - from_us) * 1e-6 / (self.period_s * self.properties.tracking_periods.max(1.0));
        // The law already tracks the damping during a ramp.
        let lag = if ramp > 0.0 { (1.0 - (-ramp).exp()) / ramp } else { 1.0 };
        self.bounded_mismatch((after / before - 1.0).abs() * lag)
    }

    /// Relative change of the damping, at most [`MAX_MISMATCH`]; 0 with fixed gains.
    pub(crate) fn change_of_damping(&self, from_us: u32, to_us: u32) -> f64 {
        let [before, after] = [from_us.saturating_sub(1), to_us].map(|at| self.mode(at).sigma);
        self.bounded_mismatch((after / before - 1.0).abs())
    }

    /// Error of the law's assumption at the start, that the start frequency is the resonance, Hz.
    pub(crate) fn initial_detuning_hz(&self) -> f64 {
        (self.mode(0).omega0 / TAU - f64::from(self.trial.start_frequency_tenths) / 10.0).abs()
    }

    pub(crate) fn change_of_resonance_hz(&self, from_us: u32, to_us: u32) -> f64 {
        let [before, after] = [from_us.saturating_sub(1), to_us].map(|at| self.mode(at).omega0);
        (after - before).abs() / TAU
    }

    fn bounded_mismatch(&self, mismatch: f64) -> f64 {
        // With fixed gains, the slow pole of the loop already includes the effect.
        if self.properties.adapts_to_damping { mismatch.min(MAX_MISMATCH) } else { 0.0 }
    }

    /// Share of an error of damping or resonance that the law has not corrected after `time_us`.
    pub(crate) fn tracking_remainder(&self, time_us: u32) -> f64 {
        (-f64::from(time_us) * 1e-6 / (self.period_s * self.properties.tracking_periods.max(1.0))).exp()
    }

    /// Largest relative change of |W| within `time` at constant drive, after the mode changes from
    /// `before` to `after`.
    pub(crate) fn effect(before: &Mode, after: &Mode, time: f64) -> f64 {
        let rate = Complex64::new(-after.sigma, after.omega0 - before.omega0);
        // Solution of W' = rate · W + σ (σ before the change) with W(0) = 1.
        let settled = -Complex64::from(before.sigma) / rate;
        let deviation = |share: f64| (((1.0 - settled) * (rate * time * share).exp() + settled).norm() - 1.0).abs();
        (1..=16).map(|part| deviation(f64::from(part) / 16.0)).fold(0.0, f64::max)
    }
}

fn seconds(us: u32) -> f64 {
    f64::from(us) * 1e-6
}

/// Longest times that an own law took in the steps that measured it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, JsonSchema)]
pub struct OwnLaw {
    /// From a step until the amplitude is within 5 %.
    pub settling_us: u32,
    /// From a step until amplitude and frequency are steady.
    pub steady_us: u32,
    /// From setpoint 0 until the drive is near 0 Vpp.
    pub rest_us: u32,
    /// Times at the resonance, by control period in ascending order.
    pub steps: [OwnSteps; 3],
}

/// Times that an own law took at one control period, on a plate that it knows from a steady state.
/// The largest number stands for a step that never came within 5 %.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, JsonSchema)]
#[expect(clippy::struct_field_names, reason = "all are times in µs")]
pub struct OwnSteps {
    pub period_us: u32,
    /// From a step of the setpoint until the amplitude is within 5 %, without and with the finger.
    pub known_us: [u32; 2],
    /// From a step of the force until the amplitude is within 5 %.
    pub touch_us: u32,
}

impl OwnLaw {
    /// The times at the next longer measured period.
    pub(crate) fn steps_at(&self, period_us: u32) -> OwnSteps {
        let longer = self.steps.iter().find(|steps| steps.period_us >= period_us);
        longer.or(self.steps.last()).copied().unwrap_or_default()
    }
}

/// The law of a trial.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ExploredLaw {
    Numbered(LawId),
    /// A law that is none of the bench's.
    Own(OwnLaw),
}

impl From<LawId> for ExploredLaw {
    fn from(law: LawId) -> Self {
        Self::Numbered(law)
    }
}

impl ExploredLaw {
    pub const fn name(self) -> &'static str {
        match self {
            Self::Numbered(law) => law.name(),
            Self::Own(_) => OWN_LAW,
        }
    }

    pub const fn number(self) -> Option<LawId> {
        match self {
            Self::Numbered(law) => Some(law),
            Self::Own(_) => None,
        }
    }

    pub(crate) const fn is_own(self) -> bool {
        matches!(self, Self::Own(_))
    }

    pub(crate) fn properties(self) -> Option<LawProperties> {
        match self {
            Self::Numbered(law) => LawProperties::of(law),
            Self::Own(own) => Some(LawProperties {
                adapts_to_damping: true,
                compensates_delay: false,
                steers: false,
                tracking_periods: 8.0,
                own: Some(own),
            }),
        }
    }

    /// Factor of the quiet times of a scene, so that the windows suffice for slow laws.
    pub(crate) fn stretch(self) -> f64 {
        match self.properties() {
            Some(LawProperties { own: Some(own), .. }) => {
                let needed = OWN_LAW_FACTOR * seconds(own.settling_us + own.steady_us) / USUAL_STEADY_S;
                needed.clamp(1.0, MAX_STRETCH)
            }
            Some(properties) if properties.adapts_to_damping => 1.0,
            _ => 2.0,
        }
    }
}

/// Time until a window is steady with a law of the bench, without the time to learn the plate.
const USUAL_STEADY_S: f64 = 7.5e-3;
const MAX_STRETCH: f64 = 8.0;

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LawProperties {
    /// True if the gains follow the damping. Otherwise they fit only the plate without a finger.
    pub adapts_to_damping: bool,
    /// True if the law compensates a configured loop delay. Other laws are explored without delay.
    pub compensates_delay: bool,
    /// True if the law computes the drives after a step in advance, at rest from the configured
    /// plate. If the amplitude then misses the setpoint, the law searches for a loop delay.
    pub steers: bool,
    /// Time constant with which the law tracks a small change of the damping, control periods.
    pub tracking_periods: f64,
    /// Measured times of an own law.
    pub own: Option<OwnLaw>,
}

impl LawProperties {
    pub fn explored_laws() -> impl Iterator<Item = LawId> {
        LawId::ALL.into_iter().filter(|law| Self::of(*law).is_some())
    }

    /// `None` for laws with a static error by design, or laws that settle only near the resonance.
    pub const fn of(law: LawId) -> Option<Self> {
        let adapting =
            Self { adapts_to_damping: true, compensates_delay: true, steers: false, tracking_periods: 8.0, own: None };
        match law {
            LawId::DqPi => Some(adapting),
            LawId::Deadbeat => Some(Self { steers: true, ..adapting }),
            LawId::DqPiFixed => {
                Some(Self { adapts_to_damping: false, compensates_delay: false, tracking_periods: 0.0, ..adapting })
            }
            LawId::OpenLoop
            | LawId::DqPiEuler
            | LawId::VoltageOnly
            | LawId::FrequencyOnly
            | LawId::BangBang
            | LawId::Pll => None,
        }
    }
}
