//! `platebench new`: a commented scenario to start from, which can be played as it stands.

use crate::exit::Exit;
use crate::output;
use clap::Args;
use platebench_wire::LawId;
use std::fs::{self, OpenOptions};
use std::io::{self, Write};
use std::path::{Path, PathBuf};

/// The paper's plate, for folders that have none.
const PLATE: &str = include_str!("../../../scenarios/plates/aluminium-198x138.toml");
const PLATE_FILE: &str = "plates/aluminium-198x138.toml";
const SCENARIOS: &str = "scenarios";
const TEMPLATE: &str = include_str!("new/scenario.toml");
/// How far up from a scenario its plate is looked for.
const FOLDERS_UP: usize = 4;

/// `platebench new`
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  platebench new first-step                 scenarios/first-step.toml, where there is a folder of scenarios, else first-step.toml
  platebench new mine/finger --law deadbeat mine/finger.toml
  platebench check scenarios/first-step.toml
  platebench run scenarios/first-step.toml

Exit codes: 0 written, 2 it is there already or cannot be written; nothing is ever overwritten")]
pub(crate) struct New {
    /// What it is called: a file name, with folders where wanted, .toml may be left out
    #[arg(default_value = "first-step")]
    name: String,
    /// Control law that it is for
    #[arg(long, value_name = "NAME", default_value = "dq-pi", value_parser = clap::builder::PossibleValuesParser::new(LawId::ALL.map(LawId::name)))]
    law: String,
}

/// Why there is no new scenario.
#[derive(Debug, thiserror::Error)]
enum NewError {
    #[error("{0:?}, expected a name for a file, without control characters")]
    Name(String),
    #[error("{} is there already, expected another name", .0.display())]
    Taken(PathBuf),
    #[error("{}: {source}", path.display())]
    Io { path: PathBuf, source: io::Error },
}

/// Writes a scenario, and the paper's plate where none is at hand.
pub(crate) fn new(arguments: &New) -> Exit {
    match written(Path::new(""), &arguments.name, &arguments.law) {
        Ok(files) => {
            let [scenario, ..] = &files[..] else { return Exit::Passed };
            for file in &files {
                output::show(&format!("{}\n", file.display()));
            }
            output::note(&format!("next: platebench run {}", scenario.display()));
            Exit::Passed
        }
        Err(error) => {
            output::error(&error.to_string());
            Exit::Invalid
        }
    }
}

/// The files that were written below `folder`, the scenario first.
fn written(folder: &Path, name: &str, law: &str) -> Result<Vec<PathBuf>, NewError> {
    let path = path_of(folder, name)?;
    let home = path.parent().unwrap_or(Path::new("")).to_owned();
    let title = path.file_stem().unwrap_or_default().to_string_lossy().replace(['-', '_'], " ");
    // The way up from a folder that is not there leads nowhere.
    fs::create_dir_all(if home.as_os_str().is_empty() { Path::new(".") } else { &home })
        .map_err(|source| NewError::Io { path: home.clone(), source })?;
    // The nearest plate upwards, by how it is called from there.
    let ups = (0..FOLDERS_UP).map(|count| "../".repeat(count));
    let up = ups.clone().find(|up| home.join(up).join(PLATE_FILE).is_file());
    let root = up.clone().unwrap_or_default();
    let schema = format!("{root}schema/scenario.json");
    let first = if home.join(&schema).is_file() { format!("#:schema {schema}\n") } else { String::new() };
    let text = TEMPLATE
        .replace("{plate}", &format!("{root}{PLATE_FILE}"))
        .replace("{law}", law)
        .replace("{laws}", &LawId::ALL.map(LawId::name).join(", "))
        .replace("{expect}", expected_of(law))
        // Last, because a title may hold anything.
        .replace("{title}", &toml::Value::from(title).to_string());
    let mut files = vec![put(path, &format!("{first}{text}"))?];
    if up.is_none() {
        // Its own schema is not beside it there.
        let plate = PLATE.strip_prefix("#:schema ../schema/plate.json\n").unwrap_or(PLATE);
        files.push(put(home.join(PLATE_FILE), plate)?);
    }
    Ok(files)
}

fn path_of(folder: &Path, name: &str) -> Result<PathBuf, NewError> {
    let wrong = || NewError::Name(name.to_owned());
    let stem = Path::new(name).file_name().ok_or_else(wrong)?.to_string_lossy().into_owned();
    if name.contains(char::is_control) || name.ends_with('/') || stem.trim_end_matches(".toml").trim().is_empty() {
        return Err(wrong());
    }
    let file = if Path::new(name).extension().is_some_and(|ending| ending == "toml") {
        name.to_owned()
    } else {
        format!("{name}.toml")
    };
    let bare = Path::new(&file).components().count() == 1;
    let scenarios = folder.join(SCENARIOS);
    Ok(if bare && scenarios.is_dir() { scenarios.join(file) } else { folder.join(file) })
}

/// Writes a file that was not there.
fn put(path: PathBuf, text: &str) -> Result<PathBuf, NewError> {
    let io = |source| NewError::Io { path: path.clone(), source };
    if let Some(folder) = path.parent().filter(|folder| !folder.as_os_str().is_empty()) {
        fs::create_dir_all(folder).map_err(io)?;
    }
    match OpenOptions::new().write(true).create_new(true).open(&path) {
        Ok(mut file) => file.write_all(text.as_bytes()).map_err(io)?,
        Err(error) if error.kind() == io::ErrorKind::AlreadyExists => return Err(NewError::Taken(path)),
        Err(error) => return Err(io(error)),
    }
    Ok(path)
}

/// What each law keeps to in the scenario as it is written, with room. Those that only follow the frequency, or only decide, come to rest later or not at all.
fn expected_of(law: &str) -> &'static str {
    match LawId::from_name(law) {
        Some(LawId::BangBang) => {
            "[[expect]]\nmetric = \"final_amplitude_um\"\nwithin = [1.0, 3.0]\n\n[[expect]]\nmetric = \"drive_peak_vpp\"\nat_most = 900.0"
        }
        Some(LawId::OpenLoop | LawId::FrequencyOnly | LawId::Pll) => {
            "[[expect]]\nmetric = \"settling_time_ms\"\nat_most = 30.0      # to within 5 % of the setpoint, for good\n\n\
             [[expect]]\nmetric = \"static_error_percent\"\nat_most = 5.0       # over the last third"
        }
        _ => {
            "[[expect]]\nmetric = \"settling_time_ms\"\nat_most = 5.0       # to within 5 % of the setpoint, for good\n\n\
             [[expect]]\nmetric = \"static_error_percent\"\nat_most = 0.5       # over the last third\n\n\
             [[expect]]\nmetric = \"overshoot_percent\"\nat_most = 20.0"
        }
    }
}

#[cfg(test)]
mod tests;
