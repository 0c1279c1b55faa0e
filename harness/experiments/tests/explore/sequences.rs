//! Tests that sequences of messages pass correct controllers, find faults of the protocol, and are
//! equal as a file.

use crate::fixtures::configuration;
use platebench_engine::SafeEnds;
use platebench_experiments::explore::exploration::Exploration;
use platebench_experiments::explore::sequence::SequenceLimits;
use platebench_experiments::explore::{ExploreConfig, explore};
use platebench_experiments::trust::{Mutant, MutantController};
use platebench_model::scenario::{ScenarioMessage, load};
use platebench_rig::{BoxedLink, CancelToken, ConnectError, HostedLink};
use platebench_wire::{Configure, LawId, Message};
use rstest::rstest;

fn limits() -> SequenceLimits {
    SequenceLimits {
        longest: 1_000_000,
        own_clock: false,
        has_loop_delay: true,
        has_own_plate: false,
        laws: LawId::ALL.to_vec(),
    }
}

fn play(config: &ExploreConfig, link: &(dyn Fn() -> BoxedLink + Send + Sync)) -> Exploration {
    let connect = || Ok::<_, ConnectError>(link());
    explore(config, &connect, &CancelToken::never(), &SafeEnds::default(), &mut |_, _| {}).unwrap()
}

#[rstest]
fn a_correct_controller_fails_no_sequence(
    #[values(LawId::DqPi, LawId::Deadbeat)] law: LawId,
    #[values(false, true)] compares_reference: bool,
) {
    let config = ExploreConfig { sequences: Some(limits()), compares_reference, ..configuration(law, 36) };
    let result = play(&config, &|| Box::new(HostedLink::new()));
    assert_eq!((result.sequences.played, result.sequences.skipped), (108, 0));
    assert_eq!(result.failed_sequences, []);
}

fn accepts_infinite_wq(message: &mut Message) {
    if let Message::Sample(sample) = message
        && sample.wq_um.is_infinite()
    {
        sample.wq_um = 0.5;
    }
}

fn timer_of_eight_bits(message: &mut Message) {
    if let Message::Configure(Configure { watchdog_timeout_ms, .. }) = message {
        *watchdog_timeout_ms &= 0x00ff;
    }
}

fn drive_above_limit(message: &mut Message) {
    if let Message::Command(command) = message
        && command.drive_vpp == 900.0
    {
        command.drive_vpp = 901.0;
    }
}

fn boxed(change: fn(&mut Message)) -> Box<dyn Mutant> {
    Box::new(change)
}

#[rstest]
#[case::infinite_wq(|| boxed(accepts_infinite_wq))]
#[case::timer(|| boxed(timer_of_eight_bits))]
#[case::drive(|| boxed(drive_above_limit))]
fn sequences_find_faults_of_every_law(
    #[case] mutant: fn() -> Box<dyn Mutant>,
    #[values(LawId::DqPi, LawId::Deadbeat)] law: LawId,
) {
    let config = ExploreConfig { sequences: Some(limits()), max_failed: 1, jobs: 1, ..configuration(law, 24) };
    let result = play(&config, &|| Box::new(MutantController::new(HostedLink::new(), mutant)));
    assert!(!result.failed_sequences.is_empty(), "{:?}", result.sequences);
}

#[test]
fn a_slow_rig_skips_long_runs() {
    let slow = SequenceLimits { longest: 2_000, ..limits() };
    let config = ExploreConfig { sequences: Some(slow), ..configuration(LawId::DqPi, 8) };
    let result = play(&config, &|| Box::new(HostedLink::new()));
    assert_eq!((result.sequences.played, result.sequences.skipped), (23, 1));
}

#[test]
fn a_sequence_is_equal_as_a_file() {
    let config = configuration(LawId::DqPi, 1);
    let folder = tempfile::tempdir().unwrap();
    for index in 0..72 {
        let sequence = limits().sequence(7, index);
        assert_eq!(limits().sequence(7, index), sequence);
        assert!(matches!(sequence.first(), Some(ScenarioMessage::Configure(_))));
        config.sequence_scenario(&sequence, "A sequence", "").write(folder.path(), "sequence", &[]).unwrap();
        let loaded = load(&folder.path().join("sequence.toml"), "sequence.toml").unwrap();
        assert_eq!(loaded.messages, sequence, "{index}");
    }
}
