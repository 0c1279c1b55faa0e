//! Runs a whole exploration: plays scenes, shrinks failing scenes, writes the minimal scenes as
//! scenarios that the next run and the next exploration play, and writes the result.

use crate::explore::envelope::Envelope;
#[cfg(feature = "firmware-analysis")]
use crate::explore::exploration::explore_and_record;
use crate::explore::exploration::{ExplorationBudget, ExploreConfig, FailedScene, FailedSequence, Regression, explore};
use crate::explore::limits::{ExploredLaw, LawProperties, OwnLaw};
use crate::explore::own_law::measure_own_law;
use crate::explore::player::{ExploreError, ScenePlayer};
use crate::explore::properties::Property;
use crate::explore::report;
use crate::explore::report::{ExploreReport, ViolationReport, violated_properties};
use crate::explore::scenario_file::ScenarioBuilder;
use crate::explore::sequence::SequenceLimits;
use crate::explore::shrink::{MinimalScene, shrink_scene, shrink_sequence};
#[cfg(feature = "firmware-analysis")]
use crate::firmware_analysis::suite::read_code;
use platebench_engine::plan::LinkFactory;
use platebench_engine::{RunError, SafeEnds, law, why_not_applicable};
use platebench_model::scenario::{OWN_LAW, Scenario, ScenarioMessage, load};
use platebench_model::trace::{AtPath, write_atomically};
use platebench_rig::{CancelToken, ConnectOptions, FaultInjector, Link, LinkKind, RigSpec, Session};
#[cfg(feature = "firmware-analysis")]
use platebench_rig::{Capability, ConnectError, EmulatedLink};
use platebench_wire::{Identity, LawId, capabilities};
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};
use std::{fmt, fs};

/// Longest wall time for shrinking all properties together.
const SHRINK_TIME: Duration = Duration::from_mins(1);
/// Longest wall time for shrinking sequences of messages.
const SEQUENCE_SHRINK_TIME: Duration = Duration::from_secs(30);
/// Largest number of messages of a sequence. A measured speed does not decide what is played.
const LONGEST_SEQUENCE: u64 = 250_000;
/// As [`LONGEST_SEQUENCE`], for a program or a board, which takes up to some milliseconds per message.
const LONGEST_SEQUENCE_IN_WALL_TIME: u64 = 6_000;
/// The exploration ends after this many failing scenes, because more add little information.
const ENOUGH_FAILURES: u64 = 10;
const MAX_MINIMAL: usize = 3;

#[derive(Debug, Clone)]
pub struct ExploreSession {
    pub envelope: Envelope,
    pub rig: RigSpec,
    /// Longest wait for an answer on a line.
    pub reply_timeout: Duration,
    /// Name of a law. By default an own law if the controller announces no number, otherwise `dq-pi`.
    pub law: Option<String>,
    pub seed: u64,
    pub budget: ExplorationBudget,
    pub jobs: usize,
    pub compares_reference: bool,
    pub regressions: Vec<Scenario>,
    pub regression_folder: PathBuf,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ProgressEvent {
    pub elapsed: Duration,
    pub scenes: u64,
    pub failed: u64,
}

impl fmt::Display for ProgressEvent {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { elapsed, scenes, failed } = self;
        write!(formatter, "{:.0} s: {scenes} scenes, {failed} failed", elapsed.as_secs_f64())
    }
}

#[cfg(feature = "firmware-analysis")]
fn branch_outcomes(rig: &RigSpec) -> Result<BTreeSet<u32>, ExploreError> {
    if !rig.has(Capability::EmulatedChip) {
        return Ok(BTreeSet::new());
    }
    Ok(read_code(rig.image()).map_err(ConnectError::from)?.1.branch_outcomes())
}

/// A build that cannot analyse firmware knows no branches.
#[cfg(not(feature = "firmware-analysis"))]
#[expect(clippy::unnecessary_wraps, reason = "the analysis may fail")]
fn branch_outcomes(_: &RigSpec) -> Result<BTreeSet<u32>, ExploreError> {
    Ok(BTreeSet::new())
}

impl ExploreSession {
    /// Writes `explore.json` and `report.html` to `folder`. A violated property is no error. Also
    /// returns the error that ended the exploration early; what was found before is in the report.
    pub fn run(
        self,
        cancel: &CancelToken,
        folder: &Path,
        on_progress: &mut dyn FnMut(ProgressEvent),
    ) -> Result<(ExploreReport, Option<ExploreError>), ExploreError> {
        let options =
            ConnectOptions { reply_timeout: self.reply_timeout, cancel: cancel.clone(), ..ConnectOptions::default() };
        let connect = || self.rig.connect_with(&options);
        let ends = SafeEnds::default();
        let (identity, kind, regressions) = self.identify(&connect, &ends, cancel)?;
        let mut config = self.config(&identity, regressions)?;
        if let Some(sequences) = &mut config.sequences {
            sequences.starts_controllers = !kind.loses_bytes();
        }
        // A board on a line needs some milliseconds for each period.
        config.has_endurance = !kind.loses_bytes();
        if config.law.is_own() {
            let measured = measure_own_law(&config.envelope, &connect, config.own_clock, cancel, &ends)?;
            config.law = ExploredLaw::Own(measured.ok_or(RunError::Cancelled)?);
        }
        let started = Instant::now();
        let mut on_scene = |scenes, failed| {
            on_progress(ProgressEvent { elapsed: started.elapsed(), scenes, failed });
        };
        #[cfg(feature = "firmware-analysis")]
        let mut exploration = if self.rig.has(Capability::EmulatedChip) {
            let connect = || Ok(self.rig.image().map_or_else(EmulatedLink::built_in, EmulatedLink::open)?);
            explore_and_record(&config, &connect, cancel, &ends, &mut on_scene)?
        } else {
            explore(&config, &connect, cancel, &ends, &mut on_scene)?
        };
        #[cfg(not(feature = "firmware-analysis"))]
        let mut exploration = explore(&config, &connect, cancel, &ends, &mut on_scene)?;
        let mut stop = exploration.error.take();
        // Without a rig, a failing scene is stored as it is.
        let mut is_playable = stop.is_none() && !exploration.is_interrupted;
        let rig = self.rig.to_string();
        let mut report = ExploreReport::new(&config, &exploration, &rig, &platebench_rig::printable_name(&identity));
        let deadline = Instant::now() + SHRINK_TIME;
        let mut add = |found: (Option<ViolationReport>, Option<ExploreError>)| {
            report.violations.extend(found.0);
            match found.1 {
                Some(ExploreError::Run(RunError::Cancelled)) => report.is_interrupted = true,
                Some(error) => stop = stop.take().or(Some(error)),
                None => return true,
            }
            false
        };
        for (position, (property, failed)) in
            violated_properties(&exploration).into_iter().take(MAX_MINIMAL).enumerate()
        {
            let rest = deadline.saturating_duration_since(Instant::now());
            let time = is_playable.then_some(rest / (MAX_MINIMAL - position) as u32);
            is_playable &= add(self.minimise(&config, &connect, (cancel, &ends), failed, property, time));
        }
        for (position, failed) in distinct_sequences(&exploration.failed_sequences).into_iter().enumerate() {
            let rest = (deadline + SEQUENCE_SHRINK_TIME).saturating_duration_since(Instant::now());
            let time = is_playable.then_some(rest / (MAX_MINIMAL - position) as u32);
            is_playable &= add(self.minimise_sequence(&config, &connect, (cancel, &ends), failed, time));
        }
        report.record_stop(stop.as_ref());
        report.record_ends(&ends);
        let text = serde_json::to_string_pretty(&report).unwrap_or_default();
        let path = folder.join(report::FILE);
        write_atomically(&path, text.as_bytes()).at(&path)?;
        report::document(&report).write(&folder.join(report::PAGE_FILE))?;
        Ok((report, stop))
    }

    /// Returns the identity, the kind of the link, and the scenarios of earlier explorations with
    /// the reason if they do not apply.
    fn identify(
        &self,
        connect: &LinkFactory<'_>,
        ends: &SafeEnds,
        cancel: &CancelToken,
    ) -> Result<(Identity, LinkKind, Vec<Regression>), ExploreError> {
        let mut session = Session::open_cancellable(FaultInjector::new(connect()?), cancel).map_err(RunError::from)?;
        let identity = *session.identity();
        let kind = session.link().kind();
        let regressions = self.regressions.iter().map(|scenario| {
            let law = law(scenario).map_err(Box::new).map_err(ExploreError::Generated)?;
            let not_applicable =
                why_not_applicable(scenario, law, true, &mut session).map_err(ExploreError::Generated)?;
            Ok::<_, ExploreError>(Regression { scenario: scenario.clone(), not_applicable })
        });
        let regressions: Result<Vec<_>, _> = regressions.collect();
        ends.record(session.close());
        Ok((identity, kind, regressions?))
    }

    fn config(&self, identity: &Identity, regressions: Vec<Regression>) -> Result<ExploreConfig, ExploreError> {
        let law = self.explored_law(identity)?;
        let laws = LawProperties::explored_laws().filter(|other| identity.has_law(*other) && !law.is_own());
        let sequences = SequenceLimits::new(
            identity,
            self.rig.has_own_clock(),
            self.rig.name() == RigSpec::hosted().name(),
            if self.rig.has_own_clock() { LONGEST_SEQUENCE_IN_WALL_TIME } else { LONGEST_SEQUENCE },
        );
        Ok(ExploreConfig {
            envelope: envelope_for(&self.envelope, identity),
            seed: self.seed,
            law,
            laws: laws.collect(),
            budget: self.budget,
            max_failed: ENOUGH_FAILURES,
            jobs: self.jobs,
            own_clock: self.rig.has_own_clock(),
            compares_reference: self.compares_reference,
            sequences: Some(SequenceLimits { is_own_law: law.is_own(), ..sequences }),
            regressions,
            has_endurance: true,
            is_guided: true,
            branch_outcomes: branch_outcomes(&self.rig)?,
        })
    }

    fn explored_law(&self, identity: &Identity) -> Result<ExploredLaw, ExploreError> {
        let name = self.law.as_deref().unwrap_or(if identity.laws == 0 { OWN_LAW } else { LawId::DqPi.name() });
        let Some(law) = LawId::from_name(name) else { return Ok(ExploredLaw::Own(OwnLaw::default())) };
        if identity.has_law(law) {
            return Ok(law.into());
        }
        let announced = LawId::ALL.into_iter().filter(|law| identity.has_law(*law)).map(LawId::name);
        let options: Vec<_> = announced.chain([OWN_LAW]).map(|law| format!("--law {law}")).collect();
        Err(ExploreError::LawNotAnnounced { law: name.to_owned(), options: options.join(" or ") })
    }

    /// Stores the sequence, reduced for at most `time`; `None` stores it as it is. An error of the rig
    /// comes with the stored sequence.
    fn minimise_sequence(
        &self,
        config: &ExploreConfig,
        connect: &LinkFactory<'_>,
        (cancel, ends): (&CancelToken, &SafeEnds),
        failed: &FailedSequence,
        time: Option<Duration>,
    ) -> (Option<ViolationReport>, Option<ExploreError>) {
        let FailedSequence { messages: original, properties, .. } = failed;
        let property = properties.first().copied().unwrap_or(Property::Answers);
        let mut player = ScenePlayer::new(connect, config.own_clock, cancel, ends);
        let shrunk = time.map(|time| shrink_sequence(config, &mut player, failed, property, time));
        let ((minimal, difference, replays), error) = or_original(shrunk, || (original.clone(), None, 0));
        let stored = self.write_sequence(config, failed, property, &minimal, difference);
        let stored = stored.map(|violation| ViolationReport { replays, ..violation });
        reproduce(stored, error, time.is_some(), &mut player)
    }

    fn write_sequence(
        &self,
        config: &ExploreConfig,
        FailedSequence { index, messages: original, text, .. }: &FailedSequence,
        property: Property,
        minimal: &[ScenarioMessage],
        difference: Option<String>,
    ) -> Result<ViolationReport, ExploreError> {
        let (law, seed) = (config.law.name(), config.seed);
        let name = format!("{law}-messages-{seed}-{index}");
        let title = format!("Explored: {law} violates the property {property} (sequence {index} of seed {seed})");
        let mut comment = vec![
            "Written by platebench suite explore: a minimal sequence of messages.".to_owned(),
            format!("property: {property}"),
            format!("difference: {}", difference.as_ref().unwrap_or(text)),
            format!("rig: {}", self.rig).replace(char::is_control, " "),
        ];
        if difference.is_none() {
            comment.push(NOT_MINIMAL.to_owned());
        }
        let folder = &self.regression_folder;
        let scenario = config.sequence_scenario(minimal, &title, &format!("{name}-"));
        scenario.write(folder, &name, &comment)?;
        let path = folder.join(format!("{name}.toml"));
        Ok(ViolationReport {
            property,
            scene: *index,
            is_sequence: true,
            value: None,
            limit: None,
            rule: Some(difference.unwrap_or_else(|| text.clone())),
            original: config.sequence_scenario(original, &title, "").text(&[]).at(&path)?,
            minimal: fs::read_to_string(&path).at(&path)?,
            minimal_value: None,
            minimal_limit: None,
            file: path.display().to_string(),
            is_reproduced: false,
            replays: 0,
        })
    }

    /// As [`Self::minimise_sequence`], for a scene.
    fn minimise(
        &self,
        config: &ExploreConfig,
        connect: &LinkFactory<'_>,
        (cancel, ends): (&CancelToken, &SafeEnds),
        failed: &FailedScene,
        property: Property,
        time: Option<Duration>,
    ) -> (Option<ViolationReport>, Option<ExploreError>) {
        let mut player = ScenePlayer::new(connect, config.own_clock, cancel, ends);
        let shrunk = time.map(|time| shrink_scene(config, &mut player, failed, property, time));
        let (minimal, error) = or_original(shrunk, || MinimalScene::original(config, failed, property));
        let stored = self.write_scene(config, failed, property, &minimal);
        reproduce(stored, error, time.is_some(), &mut player)
    }

    fn write_scene(
        &self,
        config: &ExploreConfig,
        failed: &FailedScene,
        property: Property,
        minimal: &MinimalScene,
    ) -> Result<ViolationReport, ExploreError> {
        let rig = self.rig.to_string();
        let path = write_regression(&self.regression_folder, config, &rig, failed, minimal)?;
        let original = failed.failure_of(property);
        let title = format!("Scene {} of seed {}", failed.index, config.seed);
        Ok(ViolationReport {
            property,
            scene: failed.index,
            is_sequence: false,
            value: original.and_then(|failure| failure.value),
            limit: original.and_then(|failure| failure.limit),
            rule: (property == Property::Protocol).then(|| minimal.failure.name.clone()),
            original: config.scenario(&failed.scene, &title).text(&[]).at(&path)?,
            minimal: fs::read_to_string(&path).at(&path)?,
            minimal_value: minimal.failure.value,
            minimal_limit: minimal.failure.limit,
            file: path.display().to_string(),
            is_reproduced: false,
            replays: minimal.replays,
        })
    }
}

/// Comment of a stored scene that is not reduced.
const NOT_MINIMAL: &str =
    "It is not minimal: it did not fail again with a new controller, or the exploration ended before.";

/// The reduced scene, or the original one if it could not be reduced.
fn or_original<T>(shrunk: Option<Result<T, ExploreError>>, original: impl FnOnce() -> T) -> (T, Option<ExploreError>) {
    match shrunk {
        Some(Ok(minimal)) => (minimal, None),
        Some(Err(error)) => (original(), Some(error)),
        None => (original(), None),
    }
}

/// Plays the written file with a new controller, as `platebench run` does, unless there was an
/// error before.
fn reproduce(
    stored: Result<ViolationReport, ExploreError>,
    error: Option<ExploreError>,
    is_playable: bool,
    player: &mut ScenePlayer<'_>,
) -> (Option<ViolationReport>, Option<ExploreError>) {
    let mut violation = match stored {
        Ok(violation) => violation,
        Err(unwritten) => return (None, error.or(Some(unwritten))),
    };
    if !is_playable || error.is_some() {
        return (Some(violation), error);
    }
    let path = Path::new(&violation.file);
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    player.renew();
    let again = load(path, &name).map_err(|fault| ExploreError::Generated(Box::new(fault)));
    let again = again.and_then(|scenario| player.play(&scenario)?.ok_or(RunError::Cancelled.into()));
    let again = again.map(|again| violation.is_reproduced = again.failure_of(violation.property).is_some());
    (Some(violation), again.err())
}

/// Removes loop delays from the envelope if the controller does not announce support for them.
fn envelope_for(envelope: &Envelope, identity: &Identity) -> Envelope {
    let mut reduced = envelope.clone();
    if !identity.has_capability(capabilities::LOOP_DELAY) {
        reduced.range.loop_delay_periods = [0.0; 2];
    }
    reduced
}

/// The first sequences with different differences, at most three.
fn distinct_sequences(failed: &[FailedSequence]) -> Vec<&FailedSequence> {
    let kind = |sequence: &FailedSequence| -> String {
        let letters = sequence.text.chars().filter(|letter| !letter.is_ascii_digit() && !"-.".contains(*letter));
        letters.collect()
    };
    let mut distinct: Vec<&FailedSequence> = Vec::new();
    for sequence in failed {
        if distinct.iter().all(|known| kind(known) != kind(sequence)) {
            distinct.push(sequence);
        }
    }
    distinct.truncate(MAX_MINIMAL);
    distinct
}

/// Returns the path of the scenario. `rig` is the rig as named on the command line.
fn write_regression(
    folder: &Path,
    config: &ExploreConfig,
    rig: &str,
    failed: &FailedScene,
    minimal: &MinimalScene,
) -> Result<PathBuf, ExploreError> {
    let property = minimal.failure.property;
    let (law, seed, index) = (config.law.name(), config.seed, failed.index);
    let name = format!("{law}-{property}-{seed}-{index}");
    let title = format!("Explored: {law} violates the property {property} (scene {index} of seed {seed})");
    let builder = ScenarioBuilder {
        base: &config.envelope.plate,
        title: &title,
        source: "platebench suite explore; the property and its limit: docs/exploration.md",
        plate_prefix: &format!("{name}-"),
    };
    let scenario = builder.build(&minimal.scene, &minimal.demands);
    scenario.write(folder, &name, &comment(rig, law, minimal))?;
    Ok(folder.join(format!("{name}.toml")))
}

fn comment(rig: &str, law: &str, minimal: &MinimalScene) -> Vec<String> {
    let failure = &minimal.failure;
    let number = |value: Option<f64>| value.map_or_else(|| "none".to_owned(), |value| format!("{value:.6}"));
    let unit = failure.property.metric().map_or("", |metric| metric.name());
    let measured = if failure.property == Property::Protocol {
        failure.name.clone()
    } else {
        format!("measured {} {unit}, limit {}", number(failure.value), number(failure.limit))
    };
    let mut lines = vec![
        format!("Written by platebench suite explore: a minimal scene that violates a property."),
        format!("property: {}", failure.property),
        format!("value: {measured}"),
        format!("law: {law}"),
        format!("rig: {rig}").replace(char::is_control, " "),
    ];
    if !minimal.is_reproduced {
        lines.push(NOT_MINIMAL.to_owned());
    }
    lines
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_controller_without_the_capability_gets_no_loop_delay() {
        let envelope = Envelope::load(&platebench_test_kit::scenario_path("envelope.toml")).unwrap();
        let identity = *Session::open(FaultInjector::new(RigSpec::hosted().connect().unwrap())).unwrap().identity();
        assert_eq!(envelope_for(&envelope, &identity).range.loop_delay_periods, envelope.range.loop_delay_periods);
        let without = Identity { capabilities: 0, ..identity };
        assert!(envelope.range.loop_delay_periods[1] > 0.0);
        assert_eq!(envelope_for(&envelope, &without).range.loop_delay_periods, [0.0; 2]);
    }
}
