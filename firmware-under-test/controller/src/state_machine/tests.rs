//! Tests each transition of the state diagram, and both sides of each limit.

use super::*;
use crate::law::example::CONFIGURE;
use platebench_wire::{LawId, flags};

const AT_SETPOINT: Sample = Sample { time_us: 0, setpoint_um: 2.0, wd_um: 2.0, wq_um: 0.0 };
const FROM_REST: Sample = Sample { time_us: 0, setpoint_um: 2.0, wd_um: 0.0, wq_um: 0.0 };

#[track_caller]
fn assert_fault(command: &Command, cause: StateCause) {
    assert_eq!((command.state, command.cause, command.drive_vpp), (ControllerState::Fault, cause, 0.0));
}

fn running_machine() -> StateMachine {
    let mut machine = StateMachine::new();
    machine.configure(&CONFIGURE).outcome.unwrap();
    let command = machine.sample(&FROM_REST, 0);
    assert_eq!(command.state, ControllerState::Running);
    assert!(command.drive_vpp > 500.0);
    machine
}

#[test]
fn nothing_is_driven_without_a_design() {
    let mut machine = StateMachine::new();
    let command = machine.sample(&FROM_REST, 5);
    assert_eq!((command.state, command.drive_vpp, command.target_time_us), (ControllerState::Idle, 0.0, 5));
}

#[test]
fn configuring_stops_a_running_plate_until_the_next_sample() {
    let mut machine = running_machine();
    machine.configure(&CONFIGURE).outcome.unwrap();
    assert_eq!((machine.output().state, machine.output().drive_vpp), (ControllerState::Idle, 0.0));
    assert_eq!(machine.sample(&FROM_REST, 10).state, ControllerState::Running);
}

#[test]
fn a_refused_configuration_leaves_nothing_to_run() {
    for bad in [0.0, -1.0, f32::NAN, f32::INFINITY] {
        let mut machine = running_machine();
        let refused = machine.configure(&Configure { time_constant_s: bad, ..CONFIGURE });
        assert_eq!(refused.outcome, Err(Rejection::Value), "{bad}");
        assert_eq!(machine.output().drive_vpp, 0.0);
        assert_eq!(machine.sample(&FROM_REST, 0).state, ControllerState::Idle);
    }
    let mut machine = StateMachine::new();
    assert_eq!(machine.configure(&Configure { period_us: 0, ..CONFIGURE }).outcome, Err(Rejection::Value));
}

#[test]
fn the_fifth_period_without_a_sample_is_a_timeout() {
    let mut machine = running_machine();
    assert_eq!(machine.tick(4_999), None);
    let command = machine.tick(5_000).unwrap();
    assert_fault(&command, StateCause::SampleTimeout);
    assert_eq!(machine.tick(6_000), None, "sent once");

    let mut late = running_machine();
    assert_eq!(late.sample(&AT_SETPOINT, 4_999).state, ControllerState::Running);
    assert_eq!(late.sample(&AT_SETPOINT, 9_999).cause, StateCause::SampleTimeout);
}

#[test]
fn a_configured_watchdog_replaces_the_default() {
    for (timeout_ms, last_good) in [(1, 999), (20, 19_999), (u16::MAX, 65_534_999)] {
        let mut machine = StateMachine::new();
        machine.configure(&Configure { watchdog_timeout_ms: timeout_ms, ..CONFIGURE }).outcome.unwrap();
        machine.sample(&FROM_REST, 0);
        assert_eq!(machine.tick(last_good), None, "{timeout_ms}");
        let mut late = machine;
        assert_eq!(late.sample(&AT_SETPOINT, last_good).state, ControllerState::Running);
        assert_eq!(machine.tick(last_good + 1).unwrap().cause, StateCause::SampleTimeout);
        assert_eq!(machine.sample(&AT_SETPOINT, last_good + 1).drive_vpp, 0.0);
    }
}

#[test]
fn the_clock_may_wrap() {
    let mut machine = StateMachine::new();
    machine.configure(&CONFIGURE).outcome.unwrap();
    machine.sample(&FROM_REST, u32::MAX - 1_000);
    assert_eq!(machine.tick(3_998), None);
    assert!(machine.tick(3_999).is_some());
}

#[test]
fn the_fifth_rejected_frame_in_a_row_is_line_noise() {
    let mut machine = running_machine();
    for _ in 0..4 {
        assert_eq!(machine.count_rejected_frame(10), None);
    }
    let command = machine.count_rejected_frame(20).unwrap();
    assert_fault(&command, StateCause::LineNoise);
}

#[test]
fn one_rejected_frame_in_three_is_tolerated_one_in_two_is_not() {
    let mut every_third = running_machine();
    for period in 1..300 {
        if period % 3 == 0 {
            assert_eq!(every_third.count_rejected_frame(period * 1_000), None);
        } else {
            assert_eq!(every_third.sample(&AT_SETPOINT, period * 1_000).state, ControllerState::Running);
        }
    }
    let mut every_second = running_machine();
    let faults = (1..60).filter(|period| {
        every_second.sample(&AT_SETPOINT, period * 1_000);
        every_second.count_rejected_frame(period * 1_000).is_some()
    });
    assert_eq!(faults.count(), 1);
}

#[test]
fn a_value_that_is_not_finite_is_a_lasting_fault() {
    for bad in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
        for sample in [
            Sample { setpoint_um: bad, ..AT_SETPOINT },
            Sample { wd_um: bad, ..AT_SETPOINT },
            Sample { wq_um: bad, ..AT_SETPOINT },
        ] {
            let mut machine = running_machine();
            let command = machine.sample(&sample, 1_000);
            assert_fault(&command, StateCause::NonFinite);
            assert_eq!(machine.sample(&AT_SETPOINT, 2_000).drive_vpp, 0.0);
        }
    }
    // The sample is finite, but the law's arithmetic overflows.
    let mut machine = running_machine();
    machine.sample(&Sample { setpoint_um: f32::MAX, wd_um: f32::MIN, ..AT_SETPOINT }, 1_000);
    let command = machine.sample(&AT_SETPOINT, 2_000);
    assert!(command.drive_vpp.is_finite());
}

#[test]
fn safe_holds_until_a_new_configuration() {
    let mut machine = running_machine();
    let command = machine.enter_safe(1_000);
    assert_eq!((command.state, command.drive_vpp), (ControllerState::Safe, 0.0));
    assert_eq!(machine.sample(&FROM_REST, 2_000).drive_vpp, 0.0);
    machine.configure(&CONFIGURE).outcome.unwrap();
    assert!(machine.sample(&FROM_REST, 3_000).drive_vpp > 0.0);
}

#[test]
fn the_frequency_loop_is_held_at_start_up_and_then_bounded() {
    let mut machine = StateMachine::new();
    machine.configure(&CONFIGURE).outcome.unwrap();
    let noise = Sample { wd_um: 1e-6, wq_um: -0.3, ..FROM_REST };
    let command = machine.sample(&noise, 0);
    assert_eq!(command.frequency_mhz, CONFIGURE.start_frequency_mhz);
    assert_eq!(command.flags & flags::FREQUENCY_HELD, flags::FREQUENCY_HELD);
    let slew_mhz = (CONFIGURE.frequency_slew_hz * 1000.0) as u32;
    let range_mhz = (CONFIGURE.frequency_range_hz * 1000.0) as u32;
    let mut before = command.frequency_mhz;
    for period in 1..100 {
        let command = machine.sample(&Sample { wq_um: -100.0, ..AT_SETPOINT }, period * 1_000);
        assert!(before.abs_diff(command.frequency_mhz) <= slew_mhz + 1);
        assert_eq!(command.flags & flags::FREQUENCY_LIMITED, flags::FREQUENCY_LIMITED);
        before = command.frequency_mhz;
    }
    assert!(before.abs_diff(CONFIGURE.start_frequency_mhz - range_mhz) <= 1);
}

#[test]
fn driven_below_resonance_the_frequency_rises() {
    // Wq > 0 means ω < ω0, because in the steady state Wq/Wd = −τ Δω.
    let mut machine = running_machine();
    let command = machine.sample(&Sample { wq_um: 0.1, ..AT_SETPOINT }, 1_000);
    assert!(command.frequency_mhz > CONFIGURE.start_frequency_mhz);
}

#[test]
fn the_drive_keeps_to_its_limits() {
    let mut machine = StateMachine::new();
    machine.configure(&Configure { drive_limit_vpp: 400.0, ..CONFIGURE }).outcome.unwrap();
    let command = machine.sample(&FROM_REST, 0);
    assert_eq!((command.drive_vpp, command.flags & flags::SATURATED), (400.0, flags::SATURATED));
    for period in 1..50 {
        let command = machine.sample(&Sample { setpoint_um: 0.0, ..AT_SETPOINT }, period * 1_000);
        assert!(command.drive_vpp >= 0.0);
    }
}

#[test]
fn given_gains_replace_the_design() {
    let given = platebench_wire::Gains { amplitude_kp: 10.0, amplitude_ki: 0.0, frequency_kp: 0.0, frequency_ki: 0.0 };
    let mut machine = StateMachine::new();
    let outcome = machine.configure(&Configure { gains: Some(given), ..CONFIGURE }).outcome;
    assert_eq!(outcome, Ok(given));
    assert_eq!(machine.sample(&FROM_REST, 0).drive_vpp, 20.0);
}

#[test]
fn open_loop_gives_the_drive_of_an_undisturbed_plate() {
    let mut machine = StateMachine::new();
    machine.configure(&Configure { law: LawId::OpenLoop, ..CONFIGURE }).outcome.unwrap();
    let command = machine.sample(&AT_SETPOINT, 0);
    assert!((command.drive_vpp - 286.533).abs() < 1e-3);
    assert_eq!(command.frequency_mhz, CONFIGURE.start_frequency_mhz);
}
