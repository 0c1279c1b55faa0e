//! Computes the source hash that the program reports, as the build of the board's image does.

#[path = "../stm32f4/source_hash.rs"]
mod source_hash;

use std::path::{Path, PathBuf};
use std::{env, error, fs};

fn main() -> Result<(), Box<dyn error::Error>> {
    let manifest = env::var("CARGO_MANIFEST_DIR")?;
    let root = Path::new(&manifest).parent().ok_or("the package has no folder above it")?;
    let hash = source_hash::source_hash(root)?;
    fs::write(PathBuf::from(env::var("OUT_DIR")?).join("source_hash.bin"), hash)?;
    for file in source_hash::files(root)? {
        println!("cargo:rerun-if-changed=../{file}");
    }
    // Cargo must also watch the folders, because a new file is not in this list.
    for package in ["controller", "stm32f4", "wire"] {
        println!("cargo:rerun-if-changed=../{package}/src");
    }
    println!("cargo:rustc-env=PLATEBENCH_SOURCE_HASH={}", source_hash::hex(&hash));
    Ok(())
}
