//! Parses the arguments, runs the controller and sets the exit code. As the main loop of a board does,
//! the program receives bytes, advances the controller and logs its state.

use crate::arguments::{Arguments, USAGE};
use crate::log::StateLog;
use crate::port::{HostError, Port, PortInput};
use platebench_controller::Device;
use platebench_wire::{Identity, LawId, capabilities};
use std::process::ExitCode;
use std::time::{Duration, Instant};

const SOURCE_HASH: &[u8; 32] = include_bytes!(concat!(env!("OUT_DIR"), "/source_hash.bin"));

const IDLE_WAIT: Duration = Duration::from_millis(50);
const MIN_WAIT: Duration = Duration::from_micros(20);

pub fn main() -> ExitCode {
    let arguments = match Arguments::parse(std::env::args().skip(1)) {
        Ok(Some(arguments)) => arguments,
        Ok(None) => {
            println!("{USAGE}");
            return ExitCode::SUCCESS;
        }
        Err(error) => {
            eprintln!("platebench-host-controller: {error}\n{USAGE}");
            return ExitCode::from(2);
        }
    };
    match run(&arguments) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("platebench-host-controller: {error}");
            ExitCode::FAILURE
        }
    }
}

fn identity(unique: [u8; 12]) -> Identity {
    let number = |text: &str| text.parse().unwrap_or_default();
    let mut build = [0; 8];
    build.copy_from_slice(SOURCE_HASH.first_chunk::<8>().unwrap_or(&[0; 8]));
    Identity {
        version: [
            number(env!("CARGO_PKG_VERSION_MAJOR")),
            number(env!("CARGO_PKG_VERSION_MINOR")),
            number(env!("CARGO_PKG_VERSION_PATCH")),
        ],
        capabilities: capabilities::TARGET_PACED | capabilities::COMPUTE_TIME | capabilities::LOOP_DELAY,
        laws: LawId::ALL.into_iter().fold(0, |laws, law| laws | 1 << law as u8),
        build,
        chip: 0,
        unique,
        name: *b"platebench-host\0",
    }
}

struct ControllerClock(Instant);

impl ControllerClock {
    fn now_us(&self) -> u32 {
        self.0.elapsed().as_micros() as u32
    }
}

fn run(arguments: &Arguments) -> Result<(), HostError> {
    let port = Port::open(arguments)?;
    let mut log = StateLog::open(arguments.log.as_deref())?;
    let clock = ControllerClock(Instant::now());
    let mut device = Device::new(identity(arguments.unique));
    let mut buffer = [0; 1024];
    let mut hung_up = false;
    log.write_change(clock.now_us(), device.output())?;
    loop {
        let timeout = receive_timeout(&device, clock.now_us());
        if hung_up {
            std::thread::sleep(timeout);
        } else {
            match port.receive(&mut buffer, timeout) {
                PortInput::Bytes(bytes) => {
                    let since = clock.now_us();
                    device.receive(bytes, since, |frame| port.send(frame));
                    let took_us = clock.now_us().wrapping_sub(since);
                    // At least 1 µs, because the protocol reserves 0 for "not measured".
                    device.set_compute_us(u16::try_from(took_us).unwrap_or(u16::MAX).max(1));
                }
                PortInput::TimedOut => {}
                PortInput::HungUp => {
                    hung_up = true;
                    log.write_line("hang-up", clock.now_us(), device.output())?;
                }
            }
        }
        device.tick(clock.now_us(), |frame| port.send(frame));
        log.write_change(clock.now_us(), device.output())?;
        if hung_up && device.output().drive_vpp == 0.0 {
            return log.write_line("end", clock.now_us(), device.output());
        }
    }
}

fn receive_timeout(device: &Device, now_us: u32) -> Duration {
    let quarter = device.period_us().map_or(IDLE_WAIT, |period| Duration::from_micros(u64::from(period) / 4));
    let tick = device.next_tick_us().map_or(IDLE_WAIT, |at| {
        // `at` may have passed; the difference then wraps to more than half of the range.
        let left = at.wrapping_sub(now_us);
        Duration::from_micros(if left > u32::MAX / 2 { 0 } else { left.into() })
    });
    // One microsecond more, so that the clock has reached `at` after the wait.
    quarter.clamp(MIN_WAIT, IDLE_WAIT).min(tick + Duration::from_micros(u64::from(tick > Duration::ZERO)))
}
