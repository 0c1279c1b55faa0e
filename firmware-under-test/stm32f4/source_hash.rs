// Computes the source hash: the SHA-256 of the output of `sha256sum` for the firmware's files. The
// paths are relative to `firmware-under-test/` and in byte order. The files are `SINGLE` and
// `src/**.rs` of `wire`, `controller` and `stm32f4` without `tests.rs`. `ci/firmware` does the
// same.

use sha2::{Digest, Sha256};
use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::{fs, io};

const SINGLE: [&str; 8] = [
    "controller/Cargo.toml",
    "stm32f4/.cargo/config.toml",
    "stm32f4/Cargo.lock",
    "stm32f4/Cargo.toml",
    "stm32f4/build.rs",
    "stm32f4/memory.x",
    "stm32f4/source_hash.rs",
    "wire/Cargo.toml",
];

pub(crate) fn files(firmware_under_test: &Path) -> io::Result<Vec<String>> {
    let mut files: Vec<String> = SINGLE.map(str::to_owned).to_vec();
    for package in ["controller", "stm32f4", "wire"] {
        walk(&firmware_under_test.join(package).join("src"), &format!("{package}/src"), &mut files)?;
    }
    files.sort_unstable();
    Ok(files)
}

fn walk(folder: &Path, name: &str, files: &mut Vec<String>) -> io::Result<()> {
    for entry in fs::read_dir(folder)? {
        let entry = entry?;
        let file = entry.file_name().to_string_lossy().into_owned();
        let path: PathBuf = entry.path();
        if path.is_dir() {
            walk(&path, &format!("{name}/{file}"), files)?;
        } else if path.extension().is_some_and(|extension| extension == "rs") && file != "tests.rs" {
            files.push(format!("{name}/{file}"));
        }
    }
    Ok(())
}

pub(crate) fn source_hash(firmware_under_test: &Path) -> io::Result<[u8; 32]> {
    let mut listing = String::new();
    for file in files(firmware_under_test)? {
        let content = fs::read(firmware_under_test.join(&file))?;
        let _ = writeln!(listing, "{}  {file}", hex(&Sha256::digest(content).into()));
    }
    Ok(Sha256::digest(listing).into())
}

pub(crate) fn hex(hash: &[u8; 32]) -> String {
    hash.iter().fold(String::new(), |mut text, byte| {
        let _ = write!(text, "{byte:02x}");
        text
    })
}
