//! Whether a line is fast enough for a control period.

use std::time::Duration;

/// A sample or a command as it travels.
const CYCLIC_FRAME_BYTES: f64 = 24.0;
/// A byte with its start and stop bit.
const BITS_PER_BYTE: f64 = 10.0;

/// Rates that adapters and chips can commonly do, bits per second.
const STANDARD: [u32; 19] = [
    9_600, 19_200, 38_400, 57_600, 115_200, 230_400, 460_800, 500_000, 576_000, 921_600, 1_000_000, 1_152_000,
    1_500_000, 2_000_000, 2_500_000, 3_000_000, 3_500_000, 4_000_000, 12_000_000,
];

/// A rate at which frames arrive more slowly than periods begin.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("{baud} baud cannot carry a sample and a command every {} µs: each takes {frame_us:.0} µs; {}", period.as_micros(), match smallest {
    Some(rate) => format!("{rate} baud is enough"),
    None => "no common rate can, a longer period or a smaller time scale does".to_owned(),
})]
pub struct TooSlow {
    /// The rate, bits per second.
    pub baud: u32,
    /// The control period on the wall's clock.
    pub period: Duration,
    /// How long a frame of 24 bytes takes at this rate, µs.
    pub frame_us: f64,
    /// See [`smallest_baud`].
    pub smallest: Option<u32>,
}

/// The smallest common rate at which a sample and then its command fit into one control period, bits per second; `None` where none is fast enough.
///
/// `period` is the plate's, and `time_scale` is how many plate seconds pass per second on the wall.
pub fn smallest_baud(period: Duration, time_scale: f64) -> Option<u32> {
    let needed = 2.0 * CYCLIC_FRAME_BYTES * BITS_PER_BYTE / wall_seconds(period, time_scale);
    STANDARD.into_iter().find(|&rate| f64::from(rate) >= needed)
}

/// Whether `baud` carries a frame of 24 bytes each way in every control period. Less cannot work at all, since both directions run at once but neither may fall behind; what works may still be
/// slow: a loop delay is for the law's budget to judge.
///
/// # Errors
/// [`TooSlow`], which names a rate that is enough.
pub fn check_baud(baud: u32, period: Duration, time_scale: f64) -> Result<(), TooSlow> {
    let wall = wall_seconds(period, time_scale);
    let frame = CYCLIC_FRAME_BYTES * BITS_PER_BYTE / f64::from(baud);
    // A rate of zero takes for ever; a period that is no number is no period.
    if frame <= wall {
        return Ok(());
    }
    let period_on_wall = Duration::try_from_secs_f64(wall).unwrap_or_default();
    let smallest = smallest_baud(period, time_scale);
    Err(TooSlow { baud, period: period_on_wall, frame_us: frame * 1e6, smallest })
}

fn wall_seconds(period: Duration, time_scale: f64) -> f64 {
    period.as_secs_f64() / time_scale
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: Duration = Duration::from_millis(1);

    #[test]
    fn a_frame_that_just_fits_into_a_period_is_carried() {
        assert_eq!(check_baud(240_000, MS, 1.0), Ok(()));
        let refused = check_baud(239_999, MS, 1.0).unwrap_err();
        assert_eq!(refused.smallest, Some(500_000));
        assert_eq!(
            check_baud(115_200, MS, 1.0).unwrap_err().to_string(),
            "115200 baud cannot carry a sample and a command every 1000 µs: each takes 2083 µs; 500000 baud is enough"
        );
    }

    #[test]
    fn slower_plates_need_slower_lines() {
        assert_eq!(check_baud(24_000, MS, 0.1), Ok(()));
        assert!(check_baud(23_999, MS, 0.1).is_err());
        assert_eq!(smallest_baud(MS, 0.1), Some(57_600));
        assert_eq!(smallest_baud(MS, 1.0), Some(500_000));
        // 480 bits in 480 µs is exactly a million in a second.
        assert_eq!(smallest_baud(Duration::from_micros(480), 1.0), Some(1_000_000));
        assert_eq!(smallest_baud(Duration::from_micros(479), 1.0), Some(1_152_000));
    }

    #[test]
    fn what_no_line_can_carry_is_said_so() {
        assert_eq!(smallest_baud(Duration::from_micros(10), 1.0), None);
        let refused = check_baud(12_000_000, Duration::from_micros(10), 1.0).unwrap_err();
        assert!(refused.to_string().ends_with("a longer period or a smaller time scale does"), "{refused}");
        for nonsense in [f64::NAN, f64::INFINITY] {
            assert!(check_baud(1_000_000, MS, nonsense).is_err());
        }
        assert!(check_baud(0, MS, 1.0).is_err());
        assert!(check_baud(1_000_000, Duration::ZERO, 1.0).is_err());
    }
}
