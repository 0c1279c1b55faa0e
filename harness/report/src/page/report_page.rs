//! Writes `report.html`: a run on one page, what did not pass first.

use super::elements::{scenario_anchor, sorted_by_verdict};
use super::figure::{ReferenceCurves, failure_drawings, scenario_figures};
use super::scenario::{ScenarioParts, scenario_article};
use super::trace_data::{GoldenCurves, MAX_TRIALS, PlotResolution, RowCache, SampledTrial, TraceData};
use super::{overview, script};
use crate::text::history::{RunHistory, TrendPoint};
use crate::{format, record_queries};
use maud::{Markup, html};
use platebench_document::chart::marks::Role;
use platebench_document::{Cell, Column, Table, page_frame, verdict_badge};
use platebench_model::record::{ExpectationRecord, RunRecord, ScenarioRecord, TrialRecord, Verdict};
use platebench_model::trace::{AtPath, FileError, write_atomically};
use platebench_verdict::golden::Baseline;
use std::collections::BTreeSet;
use std::path::Path;

pub const FILE: &str = "report.html";
pub const COMPARISON_FILE: &str = "comparison.html";

/// Number of scenarios, worst first, whose cards have a plot.
const MAX_CARD_PLOTS: usize = 10;
const CARD_LINE_POINTS: usize = 200;

pub fn write(record: &RunRecord, folder: &Path) -> Result<(), FileError> {
    ReportPage::new(record, folder).write(&folder.join(FILE))
}

#[derive(Debug, Clone)]
pub struct ReportPage<'a> {
    record: &'a RunRecord,
    folder: &'a Path,
    baselines: Option<&'a Path>,
    other: Option<(&'a RunRecord, &'a Path)>,
    history: RunHistory,
    is_trace_changed: Option<IsTraceChanged>,
    rows: RowCache,
}

/// True if the trace in the run folder differs from the record of its trial.
pub type IsTraceChanged = fn(&Path, &TrialRecord) -> bool;

impl<'a> ReportPage<'a> {
    pub fn new(record: &'a RunRecord, folder: &'a Path) -> Self {
        let (baselines, other, is_trace_changed) = (None, None, None);
        let (history, rows) = (RunHistory::default(), RowCache::default());
        Self { record, folder, baselines, other, history, is_trace_changed, rows }
    }

    #[must_use]
    pub fn with_baselines(self, folder: &'a Path) -> Self {
        Self { baselines: Some(folder), ..self }
    }

    /// Adds trends and the time of the last pass from the runs in neighbouring folders.
    #[must_use]
    pub fn with_earlier_runs(self) -> Self {
        Self { history: RunHistory { runs: Some(self.record.earlier_runs(self.folder, |_, _| ())) }, ..self }
    }

    /// Draws these rows instead of reading them from the traces.
    #[must_use]
    pub fn with_rows(self, rows: RowCache) -> Self {
        Self { rows, ..self }
    }

    /// Lists traces that were changed after the run instead of drawing them.
    #[must_use]
    pub fn without_changed_traces(self, is_changed: IsTraceChanged) -> Self {
        Self { is_trace_changed: Some(is_changed), ..self }
    }

    #[must_use]
    pub fn with_other_run(self, record: &'a RunRecord, folder: &'a Path) -> Self {
        Self { other: Some((record, folder)), ..self }
    }

    /// The page lists traces and baselines that cannot be read; they are not an error.
    pub fn write(&self, path: &Path) -> Result<(), FileError> {
        write_atomically(path, self.html().as_bytes()).at(path)
    }

    fn html(&self) -> String {
        let record = self.record;
        let changed = self.changed_traces(self.folder, &record.scenarios);
        let resolution = self.resolution();
        let read = |scenario: &ScenarioRecord| {
            // An unreadable baseline is reported with the scenario.
            let golden = self.baselines.and_then(|folder| Baseline::read(folder, &scenario.file).ok().flatten());
            TraceData::read(scenario, self.folder, &self.rows, resolution, &changed, golden.as_ref())
        };
        let data: Vec<TraceData> = record.scenarios.iter().map(read).collect();
        let (articles, plots) = self.scenario_articles(&data, resolution);
        let (history, changed) = (&self.history, &changed);
        let not_passed = overview::NotPassed { record, data: &data, plots: &plots, history, changed };
        let title = format!("{} · {} {}", record.verdict, record.tool.name, record.started);
        let body = html! {
            @if record.scenarios.len() > 1 { (overview::scenario_list(record, &data)) }
            div.content {
                div.overview id="overview" {
                    header { (overview::head(record)) }
                    (not_passed.section())
                    @if let Some(other) = self.other_run() { (comparison_section(record, other)) }
                    (overview::boards_section(record))
                    (overview::closest(record))
                    (overview::not_applicable(record))
                }
                main { @for article in &articles { (article) } }
                div.overview {
                    (overview::requirements(record))
                    (overview::cost_section(record))
                    (overview::environment_section(record))
                }
                footer { p { (record.tool.name) " " (record.tool.version) ". Plots: uPlot." } }
            }
            (script::end())
        };
        page_frame(&title, &script::head(), &body)
    }

    fn resolution(&self) -> PlotResolution {
        let scenarios = &self.record.scenarios;
        let trials = scenarios.iter().map(|scenario| scenario.trials.len()).max().unwrap_or(0).min(MAX_TRIALS);
        PlotResolution::of(scenarios.len(), trials)
    }

    fn other_run(&self) -> Option<OtherRun<'a>> {
        let (record, folder) = self.other?;
        let name = folder.file_name().and_then(|name| name.to_str()).unwrap_or("the other run");
        Some(OtherRun { name, record })
    }

    fn changed_traces(&self, folder: &Path, scenarios: &[ScenarioRecord]) -> BTreeSet<String> {
        let Some(is_changed) = self.is_trace_changed else { return BTreeSet::new() };
        let trials = scenarios.iter().flat_map(|scenario| &scenario.trials);
        trials.filter(|trial| is_changed(folder, trial)).map(|trial| trial.trace.clone()).collect()
    }

    /// Returns the articles, and by index of the scenario the plots for the cards.
    fn scenario_articles(&self, all: &[TraceData], resolution: PlotResolution) -> (Vec<Markup>, Vec<Markup>) {
        let record = self.record;
        let mut articles = Vec::new();
        let mut plots = vec![Markup::default(); record.scenarios.len()];
        for (place, (index, scenario)) in sorted_by_verdict(record).into_iter().enumerate() {
            let Some(data) = all.get(index) else { continue };
            let open_loop = || {
                let other = record_queries::open_loop_counterpart(record, scenario)?;
                let text = format!("open loop ({})", record.scenarios.get(other)?.file);
                Some((text, Role::OpenLoop, all.get(other)?.first_trial_on(&data.grid)?))
            };
            let other = self.other_run_trial(scenario, data, resolution).or_else(open_loop);
            let golden = self.baselines.map(|folder| GoldenCurves::read(folder, &scenario.file, &data.grid));
            let (golden, baseline_error) = match golden.transpose() {
                Ok(golden) => (golden.flatten(), None),
                Err(error) => (None, Some(error.to_string())),
            };
            let references = ReferenceCurves {
                golden: golden.as_ref(),
                other: other.as_ref().map(|(text, role, sampled)| (text.clone(), *role, sampled)),
            };
            let parts = ScenarioParts {
                data,
                figures: scenario_figures(data, &references, resolution.overlaid_trials),
                baseline_error,
                line_points: resolution.line_points,
                has_drawings: place < resolution.drawn_scenarios,
                trends: self.trends(scenario),
            };
            articles.push(scenario_article(index, scenario, &parts));
            let window = data.failure_window.filter(|_| place < MAX_CARD_PLOTS && scenario.verdict != Verdict::Pass);
            if let (Some(window), Some(plot)) = (window, plots.get_mut(index)) {
                *plot = failure_drawings(&data.grid.t_ms, window, &parts.figures, CARD_LINE_POINTS);
            }
        }
        (articles, plots)
    }

    fn trends(&self, scenario: &ScenarioRecord) -> Vec<Vec<TrendPoint>> {
        let indices = 0..scenario.expectations.len();
        indices.map(|index| self.history.trend(self.record, scenario, index)).collect()
    }

    /// The trial of the other run with the index of the trial that this page draws as a line. If
    /// there is none, the first trial.
    fn other_run_trial(
        &self,
        scenario: &ScenarioRecord,
        data: &TraceData,
        resolution: PlotResolution,
    ) -> Option<(String, Role, SampledTrial)> {
        let (other, (_, folder)) = (self.other_run()?, self.other?);
        let theirs = other.scenario(&scenario.file)?;
        let same = theirs.trials.iter().find(|trial| trial.index == data.first_trial);
        let trial = same.or_else(|| theirs.trials.first())?;
        let only = ScenarioRecord { trials: vec![trial.clone()], ..theirs.clone() };
        let changed = self.changed_traces(folder, std::slice::from_ref(&only));
        let rows = RowCache::default();
        let sampled = TraceData::read(&only, folder, &rows, resolution, &changed, None).first_trial_on(&data.grid)?;
        Some((format!("trial {} of {}", trial.index, other.name), Role::Other, sampled))
    }
}

#[derive(Debug, Clone, Copy)]
pub(super) struct OtherRun<'a> {
    pub(super) name: &'a str,
    pub(super) record: &'a RunRecord,
}

impl<'a> OtherRun<'a> {
    pub(super) fn scenario(self, file: &str) -> Option<&'a ScenarioRecord> {
        self.record.scenarios.iter().find(|scenario| scenario.file == file)
    }
}

struct ExpectationPair<'a> {
    scenario_index: Option<usize>,
    file: &'a str,
    name: &'a str,
    this_run: Option<&'a ExpectationRecord>,
    other_run: Option<&'a ExpectationRecord>,
}

impl ExpectationPair<'_> {
    fn verdict_changed(&self) -> bool {
        self.this_run.map(|found| found.verdict) != self.other_run.map(|found| found.verdict)
    }

    fn format_change(&self) -> Option<String> {
        let (now, then) = (self.this_run?.value?, self.other_run?.value?);
        if now == then {
            return Some("none".to_owned());
        }
        let sign = if now > then { "+" } else { "−" };
        let size = (now - then).abs();
        let relative = (then != 0.0).then(|| format!(" ({sign}{} %)", format::percent(size / then.abs() * 100.0)));
        Some(format!("{sign}{}{}", format::number(size), relative.unwrap_or_default()))
    }
}

fn expectation_pairs<'a>(record: &'a RunRecord, other: OtherRun<'a>) -> Vec<ExpectationPair<'a>> {
    let here = record.scenarios.iter().enumerate().map(|(number, scenario)| (Some(number), scenario.file.as_str()));
    let known = |file: &str| record.scenarios.iter().any(|scenario| scenario.file == file);
    let there = other.record.scenarios.iter().filter(|scenario| !known(&scenario.file));
    let files = here.chain(there.map(|scenario| (None, scenario.file.as_str())));
    let mut pairs: Vec<ExpectationPair<'a>> = files
        .flat_map(|(number, file)| {
            let of_this = number.and_then(|number| record.scenarios.get(number));
            let this_run = of_this.map_or(&[][..], |scenario| &scenario.expectations);
            let other_run = other.scenario(file).map_or(&[][..], |scenario| &scenario.expectations);
            let find = |all: &'a [ExpectationRecord], name: &str| all.iter().find(|found| found.name == name);
            let only_other = other_run.iter().filter(|found| find(this_run, &found.name).is_none());
            let pair = |found: &'a ExpectationRecord| ExpectationPair {
                scenario_index: number,
                file,
                this_run: find(this_run, &found.name),
                other_run: find(other_run, &found.name),
                name: &found.name,
            };
            this_run.iter().chain(only_other).map(pair).collect::<Vec<_>>()
        })
        .collect();
    pairs.sort_by_key(|pair| !pair.verdict_changed());
    pairs
}

fn comparison_section(record: &RunRecord, other: OtherRun<'_>) -> Markup {
    let pairs = expectation_pairs(record, other);
    let changed = pairs.iter().filter(|pair| pair.verdict_changed()).count();
    html! {
        section aria-labelledby="against" {
            h2 id="against" { "Comparison with the run of " (other.record.started) }
            p {
                code { (other.name) } ": " (verdict_badge(other.record.verdict, other.record.verdict.name())) " on "
                code { (other.record.rig.name) }
                ", " (format::firmware_build(other.record)) "; this run: " (format::firmware_build(record)) ". "
                @match changed {
                    0 => "No verdict differs.",
                    1 => "1 verdict differs.",
                    _ => { (changed) " verdicts differ." },
                }
            }
            (comparison_table(&pairs).html_as("Comparison of both runs", "contents stacked"))
        }
    }
}

fn comparison_table(pairs: &[ExpectationPair<'_>]) -> Table {
    let number = |name: &str| Column::number(name, "");
    let mut table = Table::new([
        "Scenario".into(),
        "Metric".into(),
        "Other run".into(),
        number("Other run measured"),
        "This run".into(),
        number("This run measured"),
        number("Change"),
    ]);
    let verdict = |found: Option<&ExpectationRecord>| match found {
        Some(found) => Cell::from(format::verdict(found)).with_verdict(found.verdict),
        None => Cell::from("not played"),
    };
    let value = |found: Option<&ExpectationRecord>| {
        let text = found.and_then(format::value_or_not_reached);
        Cell::optional(text).with_unit(found.map_or("", format::unit_of_value))
    };
    table.extend(pairs.iter().map(|pair| {
        let link = pair.scenario_index.map(|number| format!("#{}", scenario_anchor(number)));
        [
            Cell { is_highlighted: pair.verdict_changed(), ..Cell::from(pair.file).with_link(link) },
            Cell::code(pair.name),
            verdict(pair.other_run),
            value(pair.other_run),
            verdict(pair.this_run),
            value(pair.this_run),
            Cell::optional(pair.format_change()),
        ]
    }));
    table
}
