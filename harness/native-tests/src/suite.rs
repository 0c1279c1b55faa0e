//! Builds the test program of a folder of scenarios and a rig, and runs each scenario in its own
//! run folder.

use libtest_mimic::{Arguments, Trial};
use platebench_document::Style;
use platebench_engine::{Clock, RunError, RunHooks, RunPlan};
use platebench_model::record::{Assessment, FolderError, Overrides, RECORD_FILE, RunFolder, RunRecord};
use platebench_model::scenario::{Diagnostic, Scenario, find};
use platebench_model::trace::{FileError, OutputFolder};
use platebench_report::{console, junit, page, traceability};
use platebench_rig::SpecError;
use platebench_rig::{ConnectError, ConnectOptions, RigSpec};
use std::fmt::Write as _;
use std::fs::Permissions;
use std::io;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::Arc;

/// Environment variable that replaces the rig of the suite, for example by a board.
pub const RIG_VARIABLE: &str = "PLATEBENCH_RIG";

#[derive(Debug, Clone)]
pub struct Suite {
    scenarios: PathBuf,
    out: PathBuf,
    rig: String,
}

impl Suite {
    /// `scenarios` is a folder or one file. Run folders are created below `out`. Relative paths
    /// start in the folder of the package, as in every Cargo test.
    pub fn new(scenarios: impl Into<PathBuf>, out: impl Into<PathBuf>) -> Self {
        Self { scenarios: scenarios.into(), out: out.into(), rig: "emulated".to_owned() }
    }

    /// Sets the rig, as `platebench run --rig` (default `emulated`). [`RIG_VARIABLE`] overrides it.
    #[must_use]
    pub fn rig(mut self, rig: impl Into<String>) -> Self {
        self.rig = rig.into();
        self
    }

    /// Exit codes: 0 all tests passed, 101 a test failed, 2 invalid scenario or rig, 4 no scenario.
    pub fn run(mut self) -> ExitCode {
        if let Ok(rig) = std::env::var(RIG_VARIABLE) {
            self.rig = rig;
        }
        let mut arguments = Arguments::from_args();
        match self.tests() {
            Ok(tests) => {
                if tests.one_at_a_time {
                    arguments.test_threads = Some(1);
                }
                libtest_mimic::run(&arguments, tests.trials).exit_code()
            }
            Err(error) => {
                // Diagnostics of scenarios have their own prefix.
                let prefix = if matches!(error, SuiteError::Scenarios(_)) { "" } else { "error: " };
                eprintln!("{prefix}{error}");
                ExitCode::from(error.exit_code())
            }
        }
    }

    fn tests(&self) -> Result<SuiteTests, SuiteError> {
        let rig: RigSpec = self.rig.parse().map_err(SuiteError::Rig)?;
        rig.check().map_err(SuiteError::Connect)?;
        let found = find(std::slice::from_ref(&self.scenarios)).map_err(SuiteError::Scenarios)?;
        if found.scenarios.is_empty() && found.skipped.is_empty() {
            return Err(SuiteError::NoScenarios(self.scenarios.clone()));
        }
        let one_at_a_time = !rig.allows_parallel_links();
        let context = Arc::new(TestContext::new(rig, self.out.clone()));
        let judged = found.scenarios.into_iter().map(|scenario| (scenario, false));
        let mut scenarios: Vec<_> = judged.chain(found.skipped.into_iter().map(|scenario| (scenario, true))).collect();
        scenarios.sort_by(|(a, _), (b, _)| a.file.cmp(&b.file));
        let test = |(scenario, ignored): (Scenario, bool)| {
            let context = Arc::clone(&context);
            let name = scenario.name().to_owned();
            Trial::test(name, move || context.run_scenario(scenario).map_err(Into::into)).with_ignored_flag(ignored)
        };
        let trials = scenarios.into_iter().map(test).collect();
        Ok(SuiteTests { trials, one_at_a_time })
    }
}

struct SuiteTests {
    trials: Vec<Trial>,
    /// True if all tests need the same line, so that they cannot run in parallel.
    one_at_a_time: bool,
}

/// Stops the whole suite, also with a filter, because a partial suite could pass by mistake.
#[derive(Debug, thiserror::Error)]
pub enum SuiteError {
    #[error("{0}")]
    Rig(SpecError),
    /// The rig is not part of this build, or its command is invalid.
    #[error(transparent)]
    Connect(ConnectError),
    #[error("{}", render_all(.0))]
    Scenarios(Vec<Diagnostic>),
    #[error("{}: no scenario was found below this folder", .0.display())]
    NoScenarios(PathBuf),
}

impl SuiteError {
    /// Equals the exit code of `platebench run`: 2 for invalid input, 4 if there is no scenario.
    pub fn exit_code(&self) -> u8 {
        match self {
            Self::Rig(_) | Self::Connect(_) | Self::Scenarios(_) => 2,
            Self::NoScenarios(_) => 4,
        }
    }
}

fn render_all(problems: &[Diagnostic]) -> String {
    problems.iter().fold(String::new(), |mut text, problem| {
        let _ = writeln!(text, "{}\n", problem.render(false));
        text
    })
}

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
    #[error("{}: {source}", path.display())]
    Folder { path: PathBuf, source: io::Error },
}

impl From<FileError> for TestFailure {
    fn from(FileError { path, source }: FileError) -> Self {
        Self::Folder { path, source }
    }
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
        let code = Assessment::of(&record).outcome.exit_code();
        if code == expected {
            return Ok(());
        }
        let table = console::run_table(&record, Style::default());
        Err(TestFailure::Verdict { code, expected, table, folder })
    }

    /// Runs into a temporary folder, which then replaces an earlier run in `folder`.
    fn run_and_replace(&self, plan: &RunPlan, folder: &Path) -> Result<RunRecord, TestFailure> {
        let parent = folder.parent().unwrap_or(&self.out);
        let (below, name) = (OutputFolder::create(parent)?, folder.file_name().unwrap_or_default());
        let readable = Permissions::from_mode(0o755);
        let new = tempfile::Builder::new().prefix(".running-").permissions(readable).tempdir_in(parent);
        let new = new.map_err(folder_error(parent))?;
        let result = self.run_into(plan, new.path());
        if new.path().join(RECORD_FILE).exists() {
            // A folder without a record is not a run folder and must not be deleted.
            if folder.join(RECORD_FILE).exists() {
                below.remove_folder(name)?;
            }
            below.rename(new.path().file_name().unwrap_or_default(), name)?;
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

fn describe_exit_code(code: u8) -> String {
    let words = match code {
        0 => "a pass",
        1 => "a failure",
        3 => "an inconclusive verdict",
        4 => "no scenario that applies to the controller",
        5 => "a lost controller",
        _ => "no verdict",
    };
    format!("{words} (exit code {code})")
}
