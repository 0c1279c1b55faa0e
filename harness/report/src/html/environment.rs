//! The page's end: what the run was made with, so that it can be made again.
//!
//! Neighbours: everything stands in the record.

use crate::shown;
use maud::{Markup, html};
use platebench_verdict::RunRecord;
use std::collections::BTreeSet;

/// Tool, rig, firmware, clock, host, overrides and inputs.
pub(super) fn section(record: &RunRecord) -> Markup {
    let firmware = record.rig.firmware.as_ref().map(|firmware| {
        format!("{} {}, build {}, chip {}", firmware.name, firmware.version, firmware.build, firmware.chip)
    });
    let facts = [
        ("Tool", format!("{} {}", record.tool.name, record.tool.version)),
        ("Started", record.started.clone()),
        ("Rig", record.rig.name.clone()),
        ("Firmware", firmware.unwrap_or_else(|| "did not introduce itself".to_owned())),
        ("Clock", record.clock.clone()),
        ("Host", format!("{}, {}", record.host.os, record.host.arch)),
        ("Overrides", shown::overrides(record).unwrap_or_else(|| "none".to_owned())),
    ];
    let inputs: BTreeSet<(&str, &str)> = record
        .scenarios
        .iter()
        .flat_map(|scenario| &scenario.inputs)
        .map(|input| (input.file.as_str(), input.sha256.as_str()))
        .collect();
    html! {
        section aria-labelledby="environment" {
            h2 id="environment" { "Environment" }
            dl { @for (name, value) in &facts { div { dt { (name) } dd { (value) } } } }
            @if !inputs.is_empty() {
                h3 id="inputs" { "Inputs" }
                div.scroll role="group" aria-labelledby="inputs" tabindex="0" {
                    table.inputs {
                        thead { tr { th scope="col" { "File" } th scope="col" { "SHA-256" } } }
                        tbody { @for (file, sha256) in &inputs {
                            tr { th scope="row" { (file) } td { code { (sha256) } } }
                        } }
                    }
                }
            }
        }
    }
}
