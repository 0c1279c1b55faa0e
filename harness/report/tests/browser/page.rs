//! What the page does.

use crate::driver::{Browser, Look};
use crate::made;
use platebench_report::html;
use platebench_verdict::Verdict;
use platebench_verdict::golden::{Accepted, Build, Features, Golden};
use rstest::rstest;
use serde_json::{Value, json};
use std::path::{Path, PathBuf};
use std::process::Command;
use tempfile::TempDir;

const DESK: Look = Look { width: 1280, height: 900, dark: false, scripts: true };
const PHONE: Look = Look { width: 390, height: 844, ..DESK };
const TITLE: &str = "</script><b>\"A\" & 'B'</b>";
/// True when the plots of the first scenario stand.
const READY: &str = "document.querySelector('.plots').dataset.ready === 'true'";
/// From when to when the plots of the first scenario go.
const RANGE: &str = "(({from, to}) => [+from, +to])(document.querySelector('.tools').dataset)";

/// A run with everything in it, as a page: a hostile title, costs, a golden trace, another run beside it.
fn page(folder: &Path) -> PathBuf {
    let mut record = made::varied(folder);
    TITLE.clone_into(&mut record.scenarios[2].title);
    record.cost = made::costs();
    let (other_folder, baselines) = (folder.join("other"), folder.join("baselines"));
    let mut other = made::varied(&other_folder);
    other.scenarios[1].expectations[0].verdict = Verdict::Pass;
    let closed = &record.scenarios[0];
    let rows = platebench_trace::read(&folder.join(&closed.trials[0].trace)).unwrap();
    let accepted = Accepted {
        scenario: closed.file.clone(),
        law: closed.law.clone(),
        build: Build { rig: "hosted".to_owned(), firmware: "dq-pi 0.1.0".to_owned(), id: "5f3a9c01".to_owned() },
        features: Features::of(&rows),
        learned: None,
        golden: Golden::of_rows(&rows).unwrap(),
    };
    accepted.write(&baselines).unwrap();
    let path = folder.join(html::FILE);
    let page = html::Page::new(&record, folder).with_baselines(&baselines).against(&other, &other_folder);
    page.write(&path).unwrap();
    path
}

fn opened(look: Look) -> Option<(Browser, TempDir)> {
    let browser = Browser::start_or_say_why_not(look)?;
    let folder = TempDir::new().unwrap();
    browser.open(&page(folder.path()));
    Some((browser, folder))
}

fn quiet(browser: &Browser) {
    assert_eq!(browser.complaints(), Vec::<Value>::new());
}

fn range(browser: &Browser) -> [f64; 2] {
    serde_json::from_value(browser.value(RANGE)).unwrap()
}

/// Left edge, upper edge, width and height of an element in the window.
fn place(browser: &Browser, selector: &str) -> [f64; 4] {
    let expression = format!(
        "(() => {{ const found = document.querySelector({}); found.scrollIntoView({{ block: 'center', behavior: 'instant' }}); \
         const {{ left, top, width, height }} = found.getBoundingClientRect(); return [left, top, width, height]; }})()",
        json!(selector)
    );
    serde_json::from_value(browser.value(&expression)).unwrap()
}

#[test]
fn plots_zoom_move_and_are_switched_and_nobody_complains() {
    let Some((browser, _folder)) = opened(DESK) else { return };
    let first = browser.value("document.querySelector('.scenario').className");
    assert_eq!(first, "scenario fail moving", "what failed comes first");
    place(&browser, ".plots");
    browser.wait_for(READY);
    assert_eq!(browser.value("getComputedStyle(document.querySelector('.drawings')).display"), "none");
    let titles =
        browser.value("[...document.querySelectorAll('.scenario h2')].map((title) => title.textContent).join()");
    assert!(titles.as_str().unwrap().contains(TITLE), "{titles}");
    assert_eq!(browser.value("document.querySelectorAll('.scenario h2 b').length"), 0);

    // The response first; then by buttons, by dragging over a stretch, by a double click and by keys.
    let start = range(&browser);
    let pixels = "document.querySelector('.canvas canvas').toDataURL()";
    let frame = "new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(() => done(true))))";
    browser.value(frame);
    let far = browser.value(pixels);
    browser.value("document.querySelector('[aria-label=\"Zoom in\"]').click()");
    let closer = range(&browser);
    browser.value(frame);
    assert_ne!(browser.value(pixels), far, "the picture follows");
    assert!((closer[1] - closer[0] - (start[1] - start[0]) / 2.0).abs() < 1e-9, "{start:?} {closer:?}");
    browser.value("[...document.querySelectorAll('.tools button')].find((button) => button.textContent === 'Whole trial').click()");
    assert_eq!(range(&browser), [0.0, 60.0], "the whole trial");
    let [left, top, width, height] = place(&browser, ".canvas .u-over");
    let at = |share: f64| (left + share * width, top + height / 2.0);
    browser.drag(at(0.25), at(0.5));
    let dragged = range(&browser);
    assert!((dragged[0] - 15.0).abs() < 0.3 && (dragged[1] - 30.0).abs() < 0.3, "{dragged:?}");
    let press = |key: &str| {
        browser.value(&format!(
            "document.querySelector('.canvas').dispatchEvent(new KeyboardEvent('keydown', {{ key: '{key}', bubbles: true }}))"
        ))
    };
    press("ArrowRight");
    let moved = range(&browser);
    assert!(moved[0] > dragged[0] + 1.0 && (moved[1] - moved[0] - dragged[1] + dragged[0]).abs() < 1e-9, "{moved:?}");
    press("0");
    assert_eq!(range(&browser), [0.0, 60.0]);
    for _ in 0..40 {
        press("+");
        press("ArrowLeft");
    }
    let deep = range(&browser);
    assert!(deep[0] >= 0.0 && deep[1] <= 60.0 && deep[1] > deep[0], "{deep:?}");
    press("0");

    // The cursor reads values off: the first trial of the open loop has settled at some 2 µm.
    browser.point(at(0.9));
    let value = "[...document.querySelectorAll('.keys button')].find((key) => key.textContent.startsWith('trial 0')).querySelector('.value').textContent";
    browser.wait_for(&format!("{value} !== ''"));
    let shown: f64 = browser.value(value).as_str().unwrap().parse().unwrap();
    assert!((shown - 2.0).abs() < 0.06, "{shown}");

    // A signal off and on again.
    browser.point((1.0, 1.0));
    let key = "[...document.querySelectorAll('.keys button')].find((key) => key.textContent.startsWith('trial 0'))";
    browser.value(frame);
    let on = browser.value(pixels);
    browser.value(&format!("{key}.click()"));
    browser.value(frame);
    let off = browser.value(pixels);
    assert_eq!(browser.value(&format!("{key}.getAttribute('aria-pressed')")), "false");
    assert_ne!(on, off);
    browser.value(&format!("{key}.click()"));
    browser.value(frame);
    assert_eq!(browser.value(pixels), on);

    // Paper shows the drawings.
    browser.development("Emulation.setEmulatedMedia", &json!({ "media": "print" }));
    let shown = "['.plots', '.drawings'].map((part) => getComputedStyle(document.querySelector(part)).display)";
    assert_eq!(browser.value(shown), json!(["none", "block"]));

    assert_eq!(browser.value("performance.getEntriesByType('resource').length"), 0, "nothing is fetched");
    quiet(&browser);
}

#[test]
fn without_scripts_everything_is_drawn() {
    let Some((browser, _folder)) = opened(Look { scripts: false, ..DESK }) else { return };
    assert_eq!(browser.value("document.querySelectorAll('.plots, .moving').length"), 0, "no script ran");
    let sizes =
        "[...document.querySelectorAll('.drawings figure > svg')].map((svg) => svg.getBoundingClientRect().width)";
    let sizes: Vec<f64> = serde_json::from_value(browser.value(sizes)).unwrap();
    assert!(sizes.len() >= 12 && sizes.iter().all(|width| *width > 200.0), "{sizes:?}");
    place(&browser, ".drawings");
    browser.picture("no-scripts");
    quiet(&browser);
}

#[rstest]
#[case::phone_light(PHONE, "phone-light")]
#[case::phone_dark(Look { dark: true, ..PHONE }, "phone-dark")]
#[case::desk_light(DESK, "desk-light")]
#[case::desk_dark(Look { dark: true, ..DESK }, "desk-dark")]
fn nobody_is_shut_out(#[case] look: Look, #[case] name: &str) {
    let Some((browser, _folder)) = opened(look) else { return };
    browser.picture(&format!("{name}-top"));
    for number in 0..3 {
        let plots = format!("document.querySelectorAll('.plots')[{number}]");
        browser.value(&format!("{plots}.scrollIntoView({{ block: 'start', behavior: 'instant' }})"));
        browser.wait_for(&format!("{plots}.dataset.ready === 'true'"));
        browser.value("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(() => done(true))))");
        browser.picture(&format!("{name}-{number}"));
    }
    assert_eq!(browser.value("document.documentElement.scrollWidth <= innerWidth"), true, "nothing sticks out");
    // Two runs side by side may be wider than a desk; on a phone no row of these tables is.
    let cut = "[...document.querySelectorAll('main .stacked')].map((table) => table.parentElement).filter((part) => \
               part.scrollWidth > part.clientWidth && (innerWidth < 640 || part.getAttribute('aria-labelledby') !== 'against')).length";
    assert_eq!(
        browser.value("document.querySelectorAll('main .stacked').length"),
        6,
        "scenarios, requirements, both runs, expectations"
    );
    assert_eq!(browser.value(cut), 0, "no table has to be moved sideways");
    let band = "getComputedStyle([...document.querySelectorAll('.keys button')].find((key) => key.textContent.startsWith('5 % band')).querySelector('.mark')).backgroundColor";
    let (band, opacity) = (browser.value(band), if look.dark { "0.3" } else { "0.2" });
    assert!(band.as_str().unwrap().contains(&format!(", {opacity}")), "{band}");
    browser.value(&format!("{};true", axe()));
    let found = browser.value(
        "axe.run().then(({ violations }) => violations.map(({ id, help, nodes }) => \
         `${id}: ${help}: ` + nodes.slice(0, 3).map(({ html, failureSummary }) => html.slice(0, 200) + failureSummary).join(' | ')))",
    );
    assert_eq!(found, json!([]), "{found:#}");
    quiet(&browser);
}

#[test]
fn where_the_library_fails_the_drawings_come_back() {
    let Some(browser) = Browser::start_or_say_why_not(DESK) else { return };
    let folder = TempDir::new().unwrap();
    let path = page(folder.path());
    let text = std::fs::read_to_string(&path).unwrap();
    std::fs::write(&path, text.replace("new uPlot(options", "new Missing(options")).unwrap();
    browser.open(&path);
    place(&browser, ".plots");
    browser.wait_for("!document.querySelector('.scenario').classList.contains('moving')");
    assert_eq!(browser.value("getComputedStyle(document.querySelector('.drawings')).display"), "block");
    assert!(!browser.complaints().is_empty(), "and the console says why");
}

/// The picture of a report in the documentation: see docs/report.md.
#[test]
#[ignore = "makes a picture of REPORT_PAGE for people"]
fn picture() {
    let page = PathBuf::from(std::env::var_os("REPORT_PAGE").expect("REPORT_PAGE names a report"));
    let look = Look { width: 1100, height: 1900, ..DESK };
    let browser = Browser::start_or_say_why_not(look).unwrap();
    browser.open(&page.canonicalize().unwrap());
    browser.value("document.querySelector('.scenario').scrollIntoView({ block: 'start', behavior: 'instant' })");
    browser.wait_for(READY);
    browser.value("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(() => done(true))))");
    browser.picture("report");
}

/// axe-core, unpacked.
fn axe() -> String {
    let file = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/browser/axe/axe.min.js.gz");
    let unpacked = Command::new("gzip").args(["-dc", file]).output().unwrap();
    String::from_utf8(unpacked.stdout).unwrap()
}
