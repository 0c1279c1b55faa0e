//! Lockstep runs repeat bit for bit, whatever runs beside what.

use crate::test_folder::{TestFolder, exit_code, run_bench};
use std::collections::BTreeMap;
use std::fs;
use std::path::Path;

const NOISY: &str = r#"
title = "noisy"
plate = "plates/aluminium-198x138-noisy.toml"
duration_ms = 20.0
[controller]
loop_delay_ms = 0.37
[profile]
setpoint_um = { hold = [[0.0, 1.0], [7.3, 2.0]] }
finger_force_n = { sine = { mean = 1.0, amplitude = 0.5, frequency_hz = 20.0 } }
temperature_offset_k = { linear = [[0.0, 0.0], [20.0, 1.0]] }
[trials]
count = 9
[trials.spread]
gain_percent = 2.0
time_constant_percent = 3.0
sensor_gain_percent = 1.0
temperature_k = 0.5
[[expect]]
metric = "settling_time_ms"
at_most = 1000.0
"#;

fn traces(folder: &Path) -> BTreeMap<String, Vec<u8>> {
    let entries = fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path());
    entries.map(|path| (path.file_name().unwrap().to_string_lossy().into_owned(), fs::read(&path).unwrap())).collect()
}

fn run(workshop: &TestFolder, out: &str, more: &[&str]) -> BTreeMap<String, Vec<u8>> {
    let output = run_bench(workshop.path(), ["run", "--out", out].iter().chain(more));
    // What the trials come to is not the question here.
    assert!([0, 1, 3].contains(&exit_code(&output)), "{}", String::from_utf8_lossy(&output.stderr));
    traces(&workshop.path().join(out).join("traces/noisy"))
}

#[test]
fn traces_do_not_depend_on_the_number_of_jobs() {
    let workshop = TestFolder::new();
    workshop.write_scenario("noisy.toml", NOISY);
    let one = run(&workshop, "one", &["--jobs", "1"]);
    assert_eq!(one.len(), 9);
    assert_eq!(one, run(&workshop, "seven", &["--jobs", "7"]));
    assert_eq!(one, run(&workshop, "again", &["--jobs", "1"]));
    // The comparison can fail: another seed gives other traces, and seven trials are not one.
    let other = run(&workshop, "other", &["--seed", "2"]);
    assert_eq!(one["001.csv"], other["000.csv"], "a trial's seed counts up from the scenario's");
    assert_ne!(one["000.csv"], other["000.csv"]);
    assert_ne!(one["000.csv"], one["001.csv"]);
}

#[test]
fn merged_shards_equal_one_run() {
    let workshop = TestFolder::new();
    for name in ["a", "b", "c"] {
        workshop.write_scenario(&format!("{name}.toml"), NOISY);
    }
    let scenarios = |shard: &str, out: &str| {
        run_bench(workshop.path(), ["run", "--trials", "1", "--out", out, "--shard", shard]);
        let record: serde_json::Value =
            serde_json::from_slice(&fs::read(workshop.path().join(out).join("run.json")).unwrap()).unwrap();
        let files = record["scenarios"].as_array().unwrap().iter();
        files.map(|scenario| scenario["file"].as_str().unwrap().to_owned()).collect::<Vec<_>>()
    };
    assert_eq!(scenarios("1/2", "first"), ["a.toml", "c.toml"]);
    assert_eq!(scenarios("2/2", "second"), ["b.toml"]);
}
