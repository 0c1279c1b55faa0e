//! Compares the crossings of general methods with those of the plate's own search.

use crate::methods::{constant_scene, replay_from_rest, varying_scene};
use platebench_charts::integration::{
    AdaptiveMethod, EquationForm, FixedStepMethod, IntegrationMethod, MethodFailure, MethodReplay, Solver,
};
use platebench_plate::{BandMonitor, BandSignal, Complex64, Model, Time};
use rstest::rstest;

const DOP853: IntegrationMethod = IntegrationMethod::Adaptive(AdaptiveMethod::Dop853);

/// Times and W at rest, at the ends of intervals and on both sides of each crossing.
fn events(
    passage: &MethodReplay,
    solver: &Solver,
    band: &BandMonitor,
) -> Result<Vec<(Time, Complex64)>, MethodFailure> {
    let mut events = Vec::new();
    passage.find_crossings(solver, band, |time, state| events.push((time, state.w)))?;
    Ok(events)
}

fn amplitude_band(low: f64, high: f64) -> BandMonitor {
    BandMonitor { signal: BandSignal::Amplitude, low, high }
}

/// The ripple crosses an edge several times.
#[rstest]
#[case(amplitude_band(1.0, 1.1))]
#[case(amplitude_band(1.25, 1.27))]
#[case(BandMonitor { signal: BandSignal::InPhase, low: 1.2, high: 1.3 })]
#[case(BandMonitor { signal: BandSignal::Quadrature, low: 0.1, high: 0.2 })]
fn a_general_method_finds_the_crossings_of_the_plate(#[case] band: BandMonitor) {
    let passage = replay_from_rest(&constant_scene(), 4);
    let exact = events(&passage, &Solver::Exact(Model::Modal), &band).unwrap();
    // Rest, five ends of intervals and at least one crossing with both sides.
    assert!(exact.len() >= 8, "{exact:?}");
    let integrated = events(&passage, &Solver::General(EquationForm::Modal, DOP853, 1e-12), &band).unwrap();
    assert_eq!(integrated.len(), exact.len(), "{integrated:?} {exact:?}");
    for ((time, w), (exact_time, exact_w)) in integrated.iter().zip(&exact) {
        let distance_ns = time.as_nanos().abs_diff(exact_time.as_nanos());
        assert!(distance_ns <= 1 && (w - exact_w).norm() < 1e-5, "{time} {exact_time} {w} {exact_w}");
    }
    for sides in integrated.windows(2).filter(|sides| (sides[1].0 - sides[0].0).as_nanos() == 1) {
        let value = |w: Complex64| band.signal.value(&platebench_plate::State { w, u: Complex64::ZERO });
        let is_inside = |side: (Time, Complex64)| (band.low..=band.high).contains(&value(side.1));
        assert_ne!(is_inside(sides[0]), is_inside(sides[1]), "{sides:?}");
    }
}

#[test]
fn crossings_need_modal_equations_and_a_constant_mode() {
    let band = amplitude_band(1.0, 1.1);
    let unsupported = Err(MethodFailure::UnsupportedProblem);
    let (constant, varying) = (replay_from_rest(&constant_scene(), 2), replay_from_rest(&varying_scene(), 2));
    assert_eq!(events(&varying, &Solver::General(EquationForm::Modal, DOP853, 1e-6), &band), unsupported);
    for form in [EquationForm::Envelope, EquationForm::Carrier] {
        assert_eq!(events(&constant, &Solver::General(form, DOP853, 1e-6), &band), unsupported);
    }
    let unstable = IntegrationMethod::Fixed(FixedStepMethod::RungeKutta4);
    assert_eq!(
        events(&constant, &Solver::General(EquationForm::Modal, unstable, 1e-4), &band),
        Err(MethodFailure::Diverged)
    );
}
