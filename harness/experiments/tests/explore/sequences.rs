//! Tests that sequences of messages pass correct controllers, find faults of the protocol, and are
//! equal as a file.

use crate::fixtures::configuration;
use platebench_engine::SafeEnds;
use platebench_experiments::explore::choices::Drawn;
use platebench_experiments::explore::exploration::Exploration;
use platebench_experiments::explore::sequence::SequenceLimits;
use platebench_experiments::explore::shrink::shrink_sequence;
use platebench_experiments::explore::{ExploreConfig, ScenePlayer, explore};
use platebench_experiments::trust::{Mutant, MutantController, MutantSpec, protocol_faults};
use platebench_model::scenario::{ScenarioMessage, load};
use platebench_rig::{BoxedLink, CancelToken, ConnectError, HostedLink};
use platebench_wire::{Configure, LawId, Message};
use rstest::rstest;
use std::time::Duration;

fn limits() -> SequenceLimits {
    SequenceLimits {
        longest: 1_000_000,
        own_clock: false,
        exact_time: true,
        has_loop_delay: true,
        has_own_plate: false,
        laws: LawId::ALL.to_vec(),
        starts_controllers: true,
        is_own_law: false,
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
    let config = ExploreConfig { sequences: Some(limits()), compares_reference, ..configuration(law, 24) };
    let result = play(&config, &|| Box::new(HostedLink::new()));
    assert_eq!((result.sequences.played, result.sequences.skipped), (72, 0));
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

/// Wrong for some setpoints only.
fn wrong_table_entry(message: &mut Message) {
    if let Message::Sample(sample) = message
        && (1.2..1.7).contains(&sample.setpoint_um)
    {
        sample.setpoint_um *= 1.02;
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
    // Scenes find them too, so one failure may end the exploration before a sequence.
    let config = ExploreConfig { sequences: Some(limits()), max_failed: 24, jobs: 1, ..configuration(law, 24) };
    let result = play(&config, &|| Box::new(MutantController::new(HostedLink::new(), mutant)));
    assert!(!result.failed_sequences.is_empty(), "{:?}", result.sequences);
}

#[rstest]
#[case::infinite_wq(|| boxed(accepts_infinite_wq), 2)]
#[case::timer(|| boxed(timer_of_eight_bits), 4)]
fn a_failing_sequence_shrinks_to_few_messages(#[case] mutant: fn() -> Box<dyn Mutant>, #[case] most: usize) {
    let config = ExploreConfig { sequences: Some(limits()), max_failed: 1, jobs: 1, ..configuration(LawId::DqPi, 24) };
    let link = || Box::new(MutantController::new(HostedLink::new(), mutant)) as BoxedLink;
    let result = play(&config, &link);
    let connect = || Ok::<_, ConnectError>(link());
    let (cancel, ends) = (CancelToken::never(), SafeEnds::default());
    let mut player = ScenePlayer::new(&connect, false, &cancel, &ends);
    let failed = &result.failed_sequences[0];
    let time = Duration::from_hours(1);
    let (messages, difference, _) = shrink_sequence(&config, &mut player, failed, failed.properties[0], time).unwrap();
    assert!((1..=most).contains(&messages.len()) && difference.is_some(), "{messages:?}");
}

#[test]
fn scaled_samples_find_a_law_that_depends_on_the_level() {
    // Scenes find it too, so one failure may end the exploration before a sequence.
    let config = ExploreConfig { sequences: Some(limits()), max_failed: 24, jobs: 1, ..configuration(LawId::DqPi, 24) };
    let result = play(&config, &|| Box::new(MutantController::new(HostedLink::new(), || boxed(wrong_table_entry))));
    let texts: Vec<_> = result.failed_sequences.iter().map(|failed| &failed.text).collect();
    assert!(texts.iter().any(|text| text.contains("in proportion to the limit")), "{texts:?}");
}

#[test]
fn a_slow_rig_skips_long_runs() {
    let slow = SequenceLimits { longest: 2_000, ..limits() };
    let config = ExploreConfig { sequences: Some(slow), ..configuration(LawId::DqPi, 8) };
    let result = play(&config, &|| Box::new(HostedLink::new()));
    let is_long = |index: &u64| SequenceLimits::cost(&limits().sequence(config.seed, *index).item) > 2_000;
    let skipped = (0..24).filter(is_long).count() as u64;
    // Many configurations and many samples at least.
    assert!((2..12).contains(&skipped), "{skipped}");
    assert_eq!((result.sequences.played, result.sequences.skipped), (24 - skipped, skipped));
}

#[test]
fn a_sequence_is_equal_as_a_file() {
    let config = configuration(LawId::DqPi, 1);
    let folder = tempfile::tempdir().unwrap();
    for index in 0..72 {
        let Drawn { item: sequence, choices } = limits().sequence(7, index);
        assert_eq!(limits().sequence(7, index).item, sequence);
        assert_eq!(limits().replay(&choices), Drawn { item: sequence.clone(), choices }, "{index}");
        // One in eleven starts before the first configuration.
        assert_eq!(matches!(sequence.first(), Some(ScenarioMessage::Configure(_))), index % 11 != 10);
        config.sequence_scenario(&sequence, "A sequence", "").write(folder.path(), "sequence", &[]).unwrap();
        let loaded = load(&folder.path().join("sequence.toml"), "sequence.toml").unwrap();
        assert_eq!(loaded.messages, sequence, "{index}");
    }
}

/// Names of the faults that no sequence below `count` finds.
fn survivors(faults: &[MutantSpec], limits: &SequenceLimits, config: &ExploreConfig, count: u64) -> Vec<&'static str> {
    let (cancel, ends) = (CancelToken::never(), SafeEnds::default());
    let survives = |fault: &&MutantSpec| {
        let connect = || Ok::<_, ConnectError>(fault.link());
        let mut player = ScenePlayer::new(&connect, false, &cancel, &ends);
        (0..count).all(|index| {
            let messages = limits.sequence(config.seed, index).item;
            let scenario = config.sequence_scenario(&messages, "A sequence", "").check().unwrap();
            player.play(&scenario).unwrap().unwrap().failures.is_empty()
        })
    };
    faults.iter().filter(survives).map(|fault| fault.name).collect()
}

/// Faults in the figures of a law, which only the reference shows.
const ONLY_BY_THE_REFERENCE: [&str; 2] = ["short-delay-ignored", "setpoint-list-full"];
/// No message of a scenario has gains that are not finite without bit 0.
const NEVER_FOUND: &str = "unused-gains-checked";

#[rstest]
#[case::all_laws(LawId::DqPi, LawId::ALL.to_vec())]
#[case::one_law(LawId::Deadbeat, vec![LawId::Deadbeat])]
fn sequences_find_faults_of_the_protocol_page(#[case] law: LawId, #[case] laws: Vec<LawId>) {
    let config = ExploreConfig { seed: 31415, ..configuration(law, 1) };
    let is_found = |fault: &MutantSpec| !ONLY_BY_THE_REFERENCE.contains(&fault.name) && fault.name != NEVER_FOUND;
    // Samples in proportion have commands in proportion with the page's laws only.
    let is_found = |fault: &MutantSpec| is_found(fault) && (law == LawId::DqPi || fault.name != "slow-ramp-lost");
    let faults: Vec<_> = protocol_faults().into_iter().filter(is_found).collect();
    assert_eq!(survivors(&faults, &SequenceLimits { laws, ..limits() }, &config, 100), [""; 0]);
}

#[test]
fn the_reference_shows_faults_in_figures() {
    let config = ExploreConfig { seed: 31415, compares_reference: true, ..configuration(LawId::DqPi, 1) };
    let faults = protocol_faults().into_iter().filter(|fault| ONLY_BY_THE_REFERENCE.contains(&fault.name));
    let faults: Vec<_> = faults.collect();
    assert_eq!((faults.len(), survivors(&faults, &limits(), &config, 60)), (2, Vec::new()));
}
