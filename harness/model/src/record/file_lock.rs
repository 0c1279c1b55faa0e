//! Locks a folder or a file against other processes. The kernel releases the lock when the process
//! ends, also after a crash.

use crate::trace::{AtPath, FileError};
use std::fs::{File, TryLockError};
use std::path::Path;

#[derive(Debug)]
pub struct FileLock {
    /// The lock ends when the file is closed.
    _file: File,
}

impl FileLock {
    /// Locks the existing file or folder at `path` for one user. `None` if another user has it.
    pub fn exclusive(path: &Path) -> Result<Option<Self>, FileError> {
        let file = open(path)?;
        let result = file.try_lock();
        Ok(Self::after(file, &result))
    }

    /// Locks the existing file or folder at `path` for any number of users of this function. `None`
    /// if a user has it exclusively.
    pub fn shared(path: &Path) -> Result<Option<Self>, FileError> {
        let file = open(path)?;
        let result = file.try_lock_shared();
        Ok(Self::after(file, &result))
    }

    /// An error other than `WouldBlock` means a file system without locks.
    fn after(file: File, result: &Result<(), TryLockError>) -> Option<Self> {
        (!matches!(result, Err(TryLockError::WouldBlock))).then_some(Self { _file: file })
    }
}

/// Network file systems lock a file only for one that can write it. A folder can only be read.
fn open(path: &Path) -> Result<File, FileError> {
    File::options().append(true).open(path).or_else(|_| File::open(path)).at(path)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_shared_users_lock_at_the_same_time() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path();
        let first = FileLock::shared(path).unwrap().unwrap();
        let second = FileLock::shared(path).unwrap().unwrap();
        assert!(FileLock::exclusive(path).unwrap().is_none());
        drop((first, second));
        let only = FileLock::exclusive(path).unwrap().unwrap();
        assert!(FileLock::shared(path).unwrap().is_none());
        assert!(FileLock::exclusive(path).unwrap().is_none());
        drop(only);
        assert!(FileLock::exclusive(path).unwrap().is_some());
    }
}
