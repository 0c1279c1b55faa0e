//! Simulates a setpoint step on the exact plate with the firmware's loops, including their limits.
//! In contrast to [`crate::loops::ClosedLoop::step_response`] the drive saturates with anti-windup,
//! |W| includes the ripple of the fast mode, and the frequency loop is inactive while Wd is small.

use crate::loops::case::{LoopCase, OperatingCondition};
use crate::loops::step_response::StepResponse;
use crate::tuning::design::{GainDesign, TuningTarget};
use platebench_controller::{Law, Measurement};
use platebench_plate::{BandMonitor, BandSignal, ConditionProfiles, Drive, Plant, Plate, Profile, Tier, Time};
use platebench_wire::{Configure, LawId, flags};
use std::collections::VecDeque;
use std::f64::consts::TAU;

pub(crate) const BAND: f64 = 0.05;
/// Points of |W| per period, as in the rows of a trace at 1 kHz.
const POINTS_PER_PERIOD: u64 = 20;
/// If |W| enters the band after this share of the horizon, the response has not settled.
const LATEST_ENTRY_SHARE: f64 = 0.9;
/// Default frequency range in Hz and slew limit in Hz per period of a scenario.
const RANGE_HZ: f32 = 250.0;
const SLEW_HZ: f32 = 100.0;

impl GainDesign {
    /// Steps the setpoint from rest. The excitation starts at the untouched plate's resonance.
    /// Settling is the last entry of |W| into the band. Returns the default response if the
    /// firmware rejects the gains.
    pub fn simulate_step(&self, target: &TuningTarget<'_>, plate: &Plate) -> StepResponse {
        let TuningTarget { period_us, delay, setpoint, force_n, .. } = *target;
        let gains = Some(self.firmware_gains(target.period()));
        let case =
            LoopCase { period_us, gains, ..LoopCase::new(plate, LawId::DqPiFixed, OperatingCondition::Resonant) };
        let configure = Configure {
            drive_limit_vpp: plate.drive_limit_vpp as f32,
            frequency_range_hz: RANGE_HZ,
            frequency_slew_hz: SLEW_HZ,
            ..case.configure()
        };
        let Ok((mut law, _)) = Law::design(&configure) else { return StepResponse::default() };
        let scene = ConditionProfiles {
            temperature_offset_k: Profile::constant(0.0),
            finger_force_n: Profile::constant(force_n),
        };
        let mut plant = Plant::new(plate.clone(), scene, Tier::Modal);
        plant.set_drive(Drive { vpp: 0.0, omega: plate.omega0 });
        let band =
            BandMonitor { signal: BandSignal::Amplitude, low: (1.0 - BAND) * setpoint, high: (1.0 + BAND) * setpoint };
        let (period, delay) = (u64::from(period_us) * 1_000, (delay * 1e9).round() as u64);
        let mut pending: VecDeque<(u64, Drive)> = VecDeque::new();
        let (mut found, mut inside, mut crossings) = (StepResponse::default(), None, Vec::new());
        for number in 0..target.horizon() {
            let now = u64::from(number) * period;
            let w = plant.state().w;
            let measurement = Measurement { setpoint_um: setpoint as f32, wd_um: w.re as f32, wq_um: w.im as f32 };
            let actuation = law.step(&measurement);
            found.saturated_periods += u32::from(actuation.flags & flags::SATURATED != 0);
            let drive = Drive {
                vpp: f64::from(actuation.drive_vpp).min(plate.drive_limit_vpp),
                omega: plate.omega0 + TAU * f64::from(actuation.frequency_offset_hz),
            };
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
                return StepResponse { settling: None, diverged: true, ..found };
            }
        }
        let latest = LATEST_ENTRY_SHARE * f64::from(target.horizon()) * (f64::from(period_us) * 1e-6);
        StepResponse { settling: inside.filter(|entered| *entered <= latest), ..found }
    }
}
