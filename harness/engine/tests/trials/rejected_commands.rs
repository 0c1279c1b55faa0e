//! Checks that a run ends if every command of the controller has a wrong layout.

use crate::fixtures::{FIG13, LOCKSTEP, packets, plan};
use platebench_engine::{MAX_LOSSES, RunError, RunHooks, run};
use platebench_model::record::{RunFolder, RunRecord, Verdict};
use platebench_rig::{BoxedLink, HostedLink, Link, LinkError};
use platebench_test_kit::load_scenario;
use platebench_wire::Message;
use std::time::Duration;

/// Answers samples with frames of 26 bytes, expected are 24. The samples of the first trials have
/// correct answers.
struct LongCommands {
    controller: HostedLink,
    correct_trials: u32,
    configurations: u32,
}

impl Link for LongCommands {
    fn exchange(&mut self, now: Duration, bytes: &[u8], answer: &mut Vec<u8>) -> Result<Duration, LinkError> {
        let delay = self.controller.exchange(now, bytes, answer)?;
        let has = |kind: fn(&Message) -> bool| packets(bytes).iter().any(|packet| kind(&packet.message));
        self.configurations += u32::from(has(|message| matches!(message, Message::Configure(_))));
        if self.configurations > self.correct_trials && has(|message| matches!(message, Message::Sample(_))) {
            answer.clear();
            answer.extend([1; 25].into_iter().chain([0]));
        }
        Ok(delay)
    }

    fn advance_to(&mut self, now: Duration, received: &mut Vec<u8>) -> Result<(), LinkError> {
        self.controller.advance_to(now, received)
    }

    fn restart(&mut self) -> Result<bool, LinkError> {
        self.controller.restart()
    }
}

fn play(trials: u32, correct_trials: u32) -> Result<RunRecord, RunError> {
    let folder = tempfile::tempdir().unwrap();
    let run_folder = RunFolder::create(Some(&folder.path().join("run"))).unwrap();
    let scenarios = (0..trials).map(|number| {
        let mut scenario = load_scenario(FIG13);
        scenario.file = format!("{number}.toml");
        scenario
    });
    let connect = || -> Result<BoxedLink, _> {
        Ok(Box::new(LongCommands { controller: HostedLink::new(), correct_trials, configurations: 0 }))
    };
    run(&plan(scenarios.collect(), LOCKSTEP), &run_folder, &connect, RunHooks::default())
}

#[test]
fn fewer_trials_without_a_command_are_all_played() {
    let record = play(MAX_LOSSES - 1, 0).unwrap();
    assert!(record.complete && record.verdict != Verdict::Pass);
    assert_eq!(record.scenarios.len(), MAX_LOSSES as usize - 1);
}

#[test]
fn trials_without_a_command_end_the_run() {
    let error = play(MAX_LOSSES + 5, 0).unwrap_err();
    assert!(matches!(error, RunError::Rejected { trials: MAX_LOSSES, .. }), "{error:?}");
    assert_eq!(
        error.to_string(),
        "5 consecutive trials ended with: no command from the controller: a frame of 26 bytes was rejected, expected \
         24 bytes"
    );
}

/// Each connection begins with a trial that has commands.
#[test]
fn a_trial_with_commands_in_between_does_not_end_it() {
    let record = play(3 * MAX_LOSSES, 1).unwrap();
    assert!(record.complete);
    assert_eq!(record.scenarios.iter().filter(|scenario| scenario.verdict == Verdict::Pass).count(), 8);
}
