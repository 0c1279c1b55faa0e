//! Plays scenarios into a new run folder and writes the reports.

use super::arguments::RunArgs;
use crate::board_args::release;
use crate::clock::check_line_speed;
use crate::exit::Exit;
use crate::failure::{CommandResult, Failure, OrInvalid};
use crate::options::{BASELINES, OutputFormat, job_count};
use crate::outputs::{self, ScenarioLocations};
use crate::prompt::TerminalOperator;
use crate::run_plan::{EventSinks, run_plan};
use crate::{live, stdio};
use platebench_engine::{Clock, RunError, RunPlan, rejudge};
use platebench_lab::boards::BoardOutcome;
use platebench_model::record::{RunFolder, RunRecord, Verdict};
use platebench_model::scenario::{Diagnostic, Scenario};
use platebench_report::events::EventWriter;
use platebench_report::format::count;
use platebench_report::page::RowCache;
use platebench_report::{Detail, Progress, ProgressKind, junit, page, traceability};
use platebench_rig::{Capability, ConnectOptions, DebugPort};
use std::path::Path;
use tracing::info;

/// Returns the clock. Fails if the options contradict each other.
pub(super) fn check_options(arguments: &RunArgs) -> Result<Clock, Failure> {
    let clock = arguments.clock().resolve().or_invalid()?;
    arguments.rig.check().or_invalid()?;
    if arguments.gdb.is_some()
        && (!arguments.rig.has(Capability::EmulatedChip) || !matches!(clock, Clock::Lockstep { .. }))
    {
        return Err(Failure::invalid(&"--gdb: expected --rig emulated[:ELF] and --clock lockstep"));
    }
    arguments.outputs.check(arguments.format).or_invalid()?;
    Ok(clock)
}

pub(super) struct Selection {
    pub(super) scenarios: Vec<Scenario>,
    /// SHA-256 of all selected scenarios if `scenarios` is a shard of them.
    pub(super) digest: Option<String>,
}

pub(super) fn select_scenarios(
    mut scenarios: Vec<Scenario>,
    arguments: &RunArgs,
) -> Result<Selection, Box<Diagnostic>> {
    arguments.tags.retain(&mut scenarios);
    let digest = arguments.shard.map(|_| arguments.tags.selection_digest(&scenarios));
    let overrides = arguments.overrides(None);
    rejudge::check_overrides(&overrides, &scenarios)?;
    for scenario in &mut scenarios {
        rejudge::apply_overrides(&overrides, scenario);
    }
    let mut index = 0..;
    scenarios.retain(|_| arguments.shard.zip(index.next()).is_none_or(|(shard, index)| shard.contains(index)));
    Ok(Selection { scenarios, digest })
}

/// Calls `play` and returns its exit code. With `--format json`, `play` gets the event stream, and
/// the last event follows afterwards.
pub(super) fn play_with_events(
    arguments: &RunArgs,
    play: impl FnOnce(&mut Option<EventWriter>) -> Result<(Exit, RunRecord), Failure>,
) -> Exit {
    let mut events = (arguments.format == OutputFormat::Json).then(|| EventWriter::new(stdio::CheckedStdout));
    let (exit, record) = match play(&mut events) {
        Ok((exit, record)) => (exit, Some(record)),
        Err(failure) => (failure.report(), None),
    };
    if let Some(events) = &mut events {
        let error = record.is_none().then(|| outputs::exit_reason(exit));
        events.run_finished(record.as_ref(), error, exit.code());
    }
    exit
}

/// Returns the record of the run. Fails if the run ends without a record.
pub(super) fn play(
    arguments: &RunArgs,
    clock: Clock,
    selection: Selection,
    detail: Detail,
    events: &mut Option<EventWriter>,
) -> Result<(Exit, RunRecord), Failure> {
    let Selection { scenarios, digest } = selection;
    check_line_speed(&arguments.rig, clock, &scenarios).or_invalid()?;
    let debug_port = arguments.gdb.map(DebugPort::bind).transpose().or_invalid()?;
    if let Some(port) = &debug_port {
        stdio::note(&format!("the chip waits for a debugger; connect GDB with `target remote :{}`", port.number()));
    }
    let connect_options =
        ConnectOptions { reply_timeout: arguments.reply_timeout, debug_port, ..ConnectOptions::default() };
    let folder = match &arguments.out {
        Some(folder) => RunFolder::create(Some(folder)),
        None => RunFolder::create_below(&arguments.runs),
    };
    let folder = folder.or_invalid()?;
    let reservation = arguments.board.reserve("run").inspect_err(|_| {
        folder.remove_if_empty();
    })?;
    let is_real = clock == Clock::RealPlate;
    // A line or a board plays one trial at a time. In real time, parallel trials delay each other,
    // so only `--jobs` allows them.
    let jobs = match arguments.jobs {
        _ if !arguments.board.allows_parallel_links(&arguments.rig) || is_real || arguments.gdb.is_some() => 1,
        None if !matches!(clock, Clock::Lockstep { .. }) => 1,
        jobs => job_count(jobs),
    };
    let plan = RunPlan::new(&arguments.rig, clock, jobs, scenarios, arguments.overrides(digest));
    info!(folder = %folder.path().display(), scenarios = plan.scenarios.len(), jobs = plan.jobs, "run starts");
    if arguments.live && is_real {
        stdio::note("no live view with --plate-mode real, because the prompts use the terminal");
    }
    let opened = (arguments.live && !is_real).then(|| live::open_view(live::describe_run("run", live::KEYS, &plan)));
    let (view, live_tap) = opened.unwrap_or_default();
    if let Some(view) = &view {
        view.quit_on_q();
    }
    let locations = ScenarioLocations::new(&plan.scenarios);
    if let Some(events) = events {
        let trials = |scenario: &Scenario| (scenario.file.clone(), scenario.trials.count);
        let scenarios: Vec<_> = plan.scenarios.iter().map(trials).collect();
        events.run_started(&folder.path().display().to_string(), &plan.rig, plan.clock.kind().name(), &scenarios);
    }
    let operator = TerminalOperator::at_plate(is_real && !arguments.yes);
    let progress = match ProgressKind::detect() {
        _ if detail == Detail::Failures || view.is_some() => ProgressKind::Quiet,
        // With a real plate, prompts and a progress bar would overwrite each other.
        _ if is_real => ProgressKind::Lines,
        ProgressKind::Lines => ProgressKind::Quiet,
        kind => kind,
    };
    let planned_trials = plan.scenarios.iter().map(|scenario| u64::from(scenario.trials.count)).sum();
    let progress = Progress::new(progress).with_planned_trials(planned_trials);
    let mut rows = RowCache::default();
    let sinks = EventSinks { progress, view: view.as_ref(), events: events.as_mut(), rows: Some(&mut rows) };
    let played = run_plan(plan, &folder, arguments.rig.clone(), operator, live_tap, sinks, connect_options);
    drop(view);
    let end = BoardOutcome::of_run(played.as_ref().map_err(|(error, _)| error), folder.path());
    let released = release(reservation, end);
    match played {
        Ok(record) => {
            released?;
            let skipped = record.not_applicable.len();
            if arguments.format == OutputFormat::Json && skipped > 0 {
                let (scenarios, is) = (count(skipped, "scenario"), if skipped == 1 { "is" } else { "are" });
                stdio::note(&format!("{scenarios} {is} not applicable to this controller"));
            }
            Ok((write_reports(&record, rows, &folder, arguments, &locations, detail)?, record))
        }
        Err((error, signal)) => {
            if let Err(failure) = released {
                failure.report();
            }
            let exit = report_run_error(error, &folder);
            Err(signal.map_or(exit, Exit::Signal).into())
        }
    }
}

fn write_reports(
    record: &RunRecord,
    rows: RowCache,
    folder: &RunFolder,
    arguments: &RunArgs,
    locations: &ScenarioLocations,
    detail: Detail,
) -> CommandResult {
    let page = folder.path().join(page::FILE);
    let written = junit::write(record, &folder.path().join(junit::FILE))
        .and_then(|()| {
            page::ReportPage::new(record, folder.path())
                .with_baselines(Path::new(BASELINES))
                .with_earlier_runs()
                .with_rows(rows)
                .write(&page)
        })
        .and_then(|()| traceability::write(record, folder.path()))
        .and_then(|()| arguments.outputs.write(record, locations));
    if arguments.format == OutputFormat::Human {
        if arguments.outputs.replaces_table() {
            stdio::record_to_stderr(record, detail);
        } else {
            stdio::record(record, arguments.format, detail);
        }
    }
    if detail != Detail::Failures || record.verdict != Verdict::Pass {
        stdio::note(&format!("run folder: {}", folder.path().display()));
        stdio::note(&format!("report: {}", page.display()));
    }
    stdio::warn_if_not_safe(record);
    written.or_invalid()?;
    Ok(Exit::of_record(record))
}

fn report_run_error(error: RunError, folder: &RunFolder) -> Exit {
    let exit = Failure::from(error).report();
    if folder.remove_if_empty() {
        return exit;
    }
    stdio::note(&format!("run folder: {}", folder.path().display()));
    if let Ok(record) = RunRecord::read(folder.path()) {
        stdio::note(&format!("`platebench report {}` shows the complete trials", folder.path().display()));
        stdio::warn_if_not_safe(&record);
    }
    exit
}
