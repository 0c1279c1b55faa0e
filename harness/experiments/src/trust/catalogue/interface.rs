//! Lists mutants of protocol and limits, and mutants that only special scenarios reveal.

use crate::trust::mutant_spec::{
    AMPLITUDE, DYNAMICS, FIG13, MutantSpec, NOISE_STORM, REFERENCE, RESPONSE, ReferenceController, SHUTDOWN, SILENCE,
    mutant,
};
use crate::trust::mutants::hooks::{on_command, on_configure, on_sample};
use crate::trust::mutants::line::{NoBadFrameCount, NoChecksumCheck, NoSequenceCheck, RestartAfterStop};
use crate::trust::mutants::plate_changes::{PressLatch, RisingDampingOnly, alternating_drive};
use crate::trust::mutants::protocol::{IgnoredGains, LimitAfterLaw, WrappingCounter, gains_not_finite, stale_answer};
use platebench_model::record::ViolationKind;
use platebench_model::scenario::Metric;

pub(super) fn protocol_mutants() -> Vec<MutantSpec> {
    vec![
        mutant("no-watchdog", "no watchdog: holds its drive when samples stop", SHUTDOWN, SILENCE, || {
            on_configure(|configure| configure.watchdog_timeout_ms = u16::MAX)
        }),
        mutant(
            "nervous-watchdog",
            "watchdog timeout of two periods instead of five",
            &[Metric::PeakDeviation, Metric::RecoveryTime],
            "faults/four-periods-of-silence.toml",
            || on_configure(|configure| configure.watchdog_timeout_ms = (configure.period_us / 500) as u16),
        ),
        mutant("restart-after-timeout", "restarts without a configuration after a timeout", SHUTDOWN, SILENCE, || {
            Box::new(RestartAfterStop::default())
        }),
        mutant("no-storm-limit", "rejected frames not counted", SHUTDOWN, NOISE_STORM, || Box::new(NoBadFrameCount)),
        mutant("no-checksum", "checksum not checked", RESPONSE, "faults/flipped-bit.toml", || {
            Box::new(NoChecksumCheck)
        }),
        mutant(
            "doubled-steps",
            "two control steps for a repeated sample",
            DYNAMICS,
            "faults/doubled-messages.toml",
            || Box::new(NoSequenceCheck::default()),
        ),
    ]
}

/// Mutants that the paper's scenarios do not catch.
pub(super) fn blind_spot_mutants() -> Vec<MutantSpec> {
    vec![
        mutant(
            "drive-at-rest",
            "smallest drive of 10 Vpp, also at setpoint 0",
            &[Metric::RestDrive],
            "guards/rest-drive.toml",
            || on_command(|command| command.drive_vpp = command.drive_vpp.max(10.0)),
        ),
        mutant(
            "low-level-error",
            "sensor table wrong by 3 % below 0.5 µm",
            AMPLITUDE,
            "guards/low-setpoints.toml",
            || {
                on_sample(|sample| {
                    if sample.wd_um.abs() < 0.5 {
                        sample.wd_um *= 0.97;
                    }
                })
            },
        ),
        mutant(
            "press-latch",
            "keeps the drive of a finger that has left",
            &[Metric::PeakDeviation, Metric::RecoveryTime, Metric::StaticError],
            "guards/press-and-lift.toml",
            || Box::new(PressLatch::default()),
        ),
        MutantSpec {
            reference: ReferenceController::Handwritten,
            ..mutant(
                "rising-damping-only",
                "gains follow a rising damping and not a falling one",
                DYNAMICS,
                "guards/falling-damping.toml",
                || Box::new(RisingDampingOnly::default()),
            )
        },
        mutant(
            "steady-ripple",
            "drive alternates by ±2 % from period to period",
            &[Metric::Ripple, Metric::RipplePercent],
            "guards/steady-ripple.toml",
            || alternating_drive(0.02),
        ),
        mutant("fixed-period", "designed for 1 ms at every period", DYNAMICS, "guards/period-2ms.toml", || {
            on_configure(|configure| configure.period_us = 1_000)
        }),
        mutant(
            "ignored-gains",
            "confirms the gains of the configuration and uses its own",
            DYNAMICS,
            "guards/configured-gains.toml",
            || Box::new(IgnoredGains::default()),
        ),
        mutant(
            "limit-after-law",
            "law designed for 900 Vpp, the configured limit applied after it",
            DYNAMICS,
            "guards/out-of-reach.toml",
            || Box::new(LimitAfterLaw::default()),
        ),
    ]
}

pub(super) fn counter_mutants() -> Vec<MutantSpec> {
    const METRICS: &[Metric] =
        &[Metric::SettlingTime, Metric::StaticError, Metric::RecoveryTime, Metric::PeakDeviation];
    vec![
        mutant(
            "wrap-2-16-ms",
            "time in ms as u16, compared for order",
            METRICS,
            "guards/time-stamps-wrap.toml",
            || Box::new(WrappingCounter::new(|time_us| i64::from((time_us / 1_000) as u16))),
        ),
        mutant(
            "wrap-2-31-us",
            "time in µs as i32, compared for order",
            METRICS,
            "guards/time-stamps-wrap.toml",
            || Box::new(WrappingCounter::new(|time_us| i64::from(time_us.cast_signed()))),
        ),
        mutant(
            "wrap-2-32-us",
            "time in µs as u32, compared for order",
            METRICS,
            "guards/time-stamps-wrap.toml",
            || Box::new(WrappingCounter::new(i64::from)),
        ),
    ]
}

/// Mutants that violate rules which the bench checks for every command, without an expectation.
pub(super) fn violating_mutants() -> Vec<MutantSpec> {
    let mutant = |name, description, violations, witness, build| MutantSpec {
        detecting_violations: violations,
        ..mutant(name, description, &[], witness, build)
    };
    vec![
        mutant("clock-of-24-bits", "clock of 24 bits, sent as 32", &[ViolationKind::ClockBackwards], FIG13, || {
            on_command(|command| {
                command.target_time_us = command.target_time_us.wrapping_sub(40_000) & 0x00FF_FFFF;
            })
        }),
        mutant(
            "stale-answer",
            "every 1000th answer is the previous one, with its sequence number",
            &[ViolationKind::WrongSequence, ViolationKind::SecondReply],
            "guards/stale-answers.toml",
            || stale_answer(1_000),
        ),
        mutant(
            "drive-beyond-limit",
            "drive not limited: 10 times too large at the start",
            &[ViolationKind::DriveAboveLimit],
            FIG13,
            || {
                on_command(|command| {
                    if command.drive_vpp > 500.0 {
                        command.drive_vpp *= 10.0;
                    }
                })
            },
        ),
        mutant(
            "negative-drive",
            "drive of -0.5 Vpp instead of 0 Vpp",
            &[ViolationKind::DriveBelowZero],
            "guards/rest-drive.toml",
            || {
                on_command(|command| {
                    if command.drive_vpp == 0.0 {
                        command.drive_vpp = -0.5;
                    }
                })
            },
        ),
        mutant(
            "frequency-in-hz",
            "frequency sent in Hz instead of mHz",
            &[ViolationKind::FrequencyOutOfRange, ViolationKind::FrequencySlew],
            FIG13,
            || on_command(|command| command.frequency_mhz /= 1_000),
        ),
        mutant(
            "gains-not-finite",
            "reports gains that are NaN",
            &[ViolationKind::WrongConfiguration],
            FIG13,
            gains_not_finite,
        ),
    ]
}

pub(super) fn configuration_mutants() -> Vec<MutantSpec> {
    vec![
        mutant(
            "response-time-ignored",
            "configured response time ignored",
            REFERENCE,
            "reference/response-8ms.toml",
            || on_configure(|configure| configure.response_time_s = 0.0),
        ),
        mutant("start-in-whole-hz", "start frequency in whole Hz", REFERENCE, "reference/limits.toml", || {
            on_configure(|configure| configure.start_frequency_mhz -= configure.start_frequency_mhz % 1_000)
        }),
        mutant("range-in-whole-hz", "frequency range and slew in whole Hz", REFERENCE, "reference/limits.toml", || {
            on_configure(|configure| {
                configure.frequency_range_hz = configure.frequency_range_hz.trunc();
                configure.frequency_slew_hz = configure.frequency_slew_hz.trunc();
            })
        }),
        mutant(
            "limit-of-1000-vpp",
            "drive limits above 1000 Vpp taken as 1000 Vpp",
            REFERENCE,
            "reference/high-limit.toml",
            || on_configure(|configure| configure.drive_limit_vpp = configure.drive_limit_vpp.min(1e3)),
        ),
        mutant(
            "infinite-sample-ignored",
            "sample that is not finite taken as 0",
            REFERENCE,
            "reference/stops.toml",
            || {
                on_sample(|sample| {
                    if !sample.wd_um.is_finite() {
                        sample.wd_um = 0.0;
                    }
                })
            },
        ),
    ]
}
