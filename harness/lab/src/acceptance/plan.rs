//! Reads the plan of a session: requirements, scenarios, questions.

use crate::acceptance::judge::PlanDecision;
use platebench_model::scenario::{
    Diagnostic, FileChecker, Limit, MAX_TRIALS, Requirement, Scenario, find, parse_bytes, schema,
};
use platebench_verdict::uncertainty::{Budget, DecisionRule, known_quantities};
use schemars::{JsonSchema, Schema};
use serde::Deserialize;
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

const MAX_CLEAN_RUNS: u32 = 1_000_000;

/// A plan file as serde reads it.
#[derive(Debug, Clone, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
#[schemars(extend("required" = ["title", "requirement", "scenario"]))]
struct RawPlan {
    /// Title, one line.
    #[schemars(length(min = 1))]
    title: String,
    /// Trials of each scenario, instead of the number in its file.
    #[serde(default = "thirty")]
    #[schemars(range(min = 1, max = MAX_TRIALS))]
    repetitions: u32,
    /// Requirements; at least one.
    #[serde(default)]
    #[schemars(length(min = 1))]
    requirement: Vec<Requirement>,
    /// Scenarios; at least one.
    #[serde(default)]
    #[schemars(length(min = 1))]
    scenario: Vec<RawPlannedScenario>,
    /// Questions to the operator.
    #[serde(default)]
    ask: Vec<Ask>,
    /// Demands on the bench.
    #[serde(default)]
    bench: BenchDemands,
    /// Decision rule. Without it, verdicts do not consider the uncertainty of measurement.
    decision: Option<RawDecision>,
}

/// Decision rule and uncertainty budget.
#[derive(Debug, Clone, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
struct RawDecision {
    /// Decision rule.
    rule: DecisionRule,
    /// Budget file, relative to the plan.
    budget: PathBuf,
    /// Largest expanded uncertainty in percent of the tolerance, only for shared-risk.
    #[schemars(range(min = 0.1, max = 100.0))]
    largest_uncertainty_percent: Option<f64>,
}

const fn thirty() -> u32 {
    30
}

#[derive(Debug, Clone, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
struct RawPlannedScenario {
    /// Scenario file, relative to the plan.
    file: PathBuf,
    /// Trials of this scenario, by default as many as the plan states.
    #[schemars(range(min = 1, max = MAX_TRIALS))]
    repetitions: Option<u32>,
}

/// A question to the operator.
#[derive(Debug, Clone, PartialEq, Eq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Ask {
    /// Short name, unique in the plan.
    #[schemars(regex(pattern = "^[A-Za-z0-9-]+$"))]
    pub id: String,
    /// The question.
    #[schemars(length(min = 1))]
    pub question: String,
    /// Kind of answer.
    #[serde(default)]
    pub answer: AnswerKind,
    /// Time of the question.
    #[serde(default)]
    pub when: QuestionTime,
}

/// Kind of answer.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum AnswerKind {
    /// Yes or no. Without a yes the session does not pass.
    #[default]
    Confirm,
    /// A line of text, which is only recorded.
    Text,
    /// A number, which is only recorded. The question is repeated until the answer is a number.
    Number,
}

/// Time of a question.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum QuestionTime {
    /// Before the first scenario. A no stops the session. A missing answer stops it if the rig may
    /// drive a plate.
    #[default]
    Before,
    /// After the last scenario. A no prevents a pass.
    After,
}

/// Demands on the bench.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct BenchDemands {
    /// Trials of the shortest scenario in real time with the hosted controller, which measure
    /// lateness.
    #[schemars(range(min = 1, max = 1_000))]
    pub timing_trials: u32,
    /// Runs of the scenarios with correct controllers. None may fail.
    #[schemars(range(min = 1, max = MAX_CLEAN_RUNS))]
    pub clean_runs: u32,
    /// Smallest allowed kill rate of all scenarios together, percent. The lower 95 % bound must
    /// reach it.
    #[schemars(range(min = 0.0, max = 100.0))]
    pub least_kill_rate_percent: f64,
}

impl Default for BenchDemands {
    fn default() -> Self {
        Self { timing_trials: 5, clean_runs: 300, least_kill_rate_percent: 0.0 }
    }
}

#[derive(Debug, Clone)]
pub struct RepeatedScenario {
    pub scenario: Scenario,
    pub repetitions: u32,
}

#[derive(Debug, Clone)]
pub struct AcceptancePlan {
    pub bytes: Vec<u8>,
    pub title: String,
    pub requirements: Vec<Requirement>,
    pub scenarios: Vec<RepeatedScenario>,
    pub asks: Vec<Ask>,
    pub bench: BenchDemands,
    pub decision: Option<PlanDecision>,
}

impl AcceptancePlan {
    pub fn load(path: &Path) -> Result<Self, Vec<Diagnostic>> {
        let (mut checker, raw) = FileChecker::read::<RawPlan>(path)?;
        raw.check(&mut checker);
        let mut scenarios: Vec<RepeatedScenario> = Vec::new();
        for (number, planned) in raw.scenario.iter().enumerate() {
            let key = format!("scenario.{number}.file");
            let file = checker.neighbour(&planned.file);
            if file.is_dir() {
                checker.report(&key, format!("{} is a folder, expected a scenario file", file.display()));
                continue;
            }
            let repetitions = planned.repetitions.unwrap_or(raw.repetitions);
            for scenario in checker.accept(find(&[file])).into_iter().flat_map(|found| found.scenarios) {
                if scenarios.iter().any(|other| other.scenario.name() == scenario.name()) {
                    checker.report(&key, format!("`{}` is in the plan twice", scenario.file));
                }
                checker.extend(unknown_requirements(&scenario, &raw.requirement));
                scenarios.push(RepeatedScenario { scenario, repetitions });
            }
        }
        let mut decision = None;
        if let Some(raw) = &raw.decision {
            let budget = Budget::load(&checker.neighbour(&raw.budget), &known_quantities());
            decision = checker.accept(budget).map(|budget| raw.with_budget(budget));
        }
        if let Some(decision) = &decision {
            check_decidable(&mut checker, decision, &scenarios);
        }
        let bytes = checker.finish()?.into_bytes();
        let RawPlan { title, requirement, ask, bench, .. } = raw;
        Ok(Self { bytes, title, requirements: requirement, scenarios, asks: ask, bench, decision })
    }
}

impl RawDecision {
    fn with_budget(&self, budget: Budget) -> PlanDecision {
        PlanDecision { rule: self.rule, largest_percent: self.largest_uncertainty_percent.unwrap_or(100.0), budget }
    }
}

pub(crate) fn read_recorded_plan(
    path: &Path,
    bytes: Vec<u8>,
    budget: &Path,
) -> Result<(Vec<Requirement>, Option<PlanDecision>), Vec<Diagnostic>> {
    let (_, raw) = parse_bytes::<RawPlan>(path, bytes)?;
    let decision = match raw.decision {
        Some(raw) => Some(raw.with_budget(Budget::load(budget, &known_quantities())?)),
        None => None,
    };
    Ok((raw.requirement, decision))
}

/// Reports scenarios that the decision rule cannot judge. Except with rule `simple`, each
/// expectation of a requirement needs a budget and must not be `about`.
fn check_decidable(checker: &mut FileChecker, decision: &PlanDecision, scenarios: &[RepeatedScenario]) {
    if decision.rule == DecisionRule::Simple {
        return;
    }
    for RepeatedScenario { scenario, .. } in scenarios {
        for (number, expectation) in scenario.expectations.iter().enumerate() {
            if expectation.requirement.is_none() {
                continue;
            }
            if matches!(expectation.limit, Limit::About(_)) {
                let message = format!("the rule {} needs a limit, expected `within` instead of `about`", decision.rule);
                checker.extend([scenario.diagnostic(&format!("expect.{number}.about"), message)]);
            }
            let metric = expectation.metric;
            checker.require(decision.budget.quantity(metric.name()).is_some(), "decision.budget", || {
                format!("the rule {} needs a [[budget]] for {metric}, which {} expects", decision.rule, scenario.file)
            });
        }
    }
}

pub fn plan_schema() -> Schema {
    schema::schema_of::<RawPlan>("platebench acceptance plan")
}

impl RawPlan {
    fn check(&self, checker: &mut FileChecker) {
        checker.require_one_line("title", &self.title);
        checker.require(!self.requirement.is_empty(), "requirement", || {
            "no [[requirement]], expected at least one".to_owned()
        });
        checker.require(!self.scenario.is_empty(), "scenario", || "no [[scenario]], expected at least one".to_owned());
        let requirements = self.requirement.iter().map(|requirement| (&requirement.id, &requirement.text));
        check_entries(checker, "requirement", "text", "identifier", requirements);
        check_entries(checker, "ask", "question", "name", self.ask.iter().map(|ask| (&ask.id, &ask.question)));
        let Some(RawDecision { rule, largest_uncertainty_percent, .. }) = &self.decision else { return };
        let has_limit = largest_uncertainty_percent.is_some();
        let needs_limit = *rule == DecisionRule::SharedRisk;
        checker.require(has_limit || !needs_limit, "decision.rule", || {
            "shared-risk needs `largest_uncertainty_percent`".to_owned()
        });
        checker.require(needs_limit || !has_limit, "decision.largest_uncertainty_percent", || {
            format!("this limit is only for shared-risk, but the rule is {rule}")
        });
    }
}

fn check_entries<'a>(
    checker: &mut FileChecker,
    list: &str,
    text_key: &str,
    id_word: &str,
    entries: impl Iterator<Item = (&'a String, &'a String)>,
) {
    let mut known = BTreeSet::new();
    for (number, (id, text)) in entries.enumerate() {
        checker.require(!text.trim().is_empty(), &format!("{list}.{number}.{text_key}"), || {
            format!("empty, expected a {text_key}")
        });
        checker.require(is_valid_name(id) && known.insert(id), &format!("{list}.{number}.id"), || {
            format!("`{id}`, expected letters, digits and -, and another {id_word} in each [[{list}]]")
        });
    }
}

fn is_valid_name(text: &str) -> bool {
    !text.is_empty() && text.chars().all(|letter| letter.is_ascii_alphanumeric() || letter == '-')
}

fn unknown_requirements(scenario: &Scenario, known: &[Requirement]) -> Vec<Diagnostic> {
    let named = scenario.expectations.iter().map(|expectation| expectation.requirement.as_deref()).enumerate();
    let unknown = named.filter_map(|(number, id)| Some((number, id?)));
    unknown
        .filter(|(_, id)| known.iter().all(|requirement| requirement.id != *id))
        .map(|(number, id)| {
            let message = format!("the plan has no requirement `{id}`, expected a [[requirement]] with this id");
            scenario.diagnostic(&format!("expect.{number}.requirement"), message)
        })
        .collect()
}
