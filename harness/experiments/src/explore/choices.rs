//! Records the choices that make a scene or a sequence of messages, as numbers in nested parts.
//!
//! A generator asks for numbers and opens parts. In a new record the numbers are random. A replay
//! takes them from a record, and 0 if the record has no more. Every generator works with every record,
//! and 0 is the simplest value of each number. So the same record makes the same scene again, a
//! changed record makes another valid one (`guidance`), and a smaller record makes a simpler one
//! (`shrink`).

use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::Rng;
use std::ops::RangeInclusive;

/// A part of a record. `List` contains parts of one kind, any number of them.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Part {
    List,
    Configuration,
    Trial,
    Event,
    Fault,
    /// Messages that test one aspect of the protocol.
    Block,
    /// One kind of message in one state.
    Rule,
    Message,
}

#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Choice {
    Number(i32),
    Part(Part, Vec<Self>),
}

/// What a generator made, and its record.
#[derive(Debug, Clone, PartialEq)]
pub struct Drawn<T> {
    pub item: T,
    pub choices: Vec<Choice>,
}

#[derive(Debug, Default)]
struct OpenPart {
    recorded: Vec<Choice>,
    replayed: std::vec::IntoIter<Choice>,
    /// Number of parts that a list still gets in a new record.
    remaining: u32,
}

#[derive(Debug)]
pub struct Choices {
    /// `None` in a replay.
    random: Option<ChaCha8Rng>,
    index: u64,
    current: OpenPart,
    /// The parts that contain the current one, outermost first.
    outer: Vec<(Part, OpenPart)>,
}

impl Choices {
    /// A new record of the item with this number.
    pub(crate) fn new(random: ChaCha8Rng, index: u64) -> Self {
        Self { random: Some(random), index, current: OpenPart::default(), outer: Vec::new() }
    }

    pub(crate) fn replay(choices: &[Choice]) -> Self {
        let current = OpenPart { replayed: Vec::from(choices).into_iter(), ..OpenPart::default() };
        Self { random: None, index: 0, current, outer: Vec::new() }
    }

    /// Number of the item in a new record, otherwise 0.
    pub(crate) const fn index(&self) -> u64 {
        self.index
    }

    pub(crate) fn finish<T>(self, item: T) -> Drawn<T> {
        Drawn { item, choices: self.current.recorded }
    }

    /// A number in `range`. `new` draws it in a new record.
    pub(crate) fn number(&mut self, range: RangeInclusive<i32>, new: impl FnOnce(&mut ChaCha8Rng) -> i32) -> i32 {
        let next = self.current.replayed.as_slice().first();
        let number = match (&mut self.random, next) {
            (Some(random), _) => new(random),
            (None, Some(&Choice::Number(number))) => {
                self.current.replayed.next();
                number
            }
            (None, _) => 0,
        };
        let number = number.min(*range.end()).max(*range.start());
        self.current.recorded.push(Choice::Number(number));
        number
    }

    pub(crate) fn integer(&mut self, range: RangeInclusive<i32>) -> i32 {
        self.number(range.clone(), |random| uniform(random, &range))
    }

    /// In a new record `value`, or a random number if that is `None`.
    pub(crate) fn given(&mut self, value: Option<i32>, range: RangeInclusive<i32>) -> i32 {
        self.number(range.clone(), |random| value.unwrap_or_else(|| uniform(random, &range)))
    }

    /// `usual` in `parts[0]` of the sum of `parts`, otherwise any number.
    pub(crate) fn mostly(&mut self, usual: i32, parts: [u32; 2], range: RangeInclusive<i32>) -> i32 {
        self.number(range.clone(), |random| if weighted(random, &parts) == 0 { usual } else { uniform(random, &range) })
    }

    /// An index of `weights`.
    pub(crate) fn weighted(&mut self, weights: &[u32]) -> usize {
        self.number(0..=last(weights.len()), |random| weighted(random, weights)) as usize
    }

    /// A number below `count`.
    pub(crate) fn below(&mut self, count: usize) -> usize {
        self.integer(0..=last(count)) as usize
    }

    pub(crate) fn one_in(&mut self, count: u32) -> bool {
        self.weighted(&[count - 1, 1]) == 1
    }

    pub(crate) fn pick<T: Copy>(&mut self, all: &[T], default: T) -> T {
        let index = self.below(all.len());
        all.get(index).copied().unwrap_or(default)
    }

    /// Opens a part that every item of this generator has.
    pub(crate) fn begin(&mut self, part: Part) {
        // Numbers are left before the part if the generator took fewer than the record has.
        while let Some(Choice::Number(_)) = self.current.replayed.as_slice().first() {
            self.current.replayed.next();
        }
        if !self.begin_recorded(part) {
            self.open(part, Vec::new());
        }
    }

    /// Opens the next part of the replayed record if it has this kind.
    fn begin_recorded(&mut self, part: Part) -> bool {
        if !matches!(self.current.replayed.as_slice().first(), Some(Choice::Part(kind, _)) if *kind == part) {
            return false;
        }
        if let Some(Choice::Part(_, choices)) = self.current.replayed.next() {
            self.open(part, choices);
        }
        true
    }

    fn open(&mut self, part: Part, replayed: Vec<Choice>) {
        let inner = OpenPart { replayed: replayed.into_iter(), ..OpenPart::default() };
        self.outer.push((part, std::mem::replace(&mut self.current, inner)));
    }

    pub(crate) fn end(&mut self) {
        if let Some((part, outer)) = self.outer.pop() {
            let inner = std::mem::replace(&mut self.current, outer);
            self.current.recorded.push(Choice::Part(part, inner.recorded));
        }
    }

    /// Opens the next part of a list; false if the list ends.
    fn begin_next(&mut self, part: Part) -> bool {
        if self.random.is_none() {
            return self.begin_recorded(part);
        }
        let Some(remaining) = self.current.remaining.checked_sub(1) else { return false };
        self.current.remaining = remaining;
        self.open(part, Vec::new());
        true
    }

    fn begin_list(&mut self, counts: &RangeInclusive<u32>) {
        self.begin(Part::List);
        if let Some(random) = &mut self.random {
            self.current.remaining =
                counts.start() + below(random, (counts.end() - counts.start() + 1) as usize) as u32;
        }
    }
}

/// A generator of items with lists.
pub(crate) trait DrawLists {
    fn choices(&mut self) -> &mut Choices;

    /// Draws a list of parts. In a new record their number is in `counts`; a replayed record may have
    /// fewer, because shrinking removes parts.
    fn list(&mut self, part: Part, counts: RangeInclusive<u32>, mut draw: impl FnMut(&mut Self, usize)) {
        self.choices().begin_list(&counts);
        let mut number = 0;
        while self.choices().begin_next(part) {
            draw(self, number);
            self.choices().end();
            number += 1;
        }
        self.choices().end();
    }
}

impl DrawLists for Choices {
    fn choices(&mut self) -> &mut Choices {
        self
    }
}

fn last(count: usize) -> i32 {
    (count.saturating_sub(1) as u32).cast_signed()
}

pub(crate) fn below(random: &mut ChaCha8Rng, count: usize) -> usize {
    ((u64::from(random.next_u32()) * count as u64) >> 32) as usize
}

pub(crate) fn uniform(random: &mut ChaCha8Rng, range: &RangeInclusive<i32>) -> i32 {
    let count = range.end().abs_diff(*range.start()) as usize + 1;
    range.start().wrapping_add_unsigned(below(random, count) as u32)
}

pub(crate) fn weighted(random: &mut ChaCha8Rng, weights: &[u32]) -> i32 {
    let mut rest = below(random, weights.iter().sum::<u32>() as usize) as u32;
    let is_over = |weight: &u32| match rest.checked_sub(*weight) {
        Some(less) => {
            rest = less;
            false
        }
        None => true,
    };
    (weights.iter().position(is_over).unwrap_or(0) as u32).cast_signed()
}

/// All choices of a record, a part before what it contains, with true for parts of lists.
pub(crate) fn flat(choices: &[Choice]) -> Vec<(&Choice, bool)> {
    fn add<'a>(all: &mut Vec<(&'a Choice, bool)>, choices: &'a [Choice], is_list: bool) {
        for choice in choices {
            all.push((choice, is_list));
            if let Choice::Part(part, inner) = choice {
                add(all, inner, *part == Part::List);
            }
        }
    }
    let mut all = Vec::new();
    add(&mut all, choices, false);
    all
}

/// The parts of this kind in a record.
pub(crate) fn parts(choices: &[Choice], kind: Part) -> Vec<&[Choice]> {
    let all = flat(choices).into_iter();
    all.filter_map(|(choice, _)| match choice {
        Choice::Part(part, inner) if *part == kind => Some(&inner[..]),
        _ => None,
    })
    .collect()
}

/// Calls `change` for all choices in the order of [`flat`]. It returns false to remove the choice.
pub(crate) fn change_each(choices: &mut Vec<Choice>, change: &mut dyn FnMut(&mut Choice, bool) -> bool) {
    fn inside(choices: &mut Vec<Choice>, is_list: bool, change: &mut dyn FnMut(&mut Choice, bool) -> bool) {
        choices.retain_mut(|choice| {
            let is_kept = change(choice, is_list);
            if let Choice::Part(part, inner) = choice {
                inside(inner, *part == Part::List, change);
            }
            is_kept
        });
    }
    inside(choices, false, change);
}

/// Kinds of parts that another record may give.
const EXCHANGED: [Part; 5] = [Part::Configuration, Part::Trial, Part::Event, Part::Fault, Part::Block];

/// Replaces a random part of `choices` by a random part of the same kind of `donor`.
pub(crate) fn exchange(choices: &mut Vec<Choice>, donor: &[Choice], random: &mut ChaCha8Rng) {
    let has = |kind: &Part| [&choices[..], donor].iter().all(|record| !parts(record, *kind).is_empty());
    let kinds: Vec<_> = EXCHANGED.into_iter().filter(has).collect();
    let Some(&kind) = kinds.get(below(random, kinds.len())) else { return };
    let mut until = below(random, parts(choices, kind).len());
    let given = parts(donor, kind);
    let given = given.get(below(random, given.len())).copied().unwrap_or_default();
    change_each(choices, &mut |choice, _| {
        if let Choice::Part(part, inner) = choice
            && *part == kind
        {
            if until == 0 {
                *inner = given.to_vec();
            }
            until = until.wrapping_sub(1);
        }
        true
    });
}
