//! Checks recordings from which rows are missing, and steps of the voltage under different forces.

use crate::alignment::{Covered, frequency_steps, plate, voltage_drive, voltage_steps};
use crate::simulation::{STILL, relog, scene, simulate};
use platebench_design::identified_plate::document;
use platebench_design::identify::{Identification, Inconsistency, Warning, identify};
use platebench_document::Style;
use platebench_model::recording::Recording;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use rand_distr::{Distribution, Uniform};
use rstest::rstest;

fn without_rows(recording: &Recording, lost: &[usize]) -> Recording {
    relog(recording, |rows| {
        let mut number = 0;
        rows.retain(|_| {
            number += 1;
            !lost.contains(&(number - 1))
        });
    })
}

/// Four steps of the voltage at the resonance, because ARX models of Wd are biased elsewhere.
fn resonant_steps(seed: u64) -> Recording {
    simulate(&plate(), seed, &scene(STILL, STILL), 160, |ms, _| (voltage_drive(ms).0, plate().omega0))
}

fn missing(found: &Identification) -> Option<(usize, usize)> {
    found.warnings.iter().find_map(|warning| match warning {
        Warning::MissingRows { rows, unknown, .. } => Some((*rows, *unknown)),
        _ => None,
    })
}

/// The drive changes in rows 20, 60, 100 and 140.
#[rstest]
#[case::after_the_step(&[21, 61, 101, 141], 0)]
#[case::at_the_step(&[20, 60, 100, 140], 4)]
#[case::two_in_a_row(&[61, 62, 141, 142], 0)]
fn a_row_lost_at_a_step_leaves_the_estimates(#[case] lost: &[usize], #[case] unknown: usize) {
    let mut covered = Covered::default();
    let (mut by_step, mut taus, mut coloured) = ([0_usize; 2], Vec::new(), 0);
    for seed in 0..20 {
        let (found, _) = identify(&[without_rows(&resonant_steps(seed), lost)], None).unwrap();
        // The Ljung-Box test rejects one of a hundred recordings by chance.
        let is_chance = |each: &Inconsistency| matches!(each, Inconsistency::Residuals { .. });
        assert!(found.inconsistencies.iter().all(is_chance), "{seed}: {:?}", found.inconsistencies);
        coloured += found.inconsistencies.len();
        assert_eq!((found.warnings.len(), missing(&found)), (1, Some((4, unknown))), "{:?}", found.warnings);
        assert_eq!(found.voltage_steps.len(), 4);
        for step in &found.voltage_steps {
            for [gain, tau] in [step.instruments.unwrap(), step.direct.unwrap()] {
                by_step[0] += usize::from(gain.contains(plate().gain));
                by_step[1] += usize::from(tau.contains(1.0 / plate().sigma0));
            }
            taus.push(step.instruments.unwrap()[1].value);
        }
        covered.add(&found);
    }
    covered.check();
    assert!(coloured <= 2, "{coloured}");
    let mean = taus.iter().sum::<f64>() / taus.len() as f64;
    assert!((mean * 1e3 / 1.88 - 1.0).abs() < 0.02, "{mean}");
    // 160 intervals each. Those of instrumental variables assume a plate of first order.
    assert!(by_step.iter().all(|count| *count >= 140), "{by_step:?}");
}

#[rstest]
#[case::voltage_steps(voltage_steps)]
#[case::frequency_steps(frequency_steps)]
fn rows_lost_at_random_leave_the_estimates(#[case] record: fn(u64) -> Recording) {
    let mut covered = Covered::default();
    for seed in 0..20 {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        let share = Uniform::new(0.0, 1.0).unwrap();
        let lost: Vec<usize> = (1..159).filter(|_| share.sample(&mut random) < 0.05).collect();
        let (found, _) = identify(&[without_rows(&record(seed), &lost)], None).unwrap();
        assert!(missing(&found).is_some_and(|missing| missing.0 == lost.len()), "{seed}: {:?}", found.warnings);
        assert!(
            found.inconsistencies.iter().all(|each| matches!(each, Inconsistency::Residuals { .. })),
            "{seed}: {:?}",
            found.inconsistencies
        );
        covered.add(&found);
    }
    covered.check();
}

/// Without the time of the row, the samples after a lost row are one period late.
#[test]
fn a_lost_row_without_its_time_is_doubtful() {
    for seed in 0..10 {
        let numbered = relog(&without_rows(&voltage_steps(seed), &[62]), |rows| {
            (0..).zip(rows).for_each(|(number, row)| row.t = f64::from(number) * 1e-3);
        });
        let (found, _) = identify(&[numbered], None).unwrap();
        let text: String = found.inconsistencies.iter().map(ToString::to_string).collect();
        assert!(text.contains("Check for lost rows"), "{seed}: {text}");
    }
}

fn steps_under_forces(seed: u64, drive: impl Fn(u32) -> (f64, f64)) -> Recording {
    let forces = [(0.0, 0.0), (170.0, 0.5), (330.0, 1.5)];
    simulate(&plate(), seed, &scene(STILL, &forces), 500, |ms, _| drive(ms))
}

#[test]
fn steps_under_different_forces_of_a_linear_plate_agree() {
    for seed in 0..20 {
        // A higher force has higher drives, so mixed forces would look like a smaller gain.
        let levels = [120.0, 208.0, 120.0, 208.0, 208.0, 312.0, 208.0, 312.0, 312.0, 370.0, 312.0, 370.0, 0.0];
        let drive = |ms: u32| {
            let vpp = if ms % 40 < 20 { 0.0 } else { levels[(ms / 40) as usize] };
            (vpp, plate().omega0 + 40.0)
        };
        let recording = steps_under_forces(seed, drive);
        let (found, _) = identify(&[recording], None).unwrap();
        let is_chance = |each: &Inconsistency| matches!(each, Inconsistency::Residuals { .. });
        assert!(found.inconsistencies.iter().all(is_chance), "{seed}: {:?}", found.inconsistencies);
        let change = found.gain_change_percent.unwrap();
        assert!(change.value.abs() < 1.0 && change.low < 0.5 && change.high > -0.5, "{seed}: {change:?}");
        let text = document("plate", &found, &[]).to_console(None, Style::default());
        assert!(text.contains("370, 1.5 N") && text.contains("all, 0.5 N"), "{text}");
    }
}

/// One drive under each force says nothing about linearity.
#[test]
fn one_drive_under_each_force_has_no_linearity() {
    let drive = |ms: u32| {
        let vpp = match ms % 160 {
            20..100 => [120.0, 208.0, 312.0, 370.0][(ms / 160) as usize % 4],
            _ => 0.0,
        };
        (vpp, plate().omega0 + 40.0)
    };
    let (found, _) = identify(&[steps_under_forces(1, drive)], None).unwrap();
    assert_eq!((found.gain_change_percent, &found.inconsistencies[..]), (None, &[][..]));
    assert_eq!(found.voltage_steps.len(), 3);
}
