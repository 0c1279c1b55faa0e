//! Reads files of limited size. Refuses pipes and devices without opening them, because opening a
//! FIFO blocks and a device may never end.

use std::fs::{self, File};
use std::io::{self, ErrorKind, Read};
use std::path::Path;
use std::sync::OnceLock;

/// Largest input that a user writes. A CSV profile of 10⁶ points is smaller.
const MAX_INPUT_BYTES: u64 = 64 << 20;
/// Path that means standard input or output. `./-` is a file named `-`.
pub const STANDARD_STREAM: &str = "-";
pub const STANDARD_INPUT_NAME: &str = "stdin.toml";
/// Content of standard input, stored because the stream can be read only once.
static STDIN: OnceLock<Result<Vec<u8>, ErrorKind>> = OnceLock::new();

/// Reads an input that a user writes, or standard input if the path is `-`. Fails like
/// [`open_regular_file`] above 64 MiB.
pub fn read(path: &Path) -> io::Result<Vec<u8>> {
    if path != Path::new(STANDARD_STREAM) {
        return read_regular_file(path, MAX_INPUT_BYTES);
    }
    let content = STDIN.get_or_init(|| {
        let mut content = Vec::new();
        let read = io::stdin().lock().take(MAX_INPUT_BYTES + 1).read_to_end(&mut content);
        read.map_err(|error| error.kind())?;
        if content.len() as u64 > MAX_INPUT_BYTES { Err(ErrorKind::FileTooLarge) } else { Ok(content) }
    });
    content.clone().map_err(io::Error::from)
}

/// Reading ends at `max_bytes` even if the file grows. Fails with [`ErrorKind::InvalidInput`] for a
/// FIFO, a device or a folder, and with [`ErrorKind::FileTooLarge`] for a larger file.
pub fn open_regular_file(path: &Path, max_bytes: u64) -> io::Result<io::Take<File>> {
    let metadata = fs::metadata(path)?;
    let refuse = |kind: ErrorKind, what: String| Err(io::Error::new(kind, what));
    if metadata.is_dir() {
        return refuse(ErrorKind::InvalidInput, "it is a folder, expected a file".to_owned());
    }
    if !metadata.is_file() {
        return refuse(ErrorKind::InvalidInput, "it is a pipe or a device, expected a file".to_owned());
    }
    if metadata.len() > max_bytes {
        let message = format!("{} bytes, expected at most {max_bytes}", metadata.len());
        return refuse(ErrorKind::FileTooLarge, message);
    }
    Ok(File::open(path)?.take(max_bytes))
}

pub fn read_regular_file(path: &Path, max_bytes: u64) -> io::Result<Vec<u8>> {
    let mut content = Vec::new();
    open_regular_file(path, max_bytes)?.read_to_end(&mut content)?;
    Ok(content)
}

/// Fails like [`open_regular_file`], and with [`ErrorKind::InvalidData`] if the file is not UTF-8.
pub fn read_text_file(path: &Path, max_bytes: u64) -> io::Result<String> {
    let mut text = String::new();
    open_regular_file(path, max_bytes)?.read_to_string(&mut text)?;
    Ok(text)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn does_not_open_a_device() {
        let error = read(Path::new("/dev/zero")).unwrap_err();
        assert_eq!(error.to_string(), "it is a pipe or a device, expected a file");
    }

    #[test]
    fn reads_at_most_64_mib() {
        let path = std::env::temp_dir().join(format!("platebench-input-{}", std::process::id()));
        let file = File::create(&path).unwrap();
        file.set_len(MAX_INPUT_BYTES).unwrap();
        let whole = read(&path).map(|content| content.len() as u64);
        file.set_len(MAX_INPUT_BYTES + 1).unwrap();
        let more = read(&path);
        fs::remove_file(&path).unwrap();
        assert_eq!(whole.unwrap(), MAX_INPUT_BYTES);
        let error = more.unwrap_err();
        assert_eq!(error.kind(), ErrorKind::FileTooLarge);
        assert_eq!(error.to_string(), "67108865 bytes, expected at most 67108864");
    }
}
