//! Opens files that may be a pipe, a device or a huge file.
//!
//! A FIFO blocks, a device may never end, and a huge file exhausts the memory. Therefore the bench
//! reads every file of a run folder, every baseline, key, record, table of telemetry and program
//! image through this module, and every text that a user writes through `platebench_plate::input`.

use rustix::fs::OFlags;
use std::fs::{File, OpenOptions};
use std::io::{self, Read};
use std::os::unix::fs::OpenOptionsExt;
use std::path::Path;

/// Reading ends at `max_bytes` even if the file grows. Fails with [`io::ErrorKind::InvalidInput`]
/// for a FIFO, a device, a folder or a larger file.
pub fn open_regular_file(path: &Path, max_bytes: u64) -> io::Result<io::Take<File>> {
    // Without this flag opening a FIFO waits for a writer.
    let nonblock = OFlags::NONBLOCK.bits().cast_signed();
    let file = OpenOptions::new().read(true).custom_flags(nonblock).open(path)?;
    let metadata = file.metadata()?;
    let refuse = |what: String| Err(io::Error::new(io::ErrorKind::InvalidInput, what));
    if metadata.is_dir() {
        return refuse("it is a folder, expected a file".to_owned());
    }
    if !metadata.is_file() {
        return refuse("it is a pipe or a device, expected a file".to_owned());
    }
    if metadata.len() > max_bytes {
        return refuse(format!("{} bytes, expected at most {max_bytes}", metadata.len()));
    }
    Ok(file.take(max_bytes))
}

/// Largest program image: an ELF with debug information, or a shared library.
pub const MAX_IMAGE_BYTES: u64 = 256 << 20;
/// Largest table of telemetry: about an hour at 1 kHz with twenty columns.
pub const MAX_TABLE_BYTES: u64 = 1 << 30;

pub fn read_regular_file(path: &Path, max_bytes: u64) -> io::Result<Vec<u8>> {
    let mut content = Vec::new();
    open_regular_file(path, max_bytes)?.read_to_end(&mut content)?;
    Ok(content)
}

/// Fails like [`open_regular_file`], and with [`io::ErrorKind::InvalidData`] if the file is not
/// UTF-8.
pub fn read_text_file(path: &Path, max_bytes: u64) -> io::Result<String> {
    let mut text = String::new();
    open_regular_file(path, max_bytes)?.read_to_string(&mut text)?;
    Ok(text)
}

#[cfg(test)]
mod tests {
    use super::*;
    use rustix::fs::{CWD, FileType, Mode, mknodat};
    use std::fs;

    #[test]
    fn reads_a_file_up_to_its_limit() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a");
        fs::write(&path, "12345").unwrap();
        assert_eq!(read_text_file(&path, 5).unwrap(), "12345");
        assert_eq!(read_regular_file(&path, 4).unwrap_err().to_string(), "5 bytes, expected at most 4");
    }

    #[test]
    fn rejects_irregular_files() {
        let folder = tempfile::tempdir().unwrap();
        let fifo = folder.path().join("fifo");
        mknodat(CWD, &fifo, FileType::Fifo, Mode::RUSR | Mode::WUSR, 0).unwrap();
        let link = folder.path().join("link");
        std::os::unix::fs::symlink("/dev/zero", &link).unwrap();
        for path in [fifo.as_path(), &link, folder.path(), Path::new("/dev/zero")] {
            let error = open_regular_file(path, 1_000).unwrap_err();
            assert_eq!(error.kind(), io::ErrorKind::InvalidInput, "{}", path.display());
        }
    }
}
