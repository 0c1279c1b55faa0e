//! Plays one scenario with many values (sweep, Monte Carlo, search) and judges the share of failing
//! trials.
//!
//! A [campaign](definition) file names the scenario, its varied values and the number of trials.
//! [`draw`] computes the values of trial i. A [`plan`] divides the trials into shards, which
//! several machines can play, and [`submission`] writes the commands for a job scheduler. Each
//! shard writes its results to a file, the part, and [`merge`] joins the parts. A [`comparison`]
//! pairs the trials of controllers that played the same campaign. With the methods
//! `search` and `rare`, trials form chains, in which a trial depends on earlier results.

mod bench_error;
pub mod comparison;
pub mod confirm;
pub mod definition;
pub mod distribution;
pub mod draw;
pub mod error;
mod paired_trials;
mod part;
pub mod passing_region;
pub mod plan;
pub mod play;
pub mod rare;
pub mod report;
pub mod results;
pub mod row;
pub mod sample;
mod search;
pub mod summary;
pub mod truncation;
pub mod worst_run;

use bench_error::errors_in_cell;
use confirm::Agreement;
use part::PartReader;
use platebench_model::record::FileLock;
use platebench_model::trace::{AtPath, OutputFolder};
use results::ResultsWriter;
use std::path::{Path, PathBuf};
use summary::{COUNTEREXAMPLES, SUMMARY_FILE};
use worst_run::write_scenarios;

pub use confirm::confirm;
pub use definition::{Campaign, RawCampaign};
pub use error::CampaignError;
pub use plan::{CampaignPlan, part_name, shards_of_run};
pub use play::{PlayConfig, TrialEvent, TrialSource, play_shard, play_trials};
pub use row::ShardEnd;
pub use summary::Summary;
use summary::TestedController;
pub use truncation::Truncation;
pub use worst_run::{Response, ResponseLinks, play_worst, response_links, worst_trials};

/// If a part is damaged, returns an error and keeps the results of an earlier merge.
pub fn merge<'a>(
    folder: &Path,
    plan: &'a CampaignPlan,
    campaign: &'a Campaign,
    agreement: Option<Agreement>,
) -> Result<Summary<'a>, CampaignError> {
    let mut summary = Summary::new(campaign);
    summary.tested = Some(TestedController { rig: &plan.rig, firmware_sha256: plan.firmware() });
    summary.agreement = agreement;
    for shard in 1..=plan.shards {
        if !plan.part_path(folder, shard).exists() {
            summary.missing.push(shard);
            continue;
        }
        let part = PartReader::open(folder, plan, campaign, shard)?;
        summary.end.add(part.end());
        part.rows(&mut |row| {
            summary.add(&row);
            Ok(())
        })?;
        if let Some(trial) = summary.chains.foreign_chain {
            return Err(CampaignError::OtherChain { path: plan.part_path(folder, shard), trial });
        }
    }
    // The scatter in a cell is known only after all of its trials.
    let mut results = ResultsWriter::new(folder, campaign)?;
    for shard in (1..=plan.shards).filter(|shard| !summary.missing.contains(shard)) {
        PartReader::open(folder, plan, campaign, shard)?.rows(&mut |row| {
            let errors = errors_in_cell(&row, summary.cells.get(campaign.cell(&row.draws)));
            results.push(row, errors)
        })?;
    }
    results.commit()?;
    let text = serde_json::to_string_pretty(&summary.result()).unwrap_or_default();
    let output = OutputFolder::open(folder)?;
    output.write(SUMMARY_FILE, format!("{text}\n"))?;
    let failing = summary.failing.iter().map(|row| row.trial_in(campaign)).collect::<Result<Vec<_>, _>>()?;
    write_scenarios(&output, COUNTEREXAMPLES, campaign, &failing)?;
    Ok(summary)
}

#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct ShardStatus {
    pub whole: Vec<u32>,
    pub missing: Vec<u32>,
    /// Shards whose part is damaged or belongs to another plan, with the error message.
    pub unusable: Vec<(u32, String)>,
}

pub fn status(folder: &Path, plan: &CampaignPlan, campaign: &Campaign) -> Result<ShardStatus, CampaignError> {
    let mut status = ShardStatus::default();
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

/// Reserves the existing folder for one process.
pub fn lock_folder(folder: &Path) -> Result<FileLock, CampaignError> {
    FileLock::exclusive(folder)?.ok_or_else(|| CampaignError::InUse(folder.to_owned()))
}

/// Reservation of one shard. Other shards of the folder can be played at the same time.
#[derive(Debug)]
pub struct ShardLock {
    parts: OutputFolder,
    path: PathBuf,
    _shard: FileLock,
    _folder: FileLock,
}

impl ShardLock {
    /// Creates the lock file of the shard. It stays after a crash, without effect.
    pub fn new(folder: &Path, plan: &CampaignPlan, shard: u32) -> Result<Self, CampaignError> {
        if !(1..=plan.shards).contains(&shard) {
            return Err(CampaignError::NoShard { shard, shards: plan.shards });
        }
        let in_use = || CampaignError::InUse(folder.to_owned());
        let shared = FileLock::shared(folder)?.ok_or_else(in_use)?;
        let path = plan.part_path(folder, shard).with_extension("lock");
        let parts = OutputFolder::open(folder)?.create_folder(plan::PARTS)?;
        parts.append(path.file_name().unwrap_or_default())?;
        let own = FileLock::exclusive(&path)?;
        let own = own.ok_or_else(|| CampaignError::ShardInUse { folder: folder.to_owned(), shard })?;
        Ok(Self { parts, path, _shard: own, _folder: shared })
    }

    /// Removes the lock file. The part must be complete: a process that opened the file before it
    /// was removed then plays nothing.
    pub fn remove(self) {
        let _ = self.parts.remove_file(self.path.file_name().unwrap_or_default());
    }
}

/// Job scheduler that starts and restarts shards.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Engine {
    Slurm,
    HyperQueue,
}

/// Returns two commands as words. The first starts all shards, the second merges their results.
pub fn submission(engine: Engine, plan: &CampaignPlan, folder: &Path) -> Result<[Vec<String>; 2], CampaignError> {
    let program = std::env::current_exe().at(Path::new("the bench's own program"))?;
    let folder = std::path::absolute(folder).at(folder)?;
    let [program, folder] = [&program, &folder].map(|path| path.to_string_lossy().into_owned());
    let quoted = |word: &str| shlex::try_quote(word).map_or_else(|_| word.to_owned(), std::borrow::Cow::into_owned);
    let play =
        |task: &str| format!("{} campaign play {} --shard \"${task}\" --jobs 1", quoted(&program), quoted(&folder));
    let shards = format!("--array=1-{}", plan.shards);
    let words = |words: &[&str]| words.iter().map(|word| (*word).to_owned()).collect::<Vec<_>>();
    let array = match engine {
        Engine::Slurm => words(&["sbatch", "--wait", &shards, "--wrap", &play("SLURM_ARRAY_TASK_ID")]),
        Engine::HyperQueue => words(&["hq", "submit", "--wait", &shards, "--", "bash", "-c", &play("HQ_TASK_ID")]),
    };
    Ok([array, words(&[&program, "campaign", "merge", &folder])])
}

pub fn command_line(words: &[String]) -> String {
    shlex::try_join(words.iter().map(|word| &**word)).unwrap_or_else(|_| words.join(" "))
}
