//! Checks recordings with a rotated demodulator, reversed signs or exchanged columns.

use crate::alignment::{Covered, frequency_steps, plate, voltage_steps};
use crate::simulation::{LogRow, STILL, relog, scene, simulate};
use platebench_design::identified_plate::plate_file;
use platebench_design::identify::{Identification, Inconsistency, Warning, identify};
use platebench_model::recording::Recording;
use platebench_plate::{Complex64, SecondMode};
use rstest::rstest;
use std::f64::consts::TAU;

const SEEDS: u64 = 20;

fn change_w(recording: &Recording, change: impl Fn(Complex64) -> Complex64) -> Recording {
    relog(recording, |rows| rows.iter_mut().for_each(|row: &mut LogRow| row.w = change(row.w)))
}

fn rotated(recording: &Recording, degrees: f64) -> Recording {
    change_w(recording, |w| w * Complex64::cis(degrees.to_radians()))
}

fn reverse_wq(recording: &Recording) -> Recording {
    change_w(recording, |w| w.conj())
}

/// Steps of the temperature, excited between the resonances.
fn sweep(seed: u64) -> Recording {
    let warm = [(0.0, 0.0), (25.0, 3.0), (45.0, 6.0), (65.0, 9.0)];
    let drive = |ms: u32, _: f64| (if ms < 5 { 0.0 } else { 300.0 }, TAU * 32_264.2);
    simulate(&plate(), seed, &scene(&warm, STILL), 90, drive)
}

fn text_of(found: &Identification) -> String {
    let lines: Vec<_> = found.inconsistencies.iter().map(ToString::to_string).collect();
    lines.join("\n")
}

#[rstest]
#[case::three_degrees(3.0)]
#[case::ten_degrees_back(-10.0)]
#[case::thirty_degrees(30.0)]
fn a_rotation_is_estimated_and_reported(#[case] degrees: f64) {
    for record in [voltage_steps, frequency_steps] {
        let mut covered = Covered::default();
        for seed in 0..SEEDS / 4 {
            let (found, _) = identify(&[rotated(&record(seed), degrees)], None).unwrap();
            assert_eq!(found.inconsistencies, [], "{seed}");
            let [Warning::Rotation { rotation_deg, .. }] = &found.warnings[..] else {
                panic!("{seed}: {:?}", found.warnings)
            };
            assert!((rotation_deg.value - degrees).abs() < 4.0 * rotation_deg.error, "{seed}: {rotation_deg:?}");
            assert!(rotation_deg.error < 0.5, "{seed}: {rotation_deg:?}");
            covered.add(&found);
        }
        covered.check();
    }
}

/// One frequency shows a rotation by 90°, but not whether the columns are exchanged.
#[rstest]
#[case::exchanged(|w: Complex64| Complex64::new(w.im, w.re))]
#[case::rotated(|w: Complex64| w * Complex64::I)]
fn a_quarter_turn_names_both_causes(#[case] change: fn(Complex64) -> Complex64) {
    for seed in 0..5 {
        let (found, _) = identify(&[change_w(&voltage_steps(seed), change)], None).unwrap();
        let text = text_of(&found);
        assert!(text.contains("with Wd and Wq exchanged (resonance 32"), "{text}");
        assert!(text.contains("rotates W by 9") || text.contains("rotates W by 8"), "{text}");
        assert!(text.contains("Check the columns of wd and wq and the reference phase"), "{text}");
        assert!(found.gain_um_per_vpp.unwrap().contains(plate().gain), "{:?}", found.gain_um_per_vpp);
    }
}

#[rstest]
#[case::exchanged(|w: Complex64| Complex64::new(w.im, w.re), "the model fits with Wd and Wq exchanged; check")]
#[case::rotated(|w: Complex64| w * Complex64::I, "Do not exchange the columns")]
#[case::wq_reversed(|w: Complex64| w.conj(), "reversed sign of Wq; --columns wq=COLUMN:-UNIT")]
#[case::wd_reversed(|w: Complex64| -w.conj(), "reversed sign of Wd; --columns wd=COLUMN:-UNIT")]
#[case::both_reversed(|w: Complex64| -w, "the signs of Wd and Wq are reversed")]
fn steps_of_the_frequency_show_the_sign(#[case] change: fn(Complex64) -> Complex64, #[case] message: &str) {
    let mut covered = Covered::default();
    for seed in 0..SEEDS / 4 {
        let (found, _) = identify(&[change_w(&frequency_steps(seed), change)], None).unwrap();
        assert!(text_of(&found).contains(message), "{seed}: {}", text_of(&found));
        assert_eq!(found.second_mode, None);
        covered.add(&found);
    }
    covered.check();
}

#[test]
fn a_reversed_wd_under_one_frequency_is_doubtful() {
    for seed in 0..5 {
        let (found, _) = identify(&[change_w(&voltage_steps(seed), |w| -w.conj())], None).unwrap();
        assert!(
            text_of(&found).contains("the model fits with a reversed sign of Wd (resonance 32"),
            "{}",
            text_of(&found)
        );
    }
}

/// Recordings with different distances from the resonance show a reversed Wq together.
#[test]
fn a_reversed_wq_in_all_recordings_is_doubtful() {
    for seed in 0..20 {
        let right = [voltage_steps(seed), sweep(seed), sweep(seed + 100)];
        let (found, _) = identify(&right, None).unwrap();
        assert_eq!((&found.inconsistencies[..], &found.warnings[..]), (&[][..], &[][..]), "{seed}");
        let (found, _) = identify(&right.each_ref().map(reverse_wq), None).unwrap();
        let is_mirrored = |each: &Inconsistency| matches!(each, Inconsistency::Mirrored { direct_hz, mirrored_hz } if *direct_hz > 20.0 && *mirrored_hz < 1.0);
        assert!(found.inconsistencies.iter().any(is_mirrored), "{seed}: {:?}", found.inconsistencies);
        assert!(text_of(&found).contains("resonance rises by 9.6"), "{}", text_of(&found));
    }
}

#[test]
fn a_rising_resonance_names_the_sign_of_wq() {
    let (found, _) = identify(&[reverse_wq(&sweep(1))], None).unwrap();
    let [Inconsistency::RisingResonance { slope_hz_per_k }] = found.inconsistencies[..] else {
        panic!("{:?}", found.inconsistencies)
    };
    assert!((slope_hz_per_k - 9.638).abs() < 0.1, "{slope_hz_per_k}");
    assert!(text_of(&found).contains("sign of Wq is probably reversed"), "{}", text_of(&found));
    assert_eq!(identify(&[sweep(1)], None).unwrap().0.inconsistencies, []);
}

/// Different plates have different resonances, which no mirrored Wq explains.
#[test]
fn different_plates_are_not_taken_for_a_mirrored_wq() {
    for first in 0..10 {
        let record = |number: u64| {
            let hz = [0.0, 35.0, -20.0, 55.0][number as usize % 4];
            let plate = platebench_plate::Plate { omega0: plate().omega0 + TAU * hz, ..plate() };
            let excitation = plate.omega0 + [60.0, -90.0, 150.0, 20.0][(number + first) as usize % 4];
            let level = |ms: u32, _: f64| (if ms < 5 { 0.0 } else { 300.0 }, excitation);
            simulate(&plate, first * 4 + number, &scene(STILL, STILL), 60, level)
        };
        let recordings: Vec<Recording> = (0..4).map(record).collect();
        let (found, _) = identify(&recordings, None).unwrap();
        let is_mirrored = |each: &Inconsistency| matches!(each, Inconsistency::Mirrored { .. });
        assert!(!found.inconsistencies.iter().any(is_mirrored), "{:?}", found.inconsistencies);
    }
}

#[test]
fn the_plate_file_contains_the_warnings() {
    let (found, _) = identify(&[rotated(&voltage_steps(1), 5.0)], None).unwrap();
    let text = plate_file(&found, &crate::simulation::details("plate")).unwrap();
    assert!(text.starts_with("# WARNING: 1 of 1 recordings: the demodulator rotates W by "), "{text}");
    toml::from_str::<platebench_plate::RawPlate>(&text).unwrap().check().unwrap();
}

/// The samples of a mode beyond half the sampling rate are those of a nearer mode.
#[rstest]
#[case::within(400.0, true)]
#[case::beyond(620.0, false)]
fn an_alias_is_no_second_mode(#[case] distance_hz: f64, #[case] is_found: bool) {
    let second = SecondMode { omega0: plate().omega0 + TAU * distance_hz, sigma0: 1e3 / 1.5, gain: 0.0021 };
    let effects = platebench_plate::Effects { second_mode: Some(second), ..Default::default() };
    let plate = platebench_plate::Plate { effects, noise_um_rms: 0.002, ..plate() };
    let level = |ms: u32, _: f64| (if ms % 40 < 20 { 0.0 } else { 300.0 }, plate.omega0 + 60.0);
    let recordings: Vec<Recording> =
        (0..2).map(|seed| simulate(&plate, seed, &scene(STILL, STILL), 120, level)).collect();
    let (found, _) = identify(&recordings, None).unwrap();
    let distance = found.second_mode.map(|mode| mode.resonance_hz.value - plate.omega0 / TAU);
    assert_eq!(distance.is_some_and(|hz| (hz - distance_hz).abs() < 20.0), is_found, "{distance:?}");
    assert!(distance.is_none_or(|hz| hz.abs() <= 510.0), "{distance:?}");
    assert_eq!(found.inconsistencies.is_empty(), is_found, "{:?}", found.inconsistencies);
}
