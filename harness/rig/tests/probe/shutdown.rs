//! Tests the end of a session: 0 V, a reset, a running processor, a released probe.

use crate::emulated_probe::SharedChip;
use crate::image::ImageSpec;
use crate::{attach, link};
use platebench_rig::Session;

#[test]
fn confirms_0_v_and_resets() {
    let bench = SharedChip::new();
    let mut link = link(&bench, &ImageSpec::default()).unwrap();
    let before = bench.chip().resets;
    let ending = link.shut_down();
    assert!(ending.zero_volts_confirmed);
    assert!(ending.reset.is_ok());
    assert_eq!(bench.chip().resets, before + 1);
    // Only once.
    assert!(!link.shut_down().zero_volts_confirmed);
    drop(link);
    assert_eq!(bench.chip().resets, before + 1);
}

#[test]
fn resets_a_running_chip_when_the_session_is_dropped() {
    let bench = SharedChip::new();
    let session = Session::open(link(&bench, &ImageSpec::default()).unwrap()).unwrap();
    let before = bench.chip().resets;
    drop(session);
    assert_eq!(bench.chip().resets, before + 1);
    assert!(!bench.chip().is_halted());
}

#[test]
fn attaches_to_a_board_again() {
    let bench = SharedChip::new();
    drop(attach(&bench).unwrap());
    assert_eq!(bench.chip().resets, 1);
    assert!(attach(&bench).is_ok());
}
