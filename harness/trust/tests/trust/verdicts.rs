//! Compares verdicts of a live run, of its stored traces, and of a play in memory.

use platebench_record::Overrides;
use platebench_record::RunFolder;
use platebench_runner::{Clock, RunHooks, RunPlan, rejudge};
use platebench_test_kit::load_scenario;
use platebench_trust::{catalogue, play};

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
        let live = platebench_runner::run(&plan, &out, &|| Ok(entry.link()), RunHooks::default()).unwrap();
        let stored = rejudge(out.path(), None).unwrap();
        let judged = play(&scenario, entry.name, entry.link()).unwrap().judgement;
        assert_eq!(live.scenarios[0].expectations, judged.expectations, "{name}");
        assert_eq!(stored.scenarios[0].expectations, judged.expectations, "{name}");
    }
}
