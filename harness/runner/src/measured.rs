//! What a trial measured, and whether the rig's delay excuses what it missed.
//!
//! Lines take time. A demand that the law itself, computed here, meets without the delay and misses with it says nothing about the controller
//! behind the line: the rig is not fit to decide it.

use crate::real_time::Pacing;
use crate::trial::{self, Order, Patience};
use platebench_plate::{Profile, Time};
use platebench_rig::{Faulty, Hosted, Session};
use platebench_scenario::{Expectation, Metric, Scenario, Spread};
use platebench_trace::Row;
use platebench_verdict::judge::Excuse;
use platebench_verdict::metrics::Measure;
use platebench_verdict::record::Cause;
use platebench_verdict::{Telemetry, TrialMeasures, measure};
use platebench_wire::LawId;

/// A budget is looked for up to so many periods, and found to the last of these steps.
const BUDGET_PERIODS: u64 = 3;
const BUDGET_BISECTIONS: u32 = 12;
/// Periods after which a loop that settles at all has done so, and how many of them are looked at.
const BUDGET_TRIAL: u64 = 400;
const BUDGET_WINDOW: usize = 40;
/// Half the band around the setpoint.
const BUDGET_BAND: f64 = 0.05;

/// A controller without a sample for so many periods stops, unless it was told to wait longer.
const PATIENCE_PERIODS: u64 = 5;

/// Plays to the end.
struct Patient;

impl Patience for Patient {
    fn is_over(&self) -> bool {
        false
    }
}

/// Measures a trial and excuses what the rig's own delay makes impossible for the law.
pub(crate) fn measured(
    scenario: &Scenario,
    law: LawId,
    index: u32,
    rows: &[Row],
    telemetry: &Telemetry,
) -> TrialMeasures {
    let mut measures = measure(scenario, index, rows, telemetry);
    excuse_patience(scenario, telemetry, &mut measures);
    let Some((typical, longest)) = added_delay(telemetry) else { return measures };
    excuse_loop_delay(scenario, &mut measures);
    let missed: Vec<usize> = missed(scenario, &measures).collect();
    if missed.is_empty() {
        return measures;
    }
    let of_law = |delay| twin(scenario, law, index, delay);
    // What the scenario asks for in lockstep does not act in real time.
    let without = of_law(Time::ZERO);
    let with = [typical, longest].map(of_law);
    for number in missed {
        let (Some(expectation), Some(excuse)) = (scenario.expectations.get(number), measures.excuses.get_mut(number))
        else {
            continue;
        };
        let holds = |twin: &Option<TrialMeasures>| {
            let twin = twin.as_ref().and_then(|twin| twin.measures.get(number));
            twin.is_some_and(|measure| holds(expectation, measure))
        };
        let Some(delayed) = with.iter().find(|delayed| !holds(delayed)) else { continue };
        if excuse.is_none() && holds(&without) {
            let value = |twin: &Option<TrialMeasures>| {
                twin.as_ref().and_then(|twin| twin.measures.get(number)).and_then(Measure::value)
            };
            *excuse = Some(Excuse {
                cause: Cause::Rig,
                reason: format!(
                    "trial {index}: at this rig's loop delay of {:.0} µs (longest {:.0}) the law itself gets {}, without it {}; a slower --time-scale makes the delay smaller",
                    typical.seconds() * 1e6,
                    longest.seconds() * 1e6,
                    shown(value(delayed)),
                    shown(value(&without)),
                ),
            });
        }
    }
    measures
}

/// The typical and the longest loop delay in real time. Where time waits, whoever lets a delay act wants to see what it does.
fn added_delay(telemetry: &Telemetry) -> Option<(Time, Time)> {
    let timing = telemetry.timing.as_ref()?;
    let delay = timing.loop_delay_us?;
    // Where the target paces, a plate that is sampled late is no part of the delay, and does the same to the loop.
    let late = if timing.pacing == Pacing::Target.name() { timing.lateness_us.max } else { 0.0 };
    Some((Time::from_ms(delay.p50 / 1e3)?, Time::from_ms((delay.max + late) / 1e3)?))
}

/// Where the plate waits and the controller's clock does not, it is told to wait as well: a silence on the line that should stop it then does not.
fn excuse_patience(scenario: &Scenario, telemetry: &Telemetry, measures: &mut TrialMeasures) {
    let Some(patience_ms) = telemetry.patience_ms else { return };
    let period = scenario.controller.period;
    let patience = period.times(PATIENCE_PERIODS);
    if !scenario.faults.iter().any(|fault| fault.outlasts(patience, period)) {
        return;
    }
    let reason = format!(
        "in lockstep this controller waits {patience_ms} ms of its own clock for a sample, which a planned silence of the line does not last; --clock real-time decides it"
    );
    let missed: Vec<usize> = missed(scenario, measures).collect();
    for number in missed {
        if let Some(excuse @ None) = measures.excuses.get_mut(number) {
            *excuse = Some(Excuse { cause: Cause::Rig, reason: reason.clone() });
        }
    }
}

/// In real time the loop delay is that of line and bench as well.
fn excuse_loop_delay(scenario: &Scenario, measures: &mut TrialMeasures) {
    let both = scenario.expectations.iter().zip(&measures.measures);
    for ((expectation, measure), excuse) in both.zip(&mut measures.excuses) {
        if expectation.metric == Metric::LoopDelay && !holds(expectation, measure) {
            let reason = "in real time the line and the bench make the loop delay, not the controller alone";
            *excuse = Some(Excuse { cause: Cause::Rig, reason: reason.to_owned() });
        }
    }
}

/// Expectations that this trial misses by itself and that a delay could excuse.
fn missed<'a>(scenario: &'a Scenario, measures: &'a TrialMeasures) -> impl Iterator<Item = usize> + 'a {
    let both = scenario.expectations.iter().zip(&measures.measures).enumerate();
    both.filter(|(_, (expectation, measure))| {
        let of_the_rig = matches!(expectation.metric, Metric::Repeatability | Metric::LoopDelay | Metric::Overruns);
        !of_the_rig && !holds(expectation, measure)
    })
    .map(|(number, _)| number)
}

fn holds(expectation: &Expectation, measure: &Measure) -> bool {
    // An error keeps its sign in a measure.
    let signed = expectation.metric == Metric::StaticError;
    let value = measure.value().map(|value| if signed { value.abs() } else { value });
    value.is_some_and(|value| expectation.limit.holds(value))
}

fn shown(value: Option<f64>) -> String {
    value.map_or_else(|| "no value".to_owned(), |value| format!("{value:.3}"))
}

/// The same trial, played by the law in this process at a constant loop delay. `None` where it cannot be played.
fn twin(scenario: &Scenario, law: LawId, index: u32, delay: Time) -> Option<TrialMeasures> {
    let mut delayed = scenario.clone();
    delayed.controller.loop_delay = delay;
    let rows = play(&delayed, law, index)?;
    Some(measure(&delayed, index, &rows, &Telemetry::default()))
}

fn play(scenario: &Scenario, law: LawId, index: u32) -> Option<Vec<Row>> {
    let mut session = Session::open(Faulty::new(Hosted::new())).ok()?;
    let order = Order { scenario, law, index, wire_time: false, own_clock: false };
    trial::play(&mut session, &order, &Patient).map(|played| played.rows)
}

/// The longest constant loop delay at which `law` still settles on the scenario's nominal plate, as it is at the start: at its highest setpoint, from its
/// start frequency. `None` where it does not even settle without delay.
pub(crate) fn delay_budget(scenario: &Scenario, law: LawId) -> Option<Time> {
    let mut calm = scenario.clone();
    calm.plate.noise_um_rms = 0.0;
    calm.trials.spread = Spread::default();
    calm.duration = scenario.controller.period.times(BUDGET_TRIAL);
    calm.trace_step = scenario.controller.period;
    calm.expectations.clear();
    let (_, highest) = scenario.setpoint.range();
    let start = scenario.scene.at(Time::ZERO);
    calm.setpoint = Profile::constant(highest);
    calm.scene.temperature_offset_k = Profile::constant(start.temperature_offset_k);
    calm.scene.finger_force_n = Profile::constant(start.finger_force_n);
    let mut settles = |delay: Time| {
        calm.controller.loop_delay = delay;
        let rows = play(&calm, law, 0).unwrap_or_default();
        let end = rows.len().saturating_sub(BUDGET_WINDOW);
        highest > 0.0
            && !rows.is_empty()
            && rows.iter().skip(end).all(|row| (row.amplitude_um / highest - 1.0).abs() <= BUDGET_BAND)
    };
    let (mut good, mut bad) = (Time::ZERO, scenario.controller.period.times(BUDGET_PERIODS));
    if !settles(good) {
        return None;
    }
    if settles(bad) {
        return Some(bad);
    }
    for _ in 0..BUDGET_BISECTIONS {
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
    use platebench_scenario::load;
    use platebench_verdict::record::{Quantiles, Timing};
    use std::path::Path;

    fn scenario(name: &str) -> Scenario {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../scenarios").join(name);
        load(&path, name).unwrap_or_else(|fault| panic!("{fault}"))
    }

    fn budget_periods(law: LawId, response_ms: f64) -> f64 {
        let mut scenario = scenario("paper/fig13-closed-loop.toml");
        scenario.controller.response_time_ms = Some(response_ms);
        scenario.plate.drive_limit_vpp = 1e5;
        let budget = delay_budget(&scenario, law).unwrap();
        budget.seconds() / scenario.controller.period.seconds()
    }

    #[test]
    fn the_budget_is_the_boundary_of_stability() {
        // Derived for a response time of 2 ms at 1 kHz: 0.83 periods with the forward-Euler integral.
        let found = budget_periods(LawId::DqPiEuler, 2.0);
        assert!((found - 0.83).abs() < 0.02, "{found}");
        // The matched design bears one period (z² − z + 0.777 has its roots at 0.88), two it does not (z³ − z² + 0.777 has a pair at 1.07).
        let found = budget_periods(LawId::DqPiFixed, 2.0);
        assert!((found - 1.64).abs() < 0.02, "{found}");
        // Gains that follow the damping bear less, because a delay looks like damping.
        let found = budget_periods(LawId::DqPi, 2.0);
        assert!((found - 1.4).abs() < 0.02, "{found}");
    }

    fn telemetry(delay_us: f64) -> Telemetry {
        let delay = Quantiles { p50: delay_us, p99: delay_us, p999: delay_us, max: delay_us };
        let timing = Timing { loop_delay_us: Some(delay), ..Timing::default() };
        Telemetry { timing: Some(timing), ..Telemetry::default() }
    }

    /// The excuse for the first expectation, a settling time of at most 2 ms, at a delay of the rig.
    fn excuse(played_law: LawId, delay_us: f64) -> Option<Cause> {
        let scenario = scenario("paper/fig13-closed-loop.toml");
        let mut delayed = scenario.clone();
        delayed.controller.loop_delay = Time::from_ms(delay_us / 1e3).unwrap();
        let rows = play(&delayed, played_law, 0).unwrap();
        let measures = measured(&scenario, LawId::DqPi, 0, &rows, &telemetry(delay_us));
        assert_eq!(scenario.expectations[0].metric, Metric::SettlingTime);
        measures.excuses[0].as_ref().map(|excuse| excuse.cause)
    }

    #[test]
    fn a_delay_that_the_law_itself_does_not_bear_excuses_the_controller() {
        assert_eq!(excuse(LawId::DqPi, 500.0), Some(Cause::Rig));
        assert_eq!(excuse(LawId::DqPi, 1.0), None, "met");
    }

    #[test]
    fn a_controller_that_is_worse_than_the_law_at_the_same_delay_has_no_excuse() {
        assert_eq!(excuse(LawId::OpenLoop, 1.0), None);
    }

    /// Whether a controller that plays on through a planned silence is excused, by its patience.
    fn silence_excused(name: &str, patience_ms: Option<u16>) -> bool {
        let scenario = scenario(name);
        // As if nothing had been lost: it never stops.
        let undisturbed = Scenario { faults: Vec::new(), ..scenario.clone() };
        let rows = play(&undisturbed, LawId::DqPi, 0).unwrap();
        let telemetry = Telemetry { patience_ms, ..Telemetry::default() };
        let measures = measured(&scenario, LawId::DqPi, 0, &rows, &telemetry);
        let cause = |excuse: &Option<Excuse>| excuse.as_ref().map(|excuse| excuse.cause);
        measures.excuses.iter().any(|excuse| cause(excuse) == Some(Cause::Rig))
    }

    #[test]
    fn a_controller_that_was_told_to_wait_is_not_blamed_for_waiting() {
        assert!(silence_excused("faults/five-periods-of-silence.toml", Some(1_000)));
        assert!(!silence_excused("faults/five-periods-of-silence.toml", None), "its clock is the plate's");
        // One sample: nobody would stop for that.
        assert!(!silence_excused("faults/lost-sample.toml", Some(1_000)));
    }

    #[test]
    fn without_real_time_nothing_is_excused() {
        let scenario = scenario("paper/fig13-closed-loop.toml");
        let rows = play(&scenario, LawId::OpenLoop, 0).unwrap();
        let telemetry = Telemetry { loop_delay_us: Some(500.0), ..Telemetry::default() };
        assert_eq!(measured(&scenario, LawId::DqPi, 0, &rows, &telemetry).excuses[0], None);
    }
}
