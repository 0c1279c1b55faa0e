//! Produces each message in the tables of `docs/your-own-firmware.md`.

use super::images::{
    CLASS, EABI_FLAGS, KIND, MACHINE, change_image, half, image_error, link_to, segment, set_vector, set_word, word,
};
use super::own_firmware::{PLANTED, TRIGGER, action, build, start};
use super::{CONFIGURE, PERIOD, firmware_under_test, image, sample};
use platebench_rig::emulated::EmulatedOptions;
use platebench_rig::{EmulatedError, EmulatedLink, Session};
use platebench_test_kit::ScriptedLink;
use std::collections::BTreeSet;
use std::fs;
use std::time::Duration;

/// Actions of the setpoints 900 + n µm that cause a trap or an unsupported access.
const ACTIONS: &str = r#"
__attribute__((noinline)) static void on_reserved_memory(void)
{
    REGISTER(0x40023844) |= 1u << 14;
    REGISTER(0x40013800) = 1;
}
__attribute__((noinline)) static void program_option_bytes(void)
{
    REGISTER(0x40023C08) = 0x08192A3B;
    REGISTER(0x40023C08) = 0x4C5D6E7F;
    REGISTER(0x40023C14) |= 2;
}
__attribute__((noinline)) static void without_fpu(void)
{
    REGISTER(0xE000ED88) = 0;
    __asm__ volatile("dsb\n isb\n vmov s0, r0" ::: "memory");
}
__attribute__((noinline)) static void jump_to(uint32_t address)
{
    __asm__ volatile("blx %0" : : "r"(address) : "lr", "memory");
}

static void act(int number)
{
    switch (number) {
    case 1: on_reserved_memory(); break;
    case 2: REGISTER(0x40004420) = 0; break;
    case 3: REGISTER(0x08000100) = 0; break;
    case 4: program_option_bytes(); break;
    case 5: (void)REGISTER(0x60000000); break;
    case 6: without_fpu(); break;
    case 7: jump_to(0x08000100); break;
    case 8: jump_to(0x40000001); break;
    case 9: __asm__ volatile("bkpt #0"); break;
    case 10: move_vectors(0); trap(); break;
    case 11: for (;;) { }
    default: break;
    }
}

void planted_more(const struct message *message);
void planted_more(const struct message *message)
{
    if (message->kind == SAMPLE && message->sample.setpoint_um > 900.0f) {
        act((int)message->sample.setpoint_um - 900);
    }
}
"#;

/// Elements between back quotes of the first cells of all tables that list messages.
fn documented_messages() -> BTreeSet<String> {
    let page = fs::read_to_string(firmware_under_test().join("../docs/your-own-firmware.md")).unwrap();
    let section = page.split("## 6. Messages and remedies").nth(1).unwrap().split("\n## ").next().unwrap();
    let cells = section.lines().filter_map(|line| line.strip_prefix("| `")?.split(" | ").next());
    let quoted = cells.flat_map(|cell| cell.split('`').step_by(2).map(str::to_owned).collect::<Vec<_>>());
    quoted.filter(|text| !text.is_empty()).collect()
}

/// True if `message` contains the parts between the dots of `documented`, in their order.
fn contains_in_order(message: &str, documented: &str) -> bool {
    let mut rest = message;
    documented.split('…').map(str::trim).all(|part| match rest.split_once(part) {
        Some((_, after)) => {
            rest = after;
            true
        }
        None => false,
    })
}

fn start_error(elf: &[u8]) -> String {
    EmulatedLink::new(elf, EmulatedOptions::default()).unwrap_err().to_string()
}

fn image_messages() -> Vec<String> {
    let class = image_error(|elf| elf[CLASS] = 2);
    let other = image_error(|elf| half(elf, MACHINE, 62));
    let converted = image_error(|elf| {
        half(elf, KIND, 1);
        set_word(elf, EABI_FLAGS, 0);
    });
    let object = image_error(|elf| half(elf, KIND, 1));
    let errors = [image_error(Vec::clear), class, other, converted, object, image_error(|elf| elf.truncate(8_000))];
    let linked = [image_error(|elf| link_to(elf, 0x2001_0000)), image_error(|elf| link_to(elf, 0x0810_0000))];
    let vectors = [image_error(|elf| set_vector(elf, 0, 3)), image_error(|elf| set_vector(elf, 1, 0x0800_0200))];
    let all = errors.into_iter().chain(linked).chain(vectors);
    all.map(|error| EmulatedError::Image(error).to_string()).collect()
}

fn messages_of_the_shipped_image() -> Vec<String> {
    let silent = change_image(|elf| {
        let (_, table) = segment(elf, 0x0800_0000);
        let (_, at) = segment(elf, word(elf, table + 4) & !1);
        half(elf, at, 0xE7FE); // b .
    });
    let planted = |number: u8| {
        let mut session = start(&image("planted-faults.elf"));
        session.send_sample(PERIOD, &sample(900.0 + f32::from(number), 0.0)).unwrap_err().to_string()
    };
    [1, 2, 3, 4, 5, 6].map(planted).into_iter().chain([start_error(&silent)]).collect()
}

fn handshake_messages() -> Vec<String> {
    let error = |text: &'static str| {
        let other_program = ScriptedLink::new(move |_, _, _, answer| {
            answer.extend_from_slice(text.as_bytes());
            Ok(Duration::ZERO)
        });
        Session::open(other_program).map(drop).unwrap_err().to_string()
    };
    vec![error("login: "), error("")]
}

/// `None` without a cross compiler.
fn messages_of_own_firmware() -> Option<Vec<String>> {
    let both = format!("{PLANTED}{ACTIONS}");
    let trigger = (TRIGGER.0, TRIGGER.1, &*TRIGGER.2.replace("planted(&message)", "planted_more(&message)"));
    let trigger = (trigger.0, trigger.1, &*trigger.2.replace("void planted(const", "void planted_more(const"));
    let message = |elf: &[u8], number: u8| {
        let mut session = start(elf);
        let answer = session.send_sample(PERIOD, &action(number));
        answer.map_or_else(|error| error.to_string(), |_| format!("an answer in spite of action {number}"))
    };
    let more = build(&both, &[trigger])?;
    let mut messages: Vec<String> = (1..=11).map(|number| message(&more, number)).collect();
    let first = build(PLANTED, &[TRIGGER])?;
    messages.extend([1, 6, 7, 8, 9, 10, 11].map(|number| message(&first, number)));
    let longer = ("protocol.c", "    to = put(to, command->step_us, 2);", "    to = put(to, command->step_us, 4);");
    let mut session =
        Session::open(EmulatedLink::new(&build(PLANTED, &[TRIGGER, longer])?, EmulatedOptions::default()).unwrap())
            .unwrap();
    session.start_trial(&CONFIGURE).unwrap();
    messages.push(session.send_sample(Duration::ZERO, &sample(2.0, 0.0)).unwrap_err().to_string());
    Some(messages)
}

#[test]
fn produces_every_documented_message() {
    let mut messages = [image_messages(), messages_of_the_shipped_image(), handshake_messages()].concat();
    let Some(own) = messages_of_own_firmware() else { return };
    messages.extend(own);
    let documented = documented_messages();
    assert!(documented.len() > 30, "{documented:?}");
    let is_produced = |text: &&String| messages.iter().any(|message| contains_in_order(message, text));
    let missing: Vec<_> = documented.iter().filter(|text| !is_produced(text)).collect();
    assert!(missing.is_empty(), "no test produces {missing:#?}\nof {messages:#?}");
}
