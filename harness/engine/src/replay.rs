//! Replays recorded samples to a controller in open loop: no plate reacts to its commands.

mod error;
mod input;
mod recorded_trace;
mod telemetry_table;

pub use error::ReplayError;
pub use input::ReplayInput;
pub use recorded_trace::read_recorded_trace;
pub use telemetry_table::read_telemetry_table;

use crate::command_checks::drive_violation;
use crate::controller_log::{ControllerLog, MAX_MISSED_REPLIES, is_controller_failure};
use crate::executor::RigSession;
use crate::lockstep::OWN_CLOCK_WATCHDOG_TIMEOUT_MS;
use crate::plan::{LinkFactory, RunError};
use crate::trial::TrialAbort;
use crate::trial::{configure, law, missing_capability};
use platebench_model::scenario::Scenario;
use platebench_plate::Time;
use platebench_rig::{CancelToken, FaultInjector, RigError, SafeEnd};
use platebench_verdict::replay::{Replay, ReplayCommand, ReplayResult, ReplayStep};
use platebench_wire::{Command, Configure, ControllerState, LawId, Sample};
use std::time::Duration;

/// `own_clock` is true if the controller's clock runs while the bench waits.
pub fn replay(
    input: &ReplayInput,
    rig: &str,
    own_clock: bool,
    connect: &LinkFactory<'_>,
    cancel: &CancelToken,
) -> Result<ReplayResult, ReplayError> {
    let law = law(&input.scenario).map_err(|unknown| ReplayError::Scenario(Box::new(unknown)))?;
    let link = connect().map_err(RunError::from)?;
    let session = RigSession::open(FaultInjector::new(link)).map_err(RunError::from)?;
    if let Some(reason) = missing_capability(&input.scenario, law, session.identity()) {
        return Err(ReplayError::NotApplicable(reason));
    }
    let firmware = session.firmware_name();
    let mut player = Player {
        session,
        controller: ControllerLog::new(&input.scenario, law),
        scenario: &input.scenario,
        replies: Vec::with_capacity(input.recording.steps.len()),
        last: Time::ZERO,
    };
    let lost = match player.play(&input.recording.steps, law, own_clock, cancel) {
        Ok(()) => None,
        Err(TrialAbort::Cancelled) => return Err(RunError::Cancelled.into()),
        Err(TrialAbort::Lost(refused @ RigError::ConfigurationRejected(_))) => {
            return Err(RunError::Rig(refused).into());
        }
        Err(TrialAbort::Lost(error)) => Some(error),
    };
    let replay = player.finish(rig, firmware, law, lost.as_ref());
    Ok(ReplayResult::new(&input.recording, replay))
}

struct Player<'a> {
    session: RigSession,
    controller: ControllerLog<'a>,
    scenario: &'a Scenario,
    replies: Vec<Option<ReplayCommand>>,
    last: Time,
}

impl Player<'_> {
    /// If the replay is cancelled, the drop of the session requests 0 V.
    fn play(
        &mut self,
        steps: &[ReplayStep],
        law: LawId,
        own_clock: bool,
        cancel: &CancelToken,
    ) -> Result<(), TrialAbort> {
        let watchdog_timeout_ms = if own_clock { OWN_CLOCK_WATCHDOG_TIMEOUT_MS } else { 0 };
        let configure = Configure { watchdog_timeout_ms, ..configure(self.scenario, law) };
        let gains = self.session.start_trial(&configure)?;
        self.controller.record_configuration(&configure, Some(&gains), Time::ZERO);
        let first_s = steps.first().map_or(0.0, |step| step.t_s);
        for step in steps {
            if cancel.is_cancelled() {
                return Err(TrialAbort::Cancelled);
            }
            self.last = Time::from_seconds(step.t_s - first_s).unwrap_or(self.last);
            let reply = self.exchange(&sample(step, self.last))?;
            self.replies.push(reply);
            if self.controller.is_stopped() {
                break;
            }
        }
        Ok(())
    }

    fn exchange(&mut self, sample: &Sample) -> Result<Option<ReplayCommand>, RigError> {
        let now = Duration::from(self.last);
        self.controller.record_sample();
        let reply = match self.session.send_sample(now, sample)? {
            Some(reply) => Some(reply.command),
            None => self.session.advance_to(now)?.filter(|_| self.session.last_sample_answered()),
        };
        if self.session.wrong_sequences() > 0 {
            return Err(RigError::WrongSequence);
        }
        let Some(command) = reply else {
            self.controller.record_missed_reply();
            return if self.controller.missed_replies() < MAX_MISSED_REPLIES {
                Ok(None)
            } else {
                Err(RigError::NoAnswer { expected: "command" })
            };
        };
        if command.state == ControllerState::Idle {
            return Err(RigError::Restarted);
        }
        self.controller.record_command(&command, self.session.newer_messages(), self.last);
        Ok(Some(self.within_range(&command)))
    }

    /// Clips the drive to the amplifier's range, because the drive in a trace is clipped too.
    fn within_range(&self, command: &Command) -> ReplayCommand {
        let drive = f64::from(command.drive_vpp);
        let drive_vpp =
            if drive.is_finite() { drive.clamp(0.0, self.scenario.plate.drive_limit_vpp) } else { f64::NAN };
        ReplayCommand { drive_vpp, frequency_hz: f64::from(command.frequency_mhz) / 1e3 }
    }

    fn finish(mut self, rig: &str, firmware: String, law: LawId, lost: Option<&RigError>) -> Replay {
        let now = self.last + self.scenario.controller.period;
        if lost.is_none() && self.session.request_safe_state() {
            let rest = Sample { time_us: now.wrapping_micros(), setpoint_um: 0.0, wd_um: 0.0, wq_um: 0.0 };
            self.controller.watch_after_safe(&mut self.session, now, rest);
        }
        self.controller.record_session(&self.session, now);
        let mut telemetry = self.controller.telemetry(&self.session, lost);
        let end = self.session.close();
        if let SafeEnd::Driven(drives) = end {
            telemetry.violations.push(drive_violation(drives, now));
        }
        Replay {
            rig: rig.to_owned(),
            firmware,
            law: law.name(),
            replies: self.replies,
            telemetry,
            rig_lost: lost.is_some_and(|error| !is_controller_failure(error)),
            safe_confirmed: end == SafeEnd::Confirmed,
        }
    }
}

fn sample(step: &ReplayStep, now: Time) -> Sample {
    Sample {
        time_us: now.wrapping_micros(),
        setpoint_um: step.setpoint_um as f32,
        wd_um: step.wd_um as f32,
        wq_um: step.wq_um as f32,
    }
}
