//! Files and names: what is made, what is refused, and that nothing is lost.

use crate::fixtures::{self, StoredRun};
use parquet::file::metadata::RowGroupMetaData;
use parquet::file::reader::{FileReader, SerializedFileReader};
use platebench_export::{ExportError, ExportFormat, ExportResult, export};
use std::fs::{self, File};
use std::path::{Path, PathBuf};

const ALL: [ExportFormat; 4] = [ExportFormat::Parquet, ExportFormat::Mf4, ExportFormat::Csv, ExportFormat::Mcap];

fn export_folder(made: &StoredRun) -> PathBuf {
    made.folder.path().join("out")
}

fn export_run(made: &StoredRun, scenarios: &[&str], format: ExportFormat) -> Result<ExportResult, ExportError> {
    let scenarios: Vec<String> = scenarios.iter().map(ToString::to_string).collect();
    export(&made.record, made.folder.path(), &scenarios, format, &export_folder(made))
}

/// Every file below a folder, in order.
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
fn a_file_for_each_scenario_and_one_table_of_all() {
    for (format, expected) in [
        (ExportFormat::Parquet, ["one.parquet", "paper/step.parquet"]),
        (ExportFormat::Mf4, ["one.mf4", "paper/step.mf4"]),
        (ExportFormat::Mcap, ["one.mcap", "paper/step.mcap"]),
        (ExportFormat::Csv, ["traces.csv", "traces.csv-metadata.json"]),
    ] {
        let made = fixtures::stored_run();
        let told = export_run(&made, &[], format).unwrap();
        assert_eq!(relative_files(&export_folder(&made)), expected);
        let mut told: Vec<_> = told.files.iter().map(|file| file.strip_prefix(export_folder(&made)).unwrap()).collect();
        told.sort();
        assert_eq!(told, expected.map(Path::new));
    }
}

#[test]
fn scenarios_are_chosen_by_name_with_or_without_their_ending() {
    for asked in ["paper/step", "paper/step.toml"] {
        let made = fixtures::stored_run();
        export_run(&made, &[asked], ExportFormat::Mf4).unwrap();
        assert_eq!(relative_files(&export_folder(&made)), ["paper/step.mf4"]);
    }
    let made = fixtures::stored_run();
    let refused = export_run(&made, &["one", "two"], ExportFormat::Mf4).unwrap_err().to_string();
    assert_eq!(refused, "the run has no scenario `two`, expected one of paper/step, one");
    assert!(relative_files(&export_folder(&made)).is_empty());
}

#[test]
fn nothing_is_written_over() {
    for format in ALL {
        let made = fixtures::stored_run();
        let last = export_run(&made, &[], format).unwrap().files.pop().unwrap();
        for file in relative_files(&export_folder(&made)) {
            let path = export_folder(&made).join(file);
            if path != last {
                fs::remove_file(path).unwrap();
            }
        }
        fs::write(&last, "mine").unwrap();
        assert!(matches!(export_run(&made, &[], format), Err(ExportError::FileExists(path)) if path == last));
        assert_eq!(fs::read_to_string(&last).unwrap(), "mine");
        assert_eq!(relative_files(&export_folder(&made)).len(), 1, "not even those that are not in the way");
    }
}

#[test]
fn a_trial_that_was_cut_off_is_left_out_and_counted() {
    for format in ALL {
        let mut made = fixtures::stored_run();
        let trial = &mut made.record.scenarios[0].trials[1];
        trial.sha256 = None;
        let trace = made.folder.path().join(&trial.trace);
        fs::rename(&trace, trace.with_extension("csv.part")).unwrap();
        assert_eq!(export_run(&made, &[], format).unwrap().incomplete_trials, 1);
        assert_eq!(relative_files(&export_folder(&made)).len(), 2);
    }
}

#[test]
fn a_run_without_a_whole_trial_gives_nothing() {
    let mut made = fixtures::stored_run();
    made.record.scenarios.iter_mut().for_each(|scenario| scenario.trials.clear());
    assert!(matches!(export_run(&made, &[], ExportFormat::Csv), Err(ExportError::NoCompleteTrial(_))));
    assert!(!export_folder(&made).exists());
}

#[test]
fn a_broken_trace_is_told_with_its_line_and_leaves_no_file() {
    for format in ALL {
        let made = fixtures::stored_run();
        let trace = made.folder.path().join("traces/paper/step/001.csv");
        let text = fs::read_to_string(&trace).unwrap();
        let broken = text.replacen("0.0001,", "x,", 1);
        assert_ne!(text, broken);
        fs::write(&trace, broken).unwrap();
        let told = export_run(&made, &[], format).unwrap_err().to_string();
        assert!(told.contains("001.csv:4: "), "{told}");
        assert!(relative_files(&export_folder(&made)).is_empty(), "{:?}", relative_files(&export_folder(&made)));
    }
}

#[test]
fn a_trace_that_should_be_there_and_is_not_is_an_error() {
    let made = fixtures::stored_run();
    fs::remove_file(made.folder.path().join("traces/one/000.csv")).unwrap();
    let told = export_run(&made, &["one"], ExportFormat::Mcap).unwrap_err().to_string();
    assert!(told.contains("traces/one/000.csv"), "{told}");
}

#[test]
fn a_record_cannot_name_files_elsewhere() {
    let mut made = fixtures::stored_run();
    made.record.scenarios[0].file = "../../elsewhere.toml".to_owned();
    assert!(
        matches!(export_run(&made, &[], ExportFormat::Mf4), Err(ExportError::OutsideRunFolder { named, .. }) if named == "../../elsewhere.toml")
    );
    let mut made = fixtures::stored_run();
    made.record.scenarios[0].trials[0].trace = "/etc/passwd".to_owned();
    assert!(
        matches!(export_run(&made, &[], ExportFormat::Mf4), Err(ExportError::OutsideRunFolder { named, .. }) if named == "/etc/passwd")
    );
}

#[test]
fn a_time_that_is_none_is_refused() {
    let mut made = fixtures::stored_run();
    made.record.started = "yesterday".to_owned();
    let told = export_run(&made, &[], ExportFormat::Mf4).unwrap_err().to_string();
    assert!(told.contains("`started` is yesterday, expected a time like"), "{told}");
}

/// The last row of a full row group, and the first of the next.
#[test]
fn long_trials_go_into_row_groups_that_fit_into_memory() {
    for (rows, groups) in [(65_536, vec![65_536]), (65_537, vec![65_536, 1])] {
        let mut made = fixtures::stored_run();
        made.record.scenarios.truncate(1);
        let long = fixtures::write_trial(made.folder.path(), "paper/step", 0, &fixtures::rows(rows, 0));
        made.record.scenarios[0].trials = vec![long];
        let file = export_run(&made, &[], ExportFormat::Parquet).unwrap().files.pop().unwrap();
        let reader = SerializedFileReader::new(File::open(file).unwrap()).unwrap();
        let found: Vec<_> = reader.metadata().row_groups().iter().map(RowGroupMetaData::num_rows).collect();
        assert_eq!(found, groups);
    }
}
