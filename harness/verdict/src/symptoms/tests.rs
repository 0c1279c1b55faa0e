use super::*;
use platebench_model::record::NonFiniteDrive;
use platebench_test_kit::{PLATE, parse_scenario};
use rstest::rstest;

fn scenario() -> Scenario {
    let text = "title = \"Synthetic\"\nplate = \"plate.toml\"\nduration_ms = 120.0\n[profile]\nsetpoint_um = 2.0\n\
                [[expect]]\nmetric = \"settling_time_ms\"\nat_most = 2.0\n";
    parse_scenario(text, PLATE)
}

fn detect(rows: &[Row]) -> Option<LoopSymptom> {
    detect_symptom(&scenario(), rows, &Telemetry::default())
}

/// Control instants of 1 ms. The last row has the offset of the frequency from the start.
fn controlled_rows(drive_vpp: f64, offset_hz: f64, resonance_offset_hz: f64) -> Vec<Row> {
    let start_hz = scenario().controller.start_frequency_hz;
    let row = |number: u32| Row {
        t_s: f64::from(number) / 1e3,
        setpoint_um: 2.0,
        amplitude_um: 2.0,
        drive_vpp,
        frequency_hz: start_hz + offset_hz,
        resonance_hz: start_hz + resonance_offset_hz,
        flags: Flags::CONTROL,
        ..Row::default()
    };
    (0..=60).map(row).collect()
}

#[rstest]
#[case::no_drive(0.0, 0.0, 0.0, Some(LoopSymptom::NoDrive))]
#[case::least_drive(1e-3, 0.0, 0.0, None)]
#[case::away_from_the_resonance(300.0, -250.0, 87.0, Some(LoopSymptom::FrequencyAtLimit))]
#[case::away_from_a_resonance_at_the_start(300.0, 250.0, 0.0, Some(LoopSymptom::FrequencyAtLimit))]
#[case::inside_the_range(300.0, -249.9, 87.0, None)]
#[case::resonance_outside_the_range(300.0, -250.0, -400.0, None)]
#[case::unknown_resonance(300.0, -250.0, f64::NAN, None)]
fn names_a_wrong_sign(
    #[case] drive_vpp: f64,
    #[case] offset_hz: f64,
    #[case] resonance_offset_hz: f64,
    #[case] expected: Option<LoopSymptom>,
) {
    let rows = controlled_rows(drive_vpp, offset_hz, resonance_offset_hz);
    assert_eq!(detect(&rows), expected);
}

#[test]
fn a_stopped_controller_has_no_wrong_sign() {
    let mut rows = controlled_rows(0.0, 0.0, 0.0);
    for row in &mut rows {
        row.flags |= Flags::SAFE;
    }
    assert_eq!(detect(&rows), None);
    assert_eq!(detect(&[]), None);
}

/// Control instants of 1 ms at the setpoint with a drive of 300 Vpp, changed by `change`.
fn changed_rows(change: impl Fn(usize, &mut Row)) -> Vec<Row> {
    let mut rows = controlled_rows(300.0, 0.0, 0.0);
    rows.iter_mut().enumerate().for_each(|(number, row)| change(number, row));
    rows
}

/// At the limit of 900 Vpp until `until`; the amplitude passes the setpoint at 10.
fn wound_up(until: usize, peak: f64) -> Vec<Row> {
    changed_rows(|number, row| {
        row.drive_vpp = if number < until { 900.0 } else { 300.0 };
        row.amplitude_um = if number < 10 {
            1.9
        } else if number < 20 {
            2.0 * (1.0 + peak)
        } else {
            2.0
        };
    })
}

#[rstest]
#[case::nothing(changed_rows(|_, _| {}), None)]
#[case::wind_up(wound_up(13, 0.2), Some(LoopSymptom::WindUp))]
#[case::leaves_the_limit_in_time(wound_up(12, 0.2), None)]
#[case::passes_the_setpoint_slightly(wound_up(14, 0.049), None)]
#[case::spike(changed_rows(|number, row| if number == 30 { row.drive_vpp = 600.0 }), Some(LoopSymptom::DriveSpike))]
#[case::two_samples(changed_rows(|number, row| if number / 2 == 15 { row.drive_vpp = 600.0 }), None)]
#[case::small_spike(changed_rows(|number, row| if number == 30 { row.drive_vpp = 569.0 }), None)]
#[case::unmoved(changed_rows(|_, row| row.amplitude_um = 1.8), Some(LoopSymptom::UnmovedDrive))]
#[case::near(changed_rows(|_, row| row.amplitude_um = 1.91), None)]
#[case::moves(changed_rows(|number, row| (row.amplitude_um, row.drive_vpp) = (1.8, 300.0 + number as f64)), None)]
#[case::switches(
    changed_rows(|number, row| row.drive_vpp = if number % 4 < 2 { 900.0 } else { 0.0 }),
    Some(LoopSymptom::SwitchingDrive)
)]
fn names_a_likely_cause(#[case] rows: Vec<Row>, #[case] expected: Option<LoopSymptom>) {
    assert_eq!(detect(&rows), expected);
}

#[test]
fn an_unused_fpu_comes_before_a_drive_that_is_not_finite() {
    let telemetry = Telemetry { not_finite: Some(NonFiniteDrive { at_s: 0.012, count: 3 }), ..Telemetry::default() };
    let rows = controlled_rows(0.0, 0.0, 0.0);
    assert_eq!(detect_symptom(&scenario(), &rows, &telemetry), Some(LoopSymptom::NotFinite));
    let without_fpu = Telemetry { unused_fpu: true, ..telemetry };
    assert_eq!(detect_symptom(&scenario(), &rows, &without_fpu), Some(LoopSymptom::UnusedFpu));
}
