//! Plays scenarios on every model of the plate and lists what a simpler model changes.

use crate::measured_run::ChartError;
use crate::measured_run::median;
use crate::measured_run::{LOCKSTEP, MeasuredRun};
use platebench_model::record::{ExpectationRecord, RunRecord};
use platebench_model::scenario::{Expectation, Scenario};
use platebench_plate::Model;
use platebench_report::chart::{StripChart, StripRow};
use platebench_report::document::{Block, Document, Table};
use platebench_report::page::ChartSection;
use platebench_rig::RigSpec;
use std::collections::BTreeMap;

const FILE: &str = "scenes.csv";
const DRAWING: &str = "scenes.svg";
const LISTED_DIFFERENCE: f64 = 0.1;
const SCALE_FLOOR: f64 = 1e-9;

struct MetricResult<'a> {
    own: &'a ExpectationRecord,
    reference: &'a ExpectationRecord,
    /// |value − reference| in units of the tolerance. Infinite if only one of both is a number.
    difference: f64,
}

impl MetricResult<'_> {
    fn is_listed(&self) -> bool {
        self.own.verdict != self.reference.verdict || self.difference > LISTED_DIFFERENCE
    }
}

struct ModelResult<'a> {
    model: Model,
    /// True if the scenario's verdict differs from that on the reference model.
    is_changed: bool,
    metrics: Vec<MetricResult<'a>>,
}

/// Results on all models, from the simplest to the reference model.
struct SceneResult<'a> {
    scenario: &'a Scenario,
    models: Vec<ModelResult<'a>>,
}

struct ModelCost {
    model: Model,
    scenario_count: usize,
    period_us: f64,
}

/// Models that include all effects of the plate. The carrier model is included only if the plate
/// has a converter or the scenario names this model.
pub(crate) fn applicable_models(scenario: &Scenario) -> Vec<Model> {
    let has_carrier = [scenario.model, Model::exact_for(&scenario.plate)].contains(&Model::Carrier);
    let is_complete = |model: &Model| Scenario::omitted_effect(*model, &scenario.plate).is_none();
    Model::ALL.into_iter().filter(|model| *model != Model::Carrier || has_carrier).filter(is_complete).collect()
}

pub fn build_chart(scenarios: &[Scenario], rounds: u32) -> Result<ChartSection, ChartError> {
    let mut records: BTreeMap<&str, RunRecord> = BTreeMap::new();
    let mut costs: BTreeMap<&str, Vec<f64>> = BTreeMap::new();
    // Measures the models in turn, so that other load affects all of them equally.
    for _ in 0..rounds.max(1) {
        for model in Model::ALL {
            let with_model = |scenario: &Scenario| Scenario { model, ..scenario.clone() };
            let own: Vec<_> =
                scenarios.iter().filter(|scene| applicable_models(scene).contains(&model)).map(with_model).collect();
            if own.is_empty() {
                continue;
            }
            let MeasuredRun { record, period_us } = MeasuredRun::play(own, &RigSpec::hosted(), LOCKSTEP)?;
            costs.entry(model.name()).or_default().push(period_us);
            records.insert(model.name(), record);
        }
    }
    let cost = |model: Model| {
        let period_us = median(costs.get(model.name())?.clone());
        Some(ModelCost { model, scenario_count: records.get(model.name())?.scenarios.len(), period_us })
    };
    let costs: Vec<ModelCost> = Model::ALL.into_iter().filter_map(cost).collect();
    let results: Vec<_> = scenarios.iter().filter_map(|scenario| SceneResult::new(scenario, &records)).collect();
    Ok(section(&results, &costs))
}

impl<'a> SceneResult<'a> {
    fn new(scenario: &'a Scenario, records: &'a BTreeMap<&str, RunRecord>) -> Option<Self> {
        let on = |model: Model| records.get(model.name())?.scenarios.iter().find(|scene| scene.file == scenario.file);
        let models = applicable_models(scenario);
        let reference = on(*models.last()?)?;
        let result = |model: Model| {
            let record = on(model)?;
            let both = record.expectations.iter().zip(&reference.expectations);
            let metrics = both
                .zip(&scenario.expectations)
                .map(|((own, reference), expectation)| MetricResult::new(expectation, own, reference));
            let is_changed = record.verdict != reference.verdict;
            Some(ModelResult { model, is_changed, metrics: metrics.collect() })
        };
        Some(Self { scenario, models: models.into_iter().filter_map(result).collect() })
    }
}

impl<'a> MetricResult<'a> {
    fn new(expectation: &Expectation, own: &'a ExpectationRecord, reference: &'a ExpectationRecord) -> Self {
        let difference = match (own.value, reference.value) {
            (Some(value), Some(reference)) if value != reference => (value - reference).abs() / tolerance(expectation),
            (Some(_), None) | (None, Some(_)) => f64::INFINITY,
            _ => 0.0,
        };
        Self { own, reference, difference }
    }
}

/// Half the distance between two limits, or the magnitude of a single limit. It may be 0.
fn tolerance(expectation: &Expectation) -> f64 {
    match expectation.range() {
        (low, high) if low.is_finite() && high > low && high.is_finite() => 0.5 * (high - low),
        (low, high) => if high.is_finite() { high } else { low }.abs(),
    }
}

impl ModelResult<'_> {
    fn largest_difference(&self) -> f64 {
        self.metrics.iter().map(|metric| metric.difference).fold(0.0, f64::max)
    }
}

fn section(results: &[SceneResult<'_>], costs: &[ModelCost]) -> ChartSection {
    let svg = strip_chart(results).svg();
    let (models, differences) = (model_table(results, costs), difference_table(results));
    let caption = format!("{} scenarios: largest difference of a metric on every model", results.len());
    let mut blocks = vec![Block::Details(EXPLANATION.map(Block::paragraph).into())];
    blocks.push(Block::Table(models));
    blocks.push(Block::figure(svg.clone(), caption));
    blocks.push(Block::Table(differences));
    blocks.push(Block::File(FILE.to_owned()));
    ChartSection {
        document: Document::new("Scenarios: models of the plate against the most detailed one", blocks),
        files: vec![(FILE.to_owned(), full_table(results).csv()), (DRAWING.to_owned(), svg)],
    }
}

const EXPLANATION: [&str; 2] = [
    "Every scenario runs on every model of the plate with the hosted controller and is judged. A model is compared \
     with the most detailed one of the scenario: modal, or carrier if the plate has a converter. The difference of a \
     metric is relative to its tolerance: half the distance of two limits, or the size of a single limit.",
    "The table lists changed verdicts and differences of more than a tenth of the tolerance. The cost is processor \
     time of the whole run per control period: plate, controller, trace and judgement. The ring in the drawing marks \
     the model of the scenario.",
];

fn model_table(results: &[SceneResult<'_>], costs: &[ModelCost]) -> Table {
    let mut table = Table::new([
        "model",
        "scenarios",
        "changed verdicts",
        "metrics off by more than a tenth",
        "scenarios with such a metric",
        "CPU time per control period",
    ]);
    for cost in costs {
        let own: Vec<&ModelResult<'_>> =
            results.iter().flat_map(|scene| &scene.models).filter(|model| model.model == cost.model).collect();
        let changed = own.iter().filter(|model| model.is_changed).count();
        let differs = |metric: &&MetricResult<'_>| metric.difference > LISTED_DIFFERENCE;
        let metrics = own.iter().flat_map(|model| &model.metrics).filter(differs).count();
        let scenes = own.iter().filter(|model| model.largest_difference() > LISTED_DIFFERENCE).count();
        table.push(vec![
            cost.model.name().to_owned(),
            cost.scenario_count.to_string(),
            changed.to_string(),
            metrics.to_string(),
            scenes.to_string(),
            format!("{:.2} µs", cost.period_us),
        ]);
    }
    table
}

fn difference_table(results: &[SceneResult<'_>]) -> Table {
    let mut table =
        Table::new(["scenario", "model", "expectation", "value", "most detailed", "in tolerances", "verdict"]);
    for scene in results {
        for model in &scene.models {
            for metric in model.metrics.iter().filter(|metric| metric.is_listed()) {
                let MetricResult { own, reference, difference } = metric;
                let verdict = if own.verdict == reference.verdict {
                    own.verdict.to_string()
                } else {
                    format!("{} instead of {}", own.verdict, reference.verdict)
                };
                table.push(vec![
                    scene.scenario.name().to_owned(),
                    model.model.name().to_owned(),
                    own.name.clone(),
                    format_value(own.value),
                    format_value(reference.value),
                    if difference.is_finite() { format!("{difference:.2}") } else { "–".to_owned() },
                    verdict,
                ]);
            }
        }
    }
    table
}

fn format_value(value: Option<f64>) -> String {
    value.map_or_else(|| "–".to_owned(), |value| format!("{value:.4}"))
}

fn full_table(results: &[SceneResult<'_>]) -> Table {
    let mut table = Table::new([
        "scenario",
        "law",
        "scenario_model",
        "model",
        "expectation",
        "value",
        "reference_value",
        "difference_in_tolerances",
        "verdict",
        "reference_verdict",
    ]);
    let number = |value: Option<f64>| value.map_or_else(String::new, |value| value.to_string());
    for SceneResult { scenario, models } in results {
        for model in models {
            for MetricResult { own, reference, difference } in &model.metrics {
                table.push(vec![
                    scenario.file.clone(),
                    scenario.controller.law.clone(),
                    scenario.model.name().to_owned(),
                    model.model.name().to_owned(),
                    own.name.clone(),
                    number(own.value),
                    number(reference.value),
                    difference.to_string(),
                    own.verdict.to_string(),
                    reference.verdict.to_string(),
                ]);
            }
        }
    }
    table
}

fn strip_chart(results: &[SceneResult<'_>]) -> StripChart {
    let colour = |model: Model| Model::ALL.iter().position(|known| *known == model).unwrap_or_default();
    let row = |scene: &SceneResult<'_>| {
        let changed = scene.models.iter().filter(|model| model.is_changed);
        let names: Vec<&str> = changed.map(|model| model.model.name()).collect();
        let note = if names.is_empty() { String::new() } else { format!("verdict changes: {}", names.join(", ")) };
        StripRow {
            name: scene.scenario.name().to_owned(),
            limit: Some(LISTED_DIFFERENCE),
            values: scene.models.iter().map(|model| (colour(model.model), model.largest_difference())).collect(),
            chosen_colour: colour(scene.scenario.model),
            note,
        }
    };
    StripChart {
        title: "Models of the plate against the most detailed one".to_owned(),
        x_label: "largest difference of a metric / its tolerance".to_owned(),
        floor: SCALE_FLOOR,
        colours: Model::ALL.map(|model| model.name().to_owned()).into(),
        chosen_label: "ring: model of the scenario".to_owned(),
        limit_label: "a tenth of the tolerance".to_owned(),
        rows: results.iter().map(row).collect(),
    }
}
