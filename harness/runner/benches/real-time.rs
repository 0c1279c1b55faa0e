//! How punctual the real-time clock is, beside what this computer can do at all: the tables of `docs/real-time.md`.
//!
//! `cargo bench --ignore-rust-version -p platebench-runner --bench real-time`. Everything is measured in the same run, so that shares hold where the computer does something else besides.
//! Started with a path it plays the controller on that port, started with `--echo` and a path it sends back what comes.

mod real_time {
    pub(crate) mod exchange;
    pub(crate) mod limits;
    pub(crate) mod table;
}

use platebench_record::TimingRecord;
use platebench_rig::{BoxedLink, CancelToken, ExecLink, FaultInjector, Session};
use platebench_runner::real_time::{Pacing, TimeBase, play};
use platebench_runner::trial::TrialSpec;
use platebench_scenario::{Scenario, load};
use platebench_trace::Flags;
use platebench_wire::LawId;
use real_time::{exchange, limits, table};
use std::error::Error;
use std::path::Path;
use std::process::ExitCode;
use std::time::Duration;

/// Of each measurement.
const LENGTH: Duration = Duration::from_secs(4);
/// Periods of the bench's loop, µs.
const PERIODS_US: [u32; 4] = [1_000, 500, 200, 100];

fn main() -> ExitCode {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let outcome = match arguments.iter().map(String::as_str).collect::<Vec<_>>()[..] {
        [path] if path.starts_with('/') => return platebench_host_controller::main(),
        ["--echo", path] => limits::echo(path).map_err(Into::into),
        _ => measure(),
    };
    match outcome {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {error}");
            ExitCode::FAILURE
        }
    }
}

fn measure() -> Result<(), Box<dyn Error>> {
    let load = std::fs::read_to_string("/proc/loadavg").unwrap_or_default();
    let cores = std::thread::available_parallelism().map_or(0, usize::from);
    println!(
        "{cores} processors, load average at the start {}\n",
        load.split(' ').take(3).collect::<Vec<_>>().join(" ")
    );

    let sleep = limits::measure_sleep(LENGTH, false)?.ok_or("not scheduled as usual")?;
    let preferred = limits::measure_sleep(LENGTH, true)?;
    let mut references = vec![table::Reference::new("`clock_nanosleep`, absolute, SCHED_OTHER: lateness", sleep)];
    references.extend(
        preferred.map(|slept| table::Reference::new("`clock_nanosleep`, absolute, SCHED_FIFO: lateness", slept)),
    );
    references.extend(limits::run_cyclictest(LENGTH)?);
    let echo = limits::measure_echo(LENGTH)?;
    references.push(table::Reference::new("echo over a pseudo-terminal: there and back", echo));
    table::references(&references);

    let own = exchange::measure_blocking(LENGTH)?;
    let other = exchange::measure_tokio(LENGTH)?;
    table::exchanges(&[("blocking thread", &own), ("tokio-serial", &other)], sleep, echo);

    let mut loops = Vec::new();
    for period_us in PERIODS_US {
        loops.push((period_us, play_at(period_us)?));
    }
    table::loops(&loops, preferred.unwrap_or(sleep), echo);
    Ok(())
}

/// The command that starts this program as the other side of a line.
fn controller_command(option: &str) -> Result<String, Box<dyn Error>> {
    let program = std::env::current_exe()?;
    Ok(format!("'{}' {option}{{port}}", program.display()))
}

/// A trial of the paper's step over a pseudo-terminal to the host controller.
fn play_at(period_us: u32) -> Result<TimingRecord, Box<dyn Error>> {
    let scenario = scenario(period_us)?;
    let order = TrialSpec { scenario: &scenario, law: LawId::DqPi, index: 0, wire_time: false, own_clock: true };
    let link: BoxedLink = Box::new(ExecLink::start(&controller_command("")?)?);
    let mut session = Session::open(FaultInjector::new(link))?;
    let pace = TimeBase { time_scale: 1.0, pacing: Pacing::Bench };
    let played = play(&mut session, &order, pace, &CancelToken::never(), None).ok_or("given up")?;
    if let Some(error) = played.link_error {
        return Err(error.into());
    }
    let safe = played.trace_rows.iter().filter(|row| row.t_s > 0.01 && row.flags.contains(Flags::SAFE)).count();
    if safe > 0 {
        println!("at {period_us} µs the controller stopped: {}\n", played.telemetry.stopped.unwrap_or_default());
    }
    played.telemetry.timing.ok_or_else(|| "no timing".into())
}

/// The paper's step with another period and as long as a measurement.
fn scenario(period_us: u32) -> Result<Scenario, Box<dyn Error>> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../scenarios/paper/fig13-closed-loop.toml");
    let mut scenario = load(&path, "fig13-closed-loop.toml").map_err(|fault| fault.to_string())?;
    let time = |ms: f64| platebench_plate::Time::from_ms(ms).ok_or("no time");
    scenario.duration = time(LENGTH.as_secs_f64() * 1e3)?;
    scenario.controller.period = time(f64::from(period_us) / 1e3)?;
    scenario.trace_step = scenario.controller.period;
    scenario.expectations.clear();
    Ok(scenario)
}
