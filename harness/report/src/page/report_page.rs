//! Writes `report.html`: a run on one page, what did not pass first.

use super::elements::sorted_by_verdict;
use super::frame::report_page_frame;
use super::golden::GoldenCurves;
use super::kept_rows::RowCache;
use super::resolution::PlotResolution;
use super::run_comparison::{self, OtherRun};
use super::scenario::{ScenarioParts, scenario_article};
use super::scenario_figures::{ReferenceCurves, scenario_figures};
use super::trace_data::{MAX_TRIALS, SampledTrial, TraceData};
use super::{boards, cost, environment, navigation, script, summary};
use crate::chart::marks::Role;
use crate::error::{ReportError, write_file};
use crate::record_queries;
use crate::text::history::{RunHistory, TrendPoint};
use maud::{Markup, html};
use platebench_model::record::{RunRecord, ScenarioRecord, TrialRecord};
use platebench_verdict::golden::Baseline;
use std::collections::BTreeSet;
use std::path::Path;

pub const FILE: &str = "report.html";
pub const COMPARISON_FILE: &str = "comparison.html";

pub fn write(record: &RunRecord, folder: &Path) -> Result<(), ReportError> {
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
    pub fn write(&self, path: &Path) -> Result<(), ReportError> {
        write_file(path, &self.html())
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
        let articles = self.scenario_articles(&data, resolution);
        let title = format!("{} · {} {}", record.verdict, record.tool.name, record.started);
        let body = html! {
            @if record.scenarios.len() > 1 { (navigation::list(record, &data)) }
            div.content {
                div.overview id="overview" {
                    header { (summary::head(record)) }
                    (summary::not_passed_section(record, &data, &self.history, &changed))
                    @if let Some(other) = self.other_run() { (run_comparison::section(record, other)) }
                    (boards::section(record))
                    (summary::closest(record))
                    (summary::not_applicable(record))
                }
                main { @for article in &articles { (article) } }
                div.overview {
                    (summary::requirements(record))
                    (cost::section(record))
                    (environment::section(record))
                }
                footer { p { (record.tool.name) " " (record.tool.version) ". Plots: uPlot." } }
            }
            (script::end())
        };
        report_page_frame(&title, &script::head(), &body)
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

    fn scenario_articles(&self, all: &[TraceData], resolution: PlotResolution) -> Vec<Markup> {
        let record = self.record;
        let mut articles = Vec::new();
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
        }
        articles
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
