use super::*;
use proptest::prelude::*;
use rstest::rstest;

#[derive(Deserialize)]
struct Document {
    p: RawProfile,
}

fn read(text: &str) -> Result<Profile, ProfileError> {
    toml::from_str::<Document>(&format!("p = {text}")).unwrap().p.check(&[], ms(100.0))
}

fn ms(value: f64) -> Time {
    Time::from_ms(value).unwrap()
}

#[test]
fn a_hold_profile_jumps_at_its_points() {
    let profile = read("{ hold = [[1.0, 0.0], [2.0, 5.0]] }").unwrap();
    for (t, value) in [(0.0, 0.0), (1.999_999, 0.0), (2.0, 5.0), (99.0, 5.0)] {
        assert_eq!(profile.at(ms(t)), value, "at {t} ms");
    }
    assert_eq!(profile.next_point_after(ms(1.0)), Some(ms(2.0)));
    assert_eq!(profile.next_point_after(ms(2.0)), None);
    assert_eq!(profile.max_slope_after(ms(0.0)), 0.0);
}

#[test]
fn a_linear_profile_is_constant_outside_its_points() {
    let profile = read("{ linear = [[20.0, 0.0], [120.0, 1.0]] }").unwrap();
    for (t, value) in [(0.0, 0.0), (20.0, 0.0), (70.0, 0.5), (120.0, 1.0), (130.0, 1.0)] {
        assert_eq!(profile.at(ms(t)), value, "at {t} ms");
    }
    for (t, slope) in [(0.0, 0.0), (20.0, 10.0), (119.0, 10.0), (120.0, 0.0)] {
        assert!((profile.max_slope_after(ms(t)) - slope).abs() < 1e-9, "at {t} ms");
    }
}

#[test]
fn a_sine_starts_at_its_phase() {
    let profile = read("{ sine = { mean = 1.0, amplitude = 0.5, frequency_hz = 2.0, phase_deg = 90.0 } }").unwrap();
    assert!((profile.at(Time::ZERO) - 1.5).abs() < 1e-15);
    assert!((profile.at(ms(250.0)) - 0.5).abs() < 1e-12);
    assert_eq!(profile.range(), (0.5, 1.5));
    let slope = 0.5 * TAU * 2.0;
    assert!((profile.max_slope_after(Time::ZERO) - slope).abs() < 1e-12);
    assert_eq!(profile.bandwidth(), TAU * 2.0);
}

#[test]
fn a_square_wave_is_a_hold_profile() {
    let profile = read("{ square = { low = 0.5, high = 2.0, period_ms = 40.0, duty_percent = 25.0, from_ms = 5.0 } }");
    let expected =
        [(0.0, 0.5), (5.0, 2.0), (15.0, 0.5), (45.0, 2.0), (55.0, 0.5), (85.0, 2.0), (95.0, 0.5), (125.0, 2.0)];
    assert_eq!(profile.unwrap(), Profile::Hold(expected.map(|(t, value)| (ms(t), value)).to_vec()));
    let profile = read("{ square = { low = 0.0, high = 1.0, period_ms = 60.0 } }").unwrap();
    let expected = [(0.0, 1.0), (30.0, 0.0), (60.0, 1.0), (90.0, 0.0), (120.0, 1.0)];
    assert_eq!(profile, Profile::Hold(expected.map(|(t, value)| (ms(t), value)).to_vec()));
}

#[test]
fn a_pattern_repeats_without_rounding() {
    let profile = read("{ repeat = { period_ms = 0.3, from_ms = 20.0, hold = [[0.1, 1.0], [0.2, 3.0]] } }").unwrap();
    let Profile::Hold(points) = profile else { panic!() };
    assert_eq!(points[0], (Time::ZERO, 3.0));
    assert_eq!(points[1..3], [(ms(20.1), 1.0), (ms(20.2), 3.0)]);
    // The 200th period starts at 20 ms + 200 × 300 µs.
    assert_eq!(points[401], (Time::from_nanos(80_100_000), 1.0));
    let profile = read("{ repeat = { period_ms = 14.0, from_ms = 20.0, count = 2, hold = [[0.0, 1.0], [7.0, 0.0]] } }");
    let expected = [(0.0, 0.0), (20.0, 1.0), (27.0, 0.0), (34.0, 1.0), (41.0, 0.0)];
    assert_eq!(profile.unwrap(), Profile::Hold(expected.map(|(t, value)| (ms(t), value)).to_vec()));
}

#[test]
fn a_repeated_line_continues_to_the_next_period() {
    let profile = read("{ repeat = { period_ms = 60.0, linear = [[0.0, 1.0], [20.0, 3.0]] } }").unwrap();
    for (t, value) in [(0.0, 1.0), (10.0, 2.0), (40.0, 2.0), (60.0, 1.0), (80.0, 3.0), (100.0, 2.0)] {
        assert_eq!(profile.at(ms(t)), value, "at {t} ms");
    }
    let profile = read("{ repeat = { period_ms = 60.0, count = 1, linear = [[0.0, 1.0], [20.0, 3.0]] } }").unwrap();
    assert_eq!(profile.at(ms(60.0)), 3.0);
}

#[rstest]
#[case::rising(20.0, 80.0)]
#[case::falling(80.0, 20.0)]
fn a_chirp_changes_its_frequency_over_the_trial(#[case] from: f64, #[case] to: f64) {
    let profile = read(&format!("{{ chirp = {{ mean = 1.0, amplitude = 0.5, from_hz = {from}, to_hz = {to} }} }}"));
    let profile = profile.unwrap();
    // The mean frequency is 50 Hz, so a trial of 100 ms has five turns.
    assert!((profile.at(ms(100.0)) - 1.0).abs() < 1e-12);
    let slope = |t: f64| (profile.at(ms(t + 1e-3)) - profile.at(ms(t))) / 1e-6;
    assert!((slope(0.0) / (0.5 * TAU * from) - 1.0).abs() < 1e-3);
    assert!((slope(99.999) / (0.5 * TAU * to) - 1.0).abs() < 1e-3);
    let sweep = TAU * 60.0 / 0.1;
    assert!((profile.bandwidth().powi(2) / ((TAU * 80.0).powi(2) + 3.0 * sweep) - 1.0).abs() < 1e-12);
}

#[rstest]
#[case::rising("{ chirp = { mean = 1.0, amplitude = 0.5, from_hz = 40.0, to_hz = 900.0, phase_deg = 40.0 } }")]
#[case::falling("{ chirp = { mean = 1.0, amplitude = 0.5, from_hz = 400.0, to_hz = 9.0, phase_deg = 90.0 } }")]
#[case::sine("{ sine = { mean = 1.0, amplitude = 0.5, frequency_hz = 123.0, phase_deg = 40.0 } }")]
#[case::sine_upside_down("{ sine = { mean = 1.0, amplitude = -0.5, frequency_hz = 123.0, phase_deg = -400.0 } }")]
#[case::line("{ linear = [[0.0, 0.6], [5.0, 1.4], [9.0, 0.7], [20.0, 1.3], [30.0, 1.3]] }")]
fn finds_every_passage(#[case] text: &str, #[values(0.7001, 1.0, 1.25)] value: f64) {
    let profile = read(text).unwrap();
    let above = |nanos: u64| profile.at(Time::from_nanos(nanos)) >= value;
    let changes: Vec<u64> = (0..30_000).map(|us| 1_000 * us).filter(|ns| above(*ns) != above(ns + 1_000)).collect();
    let mut found = Vec::new();
    let mut now = Time::ZERO;
    while now < ms(30.0) {
        let point = profile.next_point_after(now).unwrap_or(ms(30.0)).min(ms(30.0));
        let passage = profile.next_crossing(value, now).filter(|passage| *passage < point);
        found.extend(passage);
        now = passage.unwrap_or(point);
    }
    assert!(changes.len() >= 3, "{changes:?}");
    assert_eq!(found.len(), changes.len(), "{found:?} {changes:?}");
    for (passage, change) in found.iter().zip(&changes) {
        let nanos = passage.as_nanos();
        assert!((*change..=change + 1_001).contains(&nanos), "{passage}: {change}");
        assert_ne!(above(nanos - 2), above(nanos + 1), "{passage}");
    }
}

#[test]
fn finds_no_passage_of_a_value_that_is_not_passed() {
    for text in [
        "{ sine = { mean = 1.0, amplitude = 0.5, frequency_hz = 2.0 } }",
        "1.5",
        "{ linear = [[0.0, 0.0], [9.0, 1.5]] }",
    ] {
        assert_eq!(read(text).unwrap().next_crossing(1.6, Time::ZERO), None, "{text}");
    }
    let line = read("{ linear = [[2.0, 0.0], [12.0, 10.0], [13.0, 10.0]] }").unwrap();
    assert_eq!(line.next_crossing(1.0, Time::ZERO), None);
    assert_eq!(line.next_crossing(1.0, ms(2.0)), Some(ms(3.0)));
    assert_eq!(line.next_crossing(1.0, ms(3.0)), None);
    for value in [0.0, 10.0] {
        assert_eq!(line.next_crossing(value, ms(2.0)), None);
        assert_eq!(line.next_crossing(value, ms(12.5)), None);
    }
}

#[rstest]
#[case("{ hold = [[1.0, 0.3], [2.0, 5.0]] }")]
#[case("{ linear = [[1.0, 0.3], [2.0, 0.7], [3.0, -0.1]] }")]
#[case("{ sine = { mean = 1.0, amplitude = 0.5, frequency_hz = 123.0 } }")]
fn values_at_several_times_equal_those_at_each(#[case] text: &str, #[values(0.0, 1.0, 2.0, 3.0)] from: f64) {
    let profile = read(text).unwrap();
    let times = [from, from + 0.5, from + 0.999_999].map(ms);
    assert_eq!(profile.at_each(times), times.map(|time| profile.at(time)));
}

#[rstest]
#[case("{ hold = [] }", "no points")]
#[case("nan", "point 1: NaN is not a finite number")]
#[case("{ hold = [[0.0, 1.0], [-1.0, 2.0]] }", "point 2: time -1 ms")]
#[case("{ linear = [[0.0, 1.0], [0.0, 2.0]] }", "point 2: time 0 ms is not after the previous point")]
#[case("{ linear = [[5.0, 1.0], [4.0, 2.0]] }", "point 2: time 4 ms is not after the previous point")]
#[case("{ hold = [[inf, 1.0]] }", "point 1: time inf ms")]
#[case("{ sine = { mean = 1.0, amplitude = 0.5, frequency_hz = 0.0 } }", "frequency_hz above 0")]
#[case("{ chirp = { mean = 1.0, amplitude = 0.5, from_hz = 1.0, to_hz = 0.0 } }", "to_hz above 0")]
#[case("{ square = { low = 1.0, high = inf, period_ms = 1.0 } }", "a square wave requires finite numbers")]
#[case("{ square = { low = 0.0, high = 1.0, period_ms = 1e-6 } }", "of at least 1 ns")]
#[case("{ square = { low = 0.0, high = 1.0, period_ms = 9e-5 } }", "gives 2222224 points in the trial")]
#[case("{ repeat = { period_ms = 1.0 } }", "requires one of `hold` and `linear`")]
#[case("{ repeat = { period_ms = 1.0, hold = [[0.0, 1.0]], linear = [[0.0, 1.0]] } }", "requires one of")]
#[case("{ repeat = { period_ms = 1.0, hold = [[0.0, 1.0], [1.0, 2.0]] } }", "expected one longer than 1 ms")]
#[case("{ repeat = { period_ms = 1.0, hold = [[0.0, 1.0], [0.0, 2.0]] } }", "point 2: time 0 ms is not after")]
#[case("{ csv = \"points.csv\" }", "the profile has no points")]
fn refuses_invalid_points(#[case] text: &str, #[case] message: &str) {
    let error = read(text).unwrap_err().to_string();
    assert!(error.contains(message), "{error}");
}

#[rstest]
#[case("{ ramp = [[0.0, 1.0]] }", "unknown field `ramp`, expected one of `hold`, `linear`")]
#[case("\"2.0\"", "expected a number or one of { hold = [[t_ms, value], …] }")]
#[case("{}", "missing field: expected one of { hold = [[t_ms, value], …] }")]
#[case("{ hold = [[0.0, 1.0]], csv = \"a.csv\" }", "several shapes, expected one of { hold")]
fn lists_the_shapes_if_the_shape_is_unknown(#[case] text: &str, #[case] message: &str) {
    let error = toml::from_str::<Document>(&format!("p = {text}")).err().unwrap().to_string();
    assert!(error.contains(message), "{error}");
}

proptest! {
    #[test]
    fn a_line_stays_within_its_range(
        steps in proptest::collection::vec((1_u32..1_000_000, -5.0..5.0), 1..20), t in 0_u64..40_000_000_000,
    ) {
        let mut at = 0.0;
        let points: Vec<_> = steps
            .iter()
            .map(|(step, value)| {
                at += f64::from(*step) / 1e3;
                [at, *value]
            })
            .collect();
        let profile = RawProfile::Shape(RawShape::Linear(points)).check(&[], ms(1.0)).unwrap();
        let (low, high) = profile.range();
        let value = profile.at(Time::from_nanos(t));
        prop_assert!(low - 1e-12 <= value && value <= high + 1e-12);
    }

    #[test]
    fn a_hold_only_changes_at_its_points(
        steps in proptest::collection::vec((1_u32..1_000, -5.0..5.0), 1..20), t in 0_u64..20_000,
    ) {
        let mut at = 0.0;
        let points: Vec<_> = steps.iter().map(|(step, value)| { at += f64::from(*step); [at, *value] }).collect();
        let profile = RawProfile::Shape(RawShape::Hold(points)).check(&[], ms(1.0)).unwrap();
        let from = Time::from_nanos(t * 1_000_000);
        if let Some(next) = profile.next_point_after(from) {
            prop_assert_eq!(profile.at(from), profile.at(Time::from_nanos(next.as_nanos() - 1)));
        }
    }
}
