//! Requests real-time scheduling and locked memory for the calling thread.

use rustix::mm::{MlockAllFlags, mlockall, munlockall};
use thread_priority::unix::{
    RealtimeThreadSchedulePolicy, ThreadSchedulePolicy, set_thread_priority_and_policy, thread_native_id,
};
use thread_priority::{ThreadPriority, ThreadPriorityValue};

/// Priority below the kernel's interrupt threads, which have 50 and serve the serial line.
const RT_PRIORITY: u8 = 45;

/// The scheduling class lasts until the thread ends, the memory lock until this value is dropped.
#[derive(Debug, Clone)]
pub(crate) struct ThreadScheduling {
    /// Scheduling class, with the reason if it is not `SCHED_FIFO`.
    pub(crate) scheduling: String,
    pub(crate) memory_locked: bool,
}

impl ThreadScheduling {
    pub(crate) fn request() -> Self {
        let policy = ThreadSchedulePolicy::Realtime(RealtimeThreadSchedulePolicy::Fifo);
        let outcome = ThreadPriorityValue::try_from(RT_PRIORITY).and_then(|priority| {
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

impl Drop for ThreadScheduling {
    fn drop(&mut self) {
        if self.memory_locked {
            let _ = munlockall();
        }
    }
}
