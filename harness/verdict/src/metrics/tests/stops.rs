use super::*;
use platebench_model::record::StepTime;

#[test]
fn a_stopped_controller_has_no_values() {
    let mut trace = trace_at(grid(0.05, 60.0), |_| 2.0, |_| 2.0);
    trace[3].flags = Flags::SAFE;
    let reported = Telemetry {
        loop_delay_us: Some(0.0),
        instructions_worst: Some(900.0),
        step_time: Some(StepTime { longest_percent: 5.0, ..StepTime::default() }),
        reference_difference_percent: Some(0.0),
        protocol_differences: Some(Vec::new()),
        ..EMPTY_TELEMETRY
    };
    let of_the_line = [Metric::ShutdownTime, Metric::MissedReplies, Metric::EnableOff, Metric::Text];
    let others = || Metric::ALL.iter().copied().filter(|metric| !of_the_line.contains(metric));
    for metric in others().filter(|metric| *metric != Metric::QuadratureRatio) {
        let measure = measure(&expectation_with_from(metric, 0.0), &trace, &reported);
        let has_value = measure.value().is_some() || matches!(measure, Measure::Samples(_));
        assert!(has_value, "{metric} of a controller that started late");
    }
    trace.last_mut().unwrap().flags = Flags::SAFE;
    for metric in others() {
        assert_eq!(
            measure(&expectation_with_from(metric, 0.0), &trace, &reported),
            Measure::Missing(MissingValue::NotRunning),
            "{metric}"
        );
    }
}

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
fn shutdown_time_ends_at_the_lasting_stop() {
    let time = |to_ms: f64, rows: &[Row]| measured_value(&shutdown_expectation(to_ms), rows);
    assert_close(time(60.0, &rows_with_stop(|t| t >= 44)), 4.0, 1e-9);
    assert_close(time(60.0, &rows_with_stop(|t| t >= 40)), 0.0, 1e-9);
    assert_close(time(60.0, &rows_with_stop(|t| t == 42 || t >= 44)), 4.0, 1e-9);
    assert_close(time(60.0, &rows_with_stop(|t| t >= 60)), 20.0, 1e-9);
    let resumed = rows_with_stop(|t| (44..50).contains(&t));
    assert_close(time(50.0, &resumed), 4.0, 1e-9);
    assert_eq!(measured(&shutdown_expectation(51.0), &resumed), Measure::Missing(MissingValue::NotAtRest));
}

#[test]
fn other_stops_have_no_shutdown_time() {
    let missing = |rows: &[Row], telemetry: &Telemetry| match measure(&shutdown_expectation(60.0), rows, telemetry) {
        Measure::Missing(what) => what,
        other => panic!("{other:?}"),
    };
    assert_eq!(missing(&rows_with_stop(|_| false), &EMPTY_TELEMETRY), MissingValue::NotAtRest);
    assert_eq!(missing(&rows_with_stop(|_| true), &EMPTY_TELEMETRY), MissingValue::NeverRan);
    assert_eq!(missing(&rows_with_stop(|t| t >= 39), &EMPTY_TELEMETRY), MissingValue::StoppedBefore);
    let stopped = rows_with_stop(|t| t >= 44);
    // A running controller at 0 V has not stopped, and a stopped controller must not drive.
    let with = |change: fn(&mut Row)| {
        let mut rows = stopped.clone();
        rows.iter_mut().for_each(change);
        rows
    };
    assert_eq!(missing(&with(|row| row.flags = Flags::empty()), &EMPTY_TELEMETRY), MissingValue::NotAtRest);
    assert_eq!(missing(&with(|row| row.drive_vpp = 1.0), &EMPTY_TELEMETRY), MissingValue::NotAtRest);
    let idle = stopped.iter().map(|row| Row { drive_vpp: 0.0, ..*row }).collect::<Vec<_>>();
    assert_eq!(missing(&idle, &EMPTY_TELEMETRY), MissingValue::NeverDrove);
    let without_setpoint = idle.iter().map(|row| Row { setpoint_um: 0.0, ..*row }).collect::<Vec<_>>();
    assert!(matches!(measured(&shutdown_expectation(60.0), &without_setpoint), Measure::Value(_)));
    let trapped = Telemetry { ended: Some("trapped".to_owned()), ..EMPTY_TELEMETRY };
    assert_eq!(missing(&stopped, &trapped), MissingValue::NotRunning);
}

#[test]
fn control_instants_without_an_answer_are_missed_replies() {
    let mut rows = rows_with_stop(|t| t >= 44);
    assert_eq!(value_of(Metric::MissedReplies, &rows), 0.0);
    rows[3].flags |= Flags::LINK_LOST;
    rows[5].flags |= Flags::LINK_LOST;
    rows[5].flags -= Flags::CONTROL;
    assert_eq!(value_of(Metric::MissedReplies, &rows), 1.0);
}

fn as_real_plate(rows: &[Row]) -> Vec<Row> {
    let reported = |row: &Row| Row {
        sensed_wd_um: row.wd_um,
        resonance_hz: f64::NAN,
        temperature_offset_k: f64::NAN,
        finger_force_n: f64::NAN,
        flags: row.flags | Flags::CONTROL | Flags::SENSED,
        ..*row
    };
    rows.iter().map(reported).collect()
}

#[test]
fn a_time_of_a_real_plate_is_an_interval() {
    let step = |t: f64| if t < 1.0 { 0.0 } else { 2.0 };
    // The step is at 1 ms, and the sample at 3 ms is the first one inside the band.
    let rows = as_real_plate(&trace_at(grid(1.0, 60.0), step, |t| if t < 3.0 { 0.0 } else { 1.95 }));
    let measured = measure_of(Metric::SettlingTime, &rows);
    assert_eq!(measured, Measure::Interval([1.0, 2.0]));
    // Time stamps in µs far from zero have differences with rounding errors.
    let late: Vec<Row> = rows.iter().map(|row| Row { t_s: (row.t_s * 1e6 + 43_000.0) / 1e6, ..*row }).collect();
    assert_eq!(measure_of(Metric::SettlingTime, &late), Measure::Interval([1.0, 2.0]));
}

#[test]
fn unknown_quantities_of_a_real_plate_are_undefined() {
    let rows = as_real_plate(&trace_at(grid(1.0, 60.0), |_| 2.0, |_| 2.0));
    for &metric in Metric::ALL {
        let unknown = matches!(measure_of(metric, &rows), Measure::Undefined(_));
        let expected = matches!(
            metric,
            Metric::FrequencyError
                | Metric::RecoveryTime
                | Metric::Overruns
                | Metric::MissedReplies
                | Metric::EnableOff
                | Metric::Text
                | Metric::LoopDelay
                | Metric::InstructionsPerStep
                | Metric::StepTime
                | Metric::ReferenceDifference
                | Metric::ProtocolDifferences
                | Metric::QuadratureRatio
        );
        assert_eq!(unknown, expected, "{metric}");
    }
}

#[test]
fn a_non_finite_drive_has_no_values() {
    let settled = trace_at([0.0, 1.0, 60.0], |_| 2.0, |t| if t < 1.0 { 0.0 } else { 2.0 });
    let not_a_number = Telemetry { not_finite: Some(NonFiniteDrive { at_s: 0.01, count: 1 }), ..EMPTY_TELEMETRY };
    for metric in [Metric::SettlingTime, Metric::Overshoot, Metric::DrivePeak, Metric::FinalAmplitude] {
        assert!(matches!(measure_of(metric, &settled), Measure::Value(_)), "{metric}");
        assert!(matches!(measure(&expectation_for(metric), &settled, &not_a_number), Measure::Missing(_)), "{metric}");
    }
    let shut = rows_with_stop(|t| t >= 44);
    assert!(matches!(measured(&shutdown_expectation(60.0), &shut), Measure::Value(_)));
    assert!(
        matches!(measure(&shutdown_expectation(60.0), &shut, &not_a_number), Measure::Missing(_)),
        "the bench applied its 0 V"
    );
    let missed = measure(&expectation_for(Metric::MissedReplies), &settled, &not_a_number);
    assert_eq!(
        missed,
        Measure::Missing(MissingValue::NonFiniteDrive),
        "a controller without finite drive may not pass"
    );
    let never = trace_at([0.0, 1.0, 60.0], |_| 2.0, |_| 0.0);
    assert_eq!(
        measure(&expectation_for(Metric::SettlingTime), &never, &not_a_number),
        Measure::Missing(MissingValue::NeverSettles)
    );
}
