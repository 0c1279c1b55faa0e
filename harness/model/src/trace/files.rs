//! Writes files that appear as a whole, and names the file in errors. The bench reads every file of a
//! run folder, every baseline, key, record, table of telemetry and program image with
//! [`open_regular_file`].

pub use platebench_plate::input::{open_regular_file, read_regular_file, read_text_file};
use std::fs::File;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::{fs, io};

#[derive(Debug, thiserror::Error)]
#[error("{}: {source}", path.display())]
pub struct FileError {
    pub path: PathBuf,
    pub source: io::Error,
}

pub trait AtPath<T> {
    fn at(self, path: &Path) -> Result<T, FileError>;
}

impl<T> AtPath<T> for io::Result<T> {
    fn at(self, path: &Path) -> Result<T, FileError> {
        self.map_err(|source| FileError { path: path.to_owned(), source })
    }
}

const TEMPORARY_SUFFIX: &str = ".part";

/// File with a temporary name until the commit. A drop before the commit removes it. An existing
/// pipe or device is written directly.
#[derive(Debug)]
pub struct AtomicFile {
    file: File,
    /// `None` for a pipe or a device.
    temporary: Option<TemporaryPath>,
    path: PathBuf,
}

#[derive(Debug)]
struct TemporaryPath(PathBuf);

impl Drop for TemporaryPath {
    fn drop(&mut self) {
        let _ = fs::remove_file(&self.0);
    }
}

impl AtomicFile {
    /// The folder of `path` must exist. A symbolic link stays, and its target is replaced.
    pub fn create(path: &Path) -> io::Result<Self> {
        if fs::metadata(path).is_ok_and(|metadata| !metadata.is_file()) {
            let file = File::options().write(true).open(path)?;
            return Ok(Self { file, temporary: None, path: path.to_owned() });
        }
        let path = target_of_link(path);
        let mut temporary = path.clone().into_os_string();
        temporary.push(TEMPORARY_SUFFIX);
        let temporary = TemporaryPath(temporary.into());
        Ok(Self { file: File::create(&temporary.0)?, temporary: Some(temporary), path })
    }

    pub fn file(&self) -> &File {
        &self.file
    }

    /// Renames the file to its final name and waits until content and name are on the disk.
    pub fn commit(self) -> io::Result<()> {
        let Some(temporary) = &self.temporary else { return Ok(()) };
        self.file.sync_all()?;
        fs::rename(&temporary.0, &self.path)?;
        self.path.parent().map_or(Ok(()), sync)
    }

    /// Renames the file without waiting for the disk. It is complete after a kill, but may be
    /// incomplete after a power cut.
    pub fn commit_without_sync(self) -> io::Result<()> {
        self.temporary.as_ref().map_or(Ok(()), |temporary| fs::rename(&temporary.0, &self.path))
    }
}

fn target_of_link(path: &Path) -> PathBuf {
    let Ok(target) = fs::read_link(path) else { return path.to_owned() };
    // The target may not exist yet.
    fs::canonicalize(path).unwrap_or_else(|_| path.parent().unwrap_or(Path::new("")).join(target))
}

impl Write for AtomicFile {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.file.write(bytes)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.file.flush()
    }
}

/// Replaces the content of `path` like [`AtomicFile`]. After an error, the earlier file still exists.
pub fn write_atomically(path: &Path, content: &[u8]) -> io::Result<()> {
    let mut file = AtomicFile::create(path)?;
    file.write_all(content)?;
    file.commit()
}

/// Fails with [`io::ErrorKind::AlreadyExists`] if the file exists. Leaves no unfinished file.
pub fn write_new(path: &Path, content: &[u8]) -> io::Result<()> {
    let mut file = File::create_new(path)?;
    file.write_all(content).and_then(|()| file.sync_all()).inspect_err(|_| {
        let _ = fs::remove_file(path);
    })
}

/// Creates `folder` and its parents, unless it exists.
pub fn create_folder(folder: &Path) -> io::Result<()> {
    fs::create_dir_all(folder).map_err(|error| match error.kind() {
        io::ErrorKind::AlreadyExists => {
            io::Error::new(error.kind(), "exists and is no folder, expected a new or an empty folder")
        }
        _ => error,
    })
}

/// Waits until everything below `folder`, and the entry of `folder` itself, is on the disk.
pub fn sync_tree(folder: &Path) -> Result<(), FileError> {
    for entry in fs::read_dir(folder).at(folder)? {
        let entry = entry.at(folder)?;
        let path = entry.path();
        if entry.file_type().at(&path)?.is_dir() {
            sync_tree(&path)?;
        } else {
            sync(&path).at(&path)?;
        }
    }
    sync(folder).and_then(|()| folder.parent().map_or(Ok(()), sync)).at(folder)
}

/// Removes the temporary files directly in `folder` that a killed program left behind.
pub fn remove_temporary_files(folder: &Path) -> Result<(), FileError> {
    for entry in fs::read_dir(folder).at(folder)? {
        let path = entry.at(folder)?.path();
        if path.is_file() && path.as_os_str().to_string_lossy().ends_with(TEMPORARY_SUFFIX) {
            fs::remove_file(&path).at(&path)?;
        }
    }
    Ok(())
}

fn sync(path: &Path) -> io::Result<()> {
    // The parent of a bare file name is the empty path.
    let path = if path.as_os_str().is_empty() { Path::new(".") } else { path };
    File::open(path)?.sync_all()
}

/// Largest program image: an ELF with debug information, or a shared library.
pub const MAX_IMAGE_BYTES: u64 = 256 << 20;
/// Largest table of telemetry: about an hour at 1 kHz with twenty columns.
pub const MAX_TABLE_BYTES: u64 = 1 << 30;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn replaces_the_content_and_leaves_no_other_file() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.json");
        for content in ["first", "2"] {
            write_atomically(&path, content.as_bytes()).unwrap();
            assert_eq!(fs::read_to_string(&path).unwrap(), content);
        }
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1);
    }

    #[test]
    fn keeps_the_old_content_until_the_commit() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.json");
        write_atomically(&path, b"old").unwrap();
        let mut file = AtomicFile::create(&path).unwrap();
        file.write_all(b"new").unwrap();
        assert_eq!(fs::read_to_string(&path).unwrap(), "old");
        drop(file);
        assert_eq!(fs::read_to_string(&path).unwrap(), "old");
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1);
    }

    #[test]
    fn keeps_a_link_and_replaces_its_target() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        fs::create_dir(at("kept")).unwrap();
        std::os::unix::fs::symlink("kept/a.json", at("link")).unwrap();
        for content in ["new", "replaced"] {
            write_atomically(&at("link"), content.as_bytes()).unwrap();
            assert!(at("link").is_symlink(), "{content}");
            assert_eq!(fs::read_to_string(at("kept/a.json")).unwrap(), content);
        }
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 2);
    }

    #[test]
    fn names_a_file_instead_of_a_folder() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a");
        create_folder(&path.join("b")).unwrap();
        create_folder(&path).unwrap();
        fs::write(folder.path().join("c"), "").unwrap();
        let error = create_folder(&folder.path().join("c")).unwrap_err();
        assert_eq!(error.to_string(), "exists and is no folder, expected a new or an empty folder");
    }

    #[test]
    fn writes_only_a_new_file() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.toml");
        write_new(&path, b"first").unwrap();
        assert_eq!(write_new(&path, b"second").unwrap_err().kind(), io::ErrorKind::AlreadyExists);
        assert_eq!(fs::read_to_string(&path).unwrap(), "first");
    }

    #[test]
    fn removes_unfinished_files_only() {
        let folder = tempfile::tempdir().unwrap();
        for name in ["a.json", "b.json.part"] {
            fs::write(folder.path().join(name), "").unwrap();
        }
        remove_temporary_files(folder.path()).unwrap();
        sync_tree(folder.path()).unwrap();
        assert!(folder.path().join("a.json").exists() && !folder.path().join("b.json.part").exists());
    }
}

#[cfg(test)]
mod regular_file_tests {
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
    fn writes_into_a_pipe() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("fifo");
        mknodat(CWD, &path, FileType::Fifo, Mode::RUSR | Mode::WUSR, 0).unwrap();
        // Linux opens a FIFO for reading and writing without waiting for the other end.
        let mut reader = File::options().read(true).write(true).open(&path).unwrap();
        write_atomically(&path, b"content").unwrap();
        assert!(std::os::unix::fs::FileTypeExt::is_fifo(&fs::symlink_metadata(&path).unwrap().file_type()));
        let mut content = [0; 7];
        std::io::Read::read_exact(&mut reader, &mut content).unwrap();
        assert_eq!(&content, b"content");
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1);
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
