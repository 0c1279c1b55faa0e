//! Flashing: what is written, what is left alone, what is noticed.

use crate::attach;
use crate::emulated::Bench;
use crate::image::{FLASH, Recipe};
use platebench_rig::probe::{Attached, Flashed, Image, ProbeError};
use std::sync::Arc;
use std::time::{Duration, Instant};

fn image(recipe: &Recipe) -> Arc<Image> {
    Arc::new(Image::parse(&recipe.elf()).unwrap())
}

#[test]
fn an_image_is_written_once_and_skipped_when_it_is_there() {
    let bench = Bench::new();
    let image = image(&Recipe::default());
    let mut board = attach(&bench).unwrap();
    assert_eq!(board.flash(&image).unwrap(), Flashed::Written(0x9000));
    // Three sectors of 16 KiB, 36 pages of 1 KiB.
    assert_eq!(bench.written(), (3, 36));
    for (address, &byte) in (FLASH..).zip(&image.segments()[0].bytes) {
        assert_eq!(*bench.chip().flash_byte(address), byte, "{address:#x}");
    }
    assert_eq!(board.flash(&image).unwrap(), Flashed::AlreadyThere);
    assert_eq!(bench.written(), (3, 36));
}

#[test]
fn one_changed_byte_is_reason_enough_to_write_again() {
    let bench = Bench::new();
    let image = image(&Recipe::default());
    let mut board = attach(&bench).unwrap();
    board.flash(&image).unwrap();
    *bench.chip().flash_byte(FLASH + 0x8fff) ^= 1;
    assert_eq!(board.flash(&image).unwrap(), Flashed::Written(0x9000));
}

#[test]
fn flash_that_does_not_keep_its_bytes_is_noticed() {
    let bench = Bench::new();
    bench.chip().weak_byte = Some(FLASH + 0x1234);
    let error = {
        // 35 pages: an odd number of flips.
        let recipe = Recipe { bytes: 0x8c00, ..Recipe::default() };
        attach(&bench).unwrap().flash(&image(&recipe)).unwrap_err()
    };
    assert!(matches!(error, ProbeError::Verify { address: 0x0800_1234, .. }), "{error}");
}

#[test]
fn a_flash_algorithm_that_never_returns_ends_in_an_error() {
    let bench = Bench::new();
    bench.chip().algorithm_hangs = true;
    let mut board = attach(&bench).unwrap();
    let start = Instant::now();
    let error = board.flash(&image(&Recipe::default())).unwrap_err();
    assert!(matches!(error, ProbeError::Flash(_)), "{error}");
    assert!(start.elapsed() < Duration::from_secs(10));
}

#[test]
fn an_image_for_somewhere_else_is_refused_untouched() {
    let bench = Bench::new();
    let mut board: Attached = attach(&bench).unwrap();
    let recipe = Recipe { address: 0x0810_0000, ..Recipe::default() };
    let error = board.flash(&image(&recipe)).unwrap_err();
    assert!(matches!(error, ProbeError::NotInFlash { address: 0x0810_0000, .. }), "{error}");
    assert_eq!(bench.chip().erased_sectors, 0);
}

#[test]
fn what_is_no_image_for_arm_is_refused() {
    let riscv = Recipe { machine: 243, ..Recipe::default() }.elf();
    let cut = &Recipe::default().elf()[..200];
    for (elf, problem) in [(&riscv[..], "little-endian ARM"), (cut, "outside the file"), (b"no elf", "ELF")] {
        let error = Image::parse(elf).unwrap_err().to_string();
        assert!(error.contains("no firmware image") && error.contains(problem), "{error}");
    }
}
