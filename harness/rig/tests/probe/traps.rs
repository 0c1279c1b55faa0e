//! A processor that trapped: what the bench can say of it.

use crate::emulated::Bench;
use crate::image::{CONTROL_STEP, MAIN_LOOP, Program, Recipe};
use crate::{link, patience};
use platebench_rig::link::{Link, LinkError};
use platebench_rig::probe::Image;
use platebench_rig::probe::fault::Trap;
use platebench_rig::{Session, TargetFault};
use std::sync::Arc;
use std::time::{Duration, Instant};

fn recipe() -> Recipe {
    Recipe { program: Program::Traps, ..Recipe::default() }
}

#[test]
fn a_hard_fault_is_reported_with_cause_address_function_and_callers() {
    let bench = Bench::new();
    let start = Instant::now();
    let error = Session::open(link(&bench, &recipe()).unwrap()).unwrap_err().to_string();
    assert!(start.elapsed() < patience().fault + Duration::from_secs(5));
    for part in [
        "HardFault handler",
        "data access to an address that does not answer, address 0x40001000",
        "at 0x08000212 in control_step",
        "cfsr 0x00008200, hfsr 0x40000000",
        "stacked pc 0x08000212, lr 0x08000333",
        "called from 0x08000250 in main_loop",
        "that is the outermost frame",
    ] {
        assert!(error.contains(part), "{part} is missing in: {error}");
    }
}

#[test]
fn the_registers_of_a_fault_can_be_had_one_by_one() {
    let bench = Bench::new();
    let mut link = link(&bench, &recipe()).unwrap();
    let image = Arc::new(Image::parse(&recipe().elf()).unwrap());
    assert_eq!(link.board().fault(&image).unwrap(), None);
    // The firmware's doing, not a lost line: such a trial fails.
    let error = link.exchange(Duration::ZERO, &[0], &mut Vec::new()).unwrap_err();
    let LinkError::Target(target) = &error else { panic!("{error:?}") };
    assert!(matches!(&**target, TargetFault::OnBoard(told) if told.contains("control_step")), "{target:?}");
    let fault = link.board().fault(&image).unwrap().unwrap();
    assert_eq!((fault.trap, fault.cfsr, fault.address), (Trap::HardFault, 0x8200, Some(0x4000_1000)));
    assert_eq!(fault.frame.unwrap().pc, CONTROL_STEP + 0x12);
    let calls: Vec<_> = fault.backtrace.iter().map(|call| call.address).collect();
    assert_eq!(calls, [CONTROL_STEP + 0x12, MAIN_LOOP + 0x10]);
}

#[test]
fn a_trap_ends_in_a_reset_and_no_confirmation_of_zero_volts() {
    let bench = Bench::new();
    let mut link = link(&bench, &recipe()).unwrap();
    link.exchange(Duration::ZERO, &[0], &mut Vec::new()).unwrap_err();
    let before = bench.chip().resets;
    let ending = link.end();
    assert!(!ending.zero_volts_confirmed && ending.reset.is_ok());
    assert_eq!(bench.chip().resets, before + 1);
    assert!(!bench.chip().is_halted());
}

#[test]
fn a_watchdog_that_bites_meanwhile_is_said_and_nothing_is_made_up() {
    let bench = Bench::new();
    let mut link = link(&bench, &recipe()).unwrap();
    bench.chip().watchdog_bites_when_halted = true;
    let error = link.exchange(Duration::ZERO, &[0], &mut Vec::new()).unwrap_err().to_string();
    assert!(error.contains("the watchdog reset the chip while it was read"), "{error}");
    assert!(error.contains("cfsr 0x00008200") && !error.contains("control_step"), "{error}");
}
