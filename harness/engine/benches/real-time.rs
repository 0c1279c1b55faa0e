//! Compares the lateness of the real-time loop with the limits of the computer, for
//! `docs/real-time.md`. The benchmark starts itself as other programs: with a port as argument, it
//! is the controller on this port. With `--echo` and a port, it returns all bytes.

mod real_time {
    pub(crate) mod exchange;
    pub(crate) mod limits;
    pub(crate) mod table;
}

use platebench_engine::real_time::play;
use platebench_engine::{Pacing, TimeBase, Trial};
use platebench_model::record::TimingRecord;
use platebench_model::scenario::{Scenario, load};
use platebench_model::trace::Flags;
use platebench_rig::{BoxedLink, ExecLink, FaultInjector, Session};
use platebench_wire::LawId;
use real_time::{exchange, limits, table};
use std::error::Error;
use std::path::Path;
use std::process::ExitCode;
use std::time::Duration;

const LENGTH: Duration = Duration::from_secs(4);
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
    let realtime = limits::measure_sleep(LENGTH, true)?;
    let mut references = vec![table::Reference::new("`clock_nanosleep`, absolute, SCHED_OTHER: lateness", sleep)];
    references.extend(
        realtime.map(|lateness| table::Reference::new("`clock_nanosleep`, absolute, SCHED_FIFO: lateness", lateness)),
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
    table::loops(&loops, realtime.unwrap_or(sleep), echo);
    Ok(())
}

fn controller_command(option: &str) -> Result<String, Box<dyn Error>> {
    let program = std::env::current_exe()?;
    Ok(format!("'{}' {option}{{port}}", program.display()))
}

fn play_at(period_us: u32) -> Result<TimingRecord, Box<dyn Error>> {
    let scenario = scenario(period_us)?;
    let trial = Trial { own_clock: true, ..Trial::new(&scenario, LawId::DqPi, 0) };
    let link: BoxedLink = Box::new(ExecLink::start(&controller_command("")?)?);
    let mut session = Session::open(FaultInjector::new(link))?;
    let time_base = TimeBase { time_scale: 1.0, pacing: Pacing::Bench };
    let result = play(&mut session, trial, time_base).ok_or("the trial was cancelled")?;
    if let Some(error) = result.link_error {
        return Err(error.into());
    }
    let safe = result.trace_rows.iter().filter(|row| row.t_s > 0.01 && row.flags.contains(Flags::SAFE)).count();
    if safe > 0 {
        println!("at {period_us} µs the controller stopped: {}\n", result.telemetry.stopped.unwrap_or_default());
    }
    result.telemetry.timing.map(|timing| *timing).ok_or_else(|| "no timing".into())
}

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
