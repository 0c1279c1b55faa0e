//! `platebench tune`: designs gains for a plate, writes them to a scenario or sends them to a rig.

mod verify;

use crate::board::BoardArgs;
use crate::exit::{CommandResult, Exit, Failure, OrInvalid};
use crate::options::{OutputFormat, parse_force_n, parse_number, parse_positive_ms, parse_setpoint_um};
use crate::stdio;
use clap::builder::PossibleValuesParser;
use clap::{ArgGroup, Args};
use platebench_design::loops::Discretisation;
use platebench_design::tuning::design::TuningTarget;
use platebench_design::tuning::verification::{VerificationStep, shortest_decimal};
use platebench_design::tuning::{
    DesignEvaluation, PlateSpread, TuningResult, document, infeasibility_reason, tune as design,
};
use platebench_model::scenario::load::{implausible_values, load_plate, require_no_effects};
use platebench_model::scenario::{Diagnostic, load, read_text};
use platebench_model::trace::OutputFile;
use platebench_plate::{Model, Plate, Time, Uncertainty};
use platebench_rig::RigSpec;
use platebench_wire::{Gains, LawId};
use schemars::JsonSchema;
use serde::Serialize;
use std::fs;
use std::io::Write;
use std::path::{Path, PathBuf};
use toml_edit::{DocumentMut, Item, Table, TableLike, Value};
use verify::{RigVerification, VerificationConfig, verify_on_rig};

/// Laws whose gains equation 24 of the paper gives.
const LAWS: [LawId; 3] = [LawId::DqPi, LawId::DqPiFixed, LawId::DqPiEuler];
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
    plate: Option<PathBuf>,
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
    #[arg(long, value_name = "SCENARIO", value_parser = stdio::parse_named_file)]
    write: Option<PathBuf>,
    /// If the target is met, configure this rig with the gains, play one step, and compare the
    /// predicted with the measured response
    #[arg(long, value_name = "RIG")]
    send: Option<RigSpec>,
    #[command(flatten)]
    board: BoardArgs,
    /// Design gains although the plate file has values that no such plate has, such as a gain in
    /// the wrong unit
    #[arg(long)]
    force: bool,
    /// The run folder of that step; default: a new folder below runs/
    #[arg(long, value_name = "FOLDER", requires = "target_rig")]
    out: Option<PathBuf>,
    /// Format of standard output
    #[arg(long, value_enum, default_value_t = OutputFormat::Human)]
    format: OutputFormat,
}

fn parse_delay_ms(text: &str) -> Result<f64, String> {
    parse_number(text, |ms| (0.0..=MAX_TIME_MS).contains(&ms), "a time in ms from 0 to 1000")
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

    fn target<'a>(&self, plate: &'a Plate) -> Result<TuningTarget<'a>, String> {
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
    fn spread(&self, path: &Path, plate: &Plate) -> Result<PlateSpread, Diagnostic> {
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

    fn law(&self) -> LawId {
        LawId::from_name(&self.law).unwrap_or(LawId::DqPi)
    }

    fn discretisation(&self) -> Discretisation {
        if self.law() == LawId::DqPiEuler { Discretisation::Forward } else { Discretisation::Matched }
    }
}

pub(crate) fn tune(arguments: &TuneArgs) -> CommandResult {
    let board = arguments.board.selection.find()?;
    let path = arguments.plate.as_ref().or_else(|| board.as_ref()?.plate.as_ref());
    let path = path.ok_or("the board has no plate, expected --plate FILE, or plate in boards.toml").or_invalid()?;
    let send = arguments.send.as_ref().or_else(|| board.as_ref().map(|board| &board.rig));
    let plate = load_plate(path)?;
    require_no_effects(path, &plate, "tune")?;
    let target = arguments.target(&plate).or_invalid()?;
    send.map(RigSpec::check).transpose().or_invalid()?;
    let spread = arguments.spread(path, &plate)?;
    refuse_implausible(path, &plate, arguments.force)?;
    let tuning = design(&target, arguments.discretisation(), &spread).or_invalid()?;
    if arguments.format == OutputFormat::Human {
        stdio::document(&document(&target, &spread, &tuning));
    }
    let (mut exit, mut reason) = if tuning.met {
        (Exit::Passed, "the target is met".to_owned())
    } else {
        (Exit::Failed, format!("the target cannot be met: {}", infeasibility_reason(&target, &tuning)))
    };
    let mut verification = None;
    if let Some(chosen) = &tuning.chosen {
        let gains = chosen.design.firmware_gains(target.period());
        if let Some(scenario) = &arguments.write {
            match write_gains(scenario, &target, gains) {
                Ok(message) => stdio::note(&message),
                Err(problem) => exit = Failure::from(problem).report(),
            }
        }
        if let (Some(rig), Exit::Passed) = (send, exit) {
            let config = VerificationConfig {
                board: &arguments.board,
                plate: path,
                step: VerificationStep {
                    target: &target,
                    law: arguments.law(),
                    gains,
                    peak_drive_vpp: chosen.plate.peak_drive_vpp,
                    real_time: false,
                },
                out: arguments.out.as_deref(),
            };
            match verify_on_rig(rig, &config) {
                Ok(done) => {
                    (exit, reason) = (done.exit, done.reason.clone());
                    verification = Some(done);
                }
                Err(failure) => {
                    (exit, reason) = (failure.report(), "the gains were not verified on the rig".to_owned());
                }
            }
        }
    } else if arguments.write.is_some() || send.is_some() {
        stdio::note("the target is not met: nothing was written or sent");
    }
    match arguments.format {
        OutputFormat::Human => {
            for (done, chosen) in verification.iter().zip(&tuning.chosen) {
                stdio::show("\n");
                stdio::document(&done.document(&chosen.plate));
            }
        }
        OutputFormat::Json => stdio::show_json(&TuneOutput {
            verdict: exit.word(),
            reason: &reason,
            measured: verification.as_ref(),
            ..TuneOutput::new(&target, &spread, arguments.law(), &tuning)
        }),
    }
    exit.show_verdict(&reason, arguments.format);
    Ok(exit)
}

/// Gains for a plate that cannot exist fail on the real plate, so `force` must ask for them.
fn refuse_implausible(path: &Path, plate: &Plate, force: bool) -> Result<(), Failure> {
    let mut problems = implausible_values(path, plate)?;
    if force {
        for problem in &problems {
            stdio::note(&format!("warning: {problem}"));
        }
        return Ok(());
    }
    for problem in &mut problems {
        problem.message += "; --force designs for it nevertheless";
    }
    if problems.is_empty() { Ok(()) } else { Err(problems.into()) }
}

#[derive(Serialize, JsonSchema)]
pub(crate) struct TuneOutput<'a> {
    /// Meaning of the exit code in one word.
    verdict: &'static str,
    reason: &'a str,
    /// Name in the plate file.
    plate: &'a str,
    law: &'static str,
    model: &'static str,
    demand: DemandOutput,
    spread: &'a PlateSpread,
    /// Gains for the firmware. `null` if the target cannot be met.
    gains: Option<GainsOutput>,
    /// Gains of the fastest design, if the target cannot be met.
    possible_gains: Option<GainsOutput>,
    tuning: &'a TuningResult,
    /// Step on the rig. `null` without `--send`.
    measured: Option<&'a RigVerification>,
}

#[derive(Serialize, JsonSchema)]
struct DemandOutput {
    response_ms: f64,
    period_ms: f64,
    delay_ms: f64,
    setpoint_um: f64,
    force_n: f64,
    phase_margin_deg: f64,
    drive_limit_vpp: f64,
}

/// Shortest decimal numbers that the firmware rounds to its gains.
#[derive(Serialize, JsonSchema)]
struct GainsOutput {
    amplitude_kp: f64,
    amplitude_ki: f64,
    frequency_kp: f64,
    frequency_ki: f64,
}

impl<'a> TuneOutput<'a> {
    fn new(target: &'a TuningTarget<'_>, spread: &'a PlateSpread, law: LawId, tuning: &'a TuningResult) -> Self {
        let gains = |evaluation: &DesignEvaluation| {
            let gains = evaluation.design.firmware_gains(target.period());
            GainsOutput {
                amplitude_kp: shortest_decimal(gains.amplitude_kp),
                amplitude_ki: shortest_decimal(gains.amplitude_ki),
                frequency_kp: shortest_decimal(gains.frequency_kp),
                frequency_ki: shortest_decimal(gains.frequency_ki),
            }
        };
        Self {
            verdict: "",
            reason: "",
            plate: &target.plate.name,
            law: law.name(),
            model: Model::Modal.name(),
            demand: DemandOutput {
                response_ms: target.response * 1e3,
                period_ms: target.period() * 1e3,
                delay_ms: target.delay * 1e3,
                setpoint_um: target.setpoint,
                force_n: target.force_n,
                phase_margin_deg: target.phase_margin_deg,
                drive_limit_vpp: target.plate.drive_limit_vpp,
            },
            spread,
            gains: tuning.chosen.as_ref().map(gains),
            possible_gains: tuning.possible.as_ref().map(gains),
            tuning,
            measured: None,
        }
    }
}

/// Returns a message for the user. Leaves the file unchanged and fails if plate, period or kind of
/// law do not match the gains, or if the law has a design delay.
fn write_gains(path: &Path, target: &TuningTarget<'_>, gains: Gains) -> Result<String, Diagnostic> {
    let refuse = |message: String| Diagnostic::for_file(path, message);
    let cannot_write = |error: std::io::Error| refuse(format!("cannot be written: {error}"));
    // Replaces the target of a symbolic link, so that the link stays.
    let file = fs::canonicalize(path).map_err(|error| refuse(format!("cannot be read: {error}")))?;
    let name = path.display().to_string();
    let scenario = load(&file, &name)?;
    if *scenario.design_plate() != *target.plate {
        return Err(scenario.diagnostic("plate", "differs from the tuned plate, so the gains do not fit"));
    }
    if scenario.controller.period.wrapping_micros() != target.period_us {
        let message =
            format!("differs from the period of the gains, expected {} ms", f64::from(target.period_us) / 1e3);
        return Err(scenario.diagnostic("controller.period_ms", message));
    }
    let law = LawId::from_name(&scenario.controller.law);
    if !law.is_some_and(|law| LAWS.contains(&law)) {
        let message = format!("`{}` does not use the gains of equation 24", scenario.controller.law);
        return Err(scenario.diagnostic("controller.law", message));
    }
    if scenario.controller.design_delay != Time::ZERO {
        let message = "the gains are for a law that does not compensate a delay; remove this key";
        return Err(scenario.diagnostic("controller.design_delay_ms", message));
    }
    let Gains { amplitude_kp, amplitude_ki, frequency_kp, frequency_ki } = gains;
    let wanted = [amplitude_kp, amplitude_ki, frequency_kp, frequency_ki];
    let has_gains = |scenario: &platebench_model::scenario::Scenario| {
        scenario.controller.gains.is_some_and(|gains| {
            [gains.amplitude_kp, gains.amplitude_ki, gains.frequency_kp, gains.frequency_ki].map(|gain| gain as f32)
                == wanted
        })
    };
    if has_gains(&scenario) {
        return Ok(format!("{name} has these gains already and is unchanged"));
    }
    let text = read_text(&file)?;
    let mut document: DocumentMut = text.parse().map_err(|error| refuse(format!("cannot be edited: {error}")))?;
    let keys = ["amplitude_kp", "amplitude_ki", "frequency_kp", "frequency_ki"];
    let pairs = keys.into_iter().zip(wanted.map(shortest_decimal));
    set_gains(&mut document, pairs).ok_or_else(|| refuse("`controller` is not a table".to_owned()))?;
    // The temporary file is in the same folder, which keeps relative paths valid.
    let mut edited_file = OutputFile::create(&file).map_err(|error| cannot_write(error.source))?;
    edited_file.write_all(document.to_string().as_bytes()).map_err(cannot_write)?;
    let permissions = fs::metadata(&file).map_err(cannot_write)?.permissions();
    edited_file.file().set_permissions(permissions).map_err(cannot_write)?;
    let edited = load(&edited_file.temporary_path(), &name).map_err(|problem| {
        refuse(format!("the edited file is not a valid scenario, so nothing was written: {}", problem.message))
    })?;
    if !has_gains(&edited) {
        return Err(refuse("the edited file does not have the gains, so nothing was written".to_owned()));
    }
    edited_file.commit().map_err(|error| cannot_write(error.source))?;
    Ok(format!("{name}: gains written into [controller.gains]"))
}

fn implicit_table() -> Item {
    let mut table = Table::new();
    table.set_implicit(true);
    Item::Table(table)
}

fn set_gains<'a>(document: &mut DocumentMut, pairs: impl Iterator<Item = (&'a str, f64)>) -> Option<()> {
    let root = document.as_table_mut();
    let inline = root.get("controller").is_some_and(Item::is_value);
    let controller: &mut dyn TableLike = root.entry("controller").or_insert_with(implicit_table).as_table_like_mut()?;
    let empty = || {
        if inline { Item::Value(Value::InlineTable(toml_edit::InlineTable::new())) } else { Item::Table(Table::new()) }
    };
    let gains = controller.entry("gains").or_insert_with(empty).as_table_like_mut()?;
    for (key, number) in pairs {
        match gains.get_mut(key).and_then(Item::as_value_mut) {
            Some(value) => {
                let decor = value.decor().clone();
                *value = Value::from(number);
                *value.decor_mut() = decor;
            }
            None => {
                gains.insert(key, toml_edit::value(number));
            }
        }
    }
    Some(())
}
