//! `platebench suite`: measures how well the scenarios find faults, and searches for new ones.

#[cfg(feature = "emulated")]
mod coverage;
mod explore;
#[cfg(feature = "emulated")]
mod mutate;
mod trust;

use crate::failure::CommandResult;
use clap::{Args, Subcommand};
use platebench_report::Detail;

#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  platebench suite trust
  platebench suite coverage scenarios/paper --lcov coverage.info
  platebench suite mutate --sample 200 --out runs/mutants
  platebench suite explore --for 10m")]
pub(crate) struct SuiteArgs {
    #[command(subcommand)]
    action: SuiteAction,
}

#[derive(Debug, Subcommand)]
enum SuiteAction {
    /// Measure how well the scenarios catch faulty controllers: kill rate, false-alarm rate
    Trust(trust::TrustArgs),
    /// Show which lines of the firmware the scenarios execute (emulated rig)
    #[cfg(feature = "emulated")]
    Coverage(coverage::CoverageArgs),
    /// Change the firmware's machine code and check whether the scenarios notice (emulated rig)
    #[cfg(feature = "emulated")]
    Mutate(mutate::MutateArgs),
    /// Generate scenes from an operating envelope, check properties and reduce what fails to a
    /// minimal scenario
    Explore(explore::ExploreArgs),
}

pub(crate) fn suite(arguments: &SuiteArgs, detail: Detail) -> CommandResult {
    match &arguments.action {
        SuiteAction::Trust(arguments) => trust::trust(arguments, detail),
        #[cfg(feature = "emulated")]
        SuiteAction::Coverage(arguments) => coverage::coverage(arguments, detail),
        #[cfg(feature = "emulated")]
        SuiteAction::Mutate(arguments) => mutate::mutate(arguments, detail),
        SuiteAction::Explore(arguments) => explore::explore(arguments, detail),
    }
}
