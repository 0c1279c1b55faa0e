//! Measures a trial and excuses what the rig's delay makes impossible.
//!
//! If the firmware's law, simulated here, meets an expectation without the rig's delay and misses it with the delay,
//! the rig cannot decide that expectation.

use crate::real_time::Pacing;
use crate::trial::{self, TrialSpec};
use platebench_plate::{Profile, Time};
use platebench_record::Excuse;
use platebench_record::Telemetry;
use platebench_rig::{CancelToken, FaultInjector, HostedLink, Session};
use platebench_scenario::{Expectation, Metric, Scenario, Spread};
use platebench_trace::Row;
use platebench_verdict::metrics::Measure;
use platebench_verdict::{TrialMeasures, measure};
use platebench_wire::LawId;

/// The search range of the delay boundary, periods, and its bisection steps.
const MAX_BOUNDARY_PERIODS: u64 = 3;
const BOUNDARY_BISECTIONS: u32 = 12;
/// A stable loop has settled after so many periods; the last ones are checked.
const BOUNDARY_TRIAL_PERIODS: u64 = 400;
const BOUNDARY_WINDOW_PERIODS: usize = 40;
/// Half the band around the setpoint.
const BOUNDARY_BAND: f64 = 0.05;

/// Measures a trial and excuses expectations that the rig's delay makes impossible.
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
    // The scenario's own loop delay acts in lockstep only.
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

/// The typical and the longest loop delay in real time. In lockstep, delay is part of the experiment and excuses
/// nothing.
fn rig_delay(telemetry: &Telemetry) -> Option<(Time, Time)> {
    let timing = telemetry.timing.as_ref()?;
    let delay = timing.loop_delay_us?;
    // If the target paces, late sampling is not part of the measured delay but has the same effect.
    let late = if timing.pacing == Pacing::Target.name() { timing.lateness_us.max } else { 0.0 };
    Some((Time::from_ms(delay.p50 / 1e3)?, Time::from_ms((delay.max + late) / 1e3)?))
}

/// In real time the loop delay includes line and bench.
fn excuse_loop_delay(scenario: &Scenario, measures: &mut TrialMeasures) {
    let both = scenario.expectations.iter().zip(&measures.measures);
    for ((expectation, measure), excuse) in both.zip(&mut measures.excuses) {
        if expectation.metric == Metric::LoopDelay && !is_met(expectation, measure) {
            *excuse = Some(Excuse::RealTimeDelay);
        }
    }
}

/// The numbers of the expectations that this trial misses and that a delay could excuse.
fn missed_expectations<'a>(scenario: &'a Scenario, measures: &'a TrialMeasures) -> impl Iterator<Item = usize> + 'a {
    let both = scenario.expectations.iter().zip(&measures.measures).enumerate();
    both.filter(|(_, (expectation, measure))| {
        let concerns_rig = matches!(expectation.metric, Metric::Repeatability | Metric::LoopDelay | Metric::Overruns);
        !concerns_rig && !is_met(expectation, measure)
    })
    .map(|(number, _)| number)
}

fn is_met(expectation: &Expectation, measure: &Measure) -> bool {
    // The measure of the static error has a sign.
    let signed = expectation.metric == Metric::StaticError;
    let value = measure.value().map(|value| if signed { value.abs() } else { value });
    value.is_some_and(|value| expectation.holds(value))
}

/// Plays the trial with the firmware's law in this process at a constant loop delay. `None` if that fails.
fn simulate_trial(scenario: &Scenario, law: LawId, index: u32, delay: Time) -> Option<TrialMeasures> {
    let mut delayed = scenario.clone();
    delayed.controller.loop_delay = delay;
    let rows = simulate_rows(&delayed, law, index)?;
    Some(measure(&delayed, index, &rows, &Telemetry::default()))
}

fn simulate_rows(scenario: &Scenario, law: LawId, index: u32) -> Option<Vec<Row>> {
    let mut session = Session::open(FaultInjector::new(HostedLink::new())).ok()?;
    let spec = TrialSpec { scenario, law, index, wire_time: false, own_clock: false };
    trial::play(&mut session, &spec, &CancelToken::never(), None).map(|played| played.trace_rows)
}

/// The longest constant loop delay at which `law` still settles on the scenario's nominal plate in its initial
/// conditions, at the highest setpoint. `None` if it does not settle without delay.
pub(crate) fn delay_boundary(scenario: &Scenario, law: LawId) -> Option<Time> {
    let mut calm = scenario.clone();
    calm.plate.noise_um_rms = 0.0;
    calm.trials.spread = Spread::default();
    calm.duration = scenario.controller.period.times(BOUNDARY_TRIAL_PERIODS);
    calm.trace_step = scenario.controller.period;
    calm.expectations.clear();
    let (_, highest) = scenario.setpoint.range();
    let start = scenario.conditions.at(Time::ZERO);
    calm.setpoint = Profile::constant(highest);
    calm.conditions.temperature_offset_k = Profile::constant(start.temperature_offset_k);
    calm.conditions.finger_force_n = Profile::constant(start.finger_force_n);
    let mut settles = |delay: Time| {
        calm.controller.loop_delay = delay;
        let rows = simulate_rows(&calm, law, 0).unwrap_or_default();
        let end = rows.len().saturating_sub(BOUNDARY_WINDOW_PERIODS);
        highest > 0.0
            && !rows.is_empty()
            && rows.iter().skip(end).all(|row| (row.amplitude_um / highest - 1.0).abs() <= BOUNDARY_BAND)
    };
    let (mut good, mut bad) = (Time::ZERO, scenario.controller.period.times(MAX_BOUNDARY_PERIODS));
    if !settles(good) {
        return None;
    }
    if settles(bad) {
        return Some(bad);
    }
    for _ in 0..BOUNDARY_BISECTIONS {
        let middle = good.midpoint(bad);
        if settles(middle) {
            good = middle;
        } else {
            bad = middle;
        }
    }
    Some(good)
}

#[cfg(test)]
mod tests {
    use super::*;
    use platebench_record::{Cause, Quantiles, TimingRecord};
    use platebench_scenario::load;
    use std::path::Path;

    fn scenario(name: &str) -> Scenario {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../scenarios").join(name);
        load(&path, name).unwrap_or_else(|fault| panic!("{fault}"))
    }

    fn boundary_periods(law: LawId, response_ms: f64) -> f64 {
        let mut scenario = scenario("paper/fig13-closed-loop.toml");
        scenario.controller.response_time_ms = Some(response_ms);
        scenario.plate.drive_limit_vpp = 1e5;
        let budget = delay_boundary(&scenario, law).unwrap();
        budget.seconds() / scenario.controller.period.seconds()
    }

    #[test]
    fn delay_boundary_is_the_stability_boundary() {
        // Derived for a response time of 2 ms at 1 kHz: 0.83 periods with the forward-Euler integral.
        let found = boundary_periods(LawId::DqPiEuler, 2.0);
        assert!((found - 0.83).abs() < 0.02, "{found}");
        // The matched design is stable at one period (z² − z + 0.777 has its roots at 0.88), but not at two (z³ − z² + 0.777 has a pair at 1.07).
        let found = boundary_periods(LawId::DqPiFixed, 2.0);
        assert!((found - 1.64).abs() < 0.02, "{found}");
        // Gains that follow the damping tolerate less, because a delay looks like damping.
        let found = boundary_periods(LawId::DqPi, 2.0);
        assert!((found - 1.4).abs() < 0.02, "{found}");
    }

    fn telemetry(delay_us: f64) -> Telemetry {
        let delay = Quantiles { p50: delay_us, p99: delay_us, p999: delay_us, max: delay_us };
        let timing = TimingRecord { loop_delay_us: Some(delay), ..TimingRecord::default() };
        Telemetry { timing: Some(timing), ..Telemetry::default() }
    }

    /// The excuse for the first expectation, a settling time of at most 2 ms, at a delay of the rig.
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
