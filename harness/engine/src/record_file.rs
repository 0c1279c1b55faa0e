//! Writes `run.json` during a run, so that a killed run keeps the judged scenarios. Writes take at
//! most 5 % of a run.

use platebench_model::record::{FolderError, RunFolder, RunRecord};
use platebench_model::trace::AtPath as _;
use std::time::{Duration, Instant};

const MIN_INTERVAL: Duration = Duration::from_millis(100);
const INTERVAL_PER_WRITE: u32 = 20;
/// Time until the next write if nothing has changed. It bounds one wait of the caller, not the run.
const MAX_WAIT: Duration = Duration::from_hours(1);

#[derive(Debug)]
pub(crate) struct RecordFile<'a> {
    folder: &'a RunFolder,
    next: Instant,
    has_changed: bool,
}

impl<'a> RecordFile<'a> {
    pub(crate) fn new(folder: &'a RunFolder) -> Self {
        Self { folder, next: Instant::now(), has_changed: false }
    }

    pub(crate) fn write(&mut self, record: &RunRecord) -> Result<(), FolderError> {
        let started = Instant::now();
        record.write(self.folder.path()).at(self.folder.path())?;
        self.next = Instant::now() + MIN_INTERVAL.max(INTERVAL_PER_WRITE * started.elapsed());
        self.has_changed = false;
        Ok(())
    }

    pub(crate) fn mark_changed(&mut self) {
        self.has_changed = true;
    }

    pub(crate) fn time_left(&self) -> Duration {
        if self.has_changed { self.next.saturating_duration_since(Instant::now()) } else { MAX_WAIT }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_a_change_makes_a_write_due() {
        let folder = tempfile::tempdir().unwrap();
        let folder = RunFolder::create(Some(&folder.path().join("run"))).unwrap();
        let mut file = RecordFile::new(&folder);
        assert_eq!(file.time_left(), MAX_WAIT);
        file.mark_changed();
        assert_eq!(file.time_left(), Duration::ZERO, "never written before");
        file.next = Instant::now() + MAX_WAIT / 2;
        assert!(file.time_left() > Duration::ZERO && file.time_left() < MAX_WAIT);
    }
}
