//! Compares verdicts of a live run, of its stored traces, and of a play in memory.

use platebench_engine::{Clock, RunHooks, RunPlan, rejudge};
use platebench_experiments::trust::{catalogue, play};
use platebench_model::record::{Overrides, RunFolder, Verdict};
use platebench_rig::{BoxedLink, HostedLink, Link, LinkError};
use platebench_test_kit::load_scenario;
use platebench_wire::{Message, PacketReader};
use std::time::Duration;

#[test]
fn live_stored_and_in_memory_verdicts_are_equal() {
    for name in ["setpoint-scale", "frequency-integral-missing", "restart-after-timeout", "no-checksum", "jitter"] {
        let entry = catalogue().into_iter().find(|entry| entry.name == name).unwrap();
        let scenario = load_scenario(entry.witness_scenario);
        let folder = tempfile::tempdir().unwrap();
        let out = RunFolder::create(Some(&folder.path().join("run"))).unwrap();
        let plan = RunPlan {
            scenarios: vec![scenario.clone()],
            jobs: 1,
            clock: Clock::Lockstep { wire_time: false },
            own_clock: false,
            rig: "hosted".to_owned(),
            overrides: Overrides::default(),
        };
        let live = platebench_engine::run(&plan, &out, &|| Ok(entry.link()), RunHooks::default()).unwrap();
        let stored = rejudge(out.path(), None).unwrap();
        let judged = play(&scenario, entry.name, &|| entry.link()).unwrap().judgement.with_bench_errors(&scenario);
        assert_eq!(live.scenarios[0].expectations, judged.expectations, "{name}");
        assert_eq!(stored.scenarios[0].expectations, judged.expectations, "{name}");
    }
}

/// Controller that doubles its drive after a second configuration without a restart between them.
#[derive(Default)]
struct LeftoverGain {
    inner: HostedLink,
    configurations: u32,
}

impl Link for LeftoverGain {
    fn exchange(&mut self, now: Duration, bytes: &[u8], answer: &mut Vec<u8>) -> Result<Duration, LinkError> {
        let requests: Vec<_> = PacketReader::new().packets(bytes).flatten().collect();
        self.configurations +=
            requests.iter().filter(|packet| matches!(packet.message, Message::Configure(_))).count() as u32;
        let mut own = Vec::new();
        self.inner.exchange(now, bytes, &mut own)?;
        for mut packet in PacketReader::new().packets(&own).flatten() {
            if let Message::Command(command) = &mut packet.message
                && self.configurations > 1
            {
                command.drive_vpp *= 2.0;
            }
            answer.extend_from_slice(packet.encode().as_bytes());
        }
        Ok(Duration::ZERO)
    }

    fn advance_to(&mut self, now: Duration, received: &mut Vec<u8>) -> Result<(), LinkError> {
        self.inner.advance_to(now, received)
    }

    fn restart(&mut self) -> Result<bool, LinkError> {
        self.configurations = 0;
        self.inner.restart()
    }

    fn continue_trial(&mut self) {
        self.inner.continue_trial();
    }
}

#[test]
fn scenes_between_trials_find_a_leftover_configuration() {
    let connect = || -> BoxedLink { Box::<LeftoverGain>::default() };
    let mut scenario = load_scenario("reference/between.toml");
    let judged = play(&scenario, "leftover", &connect).unwrap().judgement;
    assert_eq!(judged.verdict, Verdict::Fail);
    scenario.between.clear();
    let judged = play(&scenario, "leftover", &connect).unwrap().judgement;
    assert_eq!(judged.verdict, Verdict::Pass, "only the scenes between trials find it");
}
