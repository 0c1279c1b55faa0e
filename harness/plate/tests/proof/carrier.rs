//! Tests the carrier model: state, waveform, converter and lock-in.

use crate::reference::{
    HOLDING_DRIVE_VPP, Random, ReferencePlate, SETPOINT, constant_conditions, driven_plant, holding_plant, paper_plate,
    state_at,
};
use platebench_plate::{
    Complex64, ConditionProfiles, ConverterResolution, Drive, Lockin, Model, Plant, Plate, Profile, Time,
};
use rstest::rstest;
use std::f64::consts::{PI, TAU};

fn with_lockin(periods: u32, converter_hz: f64, resolution: Option<ConverterResolution>) -> Plate {
    Plate { lockin: Some(Lockin { converter_hz, periods, resolution }), ..paper_plate() }
}

fn random_drives(seed: u64, plate: &Plate, mut each: impl FnMut(f64, Drive)) {
    let mut random = Random::new(seed);
    for period in 1..=30 {
        let omega = plate.omega0 + random.in_range(-600.0, 600.0);
        each(f64::from(period), Drive { vpp: random.in_range(0.0, 800.0), omega });
    }
}

fn moving_conditions() -> ConditionProfiles {
    let ms = |ms| Time::from_ms(ms).unwrap();
    ConditionProfiles {
        temperature_offset_k: Profile::Linear(vec![(ms(0.0), 0.0), (ms(30.0), 9.0)]),
        finger_force_n: Profile::Hold(vec![(ms(0.0), 0.0), (ms(10.3), 1.5)]),
    }
}

#[test]
fn the_carrier_model_is_the_modal_plate_bit_for_bit() {
    let plate = with_lockin(8, 1e6, None);
    let mut modal = Plant::new(plate.clone(), moving_conditions(), Model::Modal);
    let mut carrier = Plant::new(plate.clone(), moving_conditions(), Model::Carrier);
    random_drives(21, &plate, |ms, drive| {
        for plant in [&mut modal, &mut carrier] {
            plant.set_drive(drive);
            state_at(plant, ms);
        }
        assert_eq!(modal.state(), carrier.state(), "at {ms} ms");
        assert_eq!(modal.phase(), carrier.phase(), "at {ms} ms");
        assert_eq!(modal.sensor_reading(), modal.state().w);
        assert_ne!(carrier.sensor_reading(), carrier.state().w);
    });
}

#[test]
fn without_a_lock_in_the_reading_is_w() {
    let mut plant = holding_plant(&paper_plate(), Model::Carrier, 0.0);
    let state = state_at(&mut plant, 3.0);
    assert_eq!(plant.sensor_reading(), state.w);
}

#[test]
fn the_waveform_equals_the_reference() {
    let plate = paper_plate();
    let mut plant = Plant::new(plate.clone(), constant_conditions(), Model::Carrier);
    let mut reference = ReferencePlate::at_rest(plate.omega0);
    let mut worst = 0.0_f64;
    let mode = plant.mode_at(Time::ZERO);
    random_drives(22, &plate, |ms, drive| {
        plant.set_drive(drive);
        state_at(&mut plant, ms);
        reference.advance(1e-3, plate.force_constant(), &drive, &|_| (mode.sigma, mode.omega0));
        worst = worst.max((plant.waveform() - reference.waveform()[0]).abs() / SETPOINT);
    });
    println!("waveform against reference, 30 periods: {worst:.1e}");
    assert!(worst <= 1e-10, "{worst:e}");
}

/// Loops of the paper, matched to the zero-order hold (response time 2 ms, no drive limit).
#[derive(Debug, Clone, Copy, PartialEq)]
enum ControlLoop {
    Open,
    Ideal,
    ThroughLockin,
}

/// W at the control instants; largest error of the lock-in at these instants and at any time.
fn run_loop(control: ControlLoop, plate: &Plate, detuning: f64) -> (Vec<Complex64>, [f64; 2]) {
    let (plant_pole, loop_pole) = ((-1.0_f64 / 1.88).exp(), (-1.5_f64).exp());
    let normalised = (1.0 - loop_pole) / (1.0 - plant_pole);
    let mut drive = Drive { vpp: HOLDING_DRIVE_VPP, omega: plate.omega0 + detuning };
    let mut plant = driven_plant(plate, &constant_conditions(), Model::Carrier, drive);
    let (mut voltage, mut frequency) = (0.0, drive.omega);
    let (mut at_instants, mut worst) = (Vec::new(), [0.0_f64; 2]);
    for period in 0..40 {
        if control != ControlLoop::Open {
            let w = if control == ControlLoop::Ideal { plant.state().w } else { plant.sensor_reading() };
            let error = SETPOINT - w.re;
            drive.vpp = normalised / plate.gain * error + voltage;
            voltage += normalised * (1.0 - plant_pole) / plate.gain * error;
            if w.re > 0.1 {
                let ratio = w.im / w.re * plate.sigma0;
                drive.omega = frequency + normalised * ratio;
                frequency += normalised * (1.0 - plant_pole) * ratio;
            }
            plant.set_drive(drive);
        }
        for step in 1..=100 {
            let w = state_at(&mut plant, f64::from(period) + f64::from(step) / 100.0).w;
            let error = (plant.sensor_reading() - w).norm() / SETPOINT;
            worst[1] = worst[1].max(error);
            if step == 100 {
                worst[0] = worst[0].max(error);
                at_instants.push(w);
            }
        }
    }
    (at_instants, worst)
}

/// Expected values in 1/1000 of the setpoint: the error of a lock-in of one period at the control
/// instants and at any time, and the change of W at the control instants that this error causes.
#[rstest]
#[case::step_open(0.0, ControlLoop::Open, [5.90, 10.36, 0.0])]
#[case::step_closed(0.0, ControlLoop::ThroughLockin, [11.11, 19.52, 8.65])]
#[case::detuned_open(545.0, ControlLoop::Open, [5.92, 10.34, 0.0])]
#[case::detuned_closed(545.0, ControlLoop::ThroughLockin, [11.15, 19.47, 7.35])]
fn a_lock_in_of_one_period_has_the_documented_error(
    #[case] detuning: f64,
    #[case] control: ControlLoop,
    #[case] expected: [f64; 3],
) {
    let plate = with_lockin(1, 4e6, None);
    let (with, [at_instants, ever]) = run_loop(control, &plate, detuning);
    let other = if control == ControlLoop::Open { ControlLoop::Open } else { ControlLoop::Ideal };
    let (without, _) = run_loop(other, &plate, detuning);
    let moved = with.iter().zip(&without).map(|(a, b)| (a - b).norm() / SETPOINT).fold(0.0, f64::max);
    println!(
        "lock-in of one period, {detuning} rad/s off, {control:?}: {at_instants:.3e} at control instants, \
         {ever:.3e} ever, W itself {moved:.3e}"
    );
    for (found, expected) in [at_instants, ever, moved].into_iter().zip(expected) {
        assert!((found - 1e-3 * expected).abs() <= 0.02 * found, "{found:e} instead of {expected}e-3");
    }
}

#[rstest]
fn the_ripple_of_a_steady_reading_is_bounded(
    #[values(1, 2, 8, 100)] periods: u32,
    #[values(2.0e5, 1e6, 1.234_567e6, 7e6)] converter_hz: f64,
) {
    let plate = with_lockin(periods, converter_hz, None);
    let mut plant = holding_plant(&plate, Model::Carrier, 300.0);
    let window = f64::from(periods) * converter_hz * TAU / (plate.omega0 + 300.0);
    let bound = PI * f64::from(periods) / (2.0 * window * window);
    let mut worst = 0.0_f64;
    state_at(&mut plant, 80.0);
    for step in 1..200 {
        let w = state_at(&mut plant, 80.0 + 0.013 * f64::from(step)).w;
        worst = worst.max((plant.sensor_reading() - w).norm() / w.norm());
    }
    println!("{periods} periods at {converter_hz} Hz, steady: {worst:.1e}, bound {bound:.1e}");
    // The bound is of first order in 1/L; 20 % are for higher orders at 6 samples per period.
    assert!(worst <= 1.2 * bound + 1e-12, "{worst:e} > {bound:e}");
    assert!(periods > 8 || worst >= 0.02 * bound, "{worst:e} << {bound:e}");
}

#[rstest]
fn a_lock_in_delays_by_half_its_window(#[values(1, 8, 32)] periods: u32) {
    let plate = with_lockin(periods, 2e6, None);
    // Mean age of the samples in the window; the newest sample has age 0.
    let latency = (f64::from(periods) * TAU / plate.omega0 - 0.5e-6) / 2.0;
    let mut plant = holding_plant(&plate, Model::Carrier, 0.0);
    let mut earlier = plant.clone();
    state_at(&mut plant, 4.0);
    let reading = plant.sensor_reading();
    let late = (reading - state_at(&mut earlier, 4.0 - latency * 1e3).w).norm();
    let prompt = (reading - plant.state().w).norm();
    println!(
        "{periods} periods: latency {:.1} µs, {late:.1e} µm from the earlier W, {prompt:.1e} µm from W",
        latency * 1e6
    );
    // One period leaves the ripple at twice the carrier: 1/2ω, compared with half a window, π/ω.
    assert!(late < 0.35 * prompt, "{late:e} against {prompt:e}");
}

#[test]
fn the_reading_does_not_depend_on_intervals() {
    let plate = with_lockin(8, 1.234_567e6, None);
    let mut whole = holding_plant(&plate, Model::Carrier, 545.0);
    let mut pieces = whole.clone();
    let mut random = Random::new(23);
    let mut ms = 0.0;
    while ms < 9.9 {
        ms += random.in_range(0.0, 0.01);
        state_at(&mut pieces, ms);
    }
    for plant in [&mut whole, &mut pieces] {
        state_at(plant, 10.0);
    }
    let error = (whole.sensor_reading() - pieces.sensor_reading()).norm();
    println!("10 ms in 2000 pieces against one: {error:.1e} µm");
    assert!(error < 1e-12, "{error:e}");
}

#[test]
fn a_converter_rounds_and_clips() {
    let reading = |resolution: Option<ConverterResolution>| {
        let plate = with_lockin(8, 1e6, resolution);
        let mut plant = holding_plant(&plate, Model::Carrier, 150.0);
        state_at(&mut plant, 50.0);
        plant.sensor_reading()
    };
    let ideal = reading(None);
    for bits in [4, 8, 12, 16, 24] {
        let resolution = ConverterResolution { bits, range_um: 4.0 };
        let error = (reading(Some(resolution)) - ideal).norm();
        println!("{bits} bits over 4 µm: {error:.1e} µm off, half a step is {:.1e} µm", resolution.step_um() / 2.0);
        // Each product has an error of at most 2 · step/2; their mean has a smaller one.
        assert!(error > 0.0 && error < resolution.step_um(), "{bits} bits: {error:e}");
    }
    let amplitude = ideal.norm();
    let fits = reading(Some(ConverterResolution { bits: 24, range_um: amplitude * 1.001 }));
    assert!((fits - ideal).norm() < 1e-5);
    let clipped = reading(Some(ConverterResolution { bits: 24, range_um: amplitude * 0.8 }));
    assert!(clipped.norm() < 0.95 * amplitude, "{clipped}");
    // The fundamental of a square wave is 4/π of its amplitude.
    let square = reading(Some(ConverterResolution { bits: 24, range_um: amplitude * 1e-3 }));
    assert!((square.norm() / (amplitude * 1e-3) - 4.0 / PI).abs() < 0.03, "{square}");
}

#[test]
fn the_first_window_contains_the_rest_before_the_start() {
    let plate = with_lockin(100, 1e6, None);
    let mut plant = holding_plant(&plate, Model::Carrier, 0.0);
    assert_eq!(plant.sensor_reading(), Complex64::ZERO);
    let w = state_at(&mut plant, 1.0).w;
    assert!(plant.sensor_reading().norm() < 0.3 * w.norm());
}

#[rstest]
fn readings_are_finite_for_any_frequency_and_interval(#[values(0.0, 1.0, 1e5, 4e5, 1e9, 1e12)] omega: f64) {
    let resolution = Some(ConverterResolution { bits: 12, range_um: 4.0 });
    let plate = with_lockin(2, 1e6, resolution);
    let mut plant =
        driven_plant(&plate, &constant_conditions(), Model::Carrier, Drive { vpp: 900.0, omega: plate.omega0 });
    for (step, ms) in [1e-6, 0.0309, 1.0, 1.000_001, 20.0, 2_000.0].into_iter().enumerate() {
        plant.set_drive(Drive { vpp: if step % 2 == 0 { 900.0 } else { 0.0 }, omega });
        assert!(state_at(&mut plant, ms).is_finite());
        assert!(plant.sensor_reading().is_finite() && plant.waveform().is_finite());
        assert!(plant.sensor_reading().norm() <= 8.0, "{}", plant.sensor_reading());
    }
}

#[test]
fn a_control_period_of_one_carrier_cycle_is_exact() {
    let plate = with_lockin(1, 1e6, None);
    let mut plant = Plant::new(plate.clone(), constant_conditions(), Model::Carrier);
    let mut reference = ReferencePlate::at_rest(plate.omega0);
    let mode = plant.mode_at(Time::ZERO);
    let mut random = Random::new(24);
    let mut worst = 0.0_f64;
    for _ in 0..300 {
        let drive = Drive { vpp: random.in_range(0.0, 800.0), omega: plate.omega0 + random.in_range(-2e3, 2e3) };
        plant.set_drive(drive);
        plant.advance(plant.time() + Time::from_nanos(30_952), &[], &mut Vec::new());
        reference.advance(30_952e-9, plate.force_constant(), &drive, &|_| (mode.sigma, mode.omega0));
        worst = worst.max((plant.waveform() - reference.waveform()[0]).abs() / SETPOINT);
        worst = worst.max((plant.state().w - reference.state().w).norm() / SETPOINT);
        assert!(plant.sensor_reading().is_finite());
    }
    println!("300 carrier cycles, a drive each: {worst:.1e}");
    assert!(worst <= 1e-10, "{worst:e}");
}
