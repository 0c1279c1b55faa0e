use super::*;
use crate::record::{Telemetry, Verdict};
use crate::{judge, measure};
use tempfile::TempDir;

fn scenario(duration_ms: f64, profile: &str, expect: &str) -> Scenario {
    let folder = TempDir::new().unwrap();
    let plate = include_str!("../../../../scenarios/plates/aluminium-198x138.toml");
    std::fs::write(folder.path().join("plate.toml"), plate).unwrap();
    let text = format!(
        "title = \"Real\"\nplate = \"plate.toml\"\nduration_ms = {duration_ms:?}\nexpect = [{{ {expect} }}]\n[profile]\n{profile}\n"
    );
    let path = folder.path().join("s.toml");
    std::fs::write(&path, text).unwrap();
    platebench_scenario::load(&path, "s.toml").unwrap_or_else(|fault| panic!("{}", fault.render(false)))
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

/// A step at 210 ms, ten after it was due, that settles by the sample at `settled_ms`.
fn rows(settled_ms: f64, end_ms: u32) -> Vec<Row> {
    let at = |t: f64| row(t, if t < 210.0 { 0.0 } else { 2.0 }, if t < settled_ms { 0.0 } else { 2.0 });
    (0..=end_ms).map(|t| at(f64::from(t))).collect()
}

fn cause(scenario: &Scenario, rows: &[Row]) -> Option<(Cause, String)> {
    disturbance(scenario, rows, Some(&RealPlate::default()))
}

#[test]
fn two_milliseconds_are_passed_where_the_samples_prove_them_and_left_open_where_they_do_not() {
    let scenario = scenario(400.0, STEP, SETTLES);
    let verdict = |settled_ms| {
        let trial = measure(&scenario, 0, &rows(settled_ms, 400), &Telemetry::default());
        judge(&scenario, &[trial]).expectations.remove(0)
    };
    let proved = verdict(212.0);
    assert_eq!((proved.verdict, proved.interval), (Verdict::Pass, Some([1.0, 2.0])));
    assert!(proved.evidence.observed.is_some_and(|by| by.contains("sensor")));
    // One trial of a real plate is no certainty, though the scenario draws nothing.
    assert!(proved.evidence.failure_rate.is_some());
    let open = verdict(213.0);
    assert_eq!((open.verdict, open.cause), (Verdict::Inconclusive, Some(Cause::Evidence)));
    assert_eq!(verdict(214.0).verdict, Verdict::Fail);
}

#[test]
fn a_missed_demand_at_the_drive_s_limit_is_left_open() {
    let scenario = scenario(400.0, STEP, SETTLES);
    let mut rows = rows(300.0, 400);
    rows[220].flags |= Flags::SATURATED;
    let judged = judge(&scenario, &[measure(&scenario, 0, &rows, &Telemetry::default())]).expectations.remove(0);
    assert_eq!((judged.verdict, judged.cause), (Verdict::Inconclusive, Some(Cause::Evidence)));
}

#[test]
fn what_was_not_heard_leaves_a_trial_undecided() {
    let scenario = scenario(400.0, STEP, SETTLES);
    let whole = rows(212.0, 400);
    assert_eq!(cause(&scenario, &whole), None);
    let told = |rows: &[Row]| {
        let (cause, what) = cause(&scenario, rows).unwrap();
        assert_eq!(cause, Cause::Rig);
        what
    };
    assert_eq!(told(&whole[2..]), "the telemetry starts at 2 ms");
    assert_eq!(told(&whole[..400]), "the telemetry ends at 399 ms instead of 400 ms");
    let mut gap = whole.clone();
    gap.remove(300);
    assert_eq!(told(&gap), "no telemetry between 299 and 301 ms");
    let mut deaf = whole.clone();
    deaf[250].flags |= Flags::LINK_LOST;
    assert_eq!(told(&deaf), "a setpoint was not acknowledged by 250 ms");
    let mut tardy = whole.clone();
    tardy[250].flags |= Flags::OVERRUN;
    assert_eq!(super::disturbance(&scenario, &tardy, None).map(|(cause, _)| cause), Some(Cause::Bench));
    // Jitter of a timer is no gap.
    let mut late = whole.clone();
    late[300].t_s += 4e-4;
    assert_eq!(cause(&scenario, &late), None);
    // One that stopped by itself has ended its own trial; that is judged.
    let mut stopped = whole[..300].to_vec();
    stopped[299].flags |= Flags::SAFE;
    assert_eq!(cause(&scenario, &stopped), None);
    let lost = RealPlate { lost_rows: 1, ..RealPlate::default() };
    assert_eq!(disturbance(&scenario, &whole, Some(&lost)).map(|(cause, _)| cause), Some(Cause::Bench));
}

#[test]
fn a_controller_that_holds_another_setpoint_does_not_count() {
    let scenario = scenario(400.0, STEP, SETTLES);
    let mut other = rows(212.0, 400);
    other[399].setpoint_um = 1.0;
    let (_, what) = cause(&scenario, &other).unwrap();
    assert_eq!(what, "the controller held a setpoint of 1 µm at 399 ms, it was sent 2");
    // Nothing between two levels, not even while either may still hold.
    let mut between = rows(212.0, 400);
    between[205].setpoint_um = 1.0;
    assert!(cause(&scenario, &between).is_some());
    // The last instant at which the old one may still hold, and the first at which it may not.
    let held_until = |last: usize| {
        let mut rows = rows(212.0, 400);
        rows[210..=last].iter_mut().for_each(|row| row.setpoint_um = 0.0);
        cause(&scenario, &rows)
    };
    assert_eq!(held_until(299), None);
    assert!(held_until(301).is_some());
}

#[test]
fn a_finger_that_is_measured_has_to_be_the_scenario_s() {
    let pressed = |force: f64, profile: &str| {
        let scenario = scenario(3_000.0, &format!("setpoint_um = 2.0\n{profile}"), SETTLES);
        let rows: Vec<Row> =
            (0..=3_000_u32).map(|t| Row { finger_force_n: force, ..row(f64::from(t), 2.0, 2.0) }).collect();
        cause(&scenario, &rows)
    };
    assert_eq!(pressed(2.0, "finger_force_n = 2.0"), None);
    assert_eq!(pressed(2.69, "finger_force_n = 2.0"), None);
    let (cause, what) = pressed(2.71, "finger_force_n = 2.0").unwrap();
    assert_eq!(cause, Cause::Rig);
    assert!(what.starts_with("the finger pressed with 2.71 N at 0 ms, the scenario asks for 2 to 2;"), "{what}");
    assert!(pressed(0.0, "finger_force_n = 2.0").is_some());
    assert!(pressed(2.0, "").is_some(), "a hand that rests on the plate unasked");
    // Where it is not measured the person's word has to do.
    assert_eq!(pressed(f64::NAN, "finger_force_n = 2.0"), None);
    // One that is to come after 1.5 s has to be there a second later.
    let late = "finger_force_n = { hold = [[0.0, 0.0], [1500.0, 2.0]] }";
    assert!(pressed(0.0, late).is_some() && pressed(2.0, late).is_some());
}

#[test]
fn what_no_person_did_or_can_do_is_never_decided() {
    let plain = |profile: &str, duration_ms| scenario(duration_ms, &format!("setpoint_um = 2.0\n{profile}"), SETTLES);
    let rows: Vec<Row> = (0..=3_000_u32).map(|t| row(f64::from(t), 2.0, 2.0)).collect();
    let warm = plain("temperature_offset_k = 9.0", 3_000.0);
    assert!(needs_person(&warm) && !moves(&warm) && impossible(&warm).is_none());
    assert_eq!(cause(&warm, &rows), None);
    assert!(disturbance(&warm, &rows, None).is_some(), "a run whose record was never written");
    let undone = RealPlate { undone: Some("nobody was there".to_owned()), ..RealPlate::default() };
    assert_eq!(disturbance(&warm, &rows, Some(&undone)), Some((Cause::Rig, "nobody was there".to_owned())));
    let touch = "finger_force_n = { hold = [[0.0, 0.0], [20.0, 2.0]] }";
    assert!(impossible(&plain(touch, 1_999.0)).is_some());
    assert!(impossible(&plain(touch, 2_000.0)).is_none());
    assert!(!needs_person(&plain("", 60.0)));
}
