use super::*;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use rand_distr::{ChiSquared as ChiSquaredDraw, Distribution, StandardNormal};
use rstest::rstest;
use statrs::distribution::ChiSquared;
use std::fs;
use tempfile::TempDir;

/// Draws estimates of a value that changes by `drift` true errors from each one to the next. The
/// stated errors scatter with `freedom` degrees.
fn draw(random: &mut ChaCha8Rng, count: usize, freedom: f64, drift: f64) -> Vec<Estimate> {
    let chi_squared = ChiSquaredDraw::new(freedom).unwrap();
    let mut estimate = |index: usize| {
        let error = 1.0 + (index % 3) as f64;
        let normal: f64 = StandardNormal.sample(random);
        let stated = error * (chi_squared.sample(random) / freedom).sqrt();
        Estimate::new(1000.0 + error * normal + drift * index as f64, stated, freedom)
    };
    (0..count).map(&mut estimate).collect()
}

/// Share of 4,000 histories in which the test finds a drift.
fn alarm_rate(count: usize, freedom: f64, drift: f64) -> f64 {
    let mut random = ChaCha8Rng::seed_from_u64(55);
    let mut is_drift = || welch_test(&draw(&mut random, count, freedom, drift)).unwrap().is_drift;
    (0..4000).filter(|_| is_drift()).count() as f64 / 4000.0
}

#[rstest]
#[case(2, 29.0)]
#[case(12, 29.0)]
#[case(12, 1e4)]
#[case(40, 29.0)]
#[case(3, 4.0)]
fn an_unchanged_plate_gives_alarms_at_the_level(#[case] count: usize, #[case] freedom: f64) {
    let rate = alarm_rate(count, freedom, 0.0);
    // Four standard errors of 4,000 histories are 0.014.
    assert!((rate - LEVEL).abs() < 0.014, "{rate}");
}

#[test]
fn a_drift_above_the_intervals_is_found() {
    assert!(alarm_rate(12, 29.0, 0.8) > 0.95);
    assert!(alarm_rate(12, 29.0, 0.05) < 0.1, "a drift within the intervals");
}

fn exact(values: &[f64], freedom: f64) -> Vec<Estimate> {
    values.iter().map(|value| Estimate::new(*value, 1.0, freedom)).collect()
}

#[test]
fn the_test_of_two_means_is_that_of_welch_and_satterthwaite() {
    let (a, b) = (Estimate::new(10.0, 1.0, 4.0), Estimate::new(14.0, 2.0, 9.0));
    let found = welch_test(&[a, b]).unwrap();
    // t² = 16/5, with (1 + 4)² / (1/4 + 16/9) degrees of freedom.
    assert!((found.statistic - 3.2).abs() < 1e-12, "{found:?}");
    assert!((found.freedom[1] - 25.0 / (0.25 + 16.0 / 9.0)).abs() < 1e-9, "{found:?}");
}

#[test]
fn known_errors_give_the_chi_squared_test() {
    let found = welch_test(&exact(&[0.0, 1.0, 2.0, 5.0], 1e6)).unwrap();
    // Σ (x − 2)² = 14 with 3 degrees of freedom.
    let p_value = ChiSquared::new(3.0).unwrap().sf(14.0);
    assert!((found.statistic - 14.0 / 3.0).abs() < 1e-4 && (found.p_value / p_value - 1.0).abs() < 1e-3, "{found:?}");
}

#[test]
fn one_identification_has_no_drift() {
    assert_eq!(welch_test(&exact(&[1.0], 9.0)), None);
    assert!(welch_test(&exact(&[1.0, 1.0], 9.0)).is_some());
}

#[test]
fn a_trend_needs_three_identifications_on_two_days() {
    let points = |days: &[f64]| days.iter().map(|day| (*day, Estimate::new(5.0 + 0.5 * day, 0.1, 9.0))).collect();
    let trend_of = |days: &[f64]| trend(&Vec::from_iter::<Vec<_>>(points(days)));
    assert_eq!(trend_of(&[0.0, 10.0]), None);
    assert_eq!(trend_of(&[7.0, 7.0, 7.0]), None);
    let slope = trend_of(&[0.0, 10.0, 30.0]).unwrap();
    assert!((slope.value - 0.5).abs() < 1e-12 && slope.contains(0.5) && !slope.contains(0.0), "{slope:?}");
}

fn entry(date: &str, resonance: f64, recording: &str) -> HistoryEntry {
    HistoryEntry {
        plate_history: VERSION,
        plate: "P7".to_owned(),
        date: date.to_owned(),
        model: PlateModel::OneMode,
        reference_temperature_c: 24.0,
        gain_um_per_vpp: Some(Estimate::new(0.007, 1e-5, 29.0).into()),
        time_constant_s: None,
        resonance_hz: Some(Estimate::new(resonance, 0.2, 29.0).into()),
        slope_hz_per_k: None,
        recordings: [(format!("{recording}.csv"), recording.to_owned())].into(),
    }
}

fn history_file(folder: &TempDir) -> PathBuf {
    let path = folder.path().join("p7.jsonl");
    for (date, resonance, recording) in [("2026-03-02", 32_307.6, "a"), ("2026-02-02", 32_307.4, "b")] {
        PlateHistory::append(&path, entry(date, resonance, recording)).unwrap();
    }
    path
}

#[test]
fn keeps_lines_and_tests_them_together() {
    let folder = TempDir::new().unwrap();
    let path = history_file(&folder);
    let history = PlateHistory::read(&path).unwrap();
    assert_eq!(history.entries, [entry("2026-03-02", 32_307.6, "a"), entry("2026-02-02", 32_307.4, "b")]);
    let days: Vec<f64> = history.points(&QUANTITIES[2]).iter().map(|(day, _)| *day).collect();
    assert_eq!(days, [28.0, 0.0]);
    let analysis = history.analysis();
    let tested: Vec<_> = analysis.quantities.iter().map(|one| (one.quantity.as_str(), one.drift.unwrap())).collect();
    assert_eq!(tested.iter().map(|(name, _)| *name).collect::<Vec<_>>(), ["gain_um_per_vpp", "resonance_hz"]);
    assert!(tested.iter().all(|(_, drift)| drift.level == 0.025 && !drift.is_drift));
    let changed = history.with(entry("2026-04-02", 32_310.0, "c")).unwrap();
    let drifts: Vec<_> = changed.analysis().drifts().collect();
    assert!(drifts.len() == 1 && drifts[0].starts_with("drift of resonance_hz: its 3 identifications "), "{drifts:?}");
    let svg = changed.chart().svg();
    // Three points of each of two quantities, and the legend.
    assert_eq!(svg.matches("class=\"f-first\"").count(), 7);
}

#[rstest]
#[case::plate(
    HistoryEntry { plate: "P8".to_owned(), ..entry("2026-05-02", 1.0, "c") },
    1,
    "the plate is P7, expected P8"
)]
#[case::model(
    HistoryEntry { model: PlateModel::SelfHeating, ..entry("2026-05-02", 1.0, "c") },
    1,
    "the model of the plate is one-mode, expected self-heating"
)]
#[case::temperature(
    HistoryEntry { reference_temperature_c: 20.0, ..entry("2026-05-02", 1.0, "c") },
    1,
    "the reference temperature is 24 °C, expected 20 °C"
)]
#[case::recording(entry("2026-05-02", 1.0, "b"), 2, "contains the recording b.csv already, expected a new one")]
fn a_line_of_another_plate_is_refused(#[case] new: HistoryEntry, #[case] line: usize, #[case] message: &str) {
    let folder = TempDir::new().unwrap();
    let path = history_file(&folder);
    let before = fs::read_to_string(&path).unwrap();
    let error = PlateHistory::append(&path, new).unwrap_err().to_string();
    assert_eq!(error, format!("{}:{line}: {message}", path.display()));
    assert_eq!(fs::read_to_string(&path).unwrap(), before);
}

#[rstest]
#[case::no_json("t_s,wd", "expected a line that `platebench identify --history` wrote")]
#[case::other_unit(r#"{"gain_nm_per_vpp": 7.0}"#, "unknown field `gain_nm_per_vpp`, expected one of")]
#[case::other_file(r#"{"plate": "P7"}"#, "missing field `plate_history`")]
#[case::empty_line("", "expected a line that `platebench identify --history` wrote")]
fn a_file_that_is_no_history_is_refused(#[case] line: &str, #[case] message: &str) {
    let folder = TempDir::new().unwrap();
    let path = history_file(&folder);
    fs::write(&path, fs::read_to_string(&path).unwrap() + line + "\n").unwrap();
    let error = PlateHistory::read(&path).unwrap_err().to_string();
    assert!(error.starts_with(&format!("{}:3: ", path.display())) && error.contains(message), "{error}");
    assert_eq!(PlateHistory::append(&path, entry("2026-05-02", 1.0, "c")).unwrap_err().to_string(), error);
}

#[rstest]
#[case("\"plate_history\":1", "\"plate_history\":2", "`plate_history` is 2, expected 1")]
#[case("2026-03-02", "2026-02-30", "`date` is 2026-02-30, expected a date like 2026-03-02")]
#[case("\"freedom\":29.0", "\"freedom\":0.5", "`gain_um_per_vpp`: expected a finite value")]
#[case("\"error\":0.2", "\"error\":0.0", "`resonance_hz`: expected a finite value")]
#[case("\"value\":32307.6", "\"value\":42307.6", "`resonance_hz`: expected a finite value inside its interval")]
fn an_invalid_value_is_refused(#[case] good: &str, #[case] bad: &str, #[case] message: &str) {
    let line = serde_json::to_string(&entry("2026-03-02", 32_307.6, "a")).unwrap();
    assert!(line.contains(good), "{line}");
    assert!(HistoryEntry::parse(&line).is_ok());
    let error = HistoryEntry::parse(&line.replacen(good, bad, 1)).unwrap_err();
    assert!(error.starts_with(message), "{error}");
}

#[test]
fn a_last_line_without_an_end_stays_a_line() {
    let folder = TempDir::new().unwrap();
    let path = history_file(&folder);
    let text = fs::read_to_string(&path).unwrap();
    fs::write(&path, text.trim_end()).unwrap();
    PlateHistory::append(&path, entry("2026-05-02", 32_307.5, "c")).unwrap();
    assert_eq!(PlateHistory::read(&path).unwrap().entries.len(), 3);
    // A line that was cut off while it was written.
    fs::write(&path, &text[..text.len() - 20]).unwrap();
    assert!(PlateHistory::read(&path).unwrap_err().to_string().contains(":2: "));
}

#[test]
fn a_history_in_use_is_refused() {
    let folder = TempDir::new().unwrap();
    let path = history_file(&folder);
    let lock = FileLock::exclusive(&path).unwrap().unwrap();
    let result = PlateHistory::append(&path, entry("2026-05-02", 32_307.5, "c"));
    assert!(matches!(result, Err(HistoryError::InUse(_))));
    drop(lock);
    PlateHistory::append(&path, entry("2026-05-02", 32_307.5, "c")).unwrap();
}
