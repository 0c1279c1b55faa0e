//! Logs each change of the controller as a line of JSON, without buffering.
//!
//! ```json
//! {"event":"state","time_us":1034211,"state":"fault","cause":"sample-timeout","drive_vpp":0,"since_sample_us":5012}
//! ```
//!
//! `event` is `start`, `state`, `hang-up` or `end`. `since_sample_us` is the time since the last
//! sample with a control step, or `null`. The program also logs after the bench has ended.

use crate::port::HostError;
use platebench_wire::{Command, ControllerState, StateCause};
use std::fs::{File, OpenOptions};
use std::io::Write;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct LoggedState {
    state: ControllerState,
    cause: StateCause,
    driven: bool,
}

pub(crate) struct StateLog {
    file: Option<(File, String)>,
    last_logged: Option<LoggedState>,
    last_sample_us: Option<u32>,
}

impl StateLog {
    pub(crate) fn open(name: Option<&str>) -> Result<Self, HostError> {
        let open = |name: &str| match OpenOptions::new().append(true).create(true).open(name) {
            Ok(file) => Ok((file, name.to_owned())),
            Err(error) => Err(HostError::Log { file: name.to_owned(), error }),
        };
        Ok(Self { file: name.map(open).transpose()?, last_logged: None, last_sample_us: None })
    }

    pub(crate) fn write_change(&mut self, now_us: u32, output: &Command) -> Result<(), HostError> {
        if output.state == ControllerState::Running {
            self.last_sample_us = Some(output.target_time_us);
        }
        let logged = LoggedState { state: output.state, cause: output.cause, driven: output.drive_vpp != 0.0 };
        let event = if self.last_logged.is_none() { "start" } else { "state" };
        if self.last_logged.replace(logged) == Some(logged) {
            return Ok(());
        }
        self.write_line(event, now_us, output)
    }

    pub(crate) fn write_line(&mut self, event: &str, now_us: u32, output: &Command) -> Result<(), HostError> {
        let Some((file, name)) = &mut self.file else { return Ok(()) };
        let since = self.last_sample_us.map_or_else(|| "null".to_owned(), |at| now_us.wrapping_sub(at).to_string());
        let (state, cause, drive_vpp) = (state_name(output.state), cause_name(output.cause), output.drive_vpp);
        let line = format!(
            "{{\"event\":\"{event}\",\"time_us\":{now_us},\"state\":\"{state}\",\"cause\":\"{cause}\",\
             \"drive_vpp\":{drive_vpp},\"since_sample_us\":{since}}}\n",
        );
        file.write_all(line.as_bytes()).map_err(|error| HostError::Log { file: name.clone(), error })
    }
}

fn state_name(state: ControllerState) -> &'static str {
    match state {
        ControllerState::Idle => "idle",
        ControllerState::Running => "running",
        ControllerState::Fault => "fault",
        ControllerState::Safe => "safe",
    }
}

fn cause_name(cause: StateCause) -> &'static str {
    match cause {
        StateCause::None => "none",
        StateCause::SampleTimeout => "sample-timeout",
        StateCause::LineNoise => "line-noise",
        StateCause::NonFinite => "non-finite",
    }
}
