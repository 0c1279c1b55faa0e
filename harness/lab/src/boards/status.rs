//! Lists boards with their state, and ends a quarantine.

use crate::boards::board_lock::BoardFiles;
use crate::boards::error::BoardError;
use crate::boards::inventory::{Board, Inventory};
use crate::boards::state::{LastRun, Quarantine, StoredState};
use platebench_report::document::Table;
use serde::Serialize;

#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
#[serde(tag = "state", rename_all = "lowercase")]
pub enum BoardState {
    Free,
    Held {
        holder: String,
        user: Option<String>,
        /// Time of the mark `in_use`. Absent until the holder has marked the board.
        since: Option<String>,
    },
    Quarantined(Quarantine),
}

#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct BoardStatus {
    #[serde(flatten)]
    pub board: Board,
    #[serde(flatten)]
    pub state: BoardState,
    pub last_run: Option<LastRun>,
}

pub fn list(inventory: &Inventory) -> Result<Vec<BoardStatus>, BoardError> {
    inventory.boards.iter().map(|board| status(inventory, board)).collect()
}

fn status(inventory: &Inventory, board: &Board) -> Result<BoardStatus, BoardError> {
    let files = BoardFiles::new(inventory, board)?;
    let lock = files.lock()?;
    // Read after the attempt to lock. A mark that was read earlier could be of a process that has
    // ended since.
    let stored = StoredState::read(&files.state)?;
    let state = match (&lock, stored.quarantine_without_holder()) {
        (Err(holder), _) => BoardState::Held {
            holder: holder.to_string(),
            user: stored.in_use.as_ref().and_then(|mark| mark.user.clone()),
            since: stored.in_use.as_ref().map(|mark| mark.since.clone()),
        },
        (Ok(_), Some(quarantine)) => BoardState::Quarantined(quarantine),
        (Ok(_), None) => BoardState::Free,
    };
    drop(lock);
    Ok(BoardStatus { board: board.clone(), state, last_run: stored.last_run })
}

pub fn status_table(boards: &[BoardStatus]) -> Table {
    let mut table = Table::new(["board", "state", "since", "holder or reason", "last run", "verdict"]);
    for status in boards {
        let (state, since, why) = match &status.state {
            BoardState::Free => ("free", None, String::new()),
            BoardState::Held { holder, user, since } => {
                let user = user.as_ref().map_or_else(String::new, |user| format!(" of {user}"));
                ("held", since.clone(), format!("{holder}{user}"))
            }
            BoardState::Quarantined(quarantine) => {
                ("quarantined", Some(quarantine.since.clone()), quarantine.reason.clone())
            }
        };
        let run = status.last_run.as_ref();
        let verdict = run.map(|run| run.verdict.map_or_else(|| "incomplete".to_owned(), |verdict| verdict.to_string()));
        table.push(vec![
            status.board.name.clone(),
            state.to_owned(),
            since.unwrap_or_default(),
            why,
            run.map_or_else(String::new, |run| format!("{} {}", run.started, run.folder.display())),
            verdict.unwrap_or_default(),
        ]);
    }
    table
}

pub fn clear(inventory: &Inventory, name: &str, reason: &str) -> Result<(), BoardError> {
    if reason.trim().is_empty() {
        return Err(BoardError::NoReason);
    }
    let board = inventory.board(name)?;
    let files = BoardFiles::new(inventory, board)?;
    let name = board.name.clone();
    let _lock = files.lock()?.map_err(|holder| BoardError::Held { name, holder, since: String::new() })?;
    let mut state = StoredState::read(&files.state)?;
    if !state.clear(reason) {
        return Err(BoardError::NotQuarantined { name: board.name.clone() });
    }
    state.write(&files.state)
}
