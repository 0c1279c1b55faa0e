//! Manages several boards: the inventory `boards.toml`, locks, quarantine and joined runs.
//!
//! One folder next to the inventory contains a lock file and a state file per board. The kernel
//! releases the lock when the process ends that holds it. The state file survives a power cut.

mod inventory;
mod merge;
mod soak;
mod state;

pub use inventory::{Board, BoardError, BoardSensor, INVENTORY_FILE, Inventory, RawInventory};
pub use merge::{MergeError, merge_runs};
pub use soak::{SOAK_FILE, SoakConfig, SoakEnd, SoakRecord, SoakResult, SoakScenario, soak};
pub use state::{BoardOutcome, LastRun, Quarantine, RunsBelow};

use crate::boards::state::{BoardFiles, BoardLock, StoredState};
use platebench_document::{Block, Document, Table};
use platebench_model::record::{to_hex, utc_timestamp};
use platebench_rig::{CancelToken, ConnectOptions, Session};
use schemars::JsonSchema;
use serde::Serialize;
use std::panic::resume_unwind;
use std::thread::{self, sleep};
use std::time::{Duration, Instant};

const POLL_INTERVAL: Duration = Duration::from_millis(50);
const CHIP_POLL_INTERVAL: Duration = Duration::from_millis(5);
/// Shortest wait for the lock. Another command may hold it for a moment to read the board's state.
const MIN_WAIT: Duration = Duration::from_millis(500);

/// A value that is dropped before [`Reservation::finish`] leaves its board in quarantine.
#[derive(Debug)]
pub struct Reservation {
    board: Board,
    files: BoardFiles,
    _lock: BoardLock,
}

impl Reservation {
    /// Waits at most `wait` for another holder of the board and reports the holder to `on_wait`
    /// once. Checks the chip, then marks the board as in use.
    pub fn new(
        inventory: &Inventory,
        name: &str,
        command: &str,
        wait: Duration,
        is_cancelled: &dyn Fn() -> bool,
        on_wait: &mut dyn FnMut(&BoardError),
    ) -> Result<Self, BoardError> {
        let board = inventory.board(name)?.clone();
        let files = BoardFiles::new(inventory, &board)?;
        let lock = wait_for_lock(&board, &files, wait, is_cancelled, on_wait)?;
        let mut state = StoredState::read(&files.state)?;
        if let Some(Quarantine { since, reason }) = state.quarantine_without_holder() {
            return Err(BoardError::Quarantined { name: board.name, since, reason });
        }
        if let Err(error) = check_chip(&board, is_cancelled) {
            if let BoardError::WrongChip { .. } = error {
                state.quarantine = Some(Quarantine { since: utc_timestamp(), reason: error.to_string() });
                state.write(&files.state)?;
            }
            return Err(error);
        }
        state.mark_in_use(command);
        state.write(&files.state)?;
        Ok(Self { board, files, _lock: lock })
    }

    pub fn board(&self) -> &Board {
        &self.board
    }

    /// Removes the mark `in_use`. Puts the board into quarantine if `end` states a reason.
    pub fn finish(self, end: BoardOutcome) -> Result<(), BoardError> {
        let mut state = StoredState::read(&self.files.state)?;
        state.in_use = None;
        state.last_run = end.last_run.or(state.last_run);
        if let Some(reason) = end.quarantine {
            state.quarantine = Some(Quarantine { since: utc_timestamp(), reason });
        }
        state.write(&self.files.state)
    }
}

fn wait_for_lock(
    board: &Board,
    files: &BoardFiles,
    wait: Duration,
    is_cancelled: &dyn Fn() -> bool,
    on_wait: &mut dyn FnMut(&BoardError),
) -> Result<BoardLock, BoardError> {
    let started = Instant::now();
    let mut is_reported = false;
    loop {
        let holder = match files.lock()? {
            Ok(lock) => return Ok(lock),
            Err(holder) => holder,
        };
        let mark = StoredState::read(&files.state)?.in_use;
        let since = mark.map_or_else(String::new, |mark| format!(" since {}", mark.since));
        let held = BoardError::Held { name: board.name.clone(), holder, since };
        if started.elapsed() >= wait.max(MIN_WAIT) {
            return Err(held);
        }
        if !is_reported && wait > MIN_WAIT {
            on_wait(&held);
            is_reported = true;
        }
        if is_cancelled() {
            return Err(BoardError::Cancelled(board.name.clone()));
        }
        sleep(POLL_INTERVAL);
    }
}

fn check_chip(board: &Board, is_cancelled: &dyn Fn() -> bool) -> Result<(), BoardError> {
    let Some(expected) = &board.chip_id else { return Ok(()) };
    let cancel = CancelToken::never();
    let found = thread::scope(|scope| {
        let reading = scope.spawn(|| read_chip_number(board, &cancel));
        while !reading.is_finished() {
            if is_cancelled() {
                cancel.cancel();
            }
            sleep(CHIP_POLL_INTERVAL);
        }
        reading.join().unwrap_or_else(|panic| resume_unwind(panic))
    })?;
    if found == *expected {
        return Ok(());
    }
    Err(BoardError::WrongChip { name: board.name.clone(), found, expected: expected.clone() })
}

/// Reads only the identity of the controller. The drop of the session requests 0 V.
fn read_chip_number(board: &Board, cancel: &CancelToken) -> Result<String, BoardError> {
    let options = ConnectOptions { cancel: cancel.clone(), ..ConnectOptions::default() };
    let session = Session::open_cancellable(board.rig.connect_with(&options)?, cancel)?;
    Ok(to_hex(&session.identity().unique))
}

#[derive(Debug, Clone, PartialEq, Eq, Serialize, JsonSchema)]
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

#[derive(Debug, Clone, PartialEq, Serialize, JsonSchema)]
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

pub fn document(boards: &[BoardStatus]) -> Document {
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
    Document::new("Boards", vec![Block::Table(table)])
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
