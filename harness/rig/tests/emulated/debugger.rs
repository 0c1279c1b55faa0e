//! Tests the debugger's connection with raw packets of GDB's remote protocol.

use super::{CONFIGURE, LoggedLink, PERIOD, firmware_under_test, open_logged, sample};
use object::{Object as _, ObjectSymbol as _};
use platebench_rig::{CancelToken, DebugPort, EmulatedLink, Session};
use std::io::{Read as _, Write as _};
use std::net::TcpStream;
use std::thread::{self, JoinHandle};
use std::time::Duration;

/// Address of the vector of USART2, whose interrupt ends a frame (RM0090, table 62).
const USART2_VECTOR: u32 = 0x0800_0000 + 4 * (16 + 38);
const RESET_VECTOR: u32 = 0x0800_0004;
const SAMPLES: u32 = 20;

struct Client(TcpStream);

impl Client {
    fn connect(port: &DebugPort) -> Self {
        let stream = TcpStream::connect(("127.0.0.1", port.number())).unwrap();
        stream.set_read_timeout(Some(Duration::from_mins(2))).unwrap();
        Self(stream)
    }

    fn send(&mut self, body: &str) {
        let sum = body.bytes().fold(0_u8, u8::wrapping_add);
        write!(self.0, "${body}#{sum:02x}").unwrap();
    }

    fn receive(&mut self) -> String {
        let mut byte = || {
            let mut one = [0];
            self.0.read_exact(&mut one).unwrap();
            one[0]
        };
        while byte() != b'$' {}
        let body: Vec<u8> = std::iter::from_fn(|| Some(byte()).filter(|&byte| byte != b'#')).collect();
        let _sum = [byte(), byte()];
        self.0.write_all(b"+").unwrap();
        expand_runs(&String::from_utf8(body).unwrap())
    }

    fn ask(&mut self, body: &str) -> String {
        self.send(body);
        self.receive()
    }

    fn resume(&mut self, body: &str) -> String {
        let stop = self.ask(body);
        assert!(stop.starts_with(['S', 'T']), "{stop}");
        stop[1..3].to_owned()
    }

    fn word(&mut self, address: u32) -> u32 {
        little_endian(&self.ask(&format!("m{address:x},4")))
    }

    fn pc(&mut self) -> u32 {
        let registers = self.ask("g");
        assert_eq!(registers.len(), 16 * 8, "{registers}");
        little_endian(&registers[15 * 8..])
    }
}

/// Expands run-length encoding. `0*~` is `0` and 97 repetitions, because `~` is 126 and the
/// protocol adds 29.
fn expand_runs(body: &str) -> String {
    let mut expanded = String::new();
    let mut characters = body.chars();
    while let Some(character) = characters.next() {
        match (character, expanded.chars().next_back()) {
            ('*', Some(repeated)) => {
                let count = characters.next().unwrap() as usize - 29;
                expanded.extend(std::iter::repeat_n(repeated, count));
            }
            _ => expanded.push(character),
        }
    }
    expanded
}

fn little_endian(hexadecimal: &str) -> u32 {
    u32::from_str_radix(hexadecimal, 16).unwrap().swap_bytes()
}

fn debugger(port: &DebugPort, session: impl FnOnce(Client) + Send + 'static) -> JoinHandle<()> {
    let port = port.clone();
    thread::spawn(move || session(Client::connect(&port)))
}

fn open(port: &DebugPort, image: Option<&str>) -> EmulatedLink {
    let elf = image.map(|name| firmware_under_test().join("images").join(name));
    EmulatedLink::open_with_debugger(elf.as_deref(), port, &CancelToken::never()).unwrap()
}

fn play(session: &mut Session<LoggedLink<EmulatedLink>>) {
    session.start_trial(&CONFIGURE).unwrap();
    for index in 0..SAMPLES {
        session.send_sample(index * PERIOD, &sample(2.0, 0.1 * index as f32)).unwrap();
    }
}

#[test]
fn stops_and_steps_change_no_answer_and_no_instant() {
    let (mut session, log) = open_logged(EmulatedLink::built_in().unwrap());
    play(&mut session);
    let expected = log.lock().unwrap().clone();

    let port = DebugPort::bind(0).unwrap();
    let client = debugger(&port, |mut client| {
        assert_eq!(client.resume("?"), "05");
        let reset = client.word(RESET_VECTOR) & !1;
        assert_eq!(client.pc(), reset);
        assert_eq!(client.resume("s"), "05");
        assert_ne!(client.pc(), reset);
        let handler = client.word(USART2_VECTOR) & !1;
        assert_eq!(client.ask(&format!("Z0,{handler:x},2")), "OK");
        for _ in 0..5 {
            assert!(client.ask("c").ends_with("swbreak:;"));
            assert_eq!(client.pc(), handler);
            assert_eq!(client.resume("s"), "05");
            assert_ne!(client.pc(), handler);
        }
        assert_eq!(client.ask(&format!("z0,{handler:x},2")), "OK");
        client.send("c");
        client.0.write_all(&[0x03]).unwrap();
        assert_eq!(&client.receive()[1..3], "02");
        assert_eq!(client.ask("D"), "OK");
    });
    let (mut session, log) = open_logged(open(&port, None));
    play(&mut session);
    assert_eq!(*log.lock().unwrap(), expected);
    for index in SAMPLES.. {
        if client.is_finished() {
            break;
        }
        session.advance_to(index * PERIOD).unwrap();
    }
    client.join().unwrap();
}

/// Address and size of the state of the controller, which every message changes.
fn controller_state() -> (u64, u64) {
    let elf = super::image("platebench-stm32f4.elf");
    let file = object::File::parse(&*elf).unwrap();
    let symbol = file.symbols().find(|symbol| symbol.name().is_ok_and(|name| name.contains("CONTROLLER"))).unwrap();
    (symbol.address(), symbol.size())
}

#[test]
fn serves_hardware_breakpoints_watchpoints_and_a_reset() {
    let port = DebugPort::bind(0).unwrap();
    let client = debugger(&port, |mut client| {
        let reset = client.word(RESET_VECTOR) & !1;
        let handler = client.word(USART2_VECTOR) & !1;
        assert_eq!(client.ask(&format!("Z1,{handler:x},2")), "OK");
        let stop = client.ask("c");
        assert!(stop.ends_with("hwbreak:;"), "{stop}");
        assert_eq!(client.pc(), handler);
        assert_eq!(client.ask(&format!("z1,{handler:x},2")), "OK");
        // "monitor reset halt" and "monitor halt" in hexadecimal.
        client.send("qRcmd,72657365742068616c74");
        assert!(client.receive().starts_with('O'));
        assert_eq!(client.receive(), "OK");
        assert_eq!(client.pc(), reset);
        client.send("qRcmd,68616c74");
        assert!(client.receive().starts_with('O'));
        assert_eq!(client.receive(), "OK");

        let (start, size) = controller_state();
        assert_eq!(client.ask(&format!("Z2,{start:x},{size:x}")), "OK");
        let stop = client.ask("c");
        let at = stop.split_once(";watch:").unwrap_or_else(|| panic!("{stop}")).1.trim_end_matches(';');
        let at = u64::from_str_radix(at, 16).unwrap();
        assert!((start..start + size).contains(&at), "{stop}");
        assert_eq!(client.ask(&format!("z2,{start:x},{size:x}")), "OK");
        // Status register of USART2, which the handler reads.
        assert_eq!(client.ask("Z3,40004400,4"), "OK");
        let stop = client.ask("c");
        assert!(stop.contains("rwatch:40004400"), "{stop}");
        assert_eq!(client.ask("z3,40004400,4"), "OK");

        assert_eq!(client.ask("D"), "OK");
    });
    // The handshake begins again after the reset, which counts as none of the firmware.
    let mut session = Session::open(open(&port, None)).unwrap();
    session.start_trial(&CONFIGURE).unwrap();
    assert!(session.send_sample(Duration::ZERO, &sample(2.0, 0.0)).unwrap().is_some());
    client.join().unwrap();
}

#[test]
fn the_chip_runs_on_without_a_debugger_that_goes() {
    let port = DebugPort::bind(0).unwrap();
    let client = debugger(&port, |mut client| {
        let reset = client.word(RESET_VECTOR) & !1;
        assert_eq!(client.ask(&format!("Z0,{reset:x},2")), "OK");
    });
    assert_eq!(open(&port, None).baud(), 1_000_000);
    client.join().unwrap();
}

#[test]
fn shows_a_trap_to_the_debugger_before_the_trial_ends() {
    let port = DebugPort::bind(0).unwrap();
    let client = debugger(&port, |mut client| {
        assert_eq!(client.resume("c"), "0b");
        client.send("c");
    });
    let mut session = Session::open(open(&port, Some("planted-faults.elf"))).unwrap();
    session.start_trial(&CONFIGURE).unwrap();
    let error = session.send_sample(Duration::ZERO, &sample(902.0, 0.0)).unwrap_err().to_string();
    assert!(error.contains("division by zero"), "{error}");
    client.join().unwrap();
}
