//! Runs one scenario as a test, with its own run folder.

use platebench_engine::{Clock, RunError, RunHooks, RunPlan};
use platebench_model::record::{FolderError, Overrides, RECORD_FILE, RunFolder, RunRecord, Verdict};
use platebench_model::scenario::Scenario;
use platebench_report::console;
use platebench_report::document::Style;
use platebench_report::{ReportError, junit, page, traceability};
use platebench_rig::{ConnectOptions, RigSpec};
use std::fs::{self, Permissions};
use std::io;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};

#[derive(Debug)]
pub(crate) struct TestContext {
    rig: RigSpec,
    clock: Clock,
    out: PathBuf,
}

#[derive(Debug, thiserror::Error)]
pub(crate) enum TestFailure {
    #[error(
        "the scenario ends with {}, expected {}\n\n{table}\nrun folder: {}",
        describe_exit_code(*code),
        describe_exit_code(*expected),
        folder.display()
    )]
    Verdict { code: u8, expected: u8, table: String, folder: PathBuf },
    #[error("{0}")]
    Run(#[from] RunError),
    #[error("{0}")]
    Report(#[from] ReportError),
    #[error("{}: {source}", path.display())]
    Folder { path: PathBuf, source: io::Error },
}

impl From<FolderError> for TestFailure {
    fn from(error: FolderError) -> Self {
        Self::Run(error.into())
    }
}

impl TestContext {
    /// Selects the clock like `platebench run`.
    pub(crate) fn new(rig: RigSpec, out: PathBuf) -> Self {
        Self { clock: Clock::default_for(&rig), rig, out }
    }

    pub(crate) fn run_scenario(&self, scenario: Scenario) -> Result<(), TestFailure> {
        let folder = self.out.join(scenario.name());
        let expected = scenario.expected_exit.unwrap_or(0);
        let plan = RunPlan::new(&self.rig, self.clock, 1, vec![scenario], Overrides::default());
        let record = self.run_and_replace(&plan, &folder)?;
        let code = exit_code(&record);
        if code == expected {
            return Ok(());
        }
        let table = console::run_table(&record, Style::default());
        Err(TestFailure::Verdict { code, expected, table, folder })
    }

    /// Runs into a temporary folder, which then replaces an earlier run in `folder`.
    fn run_and_replace(&self, plan: &RunPlan, folder: &Path) -> Result<RunRecord, TestFailure> {
        let parent = folder.parent().unwrap_or(&self.out);
        fs::create_dir_all(parent).map_err(folder_error(parent))?;
        let readable = Permissions::from_mode(0o755);
        let new = tempfile::Builder::new().prefix(".running-").permissions(readable).tempdir_in(parent);
        let new = new.map_err(folder_error(parent))?;
        let result = self.run_into(plan, new.path());
        if new.path().join(RECORD_FILE).exists() {
            // A folder without a record is not a run folder and must not be deleted.
            if folder.join(RECORD_FILE).exists() {
                fs::remove_dir_all(folder).map_err(folder_error(folder))?;
            }
            fs::rename(new.path(), folder).map_err(folder_error(folder))?;
        }
        result
    }

    fn run_into(&self, plan: &RunPlan, folder: &Path) -> Result<RunRecord, TestFailure> {
        let run = RunFolder::create(Some(folder))?;
        let connect = || self.clock.connect(&self.rig, &ConnectOptions::default());
        let record = platebench_engine::run(plan, &run, &connect, RunHooks::default())?;
        junit::write(&record, &folder.join(junit::FILE))?;
        page::write(&record, folder)?;
        traceability::write(&record, folder)?;
        Ok(record)
    }
}

fn folder_error(path: &Path) -> impl FnOnce(io::Error) -> TestFailure + use<> {
    let path = path.to_owned();
    |source| TestFailure::Folder { path, source }
}

fn exit_code(record: &RunRecord) -> u8 {
    let unsafe_end = record.verdict == Verdict::Inconclusive && record.safe_confirmed == Some(false);
    match record.verdict {
        _ if record.has_lost_controller() || unsafe_end => 5,
        Verdict::Pass => 0,
        Verdict::Fail => 1,
        Verdict::Inconclusive => 3,
    }
}

fn describe_exit_code(code: u8) -> String {
    let words = match code {
        0 => "a pass",
        1 => "a failure",
        3 => "an inconclusive verdict",
        5 => "a lost controller",
        _ => "no verdict",
    };
    format!("{words} (exit code {code})")
}
