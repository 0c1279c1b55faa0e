//! Serves a debugger with GDB's remote protocol. While the chip is stopped, the plate waits, too.

use super::debug_control::DebugStop;
use super::machine::Machine;
use crate::cancel::CancelToken;
use crate::debug_port::{DebuggerError, POLL};
use gdbstub::common::Signal;
use gdbstub::stub::GdbStub;
use gdbstub::stub::state_machine::GdbStubStateMachine;
use std::fmt;
use std::io::{self, Read as _};
use std::net::TcpStream;
use std::time::{Duration, Instant};

/// If a debugger has stopped the chip and is silent for this time, the chip runs on.
const COMMAND_TIMEOUT: Duration = Duration::from_hours(1);

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
