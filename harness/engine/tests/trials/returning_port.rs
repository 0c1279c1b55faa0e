//! Checks that a port that vanishes for a moment is awaited before the next trial.

use crate::fixtures::FIG13;
use platebench_engine::{Executor, ExecutorSettings, RunError, SafeEnds, law};
use platebench_rig::{CancelToken, ConnectError, HostedLink, Link, LinkError, RigSpec};
use platebench_test_kit::{ScriptedLink, load_scenario, packets};
use platebench_wire::Message;
use rstest::rstest;
use std::sync::atomic::{AtomicU32, Ordering};

/// Hosted controller whose line is lost at the first sample, if `is_lost`.
fn fragile_link(is_lost: bool) -> impl Link {
    ScriptedLink::new(move |controller, now, bytes, answer| {
        let has_sample = packets(bytes).iter().any(|packet| matches!(packet.message, Message::Sample(_)));
        if is_lost && has_sample {
            return Err(LinkError::Disconnected("the device is gone".to_owned()));
        }
        controller.exchange(now, bytes, answer)
    })
}

/// The real error of a port that is not there.
fn absent_port() -> ConnectError {
    let rig: RigSpec = "serial:/dev/there-is-no-port".parse().unwrap();
    rig.connect().err().unwrap()
}

fn invalid_port() -> ConnectError {
    let rig: RigSpec = "serial:/dev/null".parse().unwrap();
    rig.connect().err().unwrap()
}

/// The first connection is lost in the first trial. Then the port is away `attempts` times.
#[rstest]
#[case::never_away(0, absent_port, true)]
#[case::away_for_a_moment(5, absent_port, true)]
#[case::another_device(1, invalid_port, false)]
fn a_port_that_returns_plays_the_next_trial(
    #[case] attempts: u32,
    #[case] error: fn() -> ConnectError,
    #[case] is_played: bool,
) {
    let scenario = load_scenario(FIG13);
    let connections = AtomicU32::new(0);
    let connect = || match connections.fetch_add(1, Ordering::Relaxed) {
        0 => Ok(fragile_link(true)),
        number if number <= attempts => Err(error()),
        _ => Ok(fragile_link(false)),
    };
    let (ends, cancel) = (SafeEnds::default(), CancelToken::never());
    let mut executor = Executor::new(&connect, ExecutorSettings::lockstep(&cancel), &ends);
    let law = law(&scenario).unwrap();
    let first = executor.play(&scenario, law, 0, None).unwrap().unwrap();
    assert!(first.link_error.is_some());
    let second = executor.play(&scenario, law, 1, None);
    assert_eq!(second.as_ref().is_ok_and(|played| played.as_ref().unwrap().link_error.is_none()), is_played);
    assert_eq!(connections.load(Ordering::Relaxed), attempts + if is_played { 2 } else { 1 });
}

/// The first connection is not repeated, because the name of the port may be wrong.
#[test]
fn a_port_that_was_never_there_is_reported_at_once() {
    let connections = AtomicU32::new(0);
    let connect = || {
        connections.fetch_add(1, Ordering::Relaxed);
        Err::<HostedLink, _>(absent_port())
    };
    let (ends, cancel) = (SafeEnds::default(), CancelToken::never());
    let scenario = load_scenario(FIG13);
    let mut executor = Executor::new(&connect, ExecutorSettings::lockstep(&cancel), &ends);
    let refused = executor.play(&scenario, law(&scenario).unwrap(), 0, None);
    assert!(matches!(refused, Err(RunError::Connect(_))));
    assert_eq!(connections.load(Ordering::Relaxed), 1);
}
