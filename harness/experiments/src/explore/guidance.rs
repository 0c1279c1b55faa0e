//! Chooses what later scenes and sequences are derived from: those that reached something new.
//!
//! Scenes are played in rounds. What a round reached is added at its end, in the order of the
//! numbers, so that it does not depend on the number of workers.

use crate::explore::choices::{Choice, below, exchange};
use crate::explore::player::SceneResult;
use crate::explore::properties::Property;
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
/// Largest number of parts that a derived item takes from others.
const MAX_EXCHANGES: usize = 4;
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

/// A kind of item, in the order of play.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum ItemKind {
    Scene,
    Sequence,
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
    /// Choices of scenes, and of sequences.
    parents: [Vec<Vec<Choice>>; 2],
    /// Branch outcomes that were not reached yet.
    pub(crate) missing: BTreeSet<u32>,
}

/// What an item reached, its kind, and its choices.
type Reached = (BTreeSet<Feature>, ItemKind, Option<Vec<Choice>>);

impl Corpus {
    pub(crate) fn new(branch_outcomes: &BTreeSet<u32>) -> Self {
        Self { missing: branch_outcomes.clone(), ..Self::default() }
    }

    /// Adds what the items of a round reached, by their number in the exploration. Items without choices
    /// are no parents.
    pub(crate) fn add_round(&mut self, items: BTreeMap<u64, Reached>) {
        for (features, kind, choices) in items.into_values() {
            let count = self.reached.len();
            self.reached.extend(features);
            if self.reached.len() > count {
                self.parents[kind as usize].extend(choices);
            }
        }
        self.missing.retain(|address| !self.reached.contains(&Feature::Branch(*address)));
    }

    /// The choices of a parent, with parts of another one or of the drawn item. `None` if the item with
    /// this number is not derived.
    pub(crate) fn derive(&self, kind: ItemKind, seed: u64, index: u64, drawn: &[Choice]) -> Option<Vec<Choice>> {
        let mut random = random_numbers(["derived scene", "derived sequence"][kind as usize], seed, index);
        let parents = &self.parents[kind as usize];
        if parents.is_empty() || !random.next_u64().is_multiple_of(DERIVED_EVERY) {
            return None;
        }
        let [parent, other] = [(); 2].map(|()| parents.get(below(&mut random, parents.len())));
        Some(derive(parent?, [other?, drawn], &mut random))
    }

    pub(crate) fn tally(&self, branch_outcomes: usize) -> GuidanceTally {
        let reached_branch_outcomes = branch_outcomes - self.missing.len();
        GuidanceTally {
            branch_outcomes,
            reached_branch_outcomes,
            other_features: self.reached.len() - reached_branch_outcomes,
            parents: self.parents.iter().map(Vec::len).sum(),
            ..GuidanceTally::default()
        }
    }
}

/// `parent` with some parts of the donors.
pub fn derive(parent: &[Choice], donors: [&[Choice]; 2], random: &mut ChaCha8Rng) -> Vec<Choice> {
    let mut choices = parent.to_vec();
    for _ in 0..=below(random, MAX_EXCHANGES) {
        let donor = donors[below(random, 2)];
        exchange(&mut choices, donor, random);
    }
    choices
}

pub(crate) fn random_numbers(kind: &str, seed: u64, index: u64) -> ChaCha8Rng {
    let mut hash = Sha256::new_with_prefix(kind);
    hash.update(seed.to_le_bytes());
    hash.update(index.to_le_bytes());
    ChaCha8Rng::from_seed(hash.finalize().into())
}
