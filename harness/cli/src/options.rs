//! Defines options and defaults that several commands share, and the clock that they select.

use clap::ValueEnum;
use clap::builder::PossibleValuesParser;
use platebench_engine::{Clock, Pacing, TimeBase};
use platebench_model::record::{ClockKind, KeepTraces};
use platebench_model::scenario::{MAX_TIMEOUT_S, Scenario};
use platebench_rig::{Capability, RIGS, RigSpec, check_baud, rig_syntaxes};
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

pub(crate) fn law_help() -> String {
    let names: Vec<_> = platebench_engine::law_names().collect();
    format!("Control law of the firmware: {}. `own` is any algorithm, judged by the requirements", names.join(", "))
}

/// Laws of the bench.
pub(crate) fn bench_law_names() -> PossibleValuesParser {
    PossibleValuesParser::new(LawId::ALL.map(LawId::name))
}

pub(crate) fn parse_reply_timeout(text: &str) -> Result<Duration, String> {
    let ms: u32 = text.parse().unwrap_or(0);
    (1..=60_000)
        .contains(&ms)
        .then(|| Duration::from_millis(ms.into()))
        .ok_or_else(|| "expected 1 to 60000 ms".to_owned())
}

/// Laws of the bench, and `own`.
pub(crate) fn law_names() -> PossibleValuesParser {
    PossibleValuesParser::new(platebench_engine::law_names())
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

pub(crate) fn parse_positive_ms(text: &str) -> Result<f64, String> {
    parse_number(text, |ms| ms > 0.0 && ms <= 1e3, "a time in ms above 0, at most 1000")
}

pub(crate) fn parse_setpoint_um(text: &str) -> Result<f64, String> {
    parse_number(text, |um| um > 0.0 && um <= 1e3, "an amplitude in µm above 0, at most 1000")
}

pub(crate) fn parse_force_n(text: &str) -> Result<f64, String> {
    parse_number(text, |newton| (0.0..=100.0).contains(&newton), "a force in N from 0 to 100")
}

pub(crate) fn parse_time_scale(text: &str) -> Result<f64, String> {
    parse_number(text, |scale| (0.001..=10.0).contains(&scale), "a number from 0.001 to 10")
}

pub(crate) fn parse_timeout(text: &str) -> Result<f64, String> {
    let expected = format!("a number of seconds above 0, up to {MAX_TIMEOUT_S}");
    parse_number(text, |seconds| seconds > 0.0 && seconds <= MAX_TIMEOUT_S, &expected)
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

pub(crate) struct ClockRequest<'a> {
    pub(crate) rig: &'a RigSpec,
    pub(crate) clock: Option<ClockArg>,
    pub(crate) time_scale: f64,
    pub(crate) pacing: PacingArg,
    pub(crate) plate_mode: PlateModeArg,
    pub(crate) wire_time: bool,
}

impl<'a> ClockRequest<'a> {
    pub(crate) fn new(rig: &'a RigSpec, clock: Option<ClockArg>) -> Self {
        let (pacing, plate_mode) = (PacingArg::Bench, PlateModeArg::Emulated);
        Self { rig, clock, time_scale: 1.0, pacing, plate_mode, wire_time: false }
    }

    fn default_clock(&self) -> ClockArg {
        match self.rig.default_clock() {
            ClockKind::Lockstep => ClockArg::Lockstep,
            ClockKind::RealTime | ClockKind::RealPlate => ClockArg::RealTime,
        }
    }

    pub(crate) fn resolve(&self) -> Result<Clock, String> {
        let Self { time_scale, wire_time, .. } = *self;
        let pacing = Pacing::from(self.pacing);
        if self.plate_mode == PlateModeArg::Real {
            return self.resolve_real_plate();
        }
        let refuse = |reason: &str| Err(reason.to_owned());
        match self.clock.unwrap_or_else(|| self.default_clock()) {
            ClockArg::Lockstep if time_scale != 1.0 || pacing == Pacing::Target => {
                refuse("--time-scale and --pacing are for --clock real-time")
            }
            ClockArg::Lockstep if wire_time && *self.rig == RigSpec::hosted() => {
                refuse("--wire-time is for a rig with a line and a processor, such as emulated; hosted has no delay")
            }
            ClockArg::Lockstep => Ok(Clock::Lockstep { wire_time }),
            ClockArg::RealTime if let Some(reason) = self.rig.properties().no_real_time => refuse(reason),
            ClockArg::RealTime if wire_time => refuse(
                "--wire-time is for --clock lockstep; in real time line and computing time delay the loop anyway",
            ),
            ClockArg::RealTime if time_scale != 1.0 && pacing == Pacing::Target => {
                refuse("--time-scale needs --pacing bench: a controller's own timer cannot be slowed down")
            }
            ClockArg::RealTime => Ok(Clock::RealTime(TimeBase { time_scale, pacing })),
        }
    }

    /// A controller with a real plate allows one clock only, its own.
    fn resolve_real_plate(&self) -> Result<Clock, String> {
        if !self.rig.has(Capability::RealPlate) {
            let rigs = rig_syntaxes(|rig| rig.capabilities.contains(&Capability::RealPlate));
            return Err(format!("--plate-mode real is for a controller that drives its own plate: --rig {rigs}"));
        }
        let names_clock = self.clock == Some(ClockArg::Lockstep) || self.time_scale != 1.0 || self.wire_time;
        if names_clock || self.pacing == PacingArg::Target {
            let reason = "--plate-mode real uses the controller's own clock: --clock lockstep, --time-scale, --pacing \
                          and --wire-time are for an emulated plate";
            return Err(reason.to_owned());
        }
        Ok(Clock::RealPlate)
    }
}

/// Fails if the serial line is too slow for real time. In lockstep the plate waits for the line.
pub(crate) fn check_line_speed(rig: &RigSpec, clock: Clock, scenarios: &[Scenario]) -> Result<(), String> {
    let Some(baud) = rig.baud() else { return Ok(()) };
    let time_scale = match clock {
        Clock::Lockstep { .. } => return Ok(()),
        Clock::RealTime(time_base) => time_base.time_scale,
        // A period needs 43 bytes of telemetry from a real plate, less than the 48 bytes of sample
        // and command.
        Clock::RealPlate => 1.0,
    };
    for scenario in scenarios {
        check_baud(baud, scenario.controller.period.into(), time_scale)
            .map_err(|error| format!("{}: {error}", scenario.file))?;
    }
    Ok(())
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
