//! Writes the commands with which a job scheduler plays all shards of a campaign on many machines.

use crate::campaign::error::CampaignError;
use crate::campaign::plan::Plan;
use platebench_model::trace::AtPath;
use std::path::Path;

/// Job scheduler that starts and restarts shards.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Engine {
    Slurm,
    HyperQueue,
}

/// Returns two commands as words. The first starts all shards, the second merges their results.
pub fn submission(engine: Engine, plan: &Plan, folder: &Path) -> Result<[Vec<String>; 2], CampaignError> {
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
