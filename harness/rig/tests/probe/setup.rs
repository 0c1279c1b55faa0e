//! Tests the checks before the board is used, and the classification of errors.

use crate::emulated_probe::{OpenResult, SharedChip};
use crate::image::ImageSpec;
use crate::timeouts;
use platebench_rig::probe::{ProbeError, ProbeSetup};
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
