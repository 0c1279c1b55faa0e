//! Tests firmware with planted faults: each is reported with address and function, in bounded time.

use super::{CONFIGURE, PERIOD, image, sample};
use platebench_rig::emulated::EmulatedOptions;
use platebench_rig::{EmulatedLink, LinkError, RigError, Session, Symbols, TargetError};
use platebench_wire::FaultReport;
use rstest::rstest;
use std::time::{Duration, Instant};

const PLANTED_FAULT_SETPOINT_UM: f32 = 900.0;
const SOURCE: &str = "(firmware-under-test/stm32f4/src/planted_faults.rs:";
/// Most faults are reported within milliseconds. Unoptimised code on a busy machine takes longer.
const TIMEOUT: Duration = Duration::from_mins(1);

fn session(options: EmulatedOptions) -> Session<EmulatedLink> {
    let mut session = Session::open(EmulatedLink::new(&image("planted-faults.elf"), options).unwrap()).unwrap();
    session.start_trial(&CONFIGURE).unwrap();
    session.send_sample(Duration::ZERO, &sample(2.0, 0.0)).unwrap().unwrap();
    session
}

fn planted_fault(number: u8) -> platebench_wire::Sample {
    sample(PLANTED_FAULT_SETPOINT_UM + f32::from(number), 0.0)
}

#[rstest]
#[case::unaligned_access(1, &["HardFault, unaligned access, at 0x08", "planted_faults::unaligned_access", SOURCE])]
#[case::division_by_zero(2, &["HardFault, division by zero, at 0x08", "planted_faults::division_by_zero", SOURCE])]
#[case::endless_loop(3, &[
    "the target reset itself (independent watchdog)", "planted_faults::endless_loop", "planted_faults.rs:",
])]
#[case::stack_overflow(4, &[
    "the stack overflowed", "planted_faults::stack_overflow", "bus error while stacking", "address 0x1fff",
])]
#[case::undefined_instruction(5, &[
    "HardFault, undefined instruction, at 0x08", "planted_faults::undefined_instruction", SOURCE,
])]
#[case::panic(6, &["panic, at 0x08", "planted_faults::index_out_of_bounds", SOURCE])]
#[case::read_of_nothing(7, &[
    "data bus error",
    "planted_faults::read_of_nothing",
    "address 0x60000000 (nothing answers there)",
    "planted_faults.rs:",
])]
#[case::jump_into_nothing(8, &[
    "instruction bus error, at 0x30000000", "; called from", "planted_faults::jump_into_nothing",
])]
#[case::hole_between_peripherals(10, &[
    "data bus error", "planted_faults::hole_between_peripherals", "address 0x40002400 (nothing answers there)",
])]
#[case::reset(11, &["the target reset itself (request of the firmware)"])]
#[case::sleep_without_end(12, &[
    "the target reset itself (independent watchdog)", "planted_faults::sleep_without_end",
])]
fn reports_a_planted_fault(#[case] number: u8, #[case] expected: &[&str]) {
    let mut session = session(EmulatedOptions::default());
    let start = Instant::now();
    let result = session.send_sample(PERIOD, &planted_fault(number));
    assert!(start.elapsed() < TIMEOUT, "{:?}", start.elapsed());
    let Err(RigError::Link(LinkError::Target(error))) = result else { panic!("{result:?}") };
    let message = error.to_string();
    for part in expected {
        assert!(message.contains(part), "`{part}` is missing in: {message}");
    }
    assert_eq!(matches!(*error, TargetError::Reset { .. }), [3, 11, 12].contains(&number));
    let again = session.send_sample(2 * PERIOD, &sample(2.0, 0.0));
    let Err(RigError::Link(LinkError::Target(again))) = again else { panic!("{again:?}") };
    assert_eq!(again, error);
    session.start_trial(&CONFIGURE).unwrap();
    assert!(session.send_sample(Duration::ZERO, &sample(2.0, 0.0)).unwrap().is_some());
}

/// Callers of a fault, without addresses and lines.
fn callers(error: RigError) -> Vec<String> {
    let RigError::Link(LinkError::Target(target)) = error else { panic!("{error:?}") };
    let TargetError::Trap(crash) = *target else { panic!("{target:?}") };
    assert_eq!(crash.link, None, "{crash}");
    crash.callers.into_iter().map(|call| call.symbol.unwrap()).collect()
}

/// The expected calls follow from the disassembly: the planted faults are called in the main loop,
/// whose function is `__cortex_m_rt_main`.
#[rstest]
#[case::leaf(2, &[])]
#[case::with_a_frame(7, &[])]
#[case::panic(6, &[])]
#[case::jump_into_nothing(8, &["platebench_stm32f4::planted_faults::jump_into_nothing"])]
fn lists_the_callers_of_a_planted_fault(#[case] number: u8, #[case] inner: &[&str]) {
    let error = session(EmulatedOptions::default()).send_sample(PERIOD, &planted_fault(number)).unwrap_err();
    let callers = callers(error);
    let (found_inner, outer) = callers.split_at(inner.len());
    assert_eq!(found_inner, inner);
    let [main_loop, main, reset] = outer else { panic!("{callers:?}") };
    assert!(main_loop.ends_with("inlined into platebench_stm32f4::__cortex_m_rt_main"), "{callers:?}");
    assert_eq!((&**main, &**reset), ("main", "Reset"));
}

/// `Exponentials::of` is called by `EnvelopeModel::identify`, and this by the main loop. Earlier calls
/// of the configuration and of the steps have left return addresses on the stack.
#[test]
fn omits_callers_that_have_returned() {
    const UNDEFINED: [u8; 2] = 0xde00_u16.to_le_bytes();
    const TRAP_IN: &str = "platebench_controller::envelope::Exponentials::of";
    let elf = image("platebench-stm32f4.elf");
    let symbols = Symbols::read(&elf);
    let function = symbols.functions().iter().find(|function| function.name == TRAP_IN).unwrap();
    let mut session = Session::open(EmulatedLink::new(&elf, EmulatedOptions::default()).unwrap()).unwrap();
    session.start_trial(&CONFIGURE).unwrap();
    session.send_sample(Duration::ZERO, &sample(2.0, 0.0)).unwrap().unwrap();
    assert!(session.link_mut().patch(function.address as u32, &UNDEFINED));
    let steps = (1..100_u8).map(|step| (u32::from(step), sample(2.0, f32::from(step) / 50.0)));
    let error = steps.map(|(step, sample)| session.send_sample(step * PERIOD, &sample)).find_map(Result::err).unwrap();
    let callers = callers(error);
    let [identify, main_loop, main, reset] = &callers[..] else { panic!("{callers:?}") };
    assert!(identify.ends_with("platebench_controller::envelope::EnvelopeModel::identify"), "{callers:?}");
    assert!(main_loop.ends_with("inlined into platebench_stm32f4::__cortex_m_rt_main"), "{callers:?}");
    assert_eq!((&**main, &**reset), ("main", "Reset"));
}

/// Without `.debug_frame`, nothing shows which words on the stack are return addresses.
#[test]
fn names_only_the_link_register_without_call_frame_information() {
    let mut elf = image("planted-faults.elf");
    let name = b".debug_frame";
    let at = elf.windows(name.len()).position(|part| part == name).unwrap();
    elf[at + 1] = b'X';
    let mut session = Session::open(EmulatedLink::new(&elf, EmulatedOptions::default()).unwrap()).unwrap();
    session.start_trial(&CONFIGURE).unwrap();
    let message = session.send_sample(Duration::ZERO, &planted_fault(2)).unwrap_err().to_string();
    assert!(message.contains("planted_faults::division_by_zero"), "{message}");
    assert!(
        message.contains("; callers unknown, the link register has the return address of the call at"),
        "{message}"
    );
    assert!(!message.contains("called from"), "{message}");
}

fn fault_report<T: std::fmt::Debug>(result: Result<T, RigError>) -> FaultReport {
    match result {
        Err(RigError::Trapped(report)) => report,
        other => panic!("{other:?}"),
    }
}

#[test]
fn receives_the_trap_report_of_the_firmware() {
    let mut session = session(EmulatedOptions { stop_at_traps: false, ..EmulatedOptions::default() });
    let report = fault_report(session.send_sample(PERIOD, &planted_fault(2)));
    assert_eq!((report.code, report.cfsr), (2, 1 << 25));
    assert!((0x0800_0000..0x0802_0000).contains(&report.pc), "{report:x?}");
    // The watchdog resets the chip after 0.5 s. Then the firmware reports the trap again.
    assert!(session.advance_to(Duration::from_millis(400)).unwrap().is_none());
    let after = fault_report(session.advance_to(Duration::from_secs(1)));
    assert_eq!(after, FaultReport { code: 3, ..report });
}

#[test]
fn receives_the_report_of_a_stack_overflow() {
    let mut session = session(EmulatedOptions { stop_at_traps: false, ..EmulatedOptions::default() });
    let report = fault_report(session.send_sample(PERIOD, &planted_fault(4)));
    assert_eq!((report.code, report.pc), (2, 0));
    assert!((0x1FFF_0000..0x2000_0000).contains(&report.address), "{report:x?}");
}

#[test]
fn receives_the_report_of_a_panic() {
    let mut session = session(EmulatedOptions { stop_at_traps: false, ..EmulatedOptions::default() });
    let report = fault_report(session.send_sample(PERIOD, &planted_fault(6)));
    assert_eq!(report.code, 1);
    assert!((0x0800_0000..0x0802_0000).contains(&report.address), "{report:x?}");
    assert!((0x0800_0000..0x0802_0000).contains(&report.pc), "{report:x?}");
}

#[test]
fn ends_an_endless_loop_by_the_watchdog() {
    let mut session = session(EmulatedOptions { stop_at_traps: false, ..EmulatedOptions::default() });
    assert!(session.send_sample(PERIOD, &planted_fault(3)).is_err());
}
