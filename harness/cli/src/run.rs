//! `platebench run`: find, play, judge, report.

use crate::args::{BASELINES, Format, Run, SCENARIOS};
use crate::clock::{checked, fast_enough};
use crate::desk::Desk;
use crate::exit::Exit;
use crate::play::{Audience, play};
use crate::told::{self, Places};
use crate::watch::watch;
use crate::{live, output};
use platebench_plate::Tier;
use platebench_report::events::Events;
use platebench_report::{Progress, ProgressKind, html, junit, traceability};
use platebench_runner::{Plan, RunError, RunFolder, rejudge};
use platebench_scenario::{Found, Scenario, find};
use platebench_verdict::RunRecord;
use platebench_verdict::record::Overrides;
use std::num::NonZero;
use std::path::Path;
use tracing::info;

/// Plays scenarios and judges them.
pub(crate) fn run(arguments: &Run, quiet: bool) -> Exit {
    let clock = checked(arguments);
    if let (true, Ok(clock)) = (arguments.watch, clock) {
        return watch(arguments, clock, quiet);
    }
    telling(arguments, |events| {
        let clock = clock?;
        let scenarios = scenarios(arguments, clock)?;
        if scenarios.is_empty() {
            output::error("there is nothing to run");
            return Err(Exit::Nothing);
        }
        played(arguments, clock, scenarios, quiet, events)
    })
}

/// Plays these scenarios into a new run folder, shows what came of it and says how it ended.
pub(crate) fn play_all(
    arguments: &Run,
    clock: platebench_runner::Clock,
    scenarios: Vec<Scenario>,
    quiet: bool,
) -> Exit {
    telling(arguments, |events| played(arguments, clock, scenarios, quiet, events))
}

/// Tells programs that listen what `play` plays, and in any case how it ended.
fn telling(arguments: &Run, play: impl FnOnce(&mut Option<Events>) -> Result<(Exit, RunRecord), Exit>) -> Exit {
    let mut events = (arguments.format == Format::Json).then(|| Events::new(output::Shown));
    let (exit, record) = match play(&mut events) {
        Ok((exit, record)) => (exit, Some(record)),
        Err(exit) => (exit, None),
    };
    if let Some(events) = &mut events {
        let error = record.is_none().then(|| told::ended(exit));
        events.run_finished(record.as_ref(), error, exit.code());
    }
    exit
}

/// How the run ended, with its record where it came to one.
fn played(
    arguments: &Run,
    clock: platebench_runner::Clock,
    scenarios: Vec<Scenario>,
    quiet: bool,
    events: &mut Option<Events>,
) -> Result<(Exit, RunRecord), Exit> {
    if let Err(error) = fast_enough(arguments, clock, &scenarios) {
        output::error(&error);
        return Err(Exit::Invalid);
    }
    let folder = match &arguments.out {
        Some(folder) => RunFolder::create(Some(folder)),
        None => RunFolder::create_below(&arguments.runs),
    };
    let folder = match folder {
        Ok(folder) => folder,
        Err(error) => {
            output::error(&error.to_string());
            return Err(Exit::Invalid);
        }
    };
    // One line is driven by one; and in real time nothing may compete with it.
    let waits = matches!(clock, platebench_runner::Clock::Lockstep { .. });
    let most = if !waits || !arguments.rig.is_plural() {
        1
    } else {
        std::thread::available_parallelism().map_or(1, NonZero::get)
    };
    let is_real = clock == platebench_runner::Clock::OwnPlate;
    let plan = Plan {
        scenarios,
        jobs: if arguments.rig.is_plural() && !is_real { arguments.jobs.map_or(most, usize::from) } else { 1 },
        clock,
        own_clock: arguments.rig.has_own_clock(),
        rig: arguments.rig.to_string(),
        overrides: overrides(arguments),
    };
    info!(folder = %folder.path().display(), scenarios = plan.scenarios.len(), jobs = plan.jobs, "run starts");
    // Prompts and a bar of force have the terminal for themselves.
    let kind = match ProgressKind::detect() {
        _ if quiet => ProgressKind::Quiet,
        ProgressKind::Bars if is_real => ProgressKind::Lines,
        kind => kind,
    };
    if arguments.live && is_real {
        output::note("no live view: what is asked of the person at the plate has the terminal for itself");
    }
    let looks = (arguments.live && !is_real).then(|| live::open(live::subject("run", live::KEYS, &plan)));
    let (view, watch) = looks.unwrap_or_default();
    let kind = if view.is_some() { ProgressKind::Quiet } else { kind };
    if let Some(view) = &view {
        view.quit_on_q();
    }
    let places = Places::of_scenarios(&plan.scenarios);
    if let Some(events) = events {
        let trials = |scenario: &Scenario| (scenario.file.clone(), scenario.trials.count);
        let scenarios: Vec<_> = plan.scenarios.iter().map(trials).collect();
        events.run_started(&folder.path().display().to_string(), &plan.rig, plan.clock.name(), &scenarios);
    }
    let desk = Desk::new(is_real && !arguments.yes);
    let audience = Audience { progress: Progress::new(kind), view: view.as_ref(), events: events.as_mut() };
    let played = play(plan, &folder, arguments.rig.clone(), desk, watch, audience);
    // What is said from here on is for the terminal as it was.
    drop(view);
    match played {
        Ok(record) => Ok((finish(&record, &folder, arguments, &places), record)),
        Err((error, signal)) => {
            explain(&error, &folder);
            Err(signal.map_or_else(|| Exit::of_error(&error), Exit::Signal))
        }
    }
}

fn overrides(arguments: &Run) -> Overrides {
    Overrides {
        law: arguments.law.clone(),
        trials: arguments.trials,
        seed: arguments.seed,
        model: arguments.model.clone(),
    }
}

/// The scenarios that the command line means; every fault of every file, and every folder that was named for nothing, has been shown where there are any.
fn scenarios(arguments: &Run, clock: platebench_runner::Clock) -> Result<Vec<Scenario>, Exit> {
    let found = find(&arguments.scenarios).map_err(|faults| {
        faults.iter().for_each(output::diagnostic);
        if arguments.scenarios == [Path::new(SCENARIOS)] && !Path::new(SCENARIOS).exists() {
            output::note(
                "without a name the scenarios below `scenarios` are meant; platebench new writes one to start from",
            );
        }
        Exit::Invalid
    })?;
    if !found.left_out.is_empty() {
        let names = found.left_out.join(", ");
        output::note(&format!("left out, because they show a limit and were not named: {names}"));
    }
    if names_nothing(&found) {
        return Err(Exit::Nothing);
    }
    Ok(prepared(found.scenarios, arguments, clock))
}

/// True where there is nothing to run, or nothing below a folder that was named beside others; which has been shown.
pub(crate) fn names_nothing(found: &Found) -> bool {
    if found.scenarios.is_empty() {
        output::error("there is nothing to run");
        return true;
    }
    for folder in &found.empty {
        output::error(&format!("{}: there is nothing to run below it", folder.display()));
    }
    !found.empty.is_empty()
}

/// The scenarios of this command line's shard, as they are played by it.
pub(crate) fn prepared(
    mut scenarios: Vec<Scenario>,
    arguments: &Run,
    clock: platebench_runner::Clock,
) -> Vec<Scenario> {
    let overrides = overrides(arguments);
    for scenario in &mut scenarios {
        rejudge::apply(&overrides, scenario);
        scenario.choose_model(clock == platebench_runner::Clock::Lockstep { wire_time: false });
    }
    let mut index = 0..;
    scenarios.retain(|_| arguments.shard.zip(index.next()).is_none_or(|(shard, index)| shard.holds(index)));
    scenarios
}

fn finish(record: &RunRecord, folder: &RunFolder, arguments: &Run, places: &Places) -> Exit {
    let written = junit::write(record, &folder.path().join(junit::FILE))
        .and_then(|()| {
            let page = html::Page::new(record, folder.path()).with_baselines(Path::new(BASELINES)).with_earlier_runs();
            page.write(&folder.path().join(html::FILE))
        })
        .and_then(|()| traceability::write(record, folder.path()))
        .and_then(|()| arguments.told.tell(record, places));
    if arguments.format == Format::Human {
        output::record(record, arguments.format);
    }
    output::note(&format!("run folder: {}", folder.path().display()));
    output::note(&format!("report: {}", folder.path().join(html::FILE).display()));
    warn_of_drive(record);
    warn_of_models(record);
    match written {
        Ok(()) => Exit::of_record(record),
        Err(error) => {
            output::error(&error.to_string());
            Exit::Invalid
        }
    }
}

fn explain(error: &RunError, folder: &RunFolder) {
    match error {
        RunError::Scenario(diagnostic) => output::diagnostic(diagnostic),
        error => output::error(&error.to_string()),
    }
    // Where nothing was begun there is nothing to look at.
    if folder.remove_if_empty() {
        return;
    }
    output::note(&format!("run folder: {}", folder.path().display()));
    // What ended the run has been said; a folder without a record says nothing of the drive.
    if let Ok(record) = RunRecord::read(folder.path()) {
        let show = format!("what was whole by then: platebench report {}", folder.path().display());
        output::note(&show);
        warn_of_drive(&record);
    }
}

/// Somebody has to look where nobody knows.
fn warn_of_drive(record: &RunRecord) {
    if record.safe_confirmed == Some(false) {
        output::error("the controller did not confirm 0 V at its end: see to the amplifier before you touch the plate");
    }
}

/// A plate that was named and may be further off than the expectations bear has decided nothing for sure.
fn warn_of_models(record: &RunRecord) {
    for scenario in &record.scenarios {
        let Some(choice) = scenario.model_choice.as_ref().filter(|choice| choice.asked != "auto") else { continue };
        let exact = Tier::from_name(&scenario.model).is_none_or(Tier::has_both_poles);
        if !exact && choice.bound.is_none_or(|bound| bound > choice.budget) {
            let bound =
                choice.bound.map_or_else(|| "nobody knows how much".to_owned(), |bound| format!("up to {bound:.1e}"));
            let (file, model, budget) = (&scenario.file, &scenario.model, choice.budget);
            output::note(&format!(
                "{file}: the plate `{model}` that was asked for may be off by {bound} of the setpoint, where what is expected bears {budget:.1e}"
            ));
        }
    }
}
