//! Tests each law's reaction to single samples. `harness/engine/tests` tests the laws on a plate.

use super::example::CONFIGURE;
use super::*;
use crate::envelope::tests::reference_propagation;
use core::f32::consts::TAU;
use platebench_wire::flags;
use std::vec::Vec;

const REST: Measurement = Measurement { setpoint_um: 2.0, wd_um: 0.0, wq_um: 0.0 };
const ON_SETPOINT: Measurement = Measurement { wd_um: 2.0, ..REST };
const STOPPING: Measurement = Measurement { setpoint_um: 0.0, wd_um: 0.1, ..REST };

fn design_law(id: LawId) -> Law {
    Law::design(&Configure { law: id, ..CONFIGURE }).unwrap().0
}

#[test]
fn every_law_starts_bounded_and_stops_at_a_setpoint_of_zero() {
    for id in LawId::ALL {
        let mut law = design_law(id);
        let start = law.step(&REST);
        assert!(start.drive_vpp > 250.0 && start.drive_vpp <= CONFIGURE.drive_limit_vpp, "{}", id.name());
        for measurement in [ON_SETPOINT, REST, ON_SETPOINT] {
            law.step(&measurement);
        }
        let last = (0..200).map(|_| law.step(&STOPPING)).last().unwrap();
        assert!(last.drive_vpp < 1.0, "{}: {} Vpp", id.name(), last.drive_vpp);
    }
}

#[test]
fn every_law_keeps_range_slew_and_limit_for_any_sample() {
    let extremes = [-1e9, -3.0, -1e-3, 0.0, 1e-3, 3.0, 1e9];
    for (id, loop_delay_us) in LawId::ALL.into_iter().flat_map(|id| [(id, 0), (id, 350), (id, 1_000)]) {
        let mut law = Law::design(&Configure { law: id, loop_delay_us, ..CONFIGURE }).unwrap().0;
        let mut before = 0.0;
        // All pairs of extreme values in a fixed order; every 17th setpoint is 0.
        for (number, (wd_um, wq_um)) in
            extremes.iter().flat_map(|&wd| extremes.map(|wq| (wd, wq))).cycle().take(400).enumerate()
        {
            let setpoint_um = if number % 17 == 0 { 0.0 } else { 0.5 + (number % 5) as f32 * 0.5 };
            let actuation = law.step(&Measurement { setpoint_um, wd_um, wq_um });
            let name = id.name();
            assert!(actuation.is_finite(), "{name} {number}: {actuation:?}");
            assert!((0.0..=CONFIGURE.drive_limit_vpp).contains(&actuation.drive_vpp), "{name} {number}: {actuation:?}");
            let offset = actuation.frequency_offset_hz;
            assert!(offset.abs() <= CONFIGURE.frequency_range_hz * 1.000_001, "{name} {number}: {offset} Hz");
            assert!(
                (offset - before).abs() <= CONFIGURE.frequency_slew_hz * 1.000_01,
                "{name} {number}: {before} to {offset} Hz"
            );
            before = offset;
        }
    }
}

#[test]
fn every_law_rejects_a_delay_above_one_period() {
    for id in LawId::ALL {
        let design = |loop_delay_us| Law::design(&Configure { law: id, loop_delay_us, ..CONFIGURE });
        assert!(design(1_000).is_ok(), "{}", id.name());
        assert_eq!(design(1_001).err(), Some(Rejection::Value), "{}", id.name());
    }
}

#[test]
fn laws_without_a_frequency_loop_leave_the_frequency_alone() {
    for id in [LawId::OpenLoop, LawId::VoltageOnly] {
        let mut law = design_law(id);
        for wq_um in [-2.0, 0.5, 2.0] {
            assert_eq!(law.step(&Measurement { wq_um, ..ON_SETPOINT }).frequency_offset_hz, 0.0, "{}", id.name());
        }
    }
}

#[test]
fn voltage_only_looks_at_the_whole_amplitude() {
    let turned = Measurement { wd_um: 1.2, wq_um: 1.6, ..REST };
    assert_eq!(
        design_law(LawId::VoltageOnly).step(&turned).drive_vpp,
        design_law(LawId::VoltageOnly).step(&ON_SETPOINT).drive_vpp
    );
    assert!(design_law(LawId::DqPi).step(&turned).drive_vpp > 200.0);
}

#[test]
fn bang_bang_steps_are_constant() {
    let mut law = design_law(LawId::BangBang);
    let step = 1.0 / (20.0 * CONFIGURE.time_constant_s) / TAU;
    for (number, wq_um) in [0.001, 1.0, 0.1].into_iter().enumerate() {
        let offset = law.step(&Measurement { wq_um, ..ON_SETPOINT }).frequency_offset_hz;
        assert!((offset - step * (number + 1) as f32).abs() < 1e-3, "{offset} Hz");
    }
    let back = law.step(&Measurement { wq_um: -0.001, ..ON_SETPOINT }).frequency_offset_hz;
    assert!((back - step * 2.0).abs() < 1e-3, "{back} Hz");
    let held = law.step(&Measurement { wd_um: 0.19, wq_um: 0.0, ..REST });
    assert_eq!((held.frequency_offset_hz, held.flags & flags::FREQUENCY_HELD), (back, flags::FREQUENCY_HELD));
    let moved = law.step(&Measurement { wd_um: 0.21, wq_um: 0.0, ..REST });
    assert_eq!(moved.flags & flags::FREQUENCY_HELD, 0);
}

#[test]
fn the_pll_turns_towards_the_resonance_at_a_constant_voltage() {
    for wq_um in [0.3, -0.3] {
        let mut law = design_law(LawId::Pll);
        let actuation = law.step(&Measurement { wq_um, ..ON_SETPOINT });
        assert_eq!(actuation.frequency_offset_hz > 0.0, wq_um > 0.0);
        assert!((actuation.drive_vpp - 286.533).abs() < 1e-3);
        let low = law.step(&Measurement { wd_um: 0.5, ..REST });
        assert_eq!(low.drive_vpp, actuation.drive_vpp, "the amplitude is left to the plate");
    }
    // The phase is atan2(Wq, Wd), so a negative Wd gives an angle near 180°.
    let offset = |wd_um, wq_um| design_law(LawId::Pll).step(&Measurement { wd_um, wq_um, ..REST }).frequency_offset_hz;
    assert!(offset(-1.0, 0.1) > offset(1.0, 0.1) * 5.0);
}

#[test]
fn frequency_only_stays_above_the_resonance() {
    let mut law = design_law(LawId::FrequencyOnly);
    let first = law.step(&REST);
    // Detuning √((0.00698 · 450 / 2)² − 1) / (2π · 1.88 ms) = 102.58 Hz; the slew limit is 100 Hz.
    assert_eq!((first.drive_vpp, first.frequency_offset_hz), (450.0, CONFIGURE.frequency_slew_hz));
    let high = law.step(&Measurement { wd_um: 2.1, ..REST }).frequency_offset_hz;
    assert!(high > first.frequency_offset_hz, "too much amplitude leads away from the resonance");
    let low = (0..100).map(|_| law.step(&REST)).last().unwrap();
    assert_eq!((low.frequency_offset_hz, low.flags & flags::FREQUENCY_LIMITED), (0.0, flags::FREQUENCY_LIMITED));
}

#[test]
fn given_gains_replace_every_designed_one() {
    let gains = Gains { amplitude_kp: 10.0, amplitude_ki: 0.0, frequency_kp: 0.0, frequency_ki: 200.0 };
    for id in [LawId::VoltageOnly, LawId::BangBang] {
        let (mut law, reported) = Law::design(&Configure { law: id, gains: Some(gains), ..CONFIGURE }).unwrap();
        assert_eq!(reported.amplitude_kp, 10.0);
        assert_eq!(law.step(&REST).drive_vpp, 20.0, "{}", id.name());
    }
    let given = Configure { law: LawId::FrequencyOnly, gains: Some(gains), ..CONFIGURE };
    let mut law = Law::design(&given).unwrap().0;
    law.step(&REST);
    // The gain of 200 rad/s per unit and second acts for 1 ms on an error of one half: 0.1 rad/s.
    let moved = law.step(&Measurement { wd_um: 1.0, ..REST }).frequency_offset_hz - CONFIGURE.frequency_slew_hz;
    assert!((moved + 0.1 / TAU).abs() < 1e-4, "{moved} Hz");
}

// Simulates a law on the envelope in f64, for the tests of the laws.

pub(crate) const SIGMA: f64 = 1.0 / 1.88e-3;
pub(crate) const FORCE: f64 = 0.00698 * SIGMA;
pub(crate) const PERIOD: f64 = 1e-3;
/// Shift of the resonance by 9 K, rad/s.
pub(crate) const NINE_KELVIN: f64 = 544.8;

pub(crate) struct LawSimulation {
    pub(crate) law: Law,
    pub(crate) w: (f64, f64),
    /// Drive in Vpp and frequency offset in rad/s.
    pub(crate) acting_drive: (f64, f64),
    /// σ/σ0
    pub(crate) damping: f64,
    /// Resonance relative to the start frequency, rad/s.
    pub(crate) resonance: f64,
    /// b, µm/s per Vpp.
    pub(crate) force: f64,
    /// Loop delay from sampling to actuation, s.
    pub(crate) delay: f64,
    /// The next `damping` and the time within the next period at which it begins, s.
    pub(crate) next_damping: Option<(f64, f64)>,
}

#[derive(Debug, Clone, Copy)]
pub(crate) struct SimulatedPeriod {
    pub(crate) amplitude: f64,
    pub(crate) wq: f64,
    pub(crate) actuation: Actuation,
}

impl LawSimulation {
    pub(crate) fn new(configure: &Configure, damping: f64, resonance: f64) -> Self {
        let law = Law::design(configure).unwrap().0;
        Self {
            law,
            w: (0.0, 0.0),
            acting_drive: (0.0, 0.0),
            damping,
            resonance,
            force: FORCE,
            delay: 0.0,
            next_damping: None,
        }
    }

    pub(crate) fn change_damping(&mut self, damping: f64, share: f64) {
        self.next_damping = Some((damping, share * PERIOD));
    }

    fn advance(&mut self, seconds: f64) {
        let (vpp, offset) = self.acting_drive;
        self.w = reference_propagation(self.w, self.force, self.damping * SIGMA, offset - self.resonance, vpp, seconds);
    }

    pub(crate) fn run_periods(&mut self, setpoint_um: f64, periods: u32) -> Vec<SimulatedPeriod> {
        (0..periods).map(|_| self.run_period(setpoint_um)).collect()
    }

    pub(crate) fn run_period(&mut self, setpoint_um: f64) -> SimulatedPeriod {
        let (wd, wq) = self.w;
        let measurement = Measurement { setpoint_um: setpoint_um as f32, wd_um: wd as f32, wq_um: wq as f32 };
        let actuation = self.law.step(&measurement);
        self.advance(self.delay);
        self.acting_drive =
            (f64::from(actuation.drive_vpp), f64::from(actuation.frequency_offset_hz) * core::f64::consts::TAU);
        match self.next_damping.take() {
            Some((damping, after)) => {
                self.advance(after);
                self.damping = damping;
                self.advance(PERIOD - self.delay - after);
            }
            None => self.advance(PERIOD - self.delay),
        }
        SimulatedPeriod { amplitude: wd.hypot(wq), wq, actuation }
    }
}
