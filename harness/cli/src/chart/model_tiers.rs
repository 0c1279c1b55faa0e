//! Draws how far each model of the plate is from the exact one, scenario by scenario.

use super::{ChartError, ChartFolder, ChartSection, format_count, quote_csv_field};
use platebench_plate::Tier;
use platebench_report::chart::{StripChart, StripRow};
use platebench_report::page::PageBlock;
use platebench_rig::CancelToken;
use platebench_runner::fidelity::{TierDeviation, tier_deviations};
use platebench_scenario::Scenario;
use std::fmt::Write as _;

const FILE: &str = "scenes.csv";
const DRAWING: &str = "scenes.svg";
/// Smaller errors are drawn here.
const SCALE_FLOOR: f64 = 1e-9;

/// The deviations measured on one scenario.
struct TierResult {
    file: String,
    law: String,
    /// The model that the scenario is played on.
    tier: Tier,
    /// Of [`Tier::ALL`], cheapest first.
    errors: Vec<TierDeviation>,
}

impl TierResult {
    fn measure(scenario: &Scenario) -> Result<Self, ChartError> {
        let errors = tier_deviations(scenario, &CancelToken::default())
            .map_err(|error| ChartError::NotPlayed { file: scenario.file.clone(), why: error.to_string() })?;
        Ok(Self { file: scenario.file.clone(), law: scenario.controller.law.clone(), tier: scenario.tier, errors })
    }
}

/// Plays every scenario on every tier and draws the deviations.
pub(crate) fn build_chart(scenarios: &[Scenario], folder: &ChartFolder) -> Result<ChartSection, ChartError> {
    let results = scenarios.iter().map(TierResult::measure).collect::<Result<Vec<_>, _>>()?;
    folder.write(FILE, &format_csv(&results))?;
    let svg = strip_chart(&results).svg()?;
    folder.write(DRAWING, &svg)?;
    let summary = format!("{} played on {} models.", format_count(results.len(), "scenario"), Tier::ALL.len());
    let caption = format!("{}: error of every model", format_count(results.len(), "scenario"));
    let blocks = vec![
        PageBlock::Text(EXPLANATION.to_owned()),
        PageBlock::Text(summary.clone()),
        PageBlock::Drawings(vec![(svg, caption)]),
        PageBlock::File(FILE.to_owned()),
    ];
    Ok(ChartSection { blocks, summary: summary + "\n" })
}

const EXPLANATION: &str = "For every scenario: the largest |ΔW|/setpoint between each model of the plate and the exact \
    one, over the rows that the expectations judge, with the law in the loop on the hosted rig. Exact models are \
    drawn at 0. The ring marks the model that the scenario is played on.";

fn format_csv(results: &[TierResult]) -> String {
    let mut text = "scenario,law,model".to_owned();
    for what in ["error", "error_anywhere"] {
        text.extend(Tier::ALL.map(|tier| format!(",{what}_{}", tier.name())));
    }
    text.push('\n');
    for row in results {
        let _ = write!(text, "{},{},{}", quote_csv_field(&row.file), row.law, row.tier.name());
        text.extend(row.errors.iter().map(|error| format!(",{:e}", error.in_windows)));
        text.extend(row.errors.iter().map(|error| format!(",{:e}", error.overall)));
        text.push('\n');
    }
    text
}

fn strip_chart(results: &[TierResult]) -> StripChart {
    let row = |result: &TierResult| StripRow {
        name: result.file.trim_end_matches(".toml").to_owned(),
        limit: None,
        values: result.errors.iter().enumerate().map(|(index, error)| (index, error.in_windows)).collect(),
        chosen_colour: result.errors.iter().position(|error| error.tier == result.tier).unwrap_or_default(),
        note: String::new(),
    };
    StripChart {
        title: "Models of the plate against the exact one".to_owned(),
        x_label: "largest |ΔW| / setpoint".to_owned(),
        floor: SCALE_FLOOR,
        colours: Tier::ALL.map(|tier| tier.name().to_owned()).into(),
        chosen_label: "ring: model of the scenario".to_owned(),
        limit_label: "budget".to_owned(),
        rows: results.iter().map(row).collect(),
    }
}
