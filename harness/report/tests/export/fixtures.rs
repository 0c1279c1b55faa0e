//! Writes a synthetic run folder.

use platebench_model::record::{
    ClockKind, FORMAT, Firmware, Host, InputRecord, MetricValues, Overrides, RigRecord, RunRecord, ScenarioRecord,
    Telemetry, Tool, TrialRecord, Verdict,
};
use platebench_model::trace::{Flags, Row, TraceWriter};
use std::fs;
use std::path::Path;
use tempfile::TempDir;

pub(crate) struct StoredRun {
    pub(crate) folder: TempDir,
    pub(crate) record: RunRecord,
}

const EDGE_VALUES: [f64; 8] = [0.0, -0.0, 0.1, -1.0 / 3.0, f64::MIN_POSITIVE, 5e-324, f64::MAX, -32_307.612_345_678_9];

/// Makes rows that differ in every column. Every fifth row has unknown numbers.
pub(crate) fn rows(count: usize, salt: usize) -> Vec<Row> {
    let row = |index: usize| {
        let edge = |column: usize| EDGE_VALUES[(index + column + salt) % EDGE_VALUES.len()];
        let mut row = Row {
            t_s: index as f64 * 0.000_05,
            setpoint_um: edge(0),
            wd_um: edge(1),
            wq_um: edge(2),
            amplitude_um: edge(3),
            drive_vpp: edge(4),
            frequency_hz: edge(5),
            resonance_hz: edge(6),
            temperature_offset_k: edge(7),
            finger_force_n: index as f64 / 7.0,
            sensed_wd_um: (index * 3 + salt) as f64 / 11.0,
            sensed_wq_um: -(index as f64) / 13.0,
            lateness_us: salt as f64 / 3.0,
            flags: Flags::from_bits_truncate((index + salt) as u8),
        };
        if index % 5 == 4 {
            row.flags |= Flags::SENSED;
            (row.resonance_hz, row.temperature_offset_k, row.finger_force_n) = (f64::NAN, f64::NAN, f64::NAN);
        }
        row
    };
    (0..count).map(row).collect()
}

pub(crate) fn write_trial(folder: &Path, scenario: &str, index: u32, rows: &[Row]) -> TrialRecord {
    let trace = format!("traces/{scenario}/{index:03}.csv");
    let path = folder.join(&trace);
    fs::create_dir_all(path.parent().unwrap()).unwrap();
    let mut writer = TraceWriter::create(&path).unwrap();
    for row in rows {
        writer.write(row).unwrap();
    }
    writer.finish().unwrap();
    TrialRecord {
        index,
        seed: u64::MAX - u64::from(index),
        trace,
        sha256: Some("0".repeat(64)),
        metrics: MetricValues::default(),
        telemetry: Telemetry::default(),
        cause: None,
        reason: None,
        symptom: None,
        diverged_at_s: None,
        wall_ms: None,
    }
}

fn scenario_record(name: &str, title: &str, trials: Vec<TrialRecord>) -> ScenarioRecord {
    ScenarioRecord {
        file: format!("{name}.toml"),
        title: title.to_owned(),
        source: None,
        tags: Vec::new(),
        verdict: Verdict::Pass,
        law: "dq-pi".to_owned(),
        model: "modal".to_owned(),
        period_ms: Some(1.0),
        inputs: vec![InputRecord { file: format!("inputs/{name}.toml"), sha256: "a".repeat(64) }],
        expectations: Vec::new(),
        not_applicable: Vec::new(),
        requirement_texts: std::collections::BTreeMap::new(),
        time_limit_s: None,
        planned_trials: None,
        trials,
    }
}

pub(crate) fn stored_run() -> StoredRun {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path();
    let step = vec![write_trial(path, "paper/step", 0, &rows(7, 0)), write_trial(path, "paper/step", 1, &rows(9, 3))];
    let scenarios = vec![
        scenario_record("paper/step", "33 °C, <2 N> & \"5 %\"", step),
        scenario_record("one", "one", vec![write_trial(path, "one", 0, &rows(1, 5))]),
    ];
    let firmware = Firmware {
        name: "dq-pi".to_owned(),
        version: "0.1.0".to_owned(),
        build: "5f3a9c01".to_owned(),
        chip: "0".to_owned(),
    };
    let record = RunRecord {
        format: FORMAT,
        sequence: 0,
        verdict: Verdict::Pass,
        complete: true,
        tool: Tool { name: "platebench".to_owned(), version: "0.1.0".to_owned(), ..Tool::default() },
        started: "2026-03-02T09:30:00Z".to_owned(),
        rig: RigRecord {
            name: "hosted".to_owned(),
            firmware: Some(firmware),
            program_sha256: None,
            bench_firmware: true,
        },
        clock: ClockKind::Lockstep,
        overrides: Overrides::default(),
        safe_confirmed: Some(true),
        drive_after_safe: false,
        wall_ms: None,
        host: Host { os: "linux".to_owned(), arch: "x86_64".to_owned(), ..Host::default() },
        scenarios,
        not_applicable: Vec::new(),
        cost: Vec::new(),
        merge: None,
        journal: None,
    };
    StoredRun { folder, record }
}
