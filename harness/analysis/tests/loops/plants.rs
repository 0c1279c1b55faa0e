//! The plant's linear form against the exact nonlinear flow.

use crate::plate;
use platebench_analysis::plant::steady;
use platebench_analysis::{Condition, Plant};
use platebench_plate::{Complex64, Drive, Flow, State, Tier};
use rstest::rstest;

/// W after `seconds` of `drive`, from the steady state of another.
fn moved(tier: Tier, condition: Condition, from: &Drive, drive: &Drive, seconds: f64) -> Complex64 {
    let mode = plate().mode(&condition.surroundings());
    let w = steady(tier, &mode, from);
    let u = if tier == Tier::Modal { Complex64::I * from.omega * w } else { Complex64::ZERO };
    Flow::new(tier, &mode, drive, &State { w, u }).after(seconds).w - w
}

#[rstest]
fn small_motions_are_those_of_the_exact_plate(
    #[values(Tier::Envelope, Tier::Modal)] tier: Tier,
    #[values(Condition::Resonant, Condition::Detuned, Condition::Finger)] condition: Condition,
    #[values([1e-3, 0.0], [0.0, 1e-3])] change: [f64; 2],
    #[values(1e-4, 1e-3)] seconds: f64,
) {
    let from = Drive { vpp: 300.0, omega: condition.start(&plate()) };
    let drive = Drive { vpp: from.vpp + change[0], omega: from.omega + change[1] };
    let exact = moved(tier, condition, &from, &drive, seconds);
    let plant = Plant::around(tier, &plate().mode(&condition.surroundings()), &from);
    let linear: Complex64 = plant
        .poles()
        .iter()
        .map(|pole| {
            let phi = ((pole.value * seconds).exp() - 1.0) / pole.value;
            phi * (pole.by_drive * change[0] + pole.by_frequency * change[1])
        })
        .sum();
    assert!((exact - linear).norm() < 2e-6 * exact.norm() + 1e-14, "{exact} exactly, {linear} linear");
}
