//! Tests marks in the figures of `report.html`: start, end and deadline of measured times.

use crate::fixtures::{self, Response, closed_loop};
use crate::page::{legend_texts, plot_data, write_page};
use crate::page_text::section;
use platebench_model::record::ScenarioRecord;
use rstest::rstest;
use serde_json::{Value, json};

/// Instants of the marks in ms. The x axis from 0 ms to 60 ms reaches from 264 to 2184.
fn marks(drawing: &str, ink: &str) -> Vec<f64> {
    let start = format!("class=\"s-{ink}\" d=\"m");
    let lines = drawing.split(&start).skip(1);
    let x = lines.map(|line| line.split(' ').next().unwrap().parse::<f64>().unwrap());
    x.map(|x| ((x - 264.0) / (2184.0 - 264.0) * 600.0).round() / 10.0).collect()
}

fn panel_marks(curves: &Value, panel: usize) -> Vec<(String, f64)> {
    let keys = legend_texts(curves, panel);
    let marks = curves["panels"][panel]["marks"].as_array().unwrap().iter();
    marks.map(|mark| (keys[mark[0].as_u64().unwrap() as usize].clone(), mark[1].as_f64().unwrap())).collect()
}

#[rstest]
#[case::recovered(
    "recovery_time_ms", ("at_most", json!(6.0)), json!(9.614), 0, "recovered after 9.614 ms", &[40.0, 49.6], &[46.0]
)]
#[case::never("recovery_time_ms", ("at_most", json!(6.0)), Value::Null, 0, "does not recover", &[40.0], &[46.0])]
#[case::within(
    "recovery_time_ms",
    ("within", json!([1.0, 7.0])),
    json!(9.614),
    0,
    "recovered after 9.614 ms",
    &[40.0, 49.6],
    &[47.0],
)]
#[case::no_deadline(
    "recovery_time_ms", ("at_least", json!(10.0)), json!(9.614), 0, "recovered after 9.614 ms", &[40.0, 49.6], &[]
)]
#[case::beyond_the_end(
    "recovery_time_ms", ("at_most", json!(25.0)), json!(9.614), 0, "recovered after 9.614 ms", &[40.0, 49.6], &[]
)]
#[case::stopped(
    "shutdown_time_ms", ("at_most", json!(5.0)), json!(7.5), 1, "stopped after 7.5 ms", &[40.0, 47.5], &[45.0]
)]
#[case::runs_on("shutdown_time_ms", ("at_most", json!(5.0)), Value::Null, 1, "does not stop", &[40.0], &[45.0])]
fn marks_start_end_and_deadline(
    #[case] metric: &str,
    #[case] limit: (&str, Value),
    #[case] value: Value,
    #[case] panel: usize,
    #[case] text: &str,
    #[case] came: &[f64],
    #[case] deadline: &[f64],
) {
    let folder = tempfile::tempdir().unwrap();
    let mut expectation = fixtures::failed_expectation(
        fixtures::passed_expectation(metric, limit, 9.614),
        fixtures::outside(0, 9.614, 6.0),
    );
    expectation.definition.from_ms = Some(40.0);
    let mut tap = fixtures::scenario("tap.toml", "A tap", "dq-pi", vec![expectation]);
    fixtures::write_trials(&mut tap, folder.path(), 1, Response::default(), 0.0);
    tap.trials[0].metrics = fixtures::metric_values(&[(metric, value)]);
    let page = write_page(&fixtures::run(vec![tap.clone()]), folder.path());
    let drawn = section(&page, "scenario-0");
    let title = ["Amplitude |W|", "Drive"][panel];
    let drawing = drawn.split(&format!("<figcaption>{title}</figcaption>")).nth(1).unwrap();
    let drawing = drawing.split("</figure>").next().unwrap();
    assert!(drawing.contains(&format!("trial 0 {text}")), "{drawing}");
    let (svg, _) = drawing.split_once("</svg>").unwrap();
    assert_eq!((marks(svg, "settling").as_slice(), marks(svg, "deadline").as_slice()), (came, deadline));
    let curves = &plot_data(&page)[0];
    let all: Vec<_> = panel_marks(curves, panel);
    let of = |wanted: &dyn Fn(&str) -> bool| -> Vec<f64> {
        let found = all.iter().filter(|(key, _)| wanted(key));
        found.map(|(_, at_ms)| (at_ms * 10.0).round() / 10.0).collect()
    };
    assert_eq!(of(&|key| key == format!("trial 0 {text}")), came);
    let until: Vec<f64> = of(&|key| key.starts_with(metric)).into_iter().filter(|at_ms| *at_ms <= 60.0).collect();
    assert_eq!(until, deadline, "{all:?}");
    assert_eq!(panel_marks(curves, 1 - panel), []);
    tap.expectations[0].definition.from_ms = None;
    let page = write_page(&fixtures::run(vec![tap]), folder.path());
    assert!(!section(&page, "scenario-0").contains(text));
}

#[test]
fn marks_the_deadline_of_a_settling_time() {
    let folder = tempfile::tempdir().unwrap();
    let mut closed = closed_loop();
    fixtures::write_trials(&mut closed, folder.path(), 1, Response::default(), 0.0);
    let marked = |closed: &ScenarioRecord| {
        let page = write_page(&fixtures::run(vec![closed.clone()]), folder.path());
        panel_marks(&plot_data(&page)[0], 0)
            .into_iter()
            .map(|(key, at_ms)| (key, (at_ms * 1e3).round() / 1e3))
            .collect::<Vec<_>>()
    };
    let [settled, until] = ["trial 0 settled after 1.948 ms", "settling_time_ms ≤ 2 ms: until 3 ms"].map(str::to_owned);
    assert_eq!(marked(&closed), [(settled.clone(), 1.0), (settled, 2.948), (until.clone(), 3.0)]);
    closed.trials[0].metrics.set("settling_time_ms", None);
    assert_eq!(marked(&closed), [("trial 0 does not settle".to_owned(), 1.0), (until, 3.0)]);
}

#[test]
fn marks_recoveries_that_did_not_pass_or_else_the_first() {
    let folder = tempfile::tempdir().unwrap();
    let recovery = |from_ms: f64, passes: bool| {
        let mut found = fixtures::passed_expectation("recovery_time_ms", ("at_most", json!(6.0)), 3.0);
        found.definition.from_ms = Some(from_ms);
        if passes { found } else { fixtures::failed_expectation(found, fixtures::outside(0, 9.614, 6.0)) }
    };
    let marked = |passes: [bool; 3]| {
        let expectations =
            [10.0, 20.0, 30.0].into_iter().zip(passes).map(|(from_ms, passes)| recovery(from_ms, passes));
        let mut tap = fixtures::scenario("tap.toml", "Taps", "dq-pi", expectations.collect());
        fixtures::write_trials(&mut tap, folder.path(), 1, Response::default(), 0.0);
        let keys = ["recovery_time_ms", "recovery_time_ms[2]", "recovery_time_ms[3]"];
        tap.trials[0].metrics = fixtures::metric_values(&keys.map(|key| (key, json!(3.0))));
        let page = write_page(&fixtures::run(vec![tap]), folder.path());
        let until = panel_marks(&plot_data(&page)[0], 0).into_iter().filter(|(key, _)| key.contains("until"));
        until.map(|(_, at_ms)| at_ms).collect::<Vec<_>>()
    };
    assert_eq!(marked([true, false, false]), [26.0, 36.0]);
    assert_eq!(marked([true, true, true]), [16.0]);
}
