//! Simulates a setpoint step on the exact plate with the firmware's two loops in f64, including
//! their limits.
//!
//! [`crate::loops::ClosedLoop::step_response`] is the linear loop along Wd without limits. This is
//! |W| of the modal plate with the ripple of the fast mode, a saturating drive with anti-windup,
//! and a frequency loop that is inactive while Wd is small. It shares no code with the firmware;
//! the tests compare both.

use crate::loops::controller::PiGains;
use platebench_plate::BandSignal;
use platebench_plate::{BandMonitor, Complex64, ConditionProfiles, Drive, Plant, Plate, Profile, Tier, Time};
use std::collections::VecDeque;
use std::f64::consts::TAU;

/// Half the band of the settling time.
pub(crate) const BAND: f64 = 0.05;
/// Points of |W| per period, as in the rows of a trace at 1 kHz.
const POINTS_PER_PERIOD: u64 = 20;
/// A later entry into the band, as a share of the horizon, is not settled.
const LATEST_ENTRY_SHARE: f64 = 0.9;
/// As in the firmware (`controller/src/loops.rs`, `dq_pi.rs`): tracking constants of the amplitude
/// loop at 0 V and at the limit, share of the setpoint below which the frequency loop is inactive,
/// limit of Wq/Wd.
const TRACKING_AT_ZERO: f64 = 1.0;
const TRACKING_AT_LIMIT: f64 = 0.6;
const SMALLEST_WD: f64 = 0.1;
const LARGEST_RATIO: f64 = 2.0;
/// A scenario's default range of the excitation and its slew limit, Hz and Hz per period.
const RANGE_HZ: f64 = 250.0;
const SLEW_HZ: f64 = 100.0;

/// A plate and the loops around it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StepSimulation<'a> {
    /// The plate; its drive limit acts.
    pub plate: &'a Plate,
    /// Normal force of a finger, N, 0 or more.
    pub force_n: f64,
    /// Drive from the error of Wd, Vpp per µm.
    pub amplitude: PiGains,
    /// Excitation from Wq/Wd, rad/s.
    pub frequency: PiGains,
    /// Control period, µs, above 0.
    pub period_us: u32,
    /// Delay from sampling to actuation, s.
    pub delay: f64,
    /// Setpoint, µm, above 0.
    pub setpoint: f64,
}

/// Response of |W| to a setpoint step from rest.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct TransientResponse {
    /// Last entry into ±5 % of the setpoint, s; `None` if |W| does not stay there.
    pub settling: Option<f64>,
    /// Overshoot as a share of the setpoint.
    pub overshoot: f64,
    /// Highest drive, Vpp.
    pub peak_drive: f64,
    /// Highest drive before the limit, Vpp.
    pub requested_drive: f64,
    /// Control periods at the drive limit.
    pub saturated_periods: u32,
}

impl StepSimulation<'_> {
    /// The control period, s.
    pub fn period(&self) -> f64 {
        f64::from(self.period_us) * 1e-6
    }

    /// A setpoint step from rest at the first control instant, over `periods`. The excitation
    /// starts at the untouched plate's resonance.
    pub fn step(&self, periods: u32) -> TransientResponse {
        let (plate, setpoint) = (self.plate, self.setpoint);
        let scene = ConditionProfiles {
            temperature_offset_k: Profile::constant(0.0),
            finger_force_n: Profile::constant(self.force_n),
        };
        let mut plant = Plant::new(plate.clone(), scene, Tier::Modal);
        plant.set_drive(Drive { vpp: 0.0, omega: plate.omega0 });
        let band =
            BandMonitor { signal: BandSignal::Amplitude, low: (1.0 - BAND) * setpoint, high: (1.0 + BAND) * setpoint };
        let (period, delay) = (u64::from(self.period_us) * 1_000, (self.delay * 1e9).round() as u64);
        let mut law = LoopState { setting: self, integrals: [0.0; 2], offset: 0.0 };
        let mut pending: VecDeque<(u64, Drive)> = VecDeque::new();
        let (mut found, mut inside, mut crossings) = (TransientResponse::default(), None, Vec::new());
        for number in 0..periods {
            let now = u64::from(number) * period;
            let (asked, drive) = law.step(plant.state().w);
            found.requested_drive = found.requested_drive.max(asked);
            found.saturated_periods += u32::from(drive.vpp >= plate.drive_limit_vpp);
            pending.push_back((now + delay, drive));
            let end = now + period;
            let points = (1..=POINTS_PER_PERIOD).map(|point| now + period * point / POINTS_PER_PERIOD);
            let late = pending.iter().map(|(at, _)| *at).filter(|at| *at < end);
            let mut stops: Vec<u64> = points.chain(late).collect();
            stops.sort_unstable();
            for stop in stops {
                while let Some(&(at, drive)) = pending.front()
                    && at <= plant.time().as_nanos()
                {
                    plant.set_drive(drive);
                    found.peak_drive = found.peak_drive.max(drive.vpp);
                    pending.pop_front();
                }
                plant.advance(Time::from_nanos(stop), &[band], &mut crossings);
                for crossing in crossings.drain(..) {
                    let holds = (band.low..=band.high).contains(&crossing.state.amplitude());
                    inside = holds.then(|| crossing.time.seconds());
                }
                found.overshoot = found.overshoot.max(plant.state().amplitude() / setpoint - 1.0);
            }
            if !plant.state().is_finite() {
                return TransientResponse { settling: None, ..found };
            }
        }
        let latest = LATEST_ENTRY_SHARE * f64::from(periods) * self.period();
        TransientResponse { settling: inside.filter(|entered| *entered <= latest), ..found }
    }
}

/// The loops' state.
struct LoopState<'a> {
    setting: &'a StepSimulation<'a>,
    integrals: [f64; 2],
    /// Excitation − start, rad/s.
    offset: f64,
}

impl LoopState<'_> {
    /// The drive before the limit, and the limited drive.
    fn step(&mut self, w: Complex64) -> (f64, Drive) {
        let StepSimulation { plate, amplitude, frequency, setpoint, .. } = *self.setting;
        let limit = plate.drive_limit_vpp;
        let share = |unlimited: f64| if unlimited > limit { TRACKING_AT_LIMIT } else { TRACKING_AT_ZERO };
        let [drive, excitation] = &mut self.integrals;
        let asked = amplitude.proportional * (setpoint - w.re) + *drive;
        let vpp = step_with_anti_windup(&amplitude, setpoint - w.re, drive, [0.0, limit], share);
        if w.re > SMALLEST_WD * setpoint {
            let ratio = (w.im / w.re).clamp(-LARGEST_RATIO, LARGEST_RATIO);
            let (range, slew) = (RANGE_HZ * TAU, SLEW_HZ * TAU);
            let limits = [(self.offset - slew).max(-range), (self.offset + slew).min(range)];
            self.offset = step_with_anti_windup(&frequency, ratio, excitation, limits, |_| 1.0);
        }
        (asked, Drive { vpp, omega: plate.omega0 + self.offset })
    }
}

/// One period of a loop with its output limited to `low..=high` and back-calculation with tracking
/// constant `share`.
fn step_with_anti_windup(
    pi: &PiGains,
    error: f64,
    integral: &mut f64,
    [low, high]: [f64; 2],
    share: impl Fn(f64) -> f64,
) -> f64 {
    let unlimited = pi.proportional * error + *integral;
    let output = unlimited.clamp(low, high);
    let ratio = if pi.proportional > 0.0 { pi.integral_per_period / pi.proportional } else { 1.0 };
    *integral += pi.integral_per_period * error + (share(unlimited) * ratio).min(1.0) * (output - unlimited);
    output
}
