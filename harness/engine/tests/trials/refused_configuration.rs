//! Checks that a refused configuration is the controller's failure, and that the run continues.

use crate::fixtures::{FIG13, LOCKSTEP, packets, plan};
use platebench_engine::{Clock, RunError, RunHooks, run};
use platebench_model::record::{RunFolder, RunRecord, Verdict, ViolationKind};
use platebench_model::scenario::Scenario;
use platebench_plate::Time;
use platebench_rig::{HostedLink, Link, LinkError, WallClockLink};
use platebench_test_kit::load_scenario;
use platebench_wire::{Configured, Message, Packet, Rejection};
use rstest::rstest;
use std::time::Duration;

/// Refuses configurations with this control period, µs.
const REFUSED_US: u32 = 2_000;

struct RefusingLink(HostedLink);

impl Link for RefusingLink {
    fn exchange(&mut self, now: Duration, bytes: &[u8], answer: &mut Vec<u8>) -> Result<Duration, LinkError> {
        let requests = packets(bytes);
        let is_refused = |packet: &&Packet| matches!(packet.message, Message::Configure(configure) if configure.period_us == REFUSED_US);
        match requests.iter().find(is_refused) {
            Some(&Packet { sequence, .. }) => {
                let message = Message::Configured(Configured { outcome: Err(Rejection::Value) });
                answer.extend_from_slice(Packet { sequence, message }.encode().as_bytes());
                Ok(Duration::ZERO)
            }
            None => self.0.exchange(now, bytes, answer),
        }
    }

    fn advance_to(&mut self, now: Duration, received: &mut Vec<u8>) -> Result<(), LinkError> {
        self.0.advance_to(now, received)
    }

    fn restart(&mut self) -> Result<bool, LinkError> {
        self.0.restart()
    }
}

fn with_period(period_us: u64) -> Scenario {
    let mut scenario = load_scenario(FIG13);
    scenario.controller.period = Time::from_nanos(period_us * 1_000);
    scenario.file = format!("{period_us}.toml");
    scenario
}

fn play(scenarios: Vec<Scenario>, clock: Clock) -> Result<RunRecord, RunError> {
    let folder = tempfile::tempdir().unwrap();
    let run_folder = RunFolder::create(Some(&folder.path().join("run"))).unwrap();
    let connect = || -> Result<Box<dyn Link>, _> {
        let link = RefusingLink(HostedLink::new());
        Ok(if clock == LOCKSTEP { Box::new(link) } else { Box::new(WallClockLink::new(link)) })
    };
    run(&plan(scenarios, clock), &run_folder, &connect, RunHooks::default())
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
