use super::*;
use crate::scripted_link::{ScriptedLink, commands, packets};
use crate::session::Session;
use platebench_model::scenario::ConfigurationChange;
use platebench_test_kit::CONFIGURE;
use platebench_wire::{Command, ControllerState, Gains, LawId, Message, Packet, Rejection, StateCause};
use rstest::rstest;
use std::f64::consts::TAU;
use std::sync::LazyLock;

/// From the table `configuration` of `scripts.toml`.
const CONFIGURED_AMPLITUDE_KP: f32 = 275.0;

fn scripts() -> CheckOptions<'static> {
    static NEVER: LazyLock<CancelToken> = LazyLock::new(CancelToken::never);
    CheckOptions {
        own_clock: false,
        seed: 1,
        messages: &[],
        compares_numbers: false,
        own_law: false,
        long_scripts: false,
        cancel: &NEVER,
    }
}

struct ChangedAnswers<F> {
    device: HostedLink,
    exchanges: usize,
    kind: LinkKind,
    change: F,
}

impl<F: FnMut(usize, &mut Vec<Packet>)> ChangedAnswers<F> {
    fn append(&mut self, own: &[u8], received: &mut Vec<u8>) {
        let mut packets = packets(own);
        (self.change)(self.exchanges, &mut packets);
        for packet in packets {
            received.extend_from_slice(packet.encode().as_bytes());
        }
    }
}

impl<F: FnMut(usize, &mut Vec<Packet>) + Send> Link for ChangedAnswers<F> {
    fn exchange(&mut self, now: Duration, bytes: &[u8], answer: &mut Vec<u8>) -> Result<Duration, LinkError> {
        let mut own = Vec::new();
        self.device.exchange(now, bytes, &mut own)?;
        self.exchanges += 1;
        self.append(&own, answer);
        Ok(Duration::ZERO)
    }

    fn advance_to(&mut self, now: Duration, received: &mut Vec<u8>) -> Result<(), LinkError> {
        let mut own = Vec::new();
        self.device.advance_to(now, &mut own)?;
        self.append(&own, received);
        Ok(())
    }

    fn kind(&self) -> LinkKind {
        self.kind
    }
}

fn check(
    kind: LinkKind,
    options: CheckOptions<'_>,
    change: impl FnMut(usize, &mut Vec<Packet>) + Send,
) -> ProtocolCheck {
    let mut link = ChangedAnswers { device: HostedLink::new(), exchanges: 0, kind, change };
    check_protocol(&mut link, &identity(), &CONFIGURE, options).unwrap()
}

fn identity() -> Identity {
    *Session::open(HostedLink::new()).unwrap().identity()
}

fn texts(check: &ProtocolCheck) -> Vec<String> {
    check.differences.iter().map(ToString::to_string).collect()
}

fn differences(change: impl FnMut(usize, &mut Vec<Packet>) + Send) -> Vec<String> {
    texts(&check(LinkKind::Simulated, scripts(), change))
}

/// Returns a controller that designs its gains for a plate gain K1 multiplied by the first factor,
/// and multiplies all gains by the second one.
fn link_with_other_design(factors: [f32; 2]) -> impl Link {
    ScriptedLink::new(move |controller, now, bytes, answer| match packets(bytes).as_slice() {
        [Packet { sequence, message: Message::Configure(configure) }] => {
            let [gain, design] = if configure.gains.is_none() { factors } else { [factors[0], 1.0] };
            let message = Message::Configure(Configure {
                gain_um_per_vpp: configure.gain_um_per_vpp * gain,
                response_time_s: script::scaled_response_time(configure, design),
                ..*configure
            });
            controller.exchange(now, Packet { sequence: *sequence, message }.encode().as_bytes(), answer)
        }
        _ => controller.exchange(now, bytes, answer),
    })
}

#[rstest]
#[case::lower([1.05, 1.0], &[])]
#[case::higher([1.0 / 1.05, 1.0], &[])]
#[case::both_loops_lower([1.0, 0.95], &[])]
#[case::both_loops_higher([1.0, 1.05], &[])]
#[case::another_plate([1.0 / 1.2, 1.0],
    &["random samples with the law's own design",
    "gains of the law's own design", "gains that are not used", "configurations that differ in one figure"])]
fn a_design_may_be_five_percent_off(#[case] factors: [f32; 2], #[case] expected: &[&str]) {
    let mut link = link_with_other_design(factors);
    let mut found = texts(&check_protocol(&mut link, &identity(), &CONFIGURE, scripts()).unwrap());
    found.sort_unstable();
    assert_eq!(names(&found).iter().filter(|name| !expected.contains(name)).count(), 0, "{found:?}");
    assert_eq!(found.is_empty(), expected.is_empty());
}

fn names(found: &[String]) -> Vec<&str> {
    let mut names: Vec<_> = found.iter().filter_map(|text| text.split(':').next()).collect();
    names.dedup();
    names
}

#[rstest]
#[case::same(1.0, false)]
#[case::just_inside(0.9991, false)]
#[case::just_outside(0.998, true)]
fn a_drive_may_differ_by_a_thousandth_of_its_limit(#[case] factor: f32, #[case] differs: bool) {
    let found = differences(|_, packets| {
        for command in commands(packets) {
            command.drive_vpp *= factor;
        }
    });
    assert_eq!(!found.is_empty(), differs, "{found:?}");
}

#[test]
fn a_limit_of_whole_volts_differs() {
    let found = differences(|_, packets| {
        for command in commands(packets).filter(|command| command.drive_vpp == 9.75) {
            command.drive_vpp = 9.0;
        }
    });
    assert_eq!(names(&found), ["a drive limit with a fraction"]);
}

/// 0.1 % of the range are 2 mHz.
#[rstest]
#[case::largest_rounding(5, 0)]
#[case::more(6, 1)]
fn a_reported_frequency_may_differ_by_five_millihertz(#[case] offset_mhz: u32, #[case] differences: usize) {
    let narrow = ConfigurationChange {
        frequency_range_hz: Some(2.0_f32.into()),
        frequency_slew_hz: Some(2.0_f32.into()),
        ..Default::default()
    };
    let messages = [ScenarioMessage::Configure(narrow), ScenarioMessage::sample(2.0, 1.0, 0.001)];
    let change = |_, packets: &mut Vec<Packet>| {
        for command in commands(packets).filter(|command| command.state == ControllerState::Running) {
            command.frequency_mhz += offset_mhz;
        }
    };
    let options = CheckOptions { messages: &messages, compares_numbers: true, ..scripts() };
    let found = texts(&check(LinkKind::Simulated, options, change));
    assert_eq!(found.len(), differences, "{found:?}");
}

/// f32 resolves 2π · 32 kHz to 2^-6 rad/s.
#[test]
fn an_angular_frequency_in_single_precision_is_correct() {
    let found = differences(|_, packets| {
        for command in commands(packets) {
            let omega = (f64::from(command.frequency_mhz) * 1e-3 * TAU) as f32;
            command.frequency_mhz = (f64::from(omega) / TAU * 1e3).round() as u32;
        }
    });
    assert_eq!(found, [""; 0]);
}

/// Half the drive under every law but `dq-pi`, with the reference.
#[rstest]
#[case::deadbeat(LawId::Deadbeat, 0)]
#[case::pll(LawId::Pll, 0)]
#[case::dq_pi_fixed(LawId::DqPiFixed, 1)]
fn the_law_of_a_configuration_decides_what_is_compared(#[case] law: LawId, #[case] differences: usize) {
    let configure =
        |law: LawId| ScenarioMessage::Configure(ConfigurationChange { law: Some(law as u8), ..Default::default() });
    let messages = [
        configure(LawId::DqPi),
        ScenarioMessage::sample(2.0, 1.2, -0.2),
        configure(law),
        ScenarioMessage::sample(2.0, 1.2, -0.2),
    ];
    let mut configurations = 0;
    let change = |_, packets: &mut Vec<Packet>| {
        configurations += packets.iter().filter(|packet| matches!(packet.message, Message::Configured(_))).count();
        for command in commands(packets).filter(|_| configurations > 1) {
            command.drive_vpp *= 0.5;
            command.flags = 0;
        }
    };
    let options = CheckOptions { messages: &messages, compares_numbers: true, ..scripts() };
    let found = texts(&check(LinkKind::Simulated, options, change));
    assert_eq!(found.len(), differences, "{found:?}");
}

#[rstest]
fn the_built_in_scripts_are_valid(#[values(0, 15)] capabilities: u8, #[values(false, true)] own_law: bool) {
    let identity = Identity { capabilities, ..identity() };
    let all = scripts::scripts(&CONFIGURE, &identity, 1, own_law).unwrap();
    // Two scripts need ticks, one a loop delay; one needs a controller without a plate of its own, five one without
    // a law of its own.
    let of_capabilities = if capabilities == 0 { 1 } else { 3 };
    assert_eq!(all.len(), 131 + of_capabilities + if own_law { 0 } else { 5 });
    for Script { name, messages, .. } in &all {
        assert!(!name.is_empty() && matches!(messages.first(), Some(ScenarioMessage::Configure(_))), "{name}");
        for (at, message) in messages.iter().enumerate() {
            match message {
                ScenarioMessage::Body { hex } | ScenarioMessage::Bytes { hex } => {
                    let number = matches!(message, ScenarioMessage::Body { .. }).then_some(0);
                    let bytes = ScenarioMessage::bytes_of(hex, number);
                    assert!(bytes.is_some_and(|bytes| !bytes.is_empty()), "{name}: {hex}");
                }
                ScenarioMessage::Again { messages, .. } => assert!((1..=at).contains(&(*messages as usize)), "{name}"),
                _ => {}
            }
        }
    }
}

#[rstest]
#[case::name(r#"messages = ["configure"]"#, "x: `configure`, expected a name of [message]")]
#[case::element(r#"messages = ["each"]"#, "x: `each` without an element, expected `each` of the script")]
#[case::nested(
    r#"messages = ["each"]
each = ["each"]"#,
    "x: `each` without an element"
)]
#[case::key("messages = []\nstal_us = 250", "unknown field `stal_us`")]
#[case::condition(r#"condition = "tick""#, "unknown variant `tick`")]
#[case::value("messages = [[2.0, 1.2]]", "TOML parse error at line 5, column 12")]
fn an_invalid_file_is_an_error(#[case] script: &str, #[case] message: &str) {
    let file = format!("configuration = {{}}\nmessage = {{}}\n[[script]]\nname = 'x'\n{script}\n");
    let error = scripts::scripts_of(&file, &CONFIGURE, &identity(), false).unwrap_err();
    assert!(error.contains(message), "{error}");
}

/// The result must not depend on a measured speed.
#[rstest]
#[case::simulated(false, false, false)]
#[case::wall_time(true, false, true)]
#[case::requested(true, true, false)]
fn only_an_option_decides_which_scripts_are_played(
    #[case] own_clock: bool,
    #[case] long_scripts: bool,
    #[case] is_omitted: bool,
) {
    let options = CheckOptions { own_clock, long_scripts, ..scripts() };
    let all = scripts::scripts(&CONFIGURE, &identity(), 1, false).unwrap();
    let omitted: Vec<_> = all.iter().filter(|script| options.omits(script)).map(|script| &*script.name).collect();
    assert_eq!(omitted, &["more samples than sixteen bits count"][..usize::from(is_omitted)]);
}

#[test]
fn a_cancellation_ends_the_check() {
    let cancel = CancelToken::never();
    cancel.cancel();
    let mut exchanges = 0;
    let change = |number, _: &mut Vec<Packet>| exchanges = number;
    check(LinkKind::Lossless, CheckOptions { own_clock: true, cancel: &cancel, ..scripts() }, change);
    assert_eq!(exchanges, 0);
}

#[test]
fn a_frequency_may_be_rounded_to_two_millihertz() {
    let found = differences(|_, packets| {
        for command in commands(packets) {
            command.frequency_mhz &= !1;
        }
    });
    assert_eq!(found, [""; 0]);
}

fn play_messages(messages: &[ScenarioMessage], change: impl FnMut(usize, &mut Vec<Packet>) + Send) -> Vec<String> {
    texts(&check(LinkKind::Simulated, CheckOptions { messages, ..scripts() }, change))
}

/// Three samples, a stop, and the same samples after the next configuration.
fn resumed() -> Vec<ScenarioMessage> {
    let sample = |wd: f32| ScenarioMessage::sample(2.0, wd, -0.2);
    let trial = [ScenarioMessage::Configure(ConfigurationChange::default()), sample(0.1), sample(1.2), sample(1.8)];
    [&trial[..], &[ScenarioMessage::Safe {}], &trial].concat()
}

#[rstest]
#[case::in_a_stop(ControllerState::Safe, 1, "flags 1 in the state Safe, expected 0")]
#[case::below_the_limit(ControllerState::Running, 1, "flag 1 at ")]
#[case::both(ControllerState::Running, 6, "flags 6, expected 2 or 4 but not both")]
fn flags_follow_from_state_and_drive(#[case] state: ControllerState, #[case] flags: u8, #[case] text: &str) {
    let found = play_messages(&resumed(), |_, packets| {
        for command in commands(packets).filter(|command| command.state == state) {
            command.flags = flags;
        }
    });
    assert!(found.len() == 1 && found[0].contains(text), "{found:?}");
}

/// The same samples at three scales. A law with a fixed offset of the drive is not in proportion.
#[rstest]
#[case::in_proportion(0.0, 0)]
#[case::with_an_offset(5.0, 1)]
fn samples_in_proportion_have_drives_in_proportion(#[case] offset_vpp: f32, #[case] differences: usize) {
    let trial = |scale: f32| {
        let limit = ConfigurationChange { drive_limit_vpp: Some((900.0 * scale).into()), ..Default::default() };
        let sample = |wd: f32| ScenarioMessage::sample(2.0 * scale, wd * scale, -0.2 * scale);
        [ScenarioMessage::Configure(limit), sample(1.7), sample(1.8)]
    };
    let found = play_messages(&[trial(1.0), trial(0.5), trial(2.0)].concat(), |_, packets| {
        for command in commands(packets).filter(|command| command.state == ControllerState::Running) {
            command.drive_vpp += offset_vpp;
        }
    });
    assert_eq!(found.len(), differences, "{found:?}");
}

#[test]
fn a_law_of_its_own_has_its_own_figures() {
    let found = play_messages(&resumed(), |_, packets| {
        for command in commands(packets) {
            command.drive_vpp *= 0.5;
        }
    });
    assert_eq!(found, [""; 0]);
}

/// A configuration with a gain that is not finite, its sample, and a usable configuration with one.
#[rstest]
#[case::own_law_rejects(LawId::OpenLoop, true, true, 0.0, 0)]
#[case::own_law_rejects_and_drives(LawId::OpenLoop, true, true, 1.0, 1)]
#[case::own_law_accepts(LawId::DqPi, true, false, 1.0, 0)]
#[case::own_law_accepts_and_exceeds_the_limit(LawId::DqPi, true, false, 900.5, 1)]
#[case::law_without_this_gain_rejects(LawId::OpenLoop, false, true, 0.0, 0)]
#[case::law_with_this_gain_accepts(LawId::DqPi, false, false, 1.0, 1)]
fn a_law_may_ignore_a_gain_that_is_not_finite(
    #[case] law: LawId,
    #[case] own_law: bool,
    #[case] rejects: bool,
    #[case] drive_vpp: f32,
    #[case] differences: usize,
) {
    let configure = |gains: &str| {
        let text = format!("kind = 'configure'\nlaw = {}\n{gains}", law as u8);
        toml::from_str::<ScenarioMessage>(&text).unwrap()
    };
    let sample = ScenarioMessage::sample(2.0, 1.2, -0.2);
    let messages = [configure("gains = ['nan', 1.0, 1.0, 1.0]"), sample.clone(), configure(""), sample];
    let mut configurations = 0;
    let change = |_, packets: &mut Vec<Packet>| {
        for packet in packets.iter_mut() {
            configurations += usize::from(matches!(packet.message, Message::Configured(_)));
            if configurations != 1 {
                continue;
            }
            match &mut packet.message {
                Message::Configured(configured) if rejects => configured.outcome = Err(Rejection::Value),
                Message::Configured(configured) => configured.outcome = Ok(NO_GAINS),
                Message::Command(command) if rejects => {
                    (command.state, command.drive_vpp, command.flags) = (ControllerState::Idle, drive_vpp, 0);
                }
                Message::Command(command) => {
                    (command.state, command.drive_vpp) = (ControllerState::Running, drive_vpp);
                    command.frequency_mhz = CONFIGURE.start_frequency_mhz;
                }
                _ => {}
            }
        }
    };
    let options = CheckOptions { messages: &messages, own_law, ..scripts() };
    let found = texts(&check(LinkKind::Simulated, options, change));
    assert_eq!(found.len(), differences, "{found:?}");
}

const NO_GAINS: Gains = Gains { amplitude_kp: 0.0, amplitude_ki: 0.0, frequency_kp: 0.0, frequency_ki: 0.0 };

#[test]
fn a_state_that_a_configuration_keeps_differs() {
    let mut configurations = 0;
    let found = play_messages(&resumed(), |_, packets| {
        configurations += packets.iter().filter(|packet| matches!(packet.message, Message::Configured(_))).count();
        for command in commands(packets).filter(|_| configurations == 2) {
            command.drive_vpp *= 0.5;
        }
    });
    assert_eq!(found.len(), 1);
    assert!(found[0].contains("but after an earlier configuration with the same samples"), "{found:?}");
}

#[rstest]
#[case::a_drive_above_its_limit(|command: &mut Command| command.drive_vpp = 900.5, "a drive of 900.5 Vpp")]
#[case::a_frequency_step(|command: &mut Command| command.frequency_mhz += 200_010, "a frequency step of")]
#[case::a_drive_after_a_stop(|command: &mut Command| command.drive_vpp = 1.0, "expected command")]
fn rules_hold_for_every_law(#[case] change: fn(&mut Command), #[case] text: &str) {
    let found = play_messages(&resumed(), |_, packets| commands(packets).for_each(change));
    assert!(found.len() == 1 && found[0].contains(text), "{found:?}");
}

#[test]
fn messages_repeat_and_wait() {
    let message = |kind: &str| toml::from_str::<ScenarioMessage>(kind).unwrap();
    let messages = [
        message("kind = 'configure'\nwatchdog_timeout_ms = 50"),
        ScenarioMessage::sample(2.0, 1.2, -0.2),
        message("kind = 'damaged'\nbyte = 5"),
        message("kind = 'wait'\nms = 30.0"),
        message("kind = 'again'\nmessages = 2\ntimes = 1"),
        ScenarioMessage::sample(2.0, 1.2, -0.2),
    ];
    let mut states = Vec::new();
    let found = play_messages(&messages, |_, packets| states.extend(commands(packets).map(|command| command.cause)));
    assert_eq!(found, [""; 0]);
    // The watchdog reports its stop, and the last sample gets the same state.
    assert_eq!(states, [StateCause::None, StateCause::SampleTimeout, StateCause::SampleTimeout]);
}

#[rstest]
#[case::within_ten_percent(1.1, false)]
#[case::another_design(1.13, true)]
fn a_design_may_differ_by_ten_percent(#[case] factor: f32, #[case] differs: bool) {
    let mut has_own_design = false;
    let found = differences(|_, packets| {
        for packet in packets {
            if let Message::Configured(configured) = &mut packet.message
                && let Ok(Gains { amplitude_kp, .. }) = &mut configured.outcome
                && *amplitude_kp != CONFIGURED_AMPLITUDE_KP
            {
                has_own_design = true;
                *amplitude_kp *= factor;
            }
        }
    });
    assert!(has_own_design);
    let is_found = names(&found).contains(&"gains of the law's own design");
    assert_eq!(is_found, differs, "{found:?}");
}

#[test]
fn a_clock_that_counts_other_units_differs() {
    let found = differences(|_, packets| {
        for command in commands(packets) {
            command.target_time_us /= 2;
        }
    });
    assert!(found.iter().any(|text| text.contains("the controller's clock advanced by")), "{found:?}");
}

#[rstest]
#[case::missing(|packets: &mut Vec<Packet>| packets.retain(|packet| !matches!(packet.message, Message::Tick(_))))]
#[case::from_zero(|packets: &mut Vec<Packet>| {
    for packet in packets.iter_mut().filter(|packet| matches!(packet.message, Message::Tick(_))) {
        packet.sequence = packet.sequence.wrapping_sub(1);
    }
})]
fn ticks_have_their_own_numbers(#[case] change: fn(&mut Vec<Packet>)) {
    let found = differences(|_, packets| change(packets));
    assert_eq!(names(&found), ["ticks", "ticks of a short period"]);
}

#[test]
fn ticks_that_drift_differ() {
    let mut period = 0;
    let found = differences(|_, packets| {
        for packet in packets {
            match &mut packet.message {
                Message::Configured(_) => period = 0,
                Message::Tick(tick) => {
                    period += 1;
                    tick.target_time_us = tick.target_time_us.wrapping_add(period * 20);
                }
                _ => {}
            }
        }
    });
    assert_eq!(names(&found), ["ticks of a short period"]);
}

#[test]
fn a_counter_of_sixteen_bits_differs() {
    let mut samples = 0;
    let found = differences(|_, packets| {
        for packet in packets {
            match &mut packet.message {
                Message::Configured(_) => samples = 0,
                Message::Command(command) if command.state == ControllerState::Running => {
                    samples += 1;
                    if samples > 1 << 16 {
                        command.drive_vpp = 0.0;
                    }
                }
                _ => {}
            }
        }
    });
    assert_eq!(names(&found), ["more samples than sixteen bits count"]);
}

#[rstest]
#[case::simulated(LinkKind::Simulated, 1, 0)]
#[case::program(LinkKind::Lossless, 1, 0)]
#[case::serial_line(LinkKind::Lossy, 0, 1)]
fn only_a_lossy_line_may_lose_an_answer(#[case] kind: LinkKind, #[case] differences: usize, #[case] repeats: u32) {
    let found = check(kind, scripts(), |number, packets| packets.retain(|_| number != 7));
    assert_eq!((found.differences.len(), found.repeats), (differences, repeats), "{found:?}");
}

/// Delays the answers to samples past the time-out: the first `delayed` ones, from the second on.
struct LateLink {
    device: HostedLink,
    delayed: usize,
    late: Vec<u8>,
    is_lost: bool,
}

impl Link for LateLink {
    fn exchange(&mut self, now: Duration, bytes: &[u8], answer: &mut Vec<u8>) -> Result<Duration, LinkError> {
        let mut own = Vec::new();
        let took = self.device.exchange(now, bytes, &mut own)?;
        let is_sample = matches!(packets(bytes).as_slice(), [Packet { message: Message::Sample(_), .. }]);
        if is_sample && self.delayed > 0 {
            self.delayed -= 1;
            self.late.extend(own);
        } else {
            answer.extend(own);
        }
        Ok(took)
    }

    fn advance_to(&mut self, now: Duration, received: &mut Vec<u8>) -> Result<(), LinkError> {
        if !self.is_lost {
            received.append(&mut self.late);
        }
        self.device.advance_to(now, received)
    }

    fn kind(&self) -> LinkKind {
        LinkKind::Lossless
    }
}

#[rstest]
#[case::late_once(1, false, 1, "")]
#[case::late_twice(2, false, 2, "")]
#[case::late_more_often(10, false, 10, "")]
#[case::always_late(11, false, 10, "exchange 2: no answer, expected command")]
#[case::lost(1, true, 0, "exchange 2: no answer, expected command")]
fn a_late_answer_of_a_program_repeats_the_script(
    #[case] delayed: usize,
    #[case] is_lost: bool,
    #[case] repeats: u32,
    #[case] text: &str,
) {
    let configure = toml::from_str::<ScenarioMessage>("kind = 'configure'").unwrap();
    let messages = [configure, ScenarioMessage::sample(2.0, 1.2, -0.2)];
    let mut link = LateLink { device: HostedLink::new(), delayed, late: Vec::new(), is_lost };
    let options = CheckOptions { own_clock: true, messages: &messages, ..scripts() };
    let found = check_protocol(&mut link, &identity(), &CONFIGURE, options).unwrap();
    assert_eq!((found.repeats, found.differences.len()), (repeats, usize::from(!text.is_empty())), "{found:?}");
    assert!(found.differences.iter().all(|difference| difference.to_string().contains(text)), "{found:?}");
}

/// The controller would then be configured.
#[test]
fn messages_before_the_first_configuration_are_not_repeated() {
    let messages = [ScenarioMessage::sample(2.0, 1.2, -0.2)];
    let mut link = LateLink { device: HostedLink::new(), delayed: 1, late: Vec::new(), is_lost: false };
    let options = CheckOptions { own_clock: true, messages: &messages, ..scripts() };
    let found = check_protocol(&mut link, &identity(), &CONFIGURE, options).unwrap();
    assert_eq!((found.repeats, &found.differences[..], found.undecided.len()), (0, &[][..], 1), "{found:?}");
}

#[test]
fn an_answer_that_never_comes_is_the_controllers() {
    let cause = |packet: &Packet| match &packet.message {
        Message::Command(command) => Some(command.cause),
        _ => None,
    };
    let is_fault = |packet: &Packet| cause(packet) == Some(StateCause::NonFinite);
    let found = differences(|_, packets| packets.retain(|packet| !is_fault(packet)));
    assert!(found.iter().any(|text| text.contains("no answer, expected command")), "{found:?}");
}

#[test]
fn a_second_answer_differs() {
    let found = differences(|number, packets| {
        if number == 3 {
            packets.extend_from_within(..);
        }
    });
    assert_eq!(found.len(), 1, "{found:?}");
    assert!(found[0].ends_with("expected no further message"), "{found:?}");
}

#[test]
fn a_stopped_controller_keeps_its_frequency() {
    let found = differences(|_, packets| {
        for packet in packets {
            if let Message::Command(command) = &mut packet.message
                && command.state == ControllerState::Fault
            {
                command.frequency_mhz += 1;
            }
        }
    });
    assert!(!found.is_empty());
}
