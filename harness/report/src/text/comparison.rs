//! Describes comparisons: of responses with their baseline or with another run, and of commands with
//! those of a recording. Draws the place where a response leaves its tolerance tube, in characters.

use crate::format;
use platebench_document::chart::marks::extent;
use platebench_document::format::NOTHING;
use platebench_document::{Block, Document, Table};
use platebench_model::quoted;
use platebench_model::record::{RunRecord, ScenarioRecord, Verdict, ViolationKind};
use platebench_model::trace::Row;
use platebench_verdict::golden::{BaselineBuild, JudgedResponse, TubeComparison, judged_values};
use platebench_verdict::replay::{CommandDifference, ReplayResult};
use platebench_verdict::tube::{Exceedance, Tube, TubeSignal, signal_response};
use schemars::JsonSchema;
use serde::Serialize;
use std::collections::BTreeMap;
use std::fmt::{self, Display, Formatter};
use std::path::PathBuf;

#[derive(Debug, Clone, PartialEq, Serialize, JsonSchema)]
pub struct ScenarioComparison {
    pub scenario: String,
    #[serde(flatten)]
    pub comparison: TubeComparison,
    #[serde(flatten)]
    pub changes: ResponseChanges,
    /// File with a drawing of the largest deviation.
    pub drawing: Option<PathBuf>,
    /// The drawing in characters.
    #[serde(skip)]
    pub plot: Vec<String>,
}

/// What differs from the response that was accepted.
#[derive(Debug, Clone, PartialEq, Default, Serialize, JsonSchema)]
pub struct ResponseChanges {
    /// Law before and now, if it differs.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub law: Option<[String; 2]>,
    /// Rig and firmware before and now, if they differ.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub build: Option<[BaselineBuild; 2]>,
    /// Values of expectations that differ. All values if there is no reference.
    pub values: Vec<ValueChange>,
    /// True if a baseline of an earlier version contains no values.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub values_unknown: bool,
}

/// A judged value before and now, rounded; `null` if there is none.
#[derive(Debug, Clone, PartialEq, Serialize, JsonSchema)]
pub struct ValueChange {
    /// Metric, with a number from the second expectation of a metric on.
    pub name: String,
    pub before: Option<f64>,
    pub now: Option<f64>,
    /// Limit and window of the expectation; absent if this run does not contain it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub limit: Option<String>,
}

/// The values that differ, in the order of the expectations, then those that only the reference has.
pub fn value_changes(before: &BTreeMap<String, f64>, scenario: &ScenarioRecord) -> Vec<ValueChange> {
    let now = judged_values(scenario);
    let judged = (0..).zip(&scenario.expectations).map(|(index, expectation)| {
        let window = format::in_window(expectation).map_or_else(String::new, |window| format!(", {window}"));
        (scenario.metric_key(index), Some(format::limit(expectation) + &window))
    });
    let judged: Vec<_> = judged.collect();
    let is_judged = |name: &String| judged.iter().any(|(key, _)| key == name);
    let gone: Vec<_> = before.keys().filter(|name| !is_judged(name)).map(|name| (name.clone(), None)).collect();
    let changes = judged.into_iter().chain(gone).map(|(name, limit)| {
        let [before, now] = [before, &now].map(|values| values.get(&name).copied());
        ValueChange { name, before, now, limit }
    });
    changes.filter(|change| change.before != change.now).collect()
}

impl ResponseChanges {
    pub fn between(before: Option<&JudgedResponse>, record: &RunRecord, scenario: &ScenarioRecord) -> Self {
        let Some(before) = before else {
            return Self { values: value_changes(&BTreeMap::new(), scenario), ..Self::default() };
        };
        let now = JudgedResponse::of(record, scenario);
        Self {
            law: (before.law != now.law).then(|| [before.law.clone(), now.law]),
            build: (before.build != now.build).then(|| [before.build.clone(), now.build]),
            values: before.values.as_ref().map(|values| value_changes(values, scenario)).unwrap_or_default(),
            values_unknown: before.values.is_none(),
        }
    }

    /// One line per change, as `settling_time_ms: 1.956 → 1.889`.
    pub fn lines(&self) -> impl Iterator<Item = String> {
        let build = |build: &BaselineBuild| {
            format!("{} {} on {}", quoted(&build.firmware), quoted(&build.id), quoted(&build.rig))
        };
        let law = self.law.iter().map(|[before, now]| format!("  law: {before} → {now}"));
        let builds = self.build.iter();
        let builds = builds.map(move |[before, now]| format!("  build: {} → {}", build(before), build(now)));
        law.chain(builds).chain(self.values.iter().map(|change| format!("  {change}")))
    }
}

impl Display for ValueChange {
    fn fmt(&self, formatter: &mut Formatter<'_>) -> fmt::Result {
        let [before, now] = [self.before, self.now].map(optional_value);
        write!(formatter, "{}: {before} → {now}", self.name)
    }
}

fn optional_value(value: Option<f64>) -> String {
    value.map_or_else(|| NOTHING.to_owned(), |value| value.to_string())
}

impl ScenarioComparison {
    /// The verdict, the largest deviation, the reason, the changes, and the name of the drawing.
    pub fn blocks(&self) -> Vec<Block> {
        let drawing = self.drawing.iter().map(|path| format!("  drawing: {}", path.display()));
        // Without a reference nothing changed.
        let changes = self.changes.lines().filter(|_| self.comparison.trials > 0);
        let lines: Vec<_> = self.findings().map(|line| format!("  {line}")).chain(changes).chain(drawing).collect();
        let trials = format::count(self.comparison.trials, "trial");
        let verdict = Block::Verdict(self.comparison.verdict, format!("{}  ({trials})", self.scenario));
        std::iter::once(verdict).chain((!lines.is_empty()).then(|| Block::lines(lines))).collect()
    }

    fn findings(&self) -> impl Iterator<Item = String> {
        let TubeComparison { worst, reason, .. } = &self.comparison;
        let worst = worst.iter().map(|(trial, worst)| format::exceedance(*trial, worst));
        let unknown = self.changes.values_unknown && self.comparison.verdict != Verdict::Pass;
        let unknown = unknown.then(|| "an earlier version wrote the baseline, without judged values".to_owned());
        worst.chain(reason.clone()).chain(unknown)
    }

    pub fn is_changed(&self) -> bool {
        self.comparison.verdict != Verdict::Pass || !self.changes.values.is_empty()
    }

    /// Findings and changed values in one line.
    pub(crate) fn summary(&self) -> String {
        let values = self.changes.values.iter().filter(|_| self.comparison.trials > 0).map(ToString::to_string);
        self.findings().chain(values).collect::<Vec<_>>().join("; ")
    }
}

pub fn comparison_document(comparisons: &[ScenarioComparison]) -> Document {
    Document::new("Comparison of responses", comparisons.iter().flat_map(ScenarioComparison::blocks).collect())
}

/// Changed scenarios, failed ones first.
pub(crate) fn changed_scenarios(comparisons: &[ScenarioComparison]) -> Vec<&ScenarioComparison> {
    let mut changed: Vec<_> = comparisons.iter().filter(|one| one.is_changed()).collect();
    changed.sort_by_key(|one| format::display_order(one.comparison.verdict));
    changed
}

/// A row per changed value of each changed scenario, or one with the findings.
pub(crate) fn changes_table(changed: &[&ScenarioComparison]) -> Table {
    let mut table = Table::new(["", "Scenario", "Judged", "Before", "Now", "Limit"]);
    for one in changed {
        let sign = format::sign(one.comparison.verdict);
        for ValueChange { name, before, now, limit } in &one.changes.values {
            let [before, now] = [*before, *now].map(optional_value);
            table.push([sign, &one.scenario, name, &before, &now, limit.as_deref().unwrap_or(NOTHING)]);
        }
        if one.changes.values.is_empty() {
            let reason = one.comparison.reason.as_deref().unwrap_or("no judged value changed");
            table.push([sign, &one.scenario, reason, NOTHING, NOTHING, NOTHING]);
        }
    }
    table
}

const COLUMNS: usize = 64;
const ROWS: usize = 12;
const MARGIN_MS: f64 = 5.0;

/// Draws the tube as `.`, the golden curve as `-` and the response as `#`.
pub fn tube_plot(tube: &Tube, rows: &[Row], worst: &Exceedance) -> Vec<String> {
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
        let changes = ResponseChanges::default();
        let compared = ScenarioComparison { scenario, comparison, changes, drawing, plot: Vec::new() };
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
