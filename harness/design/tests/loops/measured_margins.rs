//! Compares the margins that a search measures on the played firmware with the loop analysis.

use platebench_design::margins::result::{CaseMargins, Edge};
use platebench_design::margins::scenes::{PointChoice, Quantity};
use platebench_design::margins::{MarginConfig, MarginError, measure_margins, select_requirements};
use platebench_engine::SafeEnds;
use platebench_model::scenario::load::load_template;
use platebench_model::scenario::{Scenario, ScenarioGains};
use platebench_rig::{BoxedLink, CancelToken, ConnectError, HostedLink};
use platebench_test_kit::scenario_path;
use rstest::rstest;

const STEP: &str = "paper/fig13-closed-loop.toml";
/// Largest relative difference between measured and predicted stability limits.
const AGREEMENT_PERCENT: f64 = 1.0;
const MAX_TRIALS: u32 = 300;

fn case(law: &str, point: PointChoice) -> Scenario {
    let template = load_template(&scenario_path(STEP), STEP, |_| {}).unwrap();
    point.scenario(&template, law).unwrap()
}

fn measured(case: &Scenario) -> CaseMargins {
    let (cancel, ends) = (CancelToken::never(), SafeEnds::default());
    let config = MarginConfig {
        rig: "hosted".to_owned(),
        is_reference: false,
        cases: std::slice::from_ref(case),
        quantities: &Quantity::ALL,
        own_clock: false,
        jobs: 1,
        cancel: &cancel,
    };
    let connect = || -> Result<BoxedLink, ConnectError> { Ok(Box::new(HostedLink::new())) };
    let (mut cases, skipped) = measure_margins(&config, &connect, &ends, &mut |_, _| {}).unwrap();
    assert!(skipped.is_empty() && ends.are_confirmed(), "{skipped:?}");
    let found = cases.remove(0);
    assert!((50..=MAX_TRIALS).contains(&found.trials), "{}", found.trials);
    found
}

fn edge(case: &CaseMargins, quantity: Quantity) -> &Edge {
    &case.margin(quantity).unwrap().stability
}

const UNTOUCHED: PointChoice =
    PointChoice { period_ms: None, setpoint_um: None, detuning_hz: None, force_n: Some(0.0) };
const FINGER: PointChoice = PointChoice { force_n: Some(2.0), ..UNTOUCHED };
const LOW: PointChoice = PointChoice { setpoint_um: Some(1.0), ..UNTOUCHED };
const DETUNED: PointChoice = PointChoice { detuning_hz: Some(86.74), ..UNTOUCHED };

#[rstest]
#[case::dq_pi("dq-pi", UNTOUCHED, 3)]
#[case::dq_pi_under_a_finger("dq-pi", FINGER, 3)]
#[case::dq_pi_fixed("dq-pi-fixed", UNTOUCHED, 3)]
#[case::dq_pi_euler("dq-pi-euler", UNTOUCHED, 3)]
#[case::dq_pi_euler_under_a_finger("dq-pi-euler", FINGER, 3)]
#[case::voltage_only("voltage-only", UNTOUCHED, 2)]
#[case::voltage_only_detuned("voltage-only", DETUNED, 2)]
#[case::pll("pll", UNTOUCHED, 2)]
#[case::frequency_only("frequency-only", UNTOUCHED, 2)]
#[case::deadbeat("deadbeat", UNTOUCHED, 3)]
fn measured_and_predicted_limits_agree(#[case] law: &str, #[case] point: PointChoice, #[case] predicted: usize) {
    let found = measured(&case(law, point));
    let differences: Vec<_> =
        found.margins.iter().filter_map(|margin| Some((margin.quantity, margin.difference_percent()?))).collect();
    assert_eq!(differences.len(), predicted, "{found:#?}");
    for (quantity, percent) in differences {
        assert!(percent.abs() <= AGREEMENT_PERCENT, "{quantity:?}: {percent} %: {:#?}", found.margin(quantity));
    }
}

/// With a period of many time constants, the plate's answer to a drive is complete after a period.
/// The open loop is then 1.9/(z − 1), whose phase reaches −180° only at half the sampling rate.
#[test]
fn finds_a_margin_at_half_the_sampling_rate() {
    let mut case = case("voltage-only", PointChoice { period_ms: Some(20.0), ..UNTOUCHED });
    let gain = 1.9 / case.plate.gain;
    let rate = gain / case.controller.period.seconds();
    case.controller.gains =
        Some(ScenarioGains { amplitude_kp: gain, amplitude_ki: rate, frequency_kp: 0.0, frequency_ki: 0.0 });
    case.duration = case.controller.period.times(100);
    let found = measured(&case);
    let Edge { holds_to: Some(low), fails_from: Some(high), .. } = *edge(&found, Quantity::DriveGain) else {
        panic!("{found:#?}")
    };
    assert!(low <= 2.0 / 1.9 + 0.002 && high >= 2.0 / 1.9 - 0.002 && high - low < 0.005, "{low} … {high}");
}

/// The law needs a drive 252 Hz above the resonance for 1 µm, and its range ends at 250 Hz.
#[test]
fn a_loop_at_its_frequency_limit_has_no_prediction() {
    let found = measured(&case("frequency-only", LOW));
    assert!(found.margins.iter().all(|margin| margin.predicted.is_none()), "{found:#?}");
    assert!(edge(&found, Quantity::Delay).fails_from.is_none(), "{found:#?}");
}

#[test]
fn a_law_without_feedback_is_stable_at_every_gain_and_delay() {
    let found = measured(&case("open-loop", UNTOUCHED));
    for quantity in [Quantity::DriveGain, Quantity::FrequencyGain, Quantity::Delay] {
        assert!(edge(&found, quantity).fails_from.is_none(), "{found:#?}");
    }
}

#[test]
fn requirements_fail_before_the_loop_is_unstable() {
    let found = measured(&case("dq-pi", UNTOUCHED));
    assert_eq!(found.failing, None);
    for quantity in [Quantity::Delay, Quantity::Force] {
        let margin = found.margin(quantity).unwrap();
        assert!(margin.requirement.failing.is_some(), "{margin:?}");
        let stable = margin.stability.fails_from.unwrap_or(f64::INFINITY);
        assert!(margin.requirement.fails_from.unwrap() < stable, "{margin:?}");
    }
    let noise = found.noise_gain.unwrap();
    // A law that follows its samples passes on most of their noise.
    assert!((0.5..1.0).contains(&noise.value) && noise.interval.unwrap()[0] < noise.value, "{noise:?}");
    assert!(found.settling_ms.is_some_and(|ms| (1.5..2.0).contains(&ms)), "{found:?}");
}

#[test]
fn an_operating_point_that_fails_has_no_margin() {
    let found = measured(&case("dq-pi-euler", UNTOUCHED));
    assert_eq!(found.failing.as_deref(), Some("settling_time_ms"));
    let requirement = &found.margin(Quantity::DriveGain).unwrap().requirement;
    assert_eq!((requirement.holds_to, requirement.fails_from), (None, Some(1.0)));
}

#[test]
fn a_noisy_plate_widens_the_interval() {
    let mut noisy = case("dq-pi-fixed", UNTOUCHED);
    noisy.plate.noise_um_rms = 0.008;
    let found = measured(&noisy);
    let stable = edge(&found, Quantity::DriveGain);
    // Three trials with other seeds at each end.
    assert!(
        stable.holds_to.is_some()
            && stable.trials > edge(&measured(&case("dq-pi-fixed", UNTOUCHED)), Quantity::DriveGain).trials,
        "{stable:?}"
    );
}

#[test]
fn selects_a_class_of_requirements() {
    let full = case("dq-pi", UNTOUCHED);
    let select = |class: &str| {
        let mut scenario = full.clone();
        select_requirements(&mut scenario, Some(class)).map(|()| scenario.expectations.len())
    };
    assert_eq!((select("ACC").unwrap(), select("ACC-2").unwrap()), (5, 1));
    assert!(matches!(select("GEN"), Err(MarginError::NoRequirement { .. })));
}
