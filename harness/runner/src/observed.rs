//! What the rig tells beside the trace of a trial in lockstep.

use platebench_plate::Time;
use platebench_rig::Reply;
use platebench_verdict::Telemetry;
use platebench_wire::StateCause;
use std::time::Duration;

/// What the rig tells with each answer.
#[derive(Debug, Default)]
pub(crate) struct Observed {
    pub(crate) longest_delay: Time,
    longest_rig_delay: Duration,
    answers: u64,
    instructions: Option<(u64, u64)>,
    pub(crate) late_answers: u64,
    pub(crate) stopped: Option<String>,
}

impl Observed {
    pub(crate) fn take(&mut self, reply: &Reply, delay: Time) {
        self.answers += 1;
        self.longest_delay = self.longest_delay.max(delay);
        self.longest_rig_delay = self.longest_rig_delay.max(reply.delay);
        if let Some(count) = reply.instructions {
            let (sum, worst) = self.instructions.unwrap_or_default();
            self.instructions = Some((sum + count, worst.max(count)));
        }
    }

    pub(crate) fn telemetry(&self) -> Telemetry {
        let loop_delay_us = (self.answers + self.late_answers > 0).then(|| self.longest_delay.seconds() * 1e6);
        let told = Telemetry { loop_delay_us, stopped: self.stopped.clone(), ..Telemetry::default() };
        if self.answers == 0 {
            return told;
        }
        Telemetry {
            rig_delay_us: Some(self.longest_rig_delay.as_secs_f64() * 1e6),
            instructions_mean: self.instructions.map(|(sum, _)| sum as f64 / self.answers as f64),
            instructions_worst: self.instructions.map(|(_, worst)| worst as f64),
            ..told
        }
    }
}

/// Why a controller does not run, by its own account.
pub(crate) const fn stop_reason(cause: StateCause) -> &'static str {
    match cause {
        StateCause::SampleTimeout => "no sample for five periods",
        StateCause::LineNoise => "too many refused frames",
        StateCause::NonFinite => "a value that is not finite",
        StateCause::None => "no cause given",
    }
}
