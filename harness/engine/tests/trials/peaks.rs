//! Tests peaks of the motion between two rows of the trace.

use crate::fixtures::{LOCKSTEP, plan, run_hosted};
use platebench_model::record::{Telemetry, Verdict};
use platebench_model::trace::read_trace;
use platebench_test_kit::{PLATE, write_scenario};
use platebench_verdict::missed_between_rows;
use rstest::rstest;

/// With this delay and a row per 0.05 ms, the overshoot of the rows is 4.876 %. The ripple of the
/// fast pole takes the exact one to 4.99 %.
const DELAY_MS: f64 = 0.1846;
/// With this delay, the exact overshoot is above 5 % and that of the regular rows 4.89 %.
const LONGER_DELAY_MS: f64 = 0.1848;

/// Plays a step to 2 µm. Returns value and verdict of the first expectation, and its value with the
/// extremes between the rows.
fn judge_with_extremes(delay_ms: f64, trace_step_ms: f64, expect: &str, plate: &str) -> (f64, Verdict, f64) {
    judge_law("dq-pi", "", delay_ms, trace_step_ms, expect, plate)
}

fn judge_law(
    law: &str,
    profile: &str,
    delay_ms: f64,
    trace_step_ms: f64,
    expect: &str,
    plate: &str,
) -> (f64, Verdict, f64) {
    let (model, law) = law.split_once(", ").unwrap_or(("auto", law));
    let text = format!(
        "title = \"step\"\nplate = \"plate.toml\"\nduration_ms = 12.0\ntrace_step_ms = {trace_step_ms}\n\
         model = \"{model}\"\nexpect = [{expect}]\n[controller]\nlaw = \"{law}\"\nloop_delay_ms = {delay_ms}\n\
         [profile]\nsetpoint_um = {{ hold = [[0.0, 0.0], [1.0, 2.0]] }}\n{profile}"
    );
    let folder = tempfile::tempdir().unwrap();
    let scenario = write_scenario(folder.path(), &text, plate);
    let out = folder.path().join("run");
    let record = run_hosted(&plan(vec![scenario.clone()], LOCKSTEP), &out);
    let expectation = &record.scenarios[0].expectations[0];
    let trace = std::fs::read_dir(out.join("traces")).unwrap().next().unwrap().unwrap().path();
    let rows = read_trace(&trace.join("000.csv")).unwrap();
    let value = expectation.value.unwrap();
    let missed = missed_between_rows(&scenario, 0, &scenario.expectations[0], &rows, &Telemetry::default(), value);
    (value, expectation.verdict, value + missed.unwrap())
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

const SECOND_MODE: &str = "[second_mode]\nresonance_hz = 32607.6\ntime_constant_ms = 1.2\ngain_um_per_vpp = -0.002\n";
const DISTANT_MODE: &str = "[second_mode]\nresonance_hz = 61e3\ntime_constant_ms = 3.0\ngain_um_per_vpp = 0.003\n";
const HEATING: &str = "[heating]\nrise_k_per_um2 = 4.0\ntime_constant_s = 0.03\n";
const RAMP: &str = "finger_force_n = { linear = [[1.0, 0.0], [5.0, 1.0]] }\n";

/// Dense rows have 31 points per period of the ripple, as above. They cut the steps of moving modes,
/// which changes W by up to 3e-7 of the largest amplitude.
#[rstest]
#[case::second_mode("", SECOND_MODE, "")]
#[case::distant_mode("", DISTANT_MODE, "")]
#[case::bandwidth("bandwidth_hz = 3e3", "", "")]
#[case::slew_rate_and_offset("slew_rate_vpp_per_ms = 900.0\noffset_vpp = 5.0", "", "")]
#[case::dead_time("dead_time_us = 120.0", SECOND_MODE, "")]
#[case::converter("converter_bits = 8\nconverter_range_vpp = 900.0", "", "")]
#[case::heating("", HEATING, "")]
#[case::heating_and_finger("bandwidth_hz = 2e4", HEATING, RAMP)]
#[case::finger("", "", RAMP)]
fn extremes_with_effects_are_those_of_dense_rows(
    #[case] drive: &str,
    #[case] tables: &str,
    #[case] profile: &str,
    #[values("overshoot_percent", "peak_deviation_percent")] metric: &str,
    #[values("dq-pi", "deadbeat")] law: &str,
) {
    let plate = PLATE.replace("[sensor]", &format!("{drive}\n{tables}[sensor]"));
    let expect = expectation(metric, 1e3);
    let (rows, _, exact) = judge_law(law, profile, 0.1846, 0.05, &expect, &plate);
    let (dense, _, _) = judge_law(law, profile, 0.1846, 0.000_5, &expect, &plate);
    println!("{law}, {metric}, {drive}{tables}{profile}: rows {rows}, exact {exact}, dense {dense} %");
    assert!(rows <= exact && dense <= exact + 1e-4, "{rows} {dense} {exact}");
    assert!(exact - dense < 0.02 * (exact - rows) + 1e-4, "{rows} {dense} {exact}");
}

#[test]
fn extremes_of_the_linear_model_are_those_of_dense_rows() {
    let expect = expectation("overshoot_percent", 1e3);
    let [(rows, _, exact), (dense, ..)] =
        [0.05, 0.000_5].map(|step| judge_law("linear, dq-pi", "", 0.4, step, &expect, PLATE));
    println!("linear: rows {rows}, exact {exact}, dense {dense} %");
    assert!(rows <= exact && (exact - dense).abs() < 1e-4, "{rows} {dense} {exact}");
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
