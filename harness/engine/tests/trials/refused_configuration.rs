//! Checks that a refused configuration is the controller's failure, and that the run continues.

use crate::fixtures::{FIG13, LOCKSTEP, plan, run_with_link};
use platebench_engine::{Clock, RunError};
use platebench_model::record::{RunRecord, Verdict, ViolationKind};
use platebench_model::scenario::Scenario;
use platebench_plate::Time;
use platebench_rig::{BoxedLink, Link, WallClockLink};
use platebench_test_kit::{ScriptedLink, load_scenario, packets};
use platebench_wire::{Configured, Message, Packet, Rejection};
use rstest::rstest;
use std::time::Duration;

/// Refuses configurations with this control period, µs.
const REFUSED_US: u32 = 2_000;

fn refusing_link() -> impl Link {
    ScriptedLink::new(|controller, now, bytes, answer| {
        let is_refused = |packet: &Packet| {
            let Message::Configure(configure) = packet.message else { return false };
            configure.period_us == REFUSED_US
        };
        match packets(bytes).into_iter().find(is_refused) {
            Some(Packet { sequence, .. }) => {
                let message = Message::Configured(Configured { outcome: Err(Rejection::Value) });
                answer.extend_from_slice(Packet { sequence, message }.encode().as_bytes());
                Ok(Duration::ZERO)
            }
            None => controller.exchange(now, bytes, answer),
        }
    })
}

fn with_period(period_us: u64) -> Scenario {
    let mut scenario = load_scenario(FIG13);
    scenario.controller.period = Time::from_nanos(period_us * 1_000);
    scenario.file = format!("{period_us}.toml");
    scenario
}

fn play(scenarios: Vec<Scenario>, clock: Clock) -> Result<RunRecord, RunError> {
    let folder = tempfile::tempdir().unwrap();
    let connect = || -> BoxedLink {
        let link = refusing_link();
        if clock == LOCKSTEP { Box::new(link) } else { Box::new(WallClockLink::new(link)) }
    };
    run_with_link(&plan(scenarios, clock), &folder.path().join("run"), connect)
}

fn violations(record: &RunRecord, scenario: usize) -> Vec<ViolationKind> {
    record.scenarios[scenario].trials[0].telemetry.violations.iter().map(|one| one.kind).collect()
}

#[rstest]
#[case::lockstep(LOCKSTEP)]
#[case::real_time(crate::fixtures::REAL_TIME)]
fn a_refusal_fails_its_scenario_and_the_rest_is_played(#[case] clock: Clock) {
    let record = play(vec![with_period(u64::from(REFUSED_US)), with_period(1_000)], clock).unwrap();
    assert_eq!(violations(&record, 0), [ViolationKind::RefusedConfiguration]);
    assert_eq!((record.verdict, record.scenarios[0].verdict), (Verdict::Fail, Verdict::Fail));
    let ended = record.scenarios[0].trials[0].telemetry.ended.as_deref();
    assert!(ended.is_some_and(|ended| ended.contains("refused its configuration")), "{ended:?}");
    assert_eq!((violations(&record, 1), record.scenarios[1].trials.len()), (Vec::new(), 1));
    assert!(record.complete);
}

#[test]
fn a_refusal_between_two_trials_fails_the_second_one() {
    let mut scenario = with_period(1_000);
    scenario.trials.count = 2;
    scenario.between = vec![with_period(u64::from(REFUSED_US))];
    let record = play(vec![scenario], LOCKSTEP).unwrap();
    let kinds = record.scenarios[0].trials.iter().map(|trial| trial.telemetry.violations.len()).collect::<Vec<_>>();
    assert_eq!((kinds, record.verdict), (vec![0, 1], Verdict::Fail));
}

/// The page calls a frequency range of 0 Hz unusable.
#[test]
fn what_no_controller_can_use_is_an_invalid_input_before_the_first_trial() {
    let mut unusable = with_period(1_000);
    unusable.controller.frequency_range_hz = 0.0;
    let refused = play(vec![with_period(1_000), unusable], LOCKSTEP);
    assert!(matches!(refused, Err(RunError::Refused { .. })), "{refused:?}");
}
