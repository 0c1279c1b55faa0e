//! Compares the commands of a controller with recorded ones, sample by sample, within a tolerance
//! tube.

use crate::tube::{Exceedance, Tube, TubePoint, TubeSignal};
use platebench_model::record::{Telemetry, Verdict, Violation};
use schemars::JsonSchema;
use serde::Serialize;

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ReplayCommand {
    /// Within the amplifier's range; NaN if a controller commanded NaN or an infinite drive.
    pub drive_vpp: f64,
    pub frequency_hz: f64,
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ReplayStep {
    /// Time since the start of the recording.
    pub t_s: f64,
    pub setpoint_um: f64,
    pub wd_um: f64,
    pub wq_um: f64,
    /// `None` if the recording ends before the command acts.
    pub command: Option<ReplayCommand>,
}

/// Why the commands after an instant cannot be compared.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, thiserror::Error, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum RecordingEnd {
    #[error("the recorded controller did not answer from {:.1} ms on: the rest was not replayed", at_s * 1e3)]
    LostReply { at_s: f64 },
    #[error("the recorded controller stopped from {:.1} ms on: the rest was not replayed", at_s * 1e3)]
    Stopped { at_s: f64 },
    #[error("a planned fault acts on the recording from {:.1} ms on: the rest was not replayed", at_s * 1e3)]
    Fault { at_s: f64 },
    #[error("the recording lacks samples from {:.1} ms on: the rest was not replayed", at_s * 1e3)]
    MissingSample { at_s: f64 },
}

#[derive(Debug, Clone, PartialEq)]
pub struct RecordedCommands {
    pub name: String,
    pub steps: Vec<ReplayStep>,
    pub end: Option<RecordingEnd>,
}

/// Largest difference of one signal over all compared samples.
#[derive(Debug, Clone, PartialEq, Serialize, JsonSchema)]
pub struct CommandDifference {
    pub signal: &'static str,
    pub unit: &'static str,
    /// `null` if the controller commanded NaN or an infinite value.
    #[schemars(with = "Option<f64>")]
    pub largest: f64,
    pub at_ms: f64,
    /// The worst difference outside the tube.
    pub exceedance: Option<Exceedance>,
}

#[derive(Debug, Clone, PartialEq, Serialize, JsonSchema)]
pub struct ReplayResult {
    pub verdict: Verdict,
    /// Always true, because the recorded samples do not react to the commands.
    pub open_loop: bool,
    pub recording: String,
    pub rig: String,
    pub firmware: String,
    pub law: String,
    /// Number of samples that were sent.
    pub samples: usize,
    /// Number of samples with a recorded command and a reply.
    pub compared: usize,
    /// Number of compared commands that are equal bit for bit.
    pub identical: usize,
    pub differences: Vec<CommandDifference>,
    pub missed_replies: usize,
    pub violations: Vec<Violation>,
    /// Why the controller stopped.
    pub stopped: Option<String>,
    /// Why the session ended early.
    pub ended: Option<String>,
    /// True if the rig, not the controller, ended the session.
    pub rig_lost: bool,
    pub recording_end: Option<RecordingEnd>,
    pub safe_confirmed: bool,
}

/// What a rig did with the samples of a recording.
#[derive(Debug)]
pub struct Replay {
    pub rig: String,
    pub firmware: String,
    pub law: &'static str,
    /// In the order of the steps; `None` without a reply. Shorter if the session ended early.
    pub replies: Vec<Option<ReplayCommand>>,
    pub telemetry: Telemetry,
    pub rig_lost: bool,
    pub safe_confirmed: bool,
}

impl ReplayResult {
    pub fn new(recording: &RecordedCommands, replay: Replay) -> Self {
        let answered = recording.steps.iter().zip(&replay.replies);
        let pairs: Vec<_> = answered.filter_map(|(step, reply)| Some((step.t_s, step.command?, (*reply)?))).collect();
        let is_identical = |pair: &&(f64, ReplayCommand, ReplayCommand)| pair.1 == pair.2;
        let mut result = Self {
            verdict: Verdict::Inconclusive,
            open_loop: true,
            recording: recording.name.clone(),
            rig: replay.rig,
            firmware: replay.firmware,
            law: replay.law.to_owned(),
            samples: replay.replies.len(),
            compared: pairs.len(),
            identical: pairs.iter().filter(is_identical).count(),
            differences: compare_commands(&pairs),
            missed_replies: replay.replies.iter().filter(|reply| reply.is_none()).count(),
            violations: replay.telemetry.violations,
            stopped: replay.telemetry.stopped,
            ended: replay.telemetry.ended,
            rig_lost: replay.rig_lost,
            recording_end: recording.end,
            safe_confirmed: replay.safe_confirmed,
        };
        result.verdict = result.decide();
        result
    }

    fn decide(&self) -> Verdict {
        let is_outside = self.differences.iter().any(|difference| difference.exceedance.is_some());
        let crashed = self.ended.is_some() && !self.rig_lost;
        if is_outside || crashed || self.stopped.is_some() || !self.violations.is_empty() {
            return Verdict::Fail;
        }
        let is_whole = self.compared > 0 && self.missed_replies == 0 && self.recording_end.is_none();
        if is_whole && !self.rig_lost && self.safe_confirmed { Verdict::Pass } else { Verdict::Inconclusive }
    }
}

/// `pairs` contains (time in s, recorded command, replayed command).
fn compare_commands(pairs: &[(f64, ReplayCommand, ReplayCommand)]) -> Vec<CommandDifference> {
    type Value = fn(&ReplayCommand) -> f64;
    let values: [(&str, Value); 2] =
        [("drive_vpp", |command| command.drive_vpp), ("frequency_hz", |command| command.frequency_hz)];
    let compared = values.into_iter().filter_map(|(name, value)| {
        let signal = TubeSignal::from_name(name)?;
        let point = |&(t_s, recorded, _): &(f64, ReplayCommand, _)| TubePoint {
            t_ms: t_s * 1e3,
            value: value(&recorded),
            width: 0.0,
        };
        let tube =
            Tube { signal: name.to_owned(), tolerance: signal.tolerance, points: pairs.iter().map(point).collect() };
        let response: Vec<_> = pairs.iter().map(|(t_s, _, replayed)| (t_s * 1e3, value(replayed))).collect();
        let distances =
            pairs.iter().map(|(t_s, recorded, replayed)| ((value(replayed) - value(recorded)).abs(), t_s * 1e3));
        // `total_cmp` sorts NaN as the largest. Of equal differences, the first is reported.
        let (largest, at_ms) =
            distances.reduce(|worst, other| if other.0.total_cmp(&worst.0).is_gt() { other } else { worst })?;
        let exceedance = tube.worst_exceedance(&response, None);
        Some(CommandDifference { signal: signal.name(), unit: signal.unit, largest, at_ms, exceedance })
    });
    compared.collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use rstest::rstest;

    fn recording() -> RecordedCommands {
        let command = |index: u32| ReplayCommand { drive_vpp: 300.0, frequency_hz: 32_000.0 + f64::from(index) };
        let step = |index: u32| ReplayStep {
            t_s: f64::from(index) * 1e-3,
            setpoint_um: 2.0,
            wd_um: 1.0,
            wq_um: 0.0,
            command: Some(command(index)),
        };
        RecordedCommands { name: "trace.csv".to_owned(), steps: (0..5).map(step).collect(), end: None }
    }

    fn replay_of(recording: &RecordedCommands) -> Replay {
        Replay {
            rig: "hosted".to_owned(),
            firmware: "test".to_owned(),
            law: "dq-pi",
            replies: recording.steps.iter().map(|step| step.command).collect(),
            telemetry: Telemetry::default(),
            rig_lost: false,
            safe_confirmed: true,
        }
    }

    #[test]
    fn equal_commands_pass_with_difference_0() {
        let recording = recording();
        let result = ReplayResult::new(&recording, replay_of(&recording));
        assert_eq!((result.verdict, result.compared, result.identical), (Verdict::Pass, 5, 5));
        assert!(result.differences.iter().all(|difference| difference.largest == 0.0));
        assert_eq!(result.differences.len(), 2);
    }

    /// The tube allows 3 Vpp + 1 % and 0.5 Hz, plus the change of the recorded command in 0.05 ms.
    #[rstest]
    #[case::drive_inside(5.9, 0.0, Verdict::Pass)]
    #[case::drive_outside(6.1, 0.0, Verdict::Fail)]
    #[case::frequency_inside(0.0, -0.54, Verdict::Pass)]
    #[case::frequency_outside(0.0, -0.56, Verdict::Fail)]
    #[case::not_a_number(f64::NAN, 0.0, Verdict::Fail)]
    fn one_command_outside_the_tube_fails(#[case] vpp: f64, #[case] hz: f64, #[case] expected: Verdict) {
        let recording = recording();
        let mut replay = replay_of(&recording);
        let changed = replay.replies[2].as_mut().unwrap();
        changed.drive_vpp += vpp;
        changed.frequency_hz += hz;
        let result = ReplayResult::new(&recording, replay);
        assert_eq!((result.verdict, result.identical), (expected, 4), "{:?}", result.differences);
        let largest = &result.differences[usize::from(hz != 0.0)];
        assert!(largest.largest.is_nan() || (largest.largest - (vpp.abs() + hz.abs())).abs() < 1e-9);
        assert_eq!(largest.at_ms, 2.0);
    }

    #[rstest]
    #[case::reply_missing(
        |replay: &mut Replay, _: &mut RecordedCommands| replay.replies[1] = None,
        Verdict::Inconclusive
    )]
    #[case::rig_lost(|replay: &mut Replay, _: &mut RecordedCommands| replay.rig_lost = true, Verdict::Inconclusive)]
    #[case::crashed(
        |replay: &mut Replay, _: &mut RecordedCommands| replay.telemetry.ended = Some("trap".into()),
        Verdict::Fail
    )]
    #[case::stopped(
        |replay: &mut Replay, _: &mut RecordedCommands| replay.telemetry.stopped = Some("noise".into()),
        Verdict::Fail
    )]
    #[case::no_0_v(
        |replay: &mut Replay, _: &mut RecordedCommands| replay.safe_confirmed = false,
        Verdict::Inconclusive
    )]
    #[case::nothing(|replay: &mut Replay, _: &mut RecordedCommands| replay.replies.clear(), Verdict::Inconclusive)]
    #[case::cut(
        |_: &mut Replay, recording: &mut RecordedCommands| recording.end = Some(RecordingEnd::Fault { at_s: 0.005 }),
        Verdict::Inconclusive
    )]
    fn a_pass_needs_a_whole_replay(#[case] change: fn(&mut Replay, &mut RecordedCommands), #[case] expected: Verdict) {
        let mut recording = recording();
        let mut replay = replay_of(&recording);
        change(&mut replay, &mut recording);
        assert_eq!(ReplayResult::new(&recording, replay).verdict, expected);
    }
}
