//! Tests that later scenes and sequences are derived from what earlier ones reached, and that this
//! does not depend on the number of workers.

use crate::fixtures::configuration;
use platebench_engine::SafeEnds;
use platebench_experiments::explore::exploration::{Exploration, explore_and_record};
use platebench_experiments::explore::guidance::derive;
use platebench_experiments::explore::sequence::SequenceLimits;
use platebench_experiments::explore::{ExploreConfig, ScenePlayer, explore};
use platebench_experiments::firmware_analysis::suite::read_code;
use platebench_experiments::trust::{Mutant, MutantController};
use platebench_model::scenario::{ScenarioMessage, load};
use platebench_rig::{BoxedLink, CancelToken, ConnectError, EmulatedLink, HostedLink, Session};
use platebench_wire::{LawId, Message};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use rstest::rstest;
use std::collections::BTreeSet;

fn guided(scenes: u64) -> ExploreConfig {
    let identity = *Session::open(HostedLink::new()).unwrap().identity();
    let sequences = Some(SequenceLimits::new(&identity, false, true, u64::MAX));
    ExploreConfig { is_guided: true, sequences, max_failed: u64::MAX, ..configuration(LawId::DqPi, scenes) }
}

/// Wrong for some setpoints only, so that some scenes fail.
fn wrong_table_entry(message: &mut Message) {
    if let Message::Sample(sample) = message
        && (0.3..0.5).contains(&sample.setpoint_um)
    {
        sample.setpoint_um *= 1.02;
    }
}

fn wrong() -> Box<dyn Mutant> {
    Box::new(wrong_table_entry as fn(&mut Message))
}

#[allow(clippy::unnecessary_wraps, reason = "the type of a connection")]
fn mutant() -> Result<BoxedLink, ConnectError> {
    Ok(Box::new(MutantController::new(HostedLink::new(), wrong)))
}

fn play(config: &ExploreConfig) -> Exploration {
    explore(config, &mutant, &CancelToken::never(), &SafeEnds::default(), &mut |_, _| {}).unwrap()
}

#[test]
fn derived_scenes_do_not_depend_on_the_number_of_workers() {
    let [one, two] = [1, 3].map(|jobs| play(&ExploreConfig { jobs, ..guided(130) }));
    assert!(one.guidance.derived_scenes >= 20 && one.guidance.derived_sequences >= 60, "{:?}", one.guidance);
    assert_eq!(one.guidance, two.guidance);
    assert_eq!(one.sequences, two.sequences);
    let scenes = |result: &Exploration| -> Vec<_> {
        result.failed.iter().map(|failed| (failed.index, failed.scene.clone(), failed.failures.clone())).collect()
    };
    assert_eq!(scenes(&one), scenes(&two));
    let config = guided(130);
    let drawn = |index: u64| config.generator().scene(index).item;
    assert!(
        one.failed.iter().any(|failed| failed.scene != drawn(failed.index)),
        "no derived scene failed: {:?}",
        scenes(&one).iter().map(|scene| scene.0).collect::<Vec<_>>()
    );
}

#[test]
fn a_derived_sequence_is_valid_and_passes_a_correct_controller() {
    let config = guided(1);
    let limits = config.sequences.clone().unwrap();
    let connect = || Ok::<_, ConnectError>(Box::new(HostedLink::new()) as BoxedLink);
    let (cancel, ends) = (CancelToken::never(), SafeEnds::default());
    let mut player = ScenePlayer::new(&connect, false, &cancel, &ends);
    let config = ExploreConfig { compares_reference: true, ..config };
    let mut count = 0;
    for index in 0..40 {
        let [parent, drawn] = [1, 2].map(|seed| limits.sequence(seed, index));
        if !limits.may_be_parent(&parent.item) {
            continue;
        }
        count += 1;
        let [derived, again] = [(); 2].map(|()| {
            let choices =
                derive(&parent.choices, [&drawn.choices, &drawn.choices], &mut ChaCha8Rng::seed_from_u64(index));
            limits.replay(&choices).item
        });
        assert_eq!(derived, again);
        assert!(matches!(derived.first(), Some(ScenarioMessage::Configure(_))));
        assert!(derived.len() <= 1_000 && derived != drawn.item && derived != parent.item);
        let folder = tempfile::tempdir().unwrap();
        config.sequence_scenario(&derived, "Derived", "").write(folder.path(), "derived", &[]).unwrap();
        let scenario = load(&folder.path().join("derived.toml"), "derived.toml").unwrap();
        let result = player.play(&scenario).unwrap().unwrap();
        assert!(result.failures.is_empty(), "{index}: {:?}", result.differences);
    }
    assert!(count >= 25, "{count}");
}

#[test]
fn the_emulated_board_records_branch_outcomes() {
    let branch_outcomes = read_code(None).unwrap().1.branch_outcomes();
    let config = ExploreConfig { branch_outcomes, sequences: None, jobs: 1, ..guided(3) };
    let connect = || Ok::<_, ConnectError>(EmulatedLink::built_in()?);
    let (cancel, ends) = (CancelToken::never(), SafeEnds::default());
    let result = explore_and_record(&config, &connect, &cancel, &ends, &mut |_, _| {}).unwrap();
    let guidance = result.guidance;
    assert_eq!(guidance.branch_outcomes, config.branch_outcomes.len());
    assert!((100..guidance.branch_outcomes).contains(&guidance.reached_branch_outcomes), "{guidance:?}");
    let unrecorded = ExploreConfig { branch_outcomes: BTreeSet::new(), ..config };
    let result = explore_and_record(&unrecorded, &connect, &cancel, &ends, &mut |_, _| {}).unwrap();
    assert_eq!((result.guidance.branch_outcomes, result.guidance.reached_branch_outcomes), (0, 0));
}

/// Prints what guidance reaches, and what the same number of scenes reaches without it.
#[rstest]
#[ignore = "minutes; docs/exploration.md contains the result"]
fn guidance_against_none(#[values(false, true)] is_guided: bool) {
    let branch_outcomes = read_code(None).unwrap().1.branch_outcomes();
    let config = guided(160);
    // As `platebench suite explore`, without the longest sequences on the emulated board.
    let sequences =
        config.sequences.clone().map(|limits| SequenceLimits { longest: 2_000, exact_time: false, ..limits });
    let config = ExploreConfig { is_guided, branch_outcomes, sequences, jobs: 4, ..config };
    let connect = || Ok::<_, ConnectError>(EmulatedLink::built_in()?);
    let (cancel, ends) = (CancelToken::never(), SafeEnds::default());
    let result = explore_and_record(&config, &connect, &cancel, &ends, &mut |_, _| {}).unwrap();
    let exercised = result.rules.counts().iter().filter(|(_, count)| *count > 0).count();
    println!("guided {is_guided}: {:?}, {exercised} rules and thresholds", result.guidance);
    assert!(result.failed.is_empty() && result.failed_sequences.is_empty(), "{:?}", result.failed);
}
