use super::*;

const TAU: f64 = 1.88;

fn first_order(t: f64) -> f64 {
    2.0 * (1.0 - (-t / TAU).exp())
}

#[test]
fn a_first_order_response_settles_after_tau_ln_20() {
    let exact = TAU * 20.0_f64.ln();
    // Between rows of distance h, a chord is too low by 2 µm · h²/8τ² · e^(−t/τ). Divided by the
    // slope, this is a time of h²/8τ.
    for step in [0.05, 0.01] {
        assert_close(
            value_of(Metric::SettlingTime, &trace_at(grid(step, 60.0), |_| 2.0, first_order)),
            exact,
            step * step / (8.0 * TAU),
        );
    }
    let irregular = (0_u32..3_000).map(|index| f64::from(index) * 0.02 + 0.009 * (f64::from(index) * 1.7).sin().abs());
    assert_close(value_of(Metric::SettlingTime, &trace_at(irregular, |_| 2.0, first_order)), exact, 1e-4);
}

#[test]
fn a_row_after_the_crossing_makes_settling_exact() {
    let exact = TAU * 20.0_f64.ln();
    let crossing = (exact * 1e6).ceil() / 1e6;
    let instants = grid(1.0, 5.0).chain([crossing]).chain((6..60).map(f64::from));
    assert_close(value_of(Metric::SettlingTime, &trace_at(instants, |_| 2.0, first_order)), exact, 1e-6);
}

#[test]
fn the_edges_of_the_band_are_inside() {
    let held =
        |level: f64| measure_of(Metric::SettlingTime, &rows(&[(0.0, 2.0, 0.0), (1.0, 2.0, level), (2.0, 2.0, level)]));
    let (low, high) = expectation_for(Metric::SettlingTime).band(2.0);
    assert_eq!(held(low), Measure::Value(1.0));
    assert_eq!(held(high).value().map(|t| t < 1.0), Some(true));
    assert!(matches!(held(low.next_down()), Measure::Missing(_)));
    assert!(matches!(held(high.next_up()), Measure::Missing(_)));
}

#[rstest]
#[case::re_exit_below(&[(0.0, 2.0, 0.0), (1.0, 2.0, 2.0), (2.0, 2.0, 1.8), (3.0, 2.0, 2.0), (4.0, 2.0, 2.0)],
    Some(2.5))]
#[case::re_exit_above(&[(0.0, 2.0, 0.0), (1.0, 2.0, 2.0), (2.0, 2.0, 2.2), (3.0, 2.0, 2.0), (4.0, 2.0, 2.0)],
    Some(2.5))]
#[case::just_settled(&[(0.0, 2.0, 0.0), (1.0, 2.0, 1.8), (2.0, 2.0, 2.0)], Some(1.5))]
#[case::just_not(&[(0.0, 2.0, 0.0), (1.0, 2.0, 2.0), (2.0, 2.0, 1.8)], None)]
#[case::never(&[(0.0, 2.0, 0.0), (1.0, 2.0, 0.0)], None)]
#[case::at_once(&[(0.0, 2.0, 2.0), (1.0, 2.0, 2.0)], Some(0.0))]
#[case::across_the_whole_band(&[(0.0, 2.0, 0.0), (1.0, 2.0, 3.0), (2.0, 2.0, 2.0)], Some(1.9))]
#[case::falling(&[(0.0, 2.0, 2.0), (1.0, 1.0, 2.0), (2.0, 1.0, 1.1), (3.0, 1.0, 1.0)], Some(0.0))]
fn the_last_entry_counts(#[case] points: &[(f64, f64, f64)], #[case] settled: Option<f64>) {
    let measured = measure_of(Metric::SettlingTime, &rows(points));
    match settled {
        Some(t) => assert_close(measured.value().unwrap(), t, 1e-12),
        None => assert_eq!(measured, Measure::Missing(MissingValue::NeverSettles)),
    }
}

#[test]
fn settling_of_a_falling_step_starts_at_the_step() {
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
#[case::jump_after_a_ramp(&[(0.0, 0.0), (1.0, 1.0), (2.0, 2.0), (3.0, 2.0), (4.0, 2.0), (5.0, 1.0), (6.0, 1.0)],
    &[0, 5])]
#[case::crest(&[(0.0, 0.0), (1.0, 1.0), (2.0, 1.5), (3.0, 1.5), (4.0, 1.0), (5.0, 0.5)], &[0])]
#[case::ramp_from_the_start(&[(0.0, 2.0), (1.0, 2.1), (2.0, 2.2), (3.0, 2.3), (4.0, 2.3)], &[0])]
#[case::jump_right_after_the_start(&[(0.0, 2.0), (1.0, 1.0), (2.0, 1.0)], &[0, 1])]
#[case::empty(&[], &[])]
fn finds_the_starts_of_setpoint_changes(#[case] points: &[(f64, f64)], #[case] steps: &[usize]) {
    let trace = rows(&points.iter().map(|&(t, setpoint)| (t, setpoint, 0.0)).collect::<Vec<_>>());
    assert_eq!(setpoint_steps(&trace), steps);
}

/// Setpoints of 2, 1 and 3 µm from 0, 10 and 20 ms are reached in 2, 1 and 4 ms.
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
fn settling_starts_at_the_window(#[case] window: [f64; 2], #[case] settled: f64) {
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
    assert_eq!(measured(&settling, &never), Measure::Missing(MissingValue::NeverSettles));
}

/// A setpoint step of 0.0001 µm at 15 ms must not end a window.
#[test]
fn judges_each_tap_in_its_own_window() {
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
fn ignores_rows_after_the_next_step() {
    let mut trace = staircase_rows();
    for row in trace.iter_mut().filter(|row| row.t_s > 0.021) {
        row.amplitude_um = 9.0;
    }
    assert_close(value_of(Metric::SettlingTime, &trace), 1.9, 1e-9);
    assert_eq!(value_of(Metric::Overshoot, &trace), 0.0);
    assert_eq!(measured_value(&expectation_in(Metric::RecoveryTime, &[[15.0, 20.0]]), &trace), 0.0);
}

#[test]
fn settling_of_a_ramp_ends_in_its_moving_band() {
    let setpoint = |t: f64| 1.0 + ((t - 10.0) / 10.0).clamp(0.0, 1.0);
    let trace = trace_at(grid(0.5, 30.0), setpoint, |t| setpoint(t - 1.0));
    let ramp = expectation_with_from(Metric::SettlingTime, 10.0);
    // The signal is the setpoint s of 1 ms before: 0.1 ≤ 0.05 s(t) first at s = 2, t = 20 ms.
    assert_close(measured_value(&ramp, &trace), 10.0, 1e-9);
    // With a band of 6 %: 0.1 ≤ 0.06 s at s = 1.6667, t = 16.667 ms, between two rows.
    assert_close(measured_value(&Expectation { band_percent: 6.0, ..ramp }, &trace), 20.0 / 3.0, 1e-9);
}

#[test]
fn settling_is_undefined_without_a_step_or_at_setpoint_0() {
    let settling = expectation_for(Metric::SettlingTime);
    assert!(matches!(measured(&settling, &rows(&[(0.0, 0.0, 0.0), (1.0, 0.0, 0.0)])), Measure::Undefined(_)));
    let to_rest = rows(&[(0.0, 2.0, 2.0), (1.0, 0.0, 2.0), (2.0, 0.0, 0.0)]);
    assert!(matches!(measured(&expectation_with_from(Metric::SettlingTime, 1.0), &to_rest), Measure::Undefined(_)));
    assert!(matches!(measured(&settling, &[]), Measure::Undefined(_)));
}

#[test]
fn holds_sensed_values_between_rows() {
    let mut trace = rows(&[(0.0, 2.0, 0.0), (1.0, 2.0, 0.0), (2.0, 2.0, 0.0), (3.0, 2.0, 0.0)]);
    for (row, sensed) in trace.iter_mut().zip([0.0, 1.0, 2.0, 2.0]) {
        (row.sensed_wd_um, row.wd_um) = (sensed, sensed);
    }
    let settling = |signal| Expectation { signal, ..expectation_for(Metric::SettlingTime) };
    assert_eq!(measured(&settling("sensed_wd_um"), &trace), Measure::Interval([1.0, 2.0]));
    assert_close(measured_value(&settling("wd_um"), &trace), 1.9, 1e-12);
    let error = |signal| Expectation { signal, ..expectation_in(Metric::StaticError, &[[0.0, 3.0]]) };
    // Held for 1 ms each: 0, 1, 2 µm, mean 1 µm. Linear: 0.5, 1.5, 2 µm, mean 4/3 µm.
    assert_close(measured_value(&error("sensed_wd_um"), &trace), -50.0, 1e-9);
    assert_close(measured_value(&error("wd_um"), &trace), -100.0 / 3.0, 1e-9);
}

/// Control instants are at 0.5, 1.5, … ms. The controller receives 0, 0, then 2 µm.
#[test]
fn a_time_from_samples_is_an_interval() {
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
    assert_eq!(measured(&settling, &trace), Measure::Interval([1.5, 2.5]));
    let Measure::Interval([first, last]) = measured(&recovery, &trace) else { panic!("samples") };
    assert_close(first, 1.25, 1e-12);
    assert_close(last, 2.25, 1e-12);
    for row in &mut trace {
        row.sensed_wd_um = 2.0;
    }
    assert_eq!(measured(&settling, &trace), Measure::Interval([0.0, 0.5]));
    trace[0].flags = Flags::CONTROL;
    assert_eq!(measured(&settling, &trace), Measure::Value(0.0));
    trace[7].sensed_wd_um = 0.0;
    assert!(matches!(measured(&settling, &trace), Measure::Missing(_)));
}

#[rstest]
#[case::rising(&[(0.0, 2.0, 0.0), (1.0, 2.0, 2.3), (2.0, 2.0, 2.0)], None, 15.0)]
#[case::none(&[(0.0, 2.0, 0.0), (1.0, 2.0, 1.9)], None, 0.0)]
#[case::relative_to_the_step(&[(0.0, 2.0, 2.0), (1.0, 2.5, 2.0), (2.0, 2.5, 2.6)], Some(1.0), 20.0)]
#[case::falling(&[(0.0, 2.0, 2.0), (1.0, 1.0, 2.0), (2.0, 1.0, 0.8), (3.0, 1.0, 1.0)], Some(1.0), 20.0)]
#[case::falling_short(&[(0.0, 2.0, 2.0), (1.0, 1.0, 2.0), (2.0, 1.0, 1.2)], Some(1.0), 0.0)]
#[case::falling_to_rest(&[(0.0, 2.0, 2.0), (1.0, 0.0, 2.0), (2.0, 0.0, 0.0)], Some(1.0), 0.0)]
fn overshoot_is_in_the_direction_of_the_step(
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
    assert!(matches!(measure_of(Metric::Overshoot, &triangle), Measure::Undefined(_)));
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
    match (measured(&expectation_with_from(Metric::RecoveryTime, 10.0), &rows(points)), recovered) {
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
