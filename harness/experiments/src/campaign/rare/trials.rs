//! Plays the trials of one chain, and computes with points of standard normal space.

/// Plays a trial at a point of standard normal space. Returns the scores of its limit states, or
/// `None` after a cancellation. The trial fails if the first score is at most 0. If there are
/// further scores, they are those of the expectations.
pub(crate) type Play<'a> = dyn FnMut(&[f64]) -> Option<Vec<f64>> + 'a;

pub(super) struct Trials<'a> {
    play: &'a mut Play<'a>,
    left: u64,
    used: u64,
    /// All failing points, in the order of their trials.
    pub(super) failing: Vec<Vec<f64>>,
}

impl<'a> Trials<'a> {
    pub(super) fn new(trials: u64, play: &'a mut Play<'a>) -> Self {
        Self { play, left: trials, used: 0, failing: Vec::new() }
    }

    pub(super) const fn left(&self) -> u64 {
        self.left
    }

    pub(super) const fn used(&self) -> u64 {
        self.used
    }

    /// `None` after the last trial.
    pub(super) fn play(&mut self, point: &[f64]) -> Option<Vec<f64>> {
        self.left = self.left.checked_sub(1)?;
        self.used += 1;
        let scores = (self.play)(point)?;
        if is_failure(&scores) {
            self.failing.push(point.to_vec());
        }
        Some(scores)
    }
}

pub(super) fn is_failure(scores: &[f64]) -> bool {
    scores.first().is_some_and(|score| *score <= 0.0)
}

pub(super) fn toward(from: &[f64], to: &[f64], share: f64) -> Vec<f64> {
    from.iter().zip(to).map(|(from, to)| from + (to - from) * share).collect()
}

pub(super) fn dot(one: &[f64], other: &[f64]) -> f64 {
    one.iter().zip(other).map(|(one, other)| one * other).sum()
}

pub(super) fn norm(point: &[f64]) -> f64 {
    dot(point, point).sqrt()
}

pub(super) fn distance(one: &[f64], other: &[f64]) -> f64 {
    one.iter().zip(other).map(|(one, other)| (one - other).powi(2)).sum::<f64>().sqrt()
}
