//! `platebench run`: runs scenarios once, or again if the content of a file, plate, profile or
//! firmware image changes.

mod play;

pub(crate) use play::RunArgs;

use crate::exit::{CommandResult, Exit, Failure};
use crate::options::SCENARIOS;
use crate::selection::{check_not_empty, keep_last_failed, note_skipped, nothing_to_run, warn_of_scenarios};
use crate::{shutdown, stdio};
use platebench_document::format::count;
use platebench_engine::Clock;
use platebench_model::input;
use platebench_model::quoted_path;
use platebench_model::scenario::{Diagnostic, Scenario, find, list_files};
use platebench_report::Detail;
use platebench_report::scenario_list::ScenarioList;
use play::Selection;
use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::thread::sleep;
use std::time::{Duration, Instant, SystemTime};

pub(crate) fn run(arguments: &RunArgs, detail: Detail) -> CommandResult {
    if arguments.list {
        let scenarios = scenarios_to_run(arguments, detail)?.scenarios;
        let list = ScenarioList::new(&scenarios);
        stdio::show_as(arguments.format, &list, || match detail {
            Detail::Failures => list.names(),
            Detail::Summary | Detail::Tables => stdio::console_text(&list.document()),
        });
        return Ok(Exit::Passed);
    }
    let mut arguments = arguments.clone();
    if let Some(rig) = arguments.board.find_rig()? {
        arguments.rig = rig;
    }
    let arguments = &arguments;
    let clock = play::check_options(arguments);
    if let (true, Ok(clock)) = (arguments.watch, &clock) {
        return watch(arguments, *clock, detail);
    }
    Ok(play::play_with_events(arguments, |events| {
        let clock = clock?;
        let selection = scenarios_to_run(arguments, detail)?;
        play::play(arguments, clock, selection, detail, events)
    }))
}

/// Fails if no scenario is selected.
fn scenarios_to_run(arguments: &RunArgs, detail: Detail) -> Result<Selection, Failure> {
    let mut found = find(&arguments.scenarios).map_err(|problems| {
        let exit = Failure::from(problems).report();
        if arguments.scenarios == [Path::new(SCENARIOS)] && !Path::new(SCENARIOS).exists() {
            stdio::note("the default folder is `scenarios`; `platebench new scenarios/first-step` writes a first scenario there");
        }
        exit
    })?;
    if arguments.last_failed {
        keep_last_failed(&mut found, &arguments.runs)?;
    }
    note_skipped(&found, detail);
    for copies in &found.copies {
        stdio::note(&format!("{}: skipped, copies of scenarios in a run folder", quoted_path(copies)));
    }
    check_not_empty(&found)?;
    let selection = play::select_scenarios(found.scenarios, arguments)?;
    warn_of_scenarios(&selection.scenarios);
    if selection.scenarios.is_empty() { Err(nothing_to_run()) } else { Ok(selection) }
}

const POLL_INTERVAL: Duration = Duration::from_millis(100);
/// An editor writes a file in several steps. A change counts if two polls agree, or after this
/// time.
const MAX_SETTLE_TIME: Duration = Duration::from_secs(2);
/// Time between attempts to load a faulty scenario. It may wait for a file that is not polled.
const RETRY_INTERVAL: Duration = Duration::from_secs(1);

type FileStamps = BTreeMap<PathBuf, Option<(SystemTime, u64)>>;
type FileContent = (PathBuf, Vec<u8>);
/// Inputs of the last run of each scenario. The key is the scenario file.
type PlayedInputs = BTreeMap<PathBuf, Vec<FileContent>>;

fn watch(arguments: &RunArgs, clock: Clock, detail: Detail) -> CommandResult {
    if arguments.out.is_some() {
        return Err(Failure::invalid(&"--watch makes many runs, expected --runs FOLDER instead of --out"));
    }
    shutdown::listen()
        .map_err(|error| Failure::new(Exit::Inconclusive, &format!("signals are not available: {error}")))?;
    let mut played = PlayedInputs::new();
    let mut inputs = Vec::new();
    let mut reported = Vec::new();
    loop {
        let before = file_stamps(arguments, &inputs);
        let found = find(&arguments.scenarios).and_then(|found| {
            if played.is_empty() {
                note_skipped(&found, detail);
            }
            let scenarios =
                play::select_scenarios(found.scenarios, arguments).map_err(|problem| vec![*problem])?.scenarios;
            Ok((scenarios, read_firmware(arguments).map_err(|problem| vec![problem])?))
        });
        let retry = found.is_err();
        match found {
            Err(problems) => {
                if problems != reported {
                    problems.iter().for_each(stdio::diagnostic);
                    stdio::note("waiting for a correction; Ctrl-C ends");
                }
                reported = problems;
            }
            Ok((scenarios, firmware)) => {
                reported = Vec::new();
                inputs = scenarios.iter().flat_map(input_paths).collect();
                let changed = changed_scenarios(scenarios, firmware.as_ref(), &mut played);
                if !changed.is_empty() {
                    // The run contains only a part of its shard, so it cannot be joined with
                    // others.
                    let selection = Selection { scenarios: changed, digest: None };
                    let _ = play::play_with_events(arguments, |events| {
                        play::play(arguments, clock, selection, detail, events)
                    });
                    stdio::note(&format!("watching {}; Ctrl-C ends", count(played.len(), "scenario")));
                }
            }
        }
        if let Some(number) = wait_for_change(&before, || file_stamps(arguments, &inputs), retry) {
            return Ok(Exit::Signal(number));
        }
    }
}

fn input_paths(scenario: &Scenario) -> Vec<PathBuf> {
    scenario.inputs.iter().map(|input| input.path.clone()).collect()
}

fn read_firmware(arguments: &RunArgs) -> Result<Option<FileContent>, Diagnostic> {
    let read = |path: &Path| match input::read(path) {
        Ok(bytes) => Ok((path.to_owned(), bytes)),
        Err(error) => Err(Diagnostic::for_file(path, format!("cannot be read: {error}"))),
    };
    arguments.rig.image().map(read).transpose()
}

/// Returns the scenarios whose inputs or firmware differ from `played`, and updates `played`.
fn changed_scenarios(
    scenarios: Vec<Scenario>,
    firmware: Option<&FileContent>,
    played: &mut PlayedInputs,
) -> Vec<Scenario> {
    let contents = |scenario: &Scenario| -> Vec<FileContent> {
        let inputs = scenario.inputs.iter().map(|input| (input.path.clone(), input.bytes.clone()));
        inputs.chain(firmware.cloned()).collect()
    };
    let by_file = |scenario: &Scenario| Some((scenario.inputs.first()?.path.clone(), contents(scenario)));
    let now: PlayedInputs = scenarios.iter().filter_map(by_file).collect();
    let before = std::mem::replace(played, now);
    let is_changed = |scenario: &Scenario| {
        by_file(scenario).is_none_or(|(path, contents)| before.get(&path).is_none_or(|last| *last != contents))
    };
    scenarios.into_iter().filter(is_changed).collect()
}

fn file_stamps(arguments: &RunArgs, inputs: &[PathBuf]) -> FileStamps {
    let (files, _) = list_files(&arguments.scenarios);
    let files = files.into_iter().map(|(path, _)| path).chain(inputs.iter().cloned());
    let stamped = |path: PathBuf| {
        let stamp = fs::metadata(&path).ok().and_then(|data| Some((data.modified().ok()?, data.len())));
        (path, stamp)
    };
    files.chain(arguments.rig.image().map(Path::to_owned)).map(stamped).collect()
}

/// Waits until `now` differs from `before` and is stable. Returns the number of a signal that came
/// earlier. With `retry`, also returns after [`RETRY_INTERVAL`].
fn wait_for_change(before: &FileStamps, now: impl Fn() -> FileStamps, retry: bool) -> Option<u8> {
    let started = Instant::now();
    let mut last = before.clone();
    let mut changed: Option<Instant> = None;
    loop {
        if let Some(number) = shutdown::received_signal() {
            return Some(number);
        }
        sleep(POLL_INTERVAL);
        let next = now();
        let is_stable = next == last;
        if !is_stable {
            changed.get_or_insert_with(Instant::now);
        }
        last = next;
        let settled = changed.is_some_and(|changed| is_stable || changed.elapsed() > MAX_SETTLE_TIME);
        if settled || (retry && started.elapsed() > RETRY_INTERVAL) {
            return None;
        }
    }
}
