//! Joins the parts of a campaign: writes its results, its summary and its counterexamples.

use crate::campaign::confirm::Agreement;
use crate::campaign::definition::Campaign;
use crate::campaign::error::CampaignError;
use crate::campaign::part::PartReader;
use crate::campaign::plan::Plan;
use crate::campaign::results::ResultsWriter;
use crate::campaign::scenario_files;
use crate::campaign::summary::{SUMMARY_FILE, Summary};
use platebench_model::trace::{AtPath, write_atomically};
use std::path::Path;

const COUNTEREXAMPLES: &str = "counterexamples";

/// If a part is damaged, returns an error and keeps the results of an earlier merge.
pub fn merge<'a>(
    folder: &Path,
    plan: &Plan,
    campaign: &'a Campaign,
    agreement: Option<Agreement>,
) -> Result<Summary<'a>, CampaignError> {
    let mut summary = Summary::new(campaign);
    summary.agreement = agreement;
    let mut results = ResultsWriter::new(folder, campaign)?;
    for shard in 1..=plan.shards {
        if !plan.part_path(folder, shard).exists() {
            summary.missing.push(shard);
            continue;
        }
        let part = PartReader::open(folder, plan, campaign, shard)?;
        summary.end.add(part.end());
        part.rows(&mut |row| {
            summary.add(&row);
            results.push(row)
        })?;
    }
    results.commit()?;
    let path = folder.join(SUMMARY_FILE);
    let text = serde_json::to_string_pretty(&summary.json()).unwrap_or_default();
    write_atomically(&path, format!("{text}\n").as_bytes()).at(&path)?;
    let failing = summary.failing.iter().map(|row| row.trial_in(campaign)).collect::<Result<Vec<_>, _>>()?;
    scenario_files::write(&folder.join(COUNTEREXAMPLES), campaign, &failing)?;
    Ok(summary)
}

#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Status {
    pub whole: Vec<u32>,
    pub missing: Vec<u32>,
    /// Shards whose part is damaged or belongs to another plan, with the error message.
    pub unusable: Vec<(u32, String)>,
}

pub fn status(folder: &Path, plan: &Plan, campaign: &Campaign) -> Result<Status, CampaignError> {
    let mut status = Status::default();
    for shard in 1..=plan.shards {
        if !plan.part_path(folder, shard).exists() {
            status.missing.push(shard);
            continue;
        }
        match PartReader::open(folder, plan, campaign, shard).and_then(|part| part.check_rows()) {
            Ok(()) => status.whole.push(shard),
            Err(error @ (CampaignError::Damaged { .. } | CampaignError::OtherPart(_))) => {
                status.unusable.push((shard, error.to_string()));
            }
            Err(error) => return Err(error),
        }
    }
    Ok(status)
}
