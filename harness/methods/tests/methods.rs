//! The methods keep what their books promise: order, stability, tolerance.

#![allow(clippy::unwrap_used, reason = "a helper that cannot set up its case has failed the case")]

use platebench_methods::problem::Situation;
use platebench_methods::stability::{self, LimitRow};
use platebench_methods::sweep::best_peer;
use platebench_methods::{
    Adaptive, Contender, Course, Effort, Fixed, Frame, Limit, Method, Outcome, Passage, Status, sweep,
};
use platebench_plate::file::RawPlate;
use platebench_plate::{Complex64, Conditions, Drive, Plate, Profile, Scene, Tier, Time};
use rstest::rstest;
use std::time::Duration;

fn plate() -> Plate {
    let text = include_str!("../../../scenarios/plates/aluminium-198x138.toml");
    toml::from_str::<RawPlate>(text).unwrap().check().unwrap()
}

fn ms(ms: f64) -> Time {
    Time::from_ms(ms).unwrap()
}

fn constant() -> Scene {
    Scene { temperature_offset_k: Profile::constant(0.0), finger_force_n: Profile::constant(0.5) }
}

/// From rest through drives that change every period, one of them in the middle of one.
fn passage(scene: &Scene, periods: u32) -> Passage {
    let plate = plate();
    let drive = |vpp: f64, detuning: f64| Drive { vpp, omega: plate.omega0 + detuning };
    let drives = [(ms(0.0), drive(500.0, -545.0)), (ms(1.0), drive(200.0, -200.0)), (ms(2.4), drive(290.0, 30.0))];
    let course = Course {
        plate: &plate,
        scene,
        drives: &drives,
        period: ms(1.0),
        end: ms(f64::from(periods)),
        setpoint_um: 2.0,
    };
    Passage::new(&course)
}

fn played(passage: &Passage, frame: Frame, method: Method, setting: f64) -> Outcome {
    let mut outcome = Outcome::new();
    passage.play(frame, method, setting, &mut outcome);
    outcome
}

fn error(passage: &Passage, frame: Frame, method: Method, setting: f64, truth: &[Complex64]) -> f64 {
    let outcome = played(passage, frame, method, setting);
    assert_eq!(outcome.failure, None);
    passage.error(&outcome.samples, truth)
}

/// The slope of log error over log step where halving is in the asymptotic range of both.
#[rstest]
#[case(Frame::Envelope, Fixed::Euler, 6)]
#[case(Frame::Envelope, Fixed::RungeKutta4, 3)]
#[case(Frame::Envelope, Fixed::Midpoint, 5)]
#[case(Frame::Modal, Fixed::RungeKutta4, 12)]
#[case(Frame::Modal, Fixed::Midpoint, 13)]
#[case(Frame::Carrier, Fixed::RungeKutta4, 12)]
#[case(Frame::Carrier, Fixed::Midpoint, 13)]
#[case(Frame::Carrier, Fixed::Verlet, 13)]
fn each_method_converges_with_its_order(#[case] frame: Frame, #[case] method: Fixed, #[case] power: i32) {
    let passage = passage(&constant(), 3);
    let truth = passage.exact(frame);
    let error = |power: i32| error(&passage, frame, Method::Fixed(method), 1e-3 * 0.5_f64.powi(power), &truth);
    let slope = (error(power) / error(power + 1)).log2();
    assert!((slope - f64::from(method.order())).abs() < 0.12, "{slope}");
}

/// Where a mode moves the order stays: the clock is where it should be in every stage.
#[rstest]
#[case(Frame::Envelope, Fixed::RungeKutta4, 3)]
#[case(Frame::Envelope, Fixed::Midpoint, 5)]
#[case(Frame::Modal, Fixed::RungeKutta4, 12)]
#[case(Frame::Carrier, Fixed::Verlet, 13)]
fn a_moving_mode_costs_no_order(#[case] frame: Frame, #[case] method: Fixed, #[case] power: i32) {
    let passage = passage(&moving(), 2);
    assert!(passage.drifts());
    let truth = played(&passage, frame, Method::Adaptive(Adaptive::Dop853), 1e-13).samples;
    let error = |power: i32| error(&passage, frame, Method::Fixed(method), 1e-3 * 0.5_f64.powi(power), &truth);
    let slope = (error(power) / error(power + 1)).log2();
    assert!((slope - f64::from(method.order())).abs() < 0.15, "{slope}");
}

/// 1 N in 5 ms: twenty times as fast as the paper's finger.
fn moving() -> Scene {
    let line = toml::from_str::<Document>("p = { linear = [[0.0, 0.0], [5.0, 1.0]] }").unwrap().p;
    Scene {
        temperature_offset_k: Profile::constant(0.0),
        finger_force_n: line.check(std::path::Path::new(".")).unwrap(),
    }
}

#[derive(serde::Deserialize)]
struct Document {
    p: platebench_plate::profile::RawProfile,
}

/// Each crate gets as far as it is asked to, within what accumulates over 65 turns per millisecond.
#[rstest]
fn crates_reach_their_tolerance(
    #[values(Frame::Envelope, Frame::Modal, Frame::Carrier)] frame: Frame,
    #[values(Adaptive::Dopri5, Adaptive::Dop853, Adaptive::DeDop853, Adaptive::DeVerner98)] method: Adaptive,
) {
    let passage = passage(&constant(), 3);
    let truth = passage.exact(frame);
    let error = |tolerance| error(&passage, frame, Method::Adaptive(method), tolerance, &truth);
    let [coarse, fine] = [1e-7, 1e-10].map(error);
    assert!(fine < 200.0 * 1e-10, "{fine:e}");
    // A tolerance that changes nothing is the trap that this crate walks around.
    assert!(fine < 0.01 * coarse || coarse < 1e-9, "{coarse:e} {fine:e}");
}

#[test]
fn a_moving_mode_is_the_same_for_the_closed_form_and_for_an_integrator() {
    let passage = passage(&moving(), 3);
    for frame in Frame::ALL {
        let tight = played(&passage, frame, Method::Adaptive(Adaptive::Dop853), 1e-13).samples;
        // What a moving mode may cost, `docs/mathematics.md`.
        let error = passage.error(&passage.exact(frame), &tight);
        assert!(error < 8.4e-7, "{frame:?} {error:e}");
    }
}

fn limits() -> Vec<LimitRow> {
    stability::limits(&plate())
}

#[test]
fn measured_limits_are_those_of_theory() {
    for row in limits() {
        match (row.measured, row.predicted) {
            (Limit::Step(_), Limit::Step(_)) => assert!(row.deviation().unwrap().abs() < 0.02, "{row:?}"),
            (measured, predicted) => assert_eq!(measured, predicted, "{row:?}"),
        }
    }
}

#[test]
fn a_motion_dies_out_just_below_a_limit_and_grows_just_above_it() {
    let rows = limits();
    let seen: Vec<_> = rows.iter().filter_map(|row| Some((row, row.decades?))).collect();
    assert_eq!(seen.len(), 8, "{seen:?}");
    for (row, [below, above]) in seen {
        assert!(below < -1.0 && above > 1.0, "{row:?}");
    }
}

#[rstest]
#[case("explicit Euler", "envelope, 545 rad/s off", 1.834e-3)]
#[case("explicit Euler", "envelope, 2 N, amplitude loop closed", 0.967e-3)]
#[case("RK4", "modal, resonant", 6.97e-6)]
#[case("Störmer-Verlet", "carrier", 9.852e-6)]
fn limits_known_by_number(#[case] method: &str, #[case] problem: &str, #[case] step: f64) {
    let rows = limits();
    let row = rows.iter().find(|row| row.method == method && row.problem == problem).unwrap();
    let Limit::Step(measured) = row.measured else { panic!("{row:?}") };
    assert!((measured / step - 1.0).abs() < 1e-3, "{measured}");
}

/// The period of the paper's controller lies between both limits under 2 N: the plate alone is stable in Euler's hands, the loop is not.
#[test]
fn a_loop_ends_before_its_plate_does() {
    let rows = limits();
    let limit = |problem: &str| match rows.iter().find(|row| row.problem == problem).unwrap().measured {
        Limit::Step(step) => step,
        other => panic!("{other:?}"),
    };
    assert!(limit("envelope, 2 N, amplitude loop closed") < 1e-3 && 1e-3 < limit("envelope, 2 N, 545 rad/s off"));
}

#[test]
fn limits_as_csv_have_a_field_for_every_column() {
    let csv = stability::to_csv(&limits());
    let fields = |line: &str| line.split('"').step_by(2).map(|outside| outside.matches(',').count()).sum::<usize>() + 1;
    assert!(csv.lines().all(|line| fields(line) == 9), "{csv}");
    assert!(csv.contains("never") && csv.contains("always"));
}

#[test]
fn what_cannot_be_done_is_said() {
    let passage = passage(&constant(), 3);
    let failed =
        |frame, method, setting| played(&passage, frame, method, setting).failure.map(|failure| failure.to_string());
    assert_eq!(failed(Frame::Modal, Method::Fixed(Fixed::RungeKutta4), 7.1e-6).as_deref(), Some("diverged"));
    assert_eq!(failed(Frame::Modal, Method::Fixed(Fixed::RungeKutta4), 6.9e-6), None);
    assert_eq!(
        failed(Frame::Envelope, Method::Fixed(Fixed::Verlet), 1e-3).as_deref(),
        Some("not a problem of its form")
    );
    // A tolerance that no double can keep ends, and says why.
    assert!(failed(Frame::Modal, Method::Adaptive(Adaptive::Dop853), 1e-30).is_some());
    let stuck = played(&passage, Frame::Modal, Method::Fixed(Fixed::RungeKutta4), 7.1e-6);
    assert!(stuck.samples.len() < 3 && passage.error(&stuck.samples, &passage.exact(Frame::Modal)).is_infinite());
}

#[test]
fn a_sweep_holds_every_problem_and_marks_what_failed() {
    let passage = passage(&constant(), 3);
    let measured = sweep(&passage, &Effort { rounds: 1, batch: Duration::ZERO, every: 4 });
    for tier in Tier::ALL {
        let exact = measured.iter().find(|row| row.contender == Contender::Exact(tier)).unwrap();
        assert!(exact.numerical_error < 1e-9 && exact.status == Status::Ok, "{exact:?}");
    }
    for row in &measured {
        assert!(row.ns_per_ms > 0.0 && row.ns_per_ms.is_finite(), "{row:?}");
        assert_eq!(row.status == Status::Ok, row.numerical_error.is_finite() && row.numerical_error < 2.0, "{row:?}");
        assert!(
            row.total_error <= row.numerical_error + row.model_error + 1e-9 || row.total_error.is_infinite(),
            "{row:?}"
        );
    }
    assert!(measured.iter().any(|row| row.status == Status::Diverged));
    let peer = best_peer(&measured, "modal", 1e-6).unwrap();
    assert!(peer.contender.is_peer() && peer.numerical_error <= 1e-6);
    assert!(best_peer(&measured, "modal", 0.0).is_none());
}

#[test]
fn a_mode_drifts_only_where_something_moves_it() {
    let mode = plate().mode(&Conditions::default());
    let still = Situation::constant(mode, Drive::default());
    assert!(
        !still.drifts()
            && Situation { sigma_rate: 1.0, ..still }.drifts()
            && Situation { omega0_rate: -1.0, ..still }.drifts()
    );
}
