//! Finds since when an expectation does not pass, in earlier runs with the same rig and law.

use crate::format;
use crate::format::short_build_id;
use maud::{Markup, html};
use platebench_model::record::{
    ExpectationRecord, MetricDefinition, RigRecord, RunRecord, RunSummary, ScenarioRecord, ScenarioSummary, Verdict,
};

#[derive(Debug, Clone, Default)]
pub(crate) struct RunHistory {
    /// Folder names and runs, the newest first. `None` if earlier runs were not searched.
    pub(crate) runs: Option<Vec<(String, RunSummary)>>,
}

#[derive(Debug, Clone, PartialEq)]
pub(crate) struct TrendPoint {
    pub(crate) run: String,
    pub(crate) value: Option<f64>,
    pub(crate) margin: Option<f64>,
    pub(crate) verdict: Verdict,
}

struct EarlierExpectation<'a> {
    run: &'a str,
    record: &'a RunSummary,
    expectation: &'a ExpectationRecord,
}

impl RunHistory {
    /// Earlier results with the same kind of rig and law, the newest first. The flag is true if
    /// earlier results with another rig or law exist.
    fn comparable(
        &self,
        record: &RunRecord,
        scenario: &ScenarioRecord,
        index: usize,
    ) -> Option<(Vec<EarlierExpectation<'_>>, bool)> {
        let mut elsewhere = false;
        let mut known = Vec::new();
        for (run, earlier) in self.runs.as_ref()? {
            let Some(played) = earlier.scenarios.iter().find(|played| played.file == scenario.file) else { continue };
            let Some(expectation) = matching_expectation(scenario, index, played) else { continue };
            if earlier.rig.kind() == record.rig.kind() && played.law == scenario.law {
                known.push(EarlierExpectation { run, record: earlier, expectation });
            } else {
                elsewhere = true;
            }
        }
        Some((known, elsewhere))
    }

    /// Earlier values of the same expectation, the oldest first, then the value of this run.
    pub(crate) fn trend(&self, record: &RunRecord, scenario: &ScenarioRecord, index: usize) -> Vec<TrendPoint> {
        let point = |run: &str, expectation: &ExpectationRecord| TrendPoint {
            run: run.to_owned(),
            value: expectation.value,
            margin: expectation.margin,
            verdict: expectation.verdict,
        };
        let (Some(now), Some((known, _))) =
            (scenario.expectations.get(index), self.comparable(record, scenario, index))
        else {
            return Vec::new();
        };
        let same = known.iter().filter(|then| differences(now, then.expectation).is_empty());
        let mut points: Vec<TrendPoint> = same.map(|then| point(then.run, then.expectation)).collect();
        points.reverse();
        points.push(point("this run", now));
        points
    }

    /// True if the last comparable run passed the expectation.
    pub(crate) fn is_new(&self, record: &RunRecord, scenario: &ScenarioRecord, index: usize) -> bool {
        let known = self.comparable(record, scenario, index).map(|(known, _)| known).unwrap_or_default();
        known.first().is_some_and(|then| then.expectation.verdict == Verdict::Pass)
    }

    /// `None` if earlier runs were not searched.
    pub(crate) fn not_passed_since(
        &self,
        record: &RunRecord,
        scenario: &ScenarioRecord,
        index: usize,
    ) -> Option<Markup> {
        let now = scenario.expectations.get(index)?;
        let (known, elsewhere) = self.comparable(record, scenario, index)?;
        let open = known.iter().take_while(|then| then.expectation.verdict != Verdict::Pass).count();
        let (oldest_open, last_pass) = (open.checked_sub(1).and_then(|index| known.get(index)), known.get(open));
        let comparable = html! { "on " code { (record.rig.kind()) } " with " code { (scenario.law) } };
        Some(match (oldest_open, last_pass) {
            (None, None) if elsewhere => html! { "First run of this scenario " (comparable) " in this folder." },
            (None, None) => html! { "First run of this scenario in this folder." },
            (None, Some(passed)) => html! {
                "New in this run. It last passed in " (passed.describe(now))
                (describe_build_change(&record.rig, &passed.record.rig)) "."
            },
            (Some(first), Some(passed)) => html! {
                "Since " (first.describe(now)) ", " (format::count(open, "run")) " ago. It last passed in "
                (passed.describe(now)) (describe_build_change(&first.record.rig, &passed.record.rig)) "."
            },
            (Some(first), None) => html! {
                "Since " (first.describe(now)) " or before: no earlier run " (comparable) " in this folder passed it."
            },
        })
    }
}

impl EarlierExpectation<'_> {
    fn describe(&self, now: &ExpectationRecord) -> String {
        let differs = differences(now, self.expectation);
        let differs = if differs.is_empty() { String::new() } else { format!(", then with {}", differs.join(", ")) };
        format!("{} ({}{differs})", self.run, self.record.started)
    }
}

fn matching_expectation<'a>(
    scenario: &ScenarioRecord,
    index: usize,
    played: &'a ScenarioSummary,
) -> Option<&'a ExpectationRecord> {
    let now = scenario.expectations.get(index)?;
    let namesake = played.expectations.iter().find(|then| then.name == now.name);
    let same = |then: &&ExpectationRecord| then.metric == now.metric && differences(now, then).is_empty();
    namesake.filter(same).or_else(|| played.expectations.iter().find(same)).or(namesake)
}

/// Describes how `then` differed; empty if it was the same.
fn differences(now: &ExpectationRecord, then: &ExpectationRecord) -> Vec<String> {
    let unit = format::unit(now.metric);
    let mut texts = Vec::new();
    if now.limit != then.limit {
        texts.push(format!("{} {unit}", format::limit(then)).trim_end().to_owned());
    }
    if (&now.statistic, now.evidence.quantile) != (&then.statistic, then.evidence.quantile) {
        texts.push(format!("the {}", format::statistic(then)));
    }
    if then.definition == MetricDefinition::default() || now.definition == MetricDefinition::default() {
        return texts;
    }
    if now.definition.band_percent != then.definition.band_percent {
        texts.extend(then.definition.band_percent.map(|percent| format!("a band of {} %", format::number(percent))));
    }
    if now.definition.from_ms != then.definition.from_ms {
        texts.push(
            then.definition
                .from_ms
                .map_or_else(|| "no from_ms".to_owned(), |from_ms| format!("from_ms = {}", format::number(from_ms))),
        );
    }
    if now.definition.signal != then.definition.signal {
        texts.extend(then.definition.signal.as_ref().map(|signal| format!("signal {signal}")));
    }
    texts
}

fn describe_build_change(now: &RigRecord, then: &RigRecord) -> String {
    let build = |rig: &RigRecord| rig.firmware.as_ref().map(|firmware| firmware.build.clone());
    match (build(now), build(then)) {
        (Some(now), Some(then)) if now == then && now.bytes().all(|digit| digit == b'0') => String::new(),
        (Some(now), Some(then)) if now == then => ", with the same build of the firmware".to_owned(),
        (Some(_), Some(then)) => format!(", with build {}", short_build_id(&then)),
        _ => String::new(),
    }
}
