//! Somebody's hand at an emulated plate.

use crate::stage::Held;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Mutex, PoisonError};

/// Somebody's hand at the plate, while the loop looks at it once per period.
#[derive(Debug, Default)]
pub struct Hand {
    moves: AtomicU64,
    held: Mutex<Held>,
}

impl Hand {
    /// Takes over: from now on the plate is as `held` says.
    pub fn hold(&self, held: Held) {
        *self.held.lock().unwrap_or_else(PoisonError::into_inner) = held;
        self.moves.fetch_add(1, Ordering::Release);
    }

    /// What it holds, if it has moved since it had done so `seen` times. Does not wait: one that is moving is seen in the next period.
    pub(super) fn moved(&self, seen: &mut u64) -> Option<Held> {
        let moves = self.moves.load(Ordering::Acquire);
        if moves == *seen {
            return None;
        }
        let held = *self.held.try_lock().ok()?;
        *seen = moves;
        Some(held)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_hand_is_seen_once_per_move() {
        let hand = Hand::default();
        let mut seen = 0;
        assert_eq!(hand.moved(&mut seen), None);
        let held = Held { finger_force_n: 1.5, ..Held::default() };
        hand.hold(held);
        assert_eq!(hand.moved(&mut seen), Some(held));
        assert_eq!(hand.moved(&mut seen), None);
    }
}
