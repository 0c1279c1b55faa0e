//! Searches the design point (failing point closest to the centre) and checks for a second one.
//!
//! R. Rackwitz and B. Fiessler, *Computers and Structures* 9, 1978, pp. 489-494. In addition, a
//! step that increases the magnitude of the score is halved.

use super::estimates::Score;

/// Step of the difference quotients, standard deviations. It is large to average noise.
const GRADIENT_STEP: f64 = 0.1;
const MAX_ITERATIONS: usize = 12;
const MAX_HALVINGS: u32 = 4;
/// Tolerance of the score at the design point, relative to the score at the centre.
const SCORE_TOLERANCE: f64 = 0.02;
const POINT_TOLERANCE: f64 = 0.15;
/// Largest norm β of a design point. Failures beyond it have a probability below 10⁻¹⁴.
const MAX_INDEX: f64 = 8.0;
/// A second design point is ignored if its β is larger by at least this.
const INDEX_MARGIN: f64 = 1.0;

#[derive(Debug, Clone, PartialEq)]
pub(crate) struct DesignPoint {
    pub(crate) point: Vec<f64>,
    pub(crate) reliability_index: f64,
}

/// The only design point, or the reason why there is not exactly one. `None` if the trials end.
pub(crate) fn find(dimensions: usize, score: &mut Score<'_>) -> Option<Result<DesignPoint, &'static str>> {
    let centre = vec![0.0; dimensions];
    let at_centre = score(&centre)?;
    if at_centre <= 0.0 {
        return Some(Err("the trial with the median of every value fails"));
    }
    let found = match descend(centre, at_centre, at_centre, score)? {
        Ok(found) => found,
        Err(reason) => return Some(Err(reason)),
    };
    let mirrored: Vec<f64> = found.point.iter().map(|value| -value).collect();
    let reach = found.reliability_index * 1.1;
    let axes = (0..2 * dimensions).map(|number| {
        let mut point = vec![0.0; dimensions];
        if let Some(value) = point.get_mut(number / 2) {
            *value = if number % 2 == 0 { reach } else { -reach };
        }
        point
    });
    for point in axes.chain([mirrored.clone()]) {
        let is_on_other_side = dot(&point, &found.point) < 0.5 * found.reliability_index.powi(2);
        if is_on_other_side && score(&point)? <= 0.0 {
            return Some(Err("several failing regions"));
        }
    }
    let at_mirrored = score(&mirrored)?;
    if let Ok(second) = descend(mirrored, at_mirrored, at_centre, score)? {
        let is_other = distance(&second.point, &found.point) > 1.0;
        if is_other && second.reliability_index < found.reliability_index + INDEX_MARGIN {
            return Some(Err("several design points"));
        }
    }
    Some(Ok(found))
}

fn descend(
    mut point: Vec<f64>,
    mut value: f64,
    at_centre: f64,
    score: &mut Score<'_>,
) -> Option<Result<DesignPoint, &'static str>> {
    for _ in 0..MAX_ITERATIONS {
        let mut gradient = Vec::with_capacity(point.len());
        for axis in 0..point.len() {
            let mut moved = point.clone();
            if let Some(coordinate) = moved.get_mut(axis) {
                *coordinate += GRADIENT_STEP;
            }
            gradient.push((score(&moved)? - value) / GRADIENT_STEP);
        }
        let square = dot(&gradient, &gradient);
        if square.sqrt() < at_centre * 1e-3 {
            return Some(Err("the margin does not change with the varied values"));
        }
        let scale = (dot(&gradient, &point) - value) / square;
        let target: Vec<f64> = gradient.iter().map(|slope| slope * scale).collect();
        let step = distance(&target, &point);
        let mut share = (3.0 / step).min(1.0);
        let mut next = toward(&point, &target, share);
        let mut at_next = score(&next)?;
        for _ in 0..MAX_HALVINGS {
            // A trial without a value has a score far below 0, from which no slope follows.
            if at_next.abs() <= value.abs().max(at_centre) {
                break;
            }
            share *= 0.5;
            next = toward(&point, &target, share);
            at_next = score(&next)?;
        }
        let moved = distance(&next, &point);
        (point, value) = (next, at_next);
        let index = dot(&point, &point).sqrt();
        if index > MAX_INDEX {
            return Some(Err("no failure within 8 standard deviations"));
        }
        if value.abs() <= SCORE_TOLERANCE * at_centre && moved <= POINT_TOLERANCE {
            return Some(Ok(DesignPoint { point, reliability_index: index }));
        }
    }
    Some(Err("FORM did not converge"))
}

fn toward(from: &[f64], to: &[f64], share: f64) -> Vec<f64> {
    from.iter().zip(to).map(|(from, to)| from + (to - from) * share).collect()
}

pub(crate) fn dot(one: &[f64], other: &[f64]) -> f64 {
    one.iter().zip(other).map(|(one, other)| one * other).sum()
}

fn distance(one: &[f64], other: &[f64]) -> f64 {
    one.iter().zip(other).map(|(one, other)| (one - other).powi(2)).sum::<f64>().sqrt()
}
