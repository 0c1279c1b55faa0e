//! What a board's main loop does: takes in what the line brought, lets the time pass, follows the output.

use crate::Failure;
use crate::arguments::Arguments;
use crate::log::Log;
use crate::port::{Brought, Port};
use platebench_controller::Device;
use platebench_wire::{Identity, LawId, capabilities};
use std::time::{Duration, Instant};

/// The build script's.
const SOURCE_HASH: &[u8; 32] = include_bytes!(concat!(env!("OUT_DIR"), "/source_hash.bin"));

/// Between two looks at the clock while there is nothing to control.
const IDLE: Duration = Duration::from_millis(50);
/// Never more often than this, whatever the period.
const SHORTEST: Duration = Duration::from_micros(20);

fn identity() -> Identity {
    let number = |text: &str| text.parse().unwrap_or_default();
    let mut build = [0; 8];
    build.copy_from_slice(SOURCE_HASH.first_chunk::<8>().unwrap_or(&[0; 8]));
    Identity {
        version: [
            number(env!("CARGO_PKG_VERSION_MAJOR")),
            number(env!("CARGO_PKG_VERSION_MINOR")),
            number(env!("CARGO_PKG_VERSION_PATCH")),
        ],
        capabilities: capabilities::TARGET_PACED | capabilities::MEASURES_COMPUTING | capabilities::TOLD_DELAY,
        laws: LawId::ALL.into_iter().fold(0, |laws, law| laws | 1 << law as u8),
        build,
        chip: 0,
        unique: [0; 12],
        name: *b"platebench-host\0",
    }
}

/// The controller's own clock: microseconds since its start, wrapping, as on the board.
struct Clock(Instant);

impl Clock {
    fn now_us(&self) -> u32 {
        self.0.elapsed().as_micros() as u32
    }
}

/// Controls until the line hangs up and the drive is at 0 V.
pub(crate) fn run(arguments: &Arguments) -> Result<(), Failure> {
    let port = Port::open(arguments)?;
    let mut log = Log::open(arguments.log.as_deref())?;
    let clock = Clock(Instant::now());
    let mut device = Device::new(identity());
    let mut buffer = [0; 1024];
    let mut hung_up = false;
    log.follow(clock.now_us(), device.output())?;
    loop {
        let patience = patience(&device, clock.now_us());
        if hung_up {
            std::thread::sleep(patience);
        } else {
            match port.receive(&mut buffer, patience) {
                Brought::Bytes(bytes) => {
                    let since = clock.now_us();
                    device.receive(bytes, since, |frame| port.send(frame));
                    let took_us = clock.now_us().wrapping_sub(since);
                    // Zero would say that nobody measured.
                    device.set_compute_us(u16::try_from(took_us).unwrap_or(u16::MAX).max(1));
                }
                Brought::Nothing => {}
                Brought::HungUp => {
                    hung_up = true;
                    log.note("hang-up", clock.now_us(), device.output())?;
                }
            }
        }
        device.tick(clock.now_us(), |frame| port.send(frame));
        log.follow(clock.now_us(), device.output())?;
        if hung_up && device.output().drive_vpp == 0.0 {
            return log.note("end", clock.now_us(), device.output());
        }
    }
}

/// How long there is nothing to do but to listen: a quarter of a period, and no longer than to the period that this side has to begin.
fn patience(device: &Device, now_us: u32) -> Duration {
    let quarter = device.period_us().map_or(IDLE, |period| Duration::from_micros(u64::from(period) / 4));
    let tick = device.next_tick_us().map_or(IDLE, |at| {
        // An instant that is over looks very far away.
        let left = at.wrapping_sub(now_us);
        Duration::from_micros(if left > u32::MAX / 2 { 0 } else { left.into() })
    });
    // Rounded up, so that the clock has got there.
    quarter.clamp(SHORTEST, IDLE).min(tick + Duration::from_micros(u64::from(tick > Duration::ZERO)))
}
