//! Replaces the view in a build without the feature `screen`: it never opens.

use crate::error::LiveViewError;
use crate::run_description::RunDescription;
use crate::view_event::ViewEvent;
use platebench_runner::TapReader;

#[derive(Debug)]
pub enum LiveView {}

#[derive(Debug, Clone)]
pub enum ViewSender {}

impl LiveView {
    pub fn open(_: RunDescription, _: TapReader) -> Result<Self, LiveViewError> {
        Err(LiveViewError::NotBuilt)
    }

    pub fn send(&self, _: ViewEvent) {
        match *self {}
    }

    pub fn sender(&self) -> ViewSender {
        match *self {}
    }

    pub fn quit_on_q(&self) {
        match *self {}
    }
}

impl ViewSender {
    pub fn send(&self, _: ViewEvent) {
        match *self {}
    }
}

/// Exists because the view with a screen has a `Drop` too.
impl Drop for LiveView {
    fn drop(&mut self) {
        match *self {}
    }
}
