//! Tests the interaction with the page.

use crate::driver::{Browser, BrowserOptions};
use crate::fixtures;
use platebench_document::{Block, Document, Table};
use platebench_model::record::Verdict;
use platebench_report::page;
use rstest::rstest;
use serde_json::{Value, json};
use std::path::{Path, PathBuf};
use std::process::Command;
use tempfile::TempDir;

const DESKTOP: BrowserOptions = BrowserOptions { width: 1280, height: 900, dark: false, scripts: true };
const PHONE: BrowserOptions = BrowserOptions { width: 390, height: 844, ..DESKTOP };
const TITLE: &str = "</script><b>\"A\" & 'B'</b>";
const READY: &str = "document.querySelector('.scenario:target .plots')?.dataset.ready === 'true'";
const SELECT_FIRST: &str = "location.hash = document.querySelector('.list ol a').hash";
const FRAME: &str = "new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(() => done(true))))";
const KEY: &str = "[...document.querySelectorAll('.keys button')].find((key) => key.textContent.startsWith('trial 0'))";
/// Start and end of the plots of the first scenario, ms.
const RANGE: &str = "(({from, to}) => [+from, +to])(document.querySelector('.tools').dataset)";

fn write_page(folder: &Path) -> PathBuf {
    let mut record = fixtures::run_with_traces(folder);
    TITLE.clone_into(&mut record.scenarios[2].title);
    record.cost = fixtures::cost_trends();
    let (other_folder, baselines) = (folder.join("other"), folder.join("baselines"));
    let mut other = fixtures::run_with_traces(&other_folder);
    other.scenarios[1].expectations[0].verdict = Verdict::Pass;
    fixtures::write_baseline(&record.scenarios[0], folder, &baselines);
    let path = folder.join(page::FILE);
    let report =
        page::ReportPage::new(&record, folder).with_baselines(&baselines).with_other_run(&other, &other_folder);
    report.write(&path).unwrap();
    path
}

fn open_page(options: BrowserOptions) -> Option<(Browser, TempDir)> {
    let browser = Browser::start_if_installed(options)?;
    let folder = TempDir::new().unwrap();
    browser.open(&write_page(folder.path()));
    Some((browser, folder))
}

fn assert_no_console_messages(browser: &Browser) {
    assert_eq!(browser.console_messages(), Vec::<Value>::new());
}

fn plot_range(browser: &Browser) -> [f64; 2] {
    serde_json::from_value(browser.evaluate(RANGE)).unwrap()
}

/// Left, top, width, height in the window.
fn element_rect(browser: &Browser, selector: &str) -> [f64; 4] {
    let expression = format!(
        "(() => {{ const found = document.querySelector({}); \
         found.scrollIntoView({{ block: 'center', behavior: 'instant' }}); \
         const {{ left, top, width, height }} = found.getBoundingClientRect(); \
         return [left, top, width, height]; }})()",
        json!(selector)
    );
    serde_json::from_value(browser.evaluate(&expression)).unwrap()
}

#[test]
fn plots_zoom_move_and_switch() {
    let Some((browser, _folder)) = open_page(DESKTOP) else { return };
    browser.evaluate(SELECT_FIRST);
    browser.wait_for(READY);
    let first = browser.evaluate("document.querySelector('.scenario:target').className");
    assert_eq!(first, "scenario fail", "failed scenarios are first");
    assert_eq!(browser.evaluate("getComputedStyle(document.querySelector('.drawings')).display"), "none");
    let titles =
        browser.evaluate("[...document.querySelectorAll('.scenario h2')].map((title) => title.textContent).join()");
    assert!(titles.as_str().unwrap().contains(TITLE), "{titles}");
    assert_eq!(browser.evaluate("document.querySelectorAll('.scenario h2 b').length"), 0);

    let start = plot_range(&browser);
    let pixels = "document.querySelector('.canvas canvas').toDataURL()";
    browser.evaluate(FRAME);
    let far = browser.evaluate(pixels);
    browser.evaluate("document.querySelector('[aria-label=\"Zoom in\"]').click()");
    let closer = plot_range(&browser);
    browser.evaluate(FRAME);
    assert_ne!(browser.evaluate(pixels), far, "the plot changes");
    assert!((closer[1] - closer[0] - (start[1] - start[0]) / 2.0).abs() < 1e-9, "{start:?} {closer:?}");
    browser.evaluate(
        "[...document.querySelectorAll('.tools button')].find((button) => \
         button.textContent === 'Whole trial').click()",
    );
    assert_eq!(plot_range(&browser), [0.0, 60.0], "the whole trial");
    let [left, top, width, height] = element_rect(&browser, ".canvas .u-over");
    let at = |share: f64| (left + share * width, top + height / 2.0);
    browser.drag(at(0.25), at(0.5));
    let dragged = plot_range(&browser);
    assert!((dragged[0] - 15.0).abs() < 0.3 && (dragged[1] - 30.0).abs() < 0.3, "{dragged:?}");
    let press = |key: &str| {
        browser.evaluate(&format!(
            "document.querySelector('.canvas').dispatchEvent(\
             new KeyboardEvent('keydown', {{ key: '{key}', bubbles: true }}))"
        ))
    };
    press("ArrowRight");
    let moved = plot_range(&browser);
    assert!(moved[0] > dragged[0] + 1.0 && (moved[1] - moved[0] - dragged[1] + dragged[0]).abs() < 1e-9, "{moved:?}");
    press("0");
    assert_eq!(plot_range(&browser), [0.0, 60.0]);
    for _ in 0..40 {
        press("+");
        press("ArrowLeft");
    }
    let deep = plot_range(&browser);
    assert!(deep[0] >= 0.0 && deep[1] <= 60.0 && deep[1] > deep[0], "{deep:?}");
    press("0");

    // The cursor shows values: the first trial of the open loop settles near 2 µm.
    browser.move_pointer(at(0.9));
    let value = format!("{KEY}.querySelector('.value').textContent");
    browser.wait_for(&format!("{value} !== ''"));
    let amplitude: f64 = browser.evaluate(&value).as_str().unwrap().parse().unwrap();
    assert!((amplitude - 2.0).abs() < 0.06, "{amplitude}");

    browser.move_pointer((1.0, 1.0));
    browser.evaluate(FRAME);
    let on = browser.evaluate(pixels);
    browser.evaluate(&format!("{KEY}.click()"));
    browser.evaluate(FRAME);
    let off = browser.evaluate(pixels);
    assert_eq!(browser.evaluate(&format!("{KEY}.getAttribute('aria-pressed')")), "false");
    assert_ne!(on, off);
    browser.evaluate(&format!("{KEY}.click()"));
    browser.evaluate(FRAME);
    assert_eq!(browser.evaluate(pixels), on);

    browser.devtools_command("Emulation.setEmulatedMedia", &json!({ "media": "print" }));
    let displays = "['.plots', '.drawings'].map((part) => getComputedStyle(document.querySelector(part)).display)";
    assert_eq!(browser.evaluate(displays), json!(["none", "block"]));

    assert_eq!(browser.evaluate("performance.getEntriesByType('resource').length"), 0, "no resource is loaded");
    assert_no_console_messages(&browser);
}

#[test]
fn shows_drawings_without_scripts() {
    let Some((browser, _folder)) = open_page(BrowserOptions { scripts: false, ..DESKTOP }) else { return };
    assert_eq!(browser.evaluate("document.querySelectorAll('.plots').length"), 0, "no script ran");
    let sizes =
        "[...document.querySelectorAll('.drawings figure > svg')].map((svg) => svg.getBoundingClientRect().width)";
    let sizes: Vec<f64> = serde_json::from_value(browser.evaluate(sizes)).unwrap();
    assert!(sizes.len() >= 12 && sizes.iter().all(|width| *width > 200.0), "{sizes:?}");
    element_rect(&browser, ".drawings");
    browser.save_screenshot("no-scripts");
    assert_no_console_messages(&browser);
}

#[rstest]
#[case::phone_light(PHONE, "phone-light")]
#[case::phone_dark(BrowserOptions { dark: true, ..PHONE }, "phone-dark")]
#[case::desk_light(DESKTOP, "desk-light")]
#[case::desk_dark(BrowserOptions { dark: true, ..DESKTOP }, "desk-dark")]
fn fits_every_screen_and_is_accessible(#[case] options: BrowserOptions, #[case] name: &str) {
    let Some((browser, _folder)) = open_page(options) else { return };
    browser.save_screenshot(&format!("{name}-top"));
    assert_eq!(browser.evaluate("document.querySelectorAll('.stacked').length"), 6);
    assert_fits(&browser);
    for number in 0..3 {
        browser.evaluate(&format!("location.hash = document.querySelectorAll('.list ol a')[{number}].hash"));
        browser.wait_for(READY);
        browser.evaluate(FRAME);
        browser.save_screenshot(&format!("{name}-{number}"));
        assert_fits(&browser);
        assert_accessible(&browser);
    }
    let band = "getComputedStyle([...document.querySelectorAll('.keys button')].find((key) => \
                key.textContent.startsWith('5 % band')).querySelector('.mark')).backgroundColor";
    let (band, opacity) = (browser.evaluate(band), if options.dark { "0.3" } else { "0.2" });
    assert!(band.as_str().unwrap().contains(&format!(", {opacity}")), "{band}");
    browser.evaluate("location.hash = '#overview'");
    assert_accessible(&browser);
    assert_no_console_messages(&browser);
}

/// Only the comparison of runs may be wider than the window, except on a phone.
fn assert_fits(browser: &Browser) {
    assert_eq!(browser.evaluate("document.documentElement.scrollWidth <= innerWidth"), true, "no horizontal scroll");
    let cut = "[...document.querySelectorAll('.stacked')].map((table) => table.parentElement).filter((part) => \
               part.scrollWidth > part.clientWidth \
               && (innerWidth < 640 || part.getAttribute('aria-label') !== 'Comparison of both runs')).length";
    assert_eq!(browser.evaluate(cut), 0, "no table needs a horizontal scroll");
}

fn assert_accessible(browser: &Browser) {
    browser.evaluate(&format!("window.axe ?? eval({}); true", json!(axe_source())));
    let found = browser.evaluate(
        "axe.run().then(({ violations }) => violations.map(({ id, help, nodes }) => \
         `${id}: ${help}: ` + nodes.slice(0, 3).map(({ html, failureSummary }) => \
         html.slice(0, 200) + failureSummary).join(' | ')))",
    );
    assert_eq!(found, json!([]), "{found:#}");
}

#[rstest]
#[case::phone(PHONE)]
#[case::phone_dark(BrowserOptions { dark: true, ..PHONE })]
#[case::desk(DESKTOP)]
#[case::desk_dark(BrowserOptions { dark: true, ..DESKTOP })]
fn pages_of_charts_fit_and_are_accessible(#[case] options: BrowserOptions) {
    let Some(browser) = Browser::start_if_installed(options) else { return };
    let folder = TempDir::new().unwrap();
    let wide = "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 900 100\" width=\"900\" height=\"100\"/>";
    let columns: Vec<_> = (0..9).map(|column| format!("response time of scene {column}")).collect();
    let mut table = Table::new(&columns);
    table.extend((0..9).map(|_| (0..9).map(|column| format!("{column}.55 ms, < 0.01 %"))));
    let blocks = vec![Block::heading("Laws"), Block::figure(wide, "Response times"), Block::Table(table)];
    let path = folder.path().join("charts.html");
    Document::new("Charts", blocks).write(&path).unwrap();
    browser.open(&path);
    let stacked = browser.evaluate("getComputedStyle(document.querySelector('td')).display");
    assert_eq!(stacked, if options.width < 640 { "flex" } else { "table-cell" });
    assert_eq!(browser.evaluate("document.documentElement.scrollWidth <= innerWidth"), true);
    assert_accessible(&browser);
}

#[test]
fn keys_filters_and_the_back_button_select_scenarios() {
    let Some((browser, _folder)) = open_page(DESKTOP) else { return };
    let press = |key: &str| {
        browser.evaluate(&format!(
            "document.body.dispatchEvent(new KeyboardEvent('keydown', {{ key: '{key}', bubbles: true }}))"
        ))
    };
    let shown =
        "[...document.querySelectorAll('.scenario')].filter((part) => part.checkVisibility()).map(({ id }) => id)";
    let listed = "[...document.querySelectorAll('.list ol a')].map((link) => link.hash.slice(1))";
    let order: Vec<String> = serde_json::from_value(browser.evaluate(listed)).unwrap();
    assert_eq!(browser.evaluate(shown), json!([]), "the overview");
    press("j");
    browser.wait_for("document.querySelector('.list [aria-current]') !== null");
    assert_eq!(browser.evaluate(shown), json!([order[0]]));
    press("j");
    assert_eq!(browser.evaluate(shown), json!([order[1]]));
    press("k");
    assert_eq!(browser.evaluate(shown), json!([order[0]]));
    browser.evaluate("history.back()");
    browser.wait_for(&format!("location.hash === '#{}'", order[1]));
    assert_eq!(browser.evaluate(shown), json!([order[1]]));
    assert_eq!(browser.evaluate("document.querySelector('.overview').checkVisibility()"), false);
    press("/");
    assert_eq!(browser.evaluate("document.activeElement.type"), "search");
    browser.evaluate(
        "(() => { const search = document.activeElement; search.value = 'no such scenario'; \
         search.dispatchEvent(new Event('input', { bubbles: true })); })()",
    );
    assert_eq!(browser.evaluate(listed), json!([]));
    assert_no_console_messages(&browser);
}

#[test]
fn shows_drawings_if_the_library_fails() {
    let Some(browser) = Browser::start_if_installed(DESKTOP) else { return };
    let folder = TempDir::new().unwrap();
    let path = write_page(folder.path());
    let text = std::fs::read_to_string(&path).unwrap();
    std::fs::write(&path, text.replace("new uPlot(options", "new Missing(options")).unwrap();
    browser.open(&path);
    browser.evaluate(SELECT_FIRST);
    browser.wait_for("document.querySelector('.scenario:target')?.classList.contains('undrawn')");
    assert_eq!(browser.evaluate("getComputedStyle(document.querySelector('.drawings')).display"), "block");
    assert!(!browser.console_messages().is_empty(), "the console has the reason");
}

#[test]
#[ignore = "makes a picture of REPORT_PAGE for the documentation"]
fn picture() {
    let page = PathBuf::from(std::env::var_os("REPORT_PAGE").expect("REPORT_PAGE names a report"));
    let options = BrowserOptions { width: 1280, height: 1500, ..DESKTOP };
    let browser = Browser::start_if_installed(options).unwrap();
    browser.open(&page.canonicalize().unwrap());
    browser.evaluate(SELECT_FIRST);
    browser.wait_for(READY);
    browser.evaluate(FRAME);
    browser.save_screenshot("report");
}

fn axe_source() -> String {
    let file = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/browser/axe/axe.min.js.gz");
    let unpacked = Command::new("gzip").args(["-dc", file]).output().unwrap();
    String::from_utf8(unpacked.stdout).unwrap()
}
