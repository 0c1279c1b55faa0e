//! Tests the checks before the board is used, the selection of probe and chip, and the classification
//! of errors.

use crate::chip::CHIP;
use crate::emulated_probe::{OpenResult, SharedChip};
use crate::image::ImageSpec;
use crate::{attach, timeouts};
use platebench_rig::probe::{AttachedBoard, ProbeError, ProbeSetup};
use platebench_rig::{ConnectError, RigSpec};
use std::fs;

fn rig(text: &str) -> RigSpec {
    text.parse().unwrap()
}

fn connect_error(text: &str) -> ConnectError {
    rig(text).check().unwrap_err()
}

#[test]
fn requires_a_serial_port_for_the_image_of_the_bench() {
    let error = connect_error("probe:STM32F407VG");
    assert!(matches!(error.downcast_ref(), Some(ProbeError::NoRtt)), "{error}");
    assert!(error.is_invalid_input());
    assert!(error.to_string().ends_with("--rig probe:CHIP,port=PORT[@BAUD]"), "{error}");
    rig("probe:STM32F407VG,port=/dev/ttyACM0").check().unwrap();
}

#[test]
fn accepts_rtt_in_lockstep_only() {
    let folder = tempfile::tempdir().unwrap();
    let elf = folder.path().join("own.elf");
    fs::write(&elf, ImageSpec::default().elf()).unwrap();
    let over_rtt = rig(&format!("probe:STM32F407VG,elf={}", elf.display()));
    over_rtt.check().unwrap();
    assert!(over_rtt.properties().no_real_time.is_some());
    let error = over_rtt.connect_real_time().err().unwrap();
    assert!(error.is_invalid_input() && error.to_string().contains("--clock lockstep"), "{error}");
    let over_port = rig(&format!("probe:STM32F407VG,elf={},port=/dev/ttyACM0", elf.display()));
    over_port.check().unwrap();
    assert!(over_port.properties().no_real_time.is_none());
    assert_eq!((over_port.baud(), over_rtt.baud()), (Some(1_000_000), None));
    assert!(over_rtt.has_own_clock() && !over_rtt.allows_parallel_links());
}

#[test]
fn classifies_errors_without_a_board_as_invalid_input() {
    let folder = tempfile::tempdir().unwrap();
    let elf = folder.path().join("own.elf");
    fs::write(&elf, "no ELF").unwrap();
    for (rest, expected) in [
        ("nRF52840_xxAA,port=p".to_owned(), "cannot check the identity"),
        ("STM32F407,port=p".to_owned(), "no description of a chip"),
        ("STM32F407VG@st:link,port=p".to_owned(), "expected probe:CHIP"),
        (format!("STM32F407VG,elf={}", elf.display()), "not a firmware image"),
        ("STM32F407VG,elf=/no/such.elf".to_owned(), "/no/such.elf: "),
    ] {
        let error = connect_error(&format!("probe:{rest}"));
        assert!(error.is_invalid_input(), "{rest}");
        assert!(error.to_string().contains(expected), "{rest}: {error}");
    }
}

#[test]
fn classifies_errors_of_the_board_as_errors_of_the_rig() {
    let st_link = ("ST-Link V2-1", 0x0483, 0x374b, "066DFF");
    let dap_link = ("DAPLink", 0x0d28, 0x0204, "0240");
    for (probes, opening, is_invalid) in [
        (vec![], OpenResult::Works, false),
        (vec![st_link], OpenResult::Forbidden, false),
        (vec![st_link], OpenResult::Busy, false),
        (vec![st_link, dap_link], OpenResult::Works, true),
    ] {
        let chip = SharedChip::new();
        let setup = ProbeSetup::new(crate::spec(), &ImageSpec::default().elf(), None).unwrap();
        let error = setup.connect(chip.lister_of(probes, opening), timeouts()).err().unwrap();
        assert_eq!(error.is_invalid_input(), is_invalid, "{error}");
    }
    let chip = SharedChip::new();
    chip.lock().idcode = 0x2001_6419;
    let setup = ProbeSetup::new(crate::spec(), &ImageSpec::default().elf(), None).unwrap();
    let error = setup.connect(chip.lister(), timeouts()).err().unwrap();
    assert!(matches!(&error, ProbeError::WrongChip { .. }) && !error.is_invalid_input(), "{error}");
    // The image lies behind the end of the chip's flash.
    let spec = ImageSpec { address: 0x0810_0000, ..ImageSpec::default() };
    let setup = ProbeSetup::new(crate::spec(), &spec.elf(), None).unwrap();
    let error = setup.connect(SharedChip::new().lister(), timeouts()).err().unwrap();
    assert!(matches!(&error, ProbeError::NotInFlash { .. }) && error.is_invalid_input(), "{error}");
}

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
