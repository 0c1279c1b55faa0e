//! Identifies the plate from runs of the repository's scenarios.

use crate::test_folder::{TestFolder, read_traces, run_bench, workspace_root};
use serde_json::Value;
use std::fs;
use std::path::Path;

fn run_recordings(folder: &Path) {
    let scenarios = workspace_root().join("scenarios/identify");
    run_bench(folder, ["run", scenarios.to_str().unwrap(), "--rig", "hosted", "--out", "run", "--quiet"])
        .assert_exit(0);
}

fn relative_deviation(values: &[f64]) -> f64 {
    let mean = values.iter().sum::<f64>() / values.len() as f64;
    (values.iter().map(|value| (value - mean).powi(2)).sum::<f64>() / (values.len() - 1) as f64).sqrt() / mean
}

/// Checks that the budget adds timing and temperature to the standard error of the resonance.
fn assert_budget(folder: &Path, identified: &Value) {
    let budget = workspace_root().join("docs/examples/amplitude-budget.toml");
    let arguments = ["identify", "run", "--format", "json", "--budget", budget.to_str().unwrap()];
    let budgeted = run_bench(folder, arguments).assert_exit(0).json();
    assert_eq!(budgeted["resonance_hz"], identified["resonance_hz"]);
    let quantities = budgeted["uncertainties"].as_array().unwrap();
    assert_eq!(quantities.len(), 1, "{quantities:?}");
    let combined = &quantities[0]["combined"];
    let contributions = combined["contributions"].as_array().unwrap();
    let kinds: Vec<_> = contributions.iter().filter_map(|one| one["kind"].as_str()).collect();
    assert_eq!(
        (quantities[0]["quantity"].as_str(), kinds),
        (Some("resonance_hz"), vec!["timing", "temperature", "repeatability"])
    );
    let standards: Vec<_> = contributions.iter().filter_map(|one| one["standard"].as_f64()).collect();
    assert_eq!(Some(standards[2]), identified["resonance_hz"]["error"].as_f64());
    let sum = standards.iter().map(|standard| standard.powi(2)).sum::<f64>().sqrt();
    assert!((combined["standard"].as_f64().unwrap() / sum - 1.0).abs() < 1e-12, "{combined}");
}

#[test]
fn identified_tables_match_the_paper() {
    let folder = tempfile::tempdir().unwrap();
    run_recordings(folder.path());
    let arguments =
        ["identify", "run", "--format", "json", "--out", "plate.toml", "--page", "page.html", "--name", "found"];
    let identified = run_bench(folder.path(), arguments).assert_exit(0).json();
    let steps = |key: &str, keep: &dyn Fn(&Value) -> bool, index: usize| -> Vec<f64> {
        let steps = identified[key].as_array().unwrap().iter().filter(|step| keep(step));
        steps.filter_map(|step| step["direct"][index]["value"].as_f64()).collect()
    };
    for vpp in [120.0, 208.0, 312.0, 370.0] {
        let here = |step: &Value| {
            (step["vpp"].as_f64().unwrap() - vpp).abs() < 0.5
                && step["recording"].as_str().unwrap().contains("voltage-steps")
        };
        let (gains, taus) = (steps("voltage_steps", &here, 0), steps("voltage_steps", &here, 1));
        assert_eq!((gains.len(), taus.len()), (30, 30), "{vpp} Vpp");
        // The scenarios vary K1 by 5 % and τ1 by 6 %. With 95 % probability, the deviation of 30
        // values is within 26 % of these.
        assert!((0.03..0.07).contains(&relative_deviation(&gains)), "{vpp} Vpp: K1 {}", relative_deviation(&gains));
        assert!((0.036..0.084).contains(&relative_deviation(&taus)), "{vpp} Vpp: τ1 {}", relative_deviation(&taus));
    }
    let value = |key: &str| identified[key]["value"].as_f64().unwrap();
    // Three standard errors of a mean over 30 plates are 2.7 % for K1 and 3.3 % for τ.
    assert!((value("gain_um_per_vpp") / 0.006_98 - 1.0).abs() < 0.027, "{}", value("gain_um_per_vpp"));
    assert!((value("time_constant_s") / 1.88e-3 - 1.0).abs() < 0.033, "{}", value("time_constant_s"));
    assert!((value("frequency_gain_s") / 1.88e-3 - 1.0).abs() < 0.033, "{}", value("frequency_gain_s"));
    assert_eq!(identified["frequency_steps"].as_array().unwrap().len(), 180, "six steps of thirty plates");
    assert_budget(folder.path(), &identified);
    let plate = fs::read_to_string(folder.path().join("plate.toml")).unwrap();
    assert!(plate.starts_with("name = \"found\"\n"), "{plate}");
    let output = run_bench(folder.path(), ["identify", "run", "--out", "-", "--name", "found"]).assert_exit(0);
    assert_eq!(output.stdout, plate);
    assert!(output.stderr.contains("The plate, with intervals of 95 %"), "{}", output.stderr);
    let page = fs::read_to_string(folder.path().join("page.html")).unwrap();
    assert!(page.contains("Table II") && page.contains("s-first") && page.contains("6844.5"));
    let scenario = "title = \"again\"\nplate = \"plate.toml\"\nduration_ms = 60.0\n[controller]\nlaw = \"dq-pi\"\n\
                    [profile]\nsetpoint_um = 2.0\n[trials]\ncount = 5\n\
                    [[expect]]\nmetric = \"static_error_percent\"\nat_most = 1.0\n";
    fs::write(folder.path().join("again.toml"), scenario).unwrap();
    run_bench(folder.path(), ["run", "again.toml", "--rig", "hosted", "--out", "again"]).assert_exit(0);
}

/// Writes recorded steps as a table with W in nm.
fn write_telemetry(folder: &TestFolder) {
    let scenario = workspace_root().join("scenarios/identify/voltage-steps.toml");
    let arguments = ["run", scenario.to_str().unwrap(), "--rig", "hosted", "--trials", "1", "--out", "run"];
    folder.bench(arguments);
    let trace = read_traces(&folder.join("run")).into_keys().next().unwrap();
    let mut table = "t,V,f,d,q\n".to_owned();
    for row in platebench_model::trace::read_trace(&folder.join("run").join(trace)).unwrap() {
        if row.flags.contains(platebench_model::trace::Flags::CONTROL) {
            let numbers =
                [row.t_s * 1e3, row.drive_vpp, row.frequency_hz, row.sensed_wd_um * 1e3, row.sensed_wq_um * 1e3];
            table += &(numbers.map(|number| number.to_string()).join(",") + "\n");
        }
    }
    folder.write("t.csv", &table);
}

const NM: &str = "time=t:ms,drive=V:Vpp,frequency=f:Hz,wd=d:nm,wq=q:nm";
const NM_AS_UM: &str = "time=t:ms,drive=V:Vpp,frequency=f:Hz,wd=d:um,wq=q:um";
const SWAPPED: &str = "time=t:ms,drive=V:Vpp,frequency=f:Hz,wd=q:nm,wq=d:nm";

#[test]
fn a_recording_counts_once() {
    let folder = TestFolder::new();
    write_telemetry(&folder);
    let twice = ["identify", "t.csv", "./t.csv", "--columns", NM];
    folder.bench(twice).assert_message(2, &["./t.csv is named twice, expected each recording once"]);
}

#[test]
fn impossible_estimates_write_no_plate_file() {
    let folder = TestFolder::new();
    write_telemetry(&folder);
    let identify = |columns: &str, more: &[&str]| {
        let arguments = ["identify", "t.csv", "--columns", columns, "--out", "plate.toml", "--drive-limit-vpp", "900"];
        folder.bench(arguments.iter().chain(more))
    };
    for (columns, cause) in [(NM_AS_UM, "check the units of amplitude"), (SWAPPED, "Check the columns of wd and wq")] {
        identify(columns, &[]).assert_message(3, &["inconclusive: ", cause, "no plate file was written"]);
        assert!(!folder.exists("plate.toml"));
    }
    let too_high = ["identify", "t.csv", "--columns", NM, "--out", "plate.toml", "--drive-limit-vpp", "3.5e38"];
    folder.bench(too_high).assert_message(2, &["plate.toml:", "`: 3.5e38, expected 1.2e-38 to 3.4e38"]);
    assert!(!folder.exists("plate.toml"));
    identify(NM, &[]).assert_exit(0);
    folder.bench(["tune", "--plate", "plate.toml", "--samples", "0"]).assert_exit(0);
    fs::remove_file(folder.join("plate.toml")).unwrap();
    identify(NM_AS_UM, &["--force"]).assert_exit(3);
    assert!(folder.read("plate.toml").starts_with("# DOUBTFUL: gain K1 of "), "{}", folder.read("plate.toml"));
}

/// Records voltage steps of a plate whose gain is `gain` times the nominal one.
fn record_plate(folder: &TestFolder, run: &str, gain: f64, seed: &str) {
    let scenarios = workspace_root().join("scenarios");
    let plate = fs::read_to_string(scenarios.join("plates/aluminium-198x138-noisy.toml")).unwrap();
    let nominal = "gain_um_per_vpp = 0.00698";
    assert!(plate.contains(nominal), "{plate}");
    folder.write("plate.toml", &plate.replace(nominal, &format!("gain_um_per_vpp = {}", 0.006_98 * gain)));
    let scenario = fs::read_to_string(scenarios.join("identify/voltage-steps.toml")).unwrap();
    let (scene, _) = scenario.split_once("[trials.spread]").unwrap();
    let scene = scene.replace("../plates/aluminium-198x138-noisy.toml", "plate.toml").replace("#:schema", "#");
    folder.write("steps.toml", &format!("{scene}\n[[expect]]\nmetric = \"drive_peak_vpp\"\nat_most = 900.0\n"));
    let arguments = ["run", "steps.toml", "--rig", "hosted", "--trials", "8", "--seed", seed, "--out", run];
    folder.bench(arguments).assert_exit(0);
}

#[test]
fn a_history_shows_the_drift_of_a_plate() {
    let folder = TestFolder::new();
    let identify = |run: &str, date: &str, more: &[&str]| {
        let arguments = ["identify", run, "--name", "P7", "--history", "p7.jsonl", "--date", date];
        folder.bench(arguments.iter().chain(more))
    };
    for (run, date, seed) in [("a", "2026-01-05", "1"), ("b", "2026-02-05", "100"), ("c", "2026-03-05", "200")] {
        record_plate(&folder, run, 1.0, seed);
        let output = identify(run, date, &[]).assert_exit(0);
        assert!(output.stdout.contains("History of P7: ") && !output.text().contains("drift of"), "{}", output.text());
    }
    let three = folder.read("p7.jsonl");
    assert_eq!(three.lines().count(), 3);
    identify("c", "2026-03-06", &[]).assert_message(2, &["p7.jsonl:3: contains the recording c/traces/"]);
    let other = ["identify", "a", "--name", "P8", "--history", "p7.jsonl"];
    folder.bench(other).assert_message(2, &["p7.jsonl:1: the plate is P7, expected P8"]);
    folder.bench(["identify", "a", "--history", "p7.jsonl"]).assert_message(2, &["--name <NAME>"]);
    assert_eq!(folder.read("p7.jsonl"), three);
    record_plate(&folder, "d", 1.01, "300");
    let page = ["--page", "history.html", "--format", "json"];
    let output = identify("d", "2026-04-05", &page).assert_exit(0).assert_stderr(&["drift of gain_um_per_vpp: "]);
    let history = &output.json()["history"];
    assert_eq!(history["identifications"], 4);
    let drifted = history["quantities"].as_array().unwrap().iter().filter(|one| one["drift"]["is_drift"] == true);
    let drifted: Vec<_> = drifted.filter_map(|one| one["quantity"].as_str()).collect();
    assert_eq!(drifted, ["gain_um_per_vpp"]);
    let page = folder.read("history.html");
    assert!(page.contains("History of P7") && page.contains("days since the first identification"));
    folder.write("p7.jsonl", &(three + "t_s,wd_um\n"));
    identify("d", "2026-04-05", &[]).assert_message(2, &["p7.jsonl:4: ", "expected a line that `platebench identify"]);
}
