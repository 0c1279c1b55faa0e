//! `report.html`: a run on one page that needs nothing else: no font, no picture, no script from elsewhere. Without scripts everything can be read; with them
//! the plots move.
//!
//! * `bundle`, `curves`, `grid`, `golden`, `resolution`: traces to what can be shown of them.
//! * `timed`: instants that were asked for.
//! * `figure`, `plot`: curves to drawings.
//! * `interactive`, `pack`, `script`: curves to plots.
//! * `summary`, `against`, `scenario`, `cost`, `environment`: the page's parts.
//!
//! Neighbours: the record is shown as it is. What did not pass comes first.

mod against;
mod bundle;
mod cost;
pub(crate) mod curves;
mod environment;
mod figure;
pub(crate) mod frame;
mod golden;
mod grid;
mod interactive;
mod pack;
pub(crate) mod plot;
mod resolution;
mod scenario;
mod script;
mod summary;
mod timed;

use crate::error::ReportError;
use crate::evidence;
use crate::history::History;
use against::Other;
use bundle::{Bundle, TRIALS};
use figure::Behind;
use frame::frame;
use golden::Curves;
use interactive::Beside;
use maud::{Markup, html};
use platebench_verdict::{RunRecord, ScenarioRecord, TrialRecord, Verdict};
use resolution::Resolution;
use std::collections::BTreeSet;
use std::fmt::Write as _;
use std::fs;
use std::path::Path;

/// The file's name in a run folder.
pub const FILE: &str = "report.html";
/// The file's name where two runs stand side by side.
pub const COMPARISON_FILE: &str = "comparison.html";

const STYLE: &str = include_str!("html/style.css");

/// Writes the run as a page into `folder`, the run's own: traces are looked for there. A trace that is missing is said
/// to be missing where its plots would have stood.
///
/// # Errors
/// [`ReportError`] where the file cannot be written.
pub fn write(record: &RunRecord, folder: &Path) -> Result<(), ReportError> {
    Page::new(record, folder).write(&folder.join(FILE))
}

/// A run as a page, and what stands beside it there.
#[derive(Debug, Clone)]
pub struct Page<'a> {
    record: &'a RunRecord,
    folder: &'a Path,
    baselines: Option<&'a Path>,
    other: Option<(&'a RunRecord, &'a Path)>,
    history: History,
    is_changed: Option<IsChanged>,
}

/// Whether a trial of the run in that folder has a trace that is no longer the file that the run was made with.
pub type IsChanged = fn(&Path, &TrialRecord) -> bool;

impl<'a> Page<'a> {
    /// The run alone; its traces are looked for in `folder`.
    pub fn new(record: &'a RunRecord, folder: &'a Path) -> Self {
        Self { record, folder, baselines: None, other: None, history: History::default(), is_changed: None }
    }

    /// With the golden traces in this folder and their tubes.
    #[must_use]
    pub fn with_baselines(self, folder: &'a Path) -> Self {
        Self { baselines: Some(folder), ..self }
    }

    /// With what the runs in folders beside this one's say of what did not pass: since when.
    #[must_use]
    pub fn with_earlier_runs(self) -> Self {
        Self { history: History::beside(self.folder, self.record), ..self }
    }

    /// With every trace held to what the run recorded of it: none that was changed is drawn, and which they are is said.
    #[must_use]
    pub fn without_changed_traces(self, is_changed: IsChanged) -> Self {
        Self { is_changed: Some(is_changed), ..self }
    }

    /// With another run side by side.
    #[must_use]
    pub fn against(self, record: &'a RunRecord, folder: &'a Path) -> Self {
        Self { other: Some((record, folder)), ..self }
    }

    /// Writes the page. What is missing, a trace or a baseline that cannot be read, is said where it would have stood.
    ///
    /// # Errors
    /// [`ReportError`] where the file cannot be written.
    pub fn write(&self, path: &Path) -> Result<(), ReportError> {
        fs::write(path, self.markup()?.into_string()).map_err(ReportError::io(path))
    }

    fn other(&self) -> Option<Other<'a>> {
        let (record, folder) = self.other?;
        let name = folder.file_name().and_then(|name| name.to_str()).unwrap_or("the other run");
        Some(Other { name, record })
    }

    /// The traces of these scenarios of the run in `folder` that are no longer what it was made with.
    fn changed(&self, folder: &Path, scenarios: &[ScenarioRecord]) -> BTreeSet<String> {
        let Some(is_changed) = self.is_changed else { return BTreeSet::new() };
        let trials = scenarios.iter().flat_map(|scenario| &scenario.trials);
        trials.filter(|trial| is_changed(folder, trial)).map(|trial| trial.trace.clone()).collect()
    }

    fn articles(&self, changed: &BTreeSet<String>) -> Result<Vec<Markup>, ReportError> {
        let record = self.record;
        let most = record.scenarios.iter().map(|scenario| scenario.trials.len()).max().unwrap_or(0).min(TRIALS);
        let resolution = Resolution::of(record.scenarios.len(), most);
        let read = |scenario| Bundle::read(scenario, self.folder, resolution, changed);
        let bundles: Vec<Bundle> = record.scenarios.iter().map(read).collect();
        let mut articles = Vec::new();
        for (place, (index, shown)) in in_order(record).into_iter().enumerate() {
            let Some(own) = bundles.get(index) else { continue };
            let beyond = self.of_other_run(shown, own, resolution);
            let open_loop = evidence::open_loop_of(record, shown).and_then(|other| {
                let text = format!("open loop ({})", record.scenarios.get(other)?.file);
                Some(Behind { text, bundle: bundles.get(other)? })
            });
            let behind = match &beyond {
                Some((text, bundle)) => Some(Behind { text: text.clone(), bundle }),
                None => open_loop,
            };
            let golden = self.baselines.map(|folder| Curves::read(folder, &shown.file, &own.grid));
            let (golden, damaged) = match golden {
                Some(Ok(golden)) => (golden, None),
                Some(Err(error)) => (None, Some(error.to_string())),
                None => (None, None),
            };
            let aligned =
                behind.as_ref().and_then(|behind| Some((behind.text.clone(), behind.bundle.first_on(&own.grid)?)));
            let beside = Beside {
                golden: golden.as_ref(),
                other: aligned.as_ref().map(|(text, sampled)| (text.clone(), sampled)),
            };
            let curves = interactive::scenario(own, &beside, &shown.title, resolution.overlaid);
            let parts = scenario::Parts {
                bundle: own,
                behind: behind.as_ref(),
                curves,
                damaged,
                points: resolution.points,
                all: place < resolution.full,
            };
            articles.push(scenario::article(index, shown, &parts)?);
        }
        Ok(articles)
    }

    /// The same scenario in the other run.
    fn of_other_run(&self, shown: &ScenarioRecord, own: &Bundle, resolution: Resolution) -> Option<(String, Bundle)> {
        let (other, (_, folder)) = (self.other()?, self.other?);
        let scenario = other.scenario(&shown.file)?;
        let first =
            scenario.trials.iter().find(|trial| trial.index == own.first).or_else(|| scenario.trials.first())?;
        let only = ScenarioRecord { trials: vec![first.clone()], ..scenario.clone() };
        let changed = self.changed(folder, std::slice::from_ref(&only));
        let bundle = Bundle::read(&only, folder, resolution, &changed);
        Some((format!("trial {} of {}", first.index, other.name), bundle))
    }

    fn markup(&self) -> Result<Markup, ReportError> {
        let record = self.record;
        let changed = self.changed(self.folder, &record.scenarios);
        let articles = self.articles(&changed)?;
        let title = format!("{} · {} {}", record.verdict, record.tool.name, record.started);
        let body = html! {
            header { (summary::head(record)) }
            main {
                (summary::open_points(record, &self.history, &changed))
                @if let Some(other) = self.other() { (against::section(record, other)) }
                (summary::scenarios(record))
                (summary::requirements(record))
                @for article in &articles { (article) }
                (cost::section(record))
                (environment::section(record))
            }
            footer { p { (record.tool.name) " " (record.tool.version) ". Plots: uPlot." } }
            (script::end())
        };
        Ok(frame(&title, &script::head(), &body))
    }
}

/// Scenarios with their number in the record: failed, inconclusive, passed, each as they were played.
fn in_order(record: &RunRecord) -> Vec<(usize, &ScenarioRecord)> {
    let mut scenarios: Vec<_> = record.scenarios.iter().enumerate().collect();
    scenarios.sort_by_key(|(_, scenario)| match scenario.verdict {
        Verdict::Fail => 0,
        Verdict::Inconclusive => 1,
        Verdict::Pass => 2,
    });
    scenarios
}

/// Where a scenario stands on the page.
fn anchor(index: usize) -> String {
    format!("scenario-{index}")
}

/// A file of the run folder, as a link that works where the page lies there.
fn file(path: &str) -> Markup {
    html! { @if !path.is_empty() { a href={ "./" (encoded(path)) } { (path) } } }
}

/// A relative path as a URL has it: nothing in a name is a scheme, a query or a fragment.
fn encoded(path: &str) -> String {
    path.bytes().fold(String::with_capacity(path.len()), |mut url, byte| {
        if byte.is_ascii_alphanumeric() || b"-._~/".contains(&byte) {
            url.push(char::from(byte));
        } else {
            // Writing into a string does not fail.
            let _ = write!(url, "%{byte:02X}");
        }
        url
    })
}

fn badge(verdict: Verdict, text: &str) -> Markup {
    html! { span class={ "badge " (verdict) } { span aria-hidden="true" { (crate::shown::sign(verdict)) } " " (text) } }
}
