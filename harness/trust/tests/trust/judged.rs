//! What is judged in memory is what a run judges, and what its stored traces come to.

use crate::suite::scenario;
use platebench_runner::{Cancel, Clock, Plan, RunFolder, rejudge};
use platebench_trust::{catalogue, play};
use platebench_verdict::record::Overrides;

#[test]
fn a_run_and_its_stored_traces_come_to_the_same_verdicts() {
    for name in ["setpoint-scale", "frequency-integral-missing", "restless", "credulous", "jitter"] {
        let entry = catalogue().into_iter().find(|entry| entry.name == name).unwrap();
        let scenario = scenario(entry.witness);
        let folder = tempfile::tempdir().unwrap();
        let out = RunFolder::create(Some(&folder.path().join("run"))).unwrap();
        let plan = Plan {
            scenarios: vec![scenario.clone()],
            jobs: 1,
            clock: Clock::Lockstep { wire_time: false },
            own_clock: false,
            rig: "hosted".to_owned(),
            overrides: Overrides::default(),
        };
        let live = platebench_runner::run(&plan, &out, &|| Ok(entry.link()), &Cancel::default(), &mut |_| {}).unwrap();
        let stored = rejudge(out.path(), None).unwrap();
        let judged = play(&scenario, entry.name, entry.link()).unwrap();
        assert_eq!(live.scenarios[0].expectations, judged.expectations, "{name}");
        assert_eq!(stored.scenarios[0].expectations, judged.expectations, "{name}");
    }
}
