//! Tests the selection of probe and chip.

use crate::chip::CHIP;
use crate::emulated_probe::{OpenResult, SharedChip};
use crate::{attach, timeouts};
use platebench_rig::probe::{AttachedBoard, ProbeError};

const ST_LINK: (&str, u16, u16, &str) = ("ST-Link V2-1", 0x0483, 0x374b, "066DFF");
const OTHER_ST_LINK: (&str, u16, u16, &str) = ("ST-Link V2-1", 0x0483, 0x374b, "0670FF");
const DAP_LINK: (&str, u16, u16, &str) = ("DAPLink", 0x0d28, 0x0204, "0240");

fn attach_to(
    text: &str,
    probes: &[(&'static str, u16, u16, &'static str)],
    opening: OpenResult,
) -> Result<AttachedBoard, ProbeError> {
    let chip = SharedChip::new();
    AttachedBoard::attach(&text.parse().unwrap(), chip.lister_of(probes.to_vec(), opening), timeouts())
}

#[test]
fn takes_the_only_probe() {
    let chip = SharedChip::new();
    let board = attach(&chip).unwrap();
    assert_eq!(board.chip().idcode, 0x1007_6413);
    assert_eq!(board.chip().name, CHIP);
    assert_eq!(board.chip().probe, "0483:374b:066DFF (ST-Link V2-1)");
    assert!(!chip.lock().is_halted());
    assert_eq!(chip.lock().programmed_pages, 0);
}

#[test]
fn rejects_another_chip_without_a_write() {
    let chip = SharedChip::new();
    chip.lock().idcode = 0x2001_6419;
    let error = attach(&chip).unwrap_err();
    assert!(matches!(&error, ProbeError::WrongChip { found: 0x419, .. }), "{error}");
    assert!(error.to_string().contains("STM32F427/429/437/439), expected a STM32F407VG"), "{error}");
    assert_eq!(chip.written(), (0, 0));
    assert_eq!(chip.lock().resets, 0);
}

#[test]
fn rejects_an_unknown_chip_before_the_search() {
    for (chip, variant) in
        [("nRF52840_xxAA", "UnsupportedChip"), ("STM32F407", "UnknownChip"), ("STM32F407XX", "UnknownChip")]
    {
        let error = attach_to(chip, &[], OpenResult::Works).unwrap_err();
        assert!(format!("{error:?}").starts_with(variant), "{chip}: {error}");
    }
}

#[test]
fn lists_the_probes_that_do_not_match() {
    let error = attach_to(CHIP, &[], OpenResult::Works).unwrap_err();
    assert!(error.to_string().starts_with("no debug probe was found; is it plugged in"), "{error}");
    let error = attach_to("STM32F407VG@0d28:0204", &[ST_LINK], OpenResult::Works).unwrap_err();
    assert!(error.to_string().starts_with("no debug probe matches 0d28:0204"), "{error}");
    assert!(error.to_string().ends_with("\n  0483:374b:066DFF (ST-Link V2-1)"), "{error}");
}

#[test]
fn rejects_several_matching_probes() {
    let error = attach_to(CHIP, &[ST_LINK, DAP_LINK], OpenResult::Works).unwrap_err();
    assert!(error.to_string().contains("choose one with --rig probe:CHIP@VID:PID"), "{error}");
    assert!(error.to_string().contains("\n  0483:374b:066DFF (ST-Link V2-1)\n  0d28:0204:0240 (DAPLink)"), "{error}");
    assert!(attach_to("STM32F407VG@0d28:0204", &[ST_LINK, DAP_LINK], OpenResult::Works).is_ok());
    let ambiguous = attach_to("STM32F407VG@0483:374b", &[ST_LINK, OTHER_ST_LINK], OpenResult::Works);
    assert!(matches!(ambiguous, Err(ProbeError::SeveralProbes { .. })));
    let board = attach_to("STM32F407VG@0483:374b:0670FF", &[ST_LINK, OTHER_ST_LINK], OpenResult::Works).unwrap();
    assert_eq!(board.chip().probe, "0483:374b:0670FF (ST-Link V2-1)");
}

#[test]
fn reports_why_a_probe_cannot_be_opened() {
    let denied = attach_to(CHIP, &[ST_LINK], OpenResult::Forbidden).unwrap_err();
    assert!(matches!(denied, ProbeError::PermissionDenied { .. }), "{denied}");
    assert!(denied.to_string().contains("udev"), "{denied}");
    let busy = attach_to(CHIP, &[ST_LINK], OpenResult::Busy).unwrap_err();
    assert!(matches!(busy, ProbeError::Busy { .. }), "{busy}");
    let failed = attach_to(CHIP, &[ST_LINK], OpenResult::Fails).unwrap_err();
    assert!(matches!(failed, ProbeError::Open { .. }), "{failed}");
}
