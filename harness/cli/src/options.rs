//! Defines options and defaults that several commands share.

use clap::ValueEnum;
use clap::builder::PossibleValuesParser;
use platebench_engine::Pacing;
use platebench_model::record::KeepTraces;
use platebench_rig::RIGS;
use platebench_wire::LawId;
use std::num::NonZero;
use std::time::Duration;

pub(crate) const SCENARIOS: &str = "scenarios";
pub(crate) const BASELINES: &str = "scenarios/baselines";

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum OutputFormat {
    /// A table
    Human,
    /// JSON for programs
    Json,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum ClockArg {
    /// The plate waits while a sample travels and the controller computes
    Lockstep,
    /// The plate moves on while a sample travels and the controller computes
    RealTime,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum PlateModeArg {
    /// The bench computes the plate
    Emulated,
    /// The controller drives its own plate, sensor and amplifier; the bench sends setpoints and
    /// asks the operator for finger and heat
    Real,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum PacingArg {
    /// The bench has the timer, and each sample triggers a control step
    Bench,
    /// The controller has the timer and requests each sample
    Target,
}

impl From<PacingArg> for Pacing {
    fn from(pacing: PacingArg) -> Self {
        match pacing {
            PacingArg::Bench => Self::Bench,
            PacingArg::Target => Self::Target,
        }
    }
}

/// Lists the syntax and the purpose of each rig.
pub(crate) fn rig_help() -> String {
    RIGS.iter().fold("Rig of the controller:".to_owned(), |text, rig| format!("{text}\n{rig}: {}", rig.help))
}

pub(crate) fn law_names() -> PossibleValuesParser {
    PossibleValuesParser::new(LawId::ALL.map(LawId::name))
}

pub(crate) fn parse_keep_traces(text: &str) -> Result<KeepTraces, String> {
    let worst = || text.strip_prefix("worst:")?.parse().ok().filter(|&count| count > 0).map(KeepTraces::Worst);
    match text {
        "all" => Ok(KeepTraces::All),
        "failing" => Ok(KeepTraces::Failing),
        "none" => Ok(KeepTraces::None),
        _ => worst().ok_or_else(|| "expected all, failing, none or worst:N with N of at least 1".to_owned()),
    }
}

pub(crate) fn parse_number(text: &str, is_valid: impl Fn(f64) -> bool, expected: &str) -> Result<f64, String> {
    let number = text.parse().ok().filter(|number| is_valid(*number));
    number.ok_or_else(|| format!("expected {expected}"))
}

pub(crate) fn parse_time_scale(text: &str) -> Result<f64, String> {
    parse_number(text, |scale| (0.001..=10.0).contains(&scale), "a number from 0.001 to 10")
}

pub(crate) fn parse_percent(text: &str) -> Result<f64, String> {
    parse_number(text, |percent| (0.0..=100.0).contains(&percent), "a number from 0 to 100")
}

pub(crate) fn parse_seconds(text: &str) -> Result<Duration, String> {
    parse_number(text, |seconds| (0.0..=1e7).contains(&seconds), "a number of seconds from 0 to 1e7")
        .map(Duration::from_secs_f64)
}

pub(crate) fn job_count(jobs: Option<u16>) -> usize {
    jobs.map_or_else(|| std::thread::available_parallelism().map_or(1, NonZero::get), usize::from)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn time_scales_have_two_bounds() {
        for (text, expected) in [("0.1", 0.1), ("0.001", 0.001), ("10", 10.0)] {
            assert_eq!(parse_time_scale(text), Ok(expected));
        }
        for wrong in ["0", "-1", "0.0009", "10.1", "NaN", "inf", "fast", ""] {
            assert!(parse_time_scale(wrong).is_err(), "{wrong}");
        }
    }
}
