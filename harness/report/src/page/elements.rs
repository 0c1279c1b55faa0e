//! Writes the small parts of pages: links and anchors.

use crate::format::display_order;
use maud::{Markup, html};
use platebench_model::record::{RunRecord, ScenarioRecord, TrialRecord};
use std::fmt::Write as _;

/// Anchor in `report.html` of the scenario with this index in the record.
pub fn scenario_anchor(index: usize) -> String {
    format!("scenario-{index}")
}

pub(super) fn sorted_by_verdict(record: &RunRecord) -> Vec<(usize, &ScenarioRecord)> {
    let mut scenarios: Vec<_> = record.scenarios.iter().enumerate().collect();
    scenarios.sort_by_key(|(_, scenario)| display_order(scenario.verdict));
    scenarios
}

pub(super) fn file_link(path: &str) -> Markup {
    html! { @if let Some(link) = link_to(path) { a href=(link) { (path) } } }
}

/// Address of a file in the run folder.
pub(super) fn link_to(path: &str) -> Option<String> {
    (!path.is_empty()).then(|| format!("./{}", percent_encode_path(path)))
}

pub(super) fn trace_link(trial: &TrialRecord) -> Markup {
    html! { @if trial.sha256.is_some() { (file_link(&trial.trace)) } }
}

/// Encodes a relative path, so that no part of it is a scheme, a query or a fragment.
fn percent_encode_path(path: &str) -> String {
    path.bytes().fold(String::with_capacity(path.len()), |mut url, byte| {
        if byte.is_ascii_alphanumeric() || b"-._~/".contains(&byte) {
            url.push(char::from(byte));
        } else {
            let _ = write!(url, "%{byte:02X}");
        }
        url
    })
}

/// Longer lists name this many entries and count the others.
pub(super) const MAX_NAMED: usize = 5;
