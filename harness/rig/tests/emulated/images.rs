//! Files that are no firmware for this board, and firmware that does not come up.

use super::image;
use platebench_rig::emulated::{ImageError, Options};
use platebench_rig::{Emulated, EmulatedError, TargetFault};
use std::path::Path;

const CLASS: usize = 4;
const DATA: usize = 5;
const KIND: usize = 16;
const MACHINE: usize = 18;
const PROGRAM_HEADERS: usize = 28;

fn half(elf: &mut [u8], at: usize, value: u16) {
    elf[at..at + 2].copy_from_slice(&value.to_le_bytes());
}

fn word(elf: &[u8], at: usize) -> u32 {
    u32::from_le_bytes(*elf[at..].first_chunk().unwrap())
}

fn set_word(elf: &mut [u8], at: usize, value: u32) {
    elf[at..at + 4].copy_from_slice(&value.to_le_bytes());
}

/// Where the program header and the content of the segment that is stored at `address` stand in the file.
fn segment(elf: &[u8], address: u32) -> (usize, usize) {
    let first = word(elf, PROGRAM_HEADERS) as usize;
    let header = (0..8).map(|index| first + 32 * index).find(|&at| {
        let from = word(elf, at + 12);
        word(elf, at) == 1 && (from..from + word(elf, at + 16)).contains(&address)
    });
    let header = header.unwrap();
    (header, (word(elf, header + 4) + address - word(elf, header + 12)) as usize)
}

fn refused(change: impl FnOnce(&mut Vec<u8>)) -> ImageError {
    let mut elf = image("platebench-stm32f4.elf");
    change(&mut elf);
    match Emulated::new(&elf, Options::default()) {
        Err(EmulatedError::Image(error)) => error,
        other => panic!("{other:?}"),
    }
}

#[test]
fn what_is_no_elf_for_this_processor_is_told_apart() {
    assert_eq!(refused(Vec::clear), ImageError::NotElf);
    assert_eq!(refused(|elf| *elf = b"#!/bin/sh\n".to_vec()), ImageError::NotElf);
    assert_eq!(refused(|elf| half(elf, MACHINE, 62)), ImageError::Machine(62));
    let x86_64 = refused(|elf| {
        elf[CLASS] = 2;
        half(elf, MACHINE, 62);
    });
    assert!(x86_64.to_string().starts_with("built for x86-64, expected ARM"), "{x86_64}");
    assert_eq!(refused(|elf| elf[CLASS] = 2), ImageError::Class("64-bit"));
    assert_eq!(refused(|elf| elf[DATA] = 2), ImageError::Class("big-endian"));
    assert_eq!(refused(|elf| half(elf, KIND, 1)), ImageError::NotExecutable(1));
}

#[test]
fn damage_is_told_and_never_fatal() {
    assert!(matches!(refused(|elf| elf.truncate(10)), ImageError::Damaged(_)));
    assert!(matches!(refused(|elf| elf.truncate(40)), ImageError::Damaged(_)));
    assert!(matches!(refused(|elf| elf.truncate(8_000)), ImageError::Damaged(_)));
    assert!(matches!(refused(|elf| set_word(elf, PROGRAM_HEADERS, 0xFFFF_FFF0)), ImageError::Damaged(_)));
    // Any byte of the header may be wrong: an error or a firmware that runs, but no panic.
    for at in 0..52 {
        let mut elf = image("platebench-stm32f4.elf");
        elf[at] ^= 0xFF;
        if let Err(error) = Emulated::new(&elf, Options::default()) {
            assert!(!error.to_string().is_empty());
        }
    }
}

#[test]
fn an_image_that_is_linked_elsewhere_says_where() {
    let error = refused(|elf| {
        let (header, _) = segment(elf, 0x0800_0000);
        set_word(elf, header + 12, 0x2000_0000);
    });
    assert!(matches!(error, ImageError::Misplaced { address: 0x2000_0000, .. }), "{error:?}");
    let behind_a_bootloader = refused(|elf| {
        let (header, _) = segment(elf, 0x0800_0000);
        set_word(elf, header + 12, 0x0810_0000);
    });
    assert_eq!(behind_a_bootloader, ImageError::NoVectors);
}

#[test]
fn a_vector_table_that_cannot_work_is_refused() {
    let vector = |number: usize, value| {
        refused(move |elf| {
            let (_, table) = segment(elf, 0x0800_0000);
            set_word(elf, table + 4 * number, value);
        })
    };
    assert_eq!(vector(0, 0), ImageError::Stack(0));
    assert_eq!(vector(0, 0x2000_4001), ImageError::Stack(0x2000_4001));
    assert_eq!(vector(1, 0x0800_0200), ImageError::Reset(0x0800_0200));
    assert_eq!(vector(1, 0x2000_0001), ImageError::Reset(0x2000_0001));
}

#[test]
fn firmware_that_never_answers_is_given_up_with_what_it_did() {
    let mut elf = image("platebench-stm32f4.elf");
    let (_, table) = segment(&elf, 0x0800_0000);
    let reset = word(&elf, table + 4) & !1;
    let (_, at) = segment(&elf, reset);
    half(&mut elf, at, 0xE7FE); // b .
    let Err(EmulatedError::Target(fault)) = Emulated::new(&elf, Options::default()) else { panic!() };
    let TargetFault::NoHandshake { waited_ms: 1_000.., place, .. } = &fault else { panic!("{fault:?}") };
    assert_eq!(place.address, reset);
    assert!(fault.to_string().contains("did not introduce itself on USART2 (PA2, PA3)"), "{fault}");
}

#[test]
fn a_wrong_baud_rate_is_found() {
    let options = Options { baud: Some(921_600), ..Options::default() };
    let Err(error) = Emulated::new(&image("platebench-stm32f4.elf"), options) else { panic!() };
    assert_eq!(error.to_string(), "the firmware sends at 1000000 baud instead of 921600");
}

#[test]
fn a_missing_file_is_named() {
    let error = Emulated::open(Path::new("no/such.elf")).unwrap_err();
    assert!(matches!(&error, EmulatedError::Read { .. }) && error.to_string().starts_with("no/such.elf: "), "{error}");
}

#[test]
fn a_file_of_the_user_works_like_the_one_built_in() {
    let path = super::firmware_under_test().join("images/platebench-stm32f4.elf");
    assert_eq!(Emulated::open(&path).unwrap().baud(), 1_000_000);
}
