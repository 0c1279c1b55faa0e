//! Defines the options that name a board, and reserves it for a command.

use crate::exit::Exit;
use crate::options::parse_seconds;
use crate::shutdown::{self, received_signal};
use crate::stdio;
use clap::Args;
use platebench_boards::{Board, BoardError, Inventory, Reservation, RunEnd};
use platebench_rig::RigSpec;
use std::path::PathBuf;
use std::time::Duration;

#[derive(Debug, Clone, Default, Args)]
pub(crate) struct BoardSelection {
    /// Board of boards.toml, instead of a rig
    #[arg(long, value_name = "NAME")]
    pub(crate) board: Option<String>,
    /// Board inventory; default: the nearest boards.toml, from the working directory upwards
    #[arg(long, value_name = "FILE")]
    pub(crate) boards: Option<PathBuf>,
}

/// For commands that connect to the board.
#[derive(Debug, Clone, Default, Args)]
pub(crate) struct BoardArgs {
    #[command(flatten)]
    pub(crate) selection: BoardSelection,
    /// Time to wait for a board that another process holds, s
    #[arg(long, value_name = "SECONDS", default_value = "0", value_parser = parse_wait)]
    pub(crate) wait: Duration,
}

fn parse_wait(text: &str) -> Result<Duration, String> {
    parse_seconds(text).map(Duration::from_secs_f64)
}

impl BoardSelection {
    /// `None` without `--board`. Reports an error.
    pub(crate) fn find(&self) -> Result<Option<Board>, Exit> {
        let Some(name) = &self.board else { return Ok(None) };
        let inventory = Inventory::open(self.boards.as_deref()).map_err(|error| reject(&error))?;
        inventory.board(name).cloned().map(Some).map_err(|error| reject(&error))
    }
}

impl BoardArgs {
    /// `None` without `--board`. Reports an error.
    pub(crate) fn find_rig(&self) -> Result<Option<RigSpec>, Exit> {
        self.selection.find().map(|board| board.map(|board| board.rig))
    }

    /// False for a board, which carries one trial at a time.
    pub(crate) fn allows_parallel_links(&self, rig: &RigSpec) -> bool {
        self.selection.board.is_none() && rig.allows_parallel_links()
    }

    /// `None` without `--board`. Reports an error. From then on signals do not end the program.
    pub(crate) fn reserve(&self, command: &str) -> Result<Option<Reservation>, Exit> {
        let Some(name) = &self.selection.board else { return Ok(None) };
        shutdown::listen().map_err(|error| stdio::reject(&error))?;
        let is_cancelled = || received_signal().is_some();
        let mut on_wait = |held: &BoardError| stdio::note(&format!("waiting: {held}"));
        let reserved = Inventory::open(self.selection.boards.as_deref())
            .and_then(|inventory| Reservation::new(&inventory, name, command, self.wait, &is_cancelled, &mut on_wait));
        reserved.map(Some).map_err(|error| reject(&error))
    }
}

/// Returns `exit`, or 2 if the state cannot be written; then the board stays marked.
pub(crate) fn release(reservation: Option<Reservation>, end: RunEnd, exit: Exit) -> Exit {
    let Some(reservation) = reservation else { return exit };
    if let Some(reason) = &end.quarantine {
        stdio::error(&format!("board {} is in quarantine: {reason}", reservation.board().name));
    }
    match reservation.finish(end) {
        Ok(()) => exit,
        Err(error) => reject(&error),
    }
}

pub(crate) fn reject(error: &BoardError) -> Exit {
    if let BoardError::Inventory(faults) = error {
        return stdio::reject_files(faults);
    }
    stdio::error(&error.to_string());
    match error {
        BoardError::Cancelled(_) => received_signal().map_or(Exit::Unreachable, Exit::Signal),
        error if error.is_invalid_input() => Exit::Invalid,
        _ => Exit::Unreachable,
    }
}
