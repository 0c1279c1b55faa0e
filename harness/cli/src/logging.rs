//! The log on standard error.

use crate::args::{LogFormat, Logging};
use crate::guard::Log;
use std::io::{IsTerminal, stderr};
use tracing_subscriber::EnvFilter;

const VARIABLE: &str = "PLATEBENCH_LOG";

/// Starts the log: what `PLATEBENCH_LOG` asks for, else what -v and -q do.
pub(crate) fn start(arguments: &Logging) {
    let level = match (arguments.quiet, arguments.verbose) {
        (true, _) => "error",
        (false, 0) => "warn",
        (false, 1) => "info",
        (false, 2) => "debug",
        (false, _) => "trace",
    };
    let filter = std::env::var(VARIABLE).ok().and_then(|text| EnvFilter::try_new(text).ok());
    let filter = filter.unwrap_or_else(|| EnvFilter::new(level));
    // Whoever talks to a controller logs: nobody who reads it slowly may hold that up. A log that nobody can be given any more, because the terminal is gone, is no reason to panic: that is what the subscriber's own complaint about it would do.
    let builder = tracing_subscriber::fmt().with_env_filter(filter).with_writer(|| Log).log_internal_errors(false);
    // A second start, as in a test, changes nothing.
    let _ = match arguments.log_format {
        LogFormat::Human => builder.with_ansi(stderr().is_terminal()).try_init(),
        LogFormat::Json => builder.json().try_init(),
    };
}
