//! Writes the events of a run as lines of JSON (`docs/formats.md`), flushed at once.

use crate::record_queries::own_verdict_of_run;
use platebench_model::printable::is_active;
use platebench_model::record::{Event, RunRecord};
use std::fmt::Write as _;
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

/// Returns one line, with the same characters escaped as in [`printable`](platebench_model::printable::printable).
fn json_line(value: &serde_json::Value) -> String {
    let text = value.to_string();
    if !text.contains(is_active) {
        return text;
    }
    text.chars().fold(String::with_capacity(text.len()), |mut line, character| {
        if is_active(character) {
            let mut units = [0; 2];
            for unit in character.encode_utf16(&mut units) {
                let _ = write!(line, "\\u{unit:04x}");
            }
        } else {
            line.push(character);
        }
        line
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn escapes_hostile_text() {
        let line = |text: &str| json_line(&serde_json::json!(text));
        assert_eq!(line("=1\u{1b}[2J\u{202e}\n::error::#|"), "\"=1\\u001b[2J\\u202e\\n::error::#|\"");
        assert_eq!(line("µm ≤ 2 …"), "\"µm ≤ 2 …\"");
    }
}
