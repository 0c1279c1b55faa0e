use crate::emulated_probe::SharedChip;
use crate::image::{CONTROL_STEP, ImageSpec, MAIN_LOOP, Program};
use crate::{BUSY_MACHINE_LIMIT, link};
use platebench_rig::link::{Link, LinkError};
use platebench_rig::probe::Image;
use platebench_rig::{Session, TargetError};
use std::sync::Arc;
use std::time::{Duration, Instant};

fn trapping_image() -> ImageSpec {
    ImageSpec { program: Program::Traps, ..ImageSpec::default() }
}

#[test]
fn reports_a_hard_fault_with_callers() {
    let chip = SharedChip::new();
    let start = Instant::now();
    let error = Session::open(link(&chip, &trapping_image()).unwrap()).unwrap_err().to_string();
    assert!(start.elapsed() < BUSY_MACHINE_LIMIT);
    for part in [
        "the firmware trapped: HardFault, data bus error, at 0x08000212 in control_step, address 0x40001000",
        "called from 0x0800024e in main_loop",
        "cfsr 0x00008200, hfsr 0x40000000",
    ] {
        assert!(error.contains(part), "{part} is missing in: {error}");
    }
}

#[test]
fn reads_the_registers_of_a_fault() {
    let chip = SharedChip::new();
    let mut link = link(&chip, &trapping_image()).unwrap();
    let image = Arc::new(Image::parse(&trapping_image().elf()).unwrap());
    assert_eq!(link.board().read_crash(&image).unwrap(), None);
    // A trap is an error of the firmware, not a lost line.
    let error = link.exchange(Duration::ZERO, &[0], &mut Vec::new()).unwrap_err();
    let LinkError::Target(target) = &error else { panic!("{error:?}") };
    assert!(matches!(&**target, TargetError::Trap(crash) if crash.to_string().contains("control_step")), "{target:?}");
    let crash = link.board().read_crash(&image).unwrap().unwrap();
    assert_eq!((crash.exception, crash.status.cfsr), ("HardFault", 0x8200));
    assert_eq!(crash.status.address, Some(0x4000_1000));
    assert_eq!(crash.place.unwrap().address, CONTROL_STEP + 0x12);
    // A call's address is that of the second half-word of its BL instruction.
    assert_eq!(crash.callers.iter().map(|call| call.address).collect::<Vec<_>>(), [MAIN_LOOP + 0xe]);
}

#[test]
fn resets_after_a_trap_without_confirmed_0_v() {
    let chip = SharedChip::new();
    let mut link = link(&chip, &trapping_image()).unwrap();
    link.exchange(Duration::ZERO, &[0], &mut Vec::new()).unwrap_err();
    let before = chip.lock().resets;
    let ending = link.shut_down();
    assert!(!ending.zero_volts_confirmed && ending.reset.is_ok());
    assert_eq!(chip.lock().resets, before + 1);
    assert!(!chip.lock().is_halted());
}

#[test]
fn reports_a_watchdog_reset_during_the_reading() {
    let chip = SharedChip::new();
    let mut link = link(&chip, &trapping_image()).unwrap();
    chip.lock().watchdog_resets_when_halted = true;
    let error = link.exchange(Duration::ZERO, &[0], &mut Vec::new()).unwrap_err().to_string();
    assert!(error.contains("the watchdog reset the chip before its stack was read"), "{error}");
    assert!(error.contains("cfsr 0x00008200") && !error.contains("control_step"), "{error}");
}
