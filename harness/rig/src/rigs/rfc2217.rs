//! Connects to a serial port behind a network, sets it over Telnet (RFC 854, RFC 2217) and escapes
//! the byte 255 (IAC).

use super::serial::parse_port;
use super::tcp::{CONNECT_TIMEOUT, NetworkError, connect, parse_address};
use crate::factory::{Argument, Capability, ConnectError, ConnectOptions, Rig, RigFactory, RigProperties};
use crate::link::{BoxedLink, LinkError};
use crate::port::Port;
use crate::tty::Tty;
use platebench_model::record::ClockKind;
use rustix::fd::OwnedFd;
use std::collections::VecDeque;
use std::time::Instant;

pub(super) const RIG: RigFactory = RigFactory {
    name: "rfc2217",
    argument: Argument::Required("HOST:PORT[@BAUD]"),
    help: "a board on a serial port of a server, which the bench sets over Telnet",
    capabilities: &[Capability::RealPlate],
    parse: |text| {
        let (address, baud) = parse_port(text.unwrap_or_default())?;
        Ok(Box::new(Rfc2217Rig { address: parse_address(&address)?, baud }))
    },
};

#[derive(Debug)]
struct Rfc2217Rig {
    address: String,
    baud: u32,
}

impl Rig for Rfc2217Rig {
    fn properties(&self) -> RigProperties {
        RigProperties { default_clock: ClockKind::RealTime, baud: Some(self.baud), ..RigProperties::default() }
    }

    /// Sets the server's port to 8 data bits, no parity, 1 stop bit and no flow control.
    fn open(&self, options: &ConnectOptions) -> Result<BoxedLink, ConnectError> {
        let deadline = Instant::now() + CONNECT_TIMEOUT;
        let line = connect(&self.address, deadline)?;
        let port = Port::new(Rfc2217::start(line, &self.address, self.baud, deadline)?);
        Ok(Box::new(port.with_reply_timeout(options.reply_timeout)))
    }
}

const IAC: u8 = 255;
const DONT: u8 = 254;
const DO: u8 = 253;
const WONT: u8 = 252;
const WILL: u8 = 251;
const SUBNEGOTIATION: u8 = 250;
const SUBNEGOTIATION_END: u8 = 240;

const BINARY: u8 = 0;
const SUPPRESS_GO_AHEAD: u8 = 3;
const COM_PORT: u8 = 44;

const SET_BAUDRATE: u8 = 1;
const SET_DATASIZE: u8 = 2;
const SET_PARITY: u8 = 3;
const SET_STOPSIZE: u8 = 4;
const SET_CONTROL: u8 = 5;
const PURGE_DATA: u8 = 12;
/// A server answers a command with the number of the command plus this value.
const ANSWER_OFFSET: u8 = 100;

/// Largest stored length of a subnegotiation, bytes. Further bytes are dropped.
const MAX_SUBNEGOTIATION: usize = 64;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum TelnetState {
    Data,
    Command,
    /// Contains WILL, WONT, DO or DONT. The number of the option follows.
    Option(u8),
    Subnegotiation,
    SubnegotiationCommand,
}

#[derive(Debug)]
struct Rfc2217 {
    line: OwnedFd,
    state: TelnetState,
    subnegotiation: Vec<u8>,
    unsent: VecDeque<u8>,
    baud: Option<u32>,
    is_refused: bool,
    /// True after the server has set the baud rate. Until then, a read also ends if only Telnet
    /// commands arrived.
    is_set: bool,
}

impl Rfc2217 {
    fn start(line: OwnedFd, address: &str, baud: u32, deadline: Instant) -> Result<Self, NetworkError> {
        let settings = |source| NetworkError::Settings { address: address.to_owned(), source };
        let mut port = Self {
            line,
            state: TelnetState::Data,
            subnegotiation: Vec::with_capacity(MAX_SUBNEGOTIATION),
            unsent: VecDeque::new(),
            baud: None,
            is_refused: false,
            is_set: false,
        };
        for (command, option) in
            [(WILL, COM_PORT), (WILL, BINARY), (DO, BINARY), (WILL, SUPPRESS_GO_AHEAD), (DO, SUPPRESS_GO_AHEAD)]
        {
            port.unsent.extend([IAC, command, option]);
        }
        for (command, value) in [(SET_DATASIZE, 8), (SET_PARITY, 1), (SET_STOPSIZE, 1), (SET_CONTROL, 1)] {
            port.queue_setting(command, &[value]);
        }
        port.queue_setting(PURGE_DATA, &[3]);
        port.queue_setting(SET_BAUDRATE, &baud.to_be_bytes());
        let mut discarded = [0; 256];
        loop {
            port.flush(deadline).map_err(settings)?;
            match port.baud {
                Some(found) if found == baud => {
                    port.is_set = true;
                    return Ok(port);
                }
                Some(found) => {
                    return Err(NetworkError::Baud { address: address.to_owned(), expected: baud, found });
                }
                None if port.is_refused => return Err(NetworkError::NoPortOption { address: address.to_owned() }),
                None => {}
            }
            let received = port.read(&mut discarded, deadline).map_err(settings)?;
            if received.is_none() && Instant::now() >= deadline {
                // A server that does not use Telnet does not answer.
                return Err(NetworkError::NoPortOption { address: address.to_owned() });
            }
        }
    }

    fn queue_setting(&mut self, command: u8, value: &[u8]) {
        self.unsent.extend([IAC, SUBNEGOTIATION, COM_PORT, command]);
        for &byte in value {
            self.queue_data(byte);
        }
        self.unsent.extend([IAC, SUBNEGOTIATION_END]);
    }

    fn queue_data(&mut self, byte: u8) {
        self.unsent.push_back(byte);
        if byte == IAC {
            self.unsent.push_back(IAC);
        }
    }

    fn flush(&mut self, until: Instant) -> Result<bool, LinkError> {
        while !self.unsent.is_empty() {
            let (first, _) = self.unsent.as_slices();
            match Tty::write(&mut self.line, first, until)? {
                Some(count) => drop(self.unsent.drain(..count)),
                None => return Ok(false),
            }
        }
        Ok(true)
    }

    /// Returns a byte of the serial port; `None` for a byte of a Telnet command.
    fn decode(&mut self, byte: u8) -> Option<u8> {
        match (self.state, byte) {
            (TelnetState::Data, IAC) => self.state = TelnetState::Command,
            (TelnetState::Data, _) => return Some(byte),
            (TelnetState::Command, IAC) => {
                self.state = TelnetState::Data;
                return Some(IAC);
            }
            (TelnetState::Command, WILL | WONT | DO | DONT) => self.state = TelnetState::Option(byte),
            (TelnetState::Command, SUBNEGOTIATION) => {
                self.subnegotiation.clear();
                self.state = TelnetState::Subnegotiation;
            }
            (TelnetState::Command, _) => self.state = TelnetState::Data,
            (TelnetState::Option(command), option) => {
                self.state = TelnetState::Data;
                self.answer(command, option);
            }
            (TelnetState::Subnegotiation, IAC) => self.state = TelnetState::SubnegotiationCommand,
            (TelnetState::SubnegotiationCommand, SUBNEGOTIATION_END) => {
                self.state = TelnetState::Data;
                self.finish_subnegotiation();
            }
            (TelnetState::Subnegotiation | TelnetState::SubnegotiationCommand, _) => {
                self.state = TelnetState::Subnegotiation;
                if self.subnegotiation.len() < MAX_SUBNEGOTIATION {
                    self.subnegotiation.push(byte);
                }
            }
        }
        None
    }

    /// Refuses every option that [`Self::start`] has not requested.
    fn answer(&mut self, command: u8, option: u8) {
        let is_requested = matches!(option, BINARY | SUPPRESS_GO_AHEAD | COM_PORT);
        self.is_refused |= option == COM_PORT && matches!(command, DONT);
        match command {
            WILL if !is_requested => self.unsent.extend([IAC, DONT, option]),
            DO if !is_requested => self.unsent.extend([IAC, WONT, option]),
            _ => {}
        }
    }

    fn finish_subnegotiation(&mut self) {
        const BAUD_IS_SET: u8 = SET_BAUDRATE + ANSWER_OFFSET;
        if let [COM_PORT, BAUD_IS_SET, a, b, c, d] = self.subnegotiation[..] {
            self.baud = Some(u32::from_be_bytes([a, b, c, d]));
        }
    }
}

impl Tty for Rfc2217 {
    fn read(&mut self, buffer: &mut [u8], until: Instant) -> Result<Option<usize>, LinkError> {
        loop {
            let Some(count) = Tty::read(&mut self.line, buffer, until)? else { return Ok(None) };
            let mut decoded = 0;
            for index in 0..count {
                let data = buffer.get(index).and_then(|&byte| self.decode(byte));
                // `decoded` never passes `index`, so that no unread byte is overwritten.
                if let (Some(data), Some(place)) = (data, buffer.get_mut(decoded)) {
                    *place = data;
                    decoded += 1;
                }
            }
            if !self.unsent.is_empty() {
                self.flush(Instant::now())?;
            }
            if decoded > 0 {
                return Ok(Some(decoded));
            }
            if !self.is_set || Instant::now() >= until {
                return Ok(None);
            }
        }
    }

    fn write(&mut self, bytes: &[u8], until: Instant) -> Result<Option<usize>, LinkError> {
        // First sends the rest of an earlier message, because half a message is invalid.
        if !self.flush(until)? {
            return Ok(None);
        }
        for &byte in bytes {
            self.queue_data(byte);
        }
        self.flush(until)?;
        Ok(Some(bytes.len()))
    }
}

#[cfg(test)]
mod tests {
    use super::{COM_PORT, DO, DONT, IAC, Rfc2217, SUBNEGOTIATION, SUBNEGOTIATION_END, WILL};
    use crate::rigs::tcp::NetworkError;
    use crate::tty::Tty;
    use std::io::{Read, Write};
    use std::os::unix::net::UnixStream;
    use std::thread::{self, JoinHandle};
    use std::time::{Duration, Instant};

    fn deadline() -> Instant {
        Instant::now() + Duration::from_secs(10)
    }

    /// Starts a line whose server sends `answer`. Also returns the server's end and its thread.
    fn start(answer: &'static [u8]) -> (Result<Rfc2217, NetworkError>, UnixStream, JoinHandle<()>) {
        let (line, server) = UnixStream::pair().unwrap();
        line.set_nonblocking(true).unwrap();
        let mut sender = server.try_clone().unwrap();
        let thread = thread::spawn(move || sender.write_all(answer).unwrap());
        (Rfc2217::start(line.into(), "host:1", 921_600, deadline()), server, thread)
    }

    const ACCEPTED: &[u8] = &[
        IAC,
        DO,
        COM_PORT,
        b'x',
        IAC,
        SUBNEGOTIATION,
        COM_PORT,
        101,
        0,
        14,
        16,
        0,
        IAC,
        SUBNEGOTIATION_END,
        IAC,
        WILL,
        1,
    ];

    #[test]
    fn sets_the_port_and_escapes_data() {
        let (line, mut server, thread) = start(ACCEPTED);
        let mut line = line.unwrap();
        thread.join().unwrap();
        let mut sent = [0; 256];
        let count = server.read(&mut sent).unwrap();
        let sent = &sent[..count];
        assert!(sent.starts_with(&[IAC, WILL, COM_PORT]), "{sent:?}");
        let baud = [IAC, SUBNEGOTIATION, COM_PORT, 1, 0, 14, 16, 0, IAC, SUBNEGOTIATION_END];
        assert!(sent.windows(baud.len()).any(|bytes| bytes == baud), "{sent:?}");
        assert!(sent.ends_with(&[IAC, DONT, 1]) || sent.ends_with(&baud), "{sent:?}");

        assert_eq!(line.write(&[1, IAC, 2], deadline()).unwrap(), Some(3));
        let mut escaped = [0; 16];
        let count = server.read(&mut escaped).unwrap();
        assert!(escaped[..count].ends_with(&[1, IAC, IAC, 2]), "{:?}", &escaped[..count]);

        // The data contain an escaped 255 that is split between two writes, and a Telnet command (241).
        server.write_all(&[3, IAC]).unwrap();
        let mut received = Vec::new();
        let mut buffer = [0; 8];
        let count = line.read(&mut buffer, deadline()).unwrap().unwrap();
        received.extend_from_slice(&buffer[..count]);
        server.write_all(&[IAC, IAC, 241, 4]).unwrap();
        while received.len() < 3 {
            let count = line.read(&mut buffer, deadline()).unwrap().unwrap();
            received.extend_from_slice(&buffer[..count]);
        }
        assert_eq!(received, [3, IAC, 4]);
        assert_eq!(line.read(&mut buffer, Instant::now()).unwrap(), None);
    }

    #[test]
    fn refuses_a_server_that_sets_no_port_or_another_rate() {
        let (line, _server, _) = start(&[IAC, DONT, COM_PORT]);
        assert!(matches!(line, Err(NetworkError::NoPortOption { .. })), "{line:?}");
        let (line, _server, _) = start(&[IAC, SUBNEGOTIATION, COM_PORT, 101, 0, 0, 37, 128, IAC, SUBNEGOTIATION_END]);
        assert!(matches!(line, Err(NetworkError::Baud { found: 9_600, .. })), "{line:?}");
        let (line, server) = UnixStream::pair().unwrap();
        line.set_nonblocking(true).unwrap();
        drop(server);
        let line = Rfc2217::start(line.into(), "host:1", 9_600, deadline());
        assert!(matches!(line, Err(NetworkError::Settings { .. })), "{line:?}");
    }
}
