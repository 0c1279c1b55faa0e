use super::*;
use crate::expect::{Aggregation, Limit, Metric};
use crate::fault::{Direction, FaultKind};
use crate::window::Window;
use insta::assert_snapshot;
use rstest::{Context, rstest};
use std::fmt::Write;
use tempfile::TempDir;

const PLATE: &str = include_str!("../../../../scenarios/plates/aluminium-198x138.toml");

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

/// Behind the base where a case is about them: their windows go with its duration and period.
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

/// A folder with the base scenario, each `(good, bad)` of `changes` made in whichever of its three files has the good piece.
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

/// Whether the schema of the faulty file refuses it.
fn schema_refuses(fault: &Diagnostic, good: &str, bad: &str) -> bool {
    let folder = create_folder(&[(good, bad)]);
    let schema = match fault.path.to_str().unwrap() {
        "s.toml" => crate::schema::scenario_schema(),
        "plates/plate.toml" => crate::schema::plate_schema(),
        _ => return false,
    };
    let text = std::fs::read_to_string(folder.path().join(&fault.path)).unwrap();
    // What is no TOML an editor sees without a schema.
    let Ok(document) = toml::from_str::<toml::Table>(&text) else { return true };
    let refused = !jsonschema::is_valid(schema.as_value(), &serde_json::to_value(document).unwrap());
    let structural =
        ["unknown key", "missing key", "invalid type", "invalid length", "unknown metric", "unknown signal"];
    let structural = structural.iter().any(|kind| fault.message.starts_with(kind));
    assert!(
        refused || !structural || fault.message.contains("(floating"),
        "the schema takes `{bad}`: {}",
        fault.message
    );
    refused
}

/// One readable table of everything that a group of files is told.
fn message_table(cases: &[(&str, &str)]) -> String {
    let mut table = String::new();
    for (good, bad) in cases {
        let fault = load_with_change(good, bad).err().unwrap_or_else(|| panic!("`{bad}` was taken"));
        let (line, column) = fault.position();
        let heading = if bad.is_empty() { format!("without {good}") } else { (*bad).to_owned() };
        let seen = if schema_refuses(&fault, good, bad) { "refuses it, too" } else { "does not see it" };
        let heading = heading.trim().replace('\n', " ⏎ ");
        write!(table, "## {heading}\n{line}:{column}\n{}\nthe schema {seen}\n\n", render(&fault)).unwrap();
    }
    table
}

#[test]
fn the_base_is_good_and_says_what_it_says() {
    let scenario = load_with_changes(&[]).unwrap();
    assert_eq!(scenario.inputs.len(), 3);
    assert_eq!(scenario.inputs[2].bytes, FORCE.as_bytes());
    assert_eq!(scenario.expectations[0].from, Time::from_ms(1.0));
    assert_eq!(scenario.expectations[1].limit, Limit::Within(0.0, 1.0));
    assert_eq!(scenario.expectations[1].confidence, 0.9);
    assert_eq!(scenario.expectations[2].limit, Limit::About(2.0));
    assert_eq!(scenario.expectations[2].tolerance_percent, 3.0);
    assert_eq!(scenario.trials.max_count, 200);
    assert_eq!(scenario.conditions.finger_force_n.at(Time::from_ms(25.0).unwrap()), 0.5);
}

#[test]
fn faults_say_what_they_say_and_have_their_documented_defaults() {
    let scenario = load_with_change("seed = 5", "seed = 5").unwrap();
    let [flip, delay, scale, disconnect] = &scenario.faults[..] else { panic!("{:?}", scenario.faults) };
    let [ms_10, ms_20] = [10.0, 20.0].map(|ms| Time::from_ms(ms).unwrap());
    let expected = Fault {
        kind: FaultKind::Flip,
        from: ms_10,
        until: Some(ms_20),
        direction: Direction::ToController,
        every: 10,
        seed: Some(5),
        reconfigure: true,
    };
    assert_eq!(*flip, expected);
    assert_eq!(delay.kind, FaultKind::Delay(Time::from_ms(0.5).unwrap()));
    assert_eq!((delay.direction, delay.every, delay.seed, delay.reconfigure), (Direction::Both, 1, None, false));
    assert_eq!((scale.kind, scale.direction), (FaultKind::Scale(0.9), Direction::ToController));
    assert_eq!((disconnect.kind, disconnect.until), (FaultKind::Disconnect, None));
}

#[test]
fn what_is_left_out_has_its_documented_default() {
    let folder = create_folder(&[]);
    let path = folder.path().join("short.toml");
    let text = "title = \"Short\"\nplate = \"plates/plate.toml\"\nduration_ms = 60\n[profile]\nsetpoint_um = 2\n\
                [[expect]]\nmetric = \"static_error_percent\"\nat_most = 1\n";
    std::fs::write(&path, text).unwrap();
    let scenario = load(&path, "short.toml").unwrap();
    let controller = &scenario.controller;
    assert_eq!(
        (controller.law.as_str(), controller.period, controller.loop_delay),
        ("dq-pi", Time::from_ms(1.0).unwrap(), Time::ZERO)
    );
    assert!((controller.start_frequency_hz - 32_307.6).abs() < 1e-6);
    assert_eq!((scenario.trials.count, scenario.trials.max_count, scenario.trials.seed), (1, 1, 1));
    assert!(scenario.is_deterministic());
    assert_eq!(scenario.trace_step, Time::from_ms(0.05).unwrap());
    let [expectation] = &scenario.expectations[..] else { panic!("one expectation") };
    assert_eq!((expectation.confidence, expectation.band_percent), (0.95, 5.0));
    assert_eq!(expectation.window, Window { from: Time::from_ms(40.0).unwrap(), to: Time::from_ms(60.0).unwrap() });
    assert_eq!(expectation.signal, "amplitude_um");
}

#[test]
fn what_the_trials_come_to_can_be_chosen() {
    let over = |more: &str| load_with_change("confidence = 0.9", more).unwrap().expectations[1].aggregation;
    assert_eq!(over(""), Aggregation::Mean);
    assert_eq!(over("over = \"each\""), Aggregation::Each);
    assert_eq!(over("over = \"mean\""), Aggregation::Mean);
    assert_eq!(over("over = \"quantile\""), Aggregation::Quantile(0.95));
    assert_eq!(over("over = \"quantile\"\nquantile = 0.5"), Aggregation::Quantile(0.5));
    let all = load_with_changes(&[(
        "\"final_amplitude_um\"\nabout = 2.0\ntolerance_percent = 3.0",
        "\"repeatability_percent\"\nat_most = 2.0",
    )]);
    let all: Vec<_> = all.unwrap().expectations.iter().map(|expectation| expectation.aggregation).collect();
    assert_eq!(all, [Aggregation::Each, Aggregation::Mean, Aggregation::StandardDeviation]);
}

#[rstest]
#[case::head(&[
    ("\"All keys\"", "\" \""),
    ("\"All keys\"", "\"two\\nlines\""),
    ("title = \"All keys\"\n", ""),
    ("title = \"All keys\"", "titel = \"All keys\""),
    ("title = \"All keys\"", "title = All keys"),
    ("title = \"All keys\"", "title = 3"),
    ("plate = \"plates/plate.toml\"", "plate = \"plates/no-such.toml\""),
    ("plate = \"plates/plate.toml\"\n", ""),
    ("duration_ms = 60.0", "duration_ms = 0.0"),
    ("duration_ms = 60.0", "duration_ms = nan"),
    ("duration_ms = 60.0", "duration_ms = \"60 ms\""),
    ("duration_ms = 60.0", "duration_ms = 0.999999"),
    ("duration_ms = 60.0", "duration_ms = 1e11"),
    ("duration_ms = 60.0", "duration_s = 0.06"),
    ("trace_step_ms = 0.05", "trace_step_ms = 0.0"),
    ("trace_step_ms = 0.05", "trace_step_ms = 1e-6"),
    ("model = \"modal\"", "model = \"model\""),
    ("expected_exit = 1", "expected_exit = 2"),
    ("tags = [\"paper\"]", "tags = \"paper\""),
    ("tags = [\"paper\"]", "tags = [\"paper\"]\ntags = []"),
])]
#[case::controller(&[
    ("law = \"dq-pi\"", "law = \"\""),
    ("period_ms = 1.0", "period_ms = 0.0"),
    ("period_ms = 1.0", "period_ms = -1.0"),
    ("period_ms = 1.0", "period_ms = 0.0005"),
    ("period_ms = 1.0", "period_ms = 1.0005"),
    ("period_ms = 1.0", "period_ms = 1000.001"),
    ("period_ms = 1.0", "period_us = 1000.0"),
    ("loop_delay_ms = 0.0", "loop_delay_ms = -0.1"),
    ("loop_delay_ms = 0.0", "loop_delay_ms = 100.000001"),
    ("loop_delay_ms = 0.0", "loop_delay_ms = 60.0"),
    ("design_delay_ms = 0.0", "design_delay_ms = -0.001"),
    ("design_delay_ms = 0.0", "design_delay_ms = 0.0005"),
    ("design_delay_ms = 0.0", "design_delay_ms = 1.001"),
    ("start_frequency_hz = 32220.9", "start_frequency_hz = 0.0"),
    ("start_frequency_hz = 32220.9", "start_frequency_hz = 16153.7"),
    ("start_frequency_hz = 32220.9", "start_frequency_hz = 48461.5"),
    ("response_time_ms = 1.9", "response_time_ms = 0.0"),
    ("frequency_range_hz = 250.0", "frequency_range_hz = 0.0"),
    ("frequency_range_hz = 250.0", "frequency_range_hz = 32220.9"),
    ("frequency_slew_hz = 100.0", "frequency_slew_hz = inf"),
    ("response_time_ms = 1.9", "response_time_ms = 1e39"),
    ("amplitude_kp = 1.0", "amplitude_kp = -1e39"),
    ("amplitude_kp = 1.0", "amplitude_kp = nan"),
    ("amplitude_ki = 2.0", "amplitude_ki = inf"),
    ("frequency_kp = 3.0", "frequency_kp = -inf"),
    ("frequency_ki = 4.0", "frequency_ki = nan"),
    ("frequency_ki = 4.0\n", ""),
])]
#[case::profile(&[
    ("[[0.0, 0.0], [1.0, 2.0]] }", "[] }"),
    ("[1.0, 2.0]", "[1.0, -2.0]"),
    ("[1.0, 2.0]", "[1.0, nan]"),
    ("[1.0, 2.0]", "[0.0, 2.0]"),
    ("[1.0, 2.0]", "[-1.0, 2.0]"),
    ("[1.0, 2.0]", "[1.0, 1000.1]"),
    ("[1.0, 2.0]", "[1.0]"),
    ("{ hold = [[0.0, 0.0], [1.0, 2.0]] }", "-2.0"),
    ("{ hold = [[0.0, 0.0], [1.0, 2.0]] }", "\"2 um\""),
    ("{ hold = [[0.0, 0.0], [1.0, 2.0]] }", "{ ramp = [[0.0, 1.0]] }"),
    ("{ hold = [[0.0, 0.0], [1.0, 2.0]] }", "{ sine = { mean = 1.0, amplitude = 1.5, frequency_hz = 50.0 } }"),
    ("{ hold = [[0.0, 0.0], [1.0, 2.0]] }", "{ sine = { mean = 1.0, amplitude = 0.5, frequency_hz = 0.0 } }"),
    ("setpoint_um = {", "setpoint_mm = {"),
    ("[60.0, 2.0]", "[60.0, 40000.0]"),
    ("[60.0, 2.0]", "[60.0, -297.15]"),
    ("{ csv = \"force.csv\" }", "-0.1"),
    ("{ csv = \"force.csv\" }", "1e9"),
    ("\"force.csv\"", "\"no-such.csv\""),
    ("  30.0, 1.0", "  30.0, -1.0"),
    ("  30.0, 1.0", "  30.0, inf"),
    ("  30.0, 1.0", "  20.0, 1.0"),
    ("  30.0, 1.0", "  -1.0, 1.0"),
    ("  30.0, 1.0", "  30.0, 1 N"),
    ("  30.0, 1.0", "  30.0"),
    ("  30.0, 1.0", "  30.0, 1.0, 3.0"),
    ("t_ms, value", "t_ms, force"),
    ("20.0, 0.0\n\n  30.0, 1.0\n", "\n"),
])]
#[case::plate(&[
    ("time_constant_ms = 1.88", "time_constant_ms = 0.0"),
    ("resonance_hz = 32307.6", "resonance_hz = \"32 kHz\""),
    ("limit_vpp = 900.0", "limit_v = 900.0"),
    ("noise_um_rms = 0.0", "noise_um_rms = -0.1"),
    ("[1.5, 2.0]", "[1.5, 0.5]"),
    ("name = \"Aluminium", "name = Aluminium"),
    ("[drive]\n", ""),
])]
#[case::trials(&[
    ("count = 30", "count = 0"),
    ("count = 30", "count = -1"),
    ("count = 30", "count = 2.5"),
    ("count = 30\nmax_count = 200", "count = 100001"),
    ("max_count = 200", "max_count = 29"),
    ("max_count = 200", "max_count = 100001"),
    ("seed = 7", "seed = -1"),
    ("gain_percent = 1.0", "gain_percent = 20.1"),
    ("time_constant_percent = 2.0", "time_constant_percent = -0.1"),
    ("sensor_gain_percent = 3.0", "sensor_gain_percent = nan"),
    ("temperature_k = 4.0", "temperature_k = 20.1"),
    ("temperature_k = 4.0", "temperature_percent = 4.0"),
])]
#[case::faults(&[
    ("kind = \"flip\"", "kind = \"flipp\""),
    ("kind = \"flip\"", "kind = \"lightning\""),
    ("kind = \"flip\"\n", ""),
    ("kind = \"flip\"", "kinds = \"flip\""),
    ("from_ms = 10.0\nuntil_ms = 20.0", "until_ms = 20.0"),
    ("from_ms = 10.0\nuntil_ms = 20.0", "from_ms = -1.0\nuntil_ms = 20.0"),
    ("from_ms = 10.0\nuntil_ms = 20.0", "from_ms = 60.0\nuntil_ms = 70.0"),
    ("from_ms = 10.0\nuntil_ms = 11.0\n", "from_ms = 10.0\n"),
    ("until_ms = 20.0", "until_ms = 10.0"),
    ("until_ms = 20.0", "until_ms = nan"),
    ("until_ms = 60.0", "until_ms = 60.000001"),
    ("every = 10", "every = 0"),
    ("every = 10", "every = -1"),
    ("every = 10", "every = 11"),
    ("every = 10", "every = 4294967296"),
    ("every = 10", "every = 1.5"),
    ("from_ms = 10.0\nuntil_ms = 11.0", "from_ms = 10.1\nuntil_ms = 10.9"),
    ("seed = 5", "seed = -1"),
    ("direction = \"to-controller\"", "direction = \"to-the-controller\""),
    ("direction = \"to-controller\"", "direction = \"sideways\""),
    ("direction = \"to-controller\"", "delay_ms = 1.0"),
    ("direction = \"to-controller\"", "factor = 1.0"),
    ("delay_ms = 0.5\n", ""),
    ("delay_ms = 0.5", "delay_ms = 0.0"),
    ("delay_ms = 0.5", "delay_ms = 1e-7"),
    ("delay_ms = 0.5", "delay_ms = 100.000001"),
    ("delay_ms = 0.5", "delay_ms = 0.5\nseed = 1"),
    ("factor = 0.9\n", ""),
    ("factor = 0.9", "factor = inf"),
    ("factor = 0.9", "factor = 1e39"),
    ("factor = 0.9", "factor = 1.0"),
    ("factor = 0.9", "factor = 0.9\ndirection = \"both\""),
    ("kind = \"disconnect\"", "kind = \"disconnect\"\nevery = 2"),
    ("kind = \"disconnect\"", "kind = \"disconnect\"\nreconfigure = true"),
    ("\"final_amplitude_um\"\nabout = 2.0\ntolerance_percent = 3.0", "\"shutdown_time_ms\"\nat_most = 5.0"),
])]
#[case::expectations(&[
    ("\"settling_time_ms\"", "\"settling_time\""),
    ("\"settling_time_ms\"", "\"colour\""),
    ("metric = \"settling_time_ms\"\n", ""),
    ("at_most = 2.0", "at_moste = 2.0"),
    ("at_most = 2.0\n", ""),
    ("at_most = 2.0", "at_most = 2.0\nat_least = 1.0"),
    ("at_most = 2.0", "at_most = nan"),
    ("at_most = 2.0", "at_most = -0.1"),
    ("at_most = 2.0", "at_least = 0.0"),
    ("at_most = 2.0", "about = 0.0"),
    ("within = [0.0, 1.0]", "within = [1.0, 0.9]"),
    ("within = [0.0, 1.0]", "within = [0.0, inf]"),
    ("within = [0.0, 1.0]", "within = [-2.0, -1.0]"),
    ("tolerance_percent = 3.0", "tolerance_percent = 0.0"),
    ("tolerance_percent = 3.0", "band_percent = 3.0"),
    ("tolerance_percent = 3.0", "window_ms = 3.0"),
    ("\"final_amplitude_um\"\nabout = 2.0\ntolerance_percent = 3.0", "\"loop_delay_us\"\nat_most = 5.0\nfrom_ms = 3.0"),
    ("tolerance_percent = 3.0", "signal = \"wd_um\""),
    ("paper = 2.0", "tolerance_percent = 2.0"),
    ("paper = 2.0", "paper = inf"),
    ("\"final_amplitude_um\"\nabout = 2.0", "\"repeatability_percent\"\nabout = 1.3"),
    ("\"final_amplitude_um\"\nabout = 2.0\ntolerance_percent = 3.0", "\"recovery_time_ms\"\nat_most = 5.0"),
    ("\"final_amplitude_um\"\nabout = 2.0\ntolerance_percent = 3.0", "\"saturated_percent\"\nat_most = 100.0"),
    ("\"final_amplitude_um\"\nabout = 2.0\ntolerance_percent = 3.0", "\"saturated_percent\"\nat_least = 100.1"),
    ("band_percent = 5.0", "band_percent = 0.0"),
    ("band_percent = 5.0", "band_percent = 100.0"),
    ("confidence = 0.9", "confidence = 0.49"),
    ("confidence = 0.9", "confidence = 1.0"),
    ("confidence = 0.9", "confidence = 95"),
    ("confidence = 0.9", "over = \"median\""),
    ("confidence = 0.9", "over = \"quantle\""),
    ("confidence = 0.9", "quantile = 0.9"),
    ("confidence = 0.9", "over = \"mean\"\nquantile = 0.9"),
    ("confidence = 0.9", "over = \"quantile\"\nquantile = 0.0"),
    ("confidence = 0.9", "over = \"quantile\"\nquantile = 1.0"),
    ("\"final_amplitude_um\"\nabout = 2.0\ntolerance_percent = 3.0", "\"repeatability_percent\"\nabout = 1.3\nover = \"mean\""),
    ("from_ms = 1.0", "from_ms = 60.0"),
    ("from_ms = 1.0", "from_ms = -1.0"),
    ("signal = \"amplitude_um\"", "signal = \"amplitude\""),
    ("signal = \"amplitude_um\"", "signal = \"drive_vpp\""),
    ("window_ms = 20.0", "window_ms = 0.0"),
    ("window_ms = 20.0", "window_ms = 60.000001"),
    ("window_ms = 20.0", "window_ms = [30.0, 60.000001]"),
    ("window_ms = 20.0", "window_ms = [30.0, 30.0]"),
    ("window_ms = 20.0", "window_ms = [-1.0, 30.0]"),
    ("window_ms = 20.0", "window_ms = \"last third\""),
    ("window_ms = 20.0", "window_ms = [0.5, 30.0]"),
    ("window_ms = 20.0", "window_ms = [0.0, 1.0]"),
])]
fn every_broken_rule_is_pointed_at(#[context] context: Context, #[case] cases: &[(&str, &str)]) {
    let group = context.description.unwrap();
    assert_snapshot!(format!("refused_{group}"), message_table(cases));
}

#[test]
fn a_window_needs_a_resting_setpoint_whatever_its_shape() {
    let hold = "{ hold = [[0.0, 0.0], [1.0, 2.0]] }";
    for moving in [
        "{ linear = [[0.0, 0.0], [41.0, 2.0]] }",
        "{ linear = [[0.0, 2.0], [59.9, 2.0], [60.0, 2.1]] }",
        "{ hold = [[0.0, 2.0], [59.9, 2.1]] }",
        "{ hold = [[0.0, 2.0], [50.0, 1.0], [55.0, 2.0]] }",
        "{ sine = { mean = 2.0, amplitude = 0.1, frequency_hz = 50.0 } }",
        // On its crest at both ends of the window.
        "{ sine = { mean = 500.0, amplitude = 0.1, frequency_hz = 50.0, phase_deg = 90.0 } }",
    ] {
        let fault = load_with_change(hold, moving).unwrap_err();
        assert!(fault.message.starts_with("the setpoint changes between 40 ms and 60 ms"), "{moving}: {fault}");
    }
    for resting in [
        "{ linear = [[0.0, 0.0], [40.0, 2.0]] }",
        "{ hold = [[0.0, 2.0], [60.0, 2.1]] }",
        "{ hold = [[0.0, 2.0], [50.0, 2.0]] }",
        "{ sine = { mean = 2.0, amplitude = 0.0, frequency_hz = 50.0 } }",
    ] {
        assert!(load_with_change(hold, resting).is_ok(), "{resting}");
    }
}

#[test]
fn so_many_expectations_are_pointed_at_and_no_more() {
    let folder = create_folder(&[]);
    let wrong = "[[expect]]\nmetric = \"unknown\"\n".repeat(5_000);
    let path = folder.path().join("s.toml");
    std::fs::write(&path, format!("{BASE}\n{wrong}")).unwrap();
    let faults = load_with_diagnostics(&path, "s.toml").unwrap_err();
    assert_eq!(faults.len(), MAX_DIAGNOSTICS + 1);
    assert!(faults.last().unwrap().message.starts_with("only the first"));
}

#[test]
fn a_scenario_that_expects_nothing_is_refused() {
    let folder = create_folder(&[]);
    let path = folder.path().join("s.toml");
    std::fs::write(&path, BASE.split("[[expect]]").next().unwrap()).unwrap();
    let fault = load(&path, "s.toml").unwrap_err();
    assert!(fault.message.starts_with("no [[expect]], expected at least one"), "{fault}");
}

/// The last value on either side that is still good; the first bad ones stand in the snapshots.
#[rstest]
#[case("duration_ms = 60.0", "duration_ms = 60")]
#[case("period_ms = 1.0", "period_ms = 0.001")]
#[case("period_ms = 1.0", "period_ms = 60.0")]
#[case("duration_ms = 60.0\ntags = [\"paper\"]\ntrace_step_ms = 0.05", "duration_ms = 1e5\ntrace_step_ms = 0.05")]
#[case("loop_delay_ms = 0.0", "loop_delay_ms = 59.999999")]
#[case("design_delay_ms = 0.0", "design_delay_ms = 0.001")]
#[case("design_delay_ms = 0.0", "design_delay_ms = 1.0")]
#[case("start_frequency_hz = 32220.9", "start_frequency_hz = 16153.9")]
#[case("start_frequency_hz = 32220.9", "start_frequency_hz = 48461.3")]
#[case("frequency_range_hz = 250.0", "frequency_range_hz = 32220.8")]
#[case("expected_exit = 1", "expected_exit = 3")]
#[case("expected_exit = 1", "expected_exit = 5")]
#[case("from_ms = 10.0\nuntil_ms = 20.0", "from_ms = 0.0\nuntil_ms = 60.0")]
#[case("from_ms = 10.0\nuntil_ms = 11.0", "from_ms = 59.0\nuntil_ms = 59.000001")]
#[case("every = 10", "every = 1")]
#[case("delay_ms = 0.5", "delay_ms = 100.0")]
#[case("delay_ms = 0.5", "delay_ms = 1e-6")]
#[case("factor = 0.9", "factor = -1.0")]
#[case("factor = 0.9", "factor = 3.4e38")]
#[case("kind = \"disconnect\"", "kind = \"disconnect\"\nuntil_ms = 40.0\nreconfigure = true")]
#[case("expected_exit = 1\n", "")]
#[case("trace_step_ms = 0.05", "trace_step_ms = 3e-5")]
#[case("trace_step_ms = 0.05", "trace_step_ms = 1000.0")]
#[case("[1.0, 2.0]", "[1.0, 1000.0]")]
#[case("[60.0, 2.0]", "[60.0, -297.14]")]
#[case("count = 30\nmax_count = 200", "count = 1\nmax_count = 1")]
#[case("count = 30\nmax_count = 200", "count = 100000")]
#[case("max_count = 200", "max_count = 30")]
#[case("max_count = 200", "max_count = 100000")]
#[case("seed = 7", "seed = 0")]
#[case("seed = 7", "seed = 9223372036854775807")]
#[case("gain_percent = 1.0", "gain_percent = 20.0")]
#[case("gain_percent = 1.0", "gain_percent = 0.0")]
#[case("temperature_k = 4.0", "temperature_k = 20.0")]
#[case("band_percent = 5.0", "band_percent = 99.999")]
#[case("confidence = 0.9", "confidence = 0.5")]
#[case("confidence = 0.9", "confidence = 0.9999999999999999")]
#[case("confidence = 0.9", "over = \"quantile\"\nquantile = 0.000001")]
#[case("confidence = 0.9", "over = \"quantile\"\nquantile = 0.999999")]
#[case("from_ms = 1.0", "from_ms = 59.999999")]
#[case("from_ms = 1.0", "from_ms = 0.0")]
#[case("window_ms = 20.0", "window_ms = 59.0")]
#[case("window_ms = 20.0", "window_ms = [1.0, 60.0]")]
#[case("window_ms = 20.0", "window_ms = [59.999999, 60.0]")]
#[case("within = [0.0, 1.0]", "within = [1.0, 1.0]")]
#[case("at_most = 2.0", "at_most = 0.0")]
#[case("at_most = 2.0", "at_least = 1e-9")]
#[case("\"final_amplitude_um\"\nabout = 2.0\ntolerance_percent = 3.0", "\"saturated_percent\"\nat_most = 99.9")]
#[case("\"final_amplitude_um\"\nabout = 2.0\ntolerance_percent = 3.0", "\"saturated_percent\"\nat_least = 100.0")]
#[case("\"final_amplitude_um\"\nabout = 2.0\ntolerance_percent = 3.0", "\"overruns\"\nat_most = 0.0")]
fn the_last_good_value_is_taken(#[case] good: &str, #[case] last_good: &str) {
    if let Err(fault) = load_with_change(good, last_good) {
        panic!("{}", render(&fault));
    }
    let folder = create_folder(&[(good, last_good)]);
    let text = std::fs::read_to_string(folder.path().join("s.toml")).unwrap();
    let document = serde_json::to_value(toml::from_str::<toml::Table>(&text).unwrap()).unwrap();
    if let Err(fault) = jsonschema::validate(crate::schema::scenario_schema().as_value(), &document) {
        panic!("the schema refuses what is good: {fault}");
    }
}

#[test]
fn a_trial_may_be_one_period_long_and_a_period_one_second() {
    let expectation = ("from_ms = 1.0", "from_ms = 0.0");
    let window = ("window_ms = 20.0", "window_ms = 0.5");
    let setpoint = ("{ hold = [[0.0, 0.0], [1.0, 2.0]] }", "2.0");
    assert!(load_with_changes(&[("duration_ms = 60.0", "duration_ms = 1.0"), expectation, window, setpoint]).is_ok());
    assert!(
        load_with_changes(&[("duration_ms = 60.0", "duration_ms = 1000.0"), ("period_ms = 1.0", "period_ms = 1000.0")])
            .is_ok()
    );
}

#[test]
fn a_row_per_control_instant_counts_towards_the_rows() {
    let long = |duration: &str| {
        load_with_changes(&[
            ("duration_ms = 60.0", duration),
            ("trace_step_ms = 0.05", "trace_step_ms = 1e6"),
            ("period_ms = 1.0", "period_ms = 0.01"),
        ])
    };
    assert!(long("duration_ms = 20000.0").is_ok());
    let fault = long("duration_ms = 20000.1").unwrap_err();
    assert!(fault.message.contains("2000010 rows, expected at most 2000000"), "{fault}");
    assert_eq!(fault.position(), (4, 15));
}

#[test]
fn long_scenarios_have_a_row_per_period() {
    let step = |duration: &str| {
        load_with_changes(&[("duration_ms = 60.0", duration), ("trace_step_ms = 0.05\n", "")]).unwrap().trace_step.ms()
    };
    assert_eq!(step("duration_ms = 1000.0"), 0.05);
    assert_eq!(step("duration_ms = 1000.1"), 1.0);
}

#[test]
fn a_damping_corner_between_the_forces_is_seen() {
    let curve = ("[[0.0, 1.0], [1.5, 2.0]]", "[[0.0, 1.0], [0.5, 400.0], [1.0, 2.0], [1.5, 2.0]]");
    let fault = load_with_changes(&[curve]).err().unwrap();
    assert!(fault.message.contains("leave the plate without a resonance"), "{}", render(&fault));
    assert!(load_with_changes(&[curve, ("  30.0, 1.0", "  30.0, 0.3")]).is_ok());
    // Not on a corner, and only with the heat of the day: the lightest touch.
    let light = ("[[0.0, 1.0], [1.5, 2.0]]", "[[0.0, 560.0], [0.5, 2.0], [1.5, 2.0]]");
    let touch = ("20.0, 0.0", "20.0, 0.25");
    assert!(load_with_changes(&[light, touch]).is_ok());
    let fault = load_with_changes(&[light, touch, ("[60.0, 2.0]", "[60.0, 700.0]")]).err().unwrap();
    assert_eq!(fault.position(), (28, 55), "{}", render(&fault));
}

/// A stretch of the base text that the marked value should be.
#[rstest]
#[case("period_ms = 1.0", "period_ms = 0.0", "0.0")]
#[case("[1.0, 2.0]", "[1.0, -2.5]", "-2.5")]
#[case("within = [0.0, 1.0]", "within = [9.0, 1.0]", "[9.0, 1.0]")]
#[case("\"settling_time_ms\"", "\"settling\"", "\"settling\"")]
#[case("  30.0, 1.0", "  30.0, -1.5", "-1.5")]
#[case("  30.0, 1.0", "  19.5, 1.0", "19.5")]
#[case("time_constant_ms = 1.88", "time_constant_ms = -1.5", "-1.5")]
fn the_offending_value_is_marked_and_nothing_else(#[case] good: &str, #[case] bad: &str, #[case] marked: &str) {
    let fault = load_with_change(good, bad).unwrap_err();
    let file = [BASE, PLATE, FORCE].into_iter().find(|text| text.contains(good)).unwrap().replacen(good, bad, 1);
    let start = file.find(bad).unwrap() + bad.rfind(marked).unwrap();
    let before = &file[..start];
    let column = before.chars().rev().take_while(|character| *character != '\n').count() + 1;
    assert_eq!(fault.position(), (before.matches('\n').count() + 1, column));
    let carets = "^".repeat(marked.chars().count());
    let marks: String = render(&fault).chars().filter(|character| *character == '^').collect();
    assert_eq!(marks, carets, "{}", render(&fault));
}

fn loaded_bytes(bytes: &[u8]) -> Result<Scenario, Diagnostic> {
    let folder = create_folder(&[]);
    let path = folder.path().join("s.toml");
    std::fs::write(&path, bytes).unwrap();
    load(&path, "s.toml").map_err(|mut fault| {
        fault.path = "s.toml".into();
        fault
    })
}

#[test]
fn files_of_other_systems_are_read() {
    assert!(loaded_bytes(BASE.replace('\n', "\r\n").as_bytes()).is_ok(), "CRLF");
    assert!(loaded_bytes(format!("\u{feff}{BASE}").as_bytes()).is_ok(), "BOM");
    let broken = BASE.replace("period_ms = 1.0", "period_ms = 0.0");
    for text in [broken.replace('\n', "\r\n"), format!("\u{feff}{broken}")] {
        assert_eq!(loaded_bytes(text.as_bytes()).unwrap_err().position(), (12, 13));
    }
}

#[test]
fn what_is_no_scenario_at_all_gets_a_diagnostic() {
    let cases: [(&str, &[u8]); 8] = [
        ("Latin 1", b"title = \"\xe9\""),
        ("empty", b""),
        ("blank", b"\n\n"),
        ("an umlaut", "\u{e9}".as_bytes()),
        ("a string that does not end", "title = \"\u{e9}".as_bytes()),
        ("a table that does not end", "title = \"\u{e9}\"\n[controller".as_bytes()),
        ("a byte order mark and nothing", "\u{feff}".as_bytes()),
        ("binary", &[0, 1, 2, 0xff]),
    ];
    let mut table = String::new();
    for (name, bytes) in cases {
        let fault = loaded_bytes(bytes).unwrap_err();
        write!(table, "## {name}\n{fault}\n{}\n\n", render(&fault)).unwrap();
    }
    assert_snapshot!("no_scenario", table);
}

#[test]
fn files_that_are_not_there_are_named() {
    let nowhere = load(Path::new("no/such.toml"), "such.toml").unwrap_err();
    assert!(nowhere.to_string().starts_with("no/such.toml: cannot be read: "), "{nowhere}");
    let folder = create_folder(&[]);
    let fault = load(folder.path(), "x").unwrap_err();
    assert!(fault.message.starts_with("cannot be read: "), "{fault}");
}

#[test]
fn a_plate_file_that_is_not_text_is_pointed_into() {
    let folder = create_folder(&[]);
    std::fs::write(folder.path().join("plates/plate.toml"), b"name = \"\xff\"\n").unwrap();
    let fault = load(&folder.path().join("s.toml"), "s.toml").unwrap_err();
    assert!(fault.path.ends_with("plates/plate.toml"));
    assert_eq!(fault.position(), (1, 9));
}

#[test]
fn metrics_have_the_names_that_they_are_called_by() {
    for metric in Metric::ALL {
        assert_eq!(Metric::from_name(metric.name()), Some(metric));
    }
}

#[test]
fn a_shutdown_has_to_last_until_the_next_configuration_that_is_planned() {
    let window = |from_ms: f64| {
        let expectation = format!("\"shutdown_time_ms\"\nfrom_ms = {from_ms:?}\nat_most = 5.0");
        let other = ("\"final_amplitude_um\"\nabout = 2.0\ntolerance_percent = 3.0", expectation.as_str());
        let scenario = load_with_changes(&[other, ("seed = 5", "seed = 5")]).unwrap();
        let Window { from, to } = scenario.expectations[2].window;
        (from.ms(), to.ms())
    };
    assert_eq!(window(19.0), (19.0, 20.0));
    assert_eq!(window(20.0), (20.0, 60.0));
}

/// The last good and the first bad: a quality factor of 1e9, and what single precision carries.
#[rstest]
#[case(
    "time_constant_ms = 1.88",
    "time_constant_ms = 9.852e6",
    "time_constant_ms = 9.853e6",
    "a quality factor of 1.000e9"
)]
#[case("gain_um_per_vpp = 0.00698", "gain_um_per_vpp = 3.4e38", "gain_um_per_vpp = 3.5e38", "single precision")]
#[case("gain_um_per_vpp = 0.00698", "gain_um_per_vpp = 1.2e-38", "gain_um_per_vpp = 1.1e-38", "single precision")]
#[case("limit_vpp = 900.0", "limit_vpp = 3.4e38", "limit_vpp = 3.5e38", "single precision")]
#[case("[[0.0, 1.0], [1.5, 2.0]]", "[[0.0, 1e-6], [1.5, 2.0]]", "[[0.0, 1e-7], [1.5, 2.0]]", "without a resonance")]
#[case(
    "slope_hz_per_k = -9.638",
    "slope_hz_per_k = 1.1e5",
    "slope_hz_per_k = 1.2e5",
    "without a resonance, expected one of at most 2.5e6 Hz"
)]
fn a_plate_that_cannot_be_computed_or_told_is_refused(
    #[case] plain: &str,
    #[case] good: &str,
    #[case] bad: &str,
    #[case] message: &str,
) {
    let with = |other| {
        load_with_changes(&[
            (plain, other),
            ("temperature_k = 4.0", "temperature_k = 0.0"),
            ("[60.0, 2.0]", "[60.0, 22.0]"),
        ])
    };
    assert!(with(good).is_ok(), "{}", render(&with(good).err().unwrap()));
    let fault = with(bad).err().unwrap();
    assert!(fault.message.contains(message), "{}", render(&fault));
}

#[rstest]
#[case::plain("auto", "", Tier::Modal)]
#[case::left_out("", "", Tier::Modal)]
#[case::converter("auto", "demodulator_periods = 1\nconverter_hz = 1e6\n", Tier::Carrier)]
#[case::linear("linear", "demodulator_periods = 1\nconverter_hz = 1e6\n", Tier::Linear)]
#[case::envelope("envelope", "", Tier::Envelope)]
#[case::modal("modal", "demodulator_periods = 1\nconverter_hz = 1e6\n", Tier::Modal)]
#[case::carrier("carrier", "", Tier::Carrier)]
fn auto_is_the_carrier_only_for_a_plate_with_a_demodulator(
    #[case] model: &str,
    #[case] sensor: &str,
    #[case] tier: Tier,
) {
    let model = if model.is_empty() { String::new() } else { format!("model = \"{model}\"") };
    let folder = create_folder(&[("model = \"modal\"", &model), ("[sensor]\n", &format!("[sensor]\n{sensor}"))]);
    assert_eq!(load(&folder.path().join("s.toml"), "s.toml").unwrap().tier, tier);
}
