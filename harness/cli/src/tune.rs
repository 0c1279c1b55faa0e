//! `platebench tune`: gains for a plate, into a scenario or to a rig.

mod send;
mod write;

use crate::args::Format;
use crate::exit::Exit;
use crate::output;
use crate::plate_file;
use clap::Args;
use clap::builder::PossibleValuesParser;
use platebench_analysis::tuning::design::{Demand, Reading};
use platebench_analysis::tuning::spread::Spread;
use platebench_analysis::tuning::{Figures, Tuning, shown, tune as find};
use platebench_plate::{Plate, Tier, Uncertainty};
use platebench_rig::RigSpec;
use platebench_scenario::Diagnostic;
use platebench_wire::{Gains, LawId};
use send::Verified;
use serde_json::{Value, json};
use std::path::PathBuf;

/// Laws whose gains are those of equation 24.
const LAWS: [LawId; 3] = [LawId::DqPi, LawId::DqPiFixed, LawId::DqPiEuler];
const LONGEST_MS: f64 = 1_000.0;
/// Finer periods are no control period of this plate, and a response is at most so many of them.
const SHORTEST_PERIOD_US: f64 = 20.0;
const LONGEST_RESPONSE_PERIODS: f64 = 1_000.0;
const LONGEST_DELAY_PERIODS: f64 = 20.0;
const LARGEST_SPREAD: f64 = 50.0;
/// By how much K1 and τ of Tables I and II stray, percent.
const PAPER_SPREAD: Uncertainty = Uncertainty { gain_percent: Some(5.0), time_constant_percent: Some(6.0) };

/// `platebench tune`
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  platebench tune --plate scenarios/plates/aluminium-198x138.toml     the paper's demand, its plate, equation 24 in three readings
  platebench tune --plate plate.toml --response-ms 4 --delay-ms 0.52  over a serial line
  platebench tune --plate plate.toml --write my-scenario.toml         the gains go into [controller.gains]
  platebench tune --plate plate.toml --send serial:/dev/ttyACM0       the gains go to a board, which then plays one step

Exit codes: 0 the demand is met, 1 it cannot be met or the rig does not meet it, 2 wrong usage or invalid input, 3 the rig's step is inconclusive,
5 the rig could not be reached")]
pub(crate) struct Tune {
    /// The plate file
    #[arg(long, value_name = "FILE")]
    plate: PathBuf,
    /// The law that the gains are for: dq-pi-euler has equation 24 as printed, the others matched to the zero-order hold
    #[arg(long, value_name = "NAME", default_value = "dq-pi", value_parser = PossibleValuesParser::new(LAWS.map(LawId::name)))]
    law: String,
    /// Demanded 5 % response time of |W|, ms
    #[arg(long, value_name = "X", default_value_t = 2.0, value_parser = positive_ms)]
    response_ms: f64,
    /// Control period, ms
    #[arg(long, value_name = "X", default_value_t = 1.0, value_parser = positive_ms)]
    period_ms: f64,
    /// Loop delay from sampling to actuation, ms
    #[arg(long, value_name = "X", default_value_t = 0.0, value_parser = delay_ms)]
    delay_ms: f64,
    /// Setpoint, µm
    #[arg(long, value_name = "X", default_value_t = 2.0, value_parser = setpoint_um)]
    setpoint_um: f64,
    /// Normal force of the finger that the gains are designed for, N
    #[arg(long, value_name = "X", default_value_t = 0.0, value_parser = force_n)]
    force_n: f64,
    /// Phase margin that both loops are to have, degrees
    #[arg(long, value_name = "X", default_value_t = 45.0, value_parser = phase_margin)]
    phase_margin_deg: f64,
    /// How far K1 may be from the plate file's, percent to either side; its [uncertainty] where not given, 5 where it has none
    #[arg(long, value_name = "X", value_parser = percent)]
    gain_spread_percent: Option<f64>,
    /// How far the time constant may be from the plate file's, percent to either side; its [uncertainty] where not given, 6 where it has none
    #[arg(long, value_name = "X", value_parser = percent)]
    time_constant_spread_percent: Option<f64>,
    /// Plates that are drawn from between the corners of the spread
    #[arg(long, value_name = "N", default_value_t = 64, value_parser = clap::value_parser!(u32).range(..=10_000))]
    samples: u32,
    /// What they are drawn from
    #[arg(long, value_name = "S", default_value_t = 1)]
    seed: u64,
    /// Write the gains into the [controller.gains] of this scenario, where the demand is met
    #[arg(long, value_name = "SCENARIO")]
    write: Option<PathBuf>,
    /// Configure this rig with the gains, where the demand is met, and play one step: predicted beside measured
    #[arg(long, value_name = "RIG")]
    send: Option<RigSpec>,
    /// The run folder of that step; a new one below runs/ where not given
    #[arg(long, value_name = "FOLDER", requires = "send")]
    out: Option<PathBuf>,
    /// What standard output shows
    #[arg(long, value_enum, default_value_t = Format::Human)]
    format: Format,
}

fn number(text: &str, holds: impl Fn(f64) -> bool, expected: &str) -> Result<f64, String> {
    let number = text.parse().ok().filter(|number| holds(*number));
    number.ok_or_else(|| format!("expected {expected}"))
}

fn positive_ms(text: &str) -> Result<f64, String> {
    number(text, |ms| ms > 0.0 && ms <= LONGEST_MS, "a time in ms above 0, at most 1000")
}

fn delay_ms(text: &str) -> Result<f64, String> {
    number(text, |ms| (0.0..=LONGEST_MS).contains(&ms), "a time in ms from 0 to 1000")
}

fn setpoint_um(text: &str) -> Result<f64, String> {
    number(text, |um| um > 0.0 && um <= 1e3, "an amplitude in µm above 0, at most 1000")
}

fn force_n(text: &str) -> Result<f64, String> {
    number(text, |newton| (0.0..=100.0).contains(&newton), "a force in N from 0 to 100")
}

fn phase_margin(text: &str) -> Result<f64, String> {
    number(text, |degrees| (0.0..90.0).contains(&degrees), "degrees from 0 to below 90")
}

fn percent(text: &str) -> Result<f64, String> {
    number(text, |percent| (0.0..=LARGEST_SPREAD).contains(&percent), "a share in percent from 0 to 50")
}

impl Tune {
    /// The control period in whole microseconds, with which everything else goes together; why not where it does not.
    fn period_us(&self) -> Result<u32, String> {
        let micros = self.period_ms * 1e3;
        if (micros - micros.round()).abs() > 1e-6 || micros < SHORTEST_PERIOD_US {
            return Err(format!(
                "--period-ms {}: expected whole microseconds, at least {SHORTEST_PERIOD_US}",
                self.period_ms
            ));
        }
        if self.response_ms > LONGEST_RESPONSE_PERIODS * self.period_ms {
            return Err(format!(
                "--response-ms {}: expected at most {LONGEST_RESPONSE_PERIODS} periods",
                self.response_ms
            ));
        }
        if self.delay_ms > LONGEST_DELAY_PERIODS * self.period_ms {
            return Err(format!("--delay-ms {}: expected at most {LONGEST_DELAY_PERIODS} periods", self.delay_ms));
        }
        Ok(micros.round() as u32)
    }

    fn demand<'a>(&self, plate: &'a Plate) -> Result<Demand<'a>, String> {
        let demand = Demand {
            plate,
            force_n: self.force_n,
            setpoint: self.setpoint_um,
            response: self.response_ms * 1e-3,
            period_us: self.period_us()?,
            delay: self.delay_ms * 1e-3,
            phase_margin_deg: self.phase_margin_deg,
        };
        let mode = demand.mode();
        // The plates of the spread swing as well.
        let heaviest = mode.sigma / (1.0 - LARGEST_SPREAD / 100.0);
        if mode.omega0 > heaviest {
            Ok(demand)
        } else {
            Err(format!("--force-n {}: the plate would not swing any more", self.force_n))
        }
    }

    /// How far other plates are from this one: what the command line says, else the plate file, else the paper.
    fn spread(&self, plate: &Plate) -> Result<Spread, Diagnostic> {
        let chosen = |said: Option<f64>, key: &str, of: fn(&Uncertainty) -> Option<f64>| match (
            said,
            of(&plate.uncertainty),
        ) {
            (None, Some(known)) if known > LARGEST_SPREAD => Err(plate_file::fault(
                &self.plate,
                &format!("uncertainty.{key}"),
                format!(
                    "`uncertainty.{key}` is {known}, expected at most {LARGEST_SPREAD}: identify the plate better, or name a spread on the command line"
                ),
            )),
            (said, known) => Ok(said.or(known).or(of(&PAPER_SPREAD)).unwrap_or_default()),
        };
        Ok(Spread {
            gain_percent: chosen(self.gain_spread_percent, "gain_percent", |of| of.gain_percent)?,
            time_constant_percent: chosen(self.time_constant_spread_percent, "time_constant_percent", |of| {
                of.time_constant_percent
            })?,
            samples: self.samples,
            seed: self.seed,
        })
    }

    fn law(&self) -> LawId {
        LawId::from_name(&self.law).unwrap_or(LawId::DqPi)
    }
}

/// Tunes, shows, writes, sends.
pub(crate) fn tune(arguments: &Tune) -> Exit {
    let invalid = |message: &str| {
        output::error(message);
        Exit::Invalid
    };
    let plate = match plate_file::read(&arguments.plate) {
        Ok(plate) => plate,
        Err(fault) => {
            output::diagnostic(&fault);
            return Exit::Invalid;
        }
    };
    let demand = match arguments.demand(&plate) {
        Ok(demand) => demand,
        Err(message) => return invalid(&message),
    };
    if let Some(Err(error)) = arguments.send.as_ref().map(RigSpec::check) {
        return invalid(&error.to_string());
    }
    let law = arguments.law();
    let reading = if law == LawId::DqPiEuler { Reading::Forward } else { Reading::Matched };
    let spread = match arguments.spread(&plate) {
        Ok(spread) => spread,
        Err(fault) => {
            output::diagnostic(&fault);
            return Exit::Invalid;
        }
    };
    let tuning = match find(&demand, reading, &spread) {
        Ok(tuning) => tuning,
        Err(error) => return invalid(&error.to_string()),
    };
    if arguments.format == Format::Human {
        output::show(&shown::text(&demand, &spread, &tuning));
    }
    let (mut exit, mut verified) = (if tuning.met { Exit::Passed } else { Exit::Failed }, None);
    if let Some(chosen) = &tuning.chosen {
        let gains = chosen.design.gains(demand.period());
        if let Some(scenario) = &arguments.write {
            match write::write(scenario, &demand, gains) {
                Ok(done) => output::note(&done),
                Err(fault) => {
                    output::diagnostic(&fault);
                    exit = Exit::Invalid;
                }
            }
        }
        if let (Some(rig), Exit::Passed) = (&arguments.send, exit) {
            let order =
                send::Order { plate: &arguments.plate, demand: &demand, law, gains, out: arguments.out.as_deref() };
            (exit, verified) = match send::send(rig, &order) {
                Ok(done) => (done.exit, Some(done)),
                Err(exit) => (exit, None),
            };
        }
    } else if arguments.write.is_some() || arguments.send.is_some() {
        output::note("the demand is not met: nothing was written or sent");
    }
    match arguments.format {
        Format::Human => verified.iter().for_each(|verified| output::show(&beside(&tuning, verified))),
        Format::Json => show_json(&demand, &spread, law, &tuning, verified.as_ref()),
    }
    exit
}

/// Predicted beside measured.
fn beside(tuning: &Tuning, verified: &Verified) -> String {
    let Some(Figures { plate, .. }) = &tuning.chosen else { return String::new() };
    let row = |what: &str, predicted: Option<f64>, measured: Option<f64>| {
        let shown = |value: Option<f64>| value.map_or_else(|| "–".to_owned(), |value| format!("{value:.3}"));
        format!("  {what:<16} {:>10} {:>10}\n", shown(predicted), shown(measured))
    };
    format!(
        "\n{} on {} took the gains: run folder {}\n  {:<16} {:>10} {:>10}\n{}{}{}",
        verified.firmware,
        verified.rig,
        verified.folder.display(),
        "",
        "predicted",
        "measured",
        row("settling, ms", plate.settling_ms, verified.settling_ms),
        row("overshoot, %", Some(plate.overshoot_percent), verified.overshoot_percent),
        row("peak drive, Vpp", Some(plate.peak_drive_vpp), verified.peak_drive_vpp),
    )
}

fn show_json(demand: &Demand<'_>, spread: &Spread, law: LawId, tuning: &Tuning, verified: Option<&Verified>) {
    let gains = |figures: &Figures| {
        let Gains { amplitude_kp, amplitude_ki, frequency_kp, frequency_ki } = figures.design.gains(demand.period());
        json!({
            "amplitude_kp": write::shortest(amplitude_kp), "amplitude_ki": write::shortest(amplitude_ki),
            "frequency_kp": write::shortest(frequency_kp), "frequency_ki": write::shortest(frequency_ki),
        })
    };
    let told: Value = json!({
        "plate": demand.plate.name,
        "law": law.name(),
        "model": Tier::Modal.name(),
        "demand": {
            "response_ms": demand.response * 1e3, "period_ms": demand.period() * 1e3, "delay_ms": demand.delay * 1e3,
            "setpoint_um": demand.setpoint, "force_n": demand.force_n, "phase_margin_deg": demand.phase_margin_deg,
            "drive_limit_vpp": demand.plate.drive_limit_vpp,
        },
        "spread": {
            "gain_percent": spread.gain_percent, "time_constant_percent": spread.time_constant_percent,
            "samples": spread.samples, "seed": spread.seed,
        },
        "gains": tuning.chosen.as_ref().map(gains),
        "possible_gains": tuning.possible.as_ref().map(gains),
        "tuning": tuning,
        "measured": verified.map(|verified| json!({
            "rig": verified.rig, "firmware": verified.firmware, "folder": verified.folder,
            "settling_ms": verified.settling_ms, "overshoot_percent": verified.overshoot_percent,
            "peak_drive_vpp": verified.peak_drive_vpp,
        })),
    });
    match serde_json::to_string_pretty(&told) {
        Ok(text) => output::show(&format!("{text}\n")),
        Err(fault) => output::error(&format!("the tuning cannot be shown as JSON: {fault}")),
    }
}
