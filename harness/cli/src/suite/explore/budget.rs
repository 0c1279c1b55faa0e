//! Parses the duration of an exploration.

use std::time::Duration;

const MAX_HOURS: u64 = 24 * 30;

/// Accepts `90` (seconds), `90s`, `10m` or `8h`.
pub(super) fn parse_duration(text: &str) -> Result<Duration, String> {
    let digits = text.trim_end_matches(|letter: char| !letter.is_ascii_digit());
    let factor = match text.get(digits.len()..) {
        Some("" | "s") => Some(1),
        Some("m") => Some(60),
        Some("h") => Some(3_600),
        _ => None,
    };
    let seconds = factor.zip(digits.parse::<u64>().ok()).and_then(|(factor, number)| number.checked_mul(factor));
    seconds
        .filter(|seconds| (1..=MAX_HOURS * 3_600).contains(seconds))
        .map(Duration::from_secs)
        .ok_or_else(|| format!("expected a duration such as 30s, 10m or 8h, at most {MAX_HOURS} h"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn durations_have_a_unit_and_bounds() {
        for (text, seconds) in [("30s", 30), ("90", 90), ("10m", 600), ("8h", 28_800)] {
            assert_eq!(parse_duration(text), Ok(Duration::from_secs(seconds)), "{text}");
        }
        for wrong in ["", "s", "0s", "1.5m", "-3s", "3d", "99999999h", "18446744073709551615h"] {
            assert!(parse_duration(wrong).is_err(), "{wrong}");
        }
    }
}
