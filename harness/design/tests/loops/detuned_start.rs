//! Tests a loop with a small spectral radius that never settles from a detuned start.

use crate::assert_close;
use platebench_design::law_loops::{LoopCase, OperatingCondition, PlainLoops, StartResult, loop_at_rest};
use platebench_design::loops::Discretisation;
use platebench_plate::Time;
use platebench_test_kit::paper_plate;
use platebench_wire::{Gains, LawId};

const PERIOD: f64 = 1e-3;

fn plain_loops(discretisation: Discretisation) -> PlainLoops {
    PlainLoops::new(&paper_plate(), discretisation, 2e-3, PERIOD)
}

fn start(discretisation: Discretisation, condition: OperatingCondition) -> StartResult {
    plain_loops(discretisation).simulate_start(&paper_plate(), condition, 2.0, 4_000)
}

fn firmware_gains(loops: &PlainLoops) -> Gains {
    Gains {
        amplitude_kp: loops.amplitude.proportional as f32,
        amplitude_ki: (loops.amplitude.integral_per_period / PERIOD) as f32,
        frequency_kp: loops.frequency.proportional as f32,
        frequency_ki: (loops.frequency.integral_per_period / PERIOD) as f32,
    }
}

#[test]
fn backward_euler_never_settles_from_a_detuned_start() {
    for condition in [OperatingCondition::Resonant, OperatingCondition::Detuned] {
        let closed = plain_loops(Discretisation::Backward).linearise(&paper_plate(), condition, 2.0).unwrap();
        assert_close(closed.spectral_radius().unwrap(), 0.862, 1e-3);
    }
    assert!(start(Discretisation::Backward, OperatingCondition::Resonant).settled.is_some());
    let detuned = start(Discretisation::Backward, OperatingCondition::Detuned);
    assert_eq!(detuned.settled, None, "{detuned:?}");
    assert!(detuned.diverged);
    assert!(start(Discretisation::Forward, OperatingCondition::Detuned).settled.is_some());
}

#[test]
fn the_firmware_settles_with_the_same_gains() {
    let plate = paper_plate();
    let case = LoopCase {
        gains: Some(firmware_gains(&plain_loops(Discretisation::Backward))),
        ..LoopCase::new(&plate, LawId::DqPiFixed, OperatingCondition::Detuned)
    };
    let mut bench = loop_at_rest(&case).unwrap();
    let last = (0..200).map(|_| bench.step(Time::ZERO, 0.0).unwrap()).last().unwrap();
    assert_close(last.re, 2.0, 1e-4);
    assert_close(last.im, 0.0, 1e-4);
}
