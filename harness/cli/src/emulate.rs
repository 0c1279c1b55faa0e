//! `platebench emulate`: the plate alone, in real time, for somebody else's controller.

use crate::args::{Emulate, Pacing};
use crate::exit::Exit;
use crate::signals::Ended;
use crate::{live, output, signals};
use crossterm::terminal::{disable_raw_mode, enable_raw_mode};
use platebench_live::{INTERRUPT, Show, Subject, Teller, Told, View, watch_keys};
use platebench_plate::Time;
use platebench_rig::{AnyLink, Faulty, RigSpec, Session, Terminal};
use platebench_runner::real_time::{Consumer, Emulated, emulate as play};
use platebench_runner::trial::Order;
use platebench_runner::{Cancel, Hand, Held, Pace, Watch};
use platebench_scenario::{Scenario, load};
use platebench_trace::{Flags, Row};
use platebench_wire::LawId;
use std::io::{IsTerminal, stdin, stdout};
use std::sync::Arc;
use std::thread;
use std::time::{Duration, Instant};

/// Between two calls for a controller, and between two tries to open a port that is gone.
const CALL_EVERY: Duration = Duration::from_millis(500);
/// Between two status lines on a terminal, and elsewhere.
const SHOW_EVERY: [Duration; 2] = [Duration::from_millis(200), Duration::from_secs(1)];
const LOOK_EVERY: Duration = Duration::from_millis(20);
/// 100 days: whoever is at the plate ends it, not the scenario.
const ENDLESS: Time = Time::from_nanos(100 * 24 * 3_600_000_000_000);
const LIVE_KEYS: &str = "f/F finger  t/T plate  s/S setpoint  r release, cool down  q quit, plate at 0 V";
const KEYS: &str =
    "keys: f/F finger -/+ 0.25 N, t/T plate -/+ 1 K, s/S setpoint -/+ 0.1 µm, r release and cool down, q quit";

/// Emulates the plate until somebody ends it.
pub(crate) fn emulate(arguments: &Emulate) -> Exit {
    let scenario = match load(&arguments.scenario, &arguments.scenario.display().to_string()) {
        Ok(scenario) => scenario,
        Err(fault) => {
            output::diagnostic(&fault);
            return Exit::Invalid;
        }
    };
    let name = arguments.law.as_ref().unwrap_or(&scenario.controller.law);
    let Some(law) = LawId::from_name(name) else {
        output::error(&format!("unknown law `{name}`"));
        return Exit::Invalid;
    };
    let port = match Place::of(&arguments.port) {
        Ok(port) => port,
        Err(error) => {
            output::error(&error);
            return Exit::Invalid;
        }
    };
    let pace = Pace {
        time_scale: 1.0,
        pacing: match arguments.pacing {
            Pacing::Bench => platebench_runner::Pacing::Bench,
            Pacing::Target => platebench_runner::Pacing::Target,
        },
    };
    if let Some(Err(error)) =
        port.baud().map(|baud| platebench_rig::check_baud(baud, pace.wall(scenario.controller.period), 1.0))
    {
        output::error(&error.to_string());
        return Exit::Invalid;
    }
    let subject = Subject {
        command: "emulate",
        place: arguments.port.clone(),
        lockstep: false,
        jobs: 1,
        keys: LIVE_KEYS,
        shows: vec![Show::of(&scenario).endless()],
    };
    let (view, watch) = if arguments.live { live::open(subject) } else { Default::default() };
    let teller = view.as_ref().map(View::teller);
    let plate = Plate { scenario: endless(scenario), law, pace, teller, watch };
    let cancel = Cancel::default();
    let end = arguments.seconds.map(Duration::from_secs_f64);
    let emulating = {
        let cancel = cancel.clone();
        move || {
            let ended = plate.serve(&port, &cancel);
            // Also where it ended by itself: nobody is to wait for keys any more.
            cancel.cancel();
            ended
        }
    };
    // However this ends, the terminal is the user's again.
    let raw = view.is_none().then(Raw::enter);
    let ended = signals::until_signal(emulating, &cancel, end);
    drop((view, raw));
    match ended {
        Ok(Ended::Done(exit, None)) => exit,
        Ok(Ended::Done(_, Some(number)) | Ended::GivenUp(number)) => Exit::Signal(number),
        Err(error) => {
            output::error(&error.to_string());
            Exit::Inconclusive
        }
    }
}

/// A terminal that gives each key at once.
struct Raw;

impl Raw {
    /// `None` where nobody types.
    fn enter() -> Option<Self> {
        (stdin().is_terminal() && enable_raw_mode().is_ok()).then_some(Self)
    }
}

impl Drop for Raw {
    fn drop(&mut self) {
        // Where the terminal is gone there is nothing to give back.
        let _ = disable_raw_mode();
    }
}

/// The same scenario without an end and with a row per control instant.
fn endless(mut scenario: Scenario) -> Scenario {
    scenario.duration = ENDLESS;
    scenario.trace_step = ENDLESS;
    scenario.expectations.clear();
    scenario
}

/// Where the controller is to be found.
enum Place {
    /// A new pseudo-terminal.
    Terminal,
    Serial(RigSpec),
}

impl Place {
    fn of(port: &str) -> Result<Self, String> {
        if port == "pty" {
            return Ok(Self::Terminal);
        }
        format!("serial:{port}").parse().map(Self::Serial).map_err(|error: platebench_rig::SpecError| error.to_string())
    }

    fn baud(&self) -> Option<u32> {
        match self {
            Self::Terminal => None,
            Self::Serial(rig) => rig.baud(),
        }
    }

    /// The line, or how the program ends without it.
    fn open(&self, teller: Option<&Teller>) -> Result<AnyLink, Exit> {
        let refused = |error: &dyn std::fmt::Display, exit| {
            output::error(&error.to_string());
            exit
        };
        match self {
            Self::Terminal => {
                let terminal = Terminal::open().map_err(|error| refused(&error, Exit::Unreachable))?;
                match teller {
                    Some(teller) => teller.tell(Told::Place(terminal.path().to_owned())),
                    None => output::show(&format!("port: {}\n", terminal.path())),
                }
                Ok(Box::new(terminal))
            }
            Self::Serial(rig) => rig.connect_in_real_time().map_err(|error| {
                refused(&error, if error.is_invalid_input() { Exit::Invalid } else { Exit::Unreachable })
            }),
        }
    }
}

struct Plate {
    scenario: Scenario,
    law: LawId,
    pace: Pace,
    /// The live view, where there is one.
    teller: Option<Teller>,
    watch: Watch,
}

impl Plate {
    /// One controller after the other, until the end is asked for.
    fn serve(&self, port: &Place, cancel: &Cancel) -> Exit {
        let hand = Arc::new(Hand::default());
        let mut link = match port.open(self.teller.as_ref()) {
            Ok(link) => link,
            Err(exit) => return exit,
        };
        if stdin().is_terminal() {
            let held = Held { setpoint_um: self.scenario.setpoint.range().1, ..Held::default() };
            let (hand, cancel) = (Arc::clone(&hand), cancel.clone());
            // Not waited for: a terminal that hung up keeps it for ever. It ends with the program.
            if self.teller.is_none() {
                note(KEYS);
            }
            thread::spawn(move || take_keys(held, &hand, &cancel));
        }
        note("waiting for a controller");
        while !cancel.is_cancelled() {
            let called = Instant::now();
            let Ok(mut session) = Session::open(Faulty::new(&mut link)) else {
                // A port that is gone comes back as another one.
                if let Place::Serial(rig) = port {
                    link = rig.connect_in_real_time().unwrap_or(link);
                }
                thread::sleep(CALL_EVERY.saturating_sub(called.elapsed()));
                continue;
            };
            note(&format!("controller: {}", session.firmware_name()));
            let order = Order { scenario: &self.scenario, law: self.law, index: 0, wire_time: false, own_clock: true };
            loop {
                let mut lent = self.watch.lend(0, 0);
                // Whoever looks on has a queue of its own.
                let take = if self.teller.is_some() { ignore } else { show };
                match play(&mut session, &order, self.pace, cancel, &hand, lent.tap(), take) {
                    Emulated::Stopped(reason) => {
                        let reason = reason.as_deref().unwrap_or("no cause given");
                        note(&format!("the controller has stopped ({reason}); it is configured anew"));
                        thread::sleep(CALL_EVERY);
                    }
                    Emulated::Lost(error) => {
                        note(&format!("{error}; waiting for a controller"));
                        break;
                    }
                    Emulated::GivenUp => break,
                }
            }
        }
        Exit::Passed
    }
}

/// Shows the newest control instant now and then until there are no more.
fn show(mut rows: Consumer<Row>) {
    let terminal = stdout().is_terminal();
    let every = SHOW_EVERY[usize::from(!terminal)];
    let mut shown = Instant::now();
    let mut newest = None;
    loop {
        let is_over = rows.is_abandoned();
        while let Ok(row) = rows.pop() {
            if row.flags.contains(Flags::CONTROL) {
                newest = Some(row);
            }
        }
        if is_over {
            return;
        }
        if let Some(row) = newest.filter(|_| shown.elapsed() >= every) {
            shown = Instant::now();
            output::show(&if terminal { format!("\r\u{1b}[K{}", line(&row)) } else { format!("{}\n", line(&row)) });
        }
        thread::sleep(LOOK_EVERY);
    }
}

fn line(row: &Row) -> String {
    let flags: Vec<&str> = [
        (Flags::SATURATED, "saturated"),
        (Flags::SAFE, "0 V"),
        (Flags::LINK_LOST, "no reply"),
        (Flags::OVERRUN, "late"),
    ]
    .into_iter()
    .filter(|(flag, _)| row.flags.contains(*flag))
    .map(|(_, name)| name)
    .collect();
    format!(
        "{:9.3} s  |W| {:.3} of {:.3} µm  Wq {:+.3}  {:3.0} Vpp  {:.1} Hz ({:+.1})  {:.2} N  {:+.1} K  {:3.0} µs  {}",
        row.t_s,
        row.amplitude_um,
        row.setpoint_um,
        row.wq_um,
        row.drive_vpp,
        row.frequency_hz,
        row.frequency_hz - row.resonance_hz,
        row.finger_force_n,
        row.temperature_offset_k,
        row.lateness_us,
        flags.join(" ")
    )
}

/// Takes rows that are shown otherwise.
fn ignore(mut rows: Consumer<Row>) {
    while !rows.is_abandoned() {
        while rows.pop().is_ok() {}
        thread::sleep(LOOK_EVERY);
    }
}

/// Keys move the hand until the end.
fn take_keys(mut held: Held, hand: &Hand, cancel: &Cancel) {
    watch_keys(
        || cancel.is_cancelled(),
        |key| match key {
            // In a raw terminal Ctrl-C is a key.
            'q' | INTERRUPT => cancel.cancel(),
            letter if turned(&mut held, letter) => hand.hold(held),
            _ => {}
        },
    );
}

/// Beside the status line, which has no end of its own; a raw terminal does not go back to the left by itself.
fn note(text: &str) {
    output::note(&if stdin().is_terminal() { format!("\r\u{1b}[K{text}\r") } else { text.to_owned() });
}

/// What a key does; false where it does nothing.
fn turned(held: &mut Held, letter: char) -> bool {
    match letter {
        'f' => held.finger_force_n = (held.finger_force_n - 0.25).max(0.0),
        'F' => held.finger_force_n = (held.finger_force_n + 0.25).min(10.0),
        't' => held.temperature_offset_k = (held.temperature_offset_k - 1.0).max(-40.0),
        'T' => held.temperature_offset_k = (held.temperature_offset_k + 1.0).min(60.0),
        's' => held.setpoint_um = (held.setpoint_um - 0.1).max(0.0),
        'S' => held.setpoint_um = (held.setpoint_um + 0.1).min(10.0),
        'r' => {
            held.finger_force_n = 0.0;
            held.temperature_offset_k = 0.0;
        }
        _ => return false,
    }
    true
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn keys_move_one_thing_each_and_stop_at_the_ends() {
        let mut held = Held { setpoint_um: 2.0, ..Held::default() };
        for letter in "FFFfTTtS".chars() {
            assert!(turned(&mut held, letter));
        }
        assert_eq!(held, Held { setpoint_um: 2.1, temperature_offset_k: 1.0, finger_force_n: 0.5 });
        (0..100).for_each(|_| assert!(turned(&mut held, 'f') && turned(&mut held, 'S')));
        assert_eq!((held.finger_force_n, held.setpoint_um), (0.0, 10.0));
        assert!(turned(&mut held, 'r'));
        assert_eq!(held.temperature_offset_k, 0.0);
        assert!(!turned(&mut held, 'x'));
    }
}
