//! Tests scenes between trials: one controller plays everything, and its history must not matter.

use crate::fixtures::{LOCKSTEP, plan, run_with_link};
use platebench_engine::{RunPlan, rejudge};
use platebench_model::record::{RunRecord, Verdict};
use platebench_rig::Link;
use platebench_test_kit::{PLATE, commands, link_with_changed_answers, write_scenario};
use platebench_wire::{LawId, Message};
use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};

const SCENARIO: &str = "title = \"History\"\nplate = \"plate.toml\"\nduration_ms = 20.0\n[profile]\nsetpoint_um = 2.0\n\
    [trials]\ncount = 3\n[[between]]\nduration_ms = 5.0\ncontroller = { law = \"deadbeat\", period_ms = 0.5 }\n\
    profile = { setpoint_um = 1.0 }\n[[expect]]\nmetric = \"trial_difference_um\"\nat_most = 1e-6\n";

/// Counts configurations. With `has_fault`, drives less after it has run `deadbeat`.
fn remembering_link(has_fault: bool, configurations: Arc<AtomicU32>) -> impl Link {
    let mut has_run_deadbeat = false;
    link_with_changed_answers(move |_, requests, answers| {
        for request in requests {
            if let Message::Configure(configure) = request.message {
                configurations.fetch_add(1, Ordering::Relaxed);
                has_run_deadbeat |= configure.law == LawId::Deadbeat;
            }
        }
        if has_fault && has_run_deadbeat {
            commands(answers).for_each(|command| command.drive_vpp *= 0.999);
        }
    })
}

/// Returns the record, the number of connections and the number of configurations.
fn play(text: &str, has_fault: bool, jobs: usize) -> (RunRecord, u32, u32) {
    let folder = tempfile::tempdir().unwrap();
    let scenario = write_scenario(folder.path(), text, PLATE);
    let out = folder.path().join("run");
    let (connections, configurations) = (AtomicU32::new(0), Arc::new(AtomicU32::new(0)));
    let connect = || {
        connections.fetch_add(1, Ordering::Relaxed);
        remembering_link(has_fault, Arc::clone(&configurations))
    };
    let plan = RunPlan { jobs, ..plan(vec![scenario], LOCKSTEP) };
    let record = run_with_link(&plan, &out, connect).unwrap();
    let judged = rejudge(&out, None).unwrap();
    assert_eq!(judged.scenarios[0].expectations, record.scenarios[0].expectations);
    (record, connections.into_inner(), configurations.load(Ordering::Relaxed))
}

#[test]
fn one_controller_plays_trials_and_the_scenes_between_them() {
    for jobs in [1, 4] {
        let (record, connections, configurations) = play(SCENARIO, false, jobs);
        assert_eq!(record.verdict, Verdict::Pass, "{:?}", record.scenarios[0].expectations);
        // Connections: for the identity and for the trials. Configurations: 3 trials, 2 scenes.
        assert_eq!((connections, configurations), (2, 5), "{jobs} jobs");
    }
}

#[test]
fn a_controller_that_remembers_an_earlier_scene_fails() {
    let (record, ..) = play(SCENARIO, true, 1);
    assert_eq!(record.verdict, Verdict::Fail);
    let value = record.scenarios[0].expectations[0].value.unwrap();
    assert!(value > 1e-6, "{value}");
    let without = SCENARIO.replace("deadbeat", "dq-pi");
    assert_eq!(play(&without, true, 1).0.verdict, Verdict::Pass);
}
