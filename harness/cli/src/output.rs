//! Standard output and error: a reader who went away is no error.

use crate::args::Format;
use platebench_report::console;
use platebench_scenario::Diagnostic;
use platebench_verdict::RunRecord;
use std::io::{IsTerminal, Write, stderr, stdout};

/// Shows text on standard output.
pub(crate) fn show(text: &str) {
    // Nobody is left to tell.
    let _ = stdout().lock().write_all(text.as_bytes());
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
