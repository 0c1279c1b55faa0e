//! Tests scenes between trials: one controller plays everything, and its history must not matter.

use crate::fixtures::{LOCKSTEP, packets, plan};
use platebench_engine::{RunHooks, rejudge, run};
use platebench_model::record::{RunFolder, RunRecord, Verdict};
use platebench_rig::{BoxedLink, HostedLink, Link, LinkError};
use platebench_test_kit::write_scenario;
use platebench_wire::{LawId, Message};
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::Duration;

const SCENARIO: &str = "title = \"History\"\nplate = \"plate.toml\"\nduration_ms = 20.0\n[profile]\nsetpoint_um = 2.0\n\
    [trials]\ncount = 3\n[[between]]\nduration_ms = 5.0\ncontroller = { law = \"deadbeat\", period_ms = 0.5 }\n\
    profile = { setpoint_um = 1.0 }\n[[expect]]\nmetric = \"trial_difference_um\"\nat_most = 1e-6\n";

const PLATE: &str = include_str!("../../../../scenarios/plates/aluminium-198x138.toml");

/// Counts configurations. With `has_fault`, drives less after it has run `deadbeat`.
struct Remembering<'a> {
    inner: HostedLink,
    has_fault: bool,
    has_run_deadbeat: bool,
    configurations: &'a AtomicU32,
}

impl Link for Remembering<'_> {
    fn exchange(&mut self, now: Duration, bytes: &[u8], answer: &mut Vec<u8>) -> Result<Duration, LinkError> {
        for packet in packets(bytes) {
            if let Message::Configure(configure) = packet.message {
                self.configurations.fetch_add(1, Ordering::Relaxed);
                self.has_run_deadbeat |= configure.law == LawId::Deadbeat;
            }
        }
        let mut received = Vec::new();
        let delay = self.inner.exchange(now, bytes, &mut received)?;
        for packet in &mut packets(&received) {
            if let Message::Command(command) = &mut packet.message
                && self.has_fault
                && self.has_run_deadbeat
            {
                command.drive_vpp *= 0.999;
            }
            answer.extend(packet.encode().as_bytes());
        }
        Ok(delay)
    }

    fn advance_to(&mut self, now: Duration, received: &mut Vec<u8>) -> Result<(), LinkError> {
        self.inner.advance_to(now, received)
    }

    fn restart(&mut self) -> Result<bool, LinkError> {
        self.has_run_deadbeat = false;
        self.inner.restart()
    }

    fn continue_trial(&mut self) {
        self.inner.continue_trial();
    }
}

/// Returns the record, the number of connections and the number of configurations.
fn play(text: &str, has_fault: bool, jobs: usize) -> (RunRecord, u32, u32) {
    let folder = tempfile::tempdir().unwrap();
    let scenario = write_scenario(folder.path(), text, PLATE);
    let run_folder = RunFolder::create(Some(&folder.path().join("run"))).unwrap();
    let (connections, configurations) = (AtomicU32::new(0), &*Box::leak(Box::new(AtomicU32::new(0))));
    let connect = || {
        connections.fetch_add(1, Ordering::Relaxed);
        let inner = HostedLink::new();
        Ok(Box::new(Remembering { inner, has_fault, has_run_deadbeat: false, configurations }) as BoxedLink)
    };
    let mut plan = plan(vec![scenario], LOCKSTEP);
    plan.jobs = jobs;
    let record = run(&plan, &run_folder, &connect, RunHooks::default()).unwrap();
    let judged = rejudge(run_folder.path(), None).unwrap();
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
