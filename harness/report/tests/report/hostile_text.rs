//! Tests every report with ESC, right-to-left override, a workflow command and a formula.

use crate::fixtures;
use platebench_document::Style;
use platebench_model::record::{Event, MissingValue, Reason, RunRecord, TrialFinding};
use platebench_report::events::{EventWriter, run_finished};
use platebench_report::{Progress, console, github, junit, page, traceability};
use rstest::rstest;
use std::fs;
use std::io::{self, Write};
use std::sync::{Arc, Mutex};

const HOSTILE: &str = "=1\u{1b}[2J\u{202e}\u{9b}31m\n::error::x";

fn hostile_run() -> RunRecord {
    let mut record = fixtures::mixed_run();
    let hostile = || HOSTILE.to_owned();
    HOSTILE.clone_into(&mut record.rig.name);
    for scenario in &mut record.scenarios {
        (scenario.file, scenario.title, scenario.law, scenario.source) =
            (hostile(), hostile(), hostile(), Some(hostile()));
        for expectation in &mut scenario.expectations {
            expectation.requirement = Some(hostile());
            expectation.reason = expectation.reason.as_ref().map(|_| Reason::Trial {
                trial: 0,
                divergence: None,
                finding: TrialFinding::Missing(MissingValue::NotRunning),
                ended: Some(hostile()),
                stopped: Some(hostile()),
            });
        }
        scenario.trials.iter_mut().for_each(|trial| trial.trace = hostile());
    }
    record
}

#[derive(Clone, Default)]
pub(crate) struct SharedBuffer(Arc<Mutex<Vec<u8>>>);

impl Write for SharedBuffer {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.0.lock().unwrap().write(bytes)
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

pub(crate) fn written(write: impl FnOnce(SharedBuffer)) -> String {
    let buffer = SharedBuffer::default();
    write(buffer.clone());
    String::from_utf8(buffer.0.lock().unwrap().clone()).unwrap()
}

fn file(write: impl FnOnce(&std::path::Path)) -> String {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("report");
    write(&path);
    fs::read_to_string(path).unwrap()
}

#[rstest]
#[case::console(|record: &RunRecord| console::run_table(record, Style::default()))]
#[case::markdown(|record: &RunRecord| github::render_page(record))]
#[case::annotations(|record: &RunRecord| github::workflow_commands(record, &|_, _| None))]
#[case::traceability(|record: &RunRecord| traceability::requirement_document(record).to_csv())]
#[case::junit(|record: &RunRecord| file(|path| junit::write(record, path).unwrap()))]
#[case::page(|record: &RunRecord| file(|path| {
    page::ReportPage::new(record, path.parent().unwrap()).write(path).unwrap();
}))]
#[case::events(|record: &RunRecord| written(|out| {
    let mut events = EventWriter::new(out);
    events.write(&Event::scenario_finished(&record.scenarios[1]));
    events.write(&run_finished(None, Some(HOSTILE), 2));
}))]
#[case::progress(|record: &RunRecord| written(|out| {
    let mut progress = Progress::to_writer(out);
    progress.show(&Event::ScenarioStarted { scenario: HOSTILE.to_owned(), trials: 1 });
    progress.show(&Event::scenario_finished(&record.scenarios[1]));
}))]
fn no_text_acts_on_a_terminal_a_ci_system_or_a_spreadsheet(#[case] render: fn(&RunRecord) -> String) {
    let text = render(&hostile_run());
    assert!(text.contains("error"), "the texts are there: {text}");
    for character in ['\u{1b}', '\u{9b}', '\u{202e}'] {
        assert!(!text.contains(character), "{character:?} in {text:?}");
    }
    // In HTML a line feed is a space, so no line can start a workflow command.
    let is_command = |line: &str| line.trim_start().starts_with("::") && !line.contains("title=");
    assert!(text.starts_with("<!DOCTYPE html>") || !text.lines().any(is_command), "{text}");
    assert!(!text.lines().flat_map(|line| line.split(',')).any(|field| field.starts_with('=')), "{text}");
}

#[test]
fn a_name_cannot_forge_the_line_of_what_was_tested() {
    let mut record = fixtures::mixed_run();
    record.rig.firmware.as_mut().unwrap().name = "ok; rig emulated".to_owned();
    record.rig.name = "exec:x {port}; clock real-time".to_owned();
    let expected = "\"ok; rig emulated\" 0.1.0, build 5f3a9c01; rig \"exec:x {port}; clock real-time\"; clock lockstep";
    let text = console::run_table(&record, Style::default());
    assert!(text.starts_with(&format!("tested: {expected}; ")), "{text}");
    assert!(github::render_page(&record).contains("Tested: \"ok; rig emulated\" 0.1.0"));
    let junit = file(|path| junit::write(&record, path).unwrap());
    assert!(junit.contains("value=\"&quot;ok; rig emulated&quot; 0.1.0"), "{junit}");
}
