//! Summarises the timing of a scenario in real time: loop delay against the law's budget, lateness,
//! losses.

use platebench_model::record::{ScenarioRecord, TimingRecord};

/// States the worst value of each quantity and the sum of each count. `None` in lockstep.
pub(crate) fn summary(scenario: &ScenarioRecord) -> Option<String> {
    let trials: Vec<&TimingRecord> =
        scenario.trials.iter().filter_map(|trial| trial.telemetry.timing.as_deref()).collect();
    let first = trials.first()?;
    let worst = |figure: fn(&TimingRecord) -> f64| trials.iter().map(|timing| figure(timing)).fold(0.0, f64::max);
    let count = |figure: fn(&TimingRecord) -> u64| trials.iter().map(|timing| figure(timing)).sum::<u64>();
    let scale =
        if first.time_scale == 1.0 { String::new() } else { format!(" at a time scale of {}", first.time_scale) };
    let mut parts = vec![format!("real time{scale}, paced by the {}", first.pacing)];
    if trials.iter().any(|timing| timing.loop_delay_us.is_some()) {
        let [typical, longest] = [
            worst(|timing| timing.loop_delay_us.map_or(0.0, |delay| delay.p50)),
            worst(|timing| timing.loop_delay_us.map_or(0.0, |delay| delay.max)),
        ];
        let of_budget = first.loop_delay_budget_us.map_or_else(String::new, |budget| {
            format!(
                ", {:.0} % and {:.0} % of the {budget:.0} µs of the law's budget",
                100.0 * typical / budget,
                100.0 * longest / budget
            )
        });
        parts.push(format!("loop delay {typical:.0} µs median, {longest:.0} µs maximum{of_budget}"));
    }
    parts.push(format!(
        "samples late by {:.0} µs median, {:.0} µs maximum",
        worst(|timing| timing.lateness_us.p50),
        worst(|timing| timing.lateness_us.max)
    ));
    let counts = [
        ("overruns", count(|timing| timing.overruns)),
        ("missed replies", count(|timing| timing.missed_replies)),
        ("lost replies", count(|timing| timing.lost_replies)),
        ("rejected frames", count(|timing| timing.rejected_frames)),
        ("lost rows", count(|timing| timing.lost_rows)),
    ];
    let periods = count(|timing| timing.periods);
    let lost: Vec<String> =
        counts.iter().filter(|(_, count)| *count > 0).map(|(name, count)| format!("{count} {name}")).collect();
    let lost = if lost.is_empty() { "no losses".to_owned() } else { lost.join(", ") };
    parts.push(format!("{lost} in {periods} periods"));
    parts.extend(
        first
            .target_clock_ppm
            .zip(first.target_clock_error_ppm)
            .map(|(ppm, error)| format!("controller's clock {ppm:+.0} ± {error:.0} ppm")),
    );
    let steal_ms: f64 = trials.iter().filter_map(|timing| timing.steal_ms).sum();
    if steal_ms > 0.0 {
        parts.push(format!("the hypervisor took {steal_ms:.0} ms of processor time from this machine"));
    }
    if first.scheduling != "SCHED_FIFO" {
        parts.push(first.scheduling.clone());
    }
    if !trials.iter().all(|timing| timing.safe_confirmed) {
        parts.push("0 V was not confirmed at the end".to_owned());
    }
    Some(parts.join("; "))
}
