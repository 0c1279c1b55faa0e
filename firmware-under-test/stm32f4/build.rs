//! Passes the linker script to the linker and the source hash to the firmware's identity.

#[path = "source_hash.rs"]
mod source_hash;

use std::path::{Path, PathBuf};
use std::{env, error, fs};

fn main() -> Result<(), Box<dyn error::Error>> {
    let out = PathBuf::from(env::var("OUT_DIR")?);
    fs::copy("memory.x", out.join("memory.x"))?;
    println!("cargo:rustc-link-search={}", out.display());
    println!("cargo:rustc-link-arg-bins=-Tlink.x");
    println!("cargo:rustc-link-arg-bins=--nmagic");

    let manifest = env::var("CARGO_MANIFEST_DIR")?;
    let root = Path::new(&manifest).parent().ok_or("the package has no folder above it")?;
    let hash = source_hash::source_hash(root)?;
    println!("cargo:rustc-env=PLATEBENCH_SOURCE_HASH={}", source_hash::hex(&hash));
    fs::write(out.join("source_hash.bin"), hash)?;
    for file in source_hash::files(root)? {
        println!("cargo:rerun-if-changed=../{file}");
    }
    // Cargo must also watch the folders, because a new file is not in this list.
    for package in ["controller", "stm32f4", "wire"] {
        println!("cargo:rerun-if-changed=../{package}/src");
    }
    Ok(())
}
