//! `junit.xml`: what continuous integration reads.
//!
//! A test suite per scenario, a test case per expectation. A failed expectation is a `failure`. An inconclusive one is
//! an `error`, not `skipped`: JUnit knows no third outcome, readers of the format show a skipped test as harmless, and
//! a suite that could not demonstrate what it was asked to must not turn a build green. `error` is also the right word
//! for most of it: what went wrong was the bench, the rig or the demand, and the type says which. For the same reason
//! a run or a scenario that did not pass although every expectation in it did (it was cut short, or there was nothing
//! to judge) holds one more case with an error.
//!
//! The file keeps to the schema that Jenkins' xunit plugin checks (`tests/report/junit-10.xsd`). That knows properties
//! of a suite only, so requirements stand there, as `requirement.<metric>`; what else there is to know of a case stands
//! in its `system-out`, a line each, which is what readers show beside it.
//!
//! Neighbours: the record is read, `quick-junit` writes. Times are those of the record, so that equal records give
//! equal files.

use crate::error::ReportError;
use crate::{evidence, shown};
use platebench_verdict::{RunRecord, ScenarioRecord, Verdict};
use quick_junit::{NonSuccessKind, Report, TestCase, TestCaseStatus, TestSuite};
use std::fs;
use std::path::Path;
use std::time::Duration;

/// The file's name in a run folder.
pub const FILE: &str = "junit.xml";

/// Writes the run as JUnit XML to `path`, replacing what is there.
///
/// # Errors
/// [`ReportError`] where the file cannot be written.
pub fn write(record: &RunRecord, path: &Path) -> Result<(), ReportError> {
    let text = report(record).to_string().map_err(|source| ReportError::Junit { path: path.to_owned(), source })?;
    // The schema has no such attribute for all suites together, and nothing is ever skipped.
    fs::write(path, text.replacen(" skipped=\"0\"", "", 1)).map_err(ReportError::io(path))
}

fn report(record: &RunRecord) -> Report {
    let mut report = Report::new(record.tool.name.as_str());
    report.add_test_suites(record.scenarios.iter().map(suite));
    let Some(doubt) = evidence::doubt(record) else { return report };
    let mut suite = TestSuite::new("run");
    suite.add_test_case(doubtful("the whole run", "run", doubt));
    report.add_test_suite(suite);
    report
}

fn suite(scenario: &ScenarioRecord) -> TestSuite {
    let mut suite = TestSuite::new(scenario.file.as_str());
    suite.add_properties([
        ("title", scenario.title.as_str()),
        ("law", scenario.law.as_str()),
        ("model", scenario.model.as_str()),
        ("trials", scenario.trials.len().to_string().as_str()),
    ]);
    if let Some(source) = &scenario.source {
        suite.add_property(("source", source.as_str()));
    }
    for (index, expectation) in scenario.expectations.iter().enumerate() {
        if let Some(requirement) = &expectation.requirement {
            let name = format!("requirement.{}", evidence::key(scenario, index));
            suite.add_property((name.as_str(), requirement.as_str()));
        }
    }
    let wall: Option<f64> = scenario.trials.iter().map(|trial| trial.wall_ms).sum();
    if let Some(time) = wall.and_then(|ms| Duration::try_from_secs_f64(ms / 1e3).ok()) {
        suite.set_time(time);
    }
    suite.add_test_cases((0..scenario.expectations.len()).filter_map(|index| case(scenario, index)));
    if let Some(what) = evidence::doubt_of(scenario) {
        suite.add_test_case(doubtful("the whole scenario", &scenario.file, what));
    }
    suite
}

/// A case that is not any expectation's and does not pass.
fn doubtful(name: &str, class: &str, what: &str) -> TestCase {
    let mut status = TestCaseStatus::non_success(NonSuccessKind::Error);
    status.set_type(Verdict::Inconclusive.name()).set_message(what);
    let mut case = TestCase::new(name, status);
    case.set_classname(class);
    case
}

fn case(scenario: &ScenarioRecord, index: usize) -> Option<TestCase> {
    let expectation = scenario.expectations.get(index)?;
    let kind = match expectation.verdict {
        Verdict::Pass => None,
        Verdict::Fail => Some(NonSuccessKind::Failure),
        Verdict::Inconclusive => Some(NonSuccessKind::Error),
    };
    let status = kind.map_or_else(TestCaseStatus::success, |kind| {
        let mut status = TestCaseStatus::non_success(kind);
        status.set_type(shown::verdict(expectation));
        if let Some(reason) = &expectation.reason {
            status.set_message(reason.as_str());
        }
        status
    });
    let limit = shown::limit(expectation);
    let mut case = TestCase::new(format!("{} {limit}", evidence::key(scenario, index)), status);
    case.set_classname(scenario.file.as_str());
    let trial = evidence::trial(scenario, index).or_else(|| scenario.trials.first());
    let properties = [
        ("requirement", expectation.requirement.clone()),
        ("value", expectation.value.map(|value| value.to_string())),
        ("limit", Some(limit)),
        ("interval", expectation.interval.map(|[low, high]| format!("{low} {high}"))),
        ("confidence", expectation.confidence.map(|confidence| confidence.to_string())),
        ("evidence", shown::evidence(expectation)),
        ("cause", expectation.cause.map(|cause| cause.to_string())),
        ("paper", expectation.paper.map(|paper| paper.to_string())),
        ("seed", trial.map(|trial| trial.seed.to_string())),
        ("trace", trial.map(|trial| trial.trace.clone())),
    ];
    let lines = properties.into_iter().filter_map(|(name, value)| Some(format!("{name}: {}\n", value?)));
    case.set_system_out(lines.collect::<String>());
    Some(case)
}
