//! Workflow commands of GitHub Actions: what did not pass, at the line of the scenario that expected it.
//!
//! A failure is an `error`. What is inconclusive is a `warning`, so that a reader sees at a glance what is the
//! controller's doing and what is not; the exit code keeps the job from turning green either way. Failures come first,
//! because GitHub shows ten of a kind in a step.
//!
//! Neighbours: only the command line knows where the scenario files are; it is asked for each place.

use crate::{evidence, shown};
use platebench_verdict::{RunRecord, ScenarioRecord, Verdict};
use std::fmt::Write as _;

/// Where an expectation stands.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Place {
    /// The file, relative to the repository, with `/`.
    pub file: String,
    /// Counted from 1.
    pub line: usize,
}

/// A command per line for everything that did not pass. `place` is asked with a scenario and the number of one of its
/// expectations, or none for the scenario as a whole.
pub fn commands(record: &RunRecord, place: &dyn Fn(&ScenarioRecord, Option<usize>) -> Option<Place>) -> String {
    let mut text = String::new();
    for (scenario, index) in evidence::open_points(record) {
        let Some(expectation) = scenario.expectations.get(index) else { continue };
        let kind = if expectation.verdict == Verdict::Fail { "error" } else { "warning" };
        let title = format!("{}: {}", scenario.file, shown::verdict(expectation));
        let value = shown::value(expectation).unwrap_or_else(|| "no value".to_owned());
        let mut message = format!("{} {}, found {value}", evidence::key(scenario, index), shown::limit(expectation));
        if let Some(requirement) = &expectation.requirement {
            let _ = write!(message, ", requirement {requirement}");
        }
        if let Some(reason) = &expectation.reason {
            let _ = write!(message, "\n{reason}");
        }
        text += &command(kind, place(scenario, Some(index)).as_ref(), &title, &message);
    }
    for scenario in &record.scenarios {
        if let Some(doubt) = evidence::doubt_of(scenario) {
            text += &command(kind_of(scenario.verdict), place(scenario, None).as_ref(), &scenario.file, doubt);
        }
    }
    if let Some(doubt) = evidence::doubt(record) {
        text += &command(kind_of(record.verdict), None, "platebench", doubt);
    }
    text
}

fn kind_of(verdict: Verdict) -> &'static str {
    if verdict == Verdict::Fail { "error" } else { "warning" }
}

fn command(kind: &str, place: Option<&Place>, title: &str, message: &str) -> String {
    let place = place.map_or_else(String::new, |Place { file, line }| format!("file={},line={line},", property(file)));
    format!("::{kind} {place}title={}::{}\n", property(title), data(message))
}

/// A message as a workflow command holds it.
fn data(text: &str) -> String {
    text.replace('%', "%25").replace('\r', "%0D").replace('\n', "%0A")
}

/// A property as a workflow command holds it.
fn property(text: &str) -> String {
    data(text).replace(':', "%3A").replace(',', "%2C")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nothing_in_a_text_ends_a_command_or_begins_another() {
        let place = Place { file: "a,b:c%.toml".to_owned(), line: 7 };
        assert_eq!(
            command("error", Some(&place), "t: 1,2\n", "5 % off\r\n::error::x, y: z"),
            "::error file=a%2Cb%3Ac%25.toml,line=7,title=t%3A 1%2C2%0A::5 %25 off%0D%0A::error::x, y: z\n"
        );
        assert_eq!(command("warning", None, "t", "m"), "::warning title=t::m\n");
    }
}
