//! A setpoint step on the exact plate: the two loops as the firmware runs them, limits and all, in f64.
//!
//! [`crate::ClosedLoop::step`] is the linear loop, along Wd and without a limit; this is what a finger feels: |W| of the modal plate with the fast mode's
//! ripple, a drive that saturates and an integral that tracks it, a frequency loop that rests while Wd is small. It shares no code with the firmware, and the
//! tests hold it against that.

use crate::controller::Pi;
use platebench_plate::plant::Signal;
use platebench_plate::{Complex64, Drive, Plant, Plate, Profile, Scene, Tier, Time, Watch};
use std::collections::VecDeque;
use std::f64::consts::TAU;

/// Half the band of the settling time.
pub(crate) const BAND: f64 = 0.05;
/// |W| is looked at so often per period, as in the rows of a trace at 1 kHz.
const POINTS: u64 = 20;
/// What enters the band later than this share of what is looked at has not shown that it stays.
const SETTLED_BY: f64 = 0.9;
/// Of the firmware (`controller/src/loops.rs`, `dq_pi.rs`): the share of the saturation error that the amplitude's integral takes over at 0 V and at the limit,
/// the share of the setpoint below which the frequency loop rests, and where the ratio Wq/Wd is cut off.
const TRACKED_AT_ZERO: f64 = 1.0;
const TRACKED_AT_LIMIT: f64 = 0.6;
const SMALLEST_WD: f64 = 0.1;
const LARGEST_RATIO: f64 = 2.0;
/// A scenario's bounds on the excitation where it has none of its own, Hz around its start and per period.
const RANGE_HZ: f64 = 250.0;
const SLEW_HZ: f64 = 100.0;

/// A plate and the loops around it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Setting<'a> {
    /// The plate; its drive limit acts.
    pub plate: &'a Plate,
    /// Normal force of a finger, N, 0 or more.
    pub force_n: f64,
    /// Drive from the error of Wd, Vpp per µm.
    pub amplitude: Pi,
    /// Excitation from Wq/Wd, rad/s.
    pub frequency: Pi,
    /// Control period, µs, above 0.
    pub period_us: u32,
    /// Sampling to actuation, s.
    pub delay: f64,
    /// µm, above 0.
    pub setpoint: f64,
}

/// What |W| does after a setpoint step from rest.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Transient {
    /// Last entry into ±5 % of the setpoint, s; `None` where it does not stay there.
    pub settling: Option<f64>,
    /// Overshoot as a share of the setpoint.
    pub overshoot: f64,
    /// Highest drive that is given, Vpp.
    pub peak_drive: f64,
    /// Highest drive that was asked for, Vpp.
    pub asked_drive: f64,
    /// Control periods at the amplifier's limit.
    pub saturated_periods: u32,
}

impl Setting<'_> {
    /// The control period, s.
    pub fn period(&self) -> f64 {
        f64::from(self.period_us) * 1e-6
    }

    /// A step of the setpoint from rest at the first control instant, over `periods`. The excitation starts at the untouched plate's resonance.
    pub fn step(&self, periods: u32) -> Transient {
        let (plate, setpoint) = (self.plate, self.setpoint);
        let scene =
            Scene { temperature_offset_k: Profile::constant(0.0), finger_force_n: Profile::constant(self.force_n) };
        let mut plant = Plant::new(plate.clone(), scene, Tier::Modal);
        plant.set_drive(Drive { vpp: 0.0, omega: plate.omega0 });
        let band = Watch { signal: Signal::Amplitude, low: (1.0 - BAND) * setpoint, high: (1.0 + BAND) * setpoint };
        let (period, delay) = (u64::from(self.period_us) * 1_000, (self.delay * 1e9).round() as u64);
        let mut law = Law { setting: self, integrals: [0.0; 2], offset: 0.0 };
        let mut pending: VecDeque<(u64, Drive)> = VecDeque::new();
        let (mut found, mut inside, mut crossings) = (Transient::default(), None, Vec::new());
        for number in 0..periods {
            let now = u64::from(number) * period;
            let (asked, drive) = law.step(plant.state().w);
            found.asked_drive = found.asked_drive.max(asked);
            found.saturated_periods += u32::from(drive.vpp >= plate.drive_limit_vpp);
            pending.push_back((now + delay, drive));
            let end = now + period;
            let points = (1..=POINTS).map(|point| now + period * point / POINTS);
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
                return Transient { settling: None, ..found };
            }
        }
        let latest = SETTLED_BY * f64::from(periods) * self.period();
        Transient { settling: inside.filter(|entered| *entered <= latest), ..found }
    }
}

/// The loops' state.
struct Law<'a> {
    setting: &'a Setting<'a>,
    integrals: [f64; 2],
    /// Of the excitation from its start, rad/s.
    offset: f64,
}

impl Law<'_> {
    /// The drive that is asked for and what is given.
    fn step(&mut self, w: Complex64) -> (f64, Drive) {
        let Setting { plate, amplitude, frequency, setpoint, .. } = *self.setting;
        let limit = plate.drive_limit_vpp;
        let share = |wished: f64| if wished > limit { TRACKED_AT_LIMIT } else { TRACKED_AT_ZERO };
        let [drive, excitation] = &mut self.integrals;
        let asked = amplitude.proportional * (setpoint - w.re) + *drive;
        let vpp = held(&amplitude, setpoint - w.re, drive, [0.0, limit], share);
        if w.re > SMALLEST_WD * setpoint {
            let ratio = (w.im / w.re).clamp(-LARGEST_RATIO, LARGEST_RATIO);
            let (range, slew) = (RANGE_HZ * TAU, SLEW_HZ * TAU);
            let reach = [(self.offset - slew).max(-range), (self.offset + slew).min(range)];
            self.offset = held(&frequency, ratio, excitation, reach, |_| 1.0);
        }
        (asked, Drive { vpp, omega: plate.omega0 + self.offset })
    }
}

/// One period of a loop whose output is held within `low..=high`; the integral takes over `share` of what was cut off, as back-calculation has it.
fn held(pi: &Pi, error: f64, integral: &mut f64, [low, high]: [f64; 2], share: impl Fn(f64) -> f64) -> f64 {
    let wished = pi.proportional * error + *integral;
    let given = wished.clamp(low, high);
    let ratio = if pi.proportional > 0.0 { pi.integral_per_period / pi.proportional } else { 1.0 };
    *integral += pi.integral_per_period * error + (share(wished) * ratio).min(1.0) * (given - wished);
    given
}
