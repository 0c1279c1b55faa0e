//! Reserves a board for one command.
//!
//! ```text
//! free ──lock, chip check──▶ locked ──mark on the disk──▶ in use ──finish──▶ free or in quarantine
//!                                                          │
//!                              process ends, power cut     └──▶ quarantine: the mark has no holder
//! ```

use crate::boards::board_lock::{BoardFiles, BoardLock};
use crate::boards::error::BoardError;
use crate::boards::inventory::{Board, Inventory};
use crate::boards::run_end::BoardOutcome;
use crate::boards::state::{Quarantine, StoredState};
use platebench_model::record::{to_hex, utc_timestamp};
use platebench_rig::{CancelToken, ConnectOptions, Session};
use std::thread::sleep;
use std::time::{Duration, Instant};

const POLL_INTERVAL: Duration = Duration::from_millis(50);
/// Shortest wait for the lock. Another command may hold it for a moment to read the board's state.
const MIN_WAIT: Duration = Duration::from_millis(500);

/// A value that is dropped before [`Reservation::finish`] leaves its board in quarantine.
#[derive(Debug)]
pub struct Reservation {
    board: Board,
    files: BoardFiles,
    started: String,
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
        if let Err(error) = check_chip(&board) {
            if let BoardError::WrongChip { .. } = error {
                state.quarantine = Some(Quarantine { since: utc_timestamp(), reason: error.to_string() });
                state.write(&files.state)?;
            }
            return Err(error);
        }
        state.mark_in_use(command);
        state.write(&files.state)?;
        Ok(Self { board, files, started: utc_timestamp(), _lock: lock })
    }

    pub fn board(&self) -> &Board {
        &self.board
    }

    /// Time at which the board was marked as in use, UTC, RFC 3339.
    pub fn started(&self) -> &str {
        &self.started
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

/// Reads only the identity of the controller. The drop of the session requests 0 V.
fn check_chip(board: &Board) -> Result<(), BoardError> {
    let Some(expected) = &board.chip_id else { return Ok(()) };
    let options = ConnectOptions { cancel: CancelToken::never(), ..ConnectOptions::default() };
    let session = Session::open(board.rig.connect_with(&options)?)?;
    let found = to_hex(&session.identity().unique);
    if found == *expected {
        return Ok(());
    }
    Err(BoardError::WrongChip { name: board.name.clone(), found, expected: expected.clone() })
}
