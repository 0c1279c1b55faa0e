//! `platebench campaign`: plays sweeps and Monte Carlo in shards, on one machine or many.

mod arguments;
mod progress;

pub(crate) use arguments::CampaignArgs;

use crate::board_args::{BoardArgs, release};
use crate::exit::Exit;
use crate::failure::{CommandResult, Failure};
use crate::options::{OutputFormat, job_count};
use crate::plate_warnings::warn_of_scenarios;
use crate::shutdown::{EventSender, run_until_signal, unless_signalled};
use crate::stdio;
use arguments::{CampaignCommand, EngineName, PlayArgs, RunArgs, SubmitArgs};
use platebench_engine::RunError;
use platebench_experiments::campaign::{
    Campaign, CampaignError, Plan, PlayConfig, ResponseLinks, ShardEnd, ShardLock, confirm, lock_folder, merge,
    play_shard, play_worst, report, shards_of_run, status, worst_trials,
};
use platebench_experiments::campaign::{Engine, command_line, submission};
use platebench_lab::boards::BoardOutcome;
use platebench_model::record::FileLock;
use platebench_model::trace::AtPath;
use platebench_report::Style;
use platebench_rig::{CancelToken, RigSpec};
use progress::{CampaignProgress, PlayEvent};
use std::fs;
use std::path::Path;
use std::process::Command;
use std::sync::{Arc, Mutex, PoisonError};

pub(crate) fn campaign(arguments: &CampaignArgs, quiet: bool) -> CommandResult {
    match &arguments.command {
        CampaignCommand::Run(arguments) => run(arguments, quiet),
        CampaignCommand::Plan(arguments) => {
            let campaign = Campaign::load(&arguments.file)?;
            let (plan, _lock) = plan(&campaign, &arguments.out, &arguments.rig, arguments.shards)?;
            stdio::note(&format!("{} trials in {} shards: {}", plan.trials, plan.shards, arguments.out.display()));
            Ok(Exit::Passed)
        }
        CampaignCommand::Play(arguments) => play_one(arguments, quiet),
        CampaignCommand::Merge(arguments) => merge_folder(&arguments.folder, arguments.jobs, quiet, arguments.format),
        CampaignCommand::Submit(arguments) => submit(arguments, quiet),
        CampaignCommand::Status(arguments) => show_status(&arguments.folder),
    }
}

/// Creates the folder and reserves it until the lock is dropped.
fn plan(campaign: &Campaign, folder: &Path, rig: &RigSpec, shards: u32) -> Result<(Plan, FileLock), CampaignError> {
    rig.check()?;
    warn_of_scenarios(std::slice::from_ref(&campaign.template.scenario));
    if campaign.confirm.is_some() && *rig != RigSpec::hosted() {
        return Err(CampaignError::ConfirmedRig(rig.to_string()));
    }
    let plan = Plan::new(campaign, folder, rig, shards)?;
    fs::create_dir_all(folder).at(folder)?;
    let lock = lock_folder(folder)?;
    plan.write(folder)?;
    Ok((plan, lock))
}

fn run(arguments: &RunArgs, quiet: bool) -> CommandResult {
    let campaign = Arc::new(Campaign::load(&arguments.file)?);
    let rig = arguments.board.find_rig()?.unwrap_or_else(|| arguments.rig.clone());
    let planned = Plan::exists(&arguments.out).then(|| Plan::read(&arguments.out)).transpose()?;
    let shards = planned.map_or_else(|| shards_of_run(&campaign), |plan| plan.shards);
    let (plan, _lock) = plan(&campaign, &arguments.out, &rig, shards)?;
    let shards = (1..=plan.shards).collect();
    let context = (plan.clone(), Arc::clone(&campaign));
    play_on_board(&arguments.board, &arguments.out, context, shards, &rig, arguments.jobs, quiet)?;
    merge_and_show(&arguments.out, (plan, campaign), Ok(()), arguments.jobs, quiet, arguments.format)
}

fn play_one(arguments: &PlayArgs, quiet: bool) -> CommandResult {
    let (plan, campaign) = Plan::open(&arguments.folder)?;
    let rig = match arguments.board.find_rig()?.or_else(|| arguments.rig.clone()) {
        Some(rig) => rig,
        None => plan_rig(&plan, &arguments.folder)?,
    };
    plan.check_bench(&rig)?;
    let lock = ShardLock::new(&arguments.folder, &plan, arguments.shard)?;
    let (context, shards) = ((plan, Arc::new(campaign)), vec![arguments.shard]);
    let is_lost = play_on_board(&arguments.board, &arguments.folder, context, shards, &rig, arguments.jobs, quiet)?;
    lock.remove();
    if is_lost { Err(CampaignError::NotSafe.into()) } else { Ok(Exit::Passed) }
}

fn submit(arguments: &SubmitArgs, quiet: bool) -> CommandResult {
    let plan = Plan::read(&arguments.folder)?;
    let engine = match arguments.on {
        EngineName::Slurm => Engine::Slurm,
        EngineName::Hyperqueue => Engine::HyperQueue,
    };
    let commands = submission(engine, &plan, &arguments.folder)?;
    let lines = commands.each_ref().map(|words| command_line(words));
    if !arguments.run {
        stdio::show(&format!("{}\n", lines.join("\n")));
        return Ok(Exit::Passed);
    }
    let [array, _] = &commands;
    let [program, words @ ..] = &**array else { return Ok(Exit::Invalid) };
    match Command::new(program).args(words).status() {
        Ok(status) if status.success() => merge_folder(&arguments.folder, None, quiet, OutputFormat::Human),
        Ok(status) => {
            let message = format!("{program} ended with {status}; `campaign status` lists the missing shards");
            Err(Failure::new(Exit::Unreachable, &message))
        }
        Err(error) => {
            let message = format!("{program} cannot be started: {error}; install it or use another engine with --on");
            Err(Failure::new(Exit::Unreachable, &message))
        }
    }
}

fn merge_folder(folder: &Path, jobs: Option<u16>, quiet: bool, format: OutputFormat) -> CommandResult {
    let (plan, campaign) = Plan::open(folder)?;
    let _lock = lock_folder(folder)?;
    let rig = plan_rig(&plan, folder)?;
    // Other machines may have played the shards. Only the worst trials need the planned bench here.
    let bench = if rig.is_simulated() { plan.check_bench(&rig) } else { Ok(()) };
    merge_and_show(folder, (plan, Arc::new(campaign)), bench, jobs, quiet, format)
}

fn plan_rig(plan: &Plan, folder: &Path) -> Result<RigSpec, CampaignError> {
    plan.rig.parse().map_err(|_| CampaignError::NoPlan(folder.to_owned()))
}

/// Plays the trials of `plan.confirm` again and merges. Then plays the worst trials again, unless
/// `bench` is an error because bench or firmware differ from the plan.
fn merge_and_show(
    folder: &Path,
    (plan, campaign): (Plan, Arc<Campaign>),
    bench: Result<(), CampaignError>,
    jobs: Option<u16>,
    quiet: bool,
    format: OutputFormat,
) -> CommandResult {
    let mut agreement = None;
    if campaign.confirm.is_some() {
        let config = PlayConfig::new(RigSpec::hosted(), job_count(jobs));
        let (folder, plan, campaign) = (folder.to_owned(), plan.clone(), Arc::clone(&campaign));
        agreement = run_campaign_work(config, CampaignProgress::new(0, quiet), move |config, events| {
            confirm(&folder, &plan, &campaign, config, &mut |event| events.send(PlayEvent::Trial(event)))
        })??;
    }
    let summary = merge(folder, &plan, &campaign, agreement)?;
    let config = PlayConfig::new(plan_rig(&plan, folder)?, job_count(jobs));
    let (trials, out, played) = (worst_trials(&summary)?, folder.to_owned(), Arc::clone(&campaign));
    let work = move |config: &PlayConfig, _: &mut EventSender<PlayEvent>| play_worst(&out, &played, &trials, config);
    let links = match bench {
        Ok(()) => run_campaign_work(config, CampaignProgress::new(0, true), work)?,
        Err(error) => Err(error),
    };
    let links = links.unwrap_or_else(|error| {
        stdio::note(&format!(
            "the report has no responses of the worst trials, because they could not be played again: {error}"
        ));
        ResponseLinks::new()
    });
    let document = report::write(folder, &summary, &links)?;
    stdio::show_as(format, &summary.result(), || document.to_console(None, Style::default()));
    stdio::note(&format!("report: {}", folder.join(report::REPORT_FILE).display()));
    Ok(if summary.is_rig_lost() { Exit::Unreachable } else { Exit::of_verdict(summary.verdict()) })
}

/// Returns true if the rig counts as lost, although the shards are complete.
fn play_on_board(
    board: &BoardArgs,
    folder: &Path,
    context: (Plan, Arc<Campaign>),
    shards: Vec<u32>,
    rig: &RigSpec,
    jobs: Option<u16>,
    quiet: bool,
) -> Result<bool, Failure> {
    let reservation = board.reserve("campaign")?;
    let state = Arc::new(Mutex::new(ShardEnd::default()));
    let jobs = if board.allows_parallel_links(rig) { job_count(jobs) } else { 1 };
    let config = PlayConfig { end: Arc::clone(&state), ..PlayConfig::new(rig.clone(), jobs) };
    let played = play(folder, context, shards, config, quiet);
    let end = *state.lock().unwrap_or_else(PoisonError::into_inner);
    let is_lost = end.lost || matches!(played, Ok(Err(CampaignError::Run(RunError::Lost(_)))));
    let outcome = if end.unconfirmed || is_lost { BoardOutcome::unconfirmed() } else { BoardOutcome::untouched() };
    release(reservation, outcome)?;
    played??;
    Ok(end.is_lost(end.failed))
}

fn play(
    folder: &Path,
    (plan, campaign): (Plan, Arc<Campaign>),
    shards: Vec<u32>,
    config: PlayConfig,
    quiet: bool,
) -> Result<Result<(), CampaignError>, Failure> {
    let total: u64 = shards.iter().map(|shard| plan.trials_of(*shard)).map(|trials| trials.end - trials.start).sum();
    let folder = folder.to_owned();
    run_campaign_work(config, CampaignProgress::new(total, quiet), move |config, events| {
        shards.into_iter().try_for_each(|shard| {
            let trials = plan.trials_of(shard);
            let count = trials.end.saturating_sub(trials.start);
            let mut on_trial = |event| events.send(PlayEvent::Trial(event));
            if !play_shard(&folder, &plan, &campaign, shard, config, &mut on_trial)? {
                events.send(PlayEvent::Skipped(count));
            }
            Ok(())
        })
    })
}

fn run_campaign_work<R: Send + 'static>(
    config: PlayConfig,
    mut progress: CampaignProgress,
    work: impl FnOnce(&PlayConfig, &mut EventSender<PlayEvent>) -> R + Send + 'static,
) -> Result<R, Failure> {
    let work = move |cancel: &CancelToken, events: &mut EventSender<PlayEvent>| {
        Ok::<R, Failure>(work(&PlayConfig { cancel: cancel.clone(), ..config }, events))
    };
    let result = unless_signalled(run_until_signal(None, work, |event| progress.add(event)));
    result.inspect_err(|failure| {
        if failure.is_signal() {
            stdio::note("stopped by a signal; complete shards are kept, and the same command continues");
        }
    })
}

fn show_status(folder: &Path) -> CommandResult {
    let (plan, campaign) = Plan::open(folder)?;
    let status = status(folder, &plan, &campaign)?;
    let (whole, missing) = (status.whole.len(), status.missing.len());
    stdio::show(&format!(
        "{}: {whole} of {} shards complete, {missing} missing, {} unusable\n",
        plan.title,
        plan.shards,
        status.unusable.len()
    ));
    for (_, message) in &status.unusable {
        stdio::error(message);
    }
    if !status.unusable.is_empty() {
        return Ok(Exit::Invalid);
    }
    if missing == 0 {
        return Ok(Exit::Passed);
    }
    let shards: Vec<_> = status.missing.iter().map(ToString::to_string).collect();
    stdio::show(&format!("missing: {}\n", shards.join(" ")));
    let reason = format!("{missing} of {} shards are missing; `campaign play` plays them", plan.shards);
    stdio::verdict(Exit::Inconclusive, &reason, OutputFormat::Human);
    Ok(Exit::Inconclusive)
}

impl From<CampaignError> for Failure {
    fn from(error: CampaignError) -> Self {
        match error {
            CampaignError::Files(faults) => faults.into(),
            CampaignError::Connect(error) => error.into(),
            CampaignError::Rig(error) => error.into(),
            CampaignError::Run(error) => error.into(),
            CampaignError::NotSafe => Self::new(Exit::Unreachable, &error),
            CampaignError::Cancelled => Self::new(Exit::Inconclusive, &error),
            error => Self::invalid(&error),
        }
    }
}
