//! Parameters that vary while the plate swings: freezing them per substep against a reference that does not.

use crate::reference::{Carrier, HOLD, ModeOverTime, Random, distance, driven, paper_plate, surroundings};
use platebench_plate::{Drive, Plant, Plate, Profile, Scene, Tier, Time};
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

fn pressed(finger_force_n: Profile) -> Scene {
    Scene { finger_force_n, ..surroundings(0.0, 0.0) }
}

fn warmed(temperature_offset_k: Profile) -> Scene {
    Scene { temperature_offset_k, ..surroundings(0.0, 0.0) }
}

/// What drives the plate during a test.
#[derive(Debug, Clone, Copy)]
enum Driving {
    /// What holds the setpoint untouched, at the resonance untouched.
    Hold,
    /// 0 or 800 Vpp and ±600 rad/s, another every millisecond.
    Bang,
}

impl Driving {
    /// Three times `FREEZING_ERROR` of what the drive would reach at resonance, relative to the setpoint: the bound of
    /// `docs/mathematics.md`, slow and fast pole together.
    fn bound(self) -> f64 {
        match self {
            Self::Hold => 3e-7,
            Self::Bang => 3e-7 * 800.0 / HOLD,
        }
    }
}

/// Largest error of W and U/ω relative to the setpoint, once per millisecond up to `end` ms, for plants that are given
/// intervals of each of `intervals` ns.
fn errors(
    plate: &Plate,
    scene: &Scene,
    mode: ModeOverTime<'_>,
    driving: Driving,
    end: u64,
    intervals: &[u64],
) -> Vec<f64> {
    let mut carrier = Carrier::at_rest(plate.omega0);
    let mut random = Random::new(6);
    let hold = Drive { vpp: HOLD, omega: plate.omega0 };
    let mut plants: Vec<Plant> = intervals.iter().map(|_| driven(plate, scene, Tier::Modal, hold)).collect();
    let mut worst = vec![0.0_f64; intervals.len()];
    for period in 1..=end {
        let drive = match driving {
            Driving::Hold => hold,
            Driving::Bang => Drive {
                vpp: if random.between(0.0, 1.0) < 0.5 { 0.0 } else { 800.0 },
                omega: plate.omega0 + random.between(-600.0, 600.0),
            },
        };
        carrier.advance(1e-3, plate.force_constant(), &drive, mode);
        let end = Time::from_nanos(period * 1_000_000);
        for ((plant, interval), worst) in plants.iter_mut().zip(intervals).zip(&mut worst) {
            plant.set_drive(drive);
            // Whole intervals, each when it is due; one longer than a millisecond is compared where it ends.
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

fn report(what: &str, driving: Driving, intervals: &[u64], errors: &[f64]) {
    for (interval, error) in intervals.iter().zip(errors) {
        println!("{what}, {driving:?}, intervals of {} ms: {error:.1e}", *interval as f64 / 1e6);
    }
    for error in errors {
        assert!(*error <= driving.bound() && *error <= 1e-6, "{error:e}");
    }
}

const BOTH: [u64; 2] = [1_000_000, 50_000];

#[rstest]
fn a_finger_that_presses(#[values(Driving::Hold, Driving::Bang)] driving: Driving) {
    let plate = paper_plate();
    let scene = pressed(line(20.0, 0.0, 120.0, 1.0));
    let sigma0 = plate.sigma0;
    let mode = |t: f64| (sigma0 * (1.0 + ramp(t, 20.0, 0.0, 120.0, 1.0) / 1.5), plate.omega0);
    report("1 N in 0.1 s", driving, &BOTH, &errors(&plate, &scene, &mode, driving, 140, &BOTH));
}

/// Shorter than any substep: as good as a jump.
#[test]
fn a_finger_that_strikes() {
    let plate = paper_plate();
    let scene = pressed(line(20.0, 0.0, 20.001, 1.0));
    let mode = |t: f64| (plate.sigma0 * (1.0 + ramp(t, 20.0, 0.0, 20.001, 1.0) / 1.5), plate.omega0);
    report("1 N in 1 µs", Driving::Hold, &BOTH, &errors(&plate, &scene, &mode, Driving::Hold, 40, &BOTH));
}

#[rstest]
#[case::slow(2.0, 500)]
#[case::quick(100.0, 60)]
fn a_finger_that_breathes(
    #[case] hertz: f64,
    #[case] end: u64,
    #[values(Driving::Hold, Driving::Bang)] driving: Driving,
) {
    let plate = paper_plate();
    let scene = pressed(Profile::Sine { mean: 1.0, amplitude: 0.5, omega: TAU * hertz, phase: 0.0 });
    let mode = |t: f64| (plate.sigma0 * (1.0 + (1.0 + 0.5 * (TAU * hertz * t).sin()) / 1.5), plate.omega0);
    report(&format!("0.5 to 1.5 N at {hertz} Hz"), driving, &BOTH, &errors(&plate, &scene, &mode, driving, end, &BOTH));
}

#[rstest]
#[case::slow(1000.0, 100)]
#[case::quick(50.0, 80)]
fn a_plate_that_warms_up(
    #[case] end_ms: f64,
    #[case] end: u64,
    #[values(Driving::Hold, Driving::Bang)] driving: Driving,
) {
    let plate = paper_plate();
    let scene = warmed(line(0.0, 0.0, end_ms, 9.0));
    let slope = -9.638 * TAU;
    let mode = |t: f64| (plate.sigma0, plate.omega0 + slope * ramp(t, 0.0, 0.0, end_ms, 9.0));
    report(&format!("9 K in {end_ms} ms"), driving, &BOTH, &errors(&plate, &scene, &mode, driving, end, &BOTH));
}

#[rstest]
fn a_finger_that_crosses_the_damping_curve_s_knee(#[values(Driving::Hold, Driving::Bang)] driving: Driving) {
    // Flat, then steep from 0.4317 N on, which is nowhere near the middle of a substep.
    let plate = Plate { damping_ratio: vec![[0.0, 1.0], [0.4317, 1.05], [0.8, 2.5], [2.0, 3.0]], ..paper_plate() };
    let scene = pressed(line(0.0, 0.0, 100.0, 1.0));
    let mode = |t: f64| {
        let force = ramp(t, 0.0, 0.0, 100.0, 1.0);
        let ratio = match force {
            f if f < 0.4317 => 1.0 + 0.05 * f / 0.4317,
            f if f < 0.8 => 1.05 + 1.45 * (f - 0.4317) / (0.8 - 0.4317),
            f => 2.5 + 0.5 * (f - 0.8) / 1.2,
        };
        (plate.sigma0 * ratio, plate.omega0)
    };
    report("across the knee", driving, &BOTH, &errors(&plate, &scene, &mode, driving, 100, &BOTH));
}

/// Force and temperature jump where no interval ends.
#[test]
fn a_jump_inside_an_interval_happens_there() {
    let plate = paper_plate();
    let jumps = [3.333_7, 7.123_456, 11.9];
    let force = Profile::Hold(vec![(ms(0.0), 0.0), (ms(jumps[0]), 1.5), (ms(jumps[2]), 0.5)]);
    let offset = Profile::Hold(vec![(ms(0.0), 0.0), (ms(jumps[1]), 9.0)]);
    let scene = Scene { finger_force_n: force, temperature_offset_k: offset };
    let drive = Drive { vpp: HOLD, omega: plate.omega0 };
    let mut carrier = Carrier::at_rest(plate.omega0);
    let modes = [(1.0, 0.0), (2.0, 0.0), (2.0, 9.0), (1.0 + 0.5 / 1.5, 9.0)];
    let mut from = 0.0;
    for ((ratio, offset), to) in modes.into_iter().zip([jumps[0], jumps[1], jumps[2], 15.0]) {
        let mode = (plate.sigma0 * ratio, plate.omega0 - 9.638 * TAU * offset);
        carrier.advance((to - from) / 1e3, plate.force_constant(), &drive, &|_| mode);
        from = to;
    }
    for interval in [15_000_000, 1_000_000, 70_000] {
        let mut plant = driven(&plate, &scene, Tier::Modal, drive);
        while plant.time() < ms(15.0) {
            plant.advance((plant.time() + Time::from_nanos(interval)).min(ms(15.0)), &[], &mut Vec::new());
        }
        let error = distance(&plant.state(), &carrier.state(), plate.omega0);
        println!("three jumps, intervals of {} ms: {error:.1e}", interval as f64 / 1e6);
        assert!(error <= 1e-10, "{error:e}");
    }
}

/// Substeps as long as half a carrier period kick the fast pole once per turn, always in phase.
#[test]
fn substeps_do_not_kick_the_fast_pole_in_step() {
    let plate = Plate { omega0: 32_500.0 * TAU, ..paper_plate() };
    let scene = pressed(line(0.0, 0.0, 100.0, 1.41));
    let mode = |t: f64| (plate.sigma0 * (1.0 + ramp(t, 0.0, 0.0, 100.0, 1.41) / 1.5), plate.omega0);
    let found = errors(&plate, &scene, &mode, Driving::Hold, 60, &[1_000_000]);
    report("1.41 N in 0.1 s at 32.5 kHz", Driving::Hold, &[1_000_000], &found);
}

/// A whole period: three looks at its slope see nothing, and ten thousand substeps are too few.
#[rstest]
#[case::slow(2.0, 500)]
#[case::quick(20.0, 100)]
fn a_long_interval_is_as_good_as_many(#[case] hertz: f64, #[case] end: u64) {
    let plate = paper_plate();
    let scene = pressed(Profile::Sine { mean: 1.0, amplitude: 0.5, omega: TAU * hertz, phase: 0.0 });
    let mode = |t: f64| (plate.sigma0 * (1.0 + (1.0 + 0.5 * (TAU * hertz * t).sin()) / 1.5), plate.omega0);
    let found = errors(&plate, &scene, &mode, Driving::Hold, end, &[end * 1_000_000]);
    report(&format!("0.5 to 1.5 N at {hertz} Hz"), Driving::Hold, &[end * 1_000_000], &found);
}
