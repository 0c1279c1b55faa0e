//! Compares each model with the reference and with itself in other steps, for constant modes.

use crate::reference::{
    HOLDING_DRIVE_VPP, Random, ReferencePlate, SETPOINT, conditions, constant_conditions, distance, driven_plant,
    paper_plate, state_at,
};
use platebench_plate::{
    Complex64, ConditionProfiles, Conditions, Drive, Flow, Mode, Model, Plant, Plate, Profile, State, Time,
};
use rstest::rstest;

fn nominal_mode(plate: &Plate) -> Mode {
    plate.mode(&Conditions::default())
}

fn error_under_random_drives(seed: u64, detuning: f64, jumps: bool) -> f64 {
    let plate = paper_plate();
    let mut random = Random::new(seed);
    let mut jumping = |high: f64| {
        let points = (0..40)
            .map(|period| (Time::from_nanos(period * 1_000_000), if jumps { random.in_range(0.0, high) } else { 0.0 }));
        Profile::Hold(points.collect())
    };
    let scene = ConditionProfiles { temperature_offset_k: jumping(9.0), finger_force_n: jumping(2.0) };
    let mut plant = Plant::new(plate.clone(), scene.clone(), Model::Modal);
    let mut carrier = ReferencePlate::at_rest(plate.omega0);
    let mut worst = 0.0_f64;
    for period in 1..=40 {
        let mode = plant.mode_at(plant.time());
        let omega = plate.omega0 + random.in_range(-detuning, detuning);
        let drive = Drive { vpp: random.in_range(0.0, 800.0), omega };
        plant.set_drive(drive);
        let state = state_at(&mut plant, f64::from(period));
        carrier.advance(1e-3, plate.force_constant(), &drive, &|_| (mode.sigma, mode.omega0));
        worst = worst.max(distance(&state, &carrier.state(), plate.omega0));
        for (ours, reference) in carrier.waveform_of(&state).into_iter().zip(carrier.waveform()) {
            worst = worst.max((ours - reference).abs() / SETPOINT);
        }
    }
    worst
}

#[rstest]
#[case::near_resonance(1, 600.0, false)]
#[case::far_off(2, 20_000.0, false)]
#[case::jumping_conditions(3, 600.0, true)]
fn modal_equals_the_reference(#[case] seed: u64, #[case] detuning: f64, #[case] jumps: bool) {
    let error = error_under_random_drives(seed, detuning, jumps);
    println!("modal against reference, 40 periods, ±{detuning} rad/s, jumps: {jumps}: {error:.1e}");
    assert!(error <= 1e-10, "{error:e}");
}

fn plate_with_quality(quality: Option<f64>) -> Plate {
    let plate = paper_plate();
    let sigma0 = quality.map_or(plate.sigma0, |quality| plate.omega0 / (2.0 * quality));
    // The gain changes with σ0, so that N/m stays the same.
    Plate { sigma0, gain: plate.gain * plate.sigma0 / sigma0, ..plate }
}

#[rstest]
#[case::paper(None, 545.0, HOLDING_DRIVE_VPP)]
#[case::at_resonance(None, 0.0, HOLDING_DRIVE_VPP)]
#[case::quality_1e6(Some(1e6), 545.0, 100.0)]
fn a_minute_in_steps_equals_one_step(
    #[case] quality: Option<f64>,
    #[case] detuning: f64,
    #[case] vpp: f64,
    #[values(Model::Linear, Model::Envelope, Model::Modal)] model: Model,
    #[values(false, true)] irregular: bool,
) {
    let plate = plate_with_quality(quality);
    let drive = Drive { vpp, omega: plate.omega0 + detuning };
    let whole = Flow::new(model, &nominal_mode(&plate), &drive, &State::default());
    let mut plant = driven_plant(&plate, &constant_conditions(), model, drive);
    let mut random = Random::new(4);
    let end = Time::from_nanos(60_000_000_000);
    let (mut worst, mut steps) = (0.0_f64, 0);
    while plant.time() < end {
        // Irregular steps: log-uniform from 1 ns to 9 ms. Regular steps: 60 000 times 1 ms.
        let step = if irregular { random.in_range(0.0, 16.0).exp() as u64 } else { 1_000_000 };
        plant.advance((plant.time() + Time::from_nanos(step)).min(end), &[], &mut Vec::new());
        let expected = whole.after(plant.time().seconds());
        // The linear model has no resonance curve: at quality 10⁶ it gives 5000 times the setpoint.
        let scale = if model == Model::Linear { expected.amplitude().max(1.0) } else { 1.0 };
        worst = worst.max(distance(&plant.state(), &expected, plate.omega0) / scale);
        steps += 1;
    }
    println!("{}, {steps} steps over 60 s, quality {quality:?}, {detuning} rad/s off: {worst:.1e}", model.name());
    assert!(worst <= 1e-9, "{worst:e}");
    if quality.is_none() {
        let rest = (plant.state().w - whole.steady_state()).norm() / SETPOINT;
        println!("    distance from the steady state: {rest:.1e}");
        assert!(rest <= 1e-12, "{rest:e}");
    }
}

#[rstest]
fn splitting_an_interval_changes_nothing(#[values(Model::Linear, Model::Envelope, Model::Modal)] model: Model) {
    let plate = paper_plate();
    let mut random = Random::new(5);
    let mut worst = 0.0_f64;
    for _ in 0..200 {
        let omega = plate.omega0 + random.in_range(-5000.0, 5000.0);
        let drive = Drive { vpp: random.in_range(0.0, 800.0), omega };
        let mode = plate.mode(&Conditions { temperature_offset_k: random.in_range(0.0, 9.0), finger_force_n: 1.0 });
        let mut component = || Complex64::new(random.in_range(-2.0, 2.0), random.in_range(-2.0, 2.0));
        let mut w = component();
        let u = match model {
            Model::Linear => (w.im / w.re).into(),
            Model::Envelope => Complex64::ZERO,
            Model::Modal | Model::Carrier => (component() + Complex64::I * w) * omega,
        };
        if model == Model::Linear && w.re.abs() < 0.1 {
            w.re = 1.0;
        }
        let mut state = State { w, u };
        let flow = Flow::new(model, &mode, &drive, &state);
        let mut elapsed = 0.0;
        while elapsed < 5e-3 {
            let step = random.in_range(0.0, 2e-4);
            state = Flow::new(model, &mode, &drive, &state).after(step);
            elapsed += step;
        }
        worst = worst.max(distance(&state, &flow.after(elapsed), omega));
    }
    println!("{}, 5 ms in some 50 random pieces against one: {worst:.1e}", model.name());
    assert!(worst <= 1e-12, "{worst:e}");
}

/// Loops with equation 24 matched to the zero-order hold (2 ms, no drive limit).
#[derive(Debug, Clone, Copy)]
enum ControlLoop {
    Open,
    Closed,
}

/// Expected errors in 1/1000 of the setpoint, at the control instants and at any time.
#[rstest]
#[case::step(0.0, ControlLoop::Open, [1.83, 2.56])]
#[case::step_closed(0.0, ControlLoop::Closed, [3.44, 4.83])]
#[case::detuned(545.0, ControlLoop::Open, [1.57, 2.56])]
#[case::detuned_closed(545.0, ControlLoop::Closed, [3.01, 4.82])]
#[case::far(2000.0, ControlLoop::Open, [1.45, 2.54])]
fn the_envelope_has_the_documented_error(
    #[case] detuning: f64,
    #[case] control: ControlLoop,
    #[case] expected: [f64; 2],
) {
    let plate = paper_plate();
    let omega = plate.omega0 + detuning;
    let hold = Drive { vpp: HOLDING_DRIVE_VPP, omega };
    let (plant_pole, loop_pole) = ((-1.0_f64 / 1.88).exp(), (-1.5_f64).exp());
    let proportional = (1.0 - loop_pole) / (plate.gain * (1.0 - plant_pole));
    let mut modal = driven_plant(&plate, &constant_conditions(), Model::Modal, hold);
    let mut envelope = driven_plant(&plate, &constant_conditions(), Model::Envelope, hold);
    let mut integral = 0.0;
    let (mut at_instants, mut ever) = (0.0_f64, 0.0_f64);
    for period in 0..40 {
        if let ControlLoop::Closed = control {
            let error = SETPOINT - modal.state().w.re;
            let drive = Drive { vpp: proportional * error + integral, omega };
            integral += proportional * (1.0 - plant_pole) * error;
            modal.set_drive(drive);
            envelope.set_drive(drive);
        }
        for step in 1..=100 {
            let t = f64::from(period) + f64::from(step) / 100.0;
            let error = (state_at(&mut modal, t).w - state_at(&mut envelope, t).w).norm() / SETPOINT;
            ever = ever.max(error);
            if step == 100 {
                at_instants = at_instants.max(error);
            }
        }
    }
    let of_steady = ever * SETPOINT / modal.state().amplitude();
    println!(
        "envelope against modal, {detuning} rad/s off, {control:?}: {at_instants:.2e} at control instants, \
         {ever:.2e} ever"
    );
    println!("    {of_steady:.2e} of the steady |W|");
    for (found, expected) in [at_instants, ever].into_iter().zip(expected) {
        assert!((found / (1e-3 * expected) - 1.0).abs() < 0.02, "{found:e} instead of {expected}e-3");
    }
    if detuning == 2000.0 {
        assert!((0.9e-2..1.1e-2).contains(&of_steady), "{of_steady:e}");
    }
}

#[test]
fn u_and_not_the_derivative_of_w_is_continuous() {
    let plate = paper_plate();
    let mode = nominal_mode(&plate);
    let mut carrier = ReferencePlate::at_rest(plate.omega0);
    let (mut ours, mut theirs) = (State::default(), State::default());
    let (mut our_error, mut their_error) = (0.0_f64, 0.0_f64);
    let mut omega = plate.omega0;
    for period in 0..40 {
        let next = plate.omega0 + if period / 10 % 2 == 0 { 0.0 } else { 545.0 };
        // `theirs` keeps W' = U − jωW continuous instead of U.
        theirs.u += Complex64::I * (next - omega) * theirs.w;
        omega = next;
        let drive = Drive { vpp: HOLDING_DRIVE_VPP, omega };
        ours = Flow::new(Model::Modal, &mode, &drive, &ours).after(1e-3);
        theirs = Flow::new(Model::Modal, &mode, &drive, &theirs).after(1e-3);
        carrier.advance(1e-3, plate.force_constant(), &drive, &|_| (mode.sigma, mode.omega0));
        our_error = our_error.max((ours.w - carrier.state().w).norm() / SETPOINT);
        their_error = their_error.max((theirs.w - carrier.state().w).norm() / SETPOINT);
    }
    println!("frequency steps of 545 rad/s: {our_error:.1e} with U continuous, {their_error:.1e} with W' continuous");
    assert!(our_error <= 1e-10, "{our_error:e}");
    assert!((0.5e-3..=2e-3).contains(&their_error), "{their_error:e}");
}

#[rstest]
fn a_new_drive_does_not_change_the_state(#[values(Model::Linear, Model::Envelope, Model::Modal)] model: Model) {
    let plate = paper_plate();
    let mut plant =
        driven_plant(&plate, &conditions(3.0, 1.0), model, Drive { vpp: HOLDING_DRIVE_VPP, omega: plate.omega0 });
    let before = state_at(&mut plant, 3.0);
    plant.set_drive(Drive { vpp: 10.0, omega: plate.omega0 - 300.0 });
    assert_eq!(plant.state(), before);
    plant.advance(Time::from_ms(1.0).unwrap(), &[], &mut Vec::new());
    assert_eq!((plant.time(), plant.state()), (Time::from_ms(3.0).unwrap(), before));
}
