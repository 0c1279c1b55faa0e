use platebench_engine::{Clock, Pacing, RunHooks, RunPlan, TimeBase, run};
use platebench_model::record::{Overrides, RunFolder, RunRecord};
use platebench_model::scenario::Scenario;
use platebench_rig::{BoxedLink, HostedLink, RigSpec, WallClockLink};
use platebench_wire::{Packet, PacketReader};
use std::path::Path;

pub(crate) const FIG13: &str = "paper/fig13-closed-loop.toml";
pub(crate) const LOCKSTEP: Clock = Clock::Lockstep { wire_time: false };
pub(crate) const REAL_TIME: Clock = Clock::RealTime(TimeBase { time_scale: 1.0, pacing: Pacing::Bench });

pub(crate) fn plan(scenarios: Vec<Scenario>, clock: Clock) -> RunPlan {
    let overrides = Overrides::default();
    RunPlan { scenarios, jobs: 1, clock, own_clock: false, rig: "hosted".to_owned(), overrides }
}

pub(crate) fn run_hosted(plan: &RunPlan, out: &Path) -> RunRecord {
    let folder = RunFolder::create(Some(out)).unwrap();
    run(plan, &folder, &|| RigSpec::hosted().connect(), RunHooks::default()).unwrap()
}

/// Returns a hosted controller. With a real-time clock its time is simulated, so that the load of the
/// machine changes no result.
pub(crate) fn new_link(clock: Clock) -> BoxedLink {
    if clock == LOCKSTEP {
        Box::new(HostedLink::new())
    } else {
        Box::new(WallClockLink::in_simulated_time(HostedLink::new()))
    }
}

pub(crate) fn packets(bytes: &[u8]) -> Vec<Packet> {
    PacketReader::new().packets(bytes).flatten().collect()
}
