//! Probe and chip: found, chosen, refused.

use crate::chip::CHIP;
use crate::emulated::{Bench, Opening};
use crate::{attach, patience};
use platebench_rig::probe::{Attached, ProbeError};

const ST_LINK: (&str, u16, u16, &str) = ("ST-Link V2-1", 0x0483, 0x374b, "066DFF");
const OTHER_ST_LINK: (&str, u16, u16, &str) = ("ST-Link V2-1", 0x0483, 0x374b, "0670FF");
const DAP_LINK: (&str, u16, u16, &str) = ("DAPLink", 0x0d28, 0x0204, "0240");

fn find(
    text: &str,
    probes: &[(&'static str, u16, u16, &'static str)],
    opening: Opening,
) -> Result<Attached, ProbeError> {
    let bench = Bench::new();
    Attached::attach(&text.parse().unwrap(), bench.lister_of(probes.to_vec(), opening), patience())
}

#[test]
fn the_only_probe_is_taken_and_the_chip_says_who_it_is() {
    let bench = Bench::new();
    let board = attach(&bench).unwrap();
    assert_eq!(board.chip().idcode, 0x1007_6413);
    assert_eq!(board.chip().name, CHIP);
    assert_eq!(board.chip().probe, "0483:374b:066DFF (ST-Link V2-1)");
    assert!(!bench.chip().is_halted());
    assert_eq!(bench.chip().programmed_pages, 0);
}

#[test]
fn another_chip_is_refused_before_anything_is_written() {
    let bench = Bench::new();
    bench.chip().idcode = 0x2001_6419;
    let error = attach(&bench).unwrap_err();
    assert!(matches!(&error, ProbeError::WrongChip { found: 0x419, .. }), "{error}");
    assert!(error.to_string().contains("STM32F427/429/437/439), which is no STM32F407VG"), "{error}");
    assert_eq!(bench.written(), (0, 0));
    assert_eq!(bench.chip().resets, 0);
}

#[test]
fn a_chip_that_cannot_be_checked_is_refused_before_a_probe_is_looked_for() {
    for (chip, means) in
        [("nRF52840_xxAA", "UnsupportedChip"), ("STM32F407", "UnknownChip"), ("STM32F407XX", "UnknownChip")]
    {
        let error = find(chip, &[], Opening::Works).unwrap_err();
        assert!(format!("{error:?}").starts_with(means), "{chip}: {error}");
    }
}

#[test]
fn no_probe_is_said_and_those_that_were_not_meant_are_listed() {
    let error = find(CHIP, &[], Opening::Works).unwrap_err();
    assert!(error.to_string().starts_with("no debug probe was found; is it plugged in"), "{error}");
    let error = find("STM32F407VG@0d28:0204", &[ST_LINK], Opening::Works).unwrap_err();
    assert!(error.to_string().starts_with("no debug probe matches 0d28:0204"), "{error}");
    assert!(error.to_string().ends_with("\n  0483:374b:066DFF (ST-Link V2-1)"), "{error}");
}

#[test]
fn of_several_probes_none_is_guessed() {
    let error = find(CHIP, &[ST_LINK, DAP_LINK], Opening::Works).unwrap_err();
    assert!(error.to_string().contains("choose one with --rig probe:CHIP@VID:PID"), "{error}");
    assert!(error.to_string().contains("\n  0483:374b:066DFF (ST-Link V2-1)\n  0d28:0204:0240 (DAPLink)"), "{error}");
    assert!(find("STM32F407VG@0d28:0204", &[ST_LINK, DAP_LINK], Opening::Works).is_ok());
    let two_alike = find("STM32F407VG@0483:374b", &[ST_LINK, OTHER_ST_LINK], Opening::Works);
    assert!(matches!(two_alike, Err(ProbeError::SeveralProbes { .. })));
    let board = find("STM32F407VG@0483:374b:0670FF", &[ST_LINK, OTHER_ST_LINK], Opening::Works).unwrap();
    assert_eq!(board.chip().probe, "0483:374b:0670FF (ST-Link V2-1)");
}

#[test]
fn a_probe_that_cannot_be_opened_says_why() {
    let denied = find(CHIP, &[ST_LINK], Opening::Forbidden).unwrap_err();
    assert!(matches!(denied, ProbeError::Denied { .. }), "{denied}");
    assert!(denied.to_string().contains("udev"), "{denied}");
    let busy = find(CHIP, &[ST_LINK], Opening::Busy).unwrap_err();
    assert!(matches!(busy, ProbeError::Busy { .. }), "{busy}");
    let failed = find(CHIP, &[ST_LINK], Opening::Fails).unwrap_err();
    assert!(matches!(failed, ProbeError::Open { .. }), "{failed}");
}
