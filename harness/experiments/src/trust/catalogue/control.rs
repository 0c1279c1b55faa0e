//! Lists mutants of sample, drive, frequency, timing and control law.

use crate::trust::mutant_spec::{
    AMPLITUDE, DISTURBANCE, DRUMMING_FINGER, DYNAMICS, FIG13, FIG14, FIG15, FIG16, MutantSpec, RESONANCE,
    TEMPERATURE_RAMP, handwritten_mutant, mutant,
};
use crate::trust::mutants::excitation::{InvertedFrequency, SinglePrecisionPhase, round_to_timer_ticks};
use crate::trust::mutants::hooks::{on_command, on_configure, on_sample};
use crate::trust::mutants::loops::{HandwrittenLoops, Omission};
use crate::trust::mutants::timing::{CommandJitter, low_pass_filter, repeated_command, slow_setpoint, stale_sample};
use crate::trust::mutants::values::{TightPlausibilityLimit, round_to_step};
use platebench_model::scenario::Metric;
use platebench_wire::LawId;
use std::time::Duration;

pub(super) fn amplitude_mutants() -> Vec<MutantSpec> {
    vec![
        mutant(
            "drive-gain-doubled",
            "drive computed in peak, sent as peak to peak: a gain of 2",
            DYNAMICS,
            FIG13,
            || on_command(|command| command.drive_vpp *= 2.0),
        ),
        mutant("drive-gain-halved", "amplifier set to half of its gain", DYNAMICS, FIG13, || {
            on_command(|command| command.drive_vpp *= 0.5)
        }),
        mutant(
            "setpoint-scale",
            "setpoint scaled by the calibration of another plate, 2 % off",
            AMPLITUDE,
            FIG13,
            || on_sample(|sample| sample.setpoint_um *= 1.02),
        ),
        mutant(
            "peak-for-peak-to-peak",
            "amplitude measured in peak, setpoint in peak to peak",
            AMPLITUDE,
            FIG13,
            || {
                on_sample(|sample| {
                    sample.wd_um *= 0.5;
                    sample.wq_um *= 0.5;
                })
            },
        ),
        mutant(
            "sensor-offset",
            "demodulator offset not trimmed: 10 nm on Wd, 0.5 % of 2 µm",
            AMPLITUDE,
            FIG13,
            || on_sample(|sample| sample.wd_um += 0.01),
        ),
        mutant(
            "setpoint-drift",
            "reference voltage of the setpoint drifts, 0.5 % in a minute",
            &[Metric::StaticError, Metric::PeakDeviation],
            TEMPERATURE_RAMP,
            || on_sample(|sample| sample.setpoint_um *= 1.0 + 0.005 * sample.time_us as f32 / 60e6),
        ),
        mutant(
            "coarse-sensor",
            "8 of the converter's 12 bits used: steps of 20 nm",
            &[Metric::StaticError, Metric::PeakDeviation],
            FIG13,
            || {
                on_sample(|sample| {
                    sample.wd_um = round_to_step(sample.wd_um, 0.02);
                    sample.wq_um = round_to_step(sample.wq_um, 0.02);
                })
            },
        ),
        mutant(
            "coarse-drive",
            "8-bit converter for 900 Vpp: steps of 3.5 Vpp",
            &[Metric::StaticError, Metric::PeakDeviation],
            TEMPERATURE_RAMP,
            || on_command(|command| command.drive_vpp = round_to_step(command.drive_vpp, 900.0 / 255.0)),
        ),
    ]
}

pub(super) fn resonance_mutants() -> Vec<MutantSpec> {
    vec![
        mutant("swapped-components", "Wd and Wq swapped", AMPLITUDE, FIG13, || {
            on_sample(|sample| std::mem::swap(&mut sample.wd_um, &mut sample.wq_um))
        }),
        mutant("frequency-sign", "frequency loop with the wrong sign", RESONANCE, FIG15, || {
            Box::new(InvertedFrequency::default())
        }),
        mutant(
            "coarse-frequency",
            "excitation from a timer at 84 MHz: whole ticks, steps of 12 Hz",
            RESONANCE,
            FIG15,
            || on_command(|command| command.frequency_mhz = round_to_timer_ticks(command.frequency_mhz, 84e6)),
        ),
        mutant(
            "single-phase",
            "phase of the demodulator kept as f32, in radians since the start",
            RESONANCE,
            TEMPERATURE_RAMP,
            || Box::new(SinglePrecisionPhase::default()),
        ),
        mutant("only-at-24-degrees", "frequency fixed at the resonance of 24 °C", RESONANCE, TEMPERATURE_RAMP, || {
            on_command(|command| command.frequency_mhz = 32_307_600)
        }),
    ]
}

pub(super) fn timing_mutants() -> Vec<MutantSpec> {
    vec![
        mutant("stale-sample", "uses the sample of the previous period", DYNAMICS, FIG13, stale_sample),
        mutant("late-every-100th", "every 100th command one period late", DISTURBANCE, DRUMMING_FINGER, || {
            repeated_command(100)
        }),
        mutant(
            "half-rate",
            "control step in every second period, with the gains of every period",
            DYNAMICS,
            FIG13,
            || repeated_command(2),
        ),
        mutant(
            "jitter",
            "interrupt of higher priority: commands up to 0.4 ms late, at random",
            &[Metric::SettlingTime, Metric::Overshoot, Metric::PeakDeviation, Metric::RecoveryTime, Metric::LoopDelay],
            FIG13,
            || Box::new(CommandJitter::up_to(Duration::from_micros(400))),
        ),
        mutant("slow-setpoint", "setpoint read in a task of 10 ms", &[Metric::SettlingTime], FIG13, || {
            slow_setpoint(10)
        }),
        mutant("smoothed-sample", "low-pass on the sample that the design ignores", DYNAMICS, FIG13, || {
            low_pass_filter(0.5)
        }),
    ]
}

pub(super) fn drive_limit_mutants() -> Vec<MutantSpec> {
    vec![
        mutant(
            "limit-too-low",
            "drive limit of an older amplifier, 600 Vpp",
            &[Metric::StaticError, Metric::SettlingTime, Metric::DrivePeak, Metric::PeakDeviation],
            FIG16,
            || on_command(|command| command.drive_vpp = command.drive_vpp.min(600.0)),
        ),
        mutant(
            "limit-ignored",
            "law designed without the amplifier's limit",
            DYNAMICS,
            "guards/out-of-reach.toml",
            || on_configure(|configure| configure.drive_limit_vpp *= 10.0),
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

pub(super) fn law_mutants() -> Vec<MutantSpec> {
    vec![
        mutant("untouched-gains", "gains of the untouched plate under a finger", DYNAMICS, FIG16, || {
            on_configure(|configure| {
                if configure.law == LawId::DqPi {
                    configure.law = LawId::DqPiFixed;
                }
            })
        }),
        mutant("printed-gains", "equation 24 as printed, not matched to the period of 1 ms", DYNAMICS, FIG13, || {
            on_configure(|configure| {
                if configure.law == LawId::DqPi {
                    configure.law = LawId::DqPiEuler;
                }
            })
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
