//! Tests that relations between two trials find faults that other properties allow, and that correct
//! controllers have none of them.

use crate::fixtures::configuration;
use platebench_engine::SafeEnds;
use platebench_experiments::explore::exploration::Exploration;
use platebench_experiments::explore::report::violated_properties;
use platebench_experiments::explore::scenario_file::ScenarioBuilder;
use platebench_experiments::explore::shrink::shrink_scene;
use platebench_experiments::explore::{ExploreConfig, Property, ScenePlayer, explore};
use platebench_experiments::trust::{Mutant, MutantController};
use platebench_model::scenario::load;
use platebench_rig::{BoxedLink, CancelToken, ConnectError, HostedLink};
use platebench_wire::{LawId, Message};
use rstest::rstest;
use std::time::Duration;

fn clamps_at_300_vpp(message: &mut Message) {
    if let Message::Command(command) = message {
        command.drive_vpp = command.drive_vpp.min(300.0);
    }
}

/// A phase detector with another gain above the resonance than below it.
fn gain_depends_on_the_sign(message: &mut Message) {
    if let Message::Sample(sample) = message
        && sample.wq_um > 0.0
    {
        sample.wq_um *= 0.8;
    }
}

fn ignores_the_delay(message: &mut Message) {
    if let Message::Configure(configure) = message {
        configure.loop_delay_us = 0;
    }
}

fn changes_nothing(_: &mut Message) {}

fn boxed(change: fn(&mut Message)) -> Box<dyn Mutant> {
    Box::new(change)
}

type Fault = fn() -> Box<dyn Mutant>;

#[allow(clippy::unnecessary_wraps, reason = "the type of a connection")]
fn controller(fault: Fault) -> Result<BoxedLink, ConnectError> {
    Ok(Box::new(MutantController::new(HostedLink::new(), fault)))
}

fn play(config: &ExploreConfig, fault: Fault) -> Exploration {
    let connect = || controller(fault);
    explore(config, &connect, &CancelToken::never(), &SafeEnds::default(), &mut |_, _| {}).unwrap()
}

#[rstest]
#[case::clamp(|| boxed(clamps_at_300_vpp), Property::ProportionalResponse)]
#[case::sign(|| boxed(gain_depends_on_the_sign), Property::MirroredResponse)]
#[case::delay(|| boxed(ignores_the_delay), Property::DelayedResponse)]
fn a_relation_finds_a_fault(#[case] fault: Fault, #[case] property: Property) {
    let config = ExploreConfig { max_failed: u64::MAX, jobs: 1, ..configuration(LawId::DqPi, 54) };
    let result = play(&config, fault);
    let found = violated_properties(&result);
    let (_, failed) = found.into_iter().find(|(found, _)| *found == property).unwrap();
    let connect = || controller(fault);
    let (cancel, ends) = (CancelToken::never(), SafeEnds::default());
    let mut player = ScenePlayer::new(&connect, false, &cancel, &ends);
    let minimal = shrink_scene(&config, &mut player, failed, property, Duration::from_hours(1)).unwrap();
    assert!(minimal.is_reproduced && minimal.demands.len() == 1, "{minimal:?}");
    let folder = tempfile::tempdir().unwrap();
    let base = &config.envelope.plate;
    let builder = ScenarioBuilder { base, title: "Minimal", source: "a test", plate_prefix: "" };
    builder.build(&minimal.scene, &minimal.demands).write(folder.path(), "minimal", &[]).unwrap();
    let scenario = load(&folder.path().join("minimal.toml"), "minimal.toml").unwrap();
    assert!(scenario.other_trials.is_some());
    player.renew();
    assert!(player.play(&scenario).unwrap().unwrap().failure_of(property).is_some());
    let correct = play(&config, || boxed(changes_nothing));
    assert!(correct.failed.is_empty(), "{:?}", correct.failed);
    assert!(correct.properties[&property].windows >= 5, "{:?}", correct.properties);
}

#[rstest]
#[case::adapting(LawId::DqPi, 3)]
#[case::steering(LawId::Deadbeat, 2)]
#[case::without_compensation(LawId::DqPiFixed, 2)]
#[case::without_limits(LawId::Pll, 2)]
#[case::above_the_resonance(LawId::FrequencyOnly, 1)]
#[case::with_steps(LawId::BangBang, 1)]
fn a_law_has_its_relations(#[case] law: LawId, #[case] relations: usize) {
    let config = configuration(law, 108);
    let result = play(&config, || boxed(changes_nothing));
    assert!(result.failed.is_empty(), "{:?}", result.failed);
    let all = [Property::ProportionalResponse, Property::MirroredResponse, Property::DelayedResponse];
    let judged = all.iter().filter(|property| result.properties.contains_key(property));
    assert_eq!(judged.count(), relations);
}
