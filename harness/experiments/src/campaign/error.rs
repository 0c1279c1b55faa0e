//! Defines the errors of campaigns.

use parquet::errors::ParquetError;
use platebench_engine::RunError;
use platebench_model::record::FolderError;
use platebench_model::scenario::Diagnostic;
use platebench_model::trace::FileError;
use platebench_rig::ConnectError;
use std::path::{Path, PathBuf};

#[derive(Debug, thiserror::Error)]
pub enum CampaignError {
    /// The campaign file or its scenario is wrong.
    #[error("{}", .0.iter().map(ToString::to_string).collect::<Vec<_>>().join("\n"))]
    Files(Vec<Diagnostic>),
    #[error(transparent)]
    File(#[from] FileError),
    #[error("{}: {source}", path.display())]
    Write { path: PathBuf, source: ParquetError },
    /// The page of the run of the worst trials cannot be written.
    #[error(transparent)]
    Page(FileError),
    #[error("{}: contains no plan.json, expected a folder that `platebench campaign plan` wrote", .0.display())]
    NoPlan(PathBuf),
    #[error(
        "{}: the file is damaged or was edited ({why}); restore it, or plan or play the campaign again",
        path.display()
    )]
    Damaged { path: PathBuf, why: &'static str },
    #[error(
        "{}: the chain of trials from trial {trial} on has other values than this version draws, so another version \
         played it; merge the campaign with that version, or play it again in another folder",
        path.display()
    )]
    OtherChain { path: PathBuf, trial: u64 },
    #[error("{}: belongs to another plan or shard; expected a part of this campaign folder", .0.display())]
    OtherPart(PathBuf),
    #[error(
        "{}: contains the plan of another campaign, or of this campaign with other files, another program or other \
         firmware; use another folder",
        .0.display()
    )]
    OtherPlan(PathBuf),
    #[error(
        "{}: changed since the campaign was planned; restore it, or plan again in another \
         folder",
        .0.display()
    )]
    ChangedInput(PathBuf),
    #[error(
        "this platebench program is not the one that planned the campaign (its SHA-256 is {found}, plan.json has \
         {planned}); use that program, or plan again in another folder"
    )]
    OtherBench { found: String, planned: String },
    #[error(
        "{rig}: the firmware is not the one of the plan (its SHA-256 is {found}, plan.json has {planned}); use that \
         firmware, or plan again in another folder"
    )]
    OtherFirmware { rig: String, found: String, planned: String },
    #[error("{0}: `plan.confirm` plays trials of the hosted rig again, expected --rig hosted")]
    ConfirmedRig(String),
    #[error("{}: is in use by another campaign command; wait for its end, or use another folder", .0.display())]
    InUse(PathBuf),
    #[error("{}: another process plays shard {shard}; wait for its end, or play another shard", folder.display())]
    ShardInUse { folder: PathBuf, shard: u32 },
    #[error("{}: shard {shard} is missing; play it, then compare", folder.display())]
    MissingShard { folder: PathBuf, shard: u32 },
    #[error("{0} campaign folders, expected two or more: those of the controllers, and last that of the reference")]
    NothingToCompare(usize),
    #[error(
        "{}: the methods search and rare choose trials by earlier results, so trials of two controllers differ; \
         expected grid, random or sobol",
        .0.display()
    )]
    DependentTrials(PathBuf),
    #[error("{}: its campaign, scenario or plate file differs from that of {}", path.display(), reference.display())]
    OtherInputs { path: PathBuf, reference: PathBuf },
    #[error("shard {shard} is not in the plan, expected 1 to {shards}")]
    NoShard { shard: u32, shards: u32 },
    #[error("trial {trial} cannot be played with the values {values}: {problem}")]
    Trial { trial: u64, values: String, problem: Box<Diagnostic> },
    #[error(transparent)]
    Connect(#[from] ConnectError),
    #[error(transparent)]
    Run(#[from] RunError),
    #[error(transparent)]
    Folder(#[from] FolderError),
    #[error("the controller was lost or did not confirm 0 V: check the amplifier before you touch the plate")]
    NotSafe,
}

impl CampaignError {
    pub(crate) fn write(path: &Path) -> impl Fn(ParquetError) -> Self + use<> {
        let path = path.to_owned();
        move |source| Self::Write { path: path.clone(), source }
    }
}
