//! Writes the FMU, a ZIP archive: description, plate file and shared library.

use crate::description::{MODEL_IDENTIFIER, model_description};
use crate::instance::PLATE_FILE;
use platebench_model::trace::{AtPath as _, AtomicFile, FileError, MAX_IMAGE_BYTES, read_regular_file};
use platebench_plate::Plate;
use std::io::Write;
use std::path::{Path, PathBuf};
use zip::write::SimpleFileOptions;
use zip::{CompressionMethod, ZipWriter};

const LIBRARY_FILE: &str = "libplatebench_fmi.so";

#[derive(Debug, thiserror::Error)]
pub enum FmuError {
    #[error(
        "no {LIBRARY_FILE} next to {}: an FMU contains the plate as a shared library, which a build for musl does not \
         make; build it with `cargo build --release --ignore-rust-version --package platebench-fmi` and name it with \
         --library",
        program.display()
    )]
    NoLibrary { program: PathBuf },
    #[error(transparent)]
    File(#[from] FileError),
    #[error("{} is not a shared library of Linux (ELF)", .0.display())]
    NotALibrary(PathBuf),
    #[error("an FMU needs a computer with x86_64 or aarch64, this one has {0}")]
    Architecture(&'static str),
    #[error("{} exists already, expected another name", .0.display())]
    FileExists(PathBuf),
    #[error("{}: {source}", path.display())]
    Archive { path: PathBuf, source: zip::result::ZipError },
}

/// Searches the folder of `program`, its `deps` (Cargo) and `../lib/platebench` (installed).
pub fn find_library(program: &Path) -> Result<PathBuf, FmuError> {
    let folder = program.parent().unwrap_or(Path::new("."));
    let folders = [folder.to_owned(), folder.join("deps"), folder.join("../lib/platebench")];
    let mut files = folders.into_iter().map(|folder| folder.join(LIBRARY_FILE));
    files.find(|file| file.is_file()).ok_or_else(|| FmuError::NoLibrary { program: program.to_owned() })
}

const fn platform() -> Option<&'static str> {
    if cfg!(target_arch = "x86_64") {
        Some("x86_64-linux")
    } else if cfg!(target_arch = "aarch64") {
        Some("aarch64-linux")
    } else {
        None
    }
}

/// `plate_text` is the content of the plate file. Fails if `out` exists.
pub fn write(plate: &Plate, plate_text: &str, title: &str, library: &Path, out: &Path) -> Result<(), FmuError> {
    let platform = platform().ok_or(FmuError::Architecture(std::env::consts::ARCH))?;
    let content = read_regular_file(library, MAX_IMAGE_BYTES).at(library)?;
    if !content.starts_with(b"\x7fELF") {
        return Err(FmuError::NotALibrary(library.to_owned()));
    }
    if out.exists() {
        return Err(FmuError::FileExists(out.to_owned()));
    }
    let archive = |source| FmuError::Archive { path: out.to_owned(), source };
    let file = AtomicFile::create(out).at(out)?;
    let mut zip = ZipWriter::new(file.file());
    let options = SimpleFileOptions::default().compression_method(CompressionMethod::Stored);
    let description = model_description(plate, title);
    let binary = format!("binaries/{platform}/{MODEL_IDENTIFIER}.so");
    let resource = format!("resources/{PLATE_FILE}");
    for (name, bytes) in [
        ("modelDescription.xml", description.as_bytes()),
        (resource.as_str(), plate_text.as_bytes()),
        (binary.as_str(), content.as_slice()),
    ] {
        zip.start_file(name, options).map_err(archive)?;
        zip.write_all(bytes).at(out)?;
    }
    zip.finish().map_err(archive)?;
    Ok(file.commit().at(out)?)
}
