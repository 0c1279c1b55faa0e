//! Records commands, stops and violations of a controller during a trial, for both trial loops.

use crate::command_checks::CommandChecks;
use crate::trial::configure;
use crate::trial::needs_reconfiguration;
use platebench_model::record::{Telemetry, ViolationKind};
use platebench_model::scenario::{FaultKind, Metric, Scenario, Variation};
use platebench_plate::Time;
use platebench_rig::{FaultInjector, Link, LinkError, ProtocolCheck, RigError, Session, check_protocol};
use platebench_wire::{Command, Configure, ControllerState, Gains, LawId, Sample, StateCause};
use tracing::warn;

/// Missed replies in a row after which a controller is lost. Its watchdog expires after 5 periods.
pub(crate) const MAX_MISSED_REPLIES: u32 = 20;
/// Least setpoint after confirmed 0 V, at which every running law would drive a resting plate.
const SETPOINT_AFTER_SAFE_UM: f64 = 1.0;

#[derive(Debug)]
pub(crate) struct ControllerLog<'a> {
    scenario: &'a Scenario,
    law: LawId,
    missed_replies: u32,
    stopped_since: Option<Time>,
    stop_cause: Option<StateCause>,
    samples: u32,
    checks: CommandChecks,
    protocol_check: Option<ProtocolCheck>,
}

impl<'a> ControllerLog<'a> {
    pub(crate) fn new(scenario: &'a Scenario, law: LawId) -> Self {
        let checks = CommandChecks::new(scenario);
        Self {
            scenario,
            law,
            missed_replies: 0,
            stopped_since: None,
            stop_cause: None,
            samples: 0,
            checks,
            protocol_check: None,
        }
    }

    pub(crate) fn record_sample(&mut self) {
        self.samples += 1;
    }

    /// `newer_samples` is the number of samples sent after the sample of this command.
    pub(crate) fn record_command(&mut self, command: &Command, newer_samples: u8, now: Time) {
        self.missed_replies = 0;
        let samples = std::mem::replace(&mut self.samples, newer_samples.into());
        self.checks.check_command(command, samples, now);
        if command.state == ControllerState::Running {
            self.stopped_since = None;
        } else {
            self.stopped_since.get_or_insert(now);
            self.stop_cause.get_or_insert(command.cause);
        }
    }

    pub(crate) fn record_missed_reply(&mut self) {
        self.missed_replies += 1;
    }

    pub(crate) fn reset_missed_replies(&mut self) {
        self.missed_replies = 0;
    }

    pub(crate) fn missed_replies(&self) -> u32 {
        self.missed_replies
    }

    pub(crate) fn is_stopped(&self) -> bool {
        self.stopped_since.is_some()
    }

    pub(crate) fn stop_cause(&self) -> Option<StateCause> {
        self.stop_cause
    }

    pub(crate) fn configuration(&self) -> Configure {
        configure(self.scenario, self.law)
    }

    /// Returns the configuration to send again, if the fault that stopped the controller is over.
    pub(crate) fn reconfiguration(&self, now: Time) -> Option<Configure> {
        let stopped = self.stopped_since?;
        needs_reconfiguration(self.scenario, stopped, now).then(|| self.configuration())
    }

    pub(crate) fn record_configuration(&mut self, configure: &Configure, gains: Option<&Gains>, now: Time) {
        self.stopped_since = None;
        if let Some(gains) = gains {
            self.checks.check_gains(configure, gains, now);
        }
    }

    /// Call it after the request for 0 V, which is checked too. A planned fault `duplicate` excuses
    /// a second reply, unless it differs from the first one.
    pub(crate) fn record_session<L: Link>(&mut self, session: &Session<FaultInjector<L>>, now: Time) {
        self.checks.set_count(ViolationKind::WrongSequence, session.wrong_sequences(), now);
        let is_planned = self.scenario.faults.iter().any(|fault| fault.kind == FaultKind::Duplicate);
        let repeated = if is_planned { 0 } else { session.second_replies() };
        self.checks.set_count(ViolationKind::SecondReply, session.contradictions() + repeated, now);
        // A repeated sample that arrives after the request for 0 V is answered with 0 V.
        let unrequested = if is_planned { 0 } else { session.unrequested_confirmations() };
        self.checks.set_count(ViolationKind::UnrequestedSafe, unrequested, now);
        self.checks.set_count(ViolationKind::IgnoredSafe, session.ignored_safe_requests(), now);
        let rejected = session.rejected_frames();
        if rejected > 0 && self.scenario.faults.is_empty() {
            warn!(scenario = self.scenario.file, frames = rejected, "frames from the controller rejected");
        }
    }

    /// Plays the protocol scripts if the scenario expects [`Metric::ProtocolDifferences`].
    /// Afterwards the controller may be in any state.
    pub(crate) fn check_protocol<L: Link>(
        &mut self,
        session: &mut Session<FaultInjector<L>>,
        base: &Configure,
        own_clock: bool,
        index: u32,
    ) -> Result<(), RigError> {
        if !self.scenario.expects(Metric::ProtocolDifferences) {
            return Ok(());
        }
        let identity = *session.identity();
        let seed = Variation::of_trial(self.scenario, index).seed;
        let link = session.link_mut().inner_mut();
        let check = check_protocol(link, &identity, base, own_clock, seed)?;
        for difference in &check.differences {
            warn!(scenario = self.scenario.file, "protocol: {difference}");
        }
        self.protocol_check = Some(check);
        Ok(())
    }

    /// Checks that the controller stays at 0 V. Sends one sample of a resting plate with the time
    /// stamp of `last`, because a running law would answer it with a drive.
    pub(crate) fn watch_after_safe<L: Link>(
        &mut self,
        session: &mut Session<FaultInjector<L>>,
        now: Time,
        last: Sample,
    ) {
        let setpoint_um = self.scenario.setpoint.range().1.max(SETPOINT_AFTER_SAFE_UM) as f32;
        let sample = Sample { setpoint_um, wd_um: 0.0, wq_um: 0.0, ..last };
        // A missing answer or a trap after 0 V has no effect on the plate.
        let _ = session.send_sample(now.into(), &sample);
        self.observe_safe_state(session, now);
    }

    /// Checks that the controller stays at 0 V. Sends no sample, because a faulty controller could
    /// answer with a drive, and the amplifier of a board may be on.
    pub(crate) fn observe_safe_state<L: Link>(&mut self, session: &mut Session<FaultInjector<L>>, now: Time) {
        if let Some(drives) = session.observe_safe_state() {
            self.checks.record_drives_after_safe(drives, now);
        }
    }

    pub(crate) fn telemetry<L: Link>(&self, session: &Session<FaultInjector<L>>, lost: Option<&RigError>) -> Telemetry {
        Telemetry {
            ended: lost.map(ToString::to_string),
            stopped: self.stop_cause.map(|cause| stop_reason(cause).to_owned()),
            faults: session.link().fault_counts().map(|(kind, count)| (kind.to_owned(), count)).collect(),
            violations: self.checks.violations(),
            reference_difference_percent: session.link().reference_difference_percent(),
            protocol_differences: self.protocol_check.as_ref().map(|check| check.differences.clone()),
            protocol_repeats: self.protocol_check.as_ref().map_or(0, |check| check.repeats),
            firmware_output: session.link().firmware_output(),
            ..Telemetry::default()
        }
    }
}

/// True if the controller caused the error, so the trial fails. Any other error, such as a dead
/// line, makes the trial inconclusive.
pub(crate) fn is_controller_failure(error: &RigError) -> bool {
    match error {
        RigError::Trapped(_) | RigError::WrongSequence | RigError::Link(LinkError::Target(_) | LinkError::Ended(_)) => {
            true
        }
        RigError::Link(LinkError::Disconnected(_))
        | RigError::NoAnswer { .. }
        | RigError::ConfigurationRejected(_)
        | RigError::Restarted
        | RigError::NoRealTime => false,
    }
}

pub(crate) const fn stop_reason(cause: StateCause) -> &'static str {
    match cause {
        StateCause::SampleTimeout => "no sample within the watchdog timeout",
        StateCause::LineNoise => "too many rejected frames",
        StateCause::NonFinite => "a value that is not finite",
        StateCause::None => "no cause given",
    }
}
