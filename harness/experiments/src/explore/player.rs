//! Plays scenarios on one controller and judges them, as `run` does.

use crate::explore::guidance::{Feature, RecordingLink};
use crate::explore::properties::Property;
use platebench_engine::plan::LinkFactory;
use platebench_engine::{Executor, ExecutorSettings, MAX_LOSSES, RunError, SafeEnds, law};
use platebench_model::record::{Cause, Reason, Verdict, Violation};
use platebench_model::scenario::{Diagnostic, Limit, Scenario};
use platebench_model::trace::FileError;
use platebench_rig::{BoxedLink, CancelToken, ConnectError, RigError};
use platebench_verdict::{TrialMeasures, judge, measure};
use std::collections::BTreeSet;

#[derive(Debug, Clone, PartialEq)]
pub struct SceneFailure {
    pub property: Property,
    /// Name of the expectation. For [`Property::Protocol`] it is the text of the violation.
    pub name: String,
    /// `None` if nothing was measured, for example because a response never settles.
    pub value: Option<f64>,
    /// `None` for [`Property::Protocol`].
    pub limit: Option<f64>,
}

impl SceneFailure {
    pub(crate) fn unknown(property: Property) -> Self {
        Self { property, name: String::new(), value: None, limit: None }
    }
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct WindowResult {
    pub property: Property,
    /// Distance of the value from the limit, relative to the limit. `None` if inconclusive.
    pub margin: Option<f64>,
}

#[derive(Debug, Clone, Default)]
pub struct SceneResult {
    /// Violations of the protocol come first.
    pub failures: Vec<SceneFailure>,
    pub windows: Vec<WindowResult>,
    /// Cause (`rig` or `bench`) and reason, if the rig or the bench prevented a verdict.
    pub undecided: Option<String>,
    /// Answers to messages that differ from those of the reference, or why the messages ended.
    pub differences: Vec<String>,
    /// What the trials reached.
    pub features: BTreeSet<Feature>,
}

impl SceneResult {
    pub fn failure_of(&self, property: Property) -> Option<&SceneFailure> {
        self.failures.iter().find(|failure| failure.property == property)
    }
}

pub(crate) fn violated(failures: &[SceneFailure]) -> Vec<Property> {
    let properties: BTreeSet<_> = failures.iter().map(|failure| failure.property).collect();
    properties.into_iter().collect()
}

/// Controllers play 20 and 200 scenes in turn, so scenes meet both new and old controllers.
const SCENES_PER_CONTROLLER: [u32; 2] = [20, 200];

pub struct ScenePlayer<'a, L: RecordingLink = BoxedLink> {
    executor: Executor<'a, L>,
    /// Scenes that this controller has played.
    scenes: u32,
    controllers: usize,
}

impl<'a, L: RecordingLink> ScenePlayer<'a, L> {
    pub fn new(connect: &'a LinkFactory<'a, L>, own_clock: bool, cancel: &CancelToken, ends: &'a SafeEnds) -> Self {
        let settings = ExecutorSettings {
            own_clock,
            max_losses: Some(MAX_LOSSES),
            shares_controller: true,
            ..ExecutorSettings::lockstep(cancel)
        };
        Self { executor: Executor::new(connect, settings, ends), scenes: 0, controllers: 0 }
    }

    /// Closes the controller, so that the next scene starts a new one.
    pub fn renew(&mut self) {
        self.executor.close();
        self.scenes = 0;
    }

    pub(crate) fn is_young(&self) -> bool {
        self.scenes <= 1
    }

    /// `None` after a cancellation. Fails if the controller cannot be reached, rejects a
    /// configuration or is lost in several trials in sequence.
    pub fn play(&mut self, scenario: &Scenario) -> Result<Option<SceneResult>, ExploreError> {
        self.play_and_record(scenario, &BTreeSet::new())
    }

    /// As [`Self::play`]. The features of the result contain which of `branches` were reached.
    pub(crate) fn play_and_record(
        &mut self,
        scenario: &Scenario,
        branches: &BTreeSet<u32>,
    ) -> Result<Option<SceneResult>, ExploreError> {
        if scenario.needs_new_controller() {
            self.renew();
        }
        if self.scenes >= SCENES_PER_CONTROLLER[self.controllers % 2] {
            self.renew();
            self.controllers += 1;
        }
        self.scenes += 1;
        let law = law(scenario).map_err(|unknown| ExploreError::Generated(Box::new(unknown)))?;
        let mut trials = Vec::with_capacity(scenario.trials.count as usize);
        let (mut differences, mut features) = (Vec::new(), BTreeSet::new());
        if !branches.is_empty() {
            self.executor.session()?.link_mut().inner_mut().record(branches);
        }
        for index in 0..scenario.trials.count {
            let Some(played) = self.executor.play(scenario, law, index, None)? else { return Ok(None) };
            trials.push(measure(scenario, index, &played.trace_rows, &played.telemetry));
            features.extend(played.trace_rows.iter().map(|row| Feature::of_flags(row.flags)));
            features.extend(played.telemetry.stopped.as_deref().map(Feature::of_stop));
            differences.extend(played.telemetry.protocol_differences.into_iter().flatten());
            match played.link_error {
                None => {}
                Some(RigError::ConfigurationRejected(_)) => self.renew(),
                // The executor has replaced the controller.
                Some(_) => self.scenes = 0,
            }
        }
        if !branches.is_empty() {
            let reached = self.executor.session()?.link_mut().inner_mut().recorded();
            features.extend(reached.into_iter().map(Feature::Branch));
        }
        let result = scene_result(scenario, &trials);
        features.extend(Feature::of_margins(&result));
        let result = SceneResult { features, ..result };
        Ok(Some(if differences.is_empty() { result } else { SceneResult { differences, ..result } }))
    }
}

fn scene_result(scenario: &Scenario, trials: &[TrialMeasures]) -> SceneResult {
    let judgement = judge(scenario, trials);
    let mut result = SceneResult::default();
    let violations = trials.iter().flat_map(|trial| &trial.violations);
    result.failures.extend(violations.map(protocol_failure));
    let breaks_protocol = !result.failures.is_empty();
    for record in &judgement.expectations {
        let Some(property) = Property::of_name(&record.name) else { continue };
        let limit = match record.limit {
            Limit::AtMost(limit) | Limit::Within(_, limit) | Limit::AtLeast(limit) | Limit::About(limit) => limit,
        };
        let margin = match record.verdict {
            Verdict::Inconclusive => None,
            Verdict::Pass => record.margin,
            // A failure without a margin counts as the worst failure.
            Verdict::Fail => record.margin.or(Some(f64::NEG_INFINITY)),
        };
        result.windows.push(WindowResult { property, margin });
        if record.verdict == Verdict::Fail && !matches!(record.reason, Some(Reason::Violation { .. })) {
            let (name, value) = (record.name.clone(), record.value);
            if property == Property::Answers && value.is_none() {
                result.differences.extend(record.reason.as_ref().map(ToString::to_string));
            }
            result.failures.push(SceneFailure { property, name, value, limit: Some(limit) });
        }
        if record.verdict == Verdict::Inconclusive
            && let Some(cause @ (Cause::Rig | Cause::Bench)) = record.cause
        {
            let reason = record.reason.as_ref().map_or_else(String::new, |reason| format!(", {reason}"));
            result.undecided = Some(format!("{cause}{reason}"));
        }
    }
    if !breaks_protocol {
        let passed = WindowResult { property: Property::Protocol, margin: Some(1.0) };
        result.windows.extend(std::iter::repeat_n(passed, trials.len()));
    }
    result
}

fn protocol_failure(violation: &Violation) -> SceneFailure {
    SceneFailure {
        property: Property::Protocol,
        name: violation.to_string(),
        value: violation.worst,
        limit: violation.limit,
    }
}

#[derive(Debug, thiserror::Error)]
pub enum ExploreError {
    #[error(transparent)]
    Connect(#[from] ConnectError),
    #[error(transparent)]
    Run(#[from] RunError),
    #[error("the controller does not announce the law {law}, expected {options}")]
    LawNotAnnounced { law: String, options: String },
    #[error("internal error: the bench generated an invalid scenario ({0}); report this message and the seed")]
    Generated(Box<Diagnostic>),
    #[error(transparent)]
    File(#[from] FileError),
}
