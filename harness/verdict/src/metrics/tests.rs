use super::*;
use platebench_plate::Time;
use platebench_record::NonFiniteDrive;
use platebench_scenario::{Aggregation, Limit, Window};
use rstest::rstest;
use std::collections::BTreeMap;

const EMPTY_TELEMETRY: Telemetry = Telemetry {
    timing: None,
    real_plate: None,
    loop_delay_us: None,
    rig_delay_us: None,
    instructions_mean: None,
    instructions_worst: None,
    ended: None,
    stopped: None,
    faults: BTreeMap::new(),
    not_finite: None,
    watchdog_timeout_ms: None,
    violations: Vec::new(),
};

fn ms(value: f64) -> Time {
    Time::from_ms(value).unwrap()
}

/// After the end of every trace.
const END_MS: f64 = 1e6;

fn window([from, to]: [f64; 2]) -> Window {
    Window { from: ms(from), to: ms(to) }
}

fn expectation_in(metric: Metric, windows: &[[f64; 2]]) -> Expectation {
    Expectation { windows: windows.iter().copied().map(window).collect(), ..expectation_for(metric) }
}

fn expectation_for(metric: Metric) -> Expectation {
    Expectation {
        name: metric.name().to_owned(),
        windows: vec![window(if metric.has_window() { [40.0, 60.0] } else { [0.0, END_MS] })],
        after: None,
        metric,
        limit: Limit::AtMost(2.0),
        tolerance_percent: 5.0,
        paper: None,
        requirement: None,
        confidence: 0.95,
        aggregation: Aggregation::default_for(metric),
        band_percent: 5.0,
        from: None,
        signal: "amplitude_um",
    }
}

fn expectation_with_from(metric: Metric, from_ms: f64) -> Expectation {
    expectation_in(metric, &[[from_ms, END_MS]])
}

/// Rows of (ms, setpoint, amplitude).
fn rows(points: &[(f64, f64, f64)]) -> Vec<Row> {
    let row = |&(t_ms, setpoint_um, amplitude_um)| Row {
        t_s: ms(t_ms).seconds(),
        setpoint_um,
        amplitude_um,
        ..Row::default()
    };
    points.iter().map(row).collect()
}

/// A trace at the given instants, ms.
fn trace_at(
    instants: impl IntoIterator<Item = f64>,
    setpoint: impl Fn(f64) -> f64,
    amplitude: impl Fn(f64) -> f64,
) -> Vec<Row> {
    rows(&instants.into_iter().map(|t| (t, setpoint(t), amplitude(t))).collect::<Vec<_>>())
}

fn grid(step: f64, end: f64) -> impl Iterator<Item = f64> + Clone {
    (0..=(end / step).round() as u32).map(move |index| f64::from(index) * step)
}

fn measured_value(expectation: &Expectation, rows: &[Row]) -> f64 {
    let measured = measure(expectation, rows, &EMPTY_TELEMETRY);
    measured.value().unwrap_or_else(|| panic!("{measured:?}"))
}

#[track_caller]
fn assert_close(measured: f64, expected: f64, tolerance: f64) {
    assert!((measured - expected).abs() <= tolerance, "{measured}, expected {expected}");
}

const TAU: f64 = 1.88;

fn first_order(t: f64) -> f64 {
    2.0 * (1.0 - (-t / TAU).exp())
}

#[test]
fn a_first_order_response_settles_after_tau_ln_20() {
    let exact = TAU * 20.0_f64.ln();
    // The chord error h²/8τ² · e^{-t/τ} · 2 µm over the slope there: h²/8τ.
    for step in [0.05, 0.01] {
        assert_close(
            measured_value(&expectation_for(Metric::SettlingTime), &trace_at(grid(step, 60.0), |_| 2.0, first_order)),
            exact,
            step * step / (8.0 * TAU),
        );
    }
    let irregular = (0_u32..3_000).map(|index| f64::from(index) * 0.02 + 0.009 * (f64::from(index) * 1.7).sin().abs());
    assert_close(
        measured_value(&expectation_for(Metric::SettlingTime), &trace_at(irregular, |_| 2.0, first_order)),
        exact,
        1e-4,
    );
}

#[test]
fn with_a_row_on_the_far_side_of_the_crossing_it_is_exact_to_a_nanosecond() {
    let exact = TAU * 20.0_f64.ln();
    let crossing = (exact * 1e6).ceil() / 1e6;
    let instants = grid(1.0, 5.0).chain([crossing]).chain((6..60).map(f64::from));
    assert_close(
        measured_value(&expectation_for(Metric::SettlingTime), &trace_at(instants, |_| 2.0, first_order)),
        exact,
        1e-6,
    );
}

#[test]
fn the_edges_of_the_band_are_inside_and_the_next_float_is_not() {
    let held = |level: f64| {
        measure(
            &expectation_for(Metric::SettlingTime),
            &rows(&[(0.0, 2.0, 0.0), (1.0, 2.0, level), (2.0, 2.0, level)]),
            &EMPTY_TELEMETRY,
        )
    };
    let (low, high) = expectation_for(Metric::SettlingTime).band(2.0);
    assert_eq!(held(low), Measure::Value(1.0));
    assert_eq!(held(high).value().map(|t| t < 1.0), Some(true));
    assert!(matches!(held(low.next_down()), Measure::Missing(_)));
    assert!(matches!(held(high.next_up()), Measure::Missing(_)));
}

#[rstest]
#[case::re_exit_below(&[(0.0, 2.0, 0.0), (1.0, 2.0, 2.0), (2.0, 2.0, 1.8), (3.0, 2.0, 2.0), (4.0, 2.0, 2.0)], Some(2.5))]
#[case::re_exit_above(&[(0.0, 2.0, 0.0), (1.0, 2.0, 2.0), (2.0, 2.0, 2.2), (3.0, 2.0, 2.0), (4.0, 2.0, 2.0)], Some(2.5))]
#[case::just_settled(&[(0.0, 2.0, 0.0), (1.0, 2.0, 1.8), (2.0, 2.0, 2.0)], Some(1.5))]
#[case::just_not(&[(0.0, 2.0, 0.0), (1.0, 2.0, 2.0), (2.0, 2.0, 1.8)], None)]
#[case::never(&[(0.0, 2.0, 0.0), (1.0, 2.0, 0.0)], None)]
#[case::at_once(&[(0.0, 2.0, 2.0), (1.0, 2.0, 2.0)], Some(0.0))]
#[case::across_the_whole_band(&[(0.0, 2.0, 0.0), (1.0, 2.0, 3.0), (2.0, 2.0, 2.0)], Some(1.9))]
#[case::falling(&[(0.0, 2.0, 2.0), (1.0, 1.0, 2.0), (2.0, 1.0, 1.1), (3.0, 1.0, 1.0)], Some(0.0))]
fn the_last_entry_counts(#[case] points: &[(f64, f64, f64)], #[case] settled: Option<f64>) {
    let measured = measure(&expectation_for(Metric::SettlingTime), &rows(points), &EMPTY_TELEMETRY);
    match settled {
        Some(t) => assert_close(measured.value().unwrap(), t, 1e-12),
        None => assert_eq!(measured, Measure::Missing(MissingValue::NeverSettles)),
    }
}

#[test]
fn a_falling_step_is_timed_from_its_own_instant() {
    let trace = rows(&[(0.0, 2.0, 2.0), (1.0, 1.0, 2.0), (2.0, 1.0, 1.1), (3.0, 1.0, 1.0)]);
    assert_close(measured_value(&expectation_with_from(Metric::SettlingTime, 1.0), &trace), 1.5, 1e-12);
}

#[rstest]
#[case::constant(&[(0.0, 2.0), (1.0, 2.0)], &[0])]
#[case::nothing(&[(0.0, 0.0), (1.0, 0.0)], &[])]
#[case::hold(&[(0.0, 0.0), (1.0, 2.0), (2.0, 2.0)], &[1])]
#[case::several(&[(0.0, 0.0), (1.0, 2.0), (2.0, 2.0), (3.0, 1.0), (4.0, 1.0), (5.0, 0.0)], &[1, 3, 5])]
#[case::shared_instant(&[(0.0, 0.0), (1.0, 2.0), (1.0, 2.0), (2.0, 2.0)], &[1])]
#[case::shared_instant_late(&[(0.0, 0.0), (1.0, 0.0), (1.0, 2.0), (2.0, 2.0)], &[2])]
#[case::two_values_in_one_instant(&[(0.0, 0.0), (1.0, 1.0), (1.0, 2.0), (2.0, 2.0)], &[1])]
#[case::ramp(&[(0.0, 0.0), (1.0, 0.0), (2.0, 1.0), (3.0, 2.0), (4.0, 2.0)], &[1])]
#[case::ramp_with_shared_instants(&[(0.0, 0.0), (1.0, 1.0), (1.0, 1.0), (2.0, 2.0), (2.0, 2.0), (3.0, 3.0)], &[0])]
#[case::two_ramps(&[(0.0, 0.0), (1.0, 1.0), (2.0, 2.0), (3.0, 2.0), (4.0, 2.0), (5.0, 1.0), (6.0, 0.0)], &[0, 4])]
#[case::jump_after_a_ramp(&[(0.0, 0.0), (1.0, 1.0), (2.0, 2.0), (3.0, 2.0), (4.0, 2.0), (5.0, 1.0), (6.0, 1.0)], &[0, 5])]
#[case::crest(&[(0.0, 0.0), (1.0, 1.0), (2.0, 1.5), (3.0, 1.5), (4.0, 1.0), (5.0, 0.5)], &[0])]
#[case::ramp_from_the_start(&[(0.0, 2.0), (1.0, 2.1), (2.0, 2.2), (3.0, 2.3), (4.0, 2.3)], &[0])]
#[case::jump_right_after_the_start(&[(0.0, 2.0), (1.0, 1.0), (2.0, 1.0)], &[0, 1])]
#[case::empty(&[], &[])]
fn steps_are_where_the_setpoint_starts_to_move(#[case] points: &[(f64, f64)], #[case] steps: &[usize]) {
    let trace = rows(&points.iter().map(|&(t, setpoint)| (t, setpoint, 0.0)).collect::<Vec<_>>());
    assert_eq!(setpoint_steps(&trace), steps);
}

/// 2 µm from 0 ms, 1 µm from 10 ms, 3 µm from 20 ms; each reached on a straight line, in 2, 1 and 4 ms.
fn staircase_rows() -> Vec<Row> {
    let setpoint = |t: f64| {
        if t < 10.0 {
            2.0
        } else if t < 20.0 {
            1.0
        } else {
            3.0
        }
    };
    let amplitude = |t: f64| match t {
        t if t < 10.0 => t.min(2.0),
        t if t < 20.0 => 2.0 - (t - 10.0).min(1.0),
        t => 1.0 + ((t - 20.0) / 2.0).min(2.0),
    };
    trace_at(grid(0.05, 30.0), setpoint, amplitude)
}

#[rstest]
#[case([0.0, 10.0], 1.9)]
#[case([10.0, 20.0], 0.95)]
#[case([20.0, END_MS], 3.7)]
fn settling_runs_from_the_step_at_the_start_of_the_window(#[case] window: [f64; 2], #[case] settled: f64) {
    let expectation = expectation_in(Metric::SettlingTime, &[window]);
    assert_close(measured_value(&expectation, &staircase_rows()), settled, 1e-9);
}

#[test]
fn the_worst_window_decides() {
    let all = [[0.0, 10.0], [10.0, 20.0], [20.0, END_MS]];
    let settling = expectation_in(Metric::SettlingTime, &all);
    assert_close(measured_value(&settling, &staircase_rows()), 3.7, 1e-9);
    let least = Expectation { limit: Limit::AtLeast(5.0), ..settling.clone() };
    assert_close(measured_value(&least, &staircase_rows()), 0.95, 1e-9);
    let mut never = staircase_rows();
    never.iter_mut().filter(|row| row.t_s > 0.018 && row.t_s < 0.02).for_each(|row| row.amplitude_um = 2.0);
    assert_eq!(measure(&settling, &never, &EMPTY_TELEMETRY), Measure::Missing(MissingValue::NeverSettles));
}

/// Two taps at 10 and 20 ms, recovered after 3 and 6 ms. A step of 0.0001 µm at 15 ms must not end the second window.
#[test]
fn each_tap_is_judged_by_itself_and_a_tiny_step_ends_no_window() {
    let setpoint = |t: f64| if t < 15.0 { 2.0 } else { 2.0001 };
    let dip = |t: f64| (10.0..13.0).contains(&t) || (20.0..26.0).contains(&t);
    let trace = trace_at(grid(0.05, 30.0), setpoint, |t| if dip(t) { 1.5 } else { setpoint(t) });
    let recovery = |windows: &[[f64; 2]]| measured_value(&expectation_in(Metric::RecoveryTime, windows), &trace);
    assert_close(recovery(&[[10.0, 20.0]]), 3.0, 0.05);
    assert_close(recovery(&[[10.0, 20.0], [20.0, 30.0]]), 6.0, 0.05);
    let deviation = expectation_in(Metric::PeakDeviation, &[[14.0, 30.0]]);
    assert_close(measured_value(&deviation, &trace), 25.0, 0.01);
}

#[test]
fn what_happens_after_the_next_step_does_not_count() {
    let mut trace = staircase_rows();
    for row in trace.iter_mut().filter(|row| row.t_s > 0.021) {
        row.amplitude_um = 9.0;
    }
    assert_close(measured_value(&expectation_for(Metric::SettlingTime), &trace), 1.9, 1e-9);
    assert_eq!(measured_value(&expectation_for(Metric::Overshoot), &trace), 0.0);
    assert_eq!(measured_value(&expectation_in(Metric::RecoveryTime, &[[15.0, 20.0]]), &trace), 0.0);
}

#[test]
fn a_ramp_is_timed_from_where_it_starts_to_where_its_band_is_entered() {
    // From 1 to 2 µm between 10 and 20 ms; the signal lags by 1 ms, which is more than 5 % of the setpoint until it nears the end.
    let setpoint = |t: f64| 1.0 + ((t - 10.0) / 10.0).clamp(0.0, 1.0);
    let trace = trace_at(grid(0.5, 30.0), setpoint, |t| setpoint(t - 1.0));
    let ramp = expectation_with_from(Metric::SettlingTime, 10.0);
    // s(t) − s(t − 1) = 0.1 ≤ 0.05 s(t) first at s = 2, t = 20 ms.
    assert_close(measured_value(&ramp, &trace), 10.0, 1e-9);
    // With 6 %: 0.1 ≤ 0.06 s at s = 1.6667, t = 16.667 ms, which lies between two rows of a band that moves.
    assert_close(measured_value(&Expectation { band_percent: 6.0, ..ramp }, &trace), 20.0 / 3.0, 1e-9);
}

#[test]
fn without_a_step_or_with_a_setpoint_of_0_there_is_nothing_to_settle() {
    let settling = expectation_for(Metric::SettlingTime);
    assert!(matches!(
        measure(&settling, &rows(&[(0.0, 0.0, 0.0), (1.0, 0.0, 0.0)]), &EMPTY_TELEMETRY),
        Measure::Undefined(_)
    ));
    let to_rest = rows(&[(0.0, 2.0, 2.0), (1.0, 0.0, 2.0), (2.0, 0.0, 0.0)]);
    assert!(matches!(
        measure(&expectation_with_from(Metric::SettlingTime, 1.0), &to_rest, &EMPTY_TELEMETRY),
        Measure::Undefined(_)
    ));
    assert!(matches!(measure(&settling, &[], &EMPTY_TELEMETRY), Measure::Undefined(_)));
}

#[test]
fn what_the_controller_was_given_is_held_between_rows() {
    let mut trace = rows(&[(0.0, 2.0, 0.0), (1.0, 2.0, 0.0), (2.0, 2.0, 0.0), (3.0, 2.0, 0.0)]);
    for (row, sensed) in trace.iter_mut().zip([0.0, 1.0, 2.0, 2.0]) {
        (row.sensed_wd_um, row.wd_um) = (sensed, sensed);
    }
    let settling = |signal| Expectation { signal, ..expectation_for(Metric::SettlingTime) };
    assert_eq!(measure(&settling("sensed_wd_um"), &trace, &EMPTY_TELEMETRY), Measure::Interval([1.0, 2.0]));
    assert_close(measured_value(&settling("wd_um"), &trace), 1.9, 1e-12);
    let error = |signal| Expectation { signal, ..expectation_in(Metric::StaticError, &[[0.0, 3.0]]) };
    // Held: 0, 1, 2 over a ms each, mean 1. Straight: 0.5, 1.5, 2, mean 4/3.
    assert_close(measured_value(&error("sensed_wd_um"), &trace), -50.0, 1e-9);
    assert_close(measured_value(&error("wd_um"), &trace), -100.0 / 3.0, 1e-9);
}

/// Control instants at 0.5, 1.5, … ms, rows every 0.5 ms; the controller is given 0, 0, then 2 µm.
#[test]
fn a_time_off_samples_lies_between_the_last_one_outside_and_the_first_one_inside() {
    let mut trace = rows(&[
        (0.0, 2.0, 0.0),
        (0.5, 2.0, 0.0),
        (1.0, 2.0, 0.0),
        (1.5, 2.0, 0.0),
        (2.0, 2.0, 0.0),
        (2.5, 2.0, 2.0),
        (3.0, 2.0, 2.0),
        (3.5, 2.0, 2.0),
    ]);
    for (index, row) in trace.iter_mut().enumerate() {
        row.flags = if index % 2 == 1 { Flags::CONTROL } else { Flags::empty() };
        row.sensed_wd_um = if index >= 5 { 2.0 } else { 0.0 };
    }
    let settling = Expectation { signal: "sensed_wd_um", ..expectation_for(Metric::SettlingTime) };
    let recovery = Expectation { signal: "sensed_wd_um", ..expectation_with_from(Metric::RecoveryTime, 0.25) };
    assert_eq!(measure(&settling, &trace, &EMPTY_TELEMETRY), Measure::Interval([1.5, 2.5]));
    let Measure::Interval([first, last]) = measure(&recovery, &trace, &EMPTY_TELEMETRY) else { panic!("samples") };
    assert_close(first, 1.25, 1e-12);
    assert_close(last, 2.25, 1e-12);
    // Inside from the first sample on: it settled somewhere before that.
    for row in &mut trace {
        row.sensed_wd_um = 2.0;
    }
    assert_eq!(measure(&settling, &trace, &EMPTY_TELEMETRY), Measure::Interval([0.0, 0.5]));
    trace[0].flags = Flags::CONTROL;
    assert_eq!(measure(&settling, &trace, &EMPTY_TELEMETRY), Measure::Value(0.0));
    // Outside at the last sample, whatever is held after it.
    trace[7].sensed_wd_um = 0.0;
    assert!(matches!(measure(&settling, &trace, &EMPTY_TELEMETRY), Measure::Missing(_)));
}

#[rstest]
#[case::rising(&[(0.0, 2.0, 0.0), (1.0, 2.0, 2.3), (2.0, 2.0, 2.0)], None, 15.0)]
#[case::none(&[(0.0, 2.0, 0.0), (1.0, 2.0, 1.9)], None, 0.0)]
#[case::relative_to_the_step(&[(0.0, 2.0, 2.0), (1.0, 2.5, 2.0), (2.0, 2.5, 2.6)], Some(1.0), 20.0)]
#[case::falling(&[(0.0, 2.0, 2.0), (1.0, 1.0, 2.0), (2.0, 1.0, 0.8), (3.0, 1.0, 1.0)], Some(1.0), 20.0)]
#[case::falling_short(&[(0.0, 2.0, 2.0), (1.0, 1.0, 2.0), (2.0, 1.0, 1.2)], Some(1.0), 0.0)]
#[case::falling_to_rest(&[(0.0, 2.0, 2.0), (1.0, 0.0, 2.0), (2.0, 0.0, 0.0)], Some(1.0), 0.0)]
fn overshoot_goes_beyond_the_setpoint_in_the_direction_of_the_step(
    #[case] points: &[(f64, f64, f64)],
    #[case] from_ms: Option<f64>,
    #[case] overshoot: f64,
) {
    let expectation = expectation_with_from(Metric::Overshoot, from_ms.unwrap_or(0.0));
    assert_close(measured_value(&expectation, &rows(points)), overshoot, 1e-9);
}

#[test]
fn a_triangle_has_no_step_to_overshoot() {
    let triangle = trace_at(grid(1.0, 20.0), |t| 10.0 - (t - 10.0).abs(), |_| 0.0);
    assert!(matches!(measure(&expectation_for(Metric::Overshoot), &triangle, &EMPTY_TELEMETRY), Measure::Undefined(_)));
}

#[rstest]
#[case::dip(&[(0.0, 2.0, 2.0), (10.0, 2.0, 2.0), (11.0, 2.0, 1.5), (12.0, 2.0, 2.0), (13.0, 2.0, 2.0)], Some(1.8))]
#[case::twice(&[(0.0, 2.0, 2.0), (10.0, 2.0, 1.5), (11.0, 2.0, 2.0), (12.0, 2.0, 2.5), (13.0, 2.0, 2.0)], Some(2.8))]
#[case::never_left(&[(0.0, 2.0, 2.0), (10.5, 2.0, 2.0), (13.0, 2.0, 2.0)], Some(0.0))]
#[case::not_again(&[(0.0, 2.0, 2.0), (10.0, 2.0, 2.0), (13.0, 2.0, 1.5)], None)]
fn recovery_runs_from_the_disturbance_to_the_last_entry(
    #[case] points: &[(f64, f64, f64)],
    #[case] recovered: Option<f64>,
) {
    match (measure(&expectation_with_from(Metric::RecoveryTime, 10.0), &rows(points), &EMPTY_TELEMETRY), recovered) {
        (Measure::Value(value), Some(expected)) => assert_close(value, expected, 1e-9),
        (measured, expected) => {
            assert_eq!((measured, expected), (Measure::Missing(MissingValue::NeverRecovers), None));
        }
    }
}

#[test]
fn the_peak_deviation_covers_its_window() {
    let trace = rows(&[(0.0, 2.0, 0.0), (1.0, 2.0, 1.9), (2.0, 2.0, 2.3), (3.0, 2.0, 1.96), (4.0, 2.0, 2.06)]);
    let deviation = |window| measured_value(&expectation_in(Metric::PeakDeviation, &[window]), &trace);
    assert_close(deviation([0.0, END_MS]), 100.0, 1e-9);
    assert_close(deviation([2.0, END_MS]), 15.0, 1e-9);
    assert_close(deviation([2.000_001, END_MS]), 3.0, 1e-9);
    assert_close(deviation([3.0, 3.5]), 2.0, 1e-9);
}

#[test]
fn ripple_and_rest_drive_take_the_worst_window() {
    let mut trace = trace_at(grid(1.0, 30.0), |t| if t < 20.0 { 2.0 } else { 0.0 }, |t| 2.0 + 0.1 * (t % 2.0));
    for row in &mut trace {
        row.drive_vpp = if row.t_s < 0.022 { 300.0 } else { 7.0 };
    }
    let value = |metric, window| measured_value(&expectation_in(metric, &[window]), &trace);
    assert_close(value(Metric::Ripple, [5.0, 10.0]), 0.1, 1e-9);
    assert_close(value(Metric::RipplePercent, [5.0, 10.0]), 5.0, 1e-9);
    assert_close(value(Metric::RestDrive, [22.0, 30.0]), 7.0, 0.0);
    assert_close(value(Metric::RestDrive, [21.0, 30.0]), 300.0, 0.0);
    assert_close(value(Metric::RestDrive, [21.5, 30.0]), 300.0, 0.0);
    let at_rest = expectation_in(Metric::RipplePercent, &[[22.0, 30.0]]);
    assert_eq!(measure(&at_rest, &trace, &EMPTY_TELEMETRY), Measure::Undefined(UndefinedValue::ZeroSetpoint));
}

fn error_over(window: (f64, f64), trace: &[Row]) -> Measure {
    measure(&expectation_in(Metric::StaticError, &[window.into()]), trace, &EMPTY_TELEMETRY)
}

#[test]
fn the_static_error_has_its_sign_and_is_weighted_with_time() {
    for (level, error) in [(2.1, 5.0), (1.9, -5.0)] {
        assert_close(
            measured_value(&expectation_for(Metric::StaticError), &trace_at(grid(0.05, 60.0), |_| 2.0, |_| level)),
            error,
            1e-9,
        );
    }
    // 1 µm for 9 ms, then a thousand rows of 3 µm in 1 ms.
    let instants = [0.0, 9.0].into_iter().chain((0..=1_000).map(|index| 9.0 + 1e-6 + f64::from(index) * 0.000_999));
    let trace = trace_at(instants, |_| 2.0, |t| if t <= 9.0 { 1.0 } else { 3.0 });
    assert_close(error_over((0.0, 10.0), &trace).value().unwrap(), -40.0, 0.01);
}

#[test]
fn a_window_is_cut_out_exactly_even_between_rows() {
    // A line of 1 µm per ms from 0: its mean over a window is its middle.
    let trace = trace_at([0.0, 0.7, 2.9, 3.0, 7.5, 10.0], |_| 2.0, |t| t);
    for (from, to) in [(0.0, 10.0), (1.0, 5.0), (3.1, 3.2), (2.95, 9.999)] {
        assert_close(error_over((from, to), &trace).value().unwrap(), ((from + to) / 4.0 - 1.0) * 100.0, 1e-9);
    }
    let mut outside = trace_at(grid(0.05, 60.0), |_| 2.0, |t| if (20.0..=30.0).contains(&t) { 2.0 } else { 9.0 });
    assert_close(error_over((20.0, 30.0), &outside).value().unwrap(), 0.0, 1e-12);
    outside.retain(|row| row.t_s < 0.019);
    assert_eq!(error_over((20.0, 30.0), &outside), Measure::Undefined(UndefinedValue::EmptyWindow));
}

#[test]
fn a_mean_over_a_moving_setpoint_says_nothing() {
    // Stuck at 2 µm while the setpoint is at 1 and then at 3: right on average, wrong all the time.
    let trace = trace_at(grid(0.05, 60.0), |t| if t < 50.0 { 1.0 } else { 3.0 }, |_| 2.0);
    assert_eq!(error_over((40.0, 60.0), &trace), Measure::Undefined(UndefinedValue::SetpointChanges));
    assert_close(error_over((50.0, 60.0), &trace).value().unwrap(), -100.0 / 3.0, 1e-9);
    assert_close(error_over((40.0, 50.0), &trace).value().unwrap(), 100.0, 1e-9);
    let none = trace_at(grid(0.05, 60.0), |_| 0.0, |_| 2.0);
    assert_eq!(error_over((40.0, 60.0), &none), Measure::Undefined(UndefinedValue::ZeroSetpoint));
}

#[test]
fn a_trial_s_part_in_the_repeatability_is_its_mean_in_percent() {
    let trace = trace_at(grid(0.05, 60.0), |_| 2.0, |_| 1.9);
    assert_close(measured_value(&expectation_for(Metric::Repeatability), &trace), 95.0, 1e-9);
}

#[test]
fn what_is_read_off_the_end_is_read_off_the_last_row() {
    let mut trace = rows(&[(0.0, 2.0, 9.0), (1.0, 2.0, 1.95)]);
    trace[0] = Row { frequency_hz: 1.0, wq_um: 5.0, wd_um: 1.0, ..trace[0] };
    trace[1] = Row { frequency_hz: 32_300.0, resonance_hz: 32_307.6, wd_um: -1.0, wq_um: 0.25, ..trace[1] };
    assert_close(measured_value(&expectation_for(Metric::FrequencyError), &trace), 7.6, 1e-9);
    assert_eq!(measured_value(&expectation_for(Metric::QuadratureRatio), &trace), 0.25);
    assert_eq!(measured_value(&expectation_for(Metric::FinalAmplitude), &trace), 1.95);
    trace[1].wd_um = 0.0;
    assert!(matches!(
        measure(&expectation_for(Metric::QuadratureRatio), &trace, &EMPTY_TELEMETRY),
        Measure::Undefined(_)
    ));
}

#[test]
fn saturation_is_weighted_with_time_and_counts_from_its_row_on() {
    let mut trace = rows(&[(0.0, 2.0, 0.0), (1.0, 2.0, 0.0), (4.0, 2.0, 0.0), (10.0, 2.0, 0.0)]);
    trace[1].flags = Flags::SATURATED | Flags::CONTROL;
    trace[3].flags = Flags::SATURATED;
    assert_close(measured_value(&expectation_for(Metric::Saturated), &trace), 30.0, 1e-12);
    for (row, drive) in trace.iter_mut().zip([1.0, 540.0, 12.0, 3.0]) {
        row.drive_vpp = drive;
    }
    assert_eq!(measured_value(&expectation_for(Metric::DrivePeak), &trace), 540.0);
    trace[0].flags = Flags::OVERRUN;
    trace[2].flags = Flags::OVERRUN | Flags::SATURATED;
    assert_eq!(measured_value(&expectation_for(Metric::Overruns), &trace), 2.0);
    assert_eq!(
        measure(
            &expectation_for(Metric::LoopDelay),
            &trace,
            &Telemetry { loop_delay_us: Some(520.0), ..EMPTY_TELEMETRY }
        ),
        Measure::Value(520.0)
    );
    let costly = Telemetry { instructions_mean: Some(900.0), instructions_worst: Some(950.0), ..EMPTY_TELEMETRY };
    assert_eq!(measure(&expectation_for(Metric::InstructionsPerStep), &trace, &costly), Measure::Value(950.0));
    for untold in [Metric::LoopDelay, Metric::InstructionsPerStep] {
        assert!(matches!(measure(&expectation_for(untold), &trace, &EMPTY_TELEMETRY), Measure::Undefined(_)));
    }
}

#[test]
fn a_controller_that_gave_up_meets_nothing() {
    let mut trace = trace_at(grid(0.05, 60.0), |_| 2.0, |_| 2.0);
    trace[3].flags = Flags::SAFE;
    let told = Telemetry { loop_delay_us: Some(0.0), instructions_worst: Some(900.0), ..EMPTY_TELEMETRY };
    // The last two are about controllers that stop.
    let of_the_line = [Metric::ShutdownTime, Metric::MissedReplies];
    let others = || Metric::ALL.into_iter().filter(|metric| !of_the_line.contains(metric));
    for metric in others().filter(|metric| *metric != Metric::QuadratureRatio) {
        assert!(
            measure(&expectation_with_from(metric, 0.0), &trace, &told).value().is_some(),
            "{metric} of a controller that started late"
        );
    }
    trace.last_mut().unwrap().flags = Flags::SAFE;
    for metric in others() {
        assert_eq!(
            measure(&expectation_with_from(metric, 0.0), &trace, &told),
            Measure::Missing(MissingValue::NotRunning),
            "{metric}"
        );
    }
}

/// A row per millisecond up to 60 ms; stopped where `stopped` says so.
fn rows_with_stop(stopped: impl Fn(u32) -> bool) -> Vec<Row> {
    let row = |t: u32| Row {
        t_s: ms(f64::from(t)).seconds(),
        setpoint_um: 2.0,
        drive_vpp: if stopped(t) { 0.0 } else { 286.0 },
        flags: if stopped(t) { Flags::SAFE } else { Flags::CONTROL },
        ..Row::default()
    };
    (0..=60).map(row).collect()
}

fn shutdown_expectation(to_ms: f64) -> Expectation {
    expectation_in(Metric::ShutdownTime, &[[40.0, to_ms]])
}

#[test]
fn a_shutdown_counts_from_the_disturbance_to_the_stop_that_lasts() {
    let time = |to_ms: f64, rows: &[Row]| measured_value(&shutdown_expectation(to_ms), rows);
    assert_close(time(60.0, &rows_with_stop(|t| t >= 44)), 4.0, 1e-9);
    assert_close(time(60.0, &rows_with_stop(|t| t >= 40)), 0.0, 1e-9);
    assert_close(time(60.0, &rows_with_stop(|t| t == 42 || t >= 44)), 4.0, 1e-9);
    assert_close(time(60.0, &rows_with_stop(|t| t >= 60)), 20.0, 1e-9);
    // Configured anew at 50 ms; what comes before is the stop, what comes behind is not looked at.
    let resumed = rows_with_stop(|t| (44..50).contains(&t));
    assert_close(time(50.0, &resumed), 4.0, 1e-9);
    assert_eq!(
        measure(&shutdown_expectation(51.0), &resumed, &EMPTY_TELEMETRY),
        Measure::Missing(MissingValue::NotAtRest)
    );
}

#[test]
fn what_is_no_shutdown_has_no_time() {
    let missing = |rows: &[Row], telemetry: &Telemetry| match measure(&shutdown_expectation(60.0), rows, telemetry) {
        Measure::Missing(what) => what,
        other => panic!("{other:?}"),
    };
    assert_eq!(missing(&rows_with_stop(|_| false), &EMPTY_TELEMETRY), MissingValue::NotAtRest);
    assert_eq!(missing(&rows_with_stop(|_| true), &EMPTY_TELEMETRY), MissingValue::NeverRan);
    assert_eq!(missing(&rows_with_stop(|t| t >= 39), &EMPTY_TELEMETRY), MissingValue::StoppedBefore);
    let stopped = rows_with_stop(|t| t >= 44);
    // Running at 0 V is no stop, and neither is a stop that goes on driving.
    let with = |change: fn(&mut Row)| {
        let mut rows = stopped.clone();
        rows.iter_mut().for_each(change);
        rows
    };
    assert_eq!(missing(&with(|row| row.flags = Flags::empty()), &EMPTY_TELEMETRY), MissingValue::NotAtRest);
    assert_eq!(missing(&with(|row| row.drive_vpp = 1.0), &EMPTY_TELEMETRY), MissingValue::NotAtRest);
    // Whoever never drove has nothing to take back.
    let idle = stopped.iter().map(|row| Row { drive_vpp: 0.0, ..*row }).collect::<Vec<_>>();
    assert_eq!(missing(&idle, &EMPTY_TELEMETRY), MissingValue::NeverDrove);
    let unasked = idle.iter().map(|row| Row { setpoint_um: 0.0, ..*row }).collect::<Vec<_>>();
    assert!(matches!(measure(&shutdown_expectation(60.0), &unasked, &EMPTY_TELEMETRY), Measure::Value(_)));
    let trapped = Telemetry { ended: Some("trapped".to_owned()), ..EMPTY_TELEMETRY };
    assert_eq!(missing(&stopped, &trapped), MissingValue::NotRunning);
}

#[test]
fn control_instants_without_an_answer_are_missed_replies() {
    let mut rows = rows_with_stop(|t| t >= 44);
    assert_eq!(measured_value(&expectation_for(Metric::MissedReplies), &rows), 0.0);
    rows[3].flags |= Flags::LINK_LOST;
    rows[5].flags |= Flags::LINK_LOST;
    rows[5].flags -= Flags::CONTROL;
    assert_eq!(measured_value(&expectation_for(Metric::MissedReplies), &rows), 1.0);
}

/// The same rows as a controller tells them that drives a real plate.
fn as_real_plate(rows: &[Row]) -> Vec<Row> {
    let told = |row: &Row| Row {
        sensed_wd_um: row.wd_um,
        resonance_hz: f64::NAN,
        temperature_offset_k: f64::NAN,
        finger_force_n: f64::NAN,
        flags: row.flags | Flags::CONTROL | Flags::SENSED,
        ..*row
    };
    rows.iter().map(told).collect()
}

#[test]
fn a_time_off_a_real_plate_is_the_interval_that_its_samples_leave() {
    let step = |t: f64| if t < 1.0 { 0.0 } else { 2.0 };
    // Inside from the sample at 3 ms on: somewhere after 2 ms.
    let rows = as_real_plate(&trace_at(grid(1.0, 60.0), step, |t| if t < 3.0 { 0.0 } else { 1.95 }));
    let measured = measure(&expectation_for(Metric::SettlingTime), &rows, &EMPTY_TELEMETRY);
    assert_eq!(measured, Measure::Interval([1.0, 2.0]));
    // Stamps of a clock in µs, far from zero, where a difference of doubles is not the decimal one.
    let late: Vec<Row> = rows.iter().map(|row| Row { t_s: (row.t_s * 1e6 + 43_000.0) / 1e6, ..*row }).collect();
    assert_eq!(measure(&expectation_for(Metric::SettlingTime), &late, &EMPTY_TELEMETRY), Measure::Interval([1.0, 2.0]));
}

#[test]
fn what_nobody_can_see_of_a_real_plate_has_no_number() {
    let rows = as_real_plate(&trace_at(grid(1.0, 60.0), |_| 2.0, |_| 2.0));
    for metric in Metric::ALL {
        let unknown = matches!(measure(&expectation_for(metric), &rows, &EMPTY_TELEMETRY), Measure::Undefined(_));
        let expected = matches!(
            metric,
            Metric::FrequencyError
                | Metric::RecoveryTime
                | Metric::Overruns
                | Metric::MissedReplies
                | Metric::LoopDelay
                | Metric::InstructionsPerStep
                // These rows have no Wd.
                | Metric::QuadratureRatio
        );
        assert_eq!(unknown, expected, "{metric}");
    }
}

#[test]
fn what_was_driven_in_the_place_of_what_was_commanded_is_no_merit() {
    let settled = trace_at([0.0, 1.0, 60.0], |_| 2.0, |t| if t < 1.0 { 0.0 } else { 2.0 });
    let not_a_number = Telemetry { not_finite: Some(NonFiniteDrive { at_s: 0.01, count: 1 }), ..EMPTY_TELEMETRY };
    for metric in [Metric::SettlingTime, Metric::Overshoot, Metric::DrivePeak, Metric::FinalAmplitude] {
        assert!(matches!(measure(&expectation_for(metric), &settled, &EMPTY_TELEMETRY), Measure::Value(_)), "{metric}");
        assert!(matches!(measure(&expectation_for(metric), &settled, &not_a_number), Measure::Missing(_)), "{metric}");
    }
    let shut = rows_with_stop(|t| t >= 44);
    assert!(matches!(measure(&shutdown_expectation(60.0), &shut, &EMPTY_TELEMETRY), Measure::Value(_)));
    assert!(
        matches!(measure(&shutdown_expectation(60.0), &shut, &not_a_number), Measure::Missing(_)),
        "its 0 V is the bench's"
    );
    // The line did what it should, and what was missing before stays what it was.
    assert_eq!(measure(&expectation_for(Metric::MissedReplies), &settled, &not_a_number), Measure::Value(0.0));
    let never = trace_at([0.0, 1.0, 60.0], |_| 2.0, |_| 0.0);
    assert_eq!(
        measure(&expectation_for(Metric::SettlingTime), &never, &not_a_number),
        Measure::Missing(MissingValue::NeverSettles)
    );
}
