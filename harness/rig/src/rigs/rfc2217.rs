//! Connects to a serial port behind a network, sets it over Telnet (RFC 854, RFC 2217) and escapes
//! the byte 255 (IAC).

use super::serial::parse_port;
use super::tcp::{CONNECT_TIMEOUT, NetworkError, connect, parse_address};
use crate::cancel::CancelToken;
use crate::factory::{Argument, Capability, ConnectError, ConnectOptions, Rig, RigFactory, RigProperties};
use crate::link::{BoxedLink, LinkError};
use crate::port::Port;
use crate::rejected_bytes::quoted_text;
use crate::tty::{Tty, disconnected};
use crate::wait_budget::WaitBudget;
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
        let mut budget = WaitBudget::new(CONNECT_TIMEOUT);
        let line = connect(&self.address, &mut budget, &options.cancel)?;
        let port = Port::on_network(Rfc2217::start(line, &self.address, self.baud, budget, &options.cancel)?);
        Ok(Box::new(port.with_options(options)))
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
/// Largest stored length of the text that a server sends before it sets the port, bytes.
const MAX_TEXT: usize = 200;

/// A setting that the server answered with another value: names of the expected and the set value.
#[derive(Debug, Clone)]
struct RefusedSetting {
    expected: String,
    found: String,
}

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
    baud: u32,
    has_refused_option: bool,
    refused_setting: Option<RefusedSetting>,
    /// True after the server has set the baud rate, which is the last setting.
    is_set: bool,
}

impl Rfc2217 {
    fn start(
        line: OwnedFd,
        address: &str,
        baud: u32,
        mut budget: WaitBudget,
        cancel: &CancelToken,
    ) -> Result<Self, NetworkError> {
        let address = address.to_owned();
        let mut port = Self {
            line,
            state: TelnetState::Data,
            subnegotiation: Vec::with_capacity(MAX_SUBNEGOTIATION),
            unsent: VecDeque::new(),
            baud,
            has_refused_option: false,
            refused_setting: None,
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
        let (mut text, mut buffer) = (Vec::new(), [0; 256]);
        // The budget also ends a server that sends without a pause.
        while let Some(until) = budget.next_part(Instant::now()) {
            if cancel.is_cancelled() {
                return Err(NetworkError::Cancelled { address });
            }
            // A server that is in use sends its reason and closes the line, which the write notices first.
            let flushed = port.flush(until);
            let received = port.read_data(&mut buffer, until);
            if let Ok(Some(count)) = received {
                let free = MAX_TEXT.saturating_sub(text.len());
                text.extend(buffer.iter().take(count.min(free)));
            }
            if let Some(RefusedSetting { expected, found }) = port.refused_setting {
                return Err(NetworkError::Setting { address, expected, found });
            }
            if port.is_set {
                return Ok(port);
            }
            if port.has_refused_option {
                break;
            }
            let failed = if matches!(received, Ok(Some(_))) { Ok(()) } else { received.and(flushed.map(drop)) };
            failed.map_err(|source| {
                let address = address.clone();
                NetworkError::Settings { address, source, text: quoted_text(&text) }
            })?;
        }
        // A server that does not use Telnet does not answer.
        Err(NetworkError::NoPortOption { address, text: quoted_text(&text) })
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
        self.has_refused_option |= option == COM_PORT && matches!(command, DONT);
        match command {
            WILL if !is_requested => self.unsent.extend([IAC, DONT, option]),
            DO if !is_requested => self.unsent.extend([IAC, WONT, option]),
            _ => {}
        }
    }

    /// An answer contains the value that the server has set.
    fn finish_subnegotiation(&mut self) {
        let [COM_PORT, answer, value @ ..] = &self.subnegotiation[..] else { return };
        let (expected, found) = match (answer.wrapping_sub(ANSWER_OFFSET), value) {
            (SET_BAUDRATE, &[a, b, c, d]) => {
                let found = u32::from_be_bytes([a, b, c, d]);
                self.is_set = found == self.baud;
                (format!("{} baud", self.baud), format!("{found} baud"))
            }
            (SET_DATASIZE, &[bits]) => ("8 data bits".to_owned(), format!("{bits} data bits")),
            (SET_PARITY, &[parity]) => ("no parity".to_owned(), parity_name(parity)),
            (SET_STOPSIZE, &[stop]) => ("1 stop bit".to_owned(), stop_name(stop)),
            // Other values answer other requests of the command.
            (SET_CONTROL, [2]) => ("no flow control".to_owned(), "flow control by XON and XOFF".to_owned()),
            (SET_CONTROL, [3]) => ("no flow control".to_owned(), "flow control by RTS and CTS".to_owned()),
            _ => return,
        };
        if found != expected {
            self.refused_setting.get_or_insert(RefusedSetting { expected, found });
        }
    }

    fn read_data(&mut self, buffer: &mut [u8], until: Instant) -> Result<Option<usize>, LinkError> {
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
            // The next call reports an error. The bytes that arrived before it may name its reason.
            let _ = self.flush(Instant::now());
        }
        Ok(Some(decoded))
    }
}

fn parity_name(value: u8) -> String {
    match value {
        1 => "no parity".to_owned(),
        2 => "odd parity".to_owned(),
        3 => "even parity".to_owned(),
        other => format!("parity {other}"),
    }
}

fn stop_name(value: u8) -> String {
    match value {
        1 => "1 stop bit".to_owned(),
        2 => "2 stop bits".to_owned(),
        3 => "1.5 stop bits".to_owned(),
        other => format!("stop size {other}"),
    }
}

impl Tty for Rfc2217 {
    fn read(&mut self, buffer: &mut [u8], until: Instant) -> Result<Option<usize>, LinkError> {
        loop {
            let count = self.read_data(buffer, until)?;
            // The answer to a setting may come after that to the baud rate.
            if let Some(RefusedSetting { expected, found }) = &self.refused_setting {
                return Err(disconnected(format!("the server set {found} instead of {expected}")));
            }
            match count {
                Some(0) if Instant::now() < until => {}
                Some(0) => return Ok(None),
                count => return Ok(count),
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
    use crate::cancel::CancelToken;
    use crate::rigs::tcp::NetworkError;
    use crate::tty::Tty;
    use crate::wait_budget::WaitBudget;
    use rstest::rstest;
    use std::io::{Read, Write};
    use std::os::unix::net::UnixStream;
    use std::sync::mpsc::channel;
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
        (connect(line, Duration::from_secs(10), &CancelToken::never()), server, thread)
    }

    fn connect(line: UnixStream, limit: Duration, cancel: &CancelToken) -> Result<Rfc2217, NetworkError> {
        Rfc2217::start(line.into(), "host:1", 921_600, WaitBudget::new(limit), cancel)
    }

    /// Returns the error of a connection to a server that sends `x` without a pause.
    fn error_of_a_busy_server(limit: Duration, cancel: &CancelToken) -> NetworkError {
        let (line, mut server) = UnixStream::pair().unwrap();
        line.set_nonblocking(true).unwrap();
        thread::spawn(move || while server.write_all(&[b'x'; 4096]).is_ok() {});
        let (sender, ended) = channel();
        let cancel = cancel.clone();
        thread::spawn(move || sender.send(connect(line, limit, &cancel).map(drop)));
        ended.recv_timeout(Duration::from_mins(1)).expect("the wait does not end").unwrap_err()
    }

    #[test]
    fn a_server_that_never_pauses_reaches_the_deadline() {
        let error = error_of_a_busy_server(Duration::from_millis(200), &CancelToken::never());
        assert!(matches!(error, NetworkError::NoPortOption { .. }), "{error}");
        let text = error.to_string();
        let (_, quoted) = text.split_once("; the server sent ").unwrap();
        assert_eq!(quoted, format!("\"{}\"…", "x".repeat(80)));
    }

    #[test]
    fn a_cancellation_ends_the_negotiation() {
        let cancel = CancelToken::never();
        cancel.cancel();
        let error = error_of_a_busy_server(Duration::from_hours(1), &cancel);
        assert!(matches!(error, NetworkError::Cancelled { .. }), "{error}");
    }

    const fn setting(command: u8, value: u8) -> [u8; 7] {
        [IAC, SUBNEGOTIATION, COM_PORT, command, value, IAC, SUBNEGOTIATION_END]
    }

    #[rstest]
    #[case::eight_data_bits(setting(102, 8), None)]
    #[case::seven_data_bits(setting(102, 7), Some("host:1: the server set 7 data bits instead of 8 data bits"))]
    #[case::no_parity(setting(103, 1), None)]
    #[case::even_parity(setting(103, 3), Some("host:1: the server set even parity instead of no parity"))]
    #[case::one_stop_bit(setting(104, 1), None)]
    #[case::two_stop_bits(setting(104, 2), Some("host:1: the server set 2 stop bits instead of 1 stop bit"))]
    #[case::no_flow_control(setting(105, 1), None)]
    #[case::xon_xoff(setting(105, 2), Some("host:1: the server set flow control by XON and XOFF instead of"))]
    fn another_frame_format_is_refused(#[case] answer: [u8; 7], #[case] expected: Option<&str>) {
        let answers: &'static [u8] = [answer.as_slice(), ACCEPTED].concat().leak();
        let (line, server, _) = start(answers);
        let message = line.err().map(|error| error.to_string());
        assert_eq!(message.is_some(), expected.is_some(), "{message:?}");
        assert!(message.unwrap_or_default().starts_with(expected.unwrap_or_default()));
        drop(server);
        // The answer may also come after that to the baud rate.
        let (line, mut server, thread) = start(ACCEPTED);
        thread.join().unwrap();
        server.write_all(&answer).unwrap();
        drop(server);
        let error = line.unwrap().read(&mut [0; 64], deadline()).unwrap_err().to_string();
        assert_eq!(error.contains("the server set"), expected.is_some(), "{error}");
    }

    #[test]
    fn the_text_of_the_server_is_part_of_the_message() {
        let (line, server) = UnixStream::pair().unwrap();
        line.set_nonblocking(true).unwrap();
        (&server).write_all(b"Port already in use\r\n").unwrap();
        drop(server);
        let error = connect(line, Duration::from_secs(10), &CancelToken::never()).unwrap_err().to_string();
        assert!(error.ends_with("; the server sent \"Port already in use\""), "{error}");
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
        assert!(matches!(line, Err(NetworkError::Setting { .. })), "{line:?}");
        let (line, server) = UnixStream::pair().unwrap();
        line.set_nonblocking(true).unwrap();
        drop(server);
        let line = connect(line, Duration::from_secs(10), &CancelToken::never());
        assert!(matches!(line, Err(NetworkError::Settings { .. })), "{line:?}");
    }
}
