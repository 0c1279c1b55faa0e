//! `platebench board`: lists the boards of the inventory, ends a quarantine, or runs a soak. Defines
//! the options that name a board, and reserves it for a command.

use crate::exit::{CommandResult, Exit, Failure, OrInvalid};
use crate::options::{
    ClockArg, ClockRequest, OutputFormat, SCENARIOS, check_line_speed, law_names, parse_number, parse_seconds,
};
use crate::selection::{ScenarioFilter, find_scenarios};
use crate::shutdown::{EventSender, received_signal, run_until_signal};
use crate::{shutdown, stdio};
use clap::{Args, Subcommand};
use platebench_engine::{CancelToken, RunError, RunPlan, rejudge};
use platebench_lab::boards::{
    Board, BoardError, BoardOutcome, Inventory, Reservation, RunsBelow, SoakConfig, SoakEnd, SoakRecord, SoakResult,
    SoakScenario, clear, document, list, soak,
};
use platebench_model::quoted_path;
use platebench_model::record::{Overrides, RunOutcome};
use platebench_report::{Detail, page};
use platebench_rig::{ConnectOptions, RigSpec};
use std::path::{Path, PathBuf};
use std::time::Duration;

#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  platebench board list
  platebench board clear left --reason 'amplifier checked, 0 V measured'
  platebench board soak --board left --hours 8")]
pub(crate) struct BoardCommandArgs {
    #[command(subcommand)]
    action: BoardAction,
}

#[derive(Debug, Subcommand)]
enum BoardAction {
    /// List the boards: state, holder, reason of a quarantine, last run
    #[command(after_help = "\
Examples:
  platebench board list                     state, holder, reason of a quarantine, last run
  platebench board list --format json

Exit codes: 0 listed, 2 invalid inventory")]
    List {
        #[command(flatten)]
        inventory: InventoryArgs,
        /// Format of standard output
        #[arg(long, value_enum, default_value_t = OutputFormat::Human)]
        format: OutputFormat,
    },
    /// End the quarantine of a board that a person has checked
    #[command(after_help = "\
Examples:
  platebench board clear left --reason 'amplifier checked, 0 V measured'

Exit codes: 0 cleared, 2 unknown board or not in quarantine, 5 the board is held")]
    Clear {
        /// Name of the board
        name: String,
        /// What was checked; stored with the time and the user
        #[arg(long, value_name = "TEXT")]
        reason: String,
        #[command(flatten)]
        inventory: InventoryArgs,
    },
    /// Play scenarios in rotation on a board for hours
    Soak(SoakArgs),
}

#[derive(Debug, Args)]
struct InventoryArgs {
    /// Board inventory; default: the nearest boards.toml, from the working directory upwards
    #[arg(long, value_name = "FILE")]
    boards: Option<PathBuf>,
}

impl InventoryArgs {
    fn open(&self) -> Result<Inventory, BoardError> {
        Inventory::open(self.boards.as_deref())
    }
}

pub(crate) fn board(arguments: &BoardCommandArgs, detail: Detail) -> CommandResult {
    match &arguments.action {
        BoardAction::List { inventory, format } => {
            let boards = list(&inventory.open()?)?;
            stdio::show_result(*format, &boards, &document(&boards));
        }
        BoardAction::Clear { name, reason, inventory } => {
            clear(&inventory.open()?, name, reason)?;
            stdio::note(&format!("board {name} is free"));
        }
        BoardAction::Soak(arguments) => return run_soak(arguments, detail),
    }
    Ok(Exit::Passed)
}

#[derive(Debug, Clone, Default, Args)]
#[command(next_help_heading = "Board")]
pub(crate) struct BoardSelection {
    /// Board of boards.toml, instead of a rig
    #[arg(long, hide_short_help = true, value_name = "NAME")]
    pub(crate) board: Option<String>,
    /// Board inventory; default: the nearest boards.toml, from the working directory upwards
    #[arg(long, hide_short_help = true, value_name = "FILE")]
    pub(crate) boards: Option<PathBuf>,
}

#[derive(Debug, Clone, Default, Args)]
#[command(next_help_heading = "Board")]
pub(crate) struct BoardArgs {
    #[command(flatten)]
    pub(crate) selection: BoardSelection,
    /// Time to wait for a board that another process holds, s
    #[arg(long, hide_short_help = true, value_name = "SECONDS", default_value = "0", value_parser = parse_seconds)]
    pub(crate) wait: Duration,
}

impl BoardSelection {
    pub(crate) fn find(&self) -> Result<Option<Board>, Failure> {
        let Some(name) = &self.board else { return Ok(None) };
        Ok(Some(Inventory::open(self.boards.as_deref())?.board(name)?.clone()))
    }
}

impl BoardArgs {
    pub(crate) fn find_rig(&self) -> Result<Option<RigSpec>, Failure> {
        self.selection.find().map(|board| board.map(|board| board.rig))
    }

    /// `--board` forbids parallel links, because a board plays one trial at a time.
    pub(crate) fn allows_parallel_links(&self, rig: &RigSpec) -> bool {
        self.selection.board.is_none() && rig.allows_parallel_links()
    }

    /// Reserves the board of `--board`. Signals then no longer end the process by themselves.
    pub(crate) fn reserve(&self, command: &str) -> Result<Option<Reservation>, Failure> {
        let Some(name) = &self.selection.board else { return Ok(None) };
        shutdown::listen().or_invalid()?;
        let is_cancelled = || received_signal().is_some();
        let mut on_wait = |held: &BoardError| stdio::note(&format!("waiting: {held}"));
        let inventory = Inventory::open(self.selection.boards.as_deref())?;
        Ok(Some(Reservation::new(&inventory, name, command, self.wait, &is_cancelled, &mut on_wait)?))
    }
}

/// Fails if the state of the board cannot be written. The board then stays marked as in use.
pub(crate) fn release(reservation: Option<Reservation>, end: BoardOutcome) -> Result<(), Failure> {
    let Some(reservation) = reservation else { return Ok(()) };
    if let Some(reason) = &end.quarantine {
        stdio::error(&format!("board {} is in quarantine: {reason}", reservation.board().name));
    }
    Ok(reservation.finish(end)?)
}

impl From<BoardError> for Failure {
    fn from(error: BoardError) -> Self {
        let exit = match &error {
            BoardError::Cancelled(_) => received_signal().map_or(Exit::Unreachable, Exit::Signal),
            error if error.is_invalid_input() => Exit::Invalid,
            _ => Exit::Unreachable,
        };
        match error {
            BoardError::Inventory(problems) => problems.into(),
            error => Self::new(exit, &error),
        }
    }
}

#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  platebench board soak --board left --hours 8
  platebench board soak scenarios/paper --board left --hours 60 --fail-fast --out runs/weekend
  platebench report runs/weekend          at any time, also while it runs

Exit codes: as for run")]
struct SoakArgs {
    /// Scenario files, or folders with everything below them
    #[arg(value_name = "SCENARIO|FOLDER", default_value = SCENARIOS)]
    scenarios: Vec<PathBuf>,
    #[command(flatten)]
    board: BoardArgs,
    /// No further scenario starts after this time, h
    #[arg(long, value_name = "H", value_parser = parse_hours)]
    hours: Duration,
    /// Folder of the soak
    #[arg(long, value_name = "FOLDER", default_value = "runs/soak")]
    out: PathBuf,
    /// End at the first failure
    #[arg(long)]
    fail_fast: bool,
    /// Control law of the firmware under test
    #[arg(long, value_name = "NAME", value_parser = law_names())]
    law: Option<String>,
    /// Clock of the plate, as for `platebench run`
    #[arg(long, value_enum)]
    clock: Option<ClockArg>,
}

fn parse_hours(text: &str) -> Result<Duration, String> {
    let hours = parse_number(text, |hours| hours > 0.0 && hours <= 1e5, "hours above 0, at most 1e5")?;
    Ok(Duration::from_secs_f64(hours * 3_600.0))
}

fn run_soak(arguments: &SoakArgs, detail: Detail) -> CommandResult {
    let Some(board) = arguments.board.selection.find()? else {
        let known = Inventory::open(arguments.board.selection.boards.as_deref())?.names();
        return Err(Failure::invalid(&format!("--board is missing, expected --board NAME with one of {known}")));
    };
    board.rig.check().or_invalid()?;
    let clock = ClockRequest::new(&board.rig, arguments.clock).resolve().or_invalid()?;
    let mut scenarios = find_scenarios(&arguments.scenarios, &ScenarioFilter::default(), |_| true, detail)?;
    let (law, name) = (arguments.law.clone(), Some(board.name.clone()));
    let overrides = Overrides { law, board: name, ..Overrides::default() };
    for scenario in &mut scenarios {
        rejudge::apply_overrides(&overrides, scenario);
    }
    check_line_speed(&board.rig, clock, &scenarios).or_invalid()?;
    let plan = RunPlan::new(&board.rig, clock, 1, scenarios, overrides);
    let (duration, fail_fast) = (arguments.hours, arguments.fail_fast);
    let config = SoakConfig { plan, board: board.name.clone(), duration, fail_fast };
    let reservation = arguments.board.reserve("board soak")?;
    let (out, rig) = (arguments.out.clone(), board.rig.clone());
    let earlier = RunsBelow::find(&out);
    let work = move |cancel: &CancelToken, _: &mut EventSender<()>| {
        let options = ConnectOptions { cancel: cancel.clone(), ..ConnectOptions::default() };
        soak(&config, &out, &|| config.plan.clock.connect(&rig, &options), cancel)
    };
    let (result, signal) = run_until_signal(None, work, |()| {});
    if let (Err(RunError::Cancelled), Some(signal)) = (&result, signal) {
        release(reservation, BoardOutcome::unconfirmed())?;
        return Ok(Exit::Signal(signal));
    }
    let (end, exit) = match result.flatten() {
        Ok(SoakResult { record, board, error }) => {
            stdio::document(&record.document());
            let written = write_soak_page(&record, &arguments.out).err().map(Failure::report);
            let exit = error.map_or_else(|| exit_of(&record), |error| Failure::from(error).report());
            exit.show_verdict(&soak_reason(&record), OutputFormat::Human);
            (board, written.unwrap_or(exit))
        }
        Err(error) => (BoardOutcome::of_runs_below(&arguments.out, &earlier), Failure::from(error).report()),
    };
    release(reservation, end)?;
    Ok(signal.map_or(exit, Exit::Signal))
}

fn exit_of(record: &SoakRecord) -> Exit {
    let (lost, safe) = (record.end == Some(SoakEnd::Lost), record.end != Some(SoakEnd::Unsafe));
    RunOutcome::of(record.verdict, lost, safe).into()
}

fn soak_reason(record: &SoakRecord) -> String {
    let count = |of: fn(&SoakScenario) -> u64| record.scenarios.values().map(of).sum::<u64>();
    let end = record.describe_end();
    let [failed, inconclusive, trials] =
        [count(|one| one.failed), count(|one| one.inconclusive), count(|one| one.trials)];
    let is_stated = record.safe_confirmed || record.end == Some(SoakEnd::Unsafe);
    let safe = if is_stated { "" } else { "; 0 V was not confirmed after each run" };
    let first = record.reason.as_ref().map_or_else(String::new, |reason| format!("; {reason}"));
    format!(
        "{failed} failed and {inconclusive} inconclusive of {trials} trials in {} runs; {end}{safe}{first}",
        record.runs
    )
}

/// Writes the report. This is also possible while the soak still runs.
pub(crate) fn write_soak_page(record: &SoakRecord, folder: &Path) -> CommandResult {
    let path = folder.join(page::FILE);
    record.document().write(&path).or_invalid()?;
    stdio::note(&format!("report: {}", quoted_path(&path)));
    Ok(Exit::Passed)
}
