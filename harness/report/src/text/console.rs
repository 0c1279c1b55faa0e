//! Writes a run for a terminal: tables, summary and progress.

use crate::record_queries::{CauseGroup, OwnVerdict};
use crate::text::timing;
use crate::{format, record_queries};
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use platebench_document::{Cell, Style, Table};
use platebench_model::printable::printable;
use platebench_model::record::{
    Cause, CostTrend, Event, ExpectationRecord, RunRecord, ScenarioRecord, Verdict, VerdictCounts,
};
use platebench_model::scenario::NotApplicableExpectation;
use platebench_model::{quoted, quoted_path};
use std::fmt::Write as _;
use std::io::IsTerminal as _;
use std::io::{self, Write};
use std::path::Path;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread;
use std::time::{Duration, Instant};

#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Detail {
    /// Lists what did not pass; empty if everything passed.
    Failures,
    #[default]
    Summary,
    Tables,
}

pub fn run_text(record: &RunRecord, style: Style, detail: Detail) -> String {
    let mut text = String::new();
    match detail {
        Detail::Failures if record.verdict == Verdict::Pass => {}
        Detail::Failures => {
            write_tested(&mut text, record, style);
            write_not_passed(&mut text, record, style);
        }
        Detail::Summary => {
            write_tested(&mut text, record, style);
            write_summary(&mut text, record, style, false);
        }
        Detail::Tables => {
            write_tested(&mut text, record, style);
            text.push('\n');
            for scenario in &record.scenarios {
                write_heading(&mut text, scenario, style);
                write_expectations(&mut text, scenario, style);
                text.push('\n');
            }
            write_summary(&mut text, record, style, true);
        }
    }
    text
}

pub fn run_table(record: &RunRecord, style: Style) -> String {
    run_text(record, style, Detail::Tables)
}

/// Prints `text`. A closed pipe is no error.
pub fn print(text: &str, out: &mut dyn Write) -> io::Result<()> {
    match writeln!(out, "{}", text.trim_end()).and_then(|()| out.flush()) {
        Err(error) if error.kind() == io::ErrorKind::BrokenPipe => Ok(()),
        result => result,
    }
}

fn write_tested(text: &mut String, record: &RunRecord, style: Style) {
    style.write_wrapped_on_terminals(text, "tested: ", "  ", &format::tested(record));
}

fn write_heading(text: &mut String, scenario: &ScenarioRecord, style: Style) {
    let verdict = format!("{} {}", format::sign(scenario.verdict), scenario.verdict);
    let trials = format::count(scenario.trials.len(), "trial");
    let file = quoted_path(Path::new(&scenario.file));
    // The other models are exact and are not mentioned.
    let is_simplified = matches!(scenario.model.as_str(), "linear" | "envelope");
    let model = if is_simplified { format!("model {}, ", scenario.model) } else { String::new() };
    let details = format!("(law {}, {model}{trials})", quoted(&scenario.law));
    let columns = [&verdict, &file, &details].map(|part| part.chars().count() + 2).iter().sum::<usize>() - 2;
    let gap = if style.width.is_some_and(|width| columns > width) { "\n  " } else { "  " };
    let (verdict, file) = (style.paint_verdict(scenario.verdict, &verdict), style.paint("1", &file));
    let _ = writeln!(text, "{verdict}  {file}{gap}{details}");
    style.write_wrapped(text, "  ", "  ", &scenario.title);
    if let Some(sentence) = timing::summary(scenario) {
        style.write_wrapped(text, "  ", "  ", &sentence);
    }
}

fn write_expectations(text: &mut String, scenario: &ScenarioRecord, style: Style) {
    if scenario.expectations.is_empty() {
        text.push_str("  no expectation was judged\n");
        return;
    }
    let dash = || "–".to_owned();
    let has_paper = scenario.expectations.iter().any(|expectation| expectation.paper.is_some());
    let columns = ["metric", "verdict", "value", "limit", "interval", "window"].into_iter();
    let mut table = Table::new(columns.chain(has_paper.then_some("paper")));
    for expectation in &scenario.expectations {
        let mut row = vec![
            Cell::from(expectation.name.as_str()),
            Cell::from(format::verdict(expectation)).with_verdict(expectation.verdict),
            format::value_or_not_reached(expectation).unwrap_or_else(dash).into(),
            format::limit(expectation).into(),
            format::interval(expectation).unwrap_or_else(dash).into(),
            format::windows(expectation).unwrap_or_else(dash).into(),
        ];
        row.extend(has_paper.then(|| Cell::from(expectation.paper.map_or_else(dash, format::number))));
        table.rows.push(row);
    }
    text.push('\n');
    for line in table.console_lines(style.width.map(|width| width.saturating_sub(2)), style) {
        let _ = writeln!(text, "  {line}");
    }
    for expectation in &scenario.expectations {
        if let Some(reason) = &expectation.reason {
            style.write_wrapped(text, "  ↳ ", "    ", &format!("{}: {reason}", expectation.name));
        }
    }
    for NotApplicableExpectation { name, reason, .. } in &scenario.not_applicable {
        style.write_wrapped(text, "  not applicable: ", "    ", &format!("{name}: {reason}"));
    }
}

/// Longest list without `-v`.
const MAX_LISTED: usize = 3;

/// `in_full` lists every scenario that is not applicable and the cost of every law.
fn write_summary(text: &mut String, record: &RunRecord, style: Style, in_full: bool) {
    write_not_applicable(text, record, style, in_full);
    for (name, counts) in [("scenario", record.scenario_counts()), ("expectation", record.expectation_counts())] {
        let _ = writeln!(text, "{}: {counts}", format::count(counts.total(), name));
    }
    if let Some(duration) = record.wall_ms {
        let _ = writeln!(text, "duration: {}", format::duration(duration));
    }
    if let Some((scenario, wall_ms)) = record_queries::slowest_scenario(record) {
        let trials = format::count(scenario.trials.len(), "trial");
        let slowest = format!("{}, {} in {trials}", scenario.file, format::duration(wall_ms));
        style.write_wrapped(text, "slowest scenario: ", "  ", &slowest);
    }
    if let Some((scenario, expectation, margin)) = record_queries::smallest_margin(record) {
        let result = format!("{}: {}", scenario.file, result(expectation));
        let margin = format!("smallest margin: {} %, ", format::number(margin * 100.0));
        style.write_wrapped(text, &margin, "  ", &result);
    }
    write_cost(text, &record.cost, style, in_full);
    if let Some(overrides) = format::overrides(record) {
        style.write_wrapped(text, "", "  ", &format!("overridden: {overrides}"));
    }
    write_time_limits(text, record, style, in_full);
    write_scripts_not_played(text, record, style);
    write_verdict(text, record, style);
    write_list_of_not_passed(text, record, style, in_full);
    write_hints(text, record, style, in_full);
}

/// Slowest `--time-scale`.
const SLOWEST_TIME_SCALE: f64 = 0.001;

/// Hints stand at the end, where a reader of a terminal sees them.
fn write_hints(text: &mut String, record: &RunRecord, style: Style, in_full: bool) {
    let tight = record_queries::tight_steps(record).into_iter();
    let tight: Vec<_> = tight.map(|(scenario, percent)| timing::describe_tight_step(scenario, percent)).collect();
    write_warnings(text, &tight, "a long control step", style, in_full);
    let symptoms = if in_full {
        record_queries::symptoms(record).map(|found| (found, 0)).collect()
    } else {
        record_queries::symptom_groups(record)
    };
    for ((scenario, trial, symptom), further) in symptoms {
        let others =
            if further > 0 { format!(" and {}", format::count(further, "more scenario")) } else { String::new() };
        let symptom = format::symptom(scenario, trial, symptom);
        style.write_wrapped(text, "warning: ", "  ", &format!("{}{others}: {symptom}", scenario.file));
    }
    if let Some(scale) = record_queries::late_time_scale(record) {
        let hint = format!(
            "with a slower --time-scale, for example {}, bench and line have more time per period; with --clock \
             lockstep time waits for each answer",
            format::number((scale / 10.0).max(SLOWEST_TIME_SCALE))
        );
        style.write_wrapped(text, "hint: ", "  ", &hint);
    }
    if let Some(instances) = record_queries::unmodelled_instances(record) {
        let hint = format!("the emulated chip has no model of {instances}: the writes changed nothing");
        style.write_wrapped(text, "hint: ", "  ", &hint);
    }
    let elf = record.rig.name.strip_prefix("emulated:").unwrap_or("ELF");
    if let Some(command) = record_queries::defmt_command(elf, &record.scenarios) {
        style.write_wrapped(
            text,
            "hint: ",
            "  ",
            &format!("the firmware logs by defmt; to read its messages: {command}"),
        );
    }
    if let Some(delay_ms) = record_queries::server_delay_ms(record) {
        let hint = format!(
            "every answer takes about {delay_ms:.1} ms, as behind a ser2net that collects characters, at any baud rate: \
             set `chardelay: false` in its connection"
        );
        style.write_wrapped(text, "hint: ", "  ", &hint);
    }
}

fn write_time_limits(text: &mut String, record: &RunRecord, style: Style, in_full: bool) {
    let ended = record.scenarios.iter().filter(|scenario| scenario.time_limit_s.is_some());
    let ended: Vec<_> = ended.map(|scenario| scenario.file.as_str()).collect();
    if ended.is_empty() {
        return;
    }
    let listed = if in_full { ended.len() } else { ended.len().min(MAX_LISTED) };
    let further = ended.len() - listed;
    let further = if further > 0 { format!(", and {further} more: -v lists them") } else { String::new() };
    let files = ended.iter().take(listed).copied().collect::<Vec<_>>().join(", ");
    let scenarios = format::count(ended.len(), "scenario");
    style.write_wrapped(text, "time limit reached: ", "  ", &format!("{scenarios}: {files}{further}"));
}

/// A script that was not played is no pass, even if the verdict is.
fn write_scripts_not_played(text: &mut String, record: &RunRecord, style: Style) {
    if let Some(scripts) = record_queries::scripts_not_played(record) {
        style.write_wrapped(text, "not played: ", "  ", &scripts);
    }
}

/// Reason of the verdict in one line. The verdict may be that of an interrupted run.
pub fn verdict_reason(record: &RunRecord) -> String {
    let lost = record.scenarios.iter().flat_map(|scenario| &scenario.trials).find_map(|trial| {
        let ended = trial.telemetry.ended.as_ref().filter(|_| trial.cause == Some(Cause::Rig))?;
        Some(format!("the controller was lost: {ended}"))
    });
    let reasons = record_queries::expectations_not_passed(record)
        .into_iter()
        .filter_map(|(scenario, index)| Some(result_and_reason(scenario.expectations.get(index)?)));
    let not_applicable = format::distinct(record.not_applicable.iter().map(|scenario| scenario.reason.as_str()));
    let not_applicable = not_applicable.into_iter().map(|reason| format!("not applicable: {reason}"));
    let own = record_queries::own_verdict_of_run(record).map(|own| own.reason);
    let all: Vec<String> = lost.into_iter().chain(own).chain(reasons).chain(not_applicable).collect();
    if all.is_empty() { "every expectation is met".to_owned() } else { all.join("; ") }
}

/// Results and reasons of the expectations that did not pass, in one line.
pub fn scenario_reason(scenario: &ScenarioRecord) -> Option<String> {
    let expectations =
        record_queries::indices_not_passed(scenario).filter_map(|index| scenario.expectations.get(index));
    let reasons: Vec<_> = expectations.map(result_and_reason).collect();
    (!reasons.is_empty()).then(|| reasons.join("; "))
}

fn result_and_reason(expectation: &ExpectationRecord) -> String {
    let reason = format::remaining_reason(expectation).map_or_else(String::new, |reason| format!(" ({reason})"));
    format!("{}{reason}", result(expectation))
}

fn write_not_passed(text: &mut String, record: &RunRecord, style: Style) {
    if record.scenarios.is_empty() {
        write_not_applicable(text, record, style, true);
    }
    write_time_limits(text, record, style, false);
    write_scripts_not_played(text, record, style);
    write_verdict(text, record, style);
    write_list_of_not_passed(text, record, style, false);
    write_hints(text, record, style, false);
}

fn write_not_applicable(text: &mut String, record: &RunRecord, style: Style, in_full: bool) {
    // The groups below contain the scenarios that do not apply to an own law, and the list of what
    // did not pass contains the scenarios that `--require-all` needs.
    let skipped = record_queries::skipped_scenarios(record);
    let listed: Vec<_> = skipped.iter().filter(|scenario| in_full || scenario.expectations == 0).collect();
    let groups = record_queries::not_applicable_groups(record);
    let lines = listed.iter().map(|scenario| format!("{}: {}", scenario.file, scenario.reason));
    let mut reasons: Vec<String> = lines.chain(groups.iter().map(format::not_applicable_group)).collect();
    if !in_full && reasons.len() > 1 {
        let expectations = groups.iter().map(|group| group.expectations).sum();
        let counts = [(skipped.len(), "scenario"), (expectations, "expectation")].into_iter();
        let counts = counts.filter(|(number, _)| *number > 0).map(|(number, one)| format::count(number, one));
        let counts = counts.collect::<Vec<_>>().join(" and ");
        let all = listed.iter().map(|scenario| scenario.reason.as_str()).chain(groups.iter().map(|group| group.reason));
        reasons = vec![match format::distinct(all).as_slice() {
            [reason] => format!("{counts}, listed with -v: {reason}"),
            _ => format!("{counts}; -v lists the reasons"),
        }];
    }
    for reason in reasons {
        style.write_wrapped(text, "not applicable: ", "  ", &reason);
    }
}

/// Unless `in_full`, lists the laws whose cost changed, or else the law with the highest cost.
fn write_cost(text: &mut String, trends: &[CostTrend], style: Style, in_full: bool) {
    let changed = |trend: &&CostTrend| in_full || timing::describe_change(trend).is_some();
    let mut listed: Vec<_> = trends.iter().filter(changed).collect();
    if listed.is_empty() {
        listed.extend(trends.iter().max_by(|a, b| a.cost.worst.total_cmp(&b.cost.worst)));
    }
    let further = if in_full { 0 } else { listed.len().saturating_sub(MAX_LISTED) };
    listed.truncate(listed.len() - further);
    for trend in listed {
        let _ = writeln!(text, "instructions per step: {}", timing::format_worst(trend));
        if let Some(change) = timing::describe_change(trend) {
            style.write_wrapped(text, "  ↳ ", "    ", &change);
        }
    }
    if further > 0 {
        let laws = format::count(further, "more law");
        let _ = writeln!(text, "instructions per step: {laws} with a change, listed with -v");
    }
}

/// Writes the first warnings and counts the others. `topic` names what they report.
fn write_warnings(text: &mut String, warnings: &[String], topic: &str, style: Style, in_full: bool) {
    let listed = if in_full { warnings.len() } else { MAX_LISTED };
    for warning in warnings.iter().take(listed) {
        style.write_wrapped(text, "warning: ", "  ", warning);
    }
    if warnings.len() > listed {
        let further = format::count(warnings.len() - listed, "more scenario");
        let _ = writeln!(text, "warning: {further} with {topic}, listed with -v");
    }
}

fn write_verdict(text: &mut String, record: &RunRecord, style: Style) {
    let verdict = format!("{} {}", format::sign(record.verdict), record.verdict);
    let note = format::bench_firmware_note(record);
    let mut line = String::new();
    style.write_wrapped_on_terminals(&mut line, "verdict: ", "  ", &format!("{verdict}{note}"));
    text.push_str(&line.replacen(&verdict, &style.paint_verdict(record.verdict, &verdict), 1));
}

/// Writes one entry per cause. `in_full` lists everything that has the cause.
fn write_list_of_not_passed(text: &mut String, record: &RunRecord, style: Style, in_full: bool) {
    let unplayed = record_queries::unplayed_scenarios(record);
    if !unplayed.is_empty() {
        let _ = writeln!(text, "not played after the first failure: {}", format::count(unplayed.len(), "scenario"));
    }
    let mut groups = record_queries::cause_groups(record);
    for group in &mut groups {
        group.members.retain(|(_, scenario, _)| !unplayed.contains(&scenario.file.as_str()));
    }
    groups.retain(|group| !group.members.is_empty());
    let missed = record_queries::required_not_applicable(record);
    let own = record_queries::own_verdict_of_run(record);
    if own.is_some() || !groups.is_empty() || !missed.is_empty() {
        text.push_str("\nnot passed:\n");
    }
    if let Some(OwnVerdict { verdict, reason }) = own {
        write_line_with_verdict(text, verdict, &format!("the whole run: {reason}"), style);
    }
    for scenario in missed {
        write_line_with_verdict(
            text,
            Verdict::Fail,
            &format!("{}: {}", scenario.file, format::not_applicable(scenario)),
            style,
        );
    }
    for group in &groups {
        write_group(text, group, style, in_full);
    }
}

fn write_group(text: &mut String, group: &CauseGroup<'_>, style: Style, in_full: bool) {
    let Some(&(_, scenario, index)) = group.members.first() else { return };
    let Some(expectation) = scenario.expectations.get(index) else { return };
    if group.members.len() == 1 {
        write_result(text, scenario, index, expectation, style);
        return;
    }
    let sign = style.paint_verdict(group.verdict, format::sign(group.verdict));
    let _ = writeln!(text, "  {sign} {}:", format::group_size(group));
    let first = format!("{}: {}", scenario.file, result(expectation));
    style.write_wrapped(text, "    first: ", "      ", &first);
    write_reason_and_trace(text, scenario, index, expectation, style);
    let names = |scenario: &ScenarioRecord, indices: &[usize]| {
        let names = indices.iter().filter_map(|index| Some(scenario.expectations.get(*index)?.name.as_str()));
        names.collect::<Vec<_>>().join(", ")
    };
    let scenarios = group.scenarios();
    let others: Vec<String> = match scenarios.as_slice() {
        [(_, only, indices)] => vec![names(only, indices.get(1..).unwrap_or_default())],
        all if in_full => {
            all.iter().map(|(_, scenario, of)| format!("{}: {}", scenario.file, names(scenario, of))).collect()
        }
        all => all.iter().skip(1).take(MAX_LISTED).map(|(_, scenario, _)| scenario.file.clone()).collect(),
    };
    if in_full {
        for line in &others {
            style.write_wrapped(text, "    also ", "      ", line);
        }
        return;
    }
    let further = scenarios.len().saturating_sub(1 + MAX_LISTED);
    let further = if further > 0 { format!(", and {further} more: -v lists them") } else { String::new() };
    style.write_wrapped(text, "    also ", "      ", &format!("{}{further}", others.join(", ")));
}

fn write_result(
    text: &mut String,
    scenario: &ScenarioRecord,
    index: usize,
    expectation: &ExpectationRecord,
    style: Style,
) {
    write_line_with_verdict(text, expectation.verdict, &format!("{}: {}", scenario.file, result(expectation)), style);
    write_reason_and_trace(text, scenario, index, expectation, style);
}

fn write_line_with_verdict(text: &mut String, verdict: Verdict, line: &str, style: Style) {
    let (mut lines, sign) = (String::new(), format::sign(verdict));
    style.write_wrapped(&mut lines, &format!("  {sign} "), "    ", line);
    text.push_str(&lines.replacen(sign, &style.paint_verdict(verdict, sign), 1));
}

fn write_reason_and_trace(
    text: &mut String,
    scenario: &ScenarioRecord,
    index: usize,
    expectation: &ExpectationRecord,
    style: Style,
) {
    let verdict = (expectation.verdict == Verdict::Inconclusive).then(|| format::verdict(expectation));
    let reason: Vec<_> = verdict.into_iter().chain(format::remaining_reason(expectation)).collect();
    if !reason.is_empty() {
        style.write_wrapped(text, "    ↳ ", "      ", &reason.join(": "));
    }
    for difference in record_queries::protocol_differences(scenario, index) {
        style.write_wrapped(text, "    ↳ ", "      ", difference);
    }
    let trace = record_queries::trial_to_inspect(scenario, index).map_or("none", |trial| trial.trace.as_str());
    style.write_wrapped(text, "    trace: ", "      ", trace);
}

fn result(expectation: &ExpectationRecord) -> String {
    let unit = format::unit(expectation.metric);
    let value = match format::value(expectation) {
        Some(value) => format!("{value} {unit}"),
        None => format::value_or_not_reached(expectation).unwrap_or_else(|| "no value".to_owned()),
    };
    let window = format::in_window(expectation).map_or_else(String::new, |window| format!(", {window}"));
    format!("{}: {}, limit {}{window}", expectation.name, value.trim_end(), format::limit(expectation))
}

/// Scenarios with a verdict, counted by verdict, of a run that ended early.
pub fn counts_so_far(record: &RunRecord) -> String {
    let judged = record.scenarios.iter().filter(|scenario| !scenario.expectations.is_empty());
    let counts: VerdictCounts = judged.map(|scenario| scenario.verdict).collect();
    let all = format::count(record.scenarios.len(), "scenario");
    format!("played so far: {} of {all}: {counts}", counts.total())
}

/// Wall time of the trials of a scenario above which it is listed as slow.
const SLOW_MS: f64 = 10_000.0;

/// Lists the scenarios whose trials took more than 10 s in total, the slowest first.
pub fn slow_scenarios(record: &RunRecord) -> Option<String> {
    let wall_ms = |scenario: &ScenarioRecord| scenario.trials.iter().filter_map(|trial| trial.wall_ms).sum::<f64>();
    let timed = record.scenarios.iter().map(|scenario| (wall_ms(scenario), scenario));
    let mut slow: Vec<_> = timed.filter(|(wall_ms, _)| *wall_ms > SLOW_MS).collect();
    slow.sort_by(|a, b| b.0.total_cmp(&a.0));
    let named =
        slow.iter().map(|(wall_ms, scenario)| format!("{} {}", printable(&scenario.file), format::duration(*wall_ms)));
    let named: Vec<_> = named.collect();
    (!named.is_empty()).then(|| format!("slow, over 10 s: {}", named.join(", ")))
}

const TICK: Duration = Duration::from_millis(500);
/// The message is cut at the width of the terminal.
const TRIALS: &str = "  {bar:24} {pos}/{len} trials  {elapsed}  {wide_msg}";

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ProgressKind {
    Bar,
    /// A line at the start and one at the end of a scenario.
    Lines,
    Quiet,
}

impl ProgressKind {
    pub fn detect() -> Self {
        if io::stderr().is_terminal() { Self::Bar } else { Self::Lines }
    }
}

pub struct Progress {
    sink: Sink,
}

enum Sink {
    Bar { bar: ProgressBar, running: Arc<Mutex<Running>> },
    Lines(Box<dyn Write + Send>),
    Quiet,
}

/// Scenarios that have started and not ended, oldest first, and the number that did not pass.
#[derive(Default)]
struct Running {
    scenarios: Vec<(String, Instant)>,
    not_passed: usize,
}

impl Running {
    fn message(&self) -> String {
        let count = if self.not_passed == 0 { String::new() } else { format!("{} not passed  ", self.not_passed) };
        let name = |(file, started): &(String, Instant)| format!("{file} {} s", started.elapsed().as_secs());
        let names: Vec<_> = self.scenarios.iter().map(name).collect();
        format!("{count}{}", printable(&names.join(", ")))
    }
}

fn lock(running: &Mutex<Running>) -> MutexGuard<'_, Running> {
    running.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Updates the times of the running scenarios until the progress is dropped.
fn update_times(bar: ProgressBar, running: &Arc<Mutex<Running>>) {
    let running = Arc::downgrade(running);
    // Without the thread, the times change only with the events.
    let _ = thread::Builder::new().name("progress".to_owned()).spawn(move || {
        while let Some(running) = running.upgrade() {
            if !lock(&running).scenarios.is_empty() {
                bar.set_message(lock(&running).message());
            }
            drop(running);
            thread::sleep(TICK);
        }
    });
}

impl Progress {
    pub fn new(kind: ProgressKind) -> Self {
        let sink = match kind {
            ProgressKind::Bar => {
                let target = ProgressDrawTarget::stderr();
                let bar = ProgressBar::with_draw_target(Some(0), target).with_style(bar_style(TRIALS));
                let running = Arc::default();
                update_times(bar.clone(), &running);
                Sink::Bar { bar, running }
            }
            ProgressKind::Lines => Sink::Lines(Box::new(io::stderr())),
            ProgressKind::Quiet => Sink::Quiet,
        };
        Self { sink }
    }

    pub fn to_writer(out: impl Write + Send + 'static) -> Self {
        Self { sink: Sink::Lines(Box::new(out)) }
    }

    /// The bar shows the elapsed time during a step without trials, such as mutation testing.
    #[must_use]
    pub fn with_elapsed_time(self, title: &str) -> Self {
        if let Sink::Bar { bar, .. } = &self.sink {
            bar.set_style(bar_style("  {elapsed}  {wide_msg}"));
            bar.set_message(printable(title).into_owned());
            bar.enable_steady_tick(TICK);
        }
        self
    }

    pub fn show(&mut self, event: &Event) {
        match (&mut self.sink, event) {
            // Without this event, the length is the number of trials of the started scenarios.
            (Sink::Bar { bar, .. }, Event::RunStarted { scenarios, .. }) => {
                bar.set_length(scenarios.iter().map(|planned| u64::from(planned.trials)).sum());
            }
            (Sink::Bar { bar, running }, Event::ScenarioStarted { scenario, trials }) => {
                bar.set_style(bar_style(TRIALS));
                bar.set_length(bar.length().unwrap_or(0).max(bar.position() + u64::from(*trials)));
                let mut running = lock(running);
                running.scenarios.push((scenario.clone(), Instant::now()));
                bar.set_message(running.message());
            }
            (Sink::Bar { bar, .. }, Event::TrialFinished { .. }) => {
                // A scenario may play more trials than planned until its verdicts are conclusive.
                bar.set_length(bar.length().unwrap_or(0).max(bar.position() + 1));
                bar.inc(1);
            }
            (Sink::Bar { bar, running }, Event::ScenarioFinished { scenario, verdict, .. }) => {
                let mut running = lock(running);
                running.scenarios.retain(|(name, _)| name != scenario);
                running.not_passed += usize::from(*verdict != Verdict::Pass);
                bar.set_message(running.message());
            }
            (Sink::Lines(out), Event::ScenarioStarted { scenario, trials }) => {
                let trials = format::count(usize::try_from(*trials).unwrap_or(usize::MAX), "trial");
                write_line(out.as_mut(), &format!("… {}: {trials}", printable(scenario)));
            }
            (Sink::Lines(out), Event::ScenarioFinished { scenario, verdict, trials, .. }) => {
                let (sign, trials) = (format::sign(*verdict), format::count(*trials, "trial"));
                write_line(out.as_mut(), &format!("{sign} {}: {verdict}, {trials}", printable(scenario)));
            }
            _ => {}
        }
    }

    pub fn finish(&mut self) {
        match &mut self.sink {
            Sink::Bar { bar, running } => {
                lock(running).scenarios.clear();
                bar.finish_and_clear();
            }
            Sink::Lines(out) => {
                let _ = out.flush();
            }
            Sink::Quiet => {}
        }
    }
}

fn write_line(out: &mut dyn Write, text: &str) {
    let _ = writeln!(out, "{text}");
}

fn bar_style(template: &str) -> ProgressStyle {
    ProgressStyle::with_template(template).unwrap_or_else(|_| ProgressStyle::default_bar()).progress_chars("━╸ ")
}

#[cfg(test)]
mod tests {
    use super::*;

    struct Closed;

    impl Write for Closed {
        fn write(&mut self, _: &[u8]) -> io::Result<usize> {
            Err(io::ErrorKind::BrokenPipe.into())
        }

        fn flush(&mut self) -> io::Result<()> {
            Err(io::ErrorKind::BrokenPipe.into())
        }
    }

    #[test]
    fn the_progress_names_the_running_scenarios_with_their_times() {
        let started = |seconds| Instant::now().checked_sub(Duration::from_secs(seconds)).unwrap();
        let scenarios = vec![("a.toml".to_owned(), started(70)), ("b.toml".to_owned(), started(0))];
        let running = Running { scenarios, not_passed: 2 };
        assert_eq!(running.message(), "2 not passed  a.toml 70 s, b.toml 0 s");
    }

    #[test]
    fn a_closed_pipe_is_no_error() {
        let mut progress = Progress::to_writer(Closed);
        progress.show(&Event::ScenarioStarted { scenario: "a.toml".to_owned(), trials: 3 });
        progress.finish();
        super::print("text", &mut Closed).unwrap();
    }
}
