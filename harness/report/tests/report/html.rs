//! `report.html`.

use crate::made::{self, Response};
use platebench_report::html;
use platebench_trace::{Flags, Writer};
use platebench_verdict::golden::{Accepted, Build, Features, Golden};
use platebench_verdict::{Definition, ExpectationRecord, RunRecord, ScenarioRecord, Verdict};
use rstest::rstest;
use serde_json::{Value, json};
use std::fs;
use std::path::Path;

pub(crate) fn written(record: &RunRecord, folder: &Path) -> String {
    html::write(record, folder).unwrap();
    fs::read_to_string(folder.join(html::FILE)).unwrap()
}

pub(crate) fn closed() -> ScenarioRecord {
    let settling = made::passed("settling_time_ms", ("at_most", json!(2.0)), 1.949);
    made::scenario("paper/fig13-closed-loop.toml", "Closed loop", "dq-pi", vec![settling])
}

pub(crate) fn open() -> ScenarioRecord {
    let settling = made::passed("settling_time_ms", ("at_most", json!(2.0)), 5.632);
    let settling = made::failed(settling, "trial 0: 5.6320, expected ≤ 2");
    made::scenario("paper/fig13-open-loop.toml", "Open loop", "open-loop", vec![settling])
}

/// The part of the page that belongs to the scenario with that number.
pub(crate) fn part(page: &str, index: usize) -> &str {
    let start = page.find(&format!("id=\"scenario-{index}\"")).unwrap();
    page[start..].split("</section>").next().unwrap()
}

/// The page without these elements and what they hold.
fn without(page: &str, element: &str) -> String {
    let (start, end) = (format!("<{element}"), format!("</{element}>"));
    let mut parts = page.split(&start);
    let first = parts.next().unwrap().to_owned();
    parts.fold(first, |kept, part| kept + part.split_once(&end).unwrap().1)
}

/// What the scripts of the scenarios draw, in the order of the page.
pub(crate) fn curves(page: &str) -> Vec<Value> {
    let parts = page.split("<script class=\"curves\" type=\"application/json\">").skip(1);
    parts.map(|part| serde_json::from_str(part.split_once("</script>").unwrap().0).unwrap()).collect()
}

/// The texts of the keys of a scenario's panel.
pub(crate) fn keys(curves: &Value, panel: usize) -> Vec<String> {
    let groups = curves["panels"][panel]["groups"].as_array().unwrap().iter();
    groups.map(|group| group["text"].as_str().unwrap().to_owned()).collect()
}

/// The elements of a page in order; panics where one is closed that is not open.
fn balanced(page: &str) {
    const VOID: [&str; 3] = ["meta", "!DOCTYPE", "br"];
    let mut open: Vec<&str> = Vec::new();
    let page = without(&without(page, "style"), "script");
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
    assert!(page.contains("5.632 ms</strong> in trial 1") && page.contains("traces/paper/fig13-open-loop/001.csv"));
    balanced(&page);
}

#[test]
fn it_needs_nothing_else_and_no_title_ends_its_data() {
    const TITLE: &str = "</script><script>alert(1)</script> & \"more\" ' <!--";
    let folder = tempfile::tempdir().unwrap();
    let (mut closed, open) = (closed(), open());
    made::play(&mut closed, folder.path(), 2, Response::default(), 0.01);
    closed.title = TITLE.to_owned();
    let page = written(&made::run(vec![closed, open]), folder.path());
    assert!(page.contains("&lt;/script&gt;&lt;script&gt;alert(1)&lt;/script&gt; &amp;"));
    // The data of one scenario, the library, the script.
    assert_eq!(page.matches("<script").count(), 3);
    assert_eq!(page.matches("</script>").count(), 3);
    assert_eq!(curves(&page)[0]["title"], TITLE);
    let own = without(&page, "script");
    for foreign in ["src=", "http:", "https:", "@import", "url(", "<link"] {
        assert!(!own.contains(foreign), "{foreign}");
    }
    assert!(!page.contains(" src=") && page.contains("default-src 'none'"));
    assert!(page.starts_with("<!DOCTYPE html><html lang=\"en\">"));
    assert!(page.contains("Copyright (c) 2022 Leon Sorokin"), "the library's licence asks for that");
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
    let x: f64 = mark.strip_prefix('m').unwrap().split(' ').next().unwrap().parse().unwrap();
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
    assert_eq!(part(&page, 0).matches("class=\"s-other\" d=").count(), 3);
    assert!(!part(&page, 1).contains(legend) && !part(&page, 2).contains(legend));
    assert_eq!(part(&page, 2).matches("class=\"s-other\" d=").count(), 1);
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
    assert_eq!(open.matches("class=\"s-exhibit\" d=").count(), 2);
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

#[rstest]
#[case::ten(10)]
#[case::forty(40)]
#[case::hundred(100)]
fn a_run_of_thirty_trials_each_stays_below_five_megabytes(#[case] count: usize) {
    let folder = tempfile::tempdir().unwrap();
    let mut played = closed();
    let response = Response { force_n: 2.0, temperature_k: 9.0, detuned_hz: 87.0, step_ms: 0.1, ..Response::default() };
    made::play(&mut played, folder.path(), 30, response, 0.02);
    // All play the same traces: what is drawn counts, not what is read.
    let of = |number: usize| ScenarioRecord { file: format!("paper/s{number}-closed-loop.toml"), ..played.clone() };
    let page = written(&made::run((0..count).map(of).collect()), folder.path());
    let curves = curves(&page);
    assert_eq!(curves.len(), count);
    assert!(keys(&curves[0], 0).contains(&"5 % to 95 % of 30 trials".to_owned()));
    assert!(page.contains("range of 30 trials"));
    let (drawn, packed) = (page.matches("<svg").count(), curves.iter().map(|one| one.to_string().len()).sum::<usize>());
    assert!(page.len() < 5_000_000, "{} bytes, {packed} of them curves, {drawn} drawings", page.len());
}

#[test]
fn the_band_of_the_expectation_is_drawn() {
    let folder = tempfile::tempdir().unwrap();
    let mut closed = closed();
    closed.expectations[0].definition =
        Definition { from_ms: None, band_percent: Some(1.0), signal: Some("amplitude_um".to_owned()) };
    made::play(&mut closed, folder.path(), 1, Response::default(), 0.0);
    let page = written(&made::run(vec![closed.clone()]), folder.path());
    assert!(page.contains("1 % band") && !page.contains("5 % band"));
    assert!(keys(&curves(&page)[0], 0).contains(&"1 % band".to_owned()));
    // Around the component that was looked at, instead of |W|.
    closed.expectations[0].definition.signal = Some("wd_um".to_owned());
    let page = written(&made::run(vec![closed]), folder.path());
    let curves = curves(&page);
    assert!(
        !keys(&curves[0], 0).contains(&"1 % band".to_owned()) && keys(&curves[0], 3).contains(&"1 % band".to_owned())
    );
}

#[test]
fn overruns_and_lost_links_are_marked_where_they_happened() {
    let folder = tempfile::tempdir().unwrap();
    let mut closed = closed();
    made::play(&mut closed, folder.path(), 2, Response::default(), 0.0);
    let clean = curves(&written(&made::run(vec![closed.clone()]), folder.path()));
    assert!(!keys(&clean[0], 1).iter().any(|key| key.contains("overrun") || key.contains("lost")));
    // In the second trial, whose curves are those of the first.
    let path = folder.path().join(&closed.trials[1].trace);
    let mut rows = platebench_trace::read(&path).unwrap();
    rows[400].flags |= Flags::OVERRUN;
    for row in &mut rows[600..620] {
        row.flags |= Flags::LINK_LOST;
    }
    let mut writer = Writer::create(&path).unwrap();
    for row in &rows {
        writer.write(row).unwrap();
    }
    writer.finish().unwrap();
    let found = curves(&written(&made::run(vec![closed]), folder.path()));
    let drive = &found[0]["panels"][1];
    let keys = keys(&found[0], 1);
    let at = |text: &str| keys.iter().position(|key| key == text).unwrap_or_else(|| panic!("{text}: {keys:?}"));
    assert_eq!(drive["marks"], json!([[at("overrun of the bench (1)"), rows[400].t_s * 1e3]]));
    assert_eq!(drive["spans"], json!([[at("link lost"), rows[600].t_s * 1e3, rows[620].t_s * 1e3]]));
}

#[test]
fn a_golden_trace_stands_in_its_tube() {
    let (folder, baselines) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    let mut closed = closed();
    made::play(&mut closed, folder.path(), 2, Response::default(), 0.01);
    let rows = platebench_trace::read(&folder.path().join(&closed.trials[0].trace)).unwrap();
    let accepted = Accepted {
        scenario: closed.file.clone(),
        law: "dq-pi".to_owned(),
        build: Build { rig: "hosted".to_owned(), firmware: "dq-pi 0.1.0".to_owned(), id: "5f3a9c01".to_owned() },
        features: Features::of(&rows),
        learned: None,
        golden: Golden::of_rows(&rows).unwrap(),
    };
    accepted.write(baselines.path()).unwrap();
    let record = made::run(vec![closed, open()]);
    let path = folder.path().join(html::FILE);
    html::Page::new(&record, folder.path()).with_baselines(baselines.path()).write(&path).unwrap();
    let page = fs::read_to_string(&path).unwrap();
    for panel in 0..3 {
        let keys = keys(&curves(&page)[0], panel);
        assert!(keys.contains(&"golden trace (dq-pi)".to_owned()), "{panel}: {keys:?}");
        assert!(keys.contains(&"tolerance tube of the golden trace (dq-pi)".to_owned()), "{panel}: {keys:?}");
    }
    fs::write(baselines.path().join("paper/fig13-closed-loop.toml"), "no baseline").unwrap();
    html::Page::new(&record, folder.path()).with_baselines(baselines.path()).write(&path).unwrap();
    assert!(fs::read_to_string(&path).unwrap().contains("The baseline cannot be shown: "));
}

#[test]
fn two_runs_stand_side_by_side() {
    let (here, there) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    let (mut now, mut then) = (closed(), closed());
    then.expectations[0].value = Some(1.5);
    now = ScenarioRecord { expectations: vec![made::failed(now.expectations.remove(0), "too slow")], ..now };
    made::play(&mut now, here.path(), 2, Response::default(), 0.01);
    made::play(&mut then, there.path(), 2, Response { time_constant_ms: 0.5, ..Response::default() }, 0.01);
    let same = ScenarioRecord { file: "a.toml".to_owned(), ..closed() };
    let (now, then) = (made::run(vec![same.clone(), now]), made::run(vec![same, then, open()]));
    let path = here.path().join(html::COMPARISON_FILE);
    html::Page::new(&now, here.path()).against(&then, there.path()).write(&path).unwrap();
    let page = fs::read_to_string(&path).unwrap();
    balanced(&page);
    let table = page.split("id=\"against\"").nth(1).unwrap().split("</section>").next().unwrap();
    assert!(table.contains("2 verdicts differ"), "{table}");
    assert!(table.contains("+0.449 (+29.9 %)") || table.contains("+0.449 (+30 %)"), "{table}");
    assert!(table.contains("paper/fig13-open-loop.toml") && table.contains("not played"), "{table}");
    let place = |file: &str| table.find(file).unwrap();
    assert!(place("fig13-closed-loop.toml") < place("a.toml"), "what changed comes first");
    let name = there.path().file_name().unwrap().to_str().unwrap();
    assert!(keys(&curves(&page)[0], 0).contains(&format!("trial 0 of {name}")));
    assert!(part(&page, 1).matches(&format!("trial 0 of {name}")).count() > 1, "also without scripts");
}

#[test]
fn why_is_said_once() {
    let folder = tempfile::tempdir().unwrap();
    let page = written(&made::mixed(), folder.path());
    let points = page.split("id=\"open\"").nth(1).unwrap().split("</section>").next().unwrap();
    assert!(
        points.contains("<strong>5.632 ms</strong> in trial 1, demanded <span class=\"number\">≤ 2 ms</span>"),
        "{points}"
    );
    assert!(!page.contains("5.6320"), "the same number again");
    // What says more than the numbers stays.
    assert!(points.contains("saturated: holding the setpoint needs 668 Vpp"), "{points}");
    // A value of all trials is none of one trial's.
    assert!(points.contains("<strong>1.25 %</strong>, demanded"), "{points}");
}

#[test]
fn what_never_settled_is_said_to_have_never_done_so() {
    let folder = tempfile::tempdir().unwrap();
    let page = written(&made::mixed(), folder.path());
    assert!(page.contains("<strong>never</strong>, demanded <span class=\"number\">≤ 2 ms</span>"), "{page}");
    assert!(part(&page, 1).contains("<strong><span>never"), "{}", part(&page, 1));
    // A number that could not be had for another reason is not one that never came.
    let mut record = made::mixed();
    record.scenarios[1].expectations[1].reason = Some("trial 2: the setpoint never steps".to_owned());
    assert!(!written(&record, folder.path()).contains(">never"));
}

#[test]
fn columns_that_say_nothing_are_left_out() {
    let folder = tempfile::tempdir().unwrap();
    let columns = |change: &dyn Fn(&mut ExpectationRecord)| {
        let mut closed = closed();
        closed.expectations[0].interval = Some([1.949, 1.949]);
        change(&mut closed.expectations[0]);
        let page = written(&made::run(vec![closed]), folder.path());
        ["Paper", "Interval"].map(|column| {
            part(&page, 0).matches(&format!("{column}<")).count()
                + part(&page, 0).matches(&format!("data-label=\"{column}\"")).count()
        })
    };
    assert_eq!(columns(&|_| ()), [0, 0]);
    assert_eq!(columns(&|found| found.paper = Some(2.0)), [2, 0]);
    assert_eq!(columns(&|found| found.interval = Some([1.948, 1.949])), [0, 2]);
    // Bounds are bounds, however close.
    assert_eq!(columns(&|found| "mean".clone_into(&mut found.statistic)), [0, 2]);
}

#[test]
fn a_trace_is_a_link_that_leads_nowhere_else() {
    let folder = tempfile::tempdir().unwrap();
    let mut record = made::mixed();
    let page = written(&record, folder.path());
    let link = "<a href=\"./traces/paper/fig13-open-loop/001.csv\">traces/paper/fig13-open-loop/001.csv</a>";
    // In what did not pass, beside the requirement and among the trials.
    assert_eq!(page.matches(link).count(), 3);
    for (name, url) in [
        ("javascript:alert(1)", "./javascript%3Aalert%281%29"),
        ("//else.where/a b.csv", ".///else.where/a%20b.csv"),
        ("a#b?c%d\"µ.csv", "./a%23b%3Fc%25d%22%C2%B5.csv"),
    ] {
        name.clone_into(&mut record.scenarios[1].trials[1].trace);
        let page = written(&record, folder.path());
        assert_eq!(page.matches(&format!("href=\"{url}\"")).count(), 3, "{name}");
        balanced(&page);
    }
}

/// A trace that is not the run's, of a trial that decided and of one that is not even read.
#[test]
fn changed_traces_are_named_and_not_drawn() {
    let folder = tempfile::tempdir().unwrap();
    let (mut open, mut closed) = (open(), closed());
    made::play(&mut open, folder.path(), 40, Response { time_constant_ms: 1.88, ..Response::default() }, 0.01);
    made::play(&mut closed, folder.path(), 1, Response::default(), 0.0);
    open.trials[0].metrics["settling_time_ms"] = json!(5.632);
    let record = made::run(vec![open, closed]);
    let shown = |record: &RunRecord, is_changed: html::IsChanged| {
        let path = folder.path().join(html::FILE);
        html::Page::new(record, folder.path()).without_changed_traces(is_changed).write(&path).unwrap();
        fs::read_to_string(path).unwrap()
    };
    assert!(!shown(&record, |_, _| false).contains("not the file"));
    let page = shown(&record, |_, trial| trial.trace.contains("open") && (trial.index == 0 || trial.index == 39));
    balanced(&page);
    assert!(page.contains("2 traces are not the file that the run was made with"));
    assert!(
        page.contains("001.csv") && page.contains("open-loop/000.csv</a>, not the file that the run was made with")
    );
    let open = part(&page, 0);
    assert!(
        open.contains("1 trace cannot be shown.") && open.contains("000.csv: not the file that the run was made with"),
        "{open}"
    );
    assert!(keys(&curves(&page)[0], 0).contains(&"trial 1".to_owned()), "the first of those that are the run's");
    // Where all passed it is said as well.
    let passed = made::run(vec![record.scenarios[1].clone()]);
    let page = shown(&passed, |_, _| true);
    assert!(page.contains("What was changed") && !page.contains("What did not pass") && !page.contains("<figure>"));
    // The other run's traces are held to that run.
    let path = folder.path().join(html::COMPARISON_FILE);
    let elsewhere = tempfile::tempdir().unwrap();
    let other = record.clone();
    for trial in record.scenarios.iter().flat_map(|scenario| &scenario.trials) {
        Response::default().write(elsewhere.path(), trial);
    }
    let name = elsewhere.path().file_name().unwrap().to_str().unwrap();
    for (is_changed, drawn) in
        [((|_, _| false) as html::IsChanged, true), (|folder, _| !folder.join(html::FILE).exists(), false)]
    {
        let page = html::Page::new(&record, folder.path()).without_changed_traces(is_changed);
        page.against(&other, elsewhere.path()).write(&path).unwrap();
        let page = fs::read_to_string(&path).unwrap();
        assert_eq!(keys(&curves(&page)[0], 0).contains(&format!("trial 0 of {name}")), drawn);
    }
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
    assert!(page.len() < 300_000, "{} bytes", page.len());
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
