//! Runs a firmware image on an emulated STM32F427 in this process, in virtual time. USART2 (PA2,
//! PA3) runs at the firmware's baud rate. A command takes effect with its last stop bit, so that
//! the loop delay contains both transmissions, the idle line after a frame, and the computing time.
//! While the firmware sleeps, virtual time jumps to the next event. Every trial begins with a
//! power-on, so that equal trials give equal bytes. An access that the emulator does not model ends
//! the trial, as do traps, lock-ups, resets and missing answers. Each instruction takes 1/168 µs; a
//! real processor also waits for its flash and its pipeline.

mod board;
mod boot_cache;
mod bus;
mod chip_faults;
mod debugger;
mod firmware_output;
mod image;
mod machine;
mod memory;
mod no_model;
mod peripherals;
mod post_mortem;
mod serial_port;
mod transport_check;

#[cfg(feature = "probe")]
pub(crate) use image::read_elf;
pub use image::{EmulatedError, EmulatedOptions, ImageError};

use crate::cancel::CancelToken;
use crate::crash_report::StoppedAt;
use crate::debug_port::DebugPort;
use crate::factory::BUILT_IN_IMAGE;
use crate::link::{Chip, ChipFaultError, ChipFaultPlan, Link, LinkError, TargetError};
use crate::port::{PendingRequests, Request};
use crate::rejected_frame::rejected_answer;
use board::ReceivedByte;
use bus::PinLog;
use chip_faults::ChipFaults;
use debugger::Debugger;
use gdbstub::common::Signal;
use image::{Image, catch_emulator_panic};
use machine::{DebugStop, Machine};
use platebench_model::metrics::{EnablePin, OutputRead};
use platebench_model::record::{Transport, UnmodelledInstance};
use platebench_wire::{EncodedFrame, MAX_ENCODED, Message, Packet};
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
use std::sync::Arc;
use std::time::{Duration, Instant};
use transport_check::{Call, CallLog, CallResult};

const NS_PER_MS: u64 = 1_000_000;
const BITS_PER_BYTE: u64 = 10;

/// Longest time from the last bit of the request to the answer.
const ANSWER_TIMEOUT_NS: u64 = 20 * NS_PER_MS;
/// Longest wait after a message that needs no answer.
const OPTIONAL_ANSWER_TIMEOUT_NS: u64 = NS_PER_MS / 5;
const HANDSHAKE_INTERVAL_NS: u64 = 10 * NS_PER_MS;
const HANDSHAKE_TIMEOUT_NS: u64 = 1_000 * NS_PER_MS;
/// Longest wall time of the handshake, because firmware that polls may run slower than real time.
const HANDSHAKE_WALL_TIMEOUT: Duration = Duration::from_secs(20);
/// Minimum time from the handshake to time zero of a trial.
const START_DELAY_NS: u64 = NS_PER_MS;

#[derive(Debug)]
pub struct EmulatedLink {
    target: Box<Machine>,
    debugger: Option<Debugger>,
    trial_start_ns: u64,
    /// Transmission time of one byte; 0 before the firmware's first frame.
    byte_ns: u64,
    received: Vec<ReceivedByte>,
    pending_requests: PendingRequests,
    instructions: Option<u64>,
    computing_ns: Option<u64>,
    target_error: Option<TargetError>,
    chip_faults: ChipFaults,
    transport: Transport,
    /// Calls since the restart of a trial whose transport is checked.
    calls: CallLog,
    /// True after the handshake. Faults of the chip act only then.
    has_started: bool,
}

impl EmulatedLink {
    pub fn built_in() -> Result<Self, EmulatedError> {
        Self::new(BUILT_IN_IMAGE, EmulatedOptions::default())
    }

    pub fn open(elf: &Path) -> Result<Self, EmulatedError> {
        Self::new(&image::read_image(elf)?, EmulatedOptions::default())
    }

    /// Lets a debugger on `port` control the chip. `elf` is `None` for the built-in image.
    pub fn open_with_debugger(
        elf: Option<&Path>,
        port: &DebugPort,
        cancel: &CancelToken,
    ) -> Result<Self, EmulatedError> {
        let content = elf.map_or_else(|| Ok(BUILT_IN_IMAGE.to_vec()), image::read_image)?;
        Self::start_with(&content, EmulatedOptions::default(), Some((port, cancel)))
    }

    pub fn new(elf: &[u8], options: EmulatedOptions) -> Result<Self, EmulatedError> {
        Self::start_with(elf, options, None)
    }

    fn start_with(
        elf: &[u8],
        options: EmulatedOptions,
        debugger: Option<(&DebugPort, &CancelToken)>,
    ) -> Result<Self, EmulatedError> {
        let image = Image::new(Arc::from(elf))?;
        let mut emulated = Self {
            target: Box::new(catch_emulator_panic(|| Machine::new(image, options))?),
            debugger: None,
            trial_start_ns: 0,
            byte_ns: 0,
            received: Vec::with_capacity(2 * MAX_ENCODED),
            pending_requests: PendingRequests::default(),
            instructions: None,
            computing_ns: None,
            target_error: None,
            chip_faults: ChipFaults::default(),
            transport: Transport::default(),
            calls: CallLog::default(),
            has_started: false,
        };
        if let Some((port, cancel)) = debugger
            && let Some(stream) = port.accept(cancel)?
        {
            emulated.debugger = Some(Debugger::attach(stream, &mut emulated.target, cancel)?);
        }
        catch_emulator_panic(|| emulated.start())?;
        Ok(emulated)
    }

    pub fn baud(&self) -> u32 {
        (BITS_PER_BYTE * 1_000_000_000).checked_div(self.byte_ns).unwrap_or(0) as u32
    }

    /// Largest stack use since power-on, bytes; `None` if the image does not define `_stack_end`.
    pub fn stack_used(&self) -> Option<u32> {
        self.target.stack_used()
    }

    /// Starts to record which instructions at `addresses` in flash run. Discards earlier records.
    pub fn record_execution(&mut self, addresses: &BTreeSet<u32>) {
        self.target.watch(addresses);
    }

    /// Recorded instructions that ran, by address. The value is true if the instruction ran while
    /// the firmware answered a sample.
    pub fn executed_instructions(&self) -> &BTreeMap<u32, bool> {
        self.target.executed_instructions()
    }

    /// Overwrites flash, also for later trials. Returns false if no memory is at `address`.
    pub fn patch(&mut self, address: u32, bytes: &[u8]) -> bool {
        self.target.patch(address, bytes)
    }

    /// Powers on and performs the handshake, or continues at the state after an earlier handshake of
    /// the same image in this process, which is the same. The trial starts at the next whole millisecond.
    fn start(&mut self) -> Result<(), TargetError> {
        self.target_error = None;
        self.target.set_control_step(false);
        self.has_started = false;
        self.instructions = None;
        self.computing_ns = None;
        self.byte_ns = 0;
        self.target.uses_blocks = self.may_use_blocks();
        self.calls.start(self.transport == Transport::BlocksAndWords && self.target.uses_blocks);
        let may_skip = self.debugger.is_none() && self.target.may_skip_start();
        let elf = self.target.image.elf.clone();
        if may_skip && let Some(state) = boot_cache::find(&elf, self.target.options) {
            self.target.restore(&state)?;
            self.received.clone_from(&state.answer);
            self.pending_requests = PendingRequests::default();
            self.pending_requests.send(hello().as_bytes());
            let _ = self.received.iter().any(|received| self.pending_requests.ends_wait(received.byte));
            self.measure_byte_time();
        } else {
            self.target.power_on()?;
            self.shake_hands()?;
            self.measure_byte_time();
            self.target.mark_booted();
            if may_skip {
                boot_cache::keep(&mut self.target, self.received.clone())?;
            }
        }
        self.received.clear();
        self.trial_start_ns = (self.target.now_ns() + START_DELAY_NS).next_multiple_of(NS_PER_MS);
        self.chip_faults.start_trial();
        self.has_started = true;
        Ok(())
    }

    fn shake_hands(&mut self) -> Result<(), TargetError> {
        let deadline = Instant::now() + HANDSHAKE_WALL_TIMEOUT;
        let hello = hello();
        let mut attempt_ends = 0;
        loop {
            self.pending_requests = PendingRequests::default();
            self.received.clear();
            attempt_ends += HANDSHAKE_INTERVAL_NS;
            self.run_to(self.target.now_ns() + START_DELAY_NS)?;
            self.received.clear();
            self.pending_requests.send(hello.as_bytes());
            self.target.send(hello.as_bytes());
            if self.run_until_answer(attempt_ends)?.is_some() {
                return Ok(());
            }
            if attempt_ends >= HANDSHAKE_TIMEOUT_NS || (Instant::now() > deadline && self.debugger.is_none()) {
                let silent = TargetError::NoHandshake {
                    waited_ms: self.target.now_ns() / NS_PER_MS,
                    instances: self.target.used_instances(),
                    place: self.target.code_location(),
                };
                return Err(self.target.trap(StoppedAt::Body).unwrap_or(silent));
            }
        }
    }

    /// A debugger and faults of the chip need each word at its instant.
    fn may_use_blocks(&self) -> bool {
        self.transport != Transport::Words && self.debugger.is_none() && !self.chip_faults.is_active()
    }

    fn measure_byte_time(&mut self) {
        let (Some(first), Some(last)) = (self.received.first(), self.received.last()) else { return };
        let gaps = self.received.len() as u64 - 1;
        self.byte_ns = (last.at_ns - first.at_ns + gaps / 2).checked_div(gaps).unwrap_or(0);
    }

    /// Like [`Machine::run`], but applies the planned faults of the chip at their instants.
    fn run_target(&mut self, until_ns: u64) -> Result<bool, TargetError> {
        while self.has_started
            && let Some(at) = self.chip_faults.next()
        {
            let at_ns = self.virtual_ns(at);
            if at_ns > until_ns {
                break;
            }
            if self.target.now_ns() < at_ns && self.run_machine(at_ns)? {
                return Ok(true);
            }
            self.target.drain_output();
            self.chip_faults.apply_next(&mut self.target)?;
        }
        self.run_machine(until_ns)
    }

    /// Like [`Machine::run`], but a debugger may stop the chip, also before an error returns.
    fn run_machine(&mut self, until_ns: u64) -> Result<bool, TargetError> {
        let mut stop = None;
        loop {
            if let Some(debugger) = &mut self.debugger {
                debugger.serve(&mut self.target, stop);
            }
            let result = self.target.run(until_ns);
            stop = self.target.debug.stop.take();
            if result.is_ok() && stop.is_some() {
                continue;
            }
            if let (Err(_), Some(debugger)) = (&result, &mut self.debugger) {
                debugger.serve(&mut self.target, Some(DebugStop::Signal(Signal::SIGSEGV)));
            }
            return result;
        }
    }

    fn run_to(&mut self, until_ns: u64) -> Result<(), TargetError> {
        while self.target.now_ns() < until_ns {
            self.run_target(until_ns)?;
        }
        self.target.take_received(&mut self.received);
        Ok(())
    }

    /// Runs to the end of the answer or to `until_ns`, and then to the end of a frame that has
    /// begun. Returns the end of the answer's last stop bit, ns.
    fn run_until_answer(&mut self, mut until_ns: u64) -> Result<Option<u64>, TargetError> {
        let mut read = self.received.len();
        let mut extended = false;
        loop {
            let frame_ended = self.run_target(until_ns)?;
            self.target.take_received(&mut self.received);
            let mut within_frame = false;
            while let Some(&ReceivedByte { byte, at_ns }) = self.received.get(read) {
                read += 1;
                within_frame = byte != 0;
                if self.pending_requests.ends_wait(byte) {
                    return Ok(Some(at_ns));
                }
            }
            if frame_ended {
                continue;
            }
            if within_frame && !extended {
                extended = true;
                until_ns += MAX_ENCODED as u64 * self.byte_ns.max(1);
                continue;
            }
            return Ok(None);
        }
    }

    fn virtual_ns(&self, now: Duration) -> u64 {
        self.trial_start_ns
            .saturating_add(u64::try_from(self.chip_faults.chip_time(now).as_nanos()).unwrap_or(u64::MAX))
    }

    /// The trial time of an instant on the chip's clock, s; 0 before the trial.
    fn trial_seconds(&self, at_ns: u64) -> f64 {
        let since_start = Duration::from_nanos(at_ns.saturating_sub(self.trial_start_ns));
        self.chip_faults.trial_time(since_start).as_nanos() as f64 / 1e9
    }

    /// Runs to the trial time `now`. If virtual time is already later, shifts the trial, because
    /// the plate waits for the firmware.
    fn catch_up(&mut self, now: Duration) -> Result<(), TargetError> {
        let wanted = self.virtual_ns(now);
        let ahead = self.target.now_ns().saturating_sub(wanted);
        self.trial_start_ns += ahead;
        self.target.shift_records(ahead);
        self.run_to(wanted + ahead)
    }

    fn send_and_wait(&mut self, now: Duration, bytes: &[u8]) -> Result<Duration, TargetError> {
        self.catch_up(now)?;
        let (start_ns, instructions) = (self.target.now_ns(), self.target.instructions());
        let request = self.pending_requests.send(bytes);
        let asks = request != Request::None;
        self.target.set_control_step(request == Request::Sample);
        self.target.send(bytes);
        let arrived_ns = start_ns + bytes.len() as u64 * self.byte_ns;
        let timeout_ns = if asks { ANSWER_TIMEOUT_NS } else { OPTIONAL_ANSWER_TIMEOUT_NS };
        let until_ns = if self.chip_faults.is_active() {
            start_ns + self.chip_faults.plan.answer_timeout.as_nanos() as u64
        } else {
            arrived_ns + timeout_ns
        };
        let answered = self.run_until_answer(until_ns)?;
        self.instructions = answered.map(|_| self.target.instructions() - instructions);
        let sent_back = self.received.iter().filter(|received| received.at_ns > start_ns).count();
        let line_ns = (bytes.len() + sent_back) as u64 * self.byte_ns;
        let executed_ns = self.instructions.map(|count| self.target.nanoseconds_of(count));
        let exchange_ns = answered.map(|at_ns| at_ns - start_ns);
        self.computing_ns =
            executed_ns.zip(exchange_ns).map(|(executed, exchange)| computing_ns(executed, exchange, line_ns));
        match answered {
            Some(at_ns) => Ok(Duration::from_nanos(at_ns - start_ns)),
            None if !asks || self.chip_faults.is_active() => Ok(Duration::ZERO),
            None => {
                let waited_us = (self.target.now_ns() - arrived_ns) / 1_000;
                let answer = self.received.iter().filter(|received| received.at_ns > start_ns);
                let answer: Vec<u8> = answer.map(|received| received.byte).collect();
                let silent = || TargetError::Silent { waited_us, place: self.target.code_location() };
                let unanswered = rejected_answer(bytes, &answer).map_or_else(silent, TargetError::RejectedAnswer);
                Err(self.target.trap(StoppedAt::Body).unwrap_or(unanswered))
            }
        }
    }

    /// Runs `run`. After an error, returns that error until the restart.
    fn run_unless_failed<T>(
        &mut self,
        received: &mut Vec<u8>,
        run: impl FnOnce(&mut Self) -> Result<T, TargetError>,
    ) -> Result<T, LinkError> {
        if let Some(error) = &self.target_error {
            return Err(LinkError::Target(Box::new(error.clone())));
        }
        let result = catch_emulator_panic(|| run(self));
        received.extend(self.received.drain(..).map(|received| received.byte));
        result.map_err(|error| self.fail(error))
    }

    /// Results of the last call. `received` contains the bytes since its start.
    fn call_result(&self, delay: Duration, received: &[u8]) -> CallResult {
        let Self { instructions, computing_ns, .. } = *self;
        CallResult { received: received.to_vec(), delay, instructions, computing_ns }
    }

    fn play_again_as_words(&mut self, calls: Vec<(Call, CallResult)>) -> Result<(), LinkError> {
        let transport = std::mem::replace(&mut self.transport, Transport::Words);
        let restarted = self.restart();
        self.transport = transport;
        restarted?;
        for (call, expected) in calls {
            let mut received = Vec::new();
            let delay = match &call.sent {
                Some(bytes) => self.exchange(call.now, bytes, &mut received)?,
                None => self.advance_to(call.now, &mut received).map(|()| Duration::ZERO)?,
            };
            let result = self.call_result(delay, &received);
            if result != expected {
                let problem = format!(
                    "the message {} µs after the start of the trial has another answer, delay or instruction count if \
                     its words pass as a block; the processor is at {}",
                    call.now.as_micros(),
                    self.target.code_location()
                );
                return Err(self.fail(TargetError::Emulator(problem)));
            }
        }
        Ok(())
    }

    fn fail(&mut self, error: TargetError) -> LinkError {
        self.target_error = Some(error.clone());
        LinkError::Target(Box::new(error))
    }
}

fn hello() -> EncodedFrame {
    Packet { sequence: 0, message: Message::Hello }.encode()
}

/// Time of the instructions of an exchange, without those of firmware that polls the line during
/// its transmission.
fn computing_ns(executed_ns: u64, exchange_ns: u64, line_ns: u64) -> u64 {
    executed_ns.min(exchange_ns.saturating_sub(line_ns))
}

impl Link for EmulatedLink {
    fn exchange(&mut self, now: Duration, bytes: &[u8], answer: &mut Vec<u8>) -> Result<Duration, LinkError> {
        let start = answer.len();
        let result = self.run_unless_failed(answer, |emulated| emulated.send_and_wait(now, bytes));
        if self.calls.is_recording
            && let Ok(delay) = result
        {
            let result = self.call_result(delay, answer.get(start..).unwrap_or_default());
            self.calls.push(Call { now, sent: Some(bytes.to_vec()) }, result);
        }
        result
    }

    fn advance_to(&mut self, now: Duration, received: &mut Vec<u8>) -> Result<(), LinkError> {
        let start = received.len();
        let result = self.run_unless_failed(received, |emulated| emulated.run_to(emulated.virtual_ns(now)));
        if self.calls.is_recording && result.is_ok() {
            let result = self.call_result(Duration::ZERO, received.get(start..).unwrap_or_default());
            self.calls.push(Call { now, sent: None }, result);
        }
        result
    }

    fn restart(&mut self) -> Result<bool, LinkError> {
        // The state of a failed emulator may be invalid, so it is not restarted.
        if let Some(error @ TargetError::Emulator(_)) = &self.target_error {
            return Err(LinkError::Target(Box::new(error.clone())));
        }
        catch_emulator_panic(|| self.start()).map_err(|error| self.fail(error))?;
        Ok(true)
    }

    fn continue_trial(&mut self) {
        self.trial_start_ns = self.target.now_ns();
        self.target.start_records();
        // The history of the controller before the trial cannot be played again.
        self.calls.start(false);
    }

    fn chip(&mut self) -> Option<&mut dyn Chip> {
        Some(self)
    }
}

impl Chip for EmulatedLink {
    fn instruction_count(&self) -> Option<u64> {
        let (executed, computing_ns) = self.instructions.zip(self.computing_ns)?;
        Some(executed.min(self.target.instructions_in(computing_ns)))
    }

    fn baud(&self) -> u32 {
        Self::baud(self)
    }

    fn computing_time(&self) -> Option<Duration> {
        self.computing_ns.map(Duration::from_nanos)
    }

    fn amplifier_enabled(&mut self) -> Option<bool> {
        let enabled = self.target.amplifier_enabled();
        self.chip_faults.uses_amplifier |= enabled;
        self.chip_faults.uses_amplifier.then_some(enabled)
    }

    fn enable_pin(&self) -> EnablePin {
        let PinLog { was_high, low_since_ns, .. } = self.target.bus.enable_pin;
        EnablePin { was_high, low_from_s: low_since_ns.map(|at_ns| self.trial_seconds(at_ns)) }
    }

    fn firmware_output(&self) -> Option<String> {
        self.target.firmware_output()
    }

    fn firmware_output_reads(&self) -> Option<Vec<OutputRead>> {
        self.target.firmware_output_reads(|at_ns| self.trial_seconds(at_ns))
    }

    fn defmt_frames(&self) -> Option<Vec<u8>> {
        self.target.defmt_frames()
    }

    fn unmodelled_instances(&self) -> Vec<UnmodelledInstance> {
        self.target.unmodelled_instances()
    }

    fn is_fpu_unused(&self) -> bool {
        self.target.is_fpu_unused()
    }

    fn set_transport(&mut self, transport: Transport) {
        self.transport = transport;
    }

    fn transport(&self) -> Transport {
        match (self.target.has_used_blocks(), self.calls.is_checked) {
            (_, true) => Transport::BlocksAndWords,
            (true, false) => Transport::Blocks,
            (false, false) => Transport::Words,
        }
    }

    fn check_transport(&mut self) -> Result<(), LinkError> {
        let Some(calls) = self.calls.take() else { return Ok(()) };
        if self.target.has_used_blocks() && self.target_error.is_none() {
            self.play_again_as_words(calls)?;
            self.calls.is_checked = true;
        }
        Ok(())
    }

    fn set_faults(&mut self, plan: &ChipFaultPlan) -> Result<(), ChipFaultError> {
        plan.faults.iter().try_for_each(|fault| self.target.flipped_memory(&fault.kind).map(drop))?;
        self.chip_faults.plan = plan.clone();
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::computing_ns;

    #[test]
    fn polling_during_the_transmission_is_no_computing_time() {
        assert_eq!(computing_ns(20_000, 520_000, 480_000), 20_000, "the firmware slept during the transmission");
        assert_eq!(computing_ns(520_000, 520_000, 480_000), 40_000, "the firmware polled during the transmission");
        assert_eq!(computing_ns(1_100_000, 1_600_000, 480_000), 1_100_000, "a long step");
    }
}
