//! Checks tables and plate file from simulated recordings.

use crate::simulation::{STILL, details, scene, simulate};
use platebench_design::identified_plate::{document, plate_file};
use platebench_design::identify::identify;
use platebench_document::Style;
use platebench_model::recording::{RecordedInput, RecordedSample, Recording, RecordingError, SampleSource};
use platebench_model::trace::{Flags, Row};
use platebench_plate::{Complex64, ConditionProfiles, Conditions, Plate, RawPlate};
use platebench_test_kit::paper_plate;
use std::f64::consts::TAU;

const RESONANCE: f64 = 32_307.6;

/// `drive` computes Vpp and Hz from the time in ms and Wd.
fn simulate_recording(
    scene: &ConditionProfiles,
    samples: u32,
    mut drive: impl FnMut(u32, f64) -> (f64, f64),
) -> Recording {
    let plate = Plate { noise_um_rms: 0.004, ..paper_plate() };
    simulate(&plate, 7, scene, samples, |ms, wd| {
        let (vpp, hz) = drive(ms, wd);
        (vpp, hz * TAU)
    })
}

fn voltage_recording() -> Recording {
    let level =
        |ms: u32, _| (if ms % 40 < 20 { 0.0 } else { [120.0, 208.0, 312.0, 370.0][(ms / 40) as usize % 4] }, RESONANCE);
    simulate_recording(&scene(STILL, STILL), 160, level)
}

#[test]
fn four_levels_are_four_rows_and_linear() {
    let (found, fits) = identify(&[voltage_recording()], None).unwrap();
    let drives: Vec<f64> = found.voltage_steps.iter().map(|step| step.vpp).collect();
    assert_eq!(drives, [120.0, 208.0, 312.0, 370.0]);
    for step in &found.voltage_steps {
        for [gain, tau] in [step.least_squares.unwrap(), step.instruments.unwrap(), step.direct.unwrap()] {
            assert!((gain.value / 0.006_98 - 1.0).abs() < 0.01, "{step:?}");
            assert!((tau.value / 1.88e-3 - 1.0).abs() < 0.04, "{step:?}");
        }
    }
    assert!(found.gain_change_percent.unwrap().contains(0.0));
    assert_eq!(fits[0].curve.len(), 160);
    let text = document("plate", &found, &[]).to_console(None, Style::default());
    for printed in ["7108", "6547", "6620", "7103", "6980", "6844.5"] {
        assert!(text.contains(printed), "{printed}: {text}");
    }
}

fn amplitude_controller(hz: impl Fn(u32) -> f64) -> impl FnMut(u32, f64) -> (f64, f64) {
    let mut integral = 0.0;
    move |ms, wd| {
        let error = 2.0 - wd;
        integral += 75.6 * error;
        (183.0 * error - 75.6 * error + integral, hz(ms))
    }
}

#[test]
fn frequency_and_temperature_steps_agree() {
    let step_hz = 77.0 / TAU;
    let level = |ms: u32| 3.0 - f64::from((ms.max(20) - 20) / 20).min(6.0);
    let by_frequency =
        simulate_recording(&scene(STILL, STILL), 160, amplitude_controller(|ms| RESONANCE + step_hz * level(ms)));
    let warm: Vec<(f64, f64)> = (0..8).map(|k| (f64::from(k * 20), level(k * 20) * step_hz / 9.638)).collect();
    let by_temperature = simulate_recording(&scene(&warm, STILL), 160, amplitude_controller(|_| RESONANCE));
    for recording in [by_frequency, by_temperature] {
        let (found, _) = identify(std::slice::from_ref(&recording), None).unwrap();
        assert_eq!(found.frequency_steps.len(), 6, "{}", recording.name);
        assert!(found.voltage_steps.is_empty(), "a loop at work is no step of the voltage");
        for step in &found.frequency_steps {
            assert!((step.detuning - step.from_detuning + 77.0).abs() < 1.0, "{step:?}");
            let [gain, _] = step.instruments.unwrap();
            assert!((gain.value / 1.88e-3 - 1.0).abs() < 0.04, "{step:?}");
            assert!((step.direct.unwrap().value / 1.88e-3 - 1.0).abs() < 0.1, "{step:?}");
        }
        let [gain, tau] =
            found.frequency_steps.iter().find(|step| step.detuning.abs() < 5.0).unwrap().instruments.unwrap();
        assert!((gain.value / tau.value - 1.0).abs() < 0.08, "{gain:?} {tau:?}");
    }
}

#[test]
fn a_sweep_and_forces_complete_the_plate_file() {
    let warm = [(0.0, 0.0), (25.0, 3.0), (45.0, 6.0), (65.0, 9.0)];
    let constant = |ms: u32, _: f64| (if ms < 5 { 0.0 } else { 300.0 }, 32_264.2);
    let sweep = simulate_recording(&scene(&warm, STILL), 90, constant);
    let pressed = [(0.0, 0.0), (25.0, 0.5), (45.0, 1.5)];
    let press = |ms: u32, _: f64| (if ms < 5 { 0.0 } else { 300.0 }, RESONANCE);
    let forces = simulate_recording(&scene(STILL, &pressed), 70, press);
    let (found, _) = identify(&[voltage_recording(), sweep, forces], None).unwrap();
    assert!(found.slope_hz_per_k.unwrap().contains(-9.638), "{:?}", found.slope_hz_per_k);
    assert!((found.slope_hz_per_k.unwrap().value + 9.638).abs() < 0.1);
    let named = details("mine \"one\"");
    let text = plate_file(&found, &named).unwrap();
    let plate = toml::from_str::<RawPlate>(&text).unwrap().check().unwrap();
    assert_eq!((plate.name.as_str(), plate.drive_limit_vpp), ("mine \"one\"", 370.0));
    assert!((plate.gain / 0.006_98 - 1.0).abs() < 3e-3 && (plate.sigma0 * 1.88e-3 - 1.0).abs() < 0.01, "{text}");
    assert!((plate.omega0 / TAU - RESONANCE).abs() < 0.5 && (plate.noise_um_rms - 0.004).abs() < 5e-4, "{text}");
    assert!((plate.damping_ratio_at(1.5) - 2.0).abs() < 0.03 && (plate.damping_ratio_at(0.5) - 4.0 / 3.0).abs() < 0.02);
    let uncertainties = [
        (found.gain_um_per_vpp.unwrap(), plate.uncertainty.gain_percent.unwrap()),
        (found.time_constant_s.unwrap(), plate.uncertainty.time_constant_percent.unwrap()),
    ];
    for (estimate, percent) in uncertainties {
        let reach = estimate.value * percent / 100.0;
        assert!(
            estimate.low >= estimate.value - reach && estimate.high <= estimate.value + reach,
            "{estimate:?} {percent}"
        );
        let hair = estimate.value * 0.011 / 100.0;
        assert!(
            estimate.low < estimate.value - reach + hair || estimate.high > estimate.value + reach - hair,
            "{estimate:?} {percent}"
        );
    }
}

#[test]
fn a_trace_gives_the_samples_of_the_controller() {
    let row = |step: u32| Row {
        t_s: f64::from(step) * 5e-4,
        wd_um: 1.0,
        sensed_wd_um: 1.1,
        wq_um: -0.5,
        sensed_wq_um: -0.6,
        drive_vpp: if step < 7 { 0.0 } else { 300.0 },
        frequency_hz: RESONANCE,
        // Every second row is a control instant. In row 8 the sample did not arrive.
        flags: match step {
            8 => Flags::CONTROL | Flags::LINK_LOST,
            step if step.is_multiple_of(2) => Flags::CONTROL,
            _ => Flags::empty(),
        },
        ..Row::default()
    };
    let rows: Vec<Row> = (0..30).map(row).collect();
    let given = Recording::from_trace(String::new(), &rows, SampleSource::Sensed).unwrap();
    let own = Recording::from_trace(String::new(), &rows, SampleSource::True).unwrap();
    assert_eq!((given.outputs.len(), own.outputs.len()), (14, 14));
    assert!(given.outputs.iter().all(|output| (output.w.re, output.w.im) == (1.1, -0.6) && output.t != 4e-3));
    assert_eq!((own.outputs[3].w.re, own.outputs[3].w.im), (1.0, -0.5));
    assert_eq!(
        given.inputs.iter().map(|input| input.t).collect::<Vec<_>>(),
        [0.0, 3.5e-3],
        "between control instants, too"
    );
    let output = |number: u32| RecordedSample { t: f64::from(number), w: Complex64::ZERO };
    let long = |count: u32| Recording::new(String::new(), given.inputs.clone(), (0..count).map(output).collect());
    assert!(long(100_000).is_ok());
    assert_eq!(long(100_001).unwrap_err(), RecordingError::TooLong(100_001));
}

#[test]
fn parameters_without_evidence_stay_empty() {
    // The plate is always 3 K warm. Without a slope, the resonance at 0 K is unknown.
    let level = |ms: u32, _: f64| (if ms < 5 { 0.0 } else { 300.0 }, RESONANCE);
    let warm = simulate_recording(&scene(&[(0.0, 3.0)], STILL), 40, level);
    let named = details("");
    let (found, _) = identify(std::slice::from_ref(&warm), None).unwrap();
    assert_eq!((found.resonance_hz, plate_file(&found, &named)), (None, None));
    let (found, _) = identify(&[warm], Some(-9.638)).unwrap();
    assert!((found.resonance_hz.unwrap().value - RESONANCE).abs() < 0.5);
    // W is constant, so it gives two numbers for three unknown parameters.
    let whole = simulate_recording(&scene(STILL, STILL), 80, |_, _| (300.0, RESONANCE));
    assert_eq!(identify(&[whole.slice(50, 80).unwrap()], None).unwrap_err(), RecordingError::Undetermined);
    let jumping = |held: u32| {
        let mut inputs = whole.inputs.clone();
        let warm = Conditions { temperature_offset_k: 1.0, finger_force_n: 0.0 };
        inputs.push(RecordedInput { t: f64::from(80 - held) * 1e-3, conditions: warm, ..inputs[0] });
        Recording::new(String::new(), inputs, whole.outputs.clone())
    };
    assert_eq!((jumping(4).unwrap_err(), jumping(5).is_ok()), (RecordingError::VaryingConditions, true));
    let ramp = (0..90).map(|ms| (ms, f64::from(ms) * 0.1)).collect::<Vec<_>>();
    let inputs: Vec<RecordedInput> = ramp
        .iter()
        .map(|&(ms, kelvin)| RecordedInput {
            t: f64::from(ms) * 1e-3,
            vpp: 300.0,
            omega: RESONANCE * TAU,
            conditions: Conditions { temperature_offset_k: kelvin, finger_force_n: 0.0 },
        })
        .collect();
    assert_eq!(Recording::new(String::new(), inputs, whole.outputs).unwrap_err(), RecordingError::VaryingConditions);
}
