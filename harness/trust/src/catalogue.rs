//! The mistakes, each with the metrics by which it should be caught.

use crate::middleware::{Mistake, Mistaken};
use crate::mistakes::excitation::{Mirrored, SinglePhase, whole_ticks};
use crate::mistakes::line::{Credulous, Restless, Thoughtless, Uncounted};
use crate::mistakes::loops::{Handwritten, Missing};
use crate::mistakes::timing::{Jitter, Repeats, SlowSetpoint, Smoothed, Stale};
use crate::mistakes::values::{Implausible, Nothing, OnCommand, OnConfigure, OnSample, rounded};
use platebench_rig::{AnyLink, Hosted};
use platebench_scenario::Metric;
use platebench_wire::LawId;
use std::time::Duration;

/// What a faulty controller is without its mistake: what this one fails catches nobody.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Reference {
    /// The firmware.
    Firmware,
    /// The firmware with loops written by hand in the place of its `dq-pi`.
    Handwritten,
}

impl Reference {
    /// Every reference.
    pub const ALL: [Self; 2] = [Self::Firmware, Self::Handwritten];

    /// The controller without a mistake.
    pub fn link(self) -> AnyLink {
        match self {
            Self::Firmware => Box::new(Hosted::new()),
            Self::Handwritten => {
                Box::new(Mistaken::new(Hosted::new(), || Box::new(Handwritten::without(Missing::Nothing))))
            }
        }
    }
}

/// A mistake that people make.
#[derive(Debug, Clone, Copy)]
pub struct Entry {
    /// What it is called.
    pub name: &'static str,
    /// What somebody did, in a line.
    pub mistake: &'static str,
    /// By what it should be caught: a failure of anything else is luck.
    pub metrics: &'static [Metric],
    /// A scenario that catches it for that reason.
    pub witness: &'static str,
    /// What it is without the mistake.
    pub reference: Reference,
    /// The mistake, anew for each trial.
    pub make: fn() -> Box<dyn Mistake>,
}

impl Entry {
    /// A controller in this process that makes the mistake.
    pub fn link(&self) -> AnyLink {
        Box::new(Mistaken::new(Hosted::new(), self.make))
    }

    /// An entry without a mistake, which nothing may catch: what shows that a survivor is counted.
    pub fn harmless() -> Self {
        Self {
            name: "harmless",
            mistake: "none",
            metrics: &Metric::ALL,
            witness: "paper/fig13-closed-loop.toml",
            reference: Reference::Firmware,
            make: || Box::new(Nothing),
        }
    }
}

const AMPLITUDE: &[Metric] = &[Metric::StaticError];
const DYNAMICS: &[Metric] =
    &[Metric::SettlingTime, Metric::Overshoot, Metric::RecoveryTime, Metric::PeakDeviation, Metric::DrivePeak];
const DISTURBED: &[Metric] = &[Metric::PeakDeviation, Metric::RecoveryTime];
const RESONANCE: &[Metric] = &[Metric::FrequencyError, Metric::QuadratureRatio];
const SHUTDOWN: &[Metric] = &[Metric::ShutdownTime];
const RESPONSE: &[Metric] = &[Metric::Overshoot, Metric::SettlingTime, Metric::StaticError, Metric::MissedReplies];

const FIG13: &str = "paper/fig13-closed-loop.toml";
const FIG14: &str = "paper/fig14-closed-loop.toml";
const FIG15: &str = "paper/fig15-frequency.toml";
const FIG16: &str = "paper/fig16-closed-loop.toml";
const DAY: &str = "paper/temperature-ramp.toml";
const DRUM: &str = "guards/drumming-finger.toml";
const SILENCE: &str = "faults/five-periods-of-silence.toml";
const STORM: &str = "faults/noise-storm.toml";

const fn entry(
    name: &'static str,
    mistake: &'static str,
    metrics: &'static [Metric],
    witness: &'static str,
    make: fn() -> Box<dyn Mistake>,
) -> Entry {
    Entry { name, mistake, metrics, witness, reference: Reference::Firmware, make }
}

const fn handwritten(
    name: &'static str,
    mistake: &'static str,
    metrics: &'static [Metric],
    witness: &'static str,
    make: fn() -> Box<dyn Mistake>,
) -> Entry {
    Entry { name, mistake, metrics, witness, reference: Reference::Handwritten, make }
}

/// Every mistake, by what it spoils.
pub fn catalogue() -> Vec<Entry> {
    [amplitudes(), resonances(), instants(), limits(), laws(), protocol()].concat()
}

/// What is measured, wished for and driven with.
fn amplitudes() -> Vec<Entry> {
    vec![
        entry(
            "drive-gain-doubled",
            "drive computed in peak, sent as peak to peak: a gain of 2",
            DYNAMICS,
            FIG13,
            || Box::new(OnCommand(|command| command.drive_vpp *= 2.0)),
        ),
        entry("drive-gain-halved", "amplifier set to half of its gain", DYNAMICS, FIG13, || {
            Box::new(OnCommand(|command| command.drive_vpp *= 0.5))
        }),
        entry(
            "setpoint-scale",
            "setpoint scaled by the calibration of another plate, 2 % off",
            AMPLITUDE,
            FIG13,
            || Box::new(OnSample(|sample| sample.setpoint_um *= 1.02)),
        ),
        entry(
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
        entry(
            "sensor-offset",
            "offset of the demodulator never trimmed: 10 nm on Wd, 0.5 % of 2 µm",
            AMPLITUDE,
            FIG13,
            || Box::new(OnSample(|sample| sample.wd_um += 0.01)),
        ),
        entry(
            "setpoint-drift",
            "reference voltage of the setpoint drifts, 0.5 % in a minute",
            &[Metric::StaticError, Metric::PeakDeviation],
            DAY,
            || Box::new(OnSample(|sample| sample.setpoint_um *= 1.0 + 0.005 * sample.time_us as f32 / 60e6)),
        ),
        entry(
            "coarse-sensor",
            "8 of the converter's 12 bits used: steps of 20 nm",
            &[Metric::StaticError, Metric::PeakDeviation],
            FIG13,
            || {
                Box::new(OnSample(|sample| {
                    sample.wd_um = rounded(sample.wd_um, 0.02);
                    sample.wq_um = rounded(sample.wq_um, 0.02);
                }))
            },
        ),
        entry(
            "coarse-drive",
            "8-bit converter for 900 Vpp: steps of 3.5 Vpp",
            &[Metric::StaticError, Metric::PeakDeviation],
            DAY,
            || Box::new(OnCommand(|command| command.drive_vpp = rounded(command.drive_vpp, 900.0 / 255.0))),
        ),
    ]
}

/// Where the plate swings.
fn resonances() -> Vec<Entry> {
    vec![
        entry("swapped-components", "Wd and Wq swapped", AMPLITUDE, FIG13, || {
            Box::new(OnSample(|sample| std::mem::swap(&mut sample.wd_um, &mut sample.wq_um)))
        }),
        entry("frequency-sign", "frequency loop with the wrong sign", RESONANCE, FIG15, || {
            Box::new(Mirrored::default())
        }),
        entry(
            "coarse-frequency",
            "excitation from a timer at 84 MHz: whole ticks, steps of 12 Hz",
            RESONANCE,
            FIG15,
            || Box::new(OnCommand(|command| command.frequency_mhz = whole_ticks(command.frequency_mhz, 84e6))),
        ),
        entry(
            "single-phase",
            "phase of the demodulator kept as f32, in radians since the start",
            RESONANCE,
            DAY,
            || Box::new(SinglePhase::default()),
        ),
        entry("only-at-24-degrees", "frequency fixed at the resonance of 24 °C", RESONANCE, DAY, || {
            Box::new(OnCommand(|command| command.frequency_mhz = 32_307_600))
        }),
    ]
}

/// When something happens.
fn instants() -> Vec<Entry> {
    vec![
        entry("stale-sample", "controls with the sample of the period before", DYNAMICS, FIG13, || {
            Box::new(Stale::default())
        }),
        entry("late-every-100th", "every 100th command a period late", DISTURBED, DRUM, || {
            Box::new(Repeats::every(100))
        }),
        entry("half-rate", "controls in every second period, with the gains of every period", DYNAMICS, FIG13, || {
            Box::new(Repeats::every(2))
        }),
        entry(
            "jitter",
            "an interrupt of higher priority: commands up to 0.4 ms late, at random",
            &[Metric::SettlingTime, Metric::Overshoot, Metric::PeakDeviation, Metric::RecoveryTime, Metric::LoopDelay],
            FIG13,
            || Box::new(Jitter::up_to(Duration::from_micros(400))),
        ),
        entry("slow-setpoint", "setpoint read in a task of 10 ms", &[Metric::SettlingTime], FIG13, || {
            Box::new(SlowSetpoint::every(10))
        }),
        entry("smoothed-sample", "low-pass on the sample that the design does not know of", DYNAMICS, FIG13, || {
            Box::new(Smoothed::by(0.5))
        }),
    ]
}

/// How far the drive goes.
fn limits() -> Vec<Entry> {
    vec![
        entry(
            "limit-too-low",
            "drive limit of an older amplifier, 600 Vpp",
            &[Metric::StaticError, Metric::SettlingTime, Metric::DrivePeak, Metric::PeakDeviation],
            FIG16,
            || Box::new(OnCommand(|command| command.drive_vpp = command.drive_vpp.min(600.0))),
        ),
        entry(
            "limit-ignored",
            "law designed without the amplifier's limit",
            DYNAMICS,
            "guards/out-of-reach.toml",
            || Box::new(OnConfigure(|configure| configure.drive_limit_vpp *= 10.0)),
        ),
        entry(
            "only-untouched",
            "drive above 110 % of what the untouched plate needs taken for implausible",
            &[Metric::StaticError, Metric::SettlingTime, Metric::PeakDeviation, Metric::RecoveryTime],
            FIG16,
            || Box::new(Implausible::above(1.1)),
        ),
    ]
}

/// How drive and frequency come about.
fn laws() -> Vec<Entry> {
    vec![
        entry("untouched-gains", "gains of the untouched plate whatever touches it", DYNAMICS, FIG16, || {
            Box::new(OnConfigure(|configure| {
                if configure.law == LawId::DqPi {
                    configure.law = LawId::DqPiFixed;
                }
            }))
        }),
        entry(
            "printed-gains",
            "equation 24 as printed at a period of 1 ms, not matched to it",
            DYNAMICS,
            FIG13,
            || {
                Box::new(OnConfigure(|configure| {
                    if configure.law == LawId::DqPi {
                        configure.law = LawId::DqPiEuler;
                    }
                }))
            },
        ),
        handwritten("integral-missing", "amplitude loop without its integral", AMPLITUDE, FIG13, || {
            Box::new(Handwritten::without(Missing::AmplitudeIntegral))
        }),
        handwritten("frequency-integral-missing", "frequency loop without its integral", RESONANCE, FIG14, || {
            Box::new(Handwritten::without(Missing::FrequencyIntegral))
        }),
        handwritten(
            "no-anti-windup",
            "integral goes on while the amplifier is at its limit",
            DYNAMICS,
            "paper/setpoint-steps.toml",
            || Box::new(Handwritten::without(Missing::AntiWindup)),
        ),
        handwritten(
            "small-wd",
            "divides by Wd however small it is",
            &[Metric::SettlingTime, Metric::FrequencyError, Metric::QuadratureRatio],
            "guards/noise-at-rest.toml",
            || Box::new(Handwritten::without(Missing::SmallWd)),
        ),
    ]
}

/// What the wire protocol asks for.
fn protocol() -> Vec<Entry> {
    vec![
        entry("no-watchdog", "no time-out: holds its drive when samples stop", SHUTDOWN, SILENCE, || {
            Box::new(OnConfigure(|configure| configure.patience_ms = u16::MAX))
        }),
        entry(
            "nervous-watchdog",
            "time-out after two periods instead of five",
            &[Metric::PeakDeviation, Metric::RecoveryTime],
            "faults/four-periods-of-silence.toml",
            || Box::new(OnConfigure(|configure| configure.patience_ms = (configure.period_us / 500) as u16)),
        ),
        entry("restless", "goes on by itself after a time-out", SHUTDOWN, SILENCE, || Box::new(Restless::default())),
        entry("no-storm-limit", "refused frames skipped and never counted", SHUTDOWN, STORM, || Box::new(Thoughtless)),
        entry("credulous", "checksum never looked at", RESPONSE, "faults/flipped-bit.toml", || Box::new(Credulous)),
        entry(
            "doubled-steps",
            "a doubled sample controlled with twice",
            DYNAMICS,
            "faults/doubled-messages.toml",
            || Box::new(Uncounted::default()),
        ),
    ]
}
