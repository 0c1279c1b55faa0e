//! Compares `dq-pi`, whose gains follow the damping, with the laws with constant gains.

use super::*;
use crate::law::example::CONFIGURE;
use crate::law::tests::{FORCE, LawSimulation, NINE_KELVIN, SimulatedPeriod};
use platebench_wire::LawId;
use std::vec::Vec;

fn simulate(law: LawId, damping: f64, resonance: f64, delay: f64) -> Vec<SimulatedPeriod> {
    let configure = Configure { law, ..CONFIGURE };
    LawSimulation { delay, ..LawSimulation::new(&configure, damping, resonance) }.run_periods(2.0, 40)
}

fn settling_period(periods: &[SimulatedPeriod]) -> usize {
    periods.iter().rposition(|period| (period.amplitude - 2.0).abs() > 0.1).map_or(0, |outside| outside + 1)
}

#[test]
fn the_schedule_is_neutral_on_the_nominal_plate() {
    for (resonance, delay) in [(0.0, 0.0), (NINE_KELVIN, 0.0), (-NINE_KELVIN, 0.0), (0.0, 0.2e-3), (0.0, 0.5e-3)] {
        let scheduled = simulate(LawId::DqPi, 1.0, resonance, delay);
        let fixed = simulate(LawId::DqPiFixed, 1.0, resonance, delay);
        for (a, b) in scheduled.iter().zip(&fixed) {
            assert!((a.amplitude - b.amplitude).abs() < 0.002, "{resonance} rad/s, {delay} s: {a:?} instead of {b:?}");
        }
    }
}

#[test]
fn under_a_finger_it_uses_the_gains_for_that_finger() {
    for damping in [1.5, 2.0, 7.0 / 3.0] {
        for resonance in [0.0, NINE_KELVIN, -NINE_KELVIN] {
            assert!(
                settling_period(&simulate(LawId::DqPi, damping, resonance, 0.0)) <= 4,
                "σ × {damping}, {resonance} rad/s"
            );
        }
    }
    assert!(settling_period(&simulate(LawId::DqPiFixed, 7.0 / 3.0, 0.0, 0.0)) >= 9);
    let wq = |law| simulate(law, 7.0 / 3.0, NINE_KELVIN, 0.0)[8].wq.abs();
    assert!(wq(LawId::DqPi) < 0.2 * wq(LawId::DqPiFixed), "the frequency loop as well: {} µm", wq(LawId::DqPi));
    assert!(settling_period(&simulate(LawId::DqPi, 7.0 / 3.0, 0.0, 0.4e-3)) <= 5, "with a delay as well");
}

#[test]
fn a_single_outlier_does_not_change_the_gains() {
    let configure = Configure { law: LawId::DqPi, ..CONFIGURE };
    let mut simulation = LawSimulation::new(&configure, 1.0, 0.0);
    simulation.run_periods(2.0, 30);
    let gains = |simulation: &LawSimulation| {
        let Law::DqPi(law) = simulation.law else { panic!("another law") };
        law.schedule.unwrap().sigma * CONFIGURE.time_constant_s
    };
    assert!((gains(&simulation) - 1.0).abs() < 1e-3, "{}", gains(&simulation));
    simulation.damping = 2.0;
    simulation.run_period(2.0);
    simulation.run_period(2.0);
    assert!((gains(&simulation) - 1.0).abs() < 1e-3, "one sample shows the finger: {}", gains(&simulation));
    simulation.run_period(2.0);
    assert!((gains(&simulation) - 2.0).abs() < 1e-2, "two do: {}", gains(&simulation));
    for step in 0..1000 {
        simulation.damping = 2.0 - f64::from(step) * 1e-3;
        simulation.run_period(2.0);
    }
    assert!((gains(&simulation) - 1.0).abs() < 0.02, "{}", gains(&simulation));
}

#[test]
fn given_gains_stay_as_they_are() {
    let gains = Gains { amplitude_kp: 270.0, amplitude_ki: 1.1e5, frequency_kp: 1000.0, frequency_ki: 4e5 };
    let scheduled = LawSimulation::new(&Configure { law: LawId::DqPi, gains: Some(gains), ..CONFIGURE }, 2.0, 0.0)
        .run_periods(2.0, 20);
    let fixed = LawSimulation::new(&Configure { law: LawId::DqPiFixed, gains: Some(gains), ..CONFIGURE }, 2.0, 0.0)
        .run_periods(2.0, 20);
    for (a, b) in scheduled.iter().zip(&fixed) {
        assert_eq!(a.actuation, b.actuation);
    }
}

#[test]
fn a_given_delay_only_shifts_the_response() {
    for loop_delay_us in [100, 500, 900, 1_000] {
        let delay = f64::from(loop_delay_us) * 1e-6;
        let configure = Configure { law: LawId::DqPi, loop_delay_us, ..CONFIGURE };
        let periods = LawSimulation { delay, ..LawSimulation::new(&configure, 1.0, 0.0) }.run_periods(2.0, 40);
        let undelayed = LawSimulation::new(&Configure { loop_delay_us: 0, ..configure }, 1.0, 0.0).run_periods(2.0, 40);
        for (a, b) in periods.iter().zip(&undelayed) {
            let (a, b) = (a.actuation.drive_vpp, b.actuation.drive_vpp);
            assert!((a - b).abs() < 0.5, "{delay} s: {a} instead of {b} Vpp");
        }
        let unconfigured = Configure { loop_delay_us: 0, ..configure };
        let rings = LawSimulation { delay, ..LawSimulation::new(&unconfigured, 1.0, 0.0) }.run_periods(2.0, 40);
        let highest = |periods: &[SimulatedPeriod]| periods.iter().map(|period| period.amplitude).fold(0.0, f64::max);
        assert!(highest(&periods) < 2.001, "{delay} s: {periods:?}");
        assert!(highest(&rings) > if delay < 0.2e-3 { 2.02 } else { 2.3 }, "{delay} s: {rings:?}");
    }
}

#[test]
fn a_given_delay_causes_no_static_error() {
    for loop_delay_us in [300, 700, 1_000] {
        for (damping, resonance) in [(2.0, 0.0), (1.0, NINE_KELVIN), (7.0 / 3.0, -NINE_KELVIN)] {
            let configure = Configure { law: LawId::DqPi, loop_delay_us, ..CONFIGURE };
            let delay = f64::from(loop_delay_us) * 1e-6;
            let simulation =
                LawSimulation { delay, force: 0.95 * FORCE, ..LawSimulation::new(&configure, damping, resonance) };
            let periods = { simulation }.run_periods(2.0, 120);
            assert!(periods[12..].iter().all(|period| (period.amplitude - 2.0).abs() < 0.1), "{delay} s: {periods:?}");
            let last = periods[119];
            assert!((last.amplitude - 2.0).abs() < 2e-4 && last.wq.abs() < 1e-3, "{delay} s: {last:?}");
        }
    }
}

#[test]
fn given_gains_predict_over_the_delay_too() {
    let gains = Gains { amplitude_kp: 270.0, amplitude_ki: 1.1e5, frequency_kp: 1000.0, frequency_ki: 4e5 };
    let configure = Configure { law: LawId::DqPi, gains: Some(gains), loop_delay_us: 600, ..CONFIGURE };
    let periods = LawSimulation { delay: 0.6e-3, ..LawSimulation::new(&configure, 1.0, 0.0) }.run_periods(2.0, 40);
    let without = LawSimulation::new(&Configure { loop_delay_us: 0, ..configure }, 1.0, 0.0).run_periods(2.0, 40);
    for (a, b) in periods.iter().zip(&without) {
        assert!((a.actuation.drive_vpp - b.actuation.drive_vpp).abs() < 0.5, "{a:?} instead of {b:?}");
    }
}
