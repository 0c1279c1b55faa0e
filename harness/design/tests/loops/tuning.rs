//! Compares tunings with known values, also at the limits of feasibility.

use crate::{assert_close, scaled};
use platebench_design::loops::Discretisation;
use platebench_design::tuning::design::{GainDesign, TuningTarget};
use platebench_design::tuning::{
    DesignEvaluation, InfeasibilityCause, PlateSpread, TuningResult, document, evaluate_design, evaluate_sensitivity,
    tune,
};
use platebench_document::Style;
use platebench_plate::{Model, Plate};
use platebench_test_kit::paper_plate;
use rstest::rstest;

const SPREAD: PlateSpread = PlateSpread { gain_percent: 5.0, time_constant_percent: 6.0, samples: 0, seed: 1 };

fn demand(plate: &Plate) -> TuningTarget<'_> {
    TuningTarget {
        plate,
        force_n: 0.0,
        setpoint: 2.0,
        response: 2e-3,
        period_us: 1_000,
        delay: 0.0,
        phase_margin_deg: 45.0,
    }
}

fn plate_with_limit(limit: f64) -> Plate {
    Plate { drive_limit_vpp: limit, ..paper_plate() }
}

fn tune_matched(demand: &TuningTarget<'_>) -> TuningResult {
    tune(demand, Discretisation::Matched, &SPREAD).unwrap()
}

fn evaluate_printed(demand: &TuningTarget<'_>, discretisation: Discretisation) -> DesignEvaluation {
    evaluate_design(demand, GainDesign::new(demand, discretisation, demand.response)).unwrap()
}

#[rstest]
// Columns: delay, settling time (ms), overshoot (%), peak (Vpp), radius, delay margin (ms).
#[case(Discretisation::Forward, 0.0, Some(2.834), 16.3, 808.0, 0.257, 0.830)]
#[case(Discretisation::Backward, 0.0, Some(19.05), 78.2, 1237.8, 0.862, 0.634)]
#[case(Discretisation::Matched, 0.0, Some(1.998), 0.0, 539.6, 0.5875, 1.668)]
#[case(Discretisation::Forward, 1.0, None, f64::NAN, f64::NAN, 1.117, -0.170)]
#[case(Discretisation::Backward, 1.0, None, f64::NAN, f64::NAN, 1.325, -0.366)]
#[case(Discretisation::Matched, 1.0, Some(23.79), 72.7, 762.2, 0.8814, 0.668)]
fn equation_24_at_1_khz_in_three_readings(
    #[case] discretisation: Discretisation,
    #[case] delay_ms: f64,
    #[case] settling: Option<f64>,
    #[case] overshoot: f64,
    #[case] peak: f64,
    #[case] radius: f64,
    #[case] left: f64,
) {
    let plate = paper_plate();
    let found = evaluate_printed(&TuningTarget { delay: delay_ms * 1e-3, ..demand(&plate) }, discretisation);
    assert_eq!(found.linear.settling_ms.is_some(), settling.is_some());
    if let (Some(found_ms), Some(settling)) = (found.linear.settling_ms, settling) {
        assert_close(found_ms, settling, 0.01);
        assert_close(found.linear.overshoot_percent, overshoot, 0.1);
        assert_close(found.linear.peak_drive_vpp, peak, 0.1);
    }
    // Forward, without delay: z² − 0.424z + 0.043 = 0. The other component's pole is excluded.
    assert_close(found.amplitude.spectral_radius, radius, 1e-3);
    for loop_figures in [&found.amplitude, &found.frequency] {
        assert_close(loop_figures.margins.delay_ms.unwrap(), left, 1e-3);
    }
    assert_close(found.amplitude.spectral_radius, found.frequency.spectral_radius, 1e-9);
}

#[test]
fn ripple_moves_a_marginal_band_crossing() {
    let plate = paper_plate();
    let demand = demand(&plate);
    let of = |response| evaluate_design(&demand, GainDesign::new(&demand, Discretisation::Matched, response)).unwrap();
    // For 2.0 ms an error of 4.98 % remains after 2 periods, so ripple crosses the 5 % band.
    let (two, shorter) = (of(2e-3), of(1.9e-3));
    assert!(two.linear.settling_ms.unwrap() < 2.0 && two.plate.settling_ms.unwrap() > 2.01);
    assert_close(shorter.plate.settling_ms.unwrap(), 1.956, 1e-3);
    let chosen = tune_matched(&demand).chosen.unwrap();
    assert!((1.85..2.0).contains(&chosen.designed_for_ms), "{}", chosen.designed_for_ms);
    assert!(chosen.plate.settling_ms.unwrap() < 2.0);
}

#[rstest]
#[case::just_not(415.6, 2.0, Some(2.0004))]
#[case::just(416.0, 2.0, None)]
#[case::at_400_vpp_just_not(400.0, 2.14, Some(2.1449))]
#[case::at_400_vpp_just(400.0, 2.15, None)]
fn the_drive_limit_sets_a_time_floor(#[case] limit: f64, #[case] response_ms: f64, #[case] floor_ms: Option<f64>) {
    let plate = plate_with_limit(limit);
    let demand = TuningTarget { response: response_ms * 1e-3, ..demand(&plate) };
    let found = tune_matched(&demand);
    let floor = found.obstacles.iter().find_map(|obstacle| match obstacle {
        InfeasibilityCause::DriveFloor { floor_ms, needed_vpp } => Some((*floor_ms, *needed_vpp)),
        _ => None,
    });
    assert_eq!(floor.is_some(), floor_ms.is_some(), "{:?}", found.obstacles);
    if let (Some((found_ms, needed)), Some(expected)) = (floor, floor_ms) {
        assert_close(found_ms, expected, 1e-3);
        assert!(!found.met);
        let enough = plate_with_limit(needed);
        assert_close(TuningTarget { plate: &enough, ..demand }.time_floor().unwrap(), demand.response, 1e-9);
        let possible = found.possible.unwrap().plate.settling_ms.unwrap();
        assert!((expected..1.1 * expected).contains(&possible), "{possible}");
    }
}

#[test]
fn two_milliseconds_need_416_vpp() {
    for (limit, met) in [(400.0, false), (415.0, false), (416.0, true)] {
        let plate = plate_with_limit(limit);
        let found = tune_matched(&demand(&plate));
        assert_eq!(found.met, met, "{limit}: {:?}", found.obstacles);
        let design = found.chosen.or(found.possible).unwrap();
        assert_eq!(design.plate.peak_drive_vpp, limit);
        assert!(design.saturated_periods > 0 && design.linear.peak_drive_vpp > limit);
    }
}

#[test]
fn a_setpoint_beyond_the_drive_limit_is_out_of_reach() {
    let plate = paper_plate();
    let holds = plate.drive_limit_vpp * plate.gain;
    for (setpoint, reached) in [(0.999 * holds, true), (1.001 * holds, false)] {
        let found = tune_matched(&TuningTarget { setpoint, response: 20e-3, ..demand(&plate) });
        let out = found.obstacles.iter().any(|obstacle| matches!(obstacle, InfeasibilityCause::OutOfReach { .. }));
        assert_eq!((found.met, out), (reached, !reached), "{setpoint}: {:?}", found.obstacles);
    }
}

#[rstest]
#[case::just_stable(1.66, None)]
#[case::just_not(1.675, Some(1.667))]
fn a_delay_beyond_the_boundary_is_a_cause(#[case] delay_ms: f64, #[case] boundary: Option<f64>) {
    let plate = paper_plate();
    let demand = TuningTarget { delay: delay_ms * 1e-3, ..demand(&plate) };
    let found = tune_matched(&demand);
    assert!(!found.met);
    let reported = found.obstacles.iter().find_map(|obstacle| match obstacle {
        InfeasibilityCause::Delay { boundary_ms } => Some(*boundary_ms),
        _ => None,
    });
    assert_eq!(reported.is_some(), boundary.is_some(), "{:?}", found.obstacles);
    if let (Some(reported), Some(boundary)) = (reported, boundary) {
        assert_close(reported, boundary, 2e-3);
    }
    assert!(found.possible.unwrap().spectral_radius < 1.0);
}

#[rstest]
#[case::just(0.94, true)]
#[case::just_not(0.93, false)]
fn no_response_is_faster_than_the_first_feedback(#[case] response_ms: f64, #[case] met: bool) {
    let plate = paper_plate();
    let found = tune_matched(&TuningTarget { response: response_ms * 1e-3, ..demand(&plate) });
    assert_eq!(found.met, met, "{:?}", found.obstacles);
    let reported = found.obstacles.iter().any(|obstacle| matches!(obstacle, InfeasibilityCause::Period { .. }));
    assert_eq!(reported, !met);
}

#[rstest]
#[case::just(66.0, true)]
#[case::just_not(67.5, false)]
fn a_phase_margin_is_met_or_is_a_cause(#[case] phase_margin_deg: f64, #[case] met: bool) {
    let plate = paper_plate();
    let found = tune_matched(&TuningTarget { phase_margin_deg, ..demand(&plate) });
    assert_eq!(found.met, met, "{:?}", found.obstacles);
    let design = found.chosen.or(found.possible).unwrap();
    assert!(design.amplitude.margins.phase_deg.unwrap() >= phase_margin_deg - 0.1);
    if !met {
        let [InfeasibilityCause::PhaseMargin { found_deg }] = found.obstacles[..] else {
            panic!("{:?}", found.obstacles)
        };
        assert!((66.0..67.5).contains(&found_deg), "{found_deg}");
        assert!(design.plate.settling_ms.unwrap() > 2.0);
    }
}

#[rstest]
fn margins_end_at_the_last_settling_response(
    #[values(Discretisation::Forward, Discretisation::Matched)] discretisation: Discretisation,
    #[values(0.0, 0.3)] delay_ms: f64,
) {
    // Without a drive limit, a response that does not settle is unstable.
    let plate = plate_with_limit(1e9);
    let demand = TuningTarget { delay: delay_ms * 1e-3, response: 4e-3, ..demand(&plate) };
    let found = evaluate_printed(&demand, discretisation);
    let gain = found.amplitude.margins.gain.unwrap();
    let delay = found.amplitude.margins.delay_ms.unwrap() * 1e-3;
    // Near the boundary the motion decays or grows slowly, so this target has a long horizon.
    let long = TuningTarget { response: 400e-3, ..demand };
    for (share, settles) in [(0.97, true), (1.03, false)] {
        let mut louder = found.design;
        louder.amplitude = scaled(louder.amplitude, gain * share);
        // Uses the linear loop, because the plate's drive would saturate at 0 Vpp if the gain is
        // too high.
        let closed = louder.closed_loop(&long, &plate, Model::Envelope, [true, false]).unwrap();
        let settled = closed.step_response(2.0, long.horizon()).settling;
        assert_eq!(settled.is_some(), settles, "{share} of the gain margin {gain}");
        let later = TuningTarget { delay: demand.delay + share * delay, ..long };
        let settled = found.design.simulate_step(&later, &plate).settling;
        assert_eq!(settled.is_some(), settles, "{share} of the delay margin {delay}");
    }
}

#[test]
fn worst_case_is_the_worst_and_repeats_with_its_seed() {
    let plate = paper_plate();
    let demand = demand(&plate);
    let design = GainDesign::new(&demand, Discretisation::Matched, 1.9e-3);
    let of = |seed| evaluate_sensitivity(&demand, &design, &PlateSpread { samples: 12, seed, ..SPREAD }).unwrap();
    let found = of(1);
    assert_eq!(found, of(1));
    assert_ne!(found.worst_sample, of(2).worst_sample);
    assert_eq!(found.corners.len(), 8);
    let settling = |other: &platebench_design::tuning::PlateVariant| other.plate.settling_ms.unwrap();
    let longest = found.corners.iter().map(settling).fold(0.0, f64::max);
    assert_eq!(found.worst_corner.settling_ms, Some(longest));
    let slowest = found.corners.iter().max_by(|a, b| settling(a).total_cmp(&settling(b))).unwrap();
    // With less gain and a pole faster than the controller's zero, |W| rises slowly at the end.
    assert_eq!((slowest.gain_percent, slowest.time_constant_percent), (-5.0, -6.0));
    let there = Plate { gain: 0.95 * plate.gain, sigma0: plate.sigma0 / 0.94, ..plate.clone() };
    assert_eq!(design.simulate_step(&demand, &there).settling.map(|seconds| seconds * 1e3), slowest.plate.settling_ms);
    let in_time = found.corners.iter().filter(|other| settling(other) <= 2.0).count();
    assert_eq!(found.worst_corner.meeting, in_time);
    assert!(0 < in_time && in_time < 8);
    assert!(found.worst_sample.unwrap().settling_ms.unwrap() <= longest);
    let other_finger = found.other_finger.as_ref().unwrap();
    assert_eq!(other_finger.force_n, 2.0);
    assert!((9.1..9.5).contains(&settling(other_finger)));
    let none = evaluate_sensitivity(
        &demand,
        &design,
        &PlateSpread { gain_percent: 0.0, time_constant_percent: 0.0, ..SPREAD },
    );
    let nominal = design.simulate_step(&demand, &plate).settling.map(|seconds| seconds * 1e3);
    assert_eq!(none.unwrap().worst_corner.settling_ms, nominal);
}

#[test]
fn a_design_for_a_finger_is_as_fast_under_it() {
    let plate = paper_plate();
    let found = tune_matched(&TuningTarget { force_n: 2.0, ..demand(&plate) });
    assert!(found.met);
    assert!(found.chosen.unwrap().plate.settling_ms.unwrap() <= 2.0);
    assert_eq!(found.sensitivity.unwrap().other_finger.unwrap().force_n, 0.0);
}

#[test]
fn backward_gains_convert_to_the_firmware_s_forward_integral() {
    let plate = paper_plate();
    let demand = demand(&plate);
    let [forward, backward] = [Discretisation::Forward, Discretisation::Backward].map(|discretisation| {
        GainDesign::new(&demand, discretisation, demand.response).firmware_gains(demand.period())
    });
    let per_period = forward.amplitude_ki * 1e-3;
    assert!((backward.amplitude_kp - forward.amplitude_kp - per_period).abs() < 1e-3);
    assert_eq!(backward.amplitude_ki, forward.amplitude_ki);
}

#[test]
fn the_horizon_includes_a_long_loop_delay() {
    let plate = paper_plate();
    let demand = TuningTarget { delay: 0.52e-3, response: 4e-3, ..demand(&plate) };
    // For one of these random plates, the eigenvalue solver does not converge at the first attempt.
    let found = tune(&demand, Discretisation::Matched, &PlateSpread { samples: 64, ..SPREAD }).unwrap();
    let chosen = found.chosen.unwrap();
    assert!(chosen.plate.settling_ms.unwrap() <= 4.0 && chosen.plate.overshoot_percent <= 4.0);
}

#[test]
fn the_text_names_the_infeasibility_causes() {
    let plate = plate_with_limit(400.0);
    let demand = demand(&plate);
    let text = document(&demand, &SPREAD, &tune_matched(&demand)).to_console(None, Style::default());
    for words in ["cannot be met", "2.145 ms", "415.7 Vpp", "Fastest possible design", "zero-order-hold match"] {
        assert!(text.contains(words), "{words} is not in\n{text}");
    }
}
