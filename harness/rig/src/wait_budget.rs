//! Limits a wait by the time in which the bench ran.

use std::time::{Duration, Instant};

/// Longest part of a wait. A cancellation and the end of a program are noticed after this time.
pub(crate) const MAX_PART: Duration = Duration::from_millis(100);

/// Time limit of a wait that consists of parts. A part counts at most its planned length, because
/// the bench may have stood still (SIGSTOP, suspend) while the other side had no chance to act.
#[derive(Debug)]
pub struct WaitBudget {
    left: Duration,
    part: Duration,
    /// Start and planned length of the present part.
    present: Option<(Instant, Duration)>,
}

impl WaitBudget {
    pub fn new(limit: Duration) -> Self {
        Self::with_parts(limit, MAX_PART)
    }

    pub(crate) fn with_parts(limit: Duration, part: Duration) -> Self {
        Self { left: limit, part: part.min(MAX_PART), present: None }
    }

    /// Ends the present part and starts the next one at `now`. Returns the end of the next part;
    /// `None` if no time is left.
    pub fn next_part(&mut self, now: Instant) -> Option<Instant> {
        if let Some((start, planned)) = self.present.take() {
            self.left = self.left.saturating_sub(now.saturating_duration_since(start).min(planned));
        }
        let planned = self.part.min(self.left);
        if planned.is_zero() {
            return None;
        }
        self.present = Some((now, planned));
        Some(now + planned)
    }

    /// Leaves at most `limit`, from now on.
    pub(crate) fn shorten(&mut self, limit: Duration) {
        self.left = self.left.min(limit);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: Duration = Duration::from_millis(1);

    #[test]
    fn a_stall_counts_as_one_part() {
        let start = Instant::now();
        let mut budget = WaitBudget::new(250 * MS);
        assert_eq!(budget.next_part(start), Some(start + MAX_PART));
        let resumed = start + Duration::from_secs(7);
        assert_eq!(budget.next_part(resumed), Some(resumed + MAX_PART));
        let end = resumed + MAX_PART;
        assert_eq!(budget.next_part(end), Some(end + 50 * MS), "250 ms without two parts of 100 ms");
        assert_eq!(budget.next_part(end + 50 * MS), None);
    }

    #[test]
    fn a_part_that_ends_early_counts_its_time() {
        let start = Instant::now();
        let mut budget = WaitBudget::new(3 * MS);
        let ends = (0..3).map(|step| budget.next_part(start + step * MS)).collect::<Vec<_>>();
        assert_eq!(ends, vec![Some(start + 3 * MS); 3]);
        assert_eq!(budget.next_part(start + 3 * MS), None);
    }

    #[test]
    fn a_shortened_wait_ends_earlier() {
        let start = Instant::now();
        let mut budget = WaitBudget::with_parts(Duration::from_mins(1), Duration::from_secs(6));
        budget.shorten(30 * MS);
        assert_eq!(budget.next_part(start), Some(start + 30 * MS));
        assert_eq!(budget.next_part(start + 30 * MS), None);
    }
}
