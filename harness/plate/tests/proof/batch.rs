//! Many envelopes at once against each one alone.

use crate::reference::{HOLD, Random, SETPOINT, paper_plate};
use platebench_plate::{Complex64, Conditions, Drive, Envelopes, Flow, Mode, State, Tier};
use rstest::rstest;
use std::num::FpCategory;

/// Relative to the larger of |W| and |W∞|.
fn error(batch: Complex64, alone: Complex64, rest: Complex64) -> f64 {
    (batch - alone).norm() / alone.norm().max(rest.norm())
}

/// Largest error over 50 periods in which every plate's force, temperature, drive and frequency change at random; σT up to four times
/// the untouched plate's, |Δω|T up to `detuning`.
fn worst_error(count: usize, seconds: f64, detuning: f64) -> f64 {
    let plate = paper_plate();
    let mut random = Random::new(31);
    let mut batch = Envelopes::new(vec![plate.mode(&Conditions::default()); count]);
    let mut alone = vec![State::default(); count];
    assert_eq!(batch.len(), count);
    let mut worst = 0.0_f64;
    for _ in 0..50 {
        let mut rests = vec![Complex64::ZERO; count];
        for (number, state) in alone.iter_mut().enumerate() {
            let finger_force_n = random.between(0.0, 4.5);
            let mode = plate.mode(&Conditions { temperature_offset_k: random.between(-9.0, 9.0), finger_force_n });
            let omega = mode.omega0 + random.between(-detuning, detuning) / seconds;
            let drive = Drive { vpp: random.between(0.0, 800.0), omega };
            batch.set_mode(number, &mode);
            batch.set_drive(number, &drive);
            let flow = Flow::new(Tier::Envelope, &mode, &drive, state);
            *state = flow.after(seconds);
            rests[number] = flow.rest();
        }
        batch.advance(seconds);
        for (number, state) in alone.iter().enumerate() {
            worst = worst.max(error(batch.w(number).unwrap(), state.w, rests[number]));
        }
    }
    worst
}

/// Both sides of the polynomial's reach, and batches that end inside a block.
#[rstest]
#[case::as_controlled(1e-3, 1.0, 1e-14)]
#[case::to_the_end(1.8e-3, 3.99, 5e-13)]
#[case::beyond(1.9e-3, 40.0, 5e-13)]
#[case::a_carrier_period(3.1e-5, 0.1, 5e-13)]
#[case::far_beyond(1.0, 1e5, 1e-9)]
fn each_plate_of_a_batch_is_an_envelope(
    #[case] seconds: f64,
    #[case] detuning: f64,
    #[case] allowed: f64,
    #[values(1, 7, 64)] count: usize,
) {
    let worst = worst_error(count, seconds, detuning);
    println!("batch of {count} against envelopes, 50 periods of {seconds} s, |Δω|T to {detuning}: {worst:.1e}");
    assert!(worst <= allowed, "{worst:e}");
}

#[test]
fn at_the_edge_of_the_polynomial_both_ways_agree() {
    let plate = paper_plate();
    let mode = plate.mode(&Conditions::default());
    for (sigma, detuning) in [(4e3, 4e3), (4e3_f64.next_up(), 4e3), (4e3, 4e3_f64.next_up()), (1e-3, -4e3), (4e3, 0.0)]
    {
        // ω0 such that ω0 − ω is exactly the detuning.
        let mode = Mode { sigma, omega0: detuning, ..mode };
        let drive = Drive { vpp: HOLD, omega: 0.0 };
        let mut batch = Envelopes::new([mode]);
        batch.set_drive(0, &drive);
        batch.advance(1e-3);
        let flow = Flow::new(Tier::Envelope, &mode, &drive, &State::default());
        let off = error(batch.w(0).unwrap(), flow.after(1e-3).w, flow.rest());
        println!("σT = {}, ΔωT = {}: {off:.1e}", sigma * 1e-3, detuning * 1e-3);
        assert!(off <= 2e-13, "{off:e}");
    }
}

#[test]
fn a_batch_left_alone_comes_to_rest_and_not_to_subnormal_numbers() {
    let plate = paper_plate();
    let mut batch = Envelopes::new(vec![plate.mode(&Conditions::default()); 5]);
    let drive = Drive { vpp: HOLD, omega: plate.omega0 + 100.0 };
    (0..5).for_each(|number| batch.set_drive(number, &drive));
    (0..30).for_each(|_| batch.advance(1e-3));
    assert!(batch.w(4).unwrap().norm() > 0.9 * SETPOINT);
    (0..5).for_each(|number| batch.set_drive(number, &Drive { vpp: 0.0, ..drive }));
    for _ in 0..800 {
        batch.advance(1e-3);
        for part in batch.w(4).map(|w| [w.re, w.im]).unwrap() {
            assert_ne!(part.classify(), FpCategory::Subnormal);
        }
    }
    assert_eq!(batch.w(4), Some(Complex64::ZERO));
}

#[test]
fn a_plate_that_is_not_there_is_not_there() {
    let plate = paper_plate();
    let mode = plate.mode(&Conditions::default());
    let mut batch = Envelopes::new(vec![mode; 5]);
    batch.set_drive(5, &Drive { vpp: 900.0, omega: plate.omega0 });
    batch.set_mode(1_000, &mode);
    batch.advance(1e-3);
    assert_eq!((batch.w(4), batch.w(5)), (Some(Complex64::ZERO), None));
    assert!(Envelopes::new([]).is_empty() && !batch.is_empty());
}
