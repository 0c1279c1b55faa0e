//! `platebench baseline`: what was accepted of each scenario, reviewed like snapshots.

use crate::args::{Baseline, BaselineAction};
use crate::compare::{CompareError, Played, trials_of, with_disturbed};
use crate::exit::Exit;
use crate::output;
use platebench_report::comparison;
use platebench_verdict::golden::{Accepted, Build, Features, Golden, LearnError, Learned};
use platebench_verdict::{RunRecord, ScenarioRecord, Verdict};
use std::fs;
use std::path::Path;

/// Why a scenario cannot be accepted.
#[derive(Debug, thiserror::Error)]
enum AcceptError {
    #[error(transparent)]
    Compare(#[from] CompareError),
    #[error(transparent)]
    Learn(#[from] LearnError),
    #[error("there is no trial")]
    Nothing,
    #[error("{0}")]
    Disturbed(String),
}

/// Does what is asked with the baselines.
pub(crate) fn baseline(arguments: &Baseline) -> Exit {
    let done = match &arguments.action {
        BaselineAction::List { run, baselines } => list(run.as_deref(), baselines),
        BaselineAction::Diff { run, baselines, false_alarm_rate } => RunRecord::read(run)
            .map_err(CompareError::from)
            .map(|record| review(run, &record, baselines, *false_alarm_rate, false)),
        BaselineAction::Accept { run, baselines, false_alarm_rate } => RunRecord::read(run)
            .map_err(CompareError::from)
            .map(|record| review(run, &record, baselines, *false_alarm_rate, true)),
    };
    done.unwrap_or_else(|error| {
        output::error(&error.to_string());
        Exit::Invalid
    })
}

/// What a run would change, and where `write` says so the change itself.
fn review(run: &Path, record: &RunRecord, baselines: &Path, rate: f64, write: bool) -> Exit {
    if record.scenarios.is_empty() {
        output::error("there is nothing in this run");
        return Exit::Nothing;
    }
    let (mut invalid, mut verdicts) = (false, Vec::new());
    for scenario in &record.scenarios {
        let reviewed = trials_of(run, scenario).map_err(AcceptError::from).and_then(|played| {
            let old = Accepted::read(baselines, &scenario.file).map_err(CompareError::from)?;
            if write {
                accept(record, scenario, &played, old.as_ref(), baselines, rate)
            } else {
                Ok(differ(record, scenario, &played, old.as_ref(), rate))
            }
        });
        match reviewed {
            Ok(verdict) => verdicts.push(verdict),
            Err(error) => {
                output::error(&format!("{}: {error}", scenario.file));
                invalid = true;
            }
        }
    }
    if invalid { Exit::Invalid } else { Exit::of_verdict(Verdict::over(verdicts)) }
}

fn differ(
    record: &RunRecord,
    scenario: &ScenarioRecord,
    played: &Played,
    old: Option<&Accepted>,
    rate: f64,
) -> Verdict {
    let Some(old) = old else {
        output::show(&format!("? new  {}\n", scenario.file));
        return Verdict::Inconclusive;
    };
    let compared = with_disturbed(&old.golden, played);
    let mut lines = comparison::lines(&scenario.file, &compared);
    // Where no new one can be made there is still the old one to be held against.
    if let Ok(new) = made(record, scenario, played, Some(old), rate) {
        lines.extend(changes(old, &new));
    }
    output::show(&(lines.join("\n") + "\n"));
    compared.verdict
}

/// Only what passed is accepted.
fn accept(
    record: &RunRecord,
    scenario: &ScenarioRecord,
    played: &Played,
    old: Option<&Accepted>,
    baselines: &Path,
    rate: f64,
) -> Result<Verdict, AcceptError> {
    if scenario.verdict != Verdict::Pass {
        output::show(&format!("✗ not accepted  {}: it did not pass ({})\n", scenario.file, scenario.verdict));
        return Ok(scenario.verdict);
    }
    if let Some(what) = played.disturbed.first() {
        return Err(AcceptError::Disturbed(what.clone()));
    }
    let new = made(record, scenario, played, old, rate)?;
    let lines = match old {
        Some(old) if old.texts() == new.texts() => vec![format!("✓ unchanged  {}", scenario.file)],
        Some(old) => {
            let mut lines = vec![format!("✓ accepted  {}", scenario.file)];
            lines.extend(changes(old, &new));
            let compared = with_disturbed(&old.golden, played);
            lines.extend(compared.worst.map(|(trial, worst)| format!("  {}", comparison::sentence(trial, &worst))));
            lines
        }
        None => vec![format!("✓ accepted  {}  (new, {})", scenario.file, features(&new.features))],
    };
    new.write(baselines).map_err(CompareError::from)?;
    output::show(&(lines.join("\n") + "\n"));
    Ok(Verdict::Pass)
}

/// A baseline of what was played: one curve where trials do not differ, otherwise a tube that is learned from them.
fn made(
    record: &RunRecord,
    scenario: &ScenarioRecord,
    played: &Played,
    old: Option<&Accepted>,
    rate: f64,
) -> Result<Accepted, AcceptError> {
    let Some((_, first)) = played.trials.first() else { return Err(AcceptError::Nothing) };
    // Rows are at the most one trace step apart, in whole nanoseconds.
    let gaps = first.iter().zip(first.iter().skip(1)).map(|(left, right)| right.t_s - left.t_s);
    let step_ms = (gaps.fold(0.0, f64::max) * 1e9).round() / 1e6;
    let differ = played.trials.iter().any(|(_, rows)| rows != first);
    let (mut golden, learned) = if differ {
        let trials: Vec<_> = played.trials.iter().map(|(_, rows)| rows.clone()).collect();
        let learned = Learned { trials: trials.len() as u32, false_alarm_rate: rate };
        (Golden::learn(&trials, step_ms, rate)?, Some(learned))
    } else {
        (Golden::of_trial(first, step_ms).ok_or(AcceptError::Nothing)?, None)
    };
    // Tolerances that somebody has changed stay as they are.
    for tube in &mut golden.tubes {
        if let Some(kept) = old.and_then(|old| old.golden.tubes.iter().find(|old| old.signal == tube.signal)) {
            tube.tolerance = kept.tolerance;
        }
    }
    let firmware = record.rig.firmware.as_ref();
    Ok(Accepted {
        scenario: scenario.file.clone(),
        law: scenario.law.clone(),
        build: Build {
            rig: record.rig.name.clone(),
            firmware: firmware.map_or_else(String::new, |firmware| format!("{} {}", firmware.name, firmware.version)),
            id: firmware.map_or_else(String::new, |firmware| firmware.build.clone()),
        },
        features: Features::of(first),
        learned,
        golden,
    })
}

/// What is not as it was, beside the curves.
fn changes(old: &Accepted, new: &Accepted) -> Vec<String> {
    let said = |value: Option<f64>| value.map_or_else(|| "none".to_owned(), |value| value.to_string());
    let mut lines = Vec::new();
    if old.law != new.law {
        lines.push(format!("  law: {} → {}", old.law, new.law));
    }
    if old.build != new.build {
        let told = |build: &Build| format!("{} {} on {}", build.firmware, build.id, build.rig);
        lines.push(format!("  build: {} → {}", told(&old.build), told(&new.build)));
    }
    for ((name, before), (_, after)) in old.features.named().into_iter().zip(new.features.named()) {
        if before != after {
            lines.push(format!("  {name}: {} → {}", said(before), said(after)));
        }
    }
    lines
}

fn features(features: &Features) -> String {
    let known = features.named().into_iter().filter_map(|(name, value)| Some(format!("{name} {}", value?)));
    known.collect::<Vec<_>>().join(", ")
}

/// Every baseline, or those of the scenarios of a run.
fn list(run: Option<&Path>, baselines: &Path) -> Result<Exit, CompareError> {
    let mut names = Vec::new();
    match run {
        Some(run) => names.extend(RunRecord::read(run)?.scenarios.into_iter().map(|scenario| scenario.file)),
        None => names_below(baselines, "", &mut names)?,
    }
    for name in &names {
        let line = match Accepted::read(baselines, name)? {
            None => format!("– {name}: no baseline"),
            Some(of) => {
                let learned = of.learned.as_ref().map(|learned| {
                    format!(
                        ", learned from {} trials at {} % false alarms",
                        learned.trials,
                        learned.false_alarm_rate * 100.0
                    )
                });
                let learned = learned.unwrap_or_default();
                format!("✓ {name}: {}, {} ({}){learned}", of.law, features(&of.features), of.build.firmware)
            }
        };
        output::show(&format!("{line}\n"));
    }
    if names.is_empty() {
        output::error("there is no baseline");
        return Ok(Exit::Nothing);
    }
    Ok(Exit::Passed)
}

/// The scenarios that have a baseline below `folder`, in order.
fn names_below(folder: &Path, prefix: &str, names: &mut Vec<String>) -> Result<(), CompareError> {
    let refused = |source| CompareError::Io { path: folder.to_owned(), source };
    let mut entries = fs::read_dir(folder).map_err(refused)?.collect::<Result<Vec<_>, _>>().map_err(refused)?;
    entries.sort_by_key(fs::DirEntry::file_name);
    for entry in entries {
        let name = format!("{prefix}{}", entry.file_name().to_string_lossy());
        if entry.file_type().map_err(refused)?.is_dir() {
            names_below(&entry.path(), &format!("{name}/"), names)?;
        } else if entry.path().extension().is_some_and(|extension| extension == "toml") {
            names.push(name);
        }
    }
    Ok(())
}
