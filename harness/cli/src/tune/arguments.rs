//! Defines the arguments of `platebench tune` and the design target that they state.

use crate::board_args::BoardArgs;
use crate::options::{OutputFormat, parse_number};
use clap::builder::PossibleValuesParser;
use clap::{ArgGroup, Args};
use platebench_design::loops::Discretisation;
use platebench_design::tuning::PlateSpread;
use platebench_design::tuning::design::TuningTarget;
use platebench_model::scenario::{Diagnostic, read_text};
use platebench_plate::{Plate, Uncertainty};
use platebench_rig::RigSpec;
use platebench_wire::LawId;
use std::path::{Path, PathBuf};

/// Laws whose gains equation 24 of the paper gives.
pub(super) const LAWS: [LawId; 3] = [LawId::DqPi, LawId::DqPiFixed, LawId::DqPiEuler];
const MAX_TIME_MS: f64 = 1_000.0;
/// The period must not be much shorter than one cycle of the plate, 31 µs for the paper's plate.
const MIN_PERIOD_US: f64 = 20.0;
const MAX_RESPONSE_PERIODS: f64 = 1_000.0;
/// The search first evaluates equation 24 for the response time. A time near 0 gives extreme gains.
const MIN_RESPONSE_PERIODS: f64 = 1e-3;
const MAX_DELAY_PERIODS: f64 = 20.0;
const MAX_SPREAD_PERCENT: f64 = 50.0;
/// Spread of K1 and τ in Tables I and II of the paper, percent.
const PAPER_SPREAD: Uncertainty = Uncertainty { gain_percent: Some(5.0), time_constant_percent: Some(6.0) };

#[derive(Debug, Args)]
#[command(group = ArgGroup::new("target_rig").args(["send", "board"]), after_help = "\
Examples:
  platebench tune --plate scenarios/plates/aluminium-198x138.toml     the paper's plate and response time
  platebench tune --plate plate.toml --response-ms 4 --delay-ms 0.52  over a serial line
  platebench tune --plate plate.toml --write my-scenario.toml         write the gains into [controller.gains]
  platebench tune --plate plate.toml --send serial:/dev/ttyACM0       send the gains to a board and play one step
  platebench tune --plate - < plate.toml                              the plate from standard input

Exit codes: 0 the target is met, 1 it cannot be met or the rig does not meet it, 2 wrong usage or invalid input,
3 the rig's step is inconclusive, 5 the rig could not be reached")]
pub(crate) struct TuneArgs {
    /// The plate file; default: the plate of the board
    #[arg(long, value_name = "FILE", required_unless_present = "board")]
    pub(super) plate: Option<PathBuf>,
    /// Law of the gains: dq-pi-euler uses equation 24 as printed, the others match the zero-order
    /// hold
    #[arg(long, value_name = "NAME", default_value = "dq-pi",
        value_parser = PossibleValuesParser::new(LAWS.map(LawId::name)))]
    law: String,
    /// Target for the 5 % response time of |W|, ms
    #[arg(long, value_name = "X", default_value_t = 2.0, value_parser = parse_positive_ms)]
    response_ms: f64,
    /// Control period, ms
    #[arg(long, value_name = "X", default_value_t = 1.0, value_parser = parse_positive_ms)]
    period_ms: f64,
    /// Loop delay from sampling to actuation, ms
    #[arg(long, value_name = "X", default_value_t = 0.0, value_parser = parse_delay_ms)]
    delay_ms: f64,
    /// Setpoint, µm
    #[arg(long, value_name = "X", default_value_t = 2.0, value_parser = parse_setpoint_um)]
    setpoint_um: f64,
    /// Normal force of the finger that the gains are designed for, N
    #[arg(long, value_name = "X", default_value_t = 0.0, value_parser = parse_force_n)]
    force_n: f64,
    /// Minimum phase margin of both loops, degrees
    #[arg(long, value_name = "X", default_value_t = 45.0, value_parser = parse_phase_margin)]
    phase_margin_deg: f64,
    /// Spread of K1 to either side, percent; default: [uncertainty] of the plate file, else 5
    #[arg(long, value_name = "X", value_parser = parse_percent)]
    gain_spread_percent: Option<f64>,
    /// Spread of the time constant to either side, percent; default: [uncertainty] of the plate
    /// file, else 6
    #[arg(long, value_name = "X", value_parser = parse_percent)]
    time_constant_spread_percent: Option<f64>,
    /// Number of random plates between the corners of the spread
    #[arg(long, value_name = "N", default_value_t = 64, value_parser = clap::value_parser!(u32).range(..=10_000))]
    samples: u32,
    /// Seed of the random plates
    #[arg(long, value_name = "S", default_value_t = 1)]
    seed: u64,
    /// Write the gains into [controller.gains] of this scenario, if the target is met
    #[arg(long, value_name = "SCENARIO")]
    pub(super) write: Option<PathBuf>,
    /// If the target is met, configure this rig with the gains, play one step, and compare the
    /// predicted with the measured response
    #[arg(long, value_name = "RIG")]
    pub(super) send: Option<RigSpec>,
    #[command(flatten)]
    pub(super) board: BoardArgs,
    /// Design gains although the plate file has values that no such plate has, such as a gain in
    /// the wrong unit
    #[arg(long)]
    pub(super) force: bool,
    /// The run folder of that step; default: a new folder below runs/
    #[arg(long, value_name = "FOLDER", requires = "target_rig")]
    pub(super) out: Option<PathBuf>,
    /// Format of standard output
    #[arg(long, value_enum, default_value_t = OutputFormat::Human)]
    pub(super) format: OutputFormat,
}

fn parse_positive_ms(text: &str) -> Result<f64, String> {
    parse_number(text, |ms| ms > 0.0 && ms <= MAX_TIME_MS, "a time in ms above 0, at most 1000")
}

fn parse_delay_ms(text: &str) -> Result<f64, String> {
    parse_number(text, |ms| (0.0..=MAX_TIME_MS).contains(&ms), "a time in ms from 0 to 1000")
}

fn parse_setpoint_um(text: &str) -> Result<f64, String> {
    parse_number(text, |um| um > 0.0 && um <= 1e3, "an amplitude in µm above 0, at most 1000")
}

fn parse_force_n(text: &str) -> Result<f64, String> {
    parse_number(text, |newton| (0.0..=100.0).contains(&newton), "a force in N from 0 to 100")
}

fn parse_phase_margin(text: &str) -> Result<f64, String> {
    parse_number(text, |degrees| (0.0..90.0).contains(&degrees), "degrees from 0 to below 90")
}

fn parse_percent(text: &str) -> Result<f64, String> {
    parse_number(text, |percent| (0.0..=MAX_SPREAD_PERCENT).contains(&percent), "a share in percent from 0 to 50")
}

impl TuneArgs {
    /// Returns the control period in µs. Fails if it is too short or not a multiple of 1 µs, or if
    /// response time or delay are outside the range that the period permits.
    fn period_us(&self) -> Result<u32, String> {
        let micros = self.period_ms * 1e3;
        if (micros - micros.round()).abs() > 1e-6 || micros < MIN_PERIOD_US {
            return Err(format!(
                "--period-ms {}: expected a multiple of 1 µs, at least {MIN_PERIOD_US} µs",
                self.period_ms
            ));
        }
        if self.response_ms > MAX_RESPONSE_PERIODS * self.period_ms {
            return Err(format!("--response-ms {}: expected at most {MAX_RESPONSE_PERIODS} periods", self.response_ms));
        }
        if self.response_ms < MIN_RESPONSE_PERIODS * self.period_ms {
            return Err(format!(
                "--response-ms {:e}: expected at least {MIN_RESPONSE_PERIODS} periods",
                self.response_ms
            ));
        }
        if self.delay_ms > MAX_DELAY_PERIODS * self.period_ms {
            return Err(format!("--delay-ms {}: expected at most {MAX_DELAY_PERIODS} periods", self.delay_ms));
        }
        Ok(micros.round() as u32)
    }

    pub(super) fn target<'a>(&self, plate: &'a Plate) -> Result<TuningTarget<'a>, String> {
        if self.force_n > 0.0 && !plate.depends_on_force() {
            return Err(format!(
                "--force-n {}: the plate file has no [finger], expected its damping_ratio there, or 0 N",
                self.force_n
            ));
        }
        let target = TuningTarget {
            plate,
            force_n: self.force_n,
            setpoint: self.setpoint_um,
            response: self.response_ms * 1e-3,
            period_us: self.period_us()?,
            delay: self.delay_ms * 1e-3,
            phase_margin_deg: self.phase_margin_deg,
        };
        let mode = target.mode();
        // A plate at the edge of the spread must resonate as well.
        if mode.omega0 > mode.sigma / (1.0 - MAX_SPREAD_PERCENT / 100.0) {
            Ok(target)
        } else {
            Err(format!("--force-n {}: the plate is overdamped, expected a smaller force", self.force_n))
        }
    }

    /// Takes each spread from the command line, else from the plate file, else from the paper.
    pub(super) fn spread(&self, path: &Path, plate: &Plate) -> Result<PlateSpread, Diagnostic> {
        let choose = |given: Option<f64>, key: &str, of: fn(&Uncertainty) -> Option<f64>| match of(&plate.uncertainty) {
            Some(known) if given.is_none() && known > MAX_SPREAD_PERCENT => {
                let message = format!(
                    "`uncertainty.{key}` is {known}, expected at most {MAX_SPREAD_PERCENT}: \
                     identify the plate better, or set a spread on the command line"
                );
                Err(Diagnostic::at_key(path, &read_text(path)?, &format!("uncertainty.{key}"), message))
            }
            known => Ok(given.or(known).or(of(&PAPER_SPREAD)).unwrap_or_default()),
        };
        Ok(PlateSpread {
            gain_percent: choose(self.gain_spread_percent, "gain_percent", |of| of.gain_percent)?,
            time_constant_percent: choose(self.time_constant_spread_percent, "time_constant_percent", |of| {
                of.time_constant_percent
            })?,
            samples: self.samples,
            seed: self.seed,
        })
    }

    pub(super) fn law(&self) -> LawId {
        LawId::from_name(&self.law).unwrap_or(LawId::DqPi)
    }

    pub(super) fn discretisation(&self) -> Discretisation {
        if self.law() == LawId::DqPiEuler { Discretisation::Forward } else { Discretisation::Matched }
    }
}
