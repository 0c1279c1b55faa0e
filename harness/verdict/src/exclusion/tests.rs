use super::*;
use crate::{judge, measure};
use platebench_model::record::{Cause, Telemetry, Verdict};
use platebench_test_kit::{PLATE, parse_scenario};

fn scenario(duration_ms: f64, profile: &str, expect: &str) -> Scenario {
    let text = format!(
        "title = \"Real\"\nplate = \"plate.toml\"\nduration_ms = {duration_ms:?}\nexpect = [{{ {expect} }}]\n\
         [profile]\n{profile}\n"
    );
    parse_scenario(&text, PLATE)
}

const SETTLES: &str = "metric = \"settling_time_ms\", at_most = 2.0";
const STEP: &str = "setpoint_um = { hold = [[0.0, 0.0], [200.0, 2.0]] }";

fn row(t_ms: f64, setpoint_um: f64, amplitude_um: f64) -> Row {
    Row {
        t_s: t_ms / 1e3,
        setpoint_um,
        wd_um: amplitude_um,
        amplitude_um,
        resonance_hz: f64::NAN,
        temperature_offset_k: f64::NAN,
        finger_force_n: f64::NAN,
        flags: Flags::CONTROL | Flags::SENSED,
        ..Row::default()
    }
}

/// The setpoint steps 10 ms late at 210 ms. The plate reaches it at `settled_ms`.
fn rows(settled_ms: f64, end_ms: u32) -> Vec<Row> {
    let at = |t: f64| row(t, if t < 210.0 { 0.0 } else { 2.0 }, if t < settled_ms { 0.0 } else { 2.0 });
    (0..=end_ms).map(|t| at(f64::from(t))).collect()
}

fn exclusion(scenario: &Scenario, rows: &[Row]) -> Option<Exclusion> {
    find_real_plate_exclusion(scenario, rows, Some(&RealPlateRecord::default()))
}

#[test]
fn decides_a_settling_time_only_if_the_samples_prove_it() {
    let scenario = scenario(400.0, STEP, SETTLES);
    let verdict = |settled_ms| {
        let trial = measure(&scenario, 0, &rows(settled_ms, 400), &Telemetry::default());
        judge(&scenario, &[trial]).expectations.remove(0)
    };
    let proved = verdict(212.0);
    assert_eq!((proved.verdict, proved.interval), (Verdict::Pass, Some([1.0, 2.0])));
    assert!(proved.evidence.observed.is_some_and(|by| by.contains("sensor")));
    // Trials of a real plate may differ even if the scenario is deterministic.
    assert!(proved.evidence.failure_rate.is_some());
    let open = verdict(213.0);
    assert_eq!((open.verdict, open.cause), (Verdict::Inconclusive, Some(Cause::Evidence)));
    assert_eq!(verdict(214.0).verdict, Verdict::Fail);
}

#[test]
fn excuses_a_miss_at_the_drive_limit() {
    let scenario = scenario(400.0, STEP, SETTLES);
    let mut rows = rows(300.0, 400);
    rows[220].flags |= Flags::SATURATED;
    let judged = judge(&scenario, &[measure(&scenario, 0, &rows, &Telemetry::default())]).expectations.remove(0);
    assert_eq!((judged.verdict, judged.cause), (Verdict::Inconclusive, Some(Cause::Evidence)));
}

#[test]
fn excludes_a_trial_with_missing_telemetry() {
    let scenario = scenario(400.0, STEP, SETTLES);
    let whole = rows(212.0, 400);
    assert_eq!(exclusion(&scenario, &whole), None);
    let message = |rows: &[Row]| {
        let exclusion = exclusion(&scenario, rows).unwrap();
        assert_eq!(exclusion.cause(), Cause::Rig);
        exclusion.to_string()
    };
    assert_eq!(message(&whole[2..]), "the telemetry starts at 2 ms");
    assert_eq!(message(&whole[..400]), "the telemetry ends at 399 ms instead of 400 ms");
    let mut gap = whole.clone();
    gap.remove(300);
    assert_eq!(message(&gap), "no telemetry between 299 and 301 ms");
    let mut unacknowledged = whole.clone();
    unacknowledged[250].flags |= Flags::LINK_LOST;
    assert_eq!(message(&unacknowledged), "a setpoint was not acknowledged by 250 ms");
    let mut overrun = whole.clone();
    overrun[250].flags |= Flags::OVERRUN;
    assert_eq!(find_real_plate_exclusion(&scenario, &overrun, None).as_ref().map(Exclusion::cause), Some(Cause::Bench));
    let mut late = whole.clone();
    late[300].t_s += 4e-4;
    assert_eq!(exclusion(&scenario, &late), None);
    let mut stopped = whole[..300].to_vec();
    stopped[299].flags |= Flags::SAFE;
    assert_eq!(exclusion(&scenario, &stopped), None);
    let lost = RealPlateRecord { lost_rows: 1, ..RealPlateRecord::default() };
    assert_eq!(
        find_real_plate_exclusion(&scenario, &whole, Some(&lost)).as_ref().map(Exclusion::cause),
        Some(Cause::Bench)
    );
}

#[test]
fn excludes_a_trial_with_a_wrong_setpoint() {
    let scenario = scenario(400.0, STEP, SETTLES);
    let mut other = rows(212.0, 400);
    other[399].setpoint_um = 1.0;
    let sent_um = [2.0, 2.0];
    let expected = Exclusion::WrongSetpoint { held_um: 1.0, at_ms: 399.0, sent_um };
    assert_eq!(exclusion(&scenario, &other), Some(expected));
    let mut between = rows(212.0, 400);
    between[205].setpoint_um = 1.0;
    assert!(exclusion(&scenario, &between).is_some());
    let held_until = |last: usize| {
        let mut rows = rows(212.0, 400);
        rows[210..=last].iter_mut().for_each(|row| row.setpoint_um = 0.0);
        exclusion(&scenario, &rows)
    };
    assert_eq!(held_until(299), None);
    assert!(held_until(301).is_some());
}

#[test]
fn excludes_a_trial_with_a_wrong_force() {
    let pressed = |force: f64, profile: &str| {
        let scenario = scenario(3_000.0, &format!("setpoint_um = 2.0\n{profile}"), SETTLES);
        let rows: Vec<Row> =
            (0..=3_000_u32).map(|t| Row { finger_force_n: force, ..row(f64::from(t), 2.0, 2.0) }).collect();
        exclusion(&scenario, &rows)
    };
    assert_eq!(pressed(2.0, "finger_force_n = 2.0"), None);
    assert_eq!(pressed(2.69, "finger_force_n = 2.0"), None);
    let expected =
        Exclusion::WrongForce { force_n: 2.71, at_ms: 0.0, expected_n: [2.0, 2.0], wrong_rows: 3_001, rows: 3_001 };
    assert_eq!(pressed(2.71, "finger_force_n = 2.0"), Some(expected));
    assert!(pressed(0.0, "finger_force_n = 2.0").is_some());
    assert!(pressed(2.0, "").is_some(), "a hand rests on the plate");
    assert_eq!(pressed(f64::NAN, "finger_force_n = 2.0"), None);
    // A force that starts at 1.5 s must be present at 2.5 s.
    let late = "finger_force_n = { hold = [[0.0, 0.0], [1500.0, 2.0]] }";
    assert!(pressed(0.0, late).is_some() && pressed(2.0, late).is_some());
}

#[test]
fn excludes_conditions_that_were_not_made() {
    let plain = |profile: &str, duration_ms| scenario(duration_ms, &format!("setpoint_um = 2.0\n{profile}"), SETTLES);
    let rows: Vec<Row> = (0..=3_000_u32).map(|t| row(f64::from(t), 2.0, 2.0)).collect();
    let warm = plain("temperature_offset_k = 9.0", 3_000.0);
    assert!(needs_operator(&warm) && !scene_changes(&warm) && operator_exclusion(&warm).is_none());
    assert_eq!(exclusion(&warm, &rows), None);
    assert!(find_real_plate_exclusion(&warm, &rows, None).is_some(), "a run without a record");
    let undone = RealPlateRecord { undone: Some("no operator".to_owned()), ..RealPlateRecord::default() };
    assert_eq!(
        find_real_plate_exclusion(&warm, &rows, Some(&undone)),
        Some(Exclusion::ConditionsNotMade { why: "no operator".to_owned() })
    );
    let touch = "finger_force_n = { hold = [[0.0, 0.0], [20.0, 2.0]] }";
    assert!(operator_exclusion(&plain(touch, 1_999.0)).is_some());
    assert!(operator_exclusion(&plain(touch, 2_000.0)).is_none());
    assert!(!needs_operator(&plain("", 60.0)));
}
