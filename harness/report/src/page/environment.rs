//! Writes the section on the environment, which is needed to repeat the run.

use super::elements::scroll_table;
use crate::format;
use maud::{Markup, html};
use platebench_model::record::RunRecord;
use std::collections::BTreeSet;

pub(super) fn section(record: &RunRecord) -> Markup {
    let firmware = record.rig.firmware.as_ref().map(|firmware| {
        format!("{} {}, build {}, chip {}", firmware.name, firmware.version, firmware.build, firmware.chip)
    });
    let facts = [
        ("Tool", format!("{} {}", record.tool.name, record.tool.version)),
        ("Started", record.started.clone()),
        ("Rig", record.rig.name.clone()),
        ("Firmware", firmware.unwrap_or_else(|| "unknown, the controller sent no identity".to_owned())),
        ("Clock", record.clock.to_string()),
        ("Host", format!("{}, {}", record.host.os, record.host.arch)),
        ("Overridden", format::overrides(record).unwrap_or_else(|| "nothing".to_owned())),
    ];
    let inputs = record.scenarios.iter().flat_map(|scenario| &scenario.inputs);
    let inputs: BTreeSet<(&str, &str)> = inputs.map(|input| (input.file.as_str(), input.sha256.as_str())).collect();
    let rows = html! {
        @for (file, sha256) in &inputs { tr { th scope="row" { (file) } td { code { (sha256) } } } }
    };
    html! {
        section aria-labelledby="environment" {
            h2 id="environment" { "Environment" }
            dl { @for (name, value) in &facts { div { dt { (name) } dd { (value) } } } }
            @if !inputs.is_empty() {
                h3 { "Inputs" }
                (scroll_table("Inputs", "inputs", &["File", "SHA-256"], &rows))
            }
        }
    }
}
