//! `platebench plate`: emulates the plate in real time for another controller, or exports it.

use crate::board::{BoardArgs, release};
use crate::exit::{CommandResult, Exit, Failure, OrInvalid};
use crate::options::{PacingArg, bench_law_names, parse_seconds};
use crate::selection::{warn_of_plate, warn_of_scenarios};
use crate::shutdown::{EventSender, run_until_signal, unless_signalled};
use crate::{run_plan, stdio};
use clap::{Args, Subcommand};
use crossterm::terminal::{disable_raw_mode, enable_raw_mode};
use platebench_engine::real_time::{Consumer, EmulationEnd, emulate_plate as play};
use platebench_engine::{CancelToken, Clock, LiveTap, ManualControl, ManualInputs, RunPlan, TimeBase, Trial};
#[cfg(feature = "export")]
use platebench_fmi::find_library;
use platebench_lab::boards::BoardOutcome;
use platebench_model::record::Overrides;
use platebench_model::scenario::load::load_plate;
use platebench_model::scenario::{Scenario, load, read_text};
use platebench_model::trace::{Flags, Row};
use platebench_model::{quoted, quoted_path};
use platebench_plate::Time;
use platebench_report::live::{INTERRUPT, LiveView, RunDescription, ViewSender, watch_keys};
use platebench_rig::{
    BoxedLink, Capability, FaultInjector, PtyLink, RigSpec, SafeEnd, Session, check_baud, rig_syntaxes,
};
use platebench_wire::LawId;
use std::io::{IsTerminal, stdin, stdout};
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::{Duration, Instant};

#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  platebench plate serve --port pty
  platebench plate fmu scenarios/plates/aluminium-198x138.toml --out plate.fmu")]
pub(crate) struct PlateArgs {
    #[command(subcommand)]
    action: PlateAction,
}

#[derive(Debug, Subcommand)]
enum PlateAction {
    /// Emulate the plate alone, in real time, for another controller
    Serve(ServeArgs),
    /// Export a plate as an FMU (FMI 3.0) for other simulators
    #[cfg(feature = "export")]
    Fmu(FmuArgs),
}

pub(crate) fn plate(arguments: &PlateArgs) -> CommandResult {
    match &arguments.action {
        PlateAction::Serve(arguments) => serve(arguments),
        #[cfg(feature = "export")]
        PlateAction::Fmu(arguments) => export_fmu(arguments),
    }
}

#[cfg(feature = "export")]
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  platebench plate fmu scenarios/plates/aluminium-198x138.toml --out plate.fmu

Exit codes: 0 written, 2 invalid input, no shared library, or the file exists already")]
struct FmuArgs {
    /// The plate file
    plate: PathBuf,
    /// The FMU (FMI 3.0, co-simulation), see docs/fmi.md. No file is overwritten
    #[arg(long, value_name = "FILE", value_parser = stdio::parse_named_file)]
    out: PathBuf,
    /// Shared library of the plate; default: the one that a released
    /// program contains, else next to this program, or in ../lib/platebench
    #[arg(long, value_name = "FILE")]
    library: Option<PathBuf>,
}

/// Shared library that `ci/release` builds first and names in `PLATEBENCH_FMI_LIBRARY`; empty in
/// other builds, whose library Cargo makes next to the program.
#[cfg(feature = "export")]
const EMBEDDED_LIBRARY: &[u8] = include_bytes!(concat!(env!("OUT_DIR"), "/libplatebench_fmi.so"));

#[cfg(feature = "export")]
fn export_fmu(arguments: &FmuArgs) -> CommandResult {
    let plate = load_plate(&arguments.plate)?;
    warn_of_plate(&arguments.plate, &plate);
    let text = read_text(&arguments.plate)?;
    let program = std::env::current_exe().unwrap_or_default();
    let library = find_library(arguments.library.as_deref(), EMBEDDED_LIBRARY, &program).or_invalid()?;
    let title = arguments.plate.file_stem().unwrap_or_default().to_string_lossy();
    platebench_fmi::write(&plate, &text, &title, &library, &arguments.out).or_invalid()?;
    stdio::show(&format!("{}\n", quoted_path(&arguments.out)));
    Ok(Exit::Passed)
}

#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  platebench plate serve --port pty                     prints the path of the pseudo-terminal and waits there
  platebench plate serve --port /dev/ttyUSB0@921600 --scenario scenarios/paper/force-ramp.toml")]
struct ServeArgs {
    /// Port of the controller: PORT[@BAUD], or pty for a new pseudo-terminal
    #[arg(long, value_name = "PORT", required_unless_present = "board", conflicts_with = "board")]
    port: Option<String>,
    #[command(flatten)]
    board: BoardArgs,
    /// Plate, controller and profile; after the end of the profile its last values hold
    #[arg(long, value_name = "FILE", default_value = "scenarios/paper/fig13-closed-loop.toml")]
    scenario: PathBuf,
    /// Control law to configure
    #[arg(long, value_name = "NAME", value_parser = bench_law_names())]
    law: Option<String>,
    /// Timer of the control instants
    #[arg(long, value_enum, default_value_t = PacingArg::Bench)]
    pacing: PacingArg,
    /// End after this time, s
    #[arg(long, value_name = "S", value_parser = parse_seconds)]
    seconds: Option<Duration>,
    /// Live view in the terminal; ignored without a terminal
    #[arg(long)]
    live: bool,
}

/// Time between two attempts to reach a controller, or to reopen a port that disappeared.
const RETRY_INTERVAL: Duration = Duration::from_millis(500);
/// Time between two status lines: first on a terminal, second in a file or pipe.
const STATUS_INTERVALS: [Duration; 2] = [Duration::from_millis(200), Duration::from_secs(1)];
const POLL_INTERVAL: Duration = Duration::from_millis(20);
/// 100 days. The operator ends the emulation, not the scenario.
const UNLIMITED_DURATION: Time = Time::from_nanos(100 * 24 * 3_600_000_000_000);
const LIVE_KEYS: &str = "f/F finger -/+, t/T plate -/+, s/S setpoint -/+, r release and cool, q quit";
const KEYS: &str =
    "keys: f/F finger -/+ 0.25 N, t/T plate -/+ 1 K, s/S setpoint -/+ 0.1 µm, r release and cool down, q quit";

fn serve(arguments: &ServeArgs) -> CommandResult {
    let scenario = load(&arguments.scenario, &arguments.scenario.display().to_string())?;
    warn_of_scenarios(std::slice::from_ref(&scenario));
    let name = arguments.law.as_ref().unwrap_or(&scenario.controller.law);
    let law = LawId::from_name(name).ok_or_else(|| format!("unknown law `{name}`")).or_invalid()?;
    let named = match arguments.board.find_rig()? {
        Some(rig) if rig.has(Capability::LocalPort) => rig.to_string(),
        Some(rig) => {
            let expected = rig_syntaxes(|rig| rig.capabilities.contains(&Capability::LocalPort));
            return Err(Failure::invalid(&format!("the board has the rig {rig}, expected {expected}")));
        }
        None => arguments.port.clone().unwrap_or_default(),
    };
    let port = ControllerPort::parse(&named).or_invalid()?;
    let time_base = TimeBase { time_scale: 1.0, pacing: arguments.pacing.into() };
    if let Some(baud) = port.baud() {
        check_baud(baud, time_base.wall_duration(scenario.controller.period), 1.0).or_invalid()?;
    }
    let plan = RunPlan {
        scenarios: vec![scenario.clone()],
        jobs: 1,
        clock: Clock::RealTime(time_base),
        own_clock: true,
        rig: named,
        overrides: Overrides::default(),
    };
    let description =
        RunDescription { command: "plate serve", key_help: LIVE_KEYS, plan: Arc::new(plan), has_end: false };
    let (view, live_tap) = if arguments.live { run_plan::open_view(description) } else { Default::default() };
    let view_sender = view.as_ref().map(LiveView::sender);
    let reservation = arguments.board.reserve("plate serve")?;
    let unconfirmed = Arc::new(AtomicBool::new(false));
    let plate = PlateServer {
        scenario: without_end(scenario),
        law,
        time_base,
        view_sender,
        live_tap,
        unconfirmed: Arc::clone(&unconfirmed),
    };
    let serve = move |cancel: &CancelToken, _: &mut EventSender<()>| {
        let served = plate.serve(&port, cancel);
        cancel.cancel();
        served
    };
    let raw = view.is_none().then(RawTerminalMode::enter);
    let ended = run_until_signal(arguments.seconds, serve, |()| {});
    drop((view, raw));
    let is_abandoned = ended.0.is_err();
    let is_unconfirmed = is_abandoned || unconfirmed.load(Ordering::Relaxed);
    let exit = unless_signalled(ended).map_or_else(Failure::report, |()| Exit::Passed);
    release(reservation, if is_unconfirmed { BoardOutcome::unconfirmed() } else { BoardOutcome::untouched() })?;
    Ok(exit)
}

struct RawTerminalMode;

impl RawTerminalMode {
    fn enter() -> Option<Self> {
        (stdin().is_terminal() && enable_raw_mode().is_ok()).then_some(Self)
    }
}

impl Drop for RawTerminalMode {
    fn drop(&mut self) {
        let _ = disable_raw_mode();
    }
}

fn without_end(mut scenario: Scenario) -> Scenario {
    scenario.duration = UNLIMITED_DURATION;
    scenario.trace_step = UNLIMITED_DURATION;
    scenario.expectations.clear();
    scenario
}

enum ControllerPort {
    PseudoTerminal,
    Serial(RigSpec),
}

impl ControllerPort {
    fn parse(port: &str) -> Result<Self, String> {
        if port == "pty" {
            return Ok(Self::PseudoTerminal);
        }
        let rig = if port.starts_with("serial:") { port.to_owned() } else { format!("serial:{port}") };
        rig.parse().map(Self::Serial).map_err(|error: platebench_rig::SpecError| error.to_string())
    }

    fn baud(&self) -> Option<u32> {
        match self {
            Self::PseudoTerminal => None,
            Self::Serial(rig) => rig.baud(),
        }
    }

    fn open(&self, view_sender: Option<&ViewSender>) -> Result<BoxedLink, Failure> {
        match self {
            Self::PseudoTerminal => {
                let terminal = PtyLink::open().map_err(|error| Failure::new(Exit::Unreachable, &error))?;
                match view_sender {
                    Some(sender) => sender.set_rig(terminal.path().to_owned()),
                    None => stdio::show(&format!("port: {}\n", terminal.path())),
                }
                Ok(Box::new(terminal))
            }
            Self::Serial(rig) => Ok(rig.connect_real_time()?),
        }
    }
}

struct PlateServer {
    scenario: Scenario,
    law: LawId,
    time_base: TimeBase,
    view_sender: Option<ViewSender>,
    live_tap: LiveTap,
    /// True if the last controller did not confirm 0 V.
    unconfirmed: Arc<AtomicBool>,
}

impl PlateServer {
    fn serve(&self, port: &ControllerPort, cancel: &CancelToken) -> Result<(), Failure> {
        let control = Arc::new(ManualControl::default());
        let mut link = port.open(self.view_sender.as_ref())?;
        if stdin().is_terminal() {
            let inputs = ManualInputs { setpoint_um: self.scenario.setpoint.range().1, ..ManualInputs::default() };
            let (control, cancel) = (Arc::clone(&control), cancel.clone());
            if self.view_sender.is_none() {
                print_on_stderr(KEYS);
            }
            // The thread is never joined. If the terminal hangs up, it blocks until the end.
            thread::spawn(move || handle_keys(inputs, &control, &cancel));
        }
        print_on_stderr("waiting for a controller");
        while !cancel.is_cancelled() {
            let started = Instant::now();
            let Ok(mut session) = Session::open_cancellable(FaultInjector::new(&mut link), cancel) else {
                // If a USB port was unplugged, only a new connection reaches it again.
                if let ControllerPort::Serial(rig) = port {
                    link = rig.connect_real_time().unwrap_or(link);
                }
                thread::sleep(RETRY_INTERVAL.saturating_sub(started.elapsed()));
                continue;
            };
            print_on_stderr(&format!("controller: {}", quoted(&session.firmware_name())));
            loop {
                let mut tap = self.live_tap.acquire(0, 0);
                let consume = if self.view_sender.is_some() { discard_rows } else { print_status };
                let new = Trial::new(&self.scenario, self.law, 0);
                let trial = Trial { own_clock: true, cancel: cancel.clone(), tap: tap.tap(), ..new };
                match play(&mut session, trial, self.time_base, &control, consume) {
                    EmulationEnd::Stopped(reason) => {
                        let reason = reason.as_deref().unwrap_or("without a reason");
                        print_on_stderr(&format!("the controller stopped ({reason}) and is configured again"));
                        thread::sleep(RETRY_INTERVAL);
                    }
                    EmulationEnd::Lost(error) => {
                        print_on_stderr(&format!("{error}; waiting for a controller"));
                        break;
                    }
                    EmulationEnd::Cancelled => break,
                }
            }
            self.unconfirmed.store(session.close() != SafeEnd::Confirmed, Ordering::Relaxed);
        }
        Ok(())
    }
}

fn print_status(mut rows: Consumer<Row>) {
    let terminal = stdout().is_terminal();
    let interval = STATUS_INTERVALS[usize::from(!terminal)];
    let mut printed = Instant::now();
    let mut newest = None;
    loop {
        let is_done = rows.is_abandoned();
        while let Ok(row) = rows.pop() {
            if row.flags.contains(Flags::CONTROL) {
                newest = Some(row);
            }
        }
        if is_done {
            return;
        }
        if let Some(row) = newest.filter(|_| printed.elapsed() >= interval) {
            printed = Instant::now();
            stdio::show(&if terminal {
                format!("\r\u{1b}[K{}", status_line(&row))
            } else {
                format!("{}\n", status_line(&row))
            });
        }
        thread::sleep(POLL_INTERVAL);
    }
}

fn status_line(row: &Row) -> String {
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

fn discard_rows(mut rows: Consumer<Row>) {
    while !rows.is_abandoned() {
        while rows.pop().is_ok() {}
        thread::sleep(POLL_INTERVAL);
    }
}

fn handle_keys(mut inputs: ManualInputs, control: &ManualControl, cancel: &CancelToken) {
    watch_keys(
        || cancel.is_cancelled(),
        |key| match key {
            // In raw mode, Ctrl-C is read as a key and sends no signal.
            'q' | INTERRUPT => cancel.cancel(),
            letter if apply_key(&mut inputs, letter) => control.set(inputs),
            _ => {}
        },
    );
}

/// Overwrites the status line, which has no line end. Raw mode needs the carriage returns.
fn print_on_stderr(text: &str) {
    stdio::note(&if stdin().is_terminal() { format!("\r\u{1b}[K{text}\r") } else { text.to_owned() });
}

fn apply_key(inputs: &mut ManualInputs, letter: char) -> bool {
    match letter {
        'f' => inputs.finger_force_n = (inputs.finger_force_n - 0.25).max(0.0),
        'F' => inputs.finger_force_n = (inputs.finger_force_n + 0.25).min(10.0),
        't' => inputs.temperature_offset_k = (inputs.temperature_offset_k - 1.0).max(-40.0),
        'T' => inputs.temperature_offset_k = (inputs.temperature_offset_k + 1.0).min(60.0),
        's' => inputs.setpoint_um = (inputs.setpoint_um - 0.1).max(0.0),
        'S' => inputs.setpoint_um = (inputs.setpoint_um + 0.1).min(10.0),
        'r' => {
            inputs.finger_force_n = 0.0;
            inputs.temperature_offset_k = 0.0;
        }
        _ => return false,
    }
    true
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_key_changes_one_input_within_its_bounds() {
        let mut inputs = ManualInputs { setpoint_um: 2.0, ..ManualInputs::default() };
        for letter in "FFFfTTtS".chars() {
            assert!(apply_key(&mut inputs, letter));
        }
        assert_eq!(inputs, ManualInputs { setpoint_um: 2.1, temperature_offset_k: 1.0, finger_force_n: 0.5 });
        (0..100).for_each(|_| assert!(apply_key(&mut inputs, 'f') && apply_key(&mut inputs, 'S')));
        assert_eq!((inputs.finger_force_n, inputs.setpoint_um), (0.0, 10.0));
        assert!(apply_key(&mut inputs, 'r'));
        assert_eq!(inputs.temperature_offset_k, 0.0);
        assert!(!apply_key(&mut inputs, 'x'));
    }
}
