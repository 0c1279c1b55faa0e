//! Adds the bench's own error to an interval.

/// Widens bounds of an absolute value by the bench's error `margin`, so that this error neither
/// passes nor fails a controller. Two one-sided tests: D. J. Schuirmann, *J. Pharmacokin.
/// Biopharm.* 15, 1987, pp. 657-680.
pub fn widen_bounds(bounds: [f64; 2], margin: f64) -> [f64; 2] {
    if margin > 0.0 { [(bounds[0] - margin).max(0.0), bounds[1] + margin] } else { bounds }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_margin_widens_both_bounds() {
        assert_eq!(widen_bounds([0.5, 0.75], 0.25), [0.25, 1.0]);
        assert_eq!(widen_bounds([0.1, 0.75], 0.25), [0.0, 1.0]);
        assert_eq!(widen_bounds([-0.1, 0.75], 0.0), [-0.1, 0.75]);
    }
}
