use super::*;
use crate::tube::Tolerance;
use platebench_model::record::Verdict;
use platebench_model::trace::Row;
use rstest::rstest;
use std::fs;
use tempfile::TempDir;

/// A first-order response over 20 ms, delayed by `late` ms and scaled by `factor`.
fn rows(late: f64, factor: f64) -> Vec<Row> {
    rows_to(400, late, factor)
}

fn rows_to(last: u32, late: f64, factor: f64) -> Vec<Row> {
    let row = |index: u32| {
        let t_ms = f64::from(index) * 0.05;
        let since = t_ms - 1.0 - late;
        let level = if since > 0.0 { factor * 2.0 * (1.0 - (-since / 1.88).exp()) } else { 0.0 };
        Row {
            t_s: t_ms / 1e3,
            setpoint_um: if t_ms >= 1.0 { 2.0 } else { 0.0 },
            amplitude_um: level,
            wd_um: level,
            drive_vpp: if since >= 0.0 { 286.5 } else { 0.0 },
            frequency_hz: 32_307.6,
            ..Row::default()
        }
    };
    (0..=last).map(row).collect()
}

fn golden() -> GoldenTubes {
    GoldenTubes::from_trial(&rows(0.0, 1.0), 0.05).unwrap()
}

fn compare(golden: &GoldenTubes, trials: &[Vec<Row>]) -> TubeComparison {
    golden.compare((0..).zip(trials.iter().map(Vec::as_slice)))
}

#[test]
fn matches_itself_and_its_thinned_curve() {
    let comparison = compare(&golden(), &[rows(0.0, 1.0)]);
    assert_eq!((comparison.verdict, comparison.worst, comparison.reason), (Verdict::Pass, None, None));
    assert!(golden().tubes[0].points.len() < 60);
    assert_eq!(compare(&GoldenTubes::from_rows(&rows(0.0, 1.0)).unwrap(), &[rows(0.0, 1.0)]).verdict, Verdict::Pass);
    assert_eq!(GoldenTubes::from_rows(&[]), None);
}

/// At 2 µm the tolerance is 0.01 µm + 0.5 % = 0.02 µm. Thinning may use a tenth of it.
#[rstest]
#[case::just_inside(1.0088, Verdict::Pass)]
#[case::just_outside(1.0112, Verdict::Fail)]
#[case::just_inside_below(0.9912, Verdict::Pass)]
#[case::just_outside_below(0.9888, Verdict::Fail)]
fn detects_another_height(#[case] factor: f64, #[case] expected: Verdict) {
    assert_eq!(compare(&golden(), &[rows(0.0, factor)]).verdict, expected);
}

#[rstest]
#[case::in_time(0.05, Verdict::Pass)]
#[case::early(-0.05, Verdict::Pass)]
#[case::too_late(0.1, Verdict::Fail)]
#[case::too_early(-0.1, Verdict::Fail)]
fn detects_a_delay(#[case] late: f64, #[case] expected: Verdict) {
    let comparison = compare(&golden(), &[rows(late, 1.0)]);
    assert_eq!(comparison.verdict, expected, "{comparison:?}");
}

#[test]
fn names_the_worst_trial() {
    let comparison = compare(&golden(), &[rows(0.0, 1.0), rows(0.0, 1.05), rows(0.0, 1.1), rows(0.0, 1.02)]);
    let (trial, worst) = comparison.worst.unwrap();
    assert_eq!((comparison.verdict, comparison.trials, comparison.outside, trial), (Verdict::Fail, 4, 3, 2));
    assert!(["amplitude_um", "wd_um"].contains(&worst.signal.as_str()) && worst.t_ms > 5.0, "{worst:?}");
    assert!((worst.value - 1.1 * worst.golden).abs() < 3e-3, "{worst:?}");
    assert!((worst.distance + worst.allowed - 0.1 * worst.golden).abs() < 3e-3, "{worst:?}");
    assert_eq!(comparison.reason.as_deref(), Some("3 of 4 trials are outside the tube"));
}

#[rstest]
#[case::shorter(399, Verdict::Pass)]
#[case::too_short(398, Verdict::Inconclusive)]
#[case::longer(401, Verdict::Pass)]
#[case::too_long(402, Verdict::Inconclusive)]
fn does_not_pass_a_part_that_was_not_compared(#[case] last: u32, #[case] expected: Verdict) {
    let comparison = compare(&golden(), &[rows_to(last, 0.0, 1.0)]);
    assert_eq!(comparison.verdict, expected);
    assert_eq!(compare(&golden(), &[rows_to(last, 0.0, 1.1)]).verdict, Verdict::Fail);
}

#[test]
fn does_not_pass_without_trials() {
    assert_eq!(compare(&golden(), &[]).verdict, Verdict::Inconclusive);
    assert_eq!(compare(&golden(), &[Vec::new()]).verdict, Verdict::Inconclusive);
}

/// At a rate of 5 %, P(at least 4 of 30 trials outside) = 0.061, P(at least 5) = 0.016.
#[rstest]
#[case(0.05, 30, 1, Verdict::Pass)]
#[case(0.05, 30, 2, Verdict::Inconclusive)]
#[case(0.05, 30, 4, Verdict::Inconclusive)]
#[case(0.05, 30, 5, Verdict::Fail)]
#[case(0.05, 1, 1, Verdict::Fail)]
#[case(0.06, 1, 1, Verdict::Inconclusive)]
#[case(0.05, 1, 0, Verdict::Pass)]
fn allows_some_trials_outside_a_learned_tube(
    #[case] rate: f64,
    #[case] trials: usize,
    #[case] outside: usize,
    #[case] expected: Verdict,
) {
    let golden = GoldenTubes { false_alarm_rate: Some(rate), ..golden() };
    let all: Vec<_> = (0..trials).map(|index| rows(0.0, if index < outside { 1.1 } else { 1.0 })).collect();
    assert_eq!(compare(&golden, &all).verdict, expected);
}

fn baseline() -> Baseline {
    Baseline {
        scenario: "paper/step.toml".to_owned(),
        response: JudgedResponse {
            law: "dq-pi".to_owned(),
            build: BaselineBuild {
                rig: "hosted".to_owned(),
                firmware: "dq 0.1.0".to_owned(),
                id: "0123abcd".to_owned(),
            },
            values: Some([("settling_time_ms[2]".to_owned(), 1.956), ("drive_peak_vpp".to_owned(), 551.4)].into()),
        },
        learned: None,
        golden: golden(),
    }
}

#[rstest]
#[case(1.955_51, 1.956)]
#[case(551.449, 551.4)]
#[case(32_307.61, 32_310.0)]
#[case(0.000_149, 0.0001)]
#[case(-1.3e-10, 0.0)]
#[case(f64::INFINITY, f64::INFINITY)]
fn rounds_judged_values(#[case] value: f64, #[case] expected: f64) {
    assert_eq!(rounded(value).to_bits(), expected.to_bits());
}

#[test]
fn reads_a_baseline_of_an_earlier_version() {
    let folder = TempDir::new().unwrap();
    baseline().write(folder.path()).unwrap();
    let path = folder.path().join("paper/step.toml");
    let text = fs::read_to_string(&path).unwrap();
    fs::write(&path, text.replace("[judged]", "[features]")).unwrap();
    let old = Baseline::read(folder.path(), "paper/step.toml").unwrap().unwrap();
    assert_eq!(old.response.values, None);
    assert_eq!(old.golden.tubes.len(), baseline().golden.tubes.len());
}

#[test]
fn writes_the_documented_files() {
    let [head, table] = baseline().to_texts();
    insta::assert_snapshot!("head", head);
    insta::assert_snapshot!("table", table);
    assert!(table.len() < 4_000, "{} bytes", table.len());
}

#[test]
fn round_trips_within_a_thousandth_of_the_tolerance() {
    let folder = TempDir::new().unwrap();
    assert_eq!(Baseline::read(folder.path(), "paper/step.toml").unwrap(), None);
    let (plain, learned) = (baseline(), LearningParameters { trials: 30, false_alarm_rate: 0.05 });
    let mut wide = GoldenTubes { false_alarm_rate: Some(0.05), ..golden() };
    for (index, point) in (0..).zip(&mut wide.tubes[0].points) {
        point.width = f64::from(index) * 0.001;
    }
    let wide = Baseline { learned: Some(learned), golden: wide, ..baseline() };
    for before in [plain, wide] {
        before.write(folder.path()).unwrap();
        let after = Baseline::read(folder.path(), "paper/step.toml").unwrap().unwrap();
        assert_eq!(after.to_texts(), before.to_texts());
        assert_eq!((&after.response, &after.learned), (&before.response, &before.learned));
        assert_eq!(after.golden.false_alarm_rate, before.golden.false_alarm_rate);
        for (one, other) in before.golden.tubes.iter().zip(&after.golden.tubes) {
            for (one, other) in one.points.iter().zip(&other.points) {
                assert!((one.value - other.value).abs() < 0.01 && (one.width - other.width).abs() < 1e-5);
            }
        }
        assert_eq!(compare(&after.golden, &[rows(0.0, 1.0)]).verdict, Verdict::Pass);
        assert_eq!(fs::read_dir(folder.path().join("paper")).unwrap().count(), 2);
    }
}

#[rstest]
#[case::no_absolute_part(
    "toml",
    "absolute = 0.01",
    "absolute = 0.0",
    "expected absolute above 0 (the tolerance near zero)"
)]
#[case::relative_of_one("toml", "relative = 0.005", "relative = 1.0", "relative 1")]
#[case::negative_time("toml", "time_ms = 0.05", "time_ms = -0.05", "time_ms -0.05")]
#[case::unknown_key("toml", "law =", "laws =", ":2: unknown field `laws`")]
#[case::unknown_signal(
    "toml",
    "tolerance.drive_vpp",
    "tolerance.drive",
    "tolerance of `drive`, expected one of amplitude_um"
)]
#[case::no_step("toml", "step_ms = 0.05", "step_ms = 0.0", "expected a step")]
#[case::missing_column("csv", ",wq_um,", ",wq_um_width,", "no column `wq_um`")]
#[case::same_title_twice("csv", ",wq_um,", ",wd_um,", "both have the title `wd_um`, expected one")]
#[case::other_column("csv", ",wq_um,", ",wq,", "column `wq` has no tolerance")]
#[case::not_learned("csv", ",frequency_hz\n", ",frequency_hz_width\n", "no column `frequency_hz`")]
#[case::no_time("csv", "t_ms,", "t_s,", ":1: the first column is not `t_ms`")]
#[case::no_number("csv", "\n0,0,", "\n0,x,", ":2: expected 6 finite numbers")]
#[case::not_finite("csv", "\n0,0,", "\n0,inf,", ":2: expected 6 finite numbers")]
#[case::too_few("csv", "\n0,0,", "\n0,", ":2: expected 6 finite numbers")]
#[case::back_in_time("csv", "\n0,0,", "\n99,0,", ":3: `t_ms` is")]
fn rejects_a_damaged_baseline_with_its_position(
    #[case] extension: &str,
    #[case] good: &str,
    #[case] bad: &str,
    #[case] message: &str,
) {
    let folder = TempDir::new().unwrap();
    baseline().write(folder.path()).unwrap();
    let path = folder.path().join(format!("paper/step.{extension}"));
    let text = fs::read_to_string(&path).unwrap();
    assert!(text.contains(good), "{text}");
    fs::write(&path, text.replacen(good, bad, 1)).unwrap();
    let error = Baseline::read(folder.path(), "paper/step.toml").unwrap_err().to_string();
    assert!(error.contains(message) && error.contains(&format!("step.{extension}:")), "{error}");
}

#[test]
fn rejects_half_a_baseline() {
    let folder = TempDir::new().unwrap();
    baseline().write(folder.path()).unwrap();
    fs::remove_file(folder.path().join("paper/step.csv")).unwrap();
    assert!(matches!(Baseline::read(folder.path(), "paper/step.toml"), Err(BaselineError::File(_))));
}

#[test]
fn tolerances_of_a_baseline_are_its_own() {
    let folder = TempDir::new().unwrap();
    let mut wide = baseline();
    for tube in &mut wide.golden.tubes {
        tube.tolerance = Tolerance { absolute: 1e3, relative: 0.0, time_ms: 0.0 };
    }
    wide.write(folder.path()).unwrap();
    let read = Baseline::read(folder.path(), "paper/step.toml").unwrap().unwrap();
    assert_eq!(compare(&read.golden, &[rows(0.0, 1.5)]).verdict, Verdict::Pass);
}
