//! `platebench export-fmu`: exports a plate as a co-simulation unit.

use crate::exit::Exit;
use crate::{plate_file, stdio};
use clap::Args;
use platebench_fmi::FmuError;
use platebench_plate::Plate;
use std::path::{Path, PathBuf};

#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  platebench export-fmu scenarios/plates/aluminium-198x138.toml --out plate.fmu

Exit codes: 0 written, 2 invalid input, no shared library, or the file exists already")]
pub(crate) struct ExportFmuArgs {
    /// The plate file
    plate: PathBuf,
    /// The FMU (FMI 3.0, co-simulation), see docs/fmi.md. No file is overwritten
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
    /// Shared library of the plate; default: the one near this program
    #[arg(long, value_name = "FILE")]
    library: Option<PathBuf>,
}

pub(crate) fn export_fmu(arguments: &ExportFmuArgs) -> Exit {
    let (plate, text) = match plate_file::read_with_text(&arguments.plate) {
        Ok(read) => read,
        Err(fault) => return stdio::reject_file(&fault),
    };
    match write(&plate, &text, arguments) {
        Ok(()) => {
            stdio::show(&format!("{}\n", arguments.out.display()));
            Exit::Passed
        }
        Err(error) => stdio::reject(&error),
    }
}

fn write(plate: &Plate, text: &str, arguments: &ExportFmuArgs) -> Result<(), FmuError> {
    let library = match &arguments.library {
        Some(library) => library.clone(),
        None => platebench_fmi::find_library(&std::env::current_exe().unwrap_or_default())?,
    };
    let title = arguments.plate.file_stem().unwrap_or_default().to_string_lossy();
    platebench_fmi::write(plate, text, &title, &library, Path::new(&arguments.out))
}
