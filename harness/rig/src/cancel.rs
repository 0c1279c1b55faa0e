//! Cancels work that runs or waits on another thread.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

/// A switch that ends a run early, from any thread. Clones share it.
#[derive(Debug, Clone, Default)]
pub struct CancelToken(Arc<AtomicBool>);

impl CancelToken {
    /// A token for work that nothing cancels.
    pub fn never() -> Self {
        Self::default()
    }

    /// Ends the work: trials in progress are driven to 0 V and dropped.
    pub fn cancel(&self) {
        self.0.store(true, Ordering::Relaxed);
    }

    /// True from the first [`CancelToken::cancel`] on.
    pub fn is_cancelled(&self) -> bool {
        self.0.load(Ordering::Relaxed)
    }
}
