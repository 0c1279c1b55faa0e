//! `platebench accept`: a session from a plan, and whether its record is still what it was.

mod desk;

use crate::args::{Clock, Format, Pacing, Run};
use crate::clock::{clock, fast_enough};
use crate::exit::Exit;
use crate::live::Shown;
use crate::output;
use crate::signals::{Ended, until_signal};
use clap::{Args, Subcommand};
use desk::Terminal;
use platebench_acceptance::{
    AcceptError, Order, Plan, PublicKey, SecretKey, SessionRecord, Signer, Who, conduct, page, verify,
};
use platebench_report::ProgressKind;
use platebench_rig::RigSpec;
use platebench_runner::{Cancel, RunError};
use std::num::NonZero;
use std::path::{Path, PathBuf};
use std::time::{SystemTime, UNIX_EPOCH};

/// What to do where there is no plan.
const NO_PLAN: &str = "--plan FILE names the plan; the one that comes with platebench is scenarios/plans/acceptance.toml in the folder of its sources";

/// `platebench accept`
#[derive(Debug, Args)]
#[command(
    args_conflicts_with_subcommands = true,
    after_help = "\
Examples:
  platebench accept --rig serial:/dev/ttyUSB0@1000000 --time-scale 0.1 --operator 'A. Tester' --place 'Lab 2'
  platebench accept --rig emulated --yes --out record --sign key.pem
  platebench accept --rig emulated --resume record       goes on with a session that was cut off
  platebench accept verify record --key public.pem

A key: openssl genpkey -algorithm ed25519 -out key.pem; openssl pkey -in key.pem -pubout -out public.pem"
)]
pub(crate) struct Accept {
    #[command(subcommand)]
    action: Option<Action>,
    #[command(flatten)]
    session: Session,
}

/// What else can be done with a record.
#[derive(Debug, Subcommand)]
enum Action {
    /// Whether a record is still what it was: its files, its signature, and its verdicts against its traces
    #[command(
        after_help = "Exit codes: 0 it is, 1 it is not, 2 there is no record, 3 the session has not come to its end"
    )]
    Verify {
        /// The record's folder
        record: PathBuf,
        /// The public key that the record has to be signed with, in PEM
        #[arg(long, value_name = "FILE")]
        key: Option<PathBuf>,
    },
}

/// A session.
#[derive(Debug, Args)]
struct Session {
    /// What the controller runs on, as for `platebench run`
    #[arg(long, required = true)]
    rig: Option<RigSpec>,
    /// What has to hold, what shows it, what is asked
    #[arg(long, value_name = "FILE", default_value = "scenarios/plans/acceptance.toml")]
    plan: PathBuf,
    /// The record's folder, a new one below runs/ where not given; a session in it that was cut off goes on
    #[arg(long, value_name = "FOLDER", conflicts_with = "resume")]
    out: Option<PathBuf>,
    /// Go on with the session in this folder
    #[arg(long, value_name = "RECORD")]
    resume: Option<PathBuf>,
    /// How time passes for the plate; as for `platebench run`
    #[arg(long, value_enum)]
    clock: Option<Clock>,
    /// Plate seconds per wall second
    #[arg(long, value_name = "X", default_value_t = 1.0, value_parser = crate::args::time_scale)]
    time_scale: f64,
    /// Whose timer makes the control instants in real time
    #[arg(long, value_enum, default_value_t = Pacing::Bench)]
    pacing: Pacing,
    /// Who does it
    #[arg(long, value_name = "NAME")]
    operator: Option<String>,
    /// Where
    #[arg(long, value_name = "NAME")]
    place: Option<String>,
    /// What else there is to say
    #[arg(long, value_name = "TEXT")]
    notes: Option<String>,
    /// Ask nothing: the answer to everything that is to be confirmed is yes
    #[arg(long)]
    yes: bool,
    /// Show in the terminal what passes while a scenario is played; without a terminal nothing is shown
    #[arg(long)]
    live: bool,
    /// Sign the record with this ed25519 key, PKCS #8 in PEM
    #[arg(long, value_name = "KEYFILE")]
    sign: Option<PathBuf>,
}

/// Conducts a session, or looks at its record.
pub(crate) fn accept(arguments: &Accept, quiet: bool) -> Exit {
    match &arguments.action {
        Some(Action::Verify { record, key }) => verified(record, key.as_deref()),
        None => session(&arguments.session, quiet),
    }
}

fn session(arguments: &Session, quiet: bool) -> Exit {
    let order = match order(arguments) {
        Ok(order) => order,
        Err(exit) => return exit,
    };
    let folder = order.out.clone();
    let cancel = Cancel::default();
    let kind = if quiet { ProgressKind::Quiet } else { ProgressKind::detect() };
    let shown = Shown::new(arguments.live);
    let mut desk = Terminal::new(kind, arguments.yes, cancel.clone(), shown.clone());
    let asked_to_end = cancel.clone();
    let ended = until_signal(move || conduct(&order, &mut desk, &asked_to_end), &cancel, None);
    // Also where the session itself is not waited for any more.
    shown.close();
    let (result, signal) = match ended {
        Ok(Ended::Done(result, signal)) => (result, signal),
        Ok(Ended::GivenUp(signal)) => (Err(AcceptError::Cancelled), Some(signal)),
        Err(error) => (Err(AcceptError::Run(RunError::Bench(error.to_string()))), None),
    };
    match result {
        Ok(record) => {
            show(&record);
            output::note(&format!("record: {}", folder.join(page::FILE).display()));
            if record.lost_a_controller() { Exit::Unreachable } else { Exit::of_verdict(record.verdict) }
        }
        Err(error) => {
            explain(&error);
            if folder.join(platebench_acceptance::session::FILE).exists() && can_go_on(&error) {
                output::note(&format!("the same command with --resume {} goes on from here", folder.display()));
            }
            signal.map_or_else(|| exit_of(&error), Exit::Signal)
        }
    }
}

/// False where the same command would come to the same end: what is there is not a session that waits to be gone on with.
fn can_go_on(error: &AcceptError) -> bool {
    !matches!(
        error,
        AcceptError::Finished(_)
            | AcceptError::Taken(_)
            | AcceptError::InUse(_)
            | AcceptError::Content { .. }
            | AcceptError::Changed { .. }
    )
}

/// What the command line means; all that is wrong with it has been shown where something is.
fn order(arguments: &Session) -> Result<Order, Exit> {
    let invalid = |message: &str| {
        output::error(message);
        Exit::Invalid
    };
    let Some(rig) = arguments.rig.clone() else { return Err(invalid("--rig is missing")) };
    rig.check().map_err(|error| invalid(&error.to_string()))?;
    // The rules of clock and line are those of a run.
    let like_a_run = Run {
        scenarios: Vec::new(),
        rig: rig.clone(),
        law: None,
        model: None,
        clock: arguments.clock,
        time_scale: arguments.time_scale,
        pacing: arguments.pacing,
        plate_mode: crate::args::PlateMode::Emulated,
        yes: true,
        wire_time: false,
        out: None,
        runs: PathBuf::new(),
        watch: false,
        trials: None,
        seed: None,
        jobs: None,
        shard: None,
        live: false,
        format: Format::Human,
        told: crate::told::Told::default(),
    };
    let clock = clock(&like_a_run).map_err(invalid)?;
    let plan = Plan::load(&arguments.plan).map_err(|faults| {
        faults.iter().for_each(output::diagnostic);
        if !arguments.plan.exists() {
            output::note(NO_PLAN);
        }
        Exit::Invalid
    })?;
    let scenarios: Vec<_> = plan.scenarios.iter().map(|planned| planned.scenario.clone()).collect();
    fast_enough(&like_a_run, clock, &scenarios).map_err(|error| invalid(&error))?;
    let key =
        arguments.sign.as_deref().map(SecretKey::read).transpose().map_err(|error| invalid(&error.to_string()))?;
    let alone = matches!(clock, platebench_runner::Clock::RealTime(_)) || !rig.is_plural();
    let jobs = if alone { 1 } else { std::thread::available_parallelism().map_or(1, NonZero::get) };
    let out = arguments.resume.clone().or_else(|| arguments.out.clone());
    Ok(Order {
        plan,
        rig,
        clock,
        jobs,
        out: out.unwrap_or_else(new_folder),
        resume: arguments.resume.is_some(),
        who: Who {
            operator: arguments.operator.clone(),
            place: arguments.place.clone(),
            notes: arguments.notes.clone(),
        },
        key,
    })
}

/// A name that two sessions of one bench do not share.
fn new_folder() -> PathBuf {
    let seconds = SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |since| since.as_secs());
    Path::new("runs").join(format!("acceptance-{seconds}-{}", std::process::id()))
}

fn show(record: &SessionRecord) {
    for requirement in &record.requirements {
        output::show(&format!("{:<12}  {:<8} {}\n", requirement.verdict, requirement.id, requirement.text));
    }
    output::show(&format!("{}: {}\n", record.title, record.verdict));
    if let Some(line) = record.without_a_board() {
        output::show(&format!("{line}\n"));
    }
}

fn explain(error: &AcceptError) {
    match error {
        AcceptError::Plan(faults) => faults.iter().for_each(output::diagnostic),
        AcceptError::Run(RunError::Scenario(diagnostic)) => output::diagnostic(diagnostic),
        error => output::error(&error.to_string()),
    }
}

fn exit_of(error: &AcceptError) -> Exit {
    match error {
        AcceptError::Run(error) => Exit::of_error(error),
        AcceptError::Trust(_) | AcceptError::Stopped(_) | AcceptError::Unanswered { .. } | AcceptError::Cancelled => {
            Exit::Inconclusive
        }
        _ => Exit::Invalid,
    }
}

fn verified(record: &Path, key: Option<&Path>) -> Exit {
    let found = key.map(PublicKey::read).transpose().and_then(|key| verify(record, key.as_ref()));
    let found = match found {
        Ok(found) => found,
        Err(error) => {
            output::error(&error.to_string());
            return Exit::Invalid;
        }
    };
    if found.is_unfinished() {
        output::error(&format!("{}: the session has not come to its end, nothing is sealed yet", record.display()));
        return Exit::Inconclusive;
    }
    for finding in &found.findings {
        output::error(&finding.to_string());
    }
    if !found.findings.is_empty() {
        output::show("refused: this is not the record that was sealed\n");
        return Exit::Failed;
    }
    let signer = match &found.signer {
        Signer::Nobody => "not signed: whoever changes a file can seal it again".to_owned(),
        Signer::Unknown(fingerprint) => {
            format!("signed with key {fingerprint}, which the record itself names: --key FILE says whether it is yours")
        }
        Signer::Known => "signed with the given key".to_owned(),
    };
    let says = found.session.as_ref().map_or("nothing", |session| session.verdict.name());
    let seal = found.manifest_sha256.unwrap_or_default();
    let board = found.session.as_ref().and_then(SessionRecord::without_a_board);
    let board = board.map_or_else(String::new, |line| format!("{line}\n"));
    output::show(&format!(
        "intact: {} files, judged again with the same verdict: {says}\n{board}{signer}\nmanifest {seal}\n",
        found.files
    ));
    Exit::Passed
}
