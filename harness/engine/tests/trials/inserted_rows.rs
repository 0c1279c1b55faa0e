//! Tests that rows at crossings of a band have the values of their own instant in every column.

use crate::fixtures::{LOCKSTEP, plan, run_hosted};
use platebench_model::trace::{Flags, Row, read_trace};
use platebench_test_kit::{PLATE, write_scenario};

const RISE_K_PER_UM2: f64 = 4.0;
const TIME_CONSTANT_S: f64 = 0.03;
/// Slope of the resonance, Hz/K.
const SLOPE: f64 = -9.638;

/// Rows of a step to 4 µm. The vibration heats the plate, the setpoint falls to 2 µm at 30 ms.
fn rows(plate: &str, profile: &str) -> Vec<Row> {
    let text = format!(
        "title = \"a\"\nplate = \"plate.toml\"\nduration_ms = 60.0\ntrace_step_ms = 0.05\n\
         expect = [{{ metric = \"settling_time_ms\", at_most = 50.0 }}]\n\
         [controller]\nlaw = \"dq-pi\"\nstart_frequency_hz = 32220.9\n\
         [profile]\nsetpoint_um = {{ hold = [[0.0, 4.0], [30.0, 2.0]] }}\n{profile}"
    );
    let folder = tempfile::tempdir().unwrap();
    let scenario = write_scenario(folder.path(), &text, plate);
    let out = folder.path().join("run");
    let record = run_hosted(&plan(vec![scenario], LOCKSTEP), &out);
    assert_eq!(record.scenarios.len(), 1);
    let trace = std::fs::read_dir(out.join("traces")).unwrap().next().unwrap().unwrap().path();
    read_trace(&trace.join("000.csv")).unwrap()
}

fn is_inserted(row: &Row) -> bool {
    let steps = row.t_s / 5e-5;
    (steps - steps.round()).abs() > 1e-6
}

/// Integrates the equation of the temperature along the amplitudes of the trace.
#[test]
fn an_inserted_row_has_the_resonance_of_its_instant() {
    let heating =
        format!("{PLATE}\n[heating]\nrise_k_per_um2 = {RISE_K_PER_UM2}\ntime_constant_s = {TIME_CONSTANT_S}\n");
    let rows = rows(&heating, "");
    assert!(rows.iter().filter(|row| is_inserted(row)).count() >= 4);
    let rise_k = |row: &Row| (row.resonance_hz - rows[0].resonance_hz) / SLOPE;
    let mut worst = 0.0_f64;
    for [from, to] in rows.array_windows() {
        let h = (to.t_s - from.t_s) / TIME_CONSTANT_S;
        let heat = RISE_K_PER_UM2 * (from.amplitude_um.powi(2) + to.amplitude_um.powi(2)) / 2.0;
        // The trapezoidal rule of both terms.
        let expected = (rise_k(from) * (1.0 - h / 2.0) + h * heat) / (1.0 + h / 2.0);
        worst = worst.max((rise_k(to) - expected).abs());
    }
    // The rule itself is wrong by 2e-4 K; the rise at the end of the enclosing step would be wrong by 0.015 K.
    println!("temperature between rows: {worst:.1e} K");
    assert!(worst < 5e-4, "{worst:e} K");
}

#[test]
fn an_inserted_row_has_the_conditions_and_the_command_of_its_instant() {
    let profile = "temperature_offset_k = { linear = [[0.0, 0.0], [60.0, 3.0]] }\n\
                   finger_force_n = { linear = [[0.0, 0.1], [60.0, 0.4]] }\n";
    let rows = rows(PLATE, profile);
    let mut inserted = 0;
    for [before, row] in rows.array_windows() {
        let (offset, force) = (50.0 * row.t_s, 0.1 + 5.0 * row.t_s);
        assert!((row.temperature_offset_k - offset).abs() < 1e-9, "{row:?}");
        assert!((row.finger_force_n - force).abs() < 1e-9, "{row:?}");
        assert!((row.resonance_hz - (rows[0].resonance_hz + SLOPE * offset)).abs() < 1e-6, "{row:?}");
        assert_eq!(row.setpoint_um, if row.t_s < 0.03 { 4.0 } else { 2.0 });
        assert!((row.wd_um.hypot(row.wq_um) - row.amplitude_um).abs() < 1e-12);
        if is_inserted(row) {
            inserted += 1;
            let command = |row: &Row| (row.drive_vpp, row.frequency_hz, row.sensed_wd_um, row.sensed_wq_um);
            assert_eq!(command(row), command(before));
            assert_eq!(row.flags, before.flags - Flags::CONTROL);
            assert_eq!(row.lateness_us, 0.0);
        }
    }
    assert!(inserted >= 4, "{inserted}");
}
