//! Tests the linear model, equations 13 and 19, and its error.

use crate::reference::{
    HOLDING_DRIVE_VPP, SETPOINT, conditions, constant_conditions, driven_plant, paper_plate, state_at,
};
use platebench_plate::{Complex64, Drive, Model};
use rstest::rstest;

#[rstest]
fn the_linear_model_is_the_two_transfer_functions(
    #[values(0.0, 1.5)] force: f64,
    #[values(-300.0, 0.0, 545.0)] detuning: f64,
) {
    let plate = paper_plate();
    let sigma = plate.sigma0 * plate.damping_ratio_at(force);
    let drive = Drive { vpp: HOLDING_DRIVE_VPP, omega: plate.omega0 + detuning };
    let mut plant = driven_plant(&plate, &conditions(0.0, force), Model::Linear, drive);
    for ms in [0.01, 1.0, 1.88, 5.0, 50.0] {
        let risen = -(-sigma * ms * 1e-3).exp_m1();
        let in_phase = plate.gain * plate.sigma0 / sigma * HOLDING_DRIVE_VPP * risen;
        let ratio = -detuning / sigma * risen;
        let state = state_at(&mut plant, ms);
        let expected = Complex64::new(in_phase, in_phase * ratio);
        assert!((state.w - expected).norm() < 1e-14, "{ms} ms: {} instead of {expected}", state.w);
        assert!((state.u.re - ratio).abs() < 1e-14);
    }
}

#[test]
fn the_ratio_does_not_depend_on_the_vibration() {
    let plate = paper_plate();
    let off = Drive { vpp: 0.0, omega: plate.omega0 + 200.0 };
    let mut plant = driven_plant(&plate, &constant_conditions(), Model::Linear, off);
    let state = state_at(&mut plant, 30.0);
    let settled = -200.0 / plate.sigma0;
    assert_eq!(state.w, Complex64::ZERO);
    assert!((state.u.re / settled - 1.0).abs() < 1e-6);
    plant.set_drive(Drive { vpp: HOLDING_DRIVE_VPP, ..off });
    let w = state_at(&mut plant, 31.0).w;
    assert!(w.re > 0.5 && (w.im / w.re / settled - 1.0).abs() < 1e-6, "{w}");
}

#[derive(Debug, Clone, Copy, PartialEq)]
enum StartCondition {
    Rest,
    /// The plate vibrates in the steady state, which equation 19 assumes.
    Settled,
}

/// Controls the modal plate by both loops of the paper, matched to the zero-order hold (2 ms, no
/// drive limit). The linear plate gets the same drives.
fn closed_loop_error(start: StartCondition, detuning: f64) -> f64 {
    let plate = paper_plate();
    let (plant_pole, loop_pole) = ((-1.0_f64 / 1.88).exp(), (-1.5_f64).exp());
    let normalised = (1.0 - loop_pole) / (1.0 - plant_pole);
    let settling = if start == StartCondition::Settled { 40 } else { 0 };
    let mut drive = Drive { vpp: 0.0, omega: plate.omega0 };
    let mut plants =
        [Model::Modal, Model::Linear].map(|model| driven_plant(&plate, &constant_conditions(), model, drive));
    let (mut voltage, mut frequency) = (0.0, plate.omega0);
    let mut worst = 0.0_f64;
    for period in 0..settling + 40 {
        if period == settling {
            frequency += detuning;
        }
        let w = plants[0].state().w;
        let error = SETPOINT - w.re;
        drive.vpp = normalised / plate.gain * error + voltage;
        voltage += normalised * (1.0 - plant_pole) / plate.gain * error;
        // The static gain of the plant is −τ. Near rest the ratio Wq/Wd is undefined.
        let ratio = if w.re > 0.1 { w.im / w.re * plate.sigma0 } else { 0.0 };
        drive.omega = frequency + normalised * ratio;
        frequency += normalised * (1.0 - plant_pole) * ratio;
        let [modal, linear] = plants.each_mut().map(|plant| {
            plant.set_drive(drive);
            state_at(plant, f64::from(period + 1)).w
        });
        if period >= settling {
            worst = worst.max((modal - linear).norm() / SETPOINT);
        }
    }
    worst
}

fn open_loop_error(detuning: f64) -> [f64; 2] {
    let plate = paper_plate();
    let drive = Drive { vpp: HOLDING_DRIVE_VPP, omega: plate.omega0 + detuning };
    let [modal, linear] = [Model::Modal, Model::Linear]
        .map(|model| state_at(&mut driven_plant(&plate, &constant_conditions(), model, drive), 60.0).w);
    let error = (linear - modal).norm();
    [error / SETPOINT, error / modal.norm()]
}

/// Expected errors: from rest and from a settled plate per setpoint, open loop per |W|.
#[rstest]
#[case::at_resonance(0.0, [3.44e-3, 0.0, 0.0])]
#[case::one_step_of_figure_9(77.0, [2.24e-2, 2.19e-3, 2.13e-2])]
#[case::detuned(545.0, [0.182, 0.105, 1.054])]
#[case::far(2000.0, [1.357, 4.16, 14.22])]
fn the_linear_model_has_the_documented_error(#[case] detuning: f64, #[case] expected: [f64; 3]) {
    let [from_rest, from_settled] =
        [StartCondition::Rest, StartCondition::Settled].map(|start| closed_loop_error(start, detuning));
    let [open, of_true] = open_loop_error(detuning);
    println!(
        "linear against modal, {detuning} rad/s off: closed loop {from_rest:.2e} from rest, \
         {from_settled:.2e} from settled; open loop {open:.2e}, {of_true:.2e} of |W|"
    );
    for (found, expected) in [from_rest, from_settled, of_true].into_iter().zip(expected) {
        assert!((found - expected).abs() <= 0.02 * expected + 1e-11, "{found:e} instead of {expected:e}");
    }
}
