//! `platebench soak`: plays scenarios in rotation on a board for hours.

use crate::board_args::{BoardArgs, release};
use crate::clock::{ClockRequest, check_line_speed};
use crate::exit::Exit;
use crate::options::{ClockArg, PacingArg, PlateModeArg, SCENARIOS, law_names, parse_number};
use crate::selection::{TagFilter, find_scenarios};
use crate::shutdown::{EventSender, WorkResult, run_until_signal};
use crate::stdio;
use clap::Args;
use platebench_boards::{RunEnd, SoakConfig, SoakEnd, SoakRecord, SoakResult, soak as play};
use platebench_record::Overrides;
use platebench_report::page::{self, BlockPage, PageBlock};
use platebench_rig::ConnectOptions;
use platebench_runner::{CancelToken, RunError, RunPlan, rejudge};
use std::path::{Path, PathBuf};
use std::time::Duration;

#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  platebench soak --board left --hours 8
  platebench soak scenarios/paper --board left --hours 60 --fail-fast --out runs/weekend
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

pub(crate) fn soak(arguments: &SoakArgs) -> Exit {
    play_on_board(arguments).unwrap_or_else(|exit| exit)
}

fn play_on_board(arguments: &SoakArgs) -> Result<Exit, Exit> {
    let board = arguments.board.selection.find()?.ok_or_else(|| stdio::reject(&"--board NAME is missing"))?;
    board.rig.check().map_err(|error| stdio::reject(&error))?;
    let request = ClockRequest {
        rig: &board.rig,
        clock: arguments.clock,
        time_scale: 1.0,
        pacing: PacingArg::Bench,
        plate_mode: PlateModeArg::Emulated,
        wire_time: false,
    };
    let clock = request.resolve().map_err(|fault| stdio::reject(&fault))?;
    let mut scenarios = find_scenarios(&arguments.scenarios, &TagFilter::default(), |_| true)?;
    let (law, name) = (arguments.law.clone(), Some(board.name.clone()));
    let overrides = Overrides { law, board: name, ..Overrides::default() };
    for scenario in &mut scenarios {
        rejudge::apply_overrides(&overrides, scenario);
    }
    check_line_speed(&board.rig, clock, &scenarios).map_err(|fault| stdio::reject(&fault))?;
    let plan = RunPlan {
        scenarios,
        jobs: 1,
        clock,
        own_clock: board.rig.has_own_clock(),
        rig: board.rig.to_string(),
        overrides,
    };
    let (duration, fail_fast) = (arguments.hours, arguments.fail_fast);
    let config = SoakConfig { plan, board: board.name.clone(), duration, fail_fast };
    let reservation = arguments.board.reserve("soak")?;
    let cancel = CancelToken::default();
    let options = ConnectOptions { cancel: cancel.clone(), ..ConnectOptions::default() };
    let (out, rig, soak_cancel) = (arguments.out.clone(), board.rig.clone(), cancel.clone());
    let work = move |_: &mut EventSender<_, ()>| {
        play(&config, &out, &|| config.plan.clock.connect(&rig, &options), &soak_cancel)
    };
    let (result, signal) = match run_until_signal(&cancel, None, work, |()| {}) {
        Ok(WorkResult::Finished(result, signal)) => (result, signal),
        Ok(WorkResult::Abandoned(signal)) => {
            return Ok(release(reservation, RunEnd::unconfirmed(), Exit::Signal(signal)));
        }
        Err(error) => (Err(RunError::Internal(error.to_string())), None),
    };
    let (end, exit) = match result {
        Ok(SoakResult { record, board, error }) => {
            stdio::show(&format!("{}\n", record.table().lines().join("\n")));
            let written = write_page(&record, &arguments.out);
            let exit = error.as_ref().map_or_else(
                || exit_of(&record),
                |error| {
                    stdio::error(&error.to_string());
                    Exit::of_error(error)
                },
            );
            (board, if written == Exit::Passed { exit } else { written })
        }
        Err(error) => {
            stdio::error(&error.to_string());
            (
                RunEnd::of_runs_below(&arguments.out, reservation.as_ref().map_or("", |board| board.started())),
                Exit::of_error(&error),
            )
        }
    };
    Ok(release(reservation, end, signal.map_or(exit, Exit::Signal)))
}

fn exit_of(record: &SoakRecord) -> Exit {
    if record.end == Some(SoakEnd::Lost) { Exit::Unreachable } else { Exit::of_verdict(record.verdict) }
}

/// Also of a soak that still runs.
pub(crate) fn write_page(record: &SoakRecord, folder: &Path) -> Exit {
    let path = folder.join(page::FILE);
    let state = record.end.map_or("not ended", |end| match end {
        SoakEnd::Time => "ended after its time",
        SoakEnd::Cancelled => "cancelled",
        SoakEnd::Failed => "ended at the first failure",
        SoakEnd::Lost => "ended because the board was lost",
    });
    let intro = format!(
        "{} runs on {}, {}, from {} to {}: {state}. 0 V {} after each run.",
        record.runs,
        record.board,
        record.verdict,
        record.started,
        record.updated,
        if record.safe_confirmed { "was confirmed" } else { "was not confirmed" },
    );
    let kept = record.kept.iter().chain(&record.newest).map(|run| PageBlock::File(format!("{run}/run.json")));
    let blocks = std::iter::once(PageBlock::Table(record.table())).chain(kept).collect();
    match (BlockPage { title: format!("Soak of {}", record.board), intro, blocks }).write(&path) {
        Ok(()) => {
            stdio::note(&format!("report: {}", path.display()));
            Exit::Passed
        }
        Err(error) => stdio::reject(&error),
    }
}
