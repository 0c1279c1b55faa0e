//! From telemetry to rows of a trace.

use platebench_plate::Time;
use platebench_trace::{Flags, Row};
use platebench_wire::{State, Telemetry};

/// The amplifier counts as saturated from here on, as a fraction of its limit: the wire carries the limit as f32.
const SATURATED_FROM: f64 = 1.0 - 1e-6;

/// What a piece of telemetry came to.
pub(super) enum Told {
    /// A period that comes after those that were told of so far.
    Row(Row),
    /// Doubled, older than what was told before, or with a number that is none.
    Nothing,
}

/// Puts telemetry in order on the target's own clock, which starts with its period 0.
pub(super) struct Rows {
    period_us: u32,
    limit_vpp: f64,
    last: Option<Last>,
    pub(super) heard: u64,
    pub(super) missing: u64,
    pub(super) force_measured: bool,
}

#[derive(Clone, Copy)]
struct Last {
    period: u32,
    target_time_us: u32,
    /// Since period 0, not wrapping.
    since_start_us: u64,
    row: Row,
}

impl Rows {
    pub(super) fn new(period_us: u32, limit_vpp: f64) -> Self {
        Self { period_us, limit_vpp, last: None, heard: 0, missing: 0, force_measured: false }
    }

    /// How far the trial has got, by what was told last.
    pub(super) fn time(&self) -> Option<Time> {
        self.last.map(|last| Time::from_nanos(last.since_start_us * 1_000))
    }

    pub(super) fn take(&mut self, told: &Telemetry) -> Told {
        let numbers = [told.setpoint_um, told.wd_um, told.wq_um, told.drive_vpp];
        if !numbers.iter().all(|number| number.is_finite()) {
            return Told::Nothing;
        }
        let since_start_us = match self.last {
            // Those before the first that was heard took their time.
            None => u64::from(told.period) * u64::from(self.period_us),
            Some(last) => {
                let (periods, span) =
                    (told.period.wrapping_sub(last.period), told.target_time_us.wrapping_sub(last.target_time_us));
                // Half of what a number holds lies behind.
                if periods == 0 || span == 0 || periods > u32::MAX / 2 || span > u32::MAX / 2 {
                    return Told::Nothing;
                }
                self.missing += u64::from(periods - 1);
                last.since_start_us + u64::from(span)
            }
        };
        if self.last.is_none() {
            self.missing += u64::from(told.period);
        }
        self.heard += 1;
        let force = told.force_n.filter(|force| force.is_finite());
        self.force_measured |= force.is_some();
        let [setpoint_um, wd_um, wq_um, drive_vpp] = numbers.map(f64::from);
        let also = [
            (drive_vpp >= self.limit_vpp * SATURATED_FROM, Flags::SATURATED),
            (told.state != State::Running, Flags::SAFE),
        ];
        let row = Row {
            t_s: since_start_us as f64 / 1e6,
            setpoint_um,
            wd_um,
            wq_um,
            amplitude_um: wd_um.hypot(wq_um),
            drive_vpp,
            frequency_hz: f64::from(told.frequency_mhz) / 1e3,
            resonance_hz: f64::NAN,
            temperature_offset_k: f64::NAN,
            finger_force_n: force.map_or(f64::NAN, f64::from),
            sensed_wd_um: wd_um,
            sensed_wq_um: wq_um,
            lateness_us: 0.0,
            flags: also
                .into_iter()
                .filter(|(holds, _)| *holds)
                .fold(Flags::CONTROL | Flags::SENSED, |flags, (_, flag)| flags | flag),
        };
        let Telemetry { period, target_time_us, .. } = *told;
        self.last = Some(Last { period, target_time_us, since_start_us, row });
        Told::Row(row)
    }

    /// The row that a controller leaves which has stopped and tells no more: at 0 V by its own account, a period after its last.
    pub(super) fn stopped(&self) -> Option<Row> {
        let last = self.last.filter(|last| !last.row.flags.contains(Flags::SAFE))?;
        let t_s = (last.since_start_us + u64::from(self.period_us)) as f64 / 1e6;
        Some(Row { t_s, drive_vpp: 0.0, flags: Flags::SENSED | Flags::SAFE, ..last.row })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use platebench_wire::StateCause;

    fn told(period: u32, target_time_us: u32) -> Telemetry {
        Telemetry {
            period,
            target_time_us,
            setpoint_um: 2.0,
            wd_um: 1.5,
            wq_um: -2.0,
            drive_vpp: 400.0,
            frequency_mhz: 32_307_600,
            force_n: None,
            state: State::Running,
            cause: StateCause::None,
            flags: 0,
        }
    }

    fn row(rows: &mut Rows, told: &Telemetry) -> Option<Row> {
        match rows.take(told) {
            Told::Row(row) => Some(row),
            Told::Nothing => None,
        }
    }

    #[test]
    fn the_clock_is_the_target_s_and_starts_with_its_first_period() {
        let mut rows = Rows::new(1_000, 900.0);
        let first = row(&mut rows, &told(0, u32::MAX - 499)).unwrap();
        assert_eq!((first.t_s, first.amplitude_um, first.flags), (0.0, 2.5, Flags::CONTROL | Flags::SENSED));
        assert!(first.finger_force_n.is_nan() && first.resonance_hz.is_nan());
        // Across the wrap.
        assert_eq!(row(&mut rows, &told(1, 510)).unwrap().t_s, 0.001_010);
        // Doubled, and older than what was told.
        assert!(row(&mut rows, &told(1, 510)).is_none() && row(&mut rows, &told(0, u32::MAX - 499)).is_none());
        assert!(row(&mut rows, &Telemetry { wd_um: f32::NAN, ..told(2, 1_500) }).is_none());
        assert_eq!(row(&mut rows, &told(4, 3_500)).unwrap().t_s, 0.004);
        assert_eq!((rows.heard, rows.missing), (3, 2));
    }

    #[test]
    fn periods_before_the_first_that_was_heard_are_missing() {
        let mut rows = Rows::new(1_000, 900.0);
        assert_eq!(row(&mut rows, &told(3, 77)).unwrap().t_s, 0.003);
        assert_eq!(rows.missing, 3);
    }

    #[test]
    fn force_and_limits_are_told_where_they_are_known() {
        let mut rows = Rows::new(1_000, 900.0);
        let at_limit = Telemetry { drive_vpp: 900.0, force_n: Some(0.5), ..told(0, 0) };
        let seen = row(&mut rows, &at_limit).unwrap();
        assert_eq!(seen.finger_force_n, 0.5);
        assert!(seen.flags.contains(Flags::SATURATED) && rows.force_measured);
        let broken = Telemetry { force_n: Some(f32::NAN), ..told(1, 1_000) };
        assert!(row(&mut rows, &broken).unwrap().finger_force_n.is_nan());
        let stopped = rows.stopped().unwrap();
        assert_eq!((stopped.t_s, stopped.drive_vpp), (0.002, 0.0));
        assert_eq!(stopped.flags, Flags::SENSED | Flags::SAFE);
        let fault = Telemetry { state: State::Fault, drive_vpp: 0.0, ..told(2, 2_000) };
        assert!(row(&mut rows, &fault).unwrap().flags.contains(Flags::SAFE));
        assert!(rows.stopped().is_none(), "it has told that itself");
    }
}
