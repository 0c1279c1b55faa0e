//! `platebench run --watch`: what changed is played again.
//!
//! Files are looked at ten times a second, by their time and length: no more than a few hundred, and it works on every file system. What is played again is
//! decided by content: a scenario whose own file, plate, profile or firmware is another one than when it was last played.

use crate::args::Run;
use crate::exit::Exit;
use crate::output;
use crate::run::{play_all, prepared};
use crate::signals::Signals;
use platebench_runner::Clock;
use platebench_scenario::{Diagnostic, Scenario, every_file, find, input};
use std::collections::BTreeMap;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant, SystemTime};
use tokio::runtime::Runtime;

const LOOK_EVERY: Duration = Duration::from_millis(100);
/// Editors write in several steps: a change is taken up when nothing has moved between two looks, or after this long.
const LONGEST_UNREST: Duration = Duration::from_secs(2);
/// While something is wrong, files are also read again without a change that was seen: one that was missing may be there.
const AGAIN_AFTER: Duration = Duration::from_secs(1);

/// When files were written and how long they are.
type Stamp = BTreeMap<PathBuf, Option<(SystemTime, u64)>>;
/// A file and what was in it.
type Content = (PathBuf, Vec<u8>);
/// What scenarios were made of when they were last played, by the scenario's own file.
type Played = BTreeMap<PathBuf, Vec<Content>>;

/// Plays what `arguments` mean, and what changes, until a signal comes.
pub(crate) fn watch(arguments: &Run, clock: Clock, quiet: bool) -> Exit {
    if arguments.out.is_some() {
        output::error("--watch plays many runs, expected --runs FOLDER instead of --out");
        return Exit::Invalid;
    }
    match watched(arguments, clock, quiet) {
        Ok(exit) => exit,
        Err(error) => {
            output::error(&format!("signals cannot be listened for: {error}"));
            Exit::Inconclusive
        }
    }
}

fn watched(arguments: &Run, clock: Clock, quiet: bool) -> io::Result<Exit> {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    // From here on a signal ends this loop, also one that comes while something is played.
    let mut signals = runtime.block_on(async { Signals::listen() })?;
    let mut played = Played::new();
    let mut inputs = Vec::new();
    let mut told = Vec::new();
    loop {
        let before = stamp(arguments, &inputs);
        let mut waits = false;
        let found =
            find(&arguments.scenarios).and_then(|found| Ok((found, firmware(arguments).map_err(|fault| vec![fault])?)));
        match found {
            Err(faults) => {
                if faults != told {
                    faults.iter().for_each(output::diagnostic);
                    output::note("waiting for that to be mended; Ctrl-C ends");
                }
                told = faults;
                waits = true;
            }
            Ok((found, firmware)) => {
                told = Vec::new();
                let scenarios = prepared(found.scenarios, arguments, clock);
                inputs = scenarios.iter().flat_map(paths).collect();
                let changed = changed(scenarios, firmware.as_ref(), &mut played);
                if !changed.is_empty() {
                    // How it ended has been shown; what comes next is what counts.
                    let _ = play_all(arguments, clock, changed, quiet);
                    let what = if played.len() == 1 { "scenario" } else { "scenarios" };
                    output::note(&format!("watching {} {what}; Ctrl-C ends", played.len()));
                }
            }
        }
        let now = || stamp(arguments, &inputs);
        if let Some(number) = ended_or_changed(&runtime, &mut signals, &before, now, waits) {
            return Ok(Exit::Signal(number));
        }
    }
}

fn paths(scenario: &Scenario) -> Vec<PathBuf> {
    scenario.inputs.iter().map(|input| input.path.clone()).collect()
}

/// The image that the rig is loaded with, where that is a file of its own.
fn firmware(arguments: &Run) -> Result<Option<Content>, Diagnostic> {
    let read = |path: &Path| match input::read(path) {
        Ok(bytes) => Ok((path.to_owned(), bytes)),
        Err(error) => Err(Diagnostic::of_file(path, format!("cannot be read: {error}"))),
    };
    arguments.rig.image().map(read).transpose()
}

/// Those that are not what they were when they were last played, and from now on count as played.
fn changed(scenarios: Vec<Scenario>, firmware: Option<&Content>, played: &mut Played) -> Vec<Scenario> {
    let of = |scenario: &Scenario| -> Vec<Content> {
        let inputs = scenario.inputs.iter().map(|input| (input.path.clone(), input.bytes.clone()));
        inputs.chain(firmware.cloned()).collect()
    };
    let now: Played =
        scenarios.iter().filter_map(|scenario| Some((paths(scenario).first()?.clone(), of(scenario)))).collect();
    let before = std::mem::replace(played, now);
    let same = |scenario: &Scenario| {
        let path = paths(scenario).into_iter().next();
        path.and_then(|path| before.get(&path)).is_some_and(|inputs| *inputs == of(scenario))
    };
    scenarios.into_iter().filter(|scenario| !same(scenario)).collect()
}

/// Every file that the command line means, the rig's image among them, and `inputs` of scenarios.
fn stamp(arguments: &Run, inputs: &[PathBuf]) -> Stamp {
    let (files, _) = every_file(&arguments.scenarios);
    let paths = files
        .into_iter()
        .map(|(path, _)| path)
        .chain(inputs.iter().cloned())
        .chain(arguments.rig.image().map(Path::to_owned));
    let stamped = |path: PathBuf| {
        let written = fs::metadata(&path).ok().and_then(|data| Some((data.modified().ok()?, data.len())));
        (path, written)
    };
    paths.map(stamped).collect()
}

/// Waits until a signal comes, whose number it returns, or until `now` is something else than `before` and rests.
fn ended_or_changed(
    runtime: &Runtime,
    signals: &mut Signals,
    before: &Stamp,
    now: impl Fn() -> Stamp,
    looks_again: bool,
) -> Option<u8> {
    let started = Instant::now();
    let mut last = before.clone();
    let mut moved: Option<Instant> = None;
    loop {
        let ended = runtime.block_on(async {
            tokio::select! {
                biased;
                number = signals.next() => Some(number),
                () = tokio::time::sleep(LOOK_EVERY) => None,
            }
        });
        if ended.is_some() {
            return ended;
        }
        let next = now();
        let rests = next == last;
        if !rests {
            moved.get_or_insert_with(Instant::now);
        }
        last = next;
        let settled = moved.is_some_and(|moved| rests || moved.elapsed() > LONGEST_UNREST);
        if settled || (looks_again && started.elapsed() > AGAIN_AFTER) {
            return None;
        }
    }
}
