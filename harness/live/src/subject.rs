//! What is looked at, as far as it is known before anything is played.

use platebench_scenario::Scenario;

/// Half width of the band where no expectation names one, percent: that of the response time in the paper.
const BAND_PERCENT: f64 = 5.0;
/// A trial that is longer is shown as its last seconds.
const LONGEST_S: f64 = 10.0;

/// What is looked at.
#[derive(Debug, Clone)]
pub struct Subject {
    /// The command, `run` for example.
    pub command: &'static str,
    /// The rig or port as named on the command line.
    pub place: String,
    /// True where the plate waits for the bench, so that nobody can be late.
    pub lockstep: bool,
    /// Trials that go on at once; one of them is shown.
    pub jobs: usize,
    /// What the keys do.
    pub keys: &'static str,
    /// What may be played, in the order of the plan.
    pub shows: Vec<Show>,
}

/// A scenario as the view needs it.
#[derive(Debug, Clone, PartialEq)]
pub struct Show {
    /// Its file below the scenario folder.
    pub file: String,
    /// One line that says what is played.
    pub title: String,
    /// The control law.
    pub law: String,
    /// Length of a trial, s; `None` where it has no end.
    pub duration_s: Option<f64>,
    /// Trials that are planned at least.
    pub trials: u32,
    /// Rows are at most this far apart, s.
    pub spacing_s: f64,
    /// Half width of the band around the setpoint, percent.
    pub band_percent: f64,
    /// The amplifier's limit, Vpp.
    pub limit_vpp: f64,
}

impl Show {
    /// That of `scenario`; the band is that of its first expectation that has one for |W|.
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

    /// As played by somebody who does not end it.
    #[must_use]
    pub fn endless(self) -> Self {
        Self { duration_s: None, ..self }
    }

    /// How much of a trial is shown at once, s.
    pub(crate) fn window_s(&self) -> f64 {
        self.duration_s.map_or(LONGEST_S, |duration| duration.min(LONGEST_S))
    }

    /// The edges of the band around a setpoint; without one where nothing is wished for.
    pub(crate) fn band(&self, setpoint_um: f64) -> Option<[f64; 2]> {
        let half = setpoint_um.abs() * self.band_percent / 100.0;
        (half > 0.0).then_some([setpoint_um - half, setpoint_um + half])
    }
}
