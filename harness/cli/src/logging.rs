//! Writes the log to standard error.

use crate::color::{self, ColorArg};
use crate::stdio::NonBlockingStderr;
use clap::{Args, ValueEnum};
use platebench_report::Detail;
use std::env::VarError;
use std::io::stderr;
use tracing_subscriber::filter::{LevelFilter, ParseError, Targets};
use tracing_subscriber::layer::SubscriberExt;
use tracing_subscriber::util::SubscriberInitExt;
use tracing_subscriber::{Layer, fmt, registry};

const VARIABLE: &str = "PLATEBENCH_LOG";
const EXPECTED: &str = "expected a filter such as `debug` or `platebench_rig=trace,warn`";

#[derive(Debug, Args)]
#[command(next_help_heading = "Options of every command")]
pub(crate) struct LoggingArgs {
    /// Print more: -v a table for each scenario and a log of the steps, -vv details, -vvv
    /// everything
    #[arg(short, long, global = true, action = clap::ArgAction::Count)]
    pub(crate) verbose: u8,
    /// Print only errors and what did not pass
    #[arg(short, long, global = true, conflicts_with = "verbose")]
    pub(crate) quiet: bool,
    /// Format of the log on standard error; `PLATEBENCH_LOG` selects its content
    #[arg(long, global = true, value_enum, default_value_t = LogFormat::Human, value_name = "FORMAT")]
    pub(crate) log_format: LogFormat,
    /// Colours of the output for people, of diagnostics and of the log
    #[arg(long, global = true, value_enum, default_value_t = ColorArg::Auto, value_name = "WHEN")]
    pub(crate) color: ColorArg,
}

impl LoggingArgs {
    pub(crate) const fn detail(&self) -> Detail {
        match (self.quiet, self.verbose) {
            (true, _) => Detail::Failures,
            (false, 0) => Detail::Summary,
            (false, _) => Detail::Tables,
        }
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum LogFormat {
    /// For people
    Human,
    /// One JSON object per line
    Json,
}

pub(crate) fn start(arguments: &LoggingArgs) -> Result<(), String> {
    let level = match (arguments.quiet, arguments.verbose) {
        (true, _) => LevelFilter::ERROR,
        (false, 0) => LevelFilter::WARN,
        (false, 1) => LevelFilter::INFO,
        (false, 2) => LevelFilter::DEBUG,
        (false, _) => LevelFilter::TRACE,
    };
    let filter = match std::env::var(VARIABLE) {
        Ok(text) => parse(&text).map_err(|error| format!("{VARIABLE}: {text:?}: {error}, {EXPECTED}"))?,
        Err(VarError::NotPresent) => Targets::new().with_default(level),
        Err(VarError::NotUnicode(_)) => return Err(format!("{VARIABLE}: not UTF-8, {EXPECTED}")),
    };
    // Does not block, because a slow reader must not delay the controller's thread, which logs too.
    // Internal errors are not reported: if the terminal is closed, the report would panic.
    let lines = fmt::layer().with_writer(|| NonBlockingStderr).log_internal_errors(false);
    let lines = match arguments.log_format {
        LogFormat::Human => lines.with_ansi(color::applies_to(&stderr())).boxed(),
        LogFormat::Json => lines.json().boxed(),
    };
    // If a logger exists already, for example in a test, it stays.
    let _ = registry().with(filter).with(lines).try_init();
    Ok(())
}

fn parse(text: &str) -> Result<Targets, String> {
    let filter: Targets = text.parse().map_err(|error: ParseError| error.to_string())?;
    let is_path = |target: &str| !target.is_empty() && target.chars().all(|c| c.is_alphanumeric() || "_:".contains(c));
    match filter.iter().find(|(target, _)| !is_path(target)) {
        Some((target, _)) => Err(format!("invalid target `{target}`")),
        None => Ok(filter),
    }
}
