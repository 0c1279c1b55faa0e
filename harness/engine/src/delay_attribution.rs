//! Excuses a missed expectation if the delay of the rig explains it: the simulated law meets it
//! without this delay and misses it with this delay.

use crate::lockstep;
use crate::real_time::Pacing;
use platebench_model::record::{Excuse, Telemetry};
use platebench_model::scenario::{Expectation, Metric, Scenario};
use platebench_model::trace::Row;
use platebench_plate::Time;
use platebench_verdict::metrics::Measure;
use platebench_verdict::{TrialMeasures, measure};
use platebench_wire::LawId;

pub(crate) fn measure_trial(
    scenario: &Scenario,
    law: LawId,
    index: u32,
    rows: &[Row],
    telemetry: &Telemetry,
) -> TrialMeasures {
    let mut measures = measure(scenario, index, rows, telemetry);
    let Some((typical, longest)) = rig_delay(telemetry) else { return measures };
    excuse_loop_delay(scenario, &mut measures);
    let missed: Vec<usize> = missed_expectations(scenario, &measures).collect();
    if missed.is_empty() {
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

fn missed_expectations<'a>(scenario: &'a Scenario, measures: &'a TrialMeasures) -> impl Iterator<Item = usize> + 'a {
    let both = scenario.expectations.iter().zip(&measures.measures).enumerate();
    both.filter(|(_, (expectation, measure))| {
        let metric = expectation.metric;
        let concerns_rig = !metric.has_over() || matches!(metric, Metric::LoopDelay | Metric::Overruns);
        !concerns_rig && !is_met(expectation, measure)
    })
    .map(|(number, _)| number)
}

fn is_met(expectation: &Expectation, measure: &Measure) -> bool {
    let signed = expectation.metric == Metric::StaticError;
    let value = measure.value().map(|value| if signed { value.abs() } else { value });
    value.is_some_and(|value| expectation.holds(value))
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
    use platebench_model::scenario::load;
    use std::path::Path;

    fn scenario(name: &str) -> Scenario {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../scenarios").join(name);
        load(&path, name).unwrap_or_else(|fault| panic!("{fault}"))
    }

    fn telemetry(delay_us: f64) -> Telemetry {
        let delay = Quantiles { p50: delay_us, p99: delay_us, p999: delay_us, max: delay_us };
        let timing = TimingRecord { loop_delay_us: Some(delay), ..TimingRecord::default() };
        Telemetry { timing: Some(Box::new(timing)), ..Telemetry::default() }
    }

    fn excuse(played_law: LawId, delay_us: f64) -> Option<Cause> {
        let scenario = scenario("paper/fig13-closed-loop.toml");
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
    fn excuses_nothing_in_lockstep() {
        let scenario = scenario("paper/fig13-closed-loop.toml");
        let rows = simulate_rows(&scenario, LawId::OpenLoop, 0).unwrap();
        let telemetry = Telemetry { loop_delay_us: Some(500.0), ..Telemetry::default() };
        assert_eq!(measure_trial(&scenario, LawId::DqPi, 0, &rows, &telemetry).excuses[0], None);
    }
}
