//! Since when something does not pass: what the runs beside this one say of the same expectation.
//!
//! Neighbours: `html` shows it. Records are read, traces are not; a folder without a readable record is left out.

use crate::evidence;
use platebench_verdict::{RunRecord, Verdict};
use std::path::Path;

/// Runs that started before, the newest first, each with its folder's name.
#[derive(Debug, Clone, Default)]
pub(crate) struct History {
    runs: Vec<(String, RunRecord)>,
}

impl History {
    /// The runs in folders beside `folder`, on the same kind of rig.
    pub(crate) fn beside(folder: &Path, record: &RunRecord) -> Self {
        let mut runs = record.earlier(folder, |_, _| ());
        runs.retain(|(_, earlier)| earlier.rig.kind() == record.rig.kind());
        Self { runs }
    }

    /// In a sentence, since when the expectation under `key` of the scenario in `file` has not passed; `None` where no earlier run knows it.
    pub(crate) fn since(&self, record: &RunRecord, file: &str, key: &str) -> Option<String> {
        let known: Vec<(&str, &RunRecord, Verdict)> = self
            .runs
            .iter()
            .filter_map(|(run, earlier)| Some((run.as_str(), earlier, verdict(earlier, file, key)?)))
            .collect();
        let open = known.iter().take_while(|(.., verdict)| *verdict != Verdict::Pass).count();
        let (oldest_open, last_pass) = (open.checked_sub(1).and_then(|index| known.get(index)), known.get(open));
        match (oldest_open, last_pass) {
            (None, None) => None,
            (None, Some((run, earlier, _))) => Some(format!(
                "New in this run. It last passed in {run} ({}){}.",
                earlier.started,
                other_build(record, earlier)
            )),
            (Some((since, earlier, _)), Some((run, passed, _))) => Some(
                format!(
                    "Since {since} ({}), {} runs ago. It last passed in {run} ({}){}.",
                    earlier.started,
                    open,
                    passed.started,
                    other_build(earlier, passed)
                )
                .replace(" 1 runs ago", " one run ago"),
            ),
            (Some((since, earlier, _)), None) => Some(format!(
                "Since {since} ({}) or before: it has not passed in any earlier run that is still here.",
                earlier.started
            )),
        }
    }
}

fn verdict(record: &RunRecord, file: &str, key: &str) -> Option<Verdict> {
    let scenario = record.scenarios.iter().find(|scenario| scenario.file == file)?;
    let index = (0..scenario.expectations.len()).find(|index| evidence::key(scenario, *index) == key)?;
    scenario.expectations.get(index).map(|expectation| expectation.verdict)
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
