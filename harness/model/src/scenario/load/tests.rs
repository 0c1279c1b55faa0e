mod between;
mod bounds;
mod files;
mod properties;
mod rejected;
mod values;

use super::load;
use crate::scenario::definition::Scenario;
use crate::scenario::diagnostic::Diagnostic;
use tempfile::TempDir;

const PLATE: &str = include_str!("../../../../../scenarios/plates/aluminium-198x138.toml");

const BASE: &str = r#"title = "All keys"
source = "Fig. 0"
plate = "plates/plate.toml"
duration_ms = 60.0
tags = ["paper"]
trace_step_ms = 0.05
model = "modal"
expected_exit = 1

[controller]
law = "dq-pi"
period_ms = 1.0
start_frequency_hz = 32220.9
loop_delay_ms = 0.0
design_delay_ms = 0.0
response_time_ms = 1.9
frequency_range_hz = 250.0
frequency_slew_hz = 100.0

[controller.gains]
amplitude_kp = 1.0
amplitude_ki = 2.0
frequency_kp = 3.0
frequency_ki = 4.0

[profile]
setpoint_um = { hold = [[0.0, 0.0], [1.0, 2.0]] }
temperature_offset_k = { linear = [[0.0, 1.0], [60.0, 2.0]] }
finger_force_n = { csv = "force.csv" }

[trials]
count = 30
max_count = 200
seed = 7

[trials.spread]
gain_percent = 1.0
time_constant_percent = 2.0
sensor_gain_percent = 3.0
temperature_k = 4.0

[[expect]]
metric = "settling_time_ms"
at_most = 2.0
band_percent = 5.0
from_ms = 1.0
signal = "amplitude_um"
paper = 2.0
requirement = "ACC-1"

[[expect]]
metric = "static_error_percent"
within = [0.0, 1.0]
window_ms = 20.0
confidence = 0.9

[[expect]]
metric = "final_amplitude_um"
about = 2.0
tolerance_percent = 3.0
"#;

const FAULTS: &str = r#"
[[fault]]
kind = "flip"
from_ms = 10.0
until_ms = 20.0
direction = "to-controller"
every = 10
seed = 5
reconfigure = true

[[fault]]
kind = "delay"
from_ms = 10.0
until_ms = 11.0
delay_ms = 0.5

[[fault]]
kind = "scale"
from_ms = 10.0
until_ms = 60.0
factor = 0.9

[[fault]]
kind = "disconnect"
from_ms = 30.0
"#;

const FORCE: &str = "# a finger\nt_ms, value\n20.0, 0.0\n\n  30.0, 1.0\n";

/// Creates the files of the base scenario with each `good` replaced by `bad`.
fn create_folder(changes: &[(&str, &str)]) -> TempDir {
    let folder = TempDir::new().unwrap();
    std::fs::create_dir(folder.path().join("plates")).unwrap();
    let is_of_faults = |(good, _): &(&str, &str)| FAULTS.contains(good) && !BASE.contains(good);
    let faults = if changes.iter().any(is_of_faults) { FAULTS } else { "" };
    let mut files = [
        ("s.toml", format!("{BASE}{faults}")),
        ("plates/plate.toml", PLATE.to_owned()),
        ("force.csv", FORCE.to_owned()),
    ];
    for (good, bad) in changes {
        let text = files.iter_mut().map(|(_, text)| text).find(|text| text.contains(good));
        let text = text.unwrap_or_else(|| panic!("`{good}` is in no file"));
        *text = text.replacen(good, bad, 1);
    }
    for (name, text) in files {
        std::fs::write(folder.path().join(name), text).unwrap();
    }
    folder
}

fn load_with_changes(changes: &[(&str, &str)]) -> Result<Scenario, Diagnostic> {
    let folder = create_folder(changes);
    load(&folder.path().join("s.toml"), "s.toml").map_err(|mut fault| {
        let root = format!("{}/", folder.path().display());
        fault.message = fault.message.replace(&root, "");
        fault.path = fault.path.strip_prefix(folder.path()).unwrap().to_owned();
        fault
    })
}

fn load_with_change(good: &str, bad: &str) -> Result<Scenario, Diagnostic> {
    load_with_changes(&[(good, bad)])
}

fn render(fault: &Diagnostic) -> String {
    fault.render(false).lines().map(str::trim_end).collect::<Vec<_>>().join("\n")
}
