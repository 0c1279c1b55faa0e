//! Defines the command line and parses it.

#[cfg(feature = "export")]
use crate::campaign;
use crate::config::{self, Config};
use crate::logging::LoggingArgs;
use crate::{
    acceptance, baseline, board, build_info, check, color, compare, generate, identify, new, plate, renamed_commands,
    replay, report, run, stability, suite, tune,
};
use clap::error::{ContextKind, ContextValue, ErrorKind};
use clap::{ArgMatches, CommandFactory, FromArgMatches, Parser, Subcommand};
use platebench_model::scenario::Diagnostic;
use std::ffi::OsString;

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

/// Groups of the commands in the help.
const GROUPS: [(&str, &[&str]); 5] = [
    ("Scenarios", &["run", "new", "check"]),
    ("Results", &["report", "compare", "baseline", "replay"]),
    ("Plate and controller", &["plate", "identify", "tune", "stability", "campaign"]),
    ("Lab and suite", &["board", "acceptance", "suite"]),
    ("Generate", &["generate"]),
];
const NAME_WIDTH: usize = 10;

/// A hardware-in-the-loop bench for controllers of an ultrasonic tactile plate.
#[derive(Debug, Parser)]
#[command(name = "platebench", version, after_help = EXIT_CODES)]
#[command(help_template = grouped_help(&Command::augment_subcommands(clap::Command::new("platebench"))))]
pub(crate) struct Arguments {
    #[command(subcommand)]
    pub(crate) command: Command,
    #[command(flatten)]
    pub(crate) logging: LoggingArgs,
}

/// Returns the template of the help, because clap has no headings for commands.
fn grouped_help(definition: &clap::Command) -> String {
    let styles = definition.get_styles();
    let [heading, literal] = [styles.get_header(), styles.get_literal()];
    let mut text = "{about-with-newline}\n{usage-heading} {usage}\n".to_owned();
    for (title, names) in GROUPS {
        text.push_str(&format!("\n{heading}{title}:{heading:#}\n"));
        for command in names.iter().filter_map(|name| definition.find_subcommand(name)) {
            let (name, about) = (command.get_name(), command.get_about().map(ToString::to_string).unwrap_or_default());
            text.push_str(&format!("  {literal}{name:NAME_WIDTH$}{literal:#}  {about}\n"));
        }
    }
    text + &format!("\n{heading}Options:{heading:#}\n{{options}}{{after-help}}")
}

#[derive(Debug, Subcommand)]
pub(crate) enum Command {
    /// Run scenarios and write a report
    Run(run::RunArgs),
    /// Write a commented scenario as a starting point
    New(new::NewArgs),
    /// Check scenarios, plates, plans and settings without playing them
    Check(check::CheckArgs),
    /// Render a stored run again; judge, export or join stored runs
    Report(report::ReportArgs),
    /// Compare responses with others or with baselines, within a tube
    Compare(compare::CompareArgs),
    /// Golden traces: accept, list, diff, review
    Baseline(baseline::BaselineArgs),
    /// Send recorded samples to another firmware, compare its commands
    Replay(replay::ReplayArgs),
    /// Emulate the plate for another controller, or export it as an FMU
    Plate(plate::PlateArgs),
    /// Identify plate parameters from recorded steps
    Identify(identify::IdentifyArgs),
    /// Design controller gains for a plate, with margins and limits
    Tune(tune::TuneArgs),
    /// Show where methods and loops become unstable: limits, margins
    Stability(stability::StabilityArgs),
    /// Play a scenario with many values: sweeps, Monte Carlo, search
    #[cfg(feature = "export")]
    Campaign(campaign::CampaignArgs),
    /// List boards, end a quarantine, or play scenarios for hours
    Board(board::BoardCommandArgs),
    /// Conduct a lab acceptance session, or verify its record
    Acceptance(acceptance::AcceptanceArgs),
    /// Measure how well the scenarios find faults, and explore
    Suite(suite::SuiteArgs),
    /// Print JSON Schemas, shell completions or manual pages
    Generate(generate::GenerateArgs),
}

/// Parses the command line. Wrong usage and help end the process. Fails with the faults of
/// `platebench.toml`.
pub(crate) fn parse() -> Result<(Arguments, Config), Vec<Diagnostic>> {
    let words: Vec<_> = std::env::args_os().collect();
    let texts = words.iter().map(|word| word.to_string_lossy().into_owned());
    let definition =
        Arguments::command().version(build_info::version()).color(color::choice_of_arguments(texts).for_clap());
    let found = match std::env::current_dir() {
        Ok(folder) => Config::find_above(&folder, &definition),
        Err(_) => Ok(Config::default()),
    };
    let (config, faults) = match found {
        Ok(config) => (config, Vec::new()),
        Err(faults) => (Config::default(), faults),
    };
    // Faults of `platebench.toml` follow later, so that they do not hide help or wrong usage.
    let matches = parse_words(&mut config::with_settings(definition, &config), words).unwrap_or_else(|error| {
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

/// Parses the command line. The error for a renamed command contains the new name.
pub(crate) fn parse_words(definition: &mut clap::Command, words: Vec<OsString>) -> Result<ArgMatches, clap::Error> {
    let texts: Vec<_> = words.iter().skip(1).map(|word| word.to_string_lossy().into_owned()).collect();
    let names: Vec<_> = definition.get_subcommands().map(|command| command.get_name().to_owned()).collect();
    definition.try_get_matches_from_mut(words).map_err(|error| {
        let is_unknown = matches!(error.kind(), ErrorKind::InvalidSubcommand | ErrorKind::UnknownArgument);
        match renamed_commands::message(&texts, |word| names.iter().any(|name| name == word)) {
            Some(message) if is_unknown => definition.error(ErrorKind::InvalidSubcommand, message),
            _ => error,
        }
    })
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

    fn check_examples(command: &clap::Command, call: &str) {
        let help = command.get_after_help().map(ToString::to_string).unwrap_or_default();
        assert!(help.starts_with("Examples:\n") && help.contains(call), "{call}: {help}");
    }

    #[test]
    fn every_command_shows_examples() {
        for command in Arguments::command().get_subcommands() {
            let call = format!("platebench {}", command.get_name());
            check_examples(command, &call);
            if ["plate", "board", "acceptance", "suite", "generate"].contains(&command.get_name()) {
                command
                    .get_subcommands()
                    .for_each(|below| check_examples(below, &format!("{call} {}", below.get_name())));
            }
        }
    }

    #[test]
    fn the_help_has_each_command_in_one_group() {
        let mut command = Arguments::command();
        let grouped: Vec<_> = GROUPS.iter().flat_map(|(_, names)| *names).copied().collect();
        let known: Vec<_> = command.get_subcommands().map(|command| command.get_name().to_owned()).collect();
        assert_eq!(grouped, known);
        assert_eq!(known.len(), 16);
        let help = command.render_help().to_string();
        for (title, names) in GROUPS {
            let from = help.split_once(&format!("\n{title}:\n")).unwrap_or_else(|| panic!("{title}: {help}")).1;
            let lines: Vec<_> = from.lines().take_while(|line| !line.is_empty()).collect();
            assert_eq!(lines.len(), names.len(), "{title}");
            for (line, name) in lines.iter().zip(names) {
                assert!(line.starts_with(&format!("  {name} ")) && line.len() <= 80, "{line}");
            }
        }
    }
}
