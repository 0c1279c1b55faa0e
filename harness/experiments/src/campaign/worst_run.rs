//! Plays the worst trials again as a run, whose report shows their responses.

use crate::campaign::definition::Campaign;
use crate::campaign::draw::Trial;
use crate::campaign::error::CampaignError;
use crate::campaign::play::PlayConfig;
use crate::campaign::row::Row;
use crate::campaign::scenario_files;
use crate::campaign::summary::Summary;
use crate::campaign::tally::MAX_WORST;
use platebench_engine::{Clock, Event, RunError, RunHooks, RunPlan, run};
use platebench_model::record::{KeepTraces, Overrides, RunFolder};
use platebench_model::scenario::load;
use platebench_report::page::{self, ReportPage, RowCache, scenario_anchor};
use platebench_rig::ConnectOptions;
use std::cmp::Ordering;
use std::collections::BTreeMap;
use std::path::Path;

const FOLDER: &str = "worst";
const RUN: &str = "run";
/// The report of this many trials has about 4 MB.
const MAX_TRIALS: usize = 500;
/// If more trials than this are played, no trace is stored.
const MAX_TRACES: usize = 2 * MAX_WORST;

/// Maps a trial number to a link to its response, relative to the campaign folder.
pub type ResponseLinks = BTreeMap<u64, String>;

/// Trials with the smallest margins, failing trials, and the worst of each cell; worst first.
pub fn worst_trials(summary: &Summary<'_>) -> Result<Vec<Trial>, CampaignError> {
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
    let trial = |(number, (_, row)): (u64, (f64, Option<&Row>))| match row {
        Some(row) => row.trial_in(campaign),
        None => campaign.trial(number),
    };
    trials.into_iter().take(MAX_TRIALS).map(trial).collect()
}

/// Writes the trials as scenarios to `worst`, and plays them if the rig is simulated.
pub fn play_worst(
    folder: &Path,
    campaign: &Campaign,
    trials: &[Trial],
    config: &PlayConfig,
) -> Result<ResponseLinks, CampaignError> {
    let scenario_folder = folder.join(FOLDER);
    scenario_files::write(&scenario_folder, campaign, trials)?;
    if trials.is_empty() || !config.rig.is_simulated() {
        return Ok(ResponseLinks::new());
    }
    let files = trials.iter().map(|trial| scenario_files::file_name(trial.number));
    let scenarios = files.map(|file| load(&scenario_folder.join(&file), &file)).collect::<Result<Vec<_>, _>>();
    let scenarios = scenarios.map_err(|fault| CampaignError::Files(vec![fault]))?;
    let clock = Clock::Lockstep { wire_time: false };
    let keep_traces = if trials.len() > MAX_TRACES { KeepTraces::None } else { KeepTraces::All };
    let overrides = Overrides { keep_traces, ..Overrides::default() };
    let plan = RunPlan::new(&config.rig, clock, config.jobs, scenarios, overrides);
    let run_folder = RunFolder::create(Some(&scenario_folder.join(RUN)))?;
    let options = ConnectOptions { cancel: config.cancel.clone(), ..ConnectOptions::default() };
    let mut rows = RowCache::default();
    let on_event = |event| {
        if let Event::TrialFinished { trial, rows: played, .. } = event {
            rows.add(&trial.trace, played);
        }
    };
    let hooks = RunHooks {
        cancel: config.cancel.clone(),
        on_event: Box::new(on_event),
        trials_with_rows: 1,
        ..RunHooks::default()
    };
    let record =
        run(&plan, &run_folder, &|| clock.connect(&config.rig, &options), hooks).map_err(|error| match error {
            RunError::Cancelled => CampaignError::Cancelled,
            error => CampaignError::Run(error),
        })?;
    ReportPage::new(&record, run_folder.path()).with_rows(rows).write(&run_folder.path().join(page::FILE))?;
    let link = |trial: &Trial| {
        let file = scenario_files::file_name(trial.number);
        let index = record.scenarios.iter().position(|scenario| scenario.file == file)?;
        Some((trial.number, format!("{FOLDER}/{RUN}/{}#{}", page::FILE, scenario_anchor(index))))
    };
    Ok(trials.iter().filter_map(link).collect())
}
