//! Tests extreme values: decay to zero, large detuning, small damping.

use crate::reference::{HOLDING_DRIVE_VPP, constant_conditions, driven_plant, holding_plant, paper_plate, state_at};
use platebench_plate::{Complex64, Conditions, Drive, Flow, Mode, Model, Plant, Plate, State};
use rstest::rstest;
use std::num::FpCategory;

fn components(state: &State) -> [f64; 4] {
    [state.w.re, state.w.im, state.u.re, state.u.im]
}

fn assert_normal(plant: &Plant) {
    for component in components(&plant.state()) {
        assert_ne!(component.classify(), FpCategory::Subnormal, "{component:e} at {}", plant.time());
    }
}

#[rstest]
fn without_drive_the_plate_reaches_exactly_zero(
    #[values(Model::Linear, Model::Envelope, Model::Modal)] model: Model,
    #[values(0.05, 1.0, 30.0)] interval_ms: f64,
) {
    let plate = paper_plate();
    let mut plant = holding_plant(&plate, model, 100.0);
    state_at(&mut plant, 30.0);
    plant.set_drive(Drive { vpp: 0.0, omega: plate.omega0 + 100.0 });
    let mut at_rest_from = None;
    for step in 1..=(5_000.0 / interval_ms) as u32 {
        let state = state_at(&mut plant, 30.0 + f64::from(step) * interval_ms);
        assert_normal(&plant);
        // In the linear model U is the ratio Wq/Wd, which decays independently of W.
        let state = if model == Model::Linear { State { u: Complex64::ZERO, ..state } } else { state };
        if state == State::default() && at_rest_from.is_none() {
            at_rest_from = Some(plant.time());
        }
    }
    let from = at_rest_from.unwrap();
    println!("{}, intervals of {interval_ms} ms: exactly at rest from {from} on", model.name());
    // The decay from 2 µm to 1e-150 µm takes τ · 346 = 0.65 s, that of U in µm/s about 20 ms more.
    assert!((600.0..800.0).contains(&from.ms()));
    assert_eq!(plant.state().w, Complex64::ZERO);
}

#[rstest]
fn a_decaying_quadrature_does_not_become_subnormal(
    #[values(Model::Linear, Model::Envelope, Model::Modal)] model: Model,
) {
    let plate = paper_plate();
    let mut plant = holding_plant(&plate, model, 545.0);
    state_at(&mut plant, 5.0);
    plant.set_drive(Drive { vpp: HOLDING_DRIVE_VPP, omega: plate.omega0 });
    for period in 6..=5_000 {
        state_at(&mut plant, f64::from(period));
        assert_normal(&plant);
    }
    let w = plant.state().w;
    println!("{}, 5 s at resonance: Wq = {:e} µm", model.name(), w.im);
    assert!(w.im.abs() < 1e-15 && (w.re - 2.0).abs() < 1e-12, "{w}");
}

#[test]
fn is_finite_detects_every_component() {
    let finite = State { w: Complex64::new(1.0, 2.0), u: Complex64::new(3.0, 4.0) };
    assert!(finite.is_finite());
    for bad in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY] {
        for state in [
            State { w: Complex64::new(bad, 0.0), ..finite },
            State { w: Complex64::new(0.0, bad), ..finite },
            State { u: Complex64::new(bad, 0.0), ..finite },
            State { u: Complex64::new(0.0, bad), ..finite },
        ] {
            assert!(!state.is_finite(), "{state:?}");
        }
    }
}

#[rstest]
fn no_excitation_frequency_makes_the_plate_diverge(
    #[values(Model::Linear, Model::Envelope, Model::Modal, Model::Carrier)] model: Model,
    #[values(0.0, 1.0, 1e5, 4e5, 1e9, 1e12)] omega: f64,
    #[values(None, Some(1e6))] quality: Option<f64>,
) {
    let plate = paper_plate();
    let sigma0 = quality.map_or(plate.sigma0, |quality| plate.omega0 / (2.0 * quality));
    let plate = Plate { sigma0, gain: plate.gain * plate.sigma0 / sigma0, ..plate };
    let mut plant = driven_plant(&plate, &constant_conditions(), model, Drive { vpp: 900.0, omega: plate.omega0 });
    let before = state_at(&mut plant, 10.0).amplitude();
    let mut largest = 0.0_f64;
    for period in 11..=60 {
        plant.set_drive(Drive { vpp: if period % 2 == 0 { 900.0 } else { 0.0 }, omega });
        let state = state_at(&mut plant, f64::from(period));
        assert!(state.is_finite());
        largest = largest.max(state.amplitude());
    }
    if model == Model::Linear {
        // The linear model has no resonance curve: Wd is that at resonance, and Wq = −τΔω Wd.
        let furthest = (omega - plate.omega0).abs() / plate.sigma0;
        assert!(largest <= plate.gain * 900.0 * (1.0 + furthest), "{largest} µm");
        return;
    }
    // Far from resonance a drive step gives at most twice the static (N/m) V/ω0² = 0.03 µm.
    assert!(largest <= before + 1.0, "{largest} µm after {before} µm");
}

#[test]
fn at_quality_1e6_the_amplitude_follows_the_closed_form() {
    let plate = paper_plate();
    let sigma0 = plate.omega0 / 2e6;
    let plate = Plate { sigma0, gain: plate.gain * plate.sigma0 / sigma0, ..plate };
    let mut plant =
        driven_plant(&plate, &constant_conditions(), Model::Modal, Drive { vpp: 10.0, omega: plate.omega0 });
    for seconds in [1.0, 10.0, 100.0] {
        let w = state_at(&mut plant, 1e3 * seconds).w;
        let expected = plate.gain * 10.0 * -(-sigma0 * seconds).exp_m1();
        println!("quality 1e6, {seconds} s: {:.1e} off", (w.re / expected - 1.0).abs());
        // The limit allows for the fast pole, which contributes σ/2ω0 of the steady state.
        assert!((w.re / expected - 1.0).abs() < 1e-5 && w.im.abs() < 1e-5 * expected, "{w} instead of {expected}");
    }
}

#[test]
fn is_resonant_rejects_other_modes() {
    let plate = paper_plate();
    let mode = plate.mode(&Conditions::default());
    assert!(mode.is_resonant());
    for overdamped in [
        Mode { sigma: mode.omega0, ..mode },
        Mode { sigma: 0.0, ..mode },
        Mode { sigma: -1.0, ..mode },
        Mode { omega0: -mode.omega0, ..mode },
        Mode { sigma: f64::NAN, ..mode },
    ] {
        assert!(!overdamped.is_resonant(), "{overdamped:?}");
    }
    let almost = Mode { sigma: mode.omega0 * 0.999, ..mode };
    assert!(almost.is_resonant());
    let flow = Flow::new(Model::Modal, &almost, &Drive { vpp: 400.0, omega: mode.omega0 }, &State::default());
    assert!(flow.after(1e-5).is_finite());
}
