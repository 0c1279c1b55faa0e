//! Plays scenarios into a new run folder and writes the reports.

use super::arguments::RunArgs;
use crate::board_args::release;
use crate::clock::check_line_speed;
use crate::exit::Exit;
use crate::options::{BASELINES, OutputFormat, job_count};
use crate::outputs::{self, ScenarioLocations};
use crate::prompt::TerminalOperator;
use crate::run_plan::{EventSinks, run_plan};
use crate::{live, stdio};
use platebench_boards::RunEnd;
use platebench_record::{RunFolder, RunRecord, Verdict};
use platebench_report::events::EventWriter;
use platebench_report::page::KeptRows;
use platebench_report::{Detail, Progress, ProgressKind, junit, page, traceability};
use platebench_rig::{ConnectOptions, DebugPort, RigSpec};
use platebench_runner::{Clock, RunError, RunPlan, rejudge};
use platebench_scenario::{Diagnostic, Scenario};
use std::path::Path;
use tracing::info;

/// Before anything is played. Reports a contradiction.
pub(super) fn check_options(arguments: &RunArgs) -> Result<Clock, Exit> {
    let clock = arguments.clock().resolve().map_err(|fault| stdio::reject(&fault))?;
    arguments.rig.check().map_err(|fault| stdio::reject(&fault))?;
    if arguments.gdb.is_some()
        && (!matches!(arguments.rig, RigSpec::Emulated(_)) || !matches!(clock, Clock::Lockstep { .. }))
    {
        return Err(stdio::reject(&"--gdb: expected --rig emulated[:ELF] and --clock lockstep"));
    }
    arguments.outputs.check(arguments.format).map_err(|fault| stdio::reject(&fault))?;
    Ok(clock)
}

pub(super) fn prepare_scenarios(
    mut scenarios: Vec<Scenario>,
    arguments: &RunArgs,
) -> Result<Vec<Scenario>, Box<Diagnostic>> {
    arguments.tags.retain(&mut scenarios);
    let overrides = arguments.overrides();
    rejudge::check_overrides(&overrides, &scenarios)?;
    for scenario in &mut scenarios {
        rejudge::apply_overrides(&overrides, scenario);
    }
    let mut index = 0..;
    scenarios.retain(|_| arguments.shard.zip(index.next()).is_none_or(|(shard, index)| shard.contains(index)));
    Ok(scenarios)
}

/// Writes the JSON event stream of `--format json`, and ends it.
pub(super) fn with_events(
    arguments: &RunArgs,
    play: impl FnOnce(&mut Option<EventWriter>) -> Result<(Exit, RunRecord), Exit>,
) -> Exit {
    let mut events = (arguments.format == OutputFormat::Json).then(|| EventWriter::new(stdio::CheckedStdout));
    let (exit, record) = match play(&mut events) {
        Ok((exit, record)) => (exit, Some(record)),
        Err(exit) => (exit, None),
    };
    if let Some(events) = &mut events {
        let error = record.is_none().then(|| outputs::exit_reason(exit));
        events.run_finished(record.as_ref(), error, exit.code());
    }
    exit
}

/// Reports why a run has no record, and returns the exit code.
pub(super) fn play(
    arguments: &RunArgs,
    clock: Clock,
    scenarios: Vec<Scenario>,
    detail: Detail,
    events: &mut Option<EventWriter>,
) -> Result<(Exit, RunRecord), Exit> {
    check_line_speed(&arguments.rig, clock, &scenarios).map_err(|fault| stdio::reject(&fault))?;
    let debug_port = arguments.gdb.map(DebugPort::bind).transpose().map_err(|fault| stdio::reject(&fault))?;
    if let Some(port) = &debug_port {
        stdio::note(&format!("the chip waits for a debugger: target remote :{}", port.number()));
    }
    let connect_options =
        ConnectOptions { reply_timeout: arguments.reply_timeout, debug_port, ..ConnectOptions::default() };
    let folder = match &arguments.out {
        Some(folder) => RunFolder::create(Some(folder)),
        None => RunFolder::create_below(&arguments.runs),
    };
    let folder = folder.map_err(|fault| stdio::reject(&fault))?;
    let reservation = arguments.board.reserve("run").inspect_err(|_| {
        folder.remove_if_empty();
    })?;
    let is_real = clock == Clock::RealPlate;
    // A serial line and a board carry one trial. In real time only --jobs lets work compete with the loop.
    let jobs = match arguments.jobs {
        _ if !arguments.board.allows_parallel_links(&arguments.rig) || is_real || arguments.gdb.is_some() => 1,
        None if !matches!(clock, Clock::Lockstep { .. }) => 1,
        jobs => job_count(jobs),
    };
    let plan = RunPlan {
        scenarios,
        jobs,
        clock,
        own_clock: arguments.rig.has_own_clock(),
        rig: arguments.rig.to_string(),
        overrides: arguments.overrides(),
    };
    info!(folder = %folder.path().display(), scenarios = plan.scenarios.len(), jobs = plan.jobs, "run starts");
    if arguments.live && is_real {
        stdio::note("no live view with --plate-mode real: the prompts use the terminal");
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
        // Prompts and a bar would overwrite each other.
        _ if is_real => ProgressKind::Lines,
        ProgressKind::Lines => ProgressKind::Quiet,
        kind => kind,
    };
    let planned_trials = plan.scenarios.iter().map(|scenario| u64::from(scenario.trials.count)).sum();
    let progress = Progress::new(progress).with_planned_trials(planned_trials);
    let mut rows = KeptRows::default();
    let sinks = EventSinks { progress, view: view.as_ref(), events: events.as_mut(), rows: Some(&mut rows) };
    let played = run_plan(plan, &folder, arguments.rig.clone(), operator, live_tap, sinks, connect_options);
    drop(view);
    let end = RunEnd::of_run(played.as_ref().map_err(|(error, _)| error), folder.path());
    let released = release(reservation, end, Exit::Passed);
    match played {
        Ok(_) if released != Exit::Passed => Err(released),
        Ok(record) => {
            if arguments.format == OutputFormat::Json {
                note_not_applicable(&record);
            }
            Ok((write_reports(&record, rows, &folder, arguments, &locations, detail), record))
        }
        Err((error, signal)) => {
            report_run_error(&error, &folder);
            Err(signal.map_or_else(|| Exit::of_error(&error), Exit::Signal))
        }
    }
}

fn write_reports(
    record: &RunRecord,
    rows: KeptRows,
    folder: &RunFolder,
    arguments: &RunArgs,
    locations: &ScenarioLocations,
    detail: Detail,
) -> Exit {
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
        if arguments.outputs.use_stdout() {
            stdio::record_to_stderr(record, detail);
        } else {
            stdio::record(record, arguments.format, detail);
        }
    }
    if detail != Detail::Failures || record.verdict != Verdict::Pass {
        stdio::note(&format!("run folder: {}", folder.path().display()));
        stdio::note(&format!("report: {}", page.display()));
    }
    warn_if_not_safe(record);
    match written {
        Ok(()) => Exit::of_record(record),
        Err(error) => stdio::reject(&error),
    }
}

fn report_run_error(error: &RunError, folder: &RunFolder) {
    match error {
        RunError::Scenario(diagnostic) => stdio::diagnostic(diagnostic),
        error => stdio::error(&error.to_string()),
    }
    if folder.remove_if_empty() {
        return;
    }
    stdio::note(&format!("run folder: {}", folder.path().display()));
    if let Ok(record) = RunRecord::read(folder.path()) {
        stdio::note(&format!("`platebench report {}` shows the complete trials", folder.path().display()));
        warn_if_not_safe(&record);
    }
}

fn note_not_applicable(record: &RunRecord) {
    match record.not_applicable.len() {
        0 => {}
        1 => stdio::note("1 scenario is not applicable to this controller"),
        count => stdio::note(&format!("{count} scenarios are not applicable to this controller")),
    }
}

fn warn_if_not_safe(record: &RunRecord) {
    if record.safe_confirmed == Some(false) {
        stdio::error("the controller did not confirm 0 V at the end: check the amplifier before you touch the plate");
    }
}
