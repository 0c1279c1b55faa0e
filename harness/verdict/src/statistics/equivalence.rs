//! Whether something is practically zero.

/// Bounds of a size, made from the bounds of its estimate and from what the bench itself may have added or taken.
///
/// Two one-sided tests (D. J. Schuirmann, *J. Pharmacokin. Biopharm.* 15, 1987, pp. 657-680): a quantity is equivalent to zero within ± L at the confidence c
/// where the interval between its two one-sided bounds, each at c, lies within ± L. What the measurement itself may be off by, `margin`, belongs into the
/// interval: a controller is not passed on the bench's own error, nor failed on it. A size is never negative.
pub fn widened(bounds: [f64; 2], margin: f64) -> [f64; 2] {
    [(bounds[0] - margin).max(0.0), bounds[1] + margin]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_margin_counts_against_both_answers() {
        assert_eq!(widened([0.5, 0.75], 0.25), [0.25, 1.0]);
        assert_eq!(widened([0.1, 0.75], 0.25), [0.0, 1.0]);
    }
}
