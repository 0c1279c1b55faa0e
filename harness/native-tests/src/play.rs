//! One test: a scenario played into a run folder of its own.

use platebench_report::console::{self, Style};
use platebench_report::{ReportError, html, junit, traceability};
use platebench_rig::RigSpec;
use platebench_runner::{Cancel, Clock, FolderError, Pace, Pacing, Plan, RunError, RunFolder, rejudge};
use platebench_scenario::Scenario;
use platebench_verdict::record::{FILE, Overrides};
use platebench_verdict::{RunRecord, Verdict};
use std::fs::{self, Permissions};
use std::io;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};

/// What every test of a suite shares.
#[derive(Debug)]
pub(crate) struct Stage {
    rig: RigSpec,
    clock: Clock,
    out: PathBuf,
}

/// Why a test did not pass.
#[derive(Debug, thiserror::Error)]
pub(crate) enum NotPassed {
    /// It ended, but not as it should have.
    #[error("it ends with {}, expected {}\n\n{table}\nrun folder: {}", meaning(*code), meaning(*expected), folder.display())]
    Verdict { code: u8, expected: u8, table: String, folder: PathBuf },
    /// It did not get to a verdict.
    #[error("{0}")]
    Run(#[from] RunError),
    /// Its report could not be written.
    #[error("{0}")]
    Report(#[from] ReportError),
    /// There is no place for its run folder.
    #[error("{}: {source}", path.display())]
    Folder { path: PathBuf, source: io::Error },
}

impl From<FolderError> for NotPassed {
    fn from(error: FolderError) -> Self {
        Self::Run(error.into())
    }
}

impl Stage {
    /// Real time where the board has a line that does not wait, lockstep otherwise; as `platebench run` does without `--clock`.
    pub(crate) fn new(rig: RigSpec, out: PathBuf) -> Self {
        let clock = match rig {
            RigSpec::Serial { .. } | RigSpec::Probe { port: Some(_), .. } => {
                Clock::RealTime(Pace { time_scale: 1.0, pacing: Pacing::Bench })
            }
            RigSpec::Hosted | RigSpec::Emulated(_) | RigSpec::Exec(_) | RigSpec::Probe { port: None, .. } => {
                Clock::Lockstep { wire_time: false }
            }
        };
        Self { rig, clock, out }
    }

    /// Plays `scenario` and holds how it ended to what it says.
    pub(crate) fn play(&self, mut scenario: Scenario) -> Result<(), NotPassed> {
        let overrides = Overrides::default();
        rejudge::apply(&overrides, &mut scenario);
        scenario.choose_model(matches!(self.clock, Clock::Lockstep { .. }));
        let folder = self.out.join(scenario.name());
        let expected = scenario.expected_exit.unwrap_or(0);
        let plan = Plan {
            scenarios: vec![scenario],
            jobs: 1,
            clock: self.clock,
            own_clock: self.rig.has_own_clock(),
            rig: self.rig.to_string(),
            overrides,
        };
        let record = self.record(&plan, &folder)?;
        let code = code(&record);
        if code == expected {
            return Ok(());
        }
        let table = console::table(&record, Style::default());
        Err(NotPassed::Verdict { code, expected, table, folder })
    }

    /// Plays `plan` beside `folder` and puts what came of it in its place, so that what lies there is always of one run.
    fn record(&self, plan: &Plan, folder: &Path) -> Result<RunRecord, NotPassed> {
        let parent = folder.parent().unwrap_or(&self.out);
        fs::create_dir_all(parent).map_err(at(parent))?;
        let readable = Permissions::from_mode(0o755);
        let new = tempfile::Builder::new().prefix(".playing-").permissions(readable).tempdir_in(parent);
        let new = new.map_err(at(parent))?;
        let played = self.fill(plan, new.path());
        if new.path().join(FILE).exists() {
            // Only what is a run's is taken away.
            if folder.join(FILE).exists() {
                fs::remove_dir_all(folder).map_err(at(folder))?;
            }
            fs::rename(new.path(), folder).map_err(at(folder))?;
        }
        played
    }

    fn fill(&self, plan: &Plan, folder: &Path) -> Result<RunRecord, NotPassed> {
        let run = RunFolder::create(Some(folder))?;
        let connect = || match self.clock {
            Clock::Lockstep { .. } => self.rig.connect(),
            Clock::RealTime(_) | Clock::OwnPlate => self.rig.connect_in_real_time(),
        };
        let record = platebench_runner::run(plan, &run, &connect, &Cancel::default(), &mut |_| {})?;
        junit::write(&record, &folder.join(junit::FILE))?;
        html::write(&record, folder)?;
        traceability::write(&record, folder)?;
        Ok(record)
    }
}

fn at(path: &Path) -> impl FnOnce(io::Error) -> NotPassed + use<> {
    let path = path.to_owned();
    |source| NotPassed::Folder { path, source }
}

/// How `platebench run` ends with this record.
fn code(record: &RunRecord) -> u8 {
    let unsafe_end = record.verdict == Verdict::Inconclusive && record.safe_confirmed == Some(false);
    match record.verdict {
        _ if record.lost_a_controller() || unsafe_end => 5,
        Verdict::Pass => 0,
        Verdict::Fail => 1,
        Verdict::Inconclusive => 3,
    }
}

fn meaning(code: u8) -> String {
    let words = match code {
        0 => "a pass",
        1 => "a failure",
        3 => "an inconclusive verdict",
        5 => "a lost controller",
        _ => "no verdict",
    };
    format!("{words} (exit code {code})")
}
