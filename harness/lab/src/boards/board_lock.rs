//! Locks a board and its debug probe through lock files in the state folder.

use crate::boards::error::BoardError;
use crate::boards::inventory::{Board, Inventory};
use platebench_model::trace::AtPath;
use platebench_rig::{LockHolder, lock_file};
use std::fs::{self, File};
use std::io;
use std::path::PathBuf;

#[derive(Debug, Clone)]
pub(crate) struct BoardFiles {
    pub(crate) state: PathBuf,
    locks: Vec<PathBuf>,
}

impl BoardFiles {
    /// Creates the state folder if it does not exist.
    pub(crate) fn new(inventory: &Inventory, board: &Board) -> Result<Self, BoardError> {
        let folder = inventory.state_folder();
        fs::create_dir_all(&folder).at(&folder)?;
        let probe = board.probe_serial.as_ref().map(|serial| {
            let is_plain = |letter: char| letter.is_ascii_alphanumeric();
            let name: String = serial.chars().map(|letter| if is_plain(letter) { letter } else { '_' }).collect();
            folder.join(format!("{name}.probe.lock"))
        });
        let lock = folder.join(format!("{}.lock", board.name));
        Ok(Self {
            state: folder.join(format!("{}.json", board.name)),
            locks: std::iter::once(lock).chain(probe).collect(),
        })
    }

    pub(crate) fn lock(&self) -> Result<Result<BoardLock, LockHolder>, BoardError> {
        let mut files = Vec::new();
        for path in &self.locks {
            let file = File::options().create(true).append(true).open(path).at(path)?;
            match lock_file(&file).map_err(io::Error::from).at(path)? {
                None => files.push(file),
                Some(holder) => return Ok(Err(holder)),
            }
        }
        Ok(Ok(BoardLock { _files: files }))
    }
}

#[derive(Debug)]
pub(crate) struct BoardLock {
    _files: Vec<File>,
}
