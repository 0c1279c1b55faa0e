//! Plays generated scenes on several workers until the budget is used or enough scenes fail.

use crate::explore::choices::{Choice, Drawn};
use crate::explore::coverage::ExplorationCoverage;
use crate::explore::envelope::Envelope;
use crate::explore::generator::Generator;
use crate::explore::guidance::{Corpus, Feature, GuidanceTally, ItemKind, ROUND, RecordingLink};
use crate::explore::limits::ExploredLaw;
use crate::explore::player::ExploreError;
use crate::explore::player::{SceneFailure, ScenePlayer, SceneResult, violated};
use crate::explore::properties::{Demand, Property, demands, reference_demands, relation_demand};
use crate::explore::scenario_file::{ScenarioBuilder, SceneScenario, sequence_scenario};
use crate::explore::scene::Scene;
use crate::explore::sequence::SequenceLimits;
use platebench_engine::plan::LinkFactory;
use platebench_engine::workers::{Emit, run_workers};
use platebench_engine::{RunError, SafeEnds, configure};
use platebench_model::scenario::{Scenario, ScenarioMessage};
use platebench_rig::{CancelToken, ProtocolCoverage, RigError, is_defined_law};
use platebench_wire::LawId;
use schemars::JsonSchema;
use serde::Serialize;
use std::collections::{BTreeMap, BTreeSet};
use std::ops::ControlFlow;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

/// Largest number of earlier scenes of the same controller that are stored with a failed scene.
const MAX_HISTORY: usize = 8;
const MAX_UNDECIDED: usize = 10;
/// Number of sequences of messages after each scene. A sequence takes less time than a scene.
const SEQUENCES_PER_SCENE: u64 = 3;
const ITEMS: u64 = 1 + SEQUENCES_PER_SCENE;

#[derive(Debug, Clone, Copy, PartialEq)]
pub enum ExplorationBudget {
    Time(Duration),
    Scenes(u64),
}

#[derive(Debug, Clone)]
pub struct ExploreConfig {
    pub envelope: Envelope,
    pub seed: u64,
    pub law: ExploredLaw,
    /// Laws that earlier trials may use.
    pub laws: Vec<LawId>,
    pub budget: ExplorationBudget,
    /// The exploration ends after this number of failing scenes.
    pub max_failed: u64,
    pub jobs: usize,
    /// True if the controller's clock runs while the simulated plate waits.
    pub own_clock: bool,
    /// True if every command is compared with the hosted reference.
    pub compares_reference: bool,
    /// Scenarios of earlier explorations, which are played first.
    pub regressions: Vec<Regression>,
    /// If present, a sequence of messages follows each scene.
    pub sequences: Option<SequenceLimits>,
    /// True if one scene in 512 takes more than a minute of the rig's time.
    pub has_endurance: bool,
    /// True if later scenes and sequences are derived from those that reached something new.
    pub is_guided: bool,
    /// First instructions of the blocks to which the branches of the controller's image lead. Empty
    /// if the rig records no execution.
    pub branch_outcomes: BTreeSet<u32>,
}

impl ExploreConfig {
    pub fn generator(&self) -> Generator<'_> {
        let Self { envelope, seed, law, laws, has_endurance, .. } = self;
        Generator { envelope, seed: *seed, law: *law, laws, has_endurance: *has_endurance }
    }

    /// The page of the protocol defines the commands of some laws only.
    fn compares_commands(&self) -> bool {
        self.compares_reference && self.law.number().is_some_and(is_defined_law)
    }

    pub fn demands(&self, scene: &Scene) -> Vec<Demand> {
        let mut demands = demands(scene, &self.envelope.plate);
        demands.extend(relation_demand(scene, &self.envelope.plate));
        if self.compares_commands() {
            demands.extend(reference_demands(scene));
        }
        demands
    }

    pub fn scenario(&self, scene: &Scene, title: &str) -> SceneScenario {
        let Envelope { title: envelope, plate, .. } = &self.envelope;
        let source = format!("platebench suite explore {envelope}");
        let builder = ScenarioBuilder { base: plate, title, source: &source, plate_prefix: "" };
        builder.build(scene, &self.demands(scene))
    }

    pub fn sequence_scenario(&self, messages: &[ScenarioMessage], title: &str, prefix: &str) -> SceneScenario {
        sequence_scenario(&self.envelope, self.law, messages, title, prefix, self.compares_commands())
    }
}

/// A scenario of an earlier exploration.
#[derive(Debug, Clone)]
pub struct Regression {
    pub scenario: Scenario,
    /// Why the controller or the rig cannot play it.
    pub not_applicable: Option<String>,
}

#[derive(Debug, Clone, PartialEq)]
pub struct FailedScene {
    pub index: u64,
    pub scene: Scene,
    pub choices: Vec<Choice>,
    pub failures: Vec<SceneFailure>,
    /// Choices of the scenes that the same controller played before, oldest first.
    pub history: Vec<Vec<Choice>>,
}

impl FailedScene {
    pub(crate) fn failure_of(&self, property: Property) -> Option<&SceneFailure> {
        self.failures.iter().find(|failure| failure.property == property)
    }
}

#[derive(Debug, Clone, PartialEq)]
pub struct FailedSequence {
    pub index: u64,
    pub messages: Vec<ScenarioMessage>,
    pub choices: Vec<Choice>,
    pub properties: Vec<Property>,
    /// The difference or the violated rule, in words.
    pub text: String,
}

#[derive(Debug, Clone, PartialEq, Eq, Serialize, JsonSchema)]
pub struct UndecidedScene {
    pub scene: u64,
    /// Text with the cause (`rig` or `bench`) and the reason.
    pub cause: String,
}

#[derive(Debug, Clone, PartialEq, Eq, Serialize, JsonSchema)]
pub struct FailedRegression {
    pub file: String,
    pub properties: Vec<Property>,
}

/// A scenario of an earlier exploration that has no result.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, JsonSchema)]
pub struct UnjudgedRegression {
    pub file: String,
    pub reason: String,
    /// False if the scenario does not apply to the controller or the rig. If true, the rig or the
    /// bench prevented a verdict.
    pub is_undecided: bool,
}

#[derive(Debug, Clone, Copy, PartialEq, Serialize, JsonSchema)]
pub struct PropertyTally {
    pub windows: u64,
    pub violations: u64,
    /// Smallest relative distance from the limit. Not finite (JSON: `null`) if a value is missing.
    pub smallest_margin: f64,
    pub tightest_scene: u64,
}

impl Default for PropertyTally {
    fn default() -> Self {
        Self { windows: 0, violations: 0, smallest_margin: f64::INFINITY, tightest_scene: 0 }
    }
}

#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, JsonSchema)]
pub struct SequenceTally {
    pub played: u64,
    /// Messages of these sequences, repetitions included.
    pub messages: u64,
    pub undecided: u64,
    /// Sequences that would take too long on this rig.
    pub skipped: u64,
    pub failed: u64,
}

#[derive(Debug, Default)]
pub struct Exploration {
    pub scenes: u64,
    pub undecided: u64,
    /// The first ten undecided scenes, in the order of play.
    pub undecided_scenes: Vec<UndecidedScene>,
    pub properties: BTreeMap<Property, PropertyTally>,
    pub failed: Vec<FailedScene>,
    pub sequences: SequenceTally,
    pub failed_sequences: Vec<FailedSequence>,
    pub rules: ProtocolCoverage,
    pub regressions: usize,
    pub failed_regressions: Vec<FailedRegression>,
    pub unjudged_regressions: Vec<UnjudgedRegression>,
    pub coverage: ExplorationCoverage,
    pub guidance: GuidanceTally,
    pub elapsed: Duration,
    pub is_interrupted: bool,
    /// The error that ended the exploration after at least one result.
    pub error: Option<ExploreError>,
}

impl Exploration {
    /// Returns what the sequence reached; `None` if it was not played.
    fn add_sequence(
        &mut self,
        sequence: &PlayedSequence,
        law: ExploredLaw,
    ) -> Result<Option<BTreeSet<Feature>>, ExploreError> {
        self.guidance.derived_sequences += u64::from(sequence.is_derived);
        let Some(result) = &sequence.result else {
            self.sequences.skipped += 1;
            return Ok(None);
        };
        let Scenario { messages, .. } = &sequence.scenario;
        let counts = self.rules.counts();
        let law = law.number().unwrap_or(LawId::OpenLoop);
        self.rules
            .add(messages, &configure(&sequence.scenario, law))
            .map_err(RigError::Link)
            .map_err(RunError::from)?;
        let exercised = self.rules.counts().into_iter().zip(counts).filter(|((_, now), (_, before))| now > before);
        let rules = exercised.map(|((rule, _), _)| Feature::Rule(rule));
        let features = result.features.iter().cloned().chain(rules).collect();
        self.sequences.played += 1;
        self.sequences.messages += sequence.messages;
        self.sequences.undecided += u64::from(result.undecided.is_some());
        if let Some(cause) = result.undecided.clone()
            && self.undecided_scenes.len() < MAX_UNDECIDED
        {
            self.undecided_scenes.push(UndecidedScene { scene: sequence.index, cause });
        }
        if let Some(failure) = result.failures.first() {
            self.sequences.failed += 1;
            let text = result.differences.first().unwrap_or(&failure.name).clone();
            let properties = violated(&result.failures);
            let (index, messages, choices) = (sequence.index, messages.clone(), sequence.choices.clone());
            self.failed_sequences.push(FailedSequence { index, messages, choices, properties, text });
        }
        Ok(Some(features))
    }

    fn add(&mut self, scene: &Scene, index: u64, result: &SceneResult, envelope: &Envelope) {
        self.scenes += 1;
        if let Some(cause) = result.undecided.clone() {
            self.undecided += 1;
            if self.undecided_scenes.len() < MAX_UNDECIDED {
                self.undecided_scenes.push(UndecidedScene { scene: index, cause });
            }
        }
        self.coverage.add(scene, envelope);
        for window in &result.windows {
            let tally = self.properties.entry(window.property).or_default();
            let Some(margin) = window.margin else { continue };
            tally.windows += 1;
            tally.violations += u64::from(margin < 0.0);
            if margin < tally.smallest_margin {
                (tally.smallest_margin, tally.tightest_scene) = (margin, index);
            }
        }
        let protocol = result.failures.iter().filter(|failure| failure.property == Property::Protocol).count() as u64;
        if protocol > 0 {
            let tally = self.properties.entry(Property::Protocol).or_default();
            tally.windows += protocol;
            tally.violations += protocol;
            (tally.smallest_margin, tally.tightest_scene) = (-1.0, index);
        }
    }
}

/// `ends` receives the ends of all sessions. `on_scene` receives the numbers of played and failed
/// scenes. Violations are not errors. After an error, returns what was found before, if anything
/// was played.
pub fn explore(
    config: &ExploreConfig,
    connect: &LinkFactory<'_>,
    cancel: &CancelToken,
    ends: &SafeEnds,
    on_scene: &mut dyn FnMut(u64, u64),
) -> Result<Exploration, ExploreError> {
    explore_and_record(config, connect, cancel, ends, on_scene)
}

/// As [`explore`], on links that may record which instructions run.
pub fn explore_and_record<L: RecordingLink>(
    config: &ExploreConfig,
    connect: &LinkFactory<'_, L>,
    cancel: &CancelToken,
    ends: &SafeEnds,
    on_scene: &mut dyn FnMut(u64, u64),
) -> Result<Exploration, ExploreError> {
    let started = Instant::now();
    let mut exploration = Exploration::default();
    exploration.error = play_regressions(config, connect, cancel, ends, &mut exploration).err();
    let (next, failed) = (AtomicU64::new(0), AtomicU64::new(0));
    let items = if config.sequences.is_some() { ITEMS } else { 1 };
    let mut workers: Vec<_> =
        (0..config.jobs.max(1)).map(|_| SceneWorker::new(config, connect, cancel, ends)).collect();
    let mut corpus = Corpus::new(&config.branch_outcomes);
    let is_over = |number: u64| {
        let is_used = match config.budget {
            ExplorationBudget::Time(time) => started.elapsed() >= time,
            ExplorationBudget::Scenes(count) => number / items >= count,
        };
        is_used || cancel.is_cancelled() || failed.load(Ordering::Relaxed) >= config.max_failed
    };
    for round_end in (1..).map(|round| round * ROUND * items) {
        if exploration.error.is_some() {
            break;
        }
        let source = || {
            let number = next.fetch_update(Ordering::Relaxed, Ordering::Relaxed, |next| {
                (next < round_end && !is_over(next)).then_some(next + 1)
            });
            let number = number.ok()?;
            Some(match number % items {
                0 => Item::Scene(number / items),
                sequence => Item::Sequence(number / items * SEQUENCES_PER_SCENE + sequence - 1),
            })
        };
        #[expect(clippy::mut_mut, reason = "workers keep their controllers from round to round")]
        let work = |worker: &mut &mut SceneWorker<'_, L>, item, emit: &mut Emit<'_, PlayedItem>| {
            let played = match item {
                Item::Scene(index) => worker.play(index, &corpus)?.map(|scene| PlayedItem::Scene(Box::new(scene))),
                Item::Sequence(index) => {
                    worker.play_sequence(index, &corpus)?.map(|sequence| PlayedItem::Sequence(Box::new(sequence)))
                }
            };
            let Some(played) = played else { return Ok(()) };
            if !played.result().is_none_or(|result| result.failures.is_empty()) {
                failed.fetch_add(1, Ordering::Relaxed);
            }
            emit(played);
            Ok(())
        };
        let mut round = BTreeMap::new();
        let outcome = run_workers(workers.iter_mut(), source, work, &mut |played: PlayedItem| {
            match played {
                PlayedItem::Scene(played) => {
                    let PlayedScene { index, drawn: Drawn { item: scene, choices }, is_derived, .. } = *played;
                    let PlayedScene { mut result, history, .. } = *played;
                    exploration.guidance.derived_scenes += u64::from(is_derived);
                    exploration.add(&scene, index, &result, &config.envelope);
                    let features = std::mem::take(&mut result.features);
                    let parent = (!scene.is_rare()).then(|| choices.clone());
                    round.insert(index * ITEMS, (features, ItemKind::Scene, parent));
                    if !result.failures.is_empty() {
                        let failures = result.failures;
                        exploration.failed.push(FailedScene { index, scene, choices, failures, history });
                    }
                }
                PlayedItem::Sequence(sequence) => {
                    if let Some(features) = exploration.add_sequence(&sequence, config.law)? {
                        let index = sequence.index;
                        let number = index / SEQUENCES_PER_SCENE * ITEMS + 1 + index % SEQUENCES_PER_SCENE;
                        let PlayedSequence { choices, may_be_parent, .. } = *sequence;
                        round.insert(number, (features, ItemKind::Sequence, may_be_parent.then_some(choices)));
                    }
                }
            }
            on_scene(exploration.scenes, (exploration.failed.len() + exploration.failed_sequences.len()) as u64);
            Ok::<_, ExploreError>(ControlFlow::Continue(()))
        });
        exploration.error = outcome.err();
        corpus.add_round(round);
        if is_over(next.load(Ordering::Relaxed)) {
            break;
        }
    }
    exploration.guidance = GuidanceTally {
        derived_scenes: exploration.guidance.derived_scenes,
        derived_sequences: exploration.guidance.derived_sequences,
        ..corpus.tally(config.branch_outcomes.len())
    };
    exploration.failed_sequences.sort_by_key(|sequence| sequence.index);
    exploration.is_interrupted = cancel.is_cancelled();
    exploration.error.take_if(|error| matches!(error, ExploreError::Run(RunError::Cancelled)));
    exploration.failed.sort_by_key(|scene| scene.index);
    exploration.elapsed = started.elapsed();
    let is_empty = exploration.scenes == 0 && exploration.sequences.played == 0 && exploration.regressions == 0;
    match exploration.error.take_if(|_| is_empty) {
        Some(error) => Err(error),
        None => Ok(exploration),
    }
}

fn play_regressions<L: RecordingLink>(
    config: &ExploreConfig,
    connect: &LinkFactory<'_, L>,
    cancel: &CancelToken,
    ends: &SafeEnds,
    exploration: &mut Exploration,
) -> Result<(), ExploreError> {
    let mut player = ScenePlayer::new(connect, config.own_clock, cancel, ends);
    for Regression { scenario, not_applicable } in &config.regressions {
        let unjudged = |reason, is_undecided| UnjudgedRegression { file: scenario.file.clone(), reason, is_undecided };
        if let Some(reason) = not_applicable {
            exploration.unjudged_regressions.push(unjudged(reason.clone(), false));
            continue;
        }
        // Each scenario starts with a new controller, as in `platebench run`.
        player.renew();
        let Some(result) = player.play(scenario)? else { return Ok(()) };
        exploration.regressions += 1;
        if !result.failures.is_empty() {
            let (file, properties) = (scenario.file.clone(), violated(&result.failures));
            exploration.failed_regressions.push(FailedRegression { file, properties });
        } else if let Some(cause) = result.undecided {
            exploration.unjudged_regressions.push(unjudged(cause, true));
        }
    }
    Ok(())
}

/// What a worker plays next.
#[derive(Debug, Clone, Copy)]
enum Item {
    Scene(u64),
    Sequence(u64),
}

enum PlayedItem {
    Scene(Box<PlayedScene>),
    Sequence(Box<PlayedSequence>),
}

impl PlayedItem {
    fn result(&self) -> Option<&SceneResult> {
        match self {
            Self::Scene(scene) => Some(&scene.result),
            Self::Sequence(sequence) => sequence.result.as_ref(),
        }
    }
}

struct PlayedSequence {
    index: u64,
    is_derived: bool,
    scenario: Scenario,
    choices: Vec<Choice>,
    may_be_parent: bool,
    messages: u64,
    /// `None` if the sequence is too long for the rig.
    result: Option<SceneResult>,
}

struct PlayedScene {
    index: u64,
    drawn: Drawn<Scene>,
    is_derived: bool,
    result: SceneResult,
    history: Vec<Vec<Choice>>,
}

struct SceneWorker<'a, L: RecordingLink> {
    config: &'a ExploreConfig,
    player: ScenePlayer<'a, L>,
    history: Vec<Vec<Choice>>,
}

impl<'a, L: RecordingLink> SceneWorker<'a, L> {
    fn new(
        config: &'a ExploreConfig,
        connect: &'a LinkFactory<'a, L>,
        cancel: &CancelToken,
        ends: &'a SafeEnds,
    ) -> Self {
        let player = ScenePlayer::new(connect, config.own_clock, cancel, ends);
        Self { config, player, history: Vec::new() }
    }

    /// `None` if the sequence was cancelled.
    fn play_sequence(&mut self, index: u64, corpus: &Corpus) -> Result<Option<PlayedSequence>, ExploreError> {
        let Some(limits) = &self.config.sequences else { return Ok(None) };
        let drawn = limits.sequence(self.config.seed, index);
        let derived = self.derive(ItemKind::Sequence, index, corpus, &drawn.choices);
        let is_derived = derived.is_some();
        let Drawn { item: sequence, choices } = derived.map_or(drawn, |choices| limits.replay(&choices));
        let messages = ScenarioMessage::count(&sequence);
        let may_be_parent = limits.may_be_parent(&sequence);
        let title = format!("Sequence {index} of seed {}", self.config.seed);
        let scenario = self.config.sequence_scenario(&sequence, &title, "").check()?;
        let played = PlayedSequence { index, is_derived, scenario, choices, may_be_parent, messages, result: None };
        if SequenceLimits::cost(&sequence) > limits.longest {
            return Ok(Some(played));
        }
        let result = self.player.play_and_record(&played.scenario, &corpus.missing)?;
        Ok(result.map(|result| PlayedSequence { result: Some(result), ..played }))
    }

    /// `None` if the scene was cancelled.
    fn play(&mut self, index: u64, corpus: &Corpus) -> Result<Option<PlayedScene>, ExploreError> {
        let generator = self.config.generator();
        let drawn = generator.scene(index);
        let derived = self.derive(ItemKind::Scene, index, corpus, &drawn.choices).filter(|_| !drawn.item.is_rare());
        let is_derived = derived.is_some();
        let drawn = derived.map_or(drawn, |choices| generator.replay(&choices));
        let title = format!("Scene {index} of seed {}", self.config.seed);
        let scenario = self.config.scenario(&drawn.item, &title).check()?;
        let Some(result) = self.player.play_and_record(&scenario, &corpus.missing)? else { return Ok(None) };
        if self.player.is_young() {
            self.history.clear();
        }
        let history = self.history.clone();
        self.history.push(drawn.choices.clone());
        if self.history.len() > MAX_HISTORY {
            self.history.remove(0);
        }
        Ok(Some(PlayedScene { index, drawn, is_derived, result, history }))
    }

    fn derive(&self, kind: ItemKind, index: u64, corpus: &Corpus, drawn: &[Choice]) -> Option<Vec<Choice>> {
        if self.config.is_guided { corpus.derive(kind, self.config.seed, index, drawn) } else { None }
    }
}
