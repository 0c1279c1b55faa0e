//! What a control step costs, beside earlier runs.
//!
//! Neighbours: `cost` has the words, the record the numbers.

use crate::{cost, shown};
use maud::{Markup, html};
use platebench_verdict::RunRecord;
use platebench_verdict::record::{CostTrend, EarlierCost};

/// A table by law and earlier run; nothing where the rig counts no instructions.
pub(super) fn section(record: &RunRecord) -> Markup {
    html! {
        @if !record.cost.is_empty() {
            section aria-labelledby="cost" {
                h2 id="cost" { "Instructions per control step" }
                @for trend in &record.cost {
                    p {
                        (cost::worst(trend)) ", mean " (cost::whole(trend.cost.mean)) "."
                        @if let Some(change) = cost::change(trend) { " " strong { (change) } "." }
                    }
                }
                @if record.cost.iter().any(|trend| !trend.earlier.is_empty()) { (earlier(&record.cost)) }
                p { "Instructions, not cycles. Only trials that both runs played are compared." }
            }
        }
    }
}

fn earlier(trends: &[CostTrend]) -> Markup {
    html! {
        div.scroll role="group" aria-labelledby="cost" tabindex="0" {
            table.contents {
                thead { tr {
                    th scope="col" { "Earlier run" }
                    th scope="col" { "Build" }
                    th scope="col" { "Law" }
                    th.number scope="col" { "Trials of both" }
                    th.number scope="col" { "Worst then" }
                    th.number scope="col" { "Worst now" }
                    th.number scope="col" { "Mean then" }
                    th.number scope="col" { "Mean now" }
                } }
                tbody { @for trend in trends { @for earlier in &trend.earlier { (row(trend, earlier)) } } }
            }
        }
    }
}

fn row(trend: &CostTrend, earlier: &EarlierCost) -> Markup {
    html! {
        tr {
            th scope="row" { (earlier.run.as_deref().unwrap_or("the image that comes with the bench")) }
            td { code { (cost::short(&earlier.build)) } }
            td { (trend.law) }
            td.number { (earlier.trials) }
            td.number { (cost::whole(earlier.then.worst)) }
            td.number { (changed(earlier.then.worst, earlier.now.worst)) }
            td.number { (cost::whole(earlier.then.mean)) }
            td.number { (changed(earlier.then.mean, earlier.now.mean)) }
        }
    }
}

fn changed(then: f64, now: f64) -> String {
    if then == now {
        return cost::whole(now);
    }
    let percent = (now / then - 1.0) * 100.0;
    let sign = if percent > 0.0 { "+" } else { "−" };
    format!("{} ({sign}{} %)", cost::whole(now), shown::percent(percent))
}
