//! Writes trials as scenarios that `platebench run` plays.

use crate::campaign::definition::Campaign;
use crate::campaign::draw::Trial;
use crate::campaign::error::CampaignError;
use platebench_model::trace::{AtPath, read_regular_file, write_atomically};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::{fs, io};
use toml::{Table, Value};

/// Largest plate or profile, as for the scenario that names it.
const MAX_INPUT_BYTES: u64 = 64 << 20;

const PLATES: &str = "plates";
const PROFILES: &str = "profiles";

pub(crate) fn file_name(trial: u64) -> String {
    format!("{trial}.toml")
}

/// Replaces the folder, or removes it if there are no trials.
pub(crate) fn write(folder: &Path, campaign: &Campaign, trials: &[Trial]) -> Result<(), CampaignError> {
    if folder.exists() {
        fs::remove_dir_all(folder).at(folder)?;
    }
    if trials.is_empty() {
        return Ok(());
    }
    for name in [PLATES, PROFILES] {
        let path = folder.join(name);
        fs::create_dir_all(&path).at(&path)?;
    }
    let mut copies = Copies { folder, source: source_folder(campaign), names: BTreeMap::new() };
    trials.iter().try_for_each(|trial| write_trial(folder, campaign, trial, &mut copies))?;
    let profiles = folder.join(PROFILES);
    // Removes the folder only if it is empty.
    let _ = fs::remove_dir(profiles);
    Ok(())
}

fn source_folder(campaign: &Campaign) -> PathBuf {
    let scenario = campaign.template.inputs().first().map(|input| input.path.clone()).unwrap_or_default();
    scenario.parent().map(Path::to_owned).unwrap_or_default()
}

fn write_trial(
    folder: &Path,
    campaign: &Campaign,
    trial: &Trial,
    copies: &mut Copies<'_>,
) -> Result<(), CampaignError> {
    let mut scenario = trial.tables.scenario.clone();
    scenario.insert("title".to_owned(), Value::String(campaign.title_of(trial)));
    if let Some(controller) = scenario.get_mut("controller").and_then(Value::as_table_mut) {
        copies.copy(controller, "design_plate", PLATES)?;
    }
    if let Some(plate) = &trial.tables.plate {
        let name = format!("{PLATES}/trial-{}.toml", trial.number);
        write_toml(&folder.join(&name), plate, "")?;
        scenario.insert("plate".to_owned(), Value::String(name));
    } else {
        copies.copy(&mut scenario, "plate", PLATES)?;
    }
    for profile in scenario.get_mut("profile").and_then(Value::as_table_mut).into_iter().flat_map(|all| all.iter_mut())
    {
        if let (_, Value::Table(shape)) = profile {
            copies.copy(shape, "csv", PROFILES)?;
        }
    }
    let comment = format!("# Written by platebench campaign: trial {} of {:?}.\n", trial.number, campaign.title);
    write_toml(&folder.join(file_name(trial.number)), &scenario, &comment)
}

fn write_toml(path: &Path, table: &Table, comment: &str) -> Result<(), CampaignError> {
    let text = toml::to_string(table).map_err(io::Error::other).at(path)?;
    Ok(write_atomically(path, format!("{comment}{text}").as_bytes()).at(path)?)
}

struct Copies<'a> {
    folder: &'a Path,
    source: PathBuf,
    /// Maps the path in the scenario to the path of the copy.
    names: BTreeMap<String, String>,
}

impl Copies<'_> {
    /// Copies the file that `key` names, if no copy exists, and changes its path in the table.
    fn copy(&mut self, table: &mut Table, key: &str, below: &str) -> Result<(), CampaignError> {
        let Some(Value::String(named)) = table.get_mut(key) else { return Ok(()) };
        if !self.names.contains_key(named) {
            let source = self.source.join(&*named);
            let file = source.file_name().unwrap_or_default().to_string_lossy();
            // Files in two folders may have the same name.
            let copy = format!("{below}/{}-{file}", self.names.len());
            let content = read_regular_file(&source, MAX_INPUT_BYTES).at(&source)?;
            let path = self.folder.join(&copy);
            write_atomically(&path, &content).at(&path)?;
            self.names.insert(named.clone(), copy);
        }
        if let Some(copy) = self.names.get(named) {
            named.clone_from(copy);
        }
        Ok(())
    }
}
