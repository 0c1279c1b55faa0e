//! Describes the comparison of responses with their baseline or with another run.

use crate::document::{Block, Document};
use crate::format;
use platebench_verdict::golden::TubeComparison;
use schemars::JsonSchema;
use serde::Serialize;
use std::path::PathBuf;

#[derive(Debug, Clone, PartialEq, Serialize, JsonSchema)]
pub struct ScenarioComparison {
    pub scenario: String,
    #[serde(flatten)]
    pub comparison: TubeComparison,
    /// File with a drawing of the largest deviation.
    pub drawing: Option<PathBuf>,
}

pub fn document(comparisons: &[ScenarioComparison]) -> Document {
    let blocks = comparisons.iter().flat_map(|ScenarioComparison { scenario, comparison, drawing }| {
        let drawing = drawing.iter().map(|path| format!("  drawing: {}", path.display()));
        blocks(scenario, comparison, drawing)
    });
    Document::new("Comparison of responses", blocks.collect())
}

/// The verdict, the largest deviation and the reason, followed by `further` lines.
pub fn blocks(name: &str, comparison: &TubeComparison, further: impl IntoIterator<Item = String>) -> Vec<Block> {
    let trials = format::count(comparison.trials, "trial");
    let mut lines = Vec::new();
    lines.extend(comparison.worst.as_ref().map(|(trial, worst)| format!("  {}", format::exceedance(*trial, worst))));
    lines.extend(comparison.reason.as_ref().map(|reason| format!("  {reason}")));
    lines.extend(further);
    let verdict = Block::Verdict(comparison.verdict, format!("{name}  ({trials})"));
    std::iter::once(verdict).chain((!lines.is_empty()).then(|| Block::lines(lines))).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::document::Style;
    use platebench_model::trace::Row;
    use platebench_verdict::golden::GoldenTubes;

    #[test]
    fn names_signal_time_distance_and_trial() {
        let rows = |height: f64| -> Vec<Row> {
            let amplitude = |index: u32| if index >= 100 { height } else { 0.0 };
            (0..=300)
                .map(|index| Row { t_s: f64::from(index) * 1e-4, amplitude_um: amplitude(index), ..Row::default() })
                .collect()
        };
        let (good, bad) = (rows(2.0), rows(2.5));
        let comparison = GoldenTubes::from_rows(&good).unwrap().compare([(0, good.as_slice()), (7, bad.as_slice())]);
        let (scenario, drawing) = ("paper/step.toml".to_owned(), Some("comparison/paper/step.svg".into()));
        let compared = ScenarioComparison { scenario, comparison, drawing };
        assert_eq!(
            document(&[compared]).to_console(None, Style::default()),
            "✗ fail  paper/step.toml  (2 trials)\n  \
             trial 7: amplitude_um is 2.5 µm at 10 ms, 0.48 µm outside ± 0.02 µm around 2 µm\n  \
             1 of 2 trials are outside the tube\n  \
             drawing: comparison/paper/step.svg\n"
        );
    }
}
