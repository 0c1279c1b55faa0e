//! Compares verdicts of a live run, of its stored traces, and of a play in memory.

use platebench_engine::{Clock, RunHooks, RunPlan, rejudge};
use platebench_experiments::trust::{catalogue, play};
use platebench_model::record::{Overrides, RunFolder, Verdict};
use platebench_rig::{BoxedLink, RigSpec};
use platebench_test_kit::{commands, link_with_changed_answers, load_scenario};
use platebench_wire::Message;

#[test]
fn live_stored_and_in_memory_verdicts_are_equal() {
    for name in ["setpoint-scale", "frequency-integral-missing", "restart-after-timeout", "no-checksum", "jitter"] {
        let entry = catalogue().into_iter().find(|entry| entry.name == name).unwrap();
        let scenario = load_scenario(entry.witness_scenario);
        let folder = tempfile::tempdir().unwrap();
        let out = RunFolder::create(Some(&folder.path().join("run"))).unwrap();
        let clock = Clock::Lockstep { wire_time: false };
        let plan = RunPlan::new(&RigSpec::hosted(), clock, 1, vec![scenario.clone()], Overrides::default());
        let live = platebench_engine::run(&plan, &out, &|| Ok(entry.link()), RunHooks::default()).unwrap();
        let stored = rejudge(out.path(), None).unwrap();
        let judged = play(&scenario, entry.name, &|| entry.link()).unwrap().judgement.with_bench_errors(&scenario);
        assert_eq!(live.scenarios[0].expectations, judged.expectations, "{name}");
        assert_eq!(stored.scenarios[0].expectations, judged.expectations, "{name}");
    }
}

/// Controller that doubles its drive after a second configuration without a restart between them.
fn controller_with_leftover_gain() -> BoxedLink {
    let mut configurations = 0;
    Box::new(link_with_changed_answers(move |_, requests, answers| {
        configurations += requests.iter().filter(|packet| matches!(packet.message, Message::Configure(_))).count();
        if configurations > 1 {
            commands(answers).for_each(|command| command.drive_vpp *= 2.0);
        }
    }))
}

#[test]
fn scenes_between_trials_find_a_leftover_configuration() {
    let mut scenario = load_scenario("reference/between.toml");
    let judged = play(&scenario, "leftover", &controller_with_leftover_gain).unwrap().judgement;
    assert_eq!(judged.verdict, Verdict::Fail);
    scenario.between.clear();
    let judged = play(&scenario, "leftover", &controller_with_leftover_gain).unwrap().judgement;
    assert_eq!(judged.verdict, Verdict::Pass, "only the scenes between trials find it");
}
