//! Tests that correct controllers of several kinds fail no scene and no sequence of messages.

use crate::fixtures::configuration;
use platebench_engine::SafeEnds;
use platebench_experiments::explore::sequence::SequenceLimits;
use platebench_experiments::explore::{ExploreConfig, LawProperties, ScenePlayer};
use platebench_experiments::trust::{Mutant, MutantController, clean_variants};
use platebench_rig::{BoxedLink, CancelToken, ConnectError, HostedLink, Link, Session};
use platebench_test_kit::ScriptedLink;
use platebench_wire::{LawId, Message, Packet};
use rstest::rstest;
use std::time::Duration;

fn boxed(change: fn(&mut Message)) -> Box<dyn Mutant> {
    Box::new(change)
}

/// A controller that answers late, in a time that its rig measures.
fn late_controller() -> BoxedLink {
    Box::new(ScriptedLink::new(|controller, now, bytes, answer| {
        controller.exchange(now, bytes, answer)?;
        Ok(Duration::from_micros(300))
    }))
}

struct TwoMillihertz;

impl Mutant for TwoMillihertz {
    fn on_send(&mut self, packet: &mut Packet) {
        if let Message::Command(command) = &mut packet.message {
            command.frequency_mhz &= !1;
        }
    }
}

fn gains_minus_5(message: &mut Message) {
    if let Message::Configure(configure) = message
        && configure.gains.is_none()
    {
        configure.gain_um_per_vpp *= 1.05;
    }
}

fn only_deadbeat(message: &mut Message) {
    if let Message::Identity(identity) = message {
        identity.laws = 1 << LawId::Deadbeat as u8;
    }
}

fn only_fixed(message: &mut Message) {
    if let Message::Identity(identity) = message {
        identity.laws = 1 << LawId::DqPiFixed as u8;
    }
}

type Variant = (&'static str, LawId, bool, Box<dyn Fn() -> BoxedLink + Send + Sync>);

/// Correct controllers, with their law, and whether their commands may be compared with the
/// reference.
fn correct_controllers() -> Vec<Variant> {
    let clean = clean_variants().into_iter().map(|variant| -> Variant {
        let has_reference = !variant.name.starts_with("gains");
        (variant.name, LawId::DqPi, has_reference, Box::new(move || variant.link()))
    });
    let changed = |name, law, has_reference, mutant: fn() -> Box<dyn Mutant>| -> Variant {
        (name, law, has_reference, Box::new(move || Box::new(MutantController::new(HostedLink::new(), mutant))))
    };
    let others = [
        changed("gains-minus-5", LawId::DqPi, false, || boxed(gains_minus_5)),
        changed("two-millihertz", LawId::DqPi, true, || Box::new(TwoMillihertz)),
        changed("only-deadbeat", LawId::Deadbeat, true, || boxed(only_deadbeat)),
        changed("only-dq-pi-fixed", LawId::DqPiFixed, true, || boxed(only_fixed)),
        ("late", LawId::DqPi, true, Box::new(late_controller)),
        ("firmware", LawId::DqPi, true, Box::new(|| Box::new(HostedLink::new()) as BoxedLink)),
    ];
    clean.chain(others).collect()
}

/// Numbers of scenes and of sequences per controller and seed.
#[derive(Clone, Copy)]
struct Counts {
    scenes: u64,
    sequences: u64,
}

/// Scenes and sequences with a false alarm, and the number of played ones.
fn false_alarms(seeds: std::ops::Range<u64>, counts: Counts) -> (Vec<String>, u64) {
    let (cancel, ends) = (CancelToken::never(), SafeEnds::default());
    let (mut alarms, mut played) = (Vec::new(), 0);
    for (name, law, has_reference, link) in correct_controllers() {
        let identity = *Session::open(link()).unwrap().identity();
        let limits = SequenceLimits::new(&identity, false, true, u64::MAX);
        let laws: Vec<_> = LawProperties::explored_laws().filter(|law| identity.has_law(*law)).collect();
        let connect = || Ok::<_, ConnectError>(link());
        let mut player = ScenePlayer::new(&connect, false, &cancel, &ends);
        for seed in seeds.clone() {
            let compares_reference = has_reference && seed % 2 == 0;
            let config = ExploreConfig { seed, compares_reference, laws: laws.clone(), ..configuration(law, 1) };
            // Each seed has other scenes, and with them other strata.
            let scenes = (seed * counts.scenes..).take(counts.scenes as usize).map(|index| {
                let scene = config.generator().scene(index).item;
                (format!("scene {index}"), config.scenario(&scene, "A scene"))
            });
            let sequences = (0..counts.sequences).map(|index| {
                let messages = limits.sequence(seed, index).item;
                (format!("sequence {index}"), config.sequence_scenario(&messages, "A sequence", ""))
            });
            for (item, scenario) in scenes.chain(sequences) {
                let result = player.play(&scenario.check().unwrap()).unwrap().unwrap();
                played += 1;
                if !result.failures.is_empty() || result.undecided.is_some() {
                    alarms.push(format!("{name}, seed {seed}, {item}: {:?} {:?}", result.failures, result.differences));
                }
            }
        }
    }
    (alarms, played)
}

#[test]
fn correct_controllers_fail_nothing() {
    let (alarms, played) = false_alarms(1..3, Counts { scenes: 9, sequences: 12 });
    assert_eq!((alarms, played), (Vec::new(), 420));
}

#[rstest]
#[case::scenes(Counts { scenes: 15, sequences: 0 }, 3_000)]
#[case::sequences(Counts { scenes: 0, sequences: 28 }, 5_600)]
#[ignore = "minutes; docs/trust.md contains the result"]
fn correct_controllers_fail_nothing_with_20_seeds(#[case] counts: Counts, #[case] count: u64) {
    let (alarms, played) = false_alarms(1..21, counts);
    assert_eq!((alarms, played), (Vec::new(), count));
}
