//! Checks that a repeated lockstep run gives the same traces, bit for bit.

use crate::test_folder::{TestFolder, read_traces};

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

fn run(folder: &TestFolder, out: &str, more: &[&str]) -> Vec<Vec<u8>> {
    folder.bench(["run", "--out", out].iter().chain(more)).assert_exit_in(&[0, 1, 3]);
    read_traces(&folder.join(out)).into_values().collect()
}

#[test]
fn traces_do_not_depend_on_the_number_of_jobs() {
    let folder = TestFolder::with_scenario(NOISY);
    let one = run(&folder, "one", &["--jobs", "1"]);
    assert_eq!(one.len(), 9);
    assert_eq!(one, run(&folder, "seven", &["--jobs", "7"]));
    assert_eq!(one, run(&folder, "again", &["--jobs", "1"]));
    // Shows that the comparison can fail: another seed gives other traces, and trials differ.
    let other = run(&folder, "other", &["--seed", "2"]);
    assert_eq!(one[1], other[0], "the seed of a trial is the scenario's plus its index");
    assert_ne!(one[0], other[0]);
    assert_ne!(one[0], one[1]);
}

#[test]
fn merged_shards_equal_one_run() {
    let folder = TestFolder::new();
    for name in ["a", "b", "c"] {
        folder.write_scenario(&format!("{name}.toml"), NOISY);
    }
    for (shard, expected) in [("1/2", &["a.toml", "c.toml"][..]), ("2/2", &["b.toml"])] {
        let out = &shard[..1];
        folder.bench(["run", "--trials", "1", "--out", out, "--shard", shard]);
        let files: Vec<_> = folder.record(out).scenarios.into_iter().map(|scenario| scenario.file).collect();
        assert_eq!(files, expected);
    }
}
