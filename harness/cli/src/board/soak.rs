//! `platebench board soak`: plays scenarios in rotation on a board for hours.

use crate::board_args::{BoardArgs, release};
use crate::clock::{ClockRequest, check_line_speed};
use crate::exit::Exit;
use crate::failure::{CommandResult, Failure, OrInvalid};
use crate::options::{ClockArg, OutputFormat, SCENARIOS, law_names, parse_number};
use crate::selection::{TagFilter, find_scenarios};
use crate::shutdown::{EventSender, WorkResult, run_until_signal};
use crate::stdio;
use clap::Args;
use platebench_engine::{CancelToken, RunError, RunPlan, rejudge};
use platebench_lab::boards::{BoardOutcome, SoakConfig, SoakEnd, SoakRecord, SoakResult, SoakScenario, soak as play};
use platebench_model::record::Overrides;
use platebench_report::Detail;
use platebench_report::document::{Block, Document};
use platebench_report::page;
use platebench_rig::ConnectOptions;
use std::path::{Path, PathBuf};
use std::time::Duration;

#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  platebench board soak --board left --hours 8
  platebench board soak scenarios/paper --board left --hours 60 --fail-fast --out runs/weekend
  platebench report runs/weekend          at any time, also while it runs

Exit codes: as for run")]
pub(crate) struct SoakArgs {
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

pub(crate) fn soak(arguments: &SoakArgs, detail: Detail) -> CommandResult {
    let board = arguments.board.selection.find()?.ok_or("--board NAME is missing").or_invalid()?;
    board.rig.check().or_invalid()?;
    let clock = ClockRequest::new(&board.rig, arguments.clock).resolve().or_invalid()?;
    let mut scenarios = find_scenarios(&arguments.scenarios, &TagFilter::default(), |_| true, detail)?;
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
    let work = move |cancel: &CancelToken, _: &mut EventSender<()>| {
        let options = ConnectOptions { cancel: cancel.clone(), ..ConnectOptions::default() };
        play(&config, &out, &|| config.plan.clock.connect(&rig, &options), cancel)
    };
    let (result, signal) = match run_until_signal(None, work, |()| {}) {
        Ok(WorkResult::Finished(result, signal)) => (result, signal),
        Ok(WorkResult::Abandoned(signal)) => {
            release(reservation, BoardOutcome::unconfirmed())?;
            return Ok(Exit::Signal(signal));
        }
        Err(error) => (Err(RunError::Internal(error.to_string())), None),
    };
    let (end, exit) = match result {
        Ok(SoakResult { record, board, error }) => {
            stdio::show(&format!("{}\n", record.table().lines().join("\n")));
            let written = write_page(&record, &arguments.out).err().map(Failure::report);
            let exit = error.map_or_else(|| exit_of(&record), |error| Failure::from(error).report());
            stdio::verdict(exit, &reason(&record), OutputFormat::Human);
            (board, written.unwrap_or(exit))
        }
        Err(error) => {
            let started = reservation.as_ref().map_or("", |board| board.started());
            (BoardOutcome::of_runs_below(&arguments.out, started), Failure::from(error).report())
        }
    };
    release(reservation, end)?;
    Ok(signal.map_or(exit, Exit::Signal))
}

fn exit_of(record: &SoakRecord) -> Exit {
    if record.end == Some(SoakEnd::Lost) { Exit::Unreachable } else { Exit::of_verdict(record.verdict) }
}

fn reason(record: &SoakRecord) -> String {
    let count = |of: fn(&SoakScenario) -> u64| record.scenarios.values().map(of).sum::<u64>();
    let end = describe_end(record);
    let [failed, inconclusive, trials] =
        [count(|one| one.failed), count(|one| one.inconclusive), count(|one| one.trials)];
    let safe = if record.safe_confirmed { "" } else { "; 0 V was not confirmed after each run" };
    format!("{failed} failed and {inconclusive} inconclusive of {trials} trials in {} runs; {end}{safe}", record.runs)
}

fn describe_end(record: &SoakRecord) -> &'static str {
    record.end.map_or("not ended", |end| match end {
        SoakEnd::Time => "ended after its time",
        SoakEnd::Cancelled => "cancelled",
        SoakEnd::Failed => "ended at the first failure",
        SoakEnd::Lost => "ended because the board was lost",
    })
}

/// Writes the report. This is also possible while the soak still runs.
pub(crate) fn write_page(record: &SoakRecord, folder: &Path) -> CommandResult {
    let path = folder.join(page::FILE);
    let state = describe_end(record);
    let intro = format!(
        "{} runs on {}, {}, from {} to {}: {state}. 0 V {} after each run.",
        record.runs,
        record.board,
        record.verdict,
        record.started,
        record.updated,
        if record.safe_confirmed { "was confirmed" } else { "was not confirmed" },
    );
    let kept = record.kept.iter().chain(&record.newest).map(|run| Block::File(format!("{run}/run.json")));
    let blocks = std::iter::once(Block::Table(record.table())).chain(kept).collect();
    Document { title: format!("Soak of {}", record.board), lead: intro, blocks }.write(&path).or_invalid()?;
    stdio::note(&format!("report: {}", path.display()));
    Ok(Exit::Passed)
}
