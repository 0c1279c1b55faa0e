use super::*;
use rstest::rstest;

fn tube(tolerance: Tolerance, points: &[(f64, f64)]) -> Tube {
    let points = points.iter().map(|&(t_ms, value)| TubePoint { t_ms, value, width: 0.0 }).collect();
    Tube { signal: "amplitude_um".to_owned(), tolerance, points }
}

const STRICT: Tolerance = Tolerance { absolute: 0.25, relative: 0.0, time_ms: 0.0 };

#[rstest]
#[case::on_it(2.0, true)]
#[case::just_inside_above(2.25, true)]
#[case::just_inside_below(1.75, true)]
#[case::just_outside_above(2.25_f64.next_up(), false)]
#[case::just_outside_below(1.75_f64.next_down(), false)]
#[case::no_number(f64::NAN, true)]
fn the_edge_is_inside(#[case] value: f64, #[case] inside: bool) {
    let golden = tube(STRICT, &[(0.0, 2.0), (10.0, 2.0)]);
    let found = golden.worst_exceedance(&[(0.0, 2.0), (5.0, value), (10.0, 2.0)], Some(1.0));
    if value.is_nan() {
        // NaN is outside every tube.
        assert!(found.is_some());
    } else {
        assert_eq!(found.is_none(), inside, "{found:?}");
    }
}

#[test]
fn names_the_worst_exceedance() {
    let golden = tube(STRICT, &[(0.0, 2.0), (10.0, 2.0)]);
    let found =
        golden.worst_exceedance(&[(0.0, 2.0), (3.0, 2.5), (4.0, 2.0), (7.0, 1.0), (8.0, 2.0), (10.0, 2.0)], Some(0.5));
    let found = found.unwrap();
    assert_eq!((found.t_ms, found.value, found.golden, found.distance, found.allowed), (7.0, 1.0, 2.0, 0.75, 0.25));
    assert_eq!(found.ratio(), 4.0);
}

#[rstest]
#[case(100.0, 111.0, true)]
#[case(100.0, 111.0_f64.next_up(), false)]
#[case(-100.0, -111.0, true)]
#[case(-100.0, (-111.0_f64).next_down(), false)]
#[case(0.0, 1.0, true)]
#[case(0.0, 1.0_f64.next_up(), false)]
#[case(0.0, (-1.0_f64).next_down(), false)]
fn adds_absolute_and_relative_tolerance(#[case] level: f64, #[case] value: f64, #[case] inside: bool) {
    let golden = tube(Tolerance { absolute: 1.0, relative: 0.1, time_ms: 0.0 }, &[(0.0, level), (1.0, level)]);
    assert_eq!(golden.worst_exceedance(&[(0.0, value), (1.0, value)], None).is_none(), inside);
}

fn late_step(late: f64) -> Vec<(f64, f64)> {
    vec![(0.0, 0.0), (4.95 + late, 0.0), (5.0 + late, 2.0), (10.0 + late, 2.0)]
}

#[rstest]
#[case::in_time(0.0, true)]
#[case::just_inside(0.25, true)]
#[case::early_just_inside(-0.25, true)]
// The step rises by 2 µm in 0.05 ms, so a tolerance of 0.01 µm is worth 0.00025 ms.
#[case::just_outside(0.2503, false)]
#[case::early_just_outside(-0.2503, false)]
fn allows_a_step_within_the_tolerance_in_time(#[case] late: f64, #[case] inside: bool) {
    let tolerance = Tolerance { absolute: 0.01, relative: 0.0, time_ms: 0.25 };
    let golden = tube(tolerance, &late_step(0.0));
    let response: Vec<_> = late_step(late);
    let found = golden.worst_exceedance(&response, Some(0.001));
    assert_eq!(found.is_none(), inside, "{found:?}");
}

#[test]
fn a_late_step_exceeds_by_its_height() {
    let golden = tube(Tolerance { absolute: 0.01, relative: 0.0, time_ms: 0.0 }, &late_step(0.0));
    let found = golden.worst_exceedance(&late_step(0.2), Some(0.05)).unwrap();
    assert!((found.distance - 1.99).abs() < 1e-9, "{found:?}");
}

#[test]
fn finds_a_spike_between_points_on_the_grid() {
    let golden = tube(STRICT, &[(0.0, 2.0), (10.0, 2.0)]);
    let spike = [(0.0, 2.0), (4.9, 2.0), (5.0, 9.0), (5.1, 2.0), (10.0, 2.0)];
    assert!(golden.worst_exceedance(&spike, Some(0.1)).is_some());
    assert!(
        golden.worst_exceedance(&spike, None).is_none(),
        "without a grid only the points of the curve are compared"
    );
}

#[test]
fn a_learned_width_widens_the_tube() {
    let mut golden = tube(STRICT, &[(0.0, 2.0), (5.0, 2.0), (10.0, 2.0)]);
    golden.points[1].width = 0.5;
    assert!(golden.worst_exceedance(&[(0.0, 2.0), (5.0, 2.75), (10.0, 2.0)], Some(5.0)).is_none());
    assert!(golden.worst_exceedance(&[(0.0, 2.0), (5.0, 2.75_f64.next_up()), (10.0, 2.0)], Some(5.0)).is_some());
    assert!(golden.worst_exceedance(&[(0.0, 2.75), (10.0, 2.0)], Some(5.0)).is_some());
}

#[test]
fn accepts_several_points_at_one_instant() {
    let golden = tube(STRICT, &[(0.0, 0.0), (5.0, 0.0), (5.0, 2.0), (10.0, 2.0)]);
    assert!(golden.worst_exceedance(&[(0.0, 0.0), (5.0, 0.0), (5.0, 2.0), (10.0, 2.0)], Some(0.5)).is_none());
    assert_eq!(golden.point_at(5.0).value, 2.0);
    assert_eq!((golden.point_at(-1.0).value, golden.point_at(11.0).value), (0.0, 2.0));
    assert_eq!(tube(STRICT, &[]).point_at(1.0).value, 0.0);
}
