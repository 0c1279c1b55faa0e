//! `platebench boards`: lists the boards of the inventory, or ends a quarantine.

use crate::exit::Exit;
use crate::failure::CommandResult;
use crate::options::OutputFormat;
use crate::stdio;
use clap::{Args, Subcommand};
use platebench_lab::boards::{Inventory, clear, list, status_table};
use std::path::PathBuf;

#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  platebench boards                         state, holder, reason of a quarantine, last run
  platebench boards --format json
  platebench boards clear left --reason 'amplifier checked, 0 V measured'

Exit codes: 0 listed or cleared, 2 invalid inventory, unknown board, or not in quarantine, 5 the board is held")]
pub(crate) struct BoardsArgs {
    #[command(subcommand)]
    action: Option<BoardsAction>,
    /// Board inventory; default: the nearest boards.toml, from the working directory upwards
    #[arg(long, value_name = "FILE", global = true)]
    boards: Option<PathBuf>,
    /// Format of standard output
    #[arg(long, value_enum, default_value_t = OutputFormat::Human)]
    format: OutputFormat,
}

#[derive(Debug, Subcommand)]
enum BoardsAction {
    /// End the quarantine of a board that a person has checked
    #[command(after_help = "Exit codes: 0 cleared, 2 unknown board or not in quarantine, 5 the board is held")]
    Clear {
        /// Name of the board
        name: String,
        /// What was checked; stored with the time and the user
        #[arg(long, value_name = "TEXT")]
        reason: String,
    },
}

pub(crate) fn boards(arguments: &BoardsArgs) -> CommandResult {
    let inventory = Inventory::open(arguments.boards.as_deref())?;
    if let Some(BoardsAction::Clear { name, reason }) = &arguments.action {
        clear(&inventory, name, reason)?;
        stdio::note(&format!("board {name} is free"));
    } else {
        let boards = list(&inventory)?;
        stdio::show_as(arguments.format, &boards, || status_table(&boards).lines().join("\n") + "\n");
    }
    Ok(Exit::Passed)
}
