use crate::board_args::BoardArgs;
use crate::options::{OutputFormat, rig_help};
use clap::{Args, Subcommand, ValueEnum};
use platebench_rig::RigSpec;
use std::path::PathBuf;

#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  platebench campaign run scenarios/campaigns/laws.toml --out C
  platebench campaign plan my.toml --out C --shards 64
  platebench campaign play C --shard 7             on any machine that sees C
  platebench campaign submit C --on slurm          prints the commands of an array
  platebench campaign status C
  platebench campaign merge C

Exit codes: 0 passed (play: the shard is complete), 1 failed, 2 invalid input, or a damaged or foreign part or plan,
3 inconclusive, or a shard is missing, 5 the rig could not be reached or was lost")]
pub(crate) struct CampaignArgs {
    #[command(subcommand)]
    pub(super) command: CampaignCommand,
}

#[derive(Debug, Subcommand)]
pub(super) enum CampaignCommand {
    /// Plan, play and merge on this machine; the same command resumes
    Run(RunArgs),
    /// Write plan.json for a number of shards
    Plan(PlanArgs),
    /// Play one shard; a complete one is not played again
    Play(PlayArgs),
    /// Join the parts: results, summary, report, counterexamples
    Merge(MergeArgs),
    /// Print the commands that play all shards on many machines, or run them
    Submit(SubmitArgs),
    /// Show which shards are complete
    Status(FolderArgs),
}

#[derive(Debug, Args)]
pub(super) struct RunArgs {
    /// The campaign file
    pub(super) file: PathBuf,
    /// The campaign folder
    #[arg(long, value_name = "FOLDER")]
    pub(super) out: PathBuf,
    /// Trials that are played at once; default: one per core
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=1024))]
    pub(super) jobs: Option<u16>,
    #[arg(long, help = rig_help(), default_value = "hosted", conflicts_with = "board")]
    pub(super) rig: RigSpec,
    #[command(flatten)]
    pub(super) board: BoardArgs,
    /// Format of standard output
    #[arg(long, value_enum, default_value_t = OutputFormat::Human)]
    pub(super) format: OutputFormat,
}

#[derive(Debug, Args)]
pub(super) struct PlanArgs {
    /// The campaign file
    pub(super) file: PathBuf,
    /// The campaign folder
    #[arg(long, value_name = "FOLDER")]
    pub(super) out: PathBuf,
    /// Number of shards
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..=1_000_000))]
    pub(super) shards: u32,
    #[arg(long, help = rig_help(), default_value = "hosted")]
    pub(super) rig: RigSpec,
}

#[derive(Debug, Args)]
pub(super) struct PlayArgs {
    /// The campaign folder
    pub(super) folder: PathBuf,
    /// Number of the shard, from 1
    #[arg(long, value_name = "K")]
    pub(super) shard: u32,
    /// Trials that are played at once; default: one per core
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=1024))]
    pub(super) jobs: Option<u16>,
    /// Rig with the planned firmware; default: the rig of the plan
    #[arg(long, conflicts_with = "board")]
    pub(super) rig: Option<RigSpec>,
    #[command(flatten)]
    pub(super) board: BoardArgs,
}

#[derive(Debug, Args)]
pub(super) struct MergeArgs {
    /// The campaign folder
    pub(super) folder: PathBuf,
    /// Trials that `plan.confirm` plays at once; default: one per core
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=1024))]
    pub(super) jobs: Option<u16>,
    /// Format of standard output
    #[arg(long, value_enum, default_value_t = OutputFormat::Human)]
    pub(super) format: OutputFormat,
}

#[derive(Debug, Args)]
pub(super) struct SubmitArgs {
    /// The campaign folder
    pub(super) folder: PathBuf,
    /// Engine that starts the shards
    #[arg(long, value_enum)]
    pub(super) on: EngineName,
    /// Run the commands instead of printing them
    #[arg(long)]
    pub(super) run: bool,
}

#[derive(Debug, Clone, Copy, ValueEnum)]
pub(super) enum EngineName {
    Slurm,
    Hyperqueue,
}

#[derive(Debug, Args)]
pub(super) struct FolderArgs {
    /// The campaign folder
    pub(super) folder: PathBuf,
}
