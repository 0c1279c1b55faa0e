//! `platebench.toml` and the environment: what an option is where the command line does not say it.
//!
//! Flags come before the environment, the environment before the file, the file before what is built in. clap holds that order: a setting's variable becomes
//! the `env` of its option and its value in the file the option's default, in every command that has the option.

use crate::args::{Arguments, Command as Chosen};
use crate::exit::Exit;
use crate::output;
use clap::error::{ContextKind, ContextValue};
use clap::{Command, CommandFactory, FromArgMatches};
use platebench_scenario::{Diagnostic, input, parse};
use schemars::JsonSchema;
use serde::Deserialize;
use std::path::{Path, PathBuf};

/// The file's name. The first one is taken that is found upwards from the working directory.
pub(crate) const FILE: &str = "platebench.toml";

/// `platebench.toml` as serde reads it: which keys and kinds there are. Values are taken by name, see [`SETTINGS`].
#[derive(Debug, Clone, Default, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub(crate) struct RawConfig {
    /// What the controller runs on, as `--rig`.
    #[schemars(length(min = 1))]
    rig: Option<String>,
    /// Trials or scenarios that are played at once, as `--jobs`.
    #[schemars(range(min = 1, max = 1024))]
    jobs: Option<i64>,
    /// What standard output shows, as `--format`.
    #[schemars(extend("enum" = ["human", "json"]))]
    format: Option<String>,
    /// Where baselines are, as `--baselines`, relative to this file.
    #[schemars(length(min = 1))]
    baselines: Option<String>,
    /// Scenario files and folders that are meant where none is named, relative to this file.
    #[schemars(length(min = 1))]
    scenarios: Option<Vec<String>>,
    /// Below which folder new run folders are made, as `--runs`, relative to this file.
    #[schemars(length(min = 1))]
    runs: Option<String>,
    /// The run folder, as `--out`, relative to this file; it has to be new for each run.
    #[schemars(length(min = 1))]
    out: Option<String>,
    /// Defaults of `platebench run` alone.
    run: RawRun,
}

/// `[run]`
#[derive(Debug, Clone, Default, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
struct RawRun {
    /// Control law, as `--law`.
    law: Option<String>,
    /// How much of the plate is modelled, as `--model`.
    model: Option<String>,
    /// How time passes for the plate, as `--clock`.
    #[schemars(extend("enum" = ["lockstep", "real-time"]))]
    clock: Option<String>,
    /// Plate seconds per wall second, as `--time-scale`.
    #[schemars(range(min = 0.001, max = 10.0))]
    time_scale: Option<f64>,
    /// Whose timer makes the control instants in real time, as `--pacing`.
    #[schemars(extend("enum" = ["bench", "target"]))]
    pacing: Option<String>,
    /// Trials of each scenario, as `--trials`.
    #[schemars(range(min = 1, max = 100_000))]
    trials: Option<i64>,
    /// Seed of each scenario's first trial, as `--seed`.
    #[schemars(range(min = 0))]
    seed: Option<i64>,
}

/// Something that can be set elsewhere than on the command line.
struct Setting {
    /// The option's field in the structures of `args.rs`.
    id: &'static str,
    /// Its variable; none for what is a list.
    variable: Option<&'static str>,
    /// Its key in the file.
    key: &'static str,
    /// Commands that it is for; every one that has the option where there are none.
    commands: &'static [&'static str],
    /// Relative to the file.
    is_path: bool,
}

const fn setting(
    id: &'static str,
    variable: &'static str,
    key: &'static str,
    commands: &'static [&'static str],
) -> Setting {
    Setting { id, variable: Some(variable), key, commands, is_path: false }
}

const fn path(
    id: &'static str,
    variable: &'static str,
    key: &'static str,
    commands: &'static [&'static str],
) -> Setting {
    Setting { id, variable: Some(variable), key, commands, is_path: true }
}

const RUN: &[&str] = &["run"];

/// All of them.
const SETTINGS: [Setting; 14] = [
    setting("rig", "PLATEBENCH_RIG", "rig", &[]),
    setting("jobs", "PLATEBENCH_JOBS", "jobs", &[]),
    setting("format", "PLATEBENCH_FORMAT", "format", &[]),
    path("baselines", "PLATEBENCH_BASELINES", "baselines", &[]),
    Setting { id: "scenarios", variable: None, key: "scenarios", commands: &["run", "trust", "check"], is_path: true },
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

/// A file that was read, and what it sets.
#[derive(Debug, Default)]
pub(crate) struct Config {
    /// The file; `None` where there is none.
    pub(crate) path: Option<PathBuf>,
    /// Values by the key of their setting.
    values: Vec<(&'static str, Vec<String>)>,
}

impl Config {
    /// Reads the file that holds in `folder`, the working directory.
    fn above(folder: &Path) -> Result<Self, Vec<Diagnostic>> {
        match folder.ancestors().map(|ancestor| ancestor.join(FILE)).find(|path| path.is_file()) {
            // In the working directory itself paths stay as they are written.
            Some(path) if path.parent() == Some(folder) => Self::read(Path::new(FILE)),
            Some(path) => Self::read(&path),
            None => Ok(Self::default()),
        }
    }

    /// Reads the file at `path`.
    ///
    /// # Errors
    /// Every [`Diagnostic`] of it.
    pub(crate) fn read(path: &Path) -> Result<Self, Vec<Diagnostic>> {
        let refused = |why: String| vec![Diagnostic::of_file(path, why)];
        let content = input::read(path).map_err(|error| refused(format!("cannot be read: {error}")))?;
        let text =
            String::from_utf8(content).map_err(|_| refused("not UTF-8, expected a text file in UTF-8".to_owned()))?;
        parse::<RawConfig>(path, &text)?;
        let document: toml::Table = parse(path, &text)?;
        let folder = path.parent().unwrap_or(Path::new(""));
        let mut faults = Vec::new();
        let mut values = Vec::new();
        for setting in &SETTINGS {
            let Some(written) = value_at(&document, setting.key) else { continue };
            for given in &written {
                if let Err(message) = setting.accepts(given) {
                    faults.push(Diagnostic::at_key(path, &text, setting.key, message));
                }
            }
            let placed = |text: String| if setting.is_path { folder.join(text).display().to_string() } else { text };
            values.push((setting.key, written.into_iter().map(placed).collect()));
        }
        if faults.is_empty() { Ok(Self { path: Some(path.to_owned()), values }) } else { Err(faults) }
    }

    fn value(&self, key: &str) -> Option<&[String]> {
        self.values.iter().find(|(known, _)| *known == key).map(|(_, values)| &values[..])
    }
}

impl Setting {
    /// Whether the option takes `text`; what it says where it does not.
    fn accepts(&self, text: &str) -> Result<(), String> {
        if self.is_path {
            return if text.is_empty() { Err("empty, expected a path".to_owned()) } else { Ok(()) };
        }
        let option = format!("--{}={text}", self.id.replace('_', "-"));
        match Arguments::command().try_get_matches_from(["platebench", "run", &option]) {
            Ok(_) => Ok(()),
            Err(error) => {
                let told = error.render().to_string();
                let told = told.lines().map(str::trim).take_while(|line| !line.is_empty());
                Err(told.collect::<Vec<_>>().join(" ").trim_start_matches("error: ").to_owned())
            }
        }
    }

    fn is_for(&self, command: &Command, name: &str) -> bool {
        (self.commands.is_empty() || self.commands.contains(&name))
            && command.get_arguments().any(|option| option.get_id() == self.id)
    }
}

/// What stands at a dotted key, as it would be said on the command line.
fn value_at(document: &toml::Table, key: &str) -> Option<Vec<String>> {
    let spoken = |value: &toml::Value| value.as_str().map_or_else(|| value.to_string(), str::to_owned);
    let value = match key.split_once('.') {
        Some((table, name)) => document.get(table)?.get(name)?,
        None => document.get(key)?,
    };
    Some(value.as_array().map_or_else(|| vec![spoken(value)], |values| values.iter().map(spoken).collect()))
}

/// The command line with the environment and `config` behind it.
pub(crate) fn command(config: &Config) -> Command {
    let command = Arguments::command();
    let names: Vec<_> = command.get_subcommands().map(|command| command.get_name().to_owned()).collect();
    names
        .into_iter()
        .fold(command, |command, name| command.mut_subcommand(&name, |command| with_settings(command, &name, config)))
}

/// `name` is that of the command at the top.
fn with_settings(command: Command, name: &str, config: &Config) -> Command {
    let command = SETTINGS.iter().fold(command, |command, setting| {
        if !setting.is_for(&command, name) {
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
    let names: Vec<_> = command.get_subcommands().map(|command| command.get_name().to_owned()).collect();
    names
        .into_iter()
        .fold(command, |command, below| command.mut_subcommand(below, |command| with_settings(command, name, config)))
}

/// The process's arguments, and the file that stood behind them. Ends the process where they are wrong or ask for help.
///
/// # Errors
/// How to end where the file is wrong; what is wrong has been shown.
pub(crate) fn arguments() -> Result<(Arguments, Option<PathBuf>), Exit> {
    let found = std::env::current_dir().map_or_else(|_| Ok(Config::default()), |folder| Config::above(&folder));
    let (config, faults) = match found {
        Ok(config) => (config, Vec::new()),
        Err(faults) => (Config::default(), faults),
    };
    // Help and wrong usage come first, so that they can be had whatever the file says.
    let matches = command(&config).try_get_matches().unwrap_or_else(|error| {
        if let Some(variable) = blamed(&error) {
            output::note(&format!(
                "that value is not from the command line but from the environment variable {variable}"
            ));
        }
        error.exit()
    });
    let arguments = Arguments::from_arg_matches(&matches).unwrap_or_else(|error| error.exit());
    let needs_it = !matches!(arguments.command, Chosen::Schema(_) | Chosen::Completions(_) | Chosen::Man(_));
    if needs_it && !faults.is_empty() {
        faults.iter().for_each(output::diagnostic);
        return Err(Exit::Invalid);
    }
    Ok((arguments, config.path))
}

/// The variable whose value clap refuses as that of an option which nobody gave.
fn blamed(error: &clap::Error) -> Option<&'static str> {
    let Some(ContextValue::String(option)) = error.get(ContextKind::InvalidArg) else { return None };
    let name = option.split_whitespace().next()?;
    let given = std::env::args().any(|word| word.split('=').next() == Some(name));
    let of = |setting: &&Setting| format!("--{}", setting.id.replace('_', "-")) == name;
    let variable = SETTINGS.iter().find(of)?.variable?;
    (!given && std::env::var_os(variable).is_some()).then_some(variable)
}

#[cfg(test)]
mod tests;
