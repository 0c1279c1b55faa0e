//! Tests firmware of other kinds than the shipped image: builds of the C starter with changes in C. A
//! sample with the setpoint 900 + n µm triggers the action n of `planted.c`.

use super::{CONFIGURE, PERIOD, firmware_under_test, sample};
use platebench_rig::emulated::EmulatedOptions;
use platebench_rig::{Chip, EmulatedError, EmulatedLink, LinkError, RigError, Session, TargetError};
use platebench_test_kit::skip_without;
use rstest::rstest;
use std::path::Path;
use std::process::Command;
use std::sync::OnceLock;
use std::time::Duration;

const FLAGS: &str =
    "-mcpu=cortex-m4 -mthumb -mfpu=fpv4-sp-d16 -mfloat-abi=hard -DBUILD_ID=1ull -std=c11 -Os -g -ffunction-sections";

/// Builds the starter with these replacements of text in its sources and `planted.c` as a further
/// source. `None` without a cross compiler.
fn build(planted: &str, replacements: &[(&str, &str, &str)]) -> Option<Vec<u8>> {
    let specs = Command::new("arm-none-eabi-gcc").arg("--print-file-name=nano.specs").output();
    if !specs.is_ok_and(|output| String::from_utf8_lossy(&output.stdout).contains('/')) {
        skip_without("arm-none-eabi-gcc or newlib");
        return None;
    }
    let folder = tempfile::tempdir().unwrap();
    for entry in std::fs::read_dir(firmware_under_test().join("starter-c")).unwrap() {
        let entry = entry.unwrap();
        if entry.file_type().unwrap().is_file() {
            std::fs::copy(entry.path(), folder.path().join(entry.file_name())).unwrap();
        }
    }
    std::fs::write(folder.path().join("planted.c"), planted).unwrap();
    for (file, from, to) in replacements {
        replace(&folder.path().join(file), from, to);
    }
    let sources = "main.c board.c line.c startup.c controller.c law.c damping.c protocol.c planted.c";
    let mut make = Command::new("make");
    make.arg("-C").arg(folder.path()).args([format!("SOURCES={sources}"), format!("CFLAGS={FLAGS}")]);
    let output = make.output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    Some(std::fs::read(folder.path().join("build/starter.elf")).unwrap())
}

fn replace(path: &Path, from: &str, to: &str) {
    let text = std::fs::read_to_string(path).unwrap();
    assert!(text.contains(from), "{}: no `{from}`", path.display());
    std::fs::write(path, text.replacen(from, to, 1)).unwrap();
}

const TRIGGER: (&str, &str, &str) = (
    "main.c",
    "    if (result == FRAME_MESSAGE) {\n",
    "    if (result == FRAME_MESSAGE) {\n        void planted(const struct message *);\n        planted(&message);\n",
);

const PLANTED: &str = r#"
#include "protocol.h"
#include "stm32f4.h"

static uint32_t moved[128] __attribute__((aligned(512)));

__attribute__((noinline)) static void trap(void) { __asm__ volatile("udf #7"); }
__attribute__((noinline)) static void request_reset(void) { REGISTER(0xE000ED0C) = 0x05FA0004; for (;;) { } }
__attribute__((noinline)) static void erase_flash(void)
{
    REGISTER(0x40023C04) = 0x45670123;
    REGISTER(0x40023C04) = 0xCDEF89AB;
    REGISTER(0x40023C10) = 1u << 1 | 11u << 3;
    REGISTER(0x40023C10) |= 1u << 16;
    while (REGISTER(0x40023C0C) & 1u << 16) { }
}
__attribute__((noinline)) static void read_option_bytes(void) { (void)REGISTER(0x1FFFC000); }
__attribute__((noinline)) static void use_gated_timer(void) { REGISTER(0x40000800) = 1; }
__attribute__((noinline)) static void too_few_wait_states(void) { FLASH_ACR = 0; (void)FLASH_ACR; }

static void own_handler(void) { for (;;) { } }
static void resetting_handler(void) { request_reset(); }

static void move_vectors(void (*handler)(void))
{
    for (int at = 0; at < 128; at++) {
        moved[at] = ((uint32_t *)0x08000000)[at];
    }
    for (int at = 2; at < 7; at++) {
        moved[at] = (uint32_t)handler;
    }
    REGISTER(0xE000ED08) = (uint32_t)moved;
}

void planted(const struct message *message);
void planted(const struct message *message)
{
    if (message->kind != SAMPLE) {
        return;
    }
    switch ((int)message->sample.setpoint_um - 900) {
    case 1: request_reset(); break;
    case 2: move_vectors(own_handler); break;
    case 3: trap(); break;
    case 4: move_vectors(own_handler); trap(); break;
    case 5: move_vectors(resetting_handler); trap(); break;
    case 6: erase_flash(); break;
    case 7: read_option_bytes(); break;
    case 8: use_gated_timer(); break;
    case 9: too_few_wait_states(); break;
    default: break;
    }
}
"#;

fn planted_image() -> Option<&'static [u8]> {
    static IMAGE: OnceLock<Option<Vec<u8>>> = OnceLock::new();
    IMAGE.get_or_init(|| build(PLANTED, &[TRIGGER])).as_deref()
}

fn start(elf: &[u8]) -> Session<EmulatedLink> {
    let mut session = Session::open(EmulatedLink::new(elf, EmulatedOptions::default()).unwrap()).unwrap();
    session.start_trial(&CONFIGURE).unwrap();
    session.send_sample(Duration::ZERO, &sample(2.0, 0.0)).unwrap().unwrap();
    session
}

fn action(number: u8) -> platebench_wire::Sample {
    sample(900.5 + f32::from(number), 0.0)
}

fn target_error<T: std::fmt::Debug>(result: Result<T, RigError>) -> TargetError {
    let Err(RigError::Link(LinkError::Target(error))) = result else { panic!("{result:?}") };
    *error
}

#[rstest]
#[case::reset(1, &["reset itself (request of the firmware)", "in request_reset", "planted.c:"])]
#[case::trap_after_a_move_in_the_same_step(4, &["trapped: HardFault, undefined instruction, at", "in trap", "planted.c:"])]
#[case::trap_whose_handler_resets(5, &["trapped: HardFault, undefined instruction, at", "in trap", "planted.c:"])]
#[case::erase(6, &["the erase of flash is not modelled, FLASH.CR", "0x40023c10", "in erase_flash", "planted.c:"])]
#[case::option_bytes(7, &["the option bytes are not modelled", "0x1fffc000", "in read_option_bytes", "planted.c:"])]
#[case::gated(8, &["TIM4", "is gated by RCC.APB1ENR", "in use_gated_timer", "planted.c:"])]
#[case::wait_states(9, &["FLASH.ACR", "LATENCY", "in too_few_wait_states", "planted.c:"])]
fn names_cause_function_and_line(#[case] number: u8, #[case] expected: &[&str]) {
    let Some(elf) = planted_image() else { return };
    let mut session = start(elf);
    let message = target_error(session.send_sample(PERIOD, &action(number))).to_string();
    for part in expected {
        assert!(message.contains(part), "`{part}` is missing in: {message}");
    }
}

#[test]
fn reports_a_trap_after_the_vector_table_has_moved() {
    let Some(elf) = planted_image() else { return };
    let mut session = start(elf);
    session.send_sample(PERIOD, &action(2)).unwrap();
    let error = target_error(session.send_sample(2 * PERIOD, &action(3)));
    let TargetError::Trap(crash) = &error else { panic!("{error}") };
    // Stopped at the first instruction of the handler in the table in RAM.
    assert!(crash.place.as_ref().unwrap().symbol.as_deref() == Some("trap"), "{error}");
    assert!(!crash.callers.is_empty(), "{error}");
}

/// The start executes a trap whose handler never returns. The table is moved before.
#[test]
fn reports_a_trap_of_the_start_after_the_vector_table_has_moved() {
    let start = (
        "main.c",
        "    amplifier_start();\n",
        "    void planted_start(void);\n    planted_start();\n    amplifier_start();\n",
    );
    let planted = format!(
        "{PLANTED}void planted_start(void);\nvoid planted_start(void) {{ move_vectors(own_handler); trap(); }}\n"
    );
    let Some(elf) = build(&planted, &[TRIGGER, start]) else { return };
    let result = EmulatedLink::new(&elf, EmulatedOptions::default());
    let Err(EmulatedError::Target(error @ TargetError::Trap(_))) = result else { panic!("{result:?}") };
    let message = error.to_string();
    assert!(message.contains("HardFault, undefined instruction, at") && message.contains("in trap"), "{message}");
}

/// A main loop without sleep counts the instructions of the step, not those of the transmission.
#[test]
fn counts_no_instructions_of_idle_spinning() {
    let without_sleep = ("main.c", "            wait_for_interrupt();\n", "            enable_interrupts();\n");
    let planted = "#include \"protocol.h\"\nvoid planted(const struct message *message);\n\
                   void planted(const struct message *message) { (void)message; }\n";
    let Some(sleeping) = build(planted, &[TRIGGER]) else { return };
    let spinning = build(planted, &[TRIGGER, without_sleep]).unwrap();
    let [sleeps, spins] = [sleeping, spinning].map(|elf| {
        let mut session = start(&elf);
        session.send_sample(PERIOD, &sample(2.0, 0.5)).unwrap().unwrap();
        let link = session.link_mut();
        (link.instruction_count().unwrap(), link.computing_time().unwrap())
    });
    // Half of the 16,000 instructions of an idle line of one byte at 1 Mbaud belong to the spinning.
    assert!(spins.0 < sleeps.0 + 4_000, "{sleeps:?} {spins:?}");
    assert!(spins.1 < sleeps.1 + Duration::from_micros(24), "{sleeps:?} {spins:?}");
}
