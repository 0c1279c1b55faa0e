//! Describes joined runs: missing shards, verdicts by scenario and board, and the differences between
//! boards.

use crate::document::{Block, Cell, Column, Document, Table};
use platebench_model::record::{MergeRecord, RunRecord, Verdict};
use std::collections::{BTreeMap, BTreeSet};

/// `None` if the run was not joined from others.
pub fn document(record: &RunRecord) -> Option<Document> {
    let merge = record.merge.as_ref()?;
    let mut blocks = vec![Block::heading("Boards")];
    blocks.extend(merge.missing_shards.iter().map(|missing| {
        let (shard, shards, board) = (missing.shard, missing.shards, &missing.board);
        Block::paragraph(format!("inconclusive: evidence: shard {shard}/{shards} of {board} is missing"))
    }));
    blocks.extend(verdict_matrix(record, merge).map(Block::Table));
    if !merge.differences.is_empty() {
        blocks.push(Block::heading("Differences between boards"));
        blocks.push(Block::Table(difference_table(merge)));
    }
    Some(Document::new("Boards", blocks))
}

/// `None` if the record lacks a scenario of a joined run.
fn verdict_matrix(record: &RunRecord, merge: &MergeRecord) -> Option<Table> {
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
        let cell = |board: &&str| match verdicts.get(&(scenario, board)) {
            Some(played) => Cell::verdict(Verdict::combine(played.iter().copied())),
            None => Cell::from("–"),
        };
        table.push(std::iter::once(Cell::from(scenario)).chain(boards.iter().map(cell)));
    }
    Some(table)
}

fn difference_table(merge: &MergeRecord) -> Table {
    let texts = ["scenario", "metric", "board", "against"].map(Column::from);
    let numbers = ["difference", "95 % interval"].map(|name| Column::number(name, ""));
    let mut table = Table::new(texts.into_iter().chain(numbers));
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
    table
}
