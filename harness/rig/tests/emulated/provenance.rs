//! Tests that the committed images correspond to the sources.

use super::{firmware_under_test, image};
use sha2::{Digest, Sha256};

#[path = "../../../../firmware-under-test/stm32f4/source_hash.rs"]
pub(crate) mod source_hash;

const IMAGES: [&str; 3] = ["platebench-stm32f4.elf", "planted-faults.elf", "qemu.elf"];

fn contains_text(elf: &[u8], text: &str) -> bool {
    elf.windows(text.len()).any(|window| window == text.as_bytes())
}

fn manifest() -> toml::Table {
    let text = std::fs::read_to_string(firmware_under_test().join("images/manifest.toml")).unwrap();
    text.parse().unwrap()
}

#[test]
fn finds_the_hash_of_the_sources_in_manifest_and_images() {
    let hash = source_hash::hex(&source_hash::source_hash(&firmware_under_test()).unwrap());
    let stale = "the sources of the firmware have changed: run ci/firmware --update";
    assert_eq!(manifest()["source_hash"].as_str().unwrap(), hash, "{stale}");
    for name in IMAGES {
        assert!(contains_text(&image(name), &hash), "{name}: {stale}");
    }
}

#[test]
fn finds_the_images_of_the_manifest() {
    for name in IMAGES {
        let digest = source_hash::hex(&Sha256::digest(image(name)).into());
        assert_eq!(manifest()["images"][name]["sha256"].as_str().unwrap(), digest, "{name}");
    }
}

#[test]
fn finds_no_local_path_in_the_images() {
    for name in IMAGES {
        let elf = image(name);
        assert!(elf.len() < 1_000_000, "{name}: {} bytes", elf.len());
        for path in ["/home/", "/root/", "/tmp/", "/registry/src/"] {
            assert!(!contains_text(&elf, path), "{name} contains {path}");
        }
    }
}

#[test]
fn hashes_all_sources_except_tests() {
    let files = source_hash::files(&firmware_under_test()).unwrap();
    assert!(files.iter().all(|file| firmware_under_test().join(file).is_file()));
    assert!(files.is_sorted() && !files.iter().any(|file| file.ends_with("tests.rs")));
    for file in ["controller/src/state_machine.rs", "stm32f4/Cargo.lock", "stm32f4/src/main.rs", "wire/src/frame.rs"] {
        assert!(files.iter().any(|other| other == file), "{file}");
    }
}
