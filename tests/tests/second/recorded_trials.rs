//! Records trials of the hosted controller byte for byte.

use platebench_engine::Trial;
use platebench_engine::lockstep::play;
use platebench_model::scenario::find;
use platebench_rig::{CancelToken, FaultInjector, HostedLink, Link, LinkError, Session};
use platebench_wire::{Configure, Gains, LawId, Message, Packet, PacketReader, Sample};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng, SeedableRng};
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

fn uniform(random: &mut ChaCha8Rng, low: f32, high: f32) -> f32 {
    low + (high - low) * (random.next_u32() >> 8) as f32 / 16_777_216.0
}

fn one_in(random: &mut ChaCha8Rng, many: u32) -> bool {
    random.next_u32().is_multiple_of(many)
}

fn random_configure(law: LawId, random: &mut ChaCha8Rng) -> Configure {
    let gains = one_in(random, 2).then(|| Gains {
        amplitude_kp: uniform(random, 0.0, 400.0),
        amplitude_ki: uniform(random, 0.0, 400e3),
        frequency_kp: uniform(random, 0.0, 400.0),
        frequency_ki: uniform(random, 0.0, 400e3),
    });
    Configure {
        paced_by_target: false,
        drives_own_plate: false,
        watchdog_timeout_ms: 0,
        law,
        period_us: 1_000,
        loop_delay_us: if one_in(random, 2) { 0 } else { random.next_u32() % 1_000 },
        start_frequency_mhz: 30_000_000 + random.next_u32() % 4_000_000,
        gain_um_per_vpp: uniform(random, 1e-3, 2e-2),
        time_constant_s: uniform(random, 2e-4, 1e-2),
        response_time_s: if one_in(random, 2) { 0.0 } else { uniform(random, 5e-4, 1e-2) },
        drive_limit_vpp: uniform(random, 100.0, 1_000.0),
        frequency_range_hz: uniform(random, 1.0, 500.0),
        frequency_slew_hz: uniform(random, 0.1, 100.0),
        gains,
    }
}

fn random_sample(random: &mut ChaCha8Rng, time_us: u32) -> Sample {
    let setpoint_um = if one_in(random, 32) { 0.0 } else { uniform(random, 0.0, 4.0) };
    // Some samples are almost zero, subnormal, or as large as with a broken sensor cable.
    let wd_um = match random.next_u32() % 32 {
        0 => 1e-9,
        1 => f32::from_bits(random.next_u32() % 0x80_0000),
        2 => -0.0,
        _ => uniform(random, -1.0, 4.0),
    };
    let wq_um = match random.next_u32() % 64 {
        0 => 1e6,
        1 => f32::MAX,
        _ => uniform(random, -1.0, 1.0),
    };
    Sample { time_us, setpoint_um, wd_um, wq_um }
}
