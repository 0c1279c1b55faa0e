//! Tests the law on the envelope in f64. `harness/engine/tests` tests it on the modal plate.

use super::Phase;
use crate::law::example::CONFIGURE;
use crate::law::tests::{FORCE, LawSimulation, NINE_KELVIN, SimulatedPeriod};
use crate::law::{Law, Measurement};
use platebench_wire::{Configure, Gains, LawId, flags};
use std::vec::Vec;

const DEADBEAT: Configure = Configure { law: LawId::Deadbeat, ..CONFIGURE };

fn highest_drive(periods: &[SimulatedPeriod]) -> f64 {
    periods.iter().map(|period| period.amplitude).fold(0.0, f64::max)
}

fn raised_flags(periods: &[SimulatedPeriod]) -> u8 {
    periods.iter().fold(0, |all, period| all | period.actuation.flags)
}

#[track_caller]
fn assert_near(periods: &[SimulatedPeriod], setpoint: f64, tolerance: f64, case: &str) {
    assert!(periods.iter().all(|period| (period.amplitude - setpoint).abs() < tolerance), "{case}: {periods:?}");
}

#[test]
fn settles_in_two_periods() {
    for damping in [1.0, 1.2, 1.5, 2.0, 7.0 / 3.0] {
        for resonance in [0.0, NINE_KELVIN, -NINE_KELVIN, 200.0] {
            let periods = LawSimulation::new(&DEADBEAT, damping, resonance).run_periods(2.0, 40);
            let at_two = periods[2];
            assert!((at_two.amplitude - 2.0).abs() < 1e-3, "σ × {damping}, {resonance} rad/s: {at_two:?}");
            // The slew limit of 628 rad/s per period does not always suffice to bring Wq to 0.
            assert!(at_two.wq.abs() < 0.2, "σ × {damping}, {resonance} rad/s: {at_two:?}");
            let peak = periods.iter().map(|period| period.actuation.drive_vpp).fold(0.0, f32::max);
            assert!(peak <= 800.0, "σ × {damping}, {resonance} rad/s: {peak} Vpp");
            assert_near(&periods[2..], 2.0, 0.02, "");
            let last = periods[39];
            assert!(last.wq.abs() < 1e-3 && (last.amplitude - 2.0).abs() < 1e-4, "{last:?}");
            assert_eq!(raised_flags(&periods) & (flags::SATURATED | flags::PREDICTION_MISSED), 0);
        }
    }
}

#[test]
fn the_hand_over_has_no_bump() {
    for damping in [1.0, 7.0 / 3.0] {
        let periods = LawSimulation::new(&DEADBEAT, damping, NINE_KELVIN).run_periods(2.0, 40);
        let holding = f64::from(periods[39].actuation.drive_vpp);
        assert!((holding / (2.0 * damping / 0.00698) - 1.0).abs() < 1e-3, "{holding} Vpp");
        for period in &periods[4..] {
            assert!((f64::from(period.actuation.drive_vpp) / holding - 1.0).abs() < 0.01, "{period:?}");
        }
    }
}

#[test]
fn a_new_setpoint_is_reached_in_one_period() {
    let mut simulation = LawSimulation::new(&DEADBEAT, 1.5, 100.0);
    simulation.run_periods(1.0, 20);
    for setpoint in [1.5, 1.2, 1.6, 1.5] {
        let periods = simulation.run_periods(setpoint, 12);
        assert!((periods[1].amplitude - setpoint).abs() < 0.005 * setpoint, "{setpoint} µm: {:?}", periods[1]);
        assert!(periods[1..].iter().all(|period| (period.amplitude - setpoint).abs() < 0.01 * setpoint), "{periods:?}");
    }
    let periods = simulation.run_periods(0.5, 12);
    assert_eq!(periods[0].actuation.drive_vpp, 0.0);
    assert!(periods.iter().all(|period| period.amplitude > 0.495), "{periods:?}");
    assert!((periods[3].amplitude - 0.5).abs() < 0.01, "{periods:?}");
}

#[test]
fn a_long_fall_is_steered_to_its_end() {
    let mut simulation = LawSimulation::new(&DEADBEAT, 1.0, 0.0);
    simulation.run_periods(2.5, 24);
    let periods = simulation.run_periods(0.002, 24);
    let falling = periods.iter().take_while(|period| period.actuation.drive_vpp == 0.0).count();
    assert!(falling > usize::from(super::MAX_STEERING_PERIODS), "{periods:?}");
    assert!(periods.iter().all(|period| period.amplitude > 0.00198), "{periods:?}");
    assert!(periods[falling + 1..].iter().all(|period| period.amplitude < 0.00202), "{periods:?}");
}

#[test]
fn drive_stays_at_its_limit_until_the_setpoint_is_near() {
    let mut simulation = LawSimulation::new(&Configure { drive_limit_vpp: 400.0, ..DEADBEAT }, 1.0, 0.0);
    let periods = simulation.run_periods(2.0, 20);
    let drives: Vec<_> = periods.iter().map(|period| period.actuation.drive_vpp).collect();
    assert_eq!(drives[..2], [400.0, 400.0]);
    assert!((300.0..340.0).contains(&drives[2]), "{drives:?}");
    assert_near(&periods[3..], 2.0, 0.01, "");
    assert_eq!(periods[0].actuation.flags & flags::SATURATED, flags::SATURATED);
    assert_eq!(periods[2].actuation.flags & flags::SATURATED, 0);
}

#[test]
fn out_of_reach_only_raises_saturated_and_recovers() {
    let mut simulation = LawSimulation::new(&Configure { drive_limit_vpp: 400.0, ..DEADBEAT }, 7.0 / 3.0, 0.0);
    let periods = simulation.run_periods(2.0, 60);
    assert!(periods[..50].iter().all(|period| period.actuation.drive_vpp == 400.0));
    assert_eq!(raised_flags(&periods) & !flags::FREQUENCY_LIMITED, flags::SATURATED);
    let Law::Deadbeat(law) = simulation.law else { panic!("another law") };
    assert_eq!(law.phase, Phase::Holding);
    assert!((law.mode.sigma * CONFIGURE.time_constant_s * 3.0 / 7.0 - 1.0).abs() < 1e-3, "{:?}", law.mode);
    simulation.damping = 1.0;
    let periods = simulation.run_periods(2.0, 30);
    assert!(highest_drive(&periods) < 2.1, "{periods:?}");
    assert_near(&periods[6..], 2.0, 0.02, "");
}

#[test]
fn a_restart_assumes_an_untouched_plate() {
    let mut simulation = LawSimulation::new(&DEADBEAT, 7.0 / 3.0, NINE_KELVIN);
    simulation.run_periods(2.0, 30);
    simulation.run_periods(0.0, 30);
    simulation.damping = 1.0;
    let periods = simulation.run_periods(2.0, 30);
    assert!(highest_drive(&periods) < 2.01, "{periods:?}");
    assert!(periods[1].wq.abs() < 0.01, "{periods:?}");
}

#[test]
fn given_gains_stay_fixed() {
    let gains = Gains { amplitude_kp: 50.0, amplitude_ki: 2.5e4, frequency_kp: 500.0, frequency_ki: 2e5 };
    let configure = Configure { gains: Some(gains), ..DEADBEAT };
    assert_eq!(Law::design(&configure).unwrap().1, gains);
    let mut simulation = LawSimulation::new(&configure, 1.5, 0.0);
    let before = *simulation.run_periods(2.0, 30).last().unwrap();
    simulation.w.0 += 0.01;
    let change = simulation.run_period(2.0).actuation.drive_vpp - before.actuation.drive_vpp;
    assert!((change + 50.0 * 0.01).abs() < 0.01, "{change} Vpp");
}

#[test]
fn a_sudden_finger_is_corrected_at_once() {
    for (before, after) in [(1.0, 2.0), (1.0, 7.0 / 3.0), (2.0, 1.0), (7.0 / 3.0, 1.0)] {
        let mut simulation = LawSimulation::new(&DEADBEAT, before, NINE_KELVIN);
        simulation.run_periods(2.0, 30);
        simulation.damping = after;
        let periods = simulation.run_periods(2.0, 30);
        assert!((periods[1].amplitude - 2.0).abs() > 0.2, "{periods:?}");
        assert_near(&periods[2..], 2.0, 0.02, &std::format!("σ × {before} to {after}"));
        assert_eq!(raised_flags(&periods) & flags::PREDICTION_MISSED, 0);
    }
}

/// The finger arrives within the period, so its sample fits no constant damping, but a delay.
#[test]
fn a_finger_within_a_period_is_not_taken_for_a_delay() {
    for (before, after) in [(1.0, 2.0), (7.0 / 3.0, 1.0)] {
        for share in [0.1, 0.3, 0.5, 0.7, 0.9] {
            let mut simulation = LawSimulation::new(&DEADBEAT, before, 0.0);
            simulation.run_periods(2.0, 30);
            simulation.change_damping(after, share);
            let periods = simulation.run_periods(2.0, 30);
            assert_near(&periods[4..], 2.0, 0.04, &std::format!("{share}"));
            let Law::Deadbeat(law) = simulation.law else { panic!("another law") };
            assert_eq!(law.delay, 0.0, "σ × {before} to {after} after {share} of a period");
        }
    }
}

#[test]
fn steering_ends_on_an_unsteady_plate() {
    let mut simulation = LawSimulation::new(&DEADBEAT, 1.0, 0.0);
    for period in 0..6 {
        simulation.run_period(2.0);
        simulation.w.0 *= if period % 2 == 0 { 1.033 } else { 0.967 };
    }
    let Law::Deadbeat(law) = simulation.law else { panic!("another law") };
    assert_eq!(law.phase, Phase::Holding);
}

#[test]
fn an_unknown_delay_is_found_and_compensated() {
    for delay in [0.1e-3, 0.2e-3, 0.3e-3, 0.4e-3, 0.5e-3] {
        for (damping, resonance) in [(1.0, 0.0), (1.0, NINE_KELVIN), (1.5, 0.0)] {
            let case = std::format!("{delay} s, σ × {damping}");
            let mut simulation = LawSimulation { delay, ..LawSimulation::new(&DEADBEAT, damping, resonance) };
            let first = simulation.run_periods(2.0, 30);
            assert_near(&first[6..], 2.0, 0.1, &case);
            assert_eq!(raised_flags(&first) & flags::PREDICTION_MISSED, 0);
            simulation.run_periods(0.0, 30);
            let second = simulation.run_periods(2.0, 30);
            assert!(highest_drive(&second) < 2.04, "{delay} s, σ × {damping}: {second:?}");
            assert_near(&second[4..], 2.0, 0.04, &case);
            let third = simulation.run_periods(2.4, 12);
            assert_near(&third[2..], 2.4, 0.05, &case);
        }
    }
}

#[test]
fn a_very_heavy_finger_costs_one_period() {
    for damping in [2.6, 3.0, 4.0] {
        let configure = Configure { drive_limit_vpp: 1500.0, ..DEADBEAT };
        let mut simulation = LawSimulation::new(&configure, damping, NINE_KELVIN);
        let periods = simulation.run_periods(2.0, 30);
        assert_near(&periods[3..], 2.0, 0.02, &std::format!("σ × {damping}"));
        assert_eq!(raised_flags(&periods) & flags::PREDICTION_MISSED, 0);
        let Law::Deadbeat(law) = simulation.law else { panic!("another law") };
        assert_eq!(law.delay, 0.0);
    }
}

/// Exception: with a gain below nominal under 2 N, the law identifies a delay of up to 0.1 ms.
#[test]
fn a_gain_error_is_not_taken_for_a_delay() {
    for gain in [0.9, 0.95, 1.05, 1.1] {
        for damping in [1.0, 1.5, 7.0 / 3.0] {
            let mut simulation =
                LawSimulation { force: FORCE * gain, ..LawSimulation::new(&DEADBEAT, damping, NINE_KELVIN) };
            let periods = simulation.run_periods(2.0, 40);
            assert_near(&periods[3..], 2.0, 0.1, &std::format!("K1 × {gain}, σ × {damping}"));
            assert!((periods[39].amplitude - 2.0).abs() < 1e-3);
            let Law::Deadbeat(law) = simulation.law else { panic!("another law") };
            let allowed = if gain < 1.0 && damping > 2.0 { 0.1e-3 } else { 0.0 };
            assert!(law.delay <= allowed, "K1 × {gain}, σ × {damping}: {} s", law.delay);
        }
    }
}

#[test]
fn an_unpredictable_plate_ends_in_the_fallback() {
    let mut law = Law::design(&DEADBEAT).unwrap().0;
    let samples = [(0.3, 1.0), (2.5, -0.4), (1.0, 0.2), (0.4, -1.5), (3.0, 0.1)];
    let mut flagged = 0;
    for (wd_um, wq_um) in samples.into_iter().cycle().take(200) {
        let actuation = law.step(&Measurement { setpoint_um: 2.0, wd_um, wq_um });
        assert!((0.0..=900.0).contains(&actuation.drive_vpp));
        flagged += u32::from(actuation.flags & flags::PREDICTION_MISSED != 0);
    }
    assert!(flagged > 100, "{flagged} of 200");
    let Law::Deadbeat(law) = law else { panic!("another law") };
    let mut simulation = LawSimulation { law: Law::Deadbeat(law), ..LawSimulation::new(&DEADBEAT, 1.0, 0.0) };
    simulation.run_periods(2.0, 60);
    assert_eq!(raised_flags(&simulation.run_periods(2.0, 10)) & flags::PREDICTION_MISSED, 0);
}

#[test]
fn a_given_delay_never_overshoots() {
    for loop_delay_us in [100, 300, 500, 550, 600, 800, 1_000] {
        let delay = f64::from(loop_delay_us) * 1e-6;
        // The law ignores a first sample after less than 0.45 periods of drive.
        let settled = if loop_delay_us <= 550 { 3 } else { 4 };
        for (damping, resonance) in [(1.0, 0.0), (1.0, NINE_KELVIN), (2.0, 0.0), (7.0 / 3.0, NINE_KELVIN)] {
            let configure = Configure { loop_delay_us, ..DEADBEAT };
            let mut simulation = LawSimulation { delay, ..LawSimulation::new(&configure, damping, resonance) };
            for setpoint in [2.0, 1.0, 2.0] {
                let periods = simulation.run_periods(setpoint, 30);
                let case = std::format!("{delay} s, σ × {damping}, {resonance} rad/s");
                if setpoint > 1.5 {
                    assert!(highest_drive(&periods) < 2.04, "{case}: {periods:?}");
                }
                let on_setpoint = |period: &SimulatedPeriod| (period.amplitude - setpoint).abs() < 0.04;
                assert!(periods[settled..].iter().all(on_setpoint), "{case}: {periods:?}");
                assert_eq!(raised_flags(&periods) & flags::PREDICTION_MISSED, 0, "{case}");
            }
        }
    }
}

#[test]
fn a_wrong_given_delay_is_corrected() {
    for (loop_delay_us, delay) in [(400, 0.3e-3), (400, 0.5e-3), (200, 0.4e-3)] {
        let mut simulation =
            LawSimulation { delay, ..LawSimulation::new(&Configure { loop_delay_us, ..DEADBEAT }, 1.0, 0.0) };
        simulation.run_periods(2.0, 30);
        simulation.run_periods(0.0, 30);
        let second = simulation.run_periods(2.0, 30);
        assert!(highest_drive(&second) < 2.04, "{loop_delay_us} µs configured, {delay} s: {second:?}");
        let Law::Deadbeat(law) = simulation.law else { panic!("another law") };
        let found = f64::from(law.delay);
        assert!((found - delay).abs() < 1e-5, "{loop_delay_us} µs configured, {delay} s: {found} s");
    }
}

#[test]
fn a_heavy_finger_costs_nothing_with_a_given_delay() {
    for damping in [2.6, 3.0, 4.0] {
        let configure = Configure { drive_limit_vpp: 1500.0, loop_delay_us: 300, ..DEADBEAT };
        let mut simulation = LawSimulation { delay: 0.3e-3, ..LawSimulation::new(&configure, damping, NINE_KELVIN) };
        let periods = simulation.run_periods(2.0, 30);
        assert_near(&periods[3..], 2.0, 0.06, &std::format!("σ × {damping}"));
    }
}
