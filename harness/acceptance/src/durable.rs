//! Files that are whole or not there, whenever the machine stops.

use crate::error::AcceptError;
use std::fs::{self, File};
use std::io::Write as _;
use std::path::{Path, PathBuf};

/// What a file is called until it is whole.
const PROVISIONAL: &str = ".part";

/// Replaces the file at `path` as a whole: after this returns, neither a kill nor a power cut takes it back.
pub(crate) fn write(path: &Path, content: &[u8]) -> Result<(), AcceptError> {
    let mut provisional = path.to_owned().into_os_string();
    provisional.push(PROVISIONAL);
    let provisional = PathBuf::from(provisional);
    let written = File::create(&provisional).and_then(|mut file| {
        file.write_all(content)?;
        file.sync_all()
    });
    written.map_err(AcceptError::io(&provisional))?;
    fs::rename(&provisional, path).map_err(AcceptError::io(path))?;
    path.parent().map_or(Ok(()), sync)
}

/// Brings everything below `folder`, and its own entry, to the disk.
pub(crate) fn sync_below(folder: &Path) -> Result<(), AcceptError> {
    for entry in fs::read_dir(folder).map_err(AcceptError::io(folder))? {
        let entry = entry.map_err(AcceptError::io(folder))?;
        let path = entry.path();
        if entry.file_type().map_err(AcceptError::io(&path))?.is_dir() { sync_below(&path)? } else { sync(&path)? }
    }
    sync(folder)?;
    folder.parent().map_or(Ok(()), sync)
}

fn sync(path: &Path) -> Result<(), AcceptError> {
    // The parent of a bare name is the empty path.
    let path = if path.as_os_str().is_empty() { Path::new(".") } else { path };
    File::open(path).and_then(|file| file.sync_all()).map_err(AcceptError::io(path))
}

/// Removes what a kill left half-written directly in `folder`.
pub(crate) fn remove_provisional(folder: &Path) -> Result<(), AcceptError> {
    for entry in fs::read_dir(folder).map_err(AcceptError::io(folder))? {
        let path = entry.map_err(AcceptError::io(folder))?.path();
        if path.is_file() && path.as_os_str().to_string_lossy().ends_with(PROVISIONAL) {
            fs::remove_file(&path).map_err(AcceptError::io(&path))?;
        }
    }
    Ok(())
}
