//! `platebench new`: writes a commented scenario that runs unchanged.

use crate::exit::{CommandResult, Exit, Failure, OrInvalid};
use crate::generate::SchemaKind;
use crate::options::law_names;
use crate::stdio;
use clap::Args;
use platebench_model::quoted_path;
use platebench_model::trace::{create_folder, write_new};
use platebench_wire::LawId;
use std::io;
use std::path::{Path, PathBuf};

const PLATE: &str = include_str!("../../../scenarios/plates/aluminium-198x138.toml");
const PLATE_FILE: &str = "plates/aluminium-198x138.toml";
const SCHEMA_FILE: &str = "schema/scenario.json";
const PLATE_SCHEMA_FILE: &str = "schema/plate.json";
const SCENARIOS: &str = "scenarios";
const TEMPLATE: &str = include_str!("new/scenario.toml");
/// Number of folders that the search for the plate file tries, from the scenario's folder upwards.
const MAX_SEARCHED_FOLDERS: usize = 4;

#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  platebench new first-step                 scenarios/first-step.toml; without a folder scenarios: first-step.toml
  platebench new mine/finger --law deadbeat mine/finger.toml
  platebench check scenarios/first-step.toml
  platebench run scenarios/first-step.toml                           the bench's own firmware
  platebench run scenarios/first-step.toml --rig emulated:firmware.elf   yours

Exit codes: 0 written, 2 the file exists or cannot be written; nothing is ever overwritten")]
pub(crate) struct NewArgs {
    /// File name, with or without folders and .toml
    #[arg(default_value = "first-step")]
    name: String,
    /// Control law
    #[arg(long, value_name = "NAME", default_value = "dq-pi", value_parser = law_names())]
    law: String,
}

pub(crate) fn new(arguments: &NewArgs) -> CommandResult {
    let files = write_files(Path::new(""), &arguments.name, &arguments.law)?;
    for file in &files {
        stdio::show(&format!("{}\n", quoted_path(file)));
    }
    if let Some(scenario) = files.first() {
        let next = format!("next: platebench run {} --rig emulated:FIRMWARE.elf", scenario.display());
        stdio::note(&format!("{next}; without --rig it tests the bench's own firmware"));
    }
    Ok(Exit::Passed)
}

/// Returns the paths of the written files; the first one is the scenario.
fn write_files(folder: &Path, name: &str, law: &str) -> Result<Vec<PathBuf>, Failure> {
    let path = scenario_path(folder, name)?;
    let home = path.parent().unwrap_or(Path::new("")).to_owned();
    let title = path.file_stem().unwrap_or_default().to_string_lossy().replace(['-', '_'], " ");
    // The search below uses paths with `..`, which need an existing folder.
    create_folder(&home).or_invalid_at(&home)?;
    let ups = (0..MAX_SEARCHED_FOLDERS).map(|count| "../".repeat(count));
    let up = ups.clone().find(|up| home.join(up).join(PLATE_FILE).is_file());
    let root = up.clone().unwrap_or_default();
    let schema = format!("{root}{SCHEMA_FILE}");
    let text = TEMPLATE
        .replace("{plate}", &format!("{root}{PLATE_FILE}"))
        .replace("{law}", law)
        .replace("{laws}", &platebench_engine::law_names().collect::<Vec<_>>().join(", "))
        .replace("{expect}", expectations_of_law(law))
        // The title is inserted last, because its text may look like a placeholder.
        .replace("{title}", &toml::Value::from(title).to_string());
    let mut files = vec![write_new_file(path, &format!("#:schema {schema}\n{text}"))?];
    if up.is_none() {
        files.push(write_new_file(home.join(PLATE_FILE), PLATE)?);
    }
    let mut schemas = vec![(schema, SchemaKind::Scenario)];
    if up.is_none() {
        schemas.push((PLATE_SCHEMA_FILE.to_owned(), SchemaKind::Plate));
    }
    for (file, kind) in schemas {
        // Editors read the schema. An existing one is kept; it may belong to another version.
        if !home.join(&file).exists() {
            files.push(write_new_file(home.join(&file), &kind.to_text().or_invalid()?)?);
        }
    }
    Ok(files)
}

fn scenario_path(folder: &Path, name: &str) -> Result<PathBuf, Failure> {
    let wrong = || Failure::invalid(&format!("{name:?} is not a file name, expected one without control characters"));
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

fn write_new_file(path: PathBuf, text: &str) -> Result<PathBuf, Failure> {
    if let Some(folder) = path.parent() {
        create_folder(folder).or_invalid_at(&path)?;
    }
    match write_new(&path, text.as_bytes()) {
        Err(error) if error.kind() == io::ErrorKind::AlreadyExists => {
            Err(Failure::invalid(&format!("{} exists already, expected another name", path.display())))
        }
        written => written.or_invalid_at(&path).map(|()| path),
    }
}

/// Laws without amplitude control settle late, so they get wider limits. Bang-bang never settles.
fn expectations_of_law(law: &str) -> &'static str {
    match LawId::from_name(law) {
        Some(LawId::BangBang) => {
            "[[expect]]\nmetric = \"final_amplitude_um\"\nwithin = [1.0, 3.0]\n\n\
             [[expect]]\nmetric = \"drive_peak_vpp\"\nat_most = 900.0"
        }
        Some(LawId::OpenLoop | LawId::FrequencyOnly | LawId::Pll) => {
            "[[expect]]\nmetric = \"settling_time_ms\"\nat_most = 30.0      # last entry into 5 % of the setpoint\n\n\
             [[expect]]\nmetric = \"static_error_percent\"\nat_most = 5.0       # over the last third"
        }
        _ => {
            "[[expect]]\nmetric = \"settling_time_ms\"\nat_most = 5.0       # last entry into 5 % of the setpoint\n\n\
             [[expect]]\nmetric = \"static_error_percent\"\nat_most = 0.5       # over the last third\n\n\
             [[expect]]\nmetric = \"overshoot_percent\"\nat_most = 20.0"
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use platebench_model::scenario::load_with_all_errors;
    use std::fs;
    use tempfile::tempdir;

    #[test]
    fn a_new_scenario_is_valid_for_every_law() {
        for law in platebench_engine::law_names() {
            let folder = tempdir().unwrap();
            let files = write_files(folder.path(), "mine", law).unwrap();
            let written =
                ["mine.toml", PLATE_FILE, SCHEMA_FILE, PLATE_SCHEMA_FILE].map(|file| folder.path().join(file));
            assert_eq!(files, written);
            let scenario =
                load_with_all_errors(&files[0], "mine.toml").unwrap_or_else(|faults| panic!("{law}: {faults:?}"));
            assert_eq!((scenario.controller.law.as_str(), scenario.title.as_str()), (law, "mine"));
        }
    }

    #[test]
    fn the_commented_keys_are_valid() {
        let folder = tempdir().unwrap();
        let files = write_files(folder.path(), "mine", "dq-pi").unwrap();
        let is_key = |line: &str| {
            let key = line.strip_prefix("# ").filter(|line| line.starts_with(char::is_lowercase));
            line.starts_with("# [") || key.is_some_and(|line| line.contains(" = "))
        };
        let text = fs::read_to_string(&files[0]).unwrap();
        let whole: Vec<_> = text.lines().map(|line| if is_key(line) { &line[2..] } else { line }).collect();
        assert!(whole.len() > 30 && whole.contains(&"[trials.spread]") && whole.contains(&"kind = \"drop\""));
        fs::write(&files[0], whole.join("\n")).unwrap();
        let scenario = load_with_all_errors(&files[0], "mine.toml").unwrap_or_else(|faults| panic!("{faults:?}"));
        assert_eq!((scenario.trials.count, scenario.faults.len()), (30, 1));
    }
}
