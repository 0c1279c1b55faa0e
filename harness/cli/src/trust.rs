//! `platebench trust`: the suite's own error rates.

use crate::args::{Format, Trust};
use crate::exit::Exit;
use crate::output;
use crate::run::names_nothing;
use platebench_scenario::find;
use platebench_trust::{Order, Report, catalogue, measure, shown};
use std::fs;
use std::io;
use std::num::NonZero;
use std::path::Path;

/// Plays the catalogue of faulty controllers and clean runs, and says how many were caught and how many called faulty.
pub(crate) fn trust(arguments: &Trust) -> Exit {
    let found = match find(&arguments.scenarios) {
        Ok(found) => found,
        Err(faults) => {
            faults.iter().for_each(output::diagnostic);
            return Exit::Invalid;
        }
    };
    if names_nothing(&found) {
        return Exit::Nothing;
    }
    let cores = || std::thread::available_parallelism().map_or(1, NonZero::get);
    let order = Order {
        scenarios: found.scenarios,
        faults: catalogue(),
        clean: arguments.clean,
        seed: arguments.seed,
        jobs: arguments.jobs.map_or_else(cores, usize::from),
    };
    let report = match measure(&order) {
        Ok(report) => report,
        Err(error) => {
            output::error(&error.to_string());
            return Exit::Invalid;
        }
    };
    if let Some(folder) = &arguments.out
        && let Err(error) = store(&report, folder)
    {
        output::error(&format!("{}: {error}", folder.display()));
        return Exit::Invalid;
    }
    match arguments.format {
        Format::Human => output::show(&shown::summary(&report)),
        Format::Json => match serde_json::to_string_pretty(&report) {
            Ok(text) => output::show(&format!("{text}\n")),
            Err(error) => output::error(&format!("the report cannot be shown as JSON: {error}")),
        },
    }
    Exit::of_verdict(report.verdict)
}

fn store(report: &Report, folder: &Path) -> io::Result<()> {
    fs::create_dir_all(folder)?;
    fs::write(folder.join("trust.json"), serde_json::to_string_pretty(report)?)?;
    fs::write(folder.join("matrix.md"), shown::matrix(report))
}
