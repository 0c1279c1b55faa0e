//! The committed images are what the source says.

use super::{firmware_under_test, image};
use sha2::{Digest, Sha256};

#[path = "../../../../firmware-under-test/stm32f4/source_hash.rs"]
pub(crate) mod source_hash;

const IMAGES: [&str; 3] = ["platebench-stm32f4.elf", "planted-faults.elf", "qemu.elf"];

fn holds(elf: &[u8], text: &str) -> bool {
    elf.windows(text.len()).any(|window| window == text.as_bytes())
}

fn manifest() -> toml::Table {
    let text = std::fs::read_to_string(firmware_under_test().join("images/manifest.toml")).unwrap();
    text.parse().unwrap()
}

#[test]
fn manifest_and_images_carry_the_hash_of_the_sources() {
    let hash = source_hash::hex(&source_hash::source_hash(&firmware_under_test()).unwrap());
    let stale = "the firmware's sources have changed: run ci/firmware --update";
    assert_eq!(manifest()["source_hash"].as_str().unwrap(), hash, "{stale}");
    for name in IMAGES {
        assert!(holds(&image(name), &hash), "{name}: {stale}");
    }
}

#[test]
fn the_images_are_those_of_the_manifest() {
    for name in IMAGES {
        let digest = source_hash::hex(&Sha256::digest(image(name)).into());
        assert_eq!(manifest()["images"][name]["sha256"].as_str().unwrap(), digest, "{name}");
    }
}

#[test]
fn the_images_are_small_and_tell_nothing_of_the_machine_that_built_them() {
    for name in IMAGES {
        let elf = image(name);
        assert!(elf.len() < 1_000_000, "{name}: {} bytes", elf.len());
        for path in ["/home/", "/root/", "/tmp/", "/registry/src/"] {
            assert!(!holds(&elf, path), "{name} holds {path}");
        }
    }
}

#[test]
fn a_test_is_no_source_and_everything_else_is() {
    let files = source_hash::files(&firmware_under_test()).unwrap();
    assert!(files.iter().all(|file| firmware_under_test().join(file).is_file()));
    assert!(files.is_sorted() && !files.iter().any(|file| file.ends_with("tests.rs")));
    for file in ["controller/src/machine.rs", "stm32f4/Cargo.lock", "stm32f4/src/main.rs", "wire/src/frame.rs"] {
        assert!(files.iter().any(|other| other == file), "{file}");
    }
}
