use super::*;
use rstest::rstest;

fn ms(value: f64) -> Time {
    Time::from_ms(value).unwrap()
}

fn points(points: &[(f64, f64)]) -> Vec<(Time, f64)> {
    points.iter().map(|(t, value)| (ms(*t), *value)).collect()
}

fn starts_ms(profile: &Profile, from_rest: bool) -> Vec<f64> {
    change_starts(profile, from_rest).into_iter().map(Time::ms).collect()
}

#[rstest]
#[case::constant(&[(0.0, 2.0)], &[0.0], &[])]
#[case::at_rest(&[(0.0, 0.0)], &[], &[])]
#[case::step(&[(0.0, 0.0), (1.0, 2.0)], &[1.0], &[1.0])]
#[case::same_value_again(&[(0.0, 1.0), (5.0, 1.0), (9.0, 2.0)], &[0.0, 9.0], &[9.0])]
// Before its first point, a profile has the value of this point.
#[case::late_first_point(&[(5.0, 1.0), (9.0, 2.0)], &[0.0, 9.0], &[9.0])]
fn a_hold_profile_changes_where_its_value_does(
    #[case] hold: &[(f64, f64)],
    #[case] setpoint: &[f64],
    #[case] condition: &[f64],
) {
    let profile = Profile::Hold(points(hold));
    assert_eq!(starts_ms(&profile, true), setpoint);
    assert_eq!(starts_ms(&profile, false), condition);
}

#[rstest]
#[case::ramp(&[(20.0, 0.0), (120.0, 1.0)], &[20.0])]
#[case::ramp_in_two_segments(&[(20.0, 0.0), (60.0, 0.2), (120.0, 1.0)], &[20.0])]
#[case::up_rest_down(&[(0.0, 0.0), (20.0, 0.0), (30.0, 1.0), (50.0, 1.0), (60.0, 0.0)], &[20.0, 50.0])]
#[case::constant(&[(0.0, 1.0), (9.0, 1.0)], &[])]
fn a_linear_ramp_is_one_change_at_its_first_point(#[case] linear: &[(f64, f64)], #[case] expected: &[f64]) {
    assert_eq!(starts_ms(&Profile::Linear(points(linear)), false), expected);
}

#[test]
fn a_sine_is_one_change_at_the_start() {
    let sine = |amplitude| Profile::sine(1.0, amplitude, 9.0, 0.0);
    assert_eq!((starts_ms(&sine(0.5), false), starts_ms(&sine(0.0), false)), (vec![0.0], vec![]));
    assert_eq!((starts_ms(&sine(0.5), true), starts_ms(&sine(0.0), true)), (vec![0.0], vec![0.0]));
}

#[test]
fn a_window_ends_at_the_next_change_of_any_profile() {
    let setpoint = Profile::Hold(points(&[(0.0, 1.0), (30.0, 2.0)]));
    let force = Profile::Hold(points(&[(0.0, 0.0), (10.0, 1.0), (20.0, 0.0), (40.0, 1.0), (90.0, 0.0)]));
    let temperature = Profile::Linear(points(&[(0.0, 0.0), (15.0, 0.0), (18.0, 4.0)]));
    let changes = ProfileChanges::new(&setpoint, &force, &temperature, ms(60.0));
    let windows =
        |profile| changes.windows(profile).map(|window| (window.from.ms(), window.to.ms())).collect::<Vec<_>>();
    assert_eq!(windows(ChangingProfile::Force), [(10.0, 15.0), (20.0, 30.0), (40.0, 60.0)]);
    assert_eq!(windows(ChangingProfile::Setpoint), [(0.0, 10.0), (30.0, 40.0)]);
    assert_eq!(windows(ChangingProfile::Temperature), [(15.0, 20.0)]);
    let response =
        |from: Option<f64>| changes.response_window(from.map(ms)).map(|window| (window.from.ms(), window.to.ms()));
    // Only a setpoint step ends a step response; force and temperature do not.
    assert_eq!(response(None), Some((0.0, 30.0)));
    assert_eq!(response(Some(29.0)), Some((0.0, 30.0)));
    assert_eq!(response(Some(30.0)), Some((30.0, 60.0)));
}
