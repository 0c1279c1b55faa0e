//! Runs the program: parses arguments, calls the command, returns the exit code.

use crate::args::{Arguments, Command};
#[cfg(feature = "export")]
use crate::campaign;
use crate::config::{self, Config};
use crate::exit::Exit;
use crate::failure::{CommandResult, Failure, OrInvalid};
use crate::{
    acceptance, args, baseline, board, build_info, check, compare, generate, identify, logging, new, plate, replay,
    report, run, stability, stdio, suite, tune,
};
use clap::CommandFactory;
use std::process::ExitCode;

/// Returns the command line for the generated reference and the documentation tests.
pub fn command() -> clap::Command {
    Arguments::command()
}

pub fn main() -> ExitCode {
    std::panic::set_hook(Box::new(|panic| tracing::error!("{panic}")));
    build_info::tool().set_running();
    match start() {
        // A panic is a fault of the bench, so the verdict on the controller is inconclusive.
        Ok(arguments) => {
            let result = std::panic::catch_unwind(|| dispatch(&arguments)).unwrap_or_else(|_| {
                let message = "internal fault of the bench; run again with -v and report what it prints";
                Err(Failure::new(Exit::Inconclusive, &message))
            });
            stdio::checked_exit(result.unwrap_or_else(Failure::report)).into()
        }
        Err(failure) => failure.report().into(),
    }
}

fn start() -> Result<Arguments, Failure> {
    let (arguments, config) = args::parse()?;
    logging::start(&arguments.logging).or_invalid()?;
    if let Some(path) = &config.path {
        tracing::info!(path = %path.display(), "settings");
    }
    Ok(arguments)
}

fn dispatch(arguments: &Arguments) -> CommandResult {
    let (quiet, detail) = (arguments.logging.quiet, arguments.logging.detail());
    // Without `platebench.toml`, because its values are valid only in this folder. Completions and
    // manual pages are for all folders.
    let definition = || config::with_settings(command(), &Config::default());
    match &arguments.command {
        Command::Run(arguments) => run::run(arguments, detail),
        Command::New(arguments) => new::new(arguments),
        Command::Check(arguments) => check::check(arguments, &command()),
        Command::Report(arguments) => report::report(arguments, detail),
        Command::Compare(arguments) => compare::compare(arguments),
        Command::Baseline(arguments) => baseline::baseline(arguments),
        Command::Replay(arguments) => replay::replay(arguments),
        Command::Plate(arguments) => plate::plate(arguments),
        Command::Identify(arguments) => identify::identify(arguments),
        Command::Tune(arguments) => tune::tune(arguments),
        Command::Stability(arguments) => stability::stability(arguments),
        #[cfg(feature = "export")]
        Command::Campaign(arguments) => campaign::campaign(arguments, quiet),
        Command::Board(arguments) => board::board(arguments, detail),
        Command::Acceptance(arguments) => acceptance::acceptance(arguments, quiet),
        Command::Suite(arguments) => suite::suite(arguments, detail),
        Command::Generate(arguments) => generate::generate(arguments, definition),
    }
}
