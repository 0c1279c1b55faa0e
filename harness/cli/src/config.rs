//! Takes options from the environment and from `platebench.toml`.
//!
//! Precedence: command line, environment, file, built-in default. clap implements this order: the
//! variable of a setting is the `env` of the option, and the value in the file is its default.

/// Name of the settings file. The nearest one applies, from the working directory upwards.
pub(crate) use platebench_model::scenario::SETTINGS_FILE as FILE;

use clap::Command;
use platebench_model::scenario::{Diagnostic, FileChecker, MAX_TRIALS, find_trusted_file_above};
use schemars::JsonSchema;
use serde::Deserialize;
use std::path::{Path, PathBuf};

/// Keys of `platebench.toml`.
// The type only checks the keys and the types of their values. `SETTINGS` reads the values.
#[derive(Debug, Clone, Default, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub(crate) struct RawConfig {
    /// The rig of the controller, as `--rig`.
    #[schemars(length(min = 1))]
    rig: Option<String>,
    /// Number of trials or scenarios that run at once, as `--jobs`.
    #[schemars(range(min = 1, max = 1024))]
    jobs: Option<i64>,
    /// Format of standard output, as `--format`.
    #[schemars(extend("enum" = ["human", "json"]))]
    format: Option<String>,
    /// Folder of the baselines, as `--baselines`, relative to this file.
    #[schemars(length(min = 1))]
    baselines: Option<String>,
    /// Default scenario files and folders, relative to this file.
    #[schemars(length(min = 1))]
    scenarios: Option<Vec<String>>,
    /// Parent folder of new run folders, as `--runs`, relative to this file.
    #[schemars(length(min = 1))]
    runs: Option<String>,
    /// The run folder, as `--out`, relative to this file; each run needs a new one.
    #[schemars(length(min = 1))]
    out: Option<String>,
    /// Defaults of `platebench run` only.
    run: RawRun,
}

#[derive(Debug, Clone, Default, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
struct RawRun {
    /// Control law, as `--law`.
    law: Option<String>,
    /// Model of the plate, as `--model`.
    model: Option<String>,
    /// The clock of the plate, as `--clock`.
    #[schemars(extend("enum" = ["lockstep", "real-time"]))]
    clock: Option<String>,
    /// Plate seconds per wall second, as `--time-scale`.
    #[schemars(range(min = 0.001, max = 10.0))]
    time_scale: Option<f64>,
    /// The timer of the control instants in real time, as `--pacing`.
    #[schemars(extend("enum" = ["bench", "target"]))]
    pacing: Option<String>,
    /// Trials of each scenario, as `--trials`.
    #[schemars(range(min = 1, max = MAX_TRIALS))]
    trials: Option<i64>,
    /// Seed of each scenario's first trial, as `--seed`.
    #[schemars(range(min = 0))]
    seed: Option<i64>,
}

struct Setting {
    /// Name of the field in the arguments of a command.
    id: &'static str,
    /// Environment variable of the setting. A setting with a list of values has none.
    variable: Option<&'static str>,
    key: &'static str,
    /// Commands that use the setting. If empty, all commands with the option use it.
    commands: CommandNames,
    /// True for a path. A relative path starts at the folder of the settings file.
    is_path: bool,
}

type CommandNames = &'static [&'static str];

const fn setting(id: &'static str, variable: &'static str, key: &'static str, commands: CommandNames) -> Setting {
    Setting { id, variable: Some(variable), key, commands, is_path: false }
}

const fn path(id: &'static str, variable: &'static str, key: &'static str, commands: CommandNames) -> Setting {
    Setting { is_path: true, ..setting(id, variable, key, commands) }
}

const RUN: CommandNames = &["run"];

const SETTINGS: [Setting; 14] = [
    setting("rig", "PLATEBENCH_RIG", "rig", &[]),
    setting("jobs", "PLATEBENCH_JOBS", "jobs", &[]),
    setting("format", "PLATEBENCH_FORMAT", "format", &[]),
    path("baselines", "PLATEBENCH_BASELINES", "baselines", &[]),
    Setting {
        id: "scenarios",
        variable: None,
        key: "scenarios",
        commands: &["run", "suite trust", "check"],
        is_path: true,
    },
    path("runs", "PLATEBENCH_RUNS", "runs", RUN),
    path("out", "PLATEBENCH_OUT", "out", RUN),
    setting("law", "PLATEBENCH_LAW", "run.law", RUN),
    setting("model", "PLATEBENCH_MODEL", "run.model", RUN),
    setting("clock", "PLATEBENCH_CLOCK", "run.clock", RUN),
    setting("time_scale", "PLATEBENCH_TIME_SCALE", "run.time_scale", RUN),
    setting("pacing", "PLATEBENCH_PACING", "run.pacing", RUN),
    setting("trials", "PLATEBENCH_TRIALS", "run.trials", RUN),
    setting("seed", "PLATEBENCH_SEED", "run.seed", RUN),
];

#[derive(Debug, Default)]
pub(crate) struct Config {
    pub(crate) path: Option<PathBuf>,
    values: Vec<(&'static str, Vec<String>)>,
}

impl Config {
    pub(crate) fn find_above(folder: &Path, definition: &Command) -> Result<Self, Vec<Diagnostic>> {
        let found = find_trusted_file_above(folder, FILE, "--config").map_err(|problem| vec![problem])?;
        found.map_or_else(|| Ok(Self::default()), |path| Self::read(&path, definition))
    }

    /// Reads the file. The command line `definition` checks the values. Fails with all problems.
    pub(crate) fn read(path: &Path, definition: &Command) -> Result<Self, Vec<Diagnostic>> {
        let (mut checker, _) = FileChecker::read::<RawConfig>(path)?;
        let document: toml::Table = checker.text().parse().unwrap_or_default();
        let mut values = Vec::new();
        for setting in &SETTINGS {
            let Some(written) = value_at(&document, setting.key) else { continue };
            for given in &written {
                if let Err(message) = setting.check(given, definition) {
                    checker.report(setting.key, message);
                }
            }
            let place = |text: String| checker.neighbour(text.as_ref()).display().to_string();
            let placed = |text: String| if setting.is_path { place(text) } else { text };
            values.push((setting.key, written.into_iter().map(placed).collect()));
        }
        checker.finish().map(|_| Self { path: Some(path.to_owned()), values })
    }

    fn value(&self, key: &str) -> Option<&[String]> {
        self.values.iter().find(|(known, _)| *known == key).map(|(_, values)| &values[..])
    }
}

impl Setting {
    /// Parses `text` as the value of the option of `platebench run`. Fails with the message of
    /// clap.
    fn check(&self, text: &str, definition: &Command) -> Result<(), String> {
        if self.is_path {
            return if text.is_empty() { Err(format!("`{}` is empty, expected a path", self.key)) } else { Ok(()) };
        }
        let option = format!("--{}={text}", self.id.replace('_', "-"));
        match definition.clone().try_get_matches_from(["platebench", "run", &option]) {
            Ok(_) => Ok(()),
            Err(error) => {
                let message = error.render().to_string();
                let lines = message.lines().map(str::trim).take_while(|line| !line.is_empty());
                Err(lines.collect::<Vec<_>>().join(" ").trim_start_matches("error: ").to_owned())
            }
        }
    }

    fn applies_to(&self, command: &Command, name: &str) -> bool {
        (self.commands.is_empty() || self.commands.contains(&name))
            && command.get_arguments().any(|option| option.get_id() == self.id)
    }
}

/// Returns the value of `key` as it would be typed on the command line.
fn value_at(document: &toml::Table, key: &str) -> Option<Vec<String>> {
    let word = |value: &toml::Value| value.as_str().map_or_else(|| value.to_string(), str::to_owned);
    let value = match key.split_once('.') {
        Some((table, name)) => document.get(table)?.get(name)?,
        None => document.get(key)?,
    };
    Some(value.as_array().map_or_else(|| vec![word(value)], |values| values.iter().map(word).collect()))
}

pub(crate) fn with_settings(command: Command, config: &Config) -> Command {
    subcommand_names(&command).into_iter().fold(command, |command, name| {
        command.mut_subcommand(&name, |command| with_settings_of(command, &name, config))
    })
}

fn subcommand_names(command: &Command) -> Vec<String> {
    command.get_subcommands().map(|command| command.get_name().to_owned()).collect()
}

/// `name` is the name of the command, after the names of the commands that contain it.
fn with_settings_of(command: Command, name: &str, config: &Config) -> Command {
    let command = SETTINGS.iter().fold(command, |command, setting| {
        if !setting.applies_to(&command, name) {
            return command;
        }
        command.mut_arg(setting.id, |option| {
            let option = match setting.variable {
                Some(variable) => option.env(variable),
                None => option,
            };
            match config.value(setting.key) {
                Some(values) => option.required(false).default_values(values.to_vec()),
                None => option,
            }
        })
    });
    subcommand_names(&command).into_iter().fold(command, |command, below| {
        let name = format!("{name} {below}");
        command.mut_subcommand(below, |command| with_settings_of(command, &name, config))
    })
}

pub(crate) fn variable_of_option(option: &str) -> Option<&'static str> {
    SETTINGS.iter().find(|setting| format!("--{}", setting.id.replace('_', "-")) == option)?.variable
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::command_line::{Arguments, Command};
    use crate::run::RunArgs;
    use clap::{CommandFactory, FromArgMatches};
    use platebench_model::scenario::Diagnostic;
    use std::fs;
    use std::path::{Path, PathBuf};
    use tempfile::{TempDir, tempdir};

    fn write_config(text: &str) -> TempDir {
        let folder = tempdir().unwrap();
        fs::write(folder.path().join(FILE), text).unwrap();
        folder
    }

    fn read_config(path: &Path) -> Result<Config, Vec<Diagnostic>> {
        Config::read(path, &Arguments::command())
    }

    fn parse_run(config: &Config, arguments: &[&str]) -> RunArgs {
        let matches =
            with_settings(Arguments::command(), config).get_matches_from([&["platebench", "run"], arguments].concat());
        match Arguments::from_arg_matches(&matches).unwrap().command {
            Command::Run(run) => run,
            other => panic!("{other:?}"),
        }
    }

    #[test]
    fn the_commands_are_consistent_with_and_without_a_file() {
        let folder = write_config(
            "rig = \"hosted\"\njobs = 1\nformat = \"json\"\nbaselines = \"b\"\nscenarios = [\"s\"]\n\
         runs = \"r\"\nout = \"o\"\n[run]\nlaw = \"dq-pi\"\nmodel = \"auto\"\nclock = \"lockstep\"\n\
         time_scale = 1.0\npacing = \"bench\"\ntrials = 1\nseed = 0\n",
        );
        let config = read_config(&folder.path().join(FILE)).unwrap();
        assert_eq!(config.values.len(), SETTINGS.len(), "one value per setting");
        with_settings(Arguments::command(), &config).debug_assert();
        with_settings(Arguments::command(), &Config::default()).debug_assert();
    }

    #[test]
    fn every_setting_is_an_option_and_in_the_help() {
        let help = with_settings(Arguments::command(), &Config::default())
            .find_subcommand_mut("run")
            .unwrap()
            .render_long_help()
            .to_string();
        for setting in &SETTINGS {
            let arguments = Arguments::command();
            let mut commands = vec![&arguments];
            while let Some(command) = commands.pop() {
                if command.get_arguments().any(|option| option.get_id() == setting.id) {
                    break;
                }
                assert!(!commands.is_empty() || command.has_subcommands(), "{} is no option", setting.id);
                commands.extend(command.get_subcommands());
            }
            if let Some(variable) = setting.variable.filter(|_| setting.id != "baselines") {
                assert!(help.contains(variable), "{variable}");
            }
        }
    }

    #[test]
    fn the_file_overrides_defaults_and_the_command_line_the_file() {
        let folder = write_config(
            "rig = \"hosted\"\njobs = 3\nruns = \"mine\"\nscenarios = [\"a\", \"b\"]\n\
         [run]\ntrials = 7\ntime_scale = 0.5\nlaw = \"deadbeat\"\n",
        );
        let config = read_config(&folder.path().join(FILE)).unwrap();
        let built_in = parse_run(&Config::default(), &[]);
        assert_eq!((built_in.rig.to_string().as_str(), built_in.jobs, built_in.trials), ("emulated", None, None));
        assert_eq!((built_in.runs, built_in.scenarios), (PathBuf::from("runs"), vec![PathBuf::from("scenarios")]));
        let from_file = parse_run(&config, &[]);
        assert_eq!(
            (from_file.rig.to_string().as_str(), from_file.jobs, from_file.trials),
            ("hosted", Some(3), Some(7))
        );
        assert_eq!((from_file.time_scale, from_file.law.as_deref()), (0.5, Some("deadbeat")));
        assert_eq!(from_file.runs, folder.path().join("mine"), "relative to the file");
        assert_eq!(from_file.scenarios, ["a", "b"].map(|name| folder.path().join(name)));
        let given = parse_run(
            &config,
            &["c", "--jobs", "4", "--runs", "r", "--rig", "exec:a {port}", "--trials", "1", "--time-scale", "1"],
        );
        assert_eq!(
            (given.rig.to_string().as_str(), given.jobs, given.trials, given.time_scale),
            ("exec:a {port}", Some(4), Some(1), 1.0)
        );
        assert_eq!((given.runs, given.scenarios), (PathBuf::from("r"), vec![PathBuf::from("c")]));
    }
}
