//! Compares second mode, amplifier, self-heating and sensor latency with an independent reference.

use crate::effects_reference::EffectsReference;
use crate::reference::{
    HOLDING_DRIVE_VPP, Random, SETPOINT, constant_conditions, distance, driven_plant, line, paper_plate, state_at,
};
use platebench_plate::{
    Amplifier, BandMonitor, BandSignal, Complex64, ConditionProfiles, Drive, DriveConverter, Effects, Heating, Lockin,
    Model, Plant, Plate, SecondMode, SensorElectronics, Time,
};
use rstest::rstest;
use std::f64::consts::TAU;

const MAX_ERROR: f64 = 1e-7;
/// Bound of `docs/mathematics.md`, relative to the amplitude that the largest drive reaches.
const MAX_HEATING_ERROR: f64 = 3e-7;

/// Second mode 300 Hz above the first one, with a third of its gain and the opposite sign.
fn second_mode() -> SecondMode {
    let plate = paper_plate();
    SecondMode { omega0: plate.omega0 + TAU * 300.0, sigma0: 1e3 / 1.2, gain: -0.3 * plate.gain }
}

fn plate_with(effects: Effects) -> Plate {
    Plate { effects, ..paper_plate() }
}

fn two_modes() -> Effects {
    Effects { second_mode: Some(second_mode()), ..Effects::default() }
}

fn amplified(bandwidth_hz: Option<f64>, slew_rate_vpp_per_ms: Option<f64>) -> Effects {
    let amplifier = Amplifier {
        pole: bandwidth_hz.map(|hz| TAU * hz),
        slew_rate: slew_rate_vpp_per_ms.map(|rate| 1e3 * rate),
        ..Amplifier::default()
    };
    Effects { amplifier, ..Effects::default() }
}

/// 5 µm warm this plate by 20 K with a time constant of 0.5 s, far more than a real plate.
fn heated(effects: Effects) -> Effects {
    Effects { heating: Some(Heating { rise_k_per_um2: 0.8, rate: 2.0 }), ..effects }
}

fn ramps() -> ConditionProfiles {
    ConditionProfiles { temperature_offset_k: line(0.0, 0.0, 50.0, 3.0), finger_force_n: line(0.0, 0.2, 100.0, 1.2) }
}

/// Applies a random drive of 0 to 800 Vpp within ±600 rad/s in each period of 1 ms.
fn largest_error(plate: &Plate, scene: &ConditionProfiles, periods: u32) -> f64 {
    let mut plant = Plant::new(plate.clone(), scene.clone(), Model::Modal);
    let mut reference = EffectsReference::at_rest(plate, scene);
    let mut random = Random::new(31);
    let (dead, period) = (plate.effects.amplifier.dead_time, Time::from_nanos(1_000_000));
    let mut acting = Drive::default();
    let mut worst = 0.0_f64;
    for number in 0..periods {
        let drive = Drive { vpp: random.in_range(0.0, 800.0), omega: plate.omega0 + random.in_range(-600.0, 600.0) };
        plant.set_drive(drive);
        let start = period.times(number.into());
        if acting == Drive::default() {
            acting = drive;
        }
        for (end, next) in [(start + dead, drive), (start + period, drive)] {
            if end > plant.time() {
                reference.advance((end - plant.time()).seconds(), acting.vpp, acting.omega);
                plant.advance(end, &[], &mut Vec::new());
                worst = worst.max(distance(&plant.state(), &reference.state(), plate.omega0));
                worst = worst.max((plant.waveform() - reference.waveform()).abs() / SETPOINT);
            }
            acting = next;
        }
    }
    if plate.effects.heating.is_some() {
        println!("    self-heating {:.3} K, reference {:.3} K", plant.self_heating_k(), reference.heat_k());
        assert!(plant.self_heating_k() > 0.1);
    }
    worst
}

#[rstest]
#[case::two_modes(two_modes())]
#[case::bandwidth_5_khz(amplified(Some(5e3), None))]
#[case::bandwidth_1_mhz(amplified(Some(1e6), None))]
#[case::bandwidth_of_the_plate(amplified(Some(1e3 / 1.88 / TAU), None))]
#[case::slew_rate(amplified(None, Some(500.0)))]
#[case::slew_rate_and_bandwidth(amplified(Some(2e3), Some(700.0)))]
#[case::offset(Effects { amplifier: Amplifier { offset_vpp: 4.0, ..Amplifier::default() }, ..Effects::default() })]
#[case::dead_time(Effects {
    amplifier: Amplifier { dead_time: Time::from_nanos(137_000), pole: Some(3e4), ..Amplifier::default() },
    ..two_modes()
})]
#[case::all_of_the_drive(Effects { second_mode: Some(second_mode()), ..amplified(Some(5e3), Some(1500.0)) })]
#[case::heating(heated(Effects::default()))]
#[case::heating_with_two_modes_and_bandwidth(
    heated(Effects { second_mode: Some(second_mode()), ..amplified(Some(5e3), None) }))]
fn effects_equal_the_reference(#[case] effects: Effects, #[values(false, true)] changing: bool) {
    let plate = plate_with(effects);
    let scene = if changing { ramps() } else { constant_conditions() };
    let error = largest_error(&plate, &scene, 40);
    println!("{:?}, changing conditions: {changing}: {error:.1e}", plate.first_effect().unwrap());
    assert!(error <= MAX_ERROR, "{error:e}");
}

#[rstest]
#[case::paper(1.0, MAX_ERROR)]
// Disturbances decay a hundred times more slowly than in the paper's plate, so errors add up.
#[case::slow(0.01, 3.0 * MAX_ERROR)]
fn self_heating_detunes_a_held_drive_as_the_reference_does(#[case] damping: f64, #[case] at_most: f64) {
    let heating = Some(Heating { rise_k_per_um2: 0.5, rate: 10.0 });
    let effects = Effects { heating, ..Effects::default() };
    let plate = Plate { sigma0: damping * paper_plate().sigma0, ..plate_with(effects) };
    let scene = constant_conditions();
    let mut plant = Plant::new(plate.clone(), scene.clone(), Model::Modal);
    let mut reference = EffectsReference::at_rest(&plate, &scene);
    let drive = Drive { vpp: HOLDING_DRIVE_VPP, omega: plate.omega0 };
    plant.set_drive(drive);
    let mut worst = 0.0_f64;
    for step in 1..=6 {
        reference.advance(0.05, drive.vpp, drive.omega);
        plant.advance(Time::from_nanos(50_000_000).times(step), &[], &mut Vec::new());
        worst = worst.max(distance(&plant.state(), &reference.state(), plate.omega0));
        // The error of T is weighted with the error of W that it causes after one time constant.
        let heat_error = (plant.self_heating_k() - reference.heat_k()).abs();
        worst = worst.max(heat_error * plate.omega0_per_k.abs() / plate.sigma0);
    }
    let amplitude = plant.state().amplitude();
    println!("self-heating, 0.3 s: {worst:.1e}; {amplitude:.3} µm, {:.3} K", plant.self_heating_k());
    assert!(worst <= at_most, "{worst:e}");
    assert!(amplitude < 0.99 * SETPOINT);
}

/// Largest error relative to the amplitude that 900 Vpp reach, while a drive holds some 4 µm near the
/// resonance of a plate that its vibration warms. `rows_ns` is the distance between rows of a trace.
fn heating_error(plate: &Plate, scene: &ConditionProfiles, rows_ns: u64, periods: u64, seed: u64) -> f64 {
    let mut plant = Plant::new(plate.clone(), scene.clone(), Model::Modal);
    let mut reference = EffectsReference::at_rest(plate, scene);
    let mut random = Random::new(seed);
    let (mut worst, period) = (0.0_f64, 1_000_000);
    for number in 0..periods {
        let vpp = random.in_range(400.0, 750.0) * if number < 2 { 1.2 } else { 1.0 };
        let resonance = plant.mode_at(plant.time()).omega0;
        let drive = Drive { vpp, omega: resonance + random.in_range(-300.0, 100.0) };
        plant.set_drive(drive);
        for row in 1..=period / rows_ns {
            plant.advance(Time::from_nanos(number * period + row * rows_ns), &[], &mut Vec::new());
        }
        reference.advance(1e-3, drive.vpp, drive.omega);
        worst = worst.max(SETPOINT * distance(&plant.state(), &reference.state(), plate.omega0));
    }
    assert!(plant.self_heating_k() > 0.01, "{} K", plant.self_heating_k());
    worst / (plate.gain * plate.drive_limit_vpp)
}

#[rstest]
fn strong_self_heating_keeps_its_bound_for_any_rows(#[values(1_000_000, 50_000, 5_000)] rows_ns: u64) {
    let heating = Some(Heating { rise_k_per_um2: 4.0, rate: 1.0 / 0.03 });
    let plate = plate_with(Effects { heating, ..Effects::default() });
    let error = heating_error(&plate, &constant_conditions(), rows_ns, 16, 3);
    println!("self-heating, 4 K/µm², 30 ms, rows every {rows_ns} ns: {error:.1e}");
    assert!(error <= MAX_HEATING_ERROR, "{error:e}");
}

#[test]
fn self_heating_of_random_plates_keeps_its_bound() {
    let mut random = Random::new(57);
    let (mut worst, count) = (0.0_f64, 24);
    for number in 0..count {
        // 0.1 to 10 K/µm², 10 ms to 1 s, but at most 64 K at 4 µm.
        let rise_k_per_um2 = 10.0_f64.powf(random.in_range(-1.0, 0.6));
        let rate = 10.0_f64.powf(random.in_range(0.0, 2.0));
        let heating = Some(Heating { rise_k_per_um2, rate });
        let effects = match number % 3 {
            0 => Effects { heating, ..Effects::default() },
            1 => Effects { heating, ..two_modes() },
            _ => Effects {
                heating,
                second_mode: Some(second_mode()),
                ..amplified(Some(random.in_range(1e3, 1e5)), None)
            },
        };
        let sigma0 = random.in_range(0.5, 3.0) * paper_plate().sigma0;
        let plate = Plate { sigma0, ..plate_with(effects) };
        let scene = if number % 2 == 0 { constant_conditions() } else { ramps() };
        let error = heating_error(&plate, &scene, 50_000, 8, number);
        println!("{rise_k_per_um2:.2} K/µm², {:.0} ms, σ {sigma0:.0}, case {}: {error:.1e}", 1e3 / rate, number % 3);
        worst = worst.max(error);
    }
    println!("self-heating of {count} random plates: {worst:.1e}");
    assert!(worst <= MAX_HEATING_ERROR, "{worst:e}");
}

/// Integrates y and the momentary loss, with and without the ripple of the temperature at twice the
/// carrier. At resonance the share of |W| is `|s| T'/4σω0`.
#[rstest]
#[case(480.0, 6.7e-5)]
#[case(6.4, 9.0e-7)]
fn the_neglected_ripple_of_the_temperature_has_its_stated_size(#[case] k_per_s: f64, #[case] stated: f64) {
    let heating = Some(Heating { rise_k_per_um2: k_per_s / SETPOINT.powi(2), rate: 1.0 });
    let plate = plate_with(Effects { heating, ..Effects::default() });
    let scene = constant_conditions();
    let mut mean = EffectsReference::at_rest(&plate, &scene);
    let mut momentary = EffectsReference::at_rest(&plate, &scene).with_momentary_loss();
    let seconds = 2.5e-4;
    for _ in 0..60 {
        let omega = plate.omega0 + plate.omega0_per_k * mean.heat_k();
        mean.advance(seconds, HOLDING_DRIVE_VPP, omega);
        momentary.advance(seconds, HOLDING_DRIVE_VPP, omega);
    }
    let share = momentary.amplitude_of_y() / mean.amplitude_of_y() - 1.0;
    println!("{k_per_s} K/s: the ripple of the temperature changes |W| by {share:.2e}");
    assert!((share.abs() / stated - 1.0).abs() < 0.1, "{share:e}");
}

#[test]
fn a_sensor_with_latency_reads_the_earlier_state_with_its_drift() {
    let latency = Time::from_nanos(1_234_567);
    let sensor = SensorElectronics { latency, gain_drift_per_s: 0.2 };
    let plate = plate_with(Effects { sensor, ..two_modes() });
    let mut now = Plant::new(plate.clone(), ramps(), Model::Modal);
    let mut earlier = Plant::new(plate_with(two_modes()), ramps(), Model::Modal);
    let mut random = Random::new(5);
    let mut changes = Vec::new();
    let mut worst = 0.0_f64;
    for number in 0..40_u64 {
        let time = Time::from_nanos(777_777).times(number);
        now.advance(time, &[], &mut Vec::new());
        let expected = if time < latency {
            Complex64::ZERO
        } else {
            let then = time - latency;
            while let Some((at, drive)) = changes.first().copied().filter(|(at, _)| *at <= then) {
                earlier.advance(at, &[], &mut Vec::new());
                earlier.set_drive(drive);
                changes.remove(0);
            }
            earlier.advance(then, &[], &mut Vec::new());
            earlier.state().w * (1.0 + 0.2 * time.seconds())
        };
        worst = worst.max((now.sensor_reading() - expected).norm() / SETPOINT);
        let drive = Drive { vpp: random.in_range(0.0, 800.0), omega: plate.omega0 + random.in_range(-600.0, 600.0) };
        now.set_drive(drive);
        changes.push((time, drive));
    }
    println!("sensor with a latency of {latency}: {worst:.1e}");
    assert!(worst <= MAX_ERROR, "{worst:e}");
    assert!(now.state().amplitude() > 0.5);
}

#[test]
fn a_converter_gives_the_plate_its_nearest_step() {
    let converter = Some(DriveConverter { bits: 10, range_vpp: 900.0 });
    let amplifier = Amplifier { converter, ..Amplifier::default() };
    let plate = plate_with(Effects { amplifier, ..Effects::default() });
    let step = 900.0 / 1023.0;
    let run = |plate: &Plate, vpp| {
        let mut plant = driven_plant(plate, &constant_conditions(), Model::Modal, Drive { vpp, omega: plate.omega0 });
        (state_at(&mut plant, 5.0).w, plant.drive().vpp)
    };
    for code in [0.0_f64, 1.0, 326.0, 1023.0] {
        let commanded = (code * step + 0.4 * step).min(900.0);
        let (w, vpp) = run(&plate, commanded);
        let (expected, _) = run(&paper_plate(), code * step);
        assert!((w - expected).norm() <= 1e-12, "code {code}: {w} instead of {expected}");
        assert_eq!(vpp, commanded);
    }
}

#[rstest]
fn a_lock_in_reads_both_modes(#[values(false, true)] changing: bool) {
    let lockin = Some(Lockin { converter_hz: 4e6, periods: 8, resolution: None });
    let effects = Effects { second_mode: Some(second_mode()), ..amplified(Some(5e3), None) };
    let plate = Plate { lockin, ..plate_with(effects) };
    let scene = if changing { ramps() } else { constant_conditions() };
    let drive = Drive { vpp: HOLDING_DRIVE_VPP, omega: plate.omega0 + 100.0 };
    let mut plant = driven_plant(&plate, &scene, Model::Carrier, drive);
    let mut whole = plant.clone();
    let w = state_at(&mut plant, 40.0).w;
    let error = (plant.sensor_reading() - w).norm() / SETPOINT;
    // Half of 8 periods at the speed of W; a steady reading has a ripple of 1.4e-4.
    assert!(error < if changing { 2e-3 } else { 1e-4 }, "{error:e}");
    for piece in 1..=400 {
        state_at(&mut whole, f64::from(piece) / 10.0);
    }
    let apart = (plant.sensor_reading() - whole.sensor_reading()).norm() / SETPOINT;
    assert!(apart < MAX_ERROR, "{apart:e}");
}

#[test]
fn crossings_are_found_with_both_modes() {
    let plate = plate_with(Effects { second_mode: Some(second_mode()), ..amplified(Some(5e3), None) });
    let monitor = BandMonitor { signal: BandSignal::Amplitude, low: 1.2, high: 1.6 };
    for scene in [constant_conditions(), ramps()] {
        let drive = Drive { vpp: HOLDING_DRIVE_VPP, omega: plate.omega0 };
        let mut plant = driven_plant(&plate, &scene, Model::Modal, drive);
        let mut exact = plant.clone();
        let mut crossings = Vec::new();
        plant.advance(Time::from_nanos(20_000_000), &[monitor], &mut crossings);
        assert!(!crossings.is_empty());
        for crossing in crossings {
            exact.advance(crossing.time, &[], &mut Vec::new());
            assert!((exact.state().w - crossing.state.w).norm() < 1e-6);
            let sides = [crossing.before, crossing.state].map(|state| (1.2..=1.6).contains(&state.amplitude()));
            assert_ne!(sides[0], sides[1]);
        }
    }
}

#[rstest]
fn simple_models_omit_the_effects(#[values(Model::Linear, Model::Envelope)] model: Model) {
    let plate = plate_with(Effects { second_mode: Some(second_mode()), ..amplified(Some(5e3), None) });
    let drive = Drive { vpp: HOLDING_DRIVE_VPP, omega: plate.omega0 };
    let run = |plate: &Plate| state_at(&mut driven_plant(plate, &constant_conditions(), model, drive), 3.0);
    assert_eq!(run(&plate), run(&paper_plate()));
}
