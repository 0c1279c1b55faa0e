//! Bisects an interval.

use std::convert::Infallible;

/// As [`try_bisect`], for a condition that cannot fail.
pub fn bisect(ends: [f64; 2], times: u32, holds: impl Fn(f64) -> bool) -> [f64; 2] {
    let Ok(ends) = try_bisect(ends, times, |at| Ok::<_, Infallible>(holds(at)));
    ends
}

/// Halves an interval `times` times. `holds` is true at its first end and false at the second.
pub fn try_bisect<E>(
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
