//! Reads input files of limited size, and standard input if the path is `-`. Refuses pipes and
//! devices, because they may never end.

use std::fs::{self, File};
use std::io::{self, ErrorKind, Read};
use std::path::Path;
use std::sync::OnceLock;

/// Largest size of an input. A CSV profile of 10⁶ points is smaller.
const MAX_BYTES: u64 = 64 << 20;
/// Path that means standard input or output. `./-` is a file named `-`.
pub const STANDARD_STREAM: &str = "-";
pub const STANDARD_INPUT_NAME: &str = "stdin.toml";
/// Content of standard input, stored because the stream can be read only once.
static STDIN: OnceLock<Result<Vec<u8>, ErrorKind>> = OnceLock::new();

/// Fails with `InvalidInput` for a pipe, device or socket, without opening it, and with
/// `FileTooLarge` above 64 MiB.
pub fn read(path: &Path) -> io::Result<Vec<u8>> {
    if path == Path::new(STANDARD_STREAM) {
        let content = STDIN.get_or_init(|| read_limited(io::stdin().lock()).map_err(|error| error.kind()));
        return content.clone().map_err(io::Error::from);
    }
    let kind = fs::metadata(path)?.file_type();
    if !kind.is_file() && !kind.is_dir() {
        return Err(io::Error::new(ErrorKind::InvalidInput, "it is a pipe or a device, expected a file"));
    }
    read_limited(File::open(path)?)
}

fn read_limited(source: impl Read) -> io::Result<Vec<u8>> {
    let mut content = Vec::new();
    source.take(MAX_BYTES + 1).read_to_end(&mut content)?;
    if content.len() as u64 > MAX_BYTES {
        let message = format!("it is larger than the limit of {} MiB for input files", MAX_BYTES >> 20);
        return Err(io::Error::new(ErrorKind::FileTooLarge, message));
    }
    Ok(content)
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
    fn returns_the_system_error_for_a_folder() {
        assert_eq!(read(Path::new("/")).unwrap_err().kind(), ErrorKind::IsADirectory);
    }

    #[test]
    fn reads_at_most_64_mib() {
        let path = std::env::temp_dir().join(format!("platebench-input-{}", std::process::id()));
        let file = File::create(&path).unwrap();
        file.set_len(MAX_BYTES).unwrap();
        let whole = read(&path).map(|content| content.len() as u64);
        file.set_len(MAX_BYTES + 1).unwrap();
        let more = read(&path);
        fs::remove_file(&path).unwrap();
        assert_eq!(whole.unwrap(), MAX_BYTES);
        assert_eq!(more.unwrap_err().kind(), ErrorKind::FileTooLarge);
    }
}
