//! Counts the instructions of a step and compares them with `counts.toml`; `ci/counts` runs it.
//!
//! Callgrind counts do not depend on clock or load. The difference between runs with 400 and with
//! 200 steps excludes start and end. Counts are comparable only for the same compiler, C library,
//! Valgrind and vector instructions; if one differs, the program prints a message instead.

#![allow(clippy::format_push_string, reason = "twenty lines, once")]

mod steps;

use std::collections::BTreeMap;
use std::env;
use std::fs;
use std::path::PathBuf;
use std::process::{Command, ExitCode};
use steps::{STEPS, Step};
use toml::{Table, Value};

const TOLERANCE: f64 = 0.03;
const RUNS: u64 = 200;

fn main() -> ExitCode {
    let arguments: Vec<_> = env::args().skip(1).filter(|argument| argument != "--bench").collect();
    let result = match arguments.iter().map(String::as_str).collect::<Vec<_>>()[..] {
        ["run", name, runs] => run(name, runs),
        [] => check(),
        ["--update"] => update(),
        _ => Err(format!("unknown arguments {arguments:?}, expected none or --update")),
    };
    match result {
        Ok(()) => ExitCode::SUCCESS,
        Err(message) => {
            eprintln!("counts: {message}");
            ExitCode::FAILURE
        }
    }
}

fn run(name: &str, runs: &str) -> Result<(), String> {
    let step = STEPS.iter().find(|step| step.name == name).ok_or("no such step")?;
    let mut step = step.prepare();
    (0..runs.parse::<u64>().map_err(|error| error.to_string())?).for_each(|_| step());
    Ok(())
}

fn instructions(step: &Step, runs: u64) -> Result<u64, String> {
    let own = env::current_exe().map_err(|error| error.to_string())?;
    let mut valgrind = Command::new("valgrind");
    valgrind.args(["--tool=callgrind", "--callgrind-out-file=/dev/null"]).arg(own);
    let output = valgrind.args(["run", step.name, &runs.to_string()]).output();
    let output = output.map_err(|error| format!("valgrind: {error}; ci/install-test-tools installs it"))?;
    let text = String::from_utf8_lossy(&output.stderr);
    let counted =
        text.lines().find_map(|line| line.split_once("Collected : ")).and_then(|(_, count)| count.trim().parse().ok());
    match counted {
        Some(counted) if output.status.success() => Ok(counted),
        _ => Err(format!("valgrind printed no count for {}:\n{text}", step.name)),
    }
}

/// Instructions per control period or sample.
fn measure_instructions() -> Result<BTreeMap<&'static str, f64>, String> {
    let mut counts = BTreeMap::new();
    for step in STEPS {
        let extra = instructions(step, 2 * RUNS)?.saturating_sub(instructions(step, RUNS)?);
        let per_item = extra as f64 / (RUNS as f64 * step.items as f64);
        counts.insert(step.name, (per_item * 10.0).round() / 10.0);
    }
    Ok(counts)
}

fn command_output(program: &str, arguments: &[&str]) -> String {
    let output = Command::new(program).args(arguments).output();
    let text = output.map(|output| String::from_utf8_lossy(&output.stdout).into_owned()).unwrap_or_default();
    text.lines().next().unwrap_or("unknown").trim().to_owned()
}

fn environment() -> BTreeMap<&'static str, String> {
    let vectors = if cfg!(target_arch = "x86_64") && has_vectors() { "avx2 and fma" } else { "baseline" };
    BTreeMap::from([
        ("compiler", command_output("rustc", &["--version"])),
        ("library", command_output("getconf", &["GNU_LIBC_VERSION"])),
        ("valgrind", command_output("valgrind", &["--version"])),
        ("vectors", vectors.to_owned()),
    ])
}

#[cfg(target_arch = "x86_64")]
fn has_vectors() -> bool {
    std::is_x86_feature_detected!("avx2") && std::is_x86_feature_detected!("fma")
}

#[cfg(not(target_arch = "x86_64"))]
fn has_vectors() -> bool {
    false
}

fn counts_file() -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("benches/counts.toml")
}

fn update() -> Result<(), String> {
    let mut text =
        String::from("# Instructions per control period or per converter sample: written by `ci/counts --update`.\n");
    for (name, value) in environment() {
        text += &format!("{name} = \"{value}\"\n");
    }
    text.push_str("\n[instructions]\n");
    for (name, count) in measure_instructions()? {
        text += &format!("{name} = {count:.1}\n");
    }
    fs::write(counts_file(), text).map_err(|error| error.to_string())
}

fn check() -> Result<(), String> {
    let text = fs::read_to_string(counts_file()).map_err(|error| format!("{}: {error}", counts_file().display()))?;
    let known: Table = text.parse().map_err(|error| format!("{}: {error}", counts_file().display()))?;
    let mut comparable = true;
    for (name, now) in environment() {
        let then = known.get(name).and_then(Value::as_str).unwrap_or("unknown");
        if then != now {
            eprintln!("counts: {name} is {now}, expected {then}");
            comparable = false;
        }
    }
    let known = known.get("instructions").and_then(Value::as_table).ok_or("counts.toml has no [instructions]")?;
    let measured = measure_instructions()?;
    let mut wrong = Vec::new();
    for (name, count) in &measured {
        let Some(before) = known.get(*name).and_then(Value::as_float) else {
            wrong.push(format!("{name} is not in counts.toml"));
            continue;
        };
        let change = count / before - 1.0;
        println!("{name:<20} {count:>9.1} {:>+6.1} %", 100.0 * change);
        if change > TOLERANCE {
            wrong.push(format!("{name} takes {count} instructions, expected {before}: {:+.1} %", 100.0 * change));
        }
    }
    wrong.extend(
        known
            .keys()
            .filter(|name| !measured.contains_key(name.as_str()))
            .map(|name| format!("{name} is in counts.toml but is no step")),
    );
    if !comparable {
        println!("counts: NOT COMPARED: counts.toml is from other tools (see above); update: ci/counts --update");
        return Ok(());
    }
    if wrong.is_empty() { Ok(()) } else { Err(wrong.join("\ncounts: ") + "\nif this is intended: ci/counts --update") }
}
