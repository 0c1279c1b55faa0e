//! Cancels work that runs or waits on another thread.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

/// All clones share one state.
#[derive(Debug, Clone, Default)]
pub struct CancelToken(Arc<AtomicBool>);

impl CancelToken {
    pub fn never() -> Self {
        Self::default()
    }

    /// After this call, the bench takes trials in progress to 0 V and discards them.
    pub fn cancel(&self) {
        self.0.store(true, Ordering::Relaxed);
    }

    pub fn is_cancelled(&self) -> bool {
        self.0.load(Ordering::Relaxed)
    }
}
