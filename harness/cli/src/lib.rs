//! The bench on the command line: arguments, wiring, exit codes; nothing else.
//!
//! A library only so that the whole-bench tests can start the very same program as a process of their own.

mod accept;
mod args;
mod baseline;
mod chart;
mod check;
mod clock;
mod compare;
mod completions;
mod config;
mod desk;
mod emulate;
mod exit;
mod export;
mod guard;
mod identify;
mod live;
mod logging;
mod man;
mod new;
mod output;
mod plate_file;
mod play;
mod run;
mod schema;
mod signals;
mod stability;
mod stored;
mod told;
mod trust;
mod tune;
mod watch;

use args::{Arguments, Command};
use clap::CommandFactory;
use exit::Exit;
use std::process::ExitCode;

/// What can be said on the command line, for what is written down about it: the reference and what the documentation tells people to type.
pub fn command() -> clap::Command {
    Arguments::command()
}

/// The program: reads the process's arguments, does what they say and tells how it ended.
pub fn main() -> ExitCode {
    std::panic::set_hook(Box::new(|panic| tracing::error!("{panic}")));
    let (arguments, config) = match config::arguments() {
        Ok(found) => found,
        Err(exit) => return exit.into(),
    };
    logging::start(&arguments.logging);
    if let Some(path) = config {
        tracing::info!(path = %path.display(), "settings");
    }
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
        Command::New(arguments) => new::new(arguments),
        Command::Check(arguments) => check::check(arguments),
        Command::Schema(arguments) => schema::schema(arguments),
        Command::Completions(arguments) => completions::completions(arguments),
        Command::Man(arguments) => man::man(arguments),
    });
    let exit = exit.unwrap_or_else(|_| {
        output::error("the bench has a fault of its own, please report it; -v shows more");
        Exit::Inconclusive
    });
    output::ended(exit).into()
}
