use crate::fixtures::FIG13;
use platebench_engine::{Trial, lockstep};
use platebench_model::scenario::{Scenario, find};
use platebench_plate::{Profile, Time};
use platebench_rig::{FaultInjector, HostedLink, Session};
use platebench_test_kit::{load_scenario, scenario_path};
use platebench_verdict::divergence_time_s;
use platebench_wire::LawId;

fn divergence_time(scenario: &Scenario, law: LawId) -> Option<f64> {
    let mut session = Session::open(FaultInjector::new(HostedLink::new())).unwrap();
    let result = lockstep::play(&mut session, Trial::new(scenario, law, 0)).unwrap();
    divergence_time_s(scenario, &result.trace_rows)
}

fn scenario_with_delay(periods: f64, duration_ms: f64) -> Scenario {
    let mut scenario = load_scenario(FIG13);
    scenario.controller.loop_delay = Time::from_ms(periods).unwrap();
    scenario.duration = Time::from_ms(duration_ms).unwrap();
    scenario
}

/// At the boundary the spectral radius of the loop is 1. At a delay 1.5 % away from it, an
/// oscillation changes by at least 0.5 % per period. So a trial of 2 s shows the difference.
#[test]
fn a_loop_diverges_just_past_its_stability_limit() {
    for (law, boundary) in [(LawId::DqPiEuler, 0.8302), (LawId::DqPiFixed, 1.6685)] {
        for start_hz in [32307.6, 32306.0] {
            let at = |share: f64| {
                let mut scenario = scenario_with_delay(share * boundary, 2000.0);
                scenario.controller.response_time_ms = Some(2.0);
                scenario.controller.start_frequency_hz = start_hz;
                scenario.plate.drive_limit_vpp = 1e5;
                divergence_time(&scenario, law)
            };
            assert_eq!(at(0.985), None, "{law:?} {start_hz} Hz");
            assert!(at(1.015).is_some(), "{law:?} {start_hz} Hz");
        }
    }
}

#[test]
fn a_limit_cycle_of_an_unstable_loop_is_a_divergence() {
    for (law, periods) in [
        (LawId::DqPiEuler, 0.9),
        (LawId::DqPiEuler, 2.0),
        (LawId::DqPiFixed, 1.8),
        (LawId::DqPi, 2.0),
        (LawId::Deadbeat, 3.0),
        (LawId::VoltageOnly, 2.0),
        (LawId::BangBang, 2.0),
        (LawId::FrequencyOnly, 5.0),
        (LawId::Pll, 5.0),
    ] {
        for start_hz in [32307.6, 32220.9] {
            let mut scenario = scenario_with_delay(periods, 1000.0);
            scenario.controller.response_time_ms = None;
            scenario.controller.start_frequency_hz = start_hz;
            let at_s = divergence_time(&scenario, law);
            assert!(at_s.is_some_and(|at_s| at_s < 0.1), "{law:?} {start_hz} Hz: {at_s:?}");
        }
    }
}

/// Only true alarms may remain: `dq-pi-euler` is stable up to a delay of 0.83 periods.
#[test]
fn scenarios_raise_no_false_alarm_under_any_law() {
    let found = find(&[scenario_path("")]).unwrap();
    let is_tested =
        |file: &str| ["paper/", "guards/", "laws/", "faults/", "limits/"].iter().any(|at| file.starts_with(at));
    let mut scenarios = [found.scenarios, found.skipped].concat();
    scenarios.sort_by(|a, b| a.file.cmp(&b.file));
    let mut diverging = Vec::new();
    let mut count = 0;
    for scenario in scenarios.iter().filter(|scenario| is_tested(&scenario.file)) {
        for law in LawId::ALL {
            let at_s = divergence_time(scenario, law);
            diverging.extend(at_s.map(|_| format!("{} {}", scenario.file, law.name())));
            count += 1;
        }
    }
    assert!(count > 400, "{count}");
    diverging
        .retain(|name| !name.starts_with("limits/backward-euler") && !name.starts_with("limits/past-the-delay-budget"));
    assert_eq!(
        diverging,
        [
            "laws/specified-delay-one-period-deadbeat.toml dq-pi-euler",
            "laws/specified-delay-one-period-dq-pi.toml dq-pi-euler",
            "limits/one-period-delay.toml dq-pi-euler"
        ]
    );
}

/// Tests noise of 0.4 % to 50 % of the setpoint: at resonance, detuned, under a finger, with delay.
#[test]
fn noise_raises_no_false_alarm() {
    for law in LawId::ALL {
        for noise_um in [0.008, 0.03, 0.1, 0.3, 1.0] {
            for (force_n, start_hz, periods) in
                [(0.0, 32307.6, 0.0), (0.0, 32220.9, 0.0), (2.0, 32220.9, 0.0), (0.0, 32307.6, 0.7)]
            {
                for seed in 1..4 {
                    let mut scenario = scenario_with_delay(periods, 200.0);
                    scenario.controller.response_time_ms = None;
                    scenario.controller.start_frequency_hz = start_hz;
                    scenario.conditions.finger_force_n = Profile::constant(force_n);
                    scenario.plate.noise_um_rms = noise_um;
                    scenario.trials.seed = seed;
                    assert_eq!(
                        divergence_time(&scenario, law),
                        None,
                        "{law:?} {noise_um} µm {force_n} N {start_hz} Hz"
                    );
                }
            }
        }
    }
}
