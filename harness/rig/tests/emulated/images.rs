//! Tests files that are not a firmware for the board, and firmware that does not start.

use super::image;
use platebench_rig::emulated::{EmulatedOptions, ImageError};
use platebench_rig::{EmulatedError, EmulatedLink, TargetError};
use std::path::Path;

pub(super) const CLASS: usize = 4;
const DATA: usize = 5;
pub(super) const KIND: usize = 16;
pub(super) const MACHINE: usize = 18;
pub(super) const EABI_FLAGS: usize = 36;
const PROGRAM_HEADERS: usize = 28;

pub(super) fn half(elf: &mut [u8], at: usize, value: u16) {
    elf[at..at + 2].copy_from_slice(&value.to_le_bytes());
}

pub(super) fn word(elf: &[u8], at: usize) -> u32 {
    u32::from_le_bytes(*elf[at..].first_chunk().unwrap())
}

pub(super) fn set_word(elf: &mut [u8], at: usize, value: u32) {
    elf[at..at + 4].copy_from_slice(&value.to_le_bytes());
}

/// Returns the file offsets of the program header of the segment with `address`, and of that byte.
pub(super) fn segment(elf: &[u8], address: u32) -> (usize, usize) {
    let first = word(elf, PROGRAM_HEADERS) as usize;
    let header = (0..8).map(|index| first + 32 * index).find(|&at| {
        let from = word(elf, at + 12);
        word(elf, at) == 1 && (from..from + word(elf, at + 16)).contains(&address)
    });
    let header = header.unwrap();
    (header, (word(elf, header + 4) + address - word(elf, header + 12)) as usize)
}

pub(super) fn change_image(change: impl FnOnce(&mut Vec<u8>)) -> Vec<u8> {
    let mut elf = image("platebench-stm32f4.elf");
    change(&mut elf);
    elf
}

/// Changes the load address of the segment with the vector table.
pub(super) fn link_to(elf: &mut [u8], address: u32) {
    let (header, _) = segment(elf, 0x0800_0000);
    set_word(elf, header + 12, address);
}

pub(super) fn set_vector(elf: &mut [u8], number: usize, value: u32) {
    let (_, table) = segment(elf, 0x0800_0000);
    set_word(elf, table + 4 * number, value);
}

pub(super) fn image_error(change: impl FnOnce(&mut Vec<u8>)) -> ImageError {
    let elf = change_image(change);
    match EmulatedLink::new(&elf, EmulatedOptions::default()) {
        Err(EmulatedError::Image(error)) => error,
        other => panic!("{other:?}"),
    }
}

#[test]
fn rejects_files_for_other_processors() {
    assert_eq!(image_error(Vec::clear), ImageError::NotElf);
    assert_eq!(image_error(|elf| *elf = b"#!/bin/sh\n".to_vec()), ImageError::NotElf);
    assert_eq!(image_error(|elf| half(elf, MACHINE, 62)), ImageError::Machine(62));
    let x86_64 = image_error(|elf| {
        elf[CLASS] = 2;
        half(elf, MACHINE, 62);
    });
    assert!(x86_64.to_string().starts_with("built for x86-64, expected ARM"), "{x86_64}");
    assert_eq!(image_error(|elf| elf[CLASS] = 2), ImageError::Class("64-bit"));
    assert_eq!(image_error(|elf| elf[DATA] = 2), ImageError::Class("big-endian"));
    assert_eq!(image_error(|elf| half(elf, KIND, 1)), ImageError::NotExecutable(1));
    let converted = image_error(|elf| {
        half(elf, KIND, 1);
        set_word(elf, EABI_FLAGS, 0);
    });
    assert_eq!(converted, ImageError::Converted);
    assert!(converted.to_string().starts_with("made by objcopy from a hex or binary file"), "{converted}");
}

#[test]
fn rejects_damaged_files_without_a_panic() {
    assert!(matches!(image_error(|elf| elf.truncate(10)), ImageError::Damaged(_)));
    assert!(matches!(image_error(|elf| elf.truncate(40)), ImageError::Damaged(_)));
    assert!(matches!(image_error(|elf| elf.truncate(8_000)), ImageError::Damaged(_)));
    assert!(matches!(image_error(|elf| set_word(elf, PROGRAM_HEADERS, 0xFFFF_FFF0)), ImageError::Damaged(_)));
    // With any wrong byte of the header, the result is an error or a running firmware, no panic.
    for at in 0..52 {
        let mut elf = image("platebench-stm32f4.elf");
        elf[at] ^= 0xFF;
        if let Err(error) = EmulatedLink::new(&elf, EmulatedOptions::default()) {
            assert!(!error.to_string().is_empty());
        }
    }
}

#[test]
fn rejects_an_image_linked_elsewhere() {
    let error = image_error(|elf| link_to(elf, 0x2000_0000));
    assert!(matches!(error, ImageError::Misplaced { address: 0x2000_0000, .. }), "{error:?}");
    let behind_a_bootloader = image_error(|elf| link_to(elf, 0x0810_0000));
    assert_eq!(behind_a_bootloader, ImageError::NoVectors);
}

#[test]
fn rejects_an_invalid_vector_table() {
    let vector = |number: usize, value| image_error(move |elf| set_vector(elf, number, value));
    assert_eq!(vector(0, 0), ImageError::Stack(0));
    assert_eq!(vector(0, 0x2000_4001), ImageError::Stack(0x2000_4001));
    assert_eq!(vector(1, 0x0800_0200), ImageError::Reset(0x0800_0200));
    assert_eq!(vector(1, 0x2000_0001), ImageError::Reset(0x2000_0001));
}

#[test]
fn reports_where_silent_firmware_hangs() {
    let mut elf = image("platebench-stm32f4.elf");
    let (_, table) = segment(&elf, 0x0800_0000);
    let reset = word(&elf, table + 4) & !1;
    let (_, at) = segment(&elf, reset);
    half(&mut elf, at, 0xE7FE); // b .
    let Err(EmulatedError::Target(error)) = EmulatedLink::new(&elf, EmulatedOptions::default()) else { panic!() };
    let TargetError::NoHandshake { waited_ms: 1_000.., place, .. } = &error else { panic!("{error:?}") };
    assert_eq!(place.address, reset);
    assert!(error.to_string().contains("did not answer the handshake on USART2 (PA2, PA3)"), "{error}");
}

#[test]
fn names_a_missing_file() {
    let error = EmulatedLink::open(Path::new("no/such.elf")).unwrap_err();
    assert!(matches!(&error, EmulatedError::Read { .. }) && error.to_string().starts_with("no/such.elf: "), "{error}");
}

#[test]
fn opens_a_firmware_file() {
    let path = super::firmware_under_test().join("images/platebench-stm32f4.elf");
    assert_eq!(EmulatedLink::open(&path).unwrap().baud(), 1_000_000);
}
