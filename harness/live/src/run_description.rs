//! Describes the run before the first row arrives.

use platebench_scenario::Scenario;

/// Half width of the band in percent if no expectation has one: the paper's response time.
const BAND_PERCENT: f64 = 5.0;
/// Of a longer trial the view draws the last seconds only.
const MAX_WINDOW_S: f64 = 10.0;

/// The run that the view shows.
#[derive(Debug, Clone)]
pub struct RunDescription {
    /// The command, `run` for example.
    pub command: &'static str,
    /// The rig or port as named on the command line.
    pub rig: String,
    /// True in lockstep: there is no lateness.
    pub lockstep: bool,
    /// Number of trials in parallel; the view shows one of them.
    pub jobs: usize,
    /// Text that explains the keys.
    pub key_help: &'static str,
    /// Scenarios in the order of the plan.
    pub scenarios: Vec<ScenarioDescription>,
}

/// A scenario as the view needs it.
#[derive(Debug, Clone, PartialEq)]
pub struct ScenarioDescription {
    /// Its file below the scenario folder.
    pub file: String,
    /// One line.
    pub title: String,
    /// The control law.
    pub law: String,
    /// Length of a trial in s; `None` if it has no end.
    pub duration_s: Option<f64>,
    /// Smallest planned number of trials.
    pub trials: u32,
    /// Largest distance between rows in s.
    pub spacing_s: f64,
    /// Half width of the band around the setpoint in percent.
    pub band_percent: f64,
    /// Limit of the amplifier in Vpp.
    pub limit_vpp: f64,
}

impl ScenarioDescription {
    /// Takes the band from the first expectation on |W| that has one.
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

    /// The same scenario with an unlimited duration.
    #[must_use]
    pub fn without_end(self) -> Self {
        Self { duration_s: None, ..self }
    }

    /// Length of the visible part of a trial in s.
    pub(crate) fn window_s(&self) -> f64 {
        self.duration_s.map_or(MAX_WINDOW_S, |duration| duration.min(MAX_WINDOW_S))
    }

    /// Edges of the band in µm; `None` at setpoint 0.
    pub(crate) fn band(&self, setpoint_um: f64) -> Option<[f64; 2]> {
        let half = setpoint_um.abs() * self.band_percent / 100.0;
        (half > 0.0).then_some([setpoint_um - half, setpoint_um + half])
    }
}
