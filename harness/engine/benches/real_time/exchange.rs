//! Measures one exchange per millisecond by a blocking thread and by a tokio task.

use super::table::{Quantiles, quantiles};
use platebench_rig::{ExecLink, FaultInjector, Session};
use platebench_test_kit::ChildGuard;
use platebench_wire::{Configure, Message, Packet, PacketReader, Sample};
use std::error::Error;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio_serial::{SerialPort, SerialStream};

const ANSWER_TIMEOUT: Duration = Duration::from_millis(100);
const PERIOD: Duration = Duration::from_millis(1);

pub(crate) struct ExchangeStats {
    pub(crate) lateness: Quantiles,
    pub(crate) round_trip: Quantiles,
    pub(crate) missed: u32,
}

/// The watchdog time-out of 1 s also tolerates stalls of a busy computer.
const CONFIGURE: Configure = Configure { watchdog_timeout_ms: 1_000, ..platebench_test_kit::CONFIGURE };

fn sample(number: u32) -> Sample {
    Sample { time_us: number * 1_000, setpoint_um: 2.0, wd_um: 1.9, wq_um: 0.0 }
}

#[derive(Default)]
struct ExchangeTimes {
    lateness: Vec<Duration>,
    round_trip: Vec<Duration>,
    missed: u32,
}

impl ExchangeTimes {
    fn finish(mut self) -> ExchangeStats {
        ExchangeStats {
            lateness: quantiles(&mut self.lateness),
            round_trip: quantiles(&mut self.round_trip),
            missed: self.missed,
        }
    }
}

pub(crate) fn measure_blocking(length: Duration) -> Result<ExchangeStats, Box<dyn Error>> {
    let mut session = Session::open(FaultInjector::new(ExecLink::start(&crate::controller_command("")?)?))?;
    session.start_trial(&CONFIGURE)?;
    let mut times = ExchangeTimes::default();
    let start = Instant::now();
    for number in 1..=length.as_millis() as u32 {
        let due = start + PERIOD * number;
        std::thread::sleep(due.saturating_duration_since(Instant::now()));
        let sent = Instant::now();
        times.lateness.push(sent.saturating_duration_since(due));
        let sequence = session.send(Message::Sample(sample(number)))?;
        let answered = loop {
            match session.receive(sent + ANSWER_TIMEOUT)? {
                Some(received) if received.sequence == sequence => break Some(received.received_at),
                Some(_) => {}
                None => break None,
            }
        };
        match answered {
            Some(at) => times.round_trip.push(at.saturating_duration_since(sent)),
            None => times.missed += 1,
        }
    }
    Ok(times.finish())
}

pub(crate) fn measure_tokio(length: Duration) -> Result<ExchangeStats, Box<dyn Error>> {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    runtime.block_on(async {
        let (mut port, other) = SerialStream::pair()?;
        let path = other.name().ok_or("a pseudo-terminal without a name")?;
        let mut other = Some(other);
        if let Some(other) = &mut other {
            other.set_exclusive(false)?;
        }
        let child = Command::new(std::env::current_exe()?).arg(&path).stdin(Stdio::null()).spawn()?;
        let _child = ChildGuard(child);
        let mut line = AsyncPort { port: &mut port, reader: PacketReader::new(), buffer: [0; 512], filled: 0, read: 0 };
        let begun = Instant::now();
        while !line.request(0, Message::Hello).await? {
            if begun.elapsed() > Duration::from_secs(5) {
                return Err("the controller does not answer".into());
            }
        }
        drop(other);
        if !line.request(1, Message::Configure(CONFIGURE)).await? {
            return Err("the controller is not configured".into());
        }
        let mut times = ExchangeTimes::default();
        let start = tokio::time::Instant::now();
        for number in 1..=length.as_millis() as u32 {
            let due = start + PERIOD * number;
            tokio::time::sleep_until(due).await;
            let sent = Instant::now();
            times.lateness.push(sent.saturating_duration_since(due.into_std()));
            if line.request(number as u8, Message::Sample(sample(number))).await? {
                times.round_trip.push(sent.elapsed());
            } else {
                times.missed += 1;
            }
        }
        Ok(times.finish())
    })
}

struct AsyncPort<'a> {
    port: &'a mut SerialStream,
    reader: PacketReader,
    buffer: [u8; 512],
    filled: usize,
    read: usize,
}

impl AsyncPort<'_> {
    async fn request(&mut self, sequence: u8, message: Message) -> std::io::Result<bool> {
        self.port.write_all(Packet { sequence, message }.encode().as_bytes()).await?;
        match tokio::time::timeout(ANSWER_TIMEOUT, self.await_answer(sequence)).await {
            Ok(answered) => answered.map(|()| true),
            Err(_) => Ok(false),
        }
    }

    async fn await_answer(&mut self, sequence: u8) -> std::io::Result<()> {
        loop {
            while let Some(&byte) = self.buffer.get(..self.filled).and_then(|bytes| bytes.get(self.read)) {
                self.read += 1;
                if self.reader.push(byte).is_some_and(|packet| packet.is_ok_and(|it| it.sequence == sequence)) {
                    return Ok(());
                }
            }
            self.read = 0;
            self.filled = 0;
            self.filled = self.port.read(&mut self.buffer).await?;
        }
    }
}
