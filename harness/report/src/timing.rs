//! How real time was kept, in a sentence: the rig's delay beside what the law bears, and how punctual the bench was.
//!
//! Neighbours: the figures stand in each trial's telemetry; the console and the page say the same.

use platebench_verdict::ScenarioRecord;
use platebench_verdict::record::Timing;

/// The scenario's trials together: the worst of each figure, and the counts added up. `None` where time did not pass by itself.
pub(crate) fn sentence(scenario: &ScenarioRecord) -> Option<String> {
    let trials: Vec<&Timing> = scenario.trials.iter().filter_map(|trial| trial.telemetry.timing.as_ref()).collect();
    let first = trials.first()?;
    let worst = |figure: fn(&Timing) -> f64| trials.iter().map(|timing| figure(timing)).fold(0.0, f64::max);
    let count = |figure: fn(&Timing) -> u64| trials.iter().map(|timing| figure(timing)).sum::<u64>();
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
                ", {:.0} % and {:.0} % of the {budget:.0} µs that the law bears",
                100.0 * typical / budget,
                100.0 * longest / budget
            )
        });
        parts.push(format!("loop delay {typical:.0} µs typical, {longest:.0} µs longest{of_budget}"));
    }
    parts.push(format!(
        "samples late by {:.0} µs typical, {:.0} µs at most",
        worst(|timing| timing.lateness_us.p50),
        worst(|timing| timing.lateness_us.max)
    ));
    let counts = [
        ("overruns", count(|timing| timing.overruns)),
        ("missed replies", count(|timing| timing.missed_replies)),
        ("replies that never came", count(|timing| timing.lost_replies)),
        ("refused frames", count(|timing| timing.refused_frames)),
        ("lost rows", count(|timing| timing.lost_rows)),
    ];
    let periods = count(|timing| timing.periods);
    let seen: Vec<String> =
        counts.iter().filter(|(_, count)| *count > 0).map(|(name, count)| format!("{count} {name}")).collect();
    let seen = if seen.is_empty() { "nothing missed".to_owned() } else { seen.join(", ") };
    parts.push(format!("{seen} in {periods} periods"));
    parts.extend(
        first
            .target_clock_ppm
            .zip(first.target_clock_error_ppm)
            .map(|(ppm, error)| format!("the controller's clock {ppm:+.0} ± {error:.0} ppm")),
    );
    if first.scheduling != "SCHED_FIFO" {
        parts.push(first.scheduling.clone());
    }
    if !trials.iter().all(|timing| timing.safe_confirmed) {
        parts.push("0 V was not confirmed at the end".to_owned());
    }
    Some(parts.join("; "))
}
