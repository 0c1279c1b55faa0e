//! A loop of small spectral radius that never settles.

use crate::{close, plate};
use platebench_analysis::{Bench, Case, Condition, Found, Integral, PlainLoops};
use platebench_plate::Time;
use platebench_wire::{Gains, LawId};

const PERIOD: f64 = 1e-3;

fn loops(integral: Integral) -> PlainLoops {
    PlainLoops::as_printed(&plate(), integral, 2e-3, PERIOD)
}

fn start(integral: Integral, condition: Condition) -> Found {
    loops(integral).start(&plate(), condition, 2.0, 4_000)
}

fn gains(loops: &PlainLoops) -> Gains {
    Gains {
        amplitude_kp: loops.amplitude.proportional as f32,
        amplitude_ki: (loops.amplitude.integral_per_period / PERIOD) as f32,
        frequency_kp: loops.frequency.proportional as f32,
        frequency_ki: (loops.frequency.integral_per_period / PERIOD) as f32,
    }
}

#[test]
fn backward_euler_never_settles_from_a_detuned_start_though_its_spectral_radius_is_small() {
    for condition in [Condition::Resonant, Condition::Detuned] {
        let closed = loops(Integral::Backward).linear(&plate(), condition, 2.0).unwrap();
        close(closed.spectral_radius().unwrap(), 0.862, 1e-3);
    }
    assert!(start(Integral::Backward, Condition::Resonant).settled.is_some());
    let detuned = start(Integral::Backward, Condition::Detuned);
    assert_eq!(detuned.settled, None, "{detuned:?}");
    assert!(detuned.diverged);
    assert!(start(Integral::Forward, Condition::Detuned).settled.is_some());
}

#[test]
fn the_firmware_s_guards_let_the_same_gains_settle() {
    let plate = plate();
    let case = Case {
        gains: Some(gains(&loops(Integral::Backward))),
        ..Case::new(&plate, LawId::DqPiFixed, Condition::Detuned)
    };
    let mut bench = Bench::at_rest(&case).unwrap();
    let last = (0..200).map(|_| bench.period(Time::ZERO, 0.0).unwrap()).last().unwrap();
    close(last.re, 2.0, 1e-4);
    close(last.im, 0.0, 1e-4);
}
