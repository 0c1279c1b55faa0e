//! Describes comparisons: of responses with their baseline or with another run, and of commands with
//! those of a recording. Draws the place where a response leaves its tolerance tube, in characters.

use crate::format;
use platebench_document::chart::marks::extent;
use platebench_document::{Block, Document};
use platebench_model::quoted;
use platebench_model::record::ViolationKind;
use platebench_model::trace::Row;
use platebench_verdict::golden::TubeComparison;
use platebench_verdict::replay::{CommandDifference, ReplayResult};
use platebench_verdict::tube::{Exceedance, Tube, TubeSignal, signal_response};
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

pub fn comparison_document(comparisons: &[ScenarioComparison]) -> Document {
    let blocks = comparisons.iter().flat_map(|ScenarioComparison { scenario, comparison, drawing }| {
        let drawing = drawing.iter().map(|path| format!("  drawing: {}", path.display()));
        comparison_blocks(scenario, comparison, drawing)
    });
    Document::new("Comparison of responses", blocks.collect())
}

/// The verdict, the largest deviation and the reason, followed by `further` lines.
pub fn comparison_blocks(
    name: &str,
    comparison: &TubeComparison,
    further: impl IntoIterator<Item = String>,
) -> Vec<Block> {
    let trials = format::count(comparison.trials, "trial");
    let mut lines = Vec::new();
    lines.extend(comparison.worst.as_ref().map(|(trial, worst)| format!("  {}", format::exceedance(*trial, worst))));
    lines.extend(comparison.reason.as_ref().map(|reason| format!("  {reason}")));
    lines.extend(further);
    let verdict = Block::Verdict(comparison.verdict, format!("{name}  ({trials})"));
    std::iter::once(verdict).chain((!lines.is_empty()).then(|| Block::lines(lines))).collect()
}

const COLUMNS: usize = 64;
const ROWS: usize = 12;
const MARGIN_MS: f64 = 5.0;

/// Draws the tube as `.`, the golden curve as `-` and the response as `#`.
pub fn tube_plot_document(tube: &Tube, rows: &[Row], trial: u32, worst: &Exceedance) -> Document {
    let place = format!("  {}", format::exceedance(trial, worst));
    let lines = std::iter::once(place).chain(tube_plot(tube, rows, worst));
    Document::new("Response outside its tolerance tube", vec![Block::lines(lines)])
}

fn tube_plot(tube: &Tube, rows: &[Row], worst: &Exceedance) -> Vec<String> {
    let (first, last) = tube.span_ms();
    let (from, to) = ((worst.t_ms - MARGIN_MS).max(first), (worst.t_ms + MARGIN_MS).min(last));
    let response = TubeSignal::from_name(&tube.signal).map(|signal| signal_response(signal, rows)).unwrap_or_default();
    let at = |column: usize| from + (to - from) * column as f64 / (COLUMNS - 1) as f64;
    let held = |t_ms: f64| {
        let next = response.partition_point(|point| point.0 <= t_ms);
        next.checked_sub(1).and_then(|index| response.get(index)).map(|point| point.1)
    };
    let columns: Vec<([f64; 2], f64, Option<f64>)> =
        (0..COLUMNS).map(at).map(|t_ms| (tube.edges(t_ms), tube.point_at(t_ms).value, held(t_ms))).collect();
    let values = columns.iter().flat_map(|(edges, _, value)| edges.iter().copied().chain(*value)).chain([worst.value]);
    let (low, high) = extent(values).unwrap_or_default();
    let span = (high - low).max(f64::MIN_POSITIVE);
    let row = |value: f64| ((high - value) / span * (ROWS - 1) as f64).round().clamp(0.0, (ROWS - 1) as f64) as usize;
    let mark = |line: usize, (edges, golden, value): &([f64; 2], f64, Option<f64>)| match value {
        Some(value) if row(*value) == line => '#',
        _ if row(*golden) == line => '-',
        _ if (row(edges[1])..=row(edges[0])).contains(&line) => '.',
        _ => ' ',
    };
    let label = |line: usize| match line {
        0 => format::number(high),
        line if line == ROWS - 1 => format::number(low),
        _ => String::new(),
    };
    let drawn = |line: usize| {
        let text: String = columns.iter().map(|column| mark(line, column)).collect();
        format!("  {:>9} |{}", label(line), text.trim_end())
    };
    let unit = TubeSignal::from_name(&tube.signal).map_or("", |signal| signal.unit);
    let title = format!("  {}, {unit}   # this run   - golden   . tolerance tube", tube.signal);
    let axis = format!("  {:>9} {:<32}{:>32} ms", "", format::number(from), format::number(to));
    std::iter::once(title).chain((0..ROWS).map(drawn)).chain([axis]).collect()
}

pub const OPEN_LOOP: &str =
    "open loop: the samples are recorded and do not react to the commands; this judges commands, not control";

pub fn replay_document(result: &ReplayResult) -> Document {
    let ReplayResult { verdict, compared, samples, identical, .. } = result;
    let mut lines = vec![
        format!("  rig {}, firmware {}, law {}", quoted(&result.rig), quoted(&result.firmware), quoted(&result.law)),
        format!("  {OPEN_LOOP}"),
        format!(
            "  {} sent, {compared} commands compared, {identical} equal bit for bit",
            format::count(*samples, "sample")
        ),
    ];
    lines.extend(result.differences.iter().map(difference));
    let outside = result.differences.iter().filter_map(|difference| difference.exceedance.as_ref());
    lines.extend(outside.map(|worst| format!("  {}", format::outside_tube(worst))));
    lines.extend(result.violations.iter().map(|violation| format!("  {violation}")));
    lines.extend(result.stopped.iter().map(|cause| format!("  the controller stopped: {cause}")));
    lines.extend(result.ended.iter().map(|cause| format!("  the session ended: {cause}")));
    if result.missed_replies > 0 {
        lines.push(format!("  {} without a reply", format::count(result.missed_replies, "sample")));
    }
    lines.extend(result.recording_end.iter().map(|end| format!("  {end}")));
    // A drive after confirmed 0 V is among the violations.
    if !result.safe_confirmed && !result.violations.iter().any(|one| one.kind == ViolationKind::DriveAfterSafe) {
        lines.push("  the controller did not confirm 0 V".to_owned());
    }
    let blocks = vec![Block::Verdict(*verdict, result.recording.clone()), Block::lines(lines)];
    Document::new(format!("Replay of {}", result.recording), blocks)
}

fn difference(difference: &CommandDifference) -> String {
    let CommandDifference { signal, unit, largest, at_ms, .. } = difference;
    if !largest.is_finite() {
        return format!("  {signal}: a command at {} ms is not a number", format::number(*at_ms));
    }
    let place = if *largest > 0.0 { format!(" at {} ms", format::number(*at_ms)) } else { String::new() };
    format!("  {signal}: largest difference {} {unit}{place}", format::number(*largest))
}

#[cfg(test)]
mod tests {
    use super::*;
    use platebench_document::Style;
    use platebench_model::record::{Verdict, Violation};
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
            comparison_document(&[compared]).to_console(None, Style::default()),
            "✗ fail  paper/step.toml  (2 trials)\n  \
             trial 7: amplitude_um is 2.5 µm at 10 ms, 0.48 µm outside ± 0.02 µm around 2 µm\n  \
             1 of 2 trials are outside the tube\n  \
             drawing: comparison/paper/step.svg\n"
        );
    }

    #[test]
    fn draws_tube_golden_curve_and_response() {
        let rows = |height: f64| -> Vec<Row> {
            let amplitude = |index: u32| if index >= 100 { height } else { 0.0 };
            let row =
                |index: u32| Row { t_s: f64::from(index) * 1e-4, amplitude_um: amplitude(index), ..Row::default() };
            (0..=300).map(row).collect()
        };
        let golden = GoldenTubes::from_rows(&rows(2.0)).unwrap();
        let bad = rows(2.5);
        let worst = golden.exceedances(&bad);
        assert_eq!(worst.iter().map(|found| found.signal.as_str()).collect::<Vec<_>>(), ["amplitude_um"]);
        insta::assert_snapshot!(tube_plot(&golden.tubes[0], &bad, &worst[0]).join("\n"));
    }

    #[test]
    fn a_drive_after_0_v_is_no_missing_confirmation() {
        let kind = ViolationKind::DriveAfterSafe;
        let mut result = ReplayResult {
            verdict: Verdict::Fail,
            open_loop: true,
            recording: "000.csv".to_owned(),
            rig: "hosted".to_owned(),
            firmware: "test".to_owned(),
            law: "dq-pi".to_owned(),
            samples: 5,
            compared: 5,
            identical: 5,
            differences: Vec::new(),
            missed_replies: 0,
            violations: vec![Violation { kind, at_s: 5e-3, count: 1, worst: Some(12.0), limit: None }],
            stopped: None,
            ended: None,
            rig_lost: false,
            recording_end: None,
            safe_confirmed: false,
        };
        let text = |result: &ReplayResult| replay_document(result).to_console(None, Style::default());
        assert!(!text(&result).contains("did not confirm 0 V"), "{}", text(&result));
        result.violations.clear();
        assert!(text(&result).ends_with("  the controller did not confirm 0 V\n"), "{}", text(&result));
    }
}
