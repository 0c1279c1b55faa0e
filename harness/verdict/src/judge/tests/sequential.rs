use super::*;

fn sequential_scenario(expect: &[&str], count: u32, most: u32) -> Scenario {
    ScenarioBuilder { expect, trials: count, max_count: most, is_varied: true, ..BASE }.scenario()
}

fn look_of(judgement: &Judgement) -> [u32; 2] {
    judgement.expectations[0].evidence.look.unwrap()
}

#[test]
fn a_run_stops_at_the_first_deciding_look() {
    let expect = ["metric = \"static_error_percent\", at_most = 1.0"];
    let scenario = sequential_scenario(&expect, 10, 50);
    let next_look = |trials| SequentialDecision::Continue { trials };
    assert_eq!(judge_sequentially(&scenario, &[]), next_look(10));
    assert_eq!(judge_sequentially(&scenario, &trials_with_values(&[0.5; 9])), next_look(10));
    let clear = trials_with_values(&values_with_moments(10, 0.5, 0.1));
    let SequentialDecision::Stop(judgement) = judge_sequentially(&scenario, &clear) else { panic!("clear after ten") };
    assert_eq!((judgement.verdict, look_of(&judgement)), (Verdict::Pass, [1, 4]));
    let SequentialDecision::Stop(judgement) =
        judge_sequentially(&scenario, &trials_with_values(&values_with_moments(10, 1.5, 0.1)))
    else {
        panic!()
    };
    assert_eq!(judgement.verdict, Verdict::Fail);
    // If the mean is at the limit, no early look decides, and the last one is inconclusive.
    let repeated: Vec<f64> = (0..50).map(|index| if index % 2 == 0 { 0.9 } else { 1.1 }).collect();
    for (count, next) in [(10, 20), (19, 20), (20, 40), (39, 40), (40, 50), (49, 50)] {
        let some = trials_with_values(&repeated[..count]);
        assert_eq!(judge_sequentially(&scenario, &some), next_look(next), "{count}");
        assert_eq!(verdict_and_cause(&scenario, &some), inconclusive(Cause::Evidence));
    }
    let SequentialDecision::Stop(judgement) = judge_sequentially(&scenario, &trials_with_values(&repeated)) else {
        panic!("fifty are all")
    };
    assert_eq!((judgement.verdict, look_of(&judgement)), (Verdict::Inconclusive, [4, 4]));
}

#[test]
fn ignores_trials_after_the_deciding_look() {
    let scenario = sequential_scenario(&["metric = \"static_error_percent\", at_most = 1.0"], 10, 50);
    let mut all = trials_with_values(&values_with_moments(10, 0.5, 0.1));
    let decided = judge(&scenario, &all);
    all.extend((10..50).map(|index| trial_measures(index, &[Measure::Value(9.0)])));
    assert_eq!(judge(&scenario, &all), decided);
    all.reverse();
    assert_eq!(judge(&scenario, &all), decided, "in any order");
    assert_eq!(judge_sequentially(&scenario, &all), SequentialDecision::Stop(decided));
}

#[test]
fn stops_if_more_trials_cannot_change_the_verdict() {
    let expect = ["metric = \"static_error_percent\", at_most = 1.0", "metric = \"settling_time_ms\", at_most = 2.0"];
    let scenario = sequential_scenario(&expect, 4, 50);
    let four = |exclusion: Option<Exclusion>, excuse: Option<Excuse>, settling: f64| -> Vec<_> {
        let one = |index: u32| {
            let error = 0.9 + 0.2 * f64::from(index % 2);
            let mut trial = trial_measures(index, &[Measure::Value(error), Measure::Value(settling)]);
            trial.exclusion = exclusion.clone().filter(|_| index == 2);
            trial.excuses = vec![None, excuse.clone()];
            trial
        };
        (0..4).map(one).collect()
    };
    assert_eq!(judge_sequentially(&scenario, &four(None, None, 1.0)), SequentialDecision::Continue { trials: 8 });
    for (stopped, expected) in [
        (four(Some(Exclusion::NoAnswer { at_ms: 3.0 }), None, 1.0), Verdict::Inconclusive),
        (four(None, Some(TOO_WEAK), 3.0), Verdict::Inconclusive),
        (four(None, None, 3.0), Verdict::Fail),
    ] {
        let SequentialDecision::Stop(judgement) = judge_sequentially(&scenario, &stopped) else {
            panic!("{stopped:?}")
        };
        assert_eq!(judgement.verdict, expected);
    }
}

fn sequential_pass_rate(expect: &str, count: u32, most: u32, runs: u32, draw: impl Fn(f64) -> f64) -> (f64, f64, f64) {
    let scenario = sequential_scenario(&[expect], count, most);
    let mut random = ChaCha8Rng::seed_from_u64(11);
    let (mut passed, mut failed, mut played) = (0, 0, 0);
    for _ in 0..runs {
        let mut values: Vec<TrialMeasures> = Vec::new();
        let judgement = loop {
            match judge_sequentially(&scenario, &values) {
                SequentialDecision::Stop(judgement) => break judgement,
                SequentialDecision::Continue { trials } => {
                    values.extend((values.len() as u32..trials).map(|index| {
                        trial_measures(index, &[Measure::Value(draw(StandardNormal.sample(&mut random)))])
                    }));
                }
            }
        };
        passed += u32::from(judgement.verdict == Verdict::Pass);
        failed += u32::from(judgement.verdict == Verdict::Fail);
        played += values.len();
    }
    let share = |count: u32| f64::from(count) / f64::from(runs);
    (share(passed), share(failed), played as f64 / f64::from(runs))
}

#[rstest]
#[case::mean("metric = \"static_error_percent\", at_most = 1.0", |z: f64| 1.0 + 0.3 * z)]
#[case::deviation("metric = \"repeatability_percent\", at_most = 1.3", |z: f64| 100.0 + 1.3 * z)]
#[case::quantile("metric = \"settling_time_ms\", at_most = 1.281551565545, over = \"quantile\", quantile = 0.9",
    |z: f64| z)]
fn several_looks_keep_the_error_rate(#[case] expect: &str, #[case] draw: fn(f64) -> f64) {
    let (passed, failed, played) = sequential_pass_rate(expect, 20, 160, 2_000, draw);
    assert!(passed <= 0.05 && failed <= 0.05, "{passed} {failed}");
    assert!(passed > 0.01 && failed > 0.01 && played > 120.0, "{passed} {failed} {played}");
}

#[test]
fn several_looks_keep_the_error_rate_of_agreement() {
    let expect = "metric = \"repeatability_percent\", about = 1.3";
    let (_, failed, _) = sequential_pass_rate(expect, 8, 64, 2_000, |z| 100.0 + 1.3 * z);
    assert!(failed <= 0.05, "{failed}");
}

#[test]
fn a_clear_run_ends_early() {
    let (passed, _, played) =
        sequential_pass_rate("metric = \"static_error_percent\", at_most = 1.0", 20, 160, 200, |z| 0.7 + 0.3 * z);
    assert!(passed > 0.99 && played < 30.0, "{passed} {played}");
}
