//! `--rig probe:…`: what is checked before the board, and how the bench ends where it cannot be worked with.

use crate::emulated::{Bench, Opening};
use crate::image::Recipe;
use crate::patience;
use platebench_rig::probe::{ProbeError, Setup};
use platebench_rig::{ConnectError, RigSpec};
use std::fs;

fn rig(text: &str) -> RigSpec {
    text.parse().unwrap()
}

fn refusal(text: &str) -> ConnectError {
    rig(text).check().unwrap_err()
}

#[test]
fn the_image_that_comes_with_the_bench_needs_the_serial_port() {
    let error = refusal("probe:STM32F407VG");
    assert!(matches!(&error, ConnectError::Probe(ProbeError::NoRtt)), "{error}");
    assert!(error.is_invalid_input());
    assert!(error.to_string().ends_with("--rig probe:CHIP,port=PORT[@BAUD]"), "{error}");
    rig("probe:STM32F407VG,port=/dev/ttyACM0").check().unwrap();
}

#[test]
fn own_firmware_with_rtt_needs_no_port_and_lockstep() {
    let folder = tempfile::tempdir().unwrap();
    let elf = folder.path().join("own.elf");
    fs::write(&elf, Recipe::default().elf()).unwrap();
    let over_rtt = rig(&format!("probe:STM32F407VG,elf={}", elf.display()));
    over_rtt.check().unwrap();
    assert!(!over_rtt.keeps_real_time());
    let error = over_rtt.connect_in_real_time().err().unwrap();
    assert!(error.is_invalid_input() && error.to_string().contains("--clock lockstep"), "{error}");
    let over_port = rig(&format!("probe:STM32F407VG,elf={},port=/dev/ttyACM0", elf.display()));
    over_port.check().unwrap();
    assert!(over_port.keeps_real_time());
    assert_eq!((over_port.baud(), over_rtt.baud()), (Some(1_000_000), None));
    assert!(over_rtt.has_own_clock() && !over_rtt.is_plural());
}

#[test]
fn what_can_be_seen_without_a_board_is_the_user_s_doing() {
    let folder = tempfile::tempdir().unwrap();
    let elf = folder.path().join("own.elf");
    fs::write(&elf, "no ELF").unwrap();
    for (rest, told) in [
        ("nRF52840_xxAA,port=p".to_owned(), "none of the chips"),
        ("STM32F407,port=p".to_owned(), "no description of a chip"),
        ("STM32F407VG@st:link,port=p".to_owned(), "expected probe:CHIP"),
        (format!("STM32F407VG,elf={}", elf.display()), "no firmware image"),
        ("STM32F407VG,elf=/no/such.elf".to_owned(), "/no/such.elf: "),
    ] {
        let error = refusal(&format!("probe:{rest}"));
        assert!(error.is_invalid_input(), "{rest}");
        assert!(error.to_string().contains(told), "{rest}: {error}");
    }
}

#[test]
fn what_only_a_board_can_show_is_the_rig_s_doing_but_for_a_choice_of_probes() {
    let st_link = ("ST-Link V2-1", 0x0483, 0x374b, "066DFF");
    let dap_link = ("DAPLink", 0x0d28, 0x0204, "0240");
    for (probes, opening, is_invalid) in [
        (vec![], Opening::Works, false),
        (vec![st_link], Opening::Forbidden, false),
        (vec![st_link], Opening::Busy, false),
        (vec![st_link, dap_link], Opening::Works, true),
    ] {
        let bench = Bench::new();
        let setup = Setup::new(crate::spec(), &Recipe::default().elf(), None).unwrap();
        let error = setup.connect(bench.lister_of(probes, opening), patience()).err().unwrap();
        assert_eq!(error.is_invalid_input(), is_invalid, "{error}");
    }
    let bench = Bench::new();
    bench.chip().idcode = 0x2001_6419;
    let setup = Setup::new(crate::spec(), &Recipe::default().elf(), None).unwrap();
    let error = setup.connect(bench.lister(), patience()).err().unwrap();
    assert!(
        matches!(&error, ConnectError::Probe(ProbeError::WrongChip { .. })) && !error.is_invalid_input(),
        "{error}"
    );
    // A part with less flash than the image wants.
    let recipe = Recipe { address: 0x0810_0000, ..Recipe::default() };
    let setup = Setup::new(crate::spec(), &recipe.elf(), None).unwrap();
    let error = setup.connect(Bench::new().lister(), patience()).err().unwrap();
    assert!(
        matches!(&error, ConnectError::Probe(ProbeError::NotInFlash { .. })) && error.is_invalid_input(),
        "{error}"
    );
}
