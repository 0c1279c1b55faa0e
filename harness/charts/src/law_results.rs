//! Plays every law through the same scenarios and measures response time, static error and
//! repeatability.

use crate::error::ChartError;
use crate::measured_run::play_hosted;
use platebench_engine::TrialResult;
use platebench_model::scenario::{Expectation, Metric, Scenario, Window, load};
use platebench_plate::{Profile, Tier, Time};
use platebench_verdict::statistics::SampleSummary;
use platebench_verdict::{Measure, metrics};
use platebench_wire::LawId;
use std::path::Path;

const BAND_PERCENT: f64 = 5.0;
const TRIALS: u32 = 20;
const QUICK_TRIALS: u32 = 4;
const FORCE_STEP_MS: f64 = 30.0;
const FORCE_STEP_N: f64 = 1.0;
const FINGER_N: f64 = 2.0;

pub struct LawScenario {
    pub(crate) name: String,
    pub(crate) scenario: Scenario,
    /// Measures the response time from the setpoint step or from a disturbance.
    response_expectation: Expectation,
    /// Measures the mean over the last third of the trial.
    window_mean_expectation: Expectation,
    pub(crate) trials: u32,
}

impl LawScenario {
    fn new(name: &str, mut scenario: Scenario, disturbed: Option<Time>, trials: u32) -> Self {
        let metric = if disturbed.is_some() { Metric::RecoveryTime } else { Metric::SettlingTime };
        let last_third = Window { from: Time::ZERO, to: scenario.duration }.last_third();
        let first_step = scenario.setpoint.next_point_after(Time::ZERO).unwrap_or(Time::ZERO);
        let response_window = Window { from: disturbed.unwrap_or(first_step), to: scenario.duration };
        let expected = |metric: Metric, judged: Window| Expectation {
            band_percent: BAND_PERCENT,
            from: disturbed,
            ..Expectation::for_window(metric, judged)
        };
        let (response, window_mean) = (expected(metric, response_window), expected(Metric::StaticError, last_third));
        // Because of this expectation, the trace has a row at every crossing of the band.
        scenario.expectations = vec![response.clone()];
        scenario.tier = Tier::Modal;
        Self {
            name: name.to_owned(),
            scenario,
            response_expectation: response,
            window_mean_expectation: window_mean,
            trials,
        }
    }

    pub(crate) fn is_noisy(&self) -> bool {
        self.scenario.plate.noise_um_rms > 0.0
    }

    /// Response time in ms (`None` if |W| does not stay in the band), and overshoot in percent.
    pub(crate) fn response(&self, played: &TrialResult) -> (Option<f64>, f64) {
        let response = measure(&self.response_expectation, played);
        let peak = played.trace_rows.iter().map(|row| row.amplitude_um).fold(0.0, f64::max);
        (response, ((peak / self.scenario.setpoint.range().1 - 1.0) * 100.0).max(0.0))
    }

    fn window_samples(&self) -> f64 {
        let Window { from, to } = Window { from: Time::ZERO, to: self.scenario.duration }.last_third();
        (to.seconds() - from.seconds()) / self.scenario.controller.period.seconds()
    }

    /// Standard deviation of the mean of the window's samples due to noise, % of the setpoint.
    pub(crate) fn noise_floor_percent(&self) -> f64 {
        self.scenario.plate.noise_um_rms / self.scenario.setpoint.range().1 / self.window_samples().sqrt() * 100.0
    }

    /// Shortest response time that the drive limit allows, at resonance in the initial conditions.
    pub(crate) fn drive_limited_ms(&self) -> Option<f64> {
        let scenario = &self.scenario;
        let mode = scenario.plate.mode(&scenario.conditions.at(Time::ZERO));
        let share = 1.0 - BAND_PERCENT / 100.0;
        mode.min_rise_time(scenario.setpoint.range().1, share, scenario.plate.drive_limit_vpp).map(|floor| floor * 1e3)
    }
}

pub fn load_law_scenarios(folder: &Path, is_quick: bool) -> Result<Vec<LawScenario>, ChartError> {
    let read = |file: &str| load(&folder.join(file), file).map_err(ChartError::from);
    let [resonant, detuned, pressed] = [13, 14, 16].map(|figure| read(&format!("paper/fig{figure}-closed-loop.toml")));
    let (resonant, detuned, pressed) = (resonant?, detuned?, pressed?);
    let mut finger = resonant.clone();
    finger.conditions.finger_force_n = Profile::constant(FINGER_N);
    let mut stepped = resonant.clone();
    let step = Time::from_ms(FORCE_STEP_MS).unwrap_or_default();
    stepped.conditions.finger_force_n = Profile::Hold(vec![(Time::ZERO, 0.0), (step, FORCE_STEP_N)]);
    let mut scenes = vec![
        LawScenario::new("Fig. 13: at resonance", resonant, None, 1),
        LawScenario::new("Fig. 14: 9 K off", detuned, None, 1),
        LawScenario::new("Fig. 16: 9 K off, 2 N", pressed, None, 1),
        LawScenario::new("2 N at resonance", finger, None, 1),
        LawScenario::new("1 N comes down", stepped, Some(step), 1),
    ];
    for level in [3, 10, 32] {
        let scenario = read(&format!("laws/noise-{level}nm-dq-pi.toml"))?;
        let trials = if is_quick { QUICK_TRIALS } else { TRIALS };
        scenes.push(LawScenario::new(&format!("Fig. 16, {level} nm of noise"), scenario, None, trials));
    }
    Ok(scenes)
}

pub(crate) struct LawResult {
    pub(crate) law: LawId,
    pub(crate) scenario_index: usize,
    /// Median over trials. `None` if at least half of the trials do not stay in the band.
    pub(crate) response_ms: Option<f64>,
    pub(crate) settled_trials: u32,
    /// |mean over trials − setpoint|/setpoint. `None` if the controller stopped in a trial.
    pub(crate) static_error_percent: Option<f64>,
    pub(crate) repeatability_percent: Option<f64>,
}

impl LawResult {
    pub(crate) fn measure(law: LawId, scenario_index: usize, scene: &LawScenario) -> Result<Self, ChartError> {
        let what = format!("{}, {}", scene.name, law.name());
        let (mut responses, mut means) = (Vec::new(), Vec::new());
        for index in 0..scene.trials {
            let played = play_hosted(&what, &scene.scenario, law, index)?;
            responses.push(measure(&scene.response_expectation, &played).unwrap_or(f64::INFINITY));
            means.extend(measure(&scene.window_mean_expectation, &played));
        }
        let whole = SampleSummary::of(&means).filter(|summary| summary.count == responses.len());
        let settled = responses.iter().filter(|response| response.is_finite()).count() as u32;
        Ok(Self {
            law,
            scenario_index,
            response_ms: median(responses).filter(|response| response.is_finite()),
            settled_trials: settled,
            static_error_percent: whole.map(|summary| summary.mean.abs()),
            repeatability_percent: whole.filter(|summary| summary.count > 1).map(|summary| summary.deviation),
        })
    }
}

fn measure(expectation: &Expectation, played: &TrialResult) -> Option<f64> {
    match metrics::measure(expectation, &played.trace_rows, &played.telemetry) {
        Measure::Value(value) => Some(value),
        Measure::Interval(_) | Measure::Samples(_) | Measure::Missing(_) | Measure::Undefined(_) => None,
    }
}

/// If the number of values is even, returns the larger of the two middle values.
fn median(mut values: Vec<f64>) -> Option<f64> {
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied()
}
