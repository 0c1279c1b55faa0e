//! Tests the size of `report.html`.

use crate::fixtures::{self, Response, closed_loop};
use crate::page::{legend_texts, plot_data, write_page};
use platebench_model::record::ScenarioRecord;
use rstest::rstest;

#[rstest]
#[case::ten(10)]
#[case::forty(40)]
#[case::hundred(100)]
fn thirty_trials_of_many_scenarios_take_five_megabytes(#[case] count: usize) {
    let folder = tempfile::tempdir().unwrap();
    let mut closed = closed_loop();
    let response = Response { force_n: 2.0, temperature_k: 9.0, detuned_hz: 87.0, step_ms: 0.1, ..Response::default() };
    fixtures::write_trials(&mut closed, folder.path(), 30, response, 0.02);
    // All scenarios share the traces: the size depends on the figures.
    let numbered = |number| ScenarioRecord { file: format!("paper/s{number}-closed-loop.toml"), ..closed.clone() };
    let page = write_page(&fixtures::run((0..count).map(numbered).collect()), folder.path());
    let curves = plot_data(&page);
    assert_eq!(curves.len(), count);
    assert!(legend_texts(&curves[0], 0).contains(&"5 % to 95 % of 30 trials".to_owned()));
    assert!(page.len() < 5_000_000, "{} bytes", page.len());
}

#[test]
fn a_minute_takes_less_than_300_kilobytes() {
    let folder = tempfile::tempdir().unwrap();
    let mut closed = closed_loop();
    let minute = Response { duration_ms: 60_000.0, step_ms: 1.0, ..Response::default() };
    fixtures::write_trials(&mut closed, folder.path(), 1, minute, 0.0);
    let page = write_page(&fixtures::run(vec![closed]), folder.path());
    assert!(page.len() < 300_000, "{} bytes", page.len());
}
