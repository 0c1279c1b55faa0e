//! Checks that a run ends if every command of the controller has a wrong layout.

use crate::fixtures::{FIG13, LOCKSTEP, plan, run_with_link};
use platebench_engine::{MAX_LOSSES, RunError};
use platebench_model::record::{RunRecord, Verdict};
use platebench_rig::Link;
use platebench_test_kit::{ScriptedLink, load_scenario, packets};
use platebench_wire::Message;
use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};

/// Answers samples with frames of 26 bytes, expected are 24. The samples of the first trials have
/// correct answers.
fn link_with_long_commands(correct_trials: u32) -> impl Link {
    // Each trial restarts the script, so the count is shared.
    let configurations = Arc::new(AtomicU32::new(0));
    ScriptedLink::new(move |controller, now, bytes, answer| {
        let delay = controller.exchange(now, bytes, answer)?;
        let has = |kind: fn(&Message) -> bool| packets(bytes).iter().any(|packet| kind(&packet.message));
        if has(|message| matches!(message, Message::Configure(_))) {
            configurations.fetch_add(1, Ordering::Relaxed);
        }
        let is_wrong = configurations.load(Ordering::Relaxed) > correct_trials;
        if is_wrong && has(|message| matches!(message, Message::Sample(_))) {
            answer.clear();
            answer.extend([1; 25].into_iter().chain([0]));
        }
        Ok(delay)
    })
}

fn play(trials: u32, correct_trials: u32) -> Result<RunRecord, RunError> {
    let folder = tempfile::tempdir().unwrap();
    let scenarios = (0..trials).map(|number| {
        let mut scenario = load_scenario(FIG13);
        scenario.file = format!("{number}.toml");
        scenario
    });
    run_with_link(&plan(scenarios.collect(), LOCKSTEP), &folder.path().join("run"), || {
        link_with_long_commands(correct_trials)
    })
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
