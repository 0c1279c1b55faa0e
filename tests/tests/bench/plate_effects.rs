//! Tests that commands refuse a plate with effects that they do not simulate.

use crate::test_folder::{run_bench, workspace_root};
use std::path::PathBuf;

fn shipped(path: &str) -> PathBuf {
    workspace_root().join("scenarios").join(path)
}

fn line_of(path: &str, key: &str) -> usize {
    let text = std::fs::read_to_string(shipped(path)).unwrap();
    text.lines().position(|line| line.starts_with(key)).unwrap() + 1
}

#[test]
fn a_model_of_the_command_line_may_not_omit_effects() {
    let folder = tempfile::tempdir().unwrap();
    let scenario = "hardware/amplifier-5khz-fig13-closed-loop.toml";
    let at = format!("amplifier-5khz-fig13-closed-loop.toml:{}:", line_of(scenario, "plate"));
    for model in ["linear", "envelope"] {
        let path = shipped(scenario);
        let message = format!("the model {model} omits `drive.bandwidth_hz` of the plate file");
        run_bench(folder.path(), ["run", path.to_str().unwrap(), "--model", model, "--out", "run"])
            .assert_message(2, &[&at, &message]);
        assert!(!folder.path().join("run").exists());
    }
}

#[test]
fn calculations_with_one_mode_refuse_a_second_one() {
    let folder = tempfile::tempdir().unwrap();
    let plate = "plates/aluminium-198x138-second-mode-300hz.toml";
    let at = format!("second-mode-300hz.toml:{}:", line_of(plate, "[second_mode]"));
    let path = shipped(plate);
    for command in ["tune", "stability"] {
        let message = format!("{command} assumes one mode");
        run_bench(folder.path(), [command, "--plate", path.to_str().unwrap()]).assert_message(2, &[&at, &message]);
    }
}
