//! Firmware that misbehaves on demand: each fault has its verdict, with address and function, within a bounded time.

use super::{CONFIGURE, PERIOD, image, sample};
use platebench_rig::emulated::Options;
use platebench_rig::{Emulated, LinkError, RigError, Session, TargetFault};
use platebench_wire::FaultReport;
use std::time::{Duration, Instant};

const PLANTED: f32 = 900.0;
/// Most take milliseconds; unoptimised code on a busy machine takes a multiple.
const SOON: Duration = Duration::from_secs(10);

fn session(options: Options) -> Session<Emulated> {
    let mut session = Session::open(Emulated::new(&image("planted-faults.elf"), options).unwrap()).unwrap();
    session.begin(&CONFIGURE).unwrap();
    session.sample(Duration::ZERO, &sample(2.0, 0.0)).unwrap().unwrap();
    session
}

fn fault(which: u8) -> TargetFault {
    let mut session = session(Options::default());
    let before = Instant::now();
    let result = session.sample(PERIOD, &sample(PLANTED + f32::from(which), 0.0));
    assert!(before.elapsed() < SOON, "{:?}", before.elapsed());
    let Err(RigError::Link(LinkError::Target(fault))) = result else { panic!("fault {which}: {result:?}") };
    // Dead is dead, until the next trial.
    let Err(RigError::Link(LinkError::Target(again))) = session.sample(2 * PERIOD, &sample(2.0, 0.0)) else { panic!() };
    assert_eq!(again, fault);
    session.begin(&CONFIGURE).unwrap();
    assert!(session.sample(Duration::ZERO, &sample(2.0, 0.0)).unwrap().is_some());
    *fault
}

fn assert_says(which: u8, expected: &[&str]) {
    let message = fault(which).to_string();
    for part in expected {
        assert!(message.contains(part), "fault {which}: `{part}` is missing in: {message}");
    }
}

#[test]
fn traps_name_cause_function_and_line() {
    assert_says(
        1,
        &[
            "HardFault, unaligned access, at 0x08",
            "plant::unaligned_access",
            "(firmware-under-test/stm32f4/src/plant.rs:",
        ],
    );
    assert_says(
        2,
        &[
            "HardFault, division by zero, at 0x08",
            "plant::division_by_zero",
            "(firmware-under-test/stm32f4/src/plant.rs:",
        ],
    );
    assert_says(
        5,
        &[
            "HardFault, undefined instruction, at 0x08",
            "plant::undefined_instruction",
            "(firmware-under-test/stm32f4/src/plant.rs:",
        ],
    );
}

#[test]
fn accesses_to_nothing_name_the_address() {
    let nothing = "address 0x60000000 (nothing answers there)";
    assert_says(7, &["data bus error", "plant::read_of_nothing", nothing, "plant.rs:"]);
    assert_says(
        10,
        &["data bus error", "plant::hole_between_peripherals", "address 0x40002400 (nothing answers there)"],
    );
    assert_says(8, &["instruction bus error, at 0x30000000", "called from", "plant::jump_into_nothing"]);
}

#[test]
fn an_overflowed_stack_is_called_that_and_names_its_function() {
    assert_says(4, &["the stack overflowed", "plant::stack_overflow", "bus error while stacking", "address 0x1fff"]);
}

#[test]
fn a_panic_names_the_line_that_panicked() {
    assert_says(6, &["panic, at 0x08", "plant::index_out_of_bounds", "(firmware-under-test/stm32f4/src/plant.rs:"]);
}

#[test]
fn silence_names_where_the_processor_hangs() {
    assert_says(3, &["no answer", "us after the message had arrived", "plant::endless_loop", "plant.rs:"]);
    assert_says(12, &["no answer", "plant::sleep_without_end"]);
}

#[test]
fn what_the_emulator_has_no_model_of_ends_the_trial() {
    assert!(matches!(fault(9), TargetFault::Unsupported(_)));
    assert_says(9, &["TIM6.ARR written, address 0x4000102c", "plant::unmodelled_peripheral"]);
}

#[test]
fn a_reset_is_not_taken_for_an_answer() {
    assert!(matches!(fault(11), TargetFault::Reset { .. }));
    assert_says(11, &["reset itself (request of the firmware)"]);
}

fn trapped<T: std::fmt::Debug>(result: Result<T, RigError>) -> FaultReport {
    match result {
        Err(RigError::Trapped(report)) => report,
        other => panic!("{other:?}"),
    }
}

#[test]
fn the_firmware_reports_a_trap_itself_and_again_after_the_watchdog() {
    let mut session = session(Options { stop_at_traps: false, ..Options::default() });
    let report = trapped(session.sample(PERIOD, &sample(PLANTED + 2.0, 0.0)));
    assert_eq!((report.code, report.cfsr), (2, 1 << 25));
    assert!((0x0800_0000..0x0802_0000).contains(&report.pc), "{report:x?}");
    // The watchdog ends it after half a second; the start after that remembers.
    assert!(session.pass(Duration::from_millis(400)).unwrap().is_none());
    let after = trapped(session.pass(Duration::from_secs(1)));
    assert_eq!(after, FaultReport { code: 3, ..report });
}

#[test]
fn the_firmware_reports_an_overflowed_stack_from_its_spare_one() {
    let mut session = session(Options { stop_at_traps: false, ..Options::default() });
    let report = trapped(session.sample(PERIOD, &sample(PLANTED + 4.0, 0.0)));
    assert_eq!((report.code, report.pc), (2, 0));
    assert!((0x1FFF_0000..0x2000_0000).contains(&report.address), "{report:x?}");
}

#[test]
fn the_firmware_reports_a_panic_with_its_location() {
    let mut session = session(Options { stop_at_traps: false, ..Options::default() });
    let report = trapped(session.sample(PERIOD, &sample(PLANTED + 6.0, 0.0)));
    assert_eq!(report.code, 1);
    assert!((0x0800_0000..0x0802_0000).contains(&report.address), "{report:x?}");
    assert!((0x0800_0000..0x0802_0000).contains(&report.pc), "{report:x?}");
}

#[test]
fn the_watchdog_ends_a_loop_without_end() {
    let mut session = session(Options { stop_at_traps: false, ..Options::default() });
    assert!(session.sample(PERIOD, &sample(PLANTED + 3.0, 0.0)).is_err());
}
