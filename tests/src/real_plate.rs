//! Simulates a board with its own plate behind a serial line, for tests of `--plate-mode real`.
//!
//! Usage: `real-plate-under-test PORT [KEY=VALUE]...`. The plate is the paper's. The timer of the
//! board is virtual: if a busy machine misses a period, it is computed later, so that none is
//! missing. N is the number of a period in a trial, from 0.
//!
//! | key | effect |
//! |---|---|
//! | `conditions=FILE` | force in N and temperature offset in K, read in every period |
//! | `log=FILE` | every change of state, as `PERIOD STATE DRIVE` |
//! | `force=no` | the board does not measure the force |
//! | `capability=no` | the board does not announce its plate |
//! | `skip=N` | the telemetry of this period is lost |
//! | `mute=N` | no telemetry from this period on |
//! | `deaf=N` | setpoints act but are not acknowledged from this period on |
//! | `reset=N` | the board restarts |
//! | `trap=N` | the processor traps |
//! | `stop=N` | the board stops by itself |
//! | `hold=UM` | the board keeps this setpoint, µm |
//! | `clock=X` | the board's timer runs faster by this factor |

use platebench_controller::StateMachine;
use platebench_plate::{Complex64, ConditionProfiles, Conditions, Drive, Model, Plant, Plate, Profile, RawPlate, Time};
use platebench_wire::{
    Command, Configure, Configured, ControllerState, FaultReport, Identity, LawId, Message, Packet, PacketReader,
    Rejection, Sample, Telemetry, capabilities,
};
use std::collections::BTreeMap;
use std::error::Error;
use std::f64::consts::TAU;
use std::fs::{self, File, OpenOptions};
use std::io::{Read, Write};
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, channel, sync_channel};
use std::thread;
use std::time::{Duration, Instant};

/// More than the frames of one second, which the board sends at once after a stall of the machine.
const MAX_QUEUED_FRAMES: usize = 2_048;
const PLATE: &str = include_str!("../../scenarios/plates/aluminium-198x138.toml");

fn main() -> Result<(), Box<dyn Error>> {
    let mut arguments = std::env::args().skip(1);
    let port = arguments.next().ok_or("expected PORT [KEY=VALUE]...")?;
    let options = arguments
        .map(|pair| pair.split_once('=').map(|(key, value)| (key.to_owned(), value.to_owned())))
        .collect::<Option<BTreeMap<_, _>>>()
        .ok_or("expected KEY=VALUE")?;
    let line = OpenOptions::new().read(true).write(true).open(port)?;
    let bytes = spawn_reader(line.try_clone()?);
    SimulatedBoard::new(spawn_writer(line), options)?.run(&bytes)
}

fn spawn_reader(mut line: File) -> Receiver<Vec<u8>> {
    let (sender, receiver) = channel();
    thread::spawn(move || {
        let mut buffer = [0; 512];
        while let Ok(count @ 1..) = line.read(&mut buffer) {
            if sender.send(buffer.get(..count).unwrap_or_default().to_vec()).is_err() {
                break;
            }
        }
    });
    receiver
}

/// Drops a frame if the queue is full, like a UART.
fn spawn_writer(mut line: File) -> SyncSender<Vec<u8>> {
    let (sender, frames) = sync_channel::<Vec<u8>>(MAX_QUEUED_FRAMES);
    thread::spawn(move || {
        for frame in frames {
            if line.write_all(&frame).is_err() {
                break;
            }
        }
    });
    sender
}

struct SimulatedBoard {
    line: SyncSender<Vec<u8>>,
    options: BTreeMap<String, String>,
    log: Option<File>,
    reader: PacketReader,
    plate: Plate,
    machine: StateMachine,
    trial: Option<BoardTrial>,
    next_sequence: u8,
    last_state: Option<ControllerState>,
}

struct BoardTrial {
    configure: Configure,
    plant: Plant,
    started: Option<Instant>,
    setpoint_um: f32,
    last_setpoint: Instant,
    last_sequence: u8,
    period: u32,
}

impl SimulatedBoard {
    fn new(line: SyncSender<Vec<u8>>, options: BTreeMap<String, String>) -> Result<Self, Box<dyn Error>> {
        let plate = toml::from_str::<RawPlate>(PLATE)?.check()?;
        let log = options.get("log").map(File::create).transpose()?;
        Ok(Self {
            line,
            options,
            log,
            reader: PacketReader::new(),
            plate,
            machine: StateMachine::new(),
            trial: None,
            next_sequence: 0,
            last_state: None,
        })
    }

    fn run(mut self, bytes: &Receiver<Vec<u8>>) -> Result<(), Box<dyn Error>> {
        loop {
            let timeout = self
                .next_period()
                .map_or(Duration::from_millis(50), |next| next.saturating_duration_since(Instant::now()));
            match bytes.recv_timeout(timeout) {
                Ok(bytes) => self.receive(&bytes)?,
                Err(RecvTimeoutError::Timeout) => {}
                Err(RecvTimeoutError::Disconnected) => return Ok(()),
            }
            // Messages that came while the machine stalled act before the periods that it missed.
            while let Ok(waiting) = bytes.try_recv() {
                self.receive(&waiting)?;
            }
            while self.next_period().is_some_and(|next| next <= Instant::now()) {
                self.step()?;
            }
        }
    }

    fn option<T: std::str::FromStr>(&self, key: &str) -> Option<T> {
        self.options.get(key).and_then(|value| value.parse().ok())
    }

    fn is_due(&self, key: &str, period: u32) -> bool {
        self.option::<u32>(key).is_some_and(|from| period >= from)
    }

    fn next_period(&self) -> Option<Instant> {
        let trial = self.trial.as_ref()?;
        let period = Duration::from_micros(trial.configure.period_us.into());
        let rate = self.option("clock").unwrap_or(1.0);
        trial.started.map(|started| started + (period * trial.period).div_f64(rate))
    }

    fn send(&self, sequence: u8, message: Message) {
        let _ = self.line.try_send(Packet { sequence, message }.encode().as_bytes().to_vec());
    }

    fn write_log(&mut self, period: u32) -> Result<(), Box<dyn Error>> {
        let output = *self.machine.output();
        if self.last_state.replace(output.state) != Some(output.state)
            && let Some(log) = &mut self.log
        {
            writeln!(log, "{period} {:?} {}", output.state, output.drive_vpp)?;
        }
        Ok(())
    }

    fn receive(&mut self, bytes: &[u8]) -> Result<(), Box<dyn Error>> {
        for &byte in bytes {
            let Some(Ok(Packet { sequence, message })) = self.reader.push(byte) else { continue };
            let period = self.trial.as_ref().map_or(0, |trial| trial.period);
            let answer = match message {
                Message::Hello => Some(Message::Identity(self.identity())),
                Message::Configure(configure) => Some(Message::Configured(self.configure(&configure))),
                Message::Setpoint(setpoint) => {
                    let command = self.apply_setpoint(sequence, setpoint.setpoint_um);
                    Some(Message::Command(command)).filter(|_| !self.is_due("deaf", period))
                }
                Message::Safe => {
                    self.trial = None;
                    Some(Message::Command(self.machine.enter_safe(0)))
                }
                _ => None,
            };
            self.write_log(period)?;
            if let Some(answer) = answer {
                self.send(sequence, answer);
            }
        }
        Ok(())
    }

    fn identity(&self) -> Identity {
        let has_plate = self.options.get("capability").is_none_or(|value| value != "no");
        Identity {
            version: [0, 1, 0],
            capabilities: capabilities::LOOP_DELAY | if has_plate { capabilities::OWN_PLATE } else { 0 },
            laws: LawId::ALL.into_iter().fold(0, |laws, law| laws | 1 << law as u8),
            build: [0; 8],
            chip: 0,
            unique: [0; 12],
            name: *b"real-plate\0\0\0\0\0\0",
        }
    }

    fn configure(&mut self, configure: &Configure) -> Configured {
        self.trial = None;
        if !configure.drives_own_plate {
            return Configured { outcome: Err(Rejection::Value) };
        }
        let configured = self.machine.configure(&Configure { drives_own_plate: false, ..*configure });
        let scene =
            ConditionProfiles { temperature_offset_k: Profile::constant(0.0), finger_force_n: Profile::constant(0.0) };
        self.trial = configured.outcome.is_ok().then(|| BoardTrial {
            configure: *configure,
            plant: Plant::new(self.plate.clone(), scene, Model::Envelope),
            started: None,
            setpoint_um: 0.0,
            last_setpoint: Instant::now(),
            last_sequence: 0,
            period: 0,
        });
        configured
    }

    fn apply_setpoint(&mut self, sequence: u8, setpoint_um: f32) -> Command {
        let setpoint_um = self.option("hold").unwrap_or(setpoint_um);
        let Some(trial) = &mut self.trial else { return *self.machine.output() };
        trial.setpoint_um = setpoint_um;
        trial.last_setpoint = Instant::now();
        trial.last_sequence = sequence;
        let starts = trial.started.is_none();
        trial.started.get_or_insert_with(Instant::now);
        let output = *self.machine.output();
        if starts { Command { state: ControllerState::Running, ..output } } else { output }
    }

    fn read_conditions(&self) -> Conditions {
        let text = self.options.get("conditions").and_then(|file| fs::read_to_string(file).ok()).unwrap_or_default();
        let mut numbers = text.split_whitespace().map(|number| number.parse().unwrap_or(0.0));
        let mut next = || numbers.next().unwrap_or(0.0);
        Conditions { finger_force_n: next(), temperature_offset_k: next() }
    }

    fn step(&mut self) -> Result<(), Box<dyn Error>> {
        let Some(mut trial) = self.trial.take() else { return Ok(()) };
        let period = trial.period;
        trial.period += 1;
        if self.option("reset") == Some(period) {
            self.machine = StateMachine::new();
            return self.write_log(period);
        }
        if self.option("trap") == Some(period) {
            self.machine = StateMachine::new();
            let report = FaultReport { code: 2, pc: 0x0800_1234, lr: 0, cfsr: 0, address: 0 };
            self.write_log(period)?;
            self.send(0, Message::Fault(report));
            return Ok(());
        }
        let conditions = self.read_conditions();
        if period.is_multiple_of(10) {
            trial.plant.hold_conditions(conditions);
        }
        let now_us = period.wrapping_mul(trial.configure.period_us);
        trial.plant.advance(Time::from_nanos(u64::from(now_us) * 1_000), &[], &mut Vec::new());
        let Complex64 { re, im } = trial.plant.state().w;
        let watchdog = Duration::from_millis(trial.configure.watchdog_timeout_ms.into());
        let sample = Sample { time_us: now_us, setpoint_um: trial.setpoint_um, wd_um: re as f32, wq_um: im as f32 };
        if self.option("stop") == Some(period) {
            self.machine.sample(&Sample { wd_um: f32::NAN, ..sample }, now_us);
        } else if trial.last_setpoint.elapsed() >= watchdog {
            // The state machine expects samples, not setpoints. A very late time makes its watchdog
            // act as after missing setpoints.
            if let Some(command) = self.machine.tick(now_us.wrapping_add(u32::MAX / 2)) {
                self.send(trial.last_sequence, Message::Command(command));
            }
        } else {
            self.machine.sample(&sample, now_us);
        }
        let output = *self.machine.output();
        let omega = TAU * f64::from(output.frequency_mhz) / 1e3;
        trial.plant.set_drive(Drive { vpp: output.drive_vpp.into(), omega });
        let measures_force = self.options.get("force").is_none_or(|value| value != "no");
        let telemetry = Telemetry {
            period,
            target_time_us: now_us.wrapping_add(123),
            setpoint_um: trial.setpoint_um,
            wd_um: re as f32,
            wq_um: im as f32,
            drive_vpp: output.drive_vpp,
            frequency_mhz: output.frequency_mhz,
            force_n: measures_force.then_some(conditions.finger_force_n as f32),
            state: output.state,
            cause: output.cause,
            flags: output.flags,
        };
        self.trial = Some(trial);
        self.write_log(period)?;
        self.next_sequence = self.next_sequence.wrapping_add(1);
        if self.option("skip") == Some(period) || self.is_due("mute", period) {
            return Ok(());
        }
        self.send(self.next_sequence, Message::Telemetry(telemetry));
        Ok(())
    }
}
