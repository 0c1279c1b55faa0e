//! Files that people hand in: read as a whole and never waited for.

use std::fs::{self, File};
use std::io::{self, ErrorKind, Read};
use std::path::Path;

/// Far more than a scenario, a plate or a profile of a million points takes, bytes.
const LARGEST: u64 = 64 << 20;

/// The content of the file at `path`.
///
/// # Errors
/// What the system says. Where there is a pipe, a device or a socket, which may never begin or never end, that it is no file; it is not opened. More than 64 MiB are
/// no input.
pub fn read(path: &Path) -> io::Result<Vec<u8>> {
    let kind = fs::metadata(path)?.file_type();
    if !kind.is_file() && !kind.is_dir() {
        return Err(io::Error::new(ErrorKind::InvalidInput, "it is a pipe or a device, expected a file"));
    }
    let mut content = Vec::new();
    File::open(path)?.take(LARGEST + 1).read_to_end(&mut content)?;
    if content.len() as u64 > LARGEST {
        let message = format!("it is larger than {} MiB, expected a file that somebody wrote", LARGEST >> 20);
        return Err(io::Error::new(ErrorKind::FileTooLarge, message));
    }
    Ok(content)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_never_ends_is_not_opened() {
        let error = read(Path::new("/dev/zero")).unwrap_err();
        assert_eq!(error.to_string(), "it is a pipe or a device, expected a file");
    }

    #[test]
    fn a_folder_is_what_the_system_says() {
        assert_eq!(read(Path::new("/")).unwrap_err().kind(), ErrorKind::IsADirectory);
    }

    #[test]
    fn the_largest_file_is_read_and_one_byte_more_is_not() {
        let path = std::env::temp_dir().join(format!("platebench-input-{}", std::process::id()));
        let file = File::create(&path).unwrap();
        file.set_len(LARGEST).unwrap();
        let whole = read(&path).map(|content| content.len() as u64);
        file.set_len(LARGEST + 1).unwrap();
        let more = read(&path);
        fs::remove_file(&path).unwrap();
        assert_eq!(whole.unwrap(), LARGEST);
        assert_eq!(more.unwrap_err().kind(), ErrorKind::FileTooLarge);
    }
}
