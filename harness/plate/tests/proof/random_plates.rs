//! Compares plates at random up to the bounds of the input with the reference, for each effect.
//! Errors are relative to the amplitude that the largest drive reaches at resonance.

use crate::effects_reference::EffectsReference;
use crate::reference::{Random, ReferencePlate, SETPOINT, conditions, distance, finger_profile, paper_plate};
use platebench_plate::{
    Amplifier, Complex64, ConditionProfiles, Drive, Effects, Heating, Model, Plant, Plate, Profile, SecondMode,
    SensorElectronics, Time,
};
use rstest::rstest;
use std::f64::consts::{E, TAU};

/// Carrier periods between two commands, and number of commands.
const CARRIER_PERIODS: f64 = 40.0;
const COMMANDS: u64 = 16;
const LIMIT_VPP: f64 = 900.0;

/// Number from 10^`low` to 10^`high` with a uniform logarithm.
fn power(random: &mut Random, low: f64, high: f64) -> f64 {
    10.0_f64.powf(random.in_range(low, high))
}

/// 1 kHz to 2.5 MHz with a quality factor from 1 to `max_quality`.
fn random_plate(random: &mut Random, max_quality: f64) -> Plate {
    let omega0 = TAU * power(random, 3.0, 6.398);
    let sigma0 = omega0 / 2.0 / power(random, 0.0, max_quality.log10());
    let damping_ratio = vec![[0.0, 1.0], [1.5, random.in_range(1.0, 4.0)]];
    let omega0_per_k = -omega0 * power(random, -5.0, -3.0);
    Plate { omega0, sigma0, damping_ratio, omega0_per_k, ..paper_plate() }
}

fn random_second_mode(plate: &Plate, random: &mut Random) -> SecondMode {
    let omega0 = plate.omega0 * power(random, -0.5, 0.3).min(TAU * 2.5e6 / plate.omega0);
    SecondMode { omega0, sigma0: omega0 / 2.0 / power(random, 0.7, 5.0), gain: plate.gain * random.in_range(-1.0, 1.0) }
}

/// Bandwidth from a hundredth to a hundred times that of the plate.
fn random_bandwidth(plate: &Plate, random: &mut Random) -> Amplifier {
    Amplifier { pole: Some((plate.sigma0 * power(random, -2.0, 2.0)).min(TAU * 1e9)), ..Amplifier::default() }
}

/// Largest error of W, U/ω, the waveform and the reading of the sensor, at each quarter of a command
/// period. The drives are from `least` Vpp up to the limit. Dead time and latency are multiples of a
/// quarter.
fn error_of(plate: &Plate, scene: &ConditionProfiles, least: f64, random: &mut Random) -> f64 {
    let mut plant = Plant::new(plate.clone(), scene.clone(), Model::Modal);
    let mut reference = EffectsReference::at_rest(plate, scene);
    let quarter = command_quarter(plate);
    let quarters = |time: Time| (time.seconds() / quarter.seconds()).round() as u64;
    let dead_quarters = quarters(plate.effects.amplifier.dead_time);
    let latency_quarters = quarters(plate.effects.sensor.latency) as usize;
    let mut acting = Drive::default();
    let mut commands = Vec::new();
    let mut earlier = vec![Complex64::ZERO];
    let mut worst = 0.0_f64;
    for number in 0..4 * COMMANDS {
        if number % 4 == 0 {
            let width = 3.0 * plate.sigma0.max(plate.omega0 / 2e3).min(plate.omega0 / 20.0);
            let resonance = plant.mode_at(plant.time()).omega0;
            let drive =
                Drive { vpp: random.in_range(least, LIMIT_VPP), omega: resonance + random.in_range(-1.0, 1.0) * width };
            plant.set_drive(drive);
            // The first drive is the initial state of the amplifier.
            commands.push((if number == 0 { 0 } else { number + dead_quarters }, drive));
        }
        if let Some((_, drive)) = commands.iter().find(|(at, _)| *at == number) {
            acting = *drive;
        }
        let time = quarter.times(number + 1);
        plant.advance(time, &[], &mut Vec::new());
        reference.advance(quarter.seconds(), acting.vpp, acting.omega);
        worst = worst.max(SETPOINT * distance(&plant.state(), &reference.state(), plate.omega0));
        worst = worst.max((plant.waveform() - reference.waveform()).abs());
        earlier.push(reference.state().w);
        let read = earlier.len().checked_sub(latency_quarters + 1).map_or(Complex64::ZERO, |then| earlier[then]);
        let read = read * (1.0 + plate.effects.sensor.gain_drift_per_s * time.seconds());
        worst = worst.max((plant.sensor_reading() - read).norm());
    }
    worst / (plate.gain * LIMIT_VPP)
}

fn command_quarter(plate: &Plate) -> Time {
    Time::from_seconds(CARRIER_PERIODS * TAU / plate.omega0 / 4.0).unwrap()
}

fn command_period(plate: &Plate) -> Time {
    command_quarter(plate).times(4)
}

/// A force that rises by up to 2 N during the trial or in 1 µs to 0.1 s, whichever is longer.
fn ramp(plate: &Plate, random: &mut Random) -> ConditionProfiles {
    let trial = COMMANDS as f64 * CARRIER_PERIODS * TAU / plate.omega0 + 1e-5;
    let seconds = power(random, -6.0, -1.0).max(trial);
    let end = Time::from_seconds(seconds).unwrap();
    ConditionProfiles {
        finger_force_n: Profile::Linear(vec![
            (Time::ZERO, random.in_range(0.0, 1.0)),
            (end, random.in_range(0.0, 2.0)),
        ]),
        temperature_offset_k: Profile::Linear(vec![(Time::ZERO, 0.0), (end, random.in_range(-3.0, 3.0))]),
    }
}

struct Case {
    plate: Plate,
    scene: ConditionProfiles,
    /// Smallest drive, Vpp.
    least: f64,
    at_most: f64,
}

fn check(what: &str, count: u32, case: impl Fn(&mut Random) -> Case) {
    let (mut random, mut worst, mut largest_share) = (Random::new(57), 0.0_f64, 0.0_f64);
    for number in 0..count {
        let Case { plate, scene, least, at_most } = case(&mut random);
        let error = error_of(&plate, &scene, least, &mut random);
        let (hz, quality) = (plate.omega0 / TAU, plate.omega0 / 2.0 / plate.sigma0);
        println!("  {what} {number}: {hz:.0} Hz, Q {quality:.1}: {error:.1e}, bound {at_most:.1e}");
        (worst, largest_share) = (worst.max(error), largest_share.max(error / at_most));
    }
    println!("random plates, {what}: {worst:.1e}, at most {largest_share:.2} of the bound");
    assert!(largest_share <= 1.0, "{worst:e}");
}

#[rstest]
fn random_plates_keep_the_bound_of_each_effect(
    #[values(false, true)] moving: bool,
    #[values("none", "second mode", "bandwidth", "offset", "slew rate", "dead time", "sensor")] effect: &str,
) {
    check(&format!("{effect}, moving {moving}"), 24, |random| {
        let plate = random_plate(random, 1e9);
        let mut at_most = if moving { 3e-7 } else { 1e-10 };
        let amplifier = match effect {
            "bandwidth" => random_bandwidth(&plate, random),
            "dead time" => Amplifier {
                dead_time: command_quarter(&plate).times(random.in_range(0.0, 9.0) as u64),
                ..Amplifier::default()
            },
            "offset" => Amplifier { offset_vpp: random.in_range(-9.0, 9.0), ..Amplifier::default() },
            "slew rate" => {
                let period = command_period(&plate).seconds();
                let slew_rate = LIMIT_VPP / period * power(random, -1.0, 1.0);
                // The end of a ramp is rounded to 1 ns. Half of this impulse moves the slow pole and half
                // the fast one, so that U/ω differs by the sum of both.
                let of_command = plate.sigma0 * slew_rate / LIMIT_VPP * 1e-18;
                at_most += of_command / -(-plate.sigma0 * period).exp_m1();
                Amplifier { slew_rate: Some(slew_rate), ..Amplifier::default() }
            }
            _ => Amplifier::default(),
        };
        let second_mode = (effect == "second mode").then(|| random_second_mode(&plate, random));
        let sensor = if effect == "sensor" {
            let latency = command_quarter(&plate).times(random.in_range(0.0, 33.0) as u64);
            SensorElectronics { latency, gain_drift_per_s: random.in_range(-0.5, 0.5) }
        } else {
            SensorElectronics::default()
        };
        let plate = Plate { effects: Effects { amplifier, second_mode, sensor, ..Effects::default() }, ..plate };
        let scene = if moving { ramp(&plate, random) } else { conditions(0.0, random.in_range(0.0, 2.0)) };
        Case { plate, scene, least: 0.0, at_most }
    });
}

/// The response of the amplifier is a difference of two large terms if its pole is that of the plate.
#[test]
fn a_bandwidth_near_that_of_the_plate_keeps_its_bound() {
    for share in [0.0, 1e-12, 1e-9, 1e-8, 3e-8, 1e-7, 1e-6, 1e-4] {
        let plate = paper_plate();
        let amplifier = Amplifier { pole: Some(plate.sigma0 * (1.0 + share)), ..Amplifier::default() };
        let plate = Plate { effects: Effects { amplifier, ..Effects::default() }, ..plate };
        let mut plant = Plant::new(plate.clone(), conditions(0.0, 0.0), Model::Modal);
        let mut reference = EffectsReference::at_rest(&plate, &conditions(0.0, 0.0));
        let mut worst = 0.0_f64;
        let damped = (plate.omega0.powi(2) - plate.sigma0.powi(2)).sqrt();
        for number in 1..=4 {
            let vpp = if number % 2 == 0 { 0.0 } else { LIMIT_VPP };
            plant.set_drive(Drive { vpp, omega: damped });
            plant.advance(Time::from_nanos(number * 1_000_000), &[], &mut Vec::new());
            reference.advance(1e-3, vpp, damped);
            let error = SETPOINT * distance(&plant.state(), &reference.state(), plate.omega0);
            worst = worst.max(error / (plate.gain * LIMIT_VPP));
        }
        println!("bandwidth of the plate times 1 + {share:e}: {worst:.1e}");
        assert!(worst <= 3e-8, "{worst:e}");
    }
}

/// Warming by up to the largest rate that the plate file accepts.
#[rstest]
fn random_self_heating_keeps_its_bound(#[values(false, true)] moving: bool) {
    check(&format!("self-heating, moving {moving}"), 24, |random| {
        let plate = random_plate(random, 300.0);
        let rate = power(random, -1.0, 2.0);
        let largest = plate.omega0.powi(2) / (TAU * 12_500.0) / plate.omega0_per_k.abs();
        let amplitude = plate.gain * plate.drive_limit_vpp;
        let rise_k_per_um2 = largest * power(random, -2.0, 0.0) / rate / amplitude.powi(2);
        let heating = Some(Heating { rise_k_per_um2, rate });
        let plate = Plate { effects: Effects { heating, ..Effects::default() }, ..plate };
        let scene = if moving { ramp(&plate, random) } else { conditions(0.0, random.in_range(0.0, 2.0)) };
        let at_most = 3e-7 + plate.warming_share() / (4.0 * E);
        Case { plate, scene, least: LIMIT_VPP / 2.0, at_most }
    });
}

/// Ramps so fast that the mode is frozen per substep, on plates of 10 to 150 kHz and a quality factor
/// of 5 to 300.
#[test]
fn fast_ramps_of_random_plates_keep_the_bound_of_frozen_modes() {
    let (mut random, mut worst) = (Random::new(9), 0.0_f64);
    for number in 0..300 {
        let omega0 = TAU * power(&mut random, 4.0, 5.176);
        let sigma0 = omega0 / 2.0 / power(&mut random, 0.7, 2.48);
        let ratio = random.in_range(1.2, 3.0);
        let omega0_per_n = omega0 * random.in_range(-2e-3, 2e-3);
        let plate =
            Plate { omega0, sigma0, omega0_per_n, damping_ratio: vec![[0.0, 1.0], [1.0, ratio]], ..paper_plate() };
        let change = (sigma0 * (ratio - 1.0)).hypot(omega0_per_n);
        // 1/40 000 is the limit of `varying.rs`.
        let seconds = 4e4 * change / omega0.powi(2) * power(&mut random, -2.0, -0.05);
        let nanos = |seconds: f64| Time::from_seconds(seconds).unwrap();
        let before = nanos(30.0 * TAU / omega0);
        let end = before + nanos(seconds);
        let scene = finger_profile(Profile::Linear(vec![(before, 0.0), (end, 1.0)]));
        let mode = |t: f64| {
            let force = ((t - before.seconds()) / (end - before).seconds()).clamp(0.0, 1.0);
            (sigma0 * (1.0 + (ratio - 1.0) * force), omega0 + omega0_per_n * force)
        };
        let mut times: Vec<Time> = (0..=4).map(|part| before + nanos(seconds * f64::from(part) / 4.0)).collect();
        times[4] = end;
        times.extend([20.0, 60.0].map(|periods| end + nanos(periods * TAU / omega0)));
        let mut plant = Plant::new(plate.clone(), scene, Model::Modal);
        let mut reference = ReferencePlate::at_rest(omega0);
        let mut error = 0.0_f64;
        for time in times {
            let width = 2.0 * sigma0.min(omega0 / 20.0);
            let drive =
                Drive { vpp: random.in_range(0.0, LIMIT_VPP), omega: omega0 + random.in_range(-1.0, 1.0) * width };
            plant.set_drive(drive);
            reference.advance((time - plant.time()).seconds(), plate.force_constant(), &drive, &mode);
            plant.advance(time, &[], &mut Vec::new());
            error = error.max(SETPOINT * distance(&plant.state(), &reference.state(), omega0));
        }
        let error = error / (plate.gain * LIMIT_VPP);
        let (hz, quality) = (omega0 / TAU, omega0 / 2.0 / sigma0);
        println!("  fast ramp {number}: {hz:.0} Hz, Q {quality:.1}, ratio {ratio:.1} in {seconds:.1e} s: {error:.1e}");
        worst = worst.max(error);
    }
    println!("random plates, fast ramps: {worst:.1e}");
    assert!(worst <= 3e-7, "{worst:e}");
}

/// A force that oscillates at a tenth to a third of the resonance, on the same plates.
#[test]
fn fast_sines_of_random_plates_keep_the_bound_of_frozen_modes() {
    let (mut random, mut worst) = (Random::new(10), 0.0_f64);
    for number in 0..100 {
        let omega0 = TAU * power(&mut random, 4.0, 5.176);
        let sigma0 = omega0 / 2.0 / power(&mut random, 0.7, 2.48);
        let ratio = random.in_range(1.2, 3.0);
        let plate = Plate { omega0, sigma0, damping_ratio: vec![[0.0, 1.0], [2.0, ratio]], ..paper_plate() };
        let (amplitude, nu) = (random.in_range(0.1, 1.0), omega0 * random.in_range(0.101, 0.33));
        let scene = finger_profile(Profile::sine(1.0, amplitude, nu, 0.0));
        let mode = |t: f64| (sigma0 * (1.0 + (ratio - 1.0) / 2.0 * (1.0 + amplitude * (nu * t).sin())), omega0);
        let mut plant = Plant::new(plate.clone(), scene, Model::Modal);
        let mut reference = ReferencePlate::at_rest(omega0);
        let (mut error, period) = (0.0_f64, command_period(&plate));
        for command in 1..=4 {
            let width = 2.0 * sigma0.min(omega0 / 20.0);
            let drive =
                Drive { vpp: random.in_range(0.0, LIMIT_VPP), omega: omega0 + random.in_range(-1.0, 1.0) * width };
            plant.set_drive(drive);
            reference.advance(period.seconds(), plate.force_constant(), &drive, &mode);
            plant.advance(period.times(command), &[], &mut Vec::new());
            error = error.max(SETPOINT * distance(&plant.state(), &reference.state(), omega0));
        }
        let error = error / (plate.gain * LIMIT_VPP);
        let (hz, quality, tone) = (omega0 / TAU, omega0 / 2.0 / sigma0, nu / TAU);
        println!("  fast sine {number}: {hz:.0} Hz, Q {quality:.1}, ratio {ratio:.1} at {tone:.0} Hz: {error:.1e}");
        worst = worst.max(error);
    }
    println!("random plates, fast sines: {worst:.1e}");
    assert!(worst <= 3e-7, "{worst:e}");
}
