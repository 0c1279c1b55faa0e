//! Makes a failing scene minimal: fewer trials, events and digits, and a shorter trial. Makes a
//! failing sequence of messages minimal.

use crate::explore::exploration::{ExploreConfig, FailedScene};
use crate::explore::player::ExploreError;
use crate::explore::player::{Player, SceneFailure};
use crate::explore::properties::{Demand, Property};
use crate::explore::scene::{Course, Relation, Scene, SceneTrial, Tuning};
use crate::explore::sequence::NONE;
use platebench_model::scenario::{ConfigurationChange, ScenarioMessage};
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

/// Replays candidates with new controllers until the time is used.
pub struct Shrinker<'a, 'p> {
    pub config: &'a ExploreConfig,
    pub player: &'a mut Player<'p>,
    pub deadline: Instant,
    replays: u32,
}

impl<'a, 'p> Shrinker<'a, 'p> {
    /// `time` limits the search, counted from now.
    pub fn new(config: &'a ExploreConfig, player: &'a mut Player<'p>, time: Duration) -> Self {
        Self { config, player, deadline: Instant::now() + time, replays: 0 }
    }

    /// Searches the smallest scene that violates the property.
    pub fn shrink(&mut self, failed: &FailedScene, property: Property) -> Result<MinimalScene, ExploreError> {
        self.replays = 0;
        let original = failed.scene.clone();
        let Some((earlier, mut best)) = self.reproduce(&original, failed, property)? else {
            let none = SceneFailure { property, name: String::new(), value: None, limit: None };
            let failure = failed.failure_of(property).cloned().unwrap_or(none);
            let demands = self.config.demands(&original);
            return Ok(MinimalScene { scene: original, demands, failure, is_reproduced: false, replays: self.replays });
        };
        // First removes the check of the protocol, because it takes most of the time of a replay.
        let mut script_seed = original.script_seed;
        if script_seed.is_some() {
            let scene = Scene { script_seed: None, ..best.0.clone() };
            if let Some(failure) = self.replay(&scene, property)? {
                (best, script_seed) = ((scene, failure), None);
            }
        }
        let candidate = |scene: Scene| {
            let scene = Scene { script_seed: scene.script_seed.and(script_seed), ..scene };
            match &earlier {
                Some(earlier) => Scene { earlier: earlier.clone(), count: 2, ..scene },
                None => scene,
            }
        };
        // A derived scene has no drawn numbers of its own.
        let mut tree = self.config.generator().tree(failed.index).map_err(ExploreError::Strategy)?;
        if tree.current() == original && tree.simplify() {
            loop {
                let scene = candidate(tree.current());
                let failure = self.replay(&scene, property)?;
                let goes_on = if let Some(failure) = failure {
                    best = (scene, failure);
                    tree.simplify()
                } else {
                    tree.complicate()
                };
                if !goes_on || self.is_over() {
                    break;
                }
            }
        }
        self.simplify_directly(&mut best, property)?;
        let (scene, failure) = best;
        let demands = self.config.demands(&scene);
        let relation = scene.relation.map(Relation::property).filter(|relation| *relation != property);
        let (of_property, others): (Vec<_>, Vec<_>) =
            demands.into_iter().partition(|demand| demand.property == property);
        let of_relation = others.into_iter().filter(|demand| Some(demand.property) == relation);
        let number = failure.name.rsplit(' ').next().and_then(|number| number.parse::<usize>().ok());
        let only = number.and_then(|number| of_property.get(number - 1)).copied();
        let demands = only.map_or(of_property, |only| vec![only]);
        let demands = demands.into_iter().chain(of_relation).collect();
        Ok(MinimalScene { scene, demands, failure, is_reproduced: true, replays: self.replays })
    }

    /// Finds out whether the scene fails with a new controller, alone or after trials of earlier
    /// scenes. `None` if it does not fail.
    #[expect(clippy::type_complexity, reason = "history, scene and failure belong together here only")]
    fn reproduce(
        &mut self,
        original: &Scene,
        failed: &FailedScene,
        property: Property,
    ) -> Result<Option<(Option<Vec<SceneTrial>>, (Scene, SceneFailure))>, ExploreError> {
        if let Some(failure) = self.replay(original, property)? {
            return Ok(Some((None, (original.clone(), failure))));
        }
        let mut trials = Vec::new();
        for scene in failed.history.iter().rev() {
            trials.splice(0..0, scene.earlier.iter().chain([&scene.judged]).cloned());
            trials.drain(..trials.len().saturating_sub(MAX_EARLIER));
            let scene = Scene { earlier: trials.clone(), count: 2, ..original.clone() };
            if let Some(failure) = self.replay(&scene, property)? {
                let (earlier, best) = self.remove_earlier(scene, failure, property)?;
                return Ok(Some((Some(earlier), best)));
            }
        }
        Ok(None)
    }

    fn remove_earlier(
        &mut self,
        scene: Scene,
        failure: SceneFailure,
        property: Property,
    ) -> Result<(Vec<SceneTrial>, (Scene, SceneFailure)), ExploreError> {
        let mut best = (scene, failure);
        let mut chunk = best.0.earlier.len().div_ceil(2);
        while chunk > 0 && !self.is_over() {
            let mut at = 0;
            while at < best.0.earlier.len() {
                let mut scene = best.0.clone();
                let end = (at + chunk).min(scene.earlier.len());
                scene.earlier.drain(at..end);
                match self.replay(&scene, property)? {
                    Some(failure) if !scene.earlier.is_empty() => best = (scene, failure),
                    _ => at = end,
                }
            }
            chunk /= 2;
        }
        Ok((best.0.earlier.clone(), best))
    }

    /// Tries changes that shrinking of drawn numbers cannot make: rounder values, fewer points, an
    /// earlier end.
    fn simplify_directly(&mut self, best: &mut (Scene, SceneFailure), property: Property) -> Result<(), ExploreError> {
        let mut has_changed = true;
        while has_changed && !self.is_over() {
            has_changed = false;
            for scene in simpler_scenes(&best.0, self.end_of(best, property)) {
                if scene == best.0 || self.is_over() {
                    continue;
                }
                if let Some(failure) = self.replay(&scene, property)? {
                    *best = (scene, failure);
                    has_changed = true;
                    break;
                }
            }
        }
        Ok(())
    }

    /// End, µs, of the first window with a demand of `property`.
    fn end_of(&self, best: &(Scene, SceneFailure), property: Property) -> Option<u32> {
        let demands = self.config.demands(&best.0);
        demands.iter().filter(|demand| demand.property == property).map(|demand| demand.until_us).min()
    }

    fn is_over(&self) -> bool {
        self.replays >= MAX_REPLAYS || Instant::now() >= self.deadline
    }

    /// Plays `scene` with a new controller. `None` if it does not violate `property`.
    fn replay(&mut self, scene: &Scene, property: Property) -> Result<Option<SceneFailure>, ExploreError> {
        self.replays += 1;
        let scenario = self.config.scenario(scene, "Replay").check()?;
        self.player.renew();
        let result = self.player.play(&scenario)?.ok_or(ExploreError::Cancelled)?;
        Ok(result.failure_of(property).cloned())
    }
}

fn simpler_scenes(scene: &Scene, end_us: Option<u32>) -> Vec<Scene> {
    let mut scenes = Vec::new();
    if scene.script_seed.is_some() {
        scenes.push(Scene { script_seed: None, ..scene.clone() });
    }
    if scene.relation.is_some() {
        let count = if scene.earlier.is_empty() { 1 } else { scene.count };
        scenes.push(Scene { relation: None, count, ..scene.clone() });
    }
    if scene.count > 1 && scene.earlier.is_empty() && scene.relation.is_none() {
        scenes.push(Scene { count: scene.count - 1, ..scene.clone() });
    }
    if scene.count > 1 && !scene.earlier.is_empty() {
        let count = if scene.relation.is_some() { 2 } else { 1 };
        scenes.push(Scene { count, earlier: Vec::new(), ..scene.clone() });
    }
    scenes.extend((0..scene.earlier.len()).map(|index| {
        let mut scene = scene.clone();
        scene.earlier.remove(index);
        scene
    }));
    scenes.retain(|candidate| {
        let has_second = candidate.relation.is_some() || !candidate.earlier.is_empty();
        candidate.count == 1 || scene.earlier.is_empty() || has_second
    });
    let variants = simpler_trials(&scene.judged, end_us);
    scenes.extend(variants.into_iter().map(|judged| Scene { judged, ..scene.clone() }));
    for (index, earlier) in scene.earlier.iter().enumerate() {
        for variant in simpler_trials(earlier, None) {
            let mut scene = scene.clone();
            if let Some(place) = scene.earlier.get_mut(index) {
                *place = variant;
            }
            scenes.push(scene);
        }
    }
    scenes
}

fn simpler_trials(trial: &SceneTrial, end_us: Option<u32>) -> Vec<SceneTrial> {
    let mut trials = Vec::new();
    if let Some(end_us) = end_us.filter(|end| *end < trial.duration_us) {
        trials.push(cut(trial, end_us));
    }
    let ms = trial.duration_us / 1_000;
    trials.push(SceneTrial { duration_us: (ms * 1_000).max(trial.period_us), ..trial.clone() });
    let points = trial.setpoint.points();
    let with = |points: Vec<(u32, i32)>| {
        let is_linear = matches!(trial.setpoint, Course::Linear(_));
        let setpoint = if is_linear { Course::Linear(points) } else { Course::Hold(points) };
        SceneTrial { setpoint, ..trial.clone() }
    };
    if let Course::Linear(points) = &trial.setpoint {
        // Steps at the ends of the ramps.
        let mut steps = points.clone();
        steps.dedup_by_key(|(_, level)| *level);
        trials.push(SceneTrial { setpoint: Course::Hold(steps), ..trial.clone() });
    }
    for index in 0..points.len().saturating_sub(1) {
        let mut points = points.to_vec();
        let (at, _) = points.remove(index);
        // The next level starts at the instant of the removed level.
        if let Some(next) = points.get_mut(index) {
            next.0 = at;
        }
        trials.push(with(points));
    }
    for index in 1..points.len() {
        let mut points = points.to_vec();
        points.remove(index);
        trials.push(with(points));
    }
    for index in 0..trial.faults.len() {
        let mut faults = trial.faults.clone();
        faults.remove(index);
        trials.push(SceneTrial { faults, ..trial.clone() });
    }
    if trial.tuning != Tuning::default() {
        trials.push(SceneTrial { tuning: Tuning::default(), ..trial.clone() });
    }
    let constant = Course::Hold(vec![(0, 0)]);
    if trial.force != constant {
        trials.push(SceneTrial { force: constant.clone(), ..trial.clone() });
    }
    if trial.temperature != constant {
        trials.push(SceneTrial { temperature: constant, ..trial.clone() });
    }
    for (digits, at_digits) in [(500, 5_000), (100, 1_000), (10, 500)] {
        let round = |value: i32, to: i32| (value + to / 2) / to * to;
        let rounded: Vec<_> = points
            .iter()
            .map(|(at, level)| {
                let level = if *level == 0 { 0 } else { round(*level, digits).max(digits) };
                (round(at.cast_signed(), at_digits).cast_unsigned(), level)
            })
            .collect();
        if rounded.is_sorted_by(|one, other| one.0 < other.0)
            && rounded.last().is_none_or(|last| last.0 < trial.duration_us)
        {
            trials.push(with(rounded));
        }
    }
    trials
}

fn cut(trial: &SceneTrial, end_us: u32) -> SceneTrial {
    let mut cut = SceneTrial { duration_us: end_us, ..trial.clone() };
    cut.faults.retain(|fault| fault.until_us < end_us);
    for course in [&mut cut.setpoint, &mut cut.force, &mut cut.temperature] {
        match course {
            Course::Hold(points) => points.retain(|(at, _)| *at < end_us),
            Course::Linear(points) => {
                let kept = points.partition_point(|(at, _)| *at < end_us);
                points.truncate(kept + 1);
            }
            Course::Sine { .. } => {}
        }
    }
    cut
}

/// Plays a sequence with a new controller. Returns the difference if it fails.
type FailsAgain<'a> = dyn FnMut(&[ScenarioMessage]) -> Result<Option<String>, ExploreError> + 'a;

/// Makes a failing sequence minimal. `fails` plays a candidate with a new controller. Returns the
/// sequence, and the difference of its last play if the first candidate fails.
pub(crate) fn shrink_messages(
    messages: Vec<ScenarioMessage>,
    deadline: Instant,
    fails: &mut FailsAgain<'_>,
) -> Result<(Vec<ScenarioMessage>, Option<String>), ExploreError> {
    let Some(mut text) = fails(&messages)? else { return Ok((messages, None)) };
    let mut best = messages;
    let mut has_changed = true;
    while has_changed && Instant::now() < deadline {
        has_changed = false;
        let mut chunk = best.len().div_ceil(2);
        while chunk > 0 {
            let mut at = 1;
            while at < best.len() && Instant::now() < deadline {
                let mut candidate = best.clone();
                candidate.drain(at..(at + chunk).min(best.len()));
                match fails(&candidate)? {
                    Some(new) => (best, text, has_changed) = (candidate, new, true),
                    None => at += chunk,
                }
            }
            chunk /= 2;
        }
        for index in 0..best.len() {
            for simpler in simpler_messages(best.get(index)) {
                if Instant::now() >= deadline {
                    break;
                }
                let mut candidate = best.clone();
                candidate.get_mut(index).into_iter().for_each(|message| *message = simpler.clone());
                if let Some(new) = fails(&candidate)? {
                    (best, text, has_changed) = (candidate, new, true);
                    break;
                }
            }
        }
    }
    Ok((best, Some(text)))
}

/// Simpler messages in place of `message`, the simplest first.
fn simpler_messages(message: Option<&ScenarioMessage>) -> Vec<ScenarioMessage> {
    let usual = ScenarioMessage::sample(2.0, 1.2, -0.2);
    match message {
        Some(ScenarioMessage::Configure(change)) if *change != NONE => {
            let with =
                |simpler: ConfigurationChange| (simpler != *change).then_some(ScenarioMessage::Configure(simpler));
            [NONE, ConfigurationChange { gains: None, ..*change }, ConfigurationChange { law: None, ..*change }]
                .into_iter()
                .filter_map(with)
                .collect()
        }
        Some(ScenarioMessage::Sample { .. }) if message != Some(&usual) => vec![usual],
        Some(ScenarioMessage::Again { messages, times }) if *times > 1 => {
            let shorter = [times / 2, times - times / 4, times - times / 16, times - times / 256, times - 1];
            let again = |times| ScenarioMessage::Again { messages: *messages, times };
            shorter.into_iter().filter(|shorter| shorter < times).map(again).collect()
        }
        Some(ScenarioMessage::Damaged { byte }) if *byte != 5 => vec![ScenarioMessage::Damaged { byte: 5 }],
        Some(ScenarioMessage::Body { .. } | ScenarioMessage::Bytes { .. }) => {
            vec![ScenarioMessage::Damaged { byte: 5 }]
        }
        _ => Vec::new(),
    }
}
