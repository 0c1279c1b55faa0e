//! Writes trials as scenarios that `platebench run` plays, and plays the worst ones again as a run,
//! whose page shows their responses.

use crate::campaign::definition::Campaign;
use crate::campaign::draw::DrawnTrial;
use crate::campaign::error::CampaignError;
use crate::campaign::play::PlayConfig;
use crate::campaign::row::{MAX_WORST, TrialRow};
use crate::campaign::summary::Summary;
use platebench_engine::{Clock, Event, RunHooks, RunPlan, run};
use platebench_model::record::{KeepTraces, Overrides, RunFolder, RunRecord, ScenarioRecord};
use platebench_model::scenario::load;
use platebench_model::trace::{AtPath, OutputFolder, read_regular_file};
use platebench_rig::ConnectOptions;
use std::cmp::Ordering;
use std::collections::BTreeMap;
use std::io;
use std::path::{Path, PathBuf};
use toml::{Table, Value};

const FOLDER: &str = "worst";
const RUN: &str = "run";
/// The report of this many trials has about 4 MB.
const MAX_TRIALS: usize = 500;
/// If more trials than this are played, no trace is stored.
const MAX_TRACES: usize = 2 * MAX_WORST;

/// Maps a trial number to its response.
pub type ResponseLinks = BTreeMap<u64, Response>;

#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Response {
    /// Relative to the campaign folder.
    pub link: String,
    /// Why the trial did not pass.
    pub reason: Option<String>,
}

/// Trials with the smallest margins, failing trials, and the worst of each cell; worst first.
pub fn worst_trials(summary: &Summary<'_>) -> Result<Vec<DrawnTrial>, CampaignError> {
    let campaign = summary.campaign;
    let mut trials = BTreeMap::new();
    for row in summary.worst.iter().chain(&summary.failing) {
        trials.insert(row.trial, (row.margin(), Some(row)));
    }
    for cell in summary.cells.iter().filter(|cell| cell.trials > 0) {
        // A campaign with cells has no chains, so the number of the trial determines its values.
        trials.entry(cell.worst_trial).or_insert((cell.smallest_margin, None));
    }
    let mut trials: Vec<_> = trials.into_iter().collect();
    trials.sort_by(|(_, (a, _)), (_, (b, _))| a.partial_cmp(b).unwrap_or(Ordering::Equal));
    let trial = |(number, (_, row)): (u64, (f64, Option<&TrialRow>))| match row {
        Some(row) => row.trial_in(campaign),
        None => campaign.trial(number),
    };
    trials.into_iter().take(MAX_TRIALS).map(trial).collect()
}

/// Writes the trials as scenarios to `worst`, and plays them if the rig is simulated. Keeps the rows of one trial per
/// scenario for the page of the run.
pub fn play_worst(
    folder: &Path,
    campaign: &Campaign,
    trials: &[DrawnTrial],
    config: &PlayConfig,
    on_event: impl FnMut(Event),
) -> Result<Option<(RunRecord, RunFolder)>, CampaignError> {
    let scenario_folder = folder.join(FOLDER);
    write_scenarios(&OutputFolder::open(folder)?, FOLDER, campaign, trials)?;
    if trials.is_empty() || !config.rig.is_simulated() {
        return Ok(None);
    }
    let files = trials.iter().map(|trial| file_name(trial.number));
    let scenarios = files.map(|file| load(&scenario_folder.join(&file), &file)).collect::<Result<Vec<_>, _>>();
    let scenarios = scenarios.map_err(|problem| CampaignError::Files(vec![problem]))?;
    let clock = Clock::Lockstep { wire_time: false };
    let keep_traces = if trials.len() > MAX_TRACES { KeepTraces::None } else { KeepTraces::All };
    let overrides = Overrides { keep_traces, ..Overrides::default() };
    let plan = RunPlan::new(&config.rig, clock, config.jobs, scenarios, overrides);
    let run_folder = RunFolder::create(Some(&scenario_folder.join(RUN)))?;
    let options = ConnectOptions { cancel: config.cancel.clone(), ..ConnectOptions::default() };
    let hooks = RunHooks {
        cancel: config.cancel.clone(),
        on_event: Box::new(on_event),
        trials_with_rows: 1,
        ..RunHooks::default()
    };
    let record = run(&plan, &run_folder, &|| clock.connect(&config.rig, &options), hooks)?;
    Ok(Some((record, run_folder)))
}

/// `describe` returns the address of a scenario in the run folder, and why it did not pass.
pub fn response_links(
    trials: &[DrawnTrial],
    record: &RunRecord,
    describe: impl Fn(usize, &ScenarioRecord) -> (String, Option<String>),
) -> ResponseLinks {
    let link = |trial: &DrawnTrial| {
        let file = file_name(trial.number);
        let (index, scenario) = record.scenarios.iter().enumerate().find(|(_, scenario)| scenario.file == file)?;
        let (address, reason) = describe(index, scenario);
        Some((trial.number, Response { link: format!("{FOLDER}/{RUN}/{address}"), reason }))
    };
    trials.iter().filter_map(link).collect()
}

/// Largest plate or profile, as for the scenario that names it.
const MAX_INPUT_BYTES: u64 = 64 << 20;

const PLATES: &str = "plates";
const PROFILES: &str = "profiles";

fn file_name(trial: u64) -> String {
    format!("{trial}.toml")
}

/// Replaces the folder `name` of the campaign, or removes it if there are no trials.
pub(crate) fn write_scenarios(
    campaign_folder: &OutputFolder,
    name: &str,
    campaign: &Campaign,
    trials: &[DrawnTrial],
) -> Result<(), CampaignError> {
    if campaign_folder.path().join(name).symlink_metadata().is_ok() {
        campaign_folder.remove_folder(name)?;
    }
    if trials.is_empty() {
        return Ok(());
    }
    let folder = &campaign_folder.create_folder(name)?;
    folder.create_folder(PLATES)?;
    let mut copies = Copies { folder, source: source_folder(campaign), names: BTreeMap::new() };
    trials.iter().try_for_each(|trial| write_trial(folder, campaign, trial, &mut copies))
}

fn source_folder(campaign: &Campaign) -> PathBuf {
    let scenario = campaign.template.inputs().first().map(|input| input.path.clone()).unwrap_or_default();
    scenario.parent().map(Path::to_owned).unwrap_or_default()
}

fn write_trial(
    folder: &OutputFolder,
    campaign: &Campaign,
    trial: &DrawnTrial,
    copies: &mut Copies<'_>,
) -> Result<(), CampaignError> {
    let tables = campaign.tables(trial.seed, &trial.values).map_err(|problem| CampaignError::Files(vec![problem]))?;
    let mut scenario = campaign.template.scenario_table(&tables);
    scenario.insert("title".to_owned(), Value::String(campaign.title_of(trial)));
    if let Some(controller) = scenario.get_mut("controller").and_then(Value::as_table_mut) {
        copies.copy(controller, "design_plate", PLATES)?;
    }
    if let Some(plate) = &tables.plate {
        let name = format!("{PLATES}/trial-{}.toml", trial.number);
        write_toml(folder, &name, plate, "")?;
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
    write_toml(folder, &file_name(trial.number), &scenario, &comment)
}

fn write_toml(folder: &OutputFolder, name: &str, table: &Table, comment: &str) -> Result<(), CampaignError> {
    let text = toml::to_string(table).map_err(io::Error::other).at(&folder.path().join(name))?;
    Ok(folder.write(name, format!("{comment}{text}"))?)
}

struct Copies<'a> {
    folder: &'a OutputFolder,
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
            self.folder.write(&copy, &content)?;
            self.names.insert(named.clone(), copy);
        }
        if let Some(copy) = self.names.get(named) {
            named.clone_from(copy);
        }
        Ok(())
    }
}
