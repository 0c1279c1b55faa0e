//! Measures limits of the computer: wake-up time, and echo over a pseudo-terminal.

use super::table::{Quantiles, Reference, quantiles};
use platebench_test_kit::{ChildGuard, open_terminal};
use rustix::event::{PollFd, PollFlags, poll};
use rustix::fd::OwnedFd;
use rustix::termios::{OptionalActions, tcgetattr, tcsetattr};
use rustix::thread::{ClockId, clock_nanosleep_absolute};
use rustix::time::{Timespec, clock_gettime};
use std::error::Error;
use std::fs::{File, OpenOptions};
use std::io::{ErrorKind, Read, Write};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};
use thread_priority::unix::{
    RealtimeThreadSchedulePolicy, ThreadSchedulePolicy, set_thread_priority_and_policy, thread_native_id,
};
use thread_priority::{ThreadPriority, ThreadPriorityValue};

const PERIOD_NS: i64 = 1_000_000;
/// Equals the priority of the real-time loop.
const PRIORITY: u8 = 45;
const FRAME: usize = 24;

fn nanos(time: Timespec) -> i64 {
    time.tv_sec * 1_000_000_000 + time.tv_nsec
}

/// `None` if `realtime` is true and the system does not permit real-time scheduling.
pub(crate) fn measure_sleep(length: Duration, realtime: bool) -> Result<Option<Quantiles>, Box<dyn Error>> {
    // Uses a new thread, because child processes of this thread would inherit the priority.
    let thread = std::thread::spawn(move || {
        let policy = ThreadSchedulePolicy::Realtime(RealtimeThreadSchedulePolicy::Fifo);
        let priority = ThreadPriorityValue::try_from(PRIORITY).map(ThreadPriority::Crossplatform);
        let granted = priority.is_ok_and(|priority| {
            realtime && set_thread_priority_and_policy(thread_native_id(), priority, policy).is_ok()
        });
        if granted == realtime { sleep_repeatedly(length).map(Some) } else { Ok(None) }
    });
    Ok(thread.join().map_err(|_| "the sleeping thread has panicked")??)
}

fn sleep_repeatedly(length: Duration) -> std::io::Result<Quantiles> {
    let now = || clock_gettime(ClockId::Monotonic);
    let start = nanos(now());
    let count = length.as_nanos() as i64 / PERIOD_NS;
    let mut late = Vec::with_capacity(count as usize);
    for number in 1..=count {
        let due = start + number * PERIOD_NS;
        let until = Timespec { tv_sec: due / 1_000_000_000, tv_nsec: due % 1_000_000_000 };
        clock_nanosleep_absolute(ClockId::Monotonic, &until)?;
        late.push(Duration::from_nanos((nanos(now()) - due).max(0) as u64));
    }
    Ok(quantiles(&mut late))
}

pub(crate) fn run_cyclictest(length: Duration) -> Result<Option<Reference>, Box<dyn Error>> {
    let loops = (length.as_millis()).to_string();
    let output =
        Command::new("cyclictest").args(["-q", "-p", "45", "-i", "1000", "-l", &loops, "-h", "100000"]).output();
    let output = match output {
        Err(error) if error.kind() == ErrorKind::NotFound => {
            println!("NOT MEASURED: cyclictest is not installed (ci/install-test-tools)\n");
            return Ok(None);
        }
        output => output?,
    };
    let mut late = Vec::new();
    for line in String::from_utf8_lossy(&output.stdout).lines() {
        let mut columns = line.split_whitespace();
        let (Some(Ok(micros)), Some(Ok(count))) =
            (columns.next().map(str::parse::<u64>), columns.next().map(str::parse::<usize>))
        else {
            continue;
        };
        late.extend(std::iter::repeat_n(Duration::from_micros(micros), count));
    }
    if late.is_empty() {
        println!("NOT MEASURED: cyclictest printed no histogram: {}\n", String::from_utf8_lossy(&output.stderr).trim());
        return Ok(None);
    }
    Ok(Some(Reference::new("`cyclictest`, SCHED_FIFO: lateness", quantiles(&mut late))))
}

fn raw_terminal() -> Result<(File, OwnedFd, String), Box<dyn Error>> {
    let (ours, path) = open_terminal();
    let other = OwnedFd::from(OpenOptions::new().read(true).write(true).open(&path)?);
    let mut settings = tcgetattr(&other)?;
    settings.make_raw();
    tcsetattr(&other, OptionalActions::Now, &settings)?;
    Ok((ours, other, path))
}

pub(crate) fn echo(path: &str) -> std::io::Result<()> {
    let mut port = OpenOptions::new().read(true).write(true).open(path)?;
    let mut buffer = [0; 512];
    loop {
        match port.read(&mut buffer) {
            Ok(0) | Err(_) => return Ok(()),
            Ok(count) => port.write_all(buffer.get(..count).unwrap_or_default())?,
        }
    }
}

pub(crate) fn measure_echo(length: Duration) -> Result<Quantiles, Box<dyn Error>> {
    let (mut line, other, path) = raw_terminal()?;
    let program = std::env::current_exe()?;
    let child = Command::new(program).args(["--echo", &path]).stdin(Stdio::null()).spawn()?;
    let _child = ChildGuard(child);
    let frame = [0x55; FRAME];
    let mut buffer = [0; FRAME];
    line.write_all(&frame)?;
    if poll(&mut [PollFd::new(&line, PollFlags::IN)], Some(&Timespec { tv_sec: 5, tv_nsec: 0 }))? == 0 {
        return Err("the other process does not answer".into());
    }
    line.read_exact(&mut buffer)?;
    // From now on, the line hangs up if the echo process ends.
    drop(other);
    let count = length.as_millis() as u32;
    let mut times = Vec::with_capacity(count as usize);
    let start = Instant::now();
    for number in 1..=count {
        std::thread::sleep((start + Duration::from_millis(number.into())).saturating_duration_since(Instant::now()));
        let sent = Instant::now();
        line.write_all(&frame)?;
        line.read_exact(&mut buffer)?;
        times.push(sent.elapsed());
    }
    Ok(quantiles(&mut times))
}
