//! Tests that correct laws pass, a mutant is found, and its scene shrinks to few inputs.

use crate::fixtures::configuration;
use platebench_engine::SafeEnds;
use platebench_experiments::explore::exploration::FailedScene;
use platebench_experiments::explore::kill_rate::{KillRateConfig, kill_rate};
use platebench_experiments::explore::player::SceneFailure;
use platebench_experiments::explore::report::violated_properties;
use platebench_experiments::explore::session::ExploreSession;
use platebench_experiments::explore::shrink::shrink_scene;
use platebench_experiments::explore::{ExplorationBudget, ExploreConfig, ExploreError, Property, ScenePlayer, explore};
use platebench_experiments::trust::{Mutant, MutantController, MutantSpec, clean_variants};
use platebench_model::record::Verdict;
use platebench_model::scenario::Scenario;
use platebench_rig::{BoxedLink, CancelToken, ConnectError, HostedLink, RigSpec};
use platebench_test_kit::load_scenario;
use platebench_wire::{LawId, Message};
use rstest::rstest;
use std::fs;
use std::path::PathBuf;
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::Duration;

/// Long enough that a search ends by its number of replays, also on a busy machine.
const SHRINK_TIME: Duration = Duration::from_hours(1);

#[allow(clippy::unnecessary_wraps, reason = "the type of a connection")]
fn firmware() -> Result<BoxedLink, ConnectError> {
    Ok(Box::new(HostedLink::new()))
}

fn wrong_table_entry(message: &mut Message) {
    if let Message::Sample(sample) = message
        && (1.2..1.7).contains(&sample.setpoint_um)
    {
        sample.setpoint_um *= 1.02;
    }
}

#[allow(clippy::unnecessary_wraps, reason = "the type of a connection")]
fn mutant() -> Result<BoxedLink, ConnectError> {
    Ok(Box::new(MutantController::new(HostedLink::new(), || Box::new(wrong_table_entry))))
}

/// Lowers the drive by 1 %. Control loops correct this, so every limit holds.
fn low_drive_command(message: &mut Message) {
    if let Message::Command(command) = message {
        command.drive_vpp *= 0.99;
    }
}

#[allow(clippy::unnecessary_wraps, reason = "the type of a connection")]
fn low_drive() -> Result<BoxedLink, ConnectError> {
    Ok(Box::new(MutantController::new(HostedLink::new(), || Box::new(low_drive_command))))
}

#[rstest]
#[case(LawId::DqPi)]
#[case(LawId::DqPiFixed)]
#[case(LawId::Deadbeat)]
fn correct_laws_violate_nothing(#[case] law: LawId) {
    let config = ExploreConfig { compares_reference: true, ..configuration(law, 240) };
    let result = explore(&config, &firmware, &CancelToken::never(), &SafeEnds::default(), &mut |_, _| {}).unwrap();
    assert_eq!((result.scenes, result.undecided), (240, 0));
    assert!(result.failed.is_empty(), "{:?}", result.failed);
    let judged = |property| result.properties.get(&property).map_or(0, |tally| tally.windows);
    // Only dq-pi predicts over a delay alike in every phase.
    let predicts = |property: &Property| law == LawId::DqPi || *property != Property::DelayedResponse;
    // The protocol page defines no numbers of the deadbeat law.
    let is_compared = law != LawId::Deadbeat;
    assert_eq!(judged(Property::Answers), u64::from(is_compared));
    assert_eq!(judged(Property::Reference) > 20, is_compared);
    let others = Property::ALL.iter().filter(|property| predicts(property));
    let others = others.filter(|property| !matches!(property, Property::Answers | Property::Reference));
    for property in others {
        assert!(judged(*property) > 20, "{property:?}");
    }
}

#[rstest]
#[case::without_reference(false, 0)]
#[case::with_reference(true, 2)]
fn the_reference_finds_what_the_limits_allow(#[case] compares_reference: bool, #[case] violated: usize) {
    let config = ExploreConfig { compares_reference, jobs: 1, ..configuration(LawId::DqPi, 5) };
    let cancel = CancelToken::never();
    let result = explore(&config, &low_drive, &cancel, &SafeEnds::default(), &mut |_, _| {}).unwrap();
    let found = violated_properties(&result);
    assert_eq!(found.len(), violated, "{found:?}");
    for (property, failed) in found {
        assert!(matches!(property, Property::Reference | Property::Answers));
        let ends = SafeEnds::default();
        let mut player = ScenePlayer::new(&low_drive, false, &cancel, &ends);
        let minimal = shrink_scene(&config, &mut player, failed, property, SHRINK_TIME).unwrap();
        assert_eq!((minimal.is_reproduced, minimal.demands.len()), (true, 1));
        assert!(minimal.failure.value > Some(0.1), "{:?}", minimal.failure);
    }
}

#[test]
fn a_mutant_is_found_and_its_scene_shrinks_to_one_level() {
    let config = ExploreConfig { max_failed: 200, ..configuration(LawId::DqPi, 200) };
    let cancel = CancelToken::never();
    let result = explore(&config, &mutant, &cancel, &SafeEnds::default(), &mut |_, _| {}).unwrap();
    // The first level is in the wrong entry, and no other change is needed.
    let starts_wrong = |failed: &&FailedScene| (1.2..1.7).contains(&failed.scene.judged.setpoint_at(0));
    let is_static = |failure: &SceneFailure| failure.property == Property::StaticError;
    let mut failed = result.failed.iter().filter(starts_wrong);
    let failed = failed.find(|failed| failed.failures.iter().any(is_static)).unwrap();
    let ends = SafeEnds::default();
    let mut player = ScenePlayer::new(&mutant, false, &cancel, &ends);
    let minimal = shrink_scene(&config, &mut player, failed, Property::StaticError, SHRINK_TIME).unwrap();
    assert!(minimal.is_reproduced);
    assert!(minimal.scene.earlier.is_empty(), "{:?}", minimal.scene);
    assert_eq!(minimal.scene.judged.setpoint.points().len(), 1, "{:?}", minimal.scene);
    assert!(minimal.demands.len() <= 2, "{:?}", minimal.demands);
    let value = minimal.failure.value.unwrap();
    assert!((value - 2.0).abs() < 0.1, "{value}");
}

#[test]
fn scenes_before_a_lost_rig_are_kept() {
    let connections = AtomicU32::new(0);
    // The controller is replaced after 20 scenes.
    let connect = || match connections.fetch_add(1, Ordering::Relaxed) {
        0 => mutant(),
        _ => "serial:/dev/none".parse::<RigSpec>().unwrap().connect(),
    };
    let config = ExploreConfig { jobs: 1, max_failed: u64::MAX, ..configuration(LawId::DqPi, 60) };
    let result = explore(&config, &connect, &CancelToken::never(), &SafeEnds::default(), &mut |_, _| {}).unwrap();
    assert_eq!(result.scenes, 20);
    assert!(!result.failed.is_empty() && matches!(result.error, Some(ExploreError::Run(_))), "{:?}", result.error);
    assert!(explore(&config, &connect, &CancelToken::never(), &SafeEnds::default(), &mut |_, _| {}).is_err());
}

#[test]
fn a_cancellation_while_a_controller_starts_is_no_error() {
    let (connections, cancel) = (AtomicU32::new(0), CancelToken::default());
    let connect = || {
        if connections.fetch_add(1, Ordering::Relaxed) > 0 {
            cancel.cancel();
        }
        RigSpec::hosted().connect()
    };
    let config = ExploreConfig { jobs: 1, ..configuration(LawId::DqPi, 60) };
    let result = explore(&config, &connect, &cancel, &SafeEnds::default(), &mut |_, _| {}).unwrap();
    assert!(result.is_interrupted && result.scenes > 0, "{result:?}");
    assert!(result.error.is_none(), "{:?}", result.error);
}

fn session(budget: ExplorationBudget, regressions: Vec<Scenario>) -> ExploreSession {
    let ExploreConfig { envelope, seed, jobs, .. } = configuration(LawId::DqPi, 1);
    ExploreSession {
        envelope,
        rig: RigSpec::hosted(),
        reply_timeout: Duration::from_millis(500),
        law: None,
        seed,
        budget,
        jobs,
        compares_reference: false,
        regressions,
        regression_folder: PathBuf::from("none"),
    }
}

#[test]
fn an_interrupted_exploration_writes_its_result() {
    let session = session(ExplorationBudget::Scenes(u64::MAX / 4), Vec::new());
    let folder = tempfile::tempdir().unwrap();
    let cancel = CancelToken::default();
    let (report, _) = session.run(&cancel, folder.path(), &mut |_| cancel.cancel()).unwrap();
    assert!(report.scenes + report.sequences.played >= 1 && report.is_interrupted, "{report:?}");
    assert_eq!(report.verdict, Verdict::Inconclusive);
    assert!(report.conclusion().ends_with("A signal ended the exploration."), "{}", report.conclusion());
    assert!(folder.path().join("explore.json").exists() && folder.path().join("report.html").exists());
}

#[test]
fn a_regression_that_does_not_apply_is_in_the_report() {
    let regressions = ["chip/random-flip.toml", "paper/fig13-closed-loop.toml"].map(load_scenario);
    let session = session(ExplorationBudget::Scenes(1), regressions.to_vec());
    let folder = tempfile::tempdir().unwrap();
    let (report, _) = session.run(&CancelToken::never(), folder.path(), &mut |_| {}).unwrap();
    assert_eq!((report.verdict, report.regressions), (Verdict::Pass, 1), "{report:?}");
    let [unjudged] = &report.unjudged_regressions[..] else { panic!("{:?}", report.unjudged_regressions) };
    assert!(unjudged.file == "chip/random-flip.toml" && !unjudged.is_undecided, "{unjudged:?}");
    let page = fs::read_to_string(folder.path().join("report.html")).unwrap();
    assert!(page.contains("chip/random-flip.toml (a scenario of an earlier exploration): not applicable"), "{page}");
}

struct Unmutated;

impl Mutant for Unmutated {}

#[test]
fn the_kill_rate_names_a_survivor_and_a_found_mutant() {
    let gain = platebench_experiments::trust::catalogue()
        .into_iter()
        .find(|mutant| mutant.name == "drive-gain-doubled")
        .unwrap();
    let config = KillRateConfig {
        envelope: configuration(LawId::DqPi, 1).envelope,
        mutants: vec![gain, MutantSpec { name: "unmutated", build: || Box::new(Unmutated), ..gain }],
        protocol_faults: vec![gain],
        variants: clean_variants(),
        scenes: 6,
        seed: 1,
        jobs: 1,
    };
    let report = kill_rate(&config, &CancelToken::never()).unwrap();
    let found: Vec<_> = report.mutants.iter().map(|mutant| (mutant.name, mutant.found.is_some())).collect();
    assert_eq!(found, [("drive-gain-doubled", true), ("unmutated", false)]);
    // The firmware plays 6 scenes with each of three laws, and every variant with one law. Three
    // sequences follow each scene.
    let clean = 6 * 4 * (3 + config.variants.len() as u32);
    assert_eq!((report.false_alarm_rate.seen, report.false_alarm_rate.count), (0, clean), "{:?}", report.alarms);
    assert_eq!((report.kill_rate.seen, report.kill_rate.count), (1, 2));
    let protocol = report.protocol_faults;
    assert_eq!((protocol.kill_rate.seen, protocol.kill_rate_with_reference.seen), (1, 1));
}
