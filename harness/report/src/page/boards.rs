//! Writes the section on the boards of joined runs.

use crate::text::board_matrix::{difference_table, missing_shards, verdict_matrix};
use maud::{Markup, html};
use platebench_model::record::RunRecord;

pub(crate) fn section(record: &RunRecord) -> Markup {
    let Some(merge) = &record.merge else { return html! {} };
    html! {
        section id="boards" {
            h2 { "Boards" }
            @for line in missing_shards(merge) { p { (line) } }
            @if let Some(table) = verdict_matrix(record) { (table.html()) }
            @if let Some(table) = difference_table(merge) {
                h3 { "Differences between boards" }
                (table.html())
            }
        }
    }
}
