//! Builds the firmware's identity for the bench and as text in the image.

use platebench_wire::{Identity, LawId, capabilities};
use stm32f4::stm32f405 as pac;

const SOURCE_HASH: &[u8; 32] = include_bytes!(concat!(env!("OUT_DIR"), "/source_hash.bin"));

/// `strings`, a debugger and `ci/firmware` can read this text in the image.
#[used]
static TEXT: [u8; 90] = {
    let text = concat!("platebench-stm32f4 ", env!("CARGO_PKG_VERSION"), " ", env!("PLATEBENCH_SOURCE_HASH"), "\n");
    let (bytes, mut padded, mut at) = (text.as_bytes(), [0; 90], 0);
    while at < bytes.len() {
        padded[at] = bytes[at];
        at += 1;
    }
    padded
};

/// Address of the unique device identifier, 96 bits (RM0090, 39.1).
const UNIQUE: *const [u8; 12] = 0x1FFF_7A10 as *const [u8; 12];

const QEMU: bool = cfg!(feature = "qemu");

const fn number(digits: &str) -> u8 {
    let (bytes, mut value, mut at) = (digits.as_bytes(), 0, 0);
    while at < bytes.len() {
        value = value * 10 + (bytes[at] - b'0');
        at += 1;
    }
    value
}

pub(crate) fn identity(p: &pac::Peripherals) -> Identity {
    let mut build = [0; 8];
    build.copy_from_slice(&SOURCE_HASH[..8]);
    Identity {
        version: const {
            [
                number(env!("CARGO_PKG_VERSION_MAJOR")),
                number(env!("CARGO_PKG_VERSION_MINOR")),
                number(env!("CARGO_PKG_VERSION_PATCH")),
            ]
        },
        capabilities: capabilities::TARGET_PACED | capabilities::COMPUTE_TIME | capabilities::LOOP_DELAY,
        laws: LawId::ALL.into_iter().fold(0, |laws, law| laws | 1 << law as u8),
        build,
        // QEMU models neither this register nor `UNIQUE`, and a read of them traps.
        chip: if QEMU { 0 } else { p.DBGMCU.idcode().read().bits() },
        // SAFETY: readable on every STM32F4, aligned for bytes, never written.
        unique: if QEMU { *b"qemu-f405\0\0\0" } else { unsafe { UNIQUE.read_volatile() } },
        name: if QEMU { *b"platebench-qemu\0" } else { *b"platebench-f4\0\0\0" },
    }
}
