//! Measures the emulated rig in processor time, so that other load has less influence.
//! `ci/firmware` runs it.
//! `cargo run --release --ignore-rust-version -p platebench-rig --example emulated-figures [ELF]`

use platebench_model::record::Transport;
use platebench_rig::{Chip as _, EmulatedLink, Session};
use platebench_test_kit::CONFIGURE;
use platebench_wire::{Configure, LawId, Sample};
use rustix::time::{ClockId, clock_gettime};
use std::error::Error;
use std::path::Path;
use std::time::Duration;

const EXCHANGES: u32 = 20_000;
const TRANSPORTS: [(&str, Transport); 2] = [("words", Transport::Words), ("blocks", Transport::Blocks)];
const PERIOD: Duration = Duration::from_millis(1);

fn main() -> Result<(), Box<dyn Error>> {
    let argument = std::env::args().nth(1);
    let open = || match &argument {
        Some(elf) => EmulatedLink::open(Path::new(elf)),
        None => EmulatedLink::built_in(),
    };
    let before = processor_ms();
    let emulated = open()?;
    println!("load, power-on and handshake: {:.1} ms, {} baud", processor_ms() - before, emulated.baud());
    drop(emulated);

    for (law, transport) in LawId::ALL.into_iter().flat_map(|law| TRANSPORTS.map(|transport| (law, transport))) {
        let mut session = Session::open(open()?)?;
        session.link_mut().set_transport(transport.1);
        let configure = Configure { law, ..CONFIGURE };
        session.start_trial(&configure)?;
        let before = processor_ms();
        session.start_trial(&configure)?;
        let restart_ms = processor_ms() - before;
        let before = processor_ms();
        let (mut sum, mut worst, mut delay, mut amplitude) = (0, 0, Duration::ZERO, 0.0);
        for index in 0..EXCHANGES {
            let sample = Sample { time_us: index * 1_000, setpoint_um: 2.0, wd_um: amplitude, wq_um: 0.01 };
            let reply = session.send_sample(index * PERIOD, &sample)?.ok_or("no reply")?;
            amplitude += 0.4 * (0.00698 * reply.command.drive_vpp - amplitude);
            let instructions = reply.instructions.ok_or("no count")?;
            sum += instructions;
            worst = worst.max(instructions);
            delay = delay.max(reply.delay);
        }
        let seconds = (processor_ms() - before) / 1e3;
        println!(
            "{:<14} {}: {:>6.0} exchanges/s ({:.1} us each, {:.1} times real time at 1 kHz); \
             {:.0} instructions per step, worst {worst}; loop delay at most {:.3} us; \
             restart {restart_ms:.2} ms",
            law.name(),
            transport.0,
            f64::from(EXCHANGES) / seconds,
            seconds * 1e6 / f64::from(EXCHANGES),
            f64::from(EXCHANGES) / 1e3 / seconds,
            sum as f64 / f64::from(EXCHANGES),
            delay.as_secs_f64() * 1e6,
        );
        if let Some(bytes) = session.link().stack_used() {
            println!("{:<14} stack: at most {bytes} bytes", "");
        }
    }
    if let Ok(status) = std::fs::read_to_string("/proc/self/status") {
        status
            .lines()
            .filter(|line| line.starts_with("VmHWM") || line.starts_with("VmRSS"))
            .for_each(|line| println!("{line}"));
    }
    Ok(())
}

/// Processor time of this thread, ms.
fn processor_ms() -> f64 {
    let time = clock_gettime(ClockId::ThreadCPUTime);
    time.tv_sec as f64 * 1e3 + time.tv_nsec as f64 / 1e6
}
