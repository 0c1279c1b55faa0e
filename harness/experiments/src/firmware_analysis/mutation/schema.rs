//! Writes results in the open schema of mutation reports, version 2: npm
//! `mutation-testing-report-schema`.

use super::result::{MutantResult, MutationReport, Status};
use platebench_model::trace::read_text_file;
use serde_json::{Map, Value, json};
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

/// Largest source file in the report. The image names the files, so they may be anything.
const MAX_SOURCE_BYTES: u64 = 16 << 20;

/// Thresholds of the score in percent. Viewers use them only to choose colours.
const HIGH: u8 = 90;
const LOW: u8 = 70;

pub fn mutation_json(report: &MutationReport) -> Value {
    let mut files: BTreeMap<String, Vec<Value>> = BTreeMap::new();
    let ids: BTreeMap<&str, usize> = report.scenarios.iter().map(String::as_str).zip(0..).collect();
    for (number, result) in report.results.iter().enumerate() {
        let file = result.mutant.line.as_ref().map_or("machine code without lines", |line| &line.file);
        files.entry(file.to_owned()).or_default().push(mutant(number, result, &ids));
    }
    let tests: Vec<Value> =
        ids.iter().map(|(name, number)| json!({ "id": number.to_string(), "name": name })).collect();
    let files: Map<String, Value> = files
        .into_iter()
        .map(|(file, mutants)| {
            let (language, source) = (language(&file), source(&file, &mutants));
            (file, json!({ "language": language, "source": source, "mutants": mutants }))
        })
        .collect();
    json!({
        "$schema": "https://git.io/mutation-testing-schema",
        "schemaVersion": "2",
        "thresholds": { "high": HIGH, "low": LOW },
        "framework": { "name": "platebench", "version": env!("CARGO_PKG_VERSION") },
        "files": files,
        "testFiles": { "scenarios": { "tests": tests } },
    })
}

fn mutant(number: usize, result: &MutantResult, ids: &BTreeMap<&str, usize>) -> Value {
    let mutant = &result.mutant;
    let line = mutant.line.as_ref().map_or(1, |line| line.line.max(1));
    let id = |name: &String| ids.get(name.as_str()).map(ToString::to_string);
    let mut value = json!({
        "id": number.to_string(),
        "mutatorName": mutant.operator.name(),
        "description":
            format!("{:#010x} in {}: {} -> {}", mutant.instruction, mutant.function, mutant.before, mutant.after),
        "replacement": mutant.after,
        "location": { "start": { "line": line, "column": 1 }, "end": { "line": line, "column": 2 } },
        "status": result.status.name(),
        "coveredBy": result.covered_by.iter().filter_map(id).collect::<Vec<_>>(),
        "duration": result.duration.as_millis() as u64,
    });
    let (by, reason) = match &result.status {
        Status::Killed { by, reason } | Status::RuntimeError { by, reason } => (Some(by), Some(reason.clone())),
        Status::Timeout { by } => (Some(by), None),
        Status::Survived { same_commands: true, .. } => (None, Some("no drive and no frequency changed".to_owned())),
        Status::Survived { closest: Some(closest), .. } => {
            let text = format!("closest margin {:.4}: {} {}", closest.margin, closest.scenario, closest.expectation);
            (None, Some(text))
        }
        Status::Survived { closest: None, .. } | Status::NoCoverage => (None, None),
    };
    if let Some(by) = by.and_then(id).filter(|_| result.status.is_detected()) {
        value["killedBy"] = json!([by]);
    }
    if let Some(reason) = reason {
        value["statusReason"] = json!(reason);
    }
    value
}

fn language(file: &str) -> &'static str {
    match file.rsplit_once('.').map(|(_, extension)| extension) {
        Some("rs") => "rust",
        Some("c" | "h") => "c",
        Some("cpp" | "cc" | "hpp") => "cpp",
        _ => "armasm",
    }
}

/// Returns empty lines if the file cannot be read here, because viewers place mutants on lines.
fn source(file: &str, mutants: &[Value]) -> String {
    read_text_file(Path::new(file), MAX_SOURCE_BYTES).unwrap_or_else(|_| {
        let lines: BTreeSet<u64> =
            mutants.iter().filter_map(|mutant| mutant["location"]["start"]["line"].as_u64()).collect();
        "\n".repeat(lines.last().copied().unwrap_or(1) as usize)
    })
}
