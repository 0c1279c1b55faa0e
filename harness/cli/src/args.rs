//! What can be said on the command line.

use clap::{Args, Parser, Subcommand, ValueEnum};
use platebench_plate::Tier;
use platebench_rig::RigSpec;
use platebench_scenario::model::AUTO;
use platebench_wire::LawId;
use std::path::PathBuf;

const EXIT_CODES: &str = "\
Examples:
  platebench new first-step             a commented scenario
  platebench check                      what is wrong with scenarios, without playing them
  platebench run --rig hosted           every scenario below scenarios/
  platebench COMMAND --help             examples for each command

Options may also stand in the environment (PLATEBENCH_RIG, ...) and in platebench.toml: docs/configuration.md.

Exit codes:
  0  everything passed
  1  something failed
  2  wrong usage or invalid input
  3  nothing failed but something is inconclusive
  4  there was nothing to run
  5  the rig could not be reached or was lost
  129, 130, 131, 143  ended by a closed terminal, Ctrl-C, Ctrl-\\ or SIGTERM, with the plate at 0 V";

/// A hardware-in-the-loop bench for controllers of an ultrasonic tactile plate.
#[derive(Debug, Parser)]
#[command(name = "platebench", version, after_help = EXIT_CODES)]
pub(crate) struct Arguments {
    #[command(subcommand)]
    pub(crate) command: Command,
    #[command(flatten)]
    pub(crate) logging: Logging,
}

/// How much is said about what goes on.
#[derive(Debug, Args)]
pub(crate) struct Logging {
    /// Say more: -v what is done, -vv how, -vvv everything
    #[arg(short, long, global = true, action = clap::ArgAction::Count)]
    pub(crate) verbose: u8,
    /// Say nothing but errors and the result
    #[arg(short, long, global = true, conflicts_with = "verbose")]
    pub(crate) quiet: bool,
    /// How the log on standard error is written; `PLATEBENCH_LOG` chooses what is in it
    #[arg(long, global = true, value_enum, default_value_t = LogFormat::Human, value_name = "FORMAT")]
    pub(crate) log_format: LogFormat,
}

/// `--log-format`
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum LogFormat {
    /// For people
    Human,
    /// One JSON object a line
    Json,
}

#[derive(Debug, Subcommand)]
pub(crate) enum Command {
    /// Play, record, judge, report
    Run(Run),
    /// The plate alone, in real time, for somebody else's controller
    Emulate(Emulate),
    /// Judge the traces of a stored run again, without a rig
    Judge(Judge),
    /// Render the report of a stored run again
    Report(Report),
    /// Hold responses against others, or against what was accepted, within a tolerance tube
    Compare(Compare),
    /// Golden traces: accept, list, review
    Baseline(Baseline),
    /// How well the suite catches faulty controllers: kill rate, false-alarm rate
    Trust(Trust),
    /// Where methods and loops fail: predicted limit beside the measured one, margins, maps
    Stability(crate::stability::Stability),
    /// Plate parameters from recorded steps, beside Tables I and II
    Identify(crate::identify::Identify),
    /// Speed against accuracy: plant methods and the bench's own, on one page
    Chart(crate::chart::Chart),
    /// A lab acceptance session and its record
    Accept(crate::accept::Accept),
    /// Controller gains for a plate, their margins, what can be met and what cannot
    Tune(crate::tune::Tune),
    /// The traces of a stored run as Parquet, MDF4, MCAP or CSV
    Export(crate::export::Export),
    /// Write a commented scenario to start from
    New(crate::new::New),
    /// Say all that is wrong with scenarios, plates and plans, without playing them
    Check(crate::check::Check),
    /// JSON Schema of the files that people write, for editors
    Schema(crate::schema::Schema),
    /// What a shell completes
    Completions(crate::completions::Completions),
    /// Manual pages
    Man(crate::man::Man),
}

/// `platebench run`
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  platebench run                                        every scenario below scenarios/ but those that show a limit
  platebench run scenarios/limits/one-period-delay.toml one scenario
  platebench run scenarios/paper --law dq-pi-euler      another law of the firmware
  platebench run --trials 300 --seed 7 --out /tmp/night
  platebench run scenarios/paper --watch                what is changed is played again")]
#[expect(clippy::struct_excessive_bools, reason = "each is a flag of its own on the command line")]
pub(crate) struct Run {
    /// Scenario files, or folders with everything below them
    #[arg(value_name = "SCENARIO|FOLDER", default_value = SCENARIOS)]
    pub(crate) scenarios: Vec<PathBuf>,
    /// What the controller runs on: hosted | emulated[:ELF] | exec:COMMAND | serial:PORT[@BAUD] | probe:CHIP[,elf=ELF][,port=PORT[@BAUD]]
    #[arg(long, default_value = "emulated")]
    pub(crate) rig: RigSpec,
    /// Control law of the firmware under test
    #[arg(long, value_name = "NAME", value_parser = clap::builder::PossibleValuesParser::new(LawId::ALL.map(LawId::name)))]
    pub(crate) law: Option<String>,
    /// How much of the plate is modelled, instead of what the scenarios say; auto: the cheapest that is good enough for what they expect
    #[arg(long, value_name = "NAME", value_parser = clap::builder::PossibleValuesParser::new(
        std::iter::once(AUTO).chain(Tier::ALL.map(Tier::name))))]
    pub(crate) model: Option<String>,
    /// How time passes for the plate; real-time on a serial port where not given, also on one beside a probe, else lockstep
    #[arg(long, value_enum)]
    pub(crate) clock: Option<Clock>,
    /// Plate seconds per wall second: 0.1 makes a line's delay ten times smaller for the plate
    #[arg(long, value_name = "X", default_value_t = 1.0, value_parser = time_scale)]
    pub(crate) time_scale: f64,
    /// Whose timer makes the control instants in real time
    #[arg(long, value_enum, default_value_t = Pacing::Bench)]
    pub(crate) pacing: Pacing,
    /// Let the time that an emulated line and controller take act on the plate as loop delay
    #[arg(long)]
    pub(crate) wire_time: bool,
    /// Whose plate it is
    #[arg(long, value_enum, default_value_t = PlateMode::Emulated, value_name = "MODE")]
    pub(crate) plate_mode: PlateMode,
    /// Ask nobody: with --plate-mode real, what needs a person stays undecided
    #[arg(long)]
    pub(crate) yes: bool,
    /// The run folder; a new one where not given
    #[arg(long, value_name = "FOLDER")]
    pub(crate) out: Option<PathBuf>,
    /// Below which folder new run folders are made
    #[arg(long, value_name = "FOLDER", default_value = "runs")]
    pub(crate) runs: PathBuf,
    /// Play what is changed again, until Ctrl-C: scenarios whose file, plate or profile is another one, all where the rig's ELF is
    #[arg(long)]
    pub(crate) watch: bool,
    /// Trials of each scenario
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=100_000))]
    pub(crate) trials: Option<u32>,
    /// Seed of each scenario's first trial
    #[arg(long, value_name = "S")]
    pub(crate) seed: Option<u64>,
    /// Trials that run at once; as many as there are cores where not given
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=1024))]
    pub(crate) jobs: Option<u16>,
    /// Play the K-th of N parts of the scenarios
    #[arg(long, value_name = "K/N")]
    pub(crate) shard: Option<Shard>,
    /// Show in the terminal what passes while it does; without a terminal nothing is shown
    #[arg(long)]
    pub(crate) live: bool,
    /// What standard output shows; json: what happens, a JSON object a line, the last of them the verdict
    #[arg(long, value_enum, default_value_t = Format::Human)]
    pub(crate) format: Format,
    #[command(flatten)]
    pub(crate) told: crate::told::Told,
}

/// `--clock`
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum Clock {
    /// The plate waits while a sample travels and the controller computes
    Lockstep,
    /// Every microsecond acts
    RealTime,
}

/// `--plate-mode`
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum PlateMode {
    /// The bench's, computed
    Emulated,
    /// The controller's own, with sensor and amplifier; the bench sends setpoints and asks a person for finger and heat
    Real,
}

/// `--pacing`
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum Pacing {
    /// The bench's: a sample triggers a control step
    Bench,
    /// The controller's own: it asks for each sample
    Target,
}

fn seconds(text: &str) -> Result<f64, String> {
    let seconds = text.parse().ok().filter(|seconds| (0.0..=1e7).contains(seconds));
    seconds.ok_or_else(|| "expected a number of seconds from 0 to 1e7".to_owned())
}

pub(crate) fn time_scale(text: &str) -> Result<f64, String> {
    let scale = text.parse().ok().filter(|scale| (0.001..=10.0).contains(scale));
    scale.ok_or_else(|| "expected a number from 0.001 to 10".to_owned())
}

/// `--format`
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum Format {
    /// A table
    Human,
    /// What programs read
    Json,
}

/// `--shard K/N`
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Shard {
    number: usize,
    of: usize,
}

impl Shard {
    /// True where the `index`-th thing, counted from 0, belongs to this part.
    pub(crate) fn holds(self, index: usize) -> bool {
        index % self.of == self.number - 1
    }
}

impl std::str::FromStr for Shard {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let parts = text.split_once('/').and_then(|(number, of)| Some((number.parse().ok()?, of.parse().ok()?)));
        match parts {
            Some((number, of)) if (1..=of).contains(&number) => Ok(Self { number, of }),
            _ => Err("expected K/N with K from 1 to N".to_owned()),
        }
    }
}

/// `platebench emulate`
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  platebench emulate --port pty                     says on which pseudo-terminal the plate is, and waits there
  platebench emulate --port /dev/ttyUSB0@921600 --scenario scenarios/paper/force-ramp.toml")]
pub(crate) struct Emulate {
    /// Where the controller is: PORT[@BAUD], or pty for a new pseudo-terminal
    #[arg(long, value_name = "PORT")]
    pub(crate) port: String,
    /// Plate, controller and profile; its last values hold on after its end
    #[arg(long, value_name = "FILE", default_value = "scenarios/paper/fig13-closed-loop.toml")]
    pub(crate) scenario: PathBuf,
    /// Control law to ask the controller for
    #[arg(long, value_name = "NAME", value_parser = clap::builder::PossibleValuesParser::new(LawId::ALL.map(LawId::name)))]
    pub(crate) law: Option<String>,
    /// Whose timer makes the control instants
    #[arg(long, value_enum, default_value_t = Pacing::Bench)]
    pub(crate) pacing: Pacing,
    /// End by itself after so many seconds
    #[arg(long, value_name = "S", value_parser = seconds)]
    pub(crate) seconds: Option<f64>,
    /// Show in the terminal what passes while it does; without a terminal nothing is shown
    #[arg(long)]
    pub(crate) live: bool,
}

/// `platebench trust`
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  platebench trust                          every scenario below scenarios/ but those that show a limit
  platebench trust --clean 30000 --seed 7 --out /tmp/trust
  platebench trust scenarios/faults --clean 0

Exit codes: 0 every fault caught for a right reason and no false alarm, 1 otherwise")]
pub(crate) struct Trust {
    /// Scenario files, or folders with everything below them
    #[arg(value_name = "SCENARIO|FOLDER", default_value = "scenarios")]
    pub(crate) scenarios: Vec<PathBuf>,
    /// Clean runs: one scenario each, in turn, with a plate and noise of its own
    #[arg(long, value_name = "N", default_value_t = 3_000)]
    pub(crate) clean: u32,
    /// Seed of the first clean run
    #[arg(long, value_name = "S", default_value_t = 31_415)]
    pub(crate) seed: u64,
    /// Scenarios that are played at once; as many as there are cores where not given
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=1024))]
    pub(crate) jobs: Option<u16>,
    /// What standard output shows
    #[arg(long, value_enum, default_value_t = Format::Human)]
    pub(crate) format: Format,
    /// Where trust.json and matrix.md are written
    #[arg(long, value_name = "FOLDER")]
    pub(crate) out: Option<PathBuf>,
}

/// `platebench judge`
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  platebench judge runs/tonight
  platebench judge runs/tonight --scenario scenarios/paper/fig13-closed-loop.toml    as if that had been expected")]
pub(crate) struct Judge {
    /// The run folder
    pub(crate) run: PathBuf,
    /// Expectations from this scenario file instead of the stored one of its name
    #[arg(long, value_name = "FILE")]
    pub(crate) scenario: Option<PathBuf>,
    /// What standard output shows
    #[arg(long, value_enum, default_value_t = Format::Human)]
    pub(crate) format: Format,
}

/// `platebench report`
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  platebench report runs/tonight                            runs/tonight/report.html
  platebench report runs/tonight --against runs/yesterday   runs/tonight/comparison.html, both runs side by side")]
pub(crate) struct Report {
    /// The run folder
    pub(crate) run: PathBuf,
    /// Another run to show side by side, in comparison.html
    #[arg(long, value_name = "RUN")]
    pub(crate) against: Option<PathBuf>,
    /// Where baselines are
    #[arg(long, value_name = "FOLDER", default_value = BASELINES)]
    pub(crate) baselines: PathBuf,
}

/// `platebench compare`
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  platebench compare runs/tonight --against baseline
  platebench compare runs/tonight --against runs/yesterday
  platebench compare board.csv --against scenarios/baselines/paper/fig13-closed-loop.toml

Exit codes: 0 all inside, 1 something outside, 3 nothing to compare with or not to the end")]
pub(crate) struct Compare {
    /// A trace or a run folder
    #[arg(value_name = "TRACE|RUN")]
    pub(crate) subject: PathBuf,
    /// What it is held against: a trace, a run folder, the .toml file of a baseline, or `baseline` for those of the scenarios
    #[arg(long, value_name = "TRACE|RUN|baseline")]
    pub(crate) against: String,
    /// Where baselines are
    #[arg(long, value_name = "FOLDER", default_value = BASELINES)]
    pub(crate) baselines: PathBuf,
    /// Where the worst place of each scenario is drawn; RUN/comparison for a run
    #[arg(long, value_name = "FOLDER")]
    pub(crate) draw: Option<PathBuf>,
    /// What standard output shows
    #[arg(long, value_enum, default_value_t = Format::Human)]
    pub(crate) format: Format,
}

/// What is played where nothing is named.
pub(crate) const SCENARIOS: &str = "scenarios";
pub(crate) const BASELINES: &str = "scenarios/baselines";

/// `platebench baseline`
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  platebench baseline diff runs/tonight
  platebench baseline accept runs/tonight
  platebench baseline list")]
pub(crate) struct Baseline {
    #[command(subcommand)]
    pub(crate) action: BaselineAction,
}

/// What to do with baselines.
#[derive(Debug, Subcommand)]
pub(crate) enum BaselineAction {
    /// Take what a run played as golden, where it passed, and say what that changes
    Accept {
        /// The run folder
        run: PathBuf,
        /// Where baselines are
        #[arg(long, value_name = "FOLDER", default_value = BASELINES)]
        baselines: PathBuf,
        /// Where trials differ: the share of further trials that may leave the learned tube although nothing has changed
        #[arg(long, value_name = "SHARE", default_value_t = 0.05, value_parser = share)]
        false_alarm_rate: f64,
    },
    /// Show what is golden, of all scenarios or of those of a run
    List {
        /// The run folder
        run: Option<PathBuf>,
        /// Where baselines are
        #[arg(long, value_name = "FOLDER", default_value = BASELINES)]
        baselines: PathBuf,
    },
    /// Show what accepting a run would change, without doing it
    Diff {
        /// The run folder
        run: PathBuf,
        /// Where baselines are
        #[arg(long, value_name = "FOLDER", default_value = BASELINES)]
        baselines: PathBuf,
        /// As for accept
        #[arg(long, value_name = "SHARE", default_value_t = 0.05, value_parser = share)]
        false_alarm_rate: f64,
    },
}

fn share(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(share) if (1e-4..=0.5).contains(&share) => Ok(share),
        _ => Err("expected a share from 0.0001 to 0.5".to_owned()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::CommandFactory;

    #[test]
    fn the_definition_is_consistent() {
        Arguments::command().debug_assert();
    }

    #[test]
    fn every_command_shows_examples() {
        for command in Arguments::command().get_subcommands() {
            let help = command.get_after_help().map(ToString::to_string).unwrap_or_default();
            let call = format!("platebench {}", command.get_name());
            assert!(help.starts_with("Examples:\n") && help.contains(&call), "{}: {help}", command.get_name());
        }
    }

    #[test]
    fn shards_part_everything_once() {
        let shards = ["1/3", "2/3", "3/3"].map(|text| text.parse::<Shard>().unwrap());
        for index in 0..20 {
            assert_eq!(shards.iter().filter(|shard| shard.holds(index)).count(), 1, "{index}");
        }
        for wrong in ["0/3", "4/3", "1", "1/0", "a/b", ""] {
            assert!(wrong.parse::<Shard>().is_err(), "{wrong}");
        }
    }

    #[test]
    fn time_scales_are_bounded_on_both_sides() {
        for (text, expected) in [("0.1", 0.1), ("0.001", 0.001), ("10", 10.0)] {
            assert_eq!(time_scale(text), Ok(expected));
        }
        for wrong in ["0", "-1", "0.0009", "10.1", "NaN", "inf", "fast", ""] {
            assert!(time_scale(wrong).is_err(), "{wrong}");
        }
    }
}
