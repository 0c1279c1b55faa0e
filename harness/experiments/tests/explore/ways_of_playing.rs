//! Checks that `run`, `explore`, `trust` and `campaign` send the same samples to the controller. A
//! sample contains the state of the plate, so equal samples mean equal plates, commands and scenes.

use platebench_engine::{Clock, RunHooks, RunPlan, SafeEnds, run};
use platebench_experiments::campaign::{Campaign, PlayConfig, TrialSource, play_trials};
use platebench_experiments::explore::Player;
use platebench_model::record::{Overrides, RunFolder};
use platebench_model::scenario::{Scenario, load};
use platebench_rig::{BoxedLink, CancelToken, HostedLink, Link, LinkError, RigSpec};
use platebench_wire::{Message, PacketReader, Sample};
use rstest::rstest;
use std::path::Path;
use std::sync::{Arc, Mutex};
use std::time::Duration;

type SampleLog = Arc<Mutex<Vec<Sample>>>;

struct LoggedLink {
    inner: HostedLink,
    log: SampleLog,
}

impl Link for LoggedLink {
    fn exchange(&mut self, now: Duration, bytes: &[u8], answer: &mut Vec<u8>) -> Result<Duration, LinkError> {
        for packet in PacketReader::new().packets(bytes).flatten() {
            if let Message::Sample(sample) = packet.message {
                self.log.lock().unwrap().push(sample);
            }
        }
        self.inner.exchange(now, bytes, answer)
    }

    fn advance_to(&mut self, now: Duration, received: &mut Vec<u8>) -> Result<(), LinkError> {
        self.inner.advance_to(now, received)
    }

    fn restart(&mut self) -> Result<bool, LinkError> {
        self.inner.restart()
    }

    fn continue_trial(&mut self) {
        self.inner.continue_trial();
    }
}

fn samples(play: impl FnOnce(&(dyn Fn() -> BoxedLink + Send + Sync))) -> Vec<Sample> {
    let log = SampleLog::default();
    let connect = || -> BoxedLink { Box::new(LoggedLink { inner: HostedLink::new(), log: Arc::clone(&log) }) };
    play(&connect);
    let samples = log.lock().unwrap();
    samples.clone()
}

fn play_by_run(scenario: &Scenario, connect: &(dyn Fn() -> BoxedLink + Send + Sync)) {
    let folder = tempfile::tempdir().unwrap();
    let plan = RunPlan {
        scenarios: vec![scenario.clone()],
        jobs: 1,
        clock: Clock::Lockstep { wire_time: false },
        own_clock: false,
        rig: "hosted".to_owned(),
        overrides: Overrides::default(),
    };
    let folder = RunFolder::create(Some(&folder.path().join("run"))).unwrap();
    run(&plan, &folder, &|| Ok(connect()), RunHooks::default()).unwrap();
}

#[rstest]
#[case::one_controller("reference/between.toml")]
#[case::noise("paper/fig13-closed-loop.toml")]
#[case::faults("faults/lost-command.toml")]
fn run_explore_and_trust_play_the_same_trials(#[case] file: &str) {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../scenarios").join(file);
    let scenario = load(&path, file).unwrap_or_else(|fault| panic!("{fault}"));
    let by_run = samples(|connect| play_by_run(&scenario, connect));
    let by_trust = samples(|connect| {
        platebench_experiments::trust::play(&scenario, "reference", connect).unwrap();
    });
    let by_explore = samples(|connect| {
        let (connect, ends) = (|| Ok(connect()), SafeEnds::default());
        let mut player = Player::new(&connect, false, &CancelToken::never(), &ends);
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
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../scenarios").join(file).canonicalize().unwrap();
    let mut scenario = load(&path, file).unwrap_or_else(|fault| panic!("{fault}"));
    (scenario.trials.count, scenario.trials.max_count) = (1, 1);
    let folder = tempfile::tempdir().unwrap();
    let text = format!(
        "title = \"one trial\"\nscenario = {:?}\n[vary]\n\"controller.law\" = {{ each = [{:?}] }}\n\
         [plan]\nmethod = \"grid\"\ntrials = 1\nseed = {}\n",
        path, scenario.controller.law, scenario.trials.seed
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
