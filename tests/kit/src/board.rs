//! Simulates a board, and makes samples and configurations for one.

#![allow(clippy::unwrap_used, reason = "a failed fixture fails the test")]

use crate::configuration::CONFIGURE;
use crate::identity::IDENTITY;
use platebench_controller::Device;
use platebench_wire::{Configure, Gains, LawId, Sample};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::Rng as _;
use std::io::{Read, Write};
use std::net::{SocketAddr, TcpListener};
use std::thread;
use std::time::Instant;

/// Answers the bytes of a line with a controller, each frame `copies` times, until the line ends.
pub fn answer_line(mut reader: impl Read, mut writer: impl Write, copies: usize) {
    let (mut device, start) = (Device::new(IDENTITY), Instant::now());
    let mut bytes = [0; 256];
    while let Ok(count @ 1..) = reader.read(&mut bytes) {
        let mut answer = Vec::new();
        device.receive(&bytes[..count], start.elapsed().as_micros() as u32, |frame| {
            answer.extend(frame.repeat(copies));
        });
        if writer.write_all(&answer).is_err() {
            break;
        }
    }
}

/// Address without a server. Another test could take a port that was free for a moment.
pub const UNREACHABLE: &str = "127.0.0.1:1";

/// Starts a server with a simulated board. It accepts one connection after the other.
///
/// # Panics
/// If the system has no free port.
#[must_use]
pub fn serve_board() -> SocketAddr {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = listener.local_addr().unwrap();
    thread::spawn(move || {
        for stream in listener.incoming() {
            let stream = stream.unwrap();
            stream.set_nodelay(true).unwrap();
            answer_line(stream.try_clone().unwrap(), stream, 1);
        }
    });
    address
}

/// Returns sample `step` of a plate that oscillates around 1.5 µm, one sample per ms.
#[must_use]
pub fn wave_sample(step: u32) -> Sample {
    let wave = (step as f32 * 0.7).sin();
    Sample { time_us: step * 1_000, setpoint_um: 2.0, wd_um: 1.5 + wave, wq_um: 0.3 * wave }
}

/// Returns a number from `low` to below `high`, with the 24 bits of a float's mantissa.
pub fn uniform(random: &mut ChaCha8Rng, low: f32, high: f32) -> f32 {
    low + (high - low) * (random.next_u32() >> 8) as f32 / 16_777_216.0
}

fn one_in(random: &mut ChaCha8Rng, many: u32) -> bool {
    random.next_u32().is_multiple_of(many)
}

#[must_use]
pub fn random_configure(law: LawId, random: &mut ChaCha8Rng) -> Configure {
    let gains = one_in(random, 2).then(|| Gains {
        amplitude_kp: uniform(random, 0.0, 400.0),
        amplitude_ki: uniform(random, 0.0, 400e3),
        frequency_kp: uniform(random, 0.0, 400.0),
        frequency_ki: uniform(random, 0.0, 400e3),
    });
    Configure {
        law,
        loop_delay_us: if one_in(random, 2) { 0 } else { random.next_u32() % 1_000 },
        start_frequency_mhz: 30_000_000 + random.next_u32() % 4_000_000,
        gain_um_per_vpp: uniform(random, 1e-3, 2e-2),
        time_constant_s: uniform(random, 2e-4, 1e-2),
        response_time_s: if one_in(random, 2) { 0.0 } else { uniform(random, 5e-4, 1e-2) },
        drive_limit_vpp: uniform(random, 100.0, 1_000.0),
        frequency_range_hz: uniform(random, 1.0, 500.0),
        frequency_slew_hz: uniform(random, 0.1, 100.0),
        gains,
        ..CONFIGURE
    }
}

#[must_use]
pub fn random_sample(random: &mut ChaCha8Rng, time_us: u32) -> Sample {
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
