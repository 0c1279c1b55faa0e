//! Cancels work that runs or waits on another thread.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::{Duration, Instant};

/// A loop that may drive a plate looks for a cancellation at least this often.
pub const CANCEL_POLL_INTERVAL: Duration = Duration::from_millis(10);

/// All clones share one state.
#[derive(Debug, Clone, Default)]
pub struct CancelToken {
    is_cancelled: Arc<AtomicBool>,
    deadline: Option<Instant>,
}

impl CancelToken {
    pub fn never() -> Self {
        Self::default()
    }

    /// A token that shares the state of this one and is also cancelled from `deadline` on.
    #[must_use]
    pub fn with_deadline(&self, deadline: Option<Instant>) -> Self {
        Self { deadline, ..self.clone() }
    }

    /// After this call, the bench takes trials in progress to 0 V and discards them.
    pub fn cancel(&self) {
        self.is_cancelled.store(true, Ordering::Relaxed);
    }

    pub fn is_cancelled(&self) -> bool {
        self.is_cancelled.load(Ordering::Relaxed) || self.deadline.is_some_and(|deadline| Instant::now() >= deadline)
    }

    /// Sleeps for `time`, or until a cancellation.
    pub fn sleep(&self, time: Duration) {
        let end = Instant::now() + time;
        while !self.is_cancelled()
            && let Some(left) = end.checked_duration_since(Instant::now()).filter(|left| !left.is_zero())
        {
            thread::sleep(left.min(CANCEL_POLL_INTERVAL));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_deadline_cancels_its_token_only() {
        let token = CancelToken::never();
        let later = token.with_deadline(Some(Instant::now() + Duration::from_hours(1)));
        assert!(token.with_deadline(Some(Instant::now())).is_cancelled());
        assert!(!token.is_cancelled() && !later.is_cancelled());
        token.cancel();
        assert!(later.is_cancelled());
        // Without the cancellation, it sleeps for an hour.
        token.sleep(Duration::from_hours(1));
    }
}
