//! Correct laws pass, a mutant is found, and its scene shrinks to few inputs.

use crate::fixtures::configuration;
use platebench_explore::report::violated_properties;
use platebench_explore::shrink::Shrinker;
use platebench_explore::{Player, Property, explore};
use platebench_rig::{BoxedLink, CancelToken, ConnectError, HostedLink};
use platebench_trust::{Mutant, MutantController};
use platebench_wire::{LawId, Sample};
use rstest::rstest;
use std::time::Duration;

#[allow(clippy::unnecessary_wraps, reason = "the type of a connection")]
fn firmware() -> Result<BoxedLink, ConnectError> {
    Ok(Box::new(HostedLink::new()))
}

/// Controls levels between 1.2 and 1.7 µm to 2 % too much.
struct WrongTableEntry;

impl Mutant for WrongTableEntry {
    fn on_sample(&mut self, sample: &mut Sample) {
        if (1.2..1.7).contains(&sample.setpoint_um) {
            sample.setpoint_um *= 1.02;
        }
    }
}

#[allow(clippy::unnecessary_wraps, reason = "the type of a connection")]
fn mutant() -> Result<BoxedLink, ConnectError> {
    Ok(Box::new(MutantController::new(HostedLink::new(), || Box::new(WrongTableEntry))))
}

#[rstest]
#[case(LawId::DqPi)]
#[case(LawId::DqPiFixed)]
#[case(LawId::Deadbeat)]
fn correct_laws_violate_nothing(#[case] law: LawId) {
    let result = explore(&configuration(law, 120), &firmware, &CancelToken::never(), &mut |_, _| {}).unwrap();
    assert_eq!((result.scenes, result.undecided), (120, 0));
    assert!(result.failed.is_empty(), "{:?}", result.failed);
    let judged = |property| result.properties.get(&property).map_or(0, |tally| tally.windows);
    let judged: Vec<_> =
        Property::ALL.into_iter().filter(|property| *property != Property::Reference).map(judged).collect();
    assert!(judged.iter().all(|windows| *windows > 20), "{judged:?}");
}

#[test]
fn a_mutant_is_found_and_its_scene_shrinks_to_one_level() {
    let config = configuration(LawId::DqPi, 60);
    let cancel = CancelToken::never();
    let result = explore(&config, &mutant, &cancel, &mut |_, _| {}).unwrap();
    let (_, failed) =
        violated_properties(&result).into_iter().find(|(property, _)| *property == Property::StaticError).unwrap();
    let mut player = Player::new(&mutant, false, &cancel);
    let mut shrinker = Shrinker::new(&config, &mut player, Duration::from_mins(1)).unwrap();
    let minimal = shrinker.shrink(failed, Property::StaticError).unwrap();
    assert!(minimal.is_reproduced);
    assert!(minimal.scene.earlier.is_empty(), "{:?}", minimal.scene);
    assert_eq!(minimal.scene.judged.setpoint.len(), 1, "{:?}", minimal.scene);
    assert_eq!(minimal.demands.len(), 1);
    let value = minimal.failure.value.unwrap();
    assert!((value - 2.0).abs() < 0.1, "{value}");
}
