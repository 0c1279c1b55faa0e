//! Reads exported files with `DuckDB`, asammdf and the MCAP library of Python.

use crate::fixtures::{self, StoredRun};
use platebench_model::trace::Row;
use platebench_report::export::{ExportFormat, export};
use platebench_report::export::{FLAG_COLUMNS, NUMBER_COLUMNS};
use platebench_report::page::RowCache;
use serde_json::{Value, json};
use std::path::{Path, PathBuf};
use std::process::Command;

/// Environment variable. With the value `1`, a missing program is a failure.
const REQUIRE_ALL: &str = "PLATEBENCH_REQUIRE_ALL";
const PYTHON: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../../target/test-readers/bin/python");
const SCRIPT: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/export/read.py");

fn has_readers() -> bool {
    let exists = Path::new(PYTHON).exists();
    let all = std::env::var(REQUIRE_ALL).is_ok_and(|value| value == "1");
    assert!(exists || !all, "no readers at {PYTHON} and {REQUIRE_ALL}=1: ci/install-test-tools");
    if !exists {
        eprintln!("NOT TESTED: no readers at {PYTHON} (ci/install-test-tools)");
    }
    exists
}

const NODE_MODULES: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../../target/test-node");
const NODE_SCRIPT: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/export/read_mcap.mjs");

fn read_with_python(format: &str, path: &Path) -> Value {
    let output = Command::new(PYTHON).arg(SCRIPT).arg(format).arg(path).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    serde_json::from_slice(&output.stdout).unwrap()
}

fn export_run(run: &StoredRun, format: ExportFormat) -> PathBuf {
    let out = run.folder.path().join("export");
    let exported = export(&run.record, run.folder.path(), &RowCache::default(), &[], format, Some(&out)).unwrap();
    assert_eq!(exported.incomplete_trials, 0);
    out
}

fn bits_of(value: f64) -> Value {
    json!(format!("{:016x}", value.to_bits()))
}

/// Formats a number as `read.py` does. NaN is a missing number.
fn known_bits(value: f64) -> Value {
    if value.is_nan() { Value::Null } else { bits_of(value) }
}

fn column_bits(rows: &[Row], name: &str) -> Value {
    let number = NUMBER_COLUMNS.iter().find(|number| number.name() == name);
    let flag = FLAG_COLUMNS.iter().find(|flag| flag.name == name);
    match (number, flag) {
        (Some(number), None) => rows.iter().map(|row| known_bits(number.column.value(row))).collect(),
        (None, Some(flag)) => rows.iter().map(|row| json!(row.flags.contains(flag.flag))).collect(),
        _ => panic!("{name} is not a column"),
    }
}

fn column_names() -> impl Iterator<Item = &'static str> {
    NUMBER_COLUMNS.iter().map(platebench_report::export::Number::name).chain(FLAG_COLUMNS.iter().map(|flag| flag.name))
}

const STEP: &str = "paper/step";

#[test]
fn duckdb_reads_the_same_bits_from_parquet() {
    if !has_readers() {
        return;
    }
    let run = fixtures::stored_run();
    let found = read_with_python("parquet", &export_run(&run, ExportFormat::Parquet).join("paper/step.parquet"));
    let rows = [fixtures::rows(7, 0), fixtures::rows(9, 3)].concat();
    let columns = found["columns"].as_object().unwrap();
    let expected: Vec<_> = ["scenario", "trial", "seed"].into_iter().chain(column_names()).collect();
    assert_eq!(columns.keys().collect::<Vec<_>>(), expected);
    for name in column_names() {
        assert_eq!(columns[name]["values"], column_bits(&rows, name), "{name}");
    }
    assert_eq!(columns["scenario"], json!({"kind": "VARCHAR", "values": vec![STEP; 16]}));
    let trials = [[0; 7].as_slice(), &[1; 9]].concat();
    assert_eq!(columns["trial"], json!({"kind": "UINTEGER", "values": trials}));
    let seeds = [[u64::MAX; 7].as_slice(), &[u64::MAX - 1; 9]].concat();
    assert_eq!(columns["seed"], json!({"kind": "UBIGINT", "values": seeds}));
    let metadata = &found["metadata"];
    for number in NUMBER_COLUMNS {
        assert_eq!(metadata[format!("unit.{}", number.name())], number.unit);
        assert_eq!(metadata[format!("meaning.{}", number.name())], number.meaning);
    }
    for number in NUMBER_COLUMNS {
        assert_eq!(found["fields"][number.name()], json!({"unit": number.unit, "meaning": number.meaning}));
    }
    for flag in FLAG_COLUMNS {
        assert_eq!(found["fields"][flag.name], json!({"meaning": flag.meaning}));
    }
    assert_eq!(metadata["title"], "33 °C, <2 N> & \"5 %\"");
    assert_eq!(metadata["firmware"], "dq-pi 0.1.0");
    assert_eq!(metadata["inputs"], format!("inputs/paper/step.toml sha256:{}", "a".repeat(64)));
}

#[test]
fn asammdf_reads_the_same_bits_from_mdf4() {
    if !has_readers() {
        return;
    }
    let run = fixtures::stored_run();
    let out = export_run(&run, ExportFormat::Mf4);
    for (index, rows) in [fixtures::rows(7, 0), fixtures::rows(9, 3)].iter().enumerate() {
        let found = read_with_python("mf4", &out.join(format!("paper/step/{index:03}.mf4")));
        assert_eq!(found["version"], "4.10");
        assert_eq!(found["start"], 1_772_443_800.0, "2026-03-02T09:30:00Z");
        let comment = found["comment"].as_str().unwrap();
        let has_title = comment.contains("33 °C, <2 N> & \"5 %\"") || comment.contains("33 °C, &lt;2 N&gt; &amp;");
        assert!(has_title, "{comment}");
        assert!(comment.contains("dq-pi 0.1.0"), "{comment}");
        assert!(found["history"].to_string().contains("platebench"), "{found}");
        let group = &found["group"];
        assert_eq!(group["name"], format!("trial {index:03}"));
        assert_eq!(group["comment"], format!("seed {}", u64::MAX - index as u64));
        let channels = group["channels"].as_object().unwrap();
        assert_eq!(channels.keys().collect::<Vec<_>>(), column_names().collect::<Vec<_>>());
        for name in column_names() {
            let channel = &channels[name];
            // MDF4 stores a missing number as NaN.
            let mut values = column_bits(rows, name);
            values
                .as_array_mut()
                .unwrap()
                .iter_mut()
                .filter(|value| value.is_null())
                .for_each(|value| *value = bits_of(f64::NAN));
            assert_eq!(channel["values"], values, "{name}");
            assert_eq!(channel["times"], column_bits(rows, "t_s"), "{name}");
            assert_eq!(channel["master"], name == "t_s", "{name}");
        }
        for number in NUMBER_COLUMNS {
            assert_eq!(channels[number.name()]["unit"], number.unit);
            assert_eq!(channels[number.name()]["comment"], number.meaning);
            let is_held = ["setpoint_um", "drive_vpp", "frequency_hz", "sensed_wd_um", "sensed_wq_um"];
            assert_eq!(channels[number.name()]["discrete"], is_held.contains(&number.name()), "{}", number.name());
        }
        for flag in FLAG_COLUMNS {
            assert_eq!(channels[flag.name]["unit"], "");
            assert_eq!(channels[flag.name]["comment"], flag.meaning);
        }
    }
}

#[test]
fn the_mcap_library_reads_the_same_bits() {
    if !has_readers() {
        return;
    }
    let run = fixtures::stored_run();
    let found = read_with_python("mcap", &export_run(&run, ExportFormat::Mcap).join("paper/step.mcap"));
    assert_eq!(found["count"], 16);
    assert_eq!(found["ordered"], true, "the rows of the trials are in time order");
    assert_eq!(found["metadata"]["platebench"]["law"], "dq-pi");
    assert_eq!(found["topics"].as_object().unwrap().len(), 2);
    let properties = &found["schemas"]["platebench.Row"]["properties"];
    for number in NUMBER_COLUMNS {
        assert_eq!(properties[number.name()]["unit"], number.unit);
        assert_eq!(found["metadata"]["units"][number.name()], number.unit);
    }
    for (index, rows) in [fixtures::rows(7, 0), fixtures::rows(9, 3)].into_iter().enumerate() {
        let topic = &found["topics"][format!("/trial/{index:03}")];
        assert_eq!(topic["about"]["seed"], (u64::MAX - index as u64).to_string());
        let messages = topic["messages"].as_array().unwrap();
        assert_eq!(messages.len(), rows.len());
        for name in column_names() {
            let values: Value = messages.iter().map(|message| message["row"][name].clone()).collect();
            assert_eq!(values, column_bits(&rows, name), "{name}");
        }
        assert_eq!(messages[0]["log_time"], 1_772_443_800_000_000_000_u64);
        assert_eq!(messages[6]["log_time"], 1_772_443_800_000_300_000_u64);
    }
}

/// Foxglove and Lichtblick read MCAP with this library. They refuse a list of types in a schema.
#[test]
fn the_mcap_library_of_viewers_reads_the_same_numbers() {
    if !Path::new(NODE_MODULES).join("node_modules/@mcap/core").exists() {
        return platebench_test_kit::skip_without("@mcap/core in target/test-node");
    }
    let run = fixtures::stored_run();
    let path = export_run(&run, ExportFormat::Mcap).join("paper/step.mcap");
    let output = Command::new("node").args([NODE_SCRIPT, NODE_MODULES]).arg(path).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let found: Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!(found["compressions"], json!(["lz4"]));
    let properties = found["schemas"][0]["properties"].as_object().unwrap();
    assert!(properties.values().all(|property| property["type"].is_string()), "{properties:?}");
    for (index, rows) in [fixtures::rows(7, 0), fixtures::rows(9, 3)].iter().enumerate() {
        let messages = found["topics"][format!("/trial/{index:03}")].as_array().unwrap();
        assert_eq!(messages.len(), rows.len());
        for number in NUMBER_COLUMNS {
            let values: Vec<_> = messages.iter().map(|message| message["row"][number.name()].as_f64()).collect();
            let expected: Vec<_> = rows.iter().map(|row| number.known_value(row)).collect();
            assert_eq!(values, expected, "{}", number.name());
        }
    }
}

#[test]
fn duckdb_reads_the_same_bits_from_csv() {
    if !has_readers() {
        return;
    }
    let run = fixtures::stored_run();
    let out = export_run(&run, ExportFormat::Csv);
    let found = read_with_python("csv", &out.join("traces.csv"));
    let described: Value =
        serde_json::from_slice(&std::fs::read(out.join("traces.csv-metadata.json")).unwrap()).unwrap();
    assert_eq!(described["url"], "traces.csv");
    let described = described["tableSchema"]["columns"].as_array().unwrap();
    let kinds = found["kinds"].as_object().unwrap();
    let described_names: Vec<_> = described.iter().map(|column| column["name"].as_str().unwrap()).collect();
    assert_eq!(kinds.keys().collect::<Vec<_>>(), described_names);
    for number in NUMBER_COLUMNS {
        let column = described.iter().find(|column| column["name"] == number.name()).unwrap();
        assert_eq!((&column["schema:unitText"], &kinds[number.name()]), (&json!(number.unit), &json!("DOUBLE")));
    }
    let rows = [fixtures::rows(7, 0), fixtures::rows(9, 3), fixtures::rows(1, 5)].concat();
    let lines = found["rows"].as_array().unwrap();
    assert_eq!(lines.len(), rows.len());
    for (place, name) in (3..).zip(column_names()) {
        let values: Value = lines.iter().map(|line| line[place].clone()).collect();
        assert_eq!(values, column_bits(&rows, name), "{name}");
    }
    assert_eq!(lines[15].as_array().unwrap()[..3], [json!(STEP), json!(1), json!(u64::MAX - 1)]);
    assert_eq!(lines[16][0], "one");
}
