//! Tests firmware of other kinds than the shipped image: builds of the C starter with changes in C. A
//! sample with the setpoint 900 + n µm triggers the action n of `planted.c`.

use super::{CONFIGURE, PERIOD, firmware_under_test, sample};
use platebench_model::record::{Transport, UnmodelledInstance};
use platebench_rig::emulated::EmulatedOptions;
use platebench_rig::{Chip, EmulatedError, EmulatedLink, LinkError, RigError, Session, TargetError};
use platebench_test_kit::skip_without;
use platebench_wire::{ControllerState, StateCause};
use rstest::rstest;
use std::path::Path;
use std::process::Command;
use std::sync::OnceLock;
use std::time::Duration;

const FLAGS: &str =
    "-mcpu=cortex-m4 -mthumb -mfpu=fpv4-sp-d16 -mfloat-abi=hard -DBUILD_ID=1ull -std=c11 -Os -g -ffunction-sections";

/// Builds the starter with these replacements of text in its sources and `planted.c` as a further
/// source. `None` without a cross compiler.
pub(super) fn build(planted: &str, replacements: &[(&str, &str, &str)]) -> Option<Vec<u8>> {
    build_with(FLAGS, planted, replacements)
}

fn build_with(flags: &str, planted: &str, replacements: &[(&str, &str, &str)]) -> Option<Vec<u8>> {
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
    make.arg("-C").arg(folder.path()).args([
        format!("SOURCES={sources}"),
        format!("TARGET={flags}"),
        format!("CFLAGS={flags}"),
    ]);
    let output = make.output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    Some(std::fs::read(folder.path().join("build/starter.elf")).unwrap())
}

fn replace(path: &Path, from: &str, to: &str) {
    let text = std::fs::read_to_string(path).unwrap();
    assert!(text.contains(from), "{}: no `{from}`", path.display());
    std::fs::write(path, text.replacen(from, to, 1)).unwrap();
}

pub(super) const TRIGGER: (&str, &str, &str) = (
    "main.c",
    "    if (result == FRAME_MESSAGE) {\n",
    "    if (result == FRAME_MESSAGE) {\n        void planted(const struct message *);\n        planted(&message);\n",
);

pub(super) const PLANTED: &str = r#"
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
__attribute__((noinline)) static void use_can(void)
{
    RCC_APB1ENR |= 1u << 25;
    REGISTER(0x40006400) = 1;
    while (!(REGISTER(0x40006404) & 1)) { }
}
__attribute__((noinline)) static void set_up_can(void)
{
    RCC_APB1ENR |= 1u << 25;
    (void)REGISTER(0x40006404);
    REGISTER(0x40006400) |= 1;
    REGISTER(0x4000641C) = 0x00050005;
    REGISTER(0x40006400) &= ~2u;
}
__attribute__((noinline)) static void disable_and_compute(void)
{
    GPIOB_BSRR = 1u << 16;
    for (volatile int at = 0; at < 100000; at++) { }
}
__attribute__((noinline)) static void starve_window_watchdog(void)
{
    RCC_APB1ENR |= 1u << 11;
    REGISTER(0x40002C00) = 0xFF;
    for (;;) { }
}
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
    case 10: use_can(); break;
    case 11: starve_window_watchdog(); break;
    case 12: set_up_can(); break;
    case 13: disable_and_compute(); break;
    default: break;
    }
}
"#;

fn planted_image() -> Option<&'static [u8]> {
    static IMAGE: OnceLock<Option<Vec<u8>>> = OnceLock::new();
    IMAGE.get_or_init(|| build(PLANTED, &[TRIGGER])).as_deref()
}

pub(super) fn start(elf: &[u8]) -> Session<EmulatedLink> {
    let mut session = Session::open(EmulatedLink::new(elf, EmulatedOptions::default()).unwrap()).unwrap();
    session.start_trial(&CONFIGURE).unwrap();
    session.send_sample(Duration::ZERO, &sample(2.0, 0.0)).unwrap().unwrap();
    session
}

pub(super) fn action(number: u8) -> platebench_wire::Sample {
    sample(900.5 + f32::from(number), 0.0)
}

fn target_error<T: std::fmt::Debug>(result: Result<T, RigError>) -> TargetError {
    let Err(RigError::Link(LinkError::Target(error))) = result else { panic!("{result:?}") };
    *error
}

#[rstest]
#[case::reset(1, &["reset itself (request of the firmware)", "in request_reset", "planted.c:"])]
#[case::trap_after_a_move_in_the_same_step(4, &["HardFault, undefined instruction, at", "in trap", "planted.c:"])]
#[case::trap_whose_handler_resets(5, &["trapped: HardFault, undefined instruction, at", "in trap", "planted.c:"])]
#[case::erase(6, &["the erase of flash is not modelled, FLASH.CR", "0x40023c10", "in erase_flash", "planted.c:"])]
#[case::option_bytes(7, &["the option bytes are not modelled", "0x1fffc000", "in read_option_bytes", "planted.c:"])]
#[case::gated(8, &["TIM4", "is gated by RCC.APB1ENR", "in use_gated_timer", "planted.c:"])]
#[case::unmodelled(10, &["CAN1.MSR read after a write to CAN1", "address 0x40006404", "in use_can", "planted.c:"])]
#[case::window_watchdog(11, &["reset itself (window watchdog)", "in starve_window_watchdog", "planted.c:"])]
#[case::wait_states(9, &["FLASH.ACR", "LATENCY", "in too_few_wait_states", "planted.c:"])]
fn names_cause_function_and_line(#[case] number: u8, #[case] expected: &[&str]) {
    let Some(elf) = planted_image() else { return };
    let mut session = start(elf);
    let message = target_error(session.send_sample(PERIOD, &action(number))).to_string();
    for part in expected {
        assert!(message.contains(part), "`{part}` is missing in: {message}");
    }
}

/// A board gives the same values: those at the reset before the first write, then those of control
/// registers.
#[test]
fn counts_accesses_that_change_nothing_the_bench_models() {
    let Some(elf) = planted_image() else { return };
    let mut session = start(elf);
    assert_eq!(session.link_mut().unmodelled_instances(), []);
    session.send_sample(PERIOD, &action(12)).unwrap().unwrap();
    let registers = ["MCR", "MSR", "BTR"].map(str::to_owned).to_vec();
    let can = UnmodelledInstance { instance: "CAN1".to_owned(), registers, accesses: 6 };
    assert_eq!(session.link_mut().unmodelled_instances(), [can]);
    // After the write, the state of the hardware decides.
    let message = target_error(session.send_sample(2 * PERIOD, &action(12))).to_string();
    assert!(message.contains("CAN1.MSR read after a write to CAN1"), "{message}");
}

/// The plate waits for a step that is longer than the period. This moves no earlier instant.
#[test]
fn a_late_answer_does_not_move_the_instant_of_the_enable_pin() {
    let Some(elf) = planted_image() else { return };
    let mut session = start(elf);
    session.send_sample(PERIOD, &action(13)).unwrap().unwrap();
    let at_once = session.link_mut().enable_pin().low_from_s.unwrap();
    session.send_sample(2 * PERIOD, &sample(2.0, 0.0)).unwrap().unwrap();
    assert_eq!(session.link_mut().enable_pin().low_from_s, Some(at_once));
    assert!((0.001..0.002).contains(&at_once), "{at_once} s");
}

/// Marks an image without FPU instructions as hard float, as zig does for a plain `cortex_m4`.
#[test]
fn notices_a_hard_float_image_that_does_not_use_the_fpu() {
    let planted = "#include \"protocol.h\"\nvoid planted(const struct message *message);\n\
                   void planted(const struct message *message) { (void)message; }\n";
    let is_unused = |elf: &[u8]| start(elf).link_mut().is_fpu_unused();
    let Some(hard) = build(planted, &[TRIGGER]) else { return };
    let flags = FLAGS.replace("-mfloat-abi=hard", "-mfloat-abi=soft");
    let soft = build_with(&flags, planted, &[TRIGGER]).unwrap();
    let mut marked = soft.clone();
    marked[37] |= 0x04;
    assert_eq!([&hard, &soft, &marked].map(|elf| is_unused(elf)), [false, false, true]);
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

/// The interrupt of the idle line comes at any instruction of a main loop without sleep.
#[test]
fn a_main_loop_without_sleep_answers_every_sample() {
    let without_sleep = ("main.c", "            wait_for_interrupt();\n", "            enable_interrupts();\n");
    let Some(elf) = build(PLANTED, &[TRIGGER, without_sleep]) else { return };
    let mut link = EmulatedLink::new(&elf, EmulatedOptions::default()).unwrap();
    link.set_transport(Transport::BlocksAndWords);
    let mut session = Session::open(link).unwrap();
    session.start_trial(&CONFIGURE).unwrap();
    for number in 0..150 {
        assert!(session.send_sample(number * PERIOD, &sample(2.0, 0.5)).unwrap().is_some(), "sample {number}");
    }
    session.link_mut().check_transport().unwrap();
    assert_eq!(session.link_mut().transport(), Transport::Words);
}

/// Uses every modelled peripheral once and writes the results to RTT.
const PERIPHERALS: &str = r#"
#include "board.h"
#include "protocol.h"
#include "stm32f4.h"

static char text[512];
struct {
    char id[16];
    int32_t up, down;
    const char *name;
    char *buffer;
    uint32_t size, write, read, flags;
} _SEGGER_RTT;

static void print(const char *words, uint32_t value)
{
    while (*words) { text[_SEGGER_RTT.write++] = *words++; }
    for (int shift = 28; shift >= 0; shift -= 4) {
        if (value >> shift || shift == 0) { text[_SEGGER_RTT.write++] = "0123456789abcdef"[value >> shift & 15]; }
    }
}

static volatile uint32_t basic, updates, compares, external;

void TIM6_IRQHandler(void) { REGISTER(0x40001010) = 0; basic++; }
void TIM12_IRQHandler(void)
{
    uint32_t status = REGISTER(0x40001810);
    REGISTER(0x40001810) = ~status;
    updates += status & 1;
    compares += status >> 1 & 1;
}
void EXTI0_IRQHandler(void) { REGISTER(0x40013C14) = 1; external++; }

static void wait(uint32_t us) { for (uint32_t since = now_us(); now_us() - since < us;) { } }

static void measure(void)
{
    RCC_APB1ENR |= 0x1FFu << 0 | 1u << 29;
    REGISTER(0x40023844) |= 1u << 14 | 7u << 16;
    REGISTER(0x40023830) |= 1u << 12;
    REGISTER(0x40023834) |= 1u << 6;
    REGISTER(0xE000E100) = 1u << 6;
    NVIC_ISER1 = 1u << 11 | 1u << 22;

    print("reload ", REGISTER(0x4000102C));
    REGISTER(0x40001028) = 83; REGISTER(0x4000102C) = 999; REGISTER(0x40001014) = 1;
    REGISTER(0x40001010) = 0; REGISTER(0x4000100C) = 1; REGISTER(0x40001000) = 1;
    wait(5250);
    REGISTER(0x40001000) = 0;
    print(", basic ", basic);

    REGISTER(0x40001828) = 83; REGISTER(0x4000182C) = 999; REGISTER(0x40001834) = 500; REGISTER(0x40001814) = 1;
    REGISTER(0x40001810) = 0; REGISTER(0x4000180C) = 3; REGISTER(0x40001800) = 1;
    wait(5750);
    REGISTER(0x40001800) = 0;
    print(", updates ", updates); print(", compares ", compares);

    REGISTER(0x40014428) = 167; REGISTER(0x40014414) = 1; REGISTER(0x40014400) = 1;
    wait(100);
    uint32_t count = REGISTER(0x40014424);
    print(", count ", count >= 99 && count <= 103);

    REGISTER(0x40001428) = 83; REGISTER(0x4000142C) = 999; REGISTER(0x40001414) = 1; REGISTER(0x40001410) = 0;
    REGISTER(0x40001400) = 1u << 3 | 1;
    wait(900);
    print(", pulse ", REGISTER(0x40001400)); print(" ", REGISTER(0x40001410));
    wait(200);
    print(" then ", REGISTER(0x40001400)); print(" ", REGISTER(0x40001410));

    REGISTER(0x40013808) = 1; REGISTER(0x40013C08) = 1;
    REGISTER(0x40013C10) = 1;
    REGISTER(0x40013C00) = 1;
    print(", unmasked ", external);
    REGISTER(0x40013C14) = 1;
    REGISTER(0x40013C10) = 1;
    wait(1);
    print(", external ", external); print(" ", REGISTER(0x40013C14));
    print(", port ", REGISTER(0x40013808));

    REGISTER(0x40023008) = 1;
    REGISTER(0x40023000) = 0; print(", crc ", REGISTER(0x40023000));
    REGISTER(0x50060800) = 1u << 2;
    print(", ready ", REGISTER(0x50060804)); print(" ", REGISTER(0x50060808) != REGISTER(0x50060808));
    REGISTER(0x40007400) = 1; REGISTER(0x40007408) = 0x7FF; print(", dac ", REGISTER(0x4000742C));
}

void planted(const struct message *message);
void planted(const struct message *message)
{
    if (message->kind == SAMPLE && message->sample.setpoint_um > 900.0f) {
        _SEGGER_RTT.up = 1; _SEGGER_RTT.buffer = text; _SEGGER_RTT.size = sizeof text;
        const char *id = "SEGGER RTT";
        for (int at = 0; at < 11; at++) { _SEGGER_RTT.id[at] = id[at]; }
        measure();
    }
}
"#;

/// Expected values follow from RM0090: counts from prescaler and reload at 84 and 168 MHz, the checksum
/// from the polynomial, and no software interrupt while its line is masked.
#[test]
fn models_peripherals_of_start_up_code() {
    let handlers = (
        "startup.c",
        "    [16 + USART2_IRQ] = USART2_IRQHandler,\n",
        "    [16 + USART2_IRQ] = USART2_IRQHandler,\n    [16 + 6] = EXTI0_IRQHandler,\n    \
         [16 + 43] = TIM12_IRQHandler,\n    [16 + 54] = TIM6_IRQHandler,\n",
    );
    let declared = (
        "startup.c",
        "void USART2_IRQHandler(void);\n",
        "void USART2_IRQHandler(void), EXTI0_IRQHandler(void), TIM12_IRQHandler(void), TIM6_IRQHandler(void);\n",
    );
    let longer = ("startup.c", "vectors[16 + USART2_IRQ + 1]", "vectors[16 + 91]");
    let Some(elf) = build(PERIPHERALS, &[TRIGGER, handlers, declared, longer]) else { return };
    let mut session = start(&elf);
    session.send_sample(PERIOD, &action(1)).unwrap().unwrap();
    assert_eq!(
        session.link_mut().firmware_output().as_deref(),
        Some(
            "reload ffff, basic 5, updates 5, compares 6, count 1, pulse 9 0 then 8 1, unmasked 0, external 1 0, \
             port 1, crc c704dd7b, ready 1 1, dac 7ff"
        )
    );
}

/// The order of `CubeMX` with `FreeRTOS`: TIM6 as time base first at 16 MHz and again after the change of the
/// clocks, a button on EXTI and SYSCFG.
const TIME_BASE: &str = r#"
#include "board.h"
#include "protocol.h"
#include "stm32f4.h"

void time_base_start(uint32_t timer_hz);
void time_base_start(uint32_t timer_hz)
{
    RCC_APB1ENR |= 1u << 4;
    (void)RCC_APB1ENR;
    NVIC_ISER1 = 1u << 22;
    REGISTER(0x40001000) = 1u << 7;
    REGISTER(0x4000102C) = 999;
    REGISTER(0x40001028) = timer_hz / 1000000u - 1u;
    REGISTER(0x40001014) = 1;
    REGISTER(0x40001010) = ~1u;
    REGISTER(0x4000100C) |= 1;
    REGISTER(0x40001000) |= 1;
}

void button_start(void);
void button_start(void)
{
    REGISTER(0x40023844) |= 1u << 14;
    REGISTER(0x40013814) = (REGISTER(0x40013814) & ~0xF0u) | 2u << 4;
    REGISTER(0x40013C00) |= 1u << 13;
    REGISTER(0x40013C0C) |= 1u << 13;
    NVIC_ISER1 = 1u << 8;
}

void planted(const struct message *message);
void planted(const struct message *message) { (void)message; }
"#;

#[test]
fn a_time_base_on_tim6_stops_a_silent_bench() {
    let replacements = [
        TRIGGER,
        (
            "main.c",
            "    amplifier_start();\n",
            "    void time_base_start(uint32_t);\n    time_base_start(16000000);\n    amplifier_start();\n",
        ),
        (
            "main.c",
            "    tick_start(&clocks);\n",
            "    void button_start(void);\n    button_start();\n    tick_start(&clocks);\n",
        ),
        (
            "board.c",
            "    SYST_RVR = clocks->core_hz / 1000u - 1u;\n",
            "    void time_base_start(uint32_t);\n    time_base_start(clocks->timer_hz);\n",
        ),
        ("board.c", "    SYST_CVR = 0;\n", ""),
        ("board.c", "    SYST_CSR = 7; /* core clock, interrupt, enable */\n", ""),
        ("board.c", "    tick = true;\n", "    REGISTER(0x40001010) = ~1u;\n    tick = true;\n"),
        (
            "startup.c",
            "    [16 + USART2_IRQ] = USART2_IRQHandler,\n",
            "    [16 + USART2_IRQ] = USART2_IRQHandler,\n    [16 + 54] = SysTick_Handler,\n",
        ),
        ("startup.c", "    [15] = SysTick_Handler,\n", ""),
        ("startup.c", "vectors[16 + USART2_IRQ + 1]", "vectors[16 + 91]"),
    ];
    let Some(elf) = build(TIME_BASE, &replacements) else { return };
    let mut session = start(&elf);
    assert_eq!(session.advance_to(Duration::from_micros(4_900)).unwrap(), None);
    let command = session.advance_to(Duration::from_micros(6_600)).unwrap().unwrap();
    assert_eq!((command.state, command.cause), (ControllerState::Fault, StateCause::SampleTimeout));
}

/// Writes 4096 bytes through a ring of 64 bytes as `defmt-rtt` does: it waits for room only if the host
/// has set the blocking mode, and otherwise overwrites unread bytes.
const FRAMES: &str = r#"
#include "protocol.h"

__attribute__((section(".defmt"), used)) static const char table[] = "_defmt_version_ = 4";
static char ring[64];
struct {
    char id[16];
    int32_t up, down;
    const char *name;
    char *buffer;
    uint32_t size;
    volatile uint32_t write, read, flags;
} _SEGGER_RTT;

static void put(char byte)
{
    uint32_t next = (_SEGGER_RTT.write + 1) % sizeof ring;
    if (_SEGGER_RTT.flags == 2) {
        while (next == _SEGGER_RTT.read) { }
    }
    ring[_SEGGER_RTT.write] = byte;
    _SEGGER_RTT.write = next;
}

void planted(const struct message *message);
void planted(const struct message *message)
{
    _SEGGER_RTT.up = 1; _SEGGER_RTT.buffer = ring; _SEGGER_RTT.size = sizeof ring;
    const char *id = "SEGGER RTT";
    for (int at = 0; at < 11; at++) { _SEGGER_RTT.id[at] = id[at]; }
    if (message->kind == SAMPLE && message->sample.setpoint_um > 900.0f) {
        for (int at = 0; at < 4096; at++) { put(table[0]); }
    }
}
"#;

#[test]
fn loses_no_byte_of_defmt_frames() {
    let section = ("stm32f4.ld", "    /DISCARD/ :", "    .defmt 0 (INFO) : { KEEP(*(.defmt)) }\n    /DISCARD/ :");
    let Some(elf) = build(FRAMES, &[TRIGGER, section]) else { return };
    let mut session = start(&elf);
    session.send_sample(PERIOD, &action(1)).unwrap().unwrap();
    assert_eq!(session.link_mut().defmt_frames(), Some(vec![b'_'; 4096]));
    assert_eq!((session.link_mut().firmware_output(), session.link_mut().firmware_output_reads()), (None, None));
}
