//! Tabulates the verdicts of joined runs by scenario and board, and the differences between boards.

use crate::document::Table;
use platebench_model::record::{MergeRecord, RunRecord, Verdict};
use std::collections::{BTreeMap, BTreeSet};

pub fn verdict_matrix(record: &RunRecord) -> Option<Table> {
    let merge = record.merge.as_ref()?;
    let boards: BTreeSet<&str> = merge.runs.iter().map(|run| run.board.as_str()).collect();
    let mut verdicts: BTreeMap<(&str, &str), Vec<Verdict>> = BTreeMap::new();
    for run in &merge.runs {
        for merged in &run.scenarios {
            let scenario = record.scenarios.iter().find(|scenario| scenario.file == merged.file)?;
            verdicts.entry((&merged.original, &run.board)).or_default().push(scenario.verdict);
        }
    }
    let mut table = Table::new(std::iter::once("scenario").chain(boards.iter().copied()));
    let scenarios: BTreeSet<&str> = verdicts.keys().map(|(scenario, _)| *scenario).collect();
    for scenario in scenarios {
        let cell = |board: &&str| {
            let played = verdicts.get(&(scenario, board))?;
            Some(Verdict::combine(played.iter().copied()).to_string())
        };
        let cells = boards.iter().map(|board| cell(board).unwrap_or_else(|| "–".to_owned()));
        table.push(std::iter::once(scenario.to_owned()).chain(cells));
    }
    Some(table)
}

/// `None` if no scenario was played on two boards.
pub fn difference_table(merge: &MergeRecord) -> Option<Table> {
    let mut table = Table::new(["scenario", "metric", "board", "against", "difference", "95 % interval"]);
    for found in &merge.differences {
        let interval = found.interval.map_or_else(|| "–".to_owned(), |[low, high]| format!("{low:.4} to {high:.4}"));
        table.push(vec![
            found.scenario.clone(),
            found.metric.clone(),
            found.board.clone(),
            found.reference.clone(),
            format!("{:+.4}", found.difference),
            interval,
        ]);
    }
    (!table.rows.is_empty()).then_some(table)
}

pub fn missing_shards(merge: &MergeRecord) -> Vec<String> {
    let line = |missing: &platebench_model::record::MissingShard| {
        format!("inconclusive: evidence: shard {}/{} of {} is missing", missing.shard, missing.shards, missing.board)
    };
    merge.missing_shards.iter().map(line).collect()
}
