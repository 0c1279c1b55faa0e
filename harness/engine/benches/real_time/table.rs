//! Prints the measurements as tables.

use super::exchange::ExchangeStats;
pub(crate) use platebench_model::record::Quantiles;
use platebench_model::record::TimingRecord;
use std::time::Duration;

/// Returns quantiles in µs. They are 0 if `spans` is empty.
pub(crate) fn quantiles(spans: &mut [Duration]) -> Quantiles {
    spans.sort_unstable();
    let at = |share: f64| {
        let rank = (share * spans.len() as f64).ceil() as usize;
        spans.get(rank.saturating_sub(1)).map_or(0.0, |span| span.as_secs_f64() * 1e6)
    };
    Quantiles { p50: at(0.5), p99: at(0.99), p999: at(0.999), max: at(1.0) }
}

pub(crate) struct Reference {
    name: &'static str,
    measured: Quantiles,
}

impl Reference {
    pub(crate) fn new(name: &'static str, measured: Quantiles) -> Self {
        Self { name, measured }
    }
}

fn cells(measured: &Quantiles) -> String {
    let Quantiles { p50, p99, p999, max } = measured;
    format!("{p50:.0} | {p99:.0} | {p999:.0} | {max:.0}")
}

pub(crate) fn references(references: &[Reference]) {
    println!("| limit at 1 kHz, µs | p50 | p99 | p99.9 | max |\n|---|---|---|---|---|");
    for Reference { name, measured } in references {
        println!("| {name} | {} |", cells(measured));
    }
    println!();
}

pub(crate) fn exchanges(rows: &[(&str, &ExchangeStats)], sleep: Quantiles, echo: Quantiles) {
    println!(
        "| exchange at 1 kHz, µs | p50 | p99 | p99.9 | max | p50 to the limit | missed |\n|---|---|---|---|---|---|---|"
    );
    for (name, ExchangeStats { lateness, round_trip, missed }) in rows {
        println!("| {name}: lateness | {} | {:.1} | |", cells(lateness), lateness.p50 / sleep.p50);
        println!("| {name}: sample to command | {} | {:.1} | {missed} |", cells(round_trip), round_trip.p50 / echo.p50);
    }
    println!();
}

pub(crate) fn loops(rows: &[(u32, TimingRecord)], sleep: Quantiles, echo: Quantiles) {
    println!(
        "| loop | lateness p50 | p99 | p99.9 | max | p50 to sleep | loop delay p50 | p99 | p99.9 | max | p50 to echo \
         | periods | overruns | skipped | missed |"
    );
    println!("|---|---|---|---|---|---|---|---|---|---|---|---|---|---|---|");
    for (period_us, timing) in rows {
        let delay = timing.loop_delay_us.unwrap_or_default();
        println!(
            "| {} kHz | {} | {:.2} | {} | {:.1} | {} | {} | {} | {} |",
            1e3 / f64::from(*period_us),
            cells(&timing.lateness_us),
            timing.lateness_us.p50 / sleep.p50,
            cells(&delay),
            delay.p50 / echo.p50,
            timing.periods,
            timing.overruns,
            timing.skipped,
            timing.missed_replies,
        );
    }
    let scheduled = rows.first().map_or("", |(_, timing)| timing.scheduling.as_str());
    println!("\nThe loop's thread: {scheduled}.");
}
