//! Passes manual inputs to an emulated plate.

use crate::plant_simulation::ManualInputs;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Mutex, PoisonError};

#[derive(Debug, Default)]
pub struct ManualControl {
    change_count: AtomicU64,
    inputs: Mutex<ManualInputs>,
}

impl ManualControl {
    pub fn set(&self, inputs: ManualInputs) {
        *self.inputs.lock().unwrap_or_else(PoisonError::into_inner) = inputs;
        self.change_count.fetch_add(1, Ordering::Release);
    }

    /// Returns changed inputs without a wait. Inputs that are being written follow one period
    /// later.
    pub(super) fn changed_inputs(&self, seen: &mut u64) -> Option<ManualInputs> {
        let changes = self.change_count.load(Ordering::Acquire);
        if changes == *seen {
            return None;
        }
        let inputs = *self.inputs.try_lock().ok()?;
        *seen = changes;
        Some(inputs)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn returns_each_change_once() {
        let control = ManualControl::default();
        let mut seen = 0;
        assert_eq!(control.changed_inputs(&mut seen), None);
        let inputs = ManualInputs { finger_force_n: 1.5, ..ManualInputs::default() };
        control.set(inputs);
        assert_eq!(control.changed_inputs(&mut seen), Some(inputs));
        assert_eq!(control.changed_inputs(&mut seen), None);
    }
}
