//! Checks the coverage of intervals over random plates, and that the check detects wrong intervals.

use crate::simulation::{STILL, scene, simulate};
use platebench_design::identify::{ArxMethod, Estimate, arx, fit_direct, identify};
use platebench_model::recording::Recording;
use platebench_plate::{ConditionProfiles, Conditions, Plate};
use platebench_test_kit::paper_plate;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use rand_distr::{Distribution, Uniform};
use std::f64::consts::TAU;

const PLATES: u64 = 300;
/// Low noise in µm: 0.1 to 1 % of 2 µm.
const LOW_NOISE_UM: [f64; 2] = [0.002, 0.02];
/// High noise in µm: 2.5 to 10 % of 2 µm. Least squares then have a visible bias.
const HIGH_NOISE_UM: [f64; 2] = [0.05, 0.2];

struct RandomPlate {
    plate: Plate,
    omega: f64,
    seed: u64,
}

fn random_plate(seed: u64, farthest_hz: f64, noise_um: [f64; 2]) -> RandomPlate {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let mut between = |low: f64, high: f64| Uniform::new_inclusive(low, high).unwrap().sample(&mut random);
    let nominal = paper_plate();
    let plate = Plate {
        gain: nominal.gain * between(0.8, 1.2),
        sigma0: 1e3 / between(1.0, 3.0),
        omega0: nominal.omega0 + TAU * between(-50.0, 50.0),
        noise_um_rms: between(noise_um[0], noise_um[1]),
        ..nominal
    };
    let omega = plate.omega0 + TAU * between(-farthest_hz, farthest_hz);
    RandomPlate { plate, omega, seed }
}

/// `levels` are pairs of start time in ms and drive in Vpp.
fn simulate_recording(drawn: &RandomPlate, levels: &[[f64; 2]], scene: &ConditionProfiles, samples: u32) -> Recording {
    simulate(&drawn.plate, drawn.seed, scene, samples, |ms, _| {
        let level = levels.iter().rev().find(|level| level[0] <= f64::from(ms)).unwrap();
        (level[1], drawn.omega)
    })
}

fn check_coverage(results: &[(Estimate, f64)]) -> Result<(), String> {
    let count = results.len() as f64;
    let covered = results.iter().filter(|(estimate, truth)| estimate.contains(*truth)).count() as f64 / count;
    let scores: Vec<f64> = results.iter().map(|(estimate, truth)| (estimate.value - truth) / estimate.error).collect();
    let bias = scores.iter().sum::<f64>() / count;
    // Three binomial standard errors around 95 %, and three standard errors 1/√n of the mean score.
    let reach = 3.0 * (0.95_f64 * 0.05 / count).sqrt();
    if (covered - 0.95).abs() > reach {
        return Err(format!("{:.1} % covered", covered * 100.0));
    }
    if bias.abs() > 3.0 / count.sqrt() {
        return Err(format!("biased by {bias:.2} standard errors"));
    }
    Ok(())
}

fn scale_intervals(results: &[(Estimate, f64)], factor: f64) -> Vec<(Estimate, f64)> {
    let half = |estimate: &Estimate| Estimate {
        low: estimate.value + (estimate.low - estimate.value) * factor,
        high: estimate.value + (estimate.high - estimate.value) * factor,
        ..*estimate
    };
    results.iter().map(|(estimate, truth)| (half(estimate), *truth)).collect()
}

const LEVELS: [[f64; 2]; 4] = [[0.0, 0.0], [2.0, 300.0], [22.0, 150.0], [40.0, 0.0]];

#[test]
fn direct_fit_intervals_cover_random_plates() {
    let (mut gain, mut time_constant, mut resonance, mut white) = (Vec::new(), Vec::new(), Vec::new(), 0);
    for seed in 0..PLATES {
        let drawn = random_plate(seed, 80.0, LOW_NOISE_UM);
        let fit = fit_direct(&simulate_recording(&drawn, &LEVELS, &scene(STILL, STILL), 50)).unwrap();
        gain.push((fit.gain, drawn.plate.gain));
        time_constant.push((fit.time_constant().unwrap(), 1.0 / drawn.plate.sigma0));
        resonance.push((fit.resonances[0].1, drawn.plate.omega0));
        white += u64::from(!fit.whiteness.unwrap().is_rejected());
    }
    for (name, results) in [("K1", &gain), ("τ", &time_constant), ("ω0", &resonance)] {
        check_coverage(results).unwrap_or_else(|fault| panic!("{name}: {fault}"));
        for factor in [0.5, 2.0] {
            assert!(
                check_coverage(&scale_intervals(results, factor)).is_err(),
                "{name}: intervals times {factor} pass"
            );
        }
    }
    // The test rejects 1 % of white residuals: 3 of 300, with a standard error of 1.7.
    assert!(white >= PLATES - 13, "{white} of {PLATES} white");
}

#[test]
fn instrumental_variables_cover_under_high_noise() {
    let (mut by_squares, mut by_instruments) = (Vec::new(), Vec::new());
    let levels: Vec<[f64; 2]> = (0..20).map(|k| [f64::from(k) * 10.0, f64::from(k % 2) * 300.0]).collect();
    for seed in 1000..1000 + PLATES {
        let drawn = random_plate(seed, 0.0, HIGH_NOISE_UM);
        let recording = simulate_recording(&drawn, &levels, &scene(STILL, STILL), 200);
        let wd: Vec<f64> = recording.outputs.iter().map(|output| output.w.re).collect();
        let drive: Vec<f64> = recording.inputs_at_samples().iter().map(|input| input.vpp).collect();
        let by = |method| arx(&wd, std::slice::from_ref(&drive), 1e-3, method).unwrap().time_constant;
        by_squares.push((by(ArxMethod::LeastSquares), 1.0 / drawn.plate.sigma0));
        by_instruments.push((by(ArxMethod::InstrumentalVariables), 1.0 / drawn.plate.sigma0));
    }
    check_coverage(&by_instruments).unwrap();
    assert!(check_coverage(&scale_intervals(&by_instruments, 0.5)).is_err());
    check_coverage(&by_squares).unwrap_err();
    let short = by_squares.iter().filter(|(estimate, truth)| estimate.value < *truth).count();
    assert!(short > 200, "noise makes the time constant of least squares too short, here in {short} of {PLATES}");
}

#[test]
fn effects_of_temperature_and_force_are_separated() {
    let scene = scene(&[(0.0, 0.0), (40.0, 3.0), (60.0, 6.0), (80.0, 0.0)], &[(0.0, 0.0), (80.0, 0.5), (110.0, 1.5)]);
    let (mut warm, mut slopes, mut halves) = (Vec::new(), Vec::new(), Vec::new());
    for seed in 2000..2000 + PLATES {
        let drawn = random_plate(seed, 20.0, LOW_NOISE_UM);
        let levels = [[0.0, 0.0], [2.0, 300.0], [22.0, 150.0], [40.0, 300.0]];
        let (found, fits) = identify(&[simulate_recording(&drawn, &levels, &scene, 140)], None).unwrap();
        let fit = &fits[0];
        let at = |kelvin: f64| {
            let level = |conditions: &Conditions| conditions.temperature_offset_k == kelvin;
            fit.resonances.iter().find(|(conditions, _)| level(conditions)).unwrap().1
        };
        warm.push((at(6.0), drawn.plate.omega0 + 6.0 * drawn.plate.omega0_per_k));
        slopes.push((found.slope_hz_per_k.unwrap(), drawn.plate.omega0_per_k / TAU));
        let (force, ratio) = *fit.damping.last().unwrap();
        assert_eq!(force, 1.5);
        halves.push((ratio, 2.0));
    }
    for (name, results) in [("resonance", &warm), ("slope", &slopes), ("damping", &halves)] {
        check_coverage(results).unwrap_or_else(|fault| panic!("{name}: {fault}"));
        assert!(check_coverage(&scale_intervals(results, 0.5)).is_err(), "{name}: halved intervals pass");
    }
}
