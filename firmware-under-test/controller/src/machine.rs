//! The controller's state machine: the only place that decides whether a plate is driven.
//!
//! ```text
//!                    configure                 first sample
//!   power-on ──▶ Idle ────────▶ Idle (designed) ──────────▶ Running ──┐ sample: one control step
//!                 ▲                  ▲                       │  │  ▲───┘
//!                 │ refused          │ configure             │  │ no sample for as long as there is patience,
//!                 └──────────────────┤                  safe │  │ too many refused frames, a value not finite
//!                                    │                       ▼  ▼
//!                                    └────────────────── Safe  Fault      both at 0 V
//! ```
//!
//! `safe` and `configure` are obeyed in every state.

use crate::law::{Actuation, Law, Measurement};
use platebench_wire::{Command, Configure, Configured, Rejection, Sample, State, StateCause};

/// A controller that gets no sample for this many periods goes to 0 V, where its configuration has no patience of its own.
pub const PERIODS_WITHOUT_SAMPLE: u32 = 5;

/// Each refused frame counts this much towards a storm, each good sample takes one away: five refused frames in a row, or one of
/// two over some twenty periods.
const REFUSED_WEIGHT: u8 = 2;
const STORM: u8 = 10;

/// The controller between its line and its plate. Times are the target's own clock in µs and may wrap.
#[derive(Debug, Clone, Copy)]
pub struct Machine {
    mode: Mode,
    /// The last command of this trial; what a repeated sample is answered with.
    last: Command,
}

#[derive(Debug, Clone, Copy)]
enum Mode {
    Idle(Option<Design>),
    Running(Run),
    Fault,
    Safe,
}

#[derive(Debug, Clone, Copy)]
struct Design {
    law: Law,
    period_us: u32,
    /// Without a sample for this long the drive goes to 0 V.
    patience_us: u32,
    start_frequency_mhz: u32,
}

#[derive(Debug, Clone, Copy)]
struct Run {
    design: Design,
    last_sample_us: u32,
    refused: u8,
}

const AT_REST: Command = Command {
    target_time_us: 0,
    drive_vpp: 0.0,
    frequency_mhz: 0,
    state: State::Idle,
    cause: StateCause::None,
    flags: 0,
    compute_us: 0,
};

impl Default for Machine {
    fn default() -> Self {
        Self::new()
    }
}

impl Machine {
    /// Idle, at 0 V, without a design.
    pub fn new() -> Self {
        Self { mode: Mode::Idle(None), last: AT_REST }
    }

    /// What the plate is driven with now.
    pub fn output(&self) -> &Command {
        &self.last
    }

    /// The control period while there is one to keep.
    pub fn period_us(&self) -> Option<u32> {
        match self.mode {
            Mode::Idle(design) => design.map(|design| design.period_us),
            Mode::Running(run) => Some(run.design.period_us),
            Mode::Fault | Mode::Safe => None,
        }
    }

    /// Takes over a new design and waits at 0 V for its first sample. A refused one leaves no design behind.
    pub fn configure(&mut self, configure: &Configure) -> Configured {
        let outcome = match Law::design(configure) {
            Ok((law, gains)) => {
                let patience_us = match configure.patience_ms {
                    0 => configure.period_us.saturating_mul(PERIODS_WITHOUT_SAMPLE),
                    given => u32::from(given) * 1_000,
                };
                let design = Design {
                    law,
                    period_us: configure.period_us,
                    patience_us,
                    start_frequency_mhz: configure.start_frequency_mhz,
                };
                self.mode = Mode::Idle(Some(design));
                self.last = Command { frequency_mhz: configure.start_frequency_mhz, ..AT_REST };
                Ok(gains)
            }
            Err(rejection) => Err(self.refuse(rejection)),
        };
        Configured { outcome }
    }

    /// Leaves no design behind.
    pub(crate) fn refuse(&mut self, rejection: Rejection) -> Rejection {
        self.mode = Mode::Idle(None);
        self.stop(State::Idle, StateCause::None);
        rejection
    }

    /// One control step.
    pub fn sample(&mut self, sample: &Sample, now_us: u32) -> Command {
        self.last.target_time_us = now_us;
        let mut run = match self.mode {
            Mode::Idle(Some(design)) => Run { design, last_sample_us: now_us, refused: 0 },
            Mode::Running(run) if run.is_out_of_patience(now_us) => {
                return self.fault(StateCause::SampleTimeout);
            }
            Mode::Running(run) => run,
            Mode::Idle(None) | Mode::Fault | Mode::Safe => return self.last,
        };
        let measurement = Measurement { setpoint_um: sample.setpoint_um, wd_um: sample.wd_um, wq_um: sample.wq_um };
        if !measurement.is_finite() {
            return self.fault(StateCause::NonFinite);
        }
        let actuation = run.design.law.step(&measurement);
        let Some(frequency_mhz) = run.design.frequency_mhz(&actuation) else {
            return self.fault(StateCause::NonFinite);
        };
        run.last_sample_us = now_us;
        run.refused = run.refused.saturating_sub(1);
        self.mode = Mode::Running(run);
        self.last = Command {
            drive_vpp: actuation.drive_vpp,
            frequency_mhz,
            state: State::Running,
            cause: StateCause::None,
            flags: actuation.flags,
            ..self.last
        };
        self.last
    }

    /// A frame came in that could not be read. The command that leads to 0 V where that makes a storm.
    pub fn refused_frame(&mut self, now_us: u32) -> Option<Command> {
        let Mode::Running(run) = &mut self.mode else { return None };
        run.refused = run.refused.saturating_add(REFUSED_WEIGHT);
        if run.refused < STORM {
            return None;
        }
        self.last.target_time_us = now_us;
        Some(self.fault(StateCause::LineNoise))
    }

    /// Time passes. The command that leads to 0 V where the samples have stopped.
    pub fn tick(&mut self, now_us: u32) -> Option<Command> {
        match self.mode {
            Mode::Running(run) if run.is_out_of_patience(now_us) => {
                self.last.target_time_us = now_us;
                Some(self.fault(StateCause::SampleTimeout))
            }
            _ => None,
        }
    }

    /// 0 V until the next configuration.
    pub fn safe(&mut self, now_us: u32) -> Command {
        self.mode = Mode::Safe;
        self.last.target_time_us = now_us;
        self.stop(State::Safe, StateCause::None)
    }

    fn fault(&mut self, cause: StateCause) -> Command {
        self.mode = Mode::Fault;
        self.stop(State::Fault, cause)
    }

    fn stop(&mut self, state: State, cause: StateCause) -> Command {
        self.last = Command { drive_vpp: 0.0, state, cause, flags: 0, ..self.last };
        self.last
    }
}

impl Design {
    /// The excitation frequency in mHz; `None` where the law gave something that is not finite.
    fn frequency_mhz(&self, actuation: &Actuation) -> Option<u32> {
        if !actuation.is_finite() {
            return None;
        }
        let offset_mhz = libm::roundf(actuation.frequency_offset_hz * 1000.0) as i32;
        Some(self.start_frequency_mhz.saturating_add_signed(offset_mhz))
    }
}

impl Run {
    fn is_out_of_patience(&self, now_us: u32) -> bool {
        now_us.wrapping_sub(self.last_sample_us) >= self.design.patience_us
    }
}

#[cfg(test)]
mod tests;
