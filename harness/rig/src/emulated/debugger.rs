//! Serves a debugger with GDB's remote protocol. While the chip is stopped, the plate waits, too.

use super::bus::Watchpoint;
use super::machine::{BreakpointKind as Kind, DebugStop, Machine};
use crate::cancel::CancelToken;
use crate::debug_port::{DebuggerError, POLL};
use gdbstub::arch::{Arch, RegId, Registers};
use gdbstub::common::Signal;
use gdbstub::stub::GdbStub;
use gdbstub::stub::state_machine::GdbStubStateMachine;
use gdbstub::target::ext::base::BaseOps;
use gdbstub::target::ext::base::single_register_access::{SingleRegisterAccess, SingleRegisterAccessOps};
use gdbstub::target::ext::base::singlethread::{
    SingleThreadBase, SingleThreadResume, SingleThreadResumeOps, SingleThreadSingleStep, SingleThreadSingleStepOps,
};
use gdbstub::target::ext::breakpoints::{
    Breakpoints, BreakpointsOps, HwBreakpoint, HwBreakpointOps, HwWatchpoint, HwWatchpointOps, SwBreakpoint,
    SwBreakpointOps, WatchKind,
};
use gdbstub::target::ext::monitor_cmd::{ConsoleOutput, MonitorCmd, MonitorCmdOps, outputln};
use gdbstub::target::ext::target_description_xml_override::{
    TargetDescriptionXmlOverride, TargetDescriptionXmlOverrideOps,
};
use gdbstub::target::{Target, TargetError, TargetResult};
use rigless::emulator::Queued;
use rigless::soc::Width;
use std::convert::Infallible;
use std::io::Read as _;
use std::net::TcpStream;
use std::num::NonZeroUsize;
use std::time::{Duration, Instant};
use std::{fmt, io};

/// If a debugger has stopped the chip and is silent for this time, the chip runs on.
const COMMAND_TIMEOUT: Duration = Duration::from_hours(1);

const MAX_WATCHPOINTS: usize = 64;

type Stub = GdbStubStateMachine<'static, Machine, TcpStream>;

pub(super) struct Debugger {
    stub: Option<Stub>,
    stream: TcpStream,
    cancel: CancelToken,
}

impl fmt::Debug for Debugger {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.debug_struct("Debugger").field("attached", &self.stub.is_some()).finish_non_exhaustive()
    }
}

impl Debugger {
    /// The chip waits before its first instruction until the debugger lets it run.
    pub(super) fn attach(
        stream: TcpStream,
        machine: &mut Machine,
        cancel: &CancelToken,
    ) -> Result<Self, DebuggerError> {
        stream.set_nonblocking(false)?;
        stream.set_nodelay(true)?;
        stream.set_read_timeout(Some(POLL))?;
        stream.set_write_timeout(Some(COMMAND_TIMEOUT))?;
        let own = stream.try_clone()?;
        let stub = GdbStub::new(stream).run_state_machine(machine);
        let stub = stub.map_err(|error| DebuggerError::Connection(error.to_string()))?;
        Ok(Self { stub: Some(stub), stream: own, cancel: cancel.clone() })
    }

    /// Reports `stop` to the debugger and handles its requests until the chip may run.
    pub(super) fn serve(&mut self, machine: &mut Machine, mut stop: Option<DebugStop>) {
        let mut deadline = Instant::now() + COMMAND_TIMEOUT;
        while let Some(stub) = self.stub.take() {
            let next = match stub {
                GdbStubStateMachine::Running(running) => match stop.take() {
                    Some(stop) => running.report_stop(machine, stop),
                    None => match self.pending_byte() {
                        Ok(Some(byte)) => running.incoming_data(machine, byte),
                        Ok(None) => {
                            self.stub = Some(running.into());
                            return;
                        }
                        Err(_) => break,
                    },
                },
                GdbStubStateMachine::CtrlCInterrupt(interrupt) => {
                    interrupt.interrupt_handled(machine, Some(DebugStop::Signal(Signal::SIGINT)))
                }
                GdbStubStateMachine::Idle(idle) => {
                    if self.cancel.is_cancelled() || Instant::now() > deadline {
                        break;
                    }
                    let mut byte = [0];
                    match self.stream.read(&mut byte) {
                        Ok(0) => break,
                        Ok(_) => {
                            deadline = Instant::now() + COMMAND_TIMEOUT;
                            let [byte] = byte;
                            idle.incoming_data(machine, byte)
                        }
                        Err(error) if is_timeout(&error) => Ok(idle.into()),
                        Err(_) => break,
                    }
                }
                GdbStubStateMachine::Disconnected(_) => break,
            };
            self.stub = next.ok();
        }
        machine.end_debugging();
    }

    fn pending_byte(&mut self) -> io::Result<Option<u8>> {
        self.stream.set_nonblocking(true)?;
        let mut byte = [0];
        let read = self.stream.read(&mut byte);
        self.stream.set_nonblocking(false)?;
        match read {
            Ok(0) => Err(io::ErrorKind::UnexpectedEof.into()),
            Ok(_) => Ok(byte.first().copied()),
            Err(error) if is_timeout(&error) => Ok(None),
            Err(error) => Err(error),
        }
    }
}

fn is_timeout(error: &io::Error) -> bool {
    matches!(error.kind(), io::ErrorKind::WouldBlock | io::ErrorKind::TimedOut | io::ErrorKind::Interrupted)
}

/// Number of the registers r0 to r12, sp, lr and pc. The debugger requests others one by one.
const GENERAL_REGISTERS: usize = 16;
const PC_OFFSET: usize = 60;

#[derive(Debug)]
pub(super) struct CortexM;

impl Arch for CortexM {
    type Usize = u32;
    type Registers = GeneralRegisters;
    type BreakpointKind = usize;
    type RegId = RegisterNumber;
}

#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub(super) struct GeneralRegisters(Vec<u8>);

impl Registers for GeneralRegisters {
    type ProgramCounter = u32;

    fn pc(&self) -> u32 {
        self.0.get(PC_OFFSET..).and_then(<[u8]>::first_chunk).map_or(0, |bytes| u32::from_le_bytes(*bytes))
    }

    fn gdb_serialize(&self, mut write_byte: impl FnMut(Option<u8>)) {
        self.0.iter().for_each(|byte| write_byte(Some(*byte)));
    }

    fn gdb_deserialize(&mut self, bytes: &[u8]) -> Result<(), ()> {
        self.0 = bytes.to_vec();
        Ok(())
    }
}

#[derive(Debug)]
pub(super) struct RegisterNumber(usize);

impl RegId for RegisterNumber {
    fn from_raw_id(id: usize) -> Option<(Self, Option<NonZeroUsize>)> {
        Some((Self(id), None))
    }
}

impl Machine {
    fn read_memory(&mut self, start: u32, length: usize) -> Option<Vec<u8>> {
        if let Some(bytes) = self.bus.memory.slice(u64::from(start), length) {
            return Some(bytes.to_vec());
        }
        // Other addresses belong to registers of the processor, such as SCB and NVIC.
        let now = self.bus.time_at(self.core.retired());
        let read = |at| self.core.debugger_access(None, at, Width::W32, now);
        let words: Option<Vec<u64>> = (u64::from(start)..).step_by(4).take(length.div_ceil(4)).map(read).collect();
        let mut bytes: Vec<u8> = words?.iter().flat_map(|word| (*word as u32).to_le_bytes()).collect();
        bytes.truncate(length);
        Some(bytes)
    }

    fn resume_from_stop(&mut self, single_step: bool) {
        self.debug.single_step = single_step;
        let pc = self.core.pc();
        if self.debug.has_breakpoint(pc) {
            self.core.pass_breakpoint(pc);
        }
    }

    pub(super) fn end_debugging(&mut self) {
        self.resume_from_stop(false);
        self.debug.end(&mut *self.core);
        for watchpoint in std::mem::take(&mut self.bus.watchpoints) {
            self.route(&watchpoint, false);
        }
    }

    /// Sends the processor's accesses to the pages of the watched bytes over the bus, or no longer.
    fn route(&mut self, watchpoint: &Watchpoint, over_bus: bool) {
        let page = self.core.page_size().max(1);
        let (start, end) = (watchpoint.start / page * page, watchpoint.start + watchpoint.length);
        for at in (start..end).step_by(usize::try_from(page).unwrap_or(usize::MAX)) {
            let others =
                self.bus.watchpoints.iter().any(|other| other.start < at + page && at < other.start + other.length);
            if over_bus || !others {
                self.core.ask(if over_bus { Queued::Route(at) } else { Queued::Unroute(at) });
            }
        }
    }
}

impl Target for Machine {
    type Arch = CortexM;
    type Error = Infallible;

    fn base_ops(&mut self) -> BaseOps<'_, CortexM, Infallible> {
        BaseOps::SingleThread(self)
    }

    fn support_breakpoints(&mut self) -> Option<BreakpointsOps<'_, Self>> {
        Some(self)
    }

    fn support_monitor_cmd(&mut self) -> Option<MonitorCmdOps<'_, Self>> {
        Some(self)
    }

    fn support_target_description_xml_override(&mut self) -> Option<TargetDescriptionXmlOverrideOps<'_, Self>> {
        Some(self)
    }
}

impl SingleThreadBase for Machine {
    fn read_registers(&mut self, registers: &mut GeneralRegisters) -> TargetResult<(), Self> {
        registers.0 =
            (0..GENERAL_REGISTERS).flat_map(|number| self.core.gdb_register(number).unwrap_or_default()).collect();
        Ok(())
    }

    fn write_registers(&mut self, registers: &GeneralRegisters) -> TargetResult<(), Self> {
        let all = registers.0.chunks_exact(4).take(GENERAL_REGISTERS).enumerate();
        let written = all.fold(true, |written, (number, bytes)| self.core.set_gdb_register(number, bytes) && written);
        if written { Ok(()) } else { Err(TargetError::NonFatal) }
    }

    fn support_single_register_access(&mut self) -> Option<SingleRegisterAccessOps<'_, (), Self>> {
        Some(self)
    }

    fn read_addrs(&mut self, start: u32, data: &mut [u8]) -> TargetResult<usize, Self> {
        let bytes = self.read_memory(start, data.len()).ok_or(TargetError::NonFatal)?;
        data.copy_from_slice(&bytes);
        Ok(data.len())
    }

    fn write_addrs(&mut self, start: u32, data: &[u8]) -> TargetResult<(), Self> {
        if self.patch(start, data) { Ok(()) } else { Err(TargetError::NonFatal) }
    }

    fn support_resume(&mut self) -> Option<SingleThreadResumeOps<'_, Self>> {
        Some(self)
    }
}

impl SingleRegisterAccess<()> for Machine {
    fn read_register(&mut self, (): (), number: RegisterNumber, data: &mut [u8]) -> TargetResult<usize, Self> {
        let bytes = self.core.gdb_register(number.0).ok_or(TargetError::NonFatal)?;
        data.get_mut(..bytes.len()).ok_or(TargetError::NonFatal)?.copy_from_slice(&bytes);
        Ok(bytes.len())
    }

    fn write_register(&mut self, (): (), number: RegisterNumber, data: &[u8]) -> TargetResult<(), Self> {
        if self.core.set_gdb_register(number.0, data) { Ok(()) } else { Err(TargetError::NonFatal) }
    }
}

impl SingleThreadResume for Machine {
    fn resume(&mut self, _signal: Option<Signal>) -> Result<(), Infallible> {
        self.resume_from_stop(false);
        Ok(())
    }

    fn support_single_step(&mut self) -> Option<SingleThreadSingleStepOps<'_, Self>> {
        Some(self)
    }
}

impl SingleThreadSingleStep for Machine {
    fn step(&mut self, _signal: Option<Signal>) -> Result<(), Infallible> {
        self.resume_from_stop(true);
        Ok(())
    }
}

impl Breakpoints for Machine {
    fn support_sw_breakpoint(&mut self) -> Option<SwBreakpointOps<'_, Self>> {
        Some(self)
    }

    fn support_hw_breakpoint(&mut self) -> Option<HwBreakpointOps<'_, Self>> {
        Some(self)
    }

    fn support_hw_watchpoint(&mut self) -> Option<HwWatchpointOps<'_, Self>> {
        Some(self)
    }
}

impl HwBreakpoint for Machine {
    fn add_hw_breakpoint(&mut self, address: u32, _kind: usize) -> TargetResult<bool, Self> {
        Ok(self.debug.add(u64::from(address), Kind::Hardware, &mut *self.core))
    }

    fn remove_hw_breakpoint(&mut self, address: u32, _kind: usize) -> TargetResult<bool, Self> {
        Ok(self.debug.remove(u64::from(address), Kind::Hardware, &mut *self.core))
    }
}

impl HwWatchpoint for Machine {
    fn add_hw_watchpoint(&mut self, address: u32, length: u32, kind: WatchKind) -> TargetResult<bool, Self> {
        let watchpoint = Watchpoint { start: u64::from(address), length: u64::from(length), kind };
        if length == 0 || self.bus.watchpoints.len() >= MAX_WATCHPOINTS {
            return Ok(false);
        }
        self.route(&watchpoint, true);
        self.bus.watchpoints.push(watchpoint);
        Ok(true)
    }

    fn remove_hw_watchpoint(&mut self, address: u32, length: u32, kind: WatchKind) -> TargetResult<bool, Self> {
        let watchpoint = Watchpoint { start: u64::from(address), length: u64::from(length), kind };
        let Some(index) = self.bus.watchpoints.iter().position(|other| *other == watchpoint) else { return Ok(false) };
        self.bus.watchpoints.remove(index);
        self.route(&watchpoint, false);
        Ok(true)
    }
}

/// Commands after `monitor`. The chip is stopped whenever a command arrives.
impl MonitorCmd for Machine {
    fn handle_monitor_cmd(&mut self, command: &[u8], mut out: ConsoleOutput<'_>) -> Result<(), Infallible> {
        match command {
            b"halt" => outputln!(out, "the chip is stopped"),
            b"reset" | b"reset halt" | b"reset init" => {
                self.reset_by_debugger();
                outputln!(out, "the chip is at its reset vector, stopped");
            }
            _ => outputln!(out, "unknown command; expected: halt, reset, reset halt"),
        }
        Ok(())
    }
}

impl SwBreakpoint for Machine {
    fn add_sw_breakpoint(&mut self, address: u32, _kind: usize) -> TargetResult<bool, Self> {
        Ok(self.debug.add(u64::from(address), Kind::Software, &mut *self.core))
    }

    fn remove_sw_breakpoint(&mut self, address: u32, _kind: usize) -> TargetResult<bool, Self> {
        Ok(self.debug.remove(u64::from(address), Kind::Software, &mut *self.core))
    }
}

impl TargetDescriptionXmlOverride for Machine {
    fn target_description_xml(
        &self,
        annex: &[u8],
        offset: u64,
        length: usize,
        buffer: &mut [u8],
    ) -> TargetResult<usize, Self> {
        if annex != b"target.xml" {
            return Err(TargetError::NonFatal);
        }
        let rest = self.core.target_xml().as_bytes().get(offset as usize..).unwrap_or_default();
        let count = rest.len().min(length).min(buffer.len());
        for (to, from) in buffer.iter_mut().zip(rest).take(count) {
            *to = *from;
        }
        Ok(count)
    }
}
