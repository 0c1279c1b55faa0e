//! Lists the mutants, each with the metrics that should detect it, and the correct controllers that
//! differ from the firmware.

use crate::trust::mutant_controller::{Mutant, MutantController};
use crate::trust::mutants::{
    ByteWiseReads, CommandJitter, HandwrittenLoops, NoBadFrameCount, NoChecksumCheck, NoSequenceCheck, Omission,
    RestartAfterStop, RisingDampingOnly, alternating_drive, gains_not_finite, ignored_gains, inverted_frequency,
    limit_after_law, low_pass_filter, off_after_61_s, on_command, on_configure, on_sample, other_gains, own_clock,
    press_latch, repeated_command, reported_compute_time, round_to_step, round_to_timer_ticks,
    sample_counter_of_16_bits, single_precision_phase, sleep_at_rest, slow_setpoint, small_changes_ignored,
    stale_answer, stale_sample, tight_plausibility_limit, wrapping_counter,
};
use platebench_model::record::ViolationKind;
use platebench_model::scenario::Metric;
use platebench_rig::{BoxedLink, HostedLink};
use platebench_wire::{LawId, Message};
use std::time::Duration;

const AMPLITUDE: &[Metric] = &[Metric::StaticError];
const DYNAMICS: &[Metric] =
    &[Metric::SettlingTime, Metric::Overshoot, Metric::RecoveryTime, Metric::PeakDeviation, Metric::DrivePeak];
const DISTURBANCE: &[Metric] = &[Metric::PeakDeviation, Metric::RecoveryTime];
const RESONANCE: &[Metric] = &[Metric::FrequencyError, Metric::QuadratureRatio];
pub(crate) const REFERENCE: &[Metric] = &[Metric::ReferenceDifference, Metric::ProtocolDifferences];
pub(crate) const SLOW_SETPOINT: &[Metric] = &[Metric::PeakDeviation];
const SHUTDOWN: &[Metric] = &[Metric::ShutdownTime];
const RESPONSE: &[Metric] = &[Metric::Overshoot, Metric::SettlingTime, Metric::StaticError, Metric::MissedReplies];

const FIG13: &str = "paper/fig13-closed-loop.toml";
const FIG14: &str = "paper/fig14-closed-loop.toml";
const FIG15: &str = "paper/fig15-frequency.toml";
const FIG16: &str = "paper/fig16-closed-loop.toml";
const TEMPERATURE_RAMP: &str = "paper/temperature-ramp.toml";
const DRUMMING_FINGER: &str = "guards/drumming-finger.toml";
pub(crate) const SLOW_RAMP: &str = "guards/slow-setpoint-ramp.toml";
const AFTER_A_MINUTE: &str = "guards/after-a-minute.toml";
const SILENCE: &str = "faults/five-periods-of-silence.toml";
const NOISE_STORM: &str = "faults/noise-storm.toml";

/// Correct controller for comparison. An expectation that it fails catches no mutant.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ReferenceController {
    Firmware,
    /// The firmware, with `dq-pi` replaced by an independent implementation of the PI loops.
    Handwritten,
}

impl ReferenceController {
    pub const ALL: [Self; 2] = [Self::Firmware, Self::Handwritten];

    pub fn link(self) -> BoxedLink {
        match self {
            Self::Firmware => Box::new(HostedLink::new()),
            Self::Handwritten => link(|| HandwrittenLoops::without(Omission::Nothing)),
        }
    }
}

fn link(build: fn() -> Box<dyn Mutant>) -> BoxedLink {
    Box::new(MutantController::new(HostedLink::new(), build))
}

/// A correct controller that differs from the firmware.
#[derive(Debug, Clone, Copy)]
pub struct CleanVariant {
    pub name: &'static str,
    pub description: &'static str,
    build: fn() -> Box<dyn Mutant>,
}

impl CleanVariant {
    pub fn link(&self) -> BoxedLink {
        link(self.build)
    }
}

pub fn clean_variants() -> Vec<CleanVariant> {
    let variant = |name, description, build| CleanVariant { name, description, build };
    vec![
        variant("gains-plus-5", "amplitude gains 5 % higher", || other_gains(1.0 / 1.05)),
        variant("compute-time", "reports 200 µs per control step", reported_compute_time),
        variant("own-clock", "clock with another start, which wraps and is 100 ppm fast", own_clock),
        variant("byte-wise", "reads and writes byte by byte", || Box::new(ByteWiseReads)),
    ]
}

#[derive(Debug, Clone, Copy)]
pub struct MutantSpec {
    pub name: &'static str,
    pub description: &'static str,
    /// Metrics that should detect the mutant, besides `REFERENCE`. Others are a wrong reason.
    pub detecting_metrics: &'static [Metric],
    pub detecting_violations: &'static [ViolationKind],
    /// Scenario in which one of these metrics or violations must detect the mutant. Empty if no
    /// scenario detects it.
    pub witness_scenario: &'static str,
    pub reference: ReferenceController,
    pub build: fn() -> Box<dyn Mutant>,
}

/// A mutant without mistakes, detecting metrics and witness, which the following methods set.
pub(crate) fn mutant(name: &'static str, description: &'static str) -> MutantSpec {
    MutantSpec {
        name,
        description,
        detecting_metrics: &[],
        detecting_violations: &[],
        witness_scenario: "",
        reference: ReferenceController::Firmware,
        build: || Box::new(|_: &mut Message| {}),
    }
}

impl MutantSpec {
    pub fn link(&self) -> BoxedLink {
        link(self.build)
    }

    pub(crate) const fn caught_by(self, detecting_metrics: &'static [Metric], witness_scenario: &'static str) -> Self {
        Self { detecting_metrics, witness_scenario, ..self }
    }

    pub(crate) const fn violating(
        self,
        detecting_violations: &'static [ViolationKind],
        witness_scenario: &'static str,
    ) -> Self {
        Self { detecting_violations, witness_scenario, ..self }
    }

    const fn against(self, reference: ReferenceController) -> Self {
        Self { reference, ..self }
    }

    pub(crate) fn with(self, build: fn() -> Box<dyn Mutant>) -> Self {
        Self { build, ..self }
    }
}

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
        long_trial_mutants(),
        violating_mutants(),
        configuration_mutants(),
    ]
    .concat()
}

fn amplitude_mutants() -> Vec<MutantSpec> {
    vec![
        mutant("drive-gain-doubled", "drive computed in peak, sent as peak to peak: a gain of 2")
            .caught_by(DYNAMICS, FIG13)
            .with(|| on_command(|command| command.drive_vpp *= 2.0)),
        mutant("drive-gain-halved", "amplifier set to half of its gain")
            .caught_by(DYNAMICS, FIG13)
            .with(|| on_command(|command| command.drive_vpp *= 0.5)),
        mutant("setpoint-scale", "setpoint scaled by the calibration of another plate, 2 % off")
            .caught_by(AMPLITUDE, FIG13)
            .with(|| on_sample(|sample| sample.setpoint_um *= 1.02)),
        mutant("peak-for-peak-to-peak", "amplitude measured in peak, setpoint in peak to peak")
            .caught_by(AMPLITUDE, FIG13)
            .with(|| {
                on_sample(|sample| {
                    sample.wd_um *= 0.5;
                    sample.wq_um *= 0.5;
                })
            }),
        mutant("sensor-offset", "demodulator offset not trimmed: 10 nm on Wd, 0.5 % of 2 µm")
            .caught_by(AMPLITUDE, FIG13)
            .with(|| on_sample(|sample| sample.wd_um += 0.01)),
        mutant("setpoint-drift", "reference voltage of the setpoint drifts, 0.5 % in a minute")
            .caught_by(&[Metric::StaticError, Metric::PeakDeviation], TEMPERATURE_RAMP)
            .with(|| on_sample(|sample| sample.setpoint_um *= 1.0 + 0.005 * sample.time_us as f32 / 60e6)),
        mutant("coarse-sensor", "8 of the converter's 12 bits used: steps of 20 nm")
            .caught_by(&[Metric::StaticError, Metric::PeakDeviation], FIG13)
            .with(|| {
                on_sample(|sample| {
                    sample.wd_um = round_to_step(sample.wd_um, 0.02);
                    sample.wq_um = round_to_step(sample.wq_um, 0.02);
                })
            }),
        mutant("coarse-drive", "8-bit converter for 900 Vpp: steps of 3.5 Vpp")
            .caught_by(&[Metric::StaticError, Metric::PeakDeviation], TEMPERATURE_RAMP)
            .with(|| on_command(|command| command.drive_vpp = round_to_step(command.drive_vpp, 900.0 / 255.0))),
    ]
}

fn resonance_mutants() -> Vec<MutantSpec> {
    vec![
        mutant("swapped-components", "Wd and Wq swapped")
            .caught_by(AMPLITUDE, FIG13)
            .with(|| on_sample(|sample| std::mem::swap(&mut sample.wd_um, &mut sample.wq_um))),
        mutant("frequency-sign", "frequency loop with the wrong sign")
            .caught_by(RESONANCE, FIG15)
            .with(inverted_frequency),
        mutant("coarse-frequency", "excitation from a timer at 84 MHz: whole ticks, steps of 12 Hz")
            .caught_by(RESONANCE, FIG15)
            .with(|| on_command(|command| command.frequency_mhz = round_to_timer_ticks(command.frequency_mhz, 84e6))),
        mutant("single-phase", "phase of the demodulator kept as f32, in radians since the start")
            .caught_by(RESONANCE, TEMPERATURE_RAMP)
            .with(single_precision_phase),
        mutant("only-at-24-degrees", "frequency fixed at the resonance of 24 °C")
            .caught_by(RESONANCE, TEMPERATURE_RAMP)
            .with(|| on_command(|command| command.frequency_mhz = 32_307_600)),
    ]
}

fn timing_mutants() -> Vec<MutantSpec> {
    vec![
        mutant("stale-sample", "uses the sample of the previous period").caught_by(DYNAMICS, FIG13).with(stale_sample),
        mutant("late-every-100th", "every 100th command one period late")
            .caught_by(DISTURBANCE, DRUMMING_FINGER)
            .with(|| repeated_command(100)),
        mutant("half-rate", "control step in every second period, with the gains of every period")
            .caught_by(DYNAMICS, FIG13)
            .with(|| repeated_command(2)),
        mutant("jitter", "interrupt of higher priority: commands up to 0.4 ms late, at random")
            .caught_by(
                &[
                    Metric::SettlingTime,
                    Metric::Overshoot,
                    Metric::PeakDeviation,
                    Metric::RecoveryTime,
                    Metric::LoopDelay,
                ],
                FIG13,
            )
            .with(|| Box::new(CommandJitter::up_to(Duration::from_micros(400)))),
        mutant("slow-setpoint", "setpoint read in a task of 10 ms")
            .caught_by(&[Metric::SettlingTime], FIG13)
            .with(|| slow_setpoint(10)),
        mutant("smoothed-sample", "low-pass on the sample that the design ignores")
            .caught_by(DYNAMICS, FIG13)
            .with(|| low_pass_filter(0.5)),
    ]
}

fn drive_limit_mutants() -> Vec<MutantSpec> {
    vec![
        mutant("limit-too-low", "drive limit of an older amplifier, 600 Vpp")
            .caught_by(&[Metric::StaticError, Metric::SettlingTime, Metric::DrivePeak, Metric::PeakDeviation], FIG16)
            .with(|| on_command(|command| command.drive_vpp = command.drive_vpp.min(600.0))),
        mutant("limit-ignored", "law designed without the amplifier's limit")
            .caught_by(DYNAMICS, "guards/out-of-reach.toml")
            .with(|| on_configure(|configure| configure.drive_limit_vpp *= 10.0)),
        mutant("only-untouched", "plausibility limit of the drive at 110 % of the untouched plate's")
            .caught_by(&[Metric::StaticError, Metric::SettlingTime, Metric::PeakDeviation, Metric::RecoveryTime], FIG16)
            .with(|| tight_plausibility_limit(1.1)),
    ]
}

fn law_mutants() -> Vec<MutantSpec> {
    vec![
        mutant("untouched-gains", "gains of the untouched plate under a finger").caught_by(DYNAMICS, FIG16).with(
            || {
                on_configure(|configure| {
                    if configure.law == LawId::DqPi {
                        configure.law = LawId::DqPiFixed;
                    }
                })
            },
        ),
        mutant("printed-gains", "equation 24 as printed, not matched to the period of 1 ms")
            .caught_by(DYNAMICS, FIG13)
            .with(|| {
                on_configure(|configure| {
                    if configure.law == LawId::DqPi {
                        configure.law = LawId::DqPiEuler;
                    }
                })
            }),
        mutant("integral-missing", "amplitude loop without its integral")
            .caught_by(AMPLITUDE, FIG13)
            .with(|| HandwrittenLoops::without(Omission::AmplitudeIntegral))
            .against(ReferenceController::Handwritten),
        mutant("frequency-integral-missing", "frequency loop without its integral")
            .caught_by(RESONANCE, FIG14)
            .with(|| HandwrittenLoops::without(Omission::FrequencyIntegral))
            .against(ReferenceController::Handwritten),
        mutant("no-anti-windup", "integral grows while the amplifier is at its limit")
            .caught_by(DYNAMICS, "paper/setpoint-steps.toml")
            .with(|| HandwrittenLoops::without(Omission::AntiWindup))
            .against(ReferenceController::Handwritten),
        mutant("small-wd", "divides by a Wd near zero")
            .caught_by(
                &[Metric::SettlingTime, Metric::FrequencyError, Metric::QuadratureRatio],
                "guards/noise-at-rest.toml",
            )
            .with(|| HandwrittenLoops::without(Omission::SmallWdGuard))
            .against(ReferenceController::Handwritten),
    ]
}

fn protocol_mutants() -> Vec<MutantSpec> {
    vec![
        mutant("no-watchdog", "no watchdog: holds its drive when samples stop")
            .caught_by(SHUTDOWN, SILENCE)
            .with(|| on_configure(|configure| configure.watchdog_timeout_ms = u16::MAX)),
        mutant("nervous-watchdog", "watchdog timeout of two periods instead of five")
            .caught_by(&[Metric::PeakDeviation, Metric::RecoveryTime], "faults/four-periods-of-silence.toml")
            .with(|| on_configure(|configure| configure.watchdog_timeout_ms = (configure.period_us / 500) as u16)),
        mutant("restart-after-timeout", "restarts without a configuration after a timeout")
            .caught_by(SHUTDOWN, SILENCE)
            .with(|| Box::new(RestartAfterStop::default())),
        mutant("no-storm-limit", "rejected frames not counted")
            .caught_by(SHUTDOWN, NOISE_STORM)
            .with(|| Box::new(NoBadFrameCount)),
        mutant("no-checksum", "checksum not checked")
            .caught_by(RESPONSE, "faults/flipped-bit.toml")
            .with(|| Box::new(NoChecksumCheck)),
        mutant("doubled-steps", "two control steps for a repeated sample")
            .caught_by(DYNAMICS, "faults/doubled-messages.toml")
            .with(|| Box::new(NoSequenceCheck::default())),
    ]
}

/// Mutants that the paper's scenarios do not catch.
fn blind_spot_mutants() -> Vec<MutantSpec> {
    vec![
        mutant("drive-at-rest", "smallest drive of 10 Vpp, also at setpoint 0")
            .caught_by(&[Metric::RestDrive], "guards/rest-drive.toml")
            .with(|| on_command(|command| command.drive_vpp = command.drive_vpp.max(10.0))),
        mutant("low-level-error", "sensor table wrong by 3 % below 0.5 µm")
            .caught_by(AMPLITUDE, "guards/low-setpoints.toml")
            .with(|| {
                on_sample(|sample| {
                    if sample.wd_um.abs() < 0.5 {
                        sample.wd_um *= 0.97;
                    }
                })
            }),
        mutant("press-latch", "keeps the drive of a finger that has left")
            .caught_by(
                &[Metric::PeakDeviation, Metric::RecoveryTime, Metric::StaticError],
                "guards/press-and-lift.toml",
            )
            .with(press_latch),
        mutant("rising-damping-only", "gains follow a rising damping and not a falling one")
            .caught_by(DYNAMICS, "guards/falling-damping.toml")
            .with(|| Box::new(RisingDampingOnly::default()))
            .against(ReferenceController::Handwritten),
        mutant("steady-ripple", "drive alternates by ±2 % from period to period")
            .caught_by(&[Metric::Ripple, Metric::RipplePercent], "guards/steady-ripple.toml")
            .with(|| alternating_drive(0.02)),
        mutant("fixed-period", "designed for 1 ms at every period")
            .caught_by(DYNAMICS, "guards/period-2ms.toml")
            .with(|| on_configure(|configure| configure.period_us = 1_000)),
        mutant("ignored-gains", "confirms the gains of the configuration and uses its own")
            .caught_by(DYNAMICS, "guards/configured-gains.toml")
            .with(ignored_gains),
        mutant("limit-after-law", "law designed for 900 Vpp, the configured limit applied after it")
            .caught_by(DYNAMICS, "guards/out-of-reach.toml")
            .with(limit_after_law),
    ]
}

fn counter_mutants() -> Vec<MutantSpec> {
    const METRICS: &[Metric] =
        &[Metric::SettlingTime, Metric::StaticError, Metric::RecoveryTime, Metric::PeakDeviation];
    vec![
        mutant("wrap-2-16-ms", "time in ms as u16, compared for order")
            .caught_by(METRICS, "guards/time-stamps-wrap.toml")
            .with(|| wrapping_counter(|time_us| i64::from((time_us / 1_000) as u16))),
        mutant("wrap-2-31-us", "time in µs as i32, compared for order")
            .caught_by(METRICS, "guards/time-stamps-wrap.toml")
            .with(|| wrapping_counter(|time_us| i64::from(time_us.cast_signed()))),
        mutant("wrap-2-32-us", "time in µs as u32, compared for order")
            .caught_by(METRICS, "guards/time-stamps-wrap.toml")
            .with(|| wrapping_counter(i64::from)),
    ]
}

/// Mutants that no short trial and no step of the setpoint shows.
fn long_trial_mutants() -> Vec<MutantSpec> {
    vec![
        mutant("small-changes-ignored", "drive held while the setpoint changes by less than 5 % per sample")
            .caught_by(SLOW_SETPOINT, SLOW_RAMP)
            .with(|| small_changes_ignored(0.05)),
        mutant("very-small-changes-ignored", "drive held while the setpoint changes by less than 0.006 % per sample")
            .caught_by(SLOW_SETPOINT, SLOW_RAMP)
            .with(|| small_changes_ignored(6e-5)),
        mutant("sample-counter-of-16-bits", "samples counted in 16 bits: the start is repeated after 65,536")
            .caught_by(&[Metric::PeakDeviation], AFTER_A_MINUTE)
            .with(sample_counter_of_16_bits),
        mutant("off-after-61-s", "drive off 61 s after the configuration")
            .caught_by(&[Metric::PeakDeviation], AFTER_A_MINUTE)
            .with(off_after_61_s),
        mutant("sleep-at-rest", "no drive for 200 ms after a rest of 3 s")
            .caught_by(&[Metric::SettlingTime], AFTER_A_MINUTE)
            .with(sleep_at_rest),
    ]
}

/// Mutants that violate rules which the bench checks for every command, without an expectation.
fn violating_mutants() -> Vec<MutantSpec> {
    vec![
        mutant("clock-of-24-bits", "clock of 24 bits, sent as 32")
            .violating(&[ViolationKind::ClockBackwards], FIG13)
            .with(|| {
                on_command(|command| {
                    command.target_time_us = command.target_time_us.wrapping_sub(40_000) & 0x00FF_FFFF;
                })
            }),
        mutant("stale-answer", "every 1000th answer is the previous one, with its sequence number")
            .violating(&[ViolationKind::WrongSequence, ViolationKind::SecondReply], "guards/stale-answers.toml")
            .with(|| stale_answer(1_000)),
        mutant("drive-beyond-limit", "drive not limited: 10 times too large at the start")
            .violating(&[ViolationKind::DriveAboveLimit], FIG13)
            .with(|| {
                on_command(|command| {
                    if command.drive_vpp > 500.0 {
                        command.drive_vpp *= 10.0;
                    }
                })
            }),
        mutant("negative-drive", "drive of -0.5 Vpp instead of 0 Vpp")
            .violating(&[ViolationKind::DriveBelowZero], "guards/rest-drive.toml")
            .with(|| {
                on_command(|command| {
                    if command.drive_vpp == 0.0 {
                        command.drive_vpp = -0.5;
                    }
                })
            }),
        mutant("frequency-in-hz", "frequency sent in Hz instead of mHz")
            .violating(&[ViolationKind::FrequencyOutOfRange, ViolationKind::FrequencySlew], FIG13)
            .with(|| on_command(|command| command.frequency_mhz /= 1_000)),
        mutant("gains-not-finite", "reports gains that are NaN")
            .violating(&[ViolationKind::WrongConfiguration], FIG13)
            .with(gains_not_finite),
    ]
}

fn configuration_mutants() -> Vec<MutantSpec> {
    vec![
        mutant("response-time-ignored", "configured response time ignored")
            .caught_by(REFERENCE, "reference/response-8ms.toml")
            .with(|| on_configure(|configure| configure.response_time_s = 0.0)),
        mutant("start-in-whole-hz", "start frequency in whole Hz")
            .caught_by(REFERENCE, "reference/limits.toml")
            .with(|| on_configure(|configure| configure.start_frequency_mhz -= configure.start_frequency_mhz % 1_000)),
        mutant("range-in-whole-hz", "frequency range and slew in whole Hz")
            .caught_by(REFERENCE, "reference/limits.toml")
            .with(|| {
                on_configure(|configure| {
                    configure.frequency_range_hz = configure.frequency_range_hz.trunc();
                    configure.frequency_slew_hz = configure.frequency_slew_hz.trunc();
                })
            }),
        mutant("limit-of-1000-vpp", "drive limits above 1000 Vpp taken as 1000 Vpp")
            .caught_by(REFERENCE, "reference/high-limit.toml")
            .with(|| on_configure(|configure| configure.drive_limit_vpp = configure.drive_limit_vpp.min(1e3))),
        mutant("infinite-sample-ignored", "sample that is not finite taken as 0")
            .caught_by(REFERENCE, "reference/stops.toml")
            .with(|| {
                on_sample(|sample| {
                    if !sample.wd_um.is_finite() {
                        sample.wd_um = 0.0;
                    }
                })
            }),
    ]
}
