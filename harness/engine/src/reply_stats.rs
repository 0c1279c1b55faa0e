//! Collects delays and instruction counts of the replies of a trial.

use platebench_model::record::{StepTime, Telemetry};
use platebench_plate::Time;
use platebench_rig::Reply;
use std::time::Duration;

#[derive(Default)]
pub(crate) struct ReplyStats {
    replies: u64,
    late_replies: u64,
    longest_delay: Time,
    longest_rig_delay: Duration,
    /// Instructions: sum over all control steps, and maximum of one step.
    instructions: Option<(u64, u64)>,
    step_time: Option<StepTime>,
}

impl ReplyStats {
    /// `now` is the control instant.
    pub(crate) fn record(&mut self, reply: &Reply, delay: Time, now: Time, period: Time) {
        self.replies += 1;
        self.longest_delay = self.longest_delay.max(delay);
        self.longest_rig_delay = self.longest_rig_delay.max(reply.delay);
        if let Some(count) = reply.instructions {
            let (sum, worst) = self.instructions.unwrap_or_default();
            self.instructions = Some((sum + count, worst.max(count)));
        }
        if let Some(computing) = reply.computing_time {
            let percent = computing.as_secs_f64() / period.seconds() * 100.0;
            self.step_time.get_or_insert_default().record(percent, now.seconds());
        }
    }

    pub(crate) fn record_late(&mut self, delay: Time) {
        self.late_replies += 1;
        self.longest_delay = self.longest_delay.max(delay);
    }

    pub(crate) fn add_to(&self, telemetry: Telemetry) -> Telemetry {
        let has_replies = self.replies > 0;
        Telemetry {
            loop_delay_us: (self.replies + self.late_replies > 0).then(|| self.longest_delay.seconds() * 1e6),
            rig_delay_us: has_replies.then_some(self.longest_rig_delay.as_secs_f64() * 1e6),
            instructions_mean: self.instructions.map(|(sum, _)| sum as f64 / self.replies as f64),
            instructions_worst: self.instructions.map(|(_, worst)| worst as f64),
            step_time: self.step_time,
            ..telemetry
        }
    }
}
