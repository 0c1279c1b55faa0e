//! Defines the options that name a board, and reserves it for a command.

use crate::exit::Exit;
use crate::failure::{Failure, OrInvalid};
use crate::options::parse_seconds;
use crate::shutdown::{self, received_signal};
use crate::stdio;
use clap::Args;
use platebench_lab::boards::{Board, BoardError, BoardOutcome, Inventory, Reservation};
use platebench_rig::RigSpec;
use std::path::PathBuf;
use std::time::Duration;

#[derive(Debug, Clone, Default, Args)]
#[command(next_help_heading = "Board")]
pub(crate) struct BoardSelection {
    /// Board of boards.toml, instead of a rig
    #[arg(long, value_name = "NAME")]
    pub(crate) board: Option<String>,
    /// Board inventory; default: the nearest boards.toml, from the working directory upwards
    #[arg(long, value_name = "FILE")]
    pub(crate) boards: Option<PathBuf>,
}

#[derive(Debug, Clone, Default, Args)]
#[command(next_help_heading = "Board")]
pub(crate) struct BoardArgs {
    #[command(flatten)]
    pub(crate) selection: BoardSelection,
    /// Time to wait for a board that another process holds, s
    #[arg(long, value_name = "SECONDS", default_value = "0", value_parser = parse_seconds)]
    pub(crate) wait: Duration,
}

impl BoardSelection {
    pub(crate) fn find(&self) -> Result<Option<Board>, Failure> {
        let Some(name) = &self.board else { return Ok(None) };
        Ok(Some(Inventory::open(self.boards.as_deref())?.board(name)?.clone()))
    }
}

impl BoardArgs {
    pub(crate) fn find_rig(&self) -> Result<Option<RigSpec>, Failure> {
        self.selection.find().map(|board| board.map(|board| board.rig))
    }

    /// `--board` forbids parallel links, because a board plays one trial at a time.
    pub(crate) fn allows_parallel_links(&self, rig: &RigSpec) -> bool {
        self.selection.board.is_none() && rig.allows_parallel_links()
    }

    /// Reserves the board of `--board`. Signals then no longer end the process by themselves.
    pub(crate) fn reserve(&self, command: &str) -> Result<Option<Reservation>, Failure> {
        let Some(name) = &self.selection.board else { return Ok(None) };
        shutdown::listen().or_invalid()?;
        let is_cancelled = || received_signal().is_some();
        let mut on_wait = |held: &BoardError| stdio::note(&format!("waiting: {held}"));
        let inventory = Inventory::open(self.selection.boards.as_deref())?;
        Ok(Some(Reservation::new(&inventory, name, command, self.wait, &is_cancelled, &mut on_wait)?))
    }
}

/// Fails if the state of the board cannot be written. The board then stays marked as in use.
pub(crate) fn release(reservation: Option<Reservation>, end: BoardOutcome) -> Result<(), Failure> {
    let Some(reservation) = reservation else { return Ok(()) };
    if let Some(reason) = &end.quarantine {
        stdio::error(&format!("board {} is in quarantine: {reason}", reservation.board().name));
    }
    Ok(reservation.finish(end)?)
}

impl From<BoardError> for Failure {
    fn from(error: BoardError) -> Self {
        let exit = match &error {
            BoardError::Cancelled(_) => received_signal().map_or(Exit::Unreachable, Exit::Signal),
            error if error.is_invalid_input() => Exit::Invalid,
            _ => Exit::Unreachable,
        };
        match error {
            BoardError::Inventory(faults) => faults.into(),
            error => Self::new(exit, &error),
        }
    }
}
