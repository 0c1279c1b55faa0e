use super::*;

fn set_saturated(mut rows: Vec<Row>) -> Vec<Row> {
    rows[0].flags |= Flags::SATURATED;
    rows
}

#[test]
fn a_stop_at_the_limit_fails_a_feasible_demand() {
    for expect in ["metric = \"settling_time_ms\", at_most = 3.0", "metric = \"static_error_percent\", at_most = 1.0"] {
        let scenario = fixed_scenario(expect);
        let mut rows = set_saturated(trace_rows(&scenario, |_| 2.0));
        rows.last_mut().unwrap().flags = Flags::SAFE;
        assert_eq!(judge_rows(&scenario, &rows), FAIL, "{expect}");
    }
}

fn fastest_envelope(limit_vpp: f64) -> impl Fn(f64) -> f64 {
    move |t| (0.006_98 * limit_vpp * (1.0 - (-t / 1.88).exp())).min(2.0)
}

#[test]
fn two_newtons_at_400_vpp_cannot_be_held() {
    let expect = ["metric = \"static_error_percent\", at_most = 1.0", "metric = \"overshoot_percent\", at_most = 1.0"];
    let scenario = ScenarioBuilder { expect: &expect, limit_vpp: 400.0, force: "2.0", ..BASE }.scenario();
    let low = trace_rows(&scenario, |_| 1.19);
    assert_eq!(judge_rows(&scenario, &low), FAIL, "never saturated: the controller failed");
    let record =
        judge_single_expectation(&scenario, &[measure(&scenario, 0, &set_saturated(low), &Telemetry::default())]);
    assert_eq!((record.verdict, record.cause), inconclusive(Cause::Infeasible));
    let reason = record.reason.unwrap().to_string();
    assert!(reason.contains("needs 669 Vpp, the amplifier gives 400 Vpp"), "{reason}");
    let above = judge(
        &scenario,
        &[measure(&scenario, 0, &set_saturated(trace_rows(&scenario, |_| 2.5)), &Telemetry::default())],
    );
    assert_eq!(above.expectations[1].verdict, Verdict::Fail, "too little drive does not excuse an overshoot");
    let feasible = ScenarioBuilder { expect: &expect, limit_vpp: 700.0, force: "2.0", ..BASE }.scenario();
    assert_eq!(
        judge_rows(&feasible, &set_saturated(trace_rows(&feasible, |_| 1.19))),
        FAIL,
        "with 700 Vpp it can be held"
    );
}

#[test]
fn demands_what_the_drive_can_just_reach() {
    // With a force of 2 N, 2 µm need 668.6 Vpp. 660 Vpp reach 1.974 µm, which is 1.28 % too low.
    for (at_most, expected) in [(1.4, FAIL), (1.2, inconclusive(Cause::Infeasible))] {
        let expect = format!("metric = \"static_error_percent\", at_most = {at_most:?}");
        let scenario = ScenarioBuilder { expect: &[&expect], limit_vpp: 660.0, force: "2.0", ..BASE }.scenario();
        assert_eq!(judge_rows(&scenario, &set_saturated(trace_rows(&scenario, |_| 1.6))), expected, "{at_most}");
    }
}

#[test]
fn settling_below_2_14_ms_is_infeasible_at_400_vpp() {
    // Time to 95 % of 2 µm at full drive: −τ ln(1 − 0.95 · 2/(K1 · 400)) = 2.145 ms
    let floor = -1.88 * (1.0 - 1.9 / (0.006_98 * 400.0_f64)).ln();
    assert!((floor - 2.145).abs() < 1e-3, "{floor}");
    for (at_most, late, expected) in [
        (floor + 1e-5, 3.0, FAIL),
        (floor - 1e-5, 3.0, inconclusive(Cause::Infeasible)),
        (floor + 1e-2, 0.0, PASS),
        (2.0, 0.0, inconclusive(Cause::Infeasible)),
    ] {
        let expect = format!("metric = \"settling_time_ms\", at_most = {at_most:?}");
        let scenario = ScenarioBuilder { expect: &[&expect], limit_vpp: 400.0, ..BASE }.scenario();
        let rows = trace_rows(&scenario, |t| fastest_envelope(400.0)((t - late).max(0.0)));
        assert_eq!(judge_rows(&scenario, &set_saturated(rows.clone())), expected, "{at_most} ms");
        assert_eq!(
            judge_rows(&scenario, &rows),
            if expected == PASS { PASS } else { FAIL },
            "{at_most} ms, never saturated"
        );
    }
}

#[test]
fn a_later_step_has_its_own_floor() {
    let setpoint = "{ hold = [[0.0, 1.0], [30.0, 2.0]] }";
    // From 1 µm to 1.9 µm: −τ ln((S − 1.9)/(S − 1)). Full drive gives S = 2.792 µm.
    let floor = -1.88 * ((2.792_f64 - 1.9) / (2.792 - 1.0)).ln();
    for (at_most, expected) in [(floor + 1e-5, FAIL), (floor - 1e-5, inconclusive(Cause::Infeasible))] {
        let expect = format!("metric = \"settling_time_ms\", from_ms = 30.0, at_most = {at_most:?}");
        let scenario = ScenarioBuilder { expect: &[&expect], limit_vpp: 400.0, setpoint, ..BASE }.scenario();
        let rows = trace_rows(&scenario, |t| if t < 40.0 { 1.0 } else { 2.0 });
        assert_eq!(judge_rows(&scenario, &set_saturated(rows)), expected, "{at_most} ms");
    }
}

#[test]
fn a_fall_faster_than_the_decay_is_infeasible() {
    let setpoint = "{ hold = [[0.0, 2.0], [30.0, 1.0]] }";
    let floor = 1.88 * (2.0_f64 / 1.05).ln();
    for (at_most, expected) in [(floor + 1e-5, FAIL), (floor - 1e-5, inconclusive(Cause::Infeasible))] {
        let expect = format!("metric = \"settling_time_ms\", from_ms = 30.0, at_most = {at_most:?}");
        let scenario = ScenarioBuilder { expect: &[&expect], setpoint, ..BASE }.scenario();
        let driven = trace_rows(&scenario, |t| if t < 35.0 { 2.0 } else { 1.0 });
        assert_eq!(judge_rows(&scenario, &driven), FAIL, "the drive was on: the controller failed");
        let mut rested = driven.clone();
        for row in rested.iter_mut().filter(|row| row.t_s >= 0.03) {
            row.drive_vpp = 0.0;
        }
        assert_eq!(judge_rows(&scenario, &rested), expected, "{at_most} ms");
    }
}

#[test]
fn only_too_little_amplitude_is_excused() {
    let build = |expect: &str| ScenarioBuilder { expect: &[expect], limit_vpp: 400.0, force: "2.0", ..BASE }.scenario();
    for expect in [
        "metric = \"overshoot_percent\", at_most = 1.0",
        "metric = \"frequency_error_hz\", at_most = 1.0",
        "metric = \"drive_peak_vpp\", at_most = 1.0",
        "metric = \"saturated_percent\", at_most = 0.01",
        "metric = \"final_amplitude_um\", at_most = 1.1",
    ] {
        let scenario = build(expect);
        let mut rows = set_saturated(trace_rows(&scenario, |t| if t < 30.0 { 2.5 } else { 1.19 }));
        rows.last_mut().unwrap().frequency_hz = 9.0;
        assert_eq!(judge_rows(&scenario, &rows), FAIL, "{expect}");
    }
    for expect in [
        "metric = \"final_amplitude_um\", at_least = 1.9",
        "metric = \"peak_deviation_percent\", at_most = 10.0, from_ms = 30.0",
        "metric = \"recovery_time_ms\", at_most = 10.0, from_ms = 30.0",
        "metric = \"settling_time_ms\", at_most = 10.0",
    ] {
        let scenario = build(expect);
        assert_eq!(
            judge_rows(&scenario, &set_saturated(trace_rows(&scenario, |_| 1.19))),
            inconclusive(Cause::Infeasible),
            "{expect}"
        );
    }
}

#[test]
fn an_excused_trial_does_not_excuse_another() {
    let each = varied_scenario("metric = \"settling_time_ms\", at_most = 2.0", 2);
    let excused = |values: &[f64], which: &[usize]| {
        let mut trials = trials_with_values(values);
        for index in which {
            trials[*index].excuses = vec![Some(TOO_WEAK)];
        }
        trials
    };
    assert_eq!(verdict_and_cause(&each, &excused(&[9.0, 1.0], &[0])), inconclusive(Cause::Infeasible));
    assert_eq!(
        verdict_and_cause(&each, &excused(&[9.0, 3.0], &[0])),
        FAIL,
        "the worst is excused, the other one is not"
    );
    assert_eq!(verdict_and_cause(&each, &excused(&[1.0, 1.0], &[0])), PASS);
    let mean = varied_scenario("metric = \"static_error_percent\", at_most = 1.0", 4);
    assert_eq!(verdict_and_cause(&mean, &excused(&[9.0, 9.1, 9.2, 9.3], &[0])), FAIL);
    assert_eq!(
        verdict_and_cause(&mean, &excused(&[9.0, 9.1, 9.2, 9.3], &[0, 1, 2, 3])),
        inconclusive(Cause::Infeasible)
    );
    assert_eq!(verdict_and_cause(&mean, &excused(&[9.0, 9.1, 0.1, 0.2], &[0, 1])), inconclusive(Cause::Evidence));
}

#[test]
fn a_feasible_demand_has_no_excuse_on_any_plate() {
    let scenario = varied_scenario("metric = \"static_error_percent\", at_most = 1.0", 2);
    let rows = set_saturated(trace_rows(&scenario, |_| 1.5));
    let trials: Vec<_> = (0..2).map(|index| measure(&scenario, index, &rows, &Telemetry::default())).collect();
    assert_eq!(trials.iter().map(|trial| trial.seed).collect::<Vec<_>>(), [1, 2]);
    assert!(trials.iter().all(|trial| trial.excuses == [None]));
}
