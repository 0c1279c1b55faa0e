//! What the controller did, a line of JSON for each change, written at once: for those who want to know what happened after the bench was gone.
//!
//! ```json
//! {"event":"state","time_us":1034211,"state":"fault","cause":"sample-timeout","drive_vpp":0,"since_sample_us":5012}
//! ```
//!
//! `event` is `start`, `state`, `hang-up` or `end`; times are the controller's own clock; `since_sample_us` is the time since the last sample that was controlled with, `null` where there was none.

use crate::Failure;
use platebench_wire::{Command, State, StateCause};
use std::fs::{File, OpenOptions};
use std::io::Write;

/// What makes a line.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Shown {
    state: State,
    cause: StateCause,
    driven: bool,
}

/// See the module.
pub(crate) struct Log {
    file: Option<(File, String)>,
    shown: Option<Shown>,
    last_sample_us: Option<u32>,
}

impl Log {
    /// Appends to `name`; says nothing where there is none.
    pub(crate) fn open(name: Option<&str>) -> Result<Self, Failure> {
        let open = |name: &str| match OpenOptions::new().append(true).create(true).open(name) {
            Ok(file) => Ok((file, name.to_owned())),
            Err(error) => Err(Failure::Log { file: name.to_owned(), error }),
        };
        Ok(Self { file: name.map(open).transpose()?, shown: None, last_sample_us: None })
    }

    /// Notes what the plate is driven with now, where that is another state, another cause, or from or to 0 V.
    pub(crate) fn follow(&mut self, now_us: u32, output: &Command) -> Result<(), Failure> {
        if output.state == State::Running {
            self.last_sample_us = Some(output.target_time_us);
        }
        let shown = Shown { state: output.state, cause: output.cause, driven: output.drive_vpp != 0.0 };
        let event = if self.shown.is_none() { "start" } else { "state" };
        if self.shown.replace(shown) == Some(shown) {
            return Ok(());
        }
        self.note(event, now_us, output)
    }

    /// Writes a line.
    pub(crate) fn note(&mut self, event: &str, now_us: u32, output: &Command) -> Result<(), Failure> {
        let Some((file, name)) = &mut self.file else { return Ok(()) };
        let since = self.last_sample_us.map_or_else(|| "null".to_owned(), |at| now_us.wrapping_sub(at).to_string());
        let line = format!(
            "{{\"event\":\"{event}\",\"time_us\":{now_us},\"state\":\"{}\",\"cause\":\"{}\",\"drive_vpp\":{},\"since_sample_us\":{since}}}\n",
            state(output.state),
            cause(output.cause),
            output.drive_vpp,
        );
        file.write_all(line.as_bytes()).map_err(|error| Failure::Log { file: name.clone(), error })
    }
}

fn state(state: State) -> &'static str {
    match state {
        State::Idle => "idle",
        State::Running => "running",
        State::Fault => "fault",
        State::Safe => "safe",
    }
}

fn cause(cause: StateCause) -> &'static str {
    match cause {
        StateCause::None => "none",
        StateCause::SampleTimeout => "sample-timeout",
        StateCause::LineNoise => "line-noise",
        StateCause::NonFinite => "non-finite",
    }
}
