//! What the operating system can be asked for while a real-time loop runs: to be preferred and never swapped out.

use rustix::mm::{MlockAllFlags, mlockall, munlockall};
use thread_priority::unix::{
    RealtimeThreadSchedulePolicy, ThreadSchedulePolicy, set_thread_priority_and_policy, thread_native_id,
};
use thread_priority::{ThreadPriority, ThreadPriorityValue};

/// Below the kernel's own threads for interrupts, which run at 50 and serve the line.
const PRIORITY: u8 = 45;

/// What a thread was granted, until it ends: its scheduling is not taken back, so the thread should be the loop's alone.
#[derive(Debug, Clone)]
pub(crate) struct Granted {
    /// How the thread is scheduled, or why not better.
    pub(crate) scheduling: String,
    /// True where no page can be swapped out.
    pub(crate) memory_locked: bool,
}

impl Granted {
    /// Asks for what the calling thread can have.
    pub(crate) fn ask() -> Self {
        let policy = ThreadSchedulePolicy::Realtime(RealtimeThreadSchedulePolicy::Fifo);
        let outcome = ThreadPriorityValue::try_from(PRIORITY).and_then(|priority| {
            let priority = ThreadPriority::Crossplatform(priority);
            set_thread_priority_and_policy(thread_native_id(), priority, policy).map_err(|error| error.to_string())
        });
        let scheduling = match outcome {
            Ok(()) => "SCHED_FIFO".to_owned(),
            Err(why) => format!("SCHED_OTHER, because SCHED_FIFO was not granted: {why}"),
        };
        let memory_locked = mlockall(MlockAllFlags::CURRENT | MlockAllFlags::FUTURE).is_ok();
        Self { scheduling, memory_locked }
    }
}

impl Drop for Granted {
    fn drop(&mut self) {
        if self.memory_locked {
            // What is still locked then is swapped in all the same.
            let _ = munlockall();
        }
    }
}
