//! Passes commit, profile and Cargo features of the build and the shared library for FMUs to the
//! program.

use std::env;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

fn git(arguments: &[&str]) -> Option<String> {
    let output = Command::new("git").args(arguments).output().ok().filter(|output| output.status.success())?;
    let text = String::from_utf8(output.stdout).ok()?.trim().to_owned();
    (!text.is_empty()).then_some(text)
}

/// Takes the name from `OUT_DIR`, which is `<target>/<profile>/build/<package>/out`. `PROFILE` is
/// no alternative: it is `release` for every profile that inherits from `release`.
fn profile() -> Option<String> {
    let out = PathBuf::from(env::var_os("OUT_DIR")?);
    Some(out.ancestors().nth(3)?.file_name()?.to_string_lossy().into_owned())
}

/// Copies the shared library of `PLATEBENCH_FMI_LIBRARY` to `OUT_DIR`; an empty file without the
/// variable.
fn copy_fmi_library() -> Result<(), String> {
    println!("cargo::rerun-if-env-changed=PLATEBENCH_FMI_LIBRARY");
    let folder = env::var_os("OUT_DIR").ok_or("no OUT_DIR")?;
    let content = match env::var_os("PLATEBENCH_FMI_LIBRARY") {
        Some(file) => {
            println!("cargo::rerun-if-changed={}", Path::new(&file).display());
            fs::read(&file)
                .map_err(|error| format!("PLATEBENCH_FMI_LIBRARY {}: {error}", Path::new(&file).display()))?
        }
        None => Vec::new(),
    };
    fs::write(Path::new(&folder).join("libplatebench_fmi.so"), content).map_err(|error| error.to_string())
}

fn main() -> Result<(), String> {
    copy_fmi_library()?;
    println!("cargo::rerun-if-changed=build.rs");
    println!("cargo::rerun-if-env-changed=PLATEBENCH_COMMIT");
    // A source package has no Git repository, so its builder states the commit in this variable.
    let commit = env::var("PLATEBENCH_COMMIT").ok().or_else(|| git(&["rev-parse", "HEAD"]));
    for file in ["HEAD", "logs/HEAD"] {
        if let Some(path) = git(&["rev-parse", "--git-path", file]).filter(|path| Path::new(path).exists()) {
            println!("cargo::rerun-if-changed={path}");
        }
    }
    let features: Vec<_> = ["analysis", "emulated", "export", "live", "probe"]
        .into_iter()
        .filter(|name| env::var_os(format!("CARGO_FEATURE_{}", name.to_uppercase())).is_some())
        .collect();
    println!("cargo::rustc-env=PLATEBENCH_BUILD_COMMIT={}", commit.unwrap_or_default());
    println!("cargo::rustc-env=PLATEBENCH_BUILD_PROFILE={}", profile().unwrap_or_default());
    println!("cargo::rustc-env=PLATEBENCH_BUILD_FEATURES={}", features.join(" "));
    Ok(())
}
