//! `platebench suite explore`: generates scenes from an operating envelope and checks properties of
//! the controller.

use crate::exit::{CommandResult, Exit, Failure, OrInvalid};
use crate::options::{OutputFormat, job_count, law_names, parse_reply_timeout, rig_help};
use crate::selection::note_skipped;
use crate::shutdown::{EventSender, run_until_signal, unless_signalled};
use crate::stdio;
use clap::Args;
use platebench_experiments::explore::session::{ExploreSession, ProgressEvent};
use platebench_experiments::explore::{Envelope, ExploreError, report};
use platebench_model::quoted_path;
use platebench_model::record::{RunFolder, RunOutcome};
use platebench_model::scenario::find;
use platebench_report::Detail;
use platebench_rig::{CancelToken, RigSpec};
use std::path::{Path, PathBuf};
use std::time::Duration;

const DEFAULT_ENVELOPE: &str = "scenarios/envelope.toml";

/// A controller with its own clock waits for most of a scene, for example for its watchdog.
const JOBS_PER_CORE_OF_OWN_CLOCKS: usize = 3;

#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  platebench suite explore                                      60 s on the emulated board
  platebench suite explore --rig 'exec:./controller {port}' --for 10m
  platebench suite explore --scenes 1000 --seed 7 --law deadbeat --out /tmp/night
  platebench suite explore envelopes/warm.toml --regressions tests/found

Exit codes: 0 no property was violated, 1 a property was violated, 2 invalid input, 3 the rig left scenes undecided,
4 no scene was played, 5 the rig could not be reached or was lost")]
pub(super) struct ExploreArgs {
    /// The operating envelope; default: scenarios/envelope.toml, or the same built in if there is no such file
    envelope: Option<PathBuf>,
    #[arg(long, help = rig_help(), default_value = "emulated")]
    rig: RigSpec,
    /// Control law of the firmware under test; default: dq-pi, or own if the controller announces no law
    #[arg(long, value_name = "NAME", value_parser = law_names())]
    law: Option<String>,
    /// Duration: 30s, 10m, 8h; default: 60s
    #[arg(long = "for", value_name = "DURATION", conflicts_with = "scenes", value_parser = parse_duration)]
    time: Option<Duration>,
    /// Number of scenes
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..=100_000_000))]
    scenes: Option<u64>,
    /// Time to wait for a reply over a line before it counts as missed, ms
    #[arg(long, value_name = "MS", default_value = "500", value_parser = parse_reply_timeout)]
    reply_timeout: Duration,
    /// Seed; the scenes depend on it, on the envelope and on what earlier rounds of 64 reached
    #[arg(long, value_name = "S", default_value_t = 1)]
    seed: u64,
    /// Scenes that are played at once; default: one per core, three if the controller has its own clock
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=1024))]
    jobs: Option<u16>,
    /// Compare every command with this project's implementation of the law on the PC
    #[arg(long, value_name = "RIG", value_parser = ["hosted"])]
    reference: Option<String>,
    /// The run folder; default: a new folder below runs/
    #[arg(long, value_name = "FOLDER")]
    out: Option<PathBuf>,
    /// Folder of minimal scenes; those in it are played first
    #[arg(long, value_name = "FOLDER", default_value = "scenarios/regressions")]
    regressions: PathBuf,
    /// Format of standard output
    #[arg(long, value_enum, default_value_t = OutputFormat::Human)]
    format: OutputFormat,
}

pub(super) fn explore(arguments: &ExploreArgs, detail: Detail) -> CommandResult {
    let session = prepare(arguments, detail)?;
    let folder = RunFolder::create(arguments.out.as_deref()).or_invalid()?;
    let path = folder.path().to_owned();
    let work = move |cancel: &CancelToken, events: &mut EventSender<ProgressEvent>| {
        session.run(cancel, &path, &mut |event| events.send(event))
    };
    let mut last = Duration::ZERO;
    let ended = run_until_signal(None, work, |event| {
        // In a log, a line every ten seconds shows that the work continues.
        if detail != Detail::Failures && event.elapsed >= last + Duration::from_secs(10) {
            last = event.elapsed;
            stdio::note(&event.to_string());
        }
    });
    let ((report, stop), signal) = match ended {
        (Ok(Ok(report)), signal) => (report, signal),
        ended => {
            folder.remove_if_empty();
            (unless_signalled(ended)?, None)
        }
    };
    let is_empty = report.scenes == 0 && report.regressions == 0;
    let of_scenes = || RunOutcome::of(report.verdict, false, report.safe_confirmed).into();
    let exit = || if is_empty { Exit::NothingToRun } else { of_scenes() };
    let exit = signal.map_or_else(exit, Exit::Signal);
    let lost = stop.filter(|_| signal.is_none());
    if lost.is_none() && exit.is_hidden(detail == Detail::Failures, arguments.format) {
        return Ok(exit);
    }
    stdio::show_result(arguments.format, &report, &report::document(&report));
    stdio::note(&format!("result: {}", quoted_path(&folder.path().join(report::FILE))));
    stdio::note(&format!("report: {}", quoted_path(&folder.path().join(report::PAGE_FILE))));
    if let Some(error) = lost {
        return Err(error.into());
    }
    exit.show_verdict(&report.reason(), arguments.format);
    Ok(exit)
}

fn prepare(arguments: &ExploreArgs, detail: Detail) -> Result<ExploreSession, Failure> {
    let envelope = match &arguments.envelope {
        Some(path) => Envelope::load(path)?,
        None if Path::new(DEFAULT_ENVELOPE).exists() => Envelope::load(Path::new(DEFAULT_ENVELOPE))?,
        None => Envelope::built_in()?,
    };
    arguments.rig.check().or_invalid()?;
    let regressions = if arguments.regressions.is_dir() {
        let found = find(std::slice::from_ref(&arguments.regressions))?;
        note_skipped(&found, detail);
        found.scenarios
    } else {
        Vec::new()
    };
    let jobs = match arguments.jobs {
        _ if !arguments.rig.allows_parallel_links() => 1,
        None if arguments.rig.has_own_clock() => JOBS_PER_CORE_OF_OWN_CLOCKS * job_count(None),
        jobs => job_count(jobs),
    };
    let time = arguments.time.unwrap_or(Duration::from_mins(1));
    let budget = arguments.scenes.map_or(
        platebench_experiments::explore::ExplorationBudget::Time(time),
        platebench_experiments::explore::ExplorationBudget::Scenes,
    );
    Ok(ExploreSession {
        envelope,
        rig: arguments.rig.clone(),
        reply_timeout: arguments.reply_timeout,
        law: arguments.law.clone(),
        seed: arguments.seed,
        budget,
        jobs,
        compares_reference: arguments.reference.is_some(),
        regressions,
        regression_folder: arguments.regressions.clone(),
    })
}

impl From<ExploreError> for Failure {
    fn from(error: ExploreError) -> Self {
        match error {
            ExploreError::Connect(error) => error.into(),
            ExploreError::Run(error) => error.into(),
            ExploreError::LawNotAnnounced { .. } | ExploreError::File(_) => Self::invalid(&error),
            ExploreError::Generated(_) => Self::new(Exit::Inconclusive, &error),
        }
    }
}

const MAX_HOURS: u64 = 24 * 30;

/// Accepts `90` (seconds), `90s`, `10m` or `8h`.
fn parse_duration(text: &str) -> Result<Duration, String> {
    let digits = text.trim_end_matches(|letter: char| !letter.is_ascii_digit());
    let factor = match text.get(digits.len()..) {
        Some("" | "s") => Some(1),
        Some("m") => Some(60),
        Some("h") => Some(3_600),
        _ => None,
    };
    let seconds = factor.zip(digits.parse::<u64>().ok()).and_then(|(factor, number)| number.checked_mul(factor));
    seconds
        .filter(|seconds| (1..=MAX_HOURS * 3_600).contains(seconds))
        .map(Duration::from_secs)
        .ok_or_else(|| format!("expected a duration such as 30s, 10m or 8h, at most {MAX_HOURS} h"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn durations_have_a_unit_and_bounds() {
        for (text, seconds) in [("30s", 30), ("90", 90), ("10m", 600), ("8h", 28_800)] {
            assert_eq!(parse_duration(text), Ok(Duration::from_secs(seconds)), "{text}");
        }
        for wrong in ["", "s", "0s", "1.5m", "-3s", "3d", "99999999h", "18446744073709551615h"] {
            assert!(parse_duration(wrong).is_err(), "{wrong}");
        }
    }
}
