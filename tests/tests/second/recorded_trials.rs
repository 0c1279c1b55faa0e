//! Records trials of the hosted controller byte for byte.

use platebench_engine::Trial;
use platebench_engine::lockstep::play;
use platebench_model::scenario::find;
use platebench_rig::{CancelToken, FaultInjector, HostedLink, Link, LinkError, Session};
use platebench_test_kit::{random_configure, random_sample};
use platebench_wire::{LawId, Message, Packet, PacketReader};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use std::path::Path;
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
        let decode = |bytes: &[u8]| PacketReader::new().packets(bytes).flatten().next();
        let driven = self.exchanges.iter_mut().rev().find_map(|exchange| match decode(&exchange.answer)? {
            Packet { message: Message::Command(command), sequence } if command.drive_vpp > 0.0 => {
                Some((exchange, command, sequence))
            }
            _ => None,
        });
        let (exchange, mut command, sequence) = driven.unwrap();
        command.drive_vpp = f32::from_bits(command.drive_vpp.to_bits() ^ 1);
        exchange.answer = Packet { sequence, message: Message::Command(command) }.encode().as_bytes().to_vec();
    }
}

#[derive(Default)]
struct RecordingLink {
    link: HostedLink,
    log: Arc<Mutex<Vec<RecordedExchange>>>,
    count: usize,
    cancel: Arc<Mutex<CancelToken>>,
}

impl Link for RecordingLink {
    fn exchange(&mut self, now: Duration, bytes: &[u8], answer: &mut Vec<u8>) -> Result<Duration, LinkError> {
        let delay = self.link.exchange(now, bytes, answer)?;
        self.log.lock().unwrap().push(RecordedExchange { now, request: bytes.to_vec(), answer: answer.clone() });
        self.count += 1;
        if self.count >= MAX_EXCHANGES {
            self.cancel.lock().unwrap().cancel();
        }
        Ok(delay)
    }

    fn advance_to(&mut self, now: Duration, received: &mut Vec<u8>) -> Result<(), LinkError> {
        self.link.advance_to(now, received)
    }

    fn restart(&mut self) -> Result<bool, LinkError> {
        self.log.lock().unwrap().clear();
        self.count = 0;
        self.link.restart()
    }
}

pub(crate) fn record_paper_scenarios(law: LawId) -> Vec<RecordedTrial> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../scenarios/paper");
    let scenarios = find(&[folder]).unwrap_or_else(|faults| panic!("{}", faults[0])).scenarios;
    let recorder = RecordingLink::default();
    let (log, limit) = (recorder.log.clone(), recorder.cancel.clone());
    let mut session = Session::open(FaultInjector::new(recorder)).unwrap();
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
    let recorder = RecordingLink::default();
    let log = recorder.log.clone();
    let mut session = Session::open(recorder).unwrap();
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
