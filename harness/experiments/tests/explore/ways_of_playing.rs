//! Checks that `run`, `explore`, `trust` and `campaign` send the same samples to the controller. A
//! sample contains the state of the plate, so equal samples mean equal plates, commands and scenes.

use platebench_engine::{Clock, RunHooks, RunPlan, SafeEnds, run};
use platebench_experiments::campaign::{Campaign, PlayConfig, TrialSource, play_trials};
use platebench_experiments::explore::ScenePlayer;
use platebench_model::record::{Overrides, RunFolder};
use platebench_model::scenario::Scenario;
use platebench_rig::{BoxedLink, CancelToken, Link, RigSpec};
use platebench_test_kit::{ScriptedLink, load_scenario, packets, scenario_path};
use platebench_wire::{Message, Sample};
use rstest::rstest;
use std::sync::{Arc, Mutex};

fn samples(play: impl FnOnce(&(dyn Fn() -> BoxedLink + Send + Sync))) -> Vec<Sample> {
    let log = Arc::new(Mutex::new(Vec::new()));
    play(&|| {
        let log = Arc::clone(&log);
        Box::new(ScriptedLink::new(move |controller, now, bytes, answer| {
            for packet in packets(bytes) {
                if let Message::Sample(sample) = packet.message {
                    log.lock().unwrap().push(sample);
                }
            }
            controller.exchange(now, bytes, answer)
        }))
    });
    let samples = log.lock().unwrap();
    samples.clone()
}

fn play_by_run(scenario: &Scenario, connect: &(dyn Fn() -> BoxedLink + Send + Sync)) {
    let folder = tempfile::tempdir().unwrap();
    let clock = Clock::Lockstep { wire_time: false };
    let plan = RunPlan::new(&RigSpec::hosted(), clock, 1, vec![scenario.clone()], Overrides::default());
    let folder = RunFolder::create(Some(&folder.path().join("run"))).unwrap();
    run(&plan, &folder, &|| Ok(connect()), RunHooks::default()).unwrap();
}

#[rstest]
#[case::one_controller("reference/between.toml")]
#[case::noise("paper/fig13-closed-loop.toml")]
#[case::faults("faults/lost-command.toml")]
fn run_explore_and_trust_play_the_same_trials(#[case] file: &str) {
    let scenario = load_scenario(file);
    let by_run = samples(|connect| play_by_run(&scenario, connect));
    let by_trust = samples(|connect| {
        platebench_experiments::trust::play(&scenario, "reference", connect).unwrap();
    });
    let by_explore = samples(|connect| {
        let (connect, ends) = (|| Ok(connect()), SafeEnds::default());
        let mut player = ScenePlayer::new(&connect, false, &CancelToken::never(), &ends);
        player.play(&scenario).unwrap().unwrap();
    });
    assert!(by_run.len() > 10 * scenario.trials.count as usize, "{} samples", by_run.len());
    assert!(by_run == by_trust, "trust plays other trials than run");
    assert!(by_run == by_explore, "explore plays other trials than run");
}

#[rstest]
#[case::noise("paper/fig13-closed-loop.toml")]
#[case::loop_delay("limits/one-period-delay.toml")]
#[case::faults("faults/lost-command.toml")]
fn a_campaign_plays_the_trial_of_run(#[case] file: &str) {
    let mut scenario = load_scenario(file);
    (scenario.trials.count, scenario.trials.max_count) = (1, 1);
    let folder = tempfile::tempdir().unwrap();
    let text = format!(
        "title = \"one trial\"\nscenario = {:?}\n[vary]\n\"controller.law\" = {{ each = [{:?}] }}\n\
         [plan]\nmethod = \"grid\"\ntrials = 1\nseed = {}\n",
        scenario_path(file),
        scenario.controller.law,
        scenario.trials.seed
    );
    let campaign = folder.path().join("campaign.toml");
    std::fs::write(&campaign, text).unwrap();
    let campaign = Campaign::load(&campaign).unwrap_or_else(|faults| panic!("{}", faults[0]));
    let by_campaign = samples(|connect| {
        let config = PlayConfig::new(RigSpec::hosted(), 1);
        let source = TrialSource::Numbers(0..1);
        let mut rows = 0;
        let on_row = &mut |_| {
            rows += 1;
            Ok(())
        };
        play_trials(&campaign, &source, &|| Ok(connect()), &config, on_row).unwrap();
        assert_eq!(rows, 1);
    });
    let by_run = samples(|connect| play_by_run(&scenario, connect));
    assert!(by_run.len() > 10, "{} samples", by_run.len());
    // The campaign then plays trials with and without noise for the error of the sensor.
    let first = by_campaign.get(..by_run.len()).unwrap();
    assert!(by_run == first, "campaign plays another trial than run");
}
