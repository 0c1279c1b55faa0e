use super::*;
use platebench_model::record::NonFiniteDrive;
use platebench_model::scenario::{Limit, Metric};
use platebench_plate::Time;
use rstest::rstest;
use std::collections::BTreeMap;

mod step_response;
mod stops;
mod windows;

const EMPTY_TELEMETRY: Telemetry = Telemetry {
    transport: None,
    baud: None,
    enable_pin: None,
    timing: None,
    real_plate: None,
    loop_delay_us: None,
    rig_delay_us: None,
    instructions_mean: None,
    instructions_worst: None,
    step_time: None,
    reference_difference_percent: None,
    protocol_differences: None,
    protocol_repeats: 0,
    scripts_not_played: Vec::new(),
    scripts_not_decided: Vec::new(),
    ended: None,
    end_cause: None,
    ended_by_controller: false,
    stopped: None,
    firmware_output: None,
    firmware_output_reads: None,
    defmt_bytes: None,
    defmt_frames: None,
    unmodelled_instances: Vec::new(),
    unused_fpu: false,
    faults: BTreeMap::new(),
    not_finite: None,
    watchdog_timeout_ms: None,
    violations: Vec::new(),
};

fn ms(value: f64) -> Time {
    Time::from_ms(value).unwrap()
}

const END_MS: f64 = 1e6;

fn window([from, to]: [f64; 2]) -> Window {
    Window { from: ms(from), to: ms(to) }
}

fn expectation_in(metric: Metric, windows: &[[f64; 2]]) -> Expectation {
    Expectation { windows: windows.iter().copied().map(window).collect(), ..expectation_for(metric) }
}

fn expectation_for(metric: Metric) -> Expectation {
    let judged = window(if metric.has_window_ms() { [40.0, 60.0] } else { [0.0, END_MS] });
    Expectation { limit: Limit::AtMost(2.0), tolerance_percent: 5.0, ..Expectation::for_window(metric, judged) }
}

fn expectation_with_from(metric: Metric, from_ms: f64) -> Expectation {
    expectation_in(metric, &[[from_ms, END_MS]])
}

fn rows(points: &[(f64, f64, f64)]) -> Vec<Row> {
    let row = |&(t_ms, setpoint_um, amplitude_um)| Row {
        t_s: ms(t_ms).seconds(),
        setpoint_um,
        amplitude_um,
        ..Row::default()
    };
    points.iter().map(row).collect()
}

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

fn measured(expectation: &Expectation, rows: &[Row]) -> Measure {
    measure(expectation, rows, &EMPTY_TELEMETRY)
}

fn measure_of(metric: Metric, rows: &[Row]) -> Measure {
    measured(&expectation_for(metric), rows)
}

fn value_of(metric: Metric, rows: &[Row]) -> f64 {
    measured_value(&expectation_for(metric), rows)
}

fn measured_value(expectation: &Expectation, rows: &[Row]) -> f64 {
    let measured = measured(expectation, rows);
    measured.value().unwrap_or_else(|| panic!("{measured:?}"))
}

#[track_caller]
fn assert_close(measured: f64, expected: f64, tolerance: f64) {
    assert!((measured - expected).abs() <= tolerance, "{measured}, expected {expected}");
}
