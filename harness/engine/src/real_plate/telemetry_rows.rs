//! Turns telemetry into trace rows.

use crate::plant_simulation::SATURATION_THRESHOLD;
use platebench_model::trace::{Flags, Row};
use platebench_plate::Time;
use platebench_wire::{ControllerState, Telemetry};

/// Converts telemetry in the order of the target's clock. The trial starts with period 0.
pub(super) struct TelemetryRows {
    period_us: u32,
    limit_vpp: f64,
    last: Option<LastPeriod>,
    pub(super) received: u64,
    pub(super) missing: u64,
    pub(super) force_measured: bool,
}

#[derive(Clone, Copy)]
struct LastPeriod {
    period: u32,
    target_time_us: u32,
    since_start_us: u64,
    row: Row,
}

impl TelemetryRows {
    pub(super) fn new(period_us: u32, limit_vpp: f64) -> Self {
        Self { period_us, limit_vpp, last: None, received: 0, missing: 0, force_measured: false }
    }

    pub(super) fn time(&self) -> Option<Time> {
        self.last.map(|last| Time::from_nanos(last.since_start_us * 1_000))
    }

    /// Returns `None` for a duplicate, an older period, or a value that is not finite.
    pub(super) fn accept(&mut self, telemetry: &Telemetry) -> Option<Row> {
        let numbers = [telemetry.setpoint_um, telemetry.wd_um, telemetry.wq_um, telemetry.drive_vpp];
        if !numbers.iter().all(|number| number.is_finite()) {
            return None;
        }
        let since_start_us = match self.last {
            // Periods before the first telemetry belong to the trial.
            None => u64::from(telemetry.period) * u64::from(self.period_us),
            Some(last) => {
                let (periods, span) = (
                    telemetry.period.wrapping_sub(last.period),
                    telemetry.target_time_us.wrapping_sub(last.target_time_us),
                );
                // The counters wrap, so a step of more than half their range is a step back.
                if periods == 0 || span == 0 || periods > u32::MAX / 2 || span > u32::MAX / 2 {
                    return None;
                }
                self.missing += u64::from(periods - 1);
                last.since_start_us + u64::from(span)
            }
        };
        if self.last.is_none() {
            self.missing += u64::from(telemetry.period);
        }
        self.received += 1;
        let force = telemetry.force_n.filter(|force| force.is_finite());
        self.force_measured |= force.is_some();
        let [setpoint_um, wd_um, wq_um, drive_vpp] = numbers.map(f64::from);
        let mut flags = Flags::CONTROL | Flags::SENSED;
        flags.set(Flags::SATURATED, drive_vpp >= self.limit_vpp * SATURATION_THRESHOLD);
        flags.set(Flags::SAFE, telemetry.state != ControllerState::Running);
        let row = Row {
            t_s: since_start_us as f64 / 1e6,
            setpoint_um,
            wd_um,
            wq_um,
            amplitude_um: wd_um.hypot(wq_um),
            drive_vpp,
            frequency_hz: f64::from(telemetry.frequency_mhz) / 1e3,
            resonance_hz: f64::NAN,
            temperature_offset_k: f64::NAN,
            finger_force_n: force.map_or(f64::NAN, f64::from),
            sensed_wd_um: wd_um,
            sensed_wq_um: wq_um,
            lateness_us: 0.0,
            flags,
        };
        let Telemetry { period, target_time_us, .. } = *telemetry;
        self.last = Some(LastPeriod { period, target_time_us, since_start_us, row });
        Some(row)
    }

    /// Row with 0 V one period after the last telemetry. `None` if this telemetry shows the stop.
    pub(super) fn stop_row(&self) -> Option<Row> {
        let last = self.last.filter(|last| !last.row.flags.contains(Flags::SAFE))?;
        let t_s = (last.since_start_us + u64::from(self.period_us)) as f64 / 1e6;
        Some(Row { t_s, drive_vpp: 0.0, flags: Flags::SENSED | Flags::SAFE, ..last.row })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use platebench_wire::StateCause;

    fn telemetry(period: u32, target_time_us: u32) -> Telemetry {
        Telemetry {
            period,
            target_time_us,
            setpoint_um: 2.0,
            wd_um: 1.5,
            wq_um: -2.0,
            drive_vpp: 400.0,
            frequency_mhz: 32_307_600,
            force_n: None,
            state: ControllerState::Running,
            cause: StateCause::None,
            flags: 0,
        }
    }

    #[test]
    fn uses_the_target_s_clock_from_period_0() {
        let mut rows = TelemetryRows::new(1_000, 900.0);
        let first = rows.accept(&telemetry(0, u32::MAX - 499)).unwrap();
        assert_eq!((first.t_s, first.amplitude_um, first.flags), (0.0, 2.5, Flags::CONTROL | Flags::SENSED));
        assert!(first.finger_force_n.is_nan() && first.resonance_hz.is_nan());
        assert_eq!(rows.accept(&telemetry(1, 510)).unwrap().t_s, 0.001_010);
        assert!(rows.accept(&telemetry(1, 510)).is_none() && rows.accept(&telemetry(0, u32::MAX - 499)).is_none());
        assert!(rows.accept(&Telemetry { wd_um: f32::NAN, ..telemetry(2, 1_500) }).is_none());
        assert_eq!(rows.accept(&telemetry(4, 3_500)).unwrap().t_s, 0.004);
        assert_eq!((rows.received, rows.missing), (3, 2));
    }

    #[test]
    fn counts_periods_before_the_first_as_missing() {
        let mut rows = TelemetryRows::new(1_000, 900.0);
        assert_eq!(rows.accept(&telemetry(3, 77)).unwrap().t_s, 0.003);
        assert_eq!(rows.missing, 3);
    }

    #[test]
    fn records_force_and_saturation() {
        let mut rows = TelemetryRows::new(1_000, 900.0);
        let at_limit = Telemetry { drive_vpp: 900.0, force_n: Some(0.5), ..telemetry(0, 0) };
        let seen = rows.accept(&at_limit).unwrap();
        assert_eq!(seen.finger_force_n, 0.5);
        assert!(seen.flags.contains(Flags::SATURATED) && rows.force_measured);
        let broken = Telemetry { force_n: Some(f32::NAN), ..telemetry(1, 1_000) };
        assert!(rows.accept(&broken).unwrap().finger_force_n.is_nan());
        let stopped = rows.stop_row().unwrap();
        assert_eq!((stopped.t_s, stopped.drive_vpp), (0.002, 0.0));
        assert_eq!(stopped.flags, Flags::SENSED | Flags::SAFE);
        let fault = Telemetry { state: ControllerState::Fault, drive_vpp: 0.0, ..telemetry(2, 2_000) };
        assert!(rows.accept(&fault).unwrap().flags.contains(Flags::SAFE));
        assert!(rows.stop_row().is_none(), "its telemetry has that row");
    }
}
