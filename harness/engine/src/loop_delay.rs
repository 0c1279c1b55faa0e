//! Draws the loop delay of each control period.

use platebench_model::scenario::{Scenario, Variation};
use platebench_plate::Time;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng, SeedableRng};

/// Random stream of the jitter. Streams 0 and 1 of a seed belong to sensor noise and plate spread.
const JITTER_STREAM: u64 = 2;

/// Its values are uniform from the scenario's loop delay to the sum of loop delay and jitter.
#[derive(Debug)]
pub(crate) struct LoopDelay {
    smallest: Time,
    jitter: Time,
    random: ChaCha8Rng,
}

impl LoopDelay {
    pub(crate) fn new(scenario: &Scenario, index: u32) -> Self {
        let mut random = ChaCha8Rng::seed_from_u64(Variation::of_trial(scenario, index).seed);
        random.set_stream(JITTER_STREAM);
        let controller = &scenario.controller;
        Self { smallest: controller.loop_delay, jitter: controller.loop_delay_jitter, random }
    }

    pub(crate) fn draw(&mut self) -> Time {
        if self.jitter == Time::ZERO {
            return self.smallest;
        }
        let share = f64::from(self.random.next_u32()) / f64::from(u32::MAX);
        self.smallest + Time::from_nanos((self.jitter.as_nanos() as f64 * share).round() as u64)
    }
}
