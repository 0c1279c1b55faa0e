use super::*;
use platebench_model::metrics::{EnablePin, OutputRead};
use platebench_model::record::StepTime;

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
    assert_eq!(measured(&at_rest, &trace), Measure::Undefined(UndefinedValue::ZeroSetpoint));
}

fn error_over(window: (f64, f64), trace: &[Row]) -> Measure {
    measured(&expectation_in(Metric::StaticError, &[window.into()]), trace)
}

#[test]
fn the_static_error_is_signed_and_time_weighted() {
    for (level, error) in [(2.1, 5.0), (1.9, -5.0)] {
        assert_close(value_of(Metric::StaticError, &trace_at(grid(0.05, 60.0), |_| 2.0, |_| level)), error, 1e-9);
    }
    // 1 µm for 9 ms, then a thousand rows of 3 µm in 1 ms: the mean weights rows by their duration.
    let instants = [0.0, 9.0].into_iter().chain((0..=1_000).map(|index| 9.0 + 1e-6 + f64::from(index) * 0.000_999));
    let trace = trace_at(instants, |_| 2.0, |t| if t <= 9.0 { 1.0 } else { 3.0 });
    assert_close(error_over((0.0, 10.0), &trace).value().unwrap(), -40.0, 0.01);
}

#[test]
fn cuts_a_window_between_rows() {
    // The signal rises by 1 µm per ms, so its mean over a window is its value at the middle.
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
fn a_mean_over_a_changing_setpoint_is_undefined() {
    // An amplitude of 2 µm for setpoints of 1 and 3 µm is right on average and wrong at any time.
    let trace = trace_at(grid(0.05, 60.0), |t| if t < 50.0 { 1.0 } else { 3.0 }, |_| 2.0);
    assert_eq!(error_over((40.0, 60.0), &trace), Measure::Undefined(UndefinedValue::SetpointChanges));
    assert_close(error_over((50.0, 60.0), &trace).value().unwrap(), -100.0 / 3.0, 1e-9);
    assert_close(error_over((40.0, 50.0), &trace).value().unwrap(), 100.0, 1e-9);
    let none = trace_at(grid(0.05, 60.0), |_| 0.0, |_| 2.0);
    assert_eq!(error_over((40.0, 60.0), &none), Measure::Undefined(UndefinedValue::ZeroSetpoint));
}

#[test]
fn repeatability_uses_the_mean_in_percent() {
    let trace = trace_at(grid(0.05, 60.0), |_| 2.0, |_| 1.9);
    assert_close(value_of(Metric::Repeatability, &trace), 95.0, 1e-9);
}

#[test]
fn final_values_are_from_the_last_row() {
    let mut trace = rows(&[(0.0, 2.0, 9.0), (1.0, 2.0, 1.95)]);
    trace[0] = Row { frequency_hz: 1.0, wq_um: 5.0, wd_um: 1.0, ..trace[0] };
    trace[1] = Row { frequency_hz: 32_300.0, resonance_hz: 32_307.6, wd_um: -1.0, wq_um: 0.25, ..trace[1] };
    assert_close(value_of(Metric::FrequencyError, &trace), 7.6, 1e-9);
    assert_eq!(value_of(Metric::QuadratureRatio, &trace), 0.25);
    assert_eq!(value_of(Metric::FinalAmplitude, &trace), 1.95);
    trace[1].wd_um = 0.0;
    assert!(matches!(measure_of(Metric::QuadratureRatio, &trace), Measure::Undefined(_)));
}

#[test]
fn saturation_is_time_weighted() {
    let mut trace = rows(&[(0.0, 2.0, 0.0), (1.0, 2.0, 0.0), (4.0, 2.0, 0.0), (10.0, 2.0, 0.0)]);
    trace[1].flags = Flags::SATURATED | Flags::CONTROL;
    trace[3].flags = Flags::SATURATED;
    assert_close(value_of(Metric::Saturated, &trace), 30.0, 1e-12);
    for (row, drive) in trace.iter_mut().zip([1.0, 540.0, 12.0, 3.0]) {
        row.drive_vpp = drive;
    }
    assert_eq!(value_of(Metric::DrivePeak, &trace), 540.0);
    trace[0].flags = Flags::OVERRUN;
    trace[2].flags = Flags::OVERRUN | Flags::SATURATED;
    assert_eq!(value_of(Metric::Overruns, &trace), 2.0);
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
    let step_time = StepTime { longest_percent: 6.2, ..StepTime::default() };
    let timed = Telemetry { step_time: Some(step_time), ..EMPTY_TELEMETRY };
    assert_eq!(measure(&expectation_for(Metric::StepTime), &trace, &timed), Measure::Value(6.2));
    let differing = Telemetry { reference_difference_percent: Some(0.25), ..EMPTY_TELEMETRY };
    assert_eq!(measure(&expectation_for(Metric::ReferenceDifference), &trace, &differing), Measure::Value(0.25));
    let differing = Telemetry { protocol_differences: Some(vec!["one".to_owned()]), ..EMPTY_TELEMETRY };
    assert_eq!(measure(&expectation_for(Metric::ProtocolDifferences), &trace, &differing), Measure::Value(1.0));
    let disabled = |was_high, low_from_s| {
        let enable_pin = Some(EnablePin { was_high, low_from_s });
        measure(&expectation_with_from(Metric::EnableOff, 1.5), &trace, &Telemetry { enable_pin, ..EMPTY_TELEMETRY })
    };
    assert_eq!(disabled(true, Some(0.004)), Measure::Value(2.5));
    assert_eq!(disabled(true, Some(0.0015)), Measure::Value(0.0));
    assert_eq!(disabled(true, Some(0.001_499)), Measure::Missing(MissingValue::StoppedBefore));
    assert_eq!(disabled(true, None), Measure::Missing(MissingValue::StaysEnabled));
    assert_eq!(disabled(false, Some(0.004)), Measure::Missing(MissingValue::NeverEnabled));
    for unreported in [
        Metric::LoopDelay,
        Metric::InstructionsPerStep,
        Metric::StepTime,
        Metric::ReferenceDifference,
        Metric::ProtocolDifferences,
    ] {
        assert!(matches!(measure_of(unreported, &trace), Measure::Undefined(_)));
    }
}

/// The firmware writes "boot", "ready" in two parts from 1 to 3 ms, and "ready" from 4 to 5 ms.
#[rstest]
#[case::start("boot", [0.0, 9.0], Measure::Value(0.0))]
#[case::start_is_no_answer_to_a_later_fault("boot", [0.5, 9.0], Measure::Missing(MissingValue::NoText))]
#[case::interval("ready", [0.5, 9.0], Measure::Interval([1.5, 2.5]))]
#[case::first_part("rea", [0.5, 9.0], Measure::Interval([0.5, 1.5]))]
#[case::written_before_the_end_of_its_part("ready", [2.5, 9.0], Measure::Interval([0.0, 0.5]))]
#[case::next_after_the_read("ready", [3.0, 9.0], Measure::Interval([1.0, 2.0]))]
#[case::within_the_window("ready", [3.0, 4.000_001], Measure::Interval([1.0, 2.0]))]
#[case::after_the_window("ready", [3.0, 4.0], Measure::Missing(MissingValue::NoText))]
#[case::never("steady", [0.0, 9.0], Measure::Missing(MissingValue::NoText))]
#[case::remark_of_the_bench("cut", [0.0, 9.0], Measure::Undefined(UndefinedValue::CutText))]
fn finds_a_text_of_the_firmware(#[case] text: &str, #[case] window_ms: [f64; 2], #[case] expected: Measure) {
    let trace = trace_at([0.0, 9.0], |_| 2.0, |_| 2.0);
    let read = |end, from_s, to_s| OutputRead { end, from_s, to_s };
    let reads = vec![read(4, 0.0, 0.0), read(7, 0.001, 0.002), read(9, 0.002, 0.003), read(14, 0.004, 0.005)];
    let end = if text == "cut" { " (cut)" } else { "" };
    let telemetry = Telemetry {
        firmware_output: Some(format!("bootreadyready{end}")),
        firmware_output_reads: Some(reads),
        ..EMPTY_TELEMETRY
    };
    let text = text.to_owned();
    let expectation = Expectation { text, ..expectation_in(Metric::Text, &[window_ms]) };
    assert_eq!(measure(&expectation, &trace, &telemetry), expected);
    assert_eq!(measure(&expectation, &trace, &EMPTY_TELEMETRY), Measure::Undefined(UndefinedValue::NotReported));
}

#[rstest]
#[case(Metric::SettlingTime, &[[0.0, END_MS]], 0, &[(5.0, 2.2)])]
#[case(Metric::RecoveryTime, &[[4.5, END_MS], [1.5, 4.5]], 1, &[(3.0, 1.5)])]
#[case(Metric::Overshoot, &[[0.0, END_MS]], 0, &[(2.0, 2.6)])]
#[case(Metric::PeakDeviation, &[[4.0, END_MS], [2.0, 4.0]], 1, &[(2.0, 2.6)])]
#[case(Metric::StaticError, &[[3.0, 6.0]], 0, &[(6.0, 5.95 / 3.0)])]
#[case(Metric::Ripple, &[[3.0, 6.0]], 0, &[(5.0, 2.2), (3.0, 1.5)])]
#[case(Metric::RipplePercent, &[[3.0, 6.0]], 0, &[(5.0, 2.2), (3.0, 1.5)])]
#[case(Metric::FinalAmplitude, &[[0.0, 5.5]], 0, &[(5.0, 2.2)])]
#[case(Metric::FrequencyError, &[[0.0, END_MS]], 0, &[(6.0, 32_300.0)])]
#[case(Metric::DrivePeak, &[[4.5, END_MS]], 0, &[(4.5, 300.0)])]
#[case(Metric::Overruns, &[[0.0, END_MS]], 0, &[])]
fn the_worst_window_has_its_instants(
    #[case] metric: Metric,
    #[case] windows: &[[f64; 2]],
    #[case] worst: usize,
    #[case] points: &[(f64, f64)],
) {
    let amplitudes = [0.0, 0.0, 2.6, 1.5, 2.0, 2.2, 2.0];
    let levels = [0.0, 2.0, 2.0, 2.0, 2.0, 2.0, 2.0];
    let mut trace = trace_at(grid(1.0, 6.0), |t| levels[t as usize], |t| amplitudes[t as usize]);
    trace[4].drive_vpp = 300.0;
    trace[6].frequency_hz = 32_300.0;
    let (measure, instants) = measure_with_instants(&expectation_in(metric, windows), 3, &trace, &EMPTY_TELEMETRY);
    assert!(matches!(measure, Measure::Value(_)), "{measure:?}");
    let instants = instants.unwrap();
    assert_eq!((instants.trial, instants.window_ms), (3, windows[worst]));
    let found: Vec<_> = instants.points.iter().map(|point| (point.t_ms, point.value)).collect();
    assert_eq!(found.len(), points.len(), "{found:?}");
    for (found, expected) in found.iter().zip(points) {
        assert_eq!(found.0, expected.0);
        assert_close(found.1, expected.1, 1e-12);
    }
}

#[test]
fn a_missing_value_has_its_instant_too() {
    let trace = rows(&[(0.0, 2.0, 0.0), (1.0, 2.0, 1.5), (2.0, 2.0, f64::NAN)]);
    let settling = expectation_for(Metric::SettlingTime);
    let (measure, instants) = measure_with_instants(&settling, 0, &trace[..2], &EMPTY_TELEMETRY);
    assert_eq!(measure, Measure::Missing(MissingValue::NeverSettles));
    assert_eq!(instants.unwrap().points[0].value, 1.5);
    let (_, instants) = measure_with_instants(&settling, 0, &trace, &EMPTY_TELEMETRY);
    assert_eq!(instants.unwrap().points, [], "JSON has no NaN");
}
