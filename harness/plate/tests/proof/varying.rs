//! Compares plates with varying damping and resonance with the reference.

use crate::reference::{
    HOLDING_DRIVE_VPP, ModeOverTime, Random, ReferencePlate, SETPOINT, distance, driven_plant, finger_profile, line,
    paper_plate, state_at, temperature_profile,
};
use platebench_plate::{
    BandMonitor, BandSignal, ConditionProfiles, Drive, Model, Plant, Plate, Profile, RawChirp, RawProfile, RawShape,
    Time,
};
use rstest::rstest;
use std::f64::consts::TAU;

/// Slope of the resonance, rad/s per K.
const SLOPE: f64 = -9.638 * TAU;

fn ramp(t: f64, from_ms: f64, from: f64, to_ms: f64, to: f64) -> f64 {
    from + (to - from) * ((t * 1e3 - from_ms) / (to_ms - from_ms)).clamp(0.0, 1.0)
}

/// A mode that is frozen per substep has its largest error on a strongly damped plate.
#[rstest]
fn a_rising_force_on_a_strongly_damped_plate(
    #[values(0.34, 0.2)] time_constant_ms: f64,
    #[values(3.0, 1.9, 1.5, 1.0, 0.5, 0.1)] ms: f64,
) {
    let plate = Plate { sigma0: 1e3 / time_constant_ms, ..paper_plate() };
    let scene = finger_profile(line(3.0, 0.0, 3.0 + ms, 1.0));
    let mode = |t: f64| (plate.sigma0 * (1.0 + ramp(t, 3.0, 0.0, 3.0 + ms, 1.0) / 1.5), plate.omega0);
    for drive_pattern in [DrivePattern::Hold, DrivePattern::Bang] {
        for (interval, error) in
            [1_000_000, 50_000].iter().zip(errors(&plate, &scene, &mode, drive_pattern, 8, &[1_000_000, 50_000]))
        {
            println!("{time_constant_ms} ms, 1 N in {ms} ms, {drive_pattern:?}, {interval} ns: {error:.1e}");
            assert!(error <= drive_pattern.bound(), "{error:e}");
        }
    }
}

fn oscillating_force(amplitude: f64, hertz: f64) -> Profile {
    Profile::sine(1.0, amplitude, TAU * hertz, 0.0)
}

fn force_at(t: f64, amplitude: f64, hertz: f64) -> f64 {
    1.0 + amplitude * (TAU * hertz * t).sin()
}

#[derive(Debug, Clone, Copy)]
enum DrivePattern {
    Hold,
    /// Each millisecond has a random drive: 0 or 800 Vpp, within ±600 rad/s.
    Bang,
}

impl DrivePattern {
    /// Three times `VARYING_ERROR` of the amplitude at resonance (`docs/mathematics.md`).
    fn bound(self) -> f64 {
        match self {
            Self::Hold => 3e-7,
            Self::Bang => 3e-7 * 800.0 / HOLDING_DRIVE_VPP,
        }
    }
}

/// Largest error of W and U/ω relative to the setpoint, for each length of `intervals` in ns.
fn errors(
    plate: &Plate,
    scene: &ConditionProfiles,
    mode: ModeOverTime<'_>,
    drive_pattern: DrivePattern,
    end: u64,
    intervals: &[u64],
) -> Vec<f64> {
    let mut carrier = ReferencePlate::at_rest(plate.omega0);
    let mut random = Random::new(6);
    let hold = Drive { vpp: HOLDING_DRIVE_VPP, omega: plate.omega0 };
    let mut plants: Vec<Plant> = intervals.iter().map(|_| driven_plant(plate, scene, Model::Modal, hold)).collect();
    let mut worst = vec![0.0_f64; intervals.len()];
    for period in 1..=end {
        let drive = match drive_pattern {
            DrivePattern::Hold => hold,
            DrivePattern::Bang => Drive {
                vpp: if random.in_range(0.0, 1.0) < 0.5 { 0.0 } else { 800.0 },
                omega: plate.omega0 + random.in_range(-600.0, 600.0),
            },
        };
        carrier.advance(1e-3, plate.force_constant(), &drive, mode);
        let end = Time::from_nanos(period * 1_000_000);
        for ((plant, interval), worst) in plants.iter_mut().zip(intervals).zip(&mut worst) {
            plant.set_drive(drive);
            // A plant with intervals above 1 ms is compared only at the ends of its intervals.
            let interval = Time::from_nanos(*interval);
            while plant.time() + interval <= end {
                plant.advance(plant.time() + interval, &[], &mut Vec::new());
            }
            if plant.time() == end {
                *worst = worst.max(distance(&plant.state(), &carrier.state(), plate.omega0));
            }
        }
    }
    worst
}

fn assert_errors(what: &str, drive_pattern: DrivePattern, intervals: &[u64], errors: &[f64]) {
    for (interval, error) in intervals.iter().zip(errors) {
        println!("{what}, {drive_pattern:?}, intervals of {} ms: {error:.1e}", *interval as f64 / 1e6);
        assert!(*error <= drive_pattern.bound() && *error <= 1e-6, "{error:e}");
    }
}

fn check(what: &str, end: u64, plate: &Plate, scene: &ConditionProfiles, mode: ModeOverTime<'_>) {
    const INTERVALS_NS: [u64; 2] = [1_000_000, 50_000];
    for drive_pattern in [DrivePattern::Hold, DrivePattern::Bang] {
        let errors = errors(plate, scene, mode, drive_pattern, end, &INTERVALS_NS);
        assert_errors(what, drive_pattern, &INTERVALS_NS, &errors);
    }
}

/// A ramp of 0.4 ms is the shortest for `varying.rs`; with 0.3 ms the mode is frozen per substep.
#[rstest]
#[case::press(100.0, 140)]
#[case::quick(0.4, 40)]
#[case::quicker(0.3, 40)]
#[case::jump(0.001, 40)]
fn a_rising_force(#[case] ms: f64, #[case] end: u64) {
    let plate = paper_plate();
    let scene = finger_profile(line(20.0, 0.0, 20.0 + ms, 1.0));
    let mode = |t: f64| (plate.sigma0 * (1.0 + ramp(t, 20.0, 0.0, 20.0 + ms, 1.0) / 1.5), plate.omega0);
    check(&format!("1 N in {ms} ms"), end, &plate, &scene, &mode);
}

/// The last case has almost no slope but a large curvature.
#[rstest]
#[case::slow(0.5, 2.0, 500)]
#[case::quick(0.5, 100.0, 60)]
#[case::trembling(0.02, 1_000.0, 30)]
fn an_oscillating_force(#[case] amplitude: f64, #[case] hertz: f64, #[case] end: u64) {
    let plate = paper_plate();
    let scene = finger_profile(oscillating_force(amplitude, hertz));
    let mode = |t: f64| (plate.sigma0 * (1.0 + force_at(t, amplitude, hertz) / 1.5), plate.omega0);
    check(&format!("1 ± {amplitude} N at {hertz} Hz"), end, &plate, &scene, &mode);
}

#[rstest]
#[case::slow(1000.0, 100)]
#[case::quick(50.0, 80)]
fn a_rising_temperature(#[case] end_ms: f64, #[case] end: u64) {
    let plate = paper_plate();
    let scene = temperature_profile(line(0.0, 0.0, end_ms, 9.0));
    let mode = |t: f64| (plate.sigma0, plate.omega0 + SLOPE * ramp(t, 0.0, 0.0, end_ms, 9.0));
    check(&format!("9 K in {end_ms} ms"), end, &plate, &scene, &mode);
}

/// The damping curve has bends that are not in the middle of a substep.
#[rstest]
#[case::ramp([[0.4317, 1.05], [0.8, 2.5]], None, 100)]
#[case::oscillation([[0.9, 1.3], [1.2345, 2.5]], Some(31.0), 80)]
fn a_force_across_bends_of_the_damping_curve(
    #[case] bends: [[f64; 2]; 2],
    #[case] hertz: Option<f64>,
    #[case] end: u64,
) {
    let [first, second] = bends;
    let plate = Plate { damping_ratio: vec![[0.0, 1.0], first, second, [2.0, 3.0]], ..paper_plate() };
    let scene = finger_profile(hertz.map_or(line(0.0, 0.0, 100.0, 1.0), |hertz| oscillating_force(0.5, hertz)));
    let between = |[low, from]: [f64; 2], [high, to]: [f64; 2], f: f64| from + (to - from) * (f - low) / (high - low);
    let mode = |t: f64| {
        let ratio = match hertz.map_or(ramp(t, 0.0, 0.0, 100.0, 1.0), |hertz| force_at(t, 0.5, hertz)) {
            f if f < first[0] => between([0.0, 1.0], first, f),
            f if f < second[0] => between(first, second, f),
            f => between(second, [2.0, 3.0], f),
        };
        (plate.sigma0 * ratio, plate.omega0)
    };
    check(&format!("across {bends:?}"), end, &plate, &scene, &mode);
}

/// The frequency changes by a factor of 20 within the 60 ms.
#[rstest]
#[case::rising(20.0, 400.0)]
#[case::falling(400.0, 20.0)]
fn a_chirp_of_the_force(#[case] from_hz: f64, #[case] to_hz: f64) {
    let plate = paper_plate();
    let chirp = RawChirp { mean: 1.0, amplitude: 0.5, from_hz, to_hz, phase_deg: 0.0 };
    let duration = Time::from_nanos(60_000_000);
    let scene = finger_profile(RawProfile::Shape(RawShape::Chirp(chirp)).check(&[], duration).unwrap());
    let mode = |t: f64| {
        let turns = from_hz * t + (to_hz - from_hz) * t * t / (2.0 * 0.06);
        (plate.sigma0 * (1.0 + (1.0 + 0.5 * (TAU * turns).sin()) / 1.5), plate.omega0)
    };
    check(&format!("{from_hz} to {to_hz} Hz"), 60, &plate, &scene, &mode);
}

#[test]
fn a_force_that_shifts_the_resonance() {
    let plate = Plate { omega0_per_n: -400.0, ..paper_plate() };
    let scene = ConditionProfiles {
        finger_force_n: Profile::sine(1.0, 0.5, TAU * 200.0, 1.0),
        temperature_offset_k: line(0.0, 0.0, 50.0, 9.0),
    };
    let mode = |t: f64| {
        let force = 1.0 + 0.5 * (TAU * 200.0 * t + 1.0).sin();
        let warm = SLOPE * ramp(t, 0.0, 0.0, 50.0, 9.0);
        (plate.sigma0 * (1.0 + force / 1.5), plate.omega0 - 400.0 * force + warm)
    };
    check("a shift of 400 rad/s/N at 200 Hz", 40, &plate, &scene, &mode);
}

#[test]
fn half_the_substep_has_a_sixteenth_of_the_error() {
    let plate = paper_plate();
    let scene = finger_profile(line(0.0, 0.0, 100.0, 1.0));
    let mode = |t: f64| (plate.sigma0 * (1.0 + ramp(t, 0.0, 0.0, 100.0, 1.0) / 1.5), plate.omega0);
    let intervals = [1_000_000, 500_000, 250_000];
    let found = errors(&plate, &scene, &mode, DrivePattern::Bang, 30, &intervals);
    assert_errors("1 N in 0.1 s", DrivePattern::Bang, &intervals, &found);
    for pair in found.windows(2) {
        assert!((14.0..=18.0).contains(&(pair[0] / pair[1])), "{found:?}");
    }
    // The error for a constant drive of 800 Vpp and nominal damping is λ'²h⁴/240 of the amplitude.
    let predicted = (plate.sigma0 * 10.0 / 1.5).powi(2) * 1e-12 / 240.0 * 800.0 / HOLDING_DRIVE_VPP;
    assert!((0.5..1.0).contains(&(found[0] / predicted)), "{found:?} {predicted:e}");
}

/// The fast pole makes 65 and 13 whole turns per substep, so errors of the substeps would add up.
#[test]
fn substeps_do_not_excite_the_fast_pole() {
    let plate = Plate { omega0: 32_500.0 * TAU, ..paper_plate() };
    let scene = finger_profile(line(0.0, 0.0, 100.0, 1.41));
    let mode = |t: f64| (plate.sigma0 * (1.0 + ramp(t, 0.0, 0.0, 100.0, 1.41) / 1.5), plate.omega0);
    let intervals = [1_000_000, 200_000];
    let found = errors(&plate, &scene, &mode, DrivePattern::Hold, 60, &intervals);
    assert_errors("1.41 N in 0.1 s at 32.5 kHz", DrivePattern::Hold, &intervals, &found);
}

/// The interval is a whole period of the force, in which three samples of the slope are zero.
#[rstest]
#[case::slow(2.0, 500)]
#[case::quick(20.0, 100)]
fn a_long_interval_is_as_accurate_as_many(#[case] hertz: f64, #[case] end: u64) {
    let plate = paper_plate();
    let scene = finger_profile(oscillating_force(0.5, hertz));
    let mode = |t: f64| (plate.sigma0 * (1.0 + force_at(t, 0.5, hertz) / 1.5), plate.omega0);
    let intervals = [end * 1_000_000];
    let found = errors(&plate, &scene, &mode, DrivePattern::Hold, end, &intervals);
    assert_errors(&format!("0.5 to 1.5 N at {hertz} Hz"), DrivePattern::Hold, &intervals, &found);
}

#[test]
fn the_state_within_a_substep_is_accurate() {
    let plate = paper_plate();
    let scene = finger_profile(line(20.0, 0.0, 120.0, 1.0));
    let mode = |t: f64| (plate.sigma0 * (1.0 + ramp(t, 20.0, 0.0, 120.0, 1.0) / 1.5), plate.omega0);
    let drive = Drive { vpp: HOLDING_DRIVE_VPP, omega: plate.omega0 };
    let mut plant = driven_plant(&plate, &scene, Model::Modal, drive);
    state_at(&mut plant, 20.0);
    let monitors = [1.99, 1.97, 1.95, 1.9, 1.83, 1.8].map(|low| BandMonitor {
        signal: BandSignal::Amplitude,
        low,
        high: 2.0 * SETPOINT,
    });
    let mut found = Vec::new();
    for period in 21..=60 {
        plant.advance(Time::from_nanos(period * 1_000_000), &monitors, &mut found);
    }
    assert_eq!(found.len(), monitors.len());
    let mut carrier = ReferencePlate::at_rest(plate.omega0);
    carrier.advance(20e-3, plate.force_constant(), &drive, &mode);
    let (mut now, mut worst) = (Time::from_ms(20.0).unwrap(), 0.0_f64);
    for crossing in &found {
        carrier.advance((crossing.time - now).seconds(), plate.force_constant(), &drive, &mode);
        now = crossing.time;
        worst = worst.max(distance(&crossing.state, &carrier.state(), plate.omega0));
    }
    println!("states at {} crossings inside substeps: {worst:.1e}", found.len());
    assert!(worst <= 1e-7, "{worst:e}");
}

/// The mode jumps at 5.25 ms, and the reference stops there.
#[test]
fn a_jump_during_a_ramp_acts_at_its_time() {
    let plate = paper_plate();
    let ms = |ms| Time::from_ms(ms).unwrap();
    let force = Profile::Hold(vec![(ms(0.0), 0.0), (ms(5.25), 1.5)]);
    let scene = ConditionProfiles { finger_force_n: force, temperature_offset_k: line(0.0, 0.0, 50.0, 9.0) };
    let mode = |t: f64| {
        let ratio = if t < 5.25e-3 { 1.0 } else { 2.0 };
        (plate.sigma0 * ratio, plate.omega0 + SLOPE * ramp(t, 0.0, 0.0, 50.0, 9.0))
    };
    let drive = Drive { vpp: HOLDING_DRIVE_VPP, omega: plate.omega0 };
    let mut carrier = ReferencePlate::at_rest(plate.omega0);
    for (from, to) in [(0.0, 5.25e-3), (5.25e-3, 10e-3)] {
        carrier.advance(to - from, plate.force_constant(), &drive, &|t| mode(t.clamp(from, to.next_down())));
    }
    let state = state_at(&mut driven_plant(&plate, &scene, Model::Modal, drive), 10.0);
    let error = distance(&state, &carrier.state(), plate.omega0);
    println!("1.5 N at once while it warms up: {error:.1e}");
    assert!(error <= 3e-7, "{error:e}");
}
