//! `platebench campaign`: plays sweeps and Monte Carlo in shards, on one machine or many.

mod arguments;
mod progress;

pub(crate) use arguments::CampaignArgs;

use crate::board_args::{BoardArgs, release};
use crate::exit::Exit;
use crate::options::{OutputFormat, job_count};
use crate::shutdown::{EventSender, WorkResult, run_until_signal};
use crate::stdio;
use arguments::{CampaignCommand, EngineName, PlayArgs, RunArgs, SubmitArgs};
use platebench_boards::RunEnd;
use platebench_campaign::submit::{Engine, command_line, submission};
use platebench_campaign::{
    Campaign, CampaignError, Plan, PlayConfig, ResponseLinks, Summary, confirm, merge, play_shard, play_worst,
    plays_worst, report, shards_of_run, status, worst_trials,
};
use platebench_rig::{CancelToken, RigError, RigSpec};
use progress::{PlayEvent, Progress};
use std::path::Path;
use std::process::Command;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

pub(crate) fn campaign(arguments: &CampaignArgs, quiet: bool) -> Exit {
    let result = match &arguments.command {
        CampaignCommand::Run(arguments) => run(arguments, quiet),
        CampaignCommand::Plan(arguments) => load(&arguments.file)
            .and_then(|campaign| plan(&campaign, &arguments.out, &arguments.rig, arguments.shards))
            .map(|plan| {
                stdio::note(&format!("{} trials in {} shards: {}", plan.trials, plan.shards, arguments.out.display()));
                Exit::Passed
            }),
        CampaignCommand::Play(arguments) => play_one(arguments, quiet),
        CampaignCommand::Merge(arguments) => merge_folder(&arguments.folder, arguments.jobs, quiet, arguments.format),
        CampaignCommand::Submit(arguments) => submit(arguments, quiet),
        CampaignCommand::Status(arguments) => show_status(&arguments.folder),
    };
    result.unwrap_or_else(|error| reject(&error))
}

fn load(file: &Path) -> Result<Campaign, CampaignError> {
    Campaign::load(file).map_err(CampaignError::Files)
}

fn plan(campaign: &Campaign, folder: &Path, rig: &RigSpec, shards: u32) -> Result<Plan, CampaignError> {
    rig.check()?;
    if campaign.confirm.is_some() && *rig != RigSpec::Hosted {
        return Err(CampaignError::ConfirmedRig(rig.to_string()));
    }
    let plan = Plan::new(campaign, folder, rig, shards)?;
    plan.write(folder)?;
    Ok(plan)
}

fn run(arguments: &RunArgs, quiet: bool) -> Result<Exit, CampaignError> {
    let campaign = Arc::new(load(&arguments.file)?);
    let rig = match arguments.board.find_rig() {
        Ok(rig) => rig.unwrap_or_else(|| arguments.rig.clone()),
        Err(exit) => return Ok(exit),
    };
    let planned = Plan::exists(&arguments.out).then(|| Plan::read(&arguments.out)).transpose()?;
    let shards = planned.map_or_else(|| shards_of_run(&campaign), |plan| plan.shards);
    let plan = plan(&campaign, &arguments.out, &rig, shards)?;
    let shards = (1..=plan.shards).collect();
    let context = (plan.clone(), Arc::clone(&campaign));
    if let Some(exit) = play_on_board(&arguments.board, &arguments.out, context, shards, &rig, arguments.jobs, quiet)? {
        return Ok(exit);
    }
    merge_and_show(&arguments.out, (plan, campaign), Ok(()), arguments.jobs, quiet, arguments.format)
}

fn play_one(arguments: &PlayArgs, quiet: bool) -> Result<Exit, CampaignError> {
    let (plan, campaign) = Plan::open(&arguments.folder)?;
    let planned = || plan.rig.parse().map_err(|_| CampaignError::NoPlan(arguments.folder.clone()));
    let rig = match arguments.board.find_rig() {
        Ok(rig) => rig.or_else(|| arguments.rig.clone()).map_or_else(planned, Ok)?,
        Err(exit) => return Ok(exit),
    };
    plan.check_bench(&rig)?;
    let context = (plan, Arc::new(campaign));
    let played = play_on_board(
        &arguments.board,
        &arguments.folder,
        context,
        vec![arguments.shard],
        &rig,
        arguments.jobs,
        quiet,
    )?;
    Ok(played.unwrap_or(Exit::Passed))
}

fn submit(arguments: &SubmitArgs, quiet: bool) -> Result<Exit, CampaignError> {
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
            stdio::error(&format!("{program} ended with {status}; `campaign status` lists the missing shards"));
            Ok(Exit::Unreachable)
        }
        Err(error) => {
            stdio::error(&format!("{program}: {error}; expected the program of the engine"));
            Ok(Exit::Unreachable)
        }
    }
}

fn merge_folder(folder: &Path, jobs: Option<u16>, quiet: bool, format: OutputFormat) -> Result<Exit, CampaignError> {
    let (plan, campaign) = Plan::open(folder)?;
    let rig = plan_rig(&plan, folder)?;
    // The shards may have been played elsewhere.
    let bench = if plays_worst(&rig) { plan.check_bench(&rig) } else { Ok(()) };
    merge_and_show(folder, (plan, Arc::new(campaign)), bench, jobs, quiet, format)
}

fn plan_rig(plan: &Plan, folder: &Path) -> Result<RigSpec, CampaignError> {
    plan.rig.parse().map_err(|_| CampaignError::NoPlan(folder.to_owned()))
}

/// Plays trials again: before the merge those of `plan.confirm`, after it the worst, if `bench` and firmware are those
/// of the plan.
fn merge_and_show(
    folder: &Path,
    (plan, campaign): (Plan, Arc<Campaign>),
    bench: Result<(), CampaignError>,
    jobs: Option<u16>,
    quiet: bool,
    format: OutputFormat,
) -> Result<Exit, CampaignError> {
    let mut agreement = None;
    if campaign.confirm.is_some() {
        let config = PlayConfig::new(RigSpec::Hosted, job_count(jobs));
        let (folder, plan, campaign) = (folder.to_owned(), plan.clone(), Arc::clone(&campaign));
        let cancel = config.cancel.clone();
        let work = move |events: &mut EventSender<_, PlayEvent>| {
            confirm(&folder, &plan, &campaign, &config, &mut |event| events.send(PlayEvent::Trial(event)))
        };
        match run_campaign_work(&cancel, work, Progress::new(0, quiet))? {
            Ok(found) => agreement = found,
            Err(exit) => return Ok(exit),
        }
    }
    let summary = merge(folder, &plan, &campaign, agreement)?;
    let config = PlayConfig::new(plan_rig(&plan, folder)?, job_count(jobs));
    let (trials, out, played) = (worst_trials(&summary)?, folder.to_owned(), Arc::clone(&campaign));
    let cancel = config.cancel.clone();
    let work = move |_: &mut EventSender<_, PlayEvent>| play_worst(&out, &played, &trials, &config);
    let links = match bench.and_then(|()| run_campaign_work(&cancel, work, Progress::new(0, true))) {
        Ok(Ok(links)) => links,
        Ok(Err(exit)) => return Ok(exit),
        Err(error) => {
            stdio::note(&format!("no responses of the worst trials: {error}"));
            ResponseLinks::new()
        }
    };
    report::write(folder, &summary, &links)?;
    Ok(show(&summary, folder, format))
}

/// As [`play`], with the board reserved.
fn play_on_board(
    board: &BoardArgs,
    folder: &Path,
    context: (Plan, Arc<Campaign>),
    shards: Vec<u32>,
    rig: &RigSpec,
    jobs: Option<u16>,
    quiet: bool,
) -> Result<Option<Exit>, CampaignError> {
    let reservation = match board.reserve("campaign") {
        Ok(reservation) => reservation,
        Err(exit) => return Ok(Some(exit)),
    };
    let unconfirmed = Arc::new(AtomicBool::new(false));
    let jobs = if board.allows_parallel_links(rig) { jobs } else { Some(1) };
    let played = play(folder, context, shards, rig, jobs, quiet, &unconfirmed);
    let end = if unconfirmed.load(Ordering::Relaxed) || matches!(played, Err(CampaignError::Lost(_))) {
        RunEnd::unconfirmed()
    } else {
        RunEnd::untouched()
    };
    let released = release(reservation, end, Exit::Passed);
    if released == Exit::Passed { played } else { Ok(Some(released)) }
}

/// `Some` if a signal ended it.
fn play(
    folder: &Path,
    (plan, campaign): (Plan, Arc<Campaign>),
    shards: Vec<u32>,
    rig: &RigSpec,
    jobs: Option<u16>,
    quiet: bool,
    unconfirmed: &Arc<AtomicBool>,
) -> Result<Option<Exit>, CampaignError> {
    let total: u64 = shards.iter().map(|shard| plan.trials_of(*shard)).map(|trials| trials.end - trials.start).sum();
    let config = PlayConfig { unconfirmed: Arc::clone(unconfirmed), ..PlayConfig::new(rig.clone(), job_count(jobs)) };
    let cancel = config.cancel.clone();
    let folder = folder.to_owned();
    let work = move |events: &mut EventSender<_, PlayEvent>| {
        shards.into_iter().try_for_each(|shard| {
            let trials = plan.trials_of(shard);
            let count = trials.end.saturating_sub(trials.start);
            let mut on_trial = |event| events.send(PlayEvent::Trial(event));
            if !play_shard(&folder, &plan, &campaign, shard, &config, &mut on_trial)? {
                events.send(PlayEvent::Skipped(count));
            }
            Ok(())
        })
    };
    Ok(run_campaign_work(&cancel, work, Progress::new(total, quiet))?.err())
}

/// Sends the progress of a campaign's work, and its result at the end.
type CampaignSender<R> = EventSender<Result<R, CampaignError>, PlayEvent>;

/// The result, or the exit code if a signal ended the work.
fn run_campaign_work<R: Send + 'static>(
    cancel: &CancelToken,
    work: impl FnOnce(&mut CampaignSender<R>) -> Result<R, CampaignError> + Send + 'static,
    mut progress: Progress,
) -> Result<Result<R, Exit>, CampaignError> {
    match run_until_signal(cancel, None, work, |event| progress.add(event)) {
        Ok(WorkResult::Finished(Ok(result), None)) => Ok(Ok(result)),
        Ok(WorkResult::Finished(_, Some(signal)) | WorkResult::Abandoned(signal)) => {
            stdio::note("stopped; complete shards are kept, the same command continues");
            Ok(Err(Exit::Signal(signal)))
        }
        Ok(WorkResult::Finished(Err(error), None)) => Err(error),
        Err(error) => {
            stdio::error(&error.to_string());
            Ok(Err(Exit::Inconclusive))
        }
    }
}

fn show(summary: &Summary<'_>, folder: &Path, format: OutputFormat) -> Exit {
    match format {
        OutputFormat::Human => stdio::show(&summary.text()),
        OutputFormat::Json => stdio::show_json(&summary.json()),
    }
    stdio::note(&format!("report: {}", folder.join(report::REPORT_FILE).display()));
    Exit::of_verdict(summary.verdict())
}

fn show_status(folder: &Path) -> Result<Exit, CampaignError> {
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
    Ok(Exit::Inconclusive)
}

fn reject(error: &CampaignError) -> Exit {
    if let CampaignError::Files(faults) = error {
        return stdio::reject_files(faults);
    }
    stdio::error(&error.to_string());
    match error {
        CampaignError::Connect(error) if error.is_invalid_input() => Exit::Invalid,
        CampaignError::Rig(RigError::ConfigurationRejected(_)) => Exit::Invalid,
        CampaignError::Connect(_) | CampaignError::Rig(_) | CampaignError::Lost(_) => Exit::Unreachable,
        CampaignError::Run(error) => Exit::of_error(error),
        CampaignError::Cancelled => Exit::Inconclusive,
        _ => Exit::Invalid,
    }
}
