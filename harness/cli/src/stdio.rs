//! Writes to standard output, standard error and the log, with or without colours. A reader that
//! closed its end is no error.

use crate::options::OutputFormat;
use clap::{Args, ColorChoice, ValueEnum};
use platebench_document::{Document, Style};
use platebench_model::input::STANDARD_STREAM;
use platebench_model::printable::{printable, printable_lines};
use platebench_model::record::RunRecord;
use platebench_model::scenario::Diagnostic;
use platebench_model::trace::write_named_by_user;
use platebench_report::{Detail, console};
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::io::Errno;
use rustix::termios::tcgetwinsize;
use serde::Serialize;
use std::collections::BTreeSet;
use std::env::VarError;
use std::ffi::OsStr;
use std::fmt::Write as _;
use std::io::{self, IsTerminal, Write, stderr, stdout};
use std::os::fd::{AsFd, BorrowedFd};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Mutex, OnceLock, PoisonError};
use tracing::field::{Field, Visit};
use tracing::{Event, Metadata};
use tracing_subscriber::field::RecordFields;
use tracing_subscriber::filter::{LevelFilter, ParseError, Targets};
use tracing_subscriber::fmt::FormatFields;
use tracing_subscriber::fmt::format::Writer;
use tracing_subscriber::layer::{Context, Filter, SubscriberExt};
use tracing_subscriber::util::SubscriberInitExt;
use tracing_subscriber::{Layer, fmt, registry};

/// First error of a write to standard output.
static WRITE_ERROR: OnceLock<String> = OnceLock::new();
/// True if the last log line was dropped because the reader of standard error was too slow.
static LOG_BLOCKED: AtomicBool = AtomicBool::new(false);
/// Maximum time that a log line waits for its reader. After a dropped line, the next does not wait.
const LOG_TIMEOUT: Timespec = Timespec { tv_sec: 0, tv_nsec: 100_000_000 };
const NO_WAIT: Timespec = Timespec { tv_sec: 0, tv_nsec: 0 };
/// Equals `PIPE_BUF`: a writable pipe accepts this number of bytes without blocking.
const MAX_ATOMIC_WRITE: usize = 4096;

#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct CheckedStdout;

impl CheckedStdout {
    fn record_failure<T>(result: io::Result<T>) -> io::Result<T> {
        result.inspect_err(|error| {
            // A terminal that hung up gives EIO.
            let is_closed =
                error.kind() == io::ErrorKind::BrokenPipe || error.raw_os_error() == Some(Errno::IO.raw_os_error());
            if !is_closed && error.kind() != io::ErrorKind::Interrupted {
                WRITE_ERROR.get_or_init(|| error.to_string());
            }
        })
    }
}

impl Write for CheckedStdout {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        Self::record_failure(stdout().lock().write(bytes))
    }

    fn flush(&mut self) -> io::Result<()> {
        Self::record_failure(stdout().lock().flush())
    }
}

pub(crate) fn show(text: &str) {
    let _ = CheckedStdout.write_all(text.as_bytes()).and_then(|()| CheckedStdout.flush());
}

/// True if `file` is `-`, which means standard output where a file is written.
pub(crate) fn is_stdout(file: &Path) -> bool {
    file == Path::new(STANDARD_STREAM)
}

/// Replaces `path`, or writes to standard output if it is `-`.
pub(crate) fn write_output(path: &Path, text: &str) -> io::Result<()> {
    if is_stdout(path) {
        show(text);
        return Ok(());
    }
    write_named_by_user(path, text).map_err(|error| error.source)
}

/// Parses the path of a file that is written and cannot be standard output.
pub(crate) fn parse_named_file(text: &str) -> Result<PathBuf, String> {
    if is_stdout(Path::new(text)) {
        return Err("expected the name of a file, not standard output; `./-` is a file named `-`".to_owned());
    }
    Ok(text.into())
}

pub(crate) fn error(message: &str) {
    let _ = writeln!(stderr().lock(), "error: {}", escape_commands(message));
}

/// Error of an earlier write to standard output.
pub(crate) fn write_error() -> Option<&'static str> {
    WRITE_ERROR.get().map(String::as_str)
}

/// Escapes control characters, and `::` at a line's start, which is a command for GitHub Actions.
pub(crate) fn escape_commands(message: &str) -> String {
    let message = printable_lines(message);
    let is_command = |line: &str| line.trim_start().starts_with("::");
    let lines = message.split('\n').map(|line| if is_command(line) { format!("\\n{line}") } else { line.to_owned() });
    lines.collect::<Vec<_>>().join("\n")
}

pub(crate) fn note(message: &str) {
    let _ = writeln!(stderr().lock(), "{}", escape_commands(message));
}

pub(crate) fn diagnostic(diagnostic: &Diagnostic) {
    let _ = writeln!(stderr().lock(), "{}\n", printable_diagnostic(diagnostic).render(colors_apply_to(&stderr())));
}

/// Escapes control characters, because a file name may contain them.
fn printable_diagnostic(diagnostic: &Diagnostic) -> Diagnostic {
    let mut printed = diagnostic.clone();
    printed.path = printable(&diagnostic.path.display().to_string()).into_owned().into();
    printed.message = escape_commands(&diagnostic.message);
    printed
}

pub(crate) fn show_json(value: &impl Serialize) {
    match serde_json::to_string_pretty(value) {
        Ok(text) => show(&format!("{text}\n")),
        Err(fault) => error(&format!("the result cannot be written as JSON: {fault}")),
    }
}

pub(crate) fn show_as(format: OutputFormat, value: &impl Serialize, text: impl FnOnce() -> String) {
    match format {
        OutputFormat::Human => show(&text()),
        OutputFormat::Json => show_json(value),
    }
}

/// Colours and width of an output.
fn style_of(output: &(impl IsTerminal + AsFd)) -> Style {
    // Some terminals report 0 columns.
    let width = tcgetwinsize(output).ok().map(|size| usize::from(size.ws_col)).filter(|columns| *columns > 0);
    Style { colour: colors_apply_to(output), width }
}

/// Text for standard output, with colours if they apply there.
pub(crate) fn console_text(document: &Document) -> String {
    let style = style_of(&stdout());
    document.to_console(style.width, style)
}

/// Shows text for people, on standard error if another output uses standard output.
pub(crate) fn show_beside(uses_stdout: bool, text: &str) {
    if uses_stdout {
        let _ = stderr().lock().write_all(text.as_bytes());
    } else {
        show(text);
    }
}

pub(crate) fn show_result(format: OutputFormat, value: &impl Serialize, document: &Document) {
    show_as(format, value, || console_text(document));
}

pub(crate) fn document(document: &Document) {
    show(&console_text(document));
}

/// `folder` is the run folder. The text has the paths of the traces from the working directory.
pub(crate) fn record(record: &RunRecord, folder: &Path, format: OutputFormat, detail: Detail) {
    let style = style_of(&stdout());
    show_as(format, record, || console::run_text(&record.with_traces_below(folder), style, detail));
}

pub(crate) fn warn_if_not_safe(record: &RunRecord) {
    if let Some(fault) = record.unsafe_end() {
        let remedy = if record.may_have_amplifier() { ": check the amplifier before you touch the plate" } else { "" };
        error(&format!("{fault}{remedy}"));
    }
}

pub(crate) fn record_to_stderr(record: &RunRecord, folder: &Path, detail: Detail) {
    let style = style_of(&stderr());
    let text = console::run_text(&record.with_traces_below(folder), style, detail);
    let _ = stderr().lock().write_all(text.as_bytes());
}

pub(crate) fn is_output_drained() -> bool {
    is_writable(stdout().as_fd(), NO_WAIT) && is_writable(stderr().as_fd(), NO_WAIT)
}

/// Returns true if `poll` fails.
fn is_writable(output: BorrowedFd<'_>, timeout: Timespec) -> bool {
    poll(&mut [PollFd::new(&output, PollFlags::OUT)], Some(&timeout)).map_or(true, |ready| ready > 0)
}

/// Standard error for threads that must not wait. It drops bytes if the reader is too slow.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct NonBlockingStderr;

impl Write for NonBlockingStderr {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let error = stderr();
        let timeout = if LOG_BLOCKED.load(Ordering::Relaxed) { NO_WAIT } else { LOG_TIMEOUT };
        let is_read = is_writable(error.as_fd(), timeout);
        LOG_BLOCKED.store(!is_read, Ordering::Relaxed);
        if !is_read {
            return Ok(bytes.len());
        }
        // Writes without the lock of standard error, because a blocked thread may hold the lock.
        rustix::io::write(error.as_fd(), bytes.get(..MAX_ATOMIC_WRITE).unwrap_or(bytes)).map_err(io::Error::from)
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, ValueEnum)]
pub(crate) enum ColorArg {
    /// On a terminal, unless `NO_COLOR` is set
    #[default]
    Auto,
    /// Also in files and pipes
    Always,
    /// No colours
    Never,
}

static COLOR: OnceLock<ColorArg> = OnceLock::new();

pub(crate) fn set_color(choice: ColorArg) {
    COLOR.get_or_init(|| choice);
}

fn colors_apply_to(output: &impl IsTerminal) -> bool {
    let choice = COLOR.get().copied().unwrap_or_default();
    choice.applies(output.is_terminal(), std::env::var_os("NO_COLOR").as_deref())
}

/// Reads the values of a global option before clap parses the command line.
pub(crate) fn values_of_option(option: &str, words: impl Iterator<Item = String>) -> Vec<String> {
    let words: Vec<_> = words.take_while(|word| word != "--").collect();
    let separate = words.array_windows().filter(|[word, _]| word == option).map(|[_, value]| value.clone());
    let joined = words.iter().filter_map(|word| word.strip_prefix(option)?.strip_prefix('=').map(str::to_owned));
    separate.chain(joined).collect()
}

/// Help and wrong usage need `--color` too.
pub(crate) fn color_of_arguments(words: impl Iterator<Item = String>) -> ColorArg {
    let values = values_of_option("--color", words);
    values.iter().find_map(|value| ColorArg::from_str(value, false).ok()).unwrap_or_default()
}

impl ColorArg {
    pub(crate) const fn for_clap(self) -> ColorChoice {
        match self {
            Self::Auto => ColorChoice::Auto,
            Self::Always => ColorChoice::Always,
            Self::Never => ColorChoice::Never,
        }
    }

    /// An empty `NO_COLOR` counts as not set: <https://no-color.org>.
    fn applies(self, is_terminal: bool, no_color: Option<&OsStr>) -> bool {
        match self {
            Self::Auto => is_terminal && no_color.is_none_or(OsStr::is_empty),
            Self::Always => true,
            Self::Never => false,
        }
    }
}

const LOG_VARIABLE: &str = "PLATEBENCH_LOG";
const EXPECTED_LOG: &str = "expected a filter such as `debug` or `platebench_rig=trace,warn`";

#[derive(Debug, Args)]
#[command(next_help_heading = "Options of every command")]
pub(crate) struct LoggingArgs {
    /// Print more
    ///
    /// -v a table for each scenario and a log of the steps, -vv details, -vvv everything.
    #[arg(short, long, global = true, action = clap::ArgAction::Count)]
    pub(crate) verbose: u8,
    /// Print only errors and what did not pass
    #[arg(short, long, global = true, conflicts_with = "verbose")]
    pub(crate) quiet: bool,
    /// Settings file; default: the nearest platebench.toml, from the working directory upwards
    #[arg(long, global = true, hide_short_help = true, value_name = "FILE")]
    pub(crate) config: Option<PathBuf>,
    /// Format of the log on standard error; `PLATEBENCH_LOG` selects its content
    #[arg(
        long, global = true, hide_short_help = true,
        value_enum, default_value_t = LogFormat::Human, value_name = "FORMAT"
    )]
    pub(crate) log_format: LogFormat,
    /// Colours of the output for people, of diagnostics and of the log
    #[arg(
        long, global = true, hide_short_help = true,
        value_enum, default_value_t = ColorArg::Auto, value_name = "WHEN"
    )]
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

pub(crate) fn start_log(arguments: &LoggingArgs) -> Result<(), String> {
    let level = match (arguments.quiet, arguments.verbose) {
        (true, _) => LevelFilter::ERROR,
        (false, 0) => LevelFilter::WARN,
        (false, 1) => LevelFilter::INFO,
        (false, 2) => LevelFilter::DEBUG,
        (false, _) => LevelFilter::TRACE,
    };
    let filter = match std::env::var(LOG_VARIABLE) {
        Ok(text) => {
            parse_log_filter(&text).map_err(|error| format!("{LOG_VARIABLE}: {text:?}: {error}, {EXPECTED_LOG}"))?
        }
        Err(VarError::NotPresent) => log_filter(level),
        Err(VarError::NotUnicode(_)) => return Err(format!("{LOG_VARIABLE}: not UTF-8, {EXPECTED_LOG}")),
    };
    // Does not block, because a slow reader must not delay the controller's thread, which logs too.
    // Internal errors are not reported: if the terminal is closed, the report would panic.
    let lines = fmt::layer().with_writer(|| NonBlockingStderr).log_internal_errors(false);
    // -v and PLATEBENCH_LOG ask for a log of all steps.
    let is_short = arguments.verbose == 0 && std::env::var_os(LOG_VARIABLE).is_none();
    let colours = colors_apply_to(&stderr());
    let lines = match arguments.log_format {
        LogFormat::Human if is_short => {
            lines.without_time().with_target(false).fmt_fields(SentenceFields).with_ansi(colours).boxed()
        }
        LogFormat::Human => lines.with_ansi(colours).boxed(),
        LogFormat::Json => lines.json().boxed(),
    };
    let lines = lines.with_filter(is_short.then(FirstOfCause::default));
    // If a logger exists already, for example in a test, it stays.
    let _ = registry().with(filter).with(lines).try_init();
    Ok(())
}

/// Formats an event as `MESSAGE: ERROR, NAME VALUE`.
struct SentenceFields;

impl<'writer> FormatFields<'writer> for SentenceFields {
    fn format_fields<R: RecordFields>(&self, writer: Writer<'writer>, fields: R) -> std::fmt::Result {
        let mut sentence = Sentence { writer, result: Ok(()) };
        fields.record(&mut sentence);
        sentence.result
    }
}

struct Sentence<'writer> {
    writer: Writer<'writer>,
    result: std::fmt::Result,
}

impl Visit for Sentence<'_> {
    fn record_str(&mut self, field: &Field, value: &str) {
        self.record_debug(field, &format_args!("{value}"));
    }

    fn record_debug(&mut self, field: &Field, value: &dyn std::fmt::Debug) {
        let value = escape_commands(&format!("{value:?}"));
        let written = match field.name() {
            "message" => write!(self.writer, "{value}"),
            "error" => write!(self.writer, ": {value}"),
            name => write!(self.writer, ", {name} {value}"),
        };
        self.result = self.result.and(written);
    }
}

/// Logs the first event of each message and error, because a fault of the controller repeats in
/// every trial.
#[derive(Debug, Default)]
struct FirstOfCause {
    logged: Mutex<BTreeSet<String>>,
}

impl<S> Filter<S> for FirstOfCause {
    fn enabled(&self, _: &Metadata<'_>, _: &Context<'_, S>) -> bool {
        true
    }

    fn event_enabled(&self, event: &Event<'_>, _: &Context<'_, S>) -> bool {
        let mut cause = EventCause(event.metadata().target().to_owned());
        event.record(&mut cause);
        self.logged.lock().unwrap_or_else(PoisonError::into_inner).insert(cause.0)
    }
}

/// Target, message and error of an event, without the fields that name a scenario or a number.
struct EventCause(String);

impl Visit for EventCause {
    fn record_debug(&mut self, field: &Field, value: &dyn std::fmt::Debug) {
        if matches!(field.name(), "message" | "error") {
            let _ = write!(self.0, "\n{value:?}");
        }
    }
}

/// Logs at `level` for the crates of the bench only, because the emulator's code generator logs each
/// instruction.
fn log_filter(level: LevelFilter) -> Targets {
    Targets::new().with_default(level.min(LevelFilter::WARN)).with_target("platebench", level)
}

fn parse_log_filter(text: &str) -> Result<Targets, String> {
    let filter: Targets = text.parse().map_err(|error: ParseError| error.to_string())?;
    let is_path = |target: &str| !target.is_empty() && target.chars().all(|c| c.is_alphanumeric() || "_:".contains(c));
    match filter.iter().find(|(target, _)| !is_path(target)) {
        Some((target, _)) => Err(format!("invalid target `{target}`")),
        None => Ok(filter),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rstest::rstest;
    use std::sync::Arc;

    #[rstest]
    #[case("2 scenarios\nrun folder: runs/a", "2 scenarios\nrun folder: runs/a")]
    #[case("a\u{1b}[2Jb\u{202e}", "a\\u{1b}[2Jb\\u{202e}")]
    #[case("no file x\n::error::fail.toml", "no file x\n\\n::error::fail.toml")]
    #[case("x\n  ::stop-commands::t", "x\n\\n  ::stop-commands::t")]
    fn messages_have_no_control_characters_and_no_workflow_commands(#[case] message: &str, #[case] expected: &str) {
        assert_eq!(escape_commands(message), expected);
    }

    #[test]
    fn a_diagnostic_has_a_printable_path() {
        let fault = Diagnostic::for_file("a\u{1b}[2J\n::error::b.toml".as_ref(), "x\n::error::y");
        let printed = "error: a\\u{1b}[2J\\n::error::b.toml: x\n\\n::error::y";
        assert_eq!(printable_diagnostic(&fault).render(true), printed);
    }

    #[rstest]
    #[case(ColorArg::Auto, true, None, true)]
    #[case(ColorArg::Auto, true, Some(""), true)]
    #[case(ColorArg::Auto, true, Some("1"), false)]
    #[case(ColorArg::Auto, false, None, false)]
    #[case(ColorArg::Always, false, Some("1"), true)]
    #[case(ColorArg::Never, true, None, false)]
    fn colours_follow_option_variable_and_terminal(
        #[case] choice: ColorArg,
        #[case] is_terminal: bool,
        #[case] no_color: Option<&str>,
        #[case] expected: bool,
    ) {
        assert_eq!(choice.applies(is_terminal, no_color.map(OsStr::new)), expected);
    }

    #[derive(Clone, Default)]
    struct Lines(Arc<Mutex<Vec<u8>>>);

    impl Write for Lines {
        fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
            self.0.lock().unwrap().write(bytes)
        }

        fn flush(&mut self) -> io::Result<()> {
            Ok(())
        }
    }

    #[rstest]
    #[case(true, &["lost a", "lost b", "rejected"])]
    #[case(false, &["lost a", "lost b", "lost a", "rejected", "rejected"])]
    fn logs_each_cause_once(#[case] is_short: bool, #[case] expected: &[&str]) {
        let lines = Lines::default();
        let writer = lines.clone();
        let layer = fmt::layer().without_time().with_ansi(false).with_writer(move || writer.clone());
        let layer = layer.with_filter(is_short.then(FirstOfCause::default));
        tracing::subscriber::with_default(registry().with(layer), || {
            for cause in ["a", "b", "a"] {
                tracing::error!(error = cause, "lost");
            }
            for (scenario, frames) in [("a.toml", 1), ("b.toml", 2)] {
                tracing::warn!(scenario, frames, "rejected");
            }
        });
        let text = String::from_utf8(lines.0.lock().unwrap().clone()).unwrap();
        let found: Vec<&str> = text.lines().collect();
        assert_eq!(found.len(), expected.len(), "{text}");
        for (line, expected) in found.iter().zip(expected) {
            assert!(expected.split(' ').all(|word| line.contains(word)), "{expected}: {text}");
        }
    }

    #[test]
    fn a_log_line_is_a_sentence() {
        let lines = Lines::default();
        let writer = lines.clone();
        let layer = fmt::layer().without_time().with_ansi(false).with_target(false).fmt_fields(SentenceFields);
        tracing::subscriber::with_default(registry().with(layer.with_writer(move || writer.clone())), || {
            tracing::error!(error = "the \"port\" \u{1b}[2J closed", "controller lost");
            tracing::warn!(scenario = "a.toml", frames = 2, "frames rejected");
        });
        let expected =
            "ERROR controller lost: the \"port\" \\u{1b}[2J closed\n WARN frames rejected, scenario a.toml, frames 2\n";
        assert_eq!(String::from_utf8(lines.0.lock().unwrap().clone()).unwrap(), expected);
    }

    #[rstest]
    #[case(&["run", "--color", "never"], ColorArg::Never)]
    #[case(&["--color=always", "run"], ColorArg::Always)]
    #[case(&["run", "--", "--color=always"], ColorArg::Auto)]
    #[case(&["run", "--color", "blue"], ColorArg::Auto)]
    fn the_option_is_read_before_parsing(#[case] words: &[&str], #[case] expected: ColorArg) {
        assert_eq!(color_of_arguments(words.iter().map(ToString::to_string)), expected);
    }
}
