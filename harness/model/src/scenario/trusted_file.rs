//! Finds a file of settings in a folder or above it. Such a file can start programs, so a file that
//! another user could have written is refused, as git does (`safe.directory`).

use crate::quoted_path;
use crate::scenario::diagnostic::Diagnostic;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::{env, fs, io};

/// Variable with the folders whose settings are trusted although another user owns them, separated
/// by `:`. `*` trusts every folder.
pub const TRUSTED_FOLDERS_VARIABLE: &str = "PLATEBENCH_TRUSTED_FOLDERS";
/// `sudo` sets this variable to the user who called it.
const SUDO_VARIABLE: &str = "SUDO_UID";
const ALL_FOLDERS: &str = "*";
const ROOT: u32 = 0;
/// Permission of all other users to write.
const WORLD_WRITABLE: u32 = 0o002;

/// Path of the nearest file `name` in `folder`, the working directory, or above it. The path is
/// relative if `folder` itself contains the file. Fails if another user could have written the
/// file; `option` is the option that names a file regardless of its owner.
pub fn find_trusted_file_above(folder: &Path, name: &str, option: &str) -> Result<Option<PathBuf>, Diagnostic> {
    let mut candidates = folder.ancestors().filter(|ancestor| ancestor.join(name).symlink_metadata().is_ok());
    let Some(parent) = candidates.next() else { return Ok(None) };
    let whole = parent.join(name);
    let path = if parent == folder { PathBuf::from(name) } else { whole.clone() };
    if is_listed(parent) {
        return Ok(Some(path));
    }
    let sudo_user = env::var(SUDO_VARIABLE).ok();
    let user = rustix::process::geteuid().as_raw();
    let trust = |path: &Path, noun: &str| -> io::Result<Option<String>> {
        let found = fs::metadata(path)?;
        Ok(distrust(found.uid(), found.mode(), user, sudo_user.as_deref()).map(|why| format!("{noun} {why}")))
    };
    let message = match trust(parent, "its folder").and_then(|why| Ok(why.or(trust(&whole, "the file")?))) {
        Ok(None) => return Ok(Some(path)),
        Ok(Some(why)) => format!(
            "not used, because {why}, and it can start programs; read it, then name it with {option} {}, or trust its \
             folder with {TRUSTED_FOLDERS_VARIABLE}={}",
            quoted_path(&whole),
            quoted_path(parent)
        ),
        Err(error) => format!("cannot be read: {error}"),
    };
    Err(Diagnostic::for_file(&path, message))
}

fn is_listed(folder: &Path) -> bool {
    let Some(list) = env::var_os(TRUSTED_FOLDERS_VARIABLE) else { return false };
    let canonical = |path: &Path| fs::canonicalize(path).ok();
    let wanted = canonical(folder);
    env::split_paths(&list)
        .any(|listed| listed == Path::new(ALL_FOLDERS) || (wanted.is_some() && canonical(&listed) == wanted))
}

/// Why a file or folder of `owner` is not trusted. The own user is trusted, and under `sudo` also the
/// user who called it.
fn distrust(owner: u32, mode: u32, user: u32, sudo_user: Option<&str>) -> Option<String> {
    let caller = sudo_user.filter(|_| user == ROOT).and_then(|text| text.parse().ok());
    if owner != user && Some(owner) != caller {
        return Some(format!("belongs to user {owner}, and the bench runs as user {user}"));
    }
    (mode & WORLD_WRITABLE != 0).then(|| "can be changed by every user".to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;
    use rstest::rstest;

    #[rstest]
    #[case::own(1000, 0o755, 1000, None, None)]
    #[case::own_group_writable(1000, 0o775, 1000, None, None)]
    #[case::own_world_writable(1000, 0o777, 1000, None, Some("can be changed by every user"))]
    #[case::sticky(1000, 0o1777, 1000, None, Some("can be changed by every user"))]
    #[case::other(1001, 0o755, 1000, None, Some("belongs to user 1001, and the bench runs as user 1000"))]
    #[case::of_root(0, 0o755, 1000, None, Some("belongs to user 0, and the bench runs as user 1000"))]
    #[case::root(0, 0o755, 0, None, None)]
    #[case::user_as_root(1000, 0o755, 0, None, Some("belongs to user 1000, and the bench runs as user 0"))]
    #[case::sudo(1000, 0o755, 0, Some("1000"), None)]
    #[case::root_under_sudo(0, 0o755, 0, Some("1000"), None)]
    #[case::other_under_sudo(1001, 0o755, 0, Some("1000"), Some("belongs to user 1001, and the bench runs as user 0"))]
    #[case::no_sudo(1001, 0o755, 1000, Some("1001"), Some("belongs to user 1001, and the bench runs as user 1000"))]
    #[case::invalid_sudo(1000, 0o755, 0, Some("x"), Some("belongs to user 1000, and the bench runs as user 0"))]
    fn trusts_the_own_user_and_the_caller_of_sudo(
        #[case] owner: u32,
        #[case] mode: u32,
        #[case] user: u32,
        #[case] sudo_user: Option<&str>,
        #[case] expected: Option<&str>,
    ) {
        assert_eq!(distrust(owner, mode, user, sudo_user).as_deref(), expected);
    }
}
