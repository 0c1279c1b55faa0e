//! The bound on a tier's error holds whatever the drives do, and is no wider than it has to be.

use crate::reference::{HOLD, Random, SETPOINT, calm, driven, paper_plate, surroundings};
use platebench_plate::{Beforehand, Complex64, Drive, Plant, Plate, Profile, Scene, Tier, Time};
use std::f64::consts::TAU;

/// What is known of a plate that has `scene` around it and at most `drive_vpp` on it.
fn known(plate: &Plate, scene: &Scene, detuning: f64, drive_vpp: f64, drive_swing_vpp: f64) -> Beforehand {
    let sigma = plate.sigma_within(scene.finger_force_n.range());
    let (cold, warm) = scene.temperature_offset_k.range();
    let [a, b] = [cold, warm].map(|kelvin| plate.omega0 + plate.omega0_per_k * kelvin);
    let (per_n, per_k) = plate.pole_sensitivity();
    let push_um = plate.gain * plate.sigma0 * drive_vpp / sigma.0;
    Beforehand {
        sigma,
        omega0: (a.min(b), a.max(b)),
        reference_omega0: plate.omega0,
        envelope_constant: plate.gain * plate.sigma0,
        detuning,
        amplitude_um: push_um,
        push_um,
        drive_vpp,
        drive_swing_vpp,
        pole_swing: per_n * scene.finger_force_n.decayed_variation(sigma.0, false)
            + per_k * scene.temperature_offset_k.decayed_variation(sigma.0, false),
        varies: scene.finger_force_n.varies() || scene.temperature_offset_k.varies(),
        sensor_latency_s: 0.0,
        sensor_error_um: 0.0,
    }
}

/// The largest |ΔW| in µm between `tier` and the modal plate at any of a fine grid of times, under the same drives, one per millisecond.
fn measured(plate: &Plate, scene: &Scene, tier: Tier, drives: &[Drive]) -> f64 {
    let mut plants = [tier, Tier::Modal].map(|tier| Plant::new(plate.clone(), scene.clone(), tier));
    let mut worst = 0.0_f64;
    for (period, drive) in (0_u64..).zip(drives) {
        for plant in &mut plants {
            plant.set_drive(*drive);
        }
        // 3.7 µs apart: some four points per turn of the ripple, at ever other phases.
        for step in (1..=270).map(|step| step * 3_703).chain([1_000_000]) {
            let end = Time::from_nanos(period * 1_000_000 + step.min(1_000_000));
            for plant in &mut plants {
                plant.advance(end, &[], &mut Vec::new());
            }
            worst = worst.max((plants[0].state().w - plants[1].state().w).norm());
        }
    }
    worst
}

#[test]
fn a_step_at_resonance_uses_most_of_the_bound() {
    let (plate, scene) = (paper_plate(), calm());
    let drives = [Drive { vpp: HOLD, omega: plate.omega0 }; 20];
    let known = known(&plate, &scene, 0.0, HOLD, HOLD);
    for tier in [Tier::Envelope, Tier::Linear] {
        let (bound, error) = (known.error(tier), measured(&plate, &scene, tier, &drives));
        println!("{}: {:.2e} of the setpoint, bound {:.2e}", tier.name(), error / SETPOINT, bound / SETPOINT);
        assert!(error <= bound, "{error} {bound}");
        assert!(error > 0.55 * bound, "a bound of twice that would choose dearer than it must: {error} {bound}");
    }
}

#[test]
fn no_drive_and_no_surroundings_break_the_bound() {
    let mut random = Random::new(21);
    let mut closest = [0.0_f64; 2];
    for case in 0..60 {
        let mut plate = paper_plate();
        plate.sigma0 = 1e3 / random.between(0.8, 4.0);
        let period_s = 1e-3;
        let scene = match case % 4 {
            0 => surroundings(0.0, 0.0),
            1 => surroundings(random.between(-15.0, 15.0), random.between(0.0, 3.0)),
            2 => Scene {
                temperature_offset_k: Profile::constant(random.between(-10.0, 10.0)),
                finger_force_n: Profile::Hold(
                    (0..8).map(|point| (Time::from_nanos(point * 4_300_000), random.between(0.0, 2.0))).collect(),
                ),
            },
            _ => Scene {
                temperature_offset_k: Profile::Linear(vec![
                    (Time::ZERO, 0.0),
                    (Time::from_nanos(20_000_000), random.between(-9.0, 9.0)),
                ]),
                finger_force_n: Profile::Sine {
                    mean: 1.0,
                    amplitude: 0.9,
                    omega: TAU * random.between(2.0, 200.0),
                    phase: 0.0,
                },
            },
        };
        let limit = random.between(50.0, 900.0);
        let (spread, off) = (random.between(0.0, 2_000.0), random.between(-300.0, 300.0));
        let drives: Vec<Drive> = (0..30)
            .map(|_| Drive {
                vpp: random.between(0.0, limit),
                omega: plate.omega0 + off + random.between(-spread, spread),
            })
            .collect();
        let sigma = plate.sigma_within(scene.finger_force_n.range()).0;
        let (cold, warm) = scene.temperature_offset_k.range();
        let warmed = plate.omega0_per_k.abs() * cold.abs().max(warm.abs());
        let swing = limit / (1.0 - (-sigma * period_s).exp());
        let known = known(&plate, &scene, spread + off.abs() + warmed, limit, swing);
        for (closest, tier) in closest.iter_mut().zip([Tier::Envelope, Tier::Linear]) {
            let (bound, error) = (known.error(tier), measured(&plate, &scene, tier, &drives));
            assert!(error <= bound, "case {case}, {}: {error} µm, bound {bound} µm", tier.name());
            *closest = closest.max(error / bound);
        }
    }
    println!(
        "60 random plates: at most {:.2} of the envelope's bound is used, {:.2} of the linear tier's",
        closest[0], closest[1]
    );
    assert!(closest.iter().all(|share| *share > 0.1), "{closest:?}");
}

/// A fixed detuning, where the linear tier leaves out what the envelope has.
#[test]
fn the_linear_tier_is_good_at_resonance_alone() {
    let (plate, scene) = (paper_plate(), calm());
    for off in [1.0, 10.0, 100.0, 545.0, -545.0] {
        let drives = [Drive { vpp: HOLD, omega: plate.omega0 + off }; 20];
        let known = known(&plate, &scene, f64::abs(off), HOLD, HOLD);
        let (bound, error) = (known.error(Tier::Linear), measured(&plate, &scene, Tier::Linear, &drives));
        println!("{off} rad/s: {:.2e} of the setpoint, bound {:.2e}", error / SETPOINT, bound / SETPOINT);
        assert!(error <= bound && error > 0.1 * bound, "{off} rad/s: {error} {bound}");
    }
}

/// A mean over the last carrier periods against W itself: what a tier without a demodulator leaves out.
#[test]
fn a_demodulator_is_late_by_no_more_than_its_bound() {
    let (plate, scene) = (paper_plate(), calm());
    for periods in [1.0, 4.0] {
        let seconds = periods * TAU / plate.omega0;
        let drive = Drive { vpp: HOLD, omega: plate.omega0 };
        let mut plant = driven(&plate, &scene, Tier::Modal, drive);
        let (steps, mut seen) = (64, Vec::new());
        let mut worst = 0.0_f64;
        for step in 1..=64 * 60 {
            plant.advance(
                Time::from_seconds(seconds * f64::from(step) / f64::from(steps)).unwrap(),
                &[],
                &mut Vec::new(),
            );
            seen.push(plant.state().w);
            if let Some(last) = seen.len().checked_sub(steps as usize).and_then(|from| seen.get(from..)) {
                let mean: Complex64 = last.iter().sum::<Complex64>() / f64::from(steps);
                worst = worst.max((mean - plant.state().w).norm());
            }
        }
        let known = Beforehand { sensor_latency_s: seconds / 2.0, ..known(&plate, &scene, 0.0, HOLD, HOLD) };
        let bound = known.error(Tier::Modal);
        println!(
            "lock-in of {periods} periods: {:.2e} of the setpoint, bound {:.2e}",
            worst / SETPOINT,
            bound / SETPOINT
        );
        assert!(worst <= bound, "{worst} {bound}");
        assert!(known.error(Tier::Carrier) < 1e-6 * worst, "the carrier tier has it");
        assert!(
            Beforehand { sensor_latency_s: 0.0, ..known }.error(Tier::Modal) < worst,
            "and nothing else makes up for it"
        );
    }
}
