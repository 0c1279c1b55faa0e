//! Tests that faults of classes which survived the suite before are found: state that grows with time,
//! counters and times of a minute, slow setpoints, memory of a configuration that differs in one
//! figure, values at borders, timeouts with other periods, short timeouts, and messages before the
//! first configuration. Each controller has an own law, so its commands are not compared with a
//! reference.

use crate::fixtures::judge_own_law;
use platebench_experiments::trust::{Mutant, MutantController};
use platebench_model::record::Verdict;
use platebench_rig::{BoxedLink, CancelToken, CheckOptions, HostedLink, Session, check_protocol};
use platebench_test_kit::CONFIGURE;
use platebench_wire::{Command, Configure, ControllerState, LawId, Message, Packet};
use rstest::rstest;

#[derive(Default)]
struct Memory {
    last: Option<Configure>,
    samples: u32,
    setpoint_um: f32,
    drive_vpp: f32,
    /// Samples in a row with setpoint 0, or until the drive is on again.
    rest: u32,
    dead: u32,
    is_held: bool,
}

type Fault = fn(&mut Memory, &mut Message);

/// The hosted `dq-pi` as a law without a number.
struct Faulty {
    fault: Fault,
    memory: Memory,
}

impl Mutant for Faulty {
    fn on_receive(&mut self, packet: &mut Packet) {
        if let Message::Configure(configure) = &mut packet.message {
            configure.law = LawId::DqPi;
            self.memory.samples = 0;
        }
        (self.fault)(&mut self.memory, &mut packet.message);
        match &packet.message {
            Message::Configure(configure) => self.memory.last = Some(*configure),
            Message::Sample(sample) => {
                self.memory.samples += 1;
                self.memory.setpoint_um = sample.setpoint_um;
            }
            _ => {}
        }
    }

    fn on_send(&mut self, packet: &mut Packet) {
        if let Message::Identity(identity) = &mut packet.message {
            identity.laws = 0;
        }
        (self.fault)(&mut self.memory, &mut packet.message);
        if let Message::Command(command) = &packet.message {
            self.memory.drive_vpp = command.drive_vpp;
        }
    }
}

fn with(fault: Fault) -> Box<dyn Mutant> {
    Box::new(Faulty { fault, memory: Memory::default() })
}

fn link(build: fn() -> Box<dyn Mutant>) -> BoxedLink {
    Box::new(MutantController::new(HostedLink::new(), build))
}

/// Names of the scripts with a difference, each once.
fn failing_scripts(build: fn() -> Box<dyn Mutant>) -> Vec<String> {
    let identity = *Session::open(link(build)).unwrap().identity();
    let cancel = CancelToken::never();
    let options = CheckOptions {
        own_clock: false,
        seed: 1,
        messages: &[],
        compares_numbers: false,
        own_law: true,
        long_scripts: false,
        cancel: &cancel,
    };
    let base = Configure { law: LawId::OpenLoop, ..CONFIGURE };
    let found = check_protocol(&mut link(build), &identity, &base, options).unwrap().differences;
    let mut names: Vec<_> = found.into_iter().map(|difference| difference.script).collect();
    names.dedup();
    names
}

fn on_configure(message: &mut Message, change: impl FnOnce(&mut Configure)) {
    if let Message::Configure(configure) = message {
        change(configure);
    }
}

fn none(_: &mut Memory, _: &mut Message) {}

fn keeps_a_design_of_the_same_gain_and_period(memory: &mut Memory, message: &mut Message) {
    let last = memory.last;
    on_configure(message, |configure| {
        if let Some(last) = last.filter(|last| {
            (last.period_us, last.gain_um_per_vpp) == (configure.period_us, configure.gain_um_per_vpp)
                && configure.gains.is_none()
        }) {
            configure.time_constant_s = last.time_constant_s;
        }
    });
}

fn accepts_a_response_time_that_is_no_number(_: &mut Memory, message: &mut Message) {
    on_configure(message, |configure| {
        configure.response_time_s = if configure.response_time_s.is_nan() { 0.0 } else { configure.response_time_s };
    });
}

fn accepts_a_delay_beyond_the_period(_: &mut Memory, message: &mut Message) {
    on_configure(message, |configure| {
        configure.loop_delay_us = configure.loop_delay_us.min(configure.period_us);
    });
}

fn timeout_in_periods(_: &mut Memory, message: &mut Message) {
    on_configure(message, |configure| {
        let ms = u64::from(configure.watchdog_timeout_ms) * u64::from(configure.period_us) / 1_000;
        configure.watchdog_timeout_ms = u16::try_from(ms).unwrap_or(u16::MAX);
    });
}

fn watchdog_20_percent_short(_: &mut Memory, message: &mut Message) {
    on_configure(message, |configure| {
        configure.watchdog_timeout_ms = (u32::from(configure.watchdog_timeout_ms) * 4 / 5) as u16;
    });
}

const NEAR: &str = "a watchdog near its timeout, with other periods";
const UNUSABLE: &str = "a configuration that is not accepted";

/// Only the named script finds the fault.
#[rstest]
#[case::correct(|| with(none), None)]
#[case::one_figure(|| with(keeps_a_design_of_the_same_gain_and_period), Some("configurations that differ in one figure"))]
#[case::not_a_number(|| with(accepts_a_response_time_that_is_no_number), Some(UNUSABLE))]
#[case::one_unit_beyond(|| with(accepts_a_delay_beyond_the_period), Some(UNUSABLE))]
#[case::periods(|| with(timeout_in_periods), Some(NEAR))]
#[case::short_timeout(|| with(watchdog_20_percent_short), Some(NEAR))]
fn a_script_finds_a_fault_of_an_own_law(#[case] build: fn() -> Box<dyn Mutant>, #[case] script: Option<&str>) {
    assert_eq!(failing_scripts(build), script.into_iter().collect::<Vec<_>>());
}

fn drives_before_the_first_configuration(memory: &mut Memory, message: &mut Message) {
    if let Message::Command(Command { drive_vpp, state: ControllerState::Idle, .. }) = message
        && memory.last.is_none()
    {
        *drive_vpp = 5.0;
    }
}

fn safe_is_forgotten_before_the_first_configuration(memory: &mut Memory, message: &mut Message) {
    if let Message::Command(Command { state, .. }) = message
        && memory.last.is_none()
        && memory.samples > 1
    {
        *state = ControllerState::Idle;
    }
}

fn slow_after_a_thousand_samples(memory: &mut Memory, message: &mut Message) {
    if let Message::Sample(sample) = message
        && memory.samples > 1_000
        && memory.setpoint_um > 0.0
    {
        sample.setpoint_um = memory.setpoint_um + 0.25 * (sample.setpoint_um - memory.setpoint_um);
    }
}

fn drives_after_a_long_rest(memory: &mut Memory, message: &mut Message) {
    if let Message::Command(command) = message
        && (memory.samples > 1_500 && memory.setpoint_um == 0.0)
        && command.state == ControllerState::Running
    {
        command.drive_vpp = command.drive_vpp.max(3.0);
    }
}

/// Holds its drive while the setpoint changes by less than a share of it per sample.
fn ignores(share: f32, memory: &mut Memory, message: &mut Message) {
    match message {
        Message::Sample(sample) => {
            let change = (sample.setpoint_um - memory.setpoint_um).abs();
            memory.is_held = change > 0.0 && change < share * memory.setpoint_um;
        }
        Message::Command(command) if memory.is_held && command.state == ControllerState::Running => {
            command.drive_vpp = memory.drive_vpp;
        }
        _ => {}
    }
}

fn ignores_small_changes(memory: &mut Memory, message: &mut Message) {
    ignores(0.05, memory, message);
}

fn ignores_very_small_changes(memory: &mut Memory, message: &mut Message) {
    ignores(6e-5, memory, message);
}

fn off(is_off: bool, message: &mut Message) {
    if let Message::Command(command) = message
        && is_off
        && command.state == ControllerState::Running
    {
        command.drive_vpp = 0.0;
    }
}

fn repeats_its_start_after_65_536_samples(memory: &mut Memory, message: &mut Message) {
    off(memory.samples > 65_536 && (memory.samples as u16) < 3, message);
}

fn is_off_after_61_s(memory: &mut Memory, message: &mut Message) {
    off(memory.samples > 61_000, message);
}

fn sleeps_after_a_rest_of_3_s(memory: &mut Memory, message: &mut Message) {
    if let Message::Sample(sample) = message {
        if sample.setpoint_um == 0.0 {
            memory.rest += 1;
            memory.dead = if memory.rest >= 3_000 { 200 } else { 0 };
        } else {
            memory.rest = 0;
            memory.dead = memory.dead.saturating_sub(1);
        }
    }
    off(memory.dead > 0, message);
}

#[rstest]
#[case::ramp("guards/slow-setpoint-ramp.toml", || with(ignores_small_changes))]
#[case::slow_ramp("guards/slow-setpoint-ramp.toml", || with(ignores_very_small_changes))]
#[case::sine("guards/slow-setpoint-sine.toml", || with(ignores_small_changes))]
#[case::counter("guards/after-a-minute.toml", || with(repeats_its_start_after_65_536_samples))]
#[case::time("guards/after-a-minute.toml", || with(is_off_after_61_s))]
#[case::sleep("guards/after-a-minute.toml", || with(sleeps_after_a_rest_of_3_s))]
#[case::drive("reference/before-configuration.toml", || with(drives_before_the_first_configuration))]
#[case::safe("reference/before-configuration.toml", || with(safe_is_forgotten_before_the_first_configuration))]
#[case::hold("guards/after-seconds.toml", || with(slow_after_a_thousand_samples))]
#[case::rest("guards/after-seconds.toml", || with(drives_after_a_long_rest))]
fn a_scenario_finds_a_fault_of_an_own_law(#[case] file: &str, #[case] build: fn() -> Box<dyn Mutant>) {
    for (build, verdict) in [((|| with(none)) as fn() -> Box<dyn Mutant>, Verdict::Pass), (build, Verdict::Fail)] {
        let judged = judge_own_law(file, build);
        assert_eq!(judged.verdict, verdict, "{:?}", judged.expectations);
    }
}
