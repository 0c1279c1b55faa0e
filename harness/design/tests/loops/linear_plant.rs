//! Compares the plant's linear form with the exact nonlinear flow.

use platebench_design::law_loops::OperatingCondition;
use platebench_design::loops::{LinearPlant, steady_state};
use platebench_plate::{Complex64, Drive, Flow, Model, State};
use platebench_test_kit::paper_plate;
use rstest::rstest;

fn propagated(model: Model, condition: OperatingCondition, from: &Drive, drive: &Drive, seconds: f64) -> Complex64 {
    let mode = paper_plate().mode(&condition.conditions());
    let w = steady_state(model, &mode, from);
    let u = if model == Model::Modal { Complex64::I * from.omega * w } else { Complex64::ZERO };
    Flow::new(model, &mode, drive, &State { w, u }).after(seconds).w - w
}

#[rstest]
fn linear_plant_matches_the_exact_plate_for_small_motions(
    #[values(Model::Envelope, Model::Modal)] model: Model,
    #[values(OperatingCondition::Resonant, OperatingCondition::Detuned, OperatingCondition::Finger)]
    condition: OperatingCondition,
    #[values([1e-3, 0.0], [0.0, 1e-3])] change: [f64; 2],
    #[values(1e-4, 1e-3)] seconds: f64,
) {
    let from = Drive { vpp: 300.0, omega: condition.start_omega(&paper_plate()) };
    let drive = Drive { vpp: from.vpp + change[0], omega: from.omega + change[1] };
    let exact = propagated(model, condition, &from, &drive, seconds);
    let plant = LinearPlant::linearised_at(model, &paper_plate().mode(&condition.conditions()), &from);
    let linear: Complex64 = plant
        .poles()
        .iter()
        .map(|pole| {
            let phi = ((pole.value * seconds).exp() - 1.0) / pole.value;
            phi * (pole.drive_gain * change[0] + pole.frequency_gain * change[1])
        })
        .sum();
    assert!((exact - linear).norm() < 2e-6 * exact.norm() + 1e-14, "{exact} exactly, {linear} linear");
}
