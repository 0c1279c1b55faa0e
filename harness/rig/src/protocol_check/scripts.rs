//! Loads the scripts: messages that no closed loop with a plate sends. `scripts.toml` contains all
//! but those with random samples.

use super::script::{Script, configuration};
use platebench_model::record::to_hex;
use platebench_model::scenario::{ConfigurationChange, ScenarioMessage, WireNumber};
use platebench_wire::{Configure, FrameReader, Identity, LawId, Message, Packet, capabilities};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng, SeedableRng};
use serde::Deserialize;
use std::collections::BTreeMap;
use std::ops::Range;
use std::time::Duration;

const FILE: &str = include_str!("scripts.toml");
/// A valid configuration from its start frequency on, without the last byte of the last gain.
const VALID_FIGURES: &str =
    "c6f9ec01 4260e53b 6c09f93a 00000000 00006144 00007a43 00004842 00004843 00c8af47 00002f44 007c92";
/// Stands for an element of `each` in the messages of a script.
const EACH: &str = "each";
/// Number of pairs of random scripts, and of samples in each script.
const RANDOM_SCRIPTS: u64 = 40;
const RANDOM_SAMPLES: usize = 40;

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct ScriptFile {
    configuration: ConfigurationChange,
    /// Messages with a name.
    message: BTreeMap<String, ScenarioMessage>,
    script: Vec<FileScript>,
}

#[derive(Default, Deserialize)]
#[serde(deny_unknown_fields, default)]
struct FileScript {
    name: String,
    condition: Option<Condition>,
    configuration: Option<ConfigurationChange>,
    start: Vec<Entry>,
    each: Vec<Entry>,
    messages: Vec<Entry>,
    end: Vec<Entry>,
    one_script_each: bool,
    exact: bool,
    stall_us: Option<u64>,
}

#[derive(Clone, Copy, Deserialize)]
#[serde(rename_all = "kebab-case")]
enum Condition {
    Ticks,
    LoopDelay,
    OwnPlate,
    NoOwnPlate,
    NoOwnLaw,
}

#[derive(Deserialize)]
#[serde(untagged)]
enum Entry {
    Name(String),
    Sample([WireNumber; 3]),
    Message(ScenarioMessage),
    Configure(ConfigurationChange),
}

/// Fails if the built-in file is invalid.
pub(super) fn scripts(base: &Configure, identity: &Identity, seed: u64, own_law: bool) -> Result<Vec<Script>, String> {
    let mut all = scripts_of(FILE, base, identity, own_law)?;
    all.extend(random_scripts(base, identity, seed));
    Ok(all)
}

pub(super) fn scripts_of(
    file: &str,
    base: &Configure,
    identity: &Identity,
    own_law: bool,
) -> Result<Vec<Script>, String> {
    let mut text = file.to_owned();
    for (name, value) in named_values(base, identity) {
        text = text.replace(name, &value);
    }
    let file: ScriptFile = toml::from_str(&text).map_err(|error| error.to_string())?;
    let has = |capability| identity.has_capability(capability);
    let is_met = |condition: Condition| match condition {
        Condition::Ticks => has(capabilities::TARGET_PACED),
        Condition::LoopDelay => has(capabilities::LOOP_DELAY),
        Condition::OwnPlate => has(capabilities::OWN_PLATE),
        Condition::NoOwnPlate => !has(capabilities::OWN_PLATE),
        Condition::NoOwnLaw => !own_law,
    };
    let mut all = Vec::new();
    for script in file.script.iter().filter(|script| script.condition.is_none_or(is_met)) {
        all.extend(file.expand(script, base)?);
    }
    Ok(all)
}

impl ScriptFile {
    fn expand(&self, script: &FileScript, base: &Configure) -> Result<Vec<Script>, String> {
        let FileScript { name, start, each, messages, end, .. } = script;
        // Without elements, the messages are played once.
        let each: Vec<_> = if each.is_empty() { vec![None] } else { each.iter().map(Some).collect() };
        let base = configuration(script.configuration.as_ref().unwrap_or(&self.configuration), base);
        let length = if script.one_script_each { 1 } else { each.len() };
        let expand = |elements: &[Option<&Entry>]| {
            let repeated = elements.iter().flat_map(|element| messages.iter().map(|entry| (entry, *element)));
            let all =
                start.iter().map(|entry| (entry, None)).chain(repeated).chain(end.iter().map(|entry| (entry, None)));
            let all = all.map(|(entry, element)| self.message(entry, element)).collect::<Result<Vec<_>, _>>();
            let all = all.map_err(|message| format!("{name}: {message}"))?;
            let script_of_all = Script::new(name.as_str(), base, all);
            let stall = script.stall_us.map_or(script_of_all.stall, Duration::from_micros);
            Ok(Script { stall, is_varied: !script.exact, ..script_of_all })
        };
        each.chunks(length).map(expand).collect()
    }

    fn message(&self, entry: &Entry, element: Option<&Entry>) -> Result<ScenarioMessage, String> {
        match entry {
            Entry::Name(name) if name == EACH => {
                self.message(element.ok_or("`each` without an element, expected `each` of the script")?, None)
            }
            Entry::Name(name) => {
                self.message.get(name).cloned().ok_or_else(|| format!("`{name}`, expected a name of [message]"))
            }
            Entry::Sample(values) => {
                let [setpoint_um, wd_um, wq_um] = values.map(WireNumber::value);
                Ok(ScenarioMessage::sample(setpoint_um, wd_um, wq_um))
            }
            Entry::Message(message) => Ok(message.clone()),
            Entry::Configure(change) => Ok(ScenarioMessage::Configure(*change)),
        }
    }
}

/// Values that the file names in braces: numbers, which replace a text, and bytes in hexadecimal.
fn named_values(base: &Configure, identity: &Identity) -> [(&'static str, String); 12] {
    let other = |value: f32, factor: f32| format!("{:?}", factor * value);
    let hex = |message: Message, bytes: Range<usize>| {
        let frame = Packet { sequence: 0, message }.encode();
        let mut reader = FrameReader::new();
        let body = reader.read(&mut frame.as_bytes()).and_then(Result::ok).unwrap_or_default();
        to_hex(body.get(bytes).unwrap_or_default())
    };
    let of_base = |bytes| hex(Message::Configure(*base), bytes);
    [
        ("\"{other_gain}\"", other(base.gain_um_per_vpp, 1.3)),
        ("\"{other_time_constant}\"", other(base.time_constant_s, 1.4)),
        ("\"{other_limit}\"", other(base.drive_limit_vpp, 0.7)),
        ("\"{other_range}\"", other(base.frequency_range_hz, 0.5)),
        ("\"{other_slew}\"", other(base.frequency_slew_hz, 0.6)),
        ("\"{longer_than_period}\"", base.period_us.saturating_add(1).to_string()),
        ("{identity}", hex(Message::Identity(*identity), 2..50)),
        ("{law}", of_base(2..3)),
        // Watchdog timeout and period.
        ("{times}", of_base(4..10)),
        // Gain and time constant.
        ("{plate}", of_base(14..22)),
        ("{limit}", of_base(26..30)),
        ("{figures}", VALID_FIGURES.to_owned()),
    ]
}

/// Returns pairs of scripts, each with its own random configuration. The first of a pair has
/// configured gains, the second the law's own design.
fn random_scripts(base: &Configure, identity: &Identity, seed: u64) -> Vec<Script> {
    let mut all = Vec::new();
    for number in 0..RANDOM_SCRIPTS {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        random.set_stream(number);
        // Only the second script may have a loop delay. With a delay, the law predicts the plate
        // with K1, which no variation changes if the gains are configured.
        let has_delay = number % 4 == 3 && identity.has_capability(capabilities::LOOP_DELAY);
        let mut script = |name, law, has_gains, has_delay| {
            let configure = random_configuration(&mut random, has_gains, has_delay);
            let setup = ScenarioMessage::Configure(ConfigurationChange { law, ..configure });
            Script::new(name, *base, [setup].into_iter().chain(random_samples(&mut random)).collect())
        };
        all.push(script("random samples with configured gains", None, true, false));
        let law = match number % 8 {
            1 => Some(LawId::DqPiFixed),
            5 => Some(LawId::DqPiEuler),
            _ => None,
        };
        let law = law.filter(|law| identity.has_law(*law)).map(|law| law as u8);
        all.push(script("random samples with the law's own design", law, false, has_delay));
    }
    all
}

fn uniform(random: &mut ChaCha8Rng, low: f32, high: f32) -> f32 {
    low + (high - low) * ((random.next_u32() >> 8) as f32 / (1_u32 << 24) as f32)
}

fn random_configuration(random: &mut ChaCha8Rng, has_gains: bool, has_delay: bool) -> ConfigurationChange {
    let mut range = |low, high| uniform(random, low, high);
    let longest_us = range(300.0, 4000.0);
    let time_constant_s = range(0.001, 0.004);
    // Over a period of several time constants, the factor e^z of the law's identification becomes
    // too small for single precision.
    let period_us = if has_gains { longest_us } else { longest_us.min(time_constant_s * 1e6) } as u32;
    let gains = [range(-60.0, 600.0), range(0.0, 150_000.0), range(-200.0, 2000.0), range(0.0, 600_000.0)];
    ConfigurationChange {
        period_us: Some(period_us),
        start_frequency_mhz: Some(range(32_100_000.0, 32_500_000.0) as u32),
        gain_um_per_vpp: Some(range(0.004, 0.012).into()),
        time_constant_s: Some(time_constant_s.into()),
        response_time_s: Some(WireNumber::from(if has_gains { 0.0 } else { range(0.0009, 0.006) })),
        drive_limit_vpp: Some(range(300.0, 1500.0).into()),
        frequency_range_hz: Some(range(20.0, 400.0).into()),
        frequency_slew_hz: Some(range(2.0, 200.0).into()),
        gains: has_gains.then(|| gains.map(WireNumber::from)),
        loop_delay_us: has_delay.then_some(period_us / 3),
        ..ConfigurationChange::default()
    }
}

/// Returns samples whose setpoint lasts five samples on average. Wd follows the setpoint and Wq goes
/// to zero, both with random jumps. Wd is sometimes negative.
fn random_samples(random: &mut ChaCha8Rng) -> Vec<ScenarioMessage> {
    let (mut setpoint, mut wd, mut wq) = (1.0, 0.0, 0.0);
    let step = |_| {
        if random.next_u32().is_multiple_of(5) {
            setpoint = if random.next_u32().is_multiple_of(5) { 0.0 } else { uniform(random, 0.1, 4.0) };
        }
        let share = uniform(random, 0.1, 0.9);
        wd += (setpoint - wd) * share + uniform(random, -0.2, 0.2) * setpoint;
        wq += uniform(random, -0.3, 0.3) * setpoint - 0.3 * wq;
        if random.next_u32().is_multiple_of(17) {
            wd = -wd;
        }
        ScenarioMessage::sample(setpoint, wd, wq)
    };
    (0..RANDOM_SAMPLES).map(step).collect()
}
