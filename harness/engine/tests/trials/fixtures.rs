use platebench_engine::{Clock, Pacing, RunError, RunHooks, RunPlan, TimeBase, run};
use platebench_model::record::{Overrides, RunFolder, RunRecord};
use platebench_model::scenario::Scenario;
use platebench_rig::{BoxedLink, HostedLink, Link, RigSpec, WallClockLink};
use std::path::Path;

pub(crate) const FIG13: &str = "paper/fig13-closed-loop.toml";
pub(crate) const LOCKSTEP: Clock = Clock::Lockstep { wire_time: false };
pub(crate) const REAL_TIME: Clock = Clock::RealTime(TimeBase { time_scale: 1.0, pacing: Pacing::Bench });

pub(crate) fn plan(scenarios: Vec<Scenario>, clock: Clock) -> RunPlan {
    RunPlan::new(&RigSpec::hosted(), clock, 1, scenarios, Overrides::default())
}

pub(crate) fn run_hosted(plan: &RunPlan, out: &Path) -> RunRecord {
    run_with_link(plan, out, HostedLink::new).unwrap()
}

/// Runs `plan` with the links of `connect` and writes the run into the folder `out`.
pub(crate) fn run_with_link<L: Link + 'static>(
    plan: &RunPlan,
    out: &Path,
    connect: impl Fn() -> L + Send + Sync,
) -> Result<RunRecord, RunError> {
    let folder = RunFolder::create(Some(out)).unwrap();
    run(plan, &folder, &|| Ok(Box::new(connect()) as BoxedLink), RunHooks::default())
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
