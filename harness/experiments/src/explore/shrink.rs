//! Makes a failing scene or sequence of messages minimal, by its record of choices: without parts of
//! lists, and with smaller numbers.

use crate::explore::choices::{Choice, Drawn, Part, change_each, flat, parts};
use crate::explore::exploration::{ExploreConfig, FailedScene, FailedSequence};
use crate::explore::player::{ExploreError, SceneFailure, ScenePlayer};
use crate::explore::properties::{Demand, Property};
use crate::explore::scene::{Relation, Scene};
use platebench_engine::RunError;
use platebench_model::scenario::ScenarioMessage;
use std::ops::Range;
use std::time::{Duration, Instant};

const MAX_REPLAYS: u32 = 2_000;
/// Largest number of trials between two judged trials.
const MAX_EARLIER: usize = 16;

#[derive(Debug, Clone)]
pub struct MinimalScene {
    pub scene: Scene,
    /// The violated demand, or all demands of the property if several are possible.
    pub demands: Vec<Demand>,
    pub failure: SceneFailure,
    /// False if the scene did not fail again with a new controller. It is then not minimal.
    pub is_reproduced: bool,
    pub replays: u32,
}

impl MinimalScene {
    /// The scene that failed, if it was not played again or did not fail again.
    pub(crate) fn original(config: &ExploreConfig, failed: &FailedScene, property: Property) -> Self {
        Self {
            scene: failed.scene.clone(),
            demands: config.demands(&failed.scene),
            failure: failed.failure_of(property).cloned().unwrap_or_else(|| SceneFailure::unknown(property)),
            is_reproduced: false,
            replays: 0,
        }
    }
}

/// Searches the smallest scene that violates the property, for at most `time`. Each candidate is played
/// with a new controller.
pub fn shrink_scene(
    config: &ExploreConfig,
    player: &mut ScenePlayer<'_>,
    failed: &FailedScene,
    property: Property,
    time: Duration,
) -> Result<MinimalScene, ExploreError> {
    let generator = config.generator();
    let mut fails = |scene: &Scene| {
        let scenario = config.scenario(scene, "Replay").check()?;
        player.renew();
        let result = player.play(&scenario)?.ok_or(RunError::Cancelled)?;
        Ok(result.failure_of(property).cloned())
    };
    let build = |choices: &[Choice]| generator.replay(choices);
    let mut shrinker = Shrinker { build: &build, fails: &mut fails, deadline: Instant::now() + time, replays: 0 };
    // A scene may fail only after trials of earlier scenes with the same controller.
    let mut earlier = Vec::new();
    let alone = [failed.choices.clone()].into_iter();
    let after_others = failed.history.iter().rev().map(|scene| {
        earlier.splice(0..0, trials(scene));
        earlier.drain(..earlier.len().saturating_sub(MAX_EARLIER));
        with_earlier(&failed.choices, &earlier)
    });
    let mut best = None;
    for candidate in alone.chain(after_others) {
        best = shrinker.reproduce(&candidate)?;
        if best.is_some() {
            break;
        }
    }
    let Some(mut best) = best else {
        return Ok(MinimalScene { replays: shrinker.replays, ..MinimalScene::original(config, failed, property) });
    };
    shrinker.shrink(&mut best)?;
    let Smallest { drawn: Drawn { item: scene, .. }, failure } = best;
    let demands = violated_demands(config.demands(&scene), &scene, &failure);
    Ok(MinimalScene { scene, demands, failure, is_reproduced: true, replays: shrinker.replays })
}

/// The demand that `failure` names, with the demand of the scene's relation.
fn violated_demands(demands: Vec<Demand>, scene: &Scene, failure: &SceneFailure) -> Vec<Demand> {
    let property = failure.property;
    let relation = scene.relation.map(Relation::property).filter(|relation| *relation != property);
    let (of_property, others): (Vec<_>, Vec<_>) = demands.into_iter().partition(|demand| demand.property == property);
    let of_relation = others.into_iter().filter(|demand| Some(demand.property) == relation);
    let number = failure.name.rsplit(' ').next().and_then(|number| number.parse::<usize>().ok());
    let only = number.and_then(|number| of_property.get(number - 1)).copied();
    only.map_or(of_property, |only| vec![only]).into_iter().chain(of_relation).collect()
}

/// A sequence of messages, with the difference if it failed again, and the number of replays.
pub type MinimalSequence = (Vec<ScenarioMessage>, Option<String>, u32);

/// As [`shrink_scene`], for a sequence of messages.
pub fn shrink_sequence(
    config: &ExploreConfig,
    player: &mut ScenePlayer<'_>,
    failed: &FailedSequence,
    property: Property,
    time: Duration,
) -> Result<MinimalSequence, ExploreError> {
    let none = (failed.messages.clone(), None, 0);
    let Some(limits) = &config.sequences else { return Ok(none) };
    let mut fails = |messages: &Vec<ScenarioMessage>| {
        // Without messages, the scenario would play the scripts of the protocol check.
        if messages.is_empty() {
            return Ok(None);
        }
        // A candidate may be invalid, for example if the messages before an `again` are gone.
        let Ok(scenario) = config.sequence_scenario(messages, "Replay", "").check() else { return Ok(None) };
        player.renew();
        let result = player.play(&scenario)?.ok_or(RunError::Cancelled)?;
        let failure = result.failure_of(property).map(|failure| failure.name.clone());
        Ok(failure.map(|name| result.differences.into_iter().next().unwrap_or(name)))
    };
    let build = |choices: &[Choice]| limits.replay(choices);
    let mut shrinker = Shrinker { build: &build, fails: &mut fails, deadline: Instant::now() + time, replays: 0 };
    let Some(mut best) = shrinker.reproduce(&failed.choices)? else { return Ok(none) };
    shrinker.shrink(&mut best)?;
    Ok((best.drawn.item, Some(best.failure), shrinker.replays))
}

/// The trials of a scene as earlier trials, each with its own configuration.
fn trials(scene: &[Choice]) -> Vec<Choice> {
    let trials = parts(scene, Part::Trial);
    let Some((&judged, earlier)) = trials.split_first() else { return Vec::new() };
    let with_configuration = |trial: &[Choice]| match trial.split_first() {
        Some((Choice::Number(0), rest)) => [judged.get(..2).unwrap_or_default(), rest].concat(),
        _ => trial.to_vec(),
    };
    let in_order = earlier.iter().copied().chain([judged]);
    in_order.map(|trial| Choice::Part(Part::Trial, with_configuration(trial))).collect()
}

/// The choices of a scene with other earlier trials, which are its first list.
fn with_earlier(scene: &[Choice], earlier: &[Choice]) -> Vec<Choice> {
    let mut scene = scene.to_vec();
    let list = scene.iter_mut().find(|choice| matches!(choice, Choice::Part(Part::List, _)));
    if let Some(list) = list {
        *list = Choice::Part(Part::List, earlier.to_vec());
    }
    scene
}

/// The smallest item that failed.
struct Smallest<T, F> {
    drawn: Drawn<T>,
    failure: F,
}

struct Shrinker<'a, T, F> {
    build: &'a dyn Fn(&[Choice]) -> Drawn<T>,
    fails: &'a mut dyn FnMut(&T) -> Result<Option<F>, ExploreError>,
    deadline: Instant,
    replays: u32,
}

impl<T, F> Shrinker<'_, T, F> {
    fn reproduce(&mut self, choices: &[Choice]) -> Result<Option<Smallest<T, F>>, ExploreError> {
        self.play((self.build)(choices))
    }

    fn play(&mut self, drawn: Drawn<T>) -> Result<Option<Smallest<T, F>>, ExploreError> {
        self.replays += 1;
        let failure = (self.fails)(&drawn.item)?;
        Ok(failure.map(|failure| Smallest { drawn, failure }))
    }

    fn is_over(&self) -> bool {
        self.replays >= MAX_REPLAYS || Instant::now() >= self.deadline
    }

    /// Changes `best` until no single change makes it smaller.
    fn shrink(&mut self, best: &mut Smallest<T, F>) -> Result<(), ExploreError> {
        let mut has_changed = true;
        while has_changed && !self.is_over() {
            has_changed = self.try_runs(best, count_elements, without_elements)?;
            has_changed |= self.try_runs(best, count_numbers, with_zeros)?;
            let mut at = 0;
            while at < count_numbers(&best.drawn.choices) {
                has_changed |= self.lower(best, at)?;
                at += 1;
            }
        }
        Ok(())
    }

    /// Tries `change` with runs of places, long ones first.
    fn try_runs(
        &mut self,
        best: &mut Smallest<T, F>,
        count: fn(&[Choice]) -> usize,
        change: fn(&[Choice], Range<usize>) -> Vec<Choice>,
    ) -> Result<bool, ExploreError> {
        let mut has_changed = false;
        let mut run = count(&best.drawn.choices);
        while run > 0 {
            let mut at = 0;
            while at < count(&best.drawn.choices) {
                if self.try_choices(best, &change(&best.drawn.choices, at..at + run))? {
                    has_changed = true;
                } else {
                    at += run;
                }
            }
            run /= 2;
        }
        Ok(has_changed)
    }

    /// Lowers the number at a place as far as possible.
    fn lower(&mut self, best: &mut Smallest<T, F>, at: usize) -> Result<bool, ExploreError> {
        let mut has_changed = false;
        while let Some(number) = number_at(&best.drawn.choices, at) {
            let lower = [0, number / 2, number - number / 4, number - number / 16, number - number / 256];
            let mut is_lower = false;
            for lower in lower.into_iter().chain([number - number.signum(), number.saturating_abs()]) {
                is_lower = self.try_choices(best, &with_number(&best.drawn.choices, at, lower))?;
                if is_lower {
                    break;
                }
            }
            if !is_lower {
                break;
            }
            has_changed = true;
        }
        Ok(has_changed)
    }

    /// Returns true if the choices make a smaller item that fails, which is then the best one.
    fn try_choices(&mut self, best: &mut Smallest<T, F>, choices: &[Choice]) -> Result<bool, ExploreError> {
        if self.is_over() {
            return Ok(false);
        }
        let drawn = (self.build)(choices);
        if size(&drawn.choices) >= size(&best.drawn.choices) {
            return Ok(false);
        }
        let smaller = self.play(drawn)?;
        let is_smaller = smaller.is_some();
        if let Some(smaller) = smaller {
            *best = smaller;
        }
        Ok(is_smaller)
    }
}

/// The number of choices, then each number: distance from 0, and whether it is negative.
fn size(choices: &[Choice]) -> (usize, Vec<(u32, bool)>) {
    let all = flat(choices);
    let number = |(choice, _): &(&Choice, bool)| match choice {
        Choice::Number(number) => Some((number.unsigned_abs(), *number < 0)),
        Choice::Part(..) => None,
    };
    (all.len(), all.iter().filter_map(number).collect())
}

fn count_elements(choices: &[Choice]) -> usize {
    flat(choices).iter().filter(|(_, is_element)| *is_element).count()
}

fn without_elements(choices: &[Choice], removed: Range<usize>) -> Vec<Choice> {
    let (mut choices, mut count) = (choices.to_vec(), 0);
    change_each(&mut choices, &mut |_, is_element| {
        count += usize::from(is_element);
        !(is_element && removed.contains(&(count - 1)))
    });
    choices
}

fn count_numbers(choices: &[Choice]) -> usize {
    size(choices).1.len()
}

fn with_zeros(choices: &[Choice], places: Range<usize>) -> Vec<Choice> {
    with_numbers(choices, places, 0)
}

fn with_number(choices: &[Choice], at: usize, number: i32) -> Vec<Choice> {
    with_numbers(choices, at..at + 1, number)
}

fn with_numbers(choices: &[Choice], places: Range<usize>, to: i32) -> Vec<Choice> {
    let (mut choices, mut at) = (choices.to_vec(), 0);
    change_each(&mut choices, &mut |choice, _| {
        if let Choice::Number(number) = choice {
            *number = if places.contains(&at) { to } else { *number };
            at += 1;
        }
        true
    });
    choices
}

fn number_at(choices: &[Choice], at: usize) -> Option<i32> {
    let &(distance, is_negative) = size(choices).1.get(at)?;
    Some(if is_negative { 0_i32.wrapping_sub_unsigned(distance) } else { distance.cast_signed() })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::explore::choices::{Choices, DrawLists};
    use crate::explore::guidance::random_numbers;

    /// A flag, then at most nine numbers.
    fn draw(mut choices: Choices) -> Drawn<(bool, Vec<i32>)> {
        let flag = choices.one_in(2);
        let mut numbers = Vec::new();
        choices.list(Part::Message, 5..=9, |choices, _| numbers.push(choices.integer(-500..=500)));
        choices.finish((flag, numbers))
    }

    type Item = (bool, Vec<i32>);

    /// The smallest item that `fails`, from the first drawn one that does.
    fn smallest(fails: fn(&Item) -> bool) -> Item {
        let mut play = |item: &Item| Ok(fails(item).then_some(()));
        let build = |choices: &[Choice]| draw(Choices::replay(choices));
        let deadline = Instant::now() + Duration::from_hours(1);
        let mut shrinker = Shrinker { build: &build, fails: &mut play, deadline, replays: 0 };
        let mut all = (0..).map(|index| draw(Choices::new(random_numbers("shrink", 1, index), index)));
        let first = all.find(|drawn| fails(&drawn.item)).unwrap();
        assert_eq!(build(&first.choices), first);
        let mut best = shrinker.reproduce(&first.choices).unwrap().unwrap();
        shrinker.shrink(&mut best).unwrap();
        best.drawn.item
    }

    #[test]
    fn removes_parts_and_lowers_numbers() {
        assert_eq!(smallest(|(_, numbers)| numbers.iter().any(|number| *number > 36)), (false, vec![37]));
        assert_eq!(smallest(|(_, numbers)| numbers.iter().any(|number| *number < -36)), (false, vec![-37]));
        assert_eq!(smallest(|(flag, numbers)| *flag && numbers.len() > 2), (true, vec![0; 3]));
        let (_, numbers) = smallest(|(_, numbers)| numbers.iter().sum::<i32>() > 600);
        assert_eq!(numbers.iter().sum::<i32>(), 601);
        assert_eq!(smallest(|_| true), (false, Vec::new()));
    }

    #[test]
    fn ends_after_the_largest_number_of_replays() {
        let mut count = 0;
        let mut play = |_: &Item| {
            count += 1;
            Ok((count == 1).then_some(()))
        };
        let build = |choices: &[Choice]| draw(Choices::replay(choices));
        let deadline = Instant::now() + Duration::from_hours(1);
        let mut shrinker = Shrinker { build: &build, fails: &mut play, deadline, replays: MAX_REPLAYS - 3 };
        let drawn = draw(Choices::new(random_numbers("shrink", 1, 1), 1));
        let mut best = shrinker.reproduce(&drawn.choices).unwrap().unwrap();
        shrinker.shrink(&mut best).unwrap();
        assert_eq!((best.drawn, count), (drawn, 3));
    }
}
