//! `platebench run`: runs scenarios once, or again whenever they change.

mod arguments;
mod play;
mod watch;

pub(crate) use arguments::RunArgs;

use crate::exit::Exit;
use crate::options::{OutputFormat, SCENARIOS};
use crate::selection::report_if_empty;
use crate::stdio;
use platebench_report::{Detail, scenario_list};
use platebench_scenario::{Scenario, find};
use std::path::Path;

pub(crate) fn run(arguments: &RunArgs, detail: Detail) -> Exit {
    if arguments.list {
        return list(arguments, detail);
    }
    let mut arguments = arguments.clone();
    match arguments.board.find_rig() {
        Ok(Some(rig)) => arguments.rig = rig,
        Ok(None) => {}
        Err(exit) => return exit,
    }
    let arguments = &arguments;
    let clock = play::check_options(arguments);
    if let (true, Ok(clock)) = (arguments.watch, clock) {
        return watch::watch(arguments, clock, detail);
    }
    play::with_events(arguments, |events| {
        let clock = clock?;
        let scenarios = scenarios_to_run(arguments, detail)?;
        play::play(arguments, clock, scenarios, detail, events)
    })
}

fn list(arguments: &RunArgs, detail: Detail) -> Exit {
    let scenarios = match scenarios_to_run(arguments, detail) {
        Ok(scenarios) => scenarios,
        Err(exit) => return exit,
    };
    match arguments.format {
        OutputFormat::Human => stdio::show(&scenario_list::text(&scenarios)),
        OutputFormat::Json => stdio::show_json(&scenario_list::json(&scenarios)),
    }
    Exit::Passed
}

/// At least one. Reports every fault of every file, or a named folder without a scenario.
fn scenarios_to_run(arguments: &RunArgs, detail: Detail) -> Result<Vec<Scenario>, Exit> {
    let found = find(&arguments.scenarios).map_err(|faults| {
        let exit = stdio::reject_files(&faults);
        if arguments.scenarios == [Path::new(SCENARIOS)] && !Path::new(SCENARIOS).exists() {
            stdio::note("the default folder is `scenarios`; platebench new writes a first scenario");
        }
        exit
    })?;
    if !found.skipped.is_empty() && detail != Detail::Failures {
        let s = if found.skipped.len() == 1 { "" } else { "s" };
        let (count, names) = (found.skipped.len(), found.skipped.join(", "));
        let list = if detail == Detail::Tables { format!(": {names}") } else { "; -v lists them".to_owned() };
        stdio::note(&format!("{count} scenario{s} of known limits skipped, name one to run it{list}"));
    }
    for copies in &found.copies {
        stdio::note(&format!("{}: skipped, copies of scenarios in a run folder", copies.display()));
    }
    if report_if_empty(&found) {
        return Err(Exit::NothingToRun);
    }
    let scenarios = play::prepare_scenarios(found.scenarios, arguments).map_err(|fault| stdio::reject_file(&fault))?;
    if scenarios.is_empty() {
        stdio::error("there is nothing to run");
        return Err(Exit::NothingToRun);
    }
    Ok(scenarios)
}
