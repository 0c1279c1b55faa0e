//! Compares loops with values derived by hand or with other programs.

use crate::{assert_close, scaled};
use platebench_design::loops::{
    ClosedLoop, Discretisation, LinearController, LinearPlant, LoopChannel, LoopError, LoopTiming, PiGains,
    delay_boundary,
};
use platebench_engine::delay_boundary::DelayBoundary;
use platebench_plate::{Conditions, Drive, Model};
use platebench_test_kit::paper_plate;
use rstest::rstest;

const PERIOD: f64 = 1e-3;
const RESPONSE: f64 = 2e-3;

fn amplitude_loop(pi: impl Fn(f64, f64) -> PiGains) -> (LinearPlant, LinearController) {
    let plate = paper_plate();
    let mode = plate.mode(&Conditions::default());
    let drive = Drive { vpp: mode.drive_for(2.0), omega: mode.omega0 };
    let channel = LoopChannel { pi: pi(plate.gain, 1.0 / plate.sigma0), error_weights: [-1.0, 0.0] };
    let controller = LinearController { drive: Some(channel), ..LinearController::default() };
    (LinearPlant::linearised_at(Model::Envelope, &mode, &drive), controller)
}

fn forward(gain: f64, tau: f64) -> PiGains {
    Discretisation::Forward.gains(gain, tau, RESPONSE, PERIOD)
}

fn backward(gain: f64, tau: f64) -> PiGains {
    Discretisation::Backward.gains(gain, tau, RESPONSE, PERIOD)
}

fn matched(gain: f64, tau: f64) -> PiGains {
    Discretisation::Matched.gains(gain, tau, RESPONSE, PERIOD)
}

fn closed_amplitude_loop(pi: fn(f64, f64) -> PiGains, delay: f64) -> ClosedLoop {
    let (plant, controller) = amplitude_loop(pi);
    ClosedLoop::new(plant, controller, LoopTiming { period: PERIOD, delay }).unwrap()
}

#[rstest]
// By hand: z² − 1.587z + 0.587 + 0.4125 (2.82z − 1.32) and so on. The pole of Wq is 0.587.
#[case::forward(forward, 0.0, 0.587)]
#[case::forward_a_period_late(forward, PERIOD, 1.117)]
#[case::backward(backward, 0.0, 0.862)]
#[case::backward_a_period_late(backward, PERIOD, 1.325)]
// The spectral radius is the pole that the controller's zero cancels, e^(−1/1.88).
#[case::matched(matched, 0.0, 0.5875)]
// Poles of z² − z + 0.777 = 0.
#[case::matched_a_period_late(matched, PERIOD, 0.8814)]
fn spectral_radius_of_known_loops(#[case] pi: fn(f64, f64) -> PiGains, #[case] delay: f64, #[case] expected: f64) {
    assert_close(closed_amplitude_loop(pi, delay).spectral_radius().unwrap(), expected, 6e-4);
}

#[rstest]
#[case::forward(forward, 0.0, 2.834, 0.163, 808.0)]
#[case::matched(matched, 0.0, 1.998, 0.0, 539.6)]
#[case::matched_a_period_late(matched, PERIOD, 23.79, 0.727, 762.2)]
// The error −0.946 (−0.862)ⁿ is outside the 5 % band up to n = 19.
#[case::backward(backward, 0.0, 19.05, 0.782, 1237.8)]
fn step_responses_of_known_loops(
    #[case] pi: fn(f64, f64) -> PiGains,
    #[case] delay: f64,
    #[case] settling_ms: f64,
    #[case] overshoot: f64,
    #[case] peak_vpp: f64,
) {
    let response = closed_amplitude_loop(pi, delay).step_response(2.0, 200);
    assert_close(response.settling.unwrap() * 1e3, settling_ms, 0.01);
    assert_close(response.overshoot, overshoot, 1e-3);
    assert_close(response.peak_drive, peak_vpp, 0.1);
    assert!(!response.diverged);
}

#[rstest]
#[case(0.0)]
#[case(0.4)]
#[case(1.0)]
#[case(2.7)]
fn without_feedback_a_delay_shifts_the_step(#[case] delay_ms: f64) {
    let (plant, _) = amplitude_loop(matched);
    let plate = paper_plate();
    let controller = LinearController { feedforward: 1.0 / plate.gain, ..LinearController::default() };
    let timing = LoopTiming { period: PERIOD, delay: delay_ms * 1e-3 };
    let response = ClosedLoop::new(plant, controller, timing).unwrap().step_response(2.0, 50);
    assert_close(response.settling.unwrap() * 1e3, 1.88 * 20.0_f64.ln() + delay_ms, 1e-3);
    assert_close(response.peak_drive, 2.0 / plate.gain, 1e-9);
    assert!(response.overshoot < 1e-9);
}

#[test]
fn a_loop_beyond_its_boundary_never_settles() {
    for pi in [forward, backward] {
        let response = closed_amplitude_loop(pi, PERIOD).step_response(2.0, 400);
        assert!(response.diverged);
        assert_eq!(response.settling, None);
    }
}

#[rstest]
#[case::forward(forward, 0.830)]
#[case::backward(backward, 0.634)]
#[case::matched(matched, 1.668)]
fn delay_boundary_of_known_loops(#[case] pi: fn(f64, f64) -> PiGains, #[case] periods: f64) {
    let (plant, controller) = amplitude_loop(pi);
    let found = delay_boundary(&plant, &controller, PERIOD, 4.0 * PERIOD).unwrap();
    assert_close(found.seconds().unwrap() / PERIOD, periods, 1e-3);
    let short = delay_boundary(&plant, &controller, PERIOD, 0.5 * PERIOD).unwrap();
    assert_eq!(short, DelayBoundary::Beyond(0.5 * PERIOD));
}

#[test]
fn a_delay_of_whole_periods_shifts_the_response() {
    // L = (1 − p)/(z − 1) · z^(−m) gives the poles of z^(m+1) − z^m + 1 − p = 0 and the cancelled
    // one. At m = 2 a pair has the magnitude 1.07.
    let missing: f64 = 1.0 - (-3.0 * PERIOD / RESPONSE).exp();
    for whole in [1_u32, 2, 5] {
        let poles = closed_amplitude_loop(matched, f64::from(whole) * PERIOD).poles().unwrap();
        for pole in poles.iter().filter(|pole| pole.norm() > 0.6) {
            let residue = pole.powu(whole + 1) - pole.powu(whole) + missing;
            assert!(residue.norm() < 1e-9, "{whole} periods: {pole} leaves {residue}");
        }
        assert_eq!(poles.iter().any(|pole| pole.norm() > 1.0), whole > 1);
    }
}

#[test]
fn margins_end_at_the_stability_boundary() {
    for pi in [forward, backward, matched] {
        let margins = closed_amplitude_loop(pi, 0.3 * PERIOD).margins(None);
        let gain = margins.gain.unwrap();
        for (factor, stable) in [(0.999, true), (1.001, false)] {
            let (plant, controller) = amplitude_loop(|k, tau| scaled(pi(k, tau), gain * factor));
            let timing = LoopTiming { period: PERIOD, delay: 0.3 * PERIOD };
            let radius = ClosedLoop::new(plant, controller, timing).unwrap().spectral_radius().unwrap();
            assert_eq!(radius < 1.0, stable, "{factor} of {gain}: {radius}");
        }
    }
    // L = 0.777/(z − 1) is −0.388 at z = −1. |L| = 1 at 2 sin(θ/2) = 0.777, so 90° − θ/2 remain.
    let margins = closed_amplitude_loop(matched, 0.0).margins(None);
    assert_close(margins.gain.unwrap(), 2.0 / 0.7769, 1e-3);
    assert_close(margins.phase_deg.unwrap(), 90.0 - (0.7769_f64 / 2.0).asin().to_degrees(), 1e-2);
    let late = closed_amplitude_loop(forward, PERIOD).margins(None);
    assert!(late.gain.unwrap() < 1.0 && late.phase_deg.unwrap() < 0.0, "{late:?}");
}

#[rstest]
#[case(0.0, 0.0)]
#[case(-1e-3, 0.0)]
#[case(f64::NAN, 0.0)]
#[case(1e-3, -1e-9)]
#[case(1e-3, f64::INFINITY)]
fn rejects_invalid_timing(#[case] period: f64, #[case] delay: f64) {
    let (plant, controller) = amplitude_loop(matched);
    let refused = ClosedLoop::new(plant, controller, LoopTiming { period, delay });
    assert_eq!(refused.unwrap_err(), LoopError::NotFinite);
}

#[test]
fn rejects_a_gain_that_is_not_finite() {
    let (plant, controller) = amplitude_loop(|_, tau| matched(0.0, tau));
    assert!(ClosedLoop::new(plant, controller, LoopTiming { period: PERIOD, delay: 0.0 }).is_err());
}
