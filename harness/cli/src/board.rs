//! `platebench board`: lists the boards of the inventory, ends a quarantine, or runs a soak.

mod soak;

pub(crate) use soak::write_page as write_soak_page;

use crate::exit::Exit;
use crate::failure::CommandResult;
use crate::options::OutputFormat;
use crate::stdio;
use clap::{Args, Subcommand};
use platebench_lab::boards::{BoardError, Inventory, clear, list, status_table};
use platebench_report::Detail;
use std::path::PathBuf;

#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  platebench board list
  platebench board clear left --reason 'amplifier checked, 0 V measured'
  platebench board soak --board left --hours 8")]
pub(crate) struct BoardCommandArgs {
    #[command(subcommand)]
    action: BoardAction,
}

#[derive(Debug, Subcommand)]
enum BoardAction {
    /// List the boards: state, holder, reason of a quarantine, last run
    #[command(after_help = "\
Examples:
  platebench board list                     state, holder, reason of a quarantine, last run
  platebench board list --format json

Exit codes: 0 listed, 2 invalid inventory")]
    List {
        #[command(flatten)]
        inventory: InventoryArgs,
        /// Format of standard output
        #[arg(long, value_enum, default_value_t = OutputFormat::Human)]
        format: OutputFormat,
    },
    /// End the quarantine of a board that a person has checked
    #[command(after_help = "\
Examples:
  platebench board clear left --reason 'amplifier checked, 0 V measured'

Exit codes: 0 cleared, 2 unknown board or not in quarantine, 5 the board is held")]
    Clear {
        /// Name of the board
        name: String,
        /// What was checked; stored with the time and the user
        #[arg(long, value_name = "TEXT")]
        reason: String,
        #[command(flatten)]
        inventory: InventoryArgs,
    },
    /// Play scenarios in rotation on a board for hours
    Soak(soak::SoakArgs),
}

#[derive(Debug, Args)]
struct InventoryArgs {
    /// Board inventory; default: the nearest boards.toml, from the working directory upwards
    #[arg(long, value_name = "FILE")]
    boards: Option<PathBuf>,
}

impl InventoryArgs {
    fn open(&self) -> Result<Inventory, BoardError> {
        Inventory::open(self.boards.as_deref())
    }
}

pub(crate) fn board(arguments: &BoardCommandArgs, detail: Detail) -> CommandResult {
    match &arguments.action {
        BoardAction::List { inventory, format } => {
            let boards = list(&inventory.open()?)?;
            stdio::show_as(*format, &boards, || status_table(&boards).lines().join("\n") + "\n");
        }
        BoardAction::Clear { name, reason, inventory } => {
            clear(&inventory.open()?, name, reason)?;
            stdio::note(&format!("board {name} is free"));
        }
        BoardAction::Soak(arguments) => return soak::soak(arguments, detail),
    }
    Ok(Exit::Passed)
}
