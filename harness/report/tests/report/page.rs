//! Tests `report.html`.

use crate::fixtures::{self, Response, closed_loop, open_loop};
use crate::page_text::{assert_balanced, page_text, section, strip_elements};
use platebench_model::record::{
    ExpectationRecord, LoopSymptom, Reason, RunRecord, ScenarioRecord, Statistic, TrialFinding, TrialRecord,
    UndefinedValue, Verdict,
};
use platebench_model::trace::{Flags, TraceWriter};
use platebench_report::page::{self, IsTraceChanged, ReportPage};
use rstest::rstest;
use serde_json::{Value, json};
use std::fs;
use std::path::Path;

pub(crate) fn write_page(record: &RunRecord, folder: &Path) -> String {
    page::write(&fixtures::with_worst_instants(record, folder), folder).unwrap();
    fs::read_to_string(folder.join(page::FILE)).unwrap()
}

fn scenario_section(page: &str, index: usize) -> &str {
    section(page, &format!("scenario-{index}"))
}

pub(crate) fn plot_data(page: &str) -> Vec<Value> {
    let parts = page.split("<script class=\"curves\" type=\"application/json\">").skip(1);
    parts.map(|part| serde_json::from_str(part.split_once("</script>").unwrap().0).unwrap()).collect()
}

pub(crate) fn legend_texts(curves: &Value, figure: usize) -> Vec<String> {
    let groups = curves["panels"][figure]["groups"].as_array().unwrap().iter();
    groups.map(|group| group["text"].as_str().unwrap().to_owned()).collect()
}

#[test]
fn the_first_screen_names_a_wrong_sign() {
    let folder = tempfile::tempdir().unwrap();
    let with_symptom = |mut record: RunRecord| {
        let verdict = record.verdict;
        let scenario = record.scenarios.iter_mut().find(|scenario| scenario.verdict == verdict).unwrap();
        scenario.trials[0].symptom = Some(LoopSymptom::NoDrive);
        write_page(&record, folder.path())
    };
    let failed = with_symptom(fixtures::run_with_traces(folder.path()));
    let card = failed.split_once("<ol class=\"open\">").unwrap().1;
    assert!(card.contains("<p class=\"notice\">trial 0: ") && card.contains("sign of the amplitude loop?"));
    let mut closed = closed_loop();
    fixtures::write_trials(&mut closed, folder.path(), 1, Response::default(), 0.0);
    let passed = fixtures::run(vec![closed]);
    assert_eq!(passed.verdict, Verdict::Pass);
    let passed = with_symptom(passed);
    assert!(passed.contains("sign of the amplitude loop?") && !passed.contains("What did not pass"));
}

#[test]
fn a_failing_card_contains_the_plot_with_step_and_violation() {
    let folder = tempfile::tempdir().unwrap();
    let page = write_page(&fixtures::run_with_traces(folder.path()), folder.path());
    let plots: Vec<&str> = page.split("<div class=\"failure\">").skip(1).collect();
    assert_eq!(plots.len(), 2, "one for each scenario that did not pass");
    let plot = plots[0].split_once("</div>").unwrap().0;
    let labels: Vec<&str> = plot.split("aria-label=\"").skip(1).map(|part| part.split_once('"').unwrap().0).collect();
    let [amplitude, drive, frequency] = &labels[..] else { panic!("{labels:?}") };
    for part in ["Amplitude |W| in µm", "5 % band", "setpoint", "last outside the band"] {
        assert!(amplitude.contains(part), "{part}: {amplitude}");
    }
    assert!(drive.starts_with("Drive in Vpp") && frequency.starts_with("Excitation frequency"), "{labels:?}");
    // The step is at 1 ms, and the slowest trial enters the band after 7 ms.
    assert!(amplitude.contains("against time, 0.35 to 8.8 ms"), "{amplitude}");
}

#[test]
fn cards_with_one_cause_are_folded_into_one() {
    let folder = tempfile::tempdir().unwrap();
    let record = fixtures::trapped_run(40);
    page::write(&record, folder.path()).unwrap();
    let text = std::fs::read_to_string(folder.path().join(page::FILE)).unwrap();
    let start = text.find("<ol class=\"open\">").unwrap();
    let cards = &text[start..start + text[start..].find("</ol>").unwrap()];
    assert!(cards.contains("40 scenarios, 80 expectations, 40 trials with one cause"), "{cards}");
    assert_eq!((cards.matches("<li class=").count(), cards.matches("HardFault").count()), (1, 1), "{cards}");
    let (_, folded) = cards.split_once("<details>").unwrap();
    assert!((0..40).all(|place| folded.contains(&format!("paper/{place}.toml"))), "{folded}");
}

#[test]
fn shows_every_outcome() {
    let folder = tempfile::tempdir().unwrap();
    let mut record = fixtures::mixed_run();
    record.complete = false;
    record.cost = fixtures::cost_trends();
    let page = write_page(&record, folder.path());
    assert_balanced(&page);
    insta::assert_snapshot!(page_text(&page));
}

#[test]
fn shows_figures_of_every_kind() {
    let folder = tempfile::tempdir().unwrap();
    let page = write_page(&fixtures::run_with_traces(folder.path()), folder.path());
    assert_balanced(&page);
    let figures = |index: usize| {
        let part = scenario_section(&page, index);
        let end = part.find("<details").unwrap();
        page_text(&part[part.find("class=\"drawings\"").unwrap()..end])
    };
    insta::assert_snapshot!([1, 2, 0].map(figures).join("\n\n"));
}

#[test]
fn loads_nothing_and_no_title_ends_its_data() {
    const TITLE: &str = "</script><script>alert(1)</script> & \"more\" ' <!--";
    let folder = tempfile::tempdir().unwrap();
    let (mut closed, open) = (closed_loop(), open_loop());
    fixtures::write_trials(&mut closed, folder.path(), 2, Response::default(), 0.01);
    closed.title = TITLE.to_owned();
    let page = write_page(&fixtures::run(vec![closed, open]), folder.path());
    assert!(page.contains("&lt;/script&gt;&lt;script&gt;alert(1)&lt;/script&gt; &amp;"));
    // Three scripts: the data of one scenario, the library, the script of the page.
    assert_eq!((page.matches("<script").count(), page.matches("</script>").count()), (3, 3));
    assert_eq!(plot_data(&page)[0]["title"], TITLE);
    let own = strip_elements(&page, "script");
    for foreign in ["src=", "http:", "https:", "@import", "url(", "<link"] {
        assert!(!own.contains(foreign), "{foreign}");
    }
    assert!(!page.contains(" src=") && page.contains("default-src 'none'"));
    assert!(page.starts_with("<!DOCTYPE html><html lang=\"en\">"));
    assert!(page.contains("Copyright (c) 2022 Leon Sorokin"), "the library's licence requires it");
    assert_balanced(&page);
}

#[test]
fn lists_missing_and_damaged_traces() {
    let folder = tempfile::tempdir().unwrap();
    let (mut closed, open) = (closed_loop(), open_loop());
    fixtures::write_trials(&mut closed, folder.path(), 3, Response::default(), 0.01);
    fs::remove_file(folder.path().join(&closed.trials[0].trace)).unwrap();
    fs::write(folder.path().join(&closed.trials[1].trace), "no trace").unwrap();
    let page = write_page(&fixtures::run(vec![closed, open]), folder.path());
    let text = page_text(scenario_section(&page, 0));
    let (_, notice) = text.split_once("2 traces cannot be shown:\n").unwrap();
    let notice: Vec<&str> = notice.lines().take(2).collect();
    assert_eq!(notice[0], "traces/paper/fig13-closed-loop/000.csv: No such file or directory (os error 2)");
    assert!(notice[1].starts_with("traces/paper/fig13-closed-loop/001.csv: line 1: columns"), "{notice:?}");
    assert!(!page.contains(&folder.path().display().to_string()), "a report is read elsewhere");
    assert!(text.contains("[Amplitude |W| in µm") && text.contains("trial 2"), "{text}");
    assert!(!scenario_section(&page, 1).contains("<figure>"));
}

#[test]
fn the_open_loop_is_behind_its_closed_loop_only() {
    let folder = tempfile::tempdir().unwrap();
    let (mut closed, mut open) = (closed_loop(), open_loop());
    let mut other = ScenarioRecord { file: "limits/fig13-closed-loop.toml".to_owned(), ..closed.clone() };
    let slow = Response { time_constant_ms: 1.88, ..Response::default() };
    fixtures::write_trials(&mut closed, folder.path(), 2, Response::default(), 0.01);
    fixtures::write_trials(&mut open, folder.path(), 2, slow, 0.01);
    fixtures::write_trials(&mut other, folder.path(), 1, Response::default(), 0.0);
    let page = write_page(&fixtures::run(vec![closed, open, other]), folder.path());
    let lines = |index| scenario_section(&page, index).matches("class=\"s-open-loop\" d=").count();
    // |W| and drive have a line and an entry of the legend in two views, the frequency in one.
    assert_eq!([lines(0), lines(1), lines(2)], [5, 0, 0]);
    assert_eq!(scenario_section(&page, 0).matches("</svg>open loop (paper/fig13-open-loop.toml)").count(), 5);
}

#[test]
fn reads_the_trial_that_decided_beyond_the_limit() {
    let folder = tempfile::tempdir().unwrap();
    let mut open = open_loop();
    let slow = Response { time_constant_ms: 1.88, ..Response::default() };
    fixtures::write_trials(&mut open, folder.path(), 40, slow, 0.01);
    open.trials[35].metrics.set("settling_time_ms", Some(5.632));
    let page = write_page(&fixtures::run(vec![open]), folder.path());
    let open = scenario_section(&page, 0);
    assert!(open.contains("5 % to 95 % of 31 trials"));
    // Trial 35 is in |W| and drive of both views. Its frequency equals that of the first trial.
    assert_eq!(open.matches("</svg>trial 35, decided settling_time_ms").count(), 4);
    assert_eq!(open.matches("class=\"s-deciding-trial\" d=").count(), 4);
}

#[rstest]
#[case("amplitude_um", 0)]
#[case("wd_um", 3)]
fn draws_the_band_of_the_expectation(#[case] signal: &str, #[case] figure: usize) {
    let folder = tempfile::tempdir().unwrap();
    let mut closed = closed_loop();
    closed.expectations[0].definition = fixtures::settling_definition(1.0, signal);
    fixtures::write_trials(&mut closed, folder.path(), 1, Response::default(), 0.0);
    let curves = &plot_data(&write_page(&fixtures::run(vec![closed]), folder.path()))[0];
    for number in [0, 3] {
        let has_band = legend_texts(curves, number).contains(&"1 % band".to_owned());
        assert_eq!(has_band, number == figure, "figure {number}");
    }
}

#[test]
fn marks_overruns_and_lost_links() {
    let folder = tempfile::tempdir().unwrap();
    let mut closed = closed_loop();
    fixtures::write_trials(&mut closed, folder.path(), 2, Response::default(), 0.0);
    // The flags are in the second trial, whose curves equal those of the first.
    let path = folder.path().join(&closed.trials[1].trace);
    let mut rows = platebench_model::trace::read_trace(&path).unwrap();
    rows[400].flags |= Flags::OVERRUN;
    for row in &mut rows[600..620] {
        row.flags |= Flags::LINK_LOST;
    }
    let mut writer = TraceWriter::create(&path).unwrap();
    for row in &rows {
        writer.write(row).unwrap();
    }
    writer.finish().unwrap();
    let curves = plot_data(&write_page(&fixtures::run(vec![closed]), folder.path()));
    assert_eq!(legend_texts(&curves[0], 1), ["trial 0", "link lost", "overrun of the bench (1)"]);
    let drive = &curves[0]["panels"][1];
    assert_eq!(drive["marks"], json!([[2, rows[400].t_s * 1e3]]));
    assert_eq!(drive["spans"], json!([[1, rows[600].t_s * 1e3, rows[620].t_s * 1e3]]));
}

#[test]
fn rows_in_memory_give_the_same_page_as_their_traces() {
    let folder = tempfile::tempdir().unwrap();
    let mut closed = closed_loop();
    fixtures::write_trials(&mut closed, folder.path(), 2, Response::default(), 0.01);
    let record = fixtures::run(vec![closed]);
    let from_files = write_page(&record, folder.path());
    let mut rows = page::RowCache::default();
    for trial in &record.scenarios[0].trials {
        let path = folder.path().join(&trial.trace);
        rows.add(&trial.trace, platebench_model::trace::read_trace(&path).unwrap());
        fs::remove_file(&path).unwrap();
    }
    let path = folder.path().join(page::FILE);
    ReportPage::new(&record, folder.path()).with_rows(rows).write(&path).unwrap();
    assert!(fs::read_to_string(&path).unwrap() == from_files);
    assert!(write_page(&record, folder.path()) != from_files, "without rows and traces");
}

#[test]
fn shows_golden_traces_and_their_tubes() {
    let (folder, baselines) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    let mut closed = closed_loop();
    fixtures::write_trials(&mut closed, folder.path(), 2, Response::default(), 0.01);
    fixtures::write_baseline(&closed, folder.path(), baselines.path());
    let record = fixtures::run(vec![closed, open_loop()]);
    let path = folder.path().join(page::FILE);
    ReportPage::new(&record, folder.path()).with_baselines(baselines.path()).write(&path).unwrap();
    let page = fs::read_to_string(&path).unwrap();
    for figure in 0..3 {
        let keys = legend_texts(&plot_data(&page)[0], figure);
        assert!(keys.contains(&"golden trace (dq-pi)".to_owned()), "{figure}: {keys:?}");
        assert!(keys.contains(&"tolerance tube of the golden trace (dq-pi)".to_owned()), "{figure}: {keys:?}");
    }
    fs::write(baselines.path().join("paper/fig13-closed-loop.toml"), "no baseline").unwrap();
    ReportPage::new(&record, folder.path()).with_baselines(baselines.path()).write(&path).unwrap();
    assert!(fs::read_to_string(&path).unwrap().contains("The baseline cannot be shown: "));
}

#[test]
fn compares_two_runs() {
    let (here, there) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    let there = there.path().join("other");
    let (mut now, mut then) = (closed_loop(), closed_loop());
    then.expectations[0].value = Some(1.5);
    let failed = fixtures::failed_expectation(now.expectations.remove(0), fixtures::never_settles(0));
    now = ScenarioRecord { expectations: vec![failed], ..now };
    fixtures::write_trials(&mut now, here.path(), 2, Response::default(), 0.01);
    fixtures::write_trials(&mut then, &there, 2, Response { time_constant_ms: 0.5, ..Response::default() }, 0.01);
    let same = ScenarioRecord { file: "a.toml".to_owned(), ..closed_loop() };
    let (now, then) = (fixtures::run(vec![same.clone(), now]), fixtures::run(vec![same, then, open_loop()]));
    let path = here.path().join(page::COMPARISON_FILE);
    ReportPage::new(&now, here.path()).with_other_run(&then, &there).write(&path).unwrap();
    let page = fs::read_to_string(&path).unwrap();
    assert_balanced(&page);
    insta::assert_snapshot!(page_text(section(&page, "against")));
    assert!(legend_texts(&plot_data(&page)[0], 0).contains(&"trial 0 of other".to_owned()));
    assert!(scenario_section(&page, 1).contains("</svg>trial 0 of other"), "also without scripts");
}

#[rstest]
#[case::neither(|_: &mut ExpectationRecord| (), "Metric | Verdict | Measured | Expected | Window")]
#[case::paper(
    |found: &mut ExpectationRecord| found.paper = Some(2.0), "Metric | Verdict | Measured | Paper | Expected | Window"
)]
#[case::range(
    |found: &mut ExpectationRecord| found.interval = Some([1.948, 1.949]),
    "Metric | Verdict | Measured | Expected | Interval | Window"
)]
#[case::bounds(
    |found: &mut ExpectationRecord| found.statistic = Statistic::Mean,
    "Metric | Verdict | Measured | Expected | Interval | Window"
)]
fn leaves_out_columns_without_information(#[case] change: fn(&mut ExpectationRecord), #[case] expected: &str) {
    let folder = tempfile::tempdir().unwrap();
    let mut closed = closed_loop();
    closed.expectations[0].interval = Some([1.949, 1.949]);
    change(&mut closed.expectations[0]);
    let page = write_page(&fixtures::run(vec![closed]), folder.path());
    let text = page_text(scenario_section(&page, 0));
    assert_eq!(text.lines().find(|line| line.starts_with("Metric")), Some(expected));
}

#[rstest]
#[case("javascript:alert(1)", "./javascript%3Aalert%281%29")]
#[case("//else.where/a b.csv", ".///else.where/a%20b.csv")]
#[case("a#b?c%d\"µ.csv", "./a%23b%3Fc%25d%22%C2%B5.csv")]
fn links_of_traces_stay_in_the_run_folder(#[case] name: &str, #[case] url: &str) {
    let folder = tempfile::tempdir().unwrap();
    let mut record = fixtures::mixed_run();
    name.clone_into(&mut record.scenarios[1].trials[1].trace);
    let page = write_page(&record, folder.path());
    assert_eq!(page.matches(&format!("href=\"{url}\"")).count(), 2);
    assert_balanced(&page);
}

#[test]
fn lists_changed_traces_instead_of_drawing_them() {
    let folder = tempfile::tempdir().unwrap();
    let (mut open, mut closed) = (open_loop(), closed_loop());
    let slow = Response { time_constant_ms: 1.88, ..Response::default() };
    fixtures::write_trials(&mut open, folder.path(), 40, slow, 0.01);
    fixtures::write_trials(&mut closed, folder.path(), 1, Response::default(), 0.0);
    open.trials[0].metrics.set("settling_time_ms", Some(5.632));
    let record = fixtures::run(vec![open, closed]);
    let render = |record: &RunRecord, is_changed: IsTraceChanged| {
        let path = folder.path().join(page::FILE);
        ReportPage::new(record, folder.path()).without_changed_traces(is_changed).write(&path).unwrap();
        fs::read_to_string(path).unwrap()
    };
    assert!(!render(&record, |_, _| false).contains("changed after the run"));
    let page = render(&record, |_, trial| trial.trace.contains("open") && (trial.index == 0 || trial.index == 39));
    assert_balanced(&page);
    insta::assert_snapshot!(page_text(section(&page, "open")));
    let open = page_text(scenario_section(&page, 0));
    let notice = "1 trace cannot be shown:\ntraces/paper/fig13-open-loop/000.csv: changed after the run\n";
    assert!(open.contains(notice), "{open}");
    assert!(legend_texts(&plot_data(&page)[0], 0).contains(&"trial 1".to_owned()), "the first unchanged trial");
    let passed = fixtures::run(vec![record.scenarios[1].clone()]);
    let page = render(&passed, |_, _| true);
    assert!(page.contains(">Changed traces<") && !page.contains("What did not pass") && !page.contains("<figure>"));
}

#[rstest]
#[case::unchanged(|_: &Path, _: &TrialRecord| false, true)]
#[case::changed(|folder: &Path, _: &TrialRecord| !folder.join(page::FILE).exists(), false)]
fn draws_the_other_run_unless_its_trace_changed(#[case] is_changed: IsTraceChanged, #[case] is_drawn: bool) {
    let (folder, elsewhere) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    let mut closed = closed_loop();
    fixtures::write_trials(&mut closed, folder.path(), 1, Response::default(), 0.0);
    let record = fixtures::run(vec![closed]);
    write_page(&record, folder.path());
    Response::default().write(elsewhere.path(), &record.scenarios[0].trials[0]);
    let path = folder.path().join(page::COMPARISON_FILE);
    let page = ReportPage::new(&record, folder.path()).without_changed_traces(is_changed);
    page.with_other_run(&record.clone(), elsewhere.path()).write(&path).unwrap();
    let keys = legend_texts(&plot_data(&fs::read_to_string(&path).unwrap())[0], 0);
    assert_eq!(keys.iter().any(|key| key.starts_with("trial 0 of ")), is_drawn, "{keys:?}");
}

#[test]
fn a_missing_value_for_another_reason_is_not_never() {
    let folder = tempfile::tempdir().unwrap();
    let mut record = fixtures::mixed_run();
    assert!(write_page(&record, folder.path()).contains(">never"));
    record.scenarios[1].expectations[1].reason = Some(Reason::Trial {
        trial: 2,
        divergence: None,
        finding: TrialFinding::Undefined(UndefinedValue::NoSetpointStep),
        ended: None,
        stopped: None,
    });
    assert!(!write_page(&record, folder.path()).contains(">never"));
}

#[test]
fn lists_failed_scenarios_first() {
    let folder = tempfile::tempdir().unwrap();
    let page = write_page(&fixtures::mixed_run(), folder.path());
    let place = |index: usize| page.find(&format!("id=\"scenario-{index}\"")).unwrap();
    assert!(place(1) < place(2) && place(2) < place(0), "failed, inconclusive, passed");
    assert_eq!(fixtures::mixed_run().scenarios[1].verdict, Verdict::Fail);
}

#[rstest]
#[case::small(40, 1.1, false)]
#[case::large(40, 1.3, true)]
#[case::after_a_touch(900, 1.3, false)]
fn remarks_on_a_settling_time_that_passes_with_a_large_overshoot(
    #[case] row: usize,
    #[case] peak: f64,
    #[case] expected: bool,
) {
    let folder = tempfile::tempdir().unwrap();
    let mut closed = closed_loop();
    let touched = Response { force_n: 0.1, ..Response::default() };
    fixtures::write_trials(&mut closed, folder.path(), 1, touched, 0.0);
    let path = folder.path().join(&closed.trials[0].trace);
    let mut rows = platebench_model::trace::read_trace(&path).unwrap();
    rows[row].amplitude_um = 2.0 * peak;
    let mut writer = TraceWriter::create(&path).unwrap();
    for row in &rows {
        writer.write(row).unwrap();
    }
    writer.finish().unwrap();
    let page = write_page(&fixtures::run(vec![closed]), folder.path());
    assert_eq!(page.contains("The settling time passes, but"), expected);
}

#[test]
fn marks_limit_window_and_worst_instant_of_a_missed_expectation() {
    let folder = tempfile::tempdir().unwrap();
    let missed = fixtures::failed_expectation(
        fixtures::passed_expectation("peak_deviation_percent", ("at_most", json!(1.0)), 3.0),
        fixtures::outside(0, 3.0, 1.0),
    );
    let missed = ExpectationRecord { windows_ms: vec![[15.0, 25.0], [35.0, 45.0]], ..missed };
    let mut tap = fixtures::scenario("tap.toml", "A tap", "dq-pi", vec![missed]);
    fixtures::write_trials(&mut tap, folder.path(), 1, Response { force_n: 2.0, ..Response::default() }, 0.0);
    let page = write_page(&fixtures::run(vec![tap]), folder.path());
    let curves = &plot_data(&page)[0];
    assert_eq!(curves["views"][0], json!(["peak_deviation_percent", 33.0, 47.0]), "opens at the window that decided");
    assert_eq!(curves["panels"][1]["title"], "Finger force", "directly below the amplitude");
    let amplitude = &curves["panels"][0];
    // The deviation of 6 % is largest at the end of the ramp.
    let [group, at_ms, value, text] = [0, 1, 2, 3].map(|field| amplitude["points"][0][field].clone());
    assert_eq!((at_ms.as_f64().unwrap().round(), text), (40.0, json!("1.88 µm at 40 ms")));
    assert!((value.as_f64().unwrap() - 1.88).abs() < 1e-9, "{value}");
    let keys = legend_texts(curves, 0);
    assert_eq!(keys[group.as_u64().unwrap() as usize], "peak_deviation_percent: worst");
    assert!(keys.contains(&"peak_deviation_percent ≤ 1 %, window 35 … 45 ms".to_owned()), "{keys:?}");
    assert_eq!(
        amplitude["spans"],
        json!([[keys.iter().position(|key| key == "window of peak_deviation_percent"), 35.0, 45.0]])
    );
    assert!(page.contains("; worst: <strong>1.88 µm at 40 ms</strong>"));
}
