//! `platebench judge` and `platebench report`: stored runs.

use crate::args::{Judge, Report};
use crate::exit::Exit;
use crate::output;
use platebench_report::{html, traceability};
use platebench_runner::{RejudgeError, rejudge};
use platebench_verdict::RunRecord;

/// Judges the traces of a stored run again.
pub(crate) fn judge(arguments: &Judge) -> Exit {
    let record = match rejudge(&arguments.run, arguments.scenario.as_deref()) {
        Ok(record) => record,
        Err(error) => return explain(&error),
    };
    output::record(&record, arguments.format);
    if arguments.scenario.is_none() {
        compare_with_stored(arguments, &record);
    }
    Exit::of_record(&record)
}

/// Says where the traces tell another story than the record beside them.
fn compare_with_stored(arguments: &Judge, again: &RunRecord) {
    let Ok(stored) = RunRecord::read(&arguments.run) else { return };
    if !stored.complete {
        output::note("the run was cut off; judged is what was whole by then");
        return;
    }
    for (then, now) in stored.scenarios.iter().zip(&again.scenarios) {
        for (before, after) in then.expectations.iter().zip(&now.expectations) {
            if before.verdict != after.verdict {
                let (file, metric) = (&then.file, &before.metric);
                output::note(&format!("{file}: {metric}: {} now, {} in the record", after.verdict, before.verdict));
            }
        }
    }
}

/// Renders the report of a stored run.
pub(crate) fn report(arguments: &Report) -> Exit {
    let record = match RunRecord::read(&arguments.run) {
        Ok(record) if record.complete => Ok(record),
        // A run that was cut off has traces that nobody has judged yet.
        Ok(_) => rejudge(&arguments.run, None),
        Err(error) => Err(error.into()),
    };
    let record = match record {
        Ok(record) => record,
        Err(error) => return explain(&error),
    };
    let written = html::write(&record, &arguments.run).and_then(|()| traceability::write(&record, &arguments.run));
    match written {
        Ok(()) => {
            output::show(&format!("{}\n", arguments.run.join("report.html").display()));
            Exit::Passed
        }
        Err(error) => {
            output::error(&error.to_string());
            Exit::Invalid
        }
    }
}

fn explain(error: &RejudgeError) -> Exit {
    match error {
        RejudgeError::Scenario(diagnostic) => output::diagnostic(diagnostic),
        error => output::error(&error.to_string()),
    }
    Exit::Invalid
}
