//! Records commands, stops and violations of a controller during a trial, for all trial loops.
//! Checks every command against the configured limits, before the bench clips its drive.

use crate::trial::{Trial, configure, needs_reconfiguration, start_frequency_mhz};
use platebench_model::record::{Telemetry, Violation, ViolationKind};
use platebench_model::scenario::{FaultKind, Metric, Scenario, Variation};
use platebench_plate::Time;
use platebench_rig::{
    CheckOptions, DrivesAfterSafe, FREQUENCY_TOLERANCE_MHZ, FaultInjector, Link, LinkError, ProtocolCheck,
    RejectedFrame, RigError, ScriptDifference, Session, check_protocol,
};
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
        let loses_bytes = session.link().kind().loses_bytes();
        if self.scenario.faults.is_empty() && self.scenario.chip_faults.is_empty() && !loses_bytes {
            self.checks.set_count(ViolationKind::UnrequestedMessage, session.unrequested_messages(), now);
        }
        let rejected = session.rejected_frames();
        if rejected > 0 && self.scenario.faults.is_empty() {
            warn!(scenario = self.scenario.file, frames = rejected, "frames from the controller rejected");
            // Noise on a line may damage a frame, and a reset of the chip may cut one.
            if !loses_bytes && self.scenario.chip_faults.is_empty() {
                self.checks.set_count(ViolationKind::RejectedFrame, rejected, now);
                self.checks.set_frame_lengths(session.first_rejected_frame());
            }
        }
    }

    /// Plays the scenario's messages, or the protocol scripts if it has none, if the scenario expects
    /// [`Metric::ProtocolDifferences`].
    /// Afterwards the controller may be in any state.
    pub(crate) fn check_protocol<L: Link>(
        &mut self,
        session: &mut Session<FaultInjector<L>>,
        base: &Configure,
        trial: &Trial<'_>,
    ) -> Result<(), RigError> {
        if !self.scenario.expects(Metric::ProtocolDifferences) {
            return Ok(());
        }
        let identity = *session.identity();
        let Trial { own_clock, long_scripts, index, ref cancel, .. } = *trial;
        let seed = Variation::of_trial(self.scenario, index).seed;
        let link = session.link_mut().inner_mut();
        let compares_numbers = self.scenario.expects(Metric::ReferenceDifference);
        let messages = &self.scenario.messages;
        let own_law = self.scenario.has_own_law();
        let options = CheckOptions { own_clock, seed, messages, compares_numbers, own_law, long_scripts, cancel };
        let check = check_protocol(link, &identity, base, options)?;
        for (difference, count) in distinct_differences(&check.differences) {
            let more = if count > 1 { format!(" (the same in {} more scripts)", count - 1) } else { String::new() };
            warn!(scenario = self.scenario.file, "protocol: {difference}{more}");
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

    /// What an emulated chip reports since the start of the trial, or for registers since power-on.
    pub(crate) fn chip_telemetry<L: Link>(&self, session: &mut Session<FaultInjector<L>>) -> Telemetry {
        let Some(chip) = session.link_mut().chip() else { return Telemetry::default() };
        let defmt_frames = chip.defmt_frames();
        Telemetry {
            transport: Some(chip.transport()),
            baud: Some(chip.baud()),
            firmware_output: chip.firmware_output(),
            firmware_output_reads: chip.firmware_output_reads().filter(|_| self.scenario.expects(Metric::Text)),
            defmt_bytes: defmt_frames.as_ref().map(Vec::len),
            defmt_frames,
            unmodelled_instances: chip.unmodelled_instances(),
            unused_fpu: chip.is_fpu_unused(),
            ..Telemetry::default()
        }
    }

    /// `before_restart` is what the chip reported before a restart that deleted it.
    pub(crate) fn telemetry<L: Link>(
        &self,
        session: &mut Session<FaultInjector<L>>,
        lost: Option<&RigError>,
        before_restart: Option<Telemetry>,
    ) -> Telemetry {
        let now = self.chip_telemetry(session);
        let (transport, baud) = (now.transport, now.baud);
        let chip = Telemetry { transport, baud, ..before_restart.unwrap_or(now) };
        Telemetry {
            ended: lost.map(ToString::to_string),
            end_cause: lost.map(RigError::cause),
            ended_by_controller: lost.is_some_and(is_controller_failure),
            stopped: self.stop_cause.map(|cause| stop_reason(cause).to_owned()),
            faults: session.link().fault_counts().map(|(kind, count)| (kind.to_owned(), count)).collect(),
            violations: match lost {
                // The commands may answer the other client.
                Some(RigError::OtherClient) => Vec::new(),
                lost => refused_configuration(lost).into_iter().chain(self.checks.violations()).collect(),
            },
            reference_difference_percent: session.link().reference_difference_percent(),
            protocol_differences: self
                .protocol_check
                .as_ref()
                .map(|check| check.differences.iter().map(ToString::to_string).collect()),
            protocol_repeats: self.protocol_check.as_ref().map_or(0, |check| check.repeats),
            scripts_not_played: self.protocol_check.as_ref().map_or_else(Vec::new, |check| check.not_played.clone()),
            scripts_not_decided: self.protocol_check.as_ref().map_or_else(Vec::new, |check| check.undecided.clone()),
            ..chip
        }
    }
}

/// The first of each kind of difference, and their number.
fn distinct_differences(differences: &[ScriptDifference]) -> Vec<(&ScriptDifference, usize)> {
    let mut distinct: Vec<(&ScriptDifference, usize)> = Vec::new();
    for difference in differences {
        match distinct.iter_mut().find(|(known, _)| known.is_like(difference)) {
            Some((_, count)) => *count += 1,
            None => distinct.push((difference, 1)),
        }
    }
    distinct
}

/// The executor reports a configuration that the hosted reference refuses too as an invalid input.
pub(crate) fn refused_configuration(lost: Option<&RigError>) -> Option<Violation> {
    let kind = ViolationKind::RefusedConfiguration;
    matches!(lost, Some(RigError::ConfigurationRejected(_))).then_some(Violation {
        kind,
        at_s: 0.0,
        count: 1,
        worst: None,
        limit: None,
    })
}

/// True if the controller caused the error, so the trial fails. Any other error, such as a dead
/// line, makes the trial inconclusive.
pub(crate) fn is_controller_failure(error: &RigError) -> bool {
    match error {
        RigError::Trapped(_)
        | RigError::WrongSequence
        | RigError::ConfigurationRejected(_)
        | RigError::Link(LinkError::Target(_) | LinkError::Ended(_)) => true,
        RigError::Link(LinkError::Disconnected(_) | LinkError::BytesDiffer(_))
        | RigError::NoAnswer { .. }
        | RigError::NoIdentity { .. }
        | RigError::Cancelled
        | RigError::RejectedAnswer { .. }
        | RigError::Restarted
        | RigError::OtherClient
        | RigError::NoRealTime
        | RigError::InvalidScripts(_) => false,
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

const FREQUENCY_TOLERANCE_HZ: f64 = FREQUENCY_TOLERANCE_MHZ as f64 * 1e-3;
/// Relative tolerance for the rounding of gains to f32 on the wire.
const GAIN_TOLERANCE: f32 = 1e-5;

#[derive(Debug)]
pub(crate) struct CommandChecks {
    drive_limit_vpp: f32,
    start_hz: f64,
    range_hz: f64,
    slew_hz: f64,
    /// `None` after a stop of the controller, because it may then restart at any frequency.
    last_hz: Option<f64>,
    /// False if the scenario has faults, because a fault may turn back the time of the commands.
    checks_clock: bool,
    has_own_law: bool,
    last_us: Option<u32>,
    violations: [Option<Violation>; ViolationKind::COUNT],
}

impl CommandChecks {
    pub(crate) fn new(scenario: &Scenario) -> Self {
        let start_hz = f64::from(start_frequency_mhz(scenario)) / 1e3;
        Self {
            drive_limit_vpp: scenario.design_plate().drive_limit_vpp as f32,
            start_hz,
            range_hz: scenario.controller.frequency_range_hz,
            slew_hz: scenario.controller.frequency_slew_hz,
            last_hz: Some(start_hz),
            checks_clock: scenario.faults.is_empty() && scenario.chip_faults.is_empty(),
            has_own_law: scenario.has_own_law(),
            last_us: None,
            violations: [None; ViolationKind::COUNT],
        }
    }

    /// `samples` is the maximum number of samples since the last command. Each sample allows a
    /// frequency step of `slew_hz`.
    pub(crate) fn check_command(&mut self, command: &Command, samples: u32, now: Time) {
        let drive = command.drive_vpp;
        if drive.is_finite() && drive > self.drive_limit_vpp {
            let limit = f64::from(self.drive_limit_vpp);
            self.record(ViolationKind::DriveAboveLimit, now, Some(drive.into()), Some(limit));
        } else if drive.is_finite() && drive < 0.0 {
            self.record(ViolationKind::DriveBelowZero, now, Some(drive.into()), Some(0.0));
        }
        let time_us = command.target_time_us;
        let last_us = self.last_us.replace(time_us);
        if self.checks_clock && last_us.is_some_and(|last_us| time_us.wrapping_sub(last_us).cast_signed() < 0) {
            self.record(ViolationKind::ClockBackwards, now, None, None);
        }
        if command.state != ControllerState::Running {
            self.last_hz = None;
            return;
        }
        let frequency_hz = f64::from(command.frequency_mhz) / 1e3;
        let distance = frequency_hz - self.start_hz;
        if distance.abs() > self.range_hz + FREQUENCY_TOLERANCE_HZ {
            self.record(ViolationKind::FrequencyOutOfRange, now, Some(distance), Some(self.range_hz));
        }
        if let Some(last_hz) = self.last_hz.replace(frequency_hz) {
            let samples = f64::from(samples.max(1));
            let change = frequency_hz - last_hz;
            if change.abs() > samples * self.slew_hz + FREQUENCY_TOLERANCE_HZ {
                self.record(ViolationKind::FrequencySlew, now, Some(change / samples), Some(self.slew_hz));
            }
        }
    }

    /// A law may report 0 for a gain that it does not use. The bench's `dq-pi` laws use all gains.
    pub(crate) fn check_gains(&mut self, configure: &Configure, gains: &Gains, now: Time) {
        let values = |gains: &Gains| [gains.amplitude_kp, gains.amplitude_ki, gains.frequency_kp, gains.frequency_ki];
        let uses_all = !self.has_own_law && matches!(configure.law, LawId::DqPi | LawId::DqPiFixed | LawId::DqPiEuler);
        let matches = |asked: f32, answered: f32| {
            (answered == 0.0 && !uses_all)
                || (answered - asked).abs() <= GAIN_TOLERANCE * asked.abs().max(answered.abs())
        };
        let answered = values(gains);
        let differs = configure.gains.as_ref().is_some_and(|asked| {
            values(asked).into_iter().zip(answered).any(|(asked, answered)| !matches(asked, answered))
        });
        if differs || !answered.iter().all(|gain| gain.is_finite()) {
            self.record(ViolationKind::WrongConfiguration, now, None, None);
        }
        self.last_hz = Some(self.start_hz);
    }

    pub(crate) fn set_count(&mut self, kind: ViolationKind, count: u64, now: Time) {
        if count > 0 {
            let first = Violation { kind, at_s: now.seconds(), count, worst: None, limit: None };
            if let Some(slot) = self.violations.get_mut(kind as usize) {
                slot.get_or_insert(first).count = count;
            }
        }
    }

    fn set_frame_lengths(&mut self, first: Option<RejectedFrame>) {
        if let (Some(Some(violation)), Some(frame)) =
            (self.violations.get_mut(ViolationKind::RejectedFrame as usize), first)
        {
            violation.worst.get_or_insert(frame.bytes as f64);
            violation.limit.get_or_insert(frame.expected as f64);
        }
    }

    pub(crate) fn record_drives_after_safe(&mut self, drives: DrivesAfterSafe, now: Time) {
        if let Some(slot) = self.violations.get_mut(ViolationKind::DriveAfterSafe as usize) {
            *slot = Some(drive_violation(drives, now));
        }
    }

    pub(crate) fn violations(&self) -> Vec<Violation> {
        self.violations.iter().flatten().copied().collect()
    }

    fn record(&mut self, kind: ViolationKind, now: Time, value: Option<f64>, limit: Option<f64>) {
        let value = value.filter(|value| value.is_finite());
        let Some(slot) = self.violations.get_mut(kind as usize) else { return };
        let first = Violation { kind, at_s: now.seconds(), count: 0, worst: value, limit };
        let violation = slot.get_or_insert(first);
        violation.count += 1;
        if let (Some(worst), Some(value)) = (&mut violation.worst, value)
            && value.abs() > worst.abs()
        {
            *worst = value;
        }
    }
}

pub(crate) fn drive_violation(drives: DrivesAfterSafe, now: Time) -> Violation {
    let worst = Some(f64::from(drives.worst_vpp)).filter(|drive| drive.is_finite());
    Violation { kind: ViolationKind::DriveAfterSafe, at_s: now.seconds(), count: drives.count, worst, limit: None }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::trial::configure;
    use platebench_test_kit::load_scenario;
    use platebench_wire::{LawId, StateCause};
    use rstest::rstest;

    fn scenario() -> Scenario {
        let mut scenario = load_scenario("paper/fig13-closed-loop.toml");
        scenario.plate.drive_limit_vpp = 900.0;
        scenario.controller.frequency_range_hz = 250.0;
        scenario.controller.frequency_slew_hz = 100.0;
        scenario
    }

    fn command(drive_vpp: f32, offset_mhz: i32, state: ControllerState) -> Command {
        let frequency_mhz = start_frequency_mhz(&scenario()).wrapping_add_signed(offset_mhz);
        Command { drive_vpp, frequency_mhz, state, cause: StateCause::None, flags: 0, target_time_us: 0, compute_us: 0 }
    }

    fn at(ms: u64) -> Time {
        Time::from_nanos(ms * 1_000_000)
    }

    #[test]
    fn equal_differences_are_one_warning() {
        let difference = |(script, exchange, text, rule): (&str, usize, &str, Option<&'static str>)| ScriptDifference {
            script: script.to_owned(),
            exchange,
            text: text.to_owned(),
            rule,
        };
        let all = [
            ("a", 3, "x", None),
            ("a", 4, "x", None),
            ("a", 3, "y", None),
            ("b", 3, "x", None),
            ("c", 1, "gains 1", Some("rule")),
            ("d", 2, "gains 2", Some("rule")),
            ("d", 3, "other", Some("another rule")),
        ]
        .map(difference);
        let found: Vec<_> =
            distinct_differences(&all).into_iter().map(|(first, count)| (first.to_string(), count)).collect();
        let expected = [
            ("a: exchange 3: x", 2),
            ("a: exchange 3: y", 1),
            ("b: exchange 3: x", 1),
            ("c: exchange 1: gains 1", 2),
            ("d: exchange 3: other", 1),
        ];
        assert_eq!(found, expected.map(|(text, count)| (text.to_owned(), count)));
    }

    /// Commands: drive in Vpp, offset from the start frequency in mHz, samples since the last one.
    #[rstest]
    #[case::within_limits(&[(0.0, 0, 1), (900.0, 100_004, 1), (900.0, 0, 1)], &[])]
    #[case::above_limit(&[(900.1, 0, 1), (1e30, 0, 1)], &[(ViolationKind::DriveAboveLimit, 2)])]
    #[case::below_zero(&[(-0.1, 0, 1)], &[(ViolationKind::DriveBelowZero, 1)])]
    #[case::not_finite(&[(f32::NAN, 0, 1), (f32::INFINITY, 0, 1)], &[])]
    #[case::slew(&[(0.0, 100_006, 1)], &[(ViolationKind::FrequencySlew, 1)])]
    #[case::slew_over_lost_replies(&[(0.0, 200_000, 2)], &[])]
    #[case::range(&[(0.0, -250_006, 3)], &[(ViolationKind::FrequencyOutOfRange, 1)])]
    fn checks_commands(#[case] commands: &[(f32, i32, u32)], #[case] expected: &[(ViolationKind, u64)]) {
        let mut checks = CommandChecks::new(&scenario());
        let gains = Gains { amplitude_kp: 1.0, amplitude_ki: 1.0, frequency_kp: 1.0, frequency_ki: 1.0 };
        checks.check_gains(&configure(&scenario(), LawId::DqPi), &gains, Time::ZERO);
        for (number, &(drive, offset, samples)) in (1..).zip(commands) {
            checks.check_command(&command(drive, offset, ControllerState::Running), samples, at(number));
        }
        let found: Vec<_> = checks.violations().iter().map(|violation| (violation.kind, violation.count)).collect();
        assert_eq!(found, expected);
        assert!(checks.violations().iter().all(|violation| violation.at_s == 1e-3));
    }

    #[rstest]
    #[case::forwards("paper/fig13-closed-loop.toml", &[5, 6, 6], 0)]
    #[case::wraps("paper/fig13-closed-loop.toml", &[u32::MAX - 5, 5], 0)]
    #[case::backwards("paper/fig13-closed-loop.toml", &[5, 4, 5, 4], 2)]
    #[case::wraps_early("paper/fig13-closed-loop.toml", &[0x00FF_FFFF, 5], 1)]
    #[case::a_line_with_faults("faults/lost-command.toml", &[5, 4], 0)]
    #[case::a_chip_with_faults("chip/stuck-microseconds.toml", &[5, 4], 0)]
    fn checks_the_clock(#[case] file: &str, #[case] times_us: &[u32], #[case] count: u64) {
        let scenario = load_scenario(file);
        let mut checks = CommandChecks::new(&scenario);
        for (number, &target_time_us) in (1..).zip(times_us) {
            let command = Command { target_time_us, ..command(0.0, 0, ControllerState::Running) };
            checks.check_command(&command, 1, at(number));
        }
        let found = checks.violations().iter().map(|violation| violation.count).sum::<u64>();
        assert_eq!(found, count);
    }

    #[test]
    fn records_the_worst_value_and_the_first_time() {
        let mut checks = CommandChecks::new(&scenario());
        for (ms, drive) in [(3, 1_000.0), (4, 4_000.0), (5, 2_000.0)] {
            checks.check_command(&command(drive, 0, ControllerState::Running), 1, at(ms));
        }
        let expected = Violation {
            kind: ViolationKind::DriveAboveLimit,
            at_s: 3e-3,
            count: 3,
            worst: Some(4_000.0),
            limit: Some(900.0),
        };
        assert_eq!(checks.violations(), [expected]);
    }

    #[test]
    fn allows_any_frequency_in_range_after_a_stop() {
        let mut checks = CommandChecks::new(&scenario());
        checks.check_command(&command(0.0, 0, ControllerState::Fault), 1, at(1));
        checks.check_command(&command(0.0, 240_000, ControllerState::Running), 1, at(2));
        assert_eq!(checks.violations(), []);
    }

    #[rstest]
    #[case::as_asked(LawId::DqPi, Some([1.0, 2.0, 3.0, 4.0]), [1.0, 2.0, 3.0, 4.0], false)]
    #[case::unused(LawId::VoltageOnly, Some([1.0, 2.0, 3.0, 4.0]), [1.0, 2.0, 0.0, 0.0], false)]
    #[case::zero_instead(LawId::DqPi, Some([1.0, 2.0, 3.0, 4.0]), [1.0, 2.0, 3.0, 0.0], true)]
    #[case::other(LawId::VoltageOnly, Some([1.0, 2.0, 3.0, 4.0]), [1.0, 2.1, 3.0, 4.0], true)]
    #[case::own_design(LawId::DqPi, None, [5.0, 6.0, 7.0, 8.0], false)]
    #[case::not_finite(LawId::DqPi, None, [5.0, f32::NAN, 7.0, 8.0], true)]
    fn checks_gains(
        #[case] law: LawId,
        #[case] asked: Option<[f32; 4]>,
        #[case] answered: [f32; 4],
        #[case] wrong: bool,
    ) {
        let gains = |[amplitude_kp, amplitude_ki, frequency_kp, frequency_ki]: [f32; 4]| Gains {
            amplitude_kp,
            amplitude_ki,
            frequency_kp,
            frequency_ki,
        };
        let configure = Configure { gains: asked.map(gains), ..configure(&scenario(), law) };
        let mut checks = CommandChecks::new(&scenario());
        checks.check_gains(&configure, &gains(answered), Time::ZERO);
        assert_eq!(!checks.violations().is_empty(), wrong);
    }

    #[test]
    fn an_own_law_may_ignore_gains() {
        let mut own = scenario();
        own.set_law(platebench_model::scenario::OWN_LAW);
        let gains = Gains { amplitude_kp: 1.0, amplitude_ki: 2.0, frequency_kp: 3.0, frequency_ki: 4.0 };
        let configure = Configure { gains: Some(gains), ..configure(&own, LawId::DqPi) };
        let mut checks = CommandChecks::new(&own);
        checks.check_gains(&configure, &Gains { amplitude_kp: 0.0, ..gains }, Time::ZERO);
        assert_eq!(checks.violations(), []);
        checks.check_gains(&configure, &Gains { amplitude_kp: 5.0, ..gains }, Time::ZERO);
        assert_eq!(checks.violations().len(), 1);
    }
}
