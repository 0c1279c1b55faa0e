//! `platebench replay`: sends recorded samples to another firmware and compares its commands.

use crate::exit::{CommandResult, Exit, Failure, OrInvalid};
use crate::identify::note_dialect;
use crate::options::{OutputFormat, law_names, rig_help};
use crate::shutdown::{EventSender, run_until_signal, unless_signalled};
use crate::stdio;
use clap::Args;
use platebench_engine::replay::{ReplayError, ReplayInput, read_recorded_trace, read_telemetry_table, replay as play};
use platebench_model::external_csv::ColumnMapping;
use platebench_model::record::RunOutcome;
use platebench_report::comparison::replay_document;
use platebench_rig::{CancelToken, ConnectOptions, RigSpec};
use platebench_verdict::replay::ReplayResult;
use std::path::PathBuf;

#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  platebench replay runs/tonight/traces/paper/fig13-closed-loop/000.csv --rig emulated
  platebench replay runs/tonight/traces/paper/fig13-closed-loop/000.csv --rig serial:/dev/ttyUSB0@921600
  platebench replay telemetry.csv --scenario scenarios/paper/fig13-closed-loop.toml --rig hosted \\
      --columns time=t:ms,drive=V:Vpp,frequency=f:Hz,wd=Wd:nm,wq=Wq:nm,setpoint=W:um

Columns as for identify, with setpoint (um, nm, m) besides; without that column the scenario's profile counts from the
first row.

Exit codes: 0 all commands inside the tube, 1 a command outside or a rule violated, 2 invalid input, 3 not everything
could be compared, 4 the controller does not announce the law, 5 the rig could not be reached or was lost")]
pub(crate) struct ReplayArgs {
    /// A trace of a run folder, or a table of telemetry
    #[arg(value_name = "RECORDING")]
    recording: PathBuf,
    #[arg(long, help = rig_help(), default_value = "hosted")]
    rig: RigSpec,
    /// Control law; default: the recorded one, or the scenario's
    #[arg(long, value_name = "NAME", value_parser = law_names())]
    law: Option<String>,
    /// Configure the controller from this scenario; default: the scenario of the run folder
    #[arg(long, value_name = "FILE")]
    scenario: Option<PathBuf>,
    /// Read the recording as a foreign table with these columns; needs --scenario
    #[arg(long, value_name = "COLUMNS", requires = "scenario")]
    columns: Option<ColumnMapping>,
    /// Format of standard output
    #[arg(long, value_enum, default_value_t = OutputFormat::Human)]
    format: OutputFormat,
}

pub(crate) fn replay(arguments: &ReplayArgs) -> CommandResult {
    arguments.rig.check().or_invalid()?;
    let input = read_input(arguments)?.with_law(arguments.law.as_deref());
    note_dialect(&arguments.recording, input.dialect);
    let rig = arguments.rig.clone();
    let work = move |cancel: &CancelToken, _: &mut EventSender<()>| {
        let options = ConnectOptions { cancel: cancel.clone(), ..ConnectOptions::default() };
        play(&input, &rig.to_string(), rig.has_own_clock(), &|| rig.connect_with(&options), cancel)
    };
    let result = unless_signalled(run_until_signal(None, work, |()| {}))?;
    stdio::show_result(arguments.format, &result, &replay_document(&result));
    Ok(exit_of(&result))
}

fn read_input(arguments: &ReplayArgs) -> Result<ReplayInput, ReplayError> {
    match (&arguments.columns, &arguments.scenario) {
        (Some(columns), Some(scenario)) => read_telemetry_table(&arguments.recording, columns, scenario),
        (_, scenario) => read_recorded_trace(&arguments.recording, scenario.as_deref()),
    }
}

fn exit_of(result: &ReplayResult) -> Exit {
    RunOutcome::of(result.verdict, result.rig_lost, result.safe_confirmed).into()
}

impl From<ReplayError> for Failure {
    fn from(error: ReplayError) -> Self {
        match error {
            ReplayError::Scenario(problem) => problem.into(),
            ReplayError::Run(error) => error.into(),
            ReplayError::Stored(error) => error.into(),
            ReplayError::NotApplicable(_) => Self::new(Exit::NothingToRun, &error),
            error => Self::invalid(&error),
        }
    }
}
