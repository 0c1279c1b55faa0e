//! Compares the largest stable steps of methods with theory.

use platebench_design::step_limits::{StepLimit, StepLimitRow, limits_csv, step_limits};
use platebench_test_kit::paper_plate;
use rstest::rstest;

fn limits() -> Vec<StepLimitRow> {
    step_limits(&paper_plate())
}

#[test]
fn measured_limits_match_theory() {
    for row in limits() {
        match (row.measured, row.predicted) {
            (StepLimit::Step(_), StepLimit::Step(_)) => assert!(row.deviation().unwrap().abs() < 0.02, "{row:?}"),
            (measured, predicted) => assert_eq!(measured, predicted, "{row:?}"),
        }
    }
}

#[test]
fn motion_decays_below_the_limit_and_grows_above() {
    let rows = limits();
    let seen: Vec<_> = rows.iter().filter_map(|row| Some((row, row.growth_decades?))).collect();
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
    let StepLimit::Step(measured) = row.measured else { panic!("{row:?}") };
    assert!((measured / step - 1.0).abs() < 1e-3, "{measured}");
}

/// Under 2 N, the paper's control period of 1 ms is between the limits of loop and plate.
#[test]
fn a_closed_loop_is_unstable_before_its_plate() {
    let rows = limits();
    let limit = |problem: &str| match rows.iter().find(|row| row.problem == problem).unwrap().measured {
        StepLimit::Step(step) => step,
        other => panic!("{other:?}"),
    };
    assert!(limit("envelope, 2 N, amplitude loop closed") < 1e-3 && 1e-3 < limit("envelope, 2 N, 545 rad/s off"));
}

#[test]
fn limits_as_csv_have_a_field_for_every_column() {
    let csv = limits_csv(&limits());
    let fields = |line: &str| line.split('"').step_by(2).map(|outside| outside.matches(',').count()).sum::<usize>() + 1;
    assert!(csv.lines().all(|line| fields(line) == 9), "{csv}");
    assert!(csv.contains("never") && csv.contains("always"));
}
