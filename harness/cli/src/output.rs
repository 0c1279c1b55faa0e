//! Standard output and error: a reader who went away is no error.

use crate::args::Format;
use crate::exit::Exit;
use platebench_report::console;
use platebench_scenario::Diagnostic;
use platebench_verdict::RunRecord;
use rustix::io::Errno;
use std::io::{self, IsTerminal, Write, stderr, stdout};
use std::sync::OnceLock;

/// Why something that was to be shown on standard output is not there, other than that nobody wanted it any more.
static LOST: OnceLock<String> = OnceLock::new();

/// Standard output, which remembers what it lost: a reader who went away is no error, a full disk is.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Shown;

impl Shown {
    fn noted<T>(result: io::Result<T>) -> io::Result<T> {
        result.inspect_err(|error| {
            // A pipe that was closed, a terminal that hung up.
            let is_gone =
                error.kind() == io::ErrorKind::BrokenPipe || error.raw_os_error() == Some(Errno::IO.raw_os_error());
            if !is_gone && error.kind() != io::ErrorKind::Interrupted {
                LOST.get_or_init(|| error.to_string());
            }
        })
    }
}

impl Write for Shown {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        Self::noted(stdout().lock().write(bytes))
    }

    fn flush(&mut self) -> io::Result<()> {
        Self::noted(stdout().lock().flush())
    }
}

/// Shows text on standard output.
pub(crate) fn show(text: &str) {
    // Nobody is left to tell, or it is told at the end.
    let _ = Shown.write_all(text.as_bytes()).and_then(|()| Shown.flush());
}

/// How the program ends that was to end with `exit`: whoever reads a result that is not whole must not take it for one.
pub(crate) fn ended(exit: Exit) -> Exit {
    let Some(why) = LOST.get() else { return exit };
    error(&format!("standard output is not whole: {why}"));
    Exit::Invalid
}

/// Shows an error on standard error.
pub(crate) fn error(message: &str) {
    let _ = writeln!(stderr().lock(), "error: {message}");
}

/// Shows a note on standard error.
pub(crate) fn note(message: &str) {
    let _ = writeln!(stderr().lock(), "{message}");
}

/// Shows where an input file is wrong.
pub(crate) fn diagnostic(diagnostic: &Diagnostic) {
    let _ = writeln!(stderr().lock(), "{}\n", diagnostic.render(stderr().is_terminal()));
}

/// Shows the result of a run.
pub(crate) fn record(record: &RunRecord, format: Format) {
    match format {
        Format::Human => show(&console::table(record, console::Style { colour: stdout().is_terminal() })),
        Format::Json => match serde_json::to_string_pretty(record) {
            Ok(text) => show(&format!("{text}\n")),
            Err(fault) => error(&format!("the record cannot be shown as JSON: {fault}")),
        },
    }
}
