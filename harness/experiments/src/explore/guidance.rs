//! Chooses what later scenes and sequences are derived from: those that reached something new.
//!
//! Scenes are played in rounds. What a round reached is added at its end, in the order of the
//! numbers, so that it does not depend on the number of workers.

use crate::explore::draw::{SceneDraw, Stratum};
use crate::explore::player::SceneResult;
use crate::explore::properties::Property;
use platebench_model::scenario::ScenarioMessage;
use platebench_model::trace::Flags;
#[cfg(feature = "firmware-analysis")]
use platebench_rig::EmulatedLink;
use platebench_rig::{BoxedLink, Link};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng, SeedableRng};
use schemars::JsonSchema;
use serde::Serialize;
use sha2::{Digest, Sha256};
use std::collections::{BTreeMap, BTreeSet};

/// Number of scenes of a round. The first round derives none, so that it has every stratum.
pub(crate) const ROUND: u64 = 64;
/// One scene or sequence in this many is derived, if there is something to derive it from.
const DERIVED_EVERY: u64 = 2;
/// Halvings of a margin that count as something new each.
const MAX_HALVINGS: f64 = 8.0;

/// Something that a scene or a sequence of messages reached.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub enum Feature {
    /// First instruction of a block to which a conditional branch leads.
    Branch(u32),
    /// All flags of a row of the trace.
    Flags(u8),
    /// The controller's reason for a stop, without numbers.
    Stop(String),
    /// The margin of a property is at most 1 divided by this power of two.
    Margin(Property, u8),
    /// A rule or a threshold of the protocol.
    Rule(String),
}

impl Feature {
    pub(crate) fn of_flags(flags: Flags) -> Self {
        Self::Flags(flags.bits())
    }

    pub(crate) fn of_stop(reason: &str) -> Self {
        Self::Stop(reason.chars().filter(|letter| !letter.is_ascii_digit()).collect())
    }

    pub(crate) fn of_margins(result: &SceneResult) -> impl Iterator<Item = Self> {
        let judged = result.windows.iter().filter_map(|window| Some((window.property, window.margin?)));
        judged
            .filter(|(_, margin)| *margin > 0.0 && *margin < 1.0)
            .map(|(property, margin)| Self::Margin(property, (-margin.log2()).min(MAX_HALVINGS) as u8))
    }
}

/// A link that can record which instructions of the controller ran.
pub trait RecordingLink: Link {
    /// Records only instructions at `addresses` from now on.
    fn record(&mut self, _addresses: &BTreeSet<u32>) {}

    fn recorded(&self) -> BTreeSet<u32> {
        BTreeSet::new()
    }
}

impl RecordingLink for BoxedLink {}

#[cfg(feature = "firmware-analysis")]
impl RecordingLink for EmulatedLink {
    fn record(&mut self, addresses: &BTreeSet<u32>) {
        self.record_execution(addresses);
    }

    fn recorded(&self) -> BTreeSet<u32> {
        self.executed_instructions().keys().copied().collect()
    }
}

/// Something that later items are derived from.
#[derive(Debug, Clone)]
pub(crate) enum Parent {
    Scene(Box<(Stratum, SceneDraw)>),
    Sequence(Vec<ScenarioMessage>),
}

/// Number of branch outcomes, and of items that were derived from others.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, JsonSchema)]
pub struct GuidanceTally {
    /// Branch outcomes of the firmware image; 0 on rigs other than `emulated`.
    pub branch_outcomes: usize,
    pub reached_branch_outcomes: usize,
    /// Other things that were reached: flags, stops, margins, rules and thresholds.
    pub other_features: usize,
    pub derived_scenes: u64,
    pub derived_sequences: u64,
    /// Scenes and sequences that reached something new.
    pub parents: usize,
}

/// What all complete rounds reached.
#[derive(Debug, Default)]
pub(crate) struct Corpus {
    reached: BTreeSet<Feature>,
    scenes: Vec<(Stratum, SceneDraw)>,
    sequences: Vec<Vec<ScenarioMessage>>,
    /// Branch outcomes that were not reached yet.
    pub(crate) missing: BTreeSet<u32>,
}

impl Corpus {
    pub(crate) fn new(branch_outcomes: &BTreeSet<u32>) -> Self {
        Self { missing: branch_outcomes.clone(), ..Self::default() }
    }

    /// Adds what the items of a round reached, by their number in the exploration.
    pub(crate) fn add_round(&mut self, items: BTreeMap<u64, (BTreeSet<Feature>, Parent)>) {
        for (features, parent) in items.into_values() {
            let count = self.reached.len();
            self.reached.extend(features);
            if self.reached.len() == count {
                continue;
            }
            match parent {
                Parent::Scene(scene) => self.scenes.push(*scene),
                Parent::Sequence(messages) => self.sequences.push(messages),
            }
        }
        self.missing.retain(|address| !self.reached.contains(&Feature::Branch(*address)));
    }

    /// Random numbers and two parents of scene `index`. `None` if it is not derived.
    pub(crate) fn scene_parents(&self, seed: u64, index: u64) -> Option<(ChaCha8Rng, [&(Stratum, SceneDraw); 2])> {
        let mut random = derivation("derived scene", seed, index)?;
        let parents = [(); 2].map(|()| pick(&mut random, &self.scenes));
        let [Some(one), Some(other)] = parents else { return None };
        Some((random, [one, other]))
    }

    /// `None` if sequence `index` is not derived.
    pub(crate) fn sequence_parent(&self, seed: u64, index: u64) -> Option<&[ScenarioMessage]> {
        let mut random = derivation("derived sequence", seed, index)?;
        pick(&mut random, &self.sequences).map(Vec::as_slice)
    }

    pub(crate) fn tally(&self, branch_outcomes: usize) -> GuidanceTally {
        let reached_branch_outcomes = branch_outcomes - self.missing.len();
        GuidanceTally {
            branch_outcomes,
            reached_branch_outcomes,
            other_features: self.reached.len() - reached_branch_outcomes,
            parents: self.scenes.len() + self.sequences.len(),
            ..GuidanceTally::default()
        }
    }
}

/// Combines two parents and a drawn scene. `most_events` limits the events of the judged trial.
pub(crate) fn derive_scene(
    mut random: ChaCha8Rng,
    [one, other]: [&(Stratum, SceneDraw); 2],
    drawn: (Stratum, SceneDraw),
    most_events: usize,
) -> (Stratum, SceneDraw) {
    let (stratum, mut scene) = one.clone();
    let events = &mut scene.judged.events;
    let place = below(&mut random, events.len().max(1));
    match below(&mut random, 5) {
        0 => return (drawn.0, SceneDraw { configuration: one.1.configuration.clone(), ..drawn.1 }),
        1 => scene.configuration = drawn.1.configuration,
        2 => {
            events.splice(place.min(events.len())..(place + 1).min(events.len()), drawn.1.judged.events).for_each(drop);
        }
        3 => events.splice(place.min(events.len()).., other.1.judged.events.iter().cloned()).for_each(drop),
        _ => {
            let rest = events.split_off(place.min(events.len()));
            events.extend(drawn.1.judged.events.into_iter().take(1).chain(rest));
        }
    }
    scene.judged.events.truncate(most_events);
    (Stratum { scripts: None, ..stratum }, scene)
}

pub(crate) fn random_numbers(kind: &str, seed: u64, index: u64) -> ChaCha8Rng {
    let mut hash = Sha256::new_with_prefix(kind);
    hash.update(seed.to_le_bytes());
    hash.update(index.to_le_bytes());
    ChaCha8Rng::from_seed(hash.finalize().into())
}

/// `None` if the item with this number is not derived.
fn derivation(kind: &str, seed: u64, index: u64) -> Option<ChaCha8Rng> {
    let mut random = random_numbers(kind, seed, index);
    random.next_u64().is_multiple_of(DERIVED_EVERY).then_some(random)
}

pub(crate) fn below(random: &mut ChaCha8Rng, count: usize) -> usize {
    ((u64::from(random.next_u32()) * count as u64) >> 32) as usize
}

fn pick<'a, T>(random: &mut ChaCha8Rng, all: &'a [T]) -> Option<&'a T> {
    let index = below(random, all.len());
    all.get(index)
}
