//! Tests the end of a session: 0 V, a reset, a running processor, a released probe.

use crate::emulated_probe::SharedChip;
use crate::image::ImageSpec;
use crate::{attach, link};
use platebench_rig::Session;

#[test]
fn confirms_0_v_and_resets() {
    let chip = SharedChip::new();
    let mut link = link(&chip, &ImageSpec::default()).unwrap();
    let before = chip.lock().resets;
    let ending = link.shut_down();
    assert!(ending.zero_volts_confirmed);
    assert!(ending.reset.is_ok());
    assert_eq!(chip.lock().resets, before + 1);
    assert!(!link.shut_down().zero_volts_confirmed);
    drop(link);
    assert_eq!(chip.lock().resets, before + 1);
}

#[test]
fn resets_a_running_chip_when_the_session_is_dropped() {
    let chip = SharedChip::new();
    let session = Session::open(link(&chip, &ImageSpec::default()).unwrap()).unwrap();
    let before = chip.lock().resets;
    drop(session);
    assert_eq!(chip.lock().resets, before + 1);
    assert!(!chip.lock().is_halted());
}

#[test]
fn attaches_to_a_board_again() {
    let chip = SharedChip::new();
    drop(attach(&chip).unwrap());
    assert_eq!(chip.lock().resets, 1);
    assert!(attach(&chip).is_ok());
}
