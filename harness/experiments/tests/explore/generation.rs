//! Tests that scene i depends only on envelope, seed and i, and that scenes are valid scenarios.

use crate::fixtures::configuration;
use platebench_experiments::explore::Property;
use platebench_experiments::explore::coverage::{ChangeKind, ExplorationCoverage};
use platebench_experiments::explore::guidance::derive;
use platebench_experiments::explore::scene::Tuning;
use platebench_experiments::explore::scene::{Course, PlateChoice, Scene, SceneTrial};
use platebench_model::scenario::load;
use platebench_wire::LawId;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use rstest::rstest;
use std::collections::BTreeSet;
use std::f64::consts::TAU;

#[test]
fn a_scene_does_not_depend_on_other_scenes() {
    let config = configuration(LawId::DqPi, 1);
    let generator = config.generator();
    let scene = |index| generator.scene(index);
    let forward: Vec<_> = (0..40).map(scene).collect();
    let backward: Vec<_> = (0..40).rev().map(scene).collect();
    assert!(forward.iter().eq(backward.iter().rev()));
    let other = platebench_experiments::explore::Generator { seed: 2, ..generator };
    assert_ne!(forward[7], other.scene(7));
}

#[test]
fn a_record_makes_the_same_scene_again() {
    let config = configuration(LawId::DqPi, 1);
    let generator = config.generator();
    for index in 0..600 {
        let scene = generator.scene(index);
        assert_eq!(generator.replay(&scene.choices), scene, "{index}");
    }
    // Without choices, every value is the simplest one.
    let simplest = generator.replay(&[]).item;
    assert_eq!((simplest.earlier.len(), simplest.count, simplest.script_seed), (0, 1, None));
    assert_eq!((simplest.judged.setpoint, simplest.judged.period_us), (Course::Hold(vec![(0, 1_000)]), 1_000));
}

#[test]
fn a_changed_record_makes_a_valid_scene() {
    let config = configuration(LawId::DqPi, 1);
    let generator = config.generator();
    let mut random = ChaCha8Rng::seed_from_u64(1);
    for index in 0..300 {
        let [parent, other, drawn] = [index, index + 7, index + 31].map(|index| generator.scene(index).choices);
        let derived = derive(&parent, [&other, &drawn], &mut random);
        let scene = generator.replay(&derived);
        assert_eq!(generator.replay(&scene.choices), scene, "{index}");
        config.scenario(&scene.item, "Scene").check().unwrap_or_else(|error| panic!("scene {index}: {error}"));
    }
}

#[rstest]
#[case(LawId::DqPi)]
#[case(LawId::DqPiFixed)]
#[case(LawId::Deadbeat)]
fn every_scene_loads(#[case] law: LawId) {
    let config = configuration(law, 1);
    let folder = tempfile::tempdir().unwrap();
    for index in 0..200 {
        let scene = config.generator().scene(index).item;
        let raw = config.scenario(&scene, "Scene");
        raw.write(folder.path(), "scene", &[]).unwrap();
        let scenario = load(&folder.path().join("scene.toml"), "scene.toml");
        let scenario = scenario.unwrap_or_else(|fault| panic!("scene {index}: {fault}\n{}", raw.text(&[]).unwrap()));
        assert_eq!(scenario.between.len(), scene.earlier.len());
    }
}

#[test]
fn a_plate_keeps_its_name_and_source() {
    let mut config = configuration(LawId::DqPi, 1);
    let plate = &mut config.envelope.plate;
    (plate.name, plate.source) = ("e\u{301} \"4\"\u{1b}".to_owned(), "two\nlines \\ '''\u{0}".to_owned());
    let expected = (plate.name.clone(), plate.source.clone());
    let scene = config.generator().scene(0).item;
    let folder = tempfile::tempdir().unwrap();
    config.scenario(&scene, "Scene").write(folder.path(), "scene", &[]).unwrap();
    let plate = load(&folder.path().join("scene.toml"), "scene.toml").unwrap().plate;
    assert_eq!((plate.name.clone(), plate.source.clone()), expected);
}

#[rstest]
#[case::slower_than_a_sine_of_a_tenth_of_a_hertz(0.1)]
#[case::faster(200.0)]
fn sines_stay_below_the_largest_rate(#[case] highest: f64) {
    let mut config = configuration(LawId::DqPi, 1);
    config.envelope.range.force_rate_n_per_s = [0.01, highest];
    let slopes = (0..400).filter_map(|index| match config.generator().scene(index).item.judged.force {
        // The force is in 0.01 N, the frequency in 0.1 Hz.
        Course::Sine { amplitude, frequency_tenths, .. } => {
            Some(TAU * f64::from(amplitude) / 100.0 * f64::from(frequency_tenths) / 10.0)
        }
        Course::Hold(_) | Course::Linear(_) => None,
    });
    let slopes: Vec<f64> = slopes.collect();
    assert!(highest < 1.0 || slopes.len() >= 10, "{slopes:?}");
    // The factor 1.05 is needed because the amplitude is rounded to 0.01 N.
    assert!(slopes.iter().all(|slope| *slope <= highest * 1.05), "{slopes:?}");
}

#[test]
fn a_hundred_scenes_cover_every_kind_of_change_and_history() {
    let config = configuration(LawId::DqPi, 1);
    let mut coverage = ExplorationCoverage::default();
    for index in 0..100 {
        coverage.add(&config.generator().scene(index).item, &config.envelope);
    }
    let followed = |second: ChangeKind| ChangeKind::ALL.iter().any(|first| coverage.pair(*first, second) > 0);
    let missing: Vec<_> = ChangeKind::ALL.iter().filter(|kind| !followed(**kind)).collect();
    assert!(missing.is_empty(), "{missing:?}");
    let lengths: BTreeSet<usize> = coverage.histories.keys().copied().collect();
    assert_eq!(lengths, BTreeSet::from([0, 1, 2]));
    for range in coverage.ranges().filter(|range| range.quantity == "setpoint_um" || range.quantity == "period_ms") {
        assert!(range.counts.iter().filter(|count| **count > 0).count() >= 8, "{range:?}");
    }
}

#[test]
fn the_noise_of_the_frequency_limit_grows_with_the_damping() {
    let config = configuration(LawId::DqPi, 1);
    let plate = PlateChoice {
        limit_vpp: 900,
        noise_pm: 2500,
        nominal_gain_permille: 0,
        nominal_time_constant_permille: 0,
        gain_permille: 0,
        time_constant_permille: 0,
    };
    let limit = |force: i32| {
        let judged = SceneTrial {
            law: LawId::DqPi.into(),
            plate,
            period_us: 900,
            delay_us: 0,
            start_frequency_tenths: 323_076,
            duration_us: 170_200,
            setpoint: Course::Hold(vec![(0, 500)]),
            force: Course::Hold(vec![(0, force)]),
            temperature: Course::Hold(vec![(0, 0)]),
            tuning: Tuning::default(),
            faults: Vec::new(),
        };
        let demands =
            config.demands(&Scene { earlier: Vec::new(), judged, count: 1, script_seed: None, relation: None });
        demands.iter().find(|demand| demand.property == Property::Frequency).unwrap().at_most
    };
    // Six standard deviations of 2.5 nm are 3 % of 0.5 µm. A finger of 1.5 N doubles the damping. The
    // loop multiplies the apparent detuning by (1 − e^(−3T/2 ms))/(1 − e^(−σT)).
    let of_noise = |ratio: f64| {
        let gain = (1.0 - (-3.0 * 0.9_f64 / 2.0).exp()) / (1.0 - (-ratio * 0.9 / 1.88).exp());
        gain * ratio * 0.03 / (TAU * 1.88e-3)
    };
    let (free, damped) = (limit(0), limit(150));
    assert!((free - 0.5 - of_noise(1.0)).abs() < 1e-3, "{free}");
    assert!((damped - 0.5 - of_noise(2.0)).abs() < 1e-3, "{damped}");
}

#[test]
fn tracking_is_judged_after_an_unsteady_start() {
    let config = configuration(LawId::DqPi, 1);
    let simplest = config.generator().replay(&[]).item;
    let tracking = |start_us: u32, end_us: u32| {
        let judged = SceneTrial {
            duration_us: end_us + 50_000,
            setpoint: Course::Linear(vec![(0, 500), (start_us, 500), (end_us, 1_500)]),
            ..simplest.judged.clone()
        };
        let demands = config.demands(&Scene { judged, ..simplest.clone() });
        let tracking = demands.iter().find(|demand| demand.property == Property::Tracking);
        tracking.map(|demand| (demand.from_us, demand.until_us))
    };
    // From a steady state, a ramp is judged from its start.
    assert_eq!(tracking(200_000, 400_000), Some((200_000, 400_000)));
    let (from_us, until_us) = tracking(5_000, 400_000).unwrap();
    assert!((5_000..40_000).contains(&from_us) && until_us == 400_000, "{from_us}, {until_us}");
    // Four periods are the shortest window. Ramps that end at a control instant are steady equally late.
    let shortest = (from_us + 4_000).next_multiple_of(1_000);
    assert_eq!(tracking(5_000, shortest), Some((from_us, shortest)));
    assert_eq!(tracking(5_000, shortest - 1_000), None);
}
