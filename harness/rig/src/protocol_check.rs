//! Checks rules of the wire protocol (docs/wire-protocol.md) that a closed loop with a plate does
//! not test. Plays scripts of messages and compares each answer with that of the hosted controller,
//! the *reference*.

mod comparison;
mod coverage;
mod script;
mod scripts;

use crate::cancel::CancelToken;
use crate::link::{Link, LinkError, LinkKind};
use crate::rig_error::RigError;
use crate::rigs::hosted::HostedLink;
pub use comparison::is_defined_law;
pub use coverage::ProtocolCoverage;

use comparison::{BenchCause, CommandDifference, CommandHistory, ComparisonScope, ReceivedPackets, ScriptComparison};
use platebench_model::scenario::ScenarioMessage;
use platebench_wire::{Configure, Identity};
use script::{Script, ScriptVariation};
use std::fmt;
use std::time::{Duration, Instant};

/// Variations of each script, played on further references. If a variation changes the commands,
/// rounding or a design error of 5 % decides them. The check then compares no command until the
/// next configuration.
const VARIATIONS: [ScriptVariation; 6] = [
    ScriptVariation { components: ROUNDING, ..ScriptVariation::NONE },
    ScriptVariation { components: -ROUNDING, ..ScriptVariation::NONE },
    ScriptVariation { gain: 1.05, ..ScriptVariation::NONE },
    ScriptVariation { gain: 0.95, ..ScriptVariation::NONE },
    ScriptVariation { design: 1.05, ..ScriptVariation::NONE },
    ScriptVariation { design: 0.95, ..ScriptVariation::NONE },
];
/// Relative change of the components Wd and Wq, about 17 times the resolution of single precision.
const ROUNDING: f32 = 2e-6;
/// Largest number of attempts at a script. A lost answer repeats the script only if the line may
/// have lost it, a late answer or a stall of the host only if the target runs in wall time.
const ATTEMPTS: u32 = 3;
/// Time in which a script is repeated after stalls of the host. On a busy host many attempts stall.
const STALL_REPEATS: Duration = Duration::from_secs(10);
/// Further attempts of all scripts together after late answers, which a busy host may delay again. A
/// controller that is always late costs seconds per attempt.
const LATE_ATTEMPTS: u32 = 8;
/// Longest wait for an answer after the time-out of the link. The host may have delayed a
/// controller that is a program on it.
const LATE_ANSWER: Duration = Duration::from_secs(1);
/// Time without a byte after which nothing more is expected.
const QUIET: Duration = Duration::from_millis(20);
/// After this many answers that never came, the check waits for no further late one.
const MAX_LOST_ANSWERS: u32 = 3;
/// Shortest watchdog timeout of scripts that do not test the watchdog, because an exchange over an
/// emulated line takes milliseconds.
const MIN_WATCHDOG_MS: u16 = 1_000;
/// Time step of target and reference. It is not longer than any tick period of the scripts, so that
/// the reference sends at most one tick per step.
const STEP: Duration = Duration::from_millis(3);
/// Largest number of steps of a silence. Only silences of many seconds have longer steps than
/// [`STEP`]; no script has ticks that long after its configuration.
const MAX_STEPS: u32 = 4_096;
/// A longer script takes minutes on a slow line. It is played on request if time passes meanwhile.
const LONG_SCRIPT: u64 = 10_000;

#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct ProtocolCheck {
    /// One for each script whose answers differ from those of the reference.
    pub differences: Vec<ScriptDifference>,
    /// Number of times that a script was repeated.
    pub repeats: u32,
    /// Names of the long scripts that were not requested. Never depends on a measured speed.
    pub not_played: Vec<String>,
    /// Names of the scripts with a difference that a stall of the host may have caused in each attempt.
    pub undecided: Vec<String>,
}

/// First difference of a script. Displays as a sentence.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ScriptDifference {
    pub script: String,
    /// Number of the exchange, from 1.
    pub exchange: usize,
    pub text: String,
    /// Rule that differences of several scripts have in common, whatever their numbers are.
    pub rule: Option<&'static str>,
}

impl ScriptDifference {
    /// True if both break the same rule, or scripts of one name differ in the same way, at any
    /// exchange.
    pub fn is_like(&self, other: &Self) -> bool {
        let is_same_rule = self.rule.is_some() && self.rule == other.rule;
        is_same_rule || (&self.script, &self.text) == (&other.script, &other.text)
    }
}

impl fmt::Display for ScriptDifference {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { script, exchange, text, .. } = self;
        write!(formatter, "{script}: exchange {exchange}: {text}")
    }
}

/// What is played and compared.
#[derive(Debug, Clone, Copy)]
pub struct CheckOptions<'a> {
    /// True if the controller's clock runs while the bench waits.
    pub own_clock: bool,
    /// Selects the random samples.
    pub seed: u64,
    /// Messages of the scenario, which replace the scripts.
    pub messages: &'a [ScenarioMessage],
    /// True if drive and frequency of `messages` are compared with the reference, for the laws that
    /// `docs/wire-protocol.md` defines. Those of the scripts always are.
    pub compares_numbers: bool,
    /// True for a law that is none of the page's: only the rules for every law are compared.
    pub own_law: bool,
    /// True if long scripts are played although the controller's clock runs meanwhile.
    pub long_scripts: bool,
    /// After a cancellation, the result is incomplete.
    pub cancel: &'a CancelToken,
}

impl CheckOptions<'_> {
    /// True for a long script that was not requested. In simulated time every script is played.
    fn omits(&self, script: &Script) -> bool {
        self.own_clock
            && !self.long_scripts
            && self.messages.is_empty()
            && ScenarioMessage::count(&script.messages) > LONG_SCRIPT
    }
}

/// Plays every script on `link`. Fails if the link is lost. Afterwards the controller may have
/// stopped or have another configuration. `base` supplies the law, the watchdog timeout and the
/// plate.
pub fn check_protocol(
    link: &mut dyn Link,
    identity: &Identity,
    base: &Configure,
    options: CheckOptions<'_>,
) -> Result<ProtocolCheck, RigError> {
    let CheckOptions { own_clock, seed, messages, compares_numbers, own_law, cancel, .. } = options;
    if !link.restart()? {
        link.continue_trial();
    }
    let base = script_base(base);
    let period = Duration::from_micros(base.period_us.into());
    let scope = match own_law {
        true => ComparisonScope::OwnLaw,
        false if compares_numbers || messages.is_empty() => ComparisonScope::Numbers,
        false => ComparisonScope::Rules,
    };
    let mut player = ScriptPlayer {
        link,
        identity,
        period,
        own_clock,
        scope,
        now: Duration::ZERO,
        history: CommandHistory::default(),
        cancel,
        lost_answers: 0,
    };
    let mut check = ProtocolCheck::default();
    let kind = player.link.kind();
    let may_repeat = |other_cause: Option<BenchCause>| match other_cause {
        None => false,
        Some(BenchCause::NoAnswer) => kind.loses_bytes(),
        Some(BenchCause::LateAnswer | BenchCause::LateTicks | BenchCause::Stall) => kind != LinkKind::Simulated,
    };
    let scripts = if messages.is_empty() {
        scripts::scripts(&base, identity, seed, own_law).map_err(RigError::InvalidScripts)?
    } else {
        vec![message_script(messages, base)]
    };
    // A second attempt needs a configuration that clears the state of the first one.
    let is_repeatable = matches!(messages.first(), None | Some(ScenarioMessage::Configure(_)));
    let mut late_attempts = LATE_ATTEMPTS;
    for script in scripts {
        if cancel.is_cancelled() {
            break;
        }
        if options.omits(&script) {
            check.not_played.push(script.name);
            continue;
        }
        let mut found = player.play(&script)?;
        let started = Instant::now();
        for attempt in 1.. {
            let other_cause = found.as_ref().and_then(|(_, other_cause)| *other_cause);
            let is_stalled = other_cause == Some(BenchCause::Stall);
            let has_time = attempt < ATTEMPTS || (is_stalled && started.elapsed() < STALL_REPEATS);
            let is_late = other_cause == Some(BenchCause::LateAnswer) && late_attempts > 0;
            if cancel.is_cancelled() || !is_repeatable || !may_repeat(other_cause) || !(has_time || is_late) {
                break;
            }
            late_attempts -= u32::from(!has_time);
            check.repeats += 1;
            found = player.play(&script)?;
        }
        match found {
            None => {}
            Some((_, Some(BenchCause::Stall))) => check.undecided.push(script.name),
            Some((_, Some(BenchCause::LateAnswer))) if !is_repeatable => check.undecided.push(script.name),
            Some((difference, _)) => check.differences.push(difference),
        }
    }
    Ok(check)
}

/// Configuration of the scripts for a trial with the configuration `base`.
fn script_base(base: &Configure) -> Configure {
    Configure {
        paced_by_target: false,
        drives_own_plate: false,
        loop_delay_us: 0,
        gains: None,
        watchdog_timeout_ms: base.watchdog_timeout_ms.max(MIN_WATCHDOG_MS),
        ..*base
    }
}

/// Returns the time steps of a silence.
fn silence_step(silence: Duration) -> Duration {
    STEP.max(silence / MAX_STEPS)
}

fn message_script(messages: &[ScenarioMessage], base: Configure) -> Script {
    Script { ends_silences: true, ..Script::new("messages of the scenario", base, messages.to_vec()) }
}

struct ScriptPlayer<'a> {
    link: &'a mut dyn Link,
    identity: &'a Identity,
    /// Shortest simulated time from one exchange to the next.
    period: Duration,
    own_clock: bool,
    scope: ComparisonScope,
    now: Duration,
    history: CommandHistory,
    cancel: &'a CancelToken,
    lost_answers: u32,
}

impl ScriptPlayer<'_> {
    /// Reads the line after the link's time-out. True if a message arrives, so that it was late.
    fn await_late_answer(&mut self) -> Result<bool, LinkError> {
        if !self.own_clock || self.lost_answers == MAX_LOST_ANSWERS {
            return Ok(false);
        }
        let (start, mut late) = (Instant::now(), Vec::new());
        while start.elapsed() < LATE_ANSWER && !self.cancel.is_cancelled() {
            let known = late.len();
            self.cancel.sleep(QUIET);
            self.link.advance_to(self.now, &mut late)?;
            if late.len() == known && !comparison::packets(&late).is_empty() {
                return Ok(true);
            }
        }
        self.lost_answers += 1;
        Ok(false)
    }

    fn play(&mut self, script: &Script) -> Result<Option<(ScriptDifference, Option<BenchCause>)>, LinkError> {
        let is_varied = self.scope == ComparisonScope::Numbers && script.is_varied;
        let varied = if is_varied { &VARIATIONS[..] } else { &[] };
        let mut encoders: Vec<_> = varied.iter().map(|variation| script.exchanges(*variation)).collect();
        let mut references = vec![HostedLink::new(); 1 + varied.len()];
        let mut comparison = ScriptComparison::new(self.identity, self.scope);
        let (mut since_start, mut is_stalled) = (Duration::ZERO, false);
        let mut last_request = Instant::now();
        let mut received = Vec::new();
        let mut expected = vec![Vec::new(); references.len()];
        for (number, exchange) in script.exchanges(ScriptVariation::NONE).enumerate() {
            if self.own_clock {
                self.cancel.sleep(exchange.wait);
            }
            if self.cancel.is_cancelled() {
                return Ok(None);
            }
            let mut rest = exchange.wait.max(self.period);
            let longest_step = silence_step(exchange.wait);
            while !rest.is_zero() {
                let step = rest.min(longest_step);
                rest -= step;
                self.now += step;
                since_start += step;
                // The message that ends a silence arrives before the controller checks its watchdog.
                if rest.is_zero() && script.ends_silences && !exchange.wait.is_zero() && !self.own_clock {
                    break;
                }
                self.link.advance_to(self.now, &mut received)?;
                for (reference, expected) in references.iter_mut().zip(&mut expected) {
                    reference.advance_to(since_start, expected)?;
                }
            }
            if number == 0 {
                // Discards late answers to the previous script.
                received.clear();
            }
            let since_request = last_request;
            last_request = Instant::now();
            self.link.exchange(self.now, &exchange.bytes, &mut received)?;
            let requests = encoders.iter_mut().filter_map(Iterator::next).map(|request| request.bytes);
            let requests = [exchange.bytes.clone()].into_iter().chain(requests);
            for ((reference, request), expected) in references.iter_mut().zip(requests).zip(&mut expected) {
                reference.exchange(since_start, &request, expected)?;
            }
            let longest = if self.own_clock { since_request.elapsed() } else { exchange.wait.max(self.period) + STEP };
            is_stalled |= self.own_clock && longest > exchange.wait + script.stall;
            let request = comparison.observe_requests(&exchange.bytes);
            if !exchange.is_complete {
                continue;
            }
            let answers: Vec<_> =
                expected.iter_mut().map(|bytes| ReceivedPackets::new(&std::mem::take(bytes), request)).collect();
            let received = ReceivedPackets::new(&std::mem::take(&mut received), request);
            let silence = exchange.wait.max(self.period)..=longest;
            let compared = comparison.compare(&received, &answers, silence, &mut self.history);
            if let Err(CommandDifference { text, rule, other_cause }) = compared {
                let is_late = other_cause == Some(BenchCause::NoAnswer) && self.await_late_answer()?;
                let other_cause = match other_cause {
                    Some(BenchCause::NoAnswer) if is_late => Some(BenchCause::LateAnswer),
                    // A stall of the host may change an answer, but does not suppress it.
                    Some(BenchCause::NoAnswer) => other_cause,
                    _ if is_stalled => Some(BenchCause::Stall),
                    _ => other_cause,
                };
                let text = if is_late { format!("{text}; a message arrived after the time-out") } else { text };
                let script = script.name.clone();
                let exchange = number + 1;
                return Ok(Some((ScriptDifference { script, exchange, text, rule }, other_cause)));
            }
        }
        Ok(None)
    }
}

#[cfg(test)]
mod tests;
