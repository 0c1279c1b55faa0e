//! `platebench acceptance`: conducts an acceptance session, or verifies its record.

use crate::board::{BoardArgs, release};
use crate::exit::{CommandResult, Exit, Failure, OrInvalid};
use crate::options::{ClockArg, ClockRequest, OutputFormat, PacingArg, check_line_speed, job_count, parse_time_scale};
use crate::prompt::TerminalOperator;
use crate::run_plan::SessionView;
use crate::shutdown::{EventSender, run_until_signal};
use crate::stdio;
use clap::{Args, Subcommand};
use platebench_document::format::count;
use platebench_engine::{CancelToken, Event, LiveTap, RunError, RunPlan};
use platebench_lab::acceptance::session_record::{StepKind, StepRecord};
use platebench_lab::acceptance::{
    AcceptError, AcceptancePlan, PublicKey, SecretKey, SessionConfig, SessionDetails, SessionHooks, SessionObserver,
    SessionRecord, Signer, page, play_session, verify,
};
use platebench_lab::boards::{BoardOutcome, Inventory, RunsBelow};
use platebench_model::printable::printable;
use platebench_model::quoted_path;
use platebench_model::record::{RunOutcome, Verdict};
use platebench_report::{Progress, ProgressKind};
use platebench_rig::RigSpec;
use std::path::{Path, PathBuf};
use std::time::{SystemTime, UNIX_EPOCH};

const NO_PLAN: &str =
    "--plan FILE names the plan; platebench's own is scenarios/plans/acceptance.toml in the folder of its sources";

#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  platebench acceptance run --rig serial:/dev/ttyUSB0@1000000 --time-scale 0.1
  platebench acceptance verify record --key public.pem

A key: openssl genpkey -algorithm ed25519 -out key.pem; openssl pkey -in key.pem -pubout -out public.pem")]
pub(crate) struct AcceptanceArgs {
    #[command(subcommand)]
    action: AcceptanceAction,
}

#[derive(Debug, Subcommand)]
enum AcceptanceAction {
    /// Conduct a lab acceptance session and seal its record
    Run(Box<SessionArgs>),
    /// Verify a record: its files, its signature, and its verdicts from its traces
    #[command(after_help = "\
Examples:
  platebench acceptance verify record --key public.pem

Exit codes: 0 unchanged, 1 changed or not signed, 2 no record, 3 the session is not finished")]
    Verify {
        /// Folder of the record
        record: PathBuf,
        /// Public key that the record must be signed with, in PEM
        #[arg(long, value_name = "FILE")]
        key: Option<PathBuf>,
    },
}

#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  platebench acceptance run --rig serial:/dev/ttyUSB0@1000000 --time-scale 0.1 --operator 'A. Tester' --place 'Lab 2'
  platebench acceptance run --rig emulated --yes --out record --sign key.pem
  platebench acceptance run --rig emulated --yes --resume record --sign key.pem   continues it")]
struct SessionArgs {
    /// Rig of the controller, as for `platebench run`
    #[arg(long, conflicts_with = "board")]
    rig: Option<RigSpec>,
    #[command(flatten)]
    board: BoardArgs,
    /// Plan with requirements, scenarios and questions
    #[arg(long, value_name = "FILE", default_value = "scenarios/plans/acceptance.toml")]
    plan: PathBuf,
    /// Folder of the record; default: a new folder below runs/. Continues an interrupted session in
    /// it
    #[arg(long, value_name = "FOLDER", conflicts_with = "resume")]
    out: Option<PathBuf>,
    /// Continue the session in this folder
    #[arg(long, value_name = "RECORD")]
    resume: Option<PathBuf>,
    /// Clock of the plate, as for `platebench run`
    #[arg(long, value_enum)]
    clock: Option<ClockArg>,
    /// Plate seconds per wall second
    #[arg(long, value_name = "X", default_value_t = 1.0, value_parser = parse_time_scale)]
    time_scale: f64,
    /// Timer of the control instants in real time
    #[arg(long, value_enum, default_value_t = PacingArg::Bench)]
    pacing: PacingArg,
    /// Start although the calibration of this instrument is not valid; the record states it. May be
    /// given again
    #[arg(long, value_name = "INSTRUMENT")]
    waive_calibration: Vec<String>,
    /// Name of the operator
    #[arg(long, value_name = "NAME")]
    operator: Option<String>,
    /// Place
    #[arg(long, value_name = "NAME")]
    place: Option<String>,
    /// Notes
    #[arg(long, value_name = "TEXT")]
    notes: Option<String>,
    /// Ask nothing: confirm every question with yes
    #[arg(long)]
    yes: bool,
    /// Live view in the terminal while a scenario is played; ignored without a terminal
    #[arg(long)]
    live: bool,
    /// Sign the record with this ed25519 key, PKCS #8 in PEM
    #[arg(long, value_name = "KEYFILE")]
    sign: Option<PathBuf>,
}

pub(crate) fn acceptance(arguments: &AcceptanceArgs, quiet: bool) -> CommandResult {
    match &arguments.action {
        AcceptanceAction::Verify { record, key } => verify_record(record, key.as_deref()),
        AcceptanceAction::Run(arguments) => run_session(arguments, quiet),
    }
}

fn run_session(arguments: &SessionArgs, quiet: bool) -> CommandResult {
    let config = session_config(arguments)?;
    let reservation = arguments.board.reserve("acceptance run")?;
    let folder = config.out.clone();
    let earlier = RunsBelow::find(&folder);
    let kind = if quiet { ProgressKind::Quiet } else { ProgressKind::detect() };
    let view = SessionView::new(arguments.live);
    let operator = TerminalOperator::in_session(arguments.yes);
    let mut progress = SessionProgress::new(kind, view.clone());
    let session = move |cancel: &CancelToken, _: &mut EventSender<()>| {
        play_session(&config, &mut SessionHooks { operator: &operator, observer: &mut progress, cancel })
    };
    let (result, signal) = run_until_signal(None, session, |()| {});
    view.close();
    let result = result.map_err(AcceptError::from).flatten();
    let mut end = BoardOutcome::of_runs_below(&folder, &earlier);
    if let Err(AcceptError::Run(RunError::DifferentController { .. })) = &result {
        end.quarantine = result.as_ref().err().map(ToString::to_string);
    }
    let exit = report_end(result, signal, &folder, quiet);
    release(reservation, end)?;
    Ok(exit)
}

fn report_end(result: Result<SessionRecord, AcceptError>, signal: Option<u8>, folder: &Path, quiet: bool) -> Exit {
    match result {
        Ok(record) => {
            let exit = Exit::from(RunOutcome::of(record.verdict, record.lost_a_controller(), true));
            if exit.is_hidden(quiet, OutputFormat::Human) {
                return exit;
            }
            print_session(&record);
            stdio::note(&format!("record: {}", quoted_path(&folder.join(page::FILE))));
            exit.show_verdict(&reason(&record), OutputFormat::Human);
            exit
        }
        Err(error) => {
            let is_resumable = is_resumable(&error);
            let exit = Failure::from(error).report();
            if folder.join(platebench_lab::acceptance::session_record::FILE).exists() && is_resumable {
                stdio::note(&format!("continue with the same command and --resume {}", quoted_path(folder)));
            }
            signal.map_or(exit, Exit::Signal)
        }
    }
}

fn is_resumable(error: &AcceptError) -> bool {
    !matches!(
        error,
        AcceptError::Finished(_)
            | AcceptError::FolderNotEmpty(_)
            | AcceptError::InUse(_)
            | AcceptError::NotSigned
            | AcceptError::InvalidRecord { .. }
            | AcceptError::Changed { .. }
    )
}

fn session_config(arguments: &SessionArgs) -> Result<SessionConfig, Failure> {
    let rig = arguments.board.find_rig()?.or_else(|| arguments.rig.clone());
    let Some(rig) = rig else {
        let known = Inventory::open(arguments.board.selection.boards.as_deref());
        let known = known.map_or_else(|_| String::new(), |inventory| format!(" with one of {}", inventory.names()));
        return Err(Failure::invalid(&format!("--rig is missing, expected --rig RIG or --board NAME{known}")));
    };
    rig.check().or_invalid()?;
    let (time_scale, pacing) = (arguments.time_scale, arguments.pacing);
    let request = ClockRequest { time_scale, pacing, ..ClockRequest::new(&rig, arguments.clock) };
    let clock = request.resolve().or_invalid()?;
    let plan = AcceptancePlan::load(&arguments.plan).map_err(|problems| {
        let exit = Failure::from(problems).report();
        if !arguments.plan.exists() {
            stdio::note(NO_PLAN);
        }
        exit
    })?;
    let scenarios: Vec<_> = plan.scenarios.iter().map(|planned| planned.scenario.clone()).collect();
    check_line_speed(&rig, clock, &scenarios).or_invalid()?;
    let key = arguments.sign.as_deref().map(SecretKey::read).transpose().or_invalid()?;
    let is_serial =
        matches!(clock, platebench_engine::Clock::RealTime(_)) || !arguments.board.allows_parallel_links(&rig);
    let jobs = if is_serial { 1 } else { job_count(None) };
    let out = arguments.resume.clone().or_else(|| arguments.out.clone());
    Ok(SessionConfig {
        plan,
        rig,
        clock,
        jobs,
        out: out.unwrap_or_else(new_folder),
        resume: arguments.resume.is_some(),
        details: SessionDetails {
            operator: arguments.operator.clone(),
            place: arguments.place.clone(),
            notes: arguments.notes.clone(),
        },
        signing_key: key,
        waived_calibrations: arguments.waive_calibration.clone(),
    })
}

fn new_folder() -> PathBuf {
    let seconds = SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |since| since.as_secs());
    Path::new("runs").join(format!("acceptance-{seconds}-{}", std::process::id()))
}

/// Reason of the verdict: what the requirements that are not met lack.
fn reason(record: &SessionRecord) -> String {
    let lost = record.lost_a_controller().then(|| "the controller was lost".to_owned());
    let open = record.requirements.iter().filter(|requirement| requirement.verdict != Verdict::Pass);
    let requirements = open.map(|requirement| {
        let evidence = requirement.evidence.iter().filter(|evidence| evidence.verdict != Verdict::Pass);
        let evidence: Vec<_> = evidence
            .map(|evidence| {
                let found = evidence.found.as_deref().unwrap_or("no value");
                let reason = evidence.reason.as_ref().map_or_else(String::new, |reason| format!(": {reason}"));
                format!("{} is {found}, expected {}{reason}", evidence.metric, evidence.demanded)
            })
            .collect();
        let evidence = if evidence.is_empty() { "no evidence".to_owned() } else { evidence.join(", ") };
        format!("{} ({evidence})", requirement.id)
    });
    // A step may concern no requirement.
    let is_explained = record.requirements.iter().any(|requirement| requirement.verdict == record.verdict);
    let steps = record.steps.iter().filter(|step| !is_explained && step.verdict == Some(record.verdict));
    let steps = steps.map(|step| format!("step {}: {}", step.id, step.reason.as_deref().unwrap_or("it did not pass")));
    let reasons: Vec<String> = lost.into_iter().chain(steps).chain(requirements).collect();
    match record.verdict {
        _ if !reasons.is_empty() => reasons.join("; "),
        Verdict::Pass => "every requirement is met".to_owned(),
        _ => "a step was not done; the record names it".to_owned(),
    }
}

fn print_session(record: &SessionRecord) {
    for requirement in &record.requirements {
        stdio::show(&format!(
            "{:<12}  {:<8} {}\n",
            requirement.verdict,
            printable(&requirement.id),
            printable(&requirement.text)
        ));
    }
    stdio::show(&format!("{}: {}\n", printable(&record.title), record.verdict));
    if let Some(line) = record.no_board_notice() {
        stdio::show(&format!("{line}\n"));
    }
}

impl From<AcceptError> for Failure {
    fn from(error: AcceptError) -> Self {
        match error {
            AcceptError::Plan(problems) => problems.into(),
            AcceptError::Run(error) => error.into(),
            AcceptError::Trust(_)
            | AcceptError::AnsweredNo(_)
            | AcceptError::Unanswered { .. }
            | AcceptError::Cancelled => Self::new(Exit::Inconclusive, &error),
            error => Self::invalid(&error),
        }
    }
}

fn verify_record(record: &Path, key: Option<&Path>) -> CommandResult {
    let key = key.map(PublicKey::read).transpose().or_invalid()?;
    let verified = verify(record, key.as_ref()).or_invalid()?;
    if verified.is_unfinished() {
        let message = format!("{}: the session is not finished, so the record is not sealed", record.display());
        return Err(Failure::new(Exit::Inconclusive, &message));
    }
    for finding in &verified.findings {
        stdio::error(&finding.to_string());
    }
    if !verified.findings.is_empty() {
        let reason = if verified.lacks_only_a_signature() {
            "rejected: the record is not signed"
        } else {
            "rejected: the record was changed after it was sealed"
        };
        Exit::Failed.show_verdict(reason, OutputFormat::Human);
        return Ok(Exit::Failed);
    }
    let signer = match &verified.signer {
        Signer::Unsigned => "not signed: a changed record can be sealed again without trace".to_owned(),
        Signer::RecordKey(fingerprint) => {
            format!(
                "signed with key {fingerprint}, which the record itself names; --key FILE verifies that it is yours"
            )
        }
        Signer::GivenKey => "signed with the given key".to_owned(),
    };
    let verdict = verified.session.as_ref().map_or("nothing", |session| session.verdict.name());
    let seal = verified.manifest_sha256.unwrap_or_default();
    let board = verified.session.as_ref().and_then(SessionRecord::no_board_notice);
    let board = board.map_or_else(String::new, |line| format!("{line}\n"));
    stdio::show(&format!(
        "intact: {} files, judged again with the same verdict: {verdict}\n{board}{signer}\nmanifest {seal}\n",
        verified.files
    ));
    Ok(Exit::Passed)
}

struct SessionProgress {
    kind: ProgressKind,
    progress: Option<Progress>,
    is_self_test: bool,
    live_view: SessionView,
}

impl SessionProgress {
    fn new(kind: ProgressKind, live_view: SessionView) -> Self {
        Self { kind, progress: None, is_self_test: false, live_view }
    }

    fn print(&self, text: &str) {
        if self.kind != ProgressKind::Quiet {
            stdio::note(text);
        }
    }
}

impl SessionObserver for SessionProgress {
    fn step_started(&mut self, step: &StepRecord) {
        // A progress bar would overwrite the question that the prompt shows.
        if step.kind == StepKind::Ask {
            return;
        }
        self.print(&format!("{}  {}", step.id, step.title));
        self.progress = Some(Progress::new(self.kind).with_elapsed_time(&step.title));
        self.is_self_test = step.kind == StepKind::SelfTest;
    }

    fn step_ended(&mut self, step: &StepRecord) {
        self.live_view.close();
        if let Some(mut progress) = self.progress.take() {
            progress.finish();
        }
        let is_answered = step.answer.as_ref().is_none_or(|answer| answer.text.is_some());
        let verdict = step.verdict.map_or(if is_answered { "done" } else { "no answer" }, |verdict| verdict.name());
        let reason = step.reason.as_deref().map_or_else(String::new, |reason| format!(", {reason}"));
        self.print(&format!("{}  {verdict}{reason}", step.id));
    }

    fn live_tap(&mut self, plan: &RunPlan) -> LiveTap {
        if self.is_self_test || !self.live_view.is_wanted() {
            return LiveTap::default();
        }
        // The view takes the screen: the last line of a progress would remain on the terminal.
        if let Some(mut progress) = self.progress.take() {
            progress.finish();
        }
        self.live_view.open(plan).unwrap_or_else(|| {
            self.progress = Some(Progress::new(self.kind));
            LiveTap::default()
        })
    }

    fn run_event(&mut self, event: &Event) {
        self.live_view.send(event);
        let Some(progress) = &mut self.progress else { return };
        match event {
            // The self-test measures the bench, so the scenario's verdict does not count.
            Event::ScenarioFinished { scenario, trials, .. } if self.is_self_test => {
                progress.finish();
                self.progress = Some(Progress::new(self.kind));
                self.print(&format!("  {scenario} measured in {}, not judged", count(*trials, "trial")));
            }
            event => progress.show(event),
        }
    }
}
