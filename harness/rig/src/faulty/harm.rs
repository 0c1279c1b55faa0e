//! What the faults of a trial make of one message.

use super::parcel::Parcel;
use super::{Direction, WireFault, WireFaultKind, decode};
use platebench_wire::{Message, Packet, Sample};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng, SeedableRng};
use std::time::Duration;

/// Streams 0 and 1 of a trial's seed are the sensor's noise and the plate's spread.
const FIRST_STREAM: u64 = 2;

/// Noise of a babbling line: so many pieces, each of so many bytes with its delimiter.
const PIECES: usize = 4;
const PIECE: usize = 16;

/// The faults of a trial with what they remember.
#[derive(Debug, Default)]
pub(super) struct Harm {
    /// Those of the sensor first: the sensor stands before the line.
    armed: Vec<Armed>,
    /// The components of the last sample, as the bench sent it.
    last: Option<[f32; 2]>,
    counts: [Option<(&'static str, u64)>; WireFaultKind::COUNT],
}

#[derive(Debug)]
struct Armed {
    fault: WireFault,
    random: ChaCha8Rng,
    /// Messages in the window: to the controller, from it.
    met: [u64; 2],
    frozen: Option<[f32; 2]>,
}

impl Harm {
    pub(super) fn new(faults: &[WireFault]) -> Self {
        let mut armed: Vec<_> =
            (FIRST_STREAM..).zip(faults).map(|(stream, fault)| Armed::new(*fault, stream)).collect();
        armed.sort_by_key(|armed| !is_of_the_sensor(armed.fault.kind));
        Self { armed, ..Self::default() }
    }

    pub(super) fn is_armed(&self) -> bool {
        !self.armed.is_empty()
    }

    pub(super) fn counts(&self) -> [Option<(&'static str, u64)>; WireFaultKind::COUNT] {
        self.counts
    }

    /// What becomes of a message that is sent at `now`; `None` where nothing arrives.
    pub(super) fn strike(&mut self, direction: Direction, now: Duration, frame: &[u8]) -> Option<Parcel> {
        let mut parcel = Parcel::new(now, frame);
        let Self { armed, last, counts } = self;
        for armed in armed {
            if !armed.strikes(direction, now, *last) {
                continue;
            }
            let name = armed.fault.kind.name();
            let place = counts.iter_mut().find(|place| place.is_none_or(|(known, _)| known == name));
            if let Some(place) = place {
                place.get_or_insert((name, 0)).1 += 1;
            }
            parcel = parcel.and_then(|parcel| armed.act(parcel));
        }
        if let Some(Packet { message: Message::Sample(sample), .. }) = decode(frame) {
            *last = Some([sample.wd_um, sample.wq_um]);
        }
        parcel
    }
}

const fn is_of_the_sensor(kind: WireFaultKind) -> bool {
    matches!(kind, WireFaultKind::Freeze | WireFaultKind::Scale(_))
}

impl Armed {
    fn new(fault: WireFault, stream: u64) -> Self {
        let mut random = ChaCha8Rng::seed_from_u64(fault.seed);
        random.set_stream(stream);
        Self { fault, random, met: [0; 2], frozen: None }
    }

    /// True where the message that passes now is one of those to be struck.
    fn strikes(&mut self, direction: Direction, now: Duration, last: Option<[f32; 2]>) -> bool {
        let wanted = match self.fault.kind {
            kind if is_of_the_sensor(kind) => direction == Direction::ToController,
            _ => self.fault.direction == Direction::Both || self.fault.direction == direction,
        };
        if !wanted || !self.fault.covers(now) {
            return false;
        }
        let [to, from] = &mut self.met;
        let met = if direction == Direction::ToController { to } else { from };
        *met += 1;
        if *met == 1 {
            self.frozen = last;
        }
        met.checked_rem(u64::from(self.fault.every)) == Some(0)
    }

    fn act(&mut self, mut parcel: Parcel) -> Option<Parcel> {
        let length = parcel.bytes().len();
        match self.fault.kind {
            WireFaultKind::Drop | WireFaultKind::Disconnect => return None,
            WireFaultKind::Flip => parcel.flip(self.random.next_u32() as usize % (8 * length)),
            WireFaultKind::Duplicate => parcel.double(),
            WireFaultKind::Delay(delay) => parcel.due += delay,
            WireFaultKind::Truncate => parcel.truncate(length / 2),
            WireFaultKind::Babble => parcel.prepend(&self.noise()),
            WireFaultKind::Freeze => {
                let frozen = &mut self.frozen;
                return resampled(&parcel, |seen| *frozen.get_or_insert(seen));
            }
            WireFaultKind::Scale(factor) => return resampled(&parcel, |seen| seen.map(|value| value * factor)),
        }
        Some(parcel)
    }

    fn noise(&mut self) -> [u8; PIECES * PIECE] {
        let mut noise = [0; PIECES * PIECE];
        for piece in noise.chunks_mut(PIECE) {
            let (_, garbage) = piece.split_last_mut().unwrap_or((&mut 0, &mut []));
            garbage.fill_with(|| (self.random.next_u32() % 255) as u8 + 1);
        }
        noise
    }
}

/// The sample with other components, framed as the bench would have.
fn resampled(parcel: &Parcel, change: impl FnOnce([f32; 2]) -> [f32; 2]) -> Option<Parcel> {
    let Some(Packet { sequence, message: Message::Sample(sample) }) = decode(parcel.bytes()) else {
        return Some(parcel.clone());
    };
    let [wd_um, wq_um] = change([sample.wd_um, sample.wq_um]);
    let packet = Packet { sequence, message: Message::Sample(Sample { wd_um, wq_um, ..sample }) };
    Parcel::new(parcel.due, packet.encode().as_bytes())
}
