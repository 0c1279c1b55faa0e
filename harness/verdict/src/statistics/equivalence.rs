//! Adds the bench's own error to an interval.

/// Widens the bounds of an absolute value by the error `margin` of the bench itself.
///
/// Two one-sided tests (D. J. Schuirmann, *J. Pharmacokin. Biopharm.* 15, 1987, pp. 657-680): a
/// quantity is equivalent to zero within ± L at confidence c if the interval between its two
/// one-sided bounds, each at c, lies within ± L. The margin counts against both answers, so the
/// bench's error neither passes nor fails a controller.
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
