//! `platebench plate`: serves a plate to another controller, or exports it.

#[cfg(feature = "export")]
mod fmu;
mod serve;

use crate::failure::CommandResult;
use clap::{Args, Subcommand};

#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  platebench plate serve --port pty
  platebench plate fmu scenarios/plates/aluminium-198x138.toml --out plate.fmu")]
pub(crate) struct PlateArgs {
    #[command(subcommand)]
    action: PlateAction,
}

#[derive(Debug, Subcommand)]
enum PlateAction {
    /// Emulate the plate alone, in real time, for another controller
    Serve(serve::ServeArgs),
    /// Export a plate as an FMU (FMI 3.0) for other simulators
    #[cfg(feature = "export")]
    Fmu(fmu::FmuArgs),
}

pub(crate) fn plate(arguments: &PlateArgs) -> CommandResult {
    match &arguments.action {
        PlateAction::Serve(arguments) => serve::serve(arguments),
        #[cfg(feature = "export")]
        PlateAction::Fmu(arguments) => fmu::export(arguments),
    }
}
