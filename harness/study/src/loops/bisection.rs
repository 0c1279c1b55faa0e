//! Bisects an interval.

/// Halves an interval `times` times. `holds` is true at its first end and false at the second.
pub(crate) fn bisect<E>(
    [mut low, mut high]: [f64; 2],
    times: u32,
    holds: impl Fn(f64) -> Result<bool, E>,
) -> Result<[f64; 2], E> {
    for _ in 0..times {
        let middle = f64::midpoint(low, high);
        *(if holds(middle)? { &mut low } else { &mut high }) = middle;
    }
    Ok([low, high])
}
