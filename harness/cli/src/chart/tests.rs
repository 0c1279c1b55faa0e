//! The command from its arguments to its files.

use super::*;
use std::collections::BTreeSet;

fn scenario(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../scenarios").join(name)
}

fn charted(name: &str) -> (tempfile::TempDir, Vec<Vec<String>>) {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("new");
    let arguments = Chart { scenarios: vec![scenario(name)], out: Some(out.clone()), quick: true };
    assert_eq!(chart(&arguments), Exit::Passed);
    let csv = fs::read_to_string(out.join("precision.csv")).unwrap();
    let rows =
        csv.lines().map(|line| line.split(',').map(|field| field.trim_matches('"').to_owned()).collect()).collect();
    (folder, rows)
}

#[test]
fn a_scenario_becomes_a_page_drawings_and_figures() {
    let (folder, rows) = charted("paper/fig16-closed-loop.toml");
    let header = "scenario,problem,method,setting_kind,setting,status,numerical_error,model_error,total_error,ns_per_simulated_ms,ratio_to_best_peer";
    assert_eq!(rows[0].join(","), header);
    let rows = &rows[1..];
    assert!(rows.iter().all(|row| row.len() == 11), "{rows:?}");
    let problems: BTreeSet<&str> = rows.iter().map(|row| row[1].as_str()).collect();
    assert_eq!(problems, BTreeSet::from(["carrier", "envelope", "modal"]));
    let page = fs::read_to_string(folder.path().join("new/charts.html")).unwrap();
    assert!(page.contains("explicit Euler") && page.contains("best crate"), "{}", page.len());
    for problem in problems {
        let svg =
            fs::read_to_string(folder.path().join(format!("new/precision-paper-fig16-closed-loop-{problem}.svg")))
                .unwrap();
        assert!(
            svg.contains("ns per simulated ms") && svg.contains("diverged or gave up") == (problem != "envelope"),
            "{problem}"
        );
    }
    // What fails is there and is called so.
    let failed: Vec<_> = rows.iter().filter(|row| row[5] != "ok").collect();
    assert!(
        failed.iter().any(|row| row[1] == "modal" && row[2] == "RK4" && row[5] == "diverged" && row[6].is_empty()),
        "{failed:?}"
    );
    assert!(rows.iter().any(|row| row[1] == "modal" && row[2] == "RK4" && row[5] == "ok"));
    // The closed form is exact, and the envelope is not the mode.
    let exact = |problem: &str| rows.iter().find(|row| row[1] == problem && row[2] == "exact").unwrap();
    let number = |text: &str| text.parse::<f64>().unwrap();
    assert!(number(&exact("modal")[6]) < 1e-9 && number(&exact("modal")[8]) == 0.0, "{:?}", exact("modal"));
    assert!((1e-4..1e-2).contains(&number(&exact("envelope")[7])), "{:?}", exact("envelope"));
}

#[test]
fn without_a_setpoint_there_is_no_error_to_draw() {
    let folder = tempfile::tempdir().unwrap();
    let text = fs::read_to_string(scenario("paper/fig13-open-loop.toml")).unwrap();
    let plate = scenario("plates/aluminium-198x138.toml");
    let mut still = String::new();
    for line in text.lines() {
        let line = match line.split_once(" = ") {
            Some(("plate", _)) => format!("plate = {:?}", plate.display().to_string()),
            Some(("setpoint_um", _)) => "setpoint_um = 0.0".to_owned(),
            _ => line.to_owned(),
        };
        still.push_str(&line);
        still.push('\n');
    }
    let file = folder.path().join("still.toml");
    fs::write(&file, still).unwrap();
    let arguments = Chart { scenarios: vec![file], out: Some(folder.path().join("new")), quick: true };
    assert_eq!(chart(&arguments), Exit::Invalid);
}

#[test]
fn what_is_not_there_is_invalid_input() {
    let arguments = Chart { scenarios: vec![scenario("no-such.toml")], out: None, quick: true };
    assert_eq!(chart(&arguments), Exit::Invalid);
}
