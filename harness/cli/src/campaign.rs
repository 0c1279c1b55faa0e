//! `platebench campaign`: plays sweeps and Monte Carlo in shards, on one machine or many.

use crate::board::{BoardArgs, release};
use crate::exit::{CommandResult, Exit, Failure, OrInvalid};
use crate::options::{OutputFormat, job_count, rig_help};
use crate::selection::warn_of_scenarios;
use crate::shutdown::{self, EventSender, run_until_signal, unless_signalled};
use crate::stdio;
use clap::{Args, Subcommand, ValueEnum};
use platebench_engine::{Event, RunError};
use platebench_experiments::campaign::comparison::{COMPARISON_PAGE, LabelledFolder, compare};
use platebench_experiments::campaign::draw::DrawnTrial;
use platebench_experiments::campaign::{
    Campaign, CampaignError, CampaignPlan, PlayConfig, ResponseLinks, ShardEnd, ShardLock, TrialEvent, confirm,
    lock_folder, merge, part_name, play_shard, play_worst, report, response_links, shards_of_run, status, worst_trials,
};
use platebench_experiments::campaign::{Engine, command_line, submission};
use platebench_lab::boards::BoardOutcome;
use platebench_model::record::FileLock;
use platebench_model::trace::{AtPath, create_folder};
use platebench_model::{quoted, quoted_path};
use platebench_report::console;
use platebench_report::page::{self, ReportPage, RowCache};
use platebench_rig::{CancelToken, RigSpec, SpecError};
use std::path::{Path, PathBuf};
use std::process::Command;
use std::str::FromStr;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  platebench campaign run scenarios/campaigns/laws-delay-force.toml --out C
  platebench campaign run my.toml --out C --rig own='exec:./controller {port}' --rig reference=hosted
  platebench campaign plan my.toml --out C --shards 64
  platebench campaign play C --shard 7             on any machine that sees C
  platebench campaign submit C --on slurm          prints the commands of an array
  platebench campaign status C
  platebench campaign merge C

Exit codes: 0 passed, or a complete map (play: the shard is complete), 1 failed, 2 invalid input,
or a damaged or foreign part or plan, 3 inconclusive, or a shard is missing, 4 no trial applies to
the controller, 5 the rig could not be reached or was lost. A grid without [judge] and without a
requirement is a map: its failing trials are counted and do not fail it")]
pub(crate) struct CampaignArgs {
    #[command(subcommand)]
    command: CampaignCommand,
}

#[derive(Debug, Subcommand)]
enum CampaignCommand {
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
    /// Compare controllers that played the same campaign, trial by trial
    Compare(CompareArgs),
}

#[derive(Debug, Args)]
struct RunArgs {
    /// The campaign file
    file: PathBuf,
    /// The campaign folder
    #[arg(long, value_name = "FOLDER")]
    out: PathBuf,
    /// Trials that are played at once; default: one per core
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=1024))]
    jobs: Option<u16>,
    #[arg(long, help = rig_help(), long_help = several_rigs_help(), default_value = "hosted", conflicts_with = "board")]
    rig: Vec<LabelledRig>,
    #[command(flatten)]
    board: BoardArgs,
    /// Format of standard output
    #[arg(long, value_enum, default_value_t = OutputFormat::Human)]
    format: OutputFormat,
}

fn several_rigs_help() -> String {
    format!(
        "{}\nSeveral rigs with labels (--rig own=RIG --rig reference=RIG) play the same trials, each into the folder \
         of its label. Each is then compared with the last",
        rig_help()
    )
}

#[derive(Debug, Clone)]
struct LabelledRig {
    label: Option<String>,
    rig: RigSpec,
}

impl FromStr for LabelledRig {
    type Err = SpecError;

    /// A label is the name of a folder. It contains no colon, so a `=` in a command starts none.
    fn from_str(text: &str) -> Result<Self, SpecError> {
        let is_label = |label: &str| {
            label.starts_with(|first: char| first.is_ascii_alphanumeric())
                && label.chars().all(|letter| letter.is_ascii_alphanumeric() || "-_".contains(letter))
        };
        Ok(match text.split_once('=').filter(|(label, _)| is_label(label)) {
            Some((label, rig)) => Self { label: Some(label.to_owned()), rig: rig.parse()? },
            None => Self { label: None, rig: text.parse()? },
        })
    }
}

#[derive(Debug, Args)]
struct CompareArgs {
    /// Campaign folders; each is compared with the last one
    #[arg(required = true, num_args = 2..)]
    folders: Vec<PathBuf>,
    /// Format of standard output
    #[arg(long, value_enum, default_value_t = OutputFormat::Human)]
    format: OutputFormat,
}

#[derive(Debug, Args)]
struct PlanArgs {
    /// The campaign file
    file: PathBuf,
    /// The campaign folder
    #[arg(long, value_name = "FOLDER")]
    out: PathBuf,
    /// Number of shards
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..=1_000_000))]
    shards: u32,
    #[arg(long, help = rig_help(), default_value = "hosted")]
    rig: RigSpec,
}

#[derive(Debug, Args)]
struct PlayArgs {
    /// The campaign folder
    folder: PathBuf,
    /// Number of the shard, from 1
    #[arg(long, value_name = "K")]
    shard: u32,
    /// Trials that are played at once; default: one per core
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=1024))]
    jobs: Option<u16>,
    /// Rig with the planned firmware; default: the rig of the plan
    #[arg(long, conflicts_with = "board")]
    rig: Option<RigSpec>,
    #[command(flatten)]
    board: BoardArgs,
}

#[derive(Debug, Args)]
struct MergeArgs {
    /// The campaign folder
    folder: PathBuf,
    /// Trials that `plan.confirm` plays at once; default: one per core
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=1024))]
    jobs: Option<u16>,
    /// Format of standard output
    #[arg(long, value_enum, default_value_t = OutputFormat::Human)]
    format: OutputFormat,
}

#[derive(Debug, Args)]
struct SubmitArgs {
    /// The campaign folder
    folder: PathBuf,
    /// Engine that starts the shards
    #[arg(long, value_enum)]
    on: EngineName,
    /// Run the commands instead of printing them
    #[arg(long)]
    run: bool,
}

#[derive(Debug, Clone, Copy, ValueEnum)]
enum EngineName {
    Slurm,
    Hyperqueue,
}

#[derive(Debug, Args)]
struct FolderArgs {
    /// The campaign folder
    folder: PathBuf,
}

pub(crate) fn campaign(arguments: &CampaignArgs, quiet: bool) -> CommandResult {
    match &arguments.command {
        CampaignCommand::Run(arguments) => run(arguments, quiet),
        CampaignCommand::Plan(arguments) => {
            let campaign = Campaign::load(&arguments.file)?;
            let (plan, _lock) = plan(&campaign, &arguments.out, &arguments.rig, arguments.shards)?;
            stdio::note(&format!("{} trials in {} shards: {}", plan.trials, plan.shards, quoted_path(&arguments.out)));
            campaign.truncated.iter().for_each(|truncation| stdio::note(&truncation.line()));
            Ok(Exit::Passed)
        }
        CampaignCommand::Play(arguments) => play_one(arguments, quiet),
        CampaignCommand::Merge(arguments) => merge_folder(&arguments.folder, arguments.jobs, quiet, arguments.format),
        CampaignCommand::Submit(arguments) => submit(arguments, quiet),
        CampaignCommand::Status(arguments) => show_status(&arguments.folder),
        CampaignCommand::Compare(arguments) => {
            let labels: Vec<String> = arguments.folders.iter().map(|folder| folder.display().to_string()).collect();
            let folders = labels.iter().zip(&arguments.folders).map(|(label, folder)| LabelledFolder { label, folder });
            let comparison = compare(&folders.collect::<Vec<_>>())?;
            stdio::show_result(arguments.format, &comparison, &comparison.document());
            Ok(Exit::Passed)
        }
    }
}

/// Creates the folder and reserves it until the lock is dropped.
fn plan(
    campaign: &Campaign,
    folder: &Path,
    rig: &RigSpec,
    shards: u32,
) -> Result<(CampaignPlan, FileLock), CampaignError> {
    rig.check()?;
    warn_of_scenarios(std::slice::from_ref(&campaign.template.scenario));
    if campaign.confirm.is_some() && *rig != RigSpec::hosted() {
        return Err(CampaignError::ConfirmedRig(rig.to_string()));
    }
    let plan = CampaignPlan::new(campaign, folder, rig, shards)?;
    create_folder(folder).at(folder)?;
    let lock = lock_folder(folder)?;
    plan.write(folder)?;
    Ok((plan, lock))
}

fn run(arguments: &RunArgs, quiet: bool) -> CommandResult {
    if let [LabelledRig { label: None, rig }] = &arguments.rig[..] {
        let rig = arguments.board.find_rig()?.unwrap_or_else(|| rig.clone());
        return run_on_rig(arguments, &arguments.out, &rig, quiet, Some(arguments.format));
    }
    let rigs = distinct_labels(&arguments.rig)?;
    if CampaignPlan::exists(&arguments.out) {
        return Err(CampaignError::OtherPlan(arguments.out.clone()).into());
    }
    let folders: Vec<_> = rigs.iter().map(|(label, _)| arguments.out.join(label)).collect();
    let mut exit = Exit::Passed;
    for ((label, rig), folder) in rigs.iter().zip(&folders) {
        stdio::note(&format!("{label}: rig {}", quoted(&rig.to_string())));
        // Standard output contains one JSON document, the comparison.
        let format = (arguments.format == OutputFormat::Human).then_some(OutputFormat::Human);
        exit = exit.worst(run_on_rig(arguments, folder, rig, quiet, format)?);
    }
    let labelled = rigs.iter().zip(&folders).map(|((label, _), folder)| LabelledFolder { label, folder });
    let comparison = compare(&labelled.collect::<Vec<_>>())?;
    let document = comparison.write(&arguments.out)?;
    if !exit.is_hidden(quiet, arguments.format) {
        stdio::show_result(arguments.format, &comparison, &document);
        stdio::note(&format!("comparison: {}", quoted_path(&arguments.out.join(COMPARISON_PAGE))));
    }
    Ok(exit)
}

/// Fails unless there are several rigs and each has a label of its own.
fn distinct_labels(rigs: &[LabelledRig]) -> Result<Vec<(&str, &RigSpec)>, Failure> {
    let mut labelled: Vec<(&str, &RigSpec)> = Vec::new();
    for LabelledRig { label, rig } in rigs {
        let problem = match label {
            None => format!("--rig {rig} has no label"),
            Some(label) if labelled.iter().any(|(known, _)| known == label) => format!("--rig {label}=… occurs twice"),
            Some(label) => {
                labelled.push((label, rig));
                continue;
            }
        };
        let message = format!("{problem}, expected one label per rig: --rig own=RIG --rig reference=RIG");
        return Err(Failure::invalid(&message));
    }
    if labelled.len() < 2 {
        return Err(Failure::invalid(&"one --rig with a label, expected two or more, or one without a label"));
    }
    Ok(labelled)
}

/// Plays, merges and shows one campaign; shows nothing without a format.
fn run_on_rig(
    arguments: &RunArgs,
    folder: &Path,
    rig: &RigSpec,
    quiet: bool,
    format: Option<OutputFormat>,
) -> CommandResult {
    let campaign = Arc::new(Campaign::load(&arguments.file)?);
    let planned = CampaignPlan::exists(folder).then(|| CampaignPlan::read(folder)).transpose()?;
    let shards = planned.map_or_else(|| shards_of_run(&campaign), |plan| plan.shards);
    let (plan, _lock) = plan(&campaign, folder, rig, shards)?;
    let shards = (1..=plan.shards).collect();
    let context = (plan.clone(), Arc::clone(&campaign));
    play_on_board(&arguments.board, folder, context, shards, rig, arguments.jobs, quiet)?;
    merge_and_show(folder, (plan, campaign), Ok(()), arguments.jobs, quiet, format)
}

fn play_one(arguments: &PlayArgs, quiet: bool) -> CommandResult {
    let (plan, campaign) = CampaignPlan::open(&arguments.folder)?;
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
    let plan = CampaignPlan::read(&arguments.folder)?;
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
    shutdown::listen().or_invalid()?;
    let mut command = Command::new(program);
    command.args(words);
    let Some(ended) = shutdown::run_unless_signalled(move || command.status()).or_invalid()? else {
        let cancel = match engine {
            Engine::Slurm => "scancel JOB",
            Engine::HyperQueue => "hq job cancel JOB",
        };
        let message = format!("the shards stay in the queue; end them with `{cancel}`, {program} printed the number");
        return Err(Failure::new(Exit::Signal(shutdown::received_signal().unwrap_or_default()), &message));
    };
    match ended {
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
    let (plan, campaign) = CampaignPlan::open(folder)?;
    let _lock = lock_folder(folder)?;
    let rig = plan_rig(&plan, folder)?;
    // Other machines may have played the shards. Only the worst trials need the planned bench here.
    let bench = if rig.is_simulated() { plan.check_bench(&rig) } else { Ok(()) };
    merge_and_show(folder, (plan, Arc::new(campaign)), bench, jobs, quiet, Some(format))
}

fn plan_rig(plan: &CampaignPlan, folder: &Path) -> Result<RigSpec, CampaignError> {
    plan.rig.parse().map_err(|_| CampaignError::NoPlan(folder.to_owned()))
}

/// Plays the trials of `plan.confirm` again and merges. Then plays the worst trials again, unless
/// `bench` is an error because bench or firmware differ from the plan.
fn merge_and_show(
    folder: &Path,
    (plan, campaign): (CampaignPlan, Arc<Campaign>),
    bench: Result<(), CampaignError>,
    jobs: Option<u16>,
    quiet: bool,
    format: Option<OutputFormat>,
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
    let work =
        move |config: &PlayConfig, _: &mut EventSender<PlayEvent>| play_worst_trials(&out, &played, &trials, config);
    let links = match bench {
        Ok(()) => match run_campaign_work(config, CampaignProgress::new(0, true), work)? {
            // The folder cannot be written, for example because of a link in it.
            Err(error @ CampaignError::File(_)) => return Err(error.into()),
            played => played,
        },
        Err(error) => Err(error),
    };
    let links = links.unwrap_or_else(|error| {
        stdio::note(&format!(
            "the report has no responses of the worst trials, because they could not be played again: {error}"
        ));
        ResponseLinks::new()
    });
    let document = report::write(folder, &summary, &links)?;
    let exit = match summary.verdict() {
        _ if summary.is_rig_lost() => Exit::Unreachable,
        _ if summary.overall.is_not_applicable() => Exit::NothingToRun,
        None => Exit::Passed,
        Some(verdict) => Exit::of_verdict(verdict),
    };
    // The result of a map, which has no verdict, is its table.
    let can_pass = summary.verdict().is_some();
    if let Some(format) = format.filter(|format| !exit.is_hidden(quiet && can_pass, *format)) {
        stdio::show_result(format, &summary.result(), &document);
        stdio::note(&format!("report: {}", quoted_path(&folder.join(report::REPORT_FILE))));
    }
    Ok(exit)
}

/// Plays the worst trials and writes the page of their run.
fn play_worst_trials(
    folder: &Path,
    campaign: &Campaign,
    trials: &[DrawnTrial],
    config: &PlayConfig,
) -> Result<ResponseLinks, CampaignError> {
    let mut rows = RowCache::default();
    let on_event = |event| {
        if let Event::TrialFinished { trial, rows: played, .. } = event {
            rows.add(&trial.trace, played);
        }
    };
    let Some((record, run)) = play_worst(folder, campaign, trials, config, on_event)? else {
        return Ok(ResponseLinks::new());
    };
    let page = ReportPage::new(&record, run.path()).with_rows(rows);
    page.write(&run.path().join(page::FILE)).map_err(CampaignError::Page)?;
    Ok(response_links(trials, &record, |index, scenario| {
        (format!("{}#{}", page::FILE, page::scenario_anchor(index)), console::scenario_reason(scenario))
    }))
}

/// Returns true if the rig counts as lost, although the shards are complete.
fn play_on_board(
    board: &BoardArgs,
    folder: &Path,
    context: (CampaignPlan, Arc<Campaign>),
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
    (plan, campaign): (CampaignPlan, Arc<Campaign>),
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
    let (plan, campaign) = CampaignPlan::open(folder)?;
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
    let parts: Vec<_> = status.missing.iter().map(|shard| part_name(*shard)).collect();
    stdio::show(&format!("missing: {}\nmissing parts: {}\n", shards.join(" "), parts.join(" ")));
    let reason = format!("{missing} of {} shards are missing; `campaign play` plays them", plan.shards);
    Exit::Inconclusive.show_verdict(&reason, OutputFormat::Human);
    Ok(Exit::Inconclusive)
}

impl From<CampaignError> for Failure {
    fn from(error: CampaignError) -> Self {
        match error {
            CampaignError::Files(problems) => problems.into(),
            CampaignError::Connect(error) => error.into(),
            CampaignError::Run(error) => error.into(),
            CampaignError::NotSafe => Self::new(Exit::Unreachable, &error),
            error => Self::invalid(&error),
        }
    }
}

const PROGRESS_INTERVAL: Duration = Duration::from_secs(10);

#[derive(Debug, Clone, Copy)]
enum PlayEvent {
    Trial(TrialEvent),
    /// Number of trials in a shard that was complete before, so it is not played again.
    Skipped(u64),
}

struct CampaignProgress {
    started: Instant,
    last: Instant,
    quiet: bool,
    total: u64,
    played: u64,
    skipped: u64,
    failures: u64,
}

impl CampaignProgress {
    /// `total` is the number of trials, or 0 if the number is not known.
    fn new(total: u64, quiet: bool) -> Self {
        let now = Instant::now();
        Self { started: now, last: now, quiet, total, played: 0, skipped: 0, failures: 0 }
    }

    fn add(&mut self, event: PlayEvent) {
        match event {
            PlayEvent::Skipped(trials) => self.skipped += trials,
            PlayEvent::Trial(TrialEvent { is_failure }) => {
                self.played += 1;
                self.failures += u64::from(is_failure);
            }
        }
        if !self.quiet && self.last.elapsed() >= PROGRESS_INTERVAL {
            self.last = Instant::now();
            let failures = self.failures;
            if self.total == 0 {
                return stdio::note(&format!("{} trials played again, {failures} failed", self.played));
            }
            let rate = self.played as f64 / self.started.elapsed().as_secs_f64();
            let left = self.total.saturating_sub(self.played + self.skipped) as f64 / rate.max(1e-9);
            stdio::note(&format!(
                "{} of {} trials, {failures} failed, {rate:.0} trials/s, {left:.0} s left",
                self.played + self.skipped,
                self.total
            ));
        }
    }
}
