//! `platebench judge` and `platebench report`: stored runs.

use crate::args::{Judge, Report};
use crate::exit::Exit;
use crate::output;
use platebench_report::html::{self, Page};
use platebench_report::traceability;
use platebench_runner::rejudge::trace_unchanged;
use platebench_runner::{RejudgeError, rejudge};
use platebench_verdict::RunRecord;
use std::path::Path;

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

/// Renders the report of a stored run, or of two side by side.
pub(crate) fn report(arguments: &Report) -> Exit {
    let both = || {
        let record = whole(&arguments.run)?;
        let other = arguments.against.as_deref().map(|folder| whole(folder).map(|other| (folder, other)));
        Ok((record, other.transpose()?))
    };
    let (record, other) = match both() {
        Ok(records) => records,
        Err(error) => return explain(&error),
    };
    let page = Page::new(&record, &arguments.run).with_baselines(&arguments.baselines).with_earlier_runs();
    let page = page.without_changed_traces(|folder, trial| {
        matches!(trace_unchanged(folder, trial), Err(RejudgeError::Changed { .. }))
    });
    let (page, name) = match &other {
        Some((folder, other)) => (page.against(other, folder), html::COMPARISON_FILE),
        None => (page, html::FILE),
    };
    let path = arguments.run.join(name);
    match page.write(&path).and_then(|()| traceability::write(&record, &arguments.run)) {
        Ok(()) => {
            output::show(&format!("{}\n", path.display()));
            Exit::Passed
        }
        Err(error) => {
            output::error(&error.to_string());
            Exit::Invalid
        }
    }
}

/// The record in `folder`. A run that was cut off has traces that nobody has judged yet; where one was changed since, what had been judged by then is all there is.
fn whole(folder: &Path) -> Result<RunRecord, RejudgeError> {
    let record = RunRecord::read(folder)?;
    if record.complete {
        return Ok(record);
    }
    match rejudge(folder, None) {
        Err(changed @ RejudgeError::Changed { .. }) => {
            output::note(&format!("{changed}; shown is what had been judged when the run was cut off"));
            Ok(record)
        }
        judged => judged,
    }
}

fn explain(error: &RejudgeError) -> Exit {
    match error {
        RejudgeError::Scenario(diagnostic) => output::diagnostic(diagnostic),
        error => output::error(&error.to_string()),
    }
    Exit::Invalid
}
