//! Joins the runs of shards and boards into one run folder. Compares
//! the means of the metrics of several boards.

use platebench_engine::rejudge::check_trace;
use platebench_engine::{RejudgeError, rejudge};
use platebench_model::record::{
    BoardDifference, FORMAT, FolderError, Host, MergeRecord, MergedRun, MergedScenario, MissingShard, NotApplicable,
    Overrides, RigRecord, RunFolder, RunRecord, ScenarioRecord, Tool, TrialJournal, Verdict, utc_timestamp,
};
use platebench_model::trace::{AtPath as _, open_regular_file};
use platebench_verdict::statistics::SampleSummary;
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

#[derive(Debug, thiserror::Error)]
pub enum MergeError {
    #[error(transparent)]
    Stored(#[from] RejudgeError),
    #[error(transparent)]
    Folder(#[from] FolderError),
    #[error("{}: is a run that `platebench report --merge` wrote; name the runs that it was made of", .0.display())]
    AlreadyMerged(PathBuf),
    #[error(
        "{}: is shard {shard} and does not record the selection that it is a part of; run the shard again",
        run.display()
    )]
    NoSelection { run: PathBuf, shard: usize },
    #[error(
        "{}: {what} is {found}, but {expected} in {}; only runs with the same value can be joined",
        run.display(), first.display()
    )]
    Different { run: PathBuf, first: PathBuf, what: &'static str, found: String, expected: String },
    #[error(
        "{}: trial {trial} of {scenario} on {board} (seed {seed}) is also in {}, expected each trial once",
        run.display(), first.display()
    )]
    SameTrial { run: PathBuf, first: PathBuf, scenario: String, board: String, trial: u32, seed: u64 },
}

struct StoredRun {
    folder: PathBuf,
    record: RunRecord,
    /// Name of the board, or the kind of the rig if the run names no board.
    board: String,
    /// Folder of this run's scenarios in the joined run, unique for a board and a scenario.
    place: String,
}

pub fn merge_runs(folders: &[PathBuf], out: &RunFolder) -> Result<RunRecord, MergeError> {
    let runs = read_runs(folders)?;
    check_trials(&runs)?;
    let places: BTreeSet<_> = runs.iter().map(|run| run.place.as_str()).collect();
    let mut record = joined_head(&runs, out);
    let mut journal = TrialJournal::create(out.output()).map_err(FolderError::from)?;
    let mut merge = MergeRecord { missing_shards: missing_shards(&runs), ..MergeRecord::default() };
    for (number, run) in runs.iter().enumerate() {
        let prefix = if places.len() > 1 { format!("{}/", run.place) } else { String::new() };
        let mut files = Vec::new();
        for scenario in &run.record.scenarios {
            let joined = copy_scenario(run, scenario, &prefix, number, out)?;
            for trial in &joined.trials {
                let place = record.scenarios.len();
                journal.append(place, &joined, &run.record.rig, trial).map_err(FolderError::from)?;
            }
            files.push(MergedScenario { file: joined.file.clone(), original: scenario.file.clone() });
            record.scenarios.push(joined);
        }
        let skipped = run.record.not_applicable.iter().cloned();
        let named = skipped.map(|skipped| NotApplicable { file: format!("{prefix}{}", skipped.file), ..skipped });
        record.not_applicable.extend(named);
        let RunRecord { started, verdict, complete, rig, overrides, tool, host, .. } = run.record.clone();
        let (board, folder) = (run.board.clone(), run.folder.display().to_string());
        merge.runs.push(MergedRun {
            board,
            folder,
            started,
            verdict,
            complete,
            rig,
            overrides,
            tool,
            host,
            scenarios: files,
        });
    }
    merge.differences = differences(&merge, &record.scenarios);
    record.merge = Some(merge);
    record.journal = Some(journal.finished().map_err(FolderError::from)?);
    record.update_verdict();
    record.write(out.path()).at(out.path()).map_err(FolderError::from)?;
    Ok(record)
}

fn read_runs(folders: &[PathBuf]) -> Result<Vec<StoredRun>, MergeError> {
    let mut runs: Vec<StoredRun> = Vec::new();
    let mut kinds: BTreeMap<String, Vec<String>> = BTreeMap::new();
    for folder in folders {
        if RunRecord::read(folder).map_err(RejudgeError::from)?.merge.is_some() {
            return Err(MergeError::AlreadyMerged(folder.clone()));
        }
        let record = rejudge(folder, None)?;
        let rig = record.rig.name.clone();
        let board = record.overrides.board.clone().unwrap_or_else(|| {
            let names = kinds.entry(record.rig.kind().to_owned()).or_default();
            let known = names.iter().position(|name| *name == rig);
            let number = known.unwrap_or_else(|| {
                names.push(rig.clone());
                names.len() - 1
            });
            if number == 0 { record.rig.kind().to_owned() } else { format!("{}-{}", record.rig.kind(), number + 1) }
        });
        let place = free_place(&runs, &board, &record);
        let different = |first: &StoredRun, what, found: &dyn ToString, expected: &dyn ToString| {
            let (run, first) = (folder.clone(), first.folder.clone());
            Err(MergeError::Different { run, first, what, found: found.to_string(), expected: expected.to_string() })
        };
        if let Some(first) = runs.first().filter(|first| first.record.clock != record.clock) {
            return different(first, "the clock", &record.clock, &first.record.clock);
        }
        if let Some([shard, _]) = record.overrides.shard {
            let Some(selection) = &record.overrides.selection else {
                return Err(MergeError::NoSelection { run: folder.clone(), shard });
            };
            let selections = runs.iter().filter_map(|run| Some((run, run.record.overrides.selection.as_ref()?)));
            if let Some((first, expected)) = selections.into_iter().find(|(_, other)| *other != selection) {
                return different(first, "the selection of scenarios (SHA-256)", selection, expected);
            }
            let options = shared_options(&record.overrides);
            let others = runs.iter().filter(|run| run.record.overrides.shard.is_some());
            let others = others.map(|run| (run, shared_options(&run.record.overrides)));
            if let Some((first, expected)) = others.into_iter().find(|(_, other)| *other != options) {
                return different(first, "the set of options of the shard", &options, &expected);
            }
            let shards = runs.iter().filter(|run| run.record.overrides.shard.is_some());
            let others = shards.filter(|run| !are_different_boards(&run.record.overrides, &record.overrides));
            if let Some(first) = others.into_iter().find(|run| !run.record.rig.has_same_controller(&record.rig)) {
                let [found, expected] = [&record.rig, &first.record.rig].map(RigRecord::describe_controller);
                return different(first, "the controller of the shard", &found, &expected);
            }
        }
        runs.push(StoredRun { folder: folder.clone(), record, board, place });
    }
    Ok(runs)
}

/// Only boards that are named may have different firmware.
fn are_different_boards(one: &Overrides, other: &Overrides) -> bool {
    one.board.is_some() && other.board.is_some() && one.board != other.board
}

/// Options that all shards of a run have in common.
fn shared_options(overrides: &Overrides) -> String {
    let Overrides { law, trials, seed, model, wire_time, long_scripts, .. } = overrides;
    let options = [
        law.as_ref().map(|law| format!("--law {law}")),
        trials.map(|trials| format!("--trials {trials}")),
        seed.map(|seed| format!("--seed {seed}")),
        model.as_ref().map(|model| format!("--model {model}")),
        wire_time.then(|| "--wire-time".to_owned()),
        long_scripts.then(|| "--long-scripts".to_owned()),
    ];
    let options: Vec<_> = options.into_iter().flatten().collect();
    if options.is_empty() { "none".to_owned() } else { options.join(" ") }
}

/// Returns the name of the board, with a number if an earlier run has one of the scenarios there.
fn free_place(runs: &[StoredRun], board: &str, record: &RunRecord) -> String {
    let is_used = |place: &str| {
        let there = runs.iter().filter(|run| run.place == place).flat_map(|run| &run.record.scenarios);
        there.into_iter().any(|used| record.scenarios.iter().any(|scenario| scenario.file == used.file))
    };
    let names = (2..).map(|number| format!("{board}-{number}"));
    std::iter::once(board.to_owned()).chain(names).find(|place| !is_used(place)).unwrap_or_else(|| board.to_owned())
}

fn check_trials(runs: &[StoredRun]) -> Result<(), MergeError> {
    let mut known = BTreeMap::new();
    for run in runs {
        for scenario in &run.record.scenarios {
            let content: Vec<_> = scenario.inputs.iter().map(|input| input.sha256.as_str()).collect();
            for trial in &scenario.trials {
                let key = (&run.board, &scenario.file, &scenario.law, content.clone(), trial.seed);
                if let Some(first) = known.insert(key, &run.folder) {
                    return Err(MergeError::SameTrial {
                        run: run.folder.clone(),
                        first: first.clone(),
                        scenario: scenario.file.clone(),
                        board: run.board.clone(),
                        trial: trial.index,
                        seed: trial.seed,
                    });
                }
            }
        }
    }
    Ok(())
}

/// If no two boards played the same shard, all boards share one set of shards. Otherwise each board
/// needs its own complete set.
fn missing_shards(runs: &[StoredRun]) -> Vec<MissingShard> {
    let mut present: BTreeMap<usize, BTreeMap<&str, BTreeSet<usize>>> = BTreeMap::new();
    for run in runs {
        if let Some([shard, shards]) = run.record.overrides.shard {
            present.entry(shards).or_default().entry(&run.board).or_default().insert(shard);
        }
    }
    let mut missing = Vec::new();
    for (shards, boards) in present {
        let all: BTreeSet<usize> = boards.values().flatten().copied().collect();
        let is_shared = boards.values().map(BTreeSet::len).sum::<usize>() == all.len();
        let names = boards.keys().copied().collect::<Vec<_>>().join(", ");
        let sets = if is_shared {
            vec![(names, all)]
        } else {
            boards.into_iter().map(|(board, present)| (board.to_owned(), present)).collect()
        };
        for (board, present) in sets {
            let absent = (1..=shards).filter(|shard| !present.contains(shard));
            missing.extend(absent.map(|shard| MissingShard { board: board.clone(), shard, shards }));
        }
    }
    missing
}

fn joined_head(runs: &[StoredRun], out: &RunFolder) -> RunRecord {
    let all = || runs.iter().map(|run| &run.record);
    let common = |run: &RunRecord| Overrides { board: None, shard: None, selection: None, ..run.overrides.clone() };
    let first = all().next();
    let is_common = first.is_some_and(|first| all().all(|run| common(run) == common(first)));
    let require_all = all().any(|run| run.overrides.require_all);
    let different = Overrides { require_all, ..Overrides::default() };
    let boards: BTreeSet<_> = runs.iter().map(|run| run.board.as_str()).collect();
    let one_rig = first.filter(|first| all().all(|run| run.rig == first.rig)).map(|first| first.rig.clone());
    let names = boards.into_iter().collect::<Vec<_>>().join(", ");
    let confirmed = all().map(|run| run.safe_confirmed);
    RunRecord {
        format: FORMAT,
        sequence: out.sequence(),
        verdict: Verdict::Inconclusive,
        complete: all().all(|run| run.complete),
        tool: Tool::running(),
        started: if runs.is_empty() { utc_timestamp() } else { out.started() },
        rig: one_rig.unwrap_or_else(|| RigRecord {
            name: names,
            firmware: None,
            program_sha256: None,
            bench_firmware: all().all(|run| run.rig.bench_firmware),
        }),
        clock: first.map_or(platebench_model::record::ClockKind::Lockstep, |first| first.clock),
        overrides: if is_common { first.map(common).unwrap_or_default() } else { different },
        host: Host::current(),
        drive_after_safe: all().any(|run| run.drive_after_safe),
        safe_confirmed: confirmed.reduce(|all, one| Some(all? && one?)).flatten(),
        wall_ms: all().map(|run| run.wall_ms).sum(),
        scenarios: Vec::new(),
        not_applicable: Vec::new(),
        cost: Vec::new(),
        merge: None,
        journal: None,
    }
}

/// Copies inputs and traces. Fails if the hash of a trace differs from the record.
fn copy_scenario(
    run: &StoredRun,
    scenario: &ScenarioRecord,
    prefix: &str,
    number: usize,
    out: &RunFolder,
) -> Result<ScenarioRecord, MergeError> {
    let mut joined = ScenarioRecord { file: format!("{prefix}{}", scenario.file), ..scenario.clone() };
    for input in &mut joined.inputs {
        let below = input.file.strip_prefix("inputs/").unwrap_or(&input.file);
        let target = format!("inputs/run-{}/{below}", number + 1);
        copy(&run.folder.join(&input.file), &target, out)?;
        input.file = target;
    }
    for trial in &mut joined.trials {
        let below = trial.trace.strip_prefix("traces/").unwrap_or(&trial.trace);
        let target = format!("traces/{prefix}{below}");
        let source = run.folder.join(&trial.trace);
        if trial.sha256.is_some() || source.is_file() {
            check_trace(&run.folder, trial)?;
            copy(&source, &target, out)?;
        }
        trial.trace = target;
    }
    Ok(joined)
}

fn copy(from: &Path, to: &str, out: &RunFolder) -> Result<(), FolderError> {
    let mut source = open_regular_file(from, u64::MAX).at(from)?;
    Ok(out.output().copy(source.get_mut(), to)?)
}

const CONFIDENCE: f64 = 0.95;
/// One-sided confidence at each end of the interval, 0.975.
const ONE_SIDED: f64 = f64::midpoint(1.0, CONFIDENCE);

/// Compares each board with the first board that played the scenario.
pub(crate) fn differences(merge: &MergeRecord, scenarios: &[ScenarioRecord]) -> Vec<BoardDifference> {
    let mut boards: BTreeMap<&str, Vec<(&str, &ScenarioRecord)>> = BTreeMap::new();
    for run in &merge.runs {
        for merged in &run.scenarios {
            if let Some(scenario) = scenarios.iter().find(|scenario| scenario.file == merged.file) {
                boards.entry(&merged.original).or_default().push((&run.board, scenario));
            }
        }
    }
    let mut found = Vec::new();
    for (original, played) in boards {
        let [(reference, first), others @ ..] = &played[..] else { continue };
        for (board, scenario) in others.iter().filter(|(board, _)| board != reference) {
            let metrics = first.trials.first().into_iter().flat_map(|trial| trial.metrics.iter());
            for (metric, _) in metrics {
                let (Some(expected), Some(other)) = (summary(first, metric), summary(scenario, metric)) else {
                    continue;
                };
                found.push(BoardDifference {
                    scenario: original.to_owned(),
                    metric: metric.to_owned(),
                    board: (*board).to_owned(),
                    reference: (*reference).to_owned(),
                    difference: other.mean - expected.mean,
                    interval: other.difference_bounds(&expected, ONE_SIDED),
                    confidence: CONFIDENCE,
                });
            }
        }
    }
    found
}

fn summary(scenario: &ScenarioRecord, metric: &str) -> Option<SampleSummary> {
    let counted = scenario.trials.iter().filter(|trial| trial.cause.is_none());
    let values: Vec<f64> = counted.filter_map(|trial| trial.metrics.number(metric)).collect();
    SampleSummary::of(&values)
}
