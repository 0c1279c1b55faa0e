//! Compares predicted delay boundaries with boundaries of the firmware's code on the exact plate.

use platebench_design::law_loops::{
    LoopCase, LoopMotion, LoopSimulation, OperatingCondition, measure_delay_boundary, measure_delay_boundary_from_rest,
};
use platebench_design::loops::{ClosedLoop, LoopTiming, delay_boundary};
use platebench_engine::delay_boundary::DelayBoundary;
use platebench_plate::{Model, Time};
use platebench_test_kit::paper_plate;
use platebench_wire::LawId;
use rstest::rstest;

const LONGEST: f64 = 12e-3;

fn predicted_boundary(case: &LoopCase<'_>) -> DelayBoundary {
    let (plant, controller) = case.linearise(Model::Modal).unwrap();
    delay_boundary(&plant, &controller, case.period(), LONGEST).unwrap()
}

#[rstest]
fn firmware_loses_stability_at_the_predicted_boundary(
    #[values(
        LawId::DqPi,
        LawId::DqPiEuler,
        LawId::DqPiFixed,
        LawId::VoltageOnly,
        LawId::FrequencyOnly,
        LawId::BangBang,
        LawId::Pll,
        LawId::Deadbeat
    )]
    law: LawId,
    #[values(OperatingCondition::Resonant, OperatingCondition::Detuned, OperatingCondition::Finger)]
    condition: OperatingCondition,
    #[values(1_000, 400)] period_us: u32,
) {
    if law == LawId::BangBang && period_us == 400 {
        return;
    }
    let plate = paper_plate();
    let case = LoopCase { period_us, ..LoopCase::new(&plate, law, condition) };
    let boundary = predicted_boundary(&case).seconds().unwrap();
    let bench = LoopSimulation::in_steady_state(&case).unwrap();
    for (factor, stable) in [(0.98, true), (1.02, false)] {
        let motion = bench.clone().perturbed_motion(Time::from_seconds(factor * boundary).unwrap());
        assert_eq!(motion.is_stable(), stable, "{factor} of {} periods: {motion:?}", boundary / case.period());
    }
}

#[rstest]
fn motion_grows_or_decays_by_the_spectral_radius(
    #[values(LawId::DqPi, LawId::DqPiEuler, LawId::VoltageOnly, LawId::FrequencyOnly, LawId::Pll, LawId::Deadbeat)]
    law: LawId,
    #[values(0.993, 1.007)] share: f64,
) {
    let plate = paper_plate();
    let case = LoopCase::new(&plate, law, OperatingCondition::Detuned);
    let delay = share * predicted_boundary(&case).seconds().unwrap();
    let (plant, controller) = case.linearise(Model::Modal).unwrap();
    let closed = ClosedLoop::new(plant, controller, LoopTiming { period: case.period(), delay }).unwrap();
    let radius = closed.spectral_radius().unwrap();
    let motion = LoopSimulation::in_steady_state(&case).unwrap().perturbed_motion(Time::from_seconds(delay).unwrap());
    let LoopMotion::Factor(factor) = motion else { panic!("{motion:?}, predicted {radius}") };
    // Both loops have nearly the same poles, so the windows contain the sum of two motions.
    assert!((factor - radius).abs() < 0.4 * (radius - 1.0).abs(), "{factor}, predicted {radius}");
}

#[test]
fn a_law_without_feedback_has_no_boundary() {
    let plate = paper_plate();
    for condition in OperatingCondition::ALL {
        let case = LoopCase::new(&plate, LawId::OpenLoop, condition);
        assert_eq!(predicted_boundary(&case), DelayBoundary::Beyond(LONGEST));
        assert_eq!(measure_delay_boundary(&case, LONGEST), Some(DelayBoundary::Beyond(LONGEST)));
    }
}

#[test]
fn instability_without_delay_is_predicted_and_measured() {
    let plate = paper_plate();
    // The designed response time of 0.5 ms is shorter than the period of 1 ms.
    let case =
        LoopCase { response_s: Some(0.5e-3), ..LoopCase::new(&plate, LawId::DqPiEuler, OperatingCondition::Resonant) };
    assert_eq!(predicted_boundary(&case), DelayBoundary::Unstable);
    assert!(LoopSimulation::in_steady_state(&case).is_none());
}

#[test]
fn dq_pi_tolerates_less_delay_from_rest() {
    let plate = paper_plate();
    let of = |law| {
        let case = LoopCase { response_s: Some(2e-3), ..LoopCase::new(&plate, law, OperatingCondition::Resonant) };
        let around = measure_delay_boundary(&case, 4e-3).unwrap().seconds().unwrap();
        (around, measure_delay_boundary_from_rest(&case, 4e-3).seconds().unwrap())
    };
    let ((around, rest), (fixed_around, fixed_rest)) = (of(LawId::DqPi), of(LawId::DqPiFixed));
    assert!((around / fixed_around - 1.0).abs() < 1e-3, "{around} and {fixed_around}");
    assert!((rest - 1.4e-3).abs() < 2e-5 && (fixed_rest - 1.64e-3).abs() < 2e-5, "{rest} and {fixed_rest}");
}

#[test]
fn an_unreachable_setpoint_has_no_steady_state() {
    let mut plate = paper_plate();
    // `frequency-only` uses half of the drive limit, which reaches only 0.9 µm.
    plate.drive_limit_vpp = 2.0 * 0.9 / plate.gain;
    let case = LoopCase::new(&plate, LawId::FrequencyOnly, OperatingCondition::Resonant);
    assert!(case.linearise(Model::Modal).is_none());
}

#[test]
fn bang_bang_hunting_lowers_the_measured_boundary() {
    let plate = paper_plate();
    let case = LoopCase { period_us: 250, ..LoopCase::new(&plate, LawId::BangBang, OperatingCondition::Detuned) };
    let ratio = measure_delay_boundary(&case, LONGEST).unwrap().seconds().unwrap()
        / predicted_boundary(&case).seconds().unwrap();
    assert!((0.85..0.95).contains(&ratio), "{ratio}");
}
