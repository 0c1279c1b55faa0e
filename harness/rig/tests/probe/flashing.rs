use crate::attach;
use crate::emulated_probe::SharedChip;
use crate::image::{FLASH, ImageSpec};
use platebench_rig::probe::{AttachedBoard, FlashImage, FlashOutcome, ProbeError};
use std::sync::Arc;

fn image(spec: &ImageSpec) -> Arc<FlashImage> {
    Arc::new(FlashImage::parse(&spec.elf()).unwrap())
}

#[test]
fn writes_an_image_only_if_needed() {
    let chip = SharedChip::new();
    let image = image(&ImageSpec::default());
    let mut board = attach(&chip).unwrap();
    assert_eq!(board.flash(&image).unwrap(), FlashOutcome::Written(0x9000));
    // 0x9000 bytes are three sectors of 16 KiB and 36 pages of 1 KiB.
    assert_eq!(chip.written(), (3, 36));
    for (address, &byte) in (FLASH..).zip(&image.segments()[0].bytes) {
        assert_eq!(*chip.lock().flash_byte(address), byte, "{address:#x}");
    }
    assert_eq!(board.flash(&image).unwrap(), FlashOutcome::Unchanged);
    assert_eq!(chip.written(), (3, 36));
}

#[test]
fn writes_again_after_one_changed_byte() {
    let chip = SharedChip::new();
    let image = image(&ImageSpec::default());
    let mut board = attach(&chip).unwrap();
    board.flash(&image).unwrap();
    *chip.lock().flash_byte(FLASH + 0x8fff) ^= 1;
    assert_eq!(board.flash(&image).unwrap(), FlashOutcome::Written(0x9000));
}

#[test]
fn reports_flash_that_differs_after_the_write() {
    let chip = SharedChip::new();
    chip.lock().failing_byte = Some(FLASH + 0x1234);
    let error = {
        // The image has 35 pages, so that the bit is flipped an odd number of times.
        let spec = ImageSpec { bytes: 0x8c00, ..ImageSpec::default() };
        attach(&chip).unwrap().flash(&image(&spec)).unwrap_err()
    };
    assert!(matches!(error, ProbeError::Verify { address: 0x0800_1234, .. }), "{error}");
}

#[test]
fn reports_a_flash_algorithm_that_hangs() {
    let chip = SharedChip::new();
    chip.lock().algorithm_hangs = true;
    let mut board = attach(&chip).unwrap();
    let error = board.flash(&image(&ImageSpec::default())).unwrap_err();
    assert!(matches!(error, ProbeError::Flash(_)), "{error}");
}

#[test]
fn rejects_an_image_outside_the_flash() {
    let chip = SharedChip::new();
    let mut board: AttachedBoard = attach(&chip).unwrap();
    let spec = ImageSpec { address: 0x0810_0000, ..ImageSpec::default() };
    let error = board.flash(&image(&spec)).unwrap_err();
    assert!(matches!(error, ProbeError::NotInFlash { address: 0x0810_0000, .. }), "{error}");
    assert_eq!(chip.lock().erased_sectors, 0);
}

#[test]
fn rejects_files_that_are_not_for_arm() {
    let riscv = ImageSpec { machine: 243, ..ImageSpec::default() }.elf();
    let cut = &ImageSpec::default().elf()[..200];
    for (elf, problem) in [(&riscv[..], "little-endian ARM"), (cut, "outside the file"), (b"no elf", "ELF")] {
        let error = FlashImage::parse(elf).unwrap_err().to_string();
        assert!(error.contains("not a firmware image") && error.contains(problem), "{error}");
    }
}
