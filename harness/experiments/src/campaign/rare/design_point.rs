//! Searches design points by FORM (first-order reliability method).
//!
//! A design point is the failing point of one limit state with the smallest norm β: R. Rackwitz and
//! B. Fiessler, *Computers and Structures* 9, 1978, pp. 489-494. In addition, a step that increases
//! the magnitude of the score is halved. Each limit state is searched alone, because the smallest
//! score of all has the slope of one of them only.

use super::trials::{Trials, distance, dot, norm, toward};

/// Step of the difference quotients, standard deviations. It is large to average noise.
const GRADIENT_STEP: f64 = 0.1;
const MAX_ITERATIONS: usize = 12;
const MAX_HALVINGS: u32 = 4;
/// Longest step of an iteration, standard deviations.
const MAX_STEP: f64 = 3.0;
/// Tolerance of the score at the design point, relative to the score at the centre.
const SCORE_TOLERANCE: f64 = 0.02;
const POINT_TOLERANCE: f64 = 0.15;
/// Largest norm β of a design point. Failures beyond it have a probability below 10⁻¹⁴.
const MAX_INDEX: f64 = 8.0;
/// A smaller slope, relative to the score at the centre and one standard deviation, is none.
const MIN_SLOPE: f64 = 1e-3;
/// A limit state that is linear doubles its score at the mirrored design point. Below this factor
/// the other side is searched too.
const MIRRORED_FACTOR: f64 = 1.5;

/// The design points of all limit states whose search converges, and `false` if a search was left
/// out because `max_trials` were used. `None` if the trials end.
pub(super) fn find_design_points(
    centre_scores: &[f64],
    max_trials: u64,
    trials: &mut Trials<'_>,
    dimensions: usize,
) -> Option<(Vec<Vec<f64>>, bool)> {
    let centre = vec![0.0; dimensions];
    // With several expectations, the first score is the smallest of the others.
    let limits = if centre_scores.len() > 1 { 1..centre_scores.len() } else { 0..centre_scores.len() };
    let slopes = slopes(&centre, centre_scores, trials)?;
    let (mut points, mut is_complete) = (Vec::new(), true);
    for limit in limits {
        let at_centre = centre_scores.get(limit).copied().unwrap_or_default();
        if at_centre <= 0.0 {
            continue;
        }
        if trials.used() > max_trials {
            is_complete = false;
            break;
        }
        let search = Search { limit, at_centre, max_trials };
        let Ok(found) = search.descend(centre.clone(), at_centre, Some(slope_of(&slopes, limit)), trials)? else {
            continue;
        };
        let mirrored: Vec<f64> = found.iter().map(|value| -value).collect();
        points.push(found);
        let at_mirrored = trials.play(&mirrored)?.get(limit).copied()?;
        if at_mirrored < MIRRORED_FACTOR * at_centre {
            points.extend(search.descend(mirrored, at_mirrored, None, trials)?);
        }
    }
    Some((points, is_complete))
}

/// Difference quotients of all scores, one list per axis.
fn slopes(point: &[f64], scores: &[f64], trials: &mut Trials<'_>) -> Option<Vec<Vec<f64>>> {
    let mut slopes = Vec::with_capacity(point.len());
    for axis in 0..point.len() {
        let mut moved = point.to_vec();
        if let Some(coordinate) = moved.get_mut(axis) {
            *coordinate += GRADIENT_STEP;
        }
        let quotients = trials.play(&moved)?.iter().zip(scores).map(|(to, from)| (to - from) / GRADIENT_STEP).collect();
        slopes.push(quotients);
    }
    Some(slopes)
}

fn slope_of(slopes: &[Vec<f64>], limit: usize) -> Vec<f64> {
    slopes.iter().map(|scores| scores.get(limit).copied().unwrap_or_default()).collect()
}

struct NotConverged;

struct Search {
    limit: usize,
    at_centre: f64,
    max_trials: u64,
}

impl Search {
    /// `None` if the trials end.
    fn descend(
        &self,
        mut point: Vec<f64>,
        mut value: f64,
        mut first_slope: Option<Vec<f64>>,
        trials: &mut Trials<'_>,
    ) -> Option<Result<Vec<f64>, NotConverged>> {
        let mut all = vec![0.0; self.limit + 1];
        for _ in 0..MAX_ITERATIONS {
            if trials.used() > self.max_trials {
                return Some(Err(NotConverged));
            }
            if let Some(own) = all.get_mut(self.limit) {
                *own = value;
            }
            let gradient = match first_slope.take() {
                Some(slope) => slope,
                None => slope_of(&slopes(&point, &all, trials)?, self.limit),
            };
            let square = dot(&gradient, &gradient);
            if square.sqrt() < self.at_centre * MIN_SLOPE {
                return Some(Err(NotConverged));
            }
            let scale = (dot(&gradient, &point) - value) / square;
            let target: Vec<f64> = gradient.iter().map(|slope| slope * scale).collect();
            let mut share = (MAX_STEP / distance(&target, &point)).min(1.0);
            let mut next = toward(&point, &target, share);
            let mut at_next = trials.play(&next)?.get(self.limit).copied()?;
            for _ in 0..MAX_HALVINGS {
                // A trial without a value has a score far below 0, from which no slope follows.
                if at_next.abs() <= value.abs().max(self.at_centre) {
                    break;
                }
                share *= 0.5;
                next = toward(&point, &target, share);
                at_next = trials.play(&next)?.get(self.limit).copied()?;
            }
            let moved = distance(&next, &point);
            (point, value) = (next, at_next);
            if norm(&point) > MAX_INDEX {
                return Some(Err(NotConverged));
            }
            if value.abs() <= SCORE_TOLERANCE * self.at_centre && moved <= POINT_TOLERANCE {
                return Some(Ok(point));
            }
        }
        Some(Err(NotConverged))
    }
}
