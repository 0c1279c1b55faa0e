//! Checks that recordings that no single plate can produce are reported, and clean ones are not.

use crate::simulation::details;
use platebench_design::identified_plate::plate_file;
use platebench_design::identify::{Identification, Inconsistency, identify};
use platebench_model::recording::{RecordedInput, RecordedSample, Recording};
use platebench_plate::{Complex64, Conditions, Drive, Flow, Mode, Model, Sensor, State};
use rstest::rstest;

const OMEGA0: f64 = 202_995.0;
const SIGMA0: f64 = 532.0;
const GAIN: f64 = 0.00698;
const NOISE_UM: f64 = 0.004;

#[derive(Clone, Copy, Default)]
struct Defect {
    /// Relative increase of the damping per µm of amplitude.
    damping_per_um: f64,
    /// Change of the resonance during the capture, rad/s.
    drift: f64,
    clip_um: Option<f64>,
    swapped: bool,
    time_factor: Option<f64>,
    /// Factor from a wrong unit of W.
    amplitude_factor: Option<f64>,
    /// Excitation above the resonance, rad/s; default: 190.
    detuning: Option<f64>,
}

/// Records steps from 0 V to 100, 200, 300 and 400 Vpp at 1 kHz, 30 Hz above the resonance.
fn capture(defect: Defect, seed: u64) -> Recording {
    let omega = OMEGA0 + defect.detuning.unwrap_or(190.0);
    let mut sensor = Sensor::new(1.0, NOISE_UM, seed);
    let mut state = State::default();
    let (mut inputs, mut outputs) = (Vec::new(), Vec::new());
    let levels = [0.0, 100.0, 0.0, 200.0, 0.0, 300.0, 0.0, 400.0];
    let samples = 40 * levels.len();
    for sample in 0..samples {
        let t = sample as f64 * 1e-3 * defect.time_factor.unwrap_or(1.0);
        let mut w = sensor.measure(state.w);
        if let Some(limit) = defect.clip_um {
            w = Complex64::new(w.re.clamp(-limit, limit), w.im.clamp(-limit, limit));
        }
        if defect.swapped {
            w = Complex64::new(w.im, w.re);
        }
        w *= defect.amplitude_factor.unwrap_or(1.0);
        let vpp = levels[sample / 40];
        inputs.push(RecordedInput { t, vpp, omega, conditions: Conditions::default() });
        outputs.push(RecordedSample { t, w });
        for step in 0..20 {
            let share = (sample as f64 + f64::from(step) / 20.0) / samples as f64;
            let mode = Mode {
                sigma: SIGMA0 * (1.0 + defect.damping_per_um * state.amplitude()),
                omega0: OMEGA0 + defect.drift * share,
                force_constant: GAIN * 2.0 * SIGMA0 * OMEGA0,
                envelope_constant: GAIN * SIGMA0,
            };
            state = Flow::new(Model::Modal, &mode, &Drive { vpp, omega }, &state).after(5e-5);
        }
    }
    Recording::new(format!("capture {seed}"), inputs, outputs).unwrap()
}

fn identified(defect: Defect) -> Identification {
    let recordings: Vec<Recording> = (1..=3).map(|seed| capture(defect, seed)).collect();
    identify(&recordings, None).unwrap().0
}

#[test]
fn a_clean_capture_is_not_doubtful() {
    let found = identified(Defect::default());
    assert_eq!(found.inconsistencies, []);
    assert!(found.gain_um_per_vpp.unwrap().contains(GAIN) && found.time_constant_s.unwrap().contains(1.0 / SIGMA0));
}

#[rstest]
#[case::clipped(Defect { clip_um: Some(2.0), ..Defect::default() },
    |found: &Inconsistency| matches!(found, Inconsistency::Clipped { component: "Wd", .. }))]
#[case::swapped(Defect { swapped: true, ..Defect::default() },
    |found: &Inconsistency| matches!(found, Inconsistency::Swapped { .. }))]
#[case::seconds_for_milliseconds(Defect { time_factor: Some(1e3), ..Defect::default() },
    |found: &Inconsistency| matches!(found, Inconsistency::Implausible { quantity: "time constant", .. }))]
#[case::nanometres_for_micrometres(Defect { amplitude_factor: Some(1e3), ..Defect::default() },
    |found: &Inconsistency| matches!(found, Inconsistency::Implausible { quantity: "gain K1", .. }))]
#[case::swapped_at_the_resonance(Defect { swapped: true, detuning: Some(5.0), ..Defect::default() },
    |found: &Inconsistency| matches!(found, Inconsistency::Swapped { .. }))]
#[case::damping_grows_with_the_amplitude(Defect { damping_per_um: 0.05, ..Defect::default() },
    |found: &Inconsistency| matches!(found, Inconsistency::Residuals { .. }))]
#[case::resonance_drifts(Defect { drift: -120.0, ..Defect::default() },
    |found: &Inconsistency| matches!(found, Inconsistency::Residuals { .. }))]
fn a_capture_that_no_single_plate_produces_is_doubtful(
    #[case] defect: Defect,
    #[case] expected: fn(&Inconsistency) -> bool,
) {
    let found = identified(defect);
    assert!(found.inconsistencies.iter().any(expected), "{:?}", found.inconsistencies);
    assert_eq!(found.second_mode, None);
}

/// No direct fit describes these columns. A fit with a rotation does.
#[test]
fn exchanged_columns_far_from_the_resonance_are_doubtful() {
    let recording = capture(Defect { swapped: true, detuning: Some(-545.0), ..Defect::default() }, 1);
    let (found, _) = identify(&[recording], None).unwrap();
    let [Inconsistency::Swapped { text, .. }] = &found.inconsistencies[..] else {
        panic!("{:?}", found.inconsistencies)
    };
    assert!(text.contains("Check the columns of wd and wq"), "{text}");
    assert!((found.gain_um_per_vpp.unwrap().value / GAIN - 1.0).abs() < 0.01, "{:?}", found.gain_um_per_vpp);
}

#[test]
fn a_doubtful_plate_file_states_the_reasons_and_has_wider_intervals() {
    let found = identified(Defect { damping_per_um: 0.05, ..Defect::default() });
    let text = plate_file(&found, &details("plate")).unwrap();
    assert!(text.starts_with("# DOUBTFUL: 3 of 3 recordings have residuals that are not white"), "{text}");
    assert!(text.contains("[uncertainty]    # doubtful: at least 25 %"), "{text}");
    let percent = |key: &str| -> f64 {
        let line = text.lines().find(|line| line.starts_with(key)).unwrap();
        line.split(" = ").nth(1).unwrap().parse().unwrap()
    };
    let (tau, gain) = (found.time_constant_s.unwrap(), found.gain_um_per_vpp.unwrap());
    for (value, reach, truth) in [
        (tau.value, percent("time_constant_percent"), 1.0 / SIGMA0 / 1.05),
        (gain.value, percent("gain_percent"), GAIN / 1.05),
    ] {
        assert!((value / truth - 1.0).abs() * 100.0 <= reach, "{value} ± {reach} %, {truth}");
    }
    toml::from_str::<platebench_plate::RawPlate>(&text).unwrap().check().unwrap();
}
