//! Counts how often intervals contain the true τ, with and without a finger, and the true τ2.

use crate::simulation::{STILL, scene, simulate};
use platebench_design::identify::{Estimate, fit_direct, identify};
use platebench_plate::Plate;
use platebench_test_kit::paper_plate;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use rand_distr::{Distribution, Uniform};
use rstest::rstest;
use std::f64::consts::TAU;

const RECORDINGS: u64 = 200;
const FORCES_N: [f64; 4] = [0.0, 0.5, 1.5, 2.0];

struct Draw {
    plate: Plate,
    seed: u64,
    phase: f64,
}

/// Draws a plate. `gain` and `tau` are the relative spreads of K1 and τ.
fn draw(seed: u64, noise_um: f64, [gain, tau]: [f64; 2]) -> Draw {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let mut between = |low: f64, high: f64| Uniform::new_inclusive(low, high).unwrap().sample(&mut random);
    let nominal = paper_plate();
    let plate = Plate {
        gain: nominal.gain * between(1.0 - gain, 1.0 + gain),
        sigma0: nominal.sigma0 / between(1.0 - tau, 1.0 + tau),
        omega0: nominal.omega0 + TAU * between(-50.0, 50.0),
        noise_um_rms: noise_um,
        ..nominal
    };
    Draw { plate, seed, phase: between(0.0, 1.0) }
}

/// Tests τ under a force recorded from 40 ms on, with the touch at a random time up to 1 ms before.
fn finger_case(seed: u64, noise_um: f64, force_n: f64) -> bool {
    let drawn = draw(seed, noise_um, [0.2, 0.4]);
    let scene = scene(STILL, &[(0.0, 0.0), (39.001 + 0.999 * drawn.phase, force_n)]);
    let level = |ms, _| (if ms < 5 { 0.0 } else { 300.0 }, drawn.plate.omega0);
    let recording = simulate(&drawn.plate, drawn.seed, &scene, 80, level);
    let (_, tau) = *fit_direct(&recording).unwrap().time_constants.last().unwrap();
    tau.contains(1.0 / drawn.plate.sigma0 / drawn.plate.damping_ratio_at(force_n))
}

/// Tests τ2: Wd is held at 2 µm, and the detuning falls by 77 rad/s at 40, 60 and 80 ms.
fn frequency_case(seed: u64, noise_um: f64) -> bool {
    let drawn = draw(seed, noise_um, [0.06, 0.12]);
    let omega0 = drawn.plate.omega0;
    let mut integral = 0.0;
    let recording = simulate(&drawn.plate, drawn.seed, &scene(STILL, STILL), 100, |ms, wd| {
        let error = 2.0 - wd;
        integral += 75.6 * error;
        let level = 3.0 - f64::from((ms.max(20) - 20) / 20);
        ((107.4 * error + integral).max(0.0), omega0 + 77.0 * level)
    });
    let (found, _) = identify(&[recording], None).unwrap();
    let tau2: Estimate = found.frequency_time_constant_s.unwrap();
    tau2.contains(1.0 / drawn.plate.sigma0)
}

/// Checks 0.93 to 0.97 for all cases together, and three binomial standard errors for each.
fn assert_covered(name: &str, counts: &[usize]) {
    println!("{name}: {counts:?} of {RECORDINGS}");
    let n = RECORDINGS as f64;
    let reach = 3.0 * (0.95_f64 * 0.05 / n).sqrt();
    for &count in counts {
        assert!((count as f64 / n - 0.95).abs() <= reach, "{name}: {counts:?} of {RECORDINGS}");
    }
    let share = counts.iter().sum::<usize>() as f64 / (n * counts.len() as f64);
    assert!((0.93..=0.97).contains(&share), "{name}: {share:.3} of {counts:?}");
}

fn count(cases: impl Fn(u64) -> bool, first_seed: u64) -> usize {
    (first_seed..first_seed + RECORDINGS).filter(|seed| cases(*seed)).count()
}

#[rstest]
#[case::at_8_nm(0.008, 0)]
#[case::at_32_nm(0.032, 4000)]
fn intervals_of_tau_under_a_finger_cover(#[case] noise_um: f64, #[case] first_seed: u64) {
    let seeds = (first_seed..).step_by(1000);
    let cases = FORCES_N.into_iter().zip(seeds);
    let counts: Vec<usize> =
        cases.map(|(force_n, seed)| count(|seed| finger_case(seed, noise_um, force_n), seed)).collect();
    assert_covered("τ at 0, 0.5, 1.5, 2 N", &counts);
}

#[test]
fn intervals_of_tau2_from_frequency_steps_cover() {
    let counts = [count(|seed| frequency_case(seed, 0.008), 10_000), count(|seed| frequency_case(seed, 0.032), 20_000)];
    assert_covered("τ2 at 8 nm, 32 nm", &counts);
}
