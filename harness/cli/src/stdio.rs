//! Writes to standard output and standard error. A reader that closed its end is no error.

use crate::color;
use crate::exit::Exit;
use crate::options::OutputFormat;
use platebench_model::record::RunRecord;
use platebench_model::scenario::Diagnostic;
use platebench_report::text::{printable, printable_lines};
use platebench_report::{Detail, Style, console};
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::io::Errno;
use serde::Serialize;
use std::io::{self, Write, stderr, stdout};
use std::os::fd::{AsFd, BorrowedFd};
use std::sync::OnceLock;
use std::sync::atomic::{AtomicBool, Ordering};

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

pub(crate) fn checked_exit(exit: Exit) -> Exit {
    let Some(why) = WRITE_ERROR.get() else { return exit };
    error(&format!("standard output is incomplete: {why}"));
    Exit::Invalid
}

pub(crate) fn error(message: &str) {
    let _ = writeln!(stderr().lock(), "error: {}", escape_commands(message));
}

/// Reports the reason of an exit code, after the verdict that the code means.
pub(crate) fn reason(exit: Exit, message: &str) {
    let _ = writeln!(stderr().lock(), "{}: {}", exit.word(), escape_commands(message));
}

/// Ends a text on standard output with the verdict, if there is one. Beside JSON, which has its own
/// verdict, it is on standard error.
pub(crate) fn verdict(exit: Exit, reason: &str, format: OutputFormat) {
    if matches!(exit, Exit::Invalid | Exit::Signal(_)) {
        return;
    }
    let line = escape_commands(&exit.verdict_line(reason));
    match format {
        OutputFormat::Human => show(&format!("{line}\n")),
        OutputFormat::Json => note(&line),
    }
}

/// Escapes control characters, and `::` at a line's start, which is a command for GitHub Actions.
fn escape_commands(message: &str) -> String {
    let message = printable_lines(message);
    let is_command = |line: &str| line.trim_start().starts_with("::");
    let lines = message.split('\n').map(|line| if is_command(line) { format!("\\n{line}") } else { line.to_owned() });
    lines.collect::<Vec<_>>().join("\n")
}

pub(crate) fn note(message: &str) {
    let _ = writeln!(stderr().lock(), "{}", escape_commands(message));
}

pub(crate) fn diagnostic(diagnostic: &Diagnostic) {
    let _ = writeln!(stderr().lock(), "{}\n", printable_diagnostic(diagnostic).render(color::applies_to(&stderr())));
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

pub(crate) fn record(record: &RunRecord, format: OutputFormat, detail: Detail) {
    let style = Style { colour: color::applies_to(&stdout()) };
    show_as(format, record, || console::run_text(record, style, detail));
}

pub(crate) fn warn_if_not_safe(record: &RunRecord) {
    if record.drive_after_safe {
        error(
            "the controller commanded a drive after it had confirmed 0 V: check the amplifier before you touch the \
             plate",
        );
    } else if record.safe_confirmed == Some(false) {
        error("the controller did not confirm 0 V at the end: check the amplifier before you touch the plate");
    }
}

pub(crate) fn record_to_stderr(record: &RunRecord, detail: Detail) {
    let style = Style { colour: color::applies_to(&stderr()) };
    let _ = stderr().lock().write_all(console::run_text(record, style, detail).as_bytes());
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

#[cfg(test)]
mod tests {
    use super::*;
    use rstest::rstest;

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
}
