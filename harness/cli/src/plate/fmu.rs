//! `platebench plate fmu`: exports a plate as a co-simulation unit.

use crate::exit::Exit;
use crate::failure::{CommandResult, OrInvalid};
use crate::plate_warnings::warn_of_plate;
use crate::stdio;
use clap::Args;
use platebench_fmi::find_library;
use platebench_model::scenario::load::load_plate;
use platebench_model::scenario::read_text;
use std::path::PathBuf;

#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  platebench plate fmu scenarios/plates/aluminium-198x138.toml --out plate.fmu

Exit codes: 0 written, 2 invalid input, no shared library, or the file exists already")]
pub(super) struct FmuArgs {
    /// The plate file
    plate: PathBuf,
    /// The FMU (FMI 3.0, co-simulation), see docs/fmi.md. No file is overwritten
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
    /// Shared library of the plate; default: next to this program, or in ../lib/platebench
    #[arg(long, value_name = "FILE")]
    library: Option<PathBuf>,
}

pub(super) fn export(arguments: &FmuArgs) -> CommandResult {
    let plate = load_plate(&arguments.plate)?;
    warn_of_plate(&arguments.plate, &plate);
    let text = read_text(&arguments.plate)?;
    let library = match &arguments.library {
        Some(library) => library.clone(),
        None => find_library(&std::env::current_exe().unwrap_or_default()).or_invalid()?,
    };
    let title = arguments.plate.file_stem().unwrap_or_default().to_string_lossy();
    platebench_fmi::write(&plate, &text, &title, &library, &arguments.out).or_invalid()?;
    stdio::show(&format!("{}\n", arguments.out.display()));
    Ok(Exit::Passed)
}
