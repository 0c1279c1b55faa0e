//! Writes the result of a run or a comparison for other programs: Markdown summary and annotations on GitHub.

use crate::exit::Exit;
use crate::options::OutputFormat;
use crate::stdio::{self, is_stdout};
use clap::{Args, ValueEnum};
use platebench_engine::RunPlan;
use platebench_model::record::ScenarioRecord;
use platebench_model::scenario::number_in_file;
use platebench_model::trace::{FileError, OutputFolder, write_named_by_user};
use platebench_report::github::{self, SourceLocation};
use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::{env, fs};

/// Heading of the options for files and other programs.
pub(crate) const RESULTS: &str = "Results";

#[derive(Debug, Clone, Default, Args)]
#[command(next_help_heading = RESULTS)]
pub(crate) struct Outputs {
    /// Write a summary in Markdown to FILE; `-` is standard output, and the table goes to standard
    /// error
    #[arg(long, hide_short_help = true, value_name = "FILE")]
    summary: Option<PathBuf>,
    /// Annotations on GitHub Actions and its step summary; auto: if `GITHUB_ACTIONS` is true
    #[arg(long, hide_short_help = true, value_enum, default_value_t, value_name = "WHEN")]
    github: GithubMode,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, ValueEnum)]
enum GithubMode {
    /// If `GITHUB_ACTIONS` is true
    #[default]
    Auto,
    /// Always
    On,
    /// Never
    Off,
}

impl Outputs {
    /// Fails if two outputs use standard output, or if a file cannot be written.
    pub(crate) fn check(&self, format: OutputFormat) -> Result<(), String> {
        let Some(file) = &self.summary else { return Ok(()) };
        if is_stdout(file) && format == OutputFormat::Json {
            return Err("only one of --summary - and --format json can use standard output".to_owned());
        }
        let folder = file.parent().filter(|folder| !folder.as_os_str().is_empty());
        if let Some(folder) = folder.filter(|folder| !folder.is_dir()) {
            return Err(format!("--summary {}: there is no folder {}", file.display(), folder.display()));
        }
        if file.is_dir() {
            return Err(format!("--summary {}: this is a folder, expected a file to write", file.display()));
        }
        Ok(())
    }

    /// Renames the file of an earlier run to NAME.previous, so that it never stands beside a run
    /// without a verdict.
    pub(crate) fn set_aside(&self) -> Result<(), FileError> {
        let Some(file) = &self.summary else { return Ok(()) };
        let (Some(folder), Some(name)) = (file.parent(), file.file_name()) else { return Ok(()) };
        // A device, a pipe or a link stays.
        if is_stdout(file) || !file.symlink_metadata().is_ok_and(|metadata| metadata.is_file()) {
            return Ok(());
        }
        let mut previous = name.to_owned();
        previous.push(".previous");
        OutputFolder::open(folder)?.rename(name, previous)
    }

    /// True if another output uses standard output. Text for people then goes to standard error.
    pub(crate) fn replaces_table(&self) -> bool {
        self.summary.as_deref().is_some_and(is_stdout)
    }

    /// Writes a page of Markdown, and workflow commands.
    pub(crate) fn write(&self, page: impl Fn() -> String, commands: impl FnOnce() -> String) -> Result<(), FileError> {
        match &self.summary {
            Some(file) if is_stdout(file) => stdio::show(&page()),
            Some(file) => write_named_by_user(file, page())?,
            None => {}
        }
        let github = match self.github {
            GithubMode::Auto => env::var("GITHUB_ACTIONS").is_ok_and(|value| value == "true"),
            GithubMode::On => true,
            GithubMode::Off => false,
        };
        if github {
            // GitHub reads commands from both streams. Standard output may contain JSON.
            let _ = std::io::stderr().lock().write_all(commands().as_bytes());
            if let Some(file) = env::var_os("GITHUB_STEP_SUMMARY").filter(|file| !file.is_empty()) {
                github::append_markdown(&page(), Path::new(&file))?;
            }
        }
        Ok(())
    }
}

/// The scenarios of a run, to find the lines of their expectations.
pub(crate) struct ScenarioLocations(pub(crate) Arc<RunPlan>);

impl ScenarioLocations {
    /// Returns the line of expectation `index` in the scenario, or line 1 without `index`.
    pub(crate) fn location_of(&self, scenario: &ScenarioRecord, index: Option<usize>) -> Option<SourceLocation> {
        let played = self.0.scenarios.iter().find(|played| played.file == scenario.file)?;
        let line = index.map_or(1, |index| {
            let index = number_in_file(&scenario.not_applicable, index);
            played.diagnostic(&format!("expect.{index}.metric"), "").position().0
        });
        Some(SourceLocation { file: repository_path(&played.inputs.first()?.path), line })
    }
}

/// Returns the path relative to the checkout on GitHub, else relative to the working directory.
pub(crate) fn repository_path(path: &Path) -> String {
    let whole = fs::canonicalize(path).unwrap_or_else(|_| path.to_owned());
    let roots = [env::var_os("GITHUB_WORKSPACE").map(PathBuf::from), env::current_dir().ok()];
    let mut roots = roots.into_iter().flatten().filter_map(|root| fs::canonicalize(root).ok());
    let below = roots.find_map(|root| whole.strip_prefix(root).ok().map(Path::to_owned));
    below.unwrap_or(whole).display().to_string().replace('\\', "/")
}

pub(crate) fn exit_reason(exit: Exit) -> &'static str {
    match exit {
        Exit::Invalid => "invalid input",
        Exit::NothingToRun => "nothing to run",
        Exit::Unreachable => "the rig could not be reached or was lost",
        Exit::Signal(_) => "ended by a signal",
        Exit::Passed | Exit::Failed | Exit::Inconclusive => "ended early",
    }
}
