//! Defines the arguments of `platebench run`, plays its scenarios into a new run folder and writes
//! the reports.

use crate::board::{BoardArgs, release};
use crate::exit::{CommandResult, Exit, Failure, OrInvalid};
use crate::options::{
    BASELINES, ClockArg, ClockRequest, OutputFormat, PacingArg, PlateModeArg, SCENARIOS, check_line_speed, job_count,
    law_help, law_names, parse_keep_traces, parse_reply_timeout, parse_time_scale, parse_timeout, rig_help,
};
use crate::outputs::{Outputs, RESULTS, ScenarioLocations};
use crate::prompt::TerminalOperator;
use crate::run_plan::{EventSinks, run_plan, run_started};
use crate::selection::ScenarioFilter;
use crate::{outputs, run_plan, shutdown, stdio};
use clap::Args;
use clap::builder::PossibleValuesParser;
use platebench_document::format::count;
use platebench_engine::{Clock, RunError, RunPlan, rejudge};
use platebench_lab::boards::BoardOutcome;
use platebench_model::quoted_path;
use platebench_model::record::{KeepTraces, Overrides, RunFolder, RunRecord, ScenarioRecord, Verdict};
use platebench_model::scenario::{AUTO_MODEL, Diagnostic, MAX_TRIALS, Scenario};
use platebench_plate::Model;
use platebench_report::events::{EventWriter, run_finished};
use platebench_report::live::RunDescription;
use platebench_report::page::RowCache;
use platebench_report::{
    Detail, Progress, ProgressKind, counts_so_far, github, junit, page, slow_scenarios, traceability,
};
use platebench_rig::{Capability, ConnectOptions, DebugPort, RigSpec};
use std::path::{Path, PathBuf};
use std::str::FromStr;
use std::sync::Arc;
use std::time::Duration;
use tracing::info;

// Headings of the help. Options without a heading are the common ones and come first.
const EXTENT: &str = "Extent of a run";
const PLATE: &str = "Plate, clock and line";

#[derive(Debug, Clone, Args)]
#[command(after_help = "\
Examples:
  platebench run paper/fig13-closed-loop.toml   one scenario by its name
  platebench run -k fig13 --law dq-pi-euler     names that contain a text, with another law
More options and examples: platebench run --help")]
#[command(after_long_help = "\
Examples:
  platebench run                                        every scenario below scenarios/ without `only_if_named`
  platebench run paper/fig13-closed-loop.toml           one scenario by its name, from any folder of the project
  platebench run -k fig13 -k fig14                      scenarios whose names contain a text
  platebench run --last-failed                          scenarios that did not pass in the last run
  platebench run scenarios/paper --law dq-pi-euler      another law of the firmware
  platebench run --trials 300 --seed 7 --out /tmp/night
  platebench run scenarios/paper --watch                run changed scenarios again
  platebench run --list --tag paper --not-tag acceptance      list scenarios and limits without playing them
  platebench run --list -q -k fig13                     list names only")]
#[expect(clippy::struct_excessive_bools, reason = "each is a flag of its own on the command line")]
pub(crate) struct RunArgs {
    /// Files, folders or names below `scenarios`
    ///
    /// Names are those below the nearest folder `scenarios`.
    #[arg(value_name = "SCENARIO|FOLDER", default_value = SCENARIOS)]
    pub(crate) scenarios: Vec<PathBuf>,
    /// Rig of the controller: hosted, emulated[:ELF], exec:COMMAND, serial:PORT, ...
    #[arg(long, long_help = rig_help(), default_value = "emulated", conflicts_with = "board")]
    pub(crate) rig: RigSpec,
    /// Control law of the firmware; own: any algorithm, judged by the requirements
    #[arg(long, long_help = law_help(), value_name = "NAME", value_parser = law_names(), hide_possible_values = true)]
    pub(crate) law: Option<String>,
    /// Trials of each scenario
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=i64::from(MAX_TRIALS)))]
    pub(crate) trials: Option<u32>,
    /// Seed of each scenario's first trial
    #[arg(long, hide_short_help = true, value_name = "S")]
    pub(crate) seed: Option<u64>,
    #[command(flatten)]
    pub(crate) tags: ScenarioFilter,
    /// The run folder; default: a new folder below --runs
    #[arg(long, value_name = "FOLDER")]
    pub(crate) out: Option<PathBuf>,
    /// Only scenarios that did not pass in the newest run below --runs
    #[arg(long, conflicts_with = "watch")]
    pub(crate) last_failed: bool,
    /// List the scenarios instead of playing them
    ///
    /// With tags, limits and windows; with -q, one name per line.
    #[arg(long, conflicts_with = "watch")]
    pub(crate) list: bool,
    /// Run changed scenarios again until Ctrl-C
    ///
    /// A scenario if its file, plate or profile changed, all if the ELF changed.
    #[arg(long)]
    pub(crate) watch: bool,
    /// Live view in the terminal; ignored without a terminal
    #[arg(long)]
    pub(crate) live: bool,
    /// Format of standard output; json: one event per line, the last is the verdict
    #[arg(long, hide_short_help = true, value_enum, default_value_t = OutputFormat::Human)]
    pub(crate) format: OutputFormat,
    /// Trials that run at once; default: one per core
    #[arg(long, hide_short_help = true, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=1024))]
    pub(crate) jobs: Option<u16>,
    /// Run the K-th of N parts of the scenarios
    #[arg(long, hide_short_help = true, help_heading = EXTENT, value_name = "K/N")]
    pub(crate) shard: Option<Shard>,
    /// Fail if the controller does not announce a law or capability that a scenario needs
    #[arg(long, hide_short_help = true, help_heading = EXTENT)]
    pub(crate) require_all: bool,
    /// Start no further trial once a scenario failed; scenarios without all trials are inconclusive
    #[arg(long, hide_short_help = true, help_heading = EXTENT)]
    pub(crate) fail_fast: bool,
    /// Play the long scripts of the protocol check also with a controller that runs in wall time
    #[arg(long, hide_short_help = true, help_heading = EXTENT)]
    pub(crate) long_scripts: bool,
    /// Wall time after which the trials of a scenario end, s; replaces its key `timeout_s`
    #[arg(long, hide_short_help = true, help_heading = EXTENT, value_name = "SECONDS", value_parser = parse_timeout)]
    pub(crate) timeout: Option<f64>,
    #[command(flatten)]
    pub(crate) board: BoardArgs,
    /// Model of the plate, instead of the scenario's
    #[arg(long, hide_short_help = true, help_heading = PLATE, value_name = "NAME", value_parser = PossibleValuesParser::new(
        std::iter::once(AUTO_MODEL).chain(Model::ALL.map(Model::name))))]
    pub(crate) model: Option<String>,
    /// Clock of the plate; default: real-time on a serial port, lockstep otherwise
    #[arg(long, hide_short_help = true, help_heading = PLATE, value_enum)]
    pub(crate) clock: Option<ClockArg>,
    /// Plate seconds per wall second: at 0.1 the delay of the line is ten times smaller for the
    /// plate
    #[arg(
        long, hide_short_help = true, help_heading = PLATE,
        value_name = "X", default_value_t = 1.0, value_parser = parse_time_scale
    )]
    pub(crate) time_scale: f64,
    /// Timer of the control instants in real time
    #[arg(long, hide_short_help = true, help_heading = PLATE, value_enum, default_value_t = PacingArg::Bench)]
    pub(crate) pacing: PacingArg,
    /// Let the emulated line and computing time act on the plate as loop delay
    #[arg(long, hide_short_help = true, help_heading = PLATE)]
    pub(crate) wire_time: bool,
    /// Lockstep over a line: time to wait for a reply before it counts as missed, ms
    #[arg(
        long, hide_short_help = true, help_heading = PLATE,
        value_name = "MS", default_value = "500", value_parser = parse_reply_timeout
    )]
    pub(crate) reply_timeout: Duration,
    /// Which plate is driven
    #[arg(
        long, hide_short_help = true, help_heading = PLATE,
        value_enum, default_value_t = PlateModeArg::Emulated, value_name = "MODE"
    )]
    pub(crate) plate_mode: PlateModeArg,
    /// Ask no operator; with --plate-mode real, everything that needs one stays inconclusive
    #[arg(long, hide_short_help = true, help_heading = PLATE)]
    pub(crate) yes: bool,
    /// Emulated rig: wait for a debugger on this port of the local host; the debugger controls the
    /// chip while the plate waits
    #[arg(
        long, hide_short_help = true, help_heading = PLATE,
        value_name = "PORT", conflicts_with_all = ["watch", "jobs", "board", "list"]
    )]
    pub(crate) gdb: Option<u16>,
    /// Parent folder of new run folders
    #[arg(long, hide_short_help = true, help_heading = RESULTS, value_name = "FOLDER", default_value = "runs")]
    pub(crate) runs: PathBuf,
    /// Which traces to store: all, failing, none or worst:N of each scenario; `report --rejudge`
    /// needs all
    #[arg(
        long, hide_short_help = true, help_heading = RESULTS,
        value_name = "WHICH", value_parser = parse_keep_traces, default_value = "all"
    )]
    pub(crate) keep_traces: KeepTraces,
    #[command(flatten)]
    pub(crate) outputs: Outputs,
}

impl RunArgs {
    pub(super) fn clock(&self) -> ClockRequest<'_> {
        ClockRequest {
            rig: &self.rig,
            clock: self.clock,
            time_scale: self.time_scale,
            pacing: self.pacing,
            plate_mode: self.plate_mode,
            wire_time: self.wire_time,
        }
    }

    /// `selection` is the digest of the scenarios before the shard was taken of them.
    pub(crate) fn overrides(&self, selection: Option<String>) -> Overrides {
        Overrides {
            law: self.law.clone(),
            trials: self.trials,
            seed: self.seed,
            model: self.model.clone(),
            require_all: self.require_all,
            fail_fast: self.fail_fast,
            long_scripts: self.long_scripts,
            timeout_s: self.timeout,
            wire_time: self.wire_time,
            keep_traces: self.keep_traces,
            board: self.board.selection.board.clone(),
            shard: self.shard.map(|shard| [shard.number, shard.count]),
            selection,
        }
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Shard {
    number: usize,
    count: usize,
}

impl Shard {
    /// `index` is the position of a scenario in the list, from 0.
    pub(crate) fn contains(self, index: usize) -> bool {
        index % self.count == self.number - 1
    }
}

impl FromStr for Shard {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let parts = text.split_once('/').and_then(|(number, of)| Some((number.parse().ok()?, of.parse().ok()?)));
        match parts {
            Some((number, of)) if (1..=of).contains(&number) => Ok(Self { number, count: of }),
            _ => Err("expected K/N with K from 1 to N".to_owned()),
        }
    }
}

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
        events.write(&run_finished(record.as_ref(), error, exit.code()));
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
    arguments.outputs.set_aside().or_invalid()?;
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
    let plan = Arc::new(plan);
    let description =
        RunDescription { command: "run", key_help: run_plan::KEYS, plan: Arc::clone(&plan), has_end: true };
    let opened = (arguments.live && !is_real).then(|| run_plan::open_view(description));
    let (view, live_tap) = opened.unwrap_or_default();
    if let Some(view) = &view {
        view.quit_on_q();
    }
    let locations = ScenarioLocations(Arc::clone(&plan));
    let operator = TerminalOperator::at_plate(is_real && !arguments.yes);
    let progress = match ProgressKind::detect() {
        _ if detail == Detail::Failures || view.is_some() => ProgressKind::Quiet,
        // With a real plate, prompts and a progress bar would overwrite each other.
        _ if is_real => ProgressKind::Lines,
        ProgressKind::Lines => ProgressKind::Quiet,
        kind => kind,
    };
    let (progress, mut rows) = (Progress::new(progress), RowCache::default());
    let mut sinks = EventSinks { progress, view: view.as_ref(), events: events.as_mut(), rows: Some(&mut rows) };
    sinks.send(run_started(&plan, &folder));
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
    let (owned, path) = (record.clone(), folder.path().to_owned());
    let write_files = move || {
        junit::write(&owned, &path.join(junit::FILE))
            .and_then(|()| {
                page::ReportPage::new(&owned, &path)
                    .with_baselines(Path::new(BASELINES))
                    .with_earlier_runs()
                    .with_rows(rows)
                    .write(&path.join(page::FILE))
            })
            .and_then(|()| traceability::write(&owned, &path))
    };
    let files = shutdown::run_unless_signalled(write_files).or_invalid()?;
    let is_cancelled = files.is_none();
    let written = files.unwrap_or(Ok(())).and_then(|()| {
        let record = record.with_traces_below(folder.path());
        let location = |scenario: &ScenarioRecord, index| locations.location_of(scenario, index);
        arguments.outputs.write(|| github::render_page(&record), || github::workflow_commands(&record, &location))
    });
    if arguments.format == OutputFormat::Human {
        if arguments.outputs.replaces_table() {
            stdio::record_to_stderr(record, folder.path(), detail);
        } else {
            stdio::record(record, folder.path(), arguments.format, detail);
        }
    }
    if detail != Detail::Failures || record.verdict != Verdict::Pass {
        stdio::note(&format!("run folder: {}", quoted_path(folder.path())));
        if !is_cancelled {
            stdio::note(&format!("report: {}", quoted_path(&page)));
        }
    }
    if is_cancelled {
        let folder = folder.path().display();
        stdio::note(&format!("a signal ended the report; `platebench report {folder}` writes it"));
    }
    if let Some(slow) = slow_scenarios(record) {
        stdio::note(&slow);
    }
    stdio::warn_if_not_safe(record);
    written.or_invalid()?;
    let signal = shutdown::received_signal().filter(|_| is_cancelled);
    Ok(signal.map_or_else(|| Exit::of_record(record), Exit::Signal))
}

fn report_run_error(error: RunError, folder: &RunFolder) -> Exit {
    let exit = Failure::from(error).report();
    if folder.remove_if_empty() {
        return exit;
    }
    stdio::note(&format!("run folder: {}", quoted_path(folder.path())));
    if let Ok(record) = RunRecord::read(folder.path()) {
        stdio::note(&counts_so_far(&record));
        stdio::note(&format!("`platebench report {}` shows the complete trials", quoted_path(folder.path())));
        stdio::warn_if_not_safe(&record);
    }
    exit
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_scenario_is_in_one_shard() {
        let shards = ["1/3", "2/3", "3/3"].map(|text| text.parse::<Shard>().unwrap());
        for index in 0..20 {
            assert_eq!(shards.iter().filter(|shard| shard.contains(index)).count(), 1, "{index}");
        }
        for wrong in ["0/3", "4/3", "1", "1/0", "a/b", ""] {
            assert!(wrong.parse::<Shard>().is_err(), "{wrong}");
        }
    }
}
