//! Defines the command line, parses it, and calls the command.

#[cfg(feature = "export")]
use crate::campaign;
use crate::config::Config;
use crate::exit::{CommandResult, Exit, Failure, OrInvalid};
use crate::stdio::LoggingArgs;
use crate::{
    acceptance, baseline, board, check, compare, config, generate, identify, new, plate, replay, report, run,
    stability, stdio, suite, tune,
};
use clap::error::{ContextKind, ContextValue};
use clap::{CommandFactory, FromArgMatches, Parser, Subcommand};
use platebench_model::record::Tool;
use platebench_model::scenario::Diagnostic;
use std::path::Path;
use std::process::ExitCode;

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
    let row = |name: &&str| {
        let about = definition.find_subcommand(name)?.get_about()?;
        Some(format!("  {literal}{name:NAME_WIDTH$}{literal:#}  {about}\n"))
    };
    let groups = GROUPS.map(|(title, names)| {
        format!("\n{heading}{title}:{heading:#}\n{}", names.iter().filter_map(row).collect::<String>())
    });
    format!(
        "{{about-with-newline}}\n{{usage-heading}} {{usage}}\n{}\n{heading}Options:{heading:#}\n{{options}}{{after-help}}",
        groups.concat()
    )
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

/// Parses the command line. Wrong usage and help end the process. Fails with the problems of
/// `platebench.toml`.
fn parse() -> Result<(Arguments, Config), Vec<Diagnostic>> {
    let words: Vec<_> = std::env::args_os().collect();
    let texts = words.iter().map(|word| word.to_string_lossy().into_owned());
    let definition = Arguments::command().version(version()).color(stdio::color_of_arguments(texts).for_clap());
    let named = words.iter().map(|word| word.to_string_lossy().into_owned());
    let found = match (stdio::values_of_option("--config", named).last(), std::env::current_dir()) {
        (Some(file), _) => Config::read(Path::new(file), &definition),
        (None, Ok(folder)) => Config::find_above(&folder, &definition),
        (None, Err(_)) => Ok(Config::default()),
    };
    let (config, problems) = match found {
        Ok(config) => (config, Vec::new()),
        Err(problems) => (Config::default(), problems),
    };
    // Faults of `platebench.toml` follow later, so that they do not hide help or wrong usage.
    let matches = config::with_settings(definition, &config).try_get_matches_from(words).unwrap_or_else(|error| {
        if let Some(variable) = variable_of(&error) {
            crate::stdio::note(&format!("the value comes from the environment variable {variable}"));
        }
        if let Some(feature) = missing_feature(&error) {
            crate::stdio::note(&format!(
                "this bench was built without the Cargo feature `{feature}`, which this command needs; \
                 `cargo platebench-full` builds it with all features"
            ));
        }
        error.exit()
    });
    let arguments = Arguments::from_arg_matches(&matches).unwrap_or_else(|error| error.exit());
    stdio::set_color(arguments.logging.color);
    let needs_config = !matches!(arguments.command, Command::Generate(_));
    if needs_config && !problems.is_empty() { Err(problems) } else { Ok((arguments, config)) }
}

/// Returns the Cargo feature of the unknown command or option, if this build lacks the feature.
fn missing_feature(error: &clap::Error) -> Option<&'static str> {
    let name = [ContextKind::InvalidSubcommand, ContextKind::InvalidArg].into_iter().find_map(|kind| error.get(kind));
    let Some(ContextValue::String(name)) = name else { return None };
    let (feature, is_built) = match &**name {
        "coverage" | "mutate" => ("analysis", cfg!(feature = "analysis")),
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

/// Returns the command line for the generated reference and the documentation tests.
pub fn command() -> clap::Command {
    Arguments::command()
}

pub fn main() -> ExitCode {
    std::panic::set_hook(Box::new(|panic| tracing::error!("{panic}")));
    tool().set_running();
    match start() {
        // A panic is a fault of the bench, so the verdict on the controller is inconclusive.
        Ok(arguments) => {
            let result = std::panic::catch_unwind(|| dispatch(&arguments)).unwrap_or_else(|_| {
                let message = "internal fault of the bench; run again with -v and report what it prints";
                Err(Failure::new(Exit::Inconclusive, &message))
            });
            result.unwrap_or_else(Failure::report).checked().into()
        }
        Err(failure) => failure.report().into(),
    }
}

fn start() -> Result<Arguments, Failure> {
    let (arguments, config) = parse()?;
    stdio::start_log(&arguments.logging).or_invalid()?;
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

const COMMIT: &str = env!("PLATEBENCH_BUILD_COMMIT");
const PROFILE: &str = env!("PLATEBENCH_BUILD_PROFILE");
const FEATURES: &str = env!("PLATEBENCH_BUILD_FEATURES");

fn non_empty(text: &str) -> Option<String> {
    (!text.is_empty()).then(|| text.to_owned())
}

fn tool() -> Tool {
    Tool {
        name: "platebench".to_owned(),
        version: env!("CARGO_PKG_VERSION").to_owned(),
        commit: non_empty(COMMIT),
        profile: non_empty(PROFILE),
        features: FEATURES.split_whitespace().map(str::to_owned).collect(),
    }
}

fn version() -> String {
    let Tool { version, commit, profile, features, .. } = tool();
    let commit = commit.unwrap_or_else(|| "unknown".to_owned());
    let features = if features.is_empty() { "none".to_owned() } else { features.join(", ") };
    format!("{version} (commit {commit}, profile {}, features: {features})", profile.unwrap_or_default())
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::CommandFactory;

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
