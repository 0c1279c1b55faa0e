//! Records trials of the hosted controller byte for byte.

use platebench_engine::Trial;
use platebench_engine::lockstep::play;
use platebench_model::scenario::find;
use platebench_rig::{CancelToken, FaultInjector, Link, Session};
use platebench_test_kit::{ScriptedLink, packets, random_configure, random_sample, scenario_path};
use platebench_wire::{LawId, Message, Packet};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use std::sync::{Arc, Mutex};
use std::time::Duration;

const TRIALS_PER_SCENARIO: u32 = 2;
const MAX_EXCHANGES: usize = 900;
const PERIOD: Duration = Duration::from_millis(1);

pub(crate) struct RecordedExchange {
    pub(crate) now: Duration,
    pub(crate) request: Vec<u8>,
    pub(crate) answer: Vec<u8>,
}

pub(crate) struct RecordedTrial {
    pub(crate) name: String,
    pub(crate) exchanges: Vec<RecordedExchange>,
}

impl RecordedTrial {
    pub(crate) fn flip_a_bit_of_the_last_drive(&mut self) {
        let driven = self.exchanges.iter_mut().rev().find_map(|exchange| match packets(&exchange.answer).first()? {
            &Packet { message: Message::Command(command), sequence } if command.drive_vpp > 0.0 => {
                Some((exchange, command, sequence))
            }
            _ => None,
        });
        let (exchange, mut command, sequence) = driven.unwrap();
        command.drive_vpp = f32::from_bits(command.drive_vpp.to_bits() ^ 1);
        exchange.answer = Packet { sequence, message: Message::Command(command) }.encode().as_bytes().to_vec();
    }
}

type ExchangeLog = Arc<Mutex<Vec<RecordedExchange>>>;

/// Returns a link to a hosted controller that cancels a trial after `MAX_EXCHANGES`.
fn recording_link(log: &ExchangeLog, cancel: &Arc<Mutex<CancelToken>>) -> impl Link + use<> {
    let (log, cancel) = (Arc::clone(log), Arc::clone(cancel));
    ScriptedLink::new(move |controller, now, bytes, answer| {
        let delay = controller.exchange(now, bytes, answer)?;
        let mut exchanges = log.lock().unwrap();
        exchanges.push(RecordedExchange { now, request: bytes.to_vec(), answer: answer.clone() });
        if exchanges.len() >= MAX_EXCHANGES {
            cancel.lock().unwrap().cancel();
        }
        Ok(delay)
    })
}

pub(crate) fn record_paper_scenarios(law: LawId) -> Vec<RecordedTrial> {
    let scenarios = find(&[scenario_path("paper")]).unwrap_or_else(|faults| panic!("{}", faults[0])).scenarios;
    let (log, limit) = (ExchangeLog::default(), Arc::new(Mutex::new(CancelToken::default())));
    let mut session = Session::open(FaultInjector::new(recording_link(&log, &limit))).unwrap();
    log.lock().unwrap().clear();
    let mut trials = Vec::new();
    for scenario in &scenarios {
        // Time stamps start at 0 only in every fourth trial, as those of the hosted device do.
        for index in (0..TRIALS_PER_SCENARIO).map(|number| 4 * number) {
            let cancel = CancelToken::default();
            limit.lock().unwrap().clone_from(&cancel);
            let result = play(&mut session, Trial { cancel, ..Trial::new(scenario, law, index) });
            assert!(result.is_none_or(|result| result.link_error.is_none()), "{}", scenario.file);
            let exchanges = std::mem::take(&mut *log.lock().unwrap());
            trials.push(RecordedTrial { name: format!("{}, {}", scenario.file, law.name()), exchanges });
        }
    }
    trials
}

pub(crate) fn record_random_samples(count: u32) -> Vec<RecordedTrial> {
    const PER_DESIGN: u32 = 100;
    let log = ExchangeLog::default();
    let mut session = Session::open(recording_link(&log, &Arc::default())).unwrap();
    log.lock().unwrap().clear();
    let trial = |design: u32| {
        let mut random = ChaCha8Rng::seed_from_u64(u64::from(design));
        let law = LawId::ALL[design as usize % LawId::ALL.len()];
        session.start_trial(&random_configure(law, &mut random)).unwrap();
        for index in 0..PER_DESIGN {
            session.send_sample(index * PERIOD, &random_sample(&mut random, index * 1_000)).unwrap().unwrap();
        }
        let exchanges = std::mem::take(&mut *log.lock().unwrap());
        RecordedTrial { name: format!("design {design}, {}", law.name()), exchanges }
    };
    (0..count.div_ceil(PER_DESIGN)).map(trial).collect()
}
