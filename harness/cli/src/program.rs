//! Runs the program: parses arguments, calls the command, returns the exit code.

use crate::args::{Arguments, Command};
use crate::config::{self, Config};
use crate::exit::Exit;
use crate::failure::{CommandResult, Failure, OrInvalid};
use crate::{
    accept, args, baseline, boards, build_info, check, compare, completions, emulate, explore, identify, judge,
    logging, man, merge, new, replay, report, run, schema, soak, stability, stdio, trust, tune,
};
#[cfg(feature = "export")]
use crate::{campaign, export, export_fmu};
#[cfg(feature = "emulated")]
use crate::{coverage, mutate};
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
        Command::Emulate(arguments) => emulate::emulate(arguments),
        Command::Judge(arguments) => judge::judge(arguments, detail),
        Command::Report(arguments) => report::report(arguments),
        Command::Replay(arguments) => replay::replay(arguments),
        Command::Compare(arguments) => compare::compare(arguments),
        Command::Baseline(arguments) => baseline::baseline(arguments),
        Command::Trust(arguments) => trust::trust(arguments, detail),
        Command::Explore(arguments) => explore::explore(arguments, detail),
        #[cfg(feature = "emulated")]
        Command::Coverage(arguments) => coverage::coverage(arguments, detail),
        Command::Merge(arguments) => merge::merge(arguments, detail),
        Command::Soak(arguments) => soak::soak(arguments, detail),
        #[cfg(feature = "emulated")]
        Command::Mutate(arguments) => mutate::mutate(arguments, detail),
        Command::Boards(arguments) => boards::boards(arguments),
        #[cfg(feature = "export")]
        Command::Campaign(arguments) => campaign::campaign(arguments, quiet),
        Command::Stability(arguments) => stability::stability(arguments),
        Command::Identify(arguments) => identify::identify(arguments),
        Command::Accept(arguments) => accept::accept(arguments, quiet),
        Command::Tune(arguments) => tune::tune(arguments),
        #[cfg(feature = "export")]
        Command::Export(arguments) => export::export(arguments),
        #[cfg(feature = "export")]
        Command::ExportFmu(arguments) => export_fmu::export_fmu(arguments),
        Command::New(arguments) => new::new(arguments),
        Command::Check(arguments) => check::check(arguments, &command()),
        Command::Schema(arguments) => schema::schema(arguments),
        Command::Completions(arguments) => Ok(completions::completions(arguments, definition())),
        Command::Man(arguments) => man::man(arguments, definition()),
    }
}
