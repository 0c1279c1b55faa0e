//! The bench on the command line: arguments, wiring, exit codes; nothing else.
//!
//! A library only so that the whole-bench tests can start the very same program as a process of their own.

mod accept;
mod args;
mod baseline;
mod chart;
mod compare;
mod desk;
mod emulate;
mod exit;
mod export;
mod identify;
mod live;
mod logging;
mod output;
mod plate_file;
mod run;
mod signals;
mod stability;
mod stored;
mod told;
mod trust;
mod tune;

use args::{Arguments, Command};
use clap::{CommandFactory, Parser};
use exit::Exit;
use std::process::ExitCode;

/// What can be said on the command line, for what is written down about it: the reference and what the documentation tells people to type.
pub fn command() -> clap::Command {
    Arguments::command()
}

/// The program: reads the process's arguments, does what they say and tells how it ended.
pub fn main() -> ExitCode {
    std::panic::set_hook(Box::new(|panic| tracing::error!("{panic}")));
    let arguments = Arguments::parse();
    logging::start(&arguments.logging);
    // A panic is a fault of the bench: nothing was shown, so nothing passes and nothing fails.
    let exit = std::panic::catch_unwind(|| match &arguments.command {
        Command::Run(run) => run::run(run, arguments.logging.quiet),
        Command::Emulate(emulate) => emulate::emulate(emulate),
        Command::Judge(judge) => stored::judge(judge),
        Command::Report(report) => stored::report(report),
        Command::Compare(arguments) => compare::compare(arguments),
        Command::Baseline(arguments) => baseline::baseline(arguments),
        Command::Trust(arguments) => trust::trust(arguments),
        Command::Stability(arguments) => stability::stability(arguments),
        Command::Identify(arguments) => identify::identify(arguments),
        Command::Chart(arguments) => chart::chart(arguments),
        Command::Accept(accept) => accept::accept(accept, arguments.logging.quiet),
        Command::Tune(arguments) => tune::tune(arguments),
        Command::Export(arguments) => export::export(arguments),
    });
    exit.unwrap_or_else(|_| {
        output::error("the bench has a fault of its own, please report it; -v shows more");
        Exit::Inconclusive
    })
    .into()
}
