//! Parameters that vary while the plate swings: what moves them on per substep against a reference
//! that takes thousands of steps.

use crate::reference::{
    HOLDING_DRIVE_VPP, ModeOverTime, Random, ReferencePlate, SETPOINT, conditions, distance, driven_plant, paper_plate,
};
use platebench_plate::BandSignal;
use platebench_plate::{
    BandMonitor, ConditionProfiles, Conditions, Drive, Flow, Lockin, Plant, Plate, Profile, Tier, Time,
};
use rstest::rstest;
use std::f64::consts::TAU;

fn ms(value: f64) -> Time {
    Time::from_ms(value).unwrap()
}

fn line(from_ms: f64, from: f64, to_ms: f64, to: f64) -> Profile {
    Profile::Linear(vec![(ms(from_ms), from), (ms(to_ms), to)])
}

/// The same line, said once more.
fn ramp(t: f64, from_ms: f64, from: f64, to_ms: f64, to: f64) -> f64 {
    from + (to - from) * ((t * 1e3 - from_ms) / (to_ms - from_ms)).clamp(0.0, 1.0)
}

fn with_finger_force(finger_force_n: Profile) -> ConditionProfiles {
    ConditionProfiles { finger_force_n, ..conditions(0.0, 0.0) }
}

fn with_temperature(temperature_offset_k: Profile) -> ConditionProfiles {
    ConditionProfiles { temperature_offset_k, ..conditions(0.0, 0.0) }
}

/// What drives the plate during a test.
#[derive(Debug, Clone, Copy)]
enum DrivePattern {
    /// What holds the setpoint untouched, at the resonance untouched.
    Hold,
    /// 0 or 800 Vpp and ±600 rad/s, another every millisecond.
    Bang,
}

impl DrivePattern {
    /// Three times `VARYING_ERROR` of what the drive would reach at resonance, relative to the
    /// setpoint: the bound of `docs/mathematics.md`.
    fn bound(self) -> f64 {
        match self {
            Self::Hold => 3e-7,
            Self::Bang => 3e-7 * 800.0 / HOLDING_DRIVE_VPP,
        }
    }
}

/// Largest error of W and U/ω relative to the setpoint, once per millisecond up to `end` ms, for
/// plants that are given intervals of each of `intervals` ns.
fn errors(
    plate: &Plate,
    scene: &ConditionProfiles,
    mode: ModeOverTime<'_>,
    driving: DrivePattern,
    end: u64,
    intervals: &[u64],
) -> Vec<f64> {
    let mut carrier = ReferencePlate::at_rest(plate.omega0);
    let mut random = Random::new(6);
    let hold = Drive { vpp: HOLDING_DRIVE_VPP, omega: plate.omega0 };
    let mut plants: Vec<Plant> = intervals.iter().map(|_| driven_plant(plate, scene, Tier::Modal, hold)).collect();
    let mut worst = vec![0.0_f64; intervals.len()];
    for period in 1..=end {
        let drive = match driving {
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
            // Whole intervals, each when it is due; one longer than a millisecond is compared where
            // it ends.
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

fn print_errors(what: &str, driving: DrivePattern, intervals: &[u64], errors: &[f64]) {
    for (interval, error) in intervals.iter().zip(errors) {
        println!("{what}, {driving:?}, intervals of {} ms: {error:.1e}", *interval as f64 / 1e6);
    }
    for error in errors {
        assert!(*error <= driving.bound() && *error <= 1e-6, "{error:e}");
    }
}

const INTERVALS_NS: [u64; 2] = [1_000_000, 50_000];

#[rstest]
fn a_finger_that_presses(#[values(DrivePattern::Hold, DrivePattern::Bang)] driving: DrivePattern) {
    let plate = paper_plate();
    let scene = with_finger_force(line(20.0, 0.0, 120.0, 1.0));
    let sigma0 = plate.sigma0;
    let mode = |t: f64| (sigma0 * (1.0 + ramp(t, 20.0, 0.0, 120.0, 1.0) / 1.5), plate.omega0);
    print_errors("1 N in 0.1 s", driving, &INTERVALS_NS, &errors(&plate, &scene, &mode, driving, 140, &INTERVALS_NS));
}

/// A substep twice as short is sixteen times as good, of both poles: nothing of lower order is
/// left.
#[test]
fn halving_the_substep_leaves_a_sixteenth() {
    let plate = paper_plate();
    let scene = with_finger_force(line(0.0, 0.0, 100.0, 1.0));
    let mode = |t: f64| (plate.sigma0 * (1.0 + ramp(t, 0.0, 0.0, 100.0, 1.0) / 1.5), plate.omega0);
    let intervals = [1_000_000, 500_000, 250_000];
    let found = errors(&plate, &scene, &mode, DrivePattern::Bang, 30, &intervals);
    print_errors("1 N in 0.1 s", DrivePattern::Bang, &intervals, &found);
    for pair in found.windows(2) {
        assert!((14.0..=18.0).contains(&(pair[0] / pair[1])), "{found:?}");
    }
    // λ'²h⁴/240 of what 800 Vpp would reach; it would take 800 Vpp all the time and no damping from
    // the finger.
    let predicted = (plate.sigma0 * 10.0 / 1.5).powi(2) * 1e-12 / 240.0 * 800.0 / HOLDING_DRIVE_VPP;
    assert!((0.5..1.0).contains(&(found[0] / predicted)), "{found:?} {predicted:e}");
}

/// The last that the poles are taken apart for, the first that is frozen, and one that is as good
/// as a jump.
#[rstest]
#[case::quick(0.4)]
#[case::quicker(0.3)]
#[case::jump(0.001)]
fn a_finger_that_strikes(#[case] ms: f64, #[values(DrivePattern::Hold, DrivePattern::Bang)] driving: DrivePattern) {
    let plate = paper_plate();
    let scene = with_finger_force(line(20.0, 0.0, 20.0 + ms, 1.0));
    let mode = |t: f64| (plate.sigma0 * (1.0 + ramp(t, 20.0, 0.0, 20.0 + ms, 1.0) / 1.5), plate.omega0);
    print_errors(
        &format!("1 N in {ms} ms"),
        driving,
        &INTERVALS_NS,
        &errors(&plate, &scene, &mode, driving, 40, &INTERVALS_NS),
    );
}

#[rstest]
#[case::slow(2.0, 500)]
#[case::quick(100.0, 60)]
fn a_finger_that_breathes(
    #[case] hertz: f64,
    #[case] end: u64,
    #[values(DrivePattern::Hold, DrivePattern::Bang)] driving: DrivePattern,
) {
    let plate = paper_plate();
    let scene = with_finger_force(Profile::Sine { mean: 1.0, amplitude: 0.5, omega: TAU * hertz, phase: 0.0 });
    let mode = |t: f64| (plate.sigma0 * (1.0 + (1.0 + 0.5 * (TAU * hertz * t).sin()) / 1.5), plate.omega0);
    print_errors(
        &format!("0.5 to 1.5 N at {hertz} Hz"),
        driving,
        &INTERVALS_NS,
        &errors(&plate, &scene, &mode, driving, end, &INTERVALS_NS),
    );
}

/// Hardly any slope, and nothing but bends.
#[rstest]
fn a_finger_that_trembles(#[values(DrivePattern::Hold, DrivePattern::Bang)] driving: DrivePattern) {
    let plate = paper_plate();
    let scene = with_finger_force(Profile::Sine { mean: 1.0, amplitude: 0.02, omega: TAU * 1_000.0, phase: 0.0 });
    let mode = |t: f64| (plate.sigma0 * (1.0 + (1.0 + 0.02 * (TAU * 1_000.0 * t).sin()) / 1.5), plate.omega0);
    print_errors(
        "0.98 to 1.02 N at 1 kHz",
        driving,
        &INTERVALS_NS,
        &errors(&plate, &scene, &mode, driving, 30, &INTERVALS_NS),
    );
}

#[rstest]
#[case::slow(1000.0, 100)]
#[case::quick(50.0, 80)]
fn a_plate_that_warms_up(
    #[case] end_ms: f64,
    #[case] end: u64,
    #[values(DrivePattern::Hold, DrivePattern::Bang)] driving: DrivePattern,
) {
    let plate = paper_plate();
    let scene = with_temperature(line(0.0, 0.0, end_ms, 9.0));
    let slope = -9.638 * TAU;
    let mode = |t: f64| (plate.sigma0, plate.omega0 + slope * ramp(t, 0.0, 0.0, end_ms, 9.0));
    print_errors(
        &format!("9 K in {end_ms} ms"),
        driving,
        &INTERVALS_NS,
        &errors(&plate, &scene, &mode, driving, end, &INTERVALS_NS),
    );
}

#[rstest]
fn a_finger_that_crosses_the_damping_curve_s_knee(
    #[values(DrivePattern::Hold, DrivePattern::Bang)] driving: DrivePattern,
) {
    // Flat, then steep from 0.4317 N on, which is nowhere near the middle of a substep.
    let plate = Plate { damping_ratio: vec![[0.0, 1.0], [0.4317, 1.05], [0.8, 2.5], [2.0, 3.0]], ..paper_plate() };
    let scene = with_finger_force(line(0.0, 0.0, 100.0, 1.0));
    let mode = |t: f64| {
        let force = ramp(t, 0.0, 0.0, 100.0, 1.0);
        let ratio = match force {
            f if f < 0.4317 => 1.0 + 0.05 * f / 0.4317,
            f if f < 0.8 => 1.05 + 1.45 * (f - 0.4317) / (0.8 - 0.4317),
            f => 2.5 + 0.5 * (f - 0.8) / 1.2,
        };
        (plate.sigma0 * ratio, plate.omega0)
    };
    print_errors(
        "across the knee",
        driving,
        &INTERVALS_NS,
        &errors(&plate, &scene, &mode, driving, 100, &INTERVALS_NS),
    );
}

/// Bends wherever they fall, on the way up and on the way down.
#[rstest]
fn a_finger_that_breathes_across_the_knee(#[values(DrivePattern::Hold, DrivePattern::Bang)] driving: DrivePattern) {
    let plate = Plate { damping_ratio: vec![[0.0, 1.0], [0.9, 1.3], [1.2345, 2.5], [2.0, 3.0]], ..paper_plate() };
    let scene = with_finger_force(Profile::Sine { mean: 1.0, amplitude: 0.5, omega: TAU * 31.0, phase: 0.0 });
    let mode = |t: f64| {
        let ratio = match 1.0 + 0.5 * (TAU * 31.0 * t).sin() {
            f if f < 0.9 => 1.0 + 0.3 * f / 0.9,
            f if f < 1.2345 => 1.3 + 1.2 * (f - 0.9) / 0.3345,
            f => 2.5 + 0.5 * (f - 1.2345) / 0.7655,
        };
        (plate.sigma0 * ratio, plate.omega0)
    };
    print_errors(
        "0.5 to 1.5 N at 31 Hz, bends",
        driving,
        &INTERVALS_NS,
        &errors(&plate, &scene, &mode, driving, 80, &INTERVALS_NS),
    );
}

/// A finger that shifts the resonance, on a plate that warms up: both move, and ω0 on a curve.
#[rstest]
fn a_finger_that_detunes(#[values(DrivePattern::Hold, DrivePattern::Bang)] driving: DrivePattern) {
    let plate = Plate { omega0_per_n: -400.0, ..paper_plate() };
    let scene = ConditionProfiles {
        finger_force_n: Profile::Sine { mean: 1.0, amplitude: 0.5, omega: TAU * 200.0, phase: 1.0 },
        temperature_offset_k: line(0.0, 0.0, 50.0, 9.0),
    };
    let mode = |t: f64| {
        let force = 1.0 + 0.5 * (TAU * 200.0 * t + 1.0).sin();
        let warm = -9.638 * TAU * ramp(t, 0.0, 0.0, 50.0, 9.0);
        (plate.sigma0 * (1.0 + force / 1.5), plate.omega0 - 400.0 * force + warm)
    };
    print_errors(
        "a shift of 400 rad/s/N at 200 Hz",
        driving,
        &INTERVALS_NS,
        &errors(&plate, &scene, &mode, driving, 40, &INTERVALS_NS),
    );
}

/// A held force jumps where a substep of a moving temperature ends.
#[test]
fn a_jump_on_the_way_is_not_seen_before_its_time() {
    let plate = paper_plate();
    let force = Profile::Hold(vec![(ms(0.0), 0.0), (ms(5.25), 1.5)]);
    let scene = ConditionProfiles { finger_force_n: force, temperature_offset_k: line(0.0, 0.0, 50.0, 9.0) };
    let slope = -9.638 * TAU;
    let mode = |t: f64| {
        let ratio = if t < 5.25e-3 { 1.0 } else { 2.0 };
        (plate.sigma0 * ratio, plate.omega0 + slope * ramp(t, 0.0, 0.0, 50.0, 9.0))
    };
    // The reference is stopped at the jump.
    let drive = Drive { vpp: HOLDING_DRIVE_VPP, omega: plate.omega0 };
    let mut carrier = ReferencePlate::at_rest(plate.omega0);
    for (from, to) in [(0.0, 5.25e-3), (5.25e-3, 10e-3)] {
        carrier.advance(to - from, plate.force_constant(), &drive, &|t| mode(t.clamp(from, to.next_down())));
    }
    let mut plant = driven_plant(&plate, &scene, Tier::Modal, drive);
    plant.advance(ms(10.0), &[], &mut Vec::new());
    let error = distance(&plant.state(), &carrier.state(), plate.omega0);
    println!("1.5 N at once while it warms up: {error:.1e}");
    assert!(error <= 3e-7, "{error:e}");
}

/// Held surroundings count from that instant on, whatever was known of the profiles before.
#[rstest]
fn a_hand_on_the_plate_ends_what_its_profiles_say(#[values(0.0, 50.0)] newtons_per_second: f64) {
    let plate = paper_plate();
    let scene = with_finger_force(line(0.0, 0.1, 100.0, 0.1 + newtons_per_second / 10.0));
    let mut plant = driven_plant(&plate, &scene, Tier::Modal, Drive { vpp: HOLDING_DRIVE_VPP, omega: plate.omega0 });
    plant.advance(ms(5.0), &[], &mut Vec::new());
    let held = Conditions { temperature_offset_k: 3.0, finger_force_n: 1.0 };
    plant.hold_conditions(held);
    let expected = Flow::new(Tier::Modal, &plate.mode(&held), &plant.drive(), &plant.state()).after(2e-3);
    plant.advance(ms(7.0), &[], &mut Vec::new());
    assert!(distance(&plant.state(), &expected, plate.omega0) < 1e-14);
}

/// Intervals of a millisecond against those of a microsecond, in which whatever is left of the
/// first commutator is below 1e-9.
#[rstest]
fn every_tier_is_as_good_in_long_steps(#[values(Tier::Linear, Tier::Envelope, Tier::Modal)] tier: Tier) {
    let plate = Plate { omega0_per_n: 50.0, ..paper_plate() };
    let scene = ConditionProfiles {
        temperature_offset_k: line(0.0, 0.0, 500.0, 9.0),
        ..with_finger_force(line(3.0, 0.0, 103.0, 1.0))
    };
    let drive = Drive { vpp: HOLDING_DRIVE_VPP, omega: plate.omega0 + 50.0 };
    let [mut long, mut short] = [(); 2].map(|()| driven_plant(&plate, &scene, tier, drive));
    let mut worst = 0.0_f64;
    for period in 1..=30_u64 {
        let end = Time::from_nanos(period * 1_000_000);
        long.advance(end, &[], &mut Vec::new());
        while short.time() < end {
            short.advance(short.time() + Time::from_nanos(1_000), &[], &mut Vec::new());
        }
        worst = worst.max(distance(&long.state(), &short.state(), plate.omega0));
    }
    println!("{}, 1 ms against 1 µs: {worst:.1e}", tier.name());
    assert!(worst <= 1e-7, "{worst:e}");
}

/// Too short for three instants before their end, and just long enough.
#[rstest]
fn steps_of_nanoseconds_add_up(#[values(Tier::Linear, Tier::Envelope, Tier::Modal)] tier: Tier) {
    let plate = paper_plate();
    let scene = ConditionProfiles {
        temperature_offset_k: line(0.0, 0.0, 50.0, 9.0),
        ..with_finger_force(line(0.0, 0.0, 100.0, 1.0))
    };
    let drive = Drive { vpp: HOLDING_DRIVE_VPP, omega: plate.omega0 };
    let [mut once, mut often] = [(); 2].map(|()| driven_plant(&plate, &scene, tier, drive));
    for plant in [&mut once, &mut often] {
        plant.advance(ms(5.0), &[], &mut Vec::new());
    }
    for nanos in [1, 2, 3, 4, 1, 5, 2] {
        often.advance(often.time() + Time::from_nanos(nanos), &[], &mut Vec::new());
    }
    once.advance(often.time(), &[], &mut Vec::new());
    let apart = distance(&once.state(), &often.state(), plate.omega0);
    assert!(apart < 1e-13, "{}: {apart:e}", tier.name());
}

/// Where a band is left in the middle of a substep the state is as good as at its end.
#[test]
fn inside_a_substep_the_state_is_right_too() {
    let plate = paper_plate();
    let scene = with_finger_force(line(20.0, 0.0, 120.0, 1.0));
    let mode = |t: f64| (plate.sigma0 * (1.0 + ramp(t, 20.0, 0.0, 120.0, 1.0) / 1.5), plate.omega0);
    let drive = Drive { vpp: HOLDING_DRIVE_VPP, omega: plate.omega0 };
    let mut plant = driven_plant(&plate, &scene, Tier::Modal, drive);
    plant.advance(ms(20.0), &[], &mut Vec::new());
    let watches = [1.99, 1.97, 1.95, 1.9, 1.83, 1.8].map(|low| BandMonitor {
        signal: BandSignal::Amplitude,
        low,
        high: 2.0 * SETPOINT,
    });
    let mut found = Vec::new();
    for period in 21..=60 {
        plant.advance(Time::from_nanos(period * 1_000_000), &watches, &mut found);
    }
    assert_eq!(found.len(), watches.len());
    let mut carrier = ReferencePlate::at_rest(plate.omega0);
    carrier.advance(20e-3, plate.force_constant(), &drive, &mode);
    let (mut now, mut worst) = (ms(20.0), 0.0_f64);
    for crossing in &found {
        carrier.advance((crossing.time - now).seconds(), plate.force_constant(), &drive, &mode);
        now = crossing.time;
        worst = worst.max(distance(&crossing.state, &carrier.state(), plate.omega0));
    }
    println!("states at {} crossings inside substeps: {worst:.1e}", found.len());
    assert!(worst <= 1e-7, "{worst:e}");
}

/// What a lock-in shows does not depend on how long the steps are.
#[test]
fn a_demodulator_sees_the_mode_move() {
    let lockin = Some(Lockin { converter_hz: 1e6, periods: 8, resolution: None });
    let plate = Plate { lockin, ..paper_plate() };
    let scene = ConditionProfiles {
        temperature_offset_k: line(0.0, 0.0, 500.0, 9.0),
        ..with_finger_force(line(3.0, 0.0, 103.0, 1.0))
    };
    let drive = Drive { vpp: HOLDING_DRIVE_VPP, omega: plate.omega0 + 50.0 };
    let [mut long, mut short] = [(); 2].map(|()| driven_plant(&plate, &scene, Tier::Carrier, drive));
    let mut worst = 0.0_f64;
    for period in 1..=30_u64 {
        let end = Time::from_nanos(period * 1_000_000);
        long.advance(end, &[], &mut Vec::new());
        while short.time() < end {
            short.advance(short.time() + Time::from_nanos(500), &[], &mut Vec::new());
        }
        worst = worst.max((long.sensor_reading() - short.sensor_reading()).norm() / SETPOINT);
    }
    println!("what a lock-in shows, 1 ms against 0.5 µs: {worst:.1e}");
    assert!(worst <= 3e-7, "{worst:e}");
}

/// Force and temperature jump where no interval ends.
#[test]
fn a_jump_inside_an_interval_happens_there() {
    let plate = paper_plate();
    let jumps = [3.333_7, 7.123_456, 11.9];
    let force = Profile::Hold(vec![(ms(0.0), 0.0), (ms(jumps[0]), 1.5), (ms(jumps[2]), 0.5)]);
    let offset = Profile::Hold(vec![(ms(0.0), 0.0), (ms(jumps[1]), 9.0)]);
    let scene = ConditionProfiles { finger_force_n: force, temperature_offset_k: offset };
    let drive = Drive { vpp: HOLDING_DRIVE_VPP, omega: plate.omega0 };
    let mut carrier = ReferencePlate::at_rest(plate.omega0);
    let modes = [(1.0, 0.0), (2.0, 0.0), (2.0, 9.0), (1.0 + 0.5 / 1.5, 9.0)];
    let mut from = 0.0;
    for ((ratio, offset), to) in modes.into_iter().zip([jumps[0], jumps[1], jumps[2], 15.0]) {
        let mode = (plate.sigma0 * ratio, plate.omega0 - 9.638 * TAU * offset);
        carrier.advance((to - from) / 1e3, plate.force_constant(), &drive, &|_| mode);
        from = to;
    }
    for interval in [15_000_000, 1_000_000, 70_000] {
        let mut plant = driven_plant(&plate, &scene, Tier::Modal, drive);
        while plant.time() < ms(15.0) {
            plant.advance((plant.time() + Time::from_nanos(interval)).min(ms(15.0)), &[], &mut Vec::new());
        }
        let error = distance(&plant.state(), &carrier.state(), plate.omega0);
        println!("three jumps, intervals of {} ms: {error:.1e}", interval as f64 / 1e6);
        assert!(error <= 1e-10, "{error:e}");
    }
}

/// Whole turns of the fast pole per substep, 65 and 13: what kicked it once per substep would kick
/// it in phase.
#[test]
fn substeps_do_not_kick_the_fast_pole_in_step() {
    let plate = Plate { omega0: 32_500.0 * TAU, ..paper_plate() };
    let scene = with_finger_force(line(0.0, 0.0, 100.0, 1.41));
    let mode = |t: f64| (plate.sigma0 * (1.0 + ramp(t, 0.0, 0.0, 100.0, 1.41) / 1.5), plate.omega0);
    let intervals = [1_000_000, 200_000];
    let found = errors(&plate, &scene, &mode, DrivePattern::Hold, 60, &intervals);
    print_errors("1.41 N in 0.1 s at 32.5 kHz", DrivePattern::Hold, &intervals, &found);
}

/// A whole period: three looks at its slope see nothing.
#[rstest]
#[case::slow(2.0, 500)]
#[case::quick(20.0, 100)]
fn a_long_interval_is_as_good_as_many(#[case] hertz: f64, #[case] end: u64) {
    let plate = paper_plate();
    let scene = with_finger_force(Profile::Sine { mean: 1.0, amplitude: 0.5, omega: TAU * hertz, phase: 0.0 });
    let mode = |t: f64| (plate.sigma0 * (1.0 + (1.0 + 0.5 * (TAU * hertz * t).sin()) / 1.5), plate.omega0);
    let found = errors(&plate, &scene, &mode, DrivePattern::Hold, end, &[end * 1_000_000]);
    print_errors(&format!("0.5 to 1.5 N at {hertz} Hz"), DrivePattern::Hold, &[end * 1_000_000], &found);
}
