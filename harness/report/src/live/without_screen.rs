//! Replaces the view in a build without the feature `screen`. It cannot be opened.

use crate::live::events::LiveViewError;
use crate::live::events::RunDescription;
use platebench_engine::{Event, TapReader};

#[derive(Debug)]
pub enum LiveView {}

#[derive(Debug, Clone)]
pub enum ViewSender {}

impl LiveView {
    pub fn open(_: RunDescription, _: TapReader) -> Result<Self, LiveViewError> {
        Err(LiveViewError::NotBuilt)
    }

    pub fn show(&self, _: &Event) {
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
    pub fn set_rig(&self, _: String) {
        match *self {}
    }
}

/// The view with a screen has a `Drop` too, so callers compile with both.
impl Drop for LiveView {
    fn drop(&mut self) {
        match *self {}
    }
}
