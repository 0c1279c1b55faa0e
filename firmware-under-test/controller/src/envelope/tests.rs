//! Compares the f32 polynomial, identification and steering with the envelope in f64.

use super::*;
use proptest::prelude::*;
use std::vec::Vec;

const K1: f32 = 0.00698;
const TAU: f32 = 1.88e-3;
const PERIOD: f32 = 1e-3;
const RANGE: f32 = 1570.8;

fn envelope() -> EnvelopeModel {
    EnvelopeModel::new(K1, TAU, RANGE, PERIOD)
}

fn bounds() -> DriveBounds {
    DriveBounds { limit_vpp: 900.0, lowest_offset: -RANGE, highest_offset: RANGE }
}

fn reference_exponentials(re: f64, im: f64) -> [(f64, f64); 2] {
    let (growth, (sin, cos)) = (libm::exp(re), (libm::sin(im), libm::cos(im)));
    let exp = (growth * cos, growth * sin);
    let (a, b, squared) = (exp.0 - 1.0, exp.1, re * re + im * im);
    let phi = if squared == 0.0 { (1.0, 0.0) } else { ((a * re + b * im) / squared, (b * re - a * im) / squared) };
    [exp, phi]
}

/// `force` is b in µm/s per Vpp, `sigma` in 1/s, `detuning` Δω in rad/s.
pub(crate) fn reference_propagation(
    w: (f64, f64),
    force: f64,
    sigma: f64,
    detuning: f64,
    vpp: f64,
    seconds: f64,
) -> (f64, f64) {
    let [exp, phi] = reference_exponentials(-sigma * seconds, -detuning * seconds);
    let push = force * vpp * seconds;
    (exp.0 * w.0 - exp.1 * w.1 + phi.0 * push, exp.0 * w.1 + exp.1 * w.0 + phi.1 * push)
}

fn distance(a: Complex, b: (f64, f64)) -> f64 {
    (f64::from(a.re) - b.0).hypot(f64::from(a.im) - b.1)
}

#[test]
fn the_polynomial_is_the_exponential() {
    // The model halves z = λh four times. The grid contains the largest |z| for this.
    assert_eq!(envelope().doublings, 4);
    let mut worst = 0.0_f64;
    for (re, im) in (0..=40).flat_map(|r| (-30..=30).map(move |i| (f64::from(r) * -0.08, f64::from(i) * 0.1))) {
        let growth = Exponentials::of(Complex::new(re as f32, im as f32), 4);
        let [exp, phi] = reference_exponentials(f64::from(re as f32), f64::from(im as f32));
        worst = worst.max(distance(growth.exp, exp)).max(distance(growth.phi, phi));
        let [_, (a, b)] = reference_exponentials(re + 1e-4, im);
        let [_, (c, d)] = reference_exponentials(re - 1e-4, im);
        let slope = ((a - c) / 2e-4, (b - d) / 2e-4);
        assert!(distance(growth.slope, slope) < 1e-3, "φ'({re}, {im}): {:?} instead of {slope:?}", growth.slope);
    }
    assert!(worst < 2e-6, "{worst}");
}

#[test]
fn long_periods_get_enough_doublings() {
    for period in [1e-5_f32, 1e-4, 1e-2, 0.1] {
        let envelope = EnvelopeModel::new(K1, TAU, RANGE, period);
        let untouched = Exponentials::of(Complex::new(-period / TAU, 0.0), envelope.doublings);
        let [exp, phi] = reference_exponentials(f64::from(-period / TAU), 0.0);
        assert!(
            distance(untouched.exp, exp) < 1e-4 && distance(untouched.phi, phi) < 1e-4,
            "{period} s: {untouched:?}"
        );
    }
}

#[test]
fn the_larger_root_is_the_drive() {
    // |0.5 + 0.01 V| = 2 has the roots V = 150 and −250.
    assert!((drive_to(Complex::new(0.5, 0.0), Complex::new(0.01, 0.0), 2.0) - 150.0).abs() < 1e-3);
    assert!(drive_to(Complex::new(2.5, 0.0), Complex::new(0.01, 0.0), 2.0) < 0.0);
    assert_eq!(drive_to(Complex::new(0.5, 0.0), Complex::default(), 2.0), 0.0);
}

#[test]
fn a_plate_at_rest_does_not_change_the_mode() {
    let envelope = envelope();
    let mode = envelope.nominal(12.0);
    let drives = [(Drive::default(), PERIOD), (Drive::default(), 0.0)];
    assert_eq!(envelope.identify(mode, Complex::default(), drives, Complex::default()), mode);
}

#[test]
fn any_sample_leaves_the_mode_in_its_range() {
    let envelope = envelope();
    let wild: Vec<f32> = std::vec![-1e9, -3.0, 0.0, 1e-3, 5.0, 1e9];
    for (&re, &im) in wild.iter().flat_map(|re| wild.iter().map(move |im| (re, im))) {
        let drives = [(Drive { vpp: 700.0, offset: 0.0 }, PERIOD), (Drive::default(), 0.0)];
        let mode = envelope.identify(envelope.nominal(0.0), Complex::default(), drives, Complex::new(re, im));
        assert!(mode.sigma >= 1.0 / TAU / 6.1 && mode.sigma <= 6.1 / TAU, "{re} {im}: {mode:?}");
        assert!(mode.resonance.abs() <= RANGE, "{re} {im}: {mode:?}");
    }
}

proptest! {
    #[test]
    fn one_sample_gives_the_mode(
        damping in 0.8_f64..3.0, detuning in -1000.0_f64..1000.0, vpp in 200.0_f64..900.0, late in 0.0_f64..0.6,
    ) {
        let envelope = envelope();
        let (force, sigma) = (f64::from(envelope.force), damping / f64::from(TAU));
        let seconds = f64::from(PERIOD) * (1.0 - late);
        let (re, im) = reference_propagation((0.0, 0.0), force, sigma, detuning, vpp, seconds);
        let drive = Drive { vpp: vpp as f32, offset: 0.0 };
        let drives = [(Drive::default(), PERIOD - seconds as f32), (drive, seconds as f32)];
        let w = Complex::new(re as f32, im as f32);
        let mode = envelope.identify(envelope.nominal(0.0), Complex::default(), drives, w);
        prop_assert!((f64::from(mode.sigma) / sigma - 1.0).abs() < 2e-4, "σ {} instead of {sigma}", mode.sigma);
        prop_assert!((f64::from(mode.resonance) + detuning).abs() < 0.2, "{} instead of {}", mode.resonance, -detuning);
    }

    #[test]
    fn an_early_end_gives_the_same_mode(
        damping in 0.8_f64..3.0, detuning in -1000.0_f64..1000.0, vpp in 200.0_f64..900.0,
    ) {
        let envelope = envelope();
        let (force, sigma) = (f64::from(envelope.force), damping / f64::from(TAU));
        let (re, im) = reference_propagation((1.0, 0.5), force, sigma, detuning, vpp, f64::from(PERIOD));
        let drives = [(Drive::default(), 0.0), (Drive { vpp: vpp as f32, offset: 0.0 }, PERIOD)];
        let (before, after) = (Complex::new(1.0, 0.5), Complex::new(re as f32, im as f32));
        let mut mode = envelope.nominal(0.0);
        for _ in 0..3 {
            let all = (0..ITERATIONS).fold(mode, |mode, _| envelope.newton_step(mode, before, drives, after));
            mode = envelope.identify(mode, before, drives, after);
            let bits = |mode: PlateMode| [mode.sigma, mode.resonance].map(f32::to_bits);
            prop_assert_eq!(bits(mode), bits(all));
        }
    }

    #[test]
    fn steering_ends_on_the_setpoint(
        damping in 0.8_f64..2.4, resonance in -600.0_f32..600.0, wd in 1.0_f64..2.0, wq in -0.6_f64..0.6,
    ) {
        let envelope = envelope();
        let mode = PlateMode { sigma: (damping / f64::from(TAU)) as f32, resonance };
        let w = Complex::new(wd as f32, wq as f32);
        let aim = envelope.steer(mode, w, 2.0, &bounds(), PERIOD);
        let detuning = f64::from(aim.drive.offset) - f64::from(resonance);
        let [force, sigma, vpp, period] = [envelope.force, mode.sigma, aim.drive.vpp, PERIOD].map(f64::from);
        let reached = reference_propagation((wd, wq), force, sigma, detuning, vpp, period);
        prop_assert!(distance(aim.end, reached) < 1e-5);
        prop_assert!((reached.0.hypot(reached.1) - 2.0).abs() < 1e-5, "{reached:?} with {:?}", aim.drive);
        prop_assert!(reached.1.abs() < 2e-3, "{reached:?} with {:?}", aim.drive);
    }

    #[test]
    fn steering_keeps_to_its_bounds(
        limit in 50.0_f32..900.0,
        slew in 1.0_f32..300.0,
        wd in -2.5_f32..2.5,
        wq in -2.5_f32..2.5,
        target in 0.1_f32..3.0,
    ) {
        let envelope = envelope();
        let bounds = DriveBounds { limit_vpp: limit, lowest_offset: -slew, highest_offset: slew };
        let aim = envelope.steer(envelope.nominal(300.0), Complex::new(wd, wq), target, &bounds, PERIOD);
        prop_assert!((0.0..=limit).contains(&aim.drive.vpp));
        prop_assert!(aim.drive.offset.abs() <= slew);
        if aim.drive.vpp > 0.0 && aim.drive.vpp < limit && wd > 0.0 && wq.abs() < wd {
            prop_assert!((aim.end.norm() - target).abs() < 1e-3 * target, "{:?}", aim.end);
        }
    }
}
