//! `report.html`.

use crate::made::{self, Response};
use platebench_report::html;
use platebench_verdict::{RunRecord, ScenarioRecord, Verdict};
use rstest::rstest;
use serde_json::{Value, json};
use std::fs;
use std::path::Path;

fn written(record: &RunRecord, folder: &Path) -> String {
    html::write(record, folder).unwrap();
    fs::read_to_string(folder.join(html::FILE)).unwrap()
}

fn closed() -> ScenarioRecord {
    let settling = made::passed("settling_time_ms", ("at_most", json!(2.0)), 1.949);
    made::scenario("paper/fig13-closed-loop.toml", "Closed loop", "dq-pi", vec![settling])
}

fn open() -> ScenarioRecord {
    let settling = made::passed("settling_time_ms", ("at_most", json!(2.0)), 5.632);
    let settling = made::failed(settling, "trial 0: 5.6320, expected ≤ 2");
    made::scenario("paper/fig13-open-loop.toml", "Open loop", "open-loop", vec![settling])
}

/// The part of the page that belongs to the scenario with that number.
fn part(page: &str, index: usize) -> &str {
    let start = page.find(&format!("id=\"scenario-{index}\"")).unwrap();
    page[start..].split("</section>").next().unwrap()
}

/// The elements of a page in order; panics where one is closed that is not open.
fn balanced(page: &str) {
    const VOID: [&str; 3] = ["meta", "!DOCTYPE", "br"];
    let mut open: Vec<&str> = Vec::new();
    let page = page.split_once("<style>").unwrap();
    let page = page.1.split_once("</style>").unwrap().1;
    for tag in page.split('<').skip(1) {
        let (tag, _) = tag.split_once('>').unwrap();
        if tag.ends_with('/') {
            continue;
        }
        let name = tag.split([' ', '/']).find(|part| !part.is_empty()).unwrap();
        if tag.starts_with('/') {
            let expected = open.pop();
            assert!(expected.is_none_or(|expected| expected == name), "</{name}> closes {expected:?}");
        } else if !VOID.contains(&name) {
            open.push(name);
        }
    }
    assert_eq!(open, Vec::<&str>::new());
}

#[test]
fn what_a_step_costs_stands_beside_earlier_runs() {
    let folder = tempfile::tempdir().unwrap();
    let mut record = made::mixed();
    assert!(!written(&record, folder.path()).contains("Instructions per control step"));
    record.cost = made::costs();
    let page = written(&record, folder.path());
    balanced(&page);
    let start = page.find("id=\"cost\"").unwrap();
    let part = page[start..].split("</section>").next().unwrap();
    for said in [
        "3 332 worst (dq-pi), 2.0 % of the 168 000 of a 1 ms period, mean 3 280.",
        "<strong>30 % more than 2 563 of build 1a2b3c4d (run 20260301T093000Z-abcdef)</strong>",
        "<td class=\"number\">2 563</td><td class=\"number\">3 332 (+30 %)</td>",
        "<td class=\"number\">2 500</td><td class=\"number\">2 410 (−3.6 %)</td>",
        "the image that comes with the bench",
    ] {
        assert!(part.contains(said), "`{said}` is missing in {part}");
    }
}

#[test]
fn what_failed_comes_before_what_passed() {
    let folder = tempfile::tempdir().unwrap();
    let page = written(&made::mixed(), folder.path());
    let place = |index: usize| page.find(&format!("id=\"scenario-{index}\"")).unwrap();
    assert!(place(1) < place(2) && place(2) < place(0), "failed, inconclusive, passed");
    let summary = page.find("What did not pass").unwrap();
    let link = page.find("href=\"#scenario-1\"").unwrap();
    assert!(summary < link && link < place(1));
    assert!(page.contains("trial 1: 5.6320, expected ≤ 2") && page.contains("traces/paper/fig13-open-loop/001.csv"));
    balanced(&page);
}

#[test]
fn it_needs_nothing_else_and_runs_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let (mut closed, open) = (closed(), open());
    made::play(&mut closed, folder.path(), 2, Response::default(), 0.01);
    closed.title = "<script>alert(1)</script> & \"more\"".to_owned();
    let page = written(&made::run(vec![closed, open]), folder.path());
    assert!(page.contains("&lt;script&gt;alert(1)&lt;/script&gt; &amp;"));
    for foreign in ["<script", "src=", "http:", "https:", "@import", "url(", "<link"] {
        assert!(!page.contains(foreign), "{foreign}");
    }
    assert!(page.starts_with("<!DOCTYPE html><html lang=\"en\">"));
    balanced(&page);
}

#[test]
fn a_missing_trace_is_named_where_its_plots_would_stand() {
    let folder = tempfile::tempdir().unwrap();
    let (mut closed, open) = (closed(), open());
    made::play(&mut closed, folder.path(), 3, Response::default(), 0.01);
    fs::remove_file(folder.path().join(&closed.trials[0].trace)).unwrap();
    fs::write(folder.path().join(&closed.trials[1].trace), "no trace").unwrap();
    let page = written(&made::run(vec![closed, open]), folder.path());
    let closed = part(&page, 0);
    assert!(closed.contains("2 traces cannot be shown."), "{closed}");
    assert!(closed.contains("traces/paper/fig13-closed-loop/000.csv: "));
    assert!(closed.contains("traces/paper/fig13-closed-loop/001.csv: line 1: columns"));
    assert!(!page.contains(&folder.path().display().to_string()), "a report travels");
    // The third one is shown.
    assert!(closed.contains("Amplitude |W|") && closed.contains("class=\"s-first\""));
    // A scenario without any trial has no plots.
    assert!(!part(&page, 1).contains("<figure>"));
}

#[test]
fn settling_is_marked_where_it_happens() {
    let folder = tempfile::tempdir().unwrap();
    let mut closed = closed();
    made::play(&mut closed, folder.path(), 1, Response { duration_ms: 10.0, ..Response::default() }, 0.0);
    let settling = closed.trials[0].metrics["settling_time_ms"].as_f64().unwrap();
    assert!((settling - 1.949).abs() < 1e-3, "{settling}");
    let page = written(&made::run(vec![closed.clone()]), folder.path());
    let closed_part = part(&page, 0);
    assert!(closed_part.contains("settled after 1.948 ms"), "{closed_part}");
    // 0 ms to 10 ms are spread over x = 264 to 2184; the step is at 1 ms.
    let mark = closed_part.split("class=\"s-settling\"").nth(1).unwrap().split('"').nth(1).unwrap();
    let x: f64 = mark.split(',').next().unwrap().parse().unwrap();
    let expected = 264.0 + (1.0 + settling) / 10.0 * (2184.0 - 264.0);
    assert!((x - expected).abs() < 2.0, "{x}, expected {expected}");

    closed.trials[0].metrics["settling_time_ms"] = Value::Null;
    let page = written(&made::run(vec![closed]), folder.path());
    assert!(part(&page, 0).contains("trial 0 does not settle"));
    assert!(!part(&page, 0).contains("settled after"));
}

#[test]
fn a_short_response_is_shown_on_its_own() {
    let folder = tempfile::tempdir().unwrap();
    let mut closed = closed();
    made::play(&mut closed, folder.path(), 1, Response::default(), 0.0);
    let page = written(&made::run(vec![closed]), folder.path());
    assert!(page.contains("Response to the setpoint step") && page.contains("Whole trial"));
}

#[test]
fn the_open_loop_stands_behind_the_closed_loop_only() {
    let folder = tempfile::tempdir().unwrap();
    let (mut closed, mut open) = (closed(), open());
    let stranger = ScenarioRecord { file: "limits/fig13-closed-loop.toml".to_owned(), ..closed.clone() };
    let mut stranger = ScenarioRecord { title: "No pair".to_owned(), ..stranger };
    let slow = Response { time_constant_ms: 1.88, ..Response::default() };
    made::play(&mut closed, folder.path(), 2, Response::default(), 0.01);
    made::play(&mut open, folder.path(), 2, slow, 0.01);
    made::play(&mut stranger, folder.path(), 1, Response::default(), 0.0);
    let page = written(&made::run(vec![closed, open, stranger]), folder.path());
    let legend = "open loop (paper/fig13-open-loop.toml)";
    assert!(part(&page, 0).contains(legend));
    // Once in the response, once in the whole trial; the frequency's figure draws the resonance with it.
    assert_eq!(part(&page, 0).matches("class=\"s-other\" points").count(), 3);
    assert!(!part(&page, 1).contains(legend) && !part(&page, 2).contains(legend));
    assert_eq!(part(&page, 2).matches("class=\"s-other\" points").count(), 1);
}

#[test]
fn the_trial_that_decided_stands_out() {
    let folder = tempfile::tempdir().unwrap();
    let mut open = open();
    made::play(&mut open, folder.path(), 40, Response { time_constant_ms: 1.88, ..Response::default() }, 0.01);
    open.trials[35].metrics["settling_time_ms"] = json!(5.632);
    let page = written(&made::run(vec![open]), folder.path());
    let open = part(&page, 0);
    assert!(open.contains("trial 35, decided settling_time_ms") && open.contains("class=\"s-exhibit\""), "beyond 30");
    assert!(open.contains("range of 31 trials"));
    // In |W| and in the drive; its frequency is that of the first trial and would only hide it.
    assert_eq!(open.matches("class=\"s-exhibit\" points").count(), 2);
}

#[rstest]
#[case::none(Response::default(), &[])]
#[case::finger(Response { force_n: 2.0, ..Response::default() }, &["Finger force"])]
#[case::warm(Response { temperature_k: 9.0, ..Response::default() }, &["Temperature above the reference"])]
fn profiles_are_shown_where_there_are_any(#[case] response: Response, #[case] expected: &[&str]) {
    let folder = tempfile::tempdir().unwrap();
    let mut closed = closed();
    made::play(&mut closed, folder.path(), 1, response, 0.0);
    let page = written(&made::run(vec![closed]), folder.path());
    for title in ["Finger force", "Temperature above the reference"] {
        assert_eq!(page.contains(title), expected.contains(&title), "{title}");
    }
}

#[test]
fn saturation_is_shaded() {
    let folder = tempfile::tempdir().unwrap();
    let mut closed = closed();
    let weak = Response { drive_limit_vpp: 400.0, ..Response::default() };
    made::play(&mut closed, folder.path(), 1, weak, 0.0);
    let page = written(&made::run(vec![closed.clone()]), folder.path());
    assert!(page.contains("class=\"f-saturated\""));
    closed.trials.clear();
    made::play(&mut closed, folder.path(), 1, Response::default(), 0.0);
    let page = written(&made::run(vec![closed]), folder.path());
    assert!(!page.contains("class=\"f-saturated\""));
}

#[test]
fn ten_scenarios_of_thirty_trials_stay_below_five_megabytes() {
    let folder = tempfile::tempdir().unwrap();
    let scenarios = (0..10).map(|number| {
        let mut scenario = ScenarioRecord { file: format!("paper/s{number}-closed-loop.toml"), ..closed() };
        let response = Response { force_n: 2.0, temperature_k: 9.0, detuned_hz: 87.0, ..Response::default() };
        made::play(&mut scenario, folder.path(), 30, response, 0.02);
        scenario
    });
    let page = written(&made::run(scenarios.collect()), folder.path());
    assert!(page.contains("range of 30 trials"));
    assert!(page.len() < 5_000_000, "{} bytes", page.len());
}

#[test]
fn a_minute_at_full_resolution_is_thinned() {
    let folder = tempfile::tempdir().unwrap();
    let mut closed = closed();
    made::play(
        &mut closed,
        folder.path(),
        1,
        Response { duration_ms: 60_000.0, step_ms: 1.0, ..Response::default() },
        0.0,
    );
    let page = written(&made::run(vec![closed]), folder.path());
    assert!(page.len() < 200_000, "{} bytes", page.len());
}

#[test]
fn the_environment_is_all_there() {
    let folder = tempfile::tempdir().unwrap();
    let mut record = made::mixed();
    record.complete = false;
    record.verdict = Verdict::Fail;
    let page = written(&record, folder.path());
    let hash = "a".repeat(64);
    for fact in [
        "platebench 0.1.0",
        "hosted",
        "dq-pi 0.1.0, build 5f3a9c01",
        "lockstep",
        "linux, x86_64",
        "seed 7",
        &hash,
        "was not finished",
    ] {
        assert!(page.contains(fact), "{fact}");
    }
    assert_eq!(page.matches(&hash).count(), 1, "an input that several scenarios share is listed once");
}
