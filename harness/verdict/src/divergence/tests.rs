use super::*;
use platebench_model::record::NonFiniteDrive;
use platebench_test_kit::{PLATE, parse_scenario};
use rstest::rstest;
use std::f64::consts::TAU;

fn scenario(noise_um: f64, more: &str) -> Scenario {
    let silent = "noise_um_rms = 0.0";
    assert!(PLATE.contains(silent));
    let plate = PLATE.replace(silent, &format!("noise_um_rms = {noise_um:?}"));
    let text = format!(
        "title = \"Synthetic\"\nplate = \"plate.toml\"\nduration_ms = 120.0\n[profile]\nsetpoint_um = 2.0\n\
         [[expect]]\nmetric = \"settling_time_ms\"\nat_most = 2.0\n{more}"
    );
    parse_scenario(&text, &plate)
}

/// Creates a row every 50 µs up to `end_ms`. Deviation and Wq are shares of the setpoint of 2 µm.
fn rows(end_ms: f64, deviation: impl Fn(f64) -> f64, quadrature: impl Fn(f64) -> f64) -> Vec<Row> {
    let count = (end_ms / 0.05).round() as u32;
    let row = |number: u32| {
        let t_ms = f64::from(number) * 0.05;
        Row {
            t_s: t_ms / 1e3,
            setpoint_um: 2.0,
            amplitude_um: 2.0 * (1.0 + deviation(t_ms)),
            wq_um: 2.0 * quadrature(t_ms),
            drive_vpp: 287.0,
            ..Row::default()
        }
    };
    (0..=count).map(row).collect()
}

fn oscillation(size: impl Fn(f64) -> f64) -> impl Fn(f64) -> f64 {
    move |t_ms| size(t_ms) * (TAU * 0.2 * t_ms).sin()
}

fn zero(_: f64) -> f64 {
    0.0
}

fn divergence_of(rows: &[Row]) -> Option<f64> {
    divergence_time_s(&scenario(0.0, ""), rows)
}

#[rstest]
#[case::sustained(0.2, 0.0, true)]
#[case::growing(0.1, 0.01, true)]
#[case::just_beyond_the_band(0.0502, 0.0, true)]
#[case::just_within_the_band(0.0498, 0.0, false)]
#[case::keeps_99_percent_per_third(0.2, 0.99_f64.ln() / 40.0, true)]
#[case::keeps_97_percent_per_third(0.2, 0.97_f64.ln() / 40.0, false)]
#[case::grows_but_stays_within_the_band(0.001, 0.02, false)]
fn detects_a_swing_that_does_not_decay(#[case] size: f64, #[case] rate: f64, #[case] diverged: bool) {
    let rows = rows(120.0, oscillation(|t_ms| size * (rate * t_ms).exp()), zero);
    assert_eq!(divergence_of(&rows).is_some(), diverged);
}

#[rstest]
#[case::offset(|_| -0.3)]
#[case::offset_that_ripples(|t_ms: f64| -0.3 + 0.2 * (TAU * 0.2 * t_ms).sin())]
#[case::slow_approach(|t_ms: f64| -(-t_ms / 200.0).exp())]
#[case::slow_drift_through_the_setpoint(|t_ms: f64| (t_ms - 60.0) / 100.0)]
#[case::one_swing_per_third(|t_ms: f64| 0.3 * (TAU * t_ms / 40.0).sin())]
fn ignores_deviations_without_a_swing(#[case] deviation: fn(f64) -> f64) {
    assert_eq!(divergence_of(&rows(120.0, deviation, zero)), None);
}

/// The amplitude |W| swings on one side of the setpoint only, but Wq changes its sign.
#[test]
fn counts_a_quadrature_swing_with_an_amplitude_swing() {
    let one_sided = |t_ms: f64| 0.2 * (TAU * 0.2 * t_ms).sin().powi(2);
    let quadrature = oscillation(|_| 0.6);
    assert!(divergence_of(&rows(120.0, one_sided, &quadrature)).is_some());
    assert_eq!(divergence_of(&rows(120.0, one_sided, zero)), None);
    // This amplitude swings by 5 % of the setpoint around an offset, which is less than the band.
    let offset = |t_ms: f64| -0.3 + one_sided(t_ms) / 4.0;
    assert_eq!(divergence_of(&rows(120.0, offset, &quadrature)), None);
}

#[test]
fn ignores_swings_that_noise_could_cause() {
    // 25 standard deviations of 8 nm are 10 % of the setpoint of 2 µm.
    let noisy = scenario(0.008, "");
    assert!(divergence_time_s(&noisy, &rows(120.0, oscillation(|_| 0.101), zero)).is_some());
    assert_eq!(divergence_time_s(&noisy, &rows(120.0, oscillation(|_| 0.099), zero)), None);
}

#[test]
fn starts_after_the_last_event() {
    let swinging = |end_ms| rows(end_ms, oscillation(|_| 0.2), zero);
    assert!(divergence_of(&swinging(30.0)).is_some());
    assert_eq!(divergence_of(&swinging(29.9)), None);
    let stepped = |at_ms: f64, change: fn(&mut Row)| {
        let mut rows = swinging(120.0);
        rows.iter_mut().filter(|row| row.t_s * 1e3 < at_ms - 1e-9).for_each(change);
        rows
    };
    let changes: [fn(&mut Row); 3] =
        [|row| row.finger_force_n = 1.0, |row| row.temperature_offset_k = 1.0, |row| row.setpoint_um = 1.9];
    for change in changes {
        assert!(divergence_of(&stepped(90.0, change)).is_some());
        assert_eq!(divergence_of(&stepped(90.1, change)), None);
    }
    for flag in [Flags::SAFE, Flags::LINK_LOST, Flags::OVERRUN] {
        let mut rows = swinging(120.0);
        rows[1800].flags = flag;
        assert_eq!(divergence_of(&rows), None, "{flag:?} at 90 ms");
        rows[1800].flags = Flags::CONTROL;
        rows[1200].flags = flag;
        assert!(divergence_of(&rows).is_some(), "{flag:?} at 60 ms");
    }
    let mut at_rest = swinging(120.0);
    for row in &mut at_rest {
        row.setpoint_um = 0.0;
    }
    assert_eq!(divergence_of(&at_rest), None);
}

#[test]
fn a_planned_fault_is_an_event_until_its_end() {
    let fault = |until: &str| {
        scenario(0.0, &format!("[[fault]]\nkind = \"delay\"\ndelay_ms = 0.5\nfrom_ms = 10.0\nuntil_ms = {until}\n"))
    };
    let swinging = rows(120.0, oscillation(|_| 0.2), zero);
    assert!(divergence_time_s(&fault("80.0"), &swinging).is_some());
    assert_eq!(divergence_time_s(&fault("100.0"), &swinging), None);
}

#[test]
fn allows_uneven_swings_between_the_drive_limits() {
    let uneven = |keeps: f64, low: f64| {
        let mut rows = rows(120.0, oscillation(|t_ms| if t_ms < 80.0 { 0.5 } else { 0.5 * keeps }), zero);
        for row in &mut rows {
            row.drive_vpp = if row.amplitude_um < 2.0 { 900.0 } else { low };
        }
        rows
    };
    assert!(divergence_of(&uneven(0.92, 0.0)).is_some());
    assert_eq!(divergence_of(&uneven(0.88, 0.0)), None);
    assert_eq!(divergence_of(&uneven(0.92, 1.0)), None);
}

#[rstest]
// The signal is never inside the band for ten periods, so the time is the first exit.
#[case(oscillation(|_| 0.2), 0.25)]
// The signal starts inside the band and leaves it at ln(50)/0.06 = 65.2 ms.
#[case(oscillation(|t_ms| (0.001 * (0.06 * t_ms).exp()).min(0.4)), 66.0)]
fn the_time_is_the_last_exit_from_the_band(#[case] deviation: impl Fn(f64) -> f64, #[case] expected_ms: f64) {
    let at_ms = divergence_of(&rows(120.0, deviation, zero)).unwrap() * 1e3;
    assert!((at_ms - expected_ms).abs() < 0.5, "{at_ms}");
}

#[test]
fn names_a_non_finite_command_before_a_swing() {
    let scenario = scenario(0.0, "");
    let swinging = rows(120.0, oscillation(|_| 0.2), zero);
    let telemetry = Telemetry { not_finite: Some(NonFiniteDrive { at_s: 0.012, count: 3 }), ..Telemetry::default() };
    let named = detect_divergence(&scenario, &swinging, &telemetry).unwrap();
    assert_eq!(named.to_string(), "diverged at t = 12.0 ms: the drive command was NaN or infinite");
    let plain = detect_divergence(&scenario, &swinging, &Telemetry::default()).unwrap();
    assert_eq!(plain.to_string(), "diverged at t = 0.2 ms");
}
