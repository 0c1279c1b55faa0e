//! Defines what reaches the view: the description of a run, events, and keys of the terminal.

use crossterm::event::{Event as TerminalEvent, KeyCode, KeyEventKind, KeyModifiers, poll, read};
use platebench_engine::Event;
use platebench_model::record::Verdict;
use platebench_model::scenario::Scenario;
use std::io;
use std::io::{IsTerminal, stdin};
use std::time::Duration;

/// Half width of the band in % if no expectation has one, as in the paper for the response time.
const BAND_PERCENT: f64 = 5.0;
/// Longest part of a trial that the view draws. It draws the last part.
const MAX_WINDOW_S: f64 = 10.0;

#[derive(Debug, Clone)]
pub struct RunDescription {
    pub command: &'static str,
    pub rig: String,
    pub lockstep: bool,
    /// Number of parallel trials. The view draws one of them.
    pub jobs: usize,
    pub key_help: &'static str,
    pub scenarios: Vec<ScenarioDescription>,
}

#[derive(Debug, Clone, PartialEq)]
pub struct ScenarioDescription {
    pub file: String,
    pub title: String,
    pub law: String,
    pub duration_s: Option<f64>,
    pub trials: u32,
    pub spacing_s: f64,
    pub band_percent: f64,
    pub limit_vpp: f64,
}

impl ScenarioDescription {
    pub fn of(scenario: &Scenario) -> Self {
        let mut banded = scenario.expectations.iter().filter(|expectation| expectation.metric.has_band());
        let band = banded.find(|expectation| expectation.signal == "amplitude_um");
        Self {
            file: scenario.file.clone(),
            title: scenario.title.clone(),
            law: scenario.controller.law.clone(),
            duration_s: Some(scenario.duration.seconds()),
            trials: scenario.trials.count,
            spacing_s: scenario.trace_step.seconds().min(scenario.controller.period.seconds()),
            band_percent: band.map_or(BAND_PERCENT, |expectation| expectation.band_percent),
            limit_vpp: scenario.plate.drive_limit_vpp,
        }
    }

    #[must_use]
    pub fn without_end(self) -> Self {
        Self { duration_s: None, ..self }
    }

    pub(crate) fn window_s(&self) -> f64 {
        self.duration_s.map_or(MAX_WINDOW_S, |duration| duration.min(MAX_WINDOW_S))
    }

    pub(crate) fn band(&self, setpoint_um: f64) -> Option<[f64; 2]> {
        let half = setpoint_um.abs() * self.band_percent / 100.0;
        (half > 0.0).then_some([setpoint_um - half, setpoint_um + half])
    }
}

#[derive(Debug)]
pub enum ViewEvent {
    RigLocation(String),
    TrialFinished,
    ScenarioFinished(Verdict),
}

impl ViewEvent {
    pub fn of(event: &Event) -> Option<Self> {
        match event {
            Event::ScenarioStarted { .. } => None,
            Event::TrialFinished { .. } => Some(Self::TrialFinished),
            Event::ScenarioFinished(scenario) => Some(Self::ScenarioFinished(scenario.verdict)),
        }
    }
}

/// Largest terminal in cells. A terminal may report any size, and memory holds two frames.
#[cfg(feature = "screen")]
pub(crate) const MAX_CELLS: u32 = 1 << 20;

#[derive(Debug, thiserror::Error)]
pub enum LiveViewError {
    #[cfg(not(feature = "screen"))]
    #[error("this bench was built without it; build it with the feature `live`")]
    NotBuilt,
    #[error("standard output is not a terminal")]
    NoTerminal,
    #[error("TERM=dumb: the terminal has no cursor control")]
    Dumb,
    #[cfg(feature = "screen")]
    #[error("the terminal reports {columns} x {rows} cells, expected at most {MAX_CELLS} in total")]
    Size { columns: u16, rows: u16 },
    #[error("platebench runs as a background job of the terminal; bring it to the foreground (fg)")]
    Background,
    #[error(transparent)]
    Io(#[from] io::Error),
}

const KEY_POLL_INTERVAL: Duration = Duration::from_millis(100);

/// Character for Ctrl-C if the terminal is raw. During a live view, Ctrl-C sends a signal instead.
pub const INTERRUPT: char = '\u{3}';

/// Calls `typed` for each key. Returns at once if standard input is not a terminal.
pub fn watch_keys(is_over: impl Fn() -> bool, mut typed: impl FnMut(char)) {
    if !stdin().is_terminal() {
        return;
    }
    while !is_over() {
        match poll(KEY_POLL_INTERVAL) {
            Ok(true) => {}
            Ok(false) => continue,
            Err(_) => return,
        }
        if let Ok(TerminalEvent::Key(key)) = read()
            && key.kind != KeyEventKind::Release
            && let KeyCode::Char(letter) = key.code
        {
            let is_interrupt = letter == 'c' && key.modifiers.contains(KeyModifiers::CONTROL);
            typed(if is_interrupt { INTERRUPT } else { letter });
        }
    }
}
