//! Lists faults of the protocol, which were written from `docs/wire-protocol.md` after the suite.
//! The table of `docs/trust.md` names the rule that each one breaks.

use crate::trust::catalogue::{MutantSpec, REFERENCE, SLOW_RAMP, SLOW_SETPOINT, mutant};
use crate::trust::mutants::{on_any_command, on_command, on_configure, on_message, on_sample};
use crate::trust::protocol_mutants::{
    AnswerKept, ConfigurationMark, EchoCounted, FrequencyKept, InvalidBodyNotCounted, KeptAnswer,
    NoChecksumAfterRejected, Number0AsForgotten, OwnLaw, RejectedCountKept, SecondStopNotReported, UnknownLawAnswered,
    UnusedGainsChecked, ZeroDelayAccepted, flags_kept_in_stop, has_negative_gain, refuse, send_one_flag,
    setpoint_list_full, slow_ramp_lost,
};
use crate::trust::watchdog_mutants::{OwnWatchdog, ValuesBeforeWatchdog, WatchdogFault};
use platebench_model::record::ViolationKind;
use platebench_model::scenario::Metric;

/// Scenarios that catch the faults which they name; no scenario catches the others.
const PROTOCOL: &str = "reference/protocol.toml";
const FULL_DELAY: &str = "laws/specified-delay-one-period-dq-pi.toml";

/// Every failure is a right reason: each fault breaks a rule that a correct controller keeps.
const VIOLATIONS: &[ViolationKind] = &[
    ViolationKind::DriveAboveLimit,
    ViolationKind::DriveBelowZero,
    ViolationKind::FrequencyOutOfRange,
    ViolationKind::FrequencySlew,
    ViolationKind::WrongSequence,
    ViolationKind::SecondReply,
    ViolationKind::WrongConfiguration,
    ViolationKind::DriveAfterSafe,
    ViolationKind::IgnoredSafe,
    ViolationKind::ClockBackwards,
    ViolationKind::UnrequestedSafe,
    ViolationKind::RejectedFrame,
    ViolationKind::StepTime,
    ViolationKind::RefusedConfiguration,
];

pub fn protocol_faults() -> Vec<MutantSpec> {
    let groups =
        [counter_faults(), kept_state_faults(), watchdog_faults(), step_faults(), frame_faults(), value_faults()];
    let judged = |fault| MutantSpec { detecting_metrics: Metric::ALL, detecting_violations: VIOLATIONS, ..fault };
    groups.concat().into_iter().map(judged).collect()
}

/// Counters that overflow late.
fn counter_faults() -> Vec<MutantSpec> {
    vec![
        mutant("clock-of-27-bits", "clock from a counter of 32 bits at 32 MHz: wraps at 2^27 µs instead of 2^32 µs")
            .with(|| on_any_command(|_, command| command.target_time_us &= (1 << 27) - 1)),
        mutant(
            "deadline-without-wrap",
            "watchdog compares clock and deadline without the wrap at 2^32 µs: stops there although samples arrive",
        )
        .with(|| OwnWatchdog::with(WatchdogFault::DeadlineWithoutWrap)),
        mutant(
            "configuration-pool",
            "each configuration takes one of 512 records that nothing releases: the next one is answered with 1",
        )
        .with(|| {
            let mut taken = 0_u32;
            on_configure(move |configure| {
                taken += 1;
                if taken > 512 {
                    refuse(configure);
                }
            })
        }),
        mutant(
            "configuration-mark-of-9-bits",
            "configurations counted in 9 bits, 0 means none: samples after the 512th are answered with idle",
        )
        .with(|| Box::new(ConfigurationMark { marks: 512, accepted: 0 })),
        mutant(
            "step-count-of-17-bits",
            "steps counted in 17 bits, 0 means the first: after 131,072 steps the law starts anew",
        )
        .with(|| OwnLaw::restarted_after(1 << 17)),
    ]
}

/// State that outlives a stop or a configuration.
fn kept_state_faults() -> Vec<MutantSpec> {
    vec![
        mutant("law-state-kept", "a configuration equal to the one before keeps the state of the law")
            .caught_by(REFERENCE, PROTOCOL)
            .with(OwnLaw::kept),
        mutant(
            "rejected-count-kept",
            "counter of rejected frames kept across a configuration, instead of 0 at the first sample",
        )
        .caught_by(REFERENCE, PROTOCOL)
        .with(|| Box::<RejectedCountKept>::default()),
        mutant(
            "answer-kept-after-refusal",
            "configuration answered with 1 or 2 keeps number and answer of the last sample: repeats its drive",
        )
        .with(|| AnswerKept::of(KeptAnswer::AfterRefusal)),
        mutant(
            "frequency-kept",
            "commands between a configuration and its first sample contain the last frequency, not the start frequency",
        )
        .caught_by(REFERENCE, PROTOCOL)
        .with(|| Box::<FrequencyKept>::default()),
        mutant(
            "timeout-kept",
            "watchdog timeout 0 keeps the timeout of the configuration before, instead of five periods",
        )
        .caught_by(REFERENCE, PROTOCOL)
        .with(|| {
            let mut last = 0;
            on_configure(move |configure| {
                if configure.watchdog_timeout_ms == 0 {
                    configure.watchdog_timeout_ms = last;
                }
                last = configure.watchdog_timeout_ms;
            })
        }),
        mutant(
            "gains-kept",
            "configuration without gains keeps the gains of the one before, instead of the law's design",
        )
        .caught_by(REFERENCE, PROTOCOL)
        .with(|| {
            let mut last = None;
            on_configure(move |configure| {
                configure.gains = configure.gains.or(last);
                last = configure.gains;
            })
        }),
        mutant(
            "second-stop-not-reported",
            "mark that a stop was reported outlives the configuration: only the first stop is reported",
        )
        .caught_by(REFERENCE, PROTOCOL)
        .with(|| Box::<SecondStopNotReported>::default()),
        mutant("answer-kept-after-safe", "sample repeated after `safe` is answered with the drive from before")
            .caught_by(REFERENCE, PROTOCOL)
            .with(|| AnswerKept::of(KeptAnswer::AfterSafe)),
    ]
}

fn watchdog_faults() -> Vec<MutantSpec> {
    const CYCLES_PER_MS: u32 = 168_000;
    vec![
        mutant("watchdog-reload-overflow", "timer reload of timeout + 1 in 16 bits: 65,535 ms becomes 1 ms").with(
            || {
                on_configure(|configure| {
                    if configure.watchdog_timeout_ms == u16::MAX {
                        configure.watchdog_timeout_ms = 1;
                    }
                })
            },
        ),
        mutant("watchdog-in-cycles", "timeout in cycles of 168 MHz as u32: wraps above 25,565 ms").with(|| {
            on_configure(|configure| {
                let timeout_ms = configure.watchdog_timeout_ms;
                let cycles = u32::from(timeout_ms).wrapping_mul(CYCLES_PER_MS);
                configure.watchdog_timeout_ms = ((cycles / CYCLES_PER_MS) as u16).max(timeout_ms.min(1));
            })
        }),
        // The controller has no timeout of more than 65,535 ms.
        mutant("watchdog-signed", "timeout as i16: above 32,767 ms it is negative, which means no timeout").with(
            || {
                on_configure(|configure| {
                    if configure.watchdog_timeout_ms.cast_signed() < 0 {
                        configure.watchdog_timeout_ms = u16::MAX;
                    }
                })
            },
        ),
        mutant("five-periods-overflow", "five periods in µs wrap at 2^32: periods above 859 s stop too early").with(
            || {
                on_configure(|configure| {
                    let (timeout_us, overflows) = configure.period_us.overflowing_mul(5);
                    if configure.watchdog_timeout_ms == 0 && overflows {
                        configure.watchdog_timeout_ms = (timeout_us / 1_000).clamp(1, u16::MAX.into()) as u16;
                    }
                })
            },
        ),
        mutant("watchdog-from-second-sample", "watchdog starts with the second sample instead of the first")
            .caught_by(REFERENCE, PROTOCOL)
            .with(|| OwnWatchdog::with(WatchdogFault::FromSecondSample)),
        mutant("watchdog-fed-by-rejected-frames", "any frame restarts the watchdog, rejected ones too")
            .with(|| OwnWatchdog::with(WatchdogFault::FedByRejectedFrames)),
        mutant("watchdog-fed-by-repeats", "repeated sample restarts the watchdog")
            .caught_by(REFERENCE, PROTOCOL)
            .with(|| OwnWatchdog::with(WatchdogFault::FedByRepeats)),
        mutant(
            "watchdog-after-limit",
            "silence compared with > instead of >=: a sample exactly at the timeout is used",
        )
        .with(|| OwnWatchdog::with(WatchdogFault::AfterLimit)),
        mutant("values-before-watchdog", "late sample that is not finite stops with cause 3 instead of 1")
            .with(|| Box::<ValuesBeforeWatchdog>::default()),
        mutant("watchdog-of-10-ms-ticks", "watchdog starts with the next tick of a timer of 10 ms: up to 10 ms late")
            .caught_by(REFERENCE, PROTOCOL)
            .with(|| OwnWatchdog::with(WatchdogFault::Ticks)),
    ]
}

/// Delay, flags and setpoint of a control step.
fn step_faults() -> Vec<MutantSpec> {
    const LARGE_WQ_UM: f32 = 1e6;
    vec![
        mutant("short-delay-ignored", "loop delay below a tenth of the period accepted and not used").with(|| {
            on_configure(|configure| {
                if configure.loop_delay_us < configure.period_us.div_ceil(10) {
                    configure.loop_delay_us = 0;
                }
            })
        }),
        mutant("full-period-delay-refused", "loop delay equal to the period is answered with 1")
            .violating(&[ViolationKind::RefusedConfiguration], FULL_DELAY)
            .with(|| {
                on_configure(|configure| {
                    if configure.loop_delay_us == configure.period_us {
                        refuse(configure);
                    }
                })
            }),
        mutant("one-flag-only", "flags sent as one number: at the limits of drive and frequency flag 1 is missing")
            .caught_by(REFERENCE, PROTOCOL)
            .with(|| on_command(send_one_flag)),
        mutant("flags-kept-in-stop", "command of a stop repeats the flags of the last step, instead of 0")
            .caught_by(REFERENCE, PROTOCOL)
            .with(|| {
                let mut keep = flags_kept_in_stop();
                on_any_command(move |_, command| keep(command))
            }),
        mutant(
            "slow-ramp-lost",
            "setpoint that differs by at most 0.1 nm from the sample before is taken as unchanged: slow ramps are lost",
        )
        .caught_by(SLOW_SETPOINT, SLOW_RAMP)
        .with(|| on_message(slow_ramp_lost(1e-4))),
        mutant(
            "setpoint-list-full",
            "list of 4,096 setpoint changes: later ones are ignored until the next configuration",
        )
        .caught_by(SLOW_SETPOINT, SLOW_RAMP)
        .with(|| on_message(setpoint_list_full(4_096))),
        mutant("infinite-wq-accepted", "infinite Wq clipped to a large number instead of a stop with cause 3")
            .caught_by(REFERENCE, PROTOCOL)
            .with(|| {
                on_sample(|sample| {
                    if sample.wq_um.is_infinite() {
                        sample.wq_um = LARGE_WQ_UM.copysign(sample.wq_um);
                    }
                })
            }),
    ]
}

fn frame_faults() -> Vec<MutantSpec> {
    vec![
        mutant("no-checksum-after-rejected", "CRC of the frame after a rejected one not checked")
            .caught_by(REFERENCE, PROTOCOL)
            .with(|| Box::<NoChecksumAfterRejected>::default()),
        mutant("echo-counted", "messages that only a controller sends counted as rejected frames")
            .caught_by(REFERENCE, PROTOCOL)
            .with(|| Box::new(EchoCounted)),
        mutant("invalid-body-not-counted", "frame with a valid CRC and an invalid body not counted as rejected")
            .caught_by(REFERENCE, PROTOCOL)
            .with(|| Box::new(InvalidBodyNotCounted)),
        mutant(
            "number-0-as-forgotten",
            "forgotten number of the last sample stored as 0: a first sample with number 0 is taken as repeated",
        )
        .caught_by(REFERENCE, PROTOCOL)
        .with(Number0AsForgotten::at_power_on),
    ]
}

/// Values of a configuration at the ends of their ranges.
fn value_faults() -> Vec<MutantSpec> {
    vec![
        mutant("zero-slew-accepted", "slew of 0 accepted as a fixed frequency, instead of answered with 1")
            .caught_by(REFERENCE, PROTOCOL)
            .with(|| {
                on_configure(|configure| {
                    if configure.frequency_slew_hz == 0.0 {
                        configure.frequency_slew_hz = f32::MIN_POSITIVE;
                    }
                })
            }),
        mutant(
            "zero-delay-accepted",
            "loop delay of 0 with bit 2 accepted as no delay, instead of rejected as a message",
        )
        .caught_by(REFERENCE, PROTOCOL)
        .with(|| Box::new(ZeroDelayAccepted)),
        mutant(
            "unknown-law-answered",
            "law number that the page does not list answered with 2, instead of rejected as a message",
        )
        .caught_by(REFERENCE, PROTOCOL)
        .with(|| Box::<UnknownLawAnswered>::default()),
        mutant(
            "start-frequency-in-f32",
            "start frequency stored as f32 in mHz: a multiple of 2 above 16,777 Hz, of 4 above 33,554 Hz",
        )
        .with(|| on_configure(|configure| configure.start_frequency_mhz = configure.start_frequency_mhz as f32 as u32)),
        mutant("negative-gain-refused", "configured gain below 0 answered with 1").caught_by(REFERENCE, PROTOCOL).with(
            || {
                on_configure(|configure| {
                    if configure.gains.as_ref().is_some_and(has_negative_gain) {
                        refuse(configure);
                    }
                })
            },
        ),
        mutant("unused-gains-checked", "gains that are not finite answered with 1 although bit 0 is not set")
            .caught_by(REFERENCE, PROTOCOL)
            .with(|| Box::new(UnusedGainsChecked)),
    ]
}
