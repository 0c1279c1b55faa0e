//! Checks recordings whose inputs or time stamps do not fit the samples in time.

use crate::simulation::{LogRow, STILL, move_column, relog, scene, simulate, simulate_delayed};
use platebench_design::identify::{Identification, Inconsistency, ShiftedInputs, Warning, fit_direct, identify};
use platebench_model::recording::Recording;
use platebench_plate::Plate;
use platebench_test_kit::paper_plate;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use rand_distr::{Distribution, Normal, Uniform};
use rstest::rstest;
use std::f64::consts::TAU;

const SEEDS: u64 = 20;
const NOISE_UM: f64 = 0.004;

pub(crate) fn plate() -> Plate {
    Plate { noise_um_rms: NOISE_UM, ..paper_plate() }
}

/// Four steps of the voltage from rest, 40 rad/s above the resonance.
pub(crate) fn voltage_drive(ms: u32) -> (f64, f64) {
    let vpp = if ms % 40 < 20 { 0.0 } else { [120.0, 208.0, 312.0, 370.0][(ms / 40) as usize % 4] };
    (vpp, plate().omega0 + 40.0)
}

pub(crate) fn voltage_steps(seed: u64) -> Recording {
    simulate(&plate(), seed, &scene(STILL, STILL), 160, |ms, _| voltage_drive(ms))
}

/// Steps of the frequency by −77 rad/s, with a loop that holds Wd.
pub(crate) fn frequency_steps(seed: u64) -> Recording {
    let mut integral = 0.0;
    simulate(&plate(), seed, &scene(STILL, STILL), 160, |ms, wd| {
        let error = 2.0 - wd;
        integral += 75.6 * error;
        let level = 3.0 - f64::from((ms.max(20) - 20) / 20).min(6.0);
        ((107.4 * error + integral).max(0.0), plate().omega0 + 77.0 * level)
    })
}

/// Counts how often K1, τ and the resonance are inside their intervals.
#[derive(Default, Debug)]
pub(crate) struct Covered {
    counts: [usize; 3],
    total: usize,
}

impl Covered {
    pub(crate) fn add(&mut self, found: &Identification) {
        let plate = plate();
        let truths = [
            (found.gain_um_per_vpp, plate.gain),
            (found.time_constant_s, 1.0 / plate.sigma0),
            (found.resonance_hz, plate.omega0 / TAU),
        ];
        for (count, (estimate, truth)) in self.counts.iter_mut().zip(truths) {
            *count += usize::from(estimate.is_some_and(|estimate| estimate.contains(truth)));
        }
        self.total += 1;
    }

    /// Three binomial standard errors below 95 %.
    pub(crate) fn check(&self) {
        println!("{self:?}");
        let n = self.total as f64;
        let least = 0.95 * n - 3.0 * (0.95_f64 * 0.05 * n).sqrt();
        assert!(self.total > 0 && self.counts.iter().all(|count| *count as f64 >= least), "{self:?}");
    }
}

fn shifts(found: &Identification) -> Vec<(ShiftedInputs, f64)> {
    let shift = |warning: &Warning| match warning {
        Warning::Shift { inputs, periods, .. } => Some((*inputs, periods.value)),
        _ => None,
    };
    found.warnings.iter().filter_map(shift).collect()
}

fn drive(row: &mut LogRow) -> &mut f64 {
    &mut row.vpp
}

#[rstest]
#[case::drive_one_row_late(|rows: &mut Vec<LogRow>| move_column(rows, 1, drive), -1.0)]
#[case::drive_one_row_early(|rows: &mut Vec<LogRow>| move_column(rows, -1, drive), 1.0)]
#[case::drive_two_rows_late(|rows: &mut Vec<LogRow>| move_column(rows, 2, drive), -2.0)]
#[case::w_one_row_late(|rows: &mut Vec<LogRow>| move_column(rows, 1, |row| &mut row.w), 1.0)]
fn a_shifted_column_is_identified_and_reported(#[case] change: fn(&mut Vec<LogRow>), #[case] periods: f64) {
    let mut covered = Covered::default();
    for seed in 0..SEEDS {
        let (found, _) = identify(&[relog(&voltage_steps(seed), change)], None).unwrap();
        assert_eq!(found.inconsistencies, [], "{seed}");
        let [(ShiftedInputs::All, shift)] = shifts(&found)[..] else { panic!("{seed}: {:?}", found.warnings) };
        assert!((shift - periods).abs() < 0.02, "{seed}: {shift}");
        assert!(found.input_shift_periods.is_some_and(|estimate| estimate.value == shift), "{seed}");
        assert_eq!(found.voltage_steps.len(), 4, "{seed}");
        let taus = found.voltage_steps.iter().map(|step| step.instruments.unwrap()[1].value);
        assert!(taus.clone().all(|tau| (tau * 1e3 - 1.88).abs() < 0.1), "{seed}: {:?}", taus.collect::<Vec<_>>());
        covered.add(&found);
    }
    covered.check();
}

#[rstest]
#[case::late(1, -1.0)]
#[case::early(-1, 1.0)]
fn distinguishes_a_shifted_frequency_column(#[case] late: i64, #[case] periods: f64) {
    let mut covered = Covered::default();
    for seed in 0..SEEDS / 4 {
        let shifted = relog(&frequency_steps(seed), |rows| move_column(rows, late, |row| &mut row.omega));
        let (found, _) = identify(&[shifted], None).unwrap();
        assert_eq!(found.inconsistencies, [], "{seed}");
        let [(ShiftedInputs::Frequency, shift)] = shifts(&found)[..] else { panic!("{seed}: {:?}", found.warnings) };
        assert!((shift - periods).abs() < 0.1, "{seed}: {shift}");
        covered.add(&found);
    }
    covered.check();
}

#[rstest]
#[case::a_tenth(0.1)]
#[case::a_third(0.3)]
#[case::most(0.7)]
fn a_loop_delay_of_part_of_a_period_is_identified(#[case] delay_ms: f64) {
    let mut covered = Covered::default();
    for seed in 0..SEEDS {
        let scene = scene(STILL, STILL);
        let delayed = simulate_delayed(&plate(), seed, &scene, 160, |ms, _| voltage_drive(ms), |_| delay_ms);
        let (found, _) = identify(&[delayed], None).unwrap();
        assert_eq!(found.inconsistencies, [], "{seed}");
        assert!((shifts(&found)[0].1 - delay_ms).abs() < 0.02, "{seed}: {:?}", found.warnings);
        assert_eq!(found.voltage_steps.len(), 4, "{seed}");
        assert!(found.voltage_steps.iter().all(|step| step.instruments.is_none() && step.direct.is_some()));
        covered.add(&found);
    }
    covered.check();
}

/// Each of 20 recordings is too short to show the delay, all together do.
#[test]
fn a_small_common_delay_is_found_in_many_recordings() {
    let record = |seed| {
        let noisy = Plate { noise_um_rms: 0.05, ..plate() };
        simulate_delayed(&noisy, seed, &scene(STILL, STILL), 160, |ms, _| voltage_drive(ms), |_| 0.1)
    };
    let recordings: Vec<Recording> = (0..20).map(record).collect();
    let (found, _) = identify(&recordings, None).unwrap();
    assert!(found.input_shift_periods.unwrap().contains(0.1), "{:?}", found.input_shift_periods);
    assert!(shifts(&found).iter().all(|shift| (shift.1 - 0.1).abs() < 0.04), "{:?}", found.warnings);
    assert!(found.time_constant_s.unwrap().contains(1.0 / plate().sigma0), "{:?}", found.time_constant_s);
    assert!(!shifts(&found).is_empty() && found.inconsistencies.is_empty(), "{:?}", found.inconsistencies);
}

#[test]
fn jittered_time_stamps_are_replaced_by_equal_spacing() {
    let mut covered = Covered::default();
    for seed in 0..SEEDS / 2 {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        let jitter = Normal::new(0.0, 1e-4).unwrap();
        let jittered = relog(&voltage_steps(seed), |rows| {
            for row in rows {
                row.t += f64::clamp(jitter.sample(&mut random), -4e-4, 4e-4);
            }
        });
        let (found, _) = identify(&[jittered], None).unwrap();
        assert!(matches!(found.warnings[..], [Warning::Jitter { .. }]), "{seed}: {:?}", found.warnings);
        assert_eq!(found.inconsistencies, [], "{seed}");
        covered.add(&found);
    }
    covered.check();
}

/// The drive acts at another time after each row. No common shift describes this.
#[test]
fn a_varying_delay_is_doubtful() {
    for seed in 0..10 {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        let delay = Uniform::new(0.0, 0.9).unwrap();
        let drive = |ms: u32, _: f64| voltage_drive(ms);
        let recording =
            simulate_delayed(&plate(), seed, &scene(STILL, STILL), 160, drive, |_| delay.sample(&mut random));
        let (found, _) = identify(&[recording], None).unwrap();
        let transients = found.inconsistencies.iter().find(|each| matches!(each, Inconsistency::Transients { .. }));
        let text = transients.unwrap_or_else(|| panic!("{seed}: {:?}", found.inconsistencies)).to_string();
        assert!(text.contains("1 of 1 recordings: the mean square") && text.contains("varying delay"), "{text}");
    }
}

/// Results of correct recordings are those of the direct fit, without warnings or doubts.
#[rstest]
#[case::voltage_steps(voltage_steps, 100)]
#[case::frequency_steps(frequency_steps, 40)]
fn correct_recordings_have_no_alignment(#[case] record: fn(u64) -> Recording, #[case] seeds: u64) {
    let mut covered = 0;
    for seed in 0..seeds {
        let recording = record(seed);
        let direct = fit_direct(&recording).unwrap();
        let (found, fits) = identify(std::slice::from_ref(&recording), None).unwrap();
        assert_eq!(found.warnings, [], "{seed}");
        // The Ljung-Box test rejects one of a hundred recordings by chance.
        let is_chance = |each: &Inconsistency| matches!(each, Inconsistency::Residuals { .. });
        assert!(found.inconsistencies.iter().all(is_chance), "{seed}: {:?}", found.inconsistencies);
        if fits[0].effect.is_none() {
            assert_eq!(fits[0], direct, "{seed}");
        }
        covered += u64::from(found.input_shift_periods.is_some_and(|shift| shift.contains(0.0)));
        covered += u64::from(found.demodulator_rotation_deg.is_some_and(|angle| angle.contains(0.0)));
    }
    let least = 2.0 * seeds as f64 * 0.95 - 3.0 * (2.0 * seeds as f64 * 0.05 * 0.95).sqrt();
    assert!(covered as f64 >= least, "{covered} of {}", 2 * seeds);
}
