//! `report.html`: a run on one page that needs nothing else: no script, no font, no picture from elsewhere.
//!
//! * `bundle`, `curves`: traces to what can be shown of them.
//! * `figure`, `plot`: curves to drawings.
//! * `summary`, `scenario`, `cost`, `environment`: the page's parts.
//!
//! Neighbours: the record is shown as it is. What did not pass comes first.

mod bundle;
mod cost;
pub(crate) mod curves;
mod environment;
mod figure;
pub(crate) mod plot;
mod scenario;
mod summary;

use crate::error::ReportError;
use crate::evidence;
use bundle::Bundle;
use figure::Behind;
use maud::{DOCTYPE, Markup, PreEscaped, html};
use platebench_verdict::{RunRecord, ScenarioRecord, Verdict};
use std::fs;
use std::path::Path;

/// The file's name in a run folder.
pub const FILE: &str = "report.html";

pub(crate) const STYLE: &str = include_str!("html/style.css");

/// Writes the run as a page into `folder`, the run's own: traces are looked for there. A trace that is missing is said
/// to be missing where its plots would have stood.
///
/// # Errors
/// [`ReportError`] where the file cannot be written.
pub fn write(record: &RunRecord, folder: &Path) -> Result<(), ReportError> {
    let page = page(record, folder)?.into_string();
    let path = folder.join(FILE);
    fs::write(&path, page).map_err(ReportError::io(&path))
}

fn page(record: &RunRecord, folder: &Path) -> Result<Markup, ReportError> {
    let bundles: Vec<Bundle> = record.scenarios.iter().map(|scenario| Bundle::read(scenario, folder)).collect();
    let mut articles = Vec::new();
    for (index, shown) in in_order(record) {
        let Some(own) = bundles.get(index) else { continue };
        let behind = evidence::open_loop_of(record, shown)
            .and_then(|other| Some(Behind { scenario: record.scenarios.get(other)?, bundle: bundles.get(other)? }));
        articles.push(scenario::article(index, shown, own, behind)?);
    }
    Ok(html! {
        (DOCTYPE)
        html lang="en" {
            head {
                meta charset="utf-8";
                meta name="viewport" content="width=device-width, initial-scale=1";
                meta name="color-scheme" content="light dark";
                title { (record.verdict) " · " (record.tool.name) " " (record.started) }
                style { (PreEscaped(STYLE)) }
            }
            body {
                header { (summary::head(record)) }
                main {
                    (summary::open_points(record))
                    (summary::scenarios(record))
                    (summary::requirements(record))
                    @for article in &articles { (article) }
                    (cost::section(record))
                    (environment::section(record))
                }
                footer { p { (record.tool.name) " " (record.tool.version) } }
            }
        }
    })
}

/// Scenarios with their number in the record: failed, inconclusive, passed, each as they were played.
fn in_order(record: &RunRecord) -> Vec<(usize, &ScenarioRecord)> {
    let mut scenarios: Vec<_> = record.scenarios.iter().enumerate().collect();
    scenarios.sort_by_key(|(_, scenario)| match scenario.verdict {
        Verdict::Fail => 0,
        Verdict::Inconclusive => 1,
        Verdict::Pass => 2,
    });
    scenarios
}

/// Where a scenario stands on the page.
fn anchor(index: usize) -> String {
    format!("scenario-{index}")
}

fn badge(verdict: Verdict, text: &str) -> Markup {
    html! { span class={ "badge " (verdict) } { span aria-hidden="true" { (crate::shown::sign(verdict)) } " " (text) } }
}
