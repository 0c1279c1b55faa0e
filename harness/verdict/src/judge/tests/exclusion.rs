use super::*;

#[test]
fn an_excluded_trial_prevents_a_pass_but_no_failure() {
    let scenario = varied_scenario("metric = \"settling_time_ms\", at_most = 2.0", 3);
    for exclusion in [Exclusion::NoAnswer { at_ms: 3.0 }, Exclusion::LateBench { count: 1, first_ms: 3.0 }] {
        let cause = exclusion.cause();
        let verdict_with = |values: &[f64]| {
            let mut trials = trials_with_values(values);
            trials[1].exclusion = Some(exclusion.clone());
            verdict_and_cause(&scenario, &trials)
        };
        assert_eq!(verdict_with(&[1.0, 1.0, 1.0]), inconclusive(cause));
        assert_eq!(verdict_with(&[1.0, 9.0, 1.0]), inconclusive(cause), "an excluded trial cannot fail");
        assert_eq!(verdict_with(&[1.0, 1.0, 9.0]), FAIL);
    }
    let mut all = trials_with_values(&[9.0, 9.0, 9.0]);
    for trial in &mut all {
        trial.exclusion = Some(Exclusion::NoAnswer { at_ms: 3.0 });
    }
    assert_eq!(verdict_and_cause(&scenario, &all), inconclusive(Cause::Rig));
}

#[rstest]
#[case::within("{ metric = \"overruns\", at_most = 2.0 }", 2, PASS)]
#[case::beyond("{ metric = \"overruns\", at_most = 2.0 }", 3, inconclusive(Cause::Bench))]
#[case::none_stated("{ metric = \"overshoot_percent\", at_most = 2.0 }", 1, inconclusive(Cause::Bench))]
#[case::the_smallest_counts(
    "{ metric = \"overruns\", at_most = 9.0 }, { metric = \"overruns\", at_most = 1.0 }",
    2,
    inconclusive(Cause::Bench)
)]
fn accepts_as_many_overruns_as_the_scenario_allows(
    #[case] expect: &str,
    #[case] overruns: usize,
    #[case] expected: (Verdict, Option<Cause>),
) {
    let expect = expect.trim_start_matches("{ ").trim_end_matches(" }");
    let scenario = fixed_scenario(expect);
    let mut rows = trace_rows(&scenario, |_| 2.0);
    rows.iter_mut().skip(100).step_by(20).take(overruns).for_each(|row| row.flags |= Flags::OVERRUN);
    assert_eq!(judge_rows(&scenario, &rows), expected);
}

#[rstest]
#[case::a_lost_line(false, Some(Cause::Rig))]
#[case::a_crash(true, None)]
fn a_silence_before_a_crash_is_no_failure_of_the_rig(#[case] ended_by_controller: bool, #[case] cause: Option<Cause>) {
    let scenario = fixed_scenario("metric = \"settling_time_ms\", at_most = 2.0");
    let mut rows = trace_rows(&scenario, |_| 2.0);
    rows[100].flags |= Flags::LINK_LOST;
    let telemetry = Telemetry { ended: Some("ended".to_owned()), ended_by_controller, ..Telemetry::default() };
    let measures = measure(&scenario, 0, &rows, &telemetry);
    assert_eq!(measures.exclusion.as_ref().map(Exclusion::cause), cause);
}

#[test]
fn a_trial_with_lost_rows_does_not_count() {
    let scenario = fixed_scenario("metric = \"settling_time_ms\", at_most = 2.0");
    let rows = trace_rows(&scenario, |_| 2.0);
    let cause = |lost_rows| {
        let timing = platebench_model::record::TimingRecord { lost_rows, ..Default::default() };
        let telemetry = Telemetry { timing: Some(Box::new(timing)), ..Telemetry::default() };
        measure(&scenario, 0, &rows, &telemetry).exclusion.as_ref().map(Exclusion::cause)
    };
    assert_eq!((cause(0), cause(1)), (None, Some(Cause::Bench)));
}

/// 50 ms of stall in 60 ms (833 333 ppm), 2 % of clock error, four standard errors of 0.5 %.
#[rstest]
#[case::in_step("target", 873_333.0, None)]
#[case::fast("target", 873_334.0, Some(Cause::Rig))]
#[case::slow("target", -873_334.0, Some(Cause::Rig))]
#[case::bench_paces("bench", 1e6, None)]
fn excludes_a_pacing_target_with_a_wrong_clock(
    #[case] pacing: &str,
    #[case] ppm: f64,
    #[case] expected: Option<Cause>,
) {
    let scenario = fixed_scenario("metric = \"settling_time_ms\", at_most = 2.0");
    let timing = platebench_model::record::TimingRecord {
        pacing: pacing.to_owned(),
        target_clock_ppm: Some(ppm),
        target_clock_error_ppm: Some(5_000.0),
        ..Default::default()
    };
    let telemetry = Telemetry { timing: Some(Box::new(timing)), ..Telemetry::default() };
    let trial = measure(&scenario, 0, &trace_rows(&scenario, |_| 2.0), &telemetry);
    assert_eq!(trial.exclusion.as_ref().map(Exclusion::cause), expected);
}

#[test]
fn finds_disturbances_in_the_trace() {
    let scenario = fixed_scenario("metric = \"settling_time_ms\", at_most = 2.0");
    let good = trace_rows(&scenario, |_| 2.0);
    assert_eq!(judge_rows(&scenario, &good), PASS);
    let flagged = |flag| {
        let mut rows = good.clone();
        rows[700].flags |= flag;
        judge_rows(&scenario, &rows)
    };
    assert_eq!(flagged(Flags::LINK_LOST), inconclusive(Cause::Rig));
    assert_eq!(flagged(Flags::OVERRUN), inconclusive(Cause::Bench));
    assert_eq!(flagged(Flags::LINK_LOST | Flags::OVERRUN), inconclusive(Cause::Rig));
    let flagged_at = |late: usize, silent: usize| {
        let mut rows = good.clone();
        rows[late].flags |= Flags::OVERRUN;
        rows[silent].flags |= Flags::LINK_LOST;
        judge_rows(&scenario, &rows)
    };
    assert_eq!(flagged_at(680, 700), inconclusive(Cause::Bench), "a silence just after a late bench");
    assert_eq!(flagged_at(720, 700), inconclusive(Cause::Rig), "a silence before a late bench");
    assert_eq!(flagged(Flags::SATURATED), PASS);
    assert_eq!(judge_rows(&scenario, &good[..1_200]), inconclusive(Cause::Bench), "the last row is missing");
    assert_eq!(judge_rows(&scenario, &good[1..]), inconclusive(Cause::Bench), "the first row is missing");
    assert_eq!(judge_rows(&scenario, &[]), inconclusive(Cause::Bench), "every row is missing");
    let mut gap = good.clone();
    gap.remove(600);
    assert_eq!(judge_rows(&scenario, &gap), inconclusive(Cause::Bench), "a row in the middle is missing");
}

#[rstest]
#[case::before(29, "kind = \"drop\", from_ms = 30.0, until_ms = 40.0", false)]
#[case::first(30, "kind = \"drop\", from_ms = 30.0, until_ms = 40.0", true)]
#[case::a_period_later(40, "kind = \"drop\", from_ms = 30.0, until_ms = 40.0", true)]
#[case::too_late(41, "kind = \"drop\", from_ms = 30.0, until_ms = 40.0", false)]
#[case::delayed(42, "kind = \"delay\", delay_ms = 2.0, from_ms = 30.0, until_ms = 40.0", true)]
#[case::after_the_delay(43, "kind = \"delay\", delay_ms = 2.0, from_ms = 30.0, until_ms = 40.0", false)]
#[case::for_good(30, "kind = \"disconnect\", from_ms = 30.0", false)]
#[case::both_directions(30, "kind = \"delay\", delay_ms = 0.5, from_ms = 30.0, until_ms = 40.0", true)]
#[case::in_time(
    30,
    "kind = \"delay\", delay_ms = 0.5, direction = \"to-controller\", from_ms = 30.0, until_ms = 40.0",
    false
)]
#[case::doubled(30, "kind = \"duplicate\", from_ms = 30.0, until_ms = 40.0", false)]
#[case::babble(30, "kind = \"babble\", from_ms = 30.0, until_ms = 40.0", false)]
#[case::of_the_sensor(30, "kind = \"freeze\", from_ms = 30.0, until_ms = 40.0", false)]
fn a_planned_fault_explains_a_missing_answer(#[case] at_ms: usize, #[case] fault: &str, #[case] planned: bool) {
    let expect = "metric = \"settling_time_ms\", at_most = 2.0 }]\nfault = [{ ".to_owned() + fault;
    let scenario = fixed_scenario(&expect);
    let mut rows = trace_rows(&scenario, |_| 2.0);
    rows[at_ms * 20].flags |= Flags::LINK_LOST;
    assert_eq!(judge_rows(&scenario, &rows), if planned { PASS } else { inconclusive(Cause::Rig) });
    rows[100].flags |= Flags::LINK_LOST;
    assert_eq!(judge_rows(&scenario, &rows), inconclusive(Cause::Rig));
}
