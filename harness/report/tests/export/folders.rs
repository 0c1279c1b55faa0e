//! Tests the names of exported files, and the runs that an export rejects.

use crate::fixtures::{self, StoredRun};
use parquet::file::metadata::RowGroupMetaData;
use parquet::file::reader::{FileReader, SerializedFileReader};
use platebench_report::export::{ExportError, ExportFormat, ExportResult, export};
use platebench_report::page::RowCache;
use std::fs::{self, File};
use std::path::{Path, PathBuf};

const ALL: [ExportFormat; 4] = [ExportFormat::Parquet, ExportFormat::Mf4, ExportFormat::Csv, ExportFormat::Mcap];

fn export_folder(run: &StoredRun) -> PathBuf {
    run.folder.path().join("out")
}

fn export_run(run: &StoredRun, scenarios: &[&str], format: ExportFormat) -> Result<ExportResult, ExportError> {
    let scenarios: Vec<String> = scenarios.iter().map(ToString::to_string).collect();
    export(&run.record, run.folder.path(), &RowCache::default(), &scenarios, format, Some(&export_folder(run)))
}

fn relative_files(folder: &Path) -> Vec<String> {
    let mut found = Vec::new();
    let mut folders = vec![folder.to_owned()];
    while let Some(next) = folders.pop() {
        for entry in fs::read_dir(next).into_iter().flatten().flatten() {
            match entry.path() {
                path if path.is_dir() => folders.push(path),
                path => found.push(path.strip_prefix(folder).unwrap().to_string_lossy().into_owned()),
            }
        }
    }
    found.sort();
    found
}

#[test]
fn writes_a_file_per_scenario_or_one_table() {
    let cases: [(_, &[&str]); 4] = [
        (ExportFormat::Parquet, &["one.parquet", "paper/step.parquet"]),
        (ExportFormat::Mf4, &["one.mf4", "paper/step/000.mf4", "paper/step/001.mf4"]),
        (ExportFormat::Mcap, &["one.mcap", "paper/step.mcap"]),
        (ExportFormat::Csv, &["traces.csv", "traces.csv-metadata.json"]),
    ];
    for (format, expected) in cases {
        let run = fixtures::stored_run();
        let exported = export_run(&run, &[], format).unwrap();
        assert_eq!(relative_files(&export_folder(&run)), expected);
        let mut files: Vec<_> =
            exported.files.iter().map(|file| file.strip_prefix(export_folder(&run)).unwrap()).collect();
        files.sort();
        assert_eq!(files, expected.iter().map(Path::new).collect::<Vec<_>>());
    }
}

#[test]
fn selects_scenarios_with_or_without_extension() {
    for requested in ["paper/step", "paper/step.toml"] {
        let run = fixtures::stored_run();
        export_run(&run, &[requested], ExportFormat::Mcap).unwrap();
        assert_eq!(relative_files(&export_folder(&run)), ["paper/step.mcap"]);
    }
    let run = fixtures::stored_run();
    let error = export_run(&run, &["one", "two"], ExportFormat::Mf4).unwrap_err().to_string();
    assert_eq!(error, "the run has no scenario `two`, expected one of paper/step, one");
    assert!(relative_files(&export_folder(&run)).is_empty());
}

#[test]
fn overwrites_no_file() {
    for format in ALL {
        let run = fixtures::stored_run();
        let last = export_run(&run, &[], format).unwrap().files.pop().unwrap();
        for file in relative_files(&export_folder(&run)) {
            let path = export_folder(&run).join(file);
            if path != last {
                fs::remove_file(path).unwrap();
            }
        }
        fs::write(&last, "mine").unwrap();
        assert!(matches!(export_run(&run, &[], format), Err(ExportError::FileExists(path)) if path == last));
        assert_eq!(fs::read_to_string(&last).unwrap(), "mine");
        assert_eq!(relative_files(&export_folder(&run)).len(), 1, "writes no other file either");
    }
}

#[test]
fn skips_and_counts_incomplete_trials() {
    for format in ALL {
        let mut run = fixtures::stored_run();
        let trial = &mut run.record.scenarios[0].trials[1];
        trial.sha256 = None;
        let trace = run.folder.path().join(&trial.trace);
        fs::rename(&trace, trace.with_extension("csv.part")).unwrap();
        assert_eq!(export_run(&run, &[], format).unwrap().incomplete_trials, 1);
        assert_eq!(relative_files(&export_folder(&run)).len(), 2);
    }
}

#[test]
fn rejects_a_run_without_a_complete_trial() {
    let mut run = fixtures::stored_run();
    run.record.scenarios.iter_mut().for_each(|scenario| scenario.trials.clear());
    assert!(matches!(export_run(&run, &[], ExportFormat::Csv), Err(ExportError::NoCompleteTrial(_))));
    assert!(!export_folder(&run).exists());
}

#[test]
fn names_the_line_of_a_broken_trace() {
    for format in ALL {
        let run = fixtures::stored_run();
        let trace = run.folder.path().join("traces/paper/step/001.csv");
        let text = fs::read_to_string(&trace).unwrap();
        let broken = text.replacen("0.0001,", "x,", 1);
        assert_ne!(text, broken);
        fs::write(&trace, broken).unwrap();
        let error = export_run(&run, &[], format).unwrap_err().to_string();
        assert!(error.contains("001.csv:4: "), "{error}");
        // MDF4 has a file per trial, so the file of the trial before the broken one is complete.
        let complete: &[&str] = if format == ExportFormat::Mf4 { &["paper/step/000.mf4"] } else { &[] };
        assert_eq!(relative_files(&export_folder(&run)), complete);
    }
}

#[test]
fn a_missing_trace_is_an_error() {
    let run = fixtures::stored_run();
    fs::remove_file(run.folder.path().join("traces/one/000.csv")).unwrap();
    let error = export_run(&run, &["one"], ExportFormat::Mcap).unwrap_err().to_string();
    assert!(error.contains("traces/one/000.csv"), "{error}");
}

#[test]
fn rejects_paths_outside_the_run_folder() {
    let mut run = fixtures::stored_run();
    run.record.scenarios[0].file = "../../elsewhere.toml".to_owned();
    assert!(matches!(
        export_run(&run, &[], ExportFormat::Mf4),
        Err(ExportError::OutsideRunFolder { named, .. }) if named == "../../elsewhere.toml"
    ));
    let mut run = fixtures::stored_run();
    run.record.scenarios[0].trials[0].trace = "/etc/passwd".to_owned();
    assert!(matches!(
        export_run(&run, &[], ExportFormat::Mf4),
        Err(ExportError::OutsideRunFolder { named, .. }) if named == "/etc/passwd"
    ));
}

#[test]
fn rejects_an_invalid_start_time() {
    let mut run = fixtures::stored_run();
    run.record.started = "yesterday".to_owned();
    let error = export_run(&run, &[], ExportFormat::Mf4).unwrap_err().to_string();
    assert!(error.contains("`started` is yesterday, expected a time like"), "{error}");
}

#[test]
fn splits_long_trials_into_row_groups() {
    for (rows, groups) in [(65_536, vec![65_536]), (65_537, vec![65_536, 1])] {
        let mut run = fixtures::stored_run();
        run.record.scenarios.truncate(1);
        let long = fixtures::write_trial(run.folder.path(), "paper/step", 0, &fixtures::rows(rows, 0));
        run.record.scenarios[0].trials = vec![long];
        let file = export_run(&run, &[], ExportFormat::Parquet).unwrap().files.pop().unwrap();
        let reader = SerializedFileReader::new(File::open(file).unwrap()).unwrap();
        let found: Vec<_> = reader.metadata().row_groups().iter().map(RowGroupMetaData::num_rows).collect();
        assert_eq!(found, groups);
    }
}
