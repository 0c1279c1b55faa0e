//! Applies planned faults to one message, without allocation during a trial.

use arrayvec::ArrayVec;
use platebench_model::scenario::{Direction, Fault, FaultKind, Time};
use platebench_wire::{MAX_ENCODED, Message, Packet, PacketReader, Sample};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng, SeedableRng};
use std::time::Duration;
use strum::EnumCount;

/// First random stream of the faults. Sensor noise and plate spread use streams 0 and 1.
const FIRST_STREAM: u64 = 2;

/// Number of invalid frames that the fault *babble* sends, and their length with the delimiter.
const NOISE_FRAMES: usize = 4;
const NOISE_FRAME_BYTES: usize = 16;

#[derive(Debug, Default)]
pub(super) struct ActiveFaults {
    /// Faults of the sensor come first, because a sample passes the sensor before the line.
    faults: Vec<ActiveFault>,
    last_sample: Option<[f32; 2]>,
    counts: [Option<(&'static str, u64)>; FaultKind::COUNT],
}

#[derive(Debug)]
struct ActiveFault {
    fault: Fault,
    random: ChaCha8Rng,
    /// Number of messages in the fault's window, to the controller and from it.
    message_counts: [u64; 2],
    frozen: Option<[f32; 2]>,
}

impl ActiveFaults {
    /// `seed` is that of the trial, for faults without a seed of their own.
    pub(super) fn new(faults: &[Fault], seed: u64) -> Self {
        let mut faults: Vec<_> =
            (FIRST_STREAM..).zip(faults).map(|(stream, fault)| ActiveFault::new(*fault, seed, stream)).collect();
        faults.sort_by_key(|active| !active.fault.kind.affects_sensor());
        Self { faults, ..Self::default() }
    }

    pub(super) fn has_faults(&self) -> bool {
        !self.faults.is_empty()
    }

    pub(super) fn counts(&self) -> [Option<(&'static str, u64)>; FaultKind::COUNT] {
        self.counts
    }

    /// `None` if the message is lost.
    pub(super) fn apply(&mut self, direction: Direction, now: Duration, frame: &[u8]) -> Option<QueuedPacket> {
        let mut packet = QueuedPacket::new(now, frame);
        let Self { faults, last_sample, counts } = self;
        for active in faults {
            if !active.selects(direction, now, *last_sample) {
                continue;
            }
            let name = active.fault.kind.name();
            let place = counts.iter_mut().find(|place| place.is_none_or(|(known, _)| known == name));
            if let Some(place) = place {
                place.get_or_insert((name, 0)).1 += 1;
            }
            packet = packet.and_then(|packet| active.apply(packet));
        }
        if let Some(Packet { message: Message::Sample(sample), .. }) = decode_first_packet(frame) {
            *last_sample = Some([sample.wd_um, sample.wq_um]);
        }
        packet
    }
}

impl ActiveFault {
    fn new(fault: Fault, seed: u64, stream: u64) -> Self {
        let mut random = ChaCha8Rng::seed_from_u64(fault.seed.unwrap_or(seed));
        random.set_stream(stream);
        Self { fault, random, message_counts: [0; 2], frozen: None }
    }

    fn selects(&mut self, direction: Direction, now: Duration, last_sample: Option<[f32; 2]>) -> bool {
        let applies = if self.fault.kind.affects_sensor() {
            direction == Direction::ToController
        } else {
            self.fault.direction == Direction::Both || self.fault.direction == direction
        };
        if !applies || !self.fault.is_active_at(Time::from_nanos(now.as_nanos() as u64)) {
            return false;
        }
        let [to, from] = &mut self.message_counts;
        let count = if direction == Direction::ToController { to } else { from };
        *count += 1;
        if *count == 1 {
            self.frozen = last_sample;
        }
        count.checked_rem(u64::from(self.fault.every)) == Some(0)
    }

    fn apply(&mut self, mut packet: QueuedPacket) -> Option<QueuedPacket> {
        let length = packet.bytes.len();
        match self.fault.kind {
            FaultKind::Drop | FaultKind::Disconnect => return None,
            FaultKind::Flip => packet.flip(self.random.next_u32() as usize % (8 * length)),
            FaultKind::Duplicate => packet.duplicate(),
            FaultKind::Delay(delay) => packet.due += Duration::from(delay),
            FaultKind::Truncate => packet.bytes.truncate(length / 2),
            FaultKind::Babble => packet.prepend(&self.noise()),
            FaultKind::Freeze => {
                let frozen = &mut self.frozen;
                return with_components(packet, |sensed| *frozen.get_or_insert(sensed));
            }
            FaultKind::Scale(factor) => {
                return with_components(packet, |sensed| sensed.map(|value| value * factor as f32));
            }
        }
        Some(packet)
    }

    fn noise(&mut self) -> [u8; NOISE_FRAMES * NOISE_FRAME_BYTES] {
        let mut noise = [0; NOISE_FRAMES * NOISE_FRAME_BYTES];
        for frame in noise.chunks_mut(NOISE_FRAME_BYTES) {
            let (_, garbage) = frame.split_last_mut().unwrap_or((&mut 0, &mut []));
            garbage.fill_with(|| (self.random.next_u32() % 255) as u8 + 1);
        }
        noise
    }
}

fn with_components(packet: QueuedPacket, change: impl FnOnce([f32; 2]) -> [f32; 2]) -> Option<QueuedPacket> {
    let Some(Packet { sequence, message: Message::Sample(sample) }) = decode_first_packet(&packet.bytes) else {
        return Some(packet);
    };
    let [wd_um, wq_um] = change([sample.wd_um, sample.wq_um]);
    let changed = Packet { sequence, message: Message::Sample(Sample { wd_um, wq_um, ..sample }) };
    QueuedPacket::new(packet.due, changed.encode().as_bytes())
}

/// Enough for a message with noise, or for a repeated message.
const MAX_PACKET_BYTES: usize = 4 * MAX_ENCODED;

#[derive(Debug, Clone)]
pub(super) struct QueuedPacket {
    pub(super) due: Duration,
    pub(super) bytes: ArrayVec<u8, MAX_PACKET_BYTES>,
}

impl QueuedPacket {
    /// `None` for no bytes, or more than [`MAX_PACKET_BYTES`].
    pub(super) fn new(due: Duration, content: &[u8]) -> Option<Self> {
        let bytes = ArrayVec::try_from(content).ok().filter(|bytes| !bytes.is_empty())?;
        Some(Self { due, bytes })
    }

    pub(super) fn flip(&mut self, bit: usize) {
        if let Some(byte) = self.bytes.get_mut(bit / 8) {
            *byte ^= 1 << (bit % 8);
        }
    }

    /// Changes nothing if there is not enough room.
    pub(super) fn prepend(&mut self, content: &[u8]) {
        let mut whole = ArrayVec::new();
        let added = whole.try_extend_from_slice(content).and_then(|()| whole.try_extend_from_slice(&self.bytes));
        if added.is_ok() {
            self.bytes = whole;
        }
    }

    pub(super) fn duplicate(&mut self) {
        let _ = self.bytes.try_extend_from_slice(&self.bytes.clone());
    }
}

#[derive(Debug, Default)]
pub(super) struct FrameSplitter {
    bytes: ArrayVec<u8, MAX_ENCODED>,
    complete: bool,
}

impl FrameSplitter {
    /// Returns the collected bytes if `byte` is the delimiter or fills the buffer.
    pub(super) fn push(&mut self, byte: u8) -> Option<&[u8]> {
        if std::mem::take(&mut self.complete) {
            self.bytes.clear();
        }
        let _ = self.bytes.try_push(byte);
        self.complete = byte == 0 || self.bytes.is_full();
        self.complete.then_some(&self.bytes)
    }
}

pub(super) fn decode_first_packet(bytes: &[u8]) -> Option<Packet> {
    PacketReader::new().packets(bytes).next()?.ok()
}

pub(super) fn is_sample(bytes: &[u8]) -> bool {
    matches!(decode_first_packet(bytes), Some(Packet { message: Message::Sample(_), .. }))
}
