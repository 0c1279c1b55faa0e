//! Tests the exploration of laws of the controller's own: correct ones fail nothing, and each property
//! finds a fault.

use crate::fixtures::{configuration, judge_own_law};
use platebench_engine::SafeEnds;
use platebench_experiments::explore::exploration::Exploration;
use platebench_experiments::explore::sequence::SequenceLimits;
use platebench_experiments::explore::{ExploreConfig, ExploredLaw, OwnLaw, Property, explore, measure_own_law};
use platebench_experiments::trust::{Mutant, MutantController};
use platebench_model::record::Verdict;
use platebench_rig::{BoxedLink, CancelToken, ConnectError, HostedLink, Session};
use platebench_wire::{Configure, ControllerState, Gains, LawId, Message, Packet};
use rstest::rstest;

/// What a fault remembers.
#[derive(Default)]
struct Memory {
    configurations: u32,
    samples: u32,
    setpoint_um: f32,
    drive_vpp: f32,
    remaining: u32,
    rest_start_us: Option<u32>,
}

type Fault = fn(&mut Memory, &mut Message);

/// The hosted controller as one that announces no law. It ignores number and gains of the
/// configuration.
struct OwnController {
    law: LawId,
    response_s: f32,
    gains: Option<fn(&Configure) -> Gains>,
    /// Steps of setpoint and components, µm, and of the drive, Vpp; 0 for none.
    steps: [f32; 2],
    fault: Fault,
    memory: Memory,
}

const NO_GAINS: Gains = Gains { amplitude_kp: 0.0, amplitude_ki: 0.0, frequency_kp: 0.0, frequency_ki: 0.0 };

fn to_step(value: &mut f32, step: f32) {
    if step > 0.0 && value.is_finite() {
        *value = (*value / step).floor() * step;
    }
}

impl Mutant for OwnController {
    fn on_receive(&mut self, packet: &mut Packet) {
        match &mut packet.message {
            Message::Configure(configure) => {
                self.memory.configurations += 1;
                self.memory = Memory { configurations: self.memory.configurations, ..Memory::default() };
                configure.law = self.law;
                configure.gains = None;
                if configure.response_time_s == 0.0 {
                    configure.response_time_s = self.response_s;
                }
                let is_usable = configure.gain_um_per_vpp > 0.0 && configure.period_us > 0;
                configure.gains = self.gains.filter(|_| is_usable).map(|gains| gains(configure));
            }
            Message::Sample(sample) => {
                for value in [&mut sample.setpoint_um, &mut sample.wd_um, &mut sample.wq_um] {
                    to_step(value, self.steps[0]);
                }
            }
            _ => {}
        }
        (self.fault)(&mut self.memory, &mut packet.message);
        if let Message::Sample(sample) = &packet.message {
            self.memory.samples += 1;
            self.memory.setpoint_um = sample.setpoint_um;
        }
    }

    fn on_send(&mut self, packet: &mut Packet) {
        match &mut packet.message {
            Message::Identity(identity) => identity.laws = 0,
            Message::Configured(configured) => configured.outcome = configured.outcome.map(|_| NO_GAINS),
            Message::Command(command) if command.flags & 1 == 0 => to_step(&mut command.drive_vpp, self.steps[1]),
            _ => {}
        }
        (self.fault)(&mut self.memory, &mut packet.message);
        if let Message::Command(command) = &packet.message {
            self.memory.drive_vpp = command.drive_vpp;
        }
    }
}

fn no_fault(_: &mut Memory, _: &mut Message) {}

fn own(law: LawId, response_ms: f32) -> OwnController {
    let response_s = response_ms * 1e-3;
    OwnController { law, response_s, gains: None, steps: [0.0; 2], fault: no_fault, memory: Memory::default() }
}

/// Two real poles of the amplitude and of the frequency loop on the plate without a finger.
fn integral_only(configure: &Configure) -> Gains {
    let ki = 0.25 / configure.time_constant_s;
    let amplitude_ki = ki / configure.gain_um_per_vpp;
    Gains { amplitude_ki, frequency_ki: ki / configure.time_constant_s, ..NO_GAINS }
}

type Build = fn() -> Box<dyn Mutant>;

const CORRECT: [(&str, Build); 10] = [
    ("adaptive", || Box::new(own(LawId::DqPi, 0.0))),
    ("fixed", || Box::new(own(LawId::DqPiFixed, 0.0))),
    ("adaptive, slow", || Box::new(own(LawId::DqPi, 8.0))),
    ("adaptive, fast", || Box::new(own(LawId::DqPi, 1.2))),
    ("fixed, slow", || Box::new(own(LawId::DqPiFixed, 8.0))),
    ("fixed, fast", || Box::new(own(LawId::DqPiFixed, 1.2))),
    ("deadbeat", || Box::new(own(LawId::Deadbeat, 0.0))),
    ("integral", || Box::new(OwnController { gains: Some(integral_only), ..own(LawId::DqPiFixed, 0.0) })),
    ("fixed point", || Box::new(OwnController { steps: [1e-4, 0.0625], ..own(LawId::DqPi, 0.0) })),
    ("fixed point, fixed", || Box::new(OwnController { steps: [1e-4, 0.0625], ..own(LawId::DqPiFixed, 0.0) })),
];

struct Played {
    own: OwnLaw,
    exploration: Exploration,
}

fn play(build: fn() -> Box<dyn Mutant>, seed: u64, scenes: u64) -> Played {
    let connect =
        || -> Result<BoxedLink, ConnectError> { Ok(Box::new(MutantController::new(HostedLink::new(), build))) };
    let (cancel, ends) = (CancelToken::never(), SafeEnds::default());
    let identity = *Session::open(connect().unwrap()).unwrap().identity();
    let config = configuration(ExploredLaw::Own(OwnLaw::default()), scenes);
    let own = measure_own_law(&config.envelope, &connect, false, &cancel, &ends).unwrap().unwrap();
    let config = ExploreConfig {
        seed,
        law: ExploredLaw::Own(own),
        laws: Vec::new(),
        max_failed: u64::MAX,
        sequences: Some(SequenceLimits::new(&identity, false, true, 2_000)),
        ..config
    };
    let exploration = explore(&config, &connect, &cancel, &ends, &mut |_, _| {}).unwrap();
    Played { own, exploration }
}

fn alarms(build: fn() -> Box<dyn Mutant>, seed: u64, scenes: u64) -> Vec<String> {
    let Played { exploration, own } = play(build, seed, scenes);
    assert_eq!(exploration.scenes, scenes);
    println!("{} scenes, sequences {:?}", exploration.scenes, exploration.sequences);
    let scenes = exploration.failed.iter().map(|scene| format!("{own:?}, scene {}: {:?}", scene.index, scene.failures));
    let sequences = exploration.failed_sequences.iter();
    scenes.chain(sequences.map(|sequence| format!("sequence {}: {}", sequence.index, sequence.text))).collect()
}

#[test]
fn correct_own_laws_fail_nothing() {
    for (name, build) in CORRECT {
        assert_eq!(alarms(build, 5, 30), [""; 0], "{name}");
    }
}

/// Slow ones too.
#[rstest]
#[case("guards/slow-setpoint-ramp.toml")]
#[case("guards/slow-setpoint-sine.toml")]
#[case("guards/after-a-minute.toml")]
fn correct_own_laws_pass_a_scenario_of_every_law(#[case] file: &str) {
    for (name, build) in CORRECT {
        let judged = judge_own_law(file, build);
        assert_eq!(judged.verdict, Verdict::Pass, "{name}: {:?}", judged.expectations);
    }
}

#[test]
#[ignore = "minutes; docs/trust.md contains the result"]
fn correct_own_laws_fail_nothing_in_3000_scenes() {
    for (name, build) in CORRECT {
        assert_eq!(alarms(build, 20_261_202, 300), [""; 0], "{name}");
    }
}

fn on_command(message: &mut Message, change: impl FnOnce(&mut f32)) {
    if let Message::Command(command) = message
        && command.state == ControllerState::Running
    {
        change(&mut command.drive_vpp);
    }
}

fn creeps_at_some_levels(memory: &mut Memory, message: &mut Message) {
    let (is_slow, last) = ((1.2..1.7).contains(&memory.setpoint_um), memory.drive_vpp);
    on_command(message, |drive| *drive = if is_slow { drive.min(last + 2.0) } else { *drive });
}

fn kicks_after_a_step_up(memory: &mut Memory, message: &mut Message) {
    if let Message::Sample(sample) = message
        && memory.setpoint_um > 0.0
        && sample.setpoint_um > memory.setpoint_um
    {
        memory.remaining = 4;
    }
    let is_kicked = memory.remaining > 0;
    on_command(message, |drive| *drive = if is_kicked { drive.max(390.0) } else { *drive });
    if matches!(message, Message::Command(_)) {
        memory.remaining = memory.remaining.saturating_sub(1);
    }
}

fn wrong_table_entry(_: &mut Memory, message: &mut Message) {
    if let Message::Sample(sample) = message
        && (1.2..1.7).contains(&sample.setpoint_um)
    {
        sample.setpoint_um *= 1.03;
    }
}

fn alternates(memory: &mut Memory, message: &mut Message) {
    let factor = if memory.samples.is_multiple_of(2) { 1.04 } else { 0.96 };
    on_command(message, |drive| *drive = (*drive * factor).min(400.0));
}

fn detector_with_an_offset(_: &mut Memory, message: &mut Message) {
    if let Message::Sample(sample) = message {
        sample.wq_um += 0.04 * sample.wd_um;
    }
}

fn drives_at_rest(memory: &mut Memory, message: &mut Message) {
    let is_rest = memory.setpoint_um == 0.0;
    on_command(message, |drive| *drive = if is_rest { drive.max(10.0) } else { *drive });
}

/// Holds the drive for a while after the amplitude has left the setpoint.
fn misses_a_disturbance(memory: &mut Memory, message: &mut Message) {
    if let Message::Sample(sample) = message
        && sample.setpoint_um == memory.setpoint_um
        && memory.remaining == 0
        && memory.samples > 15
        && (sample.wd_um / sample.setpoint_um - 1.0).abs() > 0.06
    {
        memory.remaining = 300;
    }
    let (is_held, last) = (memory.remaining > 0, memory.drive_vpp);
    on_command(message, |drive| *drive = if is_held { last } else { *drive });
    if matches!(message, Message::Command(_)) {
        memory.remaining = memory.remaining.saturating_sub(1);
    }
}

fn remembers_configurations(memory: &mut Memory, message: &mut Message) {
    let offset = memory.configurations as f32 * 0.01;
    on_command(message, |drive| *drive = if *drive > offset { *drive - offset } else { *drive });
}

fn clamps_at_300_vpp(_: &mut Memory, message: &mut Message) {
    on_command(message, |drive| *drive = drive.min(300.0));
}

fn gain_depends_on_the_sign(_: &mut Memory, message: &mut Message) {
    if let Message::Sample(sample) = message
        && sample.wq_um > 0.0
    {
        sample.wq_um *= 0.5;
    }
}

fn exceeds_the_limit(memory: &mut Memory, message: &mut Message) {
    let is_high = memory.setpoint_um > 2.0;
    on_command(message, |drive| *drive = if is_high { *drive + 900.0 } else { *drive });
}

/// Holds its drive while the setpoint changes by less than 5 % per sample.
fn ignores_small_changes(memory: &mut Memory, message: &mut Message) {
    if let Message::Sample(sample) = message {
        let change = (sample.setpoint_um - memory.setpoint_um).abs();
        memory.remaining = u32::from(change > 0.0 && change < 0.05 * memory.setpoint_um);
    }
    let (is_held, last) = (memory.remaining > 0, memory.drive_vpp);
    on_command(message, |drive| *drive = if is_held { last } else { *drive });
}

fn repeats_its_start_after_65_536_samples(memory: &mut Memory, message: &mut Message) {
    let is_off = memory.samples > 65_536 && (memory.samples as u16) < 3;
    on_command(message, |drive| *drive = if is_off { 0.0 } else { *drive });
}

fn is_off_after_61_s(memory: &mut Memory, message: &mut Message) {
    let is_off = memory.samples > 61_000;
    on_command(message, |drive| *drive = if is_off { 0.0 } else { *drive });
}

fn sleeps_after_a_rest_of_3_s(memory: &mut Memory, message: &mut Message) {
    if let Message::Sample(sample) = message {
        if sample.setpoint_um == 0.0 {
            let start = *memory.rest_start_us.get_or_insert(sample.time_us);
            memory.remaining = if sample.time_us.wrapping_sub(start) >= 3_000_000 { 200 } else { 0 };
        } else {
            memory.rest_start_us = None;
            memory.remaining = memory.remaining.saturating_sub(1);
        }
    }
    let is_off = memory.remaining > 0;
    on_command(message, |drive| *drive = if is_off { 0.0 } else { *drive });
}

fn repeats_its_start_after_65_536_driven_samples(memory: &mut Memory, message: &mut Message) {
    if let Message::Sample(sample) = message
        && sample.setpoint_um > 0.0
    {
        memory.remaining += 1;
    }
    let is_off = memory.remaining > 65_536 && (memory.remaining as u16) < 3;
    on_command(message, |drive| *drive = if is_off { 0.0 } else { *drive });
}

/// Does not see a change of the force while a counter of 16 bits is negative.
fn ignores_the_amplitude_from_32_768_samples_on(memory: &mut Memory, message: &mut Message) {
    let (is_held, last) = ((32_768..65_536).contains(&memory.samples), memory.drive_vpp);
    on_command(message, |drive| *drive = if is_held { last } else { *drive });
}

fn slew_in_rad_per_s(_: &mut Memory, message: &mut Message) {
    if let Message::Configure(configure) = message {
        configure.frequency_slew_hz /= std::f32::consts::TAU;
    }
}

fn limit_of_1000_vpp(_: &mut Memory, message: &mut Message) {
    if let Message::Configure(configure) = message {
        configure.drive_limit_vpp = configure.drive_limit_vpp.min(1_000.0);
    }
}

fn rests_below_50_nm(_: &mut Memory, message: &mut Message) {
    if let Message::Sample(sample) = message
        && sample.setpoint_um < 0.05
    {
        sample.wq_um = 0.0;
    }
}

fn keeps_the_frequency_after_2000_samples_of_rest(memory: &mut Memory, message: &mut Message) {
    if let Message::Sample(sample) = message {
        let is_rest = sample.setpoint_um == 0.0 && memory.remaining < 2_000;
        memory.remaining = if is_rest { memory.remaining + 1 } else { memory.remaining / 2_000 * 2_000 };
        sample.wq_um = if memory.remaining == 2_000 { 0.0 } else { sample.wq_um };
    }
}

/// Holds its drive for 30 samples after it was at the limit for as long.
fn stays_at_the_limit(memory: &mut Memory, message: &mut Message) {
    if let Message::Command(command) = message {
        let is_saturated = command.flags & 1 != 0;
        memory.remaining =
            if is_saturated { (memory.remaining + 1).min(30) } else { memory.remaining.saturating_sub(1) };
    }
    let (is_held, last) = (memory.remaining > 10, memory.drive_vpp);
    on_command(message, |drive| *drive = if is_held { last } else { *drive });
}

fn frequency_in_f32(_: &mut Memory, message: &mut Message) {
    if let Message::Command(command) = message
        && command.state == ControllerState::Running
    {
        command.frequency_mhz = command.frequency_mhz as f32 as u32;
    }
}

fn flags_in_a_stop(_: &mut Memory, message: &mut Message) {
    if let Message::Command(command) = message
        && command.state == ControllerState::Safe
    {
        command.flags = 1;
    }
}

fn with(fault: Fault) -> Box<dyn Mutant> {
    Box::new(OwnController { fault, ..own(LawId::DqPi, 0.0) })
}

#[rstest]
#[case::settling(|| with(creeps_at_some_levels), Property::Settling)]
#[case::overshoot(|| with(kicks_after_a_step_up), Property::Overshoot)]
#[case::static_error(|| with(wrong_table_entry), Property::StaticError)]
#[case::ripple(|| with(alternates), Property::Ripple)]
#[case::frequency(|| with(detector_with_an_offset), Property::Frequency)]
#[case::rest(|| with(drives_at_rest), Property::RestDrive)]
#[case::recovery(|| with(misses_a_disturbance), Property::Recovery)]
#[case::tracking(|| with(ignores_small_changes), Property::Tracking)]
#[case::memory(|| with(remembers_configurations), Property::SameResponse)]
#[case::proportion(|| with(clamps_at_300_vpp), Property::ProportionalResponse)]
#[case::mirror(|| with(gain_depends_on_the_sign), Property::MirroredResponse)]
#[case::protocol(|| with(exceeds_the_limit), Property::Protocol)]
#[case::slew(|| with(slew_in_rad_per_s), Property::Settling)]
#[case::high_limit(|| with(limit_of_1000_vpp), Property::StaticError)]
#[case::low_setpoint(|| with(rests_below_50_nm), Property::Frequency)]
#[case::long_rest(|| with(keeps_the_frequency_after_2000_samples_of_rest), Property::Frequency)]
#[case::saturation(|| with(stays_at_the_limit), Property::RestDrive)]
#[case::f32(|| with(frequency_in_f32), Property::Answers)]
#[case::answers(|| with(flags_in_a_stop), Property::Answers)]
fn a_property_finds_a_fault_of_an_own_law(#[case] build: fn() -> Box<dyn Mutant>, #[case] property: Property) {
    let Played { exploration, .. } = play(build, 7, 120);
    let scenes = exploration.failed.iter().flat_map(|scene| &scene.failures).map(|failure| failure.property);
    let sequences = exploration.failed_sequences.iter().flat_map(|sequence| sequence.properties.iter().copied());
    let mut found: Vec<_> = scenes.chain(sequences).collect();
    found.sort_unstable();
    found.dedup();
    assert!(found.contains(&property), "{found:?}");
}

/// The long trial of the first round finds the fault.
#[rstest]
#[case::counter(|| with(repeats_its_start_after_65_536_samples), Property::Ripple)]
#[case::time(|| with(is_off_after_61_s), Property::StaticError)]
#[case::driven(|| with(repeats_its_start_after_65_536_driven_samples), Property::Ripple)]
#[case::sign(|| with(ignores_the_amplitude_from_32_768_samples_on), Property::StaticError)]
#[case::sleep(|| with(sleeps_after_a_rest_of_3_s), Property::Settling)]
fn a_long_trial_finds_a_late_fault(#[case] build: fn() -> Box<dyn Mutant>, #[case] property: Property) {
    let Played { exploration, .. } = play(build, 7, 60);
    let found: Vec<_> = exploration.failed.iter().map(|scene| (scene.index, &scene.failures[..])).collect();
    let Some((_, failures)) = found.iter().find(|(index, _)| *index == 59) else { panic!("{found:?}") };
    assert!(failures.iter().any(|failure| failure.property == property), "{failures:?}");
    assert!(exploration.failed_sequences.is_empty(), "{:?}", exploration.failed_sequences);
}
