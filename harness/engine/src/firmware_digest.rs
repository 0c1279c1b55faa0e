//! Computes the SHA-256 of the program that a rig starts or of the image that it loads, and detects
//! a change of the file during a run.

use platebench_model::record::{sha256, sha256_of_file};
use platebench_rig::{BUILT_IN_IMAGE, FirmwareImage, RigSpec};
use std::fs;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

/// Programs whose first argument is the file with the controller.
const INTERPRETERS: [&str; 8] = ["python", "sh", "bash", "dash", "node", "perl", "ruby", "julia"];

#[derive(Debug, Clone, Default)]
pub struct FirmwareDigest {
    sha256: Option<String>,
    files: Vec<HashedFile>,
}

#[derive(Debug, Clone, PartialEq)]
struct HashedFile {
    path: PathBuf,
    stamp: [i64; 5],
    sha256: String,
}

impl FirmwareDigest {
    /// Contains no digest if the rig has neither a program nor an image, or a file cannot be read.
    pub fn of_rig(rig: &str) -> Self {
        let Ok(rig) = rig.parse::<RigSpec>() else { return Self::default() };
        let properties = rig.properties();
        let paths = match &properties.image {
            FirmwareImage::BuiltIn => return Self { sha256: Some(sha256(BUILT_IN_IMAGE)), files: Vec::new() },
            FirmwareImage::File(image) => vec![image.clone()],
            FirmwareImage::None => files_of_command(&properties.command),
        };
        let Some(files) = paths.iter().map(|path| HashedFile::read(path)).collect::<Option<Vec<_>>>() else {
            return Self::default();
        };
        let sha256 = match &files[..] {
            [] => None,
            [file] => Some(file.sha256.clone()),
            several => {
                let digests: Vec<_> = several.iter().map(|file| file.sha256.as_str()).collect();
                Some(sha256(digests.join("\n").as_bytes()))
            }
        };
        Self { sha256, files }
    }

    pub fn sha256(&self) -> Option<&str> {
        self.sha256.as_deref()
    }

    /// The first file with another content than at the start. A file that is gone makes the
    /// connection fail, with a message of its own.
    pub(crate) fn changed_file(&self) -> Option<String> {
        let is_changed = |file: &&HashedFile| {
            stamp(&file.path).is_some_and(|now| now != file.stamp)
                && HashedFile::read(&file.path).is_some_and(|now| now.sha256 != file.sha256)
        };
        self.files.iter().find(is_changed).map(|file| file.path.display().to_string())
    }
}

impl HashedFile {
    fn read(path: &Path) -> Option<Self> {
        let stamp = stamp(path)?;
        Some(Self { path: path.to_owned(), stamp, sha256: sha256_of_file(path).ok()? })
    }
}

/// Device, number, size and time of a file.
fn stamp(path: &Path) -> Option<[i64; 5]> {
    let data = fs::metadata(path).ok()?;
    Some([
        data.dev().cast_signed(),
        data.ino().cast_signed(),
        data.size().cast_signed(),
        data.mtime(),
        data.mtime_nsec(),
    ])
}

/// The program and, if it is an interpreter, its script.
fn files_of_command(command: &[String]) -> Vec<PathBuf> {
    let Some((program, arguments)) = command.split_first() else { return Vec::new() };
    let Some(path) = find_program(program) else { return Vec::new() };
    let name = path.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default();
    let stem = name.trim_end_matches(|end: char| end.is_ascii_digit() || end == '.');
    let script = arguments.iter().find(|word| !word.starts_with('-')).map(PathBuf::from);
    let script = script.filter(|script| INTERPRETERS.contains(&stem) && script.is_file());
    std::iter::once(path).chain(script).collect()
}

/// A name without a folder is searched in PATH only, as at the start of the program.
fn find_program(program: &str) -> Option<PathBuf> {
    if program.contains('/') {
        return Some(PathBuf::from(program));
    }
    let path = std::env::var_os("PATH")?;
    std::env::split_paths(&path).map(|folder| folder.join(program)).find(|file| file.is_file())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn hashes_the_program_and_the_script_of_an_interpreter() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name).display().to_string();
        for name in ["controller", "python3.12", "c.py", "log"] {
            fs::write(at(name), name).unwrap();
        }
        let digest = |command: &str| FirmwareDigest::of_rig(&format!("exec:{command}")).sha256;
        let program = Some(sha256(b"controller"));
        assert_eq!(digest(&format!("{} {{port}}", at("controller"))), program);
        assert_eq!(digest(&format!("{} --log {} {{port}}", at("controller"), at("log"))), program);
        let both = sha256([sha256(b"python3.12"), sha256(b"c.py")].join("\n").as_bytes());
        assert_eq!(digest(&format!("{} -u {} {{port}}", at("python3.12"), at("c.py"))), Some(both));
        assert_eq!(digest(&format!("{} {{port}}", at("none"))), None);
        for rig in ["hosted", "serial:/dev/ttyUSB0"] {
            assert_eq!(FirmwareDigest::of_rig(rig).sha256, None, "{rig}");
        }
        assert_eq!(FirmwareDigest::of_rig("emulated").sha256, Some(sha256(BUILT_IN_IMAGE)));
    }

    #[test]
    fn detects_another_content_of_the_program() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("controller");
        fs::write(&path, "first").unwrap();
        let digest = FirmwareDigest::of_rig(&format!("exec:{} {{port}}", path.display()));
        assert_eq!(digest.changed_file(), None);
        fs::remove_file(&path).unwrap();
        assert_eq!(digest.changed_file(), None, "the connection fails");
        fs::write(&path, "first").unwrap();
        assert_eq!(digest.changed_file(), None, "another file with the same content");
        fs::write(&path, "second").unwrap();
        assert_eq!(digest.changed_file(), Some(path.display().to_string()));
    }
}
