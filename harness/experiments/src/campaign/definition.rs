//! Reads and checks campaign files.

use crate::campaign::distribution::RawDistribution;
use crate::campaign::distribution::Variable;
use crate::campaign::distribution::{Correlation, RawCorrelation, SEARCH_DEVIATIONS};
use crate::campaign::truncation::{Truncation, corners, truncate_to_accepted};
use platebench_model::scenario::load::{PLATE_PREFIX, ScenarioTables, ScenarioTemplate, load_template};
use platebench_model::scenario::{Diagnostic, FileChecker, Metric, Scenario, is_scenario_path};
use platebench_rig::{Capability, RigSpec};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::ops::Range;
use std::path::{Path, PathBuf};
use toml::de::{DeTable, DeValue};
use toml::{Spanned, Table, Value};

/// The intervals of shares count trials as `u32`.
const MAX_TRIALS: u64 = 4_000_000_000;
/// The largest seed of a trial is an `i64`.
const MAX_SEED: i64 = i64::MAX / 2;
/// Each varied value is checked alone, and each trial replaces all of them.
const MAX_VARIED: usize = 200;
const MAX_CELLS: u64 = 1_000_000;
const DEFAULT_CONFIDENCE: f64 = 0.95;
/// Largest number of listed values per key that are checked before the campaign starts.
const MAX_CHECKED_VALUES: usize = 100;
const FIXED_KEYS: [&str; 9] =
    ["title", "source", "tags", "trials", "between", "only_if_named", "expected_exit", "timeout_s", "plate"];

/// A campaign file.
#[derive(Debug, Clone, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct RawCampaign {
    /// Title, one line.
    #[schemars(length(min = 1))]
    title: String,
    /// Scenario file, relative to this file.
    scenario: PathBuf,
    /// Distribution of each varied value. A key is a path in the scenario, or `plate.` and a path
    /// in its plate file. The first key varies slowest.
    vary: BTreeMap<String, RawDistribution>,
    /// Correlated normal values.
    #[serde(default)]
    correlate: Vec<RawCorrelation>,
    /// Number and choice of the trials.
    plan: RawPlan,
    /// Demand on the share of failing trials. A grid without it, and without an expectation that
    /// names a requirement, is a map and is not judged.
    judge: Option<RawJudge>,
}

#[derive(Debug, Clone, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct RawPlan {
    /// How the values of a trial are chosen.
    method: Method,
    /// Number of trials. For `grid`: number per combination of listed values.
    #[schemars(range(min = 1))]
    trials: i64,
    /// Seed of the campaign. The seed of trial i is this number + i.
    #[serde(default = "one")]
    #[schemars(range(min = 0, max = MAX_SEED))]
    seed: i64,
    /// Rig that replays some trials of the hosted rig: the failing ones, the worst ones and a
    /// random 1 %.
    #[schemars(regex(pattern = "^emulated(:.+)?$"))]
    confirm: Option<String>,
}

const fn one() -> i64 {
    1
}

#[derive(Debug, Clone, Default, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct RawJudge {
    /// Largest allowed share of failing trials. Without it, one failing trial fails the campaign.
    #[schemars(extend("exclusiveMinimum" = 0, "exclusiveMaximum" = 1))]
    at_most: Option<f64>,
    /// One-sided confidence of each end of an interval.
    #[schemars(range(min = 0.5), extend("exclusiveMaximum" = 1, "default" = DEFAULT_CONFIDENCE))]
    confidence: Option<f64>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Method {
    /// Every combination of listed values; the others are drawn at random.
    Grid,
    /// All values are drawn at random.
    Random,
    /// All values follow a scrambled Sobol sequence.
    Sobol,
    /// Search for the worst case over the whole range of every value.
    Search,
    /// Estimate of the probability of rare failures.
    Rare,
}

/// Number of trials of one search. Several short searches find more failures than one long one.
const SEARCH_CHAIN_TRIALS: u64 = 256;
const RARE_CHAIN_TRIALS: u64 = 2_048;
/// Points of `rare` beyond this many standard deviations of a value are moved to this distance.
pub(crate) const RARE_DEVIATIONS: f64 = 8.0;

impl Method {
    /// Number of trials in a chain of dependent trials. 1 if the trials are independent.
    pub const fn chain_trials(self) -> u64 {
        match self {
            Self::Grid | Self::Random | Self::Sobol => 1,
            Self::Search => SEARCH_CHAIN_TRIALS,
            Self::Rare => RARE_CHAIN_TRIALS,
        }
    }
}

#[derive(Debug)]
pub struct Campaign {
    pub path: PathBuf,
    pub text: String,
    pub title: String,
    /// Varied values in the order of the campaign file.
    pub variables: Vec<Variable>,
    /// Normal values of `search` and `rare` that the scenario refuses in part.
    pub truncated: Vec<Truncation>,
    pub method: Method,
    pub trials: u64,
    pub trials_per_cell: u64,
    /// Number of combinations of listed values; 0 for a search or without listed values.
    pub cells: u64,
    pub seed: u64,
    pub confirm: Option<RigSpec>,
    pub at_most: Option<f64>,
    pub confidence: f64,
    /// True for a grid without `[judge]` and without a requirement. Its failing trials are the result
    /// and no failure of the campaign.
    pub is_map: bool,
    pub(crate) correlation: Option<Correlation>,
    pub template: ScenarioTemplate,
}

struct CampaignChecker {
    file: FileChecker,
    /// Places of the varied keys. [`Diagnostic::at_key`] cannot find them, because they contain dots.
    spans: BTreeMap<String, Range<usize>>,
}

impl Campaign {
    /// Reports all wrong keys at once, or all numbers outside their bounds, or all other wrong values.
    pub fn load(path: &Path) -> Result<Self, Vec<Diagnostic>> {
        let (file, raw) = FileChecker::read::<RawCampaign>(path)?;
        let mut checker = CampaignChecker { spans: spans_of_variables(file.text()), file };
        checker.file.require_one_line("title", &raw.title);
        let template = checker.template(&raw.scenario);
        let mut variables = checker.variables(raw.vary);
        if let Some(template) = &template {
            let problems = variables.iter().filter_map(|variable| checker.value_problem(template, variable));
            let problems: Vec<_> = checker.scenario_problem(&template.scenario).into_iter().chain(problems).collect();
            checker.file.extend(problems);
        }
        if raw.plan.method == Method::Rare {
            let problem = checker.rare_problem(&variables);
            checker.file.extend(problem);
        }
        let keys: Vec<_> =
            variables.iter().map(|variable| (&*variable.key, variable.distribution.is_normal())).collect();
        let correlation = Correlation::new(&raw.correlate, &keys);
        let correlation = correlation.map_err(|message| checker.file.problem("correlate", message));
        let correlation = checker.file.accept_one(correlation);
        let confirm = checker.confirming_rig(&raw.plan);
        let confirm = checker.file.accept_one(confirm);
        let counts = checker.counts(&raw.plan, &variables);
        let counts = checker.file.accept_one(counts);
        let (Some(template), Some([trials, cells]), Some(correlation), Some(confirm), false) =
            (template, counts, correlation, confirm, checker.file.has_problems())
        else {
            return Err(checker.file.into_problems());
        };
        let is_judged = raw.judge.is_some()
            || template.scenario.expectations.iter().any(|expectation| expectation.requirement.is_some());
        let judge = raw.judge.unwrap_or_default();
        let truncated = checker
            .truncate(raw.plan.method, &mut variables, &template, &raw.correlate)
            .map_err(|problem| vec![problem])?;
        Ok(Self {
            path: path.to_owned(),
            title: raw.title,
            variables,
            truncated,
            method: raw.plan.method,
            trials,
            trials_per_cell: raw.plan.trials.unsigned_abs(),
            cells,
            seed: raw.plan.seed.unsigned_abs(),
            confirm,
            at_most: judge.at_most,
            confidence: judge.confidence.unwrap_or(DEFAULT_CONFIDENCE),
            is_map: raw.plan.method == Method::Grid && !is_judged,
            correlation,
            template,
            text: checker.file.finish()?,
        })
    }

    pub(crate) fn tables(&self, seed: u64, values: &[f64]) -> Result<ScenarioTables, Diagnostic> {
        let changes = self
            .variables
            .iter()
            .zip(values)
            .map(|(variable, value)| (&*variable.key, variable.distribution.value(*value)));
        let seed = ("trials.seed", Value::Integer(i64::try_from(seed).unwrap_or(i64::MAX)));
        self.template.tables(changes.chain([seed])).map_err(|message| Diagnostic::for_file(&self.path, message))
    }

    pub const fn chain_trials(&self) -> u64 {
        self.method.chain_trials()
    }

    pub fn expectation_names(&self) -> Vec<String> {
        self.template.scenario.expectations.iter().map(|expectation| expectation.name.clone()).collect()
    }
}

fn spans_of_variables(text: &str) -> BTreeMap<String, Range<usize>> {
    let Ok(document) = DeTable::parse(text) else { return BTreeMap::new() };
    let Some(DeValue::Table(vary)) = document.get_ref().get("vary").map(Spanned::get_ref) else {
        return BTreeMap::new();
    };
    vary.iter().map(|(name, _)| (name.get_ref().to_string(), name.span())).collect()
}

/// Why a trial with these values cannot be played. `None` if it can.
fn refusal<'a>(template: &ScenarioTemplate, changes: impl IntoIterator<Item = (&'a str, Value)>) -> Option<String> {
    let first =
        |problems: Vec<Diagnostic>| problems.into_iter().next().map_or_else(String::new, |problem| problem.message);
    let scenario = template.tables(changes).and_then(|tables| template.check(&tables).map_err(first));
    scenario.and_then(|scenario| platebench_engine::law(&scenario).map_err(|problem| problem.message)).err()
}

/// Removes the keys that concern several trials, because a campaign judges each trial alone.
fn prepare(scenario: &mut Table) {
    scenario.remove("trials");
    scenario.remove("expected_exit");
    scenario.remove("only_if_named");
    scenario.remove("timeout_s");
    for expectation in scenario.get_mut("expect").and_then(Value::as_array_mut).into_iter().flatten() {
        let metric = expectation.get("metric").and_then(Value::as_str).and_then(Metric::from_name);
        if let (Some(metric), Value::Table(expectation)) = (metric, expectation)
            && metric.has_over()
        {
            expectation.remove("quantile");
            expectation.insert("over".to_owned(), Value::String("each".to_owned()));
        }
    }
}

impl CampaignChecker {
    fn vary_problem(&self, key: &str, message: impl Into<String>) -> Diagnostic {
        let (path, text, span) = (self.file.path(), self.file.text(), self.span_of_variable(key));
        Diagnostic::at_span(path, text, span, format!("`{key}`: {}", message.into()))
    }

    fn span_of_variable(&self, key: &str) -> Range<usize> {
        self.spans.get(key).cloned().unwrap_or_default()
    }

    fn template(&mut self, scenario: &Path) -> Option<ScenarioTemplate> {
        let path = self.file.neighbour(scenario);
        if !is_scenario_path(&path) {
            self.file.report("scenario", format!("{}: no such file, expected a scenario file", path.display()));
            return None;
        }
        let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        self.file.accept(load_template(&path, &name, prepare))
    }

    fn variables(&mut self, raw: BTreeMap<String, RawDistribution>) -> Vec<Variable> {
        self.file.require(!raw.is_empty(), "vary", || "no varied value, expected at least one".to_owned());
        if raw.len() > MAX_VARIED {
            self.file.report("vary", format!("{} varied values, expected at most {MAX_VARIED}", raw.len()));
            return Vec::new();
        }
        let mut raw: Vec<_> = raw.into_iter().collect();
        raw.sort_by_key(|(key, _)| self.span_of_variable(key).start);
        let mut variables = Vec::new();
        for (key, distribution) in raw {
            let first = key.split('.').next().unwrap_or_default();
            if FIXED_KEYS.contains(&first) && !key.starts_with(PLATE_PREFIX) {
                let message = "cannot be varied; expected a key of the scenario's scene, controller or limits, \
                               or a key of the plate file after `plate.`";
                self.file.extend([self.vary_problem(&key, message)]);
                continue;
            }
            match distribution.check() {
                Ok(distribution) => variables.push(Variable { key, distribution }),
                Err(message) => self.file.extend([self.vary_problem(&key, message)]),
            }
        }
        variables
    }

    fn confirming_rig(&self, plan: &RawPlan) -> Result<Option<RigSpec>, Diagnostic> {
        let Some(text) = &plan.confirm else { return Ok(None) };
        match text.parse::<RigSpec>() {
            Ok(rig) if rig.has(Capability::EmulatedChip) => {
                let elf = rig.image().map(|elf| self.file.neighbour(elf));
                match elf.as_ref().filter(|elf| !elf.is_file()) {
                    Some(missing) => {
                        let message = format!("{}: no such file, expected an ELF", missing.display());
                        Err(self.file.problem("plan.confirm", message))
                    }
                    None => Ok(Some(RigSpec::emulated(elf))),
                }
            }
            _ => Err(self.file.problem("plan.confirm", format!("`{text}`, expected emulated or emulated:ELF"))),
        }
    }

    /// Rejects listed values, because the method `rare` needs continuous distributions.
    fn rare_problem(&self, variables: &[Variable]) -> Option<Diagnostic> {
        let listed = variables.iter().find(|variable| variable.distribution.choices().is_some())?;
        Some(
            self.vary_problem(
                &listed.key,
                "listed values, expected `normal`, `lognormal` or `uniform` for method `rare`",
            ),
        )
    }

    fn scenario_problem(&self, scenario: &Scenario) -> Option<Diagnostic> {
        let over_trials = scenario.expects(Metric::Repeatability) || scenario.keeps_controller();
        over_trials.then(|| {
            let message = "the scenario has [[between]] or a metric that compares trials; a campaign judges each trial \
                           alone, expected another scenario";
            self.file.problem("scenario", message)
        })
    }

    fn value_problem(&self, template: &ScenarioTemplate, variable: &Variable) -> Option<Diagnostic> {
        let values = variable.distribution.required_values();
        let step = values.len().div_ceil(MAX_CHECKED_VALUES).max(1);
        let checked = values.iter().step_by(step).chain(values.last());
        let names = |scenario: &Scenario| -> Vec<String> {
            scenario.expectations.iter().map(|expectation| expectation.name.clone()).collect()
        };
        for value in checked {
            let with_value = |message: &str| Some(self.vary_problem(&variable.key, format!("{value}: {message}")));
            let tables = match template.tables([(&*variable.key, value.clone())]) {
                Ok(tables) => tables,
                Err(message) => return Some(self.vary_problem(&variable.key, message)),
            };
            let scenario = match template.check(&tables) {
                Ok(scenario) => scenario,
                Err(problems) => return with_value(problems.first().map_or("refused", |problem| &*problem.message)),
            };
            if let Err(problem) = platebench_engine::law(&scenario) {
                return with_value(&problem.message);
            }
            let is_pinned = |path: &Path| template.inputs().iter().any(|input| input.path == path);
            if names(&scenario) != names(&template.scenario)
                || !scenario.inputs.iter().all(|input| is_pinned(&input.path))
            {
                return with_value("the value changes a file or the name of an expectation; vary another key");
            }
        }
        None
    }

    /// Truncates the distributions of `search` and `rare`, which play every point that they compute.
    /// Refuses the campaign if the scenario refuses a combination of values.
    fn truncate(
        &self,
        method: Method,
        variables: &mut [Variable],
        template: &ScenarioTemplate,
        correlations: &[RawCorrelation],
    ) -> Result<Vec<Truncation>, Diagnostic> {
        let deviations = match method {
            Method::Grid | Method::Random | Method::Sobol => return Ok(Vec::new()),
            Method::Search => SEARCH_DEVIATIONS,
            Method::Rare => RARE_DEVIATIONS,
        };
        let truncated = truncate_to_accepted(variables, deviations, &|key, value| {
            refusal(template, [(key, Value::Float(value))]).is_none()
        });
        let is_correlated = |truncation: &&Truncation| {
            correlations.iter().any(|correlation| correlation.keys.contains(&truncation.key))
        };
        // The correlation coefficient is that of the distributions in the file.
        if let Some(Truncation { key, range: [low, high], .. }) = truncated.iter().find(is_correlated)
            && method == Method::Rare
        {
            let message = format!(
                "the scenario refuses values outside {low} to {high}, and the value is correlated; expected `truncate`"
            );
            return Err(self.vary_problem(key, message));
        }
        // A search moves normal values to the middle of their range if the scenario refuses a point.
        let deviations = if method == Method::Search { 0.0 } else { deviations };
        for corner in corners(variables, deviations) {
            let values = variables.iter().zip(&corner);
            let changes = values.clone().map(|(variable, value)| (&*variable.key, variable.distribution.value(*value)));
            if let Some(why) = refusal(template, changes) {
                let texts = values
                    .map(|(variable, value)| format!("{} = {}", variable.key, variable.distribution.text(*value)));
                let texts = texts.collect::<Vec<_>>().join(", ");
                let message = format!("the scenario refuses the combination {texts}: {why}; expected smaller ranges");
                return Err(self.file.problem("vary", message));
            }
        }
        Ok(truncated)
    }

    /// Returns the number of trials and the number of cells (combinations of listed values).
    fn counts(&self, plan: &RawPlan, variables: &[Variable]) -> Result<[u64; 2], Diagnostic> {
        let lists = variables.iter().filter_map(|variable| variable.distribution.choices());
        let cells = lists.clone().try_fold(1_u64, |cells, list| cells.checked_mul(list.len() as u64));
        let cells = cells.filter(|cells| *cells <= MAX_CELLS).ok_or_else(|| {
            self.file.problem("vary", format!("more than {MAX_CELLS} combinations of listed values, expected fewer"))
        })?;
        let has_lists = lists.count() > 0;
        if plan.method == Method::Grid && !has_lists {
            let message = "a grid without `steps` or `each`, expected at least one of them, or method `random`";
            return Err(self.file.problem("plan.method", message));
        }
        // A search selects its trials, so their share of failures says nothing about a cell.
        let cells = if has_lists && plan.method != Method::Search { cells } else { 0 };
        let trials = plan.trials.unsigned_abs().checked_mul(if plan.method == Method::Grid { cells } else { 1 });
        let trials = trials.filter(|trials| *trials <= MAX_TRIALS).ok_or_else(|| {
            self.file.problem("plan.trials", format!("{}, expected 1 to {MAX_TRIALS} trials in all", plan.trials))
        })?;
        Ok([trials, cells])
    }
}

#[cfg(test)]
impl Campaign {
    /// Writes a campaign with a step to 2 µm and the metric settling time, and reads it.
    pub(crate) fn example(folder: &Path, vary: &str, plan: &str) -> Self {
        Self::example_with(folder, "", vary, plan)
    }

    /// `expect` are further keys of the expectation, and further expectations.
    pub(crate) fn example_with(folder: &Path, expect: &str, vary: &str, plan: &str) -> Self {
        let scenario = "title = \"Step\"\nplate = \"plate.toml\"\nduration_ms = 20.0\n[profile]\n\
            setpoint_um = { hold = [[0.0, 0.0], [1.0, 2.0]] }\n[[expect]]\nmetric = \"settling_time_ms\"\nat_most = 2.0\n";
        let plate = include_str!("../../../../scenarios/plates/aluminium-198x138.toml");
        let write = |name: &str, text: &str| std::fs::write(folder.join(name), text).unwrap();
        write("plate.toml", plate);
        write("step.toml", &format!("{scenario}{expect}"));
        write("campaign.toml", &format!("title = \"x\"\nscenario = \"step.toml\"\n[vary]\n{vary}\n{plan}"));
        Self::load(&folder.join("campaign.toml")).unwrap()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn problems_of(varied: usize) -> Vec<Diagnostic> {
        let line = |number: usize| format!("\"profile.key_{number}\" = {{ uniform = [1.0, 0.0] }}\n");
        problems_in(&(0..varied).map(line).collect::<String>())
    }

    fn problems_in(vary: &str) -> Vec<Diagnostic> {
        let folder = tempfile::tempdir().unwrap();
        let text =
            format!("title = \"x\"\nscenario = \"none.toml\"\n[plan]\nmethod = \"random\"\ntrials = 1\n[vary]\n{vary}");
        let path = folder.path().join("campaign.toml");
        std::fs::write(&path, text).unwrap();
        Campaign::load(&path).unwrap_err()
    }

    #[test]
    fn each_of_many_wrong_keys_is_named_at_its_line() {
        let problems = problems_of(MAX_VARIED);
        // The first problem is the missing scenario.
        assert_eq!(problems.len(), MAX_VARIED + 1);
        let last = problems.last().unwrap().to_string();
        let line = MAX_VARIED + 6;
        assert!(last.contains(&format!("campaign.toml:{line}:")) && last.contains("profile.key_199"), "{last}");
    }

    #[test]
    fn a_number_out_of_bounds_is_named_at_its_line() {
        let vary = "\"plate.mode.gain_um_per_vpp\" = { uniform = [1.0, 2.0] }\n\
                    \"plate.mode.time_constant_ms\" = { normal = { mean = 1.0, sd = 0.0 } }\n\
                    \"profile.finger_force_n\" = { steps = [0.0, nan, 3] }";
        let problems: Vec<_> = problems_in(vary).iter().map(ToString::to_string).collect();
        let found = |place: &str| problems.iter().any(|problem| problem.contains(place));
        assert!(found("campaign.toml:8:63: `sd`: 0, expected"), "{problems:?}");
        assert!(found("campaign.toml:9:44: `steps`: NaN, expected"), "{problems:?}");
    }

    #[test]
    fn too_many_varied_values_are_refused() {
        let problems = problems_of(MAX_VARIED + 1);
        assert_eq!(problems.len(), 2);
        let message = problems[1].to_string();
        assert!(message.contains("201 varied values, expected at most 200"), "{message}");
    }
}
