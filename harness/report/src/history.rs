//! Since when something does not pass: what the runs beside this one say of the same expectation.
//!
//! Only runs on the same kind of rig and with the same law of the scenario are comparable; where their expectation was another one it is said which. Neighbours: `html`
//! shows it. Records are read, traces are not; a folder without a readable record is left out.

use crate::{evidence, shown};
use maud::{Markup, html};
use platebench_verdict::{Definition, ExpectationRecord, RunRecord, ScenarioRecord, Verdict};
use std::path::Path;

/// Runs that started before, the newest first, each with its folder's name.
#[derive(Debug, Clone, Default)]
pub(crate) struct History {
    /// Whether anybody looked for earlier runs.
    looked: bool,
    runs: Vec<(String, RunRecord)>,
}

/// An expectation in an earlier run.
struct Then<'a> {
    run: &'a str,
    record: &'a RunRecord,
    expectation: &'a ExpectationRecord,
}

impl History {
    /// The runs in folders beside `folder`.
    pub(crate) fn beside(folder: &Path, record: &RunRecord) -> Self {
        Self { looked: true, runs: record.earlier(folder, |_, _| ()) }
    }

    /// In a sentence, since when an expectation of a scenario of `record` has not passed; `None` where nobody looked.
    pub(crate) fn since(&self, record: &RunRecord, scenario: &ScenarioRecord, index: usize) -> Option<Markup> {
        let now = scenario.expectations.get(index).filter(|_| self.looked)?;
        let mut elsewhere = false;
        let mut known: Vec<Then<'_>> = Vec::new();
        for (run, earlier) in &self.runs {
            let Some(played) = earlier.scenarios.iter().find(|played| played.file == scenario.file) else { continue };
            let Some(expectation) = counterpart(scenario, index, played) else { continue };
            if earlier.rig.kind() == record.rig.kind() && played.law == scenario.law {
                known.push(Then { run, record: earlier, expectation });
            } else {
                elsewhere = true;
            }
        }
        let open = known.iter().take_while(|then| then.expectation.verdict != Verdict::Pass).count();
        let (oldest_open, last_pass) = (open.checked_sub(1).and_then(|index| known.get(index)), known.get(open));
        let comparable = html! { "on " code { (record.rig.kind()) } " with " code { (scenario.law) } };
        Some(match (oldest_open, last_pass) {
            (None, None) if elsewhere => html! { "No earlier run of it " (comparable) " lies beside this one." },
            (None, None) => html! { "No earlier run of it lies beside this one." },
            (None, Some(passed)) => {
                html! { "New in this run. It last passed in " (passed.named(now)) (other_build(record, passed.record)) "." }
            }
            (Some(first), Some(passed)) => html! {
                "Since " (first.named(now)) ", " @if open == 1 { "one run" } @else { (open) " runs" } " ago. It last passed in " (passed.named(now))
                (other_build(first.record, passed.record)) "."
            },
            (Some(first), None) => html! {
                "Since " (first.named(now)) " or before: it has not passed in any earlier run " (comparable) " that lies beside this one."
            },
        })
    }
}

impl Then<'_> {
    /// The run, when it started, and what was expected then where that was something else.
    fn named(&self, now: &ExpectationRecord) -> String {
        let differs = differences(now, self.expectation);
        let differs = if differs.is_empty() { String::new() } else { format!(", then with {}", differs.join(", ")) };
        format!("{} ({}{differs})", self.run, self.record.started)
    }
}

/// What `played` expected in place of expectation `index` of `scenario`: the very same, wherever it stood, or else the one under the same key.
fn counterpart<'a>(
    scenario: &ScenarioRecord,
    index: usize,
    played: &'a ScenarioRecord,
) -> Option<&'a ExpectationRecord> {
    let now = scenario.expectations.get(index)?;
    let key = evidence::key(scenario, index);
    let number = (0..played.expectations.len()).find(|number| evidence::key(played, *number) == key);
    let under_key = number.and_then(|number| played.expectations.get(number));
    let same = |then: &&ExpectationRecord| then.metric == now.metric && differences(now, then).is_empty();
    under_key.filter(same).or_else(|| played.expectations.iter().find(same)).or(under_key)
}

/// In what an expectation was another one then, each in words; empty where it was the same.
fn differences(now: &ExpectationRecord, then: &ExpectationRecord) -> Vec<String> {
    let unit = shown::unit(&now.metric);
    let mut said = Vec::new();
    if now.limit != then.limit {
        said.push(format!("{} {unit}", shown::limit(then)).trim_end().to_owned());
    }
    if (&now.statistic, now.evidence.quantile) != (&then.statistic, then.evidence.quantile) {
        said.push(format!("the {}", shown::statistic(then)));
    }
    // Older benches did not say by what they measured.
    if then.definition == Definition::default() || now.definition == Definition::default() {
        return said;
    }
    if now.definition.band_percent != then.definition.band_percent {
        said.extend(then.definition.band_percent.map(|percent| format!("a band of {} %", shown::number(percent))));
    }
    if now.definition.from_ms != then.definition.from_ms {
        said.push(then.definition.from_ms.map_or_else(
            || "no instant to look from".to_owned(),
            |from_ms| format!("a look from {} ms on", shown::number(from_ms)),
        ));
    }
    if now.definition.signal != then.definition.signal {
        said.extend(then.definition.signal.as_ref().map(|signal| format!("a look at {signal}")));
    }
    said
}

/// Whether the firmware changed between them.
fn other_build(now: &RunRecord, then: &RunRecord) -> String {
    let build = |record: &RunRecord| record.rig.firmware.as_ref().map(|firmware| firmware.build.clone());
    match (build(now), build(then)) {
        (Some(now), Some(then)) if now == then => ", with the same build of the firmware".to_owned(),
        (Some(_), Some(then)) => format!(", with build {}", crate::cost::short(&then)),
        _ => String::new(),
    }
}
