//! What a run tells other programs: lines of JSON while it goes on, TAP, a summary in Markdown, annotations on GitHub.
//!
//! Neighbours: `platebench-report` knows the formats; here is where they go, and where an expectation stands in a file.

use crate::exit::Exit;
use clap::{Args, ValueEnum};
use platebench_report::annotations::{self, Place};
use platebench_report::{ReportError, markdown, tap};
use platebench_scenario::{Diagnostic, Scenario};
use platebench_verdict::{RunRecord, ScenarioRecord};
use std::env;
use std::fs;
use std::io::Write as _;
use std::path::{Path, PathBuf};

/// Files and annotations beside what is shown.
#[derive(Debug, Clone, Default, Args)]
pub(crate) struct Told {
    /// A page of Markdown about the run, written to FILE
    #[arg(long, value_name = "FILE")]
    summary: Option<PathBuf>,
    /// The result as TAP 14, written to FILE
    #[arg(long, value_name = "FILE")]
    tap: Option<PathBuf>,
    /// Annotations on GitHub Actions and the summary of its step: auto where `GITHUB_ACTIONS` is true
    #[arg(long, value_enum, default_value_t, value_name = "WHEN")]
    github: Github,
}

/// `--github`
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, ValueEnum)]
enum Github {
    /// Where `GITHUB_ACTIONS` is true
    #[default]
    Auto,
    /// Always
    On,
    /// Never
    Off,
}

impl Told {
    /// Says beforehand where something could not be written, and not when everything has been played.
    pub(crate) fn check(&self) -> Result<(), String> {
        for (option, file) in [("--summary", &self.summary), ("--tap", &self.tap)] {
            let Some(file) = file else { continue };
            let folder = file.parent().filter(|folder| !folder.as_os_str().is_empty());
            if let Some(folder) = folder.filter(|folder| !folder.is_dir()) {
                return Err(format!("{option} {}: there is no folder {}", file.display(), folder.display()));
            }
            if file.is_dir() {
                return Err(format!("{option} {}: a folder, expected a file to write", file.display()));
            }
        }
        Ok(())
    }

    /// Tells of a run whose scenarios were these.
    pub(crate) fn tell(&self, record: &RunRecord, places: &Places) -> Result<(), ReportError> {
        if let Some(file) = &self.summary {
            markdown::write(record, file)?;
        }
        if let Some(file) = &self.tap {
            tap::write(record, file)?;
        }
        let github = match self.github {
            Github::Auto => env::var("GITHUB_ACTIONS").is_ok_and(|value| value == "true"),
            Github::On => true,
            Github::Off => false,
        };
        if github {
            let commands = annotations::commands(record, &|scenario, index| places.of(scenario, index));
            // GitHub reads both streams, and standard output may be somebody's JSON.
            let _ = std::io::stderr().lock().write_all(commands.as_bytes());
            if let Some(file) = env::var_os("GITHUB_STEP_SUMMARY").filter(|file| !file.is_empty()) {
                markdown::append(record, Path::new(&file))?;
            }
        }
        Ok(())
    }
}

/// Where the scenarios of a run stand, as they were read.
pub(crate) struct Places(Vec<(String, PathBuf, String)>);

impl Places {
    /// Of these scenarios.
    pub(crate) fn of_scenarios(scenarios: &[Scenario]) -> Self {
        let read = scenarios.iter().filter_map(|scenario| {
            let input = scenario.inputs.first()?;
            let source = String::from_utf8_lossy(&input.bytes).into_owned();
            Some((scenario.file.clone(), input.path.clone(), source))
        });
        Self(read.collect())
    }

    /// The line of an expectation, or of the whole scenario.
    fn of(&self, scenario: &ScenarioRecord, index: Option<usize>) -> Option<Place> {
        let (_, path, source) = self.0.iter().find(|(file, ..)| *file == scenario.file)?;
        let line = index.map_or(1, |index| {
            Diagnostic::at_key(path, source, &format!("expect.{index}.metric"), String::new()).position().0
        });
        Some(Place { file: in_repository(path), line })
    }
}

/// A path as GitHub knows it: relative to the checkout, or to where the program runs.
fn in_repository(path: &Path) -> String {
    let whole = fs::canonicalize(path).unwrap_or_else(|_| path.to_owned());
    let roots = [env::var_os("GITHUB_WORKSPACE").map(PathBuf::from), env::current_dir().ok()];
    let mut roots = roots.into_iter().flatten().filter_map(|root| fs::canonicalize(root).ok());
    let below = roots.find_map(|root| whole.strip_prefix(root).ok().map(Path::to_owned));
    below.unwrap_or(whole).display().to_string().replace('\\', "/")
}

/// Why a run that came to no verdict ended, for its last line.
pub(crate) fn ended(exit: Exit) -> &'static str {
    match exit {
        Exit::Invalid => "invalid input",
        Exit::Nothing => "nothing to run",
        Exit::Unreachable => "the rig could not be reached or was lost",
        Exit::Signal(_) => "ended by a signal",
        Exit::Passed | Exit::Failed | Exit::Inconclusive => "ended early",
    }
}
