//! Defines the command line and parses it.

#[cfg(feature = "export")]
use crate::campaign;
use crate::config::{self, Config};
use crate::logging::LoggingArgs;
use crate::{
    acceptance, baseline, board, build_info, check, color, compare, generate, identify, new, plate, replay, report,
    run, stability, suite, tune,
};
use clap::error::{ContextKind, ContextValue};
use clap::{CommandFactory, FromArgMatches, Parser, Subcommand};
use platebench_model::scenario::Diagnostic;

const EXIT_CODES: &str = "\
Examples:
  platebench new first-step             a commented scenario
  platebench check                      check scenarios without playing them
  platebench run --rig hosted           every scenario below scenarios/
  platebench COMMAND --help             examples for each command

The environment (PLATEBENCH_RIG, ...) and platebench.toml also set options: docs/configuration.md.

Exit codes:
  0  everything passed
  1  something failed
  2  wrong usage or invalid input
  3  nothing failed but something is inconclusive
  4  there was nothing to run
  5  the rig could not be reached or was lost
  129, 130, 131, 143  ended by a closed terminal, Ctrl-C, Ctrl-\\ or SIGTERM, with the plate at 0 V
  134, 152            the same, ended by SIGABRT or by the limit of computing time (SIGXCPU)";

/// A hardware-in-the-loop bench for controllers of an ultrasonic tactile plate.
#[derive(Debug, Parser)]
#[command(name = "platebench", version, after_help = EXIT_CODES)]
pub(crate) struct Arguments {
    #[command(subcommand)]
    pub(crate) command: Command,
    #[command(flatten)]
    pub(crate) logging: LoggingArgs,
}

#[derive(Debug, Subcommand)]
pub(crate) enum Command {
    /// Run scenarios and write a report
    Run(run::RunArgs),
    /// Write a commented scenario as a starting point
    New(new::NewArgs),
    /// Check scenarios, plates, plans and settings without playing them
    Check(check::CheckArgs),
    /// Render the report of a stored run again; judge, export or join stored runs
    Report(report::ReportArgs),
    /// Compare responses with other responses or with baselines, within a tolerance tube
    Compare(compare::CompareArgs),
    /// Golden traces: accept, list, diff, review
    Baseline(baseline::BaselineArgs),
    /// Send recorded samples to another firmware and compare its commands with the recorded ones
    /// (open loop)
    Replay(replay::ReplayArgs),
    /// Emulate the plate alone for another controller, or export it for other simulators
    Plate(plate::PlateArgs),
    /// Identify plate parameters from recorded steps
    Identify(identify::IdentifyArgs),
    /// Design controller gains for a plate, with their margins and limits
    Tune(tune::TuneArgs),
    /// Show where methods and loops become unstable: predicted and measured limits, margins, maps
    Stability(stability::StabilityArgs),
    /// Play a scenario with many values: sweeps and Monte Carlo, on one machine or many
    #[cfg(feature = "export")]
    Campaign(campaign::CampaignArgs),
    /// List the boards of a lab, end the quarantine of one, or play scenarios on one for hours
    Board(board::BoardCommandArgs),
    /// Conduct a lab acceptance session, or verify its record
    Acceptance(acceptance::AcceptanceArgs),
    /// Measure how well the scenarios find faults: mutants, coverage, exploration
    Suite(suite::SuiteArgs),
    /// Print JSON Schemas, shell completions or manual pages
    Generate(generate::GenerateArgs),
}

/// Parses the command line. Wrong usage and help end the process. Fails with the faults of
/// `platebench.toml`.
pub(crate) fn parse() -> Result<(Arguments, Config), Vec<Diagnostic>> {
    let words = std::env::args_os().map(|word| word.to_string_lossy().into_owned());
    let definition =
        Arguments::command().version(build_info::version()).color(color::choice_of_arguments(words).for_clap());
    let found = match std::env::current_dir() {
        Ok(folder) => Config::find_above(&folder, &definition),
        Err(_) => Ok(Config::default()),
    };
    let (config, faults) = match found {
        Ok(config) => (config, Vec::new()),
        Err(faults) => (Config::default(), faults),
    };
    // Faults of `platebench.toml` follow later, so that they do not hide help or wrong usage.
    let matches = config::with_settings(definition, &config).try_get_matches().unwrap_or_else(|error| {
        if let Some(variable) = variable_of(&error) {
            crate::stdio::note(&format!("the value comes from the environment variable {variable}"));
        }
        if let Some(feature) = missing_feature(&error) {
            crate::stdio::note(&format!(
                "this bench was built without the Cargo feature `{feature}`, which this command needs"
            ));
        }
        error.exit()
    });
    let arguments = Arguments::from_arg_matches(&matches).unwrap_or_else(|error| error.exit());
    color::set(arguments.logging.color);
    let needs_config = !matches!(arguments.command, Command::Generate(_));
    if needs_config && !faults.is_empty() { Err(faults) } else { Ok((arguments, config)) }
}

/// Returns the Cargo feature of the unknown command or option, if this build lacks the feature.
fn missing_feature(error: &clap::Error) -> Option<&'static str> {
    let name = [ContextKind::InvalidSubcommand, ContextKind::InvalidArg].into_iter().find_map(|kind| error.get(kind));
    let Some(ContextValue::String(name)) = name else { return None };
    let (feature, is_built) = match &**name {
        "coverage" | "mutate" => ("emulated", cfg!(feature = "emulated")),
        "campaign" | "fmu" | "--export" => ("export", cfg!(feature = "export")),
        _ => return None,
    };
    (!is_built).then_some(feature)
}

fn variable_of(error: &clap::Error) -> Option<&'static str> {
    let Some(ContextValue::String(option)) = error.get(ContextKind::InvalidArg) else { return None };
    let option = option.split_whitespace().next()?;
    let is_on_the_command_line = std::env::args().any(|word| word.split('=').next() == Some(option));
    let variable = config::variable_of_option(option)?;
    (!is_on_the_command_line && std::env::var_os(variable).is_some()).then_some(variable)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_definition_is_consistent() {
        Arguments::command().debug_assert();
    }

    #[test]
    fn every_command_shows_examples() {
        for command in Arguments::command().get_subcommands() {
            let help = command.get_after_help().map(ToString::to_string).unwrap_or_default();
            let call = format!("platebench {}", command.get_name());
            assert!(help.starts_with("Examples:\n") && help.contains(&call), "{}: {help}", command.get_name());
        }
    }
}
