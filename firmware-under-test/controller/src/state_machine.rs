//! Decides whether the plate is driven, and detects lost samples and a noisy line.
//!
//! ```text
//!                    configure                 first sample
//!   power-on ──▶ Idle ────────▶ Idle (designed) ──────────▶ Running ──┐ sample: one control step
//!                 ▲                  ▲                       │  │  ▲───┘
//!                 │ rejected         │ configure             │  │ no sample for the watchdog timeout,
//!                 └──────────────────┤                  safe │  │ too many rejected frames, a value not finite
//!                                    │                       ▼  ▼
//!                                    └────────────────── Safe  Fault      both at 0 V
//! ```
//!
//! `safe` and `configure` act in every state, also those without an arrow.

use crate::law::{Actuation, Law, Measurement};
use platebench_wire::{Command, Configure, Configured, ControllerState, Rejection, Sample, StateCause};

pub const DEFAULT_WATCHDOG_PERIODS: u32 = 5;

/// Leaky counter of rejected frames: a rejected frame adds this weight to the score, a sample
/// subtracts 1. Five rejected frames in a row reach the limit, and so do about twenty periods in
/// which every second frame is rejected.
const REJECTED_FRAME_WEIGHT: u8 = 2;
const MAX_REJECTED_FRAME_SCORE: u8 = 10;

/// Times are µs on the target's clock and may wrap.
#[derive(Debug, Clone, Copy)]
pub struct StateMachine {
    mode: MachineState,
    /// The last command of this trial. It also answers a repeated sample.
    last_command: Command,
}

#[derive(Debug, Clone, Copy)]
enum MachineState {
    Idle(Option<ActiveConfiguration>),
    Running(RunningControl),
    Fault,
    Safe,
}

#[derive(Debug, Clone, Copy)]
struct ActiveConfiguration {
    law: Law,
    period_us: u32,
    watchdog_timeout_us: u32,
    start_frequency_mhz: u32,
}

#[derive(Debug, Clone, Copy)]
struct RunningControl {
    configuration: ActiveConfiguration,
    last_sample_us: u32,
    rejected_frame_score: u8,
}

const ZERO_DRIVE: Command = Command {
    target_time_us: 0,
    drive_vpp: 0.0,
    frequency_mhz: 0,
    state: ControllerState::Idle,
    cause: StateCause::None,
    flags: 0,
    compute_us: 0,
};

impl Default for StateMachine {
    fn default() -> Self {
        Self::new()
    }
}

impl StateMachine {
    pub fn new() -> Self {
        Self { mode: MachineState::Idle(None), last_command: ZERO_DRIVE }
    }

    pub fn output(&self) -> &Command {
        &self.last_command
    }

    pub fn period_us(&self) -> Option<u32> {
        match self.mode {
            MachineState::Idle(configuration) => configuration.map(|configuration| configuration.period_us),
            MachineState::Running(run) => Some(run.configuration.period_us),
            MachineState::Fault | MachineState::Safe => None,
        }
    }

    /// Waits at 0 V for the first sample. After a rejection there is no configuration.
    pub fn configure(&mut self, configure: &Configure) -> Configured {
        let outcome = match Law::design(configure) {
            Ok((law, gains)) => {
                let watchdog_timeout_us = match configure.watchdog_timeout_ms {
                    0 => configure.period_us.saturating_mul(DEFAULT_WATCHDOG_PERIODS),
                    timeout_ms => u32::from(timeout_ms) * 1_000,
                };
                self.mode = MachineState::Idle(Some(ActiveConfiguration {
                    law,
                    period_us: configure.period_us,
                    watchdog_timeout_us,
                    start_frequency_mhz: configure.start_frequency_mhz,
                }));
                self.last_command = Command { frequency_mhz: configure.start_frequency_mhz, ..ZERO_DRIVE };
                Ok(gains)
            }
            Err(rejection) => Err(self.reject(rejection)),
        };
        Configured { outcome }
    }

    pub(crate) fn reject(&mut self, rejection: Rejection) -> Rejection {
        self.mode = MachineState::Idle(None);
        self.stop(ControllerState::Idle, StateCause::None);
        rejection
    }

    pub fn sample(&mut self, sample: &Sample, now_us: u32) -> Command {
        self.last_command.target_time_us = now_us;
        let mut run = match self.mode {
            MachineState::Idle(Some(configuration)) => {
                RunningControl { configuration, last_sample_us: now_us, rejected_frame_score: 0 }
            }
            MachineState::Running(run) if run.is_watchdog_expired(now_us) => {
                return self.enter_fault(StateCause::SampleTimeout);
            }
            MachineState::Running(run) => run,
            MachineState::Idle(None) | MachineState::Fault | MachineState::Safe => return self.last_command,
        };
        let measurement = Measurement { setpoint_um: sample.setpoint_um, wd_um: sample.wd_um, wq_um: sample.wq_um };
        if !measurement.is_finite() {
            return self.enter_fault(StateCause::NonFinite);
        }
        let actuation = run.configuration.law.step(&measurement);
        let Some(frequency_mhz) = run.configuration.frequency_mhz(&actuation) else {
            return self.enter_fault(StateCause::NonFinite);
        };
        run.last_sample_us = now_us;
        run.rejected_frame_score = run.rejected_frame_score.saturating_sub(1);
        self.mode = MachineState::Running(run);
        self.last_command = Command {
            drive_vpp: actuation.drive_vpp,
            frequency_mhz,
            state: ControllerState::Running,
            cause: StateCause::None,
            flags: actuation.flags,
            ..self.last_command
        };
        self.last_command
    }

    /// Returns a command with 0 V if the score of rejected frames reaches its limit.
    pub fn count_rejected_frame(&mut self, now_us: u32) -> Option<Command> {
        let MachineState::Running(run) = &mut self.mode else { return None };
        run.rejected_frame_score = run.rejected_frame_score.saturating_add(REJECTED_FRAME_WEIGHT);
        if run.rejected_frame_score < MAX_REJECTED_FRAME_SCORE {
            return None;
        }
        self.last_command.target_time_us = now_us;
        Some(self.enter_fault(StateCause::LineNoise))
    }

    /// Returns a command with 0 V if the watchdog has expired.
    pub fn tick(&mut self, now_us: u32) -> Option<Command> {
        match self.mode {
            MachineState::Running(run) if run.is_watchdog_expired(now_us) => {
                self.last_command.target_time_us = now_us;
                Some(self.enter_fault(StateCause::SampleTimeout))
            }
            _ => None,
        }
    }

    pub fn enter_safe(&mut self, now_us: u32) -> Command {
        self.mode = MachineState::Safe;
        self.last_command.target_time_us = now_us;
        self.stop(ControllerState::Safe, StateCause::None)
    }

    fn enter_fault(&mut self, cause: StateCause) -> Command {
        self.mode = MachineState::Fault;
        self.stop(ControllerState::Fault, cause)
    }

    fn stop(&mut self, state: ControllerState, cause: StateCause) -> Command {
        self.last_command = Command { drive_vpp: 0.0, state, cause, flags: 0, ..self.last_command };
        self.last_command
    }
}

impl ActiveConfiguration {
    fn frequency_mhz(&self, actuation: &Actuation) -> Option<u32> {
        if !actuation.is_finite() {
            return None;
        }
        let offset_mhz = libm::roundf(actuation.frequency_offset_hz * 1000.0) as i32;
        Some(self.start_frequency_mhz.saturating_add_signed(offset_mhz))
    }
}

impl RunningControl {
    fn is_watchdog_expired(&self, now_us: u32) -> bool {
        now_us.wrapping_sub(self.last_sample_us) >= self.configuration.watchdog_timeout_us
    }
}

#[cfg(test)]
mod tests;
