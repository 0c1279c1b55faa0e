use super::{FORCE, create_folder, load_with_change, load_with_changes};
use crate::metrics::Metric;
use crate::scenario::expect::{Aggregation, Limit};
use crate::scenario::fault::{Direction, Fault, FaultKind};
use crate::scenario::load::load;
use crate::scenario::window::Window;
use platebench_plate::{Model, Time};
use rstest::rstest;

#[test]
fn reads_every_key() {
    let scenario = load_with_changes(&[]).unwrap();
    assert_eq!(scenario.inputs.len(), 3);
    assert_eq!(scenario.inputs[2].bytes, FORCE.as_bytes());
    assert_eq!(scenario.expectations[0].from, Time::from_ms(1.0));
    assert_eq!(scenario.expectations[1].limit, Limit::Within(0.0, 1.0));
    assert_eq!(scenario.expectations[1].confidence, 0.9);
    assert_eq!(scenario.expectations[2].limit, Limit::About(2.0));
    assert_eq!(scenario.expectations[2].tolerance_percent, 3.0);
    assert_eq!(scenario.trials.max_count, 200);
    assert_eq!(scenario.conditions.finger_force_n.at(Time::from_ms(25.0).unwrap()), 0.5);
}

#[test]
fn reads_faults_with_their_defaults() {
    let scenario = load_with_change("seed = 5", "seed = 5").unwrap();
    let [flip, delay, scale, disconnect] = &scenario.faults[..] else { panic!("{:?}", scenario.faults) };
    let [ms_10, ms_20] = [10.0, 20.0].map(|ms| Time::from_ms(ms).unwrap());
    let expected = Fault {
        kind: FaultKind::Flip,
        from: ms_10,
        until: Some(ms_20),
        direction: Direction::ToController,
        every: 10,
        seed: Some(5),
        reconfigure: true,
    };
    assert_eq!(*flip, expected);
    assert_eq!(delay.kind, FaultKind::Delay(Time::from_ms(0.5).unwrap()));
    assert_eq!((delay.direction, delay.every, delay.seed, delay.reconfigure), (Direction::Both, 1, None, false));
    assert_eq!((scale.kind, scale.direction), (FaultKind::Scale(0.9), Direction::ToController));
    assert_eq!((disconnect.kind, disconnect.until), (FaultKind::Disconnect, None));
}

#[test]
fn missing_keys_have_their_documented_defaults() {
    let folder = create_folder(&[]);
    let path = folder.path().join("short.toml");
    let text = "title = \"Short\"\nplate = \"plates/plate.toml\"\nduration_ms = 60\n[profile]\nsetpoint_um = 2\n\
                [[expect]]\nmetric = \"static_error_percent\"\nat_most = 1\n";
    std::fs::write(&path, text).unwrap();
    let scenario = load(&path, "short.toml").unwrap();
    let controller = &scenario.controller;
    assert_eq!(
        (controller.law.as_str(), controller.period, controller.loop_delay),
        ("dq-pi", Time::from_ms(1.0).unwrap(), Time::ZERO)
    );
    assert!((controller.start_frequency_hz - 32_307.6).abs() < 1e-6);
    assert_eq!((scenario.trials.count, scenario.trials.max_count, scenario.trials.seed), (1, 1, 1));
    assert!(scenario.is_deterministic());
    assert_eq!(scenario.trace_step, Time::from_ms(0.05).unwrap());
    let [expectation] = &scenario.expectations[..] else { panic!("one expectation") };
    assert_eq!((expectation.confidence, expectation.band_percent), (0.95, 5.0));
    assert_eq!(expectation.windows, [Window { from: Time::from_ms(40.0).unwrap(), to: Time::from_ms(60.0).unwrap() }]);
    assert_eq!(expectation.signal, "amplitude_um");
}

#[test]
fn the_statistic_over_trials_can_be_chosen() {
    let over = |more: &str| load_with_change("confidence = 0.9", more).unwrap().expectations[1].aggregation;
    assert_eq!(over(""), Aggregation::Mean);
    assert_eq!(over("over = \"each\""), Aggregation::Each);
    assert_eq!(over("over = \"mean\""), Aggregation::Mean);
    assert_eq!(over("over = \"quantile\""), Aggregation::Quantile(0.95));
    assert_eq!(over("over = \"quantile\"\nquantile = 0.5"), Aggregation::Quantile(0.5));
    let all = load_with_changes(&[(
        "\"final_amplitude_um\"\nabout = 2.0\ntolerance_percent = 3.0",
        "\"repeatability_percent\"\nat_most = 2.0",
    )]);
    let all: Vec<_> = all.unwrap().expectations.iter().map(|expectation| expectation.aggregation).collect();
    assert_eq!(all, [Aggregation::Each, Aggregation::Mean, Aggregation::StandardDeviation]);
}

#[test]
fn finds_each_metric_by_its_name() {
    for &metric in Metric::ALL {
        assert_eq!(Metric::from_name(metric.name()), Some(metric));
    }
}

#[test]
fn a_shutdown_lasts_until_the_next_planned_configuration() {
    let window = |from_ms: f64| {
        let expectation = format!("\"shutdown_time_ms\"\nfrom_ms = {from_ms:?}\nat_most = 5.0");
        let other = ("\"final_amplitude_um\"\nabout = 2.0\ntolerance_percent = 3.0", expectation.as_str());
        let scenario = load_with_changes(&[other, ("seed = 5", "seed = 5")]).unwrap();
        let Window { from, to } = scenario.expectations[2].windows[0];
        (from.ms(), to.ms())
    };
    assert_eq!(window(19.0), (19.0, 20.0));
    assert_eq!(window(20.0), (20.0, 60.0));
}

#[rstest]
#[case::plain("auto", "", Model::Modal)]
#[case::left_out("", "", Model::Modal)]
#[case::converter("auto", "demodulator_periods = 1\nconverter_hz = 1e6\n", Model::Carrier)]
#[case::linear("linear", "demodulator_periods = 1\nconverter_hz = 1e6\n", Model::Linear)]
#[case::envelope("envelope", "", Model::Envelope)]
#[case::modal("modal", "demodulator_periods = 1\nconverter_hz = 1e6\n", Model::Modal)]
#[case::carrier("carrier", "", Model::Carrier)]
fn auto_is_the_carrier_for_a_plate_with_a_demodulator(#[case] name: &str, #[case] sensor: &str, #[case] model: Model) {
    let line = if name.is_empty() { String::new() } else { format!("model = \"{name}\"") };
    let folder = create_folder(&[("model = \"modal\"", &line), ("[sensor]\n", &format!("[sensor]\n{sensor}"))]);
    assert_eq!(load(&folder.path().join("s.toml"), "s.toml").unwrap().model, model);
}

#[rstest]
#[case("[drive]\n", "[drive]\nbandwidth_hz = 5e3\n", "envelope", "drive.bandwidth_hz")]
#[case("[sensor]\n", "[sensor]\nlatency_us = 10.0\n", "linear", "sensor.latency_us")]
#[case(
    "[drive]\n",
    "[second_mode]\nresonance_hz = 32607.6\ntime_constant_ms = 1.2\ngain_um_per_vpp = 0.001\n[drive]\n",
    "envelope",
    "second_mode"
)]
fn a_model_that_omits_an_effect_of_the_plate_is_refused(
    #[case] good: &str,
    #[case] keys: &str,
    #[case] model: &str,
    #[case] effect: &str,
) {
    let model_key = format!("model = \"{model}\"");
    let fault = load_with_changes(&[(good, keys), ("model = \"modal\"", &model_key)]).unwrap_err();
    let expected = format!("the model {model} omits `{effect}` of the plate file, expected auto, modal or carrier");
    assert_eq!(fault.message, expected);
    assert_eq!(fault.position(), (7, 9));
    let scenario = load_with_changes(&[(good, keys), ("model = \"modal\"", "")]).unwrap();
    assert_eq!((scenario.model, scenario.plate.first_effect()), (Model::Modal, Some(effect)));
}

#[test]
fn calculations_with_one_mode_refuse_effects() {
    let folder = create_folder(&[("[drive]\n", "[drive]\ndead_time_us = 20.0\n")]);
    let path = folder.path().join("plates/plate.toml");
    let plate = crate::scenario::load::load_plate(&path).unwrap();
    let fault = crate::scenario::load::require_no_effects(&path, &plate, "tune").unwrap_err();
    let expected = "tune assumes one mode with an ideal amplifier and sensor, expected a plate file without \
                    `drive.dead_time_us`";
    assert_eq!(fault.message, expected);
    let line = std::fs::read_to_string(&path).unwrap().lines().position(|line| line.starts_with("dead_time_us"));
    assert_eq!(Some(fault.position().0), line.map(|line| line + 1));
}
