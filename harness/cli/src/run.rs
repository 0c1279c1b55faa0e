//! `platebench run`: runs scenarios once, or again after each change.

mod arguments;
mod play;
mod watch;

pub(crate) use arguments::RunArgs;

use crate::exit::Exit;
use crate::failure::{CommandResult, Failure};
use crate::options::SCENARIOS;
use crate::plate_warnings::warn_of_scenarios;
use crate::selection::{check_not_empty, note_skipped, nothing_to_run};
use crate::stdio;
use platebench_model::scenario::find;
use platebench_report::{Detail, scenario_list};
use play::Selection;
use std::path::Path;

pub(crate) fn run(arguments: &RunArgs, detail: Detail) -> CommandResult {
    if arguments.list {
        let scenarios = scenarios_to_run(arguments, detail)?.scenarios;
        stdio::show_as(arguments.format, &scenario_list::json(&scenarios), || scenario_list::text(&scenarios));
        return Ok(Exit::Passed);
    }
    let mut arguments = arguments.clone();
    if let Some(rig) = arguments.board.find_rig()? {
        arguments.rig = rig;
    }
    let arguments = &arguments;
    let clock = play::check_options(arguments);
    if let (true, Ok(clock)) = (arguments.watch, &clock) {
        return watch::watch(arguments, *clock, detail);
    }
    Ok(play::play_with_events(arguments, |events| {
        let clock = clock?;
        let selection = scenarios_to_run(arguments, detail)?;
        play::play(arguments, clock, selection, detail, events)
    }))
}

/// Fails if no scenario is selected.
fn scenarios_to_run(arguments: &RunArgs, detail: Detail) -> Result<Selection, Failure> {
    let found = find(&arguments.scenarios).map_err(|faults| {
        let exit = Failure::from(faults).report();
        if arguments.scenarios == [Path::new(SCENARIOS)] && !Path::new(SCENARIOS).exists() {
            stdio::note("the default folder is `scenarios`; platebench new writes a first scenario");
        }
        exit
    })?;
    note_skipped(&found, detail);
    for copies in &found.copies {
        stdio::note(&format!("{}: skipped, copies of scenarios in a run folder", copies.display()));
    }
    check_not_empty(&found)?;
    let selection = play::select_scenarios(found.scenarios, arguments)?;
    warn_of_scenarios(&selection.scenarios);
    if selection.scenarios.is_empty() { Err(nothing_to_run()) } else { Ok(selection) }
}
