//! Writes the section on instructions per control step, compared with earlier runs.

use super::elements::scroll_table;
use crate::text::cost;
use crate::{format, record_queries};
use maud::{Markup, html};
use platebench_model::record::{CostTrend, EarlierCost, RunRecord};

pub(super) fn section(record: &RunRecord) -> Markup {
    let tight = record_queries::tight_steps(record);
    html! {
        @if !record.cost.is_empty() || !tight.is_empty() {
            section aria-labelledby="cost" {
                h2 id="cost" { "Instructions per control step" }
                @for trend in &record.cost {
                    p {
                        (cost::format_worst(trend)) ", mean " (cost::format_instructions(trend.cost.mean)) "."
                        @if let Some(change) = cost::describe_change(trend) { " " strong { (change) } "." }
                    }
                }
                @for (scenario, percent) in tight {
                    p { strong { "Warning: " (cost::describe_tight_step(scenario, percent)) "." } }
                }
                @if record.cost.iter().any(|trend| !trend.earlier.is_empty()) { (earlier_runs_table(&record.cost)) }
                p { "Instructions, not cycles. The comparison counts only trials that both runs played." }
            }
        }
    }
}

fn earlier_runs_table(trends: &[CostTrend]) -> Markup {
    let columns =
        ["Earlier run", "Build", "Law", "#Trials of both", "#Worst then", "#Worst now", "#Mean then", "#Mean now"];
    let rows = html! { @for trend in trends { @for earlier in &trend.earlier { (table_row(trend, earlier)) } } };
    scroll_table("Instructions per control step", "contents", &columns, &rows)
}

fn table_row(trend: &CostTrend, earlier: &EarlierCost) -> Markup {
    html! {
        tr {
            th scope="row" { (earlier.run.as_deref().unwrap_or(cost::SHIPPED_IMAGE)) }
            td { code { (cost::short_build_id(&earlier.build)) } }
            td { (trend.law) }
            td.number { (earlier.trials) }
            td.number { (cost::format_instructions(earlier.then.worst)) }
            td.number { (format_change(earlier.then.worst, earlier.now.worst)) }
            td.number { (cost::format_instructions(earlier.then.mean)) }
            td.number { (format_change(earlier.then.mean, earlier.now.mean)) }
        }
    }
}

fn format_change(then: f64, now: f64) -> String {
    if then == now {
        return cost::format_instructions(now);
    }
    let percent = (now / then - 1.0) * 100.0;
    let sign = if percent > 0.0 { "+" } else { "−" };
    format!("{} ({sign}{} %)", cost::format_instructions(now), format::percent(percent))
}
