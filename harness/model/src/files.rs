//! Writes every file of the bench, and names the file in errors.
//!
//! A file in a folder is written with [`OutputFolder`], which never follows a link below the folder.
//! A file that the user names on the command line is written with [`OutputFile::named_by_user`]: a
//! link, a pipe or a device there keeps its meaning. Clippy refuses other functions that write
//! (`clippy.toml`). Inputs are read with [`open_regular_file`].

#![expect(clippy::disallowed_methods, reason = "the module that writes files")]

pub use crate::input::{open_regular_file, read_regular_file, read_text_file};
use rustix::fs::{AtFlags, Dir, FileType, Mode, OFlags, RenameFlags};
use rustix::io::Errno;
use std::ffi::{OsStr, OsString};
use std::fs::{self, File};
use std::hash::{BuildHasher as _, Hasher as _, RandomState};
use std::io::{self, ErrorKind, Write};
use std::os::unix::ffi::OsStrExt as _;
use std::path::{Component, Path, PathBuf};
use std::sync::Arc;

#[derive(Debug, thiserror::Error)]
#[error("{}: {source}", path.display())]
pub struct FileError {
    pub path: PathBuf,
    pub source: io::Error,
}

impl From<FileError> for io::Error {
    fn from(error: FileError) -> Self {
        Self::new(error.source.kind(), error)
    }
}

pub trait AtPath<T> {
    fn at(self, path: &Path) -> Result<T, FileError>;
}

impl<T, E: Into<io::Error>> AtPath<T> for Result<T, E> {
    fn at(self, path: &Path) -> Result<T, FileError> {
        self.map_err(|source| FileError { path: path.to_owned(), source: source.into() })
    }
}

const LINK: &str = "is a symbolic link, and the bench writes through no link in a folder; remove the link";
const NO_FOLDER: &str = "exists and is no folder, expected a new or an empty folder";
/// A temporary file is named `.`, [`RANDOM_DIGITS`] digits and this suffix.
const TEMPORARY_SUFFIX: &str = ".part";
const RANDOM_DIGITS: usize = 16;
const FOLDER: OFlags =
    OFlags::RDONLY.union(OFlags::DIRECTORY).union(OFlags::NOFOLLOW).union(OFlags::CLOEXEC).union(OFlags::NONBLOCK);
const NEW_FILE: OFlags = OFlags::WRONLY.union(OFlags::CREATE).union(OFlags::EXCL).union(OFlags::CLOEXEC);
const FILE_MODE: Mode = Mode::from_raw_mode(0o666);
const FOLDER_MODE: Mode = Mode::from_raw_mode(0o777);

/// An open folder. Every path is relative to it and contains no `..`. Missing folders on the way to a
/// new file are created.
///
/// A link in the place of a folder is an error. A link, pipe or device in the place of a file is
/// replaced by the file. Each folder on the way is opened relative to the one before, so a link that
/// another process plants in the meantime is not followed either.
#[derive(Debug, Clone)]
pub struct OutputFolder {
    handle: Arc<File>,
    path: PathBuf,
}

impl OutputFolder {
    /// Opens a folder that the user names. Links in `path` keep their meaning.
    pub fn open(path: &Path) -> Result<Self, FileError> {
        // The parent of a bare file name is the empty path.
        let place = if path.as_os_str().is_empty() { Path::new(".") } else { path };
        let handle = rustix::fs::open(place, FOLDER.difference(OFlags::NOFOLLOW), Mode::empty()).at(path)?;
        Ok(Self { handle: Arc::new(handle.into()), path: path.to_owned() })
    }

    /// Opens a folder that the user names, and creates it and its parents unless it exists.
    pub fn create(path: &Path) -> Result<Self, FileError> {
        match fs::create_dir_all(path) {
            Err(error) if error.kind() == ErrorKind::AlreadyExists => Err(io::Error::new(error.kind(), NO_FOLDER)),
            _ if path.as_os_str().is_empty() => Ok(()),
            result => result,
        }
        .at(path)?;
        Self::open(path)
    }

    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Handle of the folder, for a lock.
    pub fn handle(&self) -> &File {
        &self.handle
    }

    /// Opens the folder at `relative`.
    pub fn open_folder(&self, relative: impl AsRef<Path>) -> Result<Self, FileError> {
        self.walk(relative.as_ref(), false)
    }

    /// Opens the folder at `relative`, and creates it and its parents unless it exists.
    pub fn create_folder(&self, relative: impl AsRef<Path>) -> Result<Self, FileError> {
        self.walk(relative.as_ref(), true)
    }

    /// Creates a file that replaces the one at `relative` in [`OutputFile::commit`].
    pub fn create_file(&self, relative: impl AsRef<Path>) -> Result<OutputFile, FileError> {
        let (folder, name) = self.parent(relative.as_ref(), true)?;
        let (temporary, file) = loop {
            // The keys of this hash come from the operating system's random numbers.
            let random = RandomState::new().build_hasher().finish();
            let temporary = format!(".{random:016x}{TEMPORARY_SUFFIX}");
            match rustix::fs::openat(&folder.handle, &temporary, NEW_FILE, FILE_MODE) {
                Err(Errno::EXIST) => {}
                file => break (temporary, file.at(&folder.path.join(&name))?),
            }
        };
        Ok(OutputFile { file: file.into(), place: Some(Place { folder, temporary: temporary.into(), name }) })
    }

    /// Replaces the file at `relative` and waits until it is on the disk. After an error, the earlier
    /// file still exists.
    pub fn write(&self, relative: impl AsRef<Path>, content: impl AsRef<[u8]>) -> Result<(), FileError> {
        self.create_file(relative)?.write_and_commit(content.as_ref())
    }

    /// Fails with [`ErrorKind::AlreadyExists`] if the file exists. Leaves no unfinished file.
    pub fn write_new(&self, relative: impl AsRef<Path>, content: impl AsRef<[u8]>) -> Result<(), FileError> {
        let (folder, name) = self.parent(relative.as_ref(), true)?;
        let path = folder.path.join(&name);
        let mut file = File::from(rustix::fs::openat(&folder.handle, &name, NEW_FILE, FILE_MODE).at(&path)?);
        file.write_all(content.as_ref()).and_then(|()| file.sync_all()).at(&path).inspect_err(|_| {
            let _ = folder.remove_file(&name);
        })
    }

    /// Opens a file for appending, and creates it unless it exists. Also for a file that is locked.
    pub fn append(&self, relative: impl AsRef<Path>) -> Result<File, FileError> {
        let (folder, name) = self.parent(relative.as_ref(), true)?;
        // Opening a pipe without a reader would wait.
        let flags = OFlags::WRONLY | OFlags::APPEND | OFlags::CREATE | OFlags::CLOEXEC;
        let flags = flags | OFlags::NOFOLLOW | OFlags::NONBLOCK;
        let file = rustix::fs::openat(&folder.handle, &name, flags, FILE_MODE);
        let file = File::from(file.map_err(|error| folder.error_at(&name, error))?);
        let path = folder.path.join(&name);
        if !file.metadata().at(&path)?.is_file() {
            let message = "it is a pipe or a device, expected a file";
            return Err(io::Error::new(ErrorKind::InvalidInput, message)).at(&path);
        }
        Ok(file)
    }

    /// Replaces the file at `relative` by a copy of `source`, without waiting for the disk.
    pub fn copy(&self, source: &mut File, relative: impl AsRef<Path>) -> Result<(), FileError> {
        let mut copy = self.create_file(relative)?;
        io::copy(source, &mut copy.file).at(&copy.path())?;
        copy.commit_without_sync()
    }

    /// Renames a file or an empty or new folder; replaces a file at `to`.
    pub fn rename(&self, from: impl AsRef<Path>, to: impl AsRef<Path>) -> Result<(), FileError> {
        let (from_folder, from) = self.parent(from.as_ref(), false)?;
        let (to_folder, to) = self.parent(to.as_ref(), true)?;
        let renamed = rustix::fs::renameat(&from_folder.handle, &from, &to_folder.handle, &to);
        renamed.at(&to_folder.path.join(&to))
    }

    /// Removes a file, or a link and not its target. Fails if there is none.
    pub fn remove_file(&self, relative: impl AsRef<Path>) -> Result<(), FileError> {
        let (folder, name) = self.parent(relative.as_ref(), false)?;
        rustix::fs::unlinkat(&folder.handle, &name, AtFlags::empty()).at(&folder.path.join(&name))
    }

    /// Removes a folder without content.
    pub fn remove_empty_folder(&self, relative: impl AsRef<Path>) -> Result<(), FileError> {
        let (folder, name) = self.parent(relative.as_ref(), false)?;
        rustix::fs::unlinkat(&folder.handle, &name, AtFlags::REMOVEDIR).at(&folder.path.join(&name))
    }

    /// Removes a folder with its content. A link in it is removed, its target is not.
    pub fn remove_folder(&self, relative: impl AsRef<Path>) -> Result<(), FileError> {
        let folder = self.open_folder(relative.as_ref())?;
        for (name, file_type) in folder.entries()? {
            if file_type == FileType::Directory {
                folder.remove_folder(&name)?;
            } else {
                folder.remove_file(&name)?;
            }
        }
        self.remove_empty_folder(relative)
    }

    /// Waits until everything below the folder, and the entry of the folder itself, is on the disk.
    pub fn sync_tree(&self) -> Result<(), FileError> {
        for (name, file_type) in self.entries()? {
            match file_type {
                FileType::Directory => self.open_folder(&name)?.sync_tree()?,
                FileType::RegularFile => {
                    let flags = OFlags::RDONLY | OFlags::NOFOLLOW | OFlags::NONBLOCK | OFlags::CLOEXEC;
                    let file = rustix::fs::openat(&self.handle, &name, flags, Mode::empty());
                    file.and_then(rustix::fs::fsync).at(&self.path.join(&name))?;
                }
                // A link, pipe or device has no content of its own.
                _ => {}
            }
        }
        self.handle.sync_all().at(&self.path)?;
        let parent = rustix::fs::openat(&self.handle, "..", FOLDER, Mode::empty());
        parent.and_then(rustix::fs::fsync).at(&self.path)
    }

    /// Removes the temporary files directly in the folder that a killed program left behind. The
    /// caller holds the lock of the folder.
    pub fn remove_temporary_files(&self) -> Result<(), FileError> {
        for (name, file_type) in self.entries()? {
            if file_type == FileType::RegularFile && is_temporary(&name) {
                self.remove_file(&name)?;
            }
        }
        Ok(())
    }

    fn walk(&self, relative: &Path, create: bool) -> Result<Self, FileError> {
        relative.components().try_fold(self.clone(), |folder, component| match component {
            Component::Normal(name) => folder.child(name, create),
            Component::CurDir => Ok(folder),
            _ => {
                let message = "expected a path below the folder";
                Err(io::Error::new(ErrorKind::InvalidInput, message)).at(&self.path.join(relative))
            }
        })
    }

    /// Returns the folder that contains `relative`, and the name in it.
    fn parent(&self, relative: &Path, create: bool) -> Result<(Self, OsString), FileError> {
        let Some(name) = relative.file_name() else {
            let message = "expected the name of a file";
            return Err(io::Error::new(ErrorKind::InvalidInput, message)).at(&self.path.join(relative));
        };
        Ok((self.walk(relative.parent().unwrap_or(Path::new("")), create)?, name.to_owned()))
    }

    fn child(&self, name: &OsStr, create: bool) -> Result<Self, FileError> {
        let open = || rustix::fs::openat(&self.handle, name, FOLDER, Mode::empty());
        let opened = match open() {
            Err(Errno::NOENT) if create => match rustix::fs::mkdirat(&self.handle, name, FOLDER_MODE) {
                Ok(()) | Err(Errno::EXIST) => open(),
                Err(error) => Err(error),
            },
            opened => opened,
        };
        let handle = opened.map_err(|error| self.error_at(name, error))?;
        Ok(Self { handle: Arc::new(handle.into()), path: self.path.join(name) })
    }

    /// The kernel has the same number for a link and a file in the place of a folder.
    fn error_at(&self, name: &OsStr, error: Errno) -> FileError {
        let is_link = rustix::fs::statat(&self.handle, name, AtFlags::SYMLINK_NOFOLLOW)
            .is_ok_and(|stat| FileType::from_raw_mode(stat.st_mode) == FileType::Symlink);
        let source = match error {
            Errno::NOTDIR | Errno::LOOP if is_link => io::Error::new(ErrorKind::InvalidInput, LINK),
            Errno::NOTDIR => io::Error::new(ErrorKind::AlreadyExists, NO_FOLDER),
            error => error.into(),
        };
        FileError { path: self.path.join(name), source }
    }

    fn entries(&self) -> Result<Vec<(OsString, FileType)>, FileError> {
        let entry_of = |name: &OsStr, found: FileType| match found {
            // Some file systems do not know the type.
            FileType::Unknown => rustix::fs::statat(&self.handle, name, AtFlags::SYMLINK_NOFOLLOW)
                .map(|stat| (name.to_owned(), FileType::from_raw_mode(stat.st_mode))),
            file_type => Ok((name.to_owned(), file_type)),
        };
        let mut entries = Vec::new();
        for entry in Dir::read_from(&self.handle).at(&self.path)? {
            let entry = entry.at(&self.path)?;
            let name = OsStr::from_bytes(entry.file_name().to_bytes());
            if name != "." && name != ".." {
                entries.push(entry_of(name, entry.file_type()).at(&self.path.join(name))?);
            }
        }
        Ok(entries)
    }
}

fn is_temporary(name: &OsStr) -> bool {
    let name = name.to_string_lossy();
    let digits = name.strip_prefix('.').and_then(|rest| rest.strip_suffix(TEMPORARY_SUFFIX));
    digits.is_some_and(|digits| digits.len() == RANDOM_DIGITS && digits.bytes().all(|byte| byte.is_ascii_hexdigit()))
}

/// File with a temporary name until the commit. A drop before the commit removes it.
#[derive(Debug)]
pub struct OutputFile {
    file: File,
    /// `None` for a pipe or a device.
    place: Option<Place>,
}

#[derive(Debug)]
struct Place {
    folder: OutputFolder,
    temporary: OsString,
    name: OsString,
}

impl Drop for Place {
    fn drop(&mut self) {
        let _ = self.folder.remove_file(&self.temporary);
    }
}

impl OutputFile {
    /// Creates the file at `path`, directly in a folder that the user names. Its folder must exist. A
    /// link in the place of the file is replaced by the file.
    pub fn create(path: &Path) -> Result<Self, FileError> {
        let (folder, name) = folder_and_name(path);
        OutputFolder::open(folder).and_then(|folder| folder.create_file(name)).map_err(|error| {
            // The error names the file, also if its folder is missing.
            FileError { path: path.to_owned(), ..error }
        })
    }

    /// Creates an output that the user names on the command line. Its folder must exist. A symbolic
    /// link stays, and its target is replaced. An existing pipe or device is written directly.
    pub fn named_by_user(path: &Path) -> Result<Self, FileError> {
        if fs::metadata(path).is_ok_and(|metadata| !metadata.is_file()) {
            return Ok(Self { file: File::options().write(true).open(path).at(path)?, place: None });
        }
        Self::create(&target_of_link(path)).map_err(|error| FileError { path: path.to_owned(), ..error })
    }

    pub fn file(&self) -> &File {
        &self.file
    }

    /// Renames the file to its final name and waits until content and name are on the disk.
    pub fn commit(self) -> Result<(), FileError> {
        let Some(place) = &self.place else { return Ok(()) };
        self.file.sync_all().at(&self.path())?;
        self.rename(false)?;
        place.folder.handle.sync_all().at(&place.folder.path)
    }

    /// Renames the file without waiting for the disk. It is complete after a kill, but may be
    /// incomplete after a power cut.
    pub fn commit_without_sync(self) -> Result<(), FileError> {
        self.rename(false)
    }

    /// Like [`Self::commit_without_sync`]. Fails with [`ErrorKind::AlreadyExists`] if the file exists.
    pub fn commit_new(self) -> Result<(), FileError> {
        self.rename(true)
    }

    fn rename(&self, is_new: bool) -> Result<(), FileError> {
        let Some(Place { folder, temporary, name }) = &self.place else { return Ok(()) };
        let handle = &folder.handle;
        let renamed = if is_new {
            match rustix::fs::renameat_with(handle, temporary, handle, name, RenameFlags::NOREPLACE) {
                // Some network file systems know no flags. A hard link replaces nothing either.
                Err(Errno::INVAL | Errno::NOSYS) => {
                    rustix::fs::linkat(handle, temporary, handle, name, AtFlags::empty())
                }
                renamed => renamed,
            }
        } else {
            rustix::fs::renameat(handle, temporary, handle, name)
        };
        renamed.at(&folder.path.join(name))
    }

    fn write_and_commit(mut self, content: &[u8]) -> Result<(), FileError> {
        self.file.write_all(content).at(&self.path())?;
        self.commit()
    }

    /// Path of the content before the commit; empty for a pipe or a device.
    pub fn temporary_path(&self) -> PathBuf {
        self.place.as_ref().map(|place| place.folder.path.join(&place.temporary)).unwrap_or_default()
    }

    fn path(&self) -> PathBuf {
        self.place.as_ref().map(|place| place.folder.path.join(&place.name)).unwrap_or_default()
    }
}

impl Write for OutputFile {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.file.write(bytes)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.file.flush()
    }
}

/// Replaces an output that the user names, like [`OutputFile::named_by_user`].
pub fn write_named_by_user(path: &Path, content: impl AsRef<[u8]>) -> Result<(), FileError> {
    OutputFile::named_by_user(path)?.write_and_commit(content.as_ref())
}

/// Returns the folders that must be created for the folder `path`, innermost first.
pub fn missing_folders(path: &Path) -> Vec<PathBuf> {
    let named = path.ancestors().filter(|folder| !folder.as_os_str().is_empty());
    named.take_while(|folder| !folder.exists()).map(Path::to_owned).collect()
}

/// Removes folders in the given order, and stops at the first one with content. True if one was removed.
pub fn remove_empty_folders<'a>(folders: impl IntoIterator<Item = &'a PathBuf>) -> bool {
    folders.into_iter().take_while(|folder| fs::remove_dir(folder).is_ok()).count() > 0
}

fn target_of_link(path: &Path) -> PathBuf {
    let Ok(target) = fs::read_link(path) else { return path.to_owned() };
    // The target may not exist yet.
    fs::canonicalize(path).unwrap_or_else(|_| path.parent().unwrap_or(Path::new("")).join(target))
}

/// Largest program image: an ELF with debug information, or a shared library.
pub const MAX_IMAGE_BYTES: u64 = 256 << 20;
/// Largest table of telemetry: about an hour at 1 kHz with twenty columns.
pub const MAX_TABLE_BYTES: u64 = 1 << 30;

/// Replaces the file at `path`, directly in a folder that the user names: a link in the place of the
/// file is replaced by the file. Files in a folder below need an [`OutputFolder`].
pub fn write_atomically(path: &Path, content: &[u8]) -> io::Result<()> {
    OutputFile::create(path).and_then(|file| file.write_and_commit(content)).map_err(|error| error.source)
}

/// Like [`OutputFolder::write_new`], for a file that the user names.
pub fn write_new(path: &Path, content: &[u8]) -> io::Result<()> {
    let (folder, name) = folder_and_name(path);
    OutputFolder::open(folder).and_then(|folder| folder.write_new(name, content)).map_err(|error| error.source)
}

/// Like [`OutputFolder::create`].
pub fn create_folder(path: &Path) -> io::Result<()> {
    OutputFolder::create(path).map(drop).map_err(|error| error.source)
}

fn folder_and_name(path: &Path) -> (&Path, &OsStr) {
    (path.parent().unwrap_or(Path::new("")), path.file_name().unwrap_or_default())
}

#[cfg(test)]
mod tests;
