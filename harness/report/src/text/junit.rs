//! Writes `junit.xml`: a test suite per scenario, a test case per expectation.
//!
//! An inconclusive expectation is an `error`, because readers count `skipped` as harmless. A run or
//! scenario that did not pass although its expectations did has one more case. The
//! schema of Jenkins' xunit plugin (`tests/report/junit-10.xsd`) allows properties of suites only,
//! so requirements are properties `requirement.<name>` of the suite, the controller and its setting
//! are its property `tested`, and other facts are lines in `system-out`. Times come from the
//! record: equal records in equal folders give equal files.

use crate::record_queries::OwnVerdict;
use crate::{format, record_queries};
use platebench_model::printable::printable;
use platebench_model::record::{ExpectationRecord, NotApplicable, RunRecord, ScenarioRecord, Verdict};
use platebench_model::trace::{AtPath, FileError, write_atomically};
use quick_junit::{NonSuccessKind, Report, TestCase, TestCaseStatus, TestSuite};
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::time::Duration;
use std::{env, io, iter};

pub const FILE: &str = "junit.xml";

pub fn write(record: &RunRecord, path: &Path) -> Result<(), FileError> {
    let folder = from_workspace(path.parent().unwrap_or(Path::new("")));
    let text = junit_report(&record.with_traces_below(&folder)).to_string().map_err(io::Error::other).at(path)?;
    let expectations: usize = record.scenarios.iter().map(|scenario| scenario.not_applicable.len()).sum();
    let skipped = record_queries::skipped_scenarios(record).len() + expectations;
    // The schema allows no attribute `skipped` of the element `testsuites`.
    let text = text.replacen(&format!(" skipped=\"{skipped}\""), "", 1);
    write_atomically(path, text.as_bytes()).at(path)
}

/// Path of a folder relative to the working directory, which is the workspace of a CI job. Jenkins
/// reads the paths of attachments from there.
fn from_workspace(folder: &Path) -> PathBuf {
    let current = env::current_dir().unwrap_or_default();
    folder.strip_prefix(current).unwrap_or(folder).to_owned()
}

fn junit_report(record: &RunRecord) -> Report {
    let mut report = Report::new(record.tool.name.as_str());
    let classes = class_names(record);
    let class_of = |file: &String| classes.get(file).map_or("", String::as_str);
    report.add_test_suites(
        record.scenarios.iter().map(|scenario| test_suite(scenario, class_of(&scenario.file), record)),
    );
    let skipped = record_queries::skipped_scenarios(record).iter();
    report.add_test_suites(skipped.map(|scenario| {
        let case = skipped_case("not applicable", class_of(&scenario.file), &scenario.reason);
        not_applicable_suite(scenario, case, record)
    }));
    let required = record_queries::required_not_applicable(record).iter();
    report.add_test_suites(required.map(|scenario| {
        let case =
            case_of("not applicable", class_of(&scenario.file), Verdict::Fail, &format::not_applicable(scenario));
        not_applicable_suite(scenario, case, record)
    }));
    let Some(OwnVerdict { verdict, reason }) = record_queries::own_verdict_of_run(record) else { return report };
    let mut suite = TestSuite::new("run");
    suite.add_test_case(case_of("the whole run", "run", verdict, &reason));
    report.add_test_suite(suite);
    report
}

/// Jenkins' schema allows `file` and `timestamp` as attributes of a suite only.
fn suite_of_file(file: &str, record: &RunRecord) -> TestSuite {
    let mut suite = TestSuite::new(printable(file).as_ref());
    suite.extra.insert("file".into(), printable(file).as_ref().into());
    suite.extra.insert("timestamp".into(), printable(&record.started).as_ref().into());
    suite.add_property(("tested", format::tested(record).as_str()));
    suite
}

fn test_suite(scenario: &ScenarioRecord, class: &str, record: &RunRecord) -> TestSuite {
    let mut suite = suite_of_file(&scenario.file, record);
    suite.add_properties([
        ("title", printable(&scenario.title).as_ref()),
        ("law", printable(&scenario.law).as_ref()),
        ("model", scenario.model.as_str()),
        ("trials", scenario.trials.len().to_string().as_str()),
    ]);
    if let Some(source) = &scenario.source {
        suite.add_property(("source", printable(source).as_ref()));
    }
    for expectation in &scenario.expectations {
        if let Some(requirement) = &expectation.requirement {
            let name = format!("requirement.{}", printable(&expectation.name));
            suite.add_property((name.as_str(), printable(requirement).as_ref()));
        }
    }
    let wall: Option<f64> = scenario.trials.iter().map(|trial| trial.wall_ms).sum();
    let time = wall.and_then(|ms| Duration::try_from_secs_f64(ms / 1e3).ok());
    if let Some(time) = time {
        suite.set_time(time);
    }
    let count = scenario.expectations.len();
    // All expectations judge the same trials, so each gets an equal share of the scenario's time.
    let share = time.zip(u32::try_from(count).ok()).and_then(|(time, count)| time.checked_div(count));
    suite.add_test_cases((0..count).filter_map(|index| test_case(scenario, class, index, share)));
    let skipped = scenario.not_applicable.iter();
    suite.add_test_cases(skipped.map(|skipped| skipped_case(&skipped.name, class, &skipped.reason)));
    let scripts = scenario.trials.iter().flat_map(|trial| &trial.telemetry.scripts_not_played).map(String::as_str);
    suite.add_test_cases(
        format::distinct(scripts).into_iter().map(|script| {
            skipped_case(&format!("script: {script}"), class, "not played; `run --long-scripts` plays it")
        }),
    );
    if let Some(OwnVerdict { verdict, reason }) = record_queries::own_verdict_of_scenario(scenario) {
        suite.add_test_case(case_of("the whole scenario", class, verdict, &reason));
    }
    suite
}

fn not_applicable_suite(scenario: &NotApplicable, case: TestCase, record: &RunRecord) -> TestSuite {
    let mut suite = suite_of_file(&scenario.file, record);
    suite.add_property(("title", printable(&scenario.title).as_ref()));
    suite.add_test_case(case);
    suite
}

fn skipped_case(name: &str, class: &str, reason: &str) -> TestCase {
    let mut status = TestCaseStatus::skipped();
    status.set_message(printable(reason).as_ref());
    let mut case = TestCase::new(printable(name).as_ref(), status);
    case.set_classname(class);
    case
}

/// Class names by file.
type ClassNames = BTreeMap<String, String>;

/// Jenkins splits a class name at its last dot, so dots become `_`. A class name that another file
/// has already gets a number, in the order of the files.
fn class_names(record: &RunRecord) -> ClassNames {
    let played = record.scenarios.iter().map(|scenario| &scenario.file);
    let files: BTreeSet<&String> = played.chain(record.not_applicable.iter().map(|scenario| &scenario.file)).collect();
    let mut used = BTreeSet::new();
    let class_of = |file: &String| {
        let class = printable(file.strip_suffix(".toml").unwrap_or(file)).replace('.', "_");
        let numbered = (2..).map(|number| format!("{class} {number}"));
        let free = iter::once(class.clone()).chain(numbered).find(|name| used.insert(name.clone()));
        (file.clone(), free.unwrap_or_default())
    };
    // Names without dots come first, because they keep their class.
    let (dotted, plain): (Vec<_>, Vec<_>) =
        files.into_iter().partition(|file| file.strip_suffix(".toml").unwrap_or(file).contains('.'));
    plain.into_iter().chain(dotted).map(class_of).collect()
}

/// The only place that turns a verdict into a status.
fn status_of(verdict: Verdict, kind: &str, text: &str) -> TestCaseStatus {
    let mut status = match verdict {
        Verdict::Pass => return TestCaseStatus::success(),
        Verdict::Fail => TestCaseStatus::non_success(NonSuccessKind::Failure),
        Verdict::Inconclusive => TestCaseStatus::non_success(NonSuccessKind::Error),
    };
    // GitLab displays the description.
    status.set_type(kind).set_message(text.replace('\n', "; ")).set_description(text);
    status
}

fn case_of(name: &str, class: &str, verdict: Verdict, reason: &str) -> TestCase {
    let mut case = TestCase::new(name, status_of(verdict, verdict.name(), &printable(reason)));
    case.set_classname(class);
    case
}

fn test_case(scenario: &ScenarioRecord, class: &str, index: usize, time: Option<Duration>) -> Option<TestCase> {
    let expectation = scenario.expectations.get(index)?;
    let text = failure_text(expectation, record_queries::protocol_differences(scenario, index));
    let status = status_of(expectation.verdict, &format::verdict(expectation), &text);
    let mut case = TestCase::new(printable(&expectation.name).as_ref(), status);
    case.set_classname(class);
    if let Some(time) = time {
        case.set_time(time);
    }
    let trial = record_queries::trial_to_inspect(scenario, index).or_else(|| scenario.trials.first());
    let properties = [
        ("requirement", expectation.requirement.clone()),
        ("value", expectation.value.map(|value| value.to_string())),
        ("limit", Some(format::limit(expectation))),
        ("window", format::windows(expectation)),
        ("interval", expectation.interval.map(|[low, high]| format!("{low} {high}"))),
        ("confidence", expectation.confidence.map(|confidence| confidence.to_string())),
        ("evidence", format::evidence(expectation)),
        ("cause", expectation.cause.map(|cause| cause.to_string())),
        ("paper", expectation.paper.map(|paper| paper.to_string())),
        ("seed", trial.map(|trial| trial.seed.to_string())),
        ("trace", trial.map(|trial| trial.trace.clone())),
    ];
    let lines = properties.into_iter().filter_map(|(name, value)| Some(format!("{name}: {}\n", printable(&value?))));
    // Jenkins links the attached file to the test case.
    let attachment = trial.map(|trial| format!("[[ATTACHMENT|{}]]\n", printable(&trial.trace)));
    case.set_system_out(lines.chain(attachment).collect::<String>());
    Some(case)
}

fn failure_text(expectation: &ExpectationRecord, differences: &[String]) -> String {
    let facts = [Some(format::summary(expectation)), expectation.reason.as_ref().map(ToString::to_string)];
    let facts = facts.into_iter().flatten().chain(differences.iter().cloned());
    let lines: Vec<_> = facts.map(|fact| printable(&fact).into_owned()).collect();
    lines.join("\n")
}
