//! Plays scenarios on every model of the plate and lists what a simpler model changes.

use crate::measured_run::ChartError;
use crate::measured_run::median;
use crate::measured_run::{LOCKSTEP, MeasuredRun};
use platebench_document::chart::marks::{Axis, Mark, Role, Scale, Shape, Ticks, decades, format_power_of_ten};
use platebench_document::chart::panels::{LegendEntry, Panel, PanelAxis, PanelChart, Symbol};
use platebench_document::format::with_decimals;
use platebench_document::{Block, ChartSection, Document, Table};
use platebench_model::record::{ExpectationRecord, RunRecord};
use platebench_model::scenario::{Expectation, Scenario};
use platebench_plate::Model;
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
    let svg = difference_chart(results).svg();
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
                    with_decimals(own.value, 4),
                    with_decimals(reference.value, 4),
                    with_decimals(difference.is_finite().then_some(*difference), 2),
                    verdict,
                ]);
            }
        }
    }
    table
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

const CHART_WIDTH: f64 = 980.0;
const LINE_HEIGHT: f64 = 16.0;
/// Heights of title and labels of the panel.
const MARGINS: f64 = 84.0;
/// Ratio of the first tick to the left edge: one decade is reserved for differences of exactly 0.
const ZERO_AREA_RATIO: f64 = 10.0;

/// One line of points per scenario on one logarithmic axis, one colour per model.
fn difference_chart(results: &[SceneResult<'_>]) -> PanelChart {
    let differences = results.iter().flat_map(|scene| &scene.models).map(ModelResult::largest_difference);
    let positive = differences.filter(|difference| *difference > 0.0).map(|difference| difference.max(SCALE_FLOOR));
    let xs = decades(positive.chain([LISTED_DIFFERENCE]));
    let left = xs.start / ZERO_AREA_RATIO;
    // The position of 0 is in the middle of its decade.
    let zero = left * ZERO_AREA_RATIO.sqrt();
    let x_ticks = |axis: &Axis| {
        let decades = axis.ticks(usize::MAX).into_iter().filter(|decade| *decade > left * 1.01);
        let mut ticks = Ticks::new(decades.collect(), true, format_power_of_ten);
        ticks.texts.insert(0, (zero, "0".to_owned()));
        ticks
    };
    let names: Vec<String> = results.iter().map(SceneResult::name_with_changes).collect();
    let x_label = "largest difference of a metric / its tolerance";
    let panel = Panel {
        title: String::new(),
        x: PanelAxis::new(x_label, Scale::Logarithmic, left..xs.end, x_ticks),
        y: PanelAxis::names("", &names, usize::MAX).downwards(),
        cells: Vec::new(),
        marks: results.iter().enumerate().flat_map(|(number, scene)| scene.marks(number as f64, zero)).collect(),
    };
    let rest = [
        LegendEntry::new(Symbol::Point(Role::Series(0), Shape::Ring), "ring: model of the scenario"),
        LegendEntry::new(Symbol::Line(Role::Axis), "a tenth of the tolerance"),
    ];
    PanelChart {
        title: "Models of the plate against the most detailed one".to_owned(),
        has_heading: true,
        panel_size: (CHART_WIDTH, MARGINS + LINE_HEIGHT * results.len() as f64),
        columns: 1,
        panels: vec![panel],
        legend: LegendEntry::series(Model::ALL.map(Model::name)).chain(rest).collect(),
    }
}

impl SceneResult<'_> {
    fn name_with_changes(&self) -> String {
        let changed = self.models.iter().filter(|model| model.is_changed).map(|model| model.model.name());
        match &*changed.collect::<Vec<_>>() {
            [] => self.scenario.name().to_owned(),
            names => format!("{} (verdict changes: {})", self.scenario.name(), names.join(", ")),
        }
    }

    /// Marks of the line that begins at `top`. A difference of 0 lies at `zero`.
    fn marks(&self, top: f64, zero: f64) -> Vec<Mark> {
        let mut marks = vec![Mark::Line(Role::Axis, [0.1, 0.9].map(|y| (LISTED_DIFFERENCE, top + y)).into())];
        // The circle of the simplest model is the smallest and is drawn last, so that circles with
        // the same value are all visible.
        for model in self.models.iter().rev() {
            let colour = Model::ALL.iter().position(|known| *known == model.model).unwrap_or_default();
            let (role, difference) = (Role::Series(colour), model.largest_difference());
            if !difference.is_finite() {
                continue;
            }
            let at = (if difference > 0.0 { difference.max(SCALE_FLOOR) } else { zero }, top + 0.5);
            marks.push(Mark::point(role, at, Shape::Disc, 2.5 + colour as f64));
            if model.model == self.scenario.model {
                marks.push(Mark::point(role, at, Shape::Ring, 7.0));
            }
        }
        marks
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use platebench_model::record::Telemetry;
    use platebench_test_kit::load_scenario;
    use platebench_verdict::{judge, measure};

    /// Draws a line per scene, with differences of the models `linear` and `modal`.
    fn svg(scenes: &[(Model, [f64; 2], bool)]) -> String {
        let scenario = load_scenario("paper/fig13-closed-loop.toml");
        let measures = measure(&scenario, 0, &[], &Telemetry::default());
        let record = judge(&scenario, &[measures]).expectations.remove(0);
        let scenarios: Vec<Scenario> =
            scenes.iter().map(|(model, ..)| Scenario { model: *model, ..scenario.clone() }).collect();
        let results = scenarios.iter().zip(scenes).map(|(scenario, (_, differences, is_changed))| {
            let models = [Model::Linear, Model::Modal].into_iter().zip(differences).map(|(model, difference)| {
                let metric = MetricResult { own: &record, reference: &record, difference: *difference };
                ModelResult { model, is_changed: *is_changed && model == Model::Linear, metrics: vec![metric] }
            });
            SceneResult { scenario, models: models.collect() }
        });
        difference_chart(&results.collect::<Vec<_>>()).svg()
    }

    #[test]
    fn draws_marks_limits_rings_and_legend() {
        let svg = svg(&[(Model::Modal, [2e-2, 0.0], true), (Model::Linear, [2e-2, 0.0], false)]);
        // One ring in the legend and one per line, in the colour of the scenario's model.
        let rings = |colour: usize| svg.matches(&format!("class=\"s-series-{colour}\"")).count();
        assert_eq!((rings(0), rings(2)), (2, 1), "{svg}");
        insta::assert_snapshot!(svg.replace("><", ">\n<"));
    }

    #[test]
    fn draws_charts_without_lines_and_without_numbers() {
        assert!(svg(&[]).contains(">a tenth of the tolerance<"));
        let odd = svg(&[(Model::Modal, [f64::INFINITY, f64::NAN], false)]);
        assert!(odd.contains(">paper/fig13-closed-loop<") && !odd.contains("NaN"), "{odd}");
    }
}
