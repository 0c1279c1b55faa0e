//! Writes the events of a run as lines of JSON (`docs/formats.md`), flushed at once.

use crate::escape::json_line;
use crate::record_queries::own_verdict_of_run;
use platebench_model::record::{Event, RunRecord};
use std::io::Write;

/// Writes event lines. A closed pipe is no error.
pub struct EventWriter {
    out: Box<dyn Write + Send>,
}

impl EventWriter {
    pub fn new(out: impl Write + Send + 'static) -> Self {
        Self { out: Box::new(out) }
    }

    pub fn write(&mut self, event: &Event) {
        if let Ok(value) = serde_json::to_value(event) {
            let _ = writeln!(self.out, "{}", json_line(&value)).and_then(|()| self.out.flush());
        }
    }
}

/// The last event of a run.
pub fn run_finished(record: Option<&RunRecord>, error: Option<&str>, exit_code: u8) -> Event {
    let reason = record.and_then(own_verdict_of_run).map(|own| own.reason);
    Event::run_finished(record, error, reason, exit_code)
}
