use super::*;
use platebench_test_kit::{scenario_path, skip_without};
use std::collections::BTreeSet;
use std::fs;
use std::os::unix::fs::PermissionsExt;

fn arguments(only: ChartKind, named: &[PathBuf], out: &Path) -> Arguments {
    Arguments {
        scenarios: named.into(),
        out: Some(out.to_owned()),
        quick: true,
        only: vec![only],
        rigs: Vec::new(),
        python: PathBuf::from("python3"),
        scenes: scenario_path(""),
    }
}

fn parse_csv(csv: &str) -> Vec<Vec<String>> {
    let fields = |line: &str| {
        let (mut fields, mut is_quoted) = (vec![String::new()], false);
        for character in line.chars() {
            match character {
                '"' => is_quoted = !is_quoted,
                ',' if !is_quoted => fields.push(String::new()),
                other => fields.last_mut().unwrap().push(other),
            }
        }
        fields
    };
    csv.lines().map(fields).collect()
}

fn run_chart(only: ChartKind, named: &[PathBuf], csv: &str) -> (tempfile::TempDir, Vec<Vec<String>>) {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("new");
    draw(&arguments(only, named, &out)).unwrap();
    let rows = parse_csv(&fs::read_to_string(out.join(csv)).unwrap());
    (folder, rows)
}

fn exit_of(arguments: &Arguments) -> u8 {
    draw(arguments).unwrap_err().exit
}

fn parse_number(text: &str) -> f64 {
    text.parse().unwrap_or_else(|_| panic!("{text}"))
}

#[test]
fn writes_a_page_drawings_and_numbers_for_methods() {
    let (folder, rows) =
        run_chart(ChartKind::Methods, &[scenario_path("paper/fig16-closed-loop.toml")], "precision.csv");
    let header = "scenario,problem,method,setting_kind,setting,status,numerical_error,model_error,total_error,\
                  ns_per_simulated_ms,ratio_to_best_peer";
    assert_eq!(rows[0].join(","), header);
    let rows = &rows[1..];
    assert!(rows.iter().all(|row| row.len() == 11), "{rows:?}");
    let problems: BTreeSet<&str> = rows.iter().map(|row| row[1].as_str()).collect();
    assert_eq!(problems, BTreeSet::from(["carrier", "envelope", "linear", "modal"]));
    let page = fs::read_to_string(folder.path().join("new/charts.html")).unwrap();
    assert!(page.contains("explicit Euler") && page.contains("best crate"), "{}", page.len());
    for problem in ["carrier", "envelope", "modal"] {
        let svg =
            fs::read_to_string(folder.path().join(format!("new/precision-paper-fig16-closed-loop-{problem}.svg")))
                .unwrap();
        assert!(
            svg.contains("ns per simulated ms") && svg.contains("diverged or gave up") == (problem != "envelope"),
            "{problem}"
        );
    }
    let failed: Vec<_> = rows.iter().filter(|row| row[5] != "ok").collect();
    assert!(
        failed.iter().any(|row| row[1] == "modal" && row[2] == "RK4" && row[5] == "diverged" && row[6].is_empty()),
        "{failed:?}"
    );
    assert!(rows.iter().any(|row| row[1] == "modal" && row[2] == "RK4" && row[5] == "ok"));
    // The closed form is exact for the modal problem. The envelope differs from the modal model.
    let exact = |problem: &str| rows.iter().find(|row| row[1] == problem && row[2] == "exact").unwrap();
    assert!(parse_number(&exact("modal")[6]) < 1e-9 && parse_number(&exact("modal")[8]) == 0.0, "{:?}", exact("modal"));
    assert!((1e-4..1e-2).contains(&parse_number(&exact("envelope")[7])), "{:?}", exact("envelope"));
}

#[test]
fn rejects_a_scenario_without_a_setpoint() {
    let folder = tempfile::tempdir().unwrap();
    let text = fs::read_to_string(scenario_path("paper/fig13-open-loop.toml")).unwrap();
    let plate = scenario_path("plates/aluminium-198x138.toml");
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
    assert_eq!(exit_of(&arguments(ChartKind::Methods, &[file], &folder.path().join("new"))), Failure::INVALID);
}

#[test]
fn rejects_missing_files_and_empty_folders() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("new");
    for which in [ChartKind::Methods, ChartKind::Scenes] {
        assert_eq!(exit_of(&arguments(which, &[scenario_path("no-such.toml")], &out)), Failure::INVALID);
    }
    let nowhere = Arguments { scenes: scenario_path("no-such"), ..arguments(ChartKind::Laws, &[], &out) };
    assert_eq!(exit_of(&nowhere), Failure::INVALID);
    assert_eq!(exit_of(&arguments(ChartKind::Scenes, &[folder.path().to_owned()], &out)), Failure::NOTHING_TO_DRAW);
    assert!(!out.exists(), "nothing was drawn");
}

/// Writes a step to 2 µm, 30 ms long. Its final amplitude may be off by `tolerance`, µm.
fn scenario_with_tolerance(folder: &Path, law: &str, model: &str, tolerance: f64) -> PathBuf {
    let plate = scenario_path("plates/aluminium-198x138.toml");
    let (low, high) = (2.0 - tolerance, 2.0 + tolerance);
    let text = format!(
        "title = \"{law}\"\nplate = {:?}\nmodel = \"{model}\"\nduration_ms = 30.0\n\
         [controller]\nlaw = \"{law}\"\n[profile]\nsetpoint_um = 2.0\n\
         [[expect]]\nmetric = \"final_amplitude_um\"\nwithin = [{low}, {high}]\n",
        plate.display().to_string()
    );
    let file = folder.join(format!("{law}-{tolerance}.toml"));
    fs::write(&file, text).unwrap();
    file
}

fn rows_of<'a>(rows: &'a [Vec<String>], file: &str, model: &str) -> Vec<&'a Vec<String>> {
    let model_column = rows[0].iter().position(|column| column == "model").unwrap();
    rows.iter().filter(|row| row[0].contains(file) && row[model_column] == model).collect()
}

#[test]
fn scenes_are_judged_on_every_model() {
    let folder = tempfile::tempdir().unwrap();
    let named = [
        scenario_with_tolerance(folder.path(), "open-loop", "linear", 1.0),
        scenario_with_tolerance(folder.path(), "dq-pi", "auto", 0.05),
        scenario_path("paper/fig13-closed-loop.toml"),
    ];
    let (folder, rows) = run_chart(ChartKind::Scenes, &named, "scenes.csv");
    let column = |name: &str| rows[0].iter().position(|column| column == name).unwrap();
    let scenario_model = |file: &str| rows_of(&rows, file, "modal")[0][column("scenario_model")].clone();
    assert_eq!((scenario_model("open-loop-1").as_str(), scenario_model("dq-pi-0.05").as_str()), ("linear", "modal"));
    for file in ["open-loop-1", "dq-pi-0.05", "fig13-closed"] {
        for row in rows_of(&rows, file, "modal") {
            assert_eq!(parse_number(&row[column("difference_in_tolerances")]), 0.0, "{row:?}");
        }
        let expectations = ["linear", "envelope"].map(|model| rows_of(&rows, file, model).len());
        assert_eq!(expectations, [rows_of(&rows, file, "modal").len(); 2]);
        assert_eq!(rows_of(&rows, file, "carrier").len(), 0, "the plate has no converter");
    }
    let page = fs::read_to_string(folder.path().join("new/charts.html")).unwrap();
    assert!(page.contains("CPU time per control period"), "{page}");
    let svg = fs::read_to_string(folder.path().join("new/scenes.svg")).unwrap();
    assert!(svg.contains("fig13-closed-loop"), "{}", svg.len());
    // The legend has a ring, and each scene has one with the colour of its model: linear or modal.
    let rings = |colour: usize| svg.matches(&format!("class=\"s-series-{colour}\"")).count();
    assert_eq!((rings(0), rings(1), rings(2)), (2, 0, 2), "{svg}");
}

#[test]
fn scenes_show_a_verdict_that_a_wrong_model_changes() {
    let folder = tempfile::tempdir().unwrap();
    // The plate is detuned by 545 rad/s, which the linear model without coupling ignores.
    let plate = scenario_path("plates/aluminium-198x138.toml");
    let text = format!(
        "title = \"detuned\"\nplate = {:?}\nduration_ms = 30.0\n[controller]\nlaw = \"open-loop\"\n\
         [profile]\nsetpoint_um = 2.0\ntemperature_offset_k = 9.0\n\
         [[expect]]\nmetric = \"final_amplitude_um\"\nat_most = 1.9\n",
        plate.display().to_string()
    );
    let file = folder.path().join("detuned.toml");
    fs::write(&file, text).unwrap();
    let (folder, rows) = run_chart(ChartKind::Scenes, &[file], "scenes.csv");
    let column = |name: &str| rows[0].iter().position(|column| column == name).unwrap();
    let [row] = rows_of(&rows, "detuned", "linear")[..] else { panic!("{rows:?}") };
    assert_eq!((row[column("verdict")].as_str(), row[column("reference_verdict")].as_str()), ("fail", "pass"));
    let page = fs::read_to_string(folder.path().join("new/charts.html")).unwrap();
    assert!(page.contains("fail instead of pass"), "{page}");
    let svg = fs::read_to_string(folder.path().join("new/scenes.svg")).unwrap();
    assert!(svg.contains("detuned (verdict changes: linear"), "{svg}");
}

#[test]
fn the_ladder_compares_models_with_the_emulated_firmware() {
    let named = ["paper/fig13-closed-loop.toml", "paper/fig14-closed-loop.toml"].map(scenario_path);
    let (folder, rows) = run_chart(ChartKind::Ladder, &named, "ladder.csv");
    let names: Vec<&str> = rows.iter().map(|row| row[0].as_str()).collect();
    assert_eq!(
        names,
        ["rung", "hosted, linear plate", "hosted, envelope plate", "hosted, modal plate", "emulated, lockstep"]
    );
    let differences = |row: &[String]| -> Vec<f64> { row[3..6].iter().map(|field| parse_number(field)).collect() };
    // The hosted and the emulated rung run the same law on the same plate.
    assert_eq!(differences(&rows[3]), [0.0; 3]);
    assert_eq!(differences(&rows[4]), [0.0; 3]);
    let (linear, envelope) = (differences(&rows[1])[0], differences(&rows[2])[0]);
    assert!(linear > envelope && envelope > 0.0, "settling time: {linear} ms, {envelope} ms");
    assert!(rows[1..].iter().all(|row| row[1] == "2" && parse_number(&row[2]) > 0.0), "{rows:?}");
    let svg = fs::read_to_string(folder.path().join("new/ladder-settling-time.svg")).unwrap();
    assert!(svg.contains("emulated, lockstep"), "{}", svg.len());
}

/// Draws the chart of the bench with `python`, and returns the rows of its CSV without the header.
fn bench_chart(python: &Path) -> (tempfile::TempDir, Vec<Vec<String>>) {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("new");
    draw(&Arguments { python: python.to_owned(), ..arguments(ChartKind::Bench, &[], &out) }).unwrap();
    let mut rows = parse_csv(&fs::read_to_string(out.join("bench.csv")).unwrap());
    assert_eq!(rows.remove(0).join(","), "method,setting,status,cpu_us_per_trial,settling_time_ms,error_ms");
    (folder, rows)
}

#[test]
fn the_bench_chart_compares_rigs_methods_and_numpy() {
    let python = tempfile::tempdir().unwrap();
    let script = python.path().join("python");
    // The batch of numpy has the arguments -c PROGRAM PLATES SAMPLES FREQUENCY.
    fs::write(&script, "#!/bin/sh\nset -e\n[ $5 = 32220.9 ]\necho $(($3 * $4)) 1.9$4\n").unwrap();
    fs::set_permissions(&script, fs::Permissions::from_mode(0o755)).unwrap();
    let (folder, rows) = bench_chart(&script);
    let point = |method: &str, setting: &str| {
        let row = rows.iter().find(|row| row[0].starts_with(method) && row[1] == setting).unwrap();
        assert_eq!(row[2], "ok", "{row:?}");
        let [cost, settling_ms, error_ms] = [3, 4, 5].map(|column| parse_number(&row[column]));
        assert!(cost > 0.0, "{row:?}");
        (cost, settling_ms, error_ms)
    };
    // The hosted and the emulated rig run the same law on the same plate.
    let (_, reference, error) = point("emulated rig", "modal");
    assert!((1.93..1.95).contains(&reference) && error == 0.0, "{reference} {error}");
    assert_eq!(point("hosted rig", "modal").2, 0.0);
    let (linear, envelope) = (point("hosted rig", "linear").2, point("hosted rig", "envelope").2);
    assert!(linear > envelope && envelope > 1e-4, "{linear} {envelope}");
    // The replay has the drives of the run, so the closed form crosses the band at the same instant.
    assert!(point("closed form", "modal").2 < 1e-9, "{rows:?}");
    assert!(point("closed form", "linear").2 > 1e-3, "{rows:?}");
    for method in ["ode_solvers DOPRI5", "ode_solvers DOP853", "differential-equations DOP853"] {
        let (coarse, fine) = (point(method, "1e-4").2, point(method, "1e-8").2);
        assert!(fine < 1e-4 && coarse > 10.0 * fine, "{method}: {coarse} {fine}");
    }
    assert_eq!(point("numpy batch", "10").0, 10_000.0);
    assert!((point("numpy batch", "1").2 - (reference - 1.91)).abs() < 1e-12, "{rows:?}");
    let svg = fs::read_to_string(folder.path().join("new/bench.svg")).unwrap();
    let texts = ["hosted rig, whole run", ">envelope<", ">10<", ">uncertainty of the reference<"];
    assert!(texts.iter().all(|text| svg.contains(text)) && svg.contains("per trial of 60 ms"), "{svg}");
}

#[test]
fn numpy_settles_at_the_sample_before_the_crossing() {
    let python = Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../../target/test-readers/bin/python"));
    if !python.exists() {
        skip_without("python3 with numpy");
        return;
    }
    let (_folder, rows) = bench_chart(python);
    let settling_ms = |method: &str, setting: &str| {
        let row = rows.iter().find(|row| row[0].starts_with(method) && row[1] == setting).unwrap();
        parse_number(&row[4])
    };
    let before = settling_ms("emulated rig", "modal") - settling_ms("numpy batch", "10");
    assert!((0.0..0.1).contains(&before), "{before} ms");
}

#[test]
fn the_bench_chart_states_that_numpy_is_missing() {
    let (folder, rows) = bench_chart(Path::new("no-such-python"));
    let [.., row] = &rows[..] else { panic!("{rows:?}") };
    assert!(row[2].starts_with("failed: not measured: no-such-python: "), "{row:?}");
    assert_eq!(row[3..], [""; 3]);
    for file in ["charts.html", "bench.svg"] {
        let text = fs::read_to_string(folder.path().join("new").join(file)).unwrap();
        assert!(text.contains("numpy batch: not measured, no-such-python: "), "{file}");
    }
}

#[test]
fn law_table_equals_the_documented_one() {
    let (folder, rows) = run_chart(ChartKind::Laws, &[], "laws.csv");
    let column = |name: &str| rows[0].iter().position(|column| column == name).unwrap();
    let of = |law: &str, scene: &str, name: &str| {
        let row = rows.iter().find(|row| row[0] == law && row[1].contains(scene)).unwrap();
        row[column(name)].clone()
    };
    assert_eq!(rows.len(), 1 + 9 * 8);
    assert!((1.8..2.0).contains(&parse_number(&of("dq-pi", "Fig. 13", "response_ms"))), "{rows:?}");
    assert!(parse_number(&of("deadbeat", "Fig. 16", "response_ms")) <= 2.0, "{rows:?}");
    // Without feedback, detuning lowers the amplitude by 30 %, so the response never settles.
    assert_eq!(of("open-loop", "Fig. 14", "response_ms"), "");
    assert!((29.0..32.0).contains(&parse_number(&of("open-loop", "Fig. 14", "static_error_percent"))), "{rows:?}");
    assert_eq!(
        (of("open-loop", "10 nm", "settled_trials").as_str(), of("dq-pi", "10 nm", "settled_trials").as_str()),
        ("0", "4")
    );
    // 10 nm/√20 of 2 µm: noise of 20 samples. A law that follows them has about this scatter.
    let floor = parse_number(&of("dq-pi", "10 nm", "noise_floor_percent"));
    assert!((floor - 0.111_803).abs() < 1e-5, "{floor}");
    let scatter = parse_number(&of("dq-pi", "10 nm", "repeatability_percent"));
    assert!((0.3..2.5).contains(&(scatter / floor)), "{scatter}");
    assert_eq!(parse_number(&of("open-loop", "32 nm", "repeatability_percent")), 0.0);
    // In s; the second is with 2 N: −ln(1 − 0.95·286.5/900)/532 and −ln(1 − 0.95·668.6/900)/1241.
    assert!((parse_number(&of("pll", "Fig. 13", "drive_floor_ms")) - 0.677).abs() < 2e-3, "{rows:?}");
    assert!((parse_number(&of("pll", "Fig. 16", "drive_floor_ms")) - 0.985).abs() < 2e-3, "{rows:?}");
    let svg = fs::read_to_string(folder.path().join("new/laws.svg")).unwrap();
    for text in ["two periods", "drive floor, untouched", "drive floor, 2 N", "noise floor, 10 nm", "never within 5 %"]
    {
        assert!(svg.contains(text), "{text}");
    }
    let variants = parse_csv(&fs::read_to_string(folder.path().join("new/law-variants.csv")).unwrap());
    assert_eq!(variants.len(), 1 + 9 * 5 * 4 * 3);
    let response = |law: &str, known: &str, gain: &str, delay: &str| {
        let wanted = [law, "Fig. 13: at resonance", known, gain, delay];
        let row = variants.iter().find(|row| row[..5] == wanted).unwrap();
        (parse_number(&row[5]), parse_number(&row[6]))
    };
    // docs/laws.md has these values in its table of delays.
    let (unknown, known) = (response("dq-pi", "false", "1", "0.8"), response("dq-pi", "true", "1", "0.8"));
    assert!((unknown.0 - 13.8).abs() < 0.1 && (unknown.1 - 47.0).abs() < 1.0, "{unknown:?}");
    assert!((known.0 - 2.76).abs() < 0.01 && known.1 < 0.1, "{known:?}");
    let stronger = response("deadbeat", "true", "1.1", "0");
    assert!(stronger.1 > response("deadbeat", "true", "1", "0").1 + 5.0, "{stronger:?}");
    let drawing = |path: &Path| fs::read_to_string(path).unwrap();
    assert!(
        drawing(&folder.path().join("new/law-variants.svg"))
            == drawing(&scenario_path("../docs/charts/law-variants.svg")),
        "docs/charts/law-variants.svg differs"
    );
    // Scenes with noise ran fewer trials here than in docs/laws.md, so they are not compared.
    let without_noise = |text: &str| {
        let lines = text.lines().filter(|line| line.starts_with("| "));
        lines.map(|line| line.split('|').take(7).collect::<Vec<_>>().join("|")).collect::<Vec<_>>()
    };
    let table = without_noise(&fs::read_to_string(folder.path().join("new/laws.md")).unwrap());
    assert_eq!(table.len(), 10);
    let page = without_noise(&fs::read_to_string(scenario_path("../docs/laws.md")).unwrap());
    for line in &table {
        assert!(page.contains(line), "docs/laws.md has no line {line}");
    }
}
