//! Where loops stop converging, what is and what is not called a divergence, and that no such trial leaves a number behind that is none.

#![allow(clippy::unwrap_used, clippy::panic, reason = "helpers of tests")]

use platebench_plate::{Profile, Time};
use platebench_rig::{CancelToken, FaultInjector, HostedLink, Link, Session};
use platebench_runner::trial::{self, TrialResult, TrialSpec};
use platebench_scenario::{Scenario, load};
use platebench_verdict::divergence_time_s;
use platebench_wire::LawId;
use std::fs;
use std::path::{Path, PathBuf};

fn scenarios() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../scenarios")
}

fn scenario(name: &str) -> Scenario {
    load(&scenarios().join(name), name).unwrap_or_else(|fault| panic!("{fault}"))
}

fn play_over<L: Link>(link: L, scenario: &Scenario, law: LawId) -> TrialResult {
    let mut session = Session::open(FaultInjector::new(link)).unwrap();
    let order = TrialSpec { scenario, law, index: 0, wire_time: false, own_clock: false };
    trial::play(&mut session, &order, &CancelToken::never(), None).unwrap()
}

fn divergence_time(scenario: &Scenario, law: LawId) -> Option<f64> {
    divergence_time_s(scenario, &play_over(HostedLink::new(), scenario, law).trace_rows)
}

/// Fig. 13's step with a design response time of 2 ms, a drive that is not in the way, and a delay in periods.
fn scenario_with_delay(periods: f64, duration_ms: f64) -> Scenario {
    let mut scenario = scenario("paper/fig13-closed-loop.toml");
    scenario.controller.response_time_ms = Some(2.0);
    scenario.controller.loop_delay = Time::from_ms(periods).unwrap();
    scenario.duration = Time::from_ms(duration_ms).unwrap();
    scenario
}

/// Where the linear loop's spectral radius is 1, in periods of 1 ms: forward Euler, and the design that is matched to the zero-order hold. Far enough from the
/// boundary to tell within two seconds: at 1.5 % from it a swing changes by 0.5 to 0.9 % per period.
#[test]
fn a_loop_just_past_its_boundary_diverges_and_one_just_before_it_does_not() {
    for (law, boundary) in [(LawId::DqPiEuler, 0.8302), (LawId::DqPiFixed, 1.6685)] {
        for start_hz in [32307.6, 32306.0] {
            let at = |share: f64| {
                let mut scenario = scenario_with_delay(share * boundary, 2000.0);
                scenario.controller.start_frequency_hz = start_hz;
                scenario.plate.drive_limit_vpp = 1e5;
                divergence_time(&scenario, law)
            };
            assert_eq!(at(0.985), None, "{law:?} {start_hz} Hz");
            assert!(at(1.015).is_some(), "{law:?} {start_hz} Hz");
        }
    }
}

/// Behind the amplifier of 900 Vpp what swings up ends in a swing from limit to limit. The first second is enough.
#[test]
fn an_unstable_loop_is_told_by_what_its_limits_leave_of_it() {
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

fn files(folder: &str) -> impl Iterator<Item = String> {
    let mut names: Vec<_> = fs::read_dir(scenarios().join(folder)).unwrap().map(|entry| entry.unwrap()).collect();
    names.sort_by_key(std::fs::DirEntry::file_name);
    names.into_iter().map(move |entry| format!("{folder}/{}", entry.file_name().into_string().unwrap()))
}

/// Slow laws, offsets, saturated drives, fingers, faults: every scenario under every law, and none of them diverges but the loops that are past their boundary.
/// The forward-Euler integral bears 0.83 periods, not one.
#[test]
fn no_scenario_raises_a_false_alarm_under_any_law() {
    let names = ["paper", "guards", "laws", "faults", "limits"].into_iter().flat_map(files);
    let mut found = Vec::new();
    let mut played = 0;
    for name in names.filter(|name| Path::new(name).extension().is_some_and(|ending| ending == "toml")) {
        let scenario = scenario(&name);
        for law in LawId::ALL {
            let at_s = divergence_time(&scenario, law);
            found.extend(at_s.map(|_| format!("{name} {}", law.name())));
            played += 1;
        }
    }
    assert!(played > 400, "{played}");
    found.retain(|found| {
        !found.starts_with("limits/backward-euler") && !found.starts_with("limits/past-the-delay-budget")
    });
    assert_eq!(
        found,
        [
            "laws/told-one-period-deadbeat.toml dq-pi-euler",
            "laws/told-one-period-dq-pi.toml dq-pi-euler",
            "limits/one-period-delay.toml dq-pi-euler"
        ]
    );
}

/// 0.4 % to half of the setpoint on each component, at resonance, detuned, under a finger, and at a delay that each law bears.
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
