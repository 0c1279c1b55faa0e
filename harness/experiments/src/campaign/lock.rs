//! Reserves a campaign folder, so that no two processes write the same files.
//!
//! `run`, `plan` and `merge` need the whole folder. Any number of `play` share it, one per shard.

use crate::campaign::error::CampaignError;
use crate::campaign::plan::Plan;
use platebench_model::record::FileLock;
use platebench_model::trace::AtPath;
use std::fs::{self, File};
use std::path::{Path, PathBuf};

/// Reserves the existing folder for one process.
pub fn lock_folder(folder: &Path) -> Result<FileLock, CampaignError> {
    FileLock::exclusive(folder)?.ok_or_else(|| CampaignError::InUse(folder.to_owned()))
}

/// Reservation of one shard. Other shards of the folder can be played at the same time.
#[derive(Debug)]
pub struct ShardLock {
    path: PathBuf,
    _shard: FileLock,
    _folder: FileLock,
}

impl ShardLock {
    /// Creates the lock file of the shard. It stays after a crash, without effect.
    pub fn new(folder: &Path, plan: &Plan, shard: u32) -> Result<Self, CampaignError> {
        if !(1..=plan.shards).contains(&shard) {
            return Err(CampaignError::NoShard { shard, shards: plan.shards });
        }
        let in_use = || CampaignError::InUse(folder.to_owned());
        let shared = FileLock::shared(folder)?.ok_or_else(in_use)?;
        let path = plan.part_path(folder, shard).with_extension("lock");
        if let Some(parts) = path.parent() {
            fs::create_dir_all(parts).at(parts)?;
        }
        File::options().create(true).append(true).open(&path).at(&path)?;
        let own = FileLock::exclusive(&path)?;
        let own = own.ok_or_else(|| CampaignError::ShardInUse { folder: folder.to_owned(), shard })?;
        Ok(Self { path, _shard: own, _folder: shared })
    }

    /// Removes the lock file. The part must be complete: a process that opened the file before it
    /// was removed then plays nothing.
    pub fn remove(self) {
        let _ = fs::remove_file(&self.path);
    }
}
