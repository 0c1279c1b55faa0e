//! Predicted boundaries against those of the firmware's own code on the exact plate.

use crate::plate;
use platebench_analysis::{
    Bench, Case, ClosedLoop, Condition, DelayBoundary, Motion, Timing, delay_boundary, measured,
};
use platebench_plate::{Tier, Time};
use platebench_wire::LawId;
use rstest::rstest;

/// Longest delay that is looked at, s.
const LONGEST: f64 = 12e-3;

fn predicted(case: &Case<'_>) -> DelayBoundary {
    let (plant, controller) = case.linear(Tier::Modal).unwrap();
    delay_boundary(&plant, &controller, case.period(), LONGEST).unwrap()
}

#[rstest]
fn the_firmware_is_stable_just_below_the_predicted_boundary_and_not_just_above(
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
    #[values(Condition::Resonant, Condition::Detuned, Condition::Finger)] condition: Condition,
    #[values(1_000, 400)] period_us: u32,
) {
    if law == LawId::BangBang && period_us == 400 {
        // Below.
        return;
    }
    let plate = plate();
    let case = Case { period_us, ..Case::new(&plate, law, condition) };
    let boundary = predicted(&case).seconds().unwrap();
    let bench = Bench::in_steady_state(&case).unwrap();
    for (factor, stable) in [(0.98, true), (1.02, false)] {
        let motion = bench.clone().motion(Time::from_seconds(factor * boundary).unwrap());
        assert_eq!(motion.is_stable(), stable, "{factor} of {} periods: {motion:?}", boundary / case.period());
    }
}

#[rstest]
fn a_motion_grows_or_dies_out_by_the_spectral_radius(
    #[values(LawId::DqPi, LawId::DqPiEuler, LawId::VoltageOnly, LawId::FrequencyOnly, LawId::Pll, LawId::Deadbeat)]
    law: LawId,
    #[values(0.993, 1.007)] share: f64,
) {
    let plate = plate();
    let case = Case::new(&plate, law, Condition::Detuned);
    let delay = share * predicted(&case).seconds().unwrap();
    let (plant, controller) = case.linear(Tier::Modal).unwrap();
    let closed = ClosedLoop::new(plant, controller, Timing { period: case.period(), delay }).unwrap();
    let radius = closed.spectral_radius().unwrap();
    let motion = Bench::in_steady_state(&case).unwrap().motion(Time::from_seconds(delay).unwrap());
    let Motion::Factor(factor) = motion else { panic!("{motion:?}, predicted {radius}") };
    // What is left of 1 is what tells stable from unstable. Both loops of a pair have nearly the same poles, so the windows see their sum.
    assert!((factor - radius).abs() < 0.4 * (radius - 1.0).abs(), "{factor}, predicted {radius}");
}

#[test]
fn a_law_without_feedback_has_no_boundary() {
    let plate = plate();
    for condition in Condition::ALL {
        let case = Case::new(&plate, LawId::OpenLoop, condition);
        assert_eq!(predicted(&case), DelayBoundary::Beyond(LONGEST));
        assert_eq!(measured::boundary(&case, LONGEST), Some(DelayBoundary::Beyond(LONGEST)));
    }
}

#[test]
fn a_loop_that_is_unstable_without_delay_is_so_in_both() {
    let plate = plate();
    // The wished loop is ten times faster than its period.
    let case = Case { response_s: Some(0.5e-3), ..Case::new(&plate, LawId::DqPiEuler, Condition::Resonant) };
    assert_eq!(predicted(&case), DelayBoundary::Never);
    assert!(Bench::in_steady_state(&case).is_none());
}

#[test]
fn from_rest_dq_pi_bears_less_than_around_its_steady_state_because_a_delay_looks_like_damping() {
    let plate = plate();
    let of = |law| {
        let case = Case { response_s: Some(2e-3), ..Case::new(&plate, law, Condition::Resonant) };
        let around = measured::boundary(&case, 4e-3).unwrap().seconds().unwrap();
        (around, measured::from_rest(&case, 4e-3).seconds().unwrap())
    };
    let ((around, rest), (fixed_around, fixed_rest)) = (of(LawId::DqPi), of(LawId::DqPiFixed));
    assert!((around / fixed_around - 1.0).abs() < 1e-3, "{around} and {fixed_around}");
    assert!((rest - 1.4e-3).abs() < 2e-5 && (fixed_rest - 1.64e-3).abs() < 2e-5, "{rest} and {fixed_rest}");
}

#[test]
fn what_cannot_be_reached_has_no_steady_state() {
    let mut plate = plate();
    // Half of the drive reaches 0.9 µm.
    plate.drive_limit_vpp = 2.0 * 0.9 / plate.gain;
    let case = Case::new(&plate, LawId::FrequencyOnly, Condition::Resonant);
    assert!(case.linear(Tier::Modal).is_none());
}

#[test]
fn a_relay_that_hunts_over_several_periods_of_delay_stirs_the_amplitude_loop_a_little_early() {
    let plate = plate();
    let case = Case { period_us: 250, ..Case::new(&plate, LawId::BangBang, Condition::Detuned) };
    let ratio = measured::boundary(&case, LONGEST).unwrap().seconds().unwrap() / predicted(&case).seconds().unwrap();
    assert!((0.85..0.95).contains(&ratio), "{ratio}");
}
