//! Limits the sizes of files that may be a pipe, a device or a huge file.

pub use platebench_plate::input::{open_regular_file, read_regular_file, read_text_file};

/// Largest program image: an ELF with debug information, or a shared library.
pub const MAX_IMAGE_BYTES: u64 = 256 << 20;
/// Largest table of telemetry: about an hour at 1 kHz with twenty columns.
pub const MAX_TABLE_BYTES: u64 = 1 << 30;

#[cfg(test)]
mod tests {
    use super::*;
    use rustix::fs::{CWD, FileType, Mode, mknodat};
    use std::path::Path;
    use std::{fs, io};

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
