//! Finds the delay boundary, the longest constant loop delay at which a law still settles, and
//! excuses a missed expectation that the delay of the rig explains.
//!
//! The simulated plate of the search has no noise, and no link lies between plate and controller.

use crate::lockstep;
use crate::timing::Pacing;
use crate::trial::configure;
use platebench_controller::StateMachine;
use platebench_model::metrics::Subject;
use platebench_model::record::{Excuse, Telemetry};
use platebench_model::scenario::{Expectation, Metric, Scenario};
use platebench_model::trace::Row;
use platebench_plate::{Complex64, ConditionProfiles, Conditions, Drive, Model, Plant, Plate, Profile, Time};
use platebench_verdict::metrics::Measure;
use platebench_verdict::statistics::bisect;
use platebench_verdict::{TrialMeasures, measure};
use platebench_wire::{Configure, ControllerState, LawId, Sample};
use std::collections::VecDeque;
use std::f64::consts::TAU;

const MAX_PERIODS: f64 = 3.0;
/// Step of the first search, in control periods. `BISECTIONS` bisections of one step follow.
const SCAN_STEP: f64 = 0.25;
const BISECTIONS: u32 = 8;
/// Length of a trial in control periods. `WINDOW_PERIODS` at its end decide whether it settled.
const TRIAL_PERIODS: u32 = 400;
const WINDOW_PERIODS: u32 = 40;
/// Half width of the settling band as a share of the setpoint.
const BAND: f64 = 0.05;
/// Longest loop delay with which a missed expectation is attributed to an own law, as a share of the
/// control period. A loop that settles to 5 % in two periods has τ of 2/3 of a period, and loses 9°
/// of phase by it.
const OWN_LAW_DELAY: f64 = 0.1;
/// Relative deviation from the setpoint at which the response counts as diverged.
const DIVERGED: f64 = 10.0;

#[derive(Debug, Clone, Copy, PartialEq)]
pub enum DelayBoundary {
    Unstable,
    /// The loop is stable up to this delay, s.
    At(f64),
    /// The loop is stable up to the end of the search, at this delay in s.
    Beyond(f64),
}

impl DelayBoundary {
    pub fn seconds(self) -> Option<f64> {
        match self {
            Self::At(seconds) => Some(seconds),
            Self::Unstable | Self::Beyond(_) => None,
        }
    }
}

#[derive(Debug, Clone)]
pub struct DelayedLoop {
    machine: StateMachine,
    plant: Plant,
    setpoint: f64,
    period: Time,
    /// Drives that do not act yet, each with the time from which it acts, earliest first.
    pending: VecDeque<(Time, Drive)>,
}

impl DelayedLoop {
    /// Starts with a resting plate. `setpoint` is in µm. `None` if `configure` is invalid.
    pub fn new(
        configure: &Configure,
        plate: &Plate,
        conditions: Conditions,
        model: Model,
        setpoint: f64,
    ) -> Option<Self> {
        let mut machine = StateMachine::new();
        machine.configure(configure).outcome.ok()?;
        let scene = ConditionProfiles {
            temperature_offset_k: Profile::constant(conditions.temperature_offset_k),
            finger_force_n: Profile::constant(conditions.finger_force_n),
        };
        let mut plant = Plant::new(plate.clone(), scene, model);
        plant.set_drive(Drive { vpp: 0.0, omega: f64::from(configure.start_frequency_mhz) * 1e-3 * TAU });
        let period = Time::from_nanos(u64::from(configure.period_us) * 1_000);
        Some(Self { machine, plant, setpoint, period, pending: VecDeque::new() })
    }

    pub fn setpoint(&self) -> f64 {
        self.setpoint
    }

    /// Simulates one control period and returns the vibration W at its start, µm. `perturbation` is
    /// added to both measured components, µm. `None` if the controller stopped or W is not finite.
    pub fn step(&mut self, delay: Time, perturbation: f64) -> Option<Complex64> {
        let (now, w) = (self.plant.time(), self.plant.state().w);
        let sensed = self.plant.sensor_reading();
        let time_us = (now.as_nanos() / 1_000) as u32;
        let sample = Sample {
            time_us,
            setpoint_um: self.setpoint as f32,
            wd_um: (sensed.re + perturbation) as f32,
            wq_um: (sensed.im + perturbation) as f32,
        };
        let command = self.machine.sample(&sample, time_us);
        if command.state != ControllerState::Running || !w.is_finite() {
            return None;
        }
        let drive = Drive { vpp: f64::from(command.drive_vpp), omega: f64::from(command.frequency_mhz) * 1e-3 * TAU };
        self.pending.push_back((now + delay, drive));
        let end = now + self.period;
        while let Some(&(at, drive)) = self.pending.front() {
            if at >= end {
                break;
            }
            self.plant.advance(at, &[], &mut Vec::new());
            self.plant.set_drive(drive);
            self.pending.pop_front();
        }
        self.plant.advance(end, &[], &mut Vec::new());
        Some(w)
    }

    fn settles(mut self, delay: Time) -> bool {
        (0..TRIAL_PERIODS).all(|number| {
            let is_early = number < TRIAL_PERIODS - WINDOW_PERIODS;
            let w = self.step(delay, 0.0);
            w.is_some_and(|w| is_early || (w.norm() / self.setpoint - 1.0).abs() <= BAND)
        })
    }

    /// Returns the time in s from which |W| stays within `BAND` until `end`, s. `None` if the loop
    /// diverges, stops, or settles only in the last quarter.
    pub fn settling_time(mut self, delay: Time, end: f64) -> Option<f64> {
        let period = self.period.seconds();
        let periods = (end / period).ceil() as u32;
        let mut settled = None;
        for number in 0..=periods {
            let deviation = (self.step(delay, 0.0)?.norm() / self.setpoint - 1.0).abs();
            settled = if deviation <= BAND { settled.or(Some(number)) } else { None };
            if deviation > DIVERGED {
                return None;
            }
        }
        settled.filter(|number| *number <= periods - periods / 4).map(|number| f64::from(number) * period)
    }

    pub fn settling_boundary(&self, longest: f64) -> DelayBoundary {
        search_boundary(self.period.seconds(), longest, |delay| self.clone().settles(delay))
    }
}

/// Uses the highest setpoint of the scenario. `None` if the law does not settle without delay, or is
/// the controller's own.
pub(crate) fn scenario_delay_boundary(scenario: &Scenario, law: LawId) -> Option<Time> {
    if scenario.has_own_law() {
        return None;
    }
    let (_, setpoint) = scenario.setpoint.range();
    let conditions = scenario.conditions.at(Time::ZERO);
    let start = DelayedLoop::new(&configure(scenario, law), &scenario.plate, conditions, scenario.model, setpoint)?;
    match start.settling_boundary(MAX_PERIODS * scenario.controller.period.seconds()) {
        DelayBoundary::Unstable => None,
        DelayBoundary::At(seconds) | DelayBoundary::Beyond(seconds) => Time::from_seconds(seconds),
    }
}

/// Searches from 0 to `longest` s with a resolution of 1/1024 of `period`.
pub fn search_boundary(period: f64, longest: f64, is_stable: impl Fn(Time) -> bool) -> DelayBoundary {
    let at = |seconds: f64| Time::from_seconds(seconds).is_some_and(&is_stable);
    if !at(0.0) {
        return DelayBoundary::Unstable;
    }
    let mut low = 0.0;
    let steps = (longest / (SCAN_STEP * period)).ceil() as u32;
    for step in 1..=steps {
        let high = (f64::from(step) * SCAN_STEP * period).min(longest);
        if !at(high) {
            let [low, high] = bisect([low, high], BISECTIONS, at);
            return DelayBoundary::At(f64::midpoint(low, high));
        }
        low = high;
    }
    DelayBoundary::Beyond(longest)
}

pub(crate) fn measure_trial(
    scenario: &Scenario,
    law: LawId,
    index: u32,
    rows: &[Row],
    telemetry: &Telemetry,
) -> TrialMeasures {
    let scenario = scenario.of_trial(index);
    let mut measures = measure(scenario, index, rows, telemetry);
    let delay = rig_delay(telemetry).filter(|_| !telemetry.ended_by_controller);
    let Some((typical, longest)) = delay else { return measures };
    excuse_loop_delay(scenario, &mut measures);
    let missed: Vec<usize> = missed_expectations(scenario, &measures).collect();
    if missed.is_empty() {
        return measures;
    }
    if scenario.has_own_law() {
        excuse_own_law(scenario, index, longest, &missed, &mut measures);
        return measures;
    }
    let simulate = |delay| simulate_trial(scenario, law, index, delay);
    // In real time, the bench does not simulate the loop delay of the scenario.
    let without = simulate(Time::ZERO);
    let with = [typical, longest].map(simulate);
    for number in missed {
        let (Some(expectation), Some(excuse)) = (scenario.expectations.get(number), measures.excuses.get_mut(number))
        else {
            continue;
        };
        let holds = |simulated: &Option<TrialMeasures>| {
            let measure = simulated.as_ref().and_then(|trial| trial.measures.get(number));
            measure.is_some_and(|measure| is_met(expectation, measure))
        };
        let Some(delayed) = with.iter().find(|delayed| !holds(delayed)) else { continue };
        if excuse.is_none() && holds(&without) {
            let value = |simulated: &Option<TrialMeasures>| {
                simulated.as_ref().and_then(|trial| trial.measures.get(number)).and_then(Measure::value)
            };
            *excuse = Some(Excuse::LoopDelay {
                trial: index,
                typical_us: typical.seconds() * 1e6,
                longest_us: longest.seconds() * 1e6,
                delayed: value(delayed),
                undelayed: value(&without),
            });
        }
    }
    measures
}

/// Median and longest loop delay. `None` in lockstep, because delay is then part of the experiment.
fn rig_delay(telemetry: &Telemetry) -> Option<(Time, Time)> {
    let timing = telemetry.timing.as_ref()?;
    let delay = timing.loop_delay_us?;
    // With target pacing, the measured delay begins at the tick. A late tick acts like delay too.
    let late = if timing.pacing == Pacing::Target.name() { timing.lateness_us.max } else { 0.0 };
    Some((Time::from_ms(delay.p50 / 1e3)?, Time::from_ms((delay.max + late) / 1e3)?))
}

/// Excuses a missed limit of the loop delay, because line and bench add to it in real time.
fn excuse_loop_delay(scenario: &Scenario, measures: &mut TrialMeasures) {
    let both = scenario.expectations.iter().zip(&measures.measures);
    for ((expectation, measure), excuse) in both.zip(&mut measures.excuses) {
        if expectation.metric == Metric::LoopDelay && !is_met(expectation, measure) {
            *excuse = Some(Excuse::RealTimeDelay);
        }
    }
}

/// The bench cannot simulate an own law, so it does not know which delay such a law tolerates.
fn excuse_own_law(scenario: &Scenario, index: u32, longest: Time, missed: &[usize], measures: &mut TrialMeasures) {
    let limit = scenario.controller.period.seconds() * OWN_LAW_DELAY;
    if longest.seconds() <= limit {
        return;
    }
    for number in missed {
        let Some(excuse) = measures.excuses.get_mut(*number) else { continue };
        excuse.get_or_insert(Excuse::OwnLawDelay {
            trial: index,
            longest_us: longest.seconds() * 1e6,
            limit_us: limit * 1e6,
        });
    }
}

fn missed_expectations<'a>(scenario: &'a Scenario, measures: &'a TrialMeasures) -> impl Iterator<Item = usize> + 'a {
    let both = scenario.expectations.iter().zip(&measures.measures).enumerate();
    both.filter(|(_, (expectation, measure))| {
        let metric = expectation.metric;
        let concerns_rig = !metric.has_over() || metric.spec().subject == Subject::Rig;
        !concerns_rig && !is_met(expectation, measure)
    })
    .map(|(number, _)| number)
}

fn is_met(expectation: &Expectation, measure: &Measure) -> bool {
    measure.value().is_some_and(|value| expectation.holds(expectation.metric.spec().judged(value)))
}

/// Plays the trial with the hosted firmware. `None` if the firmware does not answer.
fn simulate_trial(scenario: &Scenario, law: LawId, index: u32, delay: Time) -> Option<TrialMeasures> {
    let mut delayed = scenario.clone();
    delayed.controller.loop_delay = delay;
    let rows = simulate_rows(&delayed, law, index)?;
    Some(measure(&delayed, index, &rows, &Telemetry::default()))
}

fn simulate_rows(scenario: &Scenario, law: LawId, index: u32) -> Option<Vec<Row>> {
    lockstep::play_hosted(scenario, law, index).ok().map(|played| played.trace_rows)
}

#[cfg(test)]
mod tests {
    use super::*;
    use platebench_model::record::{Cause, Quantiles, TimingRecord};
    use platebench_test_kit::load_scenario;

    fn boundary_periods(law: LawId, response_ms: f64) -> f64 {
        let mut scenario = load_scenario("paper/fig13-closed-loop.toml");
        scenario.controller.response_time_ms = Some(response_ms);
        scenario.plate.drive_limit_vpp = 1e5;
        let boundary = scenario_delay_boundary(&scenario, law).unwrap();
        boundary.seconds() / scenario.controller.period.seconds()
    }

    #[test]
    fn settles_from_rest_only_below_the_boundary() {
        let scenario = load_scenario("paper/fig13-closed-loop.toml");
        let configure = configure(&scenario, LawId::DqPi);
        let conditions = scenario.conditions.at(Time::ZERO);
        let start = DelayedLoop::new(&configure, &scenario.plate, conditions, scenario.model, 2.0).unwrap();
        let settling = |delay_ms: f64| start.clone().settling_time(Time::from_ms(delay_ms).unwrap(), 0.05);
        assert_eq!(settling(0.0), Some(2e-3));
        let late = settling(0.8).unwrap();
        assert!((5e-3..20e-3).contains(&late), "{late}");
        assert_eq!(settling(2.0), None);
    }

    #[test]
    fn delay_boundary_is_the_stability_boundary() {
        // Theory for a response of 2 ms at 1 kHz and forward Euler: stable up to 0.83 periods.
        let found = boundary_periods(LawId::DqPiEuler, 2.0);
        assert!((found - 0.83).abs() < 0.02, "{found}");
        // One period of delay is stable: z² − z + 0.777 has roots of magnitude 0.88. Two periods
        // are unstable: z³ − z² + 0.777 has a pair of magnitude 1.07.
        let found = boundary_periods(LawId::DqPiFixed, 2.0);
        assert!((found - 1.64).abs() < 0.02, "{found}");
        // A delay looks like damping, so gains that adapt to the damping tolerate less delay.
        let found = boundary_periods(LawId::DqPi, 2.0);
        assert!((found - 1.4).abs() < 0.02, "{found}");
    }

    fn telemetry(delay_us: f64) -> Telemetry {
        let delay = Quantiles { p50: delay_us, p99: delay_us, p999: delay_us, max: delay_us };
        let timing = TimingRecord { loop_delay_us: Some(delay), ..TimingRecord::default() };
        Telemetry { timing: Some(Box::new(timing)), ..Telemetry::default() }
    }

    fn excuse(played_law: LawId, delay_us: f64) -> Option<Cause> {
        let scenario = load_scenario("paper/fig13-closed-loop.toml");
        let mut delayed = scenario.clone();
        delayed.controller.loop_delay = Time::from_ms(delay_us / 1e3).unwrap();
        let rows = simulate_rows(&delayed, played_law, 0).unwrap();
        let measures = measure_trial(&scenario, LawId::DqPi, 0, &rows, &telemetry(delay_us));
        assert_eq!(scenario.expectations[0].metric, Metric::SettlingTime);
        measures.excuses[0].as_ref().map(Excuse::cause)
    }

    #[test]
    fn excuses_a_delay_that_the_law_does_not_tolerate() {
        assert_eq!(excuse(LawId::DqPi, 500.0), Some(Cause::Rig));
        assert_eq!(excuse(LawId::DqPi, 1.0), None, "met");
    }

    #[test]
    fn does_not_excuse_a_controller_worse_than_the_law() {
        assert_eq!(excuse(LawId::OpenLoop, 1.0), None);
    }

    #[test]
    fn excuses_an_own_law_above_a_tenth_of_the_period() {
        let mut scenario = load_scenario("paper/fig13-closed-loop.toml");
        scenario.set_law("own");
        let rows = simulate_rows(&scenario, LawId::OpenLoop, 0).unwrap();
        let excuse =
            |delay_us| measure_trial(&scenario, LawId::DqPi, 0, &rows, &telemetry(delay_us)).excuses[0].clone();
        assert_eq!(excuse(100.0), None);
        let expected = Excuse::OwnLawDelay { trial: 0, longest_us: 101.0, limit_us: 100.0 };
        assert_eq!(excuse(101.0).as_ref().map(Excuse::to_string), Some(expected.to_string()));
    }

    #[test]
    fn excuses_nothing_in_lockstep() {
        let scenario = load_scenario("paper/fig13-closed-loop.toml");
        let rows = simulate_rows(&scenario, LawId::OpenLoop, 0).unwrap();
        let telemetry = Telemetry { loop_delay_us: Some(500.0), ..Telemetry::default() };
        assert_eq!(measure_trial(&scenario, LawId::DqPi, 0, &rows, &telemetry).excuses[0], None);
    }
}
