//! Tests peaks of the motion between two rows of the trace.

use crate::fixtures::{LOCKSTEP, plan, run_hosted};
use platebench_model::record::{Telemetry, Verdict};
use platebench_model::trace::read_trace;
use platebench_test_kit::{PLATE, write_scenario};
use platebench_verdict::metrics::measure;
use platebench_verdict::rows_with_extremes;
use rstest::rstest;

/// With this delay and a row per 0.05 ms, the overshoot of the rows is 4.876 %. The ripple of the
/// fast pole takes the exact one to 4.99 %.
const DELAY_MS: f64 = 0.1846;
/// With this delay, the exact overshoot is above 5 % and that of the regular rows 4.89 %.
const LONGER_DELAY_MS: f64 = 0.1848;

/// Plays a step to 2 µm. Returns value and verdict of the first expectation, and its value with the
/// extremes between the rows.
fn judge_with_extremes(delay_ms: f64, trace_step_ms: f64, expect: &str, plate: &str) -> (f64, Verdict, f64) {
    let text = format!(
        "title = \"step\"\nplate = \"plate.toml\"\nduration_ms = 12.0\ntrace_step_ms = {trace_step_ms}\n\
         expect = [{expect}]\n[controller]\nlaw = \"dq-pi\"\nloop_delay_ms = {delay_ms}\n\
         [profile]\nsetpoint_um = {{ hold = [[0.0, 0.0], [1.0, 2.0]] }}\n"
    );
    let folder = tempfile::tempdir().unwrap();
    let scenario = write_scenario(folder.path(), &text, plate);
    let out = folder.path().join("run");
    let record = run_hosted(&plan(vec![scenario.clone()], LOCKSTEP), &out);
    let expectation = &record.scenarios[0].expectations[0];
    let trace = std::fs::read_dir(out.join("traces")).unwrap().next().unwrap().unwrap().path();
    let rows = read_trace(&trace.join("000.csv")).unwrap();
    let exact = rows_with_extremes(&scenario, 0, &scenario.expectations[0], &rows).unwrap();
    let exact = measure(&scenario.expectations[0], &exact, &Telemetry::default()).value().unwrap();
    (expectation.value.unwrap(), expectation.verdict, exact)
}

fn judge(delay_ms: f64, trace_step_ms: f64, expect: &str) -> (f64, Verdict) {
    let (value, verdict, _) = judge_with_extremes(delay_ms, trace_step_ms, expect, PLATE);
    (value, verdict)
}

/// Rows every 0.5 µs of the same motion contain 31 points per period of the ripple: their largest
/// value is below the exact one by at most 1 % of the ripple.
#[rstest]
fn the_extreme_between_two_rows_is_that_of_dense_rows(
    #[values("overshoot_percent", "peak_deviation_percent")] metric: &str,
    #[values(0.0, 0.1846, 0.4)] delay_ms: f64,
    #[values("1.88", "0.4", "6.0")] time_constant_ms: &str,
    #[values(0.05, 0.2)] trace_step_ms: f64,
) {
    let plate = PLATE.replace("time_constant_ms = 1.88", &format!("time_constant_ms = {time_constant_ms}"));
    let expect = expectation(metric, 1e3);
    let (rows, _, exact) = judge_with_extremes(delay_ms, trace_step_ms, &expect, &plate);
    let (dense, _, exact_of_dense) = judge_with_extremes(delay_ms, 0.000_5, &expect, &plate);
    println!("{metric}, {delay_ms} ms, τ {time_constant_ms} ms: rows {rows}, exact {exact}, dense {dense} %");
    assert!(rows <= exact && dense <= exact + 1e-9, "{rows} {dense} {exact}");
    assert!(exact - dense < 0.02 * (exact - rows) + 1e-4, "{rows} {dense} {exact}");
    assert!((exact - exact_of_dense).abs() < 1e-7, "{exact} {exact_of_dense}");
}

fn expectation(metric: &str, at_most: f64) -> String {
    let window = if metric == "overshoot_percent" { "" } else { ", from_ms = 3.0" };
    format!("{{ metric = \"{metric}\", at_most = {at_most}{window} }}")
}

#[rstest]
fn a_peak_above_its_limit_between_two_rows_fails(
    #[values("overshoot_percent", "peak_deviation_percent")] metric: &str,
    #[values(4.9, 4.95, 4.98)] at_most: f64,
) {
    let (rows, verdict) = judge(DELAY_MS, 0.05, &expectation(metric, 6.0));
    assert!(rows < 4.88 && verdict == Verdict::Pass, "{rows}");
    let (exact, _) = judge(DELAY_MS, 0.001, &expectation(metric, 6.0));
    assert!(exact > 4.985, "{exact}");
    let (value, verdict) = judge(DELAY_MS, 0.05, &expectation(metric, at_most));
    assert_eq!(verdict, Verdict::Fail, "{value}");
    assert!(at_most < value && value <= exact + 1e-6, "{value} of {exact}");
}

#[test]
fn a_row_at_the_edge_of_a_band_belongs_to_the_exact_motion() {
    let overshoot = expectation("overshoot_percent", 30.0);
    let with_band = format!("{overshoot}, {{ metric = \"settling_time_ms\", at_most = 10.0 }}");
    let (regular, _) = judge(LONGER_DELAY_MS, 0.05, &overshoot);
    let (reported, _) = judge(LONGER_DELAY_MS, 0.05, &with_band);
    let (exact, _) = judge(LONGER_DELAY_MS, 0.001, &overshoot);
    println!("{regular} % at the regular rows, {reported} % with the rows at the edge, exact {exact} %");
    assert!(regular < 4.9, "{regular}");
    assert!((5.0..5.0001).contains(&reported) && reported <= exact + 1e-6, "{reported} of {exact}");
}
