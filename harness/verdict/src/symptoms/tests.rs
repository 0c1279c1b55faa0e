use super::*;
use platebench_model::record::NonFiniteDrive;
use platebench_test_kit::{PLATE, parse_scenario};
use rstest::rstest;
use std::cmp::Ordering;

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
        wd_um: 2.0,
        sensed_wd_um: 2.0,
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
fn changed_rows(mut change: impl FnMut(usize, &mut Row)) -> Vec<Row> {
    let mut rows = controlled_rows(300.0, 0.0, 0.0);
    rows.iter_mut().enumerate().for_each(|(number, row)| change(number, row));
    rows
}

/// At the limit from the start on; from `passed` on, Wd is above the setpoint by `peak`.
fn driven_above(passed: usize, peak: f64) -> Vec<Row> {
    changed_rows(|number, row| {
        row.drive_vpp = 900.0;
        row.wd_um = if number < passed { 1.9 } else { 2.0 * (1.0 + peak) };
    })
}

/// A PI law with multiples of the designed Kp and Ki, and an oscillating error that decays.
fn pi_law(kp: f64, ki: f64) -> Vec<Row> {
    pi_law_with_offset(kp, ki, 0.0)
}

fn pi_law_with_offset(kp: f64, ki: f64, offset_um: f64) -> Vec<Row> {
    let Scenario { plate, controller, .. } = scenario();
    let period_s = controller.period.seconds();
    let decay = 1.0 - (-period_s * plate.sigma0).exp();
    let design = (1.0 - (-3.0 * period_s / 1.9e-3).exp()) / (plate.gain * decay);
    let mut integral_vpp = 100.0;
    changed_rows(|number, row| {
        let error_um = 0.1 * 0.7_f64.powf(number as f64) * (number as f64).cos();
        row.sensed_wd_um = 2.0 - error_um - offset_um;
        row.drive_vpp = kp * design * error_um + integral_vpp;
        integral_vpp += ki * design * decay * error_um;
    })
}

/// A loop with one pole, as if both gains were `ratio` times those of the design, and a drive that
/// changes `factor` times as much.
fn one_pole(ratio: f64, factor: f64) -> Vec<Row> {
    let Scenario { plate, controller, .. } = scenario();
    let period_s = controller.period.seconds();
    let decay = 1.0 - (-period_s * plate.sigma0).exp();
    let step = 1.0 - (-3.0 * period_s / 1.9e-3).exp();
    let (mut error_um, mut integral_vpp) = (0.1, 300.0);
    changed_rows(|_, row| {
        let kp = ratio * factor * step / (plate.gain * decay);
        row.sensed_wd_um = 2.0 - error_um;
        row.drive_vpp = kp * error_um + integral_vpp;
        integral_vpp += kp * decay * error_um;
        error_um *= 1.0 - ratio * step;
    })
}

/// `count` periods at a limit of the drive, then an error of `overshoot` beyond the setpoint.
fn overshoot_after(count: usize, limit_vpp: f64, overshoot: f64) -> Vec<Row> {
    changed_rows(|number, row| {
        row.drive_vpp = if number < count { limit_vpp } else { 300.0 };
        let beyond = if limit_vpp > 0.0 { overshoot } else { -overshoot };
        let error = match number.cmp(&count) {
            Ordering::Less => -0.3 * beyond.signum(),
            Ordering::Equal => beyond,
            Ordering::Greater => 0.0,
        };
        row.wd_um = 2.0 * (1.0 + error);
    })
}

#[rstest]
#[case::nothing(changed_rows(|_, _| {}), None)]
#[case::ends_driven(driven_above(5, 0.051), Some(LoopSymptom::LimitAboveSetpoint))]
#[case::ends_driven_after_a_long_error(driven_above(51, 0.051), Some(LoopSymptom::WindUp))]
#[case::ends_driven_slightly_above(driven_above(0, 0.049), None)]
#[case::far_frequency(changed_rows(|_, row| row.frequency_hz += 2501.0), Some(LoopSymptom::FarFrequency))]
#[case::frequency_ten_ranges_away(
    changed_rows(|_, row| row.frequency_hz += 2499.0),
    Some(LoopSymptom::FrequencyAtLimit)
)]
#[case::overshoot_after_the_upper_limit(overshoot_after(3, 900.0, 0.051), Some(LoopSymptom::WindUp))]
#[case::overshoot_after_0_v(overshoot_after(3, 0.0, 0.051), Some(LoopSymptom::WindUp))]
#[case::small_overshoot_after_the_limit(overshoot_after(3, 900.0, 0.049), None)]
#[case::overshoot_after_a_short_limit(overshoot_after(2, 900.0, 0.051), None)]
#[case::one_pole(one_pole(1.0, 1.0), None)]
#[case::one_pole_with_another_drive(one_pole(1.6, 1.2), None)]
#[case::offset_of_the_sample(pi_law_with_offset(1.0, 1.0, 0.04), None)]
#[case::designed_gains(pi_law(1.0, 1.0), None)]
#[case::near_gains(pi_law(1.49, 0.67), None)]
#[case::a_setpoint_that_moves(
    pi_law(2.0, 2.0).into_iter().enumerate().map(|(number, row)| Row {
        setpoint_um: 2.0 + number as f64,
        ..row
    }).collect(),
    None
)]
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

#[rstest]
#[case::large_kp(1.51, 1.0)]
#[case::small_kp(0.66, 1.0)]
#[case::large_ki(1.0, 1.51)]
#[case::small_ki(1.0, 0.66)]
#[case::no_ki(1.0, 0.0)]
fn finds_the_gains_of_a_pi_law(#[case] expected_kp: f64, #[case] expected_ki: f64) {
    let Some(LoopSymptom::FarGains { kp, ki }) = detect(&pi_law(expected_kp, expected_ki)) else {
        panic!("no gains found")
    };
    assert!((kp - expected_kp).abs() < 1e-6 && (ki - expected_ki).abs() < 1e-6, "{kp} {ki}");
}

#[rstest]
#[case::both(2.0, 1.85, true)]
#[case::kp_only(2.0, 1.05, true)]
#[case::ki_only(0.95, 0.5, true)]
#[case::another_design(1.42, 1.77, false)]
fn one_wrong_figure_of_an_own_law_changes_one_gain_or_both(#[case] kp: f64, #[case] ki: f64, #[case] is_found: bool) {
    let mut own = scenario();
    own.set_law("own");
    let found = detect_symptom(&own, &pi_law(kp, ki), &Telemetry::default());
    assert_eq!(matches!(found, Some(LoopSymptom::FarGains { .. })), is_found, "{found:?}");
}

#[test]
fn finds_the_gains_of_a_loop_with_one_pole() {
    let Some(LoopSymptom::FarGains { kp, ki }) = detect(&one_pole(1.6, 1.05)) else { panic!("no gains found") };
    assert!((kp - 1.68).abs() < 1e-6 && (ki - 1.68).abs() < 1e-6, "{kp} {ki}");
}

#[test]
fn the_answer_to_a_sample_acts_after_the_loop_delay() {
    let late: Vec<Row> = pi_law(2.0, 0.5)
        .windows(2)
        .flat_map(|rows| {
            let [before, row] = rows else { return Vec::new() };
            let answer = Row { t_s: row.t_s + 3e-4, flags: Flags::empty(), ..*row };
            vec![Row { drive_vpp: before.drive_vpp, ..*row }, answer]
        })
        .collect();
    let Some(LoopSymptom::FarGains { kp, ki }) = detect(&late) else { panic!("no gains found") };
    assert!((kp - 2.0).abs() < 1e-6 && (ki - 0.5).abs() < 1e-6, "{kp} {ki}");
}

#[test]
fn an_unused_fpu_comes_before_a_drive_that_is_not_finite() {
    let telemetry = Telemetry { not_finite: Some(NonFiniteDrive { at_s: 0.012, count: 3 }), ..Telemetry::default() };
    let rows = controlled_rows(0.0, 0.0, 0.0);
    assert_eq!(detect_symptom(&scenario(), &rows, &telemetry), Some(LoopSymptom::NotFinite));
    let without_fpu = Telemetry { unused_fpu: true, ..telemetry };
    assert_eq!(detect_symptom(&scenario(), &rows, &without_fpu), Some(LoopSymptom::UnusedFpu));
}
