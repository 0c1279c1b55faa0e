use crate::board_args::BoardArgs;
use crate::clock::ClockRequest;
use crate::options::{
    ClockArg, OutputFormat, PacingArg, PlateModeArg, SCENARIOS, law_names, parse_keep_traces, parse_time_scale,
    rig_help,
};
use crate::outputs::{Outputs, RESULTS};
use crate::selection::TagFilter;
use clap::Args;
use clap::builder::PossibleValuesParser;
use platebench_model::record::{KeepTraces, Overrides};
use platebench_model::scenario::{AUTO_MODEL, MAX_TRIALS};
use platebench_plate::Tier;
use platebench_rig::RigSpec;
use std::path::PathBuf;
use std::str::FromStr;
use std::time::Duration;

// Headings of the help. Options without a heading are the common ones and come first.
const EXTENT: &str = "Extent of a run";
const PLATE: &str = "Plate, clock and line";

#[derive(Debug, Clone, Args)]
#[command(after_help = "\
Examples:
  platebench run                                        every scenario below scenarios/ without `only_if_named`
  platebench run scenarios/limits/one-period-delay.toml one scenario
  platebench run scenarios/paper --law dq-pi-euler      another law of the firmware
  platebench run --trials 300 --seed 7 --out /tmp/night
  platebench run scenarios/paper --watch                run changed scenarios again
  platebench run --list --tag paper --not-tag acceptance      list scenarios and limits without playing them")]
#[expect(clippy::struct_excessive_bools, reason = "each is a flag of its own on the command line")]
pub(crate) struct RunArgs {
    /// Scenario files, or folders with everything below them
    #[arg(value_name = "SCENARIO|FOLDER", default_value = SCENARIOS)]
    pub(crate) scenarios: Vec<PathBuf>,
    #[arg(long, help = rig_help(), default_value = "emulated", conflicts_with = "board")]
    pub(crate) rig: RigSpec,
    /// Control law of the firmware under test
    #[arg(long, value_name = "NAME", value_parser = law_names())]
    pub(crate) law: Option<String>,
    /// Trials of each scenario
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=i64::from(MAX_TRIALS)))]
    pub(crate) trials: Option<u32>,
    /// Seed of each scenario's first trial
    #[arg(long, value_name = "S")]
    pub(crate) seed: Option<u64>,
    #[command(flatten)]
    pub(crate) tags: TagFilter,
    /// The run folder; default: a new folder below --runs
    #[arg(long, value_name = "FOLDER")]
    pub(crate) out: Option<PathBuf>,
    /// List the scenarios with tags, limits and windows instead of playing them
    #[arg(long, conflicts_with = "watch")]
    pub(crate) list: bool,
    /// Run changed scenarios again until Ctrl-C: a scenario if its file, plate or profile changed,
    /// all if the ELF changed
    #[arg(long)]
    pub(crate) watch: bool,
    /// Live view in the terminal; ignored without a terminal
    #[arg(long)]
    pub(crate) live: bool,
    /// Format of standard output; json: one event per line, the last is the verdict
    #[arg(long, value_enum, default_value_t = OutputFormat::Human)]
    pub(crate) format: OutputFormat,
    /// Trials that run at once; default: one per core
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=1024))]
    pub(crate) jobs: Option<u16>,
    /// Run the K-th of N parts of the scenarios
    #[arg(long, help_heading = EXTENT, value_name = "K/N")]
    pub(crate) shard: Option<Shard>,
    /// Fail if the controller does not announce a law or capability that a scenario needs
    #[arg(long, help_heading = EXTENT)]
    pub(crate) require_all: bool,
    /// Start no further trial once a scenario failed; scenarios without all trials are inconclusive
    #[arg(long, help_heading = EXTENT)]
    pub(crate) fail_fast: bool,
    #[command(flatten)]
    pub(crate) board: BoardArgs,
    /// Model of the plate, instead of the scenario's
    #[arg(long, help_heading = PLATE, value_name = "NAME", value_parser = PossibleValuesParser::new(
        std::iter::once(AUTO_MODEL).chain(Tier::ALL.map(Tier::name))))]
    pub(crate) model: Option<String>,
    /// Clock of the plate; default: real-time on a serial port, lockstep otherwise
    #[arg(long, help_heading = PLATE, value_enum)]
    pub(crate) clock: Option<ClockArg>,
    /// Plate seconds per wall second: at 0.1 the delay of the line is ten times smaller for the
    /// plate
    #[arg(long, help_heading = PLATE, value_name = "X", default_value_t = 1.0, value_parser = parse_time_scale)]
    pub(crate) time_scale: f64,
    /// Timer of the control instants in real time
    #[arg(long, help_heading = PLATE, value_enum, default_value_t = PacingArg::Bench)]
    pub(crate) pacing: PacingArg,
    /// Let the emulated line and computing time act on the plate as loop delay
    #[arg(long, help_heading = PLATE)]
    pub(crate) wire_time: bool,
    /// Lockstep over a line: time to wait for a reply before it counts as missed, ms
    #[arg(long, help_heading = PLATE, value_name = "MS", default_value = "500", value_parser = parse_reply_timeout)]
    pub(crate) reply_timeout: Duration,
    /// Which plate is driven
    #[arg(long, help_heading = PLATE, value_enum, default_value_t = PlateModeArg::Emulated, value_name = "MODE")]
    pub(crate) plate_mode: PlateModeArg,
    /// Ask no operator; with --plate-mode real, everything that needs one stays inconclusive
    #[arg(long, help_heading = PLATE)]
    pub(crate) yes: bool,
    /// Emulated rig: wait for a debugger on this port of the local host; the debugger controls the
    /// chip while the plate waits
    #[arg(long, help_heading = PLATE, value_name = "PORT", conflicts_with_all = ["watch", "jobs", "board", "list"])]
    pub(crate) gdb: Option<u16>,
    /// Parent folder of new run folders
    #[arg(long, help_heading = RESULTS, value_name = "FOLDER", default_value = "runs")]
    pub(crate) runs: PathBuf,
    /// Which traces to store: all, failing, none or worst:N of each scenario; `report --rejudge`
    /// needs all
    #[arg(long, help_heading = RESULTS, value_name = "WHICH", value_parser = parse_keep_traces, default_value = "all")]
    pub(crate) keep_traces: KeepTraces,
    #[command(flatten)]
    pub(crate) outputs: Outputs,
}

impl RunArgs {
    pub(super) fn clock(&self) -> ClockRequest<'_> {
        ClockRequest {
            rig: &self.rig,
            clock: self.clock,
            time_scale: self.time_scale,
            pacing: self.pacing,
            plate_mode: self.plate_mode,
            wire_time: self.wire_time,
        }
    }

    /// `selection` is the digest of the scenarios before the shard was taken of them.
    pub(crate) fn overrides(&self, selection: Option<String>) -> Overrides {
        Overrides {
            law: self.law.clone(),
            trials: self.trials,
            seed: self.seed,
            model: self.model.clone(),
            require_all: self.require_all,
            fail_fast: self.fail_fast,
            keep_traces: self.keep_traces,
            board: self.board.selection.board.clone(),
            shard: self.shard.map(|shard| [shard.number, shard.count]),
            selection,
        }
    }
}

fn parse_reply_timeout(text: &str) -> Result<Duration, String> {
    let ms: u32 = text.parse().unwrap_or(0);
    (1..=60_000)
        .contains(&ms)
        .then(|| Duration::from_millis(ms.into()))
        .ok_or_else(|| "expected 1 to 60000 ms".to_owned())
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Shard {
    number: usize,
    count: usize,
}

impl Shard {
    /// `index` is the position of a scenario in the list, from 0.
    pub(crate) fn contains(self, index: usize) -> bool {
        index % self.count == self.number - 1
    }
}

impl FromStr for Shard {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let parts = text.split_once('/').and_then(|(number, of)| Some((number.parse().ok()?, of.parse().ok()?)));
        match parts {
            Some((number, of)) if (1..=of).contains(&number) => Ok(Self { number, count: of }),
            _ => Err("expected K/N with K from 1 to N".to_owned()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_scenario_is_in_one_shard() {
        let shards = ["1/3", "2/3", "3/3"].map(|text| text.parse::<Shard>().unwrap());
        for index in 0..20 {
            assert_eq!(shards.iter().filter(|shard| shard.contains(index)).count(), 1, "{index}");
        }
        for wrong in ["0/3", "4/3", "1", "1/0", "a/b", ""] {
            assert!(wrong.parse::<Shard>().is_err(), "{wrong}");
        }
    }
}
