//! Reduces curves to the points that are needed to draw them.

use crate::tube::{Tube, TubePoint};

/// Largest error from removed points, as a share of the tolerance.
const TOLERANCE_SHARE: f64 = 0.1;

/// Removes points near the line between their neighbours, by the algorithm of D. H. Douglas and T.
/// K. Peucker (*Cartographica* 10, 1973, pp. 112-122). The distance is the difference in value at
/// one instant. All tubes keep the same instants.
pub(super) fn thin(tubes: &mut [Tube]) {
    let count = tubes.first().map_or(0, |tube| tube.points.len());
    let mut kept = vec![false; count];
    let mut open: Vec<(usize, usize)> = Vec::new();
    if let Some(last) = count.checked_sub(1) {
        for end in [0, last] {
            if let Some(kept) = kept.get_mut(end) {
                *kept = true;
            }
        }
        open.push((0, last));
    }
    while let Some((from, to)) = open.pop() {
        let farthest = (from + 1..to)
            .map(|index| (index, tubes.iter().map(|tube| relative_distance(tube, from, index, to)).fold(0.0, f64::max)))
            .reduce(|worst, other| if other.1 > worst.1 { other } else { worst });
        if let Some((index, _)) = farthest.filter(|(_, off)| *off > TOLERANCE_SHARE) {
            if let Some(kept) = kept.get_mut(index) {
                *kept = true;
            }
            open.extend([(from, index), (index, to)]);
        }
    }
    for tube in tubes {
        let mut stays = kept.iter();
        tube.points.retain(|_| stays.next().copied().unwrap_or(false));
    }
}

/// Distance of the point `index` from the line between `from` and `to`, in units of the tolerance.
fn relative_distance(tube: &Tube, from: usize, index: usize, to: usize) -> f64 {
    let [Some(left), Some(point), Some(right)] = [from, index, to].map(|at| tube.points.get(at)) else { return 0.0 };
    let length = right.t_ms - left.t_ms;
    let share = if length > 0.0 { (point.t_ms - left.t_ms) / length } else { 0.0 };
    let line = |of: fn(&TubePoint) -> f64| of(left) + (of(right) - of(left)) * share;
    let value = (line(|point| point.value) - point.value).abs();
    let width = (line(|point| point.width) - point.width).abs();
    value.max(width) / tube.half_height(*point)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tube::Tolerance;

    fn tube(value: impl Fn(f64) -> f64) -> Tube {
        let points = (0..=1_000).map(|index| f64::from(index) * 0.06);
        Tube {
            signal: "amplitude_um".to_owned(),
            tolerance: Tolerance { absolute: 0.01, relative: 0.0, time_ms: 0.0 },
            points: points.map(|t_ms| TubePoint { t_ms, value: value(t_ms), width: 0.0 }).collect(),
        }
    }

    #[test]
    fn keeps_the_curve() {
        let response = tube(|t| 2.0 * (1.0 - (-t / 1.88_f64).exp()));
        let jump = tube(|t| if t < 30.0 { 0.0 } else { 5.0 });
        let mut thinned = [response.clone(), jump.clone()];
        thin(&mut thinned);
        let [short, steep] = &thinned;
        assert!((10..60).contains(&short.points.len()), "{}", short.points.len());
        assert_eq!(short.points.len(), steep.points.len());
        for (before, after) in [(&response, short), (&jump, steep)] {
            for point in &before.points {
                assert!((after.point_at(point.t_ms).value - point.value).abs() <= 0.001 + 1e-12);
            }
        }
    }

    #[test]
    fn keeps_the_ends() {
        let mut flat = [tube(|_| 1.0)];
        thin(&mut flat);
        assert_eq!(flat[0].points.len(), 2);
        let mut empty = [Tube { points: Vec::new(), ..tube(|_| 1.0) }];
        thin(&mut empty);
        assert!(empty[0].points.is_empty());
    }
}
