//! Finds the scenarios of a command, selects them by tags, names and the last run, and warns of
//! plates that no ultrasonic tactile plate resembles, such as a gain in a wrong unit.

use crate::exit::{Exit, Failure, OrInvalid};
use crate::stdio;
use clap::Args;
use platebench_document::format::count;
use platebench_model::quoted_path;
use platebench_model::record::{Assessment, RunRecord, newest_run, sha256};
use platebench_model::scenario::load::implausible_values;
use platebench_model::scenario::{FoundScenarios, Scenario, find, plate_warnings, suggestion};
use platebench_plate::Plate;
use platebench_report::Detail;
use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

/// Reports how many scenarios `only_if_named` excludes, for which reasons, and how to play them.
pub(crate) fn note_skipped(found: &FoundScenarios, detail: Detail) {
    if found.skipped.is_empty() || detail == Detail::Failures {
        return;
    }
    let mut reasons: BTreeMap<&str, usize> = BTreeMap::new();
    for reason in found.skipped.iter().filter_map(|scenario| scenario.only_if_named.as_deref()) {
        *reasons.entry(reason).or_default() += 1;
    }
    let mut reasons: Vec<_> = reasons.into_iter().collect();
    reasons.sort_by_key(|(_, number)| Reverse(*number));
    let reasons: Vec<_> = reasons.into_iter().map(|(reason, number)| format!("{reason} {number}")).collect();
    let names: Vec<_> = found.skipped.iter().map(|scenario| &*scenario.file).collect();
    let names = if detail == Detail::Tables { format!(": {}", names.join(", ")) } else { "; -v lists them".to_owned() };
    stdio::note(&format!(
        "{} with `only_if_named` skipped ({}); name a file or its folder to play it{names}",
        count(found.skipped.len(), "scenario"),
        reasons.join(", ")
    ));
}

pub(crate) fn check_not_empty(found: &FoundScenarios) -> Result<(), Failure> {
    if found.scenarios.is_empty() {
        return Err(nothing_to_run());
    }
    for folder in &found.empty_folders {
        Exit::NothingToRun.show_reason(&format!("{}: no scenario was found below this folder", folder.display()));
    }
    if found.empty_folders.is_empty() { Ok(()) } else { Err(Exit::NothingToRun.into()) }
}

pub(crate) fn nothing_to_run() -> Failure {
    Failure::new(
        Exit::NothingToRun,
        &"no scenario was found or selected, so there is nothing to run; name a scenario file or a folder with \
          scenarios",
    )
}

/// Loads the scenarios below `paths` that `tags` and `keep` select. Fails if no scenario remains.
pub(crate) fn find_scenarios(
    paths: &[PathBuf],
    tags: &ScenarioFilter,
    keep: impl Fn(&Scenario) -> bool,
    detail: Detail,
) -> Result<Vec<Scenario>, Failure> {
    let mut found = find(paths)?;
    note_skipped(&found, detail);
    tags.retain(&mut found.scenarios);
    found.scenarios.retain(keep);
    check_not_empty(&found)?;
    Ok(found.scenarios)
}

/// Keeps the scenarios that did not pass in the newest run below `runs`, also with `only_if_named`.
/// Fails if one of them exists no longer, because it would pass by its absence.
pub(crate) fn keep_last_failed(found: &mut FoundScenarios, runs: &Path) -> Result<(), Failure> {
    let newest = newest_run(runs).map_err(|error| {
        Failure::invalid(&format!(
            "--last-failed: {error}; this may be the newest run: remove its folder, or name the \
                                   scenarios"
        ))
    })?;
    let folder = newest.ok_or_else(|| {
        let message = format!("--last-failed: {} contains no run; --runs selects another folder", runs.display());
        Failure::invalid(&message)
    })?;
    let record = RunRecord::read(&folder).or_invalid()?;
    let assessment = Assessment::of(&record);
    let mut names: BTreeSet<&str> =
        assessment.not_passed().map(|scenario| record.original_file(scenario.file)).collect();
    if names.is_empty() {
        let state = if record.scenarios.is_empty() { "no scenario was played in" } else { "every scenario passed in" };
        let message = format!("{state} {}, so there is nothing to run", quoted_path(&folder));
        return Err(Failure::new(Exit::NothingToRun, &message));
    }
    found.scenarios.append(&mut found.skipped);
    found.scenarios.retain(|scenario| names.contains(scenario.file.as_str()));
    found.scenarios.sort_by(|a, b| a.file.cmp(&b.file));
    for scenario in &found.scenarios {
        names.remove(scenario.file.as_str());
    }
    let (not_named, gone): (Vec<_>, Vec<_>) = names.into_iter().partition(|name| find(&[PathBuf::from(name)]).is_ok());
    if !gone.is_empty() {
        let is = if gone.len() == 1 { "is" } else { "are" };
        let (names, folder) = (gone.join(", "), quoted_path(&folder));
        let message = format!(
            "--last-failed: {names} did not pass in {folder} and {is} not found; name the file if it was renamed or lies \
             elsewhere, or the scenarios to run if it was deleted"
        );
        return Err(Failure::invalid(&message));
    }
    for name in not_named {
        stdio::note(&format!("{name} did not pass in {}, but is not among the named scenarios", quoted_path(&folder)));
    }
    Ok(())
}

#[derive(Debug, Clone, Default, Args)]
pub(crate) struct ScenarioFilter {
    /// Only scenarios with this tag
    ///
    /// If given again, scenarios with any of the tags.
    #[arg(long = "tag", value_name = "TAG")]
    tags: Vec<String>,
    /// No scenarios with this tag, also if --tag selects them; may be given again
    #[arg(long = "not-tag", hide_short_help = true, value_name = "TAG")]
    excluded: Vec<String>,
    /// Only scenarios whose name contains this text
    ///
    /// If given again, any of the texts.
    #[arg(short = 'k', long = "filter", value_name = "TEXT")]
    texts: Vec<String>,
}

impl ScenarioFilter {
    pub(crate) fn is_empty(&self) -> bool {
        self.tags.is_empty() && self.excluded.is_empty() && self.texts.is_empty()
    }

    pub(crate) fn selects(&self, scenario: &Scenario) -> bool {
        let has_any = |tags: &[String]| tags.iter().any(|tag| scenario.tags.contains(tag));
        let is_named = self.texts.is_empty() || self.texts.iter().any(|text| name_contains(&scenario.file, text));
        is_named && (self.tags.is_empty() || has_any(&self.tags)) && !has_any(&self.excluded)
    }

    pub(crate) fn retain(&self, scenarios: &mut Vec<Scenario>) {
        if self.is_empty() {
            return;
        }
        self.report_unknown_tags(scenarios);
        self.report_unknown_texts(scenarios);
        scenarios.retain(|scenario| self.selects(scenario));
    }

    /// SHA-256 over the filters and the names and inputs of the selected scenarios.
    pub(crate) fn selection_digest(&self, scenarios: &[Scenario]) -> String {
        let sorted = |tags: &[String]| tags.iter().cloned().collect::<BTreeSet<_>>();
        let content = |scenario: &Scenario| {
            let inputs = scenario.inputs.iter().map(|input| sha256(&input.bytes));
            (scenario.file.clone(), inputs.collect::<Vec<_>>())
        };
        let scenarios: Vec<_> = scenarios.iter().map(content).collect();
        let all = (sorted(&self.tags), sorted(&self.excluded), scenarios);
        sha256(serde_json::to_string(&all).unwrap_or_default().as_bytes())
    }

    fn report_unknown_texts(&self, scenarios: &[Scenario]) {
        let is_unknown = |text: &&String| !scenarios.iter().any(|scenario| name_contains(&scenario.file, text));
        for text in self.texts.iter().filter(is_unknown) {
            let parts = scenarios.iter().flat_map(|scenario| scenario.name().split('/'));
            let hint = suggestion(text, parts);
            stdio::note(&format!("no scenario name contains `{text}`{hint}"));
        }
    }

    fn report_unknown_tags(&self, scenarios: &[Scenario]) {
        let known: BTreeSet<&str> = scenarios.iter().flat_map(|scenario| &scenario.tags).map(String::as_str).collect();
        for tag in self.tags.iter().chain(&self.excluded).filter(|tag| !known.contains(&***tag)) {
            let mut hint = suggestion(tag, known.iter().copied());
            if hint.is_empty() && !known.is_empty() {
                hint = format!("; known tags: {}", known.iter().copied().collect::<Vec<_>>().join(", "));
            }
            stdio::note(&format!("no scenario has the tag `{tag}`{hint}"));
        }
    }
}

/// Ignores upper and lower case.
fn name_contains(file: &str, text: &str) -> bool {
    file.to_lowercase().contains(&text.to_lowercase())
}

/// Many scenarios share a plate, so each warning is printed once.
pub(crate) fn warn_of_scenarios(scenarios: &[Scenario]) {
    let mut printed = BTreeSet::new();
    for warning in scenarios.iter().flat_map(plate_warnings) {
        if printed.insert(warning.message.clone()) {
            stdio::note(&format!("warning: {warning}"));
        }
    }
}

pub(crate) fn warn_of_plate(path: &Path, plate: &Plate) {
    for warning in implausible_values(path, plate).unwrap_or_default() {
        stdio::note(&format!("warning: {warning}"));
    }
}
