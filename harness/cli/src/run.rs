//! `platebench run`: find, play, judge, report.

use crate::args::{BASELINES, Clock, Format, Pacing, PlateMode, Run, SCENARIOS};
use crate::desk::Desk;
use crate::exit::Exit;
use crate::guard::Busy;
use crate::signals::{PATIENCE, Signals};
use crate::told::{self, Places};
use crate::watch::watch;
use crate::{live, output};
use platebench_live::{Told, View};
use platebench_plate::Tier;
use platebench_report::events::Events;
use platebench_report::{Progress, ProgressKind, html, junit, traceability};
use platebench_rig::{RigSpec, check_baud};
use platebench_runner::{Cancel, Company, Event, Pace, Plan, RunError, RunFolder, Watch, rejudge};
use platebench_scenario::{Found, Scenario, find};
use platebench_verdict::RunRecord;
use platebench_verdict::record::Overrides;
use std::num::NonZero;
use std::path::Path;
use std::time::{Duration, Instant};
use tokio::sync::mpsc;
use tokio::sync::mpsc::error::TrySendError;
use tracing::info;

/// Whoever follows a run that is to end has so long for what it was told.
const HEARD_WITHIN: Duration = Duration::from_secs(1);
const ASK_AGAIN: Duration = Duration::from_millis(1);

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

/// The clock, where clock and rig go together; why not has been shown.
fn checked(arguments: &Run) -> Result<platebench_runner::Clock, Exit> {
    let clock = clock(arguments).map_err(|what| {
        output::error(what);
        Exit::Invalid
    })?;
    arguments.rig.check().map_err(|error| {
        output::error(&error.to_string());
        Exit::Invalid
    })?;
    arguments.told.check().map_err(|what| {
        output::error(&what);
        Exit::Invalid
    })?;
    Ok(clock)
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
    let around =
        Around { desk: Desk::new(is_real && !arguments.yes), view: view.as_ref(), watch, events: events.as_mut() };
    let played = play(plan, &folder, arguments.rig.clone(), kind, around);
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

/// The clock of a rig where none is named.
pub(crate) fn default_clock(rig: &RigSpec) -> Clock {
    match rig {
        RigSpec::Serial { .. } | RigSpec::Probe { port: Some(_), .. } => Clock::RealTime,
        RigSpec::Hosted | RigSpec::Emulated(_) | RigSpec::Exec(_) | RigSpec::Probe { port: None, .. } => {
            Clock::Lockstep
        }
    }
}

/// The clock that the command line means; why it cannot be meant where it cannot.
pub(crate) fn clock(arguments: &Run) -> Result<platebench_runner::Clock, &'static str> {
    let pacing = match arguments.pacing {
        Pacing::Bench => platebench_runner::Pacing::Bench,
        Pacing::Target => platebench_runner::Pacing::Target,
    };
    let time_scale = arguments.time_scale;
    if arguments.plate_mode == PlateMode::Real {
        return real_plate(arguments);
    }
    match arguments.clock.unwrap_or(default_clock(&arguments.rig)) {
        Clock::Lockstep if time_scale != 1.0 || arguments.pacing == Pacing::Target => {
            Err("--time-scale and --pacing are for --clock real-time")
        }
        Clock::Lockstep => Ok(platebench_runner::Clock::Lockstep { wire_time: arguments.wire_time }),
        Clock::RealTime if !arguments.rig.keeps_real_time() => Err(
            "RTT through a debug probe does not keep real time: use --clock lockstep or name the board's serial port, --rig probe:CHIP,port=PORT[@BAUD]",
        ),
        Clock::RealTime if arguments.wire_time => {
            Err("--wire-time is for --clock lockstep; in real time every microsecond acts anyway")
        }
        Clock::RealTime if time_scale != 1.0 && pacing == platebench_runner::Pacing::Target => {
            Err("--time-scale needs --pacing bench: a controller's own timer cannot be slowed down")
        }
        Clock::RealTime => Ok(platebench_runner::Clock::RealTime(Pace { time_scale, pacing })),
    }
}

/// A real plate has one clock, the controller's.
fn real_plate(arguments: &Run) -> Result<platebench_runner::Clock, &'static str> {
    if !matches!(arguments.rig, RigSpec::Serial { .. } | RigSpec::Exec(_)) {
        return Err(
            "--plate-mode real is for a controller with a plate of its own: --rig serial:PORT[@BAUD] or exec:COMMAND",
        );
    }
    let asks_for_another =
        arguments.clock == Some(Clock::Lockstep) || arguments.time_scale != 1.0 || arguments.wire_time;
    if asks_for_another || arguments.pacing == Pacing::Target {
        return Err(
            "--plate-mode real has the controller's own clock: --clock lockstep, --time-scale, --pacing and --wire-time are for an emulated plate",
        );
    }
    Ok(platebench_runner::Clock::OwnPlate)
}

/// Whether the line can carry what the scenarios ask for, in real time; in lockstep the plate waits for it.
pub(crate) fn fast_enough(
    arguments: &Run,
    clock: platebench_runner::Clock,
    scenarios: &[Scenario],
) -> Result<(), String> {
    let Some(baud) = arguments.rig.baud() else { return Ok(()) };
    let time_scale = match clock {
        platebench_runner::Clock::Lockstep { .. } => return Ok(()),
        platebench_runner::Clock::RealTime(pace) => pace.time_scale,
        // Telemetry takes 43 bytes a period, a sample and its command 48.
        platebench_runner::Clock::OwnPlate => 1.0,
    };
    for scenario in scenarios {
        let period = Duration::from_nanos(scenario.controller.period.as_nanos());
        check_baud(baud, period, time_scale).map_err(|error| format!("{}: {error}", scenario.file))?;
    }
    Ok(())
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

/// Who is there while a run is played, what they look at and what they are told.
pub(crate) struct Around<'a> {
    pub(crate) desk: Desk,
    pub(crate) view: Option<&'a View>,
    pub(crate) watch: Watch,
    pub(crate) events: Option<&'a mut Events>,
}

impl Around<'_> {
    /// Nobody.
    pub(crate) fn nobody() -> Self {
        Self { desk: Desk::new(false), view: None, watch: Watch::default(), events: None }
    }

    fn hear(&mut self, event: &Event) {
        if let (Some(view), Some(news)) = (self.view, Told::of(event)) {
            view.tell(news);
        }
        if let Some(events) = &mut self.events {
            tell(events, event);
        }
    }
}

/// Plays the plan on threads of its own while this one listens for signals and tells of progress.
pub(crate) fn play(
    plan: Plan,
    folder: &RunFolder,
    rig: RigSpec,
    kind: ProgressKind,
    mut around: Around<'_>,
) -> Result<RunRecord, (RunError, Option<u8>)> {
    let desk = std::mem::replace(&mut around.desk, Desk::new(false));
    let watch = std::mem::take(&mut around.watch);
    let without_signal = |error: std::io::Error| (RunError::Bench(error.to_string()), None);
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().map_err(without_signal)?;
    let cancel = Cancel::default();
    let result = runtime.block_on(async {
        let mut signals = Signals::listen().map_err(without_signal)?;
        let (teller, mut events) = mpsc::channel::<Event>(64);
        let busy = Busy::begin(&cancel);
        let mut playing = {
            let (folder, cancel) = (folder.clone(), cancel.clone());
            tokio::task::spawn_blocking(move || {
                let _busy = busy;
                let mut asked = None;
                let mut tell = |event| send(&teller, event, &cancel, &mut asked);
                let connect = || match plan.clock {
                    platebench_runner::Clock::Lockstep { .. } => rig.connect(),
                    platebench_runner::Clock::RealTime(_) | platebench_runner::Clock::OwnPlate => {
                        rig.connect_in_real_time()
                    }
                };
                let company = Company { person: &desk, watch: &watch };
                platebench_runner::run_in_company(&plan, &folder, &connect, &cancel, company, &mut tell)
            })
        };
        let mut progress = Progress::new(kind);
        let mut received = None;
        let mut asked = None;
        loop {
            let number = tokio::select! {
                Some(event) = events.recv() => {
                    follow(&mut progress, &event);
                    around.hear(&event);
                    continue;
                }
                ended = &mut playing => {
                    // What was said before the end may not have been heard yet.
                    while let Ok(event) = events.try_recv() {
                        follow(&mut progress, &event);
                        around.hear(&event);
                    }
                    progress.finish();
                    let ended = ended.unwrap_or_else(|error| Err(RunError::Bench(error.to_string())));
                    return ended.map_err(|error| (error, received));
                }
                number = signals.next() => number,
            };
            let first = *asked.get_or_insert_with(Instant::now);
            // A closing terminal asks twice by itself: nobody is left alone with the drive before it had time to go to 0 V.
            if first.elapsed() > PATIENCE {
                return Err((RunError::Cancelled, received));
            }
            received.get_or_insert(number);
            cancel.cancel();
        }
    });
    // A trial that does not come back is not waited for.
    runtime.shutdown_background();
    result
}

/// Tells `event`; where nobody listens any more, or does not come to it once the end was asked for, which was seen at `asked`, it is not told.
fn send(teller: &mpsc::Sender<Event>, mut event: Event, cancel: &Cancel, asked: &mut Option<Instant>) {
    while let Err(TrySendError::Full(back)) = teller.try_send(event) {
        if cancel.is_cancelled() && asked.get_or_insert_with(Instant::now).elapsed() > HEARD_WITHIN {
            return;
        }
        event = back;
        std::thread::sleep(ASK_AGAIN);
    }
}

pub(crate) fn follow(progress: &mut Progress, event: &Event) {
    match event {
        Event::ScenarioStarted { file, trials } => progress.scenario_started(file, *trials),
        Event::TrialFinished { file, trial } => progress.trial_finished(file, trial.index),
        Event::ScenarioFinished(record) => progress.scenario_finished(record),
    }
}

fn tell(events: &mut Events, event: &Event) {
    match event {
        Event::ScenarioStarted { file, trials } => events.scenario_started(file, *trials),
        Event::TrialFinished { file, trial } => events.trial_finished(file, trial),
        Event::ScenarioFinished(record) => events.scenario_finished(record),
    }
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
