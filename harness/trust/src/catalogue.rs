//! Lists the mutants, each with the metrics that should detect it.

use crate::mutant_controller::{Mutant, MutantController};
use crate::mutants::clean::{ByteWiseReads, OtherGains, OwnClock, ReportedComputeTime};
use crate::mutants::excitation::{InvertedFrequency, SinglePrecisionPhase, round_to_timer_ticks};
use crate::mutants::line::{NoBadFrameCount, NoChecksumCheck, NoSequenceCheck, RestartAfterStop};
use crate::mutants::loops::{HandwrittenLoops, Omission};
use crate::mutants::plate_changes::{AlternatingDrive, PressLatch, RisingDampingOnly};
use crate::mutants::protocol::{IgnoredGains, LimitAfterLaw, OnConfigured, StaleAnswer, WrappingCounter};
use crate::mutants::timing::{CommandJitter, LowPassFilter, RepeatedCommand, SlowSetpoint, StaleSample};
use crate::mutants::values::{NoMutation, OnCommand, OnConfigure, OnSample, TightPlausibilityLimit, round_to_step};
use platebench_record::ViolationKind;
use platebench_rig::{BoxedLink, HostedLink};
use platebench_scenario::Metric;
use platebench_wire::LawId;
use std::time::Duration;

/// A mutant without its mistake. An expectation that the reference fails catches no mutant.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ReferenceController {
    /// The firmware.
    Firmware,
    /// The firmware with independent PI loops instead of its `dq-pi`.
    Handwritten,
}

impl ReferenceController {
    /// Every reference.
    pub const ALL: [Self; 2] = [Self::Firmware, Self::Handwritten];

    /// A link to the controller without a mistake.
    pub fn link(self) -> BoxedLink {
        match self {
            Self::Firmware => Box::new(HostedLink::new()),
            Self::Handwritten => Box::new(MutantController::new(HostedLink::new(), || {
                Box::new(HandwrittenLoops::without(Omission::Nothing))
            })),
        }
    }
}

/// A mutant of the catalogue.
#[derive(Debug, Clone, Copy)]
pub struct MutantSpec {
    /// Unique name.
    pub name: &'static str,
    /// The mistake, in one line.
    pub description: &'static str,
    /// Metrics that should detect it; a failure of another metric is the wrong reason.
    pub detecting_metrics: &'static [Metric],
    /// Violations of the protocol that should detect it.
    pub detecting_violations: &'static [ViolationKind],
    /// A scenario that detects it by one of these metrics or violations.
    pub witness_scenario: &'static str,
    /// The controller without the mistake.
    pub reference: ReferenceController,
    /// Creates the mutant for a trial.
    pub build: fn() -> Box<dyn Mutant>,
}

impl MutantSpec {
    /// A link to a hosted controller with the mistake.
    pub fn link(&self) -> BoxedLink {
        Box::new(MutantController::new(HostedLink::new(), self.build))
    }

    /// A mutant without a mistake, which must survive.
    pub fn unmutated() -> Self {
        Self {
            name: "unmutated",
            description: "none",
            detecting_metrics: &Metric::ALL,
            detecting_violations: &[],
            witness_scenario: "paper/fig13-closed-loop.toml",
            reference: ReferenceController::Firmware,
            build: || Box::new(NoMutation),
        }
    }
}

const AMPLITUDE: &[Metric] = &[Metric::StaticError];
const DYNAMICS: &[Metric] =
    &[Metric::SettlingTime, Metric::Overshoot, Metric::RecoveryTime, Metric::PeakDeviation, Metric::DrivePeak];
const DISTURBANCE: &[Metric] = &[Metric::PeakDeviation, Metric::RecoveryTime];
const RESONANCE: &[Metric] = &[Metric::FrequencyError, Metric::QuadratureRatio];
const SHUTDOWN: &[Metric] = &[Metric::ShutdownTime];
const RESPONSE: &[Metric] = &[Metric::Overshoot, Metric::SettlingTime, Metric::StaticError, Metric::MissedReplies];

const FIG13: &str = "paper/fig13-closed-loop.toml";
const FIG14: &str = "paper/fig14-closed-loop.toml";
const FIG15: &str = "paper/fig15-frequency.toml";
const FIG16: &str = "paper/fig16-closed-loop.toml";
const TEMPERATURE_RAMP: &str = "paper/temperature-ramp.toml";
const DRUMMING_FINGER: &str = "guards/drumming-finger.toml";
const SILENCE: &str = "faults/five-periods-of-silence.toml";
const NOISE_STORM: &str = "faults/noise-storm.toml";

const fn mutant(
    name: &'static str,
    description: &'static str,
    detecting_metrics: &'static [Metric],
    witness_scenario: &'static str,
    build: fn() -> Box<dyn Mutant>,
) -> MutantSpec {
    let reference = ReferenceController::Firmware;
    MutantSpec { name, description, detecting_metrics, detecting_violations: &[], witness_scenario, reference, build }
}

const fn handwritten_mutant(
    name: &'static str,
    description: &'static str,
    detecting_metrics: &'static [Metric],
    witness_scenario: &'static str,
    build: fn() -> Box<dyn Mutant>,
) -> MutantSpec {
    let reference = ReferenceController::Handwritten;
    MutantSpec { reference, ..mutant(name, description, detecting_metrics, witness_scenario, build) }
}

/// A correct controller that differs from the firmware.
#[derive(Debug, Clone, Copy)]
pub struct CleanVariant {
    /// Unique name.
    pub name: &'static str,
    /// The difference, in one line.
    pub description: &'static str,
    build: fn() -> Box<dyn Mutant>,
}

impl CleanVariant {
    /// A link to the hosted controller with the difference.
    pub fn link(&self) -> BoxedLink {
        Box::new(MutantController::new(HostedLink::new(), self.build))
    }
}

/// Every clean variant.
pub fn clean_variants() -> Vec<CleanVariant> {
    let variant = |name, description, build| CleanVariant { name, description, build };
    vec![
        variant("gains-plus-5", "amplitude gains 5 % higher", || Box::new(OtherGains(1.0 / 1.05))),
        variant("compute-time", "reports 200 µs per control step", || Box::new(ReportedComputeTime)),
        variant("own-clock", "clock with another start, which wraps and is 100 ppm fast", || Box::new(OwnClock)),
        variant("byte-wise", "reads and writes byte by byte", || Box::new(ByteWiseReads)),
    ]
}

/// Every mutant.
pub fn catalogue() -> Vec<MutantSpec> {
    [
        amplitude_mutants(),
        resonance_mutants(),
        timing_mutants(),
        drive_limit_mutants(),
        law_mutants(),
        protocol_mutants(),
        blind_spot_mutants(),
        counter_mutants(),
        violating_mutants(),
    ]
    .concat()
}

/// Mistakes in sample, setpoint and drive.
fn amplitude_mutants() -> Vec<MutantSpec> {
    vec![
        mutant(
            "drive-gain-doubled",
            "drive computed in peak, sent as peak to peak: a gain of 2",
            DYNAMICS,
            FIG13,
            || Box::new(OnCommand(|command| command.drive_vpp *= 2.0)),
        ),
        mutant("drive-gain-halved", "amplifier set to half of its gain", DYNAMICS, FIG13, || {
            Box::new(OnCommand(|command| command.drive_vpp *= 0.5))
        }),
        mutant(
            "setpoint-scale",
            "setpoint scaled by the calibration of another plate, 2 % off",
            AMPLITUDE,
            FIG13,
            || Box::new(OnSample(|sample| sample.setpoint_um *= 1.02)),
        ),
        mutant(
            "peak-for-peak-to-peak",
            "amplitude measured in peak, setpoint in peak to peak",
            AMPLITUDE,
            FIG13,
            || {
                Box::new(OnSample(|sample| {
                    sample.wd_um *= 0.5;
                    sample.wq_um *= 0.5;
                }))
            },
        ),
        mutant(
            "sensor-offset",
            "demodulator offset not trimmed: 10 nm on Wd, 0.5 % of 2 µm",
            AMPLITUDE,
            FIG13,
            || Box::new(OnSample(|sample| sample.wd_um += 0.01)),
        ),
        mutant(
            "setpoint-drift",
            "reference voltage of the setpoint drifts, 0.5 % in a minute",
            &[Metric::StaticError, Metric::PeakDeviation],
            TEMPERATURE_RAMP,
            || Box::new(OnSample(|sample| sample.setpoint_um *= 1.0 + 0.005 * sample.time_us as f32 / 60e6)),
        ),
        mutant(
            "coarse-sensor",
            "8 of the converter's 12 bits used: steps of 20 nm",
            &[Metric::StaticError, Metric::PeakDeviation],
            FIG13,
            || {
                Box::new(OnSample(|sample| {
                    sample.wd_um = round_to_step(sample.wd_um, 0.02);
                    sample.wq_um = round_to_step(sample.wq_um, 0.02);
                }))
            },
        ),
        mutant(
            "coarse-drive",
            "8-bit converter for 900 Vpp: steps of 3.5 Vpp",
            &[Metric::StaticError, Metric::PeakDeviation],
            TEMPERATURE_RAMP,
            || Box::new(OnCommand(|command| command.drive_vpp = round_to_step(command.drive_vpp, 900.0 / 255.0))),
        ),
    ]
}

/// Mistakes in the excitation frequency.
fn resonance_mutants() -> Vec<MutantSpec> {
    vec![
        mutant("swapped-components", "Wd and Wq swapped", AMPLITUDE, FIG13, || {
            Box::new(OnSample(|sample| std::mem::swap(&mut sample.wd_um, &mut sample.wq_um)))
        }),
        mutant("frequency-sign", "frequency loop with the wrong sign", RESONANCE, FIG15, || {
            Box::new(InvertedFrequency::default())
        }),
        mutant(
            "coarse-frequency",
            "excitation from a timer at 84 MHz: whole ticks, steps of 12 Hz",
            RESONANCE,
            FIG15,
            || Box::new(OnCommand(|command| command.frequency_mhz = round_to_timer_ticks(command.frequency_mhz, 84e6))),
        ),
        mutant(
            "single-phase",
            "phase of the demodulator kept as f32, in radians since the start",
            RESONANCE,
            TEMPERATURE_RAMP,
            || Box::new(SinglePrecisionPhase::default()),
        ),
        mutant("only-at-24-degrees", "frequency fixed at the resonance of 24 °C", RESONANCE, TEMPERATURE_RAMP, || {
            Box::new(OnCommand(|command| command.frequency_mhz = 32_307_600))
        }),
    ]
}

/// Mistakes in timing.
fn timing_mutants() -> Vec<MutantSpec> {
    vec![
        mutant("stale-sample", "uses the sample of the previous period", DYNAMICS, FIG13, || {
            Box::new(StaleSample::default())
        }),
        mutant("late-every-100th", "every 100th command one period late", DISTURBANCE, DRUMMING_FINGER, || {
            Box::new(RepeatedCommand::every(100))
        }),
        mutant(
            "half-rate",
            "control step in every second period, with the gains of every period",
            DYNAMICS,
            FIG13,
            || Box::new(RepeatedCommand::every(2)),
        ),
        mutant(
            "jitter",
            "interrupt of higher priority: commands up to 0.4 ms late, at random",
            &[Metric::SettlingTime, Metric::Overshoot, Metric::PeakDeviation, Metric::RecoveryTime, Metric::LoopDelay],
            FIG13,
            || Box::new(CommandJitter::up_to(Duration::from_micros(400))),
        ),
        mutant("slow-setpoint", "setpoint read in a task of 10 ms", &[Metric::SettlingTime], FIG13, || {
            Box::new(SlowSetpoint::every(10))
        }),
        mutant("smoothed-sample", "low-pass on the sample that the design ignores", DYNAMICS, FIG13, || {
            Box::new(LowPassFilter::new(0.5))
        }),
    ]
}

/// Mistakes in the drive limit.
fn drive_limit_mutants() -> Vec<MutantSpec> {
    vec![
        mutant(
            "limit-too-low",
            "drive limit of an older amplifier, 600 Vpp",
            &[Metric::StaticError, Metric::SettlingTime, Metric::DrivePeak, Metric::PeakDeviation],
            FIG16,
            || Box::new(OnCommand(|command| command.drive_vpp = command.drive_vpp.min(600.0))),
        ),
        mutant(
            "limit-ignored",
            "law designed without the amplifier's limit",
            DYNAMICS,
            "guards/out-of-reach.toml",
            || Box::new(OnConfigure(|configure| configure.drive_limit_vpp *= 10.0)),
        ),
        mutant(
            "only-untouched",
            "plausibility limit of the drive at 110 % of the untouched plate's",
            &[Metric::StaticError, Metric::SettlingTime, Metric::PeakDeviation, Metric::RecoveryTime],
            FIG16,
            || Box::new(TightPlausibilityLimit::new(1.1)),
        ),
    ]
}

/// Mistakes in the control law.
fn law_mutants() -> Vec<MutantSpec> {
    vec![
        mutant("untouched-gains", "gains of the untouched plate under a finger", DYNAMICS, FIG16, || {
            Box::new(OnConfigure(|configure| {
                if configure.law == LawId::DqPi {
                    configure.law = LawId::DqPiFixed;
                }
            }))
        }),
        mutant("printed-gains", "equation 24 as printed, not matched to the period of 1 ms", DYNAMICS, FIG13, || {
            Box::new(OnConfigure(|configure| {
                if configure.law == LawId::DqPi {
                    configure.law = LawId::DqPiEuler;
                }
            }))
        }),
        handwritten_mutant("integral-missing", "amplitude loop without its integral", AMPLITUDE, FIG13, || {
            Box::new(HandwrittenLoops::without(Omission::AmplitudeIntegral))
        }),
        handwritten_mutant(
            "frequency-integral-missing",
            "frequency loop without its integral",
            RESONANCE,
            FIG14,
            || Box::new(HandwrittenLoops::without(Omission::FrequencyIntegral)),
        ),
        handwritten_mutant(
            "no-anti-windup",
            "integral grows while the amplifier is at its limit",
            DYNAMICS,
            "paper/setpoint-steps.toml",
            || Box::new(HandwrittenLoops::without(Omission::AntiWindup)),
        ),
        handwritten_mutant(
            "small-wd",
            "divides by a Wd near zero",
            &[Metric::SettlingTime, Metric::FrequencyError, Metric::QuadratureRatio],
            "guards/noise-at-rest.toml",
            || Box::new(HandwrittenLoops::without(Omission::SmallWdGuard)),
        ),
    ]
}

/// Mistakes in the wire protocol.
fn protocol_mutants() -> Vec<MutantSpec> {
    vec![
        mutant("no-watchdog", "no watchdog: holds its drive when samples stop", SHUTDOWN, SILENCE, || {
            Box::new(OnConfigure(|configure| configure.watchdog_timeout_ms = u16::MAX))
        }),
        mutant(
            "nervous-watchdog",
            "watchdog timeout of two periods instead of five",
            &[Metric::PeakDeviation, Metric::RecoveryTime],
            "faults/four-periods-of-silence.toml",
            || Box::new(OnConfigure(|configure| configure.watchdog_timeout_ms = (configure.period_us / 500) as u16)),
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

/// Mistakes that show only away from the paper's scenarios.
fn blind_spot_mutants() -> Vec<MutantSpec> {
    vec![
        mutant(
            "drive-at-rest",
            "smallest drive of 10 Vpp, also at setpoint 0",
            &[Metric::RestDrive],
            "guards/rest-drive.toml",
            || Box::new(OnCommand(|command| command.drive_vpp = command.drive_vpp.max(10.0))),
        ),
        mutant(
            "low-level-error",
            "sensor table wrong by 3 % below 0.5 µm",
            AMPLITUDE,
            "guards/low-setpoints.toml",
            || {
                Box::new(OnSample(|sample| {
                    if sample.wd_um.abs() < 0.5 {
                        sample.wd_um *= 0.97;
                    }
                }))
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
            || Box::new(AlternatingDrive::new(0.02)),
        ),
        mutant("fixed-period", "designed for 1 ms at every period", DYNAMICS, "guards/period-2ms.toml", || {
            Box::new(OnConfigure(|configure| configure.period_us = 1_000))
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

/// Counters of the sample time that wrap.
fn counter_mutants() -> Vec<MutantSpec> {
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

/// Mistakes that the checks of every command detect, whatever the scenario expects.
fn violating_mutants() -> Vec<MutantSpec> {
    let mutant = |name, description, violations, witness, build| MutantSpec {
        detecting_violations: violations,
        ..mutant(name, description, &[], witness, build)
    };
    vec![
        mutant(
            "stale-answer",
            "every 1000th answer is the previous one, with its sequence number",
            &[ViolationKind::WrongSequence, ViolationKind::SecondReply],
            "guards/stale-answers.toml",
            || Box::new(StaleAnswer::every(1_000)),
        ),
        mutant(
            "drive-beyond-limit",
            "drive not limited: 10 times too large at the start",
            &[ViolationKind::DriveAboveLimit],
            FIG13,
            || {
                Box::new(OnCommand(|command| {
                    if command.drive_vpp > 500.0 {
                        command.drive_vpp *= 10.0;
                    }
                }))
            },
        ),
        mutant(
            "negative-drive",
            "drive of -0.5 Vpp instead of 0 Vpp",
            &[ViolationKind::DriveBelowZero],
            "guards/rest-drive.toml",
            || {
                Box::new(OnCommand(|command| {
                    if command.drive_vpp == 0.0 {
                        command.drive_vpp = -0.5;
                    }
                }))
            },
        ),
        mutant(
            "frequency-in-hz",
            "frequency sent in Hz instead of mHz",
            &[ViolationKind::FrequencyOutOfRange, ViolationKind::FrequencySlew],
            FIG13,
            || Box::new(OnCommand(|command| command.frequency_mhz /= 1_000)),
        ),
        mutant("gains-not-finite", "reports gains that are NaN", &[ViolationKind::WrongConfiguration], FIG13, || {
            Box::new(OnConfigured(|gains| gains.amplitude_ki = f32::NAN))
        }),
    ]
}
