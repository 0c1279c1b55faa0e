use super::{BASE, FORCE, PLATE, create_folder, load_with_change, render};
use crate::scenario::diagnostic::{Diagnostic, MAX_DIAGNOSTICS};
use crate::scenario::load::{load, load_with_all_errors};
use insta::assert_snapshot;
use rstest::{Context, rstest};
use std::fmt::Write;

fn is_rejected_by_schema(fault: &Diagnostic, good: &str, bad: &str) -> bool {
    let folder = create_folder(&[(good, bad)]);
    let schema = match fault.path.to_str().unwrap() {
        "s.toml" => crate::scenario::schema::scenario_schema(),
        "plates/plate.toml" => crate::scenario::schema::plate_schema(),
        _ => return false,
    };
    let text = std::fs::read_to_string(folder.path().join(&fault.path)).unwrap();
    // An editor reports a TOML error without a schema.
    let Ok(document) = toml::from_str::<toml::Table>(&text) else { return true };
    let is_rejected = !jsonschema::is_valid(schema.as_value(), &serde_json::to_value(document).unwrap());
    let structural =
        ["unknown key", "missing key", "invalid type", "invalid length", "unknown metric", "unknown signal"];
    let structural = structural.iter().any(|kind| fault.message.starts_with(kind));
    assert!(
        is_rejected || !structural || fault.message.contains("(floating"),
        "the schema accepts `{bad}`: {}",
        fault.message
    );
    is_rejected
}

fn message_table(cases: &[(&str, &str)]) -> String {
    let mut table = String::new();
    for (good, bad) in cases {
        let fault = load_with_change(good, bad).err().unwrap_or_else(|| panic!("`{bad}` was accepted"));
        let (line, column) = fault.position();
        let heading = if bad.is_empty() { format!("without {good}") } else { (*bad).to_owned() };
        let by_schema = if is_rejected_by_schema(&fault, good, bad) { "rejects it too" } else { "accepts it" };
        let heading = heading.trim().replace('\n', " ⏎ ");
        write!(table, "## {heading}\n{line}:{column}\n{}\nthe schema {by_schema}\n\n", render(&fault)).unwrap();
    }
    table
}

/// The expectation of the base scenario that cases replace by another one.
const FINAL: &str = "\"final_amplitude_um\"\nabout = 2.0\ntolerance_percent = 3.0";

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
    ("loop_delay_ms = 0.0", "loop_delay_jitter_ms = -0.1"),
    ("loop_delay_ms = 0.0", "loop_delay_ms = 50.0\nloop_delay_jitter_ms = 50.1"),
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
    ("{ hold = [[0.0, 0.0], [1.0, 2.0]] }", "{ square = 3 }"),
    ("{ hold = [[0.0, 0.0], [1.0, 2.0]] }", "{ csv = 3 }"),
    ("{ hold = [[0.0, 0.0], [1.0, 2.0]] }", "{ sine = { mean = 1.0, amplitude = 1.5, frequency_hz = 50.0 } }"),
    ("{ hold = [[0.0, 0.0], [1.0, 2.0]] }", "{ sine = { mean = 1.0, amplitude = 0.5, frequency_hz = 0.0 } }"),
    ("{ hold = [[0.0, 0.0], [1.0, 2.0]] }", "{ chirp = { mean = 1.0, amplitude = 0.5, from_hz = 0.0, to_hz = 9.0 } }"),
    ("{ hold = [[0.0, 0.0], [1.0, 2.0]] }", "{ square = { low = -1.0, high = 2.0, period_ms = 9.0 } }"),
    ("{ hold = [[0.0, 0.0], [1.0, 2.0]] }", "{ repeat = { period_ms = 2.0, hold = [[0.5, 1.0], [1.0, -2.0]] } }"),
    ("{ hold = [[0.0, 0.0], [1.0, 2.0]] }", "{ repeat = { period_ms = 2.0, linear = [[0.0, 1.0], [2.0, 2.0]] } }"),
    ("{ hold = [[0.0, 0.0], [1.0, 2.0]] }", "{ repeat = { period_ms = 2.0 } }"),
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
    ("t_ms, value", "t_ms, value, value"),
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
    (FINAL, "\"shutdown_time_ms\"\nat_most = 5.0"),
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
    (FINAL, "\"loop_delay_us\"\nat_most = 5.0\nfrom_ms = 3.0"),
    ("tolerance_percent = 3.0", "signal = \"wd_um\""),
    ("paper = 2.0", "tolerance_percent = 2.0"),
    ("paper = 2.0", "paper = inf"),
    ("\"final_amplitude_um\"\nabout = 2.0", "\"repeatability_percent\"\nabout = 1.3"),
    (FINAL, "\"recovery_time_ms\"\nat_most = 5.0"),
    (FINAL, "\"saturated_percent\"\nat_most = 100.0"),
    (FINAL, "\"saturated_percent\"\nat_least = 100.1"),
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
    (FINAL,
        "\"repeatability_percent\"\nabout = 1.3\nover = \"mean\""),
    (FINAL, "\"text_ms\"\nat_most = 5.0\ntext = \"ready\""),
    (FINAL, "\"text_ms\"\nat_most = 5.0\nfrom_ms = 3.0"),
    (FINAL, "\"text_ms\"\nat_most = 5.0\nfrom_ms = 3.0\ntext = \"\""),
    (FINAL, "\"enable_off_ms\"\nat_most = 5.0\nfrom_ms = 3.0\ntext = \"ready\""),
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
fn points_at_every_broken_rule(#[context] context: Context, #[case] cases: &[(&str, &str)]) {
    let group = context.description.unwrap();
    assert_snapshot!(format!("rejected_{group}"), message_table(cases));
}

#[test]
fn a_window_needs_a_constant_setpoint() {
    let hold = "{ hold = [[0.0, 0.0], [1.0, 2.0]] }";
    for moving in [
        "{ linear = [[0.0, 0.0], [41.0, 2.0]] }",
        "{ linear = [[0.0, 2.0], [59.9, 2.0], [60.0, 2.1]] }",
        "{ hold = [[0.0, 2.0], [59.9, 2.1]] }",
        "{ hold = [[0.0, 2.0], [50.0, 1.0], [55.0, 2.0]] }",
        "{ sine = { mean = 2.0, amplitude = 0.1, frequency_hz = 50.0 } }",
        // This sine is at its maximum at both ends of the window.
        "{ sine = { mean = 500.0, amplitude = 0.1, frequency_hz = 50.0, phase_deg = 90.0 } }",
    ] {
        let fault = load_with_change(hold, moving).unwrap_err();
        assert!(
            fault.message.starts_with("`window_ms`: the setpoint changes between 40 ms and 60 ms"),
            "{moving}: {fault}"
        );
    }
    for constant in [
        "{ linear = [[0.0, 0.0], [40.0, 2.0]] }",
        "{ hold = [[0.0, 2.0], [60.0, 2.1]] }",
        "{ hold = [[0.0, 2.0], [50.0, 2.0]] }",
        "{ sine = { mean = 2.0, amplitude = 0.0, frequency_hz = 50.0 } }",
    ] {
        assert!(load_with_change(hold, constant).is_ok(), "{constant}");
    }
}

#[test]
fn limits_the_number_of_reported_errors() {
    let folder = create_folder(&[]);
    let wrong = "[[expect]]\nmetric = \"unknown\"\n".repeat(5_000);
    let path = folder.path().join("s.toml");
    std::fs::write(&path, format!("{BASE}\n{wrong}")).unwrap();
    let faults = load_with_all_errors(&path, "s.toml").unwrap_err();
    assert_eq!(faults.len(), MAX_DIAGNOSTICS + 1);
    assert!(faults.last().unwrap().message.starts_with("only the first"));
}

#[test]
fn rejects_a_scenario_without_expectations() {
    let folder = create_folder(&[]);
    let path = folder.path().join("s.toml");
    std::fs::write(&path, BASE.split("[[expect]]").next().unwrap()).unwrap();
    let fault = load(&path, "s.toml").unwrap_err();
    assert!(fault.message.starts_with("no [[expect]], expected at least one"), "{fault}");
}

#[rstest]
#[case("period_ms = 1.0", "period_ms = 0.0", "0.0")]
#[case("[1.0, 2.0]", "[1.0, -2.5]", "-2.5")]
#[case("within = [0.0, 1.0]", "within = [9.0, 1.0]", "[9.0, 1.0]")]
#[case("\"settling_time_ms\"", "\"settling\"", "\"settling\"")]
#[case("  30.0, 1.0", "  30.0, -1.5", "-1.5")]
#[case("  30.0, 1.0", "  19.5, 1.0", "19.5")]
#[case("time_constant_ms = 1.88", "time_constant_ms = -1.5", "-1.5")]
fn marks_only_the_wrong_value(#[case] good: &str, #[case] bad: &str, #[case] marked: &str) {
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
