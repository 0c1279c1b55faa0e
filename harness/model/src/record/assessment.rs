//! Decides from the record of a run what was selected, played and not played, why not, by which
//! controllers, and with which verdict. No other place decides this. Its rule: a selected scenario
//! without a valid record of each trial that it needs is no pass.

use crate::record::reason::Reason;
use crate::record::run_record::{RigRecord, RunRecord, ScenarioRecord};
use crate::record::trial_record::TrialRecord;
use crate::record::verdict::{Exclusion, Verdict};
use std::path::Path;

#[derive(Debug, Clone, PartialEq)]
pub struct Assessment<'a> {
    pub verdict: Verdict,
    pub outcome: RunOutcome,
    /// Every selected scenario in the order of the record; those that are not applicable come last.
    pub scenarios: Vec<ScenarioAssessment<'a>>,
    /// Why the whole run is no pass although every scenario passed.
    pub inconclusive: Option<&'static str>,
}

#[derive(Debug, Clone, PartialEq)]
pub struct ScenarioAssessment<'a> {
    pub file: &'a str,
    pub verdict: Verdict,
    /// Number of trials with a valid record.
    pub played: usize,
    /// Why trials are missing. `None` if the scenario has all that it needs.
    pub not_played: Option<NotPlayed<'a>>,
}

/// Why a selected scenario lacks trials.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum NotPlayed<'a> {
    /// The controller lacks a law or a capability. Fails the run with `--require-all`.
    NotApplicable {
        reason: &'a str,
        is_required: bool,
    },
    TimeLimit(f64),
    FailFast,
    /// The connection to the controller failed, which ended the run.
    LostController,
    /// The run was killed, cancelled or ended by an error.
    Interrupted,
    /// The run is complete and has no record of the trials.
    MissingRecord,
}

/// How a run ends, the one source of the exit codes 0, 1, 3, 4 and 5.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RunOutcome {
    Passed,
    Failed,
    Inconclusive,
    NothingToRun,
    /// The controller was lost or did not confirm 0 V.
    Unreachable,
}

impl RunOutcome {
    pub const fn exit_code(self) -> u8 {
        match self {
            Self::Passed => 0,
            Self::Failed => 1,
            Self::Inconclusive => 3,
            Self::NothingToRun => 4,
            Self::Unreachable => 5,
        }
    }

    /// Outcome of everything that one command played. `lost` is true if the rig lost a controller. A
    /// failure explains a controller that did not confirm 0 V, such as a program that crashed.
    pub const fn of(verdict: Verdict, lost: bool, safe_confirmed: bool) -> Self {
        match verdict {
            _ if lost => Self::Unreachable,
            Verdict::Fail => Self::Failed,
            _ if !safe_confirmed => Self::Unreachable,
            Verdict::Pass => Self::Passed,
            Verdict::Inconclusive => Self::Inconclusive,
        }
    }
}

/// Verdict of several parts, of which a pass needs all.
pub fn combine_runs(verdicts: impl IntoIterator<Item = Verdict>, has_all: bool) -> Verdict {
    match Verdict::combine(verdicts) {
        Verdict::Pass if !has_all => Verdict::Inconclusive,
        combined => combined,
    }
}

impl<'a> Assessment<'a> {
    pub fn of(record: &'a RunRecord) -> Self {
        let played = record.scenarios.iter().map(|scenario| assess_scenario(record, scenario));
        let is_required = record.overrides.require_all;
        let skipped = record.not_applicable.iter().map(|skipped| ScenarioAssessment {
            file: &skipped.file,
            verdict: if is_required { Verdict::Fail } else { Verdict::Inconclusive },
            played: 0,
            not_played: Some(NotPlayed::NotApplicable { reason: &skipped.reason, is_required }),
        });
        let scenarios: Vec<_> = played.chain(skipped).collect();
        let inconclusive = missing_part(record);
        let misses_required = is_required && !record.not_applicable.is_empty();
        let judged = scenarios.iter().filter(|scenario| !scenario.is_not_applicable());
        let verdict = if misses_required || record.drive_after_safe {
            Verdict::Fail
        } else {
            combine_runs(judged.map(|scenario| scenario.verdict), inconclusive.is_none())
        };
        let outcome = if record.scenarios.is_empty() && verdict != Verdict::Fail {
            RunOutcome::NothingToRun
        } else {
            RunOutcome::of(verdict, record.has_lost_controller(), record.safe_confirmed != Some(false))
        };
        Self { verdict, outcome, scenarios, inconclusive }
    }

    /// Scenarios that must be played again: those that did not pass and apply, or fail the run.
    pub fn not_passed(&self) -> impl Iterator<Item = &ScenarioAssessment<'a>> {
        self.scenarios.iter().filter(|scenario| match scenario.not_played {
            Some(NotPlayed::NotApplicable { is_required, .. }) => is_required,
            _ => scenario.verdict != Verdict::Pass,
        })
    }
}

impl ScenarioAssessment<'_> {
    pub fn is_not_applicable(&self) -> bool {
        matches!(self.not_played, Some(NotPlayed::NotApplicable { .. }))
    }
}

fn assess_scenario<'a>(record: &RunRecord, scenario: &'a ScenarioRecord) -> ScenarioAssessment<'a> {
    let played = scenario.trials.len();
    let lacks_trials = scenario.planned_trials.is_some_and(|planned| played < planned as usize);
    let run = record.merge.as_ref().and_then(|merge| merge.run_of(&scenario.file));
    let (is_complete, overrides) =
        run.map_or((record.complete, &record.overrides), |run| (run.complete, &run.overrides));
    let not_played = if !lacks_trials && played > 0 {
        None
    } else if let Some(limit_s) = scenario.time_limit_s {
        Some(NotPlayed::TimeLimit(limit_s))
    } else if is_complete {
        Some(if overrides.fail_fast { NotPlayed::FailFast } else { NotPlayed::MissingRecord })
    } else if record.has_lost_controller() {
        Some(NotPlayed::LostController)
    } else {
        Some(NotPlayed::Interrupted)
    };
    let verdict = combine_runs([scenario.verdict], not_played.is_none());
    ScenarioAssessment { file: &scenario.file, verdict, played, not_played }
}

/// What the whole run lacks for a pass.
fn missing_part(record: &RunRecord) -> Option<&'static str> {
    if !record.complete {
        Some("the run was not finished")
    } else if record.merge.as_ref().is_some_and(|merge| !merge.missing_shards.is_empty()) {
        Some("a shard is missing")
    } else if record.safe_confirmed == Some(false) {
        Some("0 V was not confirmed")
    } else {
        None
    }
}

impl RunRecord {
    /// Each rig with another controller.
    pub fn controllers(&self) -> Vec<&RigRecord> {
        let runs = self.merge.iter().flat_map(|merge| merge.runs.iter().map(|run| &run.rig));
        let mut rigs: Vec<&RigRecord> = Vec::new();
        for rig in runs.chain(self.merge.is_none().then_some(&self.rig)) {
            if !rigs.iter().any(|known| known.has_same_controller(rig)) {
                rigs.push(rig);
            }
        }
        rigs
    }

    /// Sets the verdict of [`Assessment`].
    pub fn update_verdict(&mut self) {
        self.verdict = Assessment::of(self).verdict;
    }

    /// Turns passes of a scenario into inconclusive verdicts if one of its traces is missing.
    /// Returns whether a trace is missing.
    pub fn discount_missing_traces(&mut self, folder: &Path) -> bool {
        let mut misses_traces = false;
        for scenario in &mut self.scenarios {
            let is_missing = |trial: &&TrialRecord| trial.sha256.is_some() && !folder.join(&trial.trace).is_file();
            let Some(trial) = scenario.trials.iter().find(is_missing).map(|trial| trial.index) else { continue };
            misses_traces = true;
            for expectation in &mut scenario.expectations {
                if expectation.verdict == Verdict::Pass {
                    let exclusion = Exclusion::MissingTrace;
                    expectation.verdict = Verdict::Inconclusive;
                    expectation.cause = Some(exclusion.cause());
                    expectation.reason = Some(Reason::Excluded { trial, exclusion });
                }
            }
            scenario.verdict = Verdict::combine(scenario.expectations.iter().map(|expectation| expectation.verdict));
        }
        self.update_verdict();
        misses_traces
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::record::run_record::tests::record;
    use rstest::rstest;

    /// A run whose only scenario passed with all its trials.
    fn passed() -> RunRecord {
        let mut record = record();
        let scenario = &mut record.scenarios[0];
        scenario.verdict = Verdict::Pass;
        scenario.trials[0].cause = None;
        record
    }

    fn assess(change: impl Fn(&mut RunRecord)) -> (Verdict, RunOutcome, Option<String>) {
        let mut record = passed();
        change(&mut record);
        let assessment = Assessment::of(&record);
        let not_played = assessment.scenarios.first().and_then(|scenario| scenario.not_played);
        (assessment.verdict, assessment.outcome, not_played.map(|why| format!("{why:?}")))
    }

    #[rstest]
    #[case::all_played(|_: &mut RunRecord| {}, Verdict::Pass, None)]
    #[case::no_plan_of_0_3(|run: &mut RunRecord| run.scenarios[0].planned_trials = None, Verdict::Pass, None)]
    #[case::one_trial_more(
        |run: &mut RunRecord| run.scenarios[0].planned_trials = Some(2), Verdict::Inconclusive, Some("MissingRecord")
    )]
    #[case::no_trial_of_0_3(
        |run: &mut RunRecord| {
            run.scenarios[0].planned_trials = None;
            run.scenarios[0].trials.clear();
        },
        Verdict::Inconclusive,
        Some("MissingRecord")
    )]
    #[case::fail_fast(
        |run: &mut RunRecord| {
            run.overrides.fail_fast = true;
            run.scenarios[0].trials.clear();
        },
        Verdict::Inconclusive,
        Some("FailFast")
    )]
    #[case::killed(
        |run: &mut RunRecord| {
            run.complete = false;
            run.scenarios[0].trials.clear();
        },
        Verdict::Inconclusive,
        Some("Interrupted")
    )]
    #[case::killed_after_all_trials(|run: &mut RunRecord| run.complete = false, Verdict::Inconclusive, None)]
    fn a_selected_scenario_without_its_trials_is_no_pass(
        #[case] change: fn(&mut RunRecord),
        #[case] verdict: Verdict,
        #[case] expected: Option<&str>,
    ) {
        let (found, outcome, not_played) = assess(change);
        assert_eq!((found, not_played.as_deref()), (verdict, expected));
        assert_eq!(outcome.exit_code(), if verdict == Verdict::Pass { 0 } else { 3 });
    }

    #[test]
    fn scenarios_that_do_not_apply_fail_only_if_required() {
        let skip = |require_all: bool| {
            move |run: &mut RunRecord| {
                let (file, title, reason) = ("b.toml".to_owned(), String::new(), "no law".to_owned());
                run.not_applicable = vec![crate::record::NotApplicable { file, title, reason, expectations: 0 }];
                run.overrides.require_all = require_all;
            }
        };
        assert_eq!(assess(skip(false)).1, RunOutcome::Passed);
        assert_eq!(assess(skip(true)).1, RunOutcome::Failed);
        let mut required = passed();
        skip(true)(&mut required);
        let assessment = Assessment::of(&required);
        assert_eq!(assessment.not_passed().map(|scenario| scenario.file).collect::<Vec<_>>(), ["b.toml"]);
        required.overrides.require_all = false;
        assert_eq!(Assessment::of(&required).not_passed().count(), 0);
    }
}
