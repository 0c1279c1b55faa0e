//! The end: 0 V, a reset, a processor that runs, a probe that is free again.

use crate::emulated::Bench;
use crate::image::Recipe;
use crate::{attach, link};
use platebench_rig::Session;

#[test]
fn the_end_confirms_zero_volts_and_resets() {
    let bench = Bench::new();
    let mut link = link(&bench, &Recipe::default()).unwrap();
    let before = bench.chip().resets;
    let ending = link.end();
    assert!(ending.zero_volts_confirmed);
    assert!(ending.reset.is_ok());
    assert_eq!(bench.chip().resets, before + 1);
    // Once is enough.
    assert!(!link.end().zero_volts_confirmed);
    drop(link);
    assert_eq!(bench.chip().resets, before + 1);
}

#[test]
fn whoever_drops_a_session_leaves_a_chip_that_was_reset_and_runs() {
    let bench = Bench::new();
    let session = Session::open(link(&bench, &Recipe::default()).unwrap()).unwrap();
    let before = bench.chip().resets;
    drop(session);
    assert_eq!(bench.chip().resets, before + 1);
    assert!(!bench.chip().is_halted());
}

#[test]
fn a_board_beside_a_serial_port_is_reset_too_and_can_be_attached_to_again() {
    let bench = Bench::new();
    drop(attach(&bench).unwrap());
    assert_eq!(bench.chip().resets, 1);
    assert!(attach(&bench).is_ok());
}
