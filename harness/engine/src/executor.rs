//! Plays the trials of scenarios on one controller. Connects to the controller, plays the scenes
//! between trials, replaces a lost controller and confirms 0 V at the end. Its callers choose,
//! judge and store the trials.

use crate::controller_log::is_controller_failure;
use crate::firmware_digest::FirmwareDigest;
use crate::live_tap::TapWriter;
use crate::plan::{Clock, LinkFactory, NoOperator, Operator, RigSession, RunError};
use crate::trial::{self, Trial, TrialResult};
use crate::{lockstep, real_plate, real_time};
use platebench_model::quoted;
use platebench_model::record::Telemetry;
use platebench_model::scenario::Scenario;
use platebench_rig::{BoxedLink, CancelToken, FaultInjector, Link, LinkError, RigError, SafeEnd, WaitBudget};
use platebench_verdict::{Judgement, SequentialDecision, judge_sequentially, measure};
use platebench_wire::{Identity, LawId};
use std::ops::ControlFlow;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, OnceLock};
use std::time::{Duration, Instant};
use tracing::{debug, error};

/// Number of consecutive trials with a lost controller after which a search or a sweep ends, and of
/// trials whose frames are all rejected after which a run ends.
pub const MAX_LOSSES: u32 = 5;

/// Longest wait for a port or a server that has vanished.
const RETURN_TIMEOUT: Duration = Duration::from_secs(5);

/// Ends of all sessions of several executors.
#[derive(Debug, Default)]
pub struct SafeEnds {
    unconfirmed: AtomicBool,
    driven: AtomicBool,
}

impl SafeEnds {
    pub fn record(&self, end: SafeEnd) {
        self.unconfirmed.fetch_or(end != SafeEnd::Confirmed, Ordering::Relaxed);
        self.driven.fetch_or(matches!(end, SafeEnd::Driven(_)), Ordering::Relaxed);
    }

    /// True if every controller confirmed 0 V and stayed there.
    pub fn are_confirmed(&self) -> bool {
        !self.unconfirmed.load(Ordering::Relaxed)
    }

    /// True if a controller commanded a drive after it had confirmed 0 V, outside all trials.
    pub fn have_drive(&self) -> bool {
        self.driven.load(Ordering::Relaxed)
    }
}

#[derive(Clone)]
pub struct ExecutorSettings<'a> {
    pub clock: Clock,
    pub own_clock: bool,
    /// True if the protocol check plays its long scripts also with an own clock.
    pub long_scripts: bool,
    pub cancel: CancelToken,
    pub operator: &'a dyn Operator,
    /// Identity of the first controller, shared by all executors with a copy of these settings. An
    /// executor fails if it connects to another controller.
    pub identity: Arc<OnceLock<Identity>>,
    /// The executor fails if it connects after the program or image of the controller changed.
    pub firmware: Option<&'a FirmwareDigest>,
    /// Number of consecutive trials with a lost controller after which the executor fails.
    pub max_losses: Option<u32>,
    /// True if the controller keeps its history from one scenario to the next.
    pub shares_controller: bool,
    /// True if the executor never replaces its link, because the caller changes or observes the
    /// target. The link must be able to restart the target.
    pub keeps_link: bool,
    /// True if the session belongs to several runs, so that no scenario starts with a new one.
    pub keeps_session: bool,
}

impl ExecutorSettings<'_> {
    pub fn lockstep(cancel: &CancelToken) -> Self {
        Self {
            clock: Clock::Lockstep { wire_time: false },
            own_clock: false,
            long_scripts: false,
            cancel: cancel.clone(),
            operator: &NoOperator,
            identity: Arc::default(),
            firmware: None,
            max_losses: None,
            shares_controller: false,
            keeps_link: false,
            keeps_session: false,
        }
    }
}

/// How the trials of a scenario ended.
#[derive(Debug)]
pub enum ScenarioEnd<B> {
    Judged(Judgement),
    Stopped(B),
    Cancelled,
}

/// Dropping the executor requests 0 V and records the end of the session.
pub struct Executor<'a, L: Link = BoxedLink> {
    connect: &'a LinkFactory<'a, L>,
    settings: ExecutorSettings<'a>,
    ends: &'a SafeEnds,
    session: Option<RigSession<L>>,
    losses: u32,
    /// Number of consecutive trials without a command because frames were rejected.
    rejections: u32,
    /// True after the first connection.
    has_connected: bool,
}

impl<'a, L: Link> Executor<'a, L> {
    /// Connects at the first trial.
    pub fn new(connect: &'a LinkFactory<'a, L>, settings: ExecutorSettings<'a>, ends: &'a SafeEnds) -> Self {
        Self { connect, settings, ends, session: None, losses: 0, rejections: 0, has_connected: false }
    }

    pub(crate) fn with_session(mut self, session: RigSession<L>) -> Self {
        (self.session, self.has_connected) = (Some(session), true);
        self
    }

    pub fn set_cancel(&mut self, cancel: &CancelToken) {
        self.settings.cancel = cancel.clone();
    }

    /// Returns the open session, or connects.
    pub fn session(&mut self) -> Result<&mut RigSession<L>, RunError> {
        let session = match self.session.take() {
            Some(open) => open,
            None => self.connect()?,
        };
        Ok(self.session.insert(session))
    }

    /// Requests 0 V and closes the session, so that the next trial connects again.
    pub fn close(&mut self) {
        let Some(session) = self.session.take() else { return };
        // A panic of the link counts as a missing confirmation of 0 V.
        let end = catch_unwind(AssertUnwindSafe(|| session.close())).unwrap_or(SafeEnd::Unconfirmed);
        self.ends.record(end);
    }

    /// Plays trial `index` and, before it, the scenes between trials. `None` if it was cancelled.
    /// Fails if the controller cannot be reached, or if the configuration is unusable for every
    /// controller. A lost controller is no error of the trial, unless it is lost too often, or all
    /// of its frames are rejected in trial after trial.
    pub fn play(
        &mut self,
        scenario: &Scenario,
        law: LawId,
        index: u32,
        tap: Option<&mut TapWriter>,
    ) -> Result<Option<TrialResult>, RunError> {
        let keeps_controller = index > 0 && scenario.keeps_controller();
        self.close_unusable_session(scenario, index, keeps_controller);
        let mut scenes = Telemetry::default();
        for scene in scenario.between.iter().filter(|_| index > 0) {
            let law = trial::law(scene).map_err(|unknown| RunError::Scenario(Box::new(unknown)))?;
            let Some(played) = self.play_on_clock(scene, law, index, true, None)? else { return Ok(None) };
            scenes.include_scene(played.telemetry);
        }
        let continues = keeps_controller || self.settings.shares_controller;
        let scene = scenario.of_trial(index);
        let law = match &scenario.other_trials {
            Some(_) if index > 0 => trial::law(scene).map_err(|unknown| RunError::Scenario(Box::new(unknown)))?,
            _ => law,
        };
        let Some(mut played) = self.play_on_clock(scene, law, index, continues, tap)? else { return Ok(None) };
        played.telemetry.include_scene(scenes);
        self.rejections =
            if matches!(played.link_error, Some(RigError::RejectedAnswer { .. })) { self.rejections + 1 } else { 0 };
        match &played.link_error {
            // A controller that refuses a configuration answers, so the next trial needs no other one.
            None | Some(RigError::ConfigurationRejected(_)) => self.losses = 0,
            Some(lost) => self.replace_lost_controller(lost)?,
        }
        match played.link_error.take_if(|_| self.rejections >= MAX_LOSSES) {
            Some(error) => Err(RunError::Rejected { trials: self.rejections, error }),
            None => Ok(Some(played)),
        }
    }

    /// Plays trials of `variant` until `scenario` is decided or `on_trial` stops it. The two differ
    /// only in the spread of the trials.
    pub fn play_until_decided<B>(
        &mut self,
        scenario: &Scenario,
        variant: &Scenario,
        law: LawId,
        mut on_trial: impl FnMut(&TrialResult) -> ControlFlow<B>,
    ) -> Result<ScenarioEnd<B>, RunError> {
        let mut trials = Vec::new();
        loop {
            let goal = match judge_sequentially(scenario, &trials) {
                SequentialDecision::Stop(judgement) => return Ok(ScenarioEnd::Judged(judgement)),
                SequentialDecision::Continue { trials } => trials,
            };
            for index in trials.len() as u32..goal {
                let Some(played) = self.play(variant, law, index, None)? else { return Ok(ScenarioEnd::Cancelled) };
                if let ControlFlow::Break(reason) = on_trial(&played) {
                    return Ok(ScenarioEnd::Stopped(reason));
                }
                trials.push(measure(variant, index, &played.trace_rows, &played.telemetry));
            }
        }
    }

    fn open(&self) -> Result<RigSession<L>, RunError> {
        let link = FaultInjector::new((self.connect)()?);
        // The time limit of a scenario does not end the run.
        Ok(RigSession::open_cancellable(link, &self.settings.cancel.with_deadline(None))?)
    }

    /// Waits for a port or a server that was there before, such as a USB board that resets.
    fn open_again(&self) -> Result<RigSession<L>, RunError> {
        let mut budget = WaitBudget::new(RETURN_TIMEOUT);
        loop {
            let error = match self.open() {
                Err(error) if may_come_back(&error) => error,
                opened => return opened,
            };
            if self.settings.cancel.with_deadline(None).is_cancelled() {
                return Err(RunError::Cancelled);
            }
            let Some(until) = budget.next_part(Instant::now()) else { return Err(error) };
            debug!(%error, "the rig is not there, which is tried again");
            self.settings.cancel.sleep(until.saturating_duration_since(Instant::now()));
        }
    }

    /// Requests 0 V and returns the session for another run. `None` if it is closed or has ended,
    /// or if the controller did not confirm 0 V.
    pub(crate) fn rest(&mut self) -> Option<RigSession<L>> {
        let mut session = self.session.take()?;
        // A panic of the link counts as a missing confirmation of 0 V.
        let end = catch_unwind(AssertUnwindSafe(|| session.rest())).unwrap_or(SafeEnd::Unconfirmed);
        self.ends.record(end);
        Some(session).filter(|session| end == SafeEnd::Confirmed && !session.has_ended())
    }

    fn connect(&mut self) -> Result<RigSession<L>, RunError> {
        if let Some(file) = self.settings.firmware.and_then(FirmwareDigest::changed_file) {
            return Err(RunError::DifferentProgram { file });
        }
        let session = if self.has_connected { self.open_again()? } else { self.open()? };
        self.has_connected = true;
        let found = *session.identity();
        let expected = self.settings.identity.get_or_init(|| found);
        if found == *expected {
            return Ok(session);
        }
        self.ends.record(session.close());
        Err(RunError::DifferentController { found: controller_name(&found), expected: controller_name(expected) })
    }

    /// Closes the session if the trial needs another one: for a controller without a history or a
    /// configuration, or after the end of a program that had confirmed 0 V.
    fn close_unusable_session(&mut self, scenario: &Scenario, index: u32, keeps_controller: bool) {
        let Some(session) = &self.session else { return };
        let is_kept = self.settings.shares_controller || self.settings.keeps_link || self.settings.keeps_session;
        let needs_new = !scenario.between.is_empty() && index == 0 && !is_kept;
        let needs_first = scenario.needs_new_controller() && !self.settings.keeps_link;
        if needs_new || needs_first || (session.has_ended() && !keeps_controller) {
            self.close();
        }
    }

    fn play_on_clock(
        &mut self,
        scenario: &Scenario,
        law: LawId,
        index: u32,
        continues: bool,
        tap: Option<&mut TapWriter>,
    ) -> Result<Option<TrialResult>, RunError> {
        let ExecutorSettings { clock, own_clock, long_scripts, operator, .. } = self.settings;
        let wire_time = clock == Clock::Lockstep { wire_time: true };
        let cancel = self.settings.cancel.clone();
        // The start of an emulated board or a program takes up to seconds.
        if cancel.is_cancelled() {
            return Ok(None);
        }
        let session = match self.session() {
            Err(RunError::Cancelled) => return Ok(None),
            session => session?,
        };
        let law = trial::law_number(scenario, law, session.identity());
        let trial =
            Trial { wire_time, own_clock, long_scripts, continues, cancel, tap, ..Trial::new(scenario, law, index) };
        let played = match clock {
            Clock::RealPlate => real_plate::play(session, &trial, operator)?,
            Clock::Lockstep { .. } => lockstep::play(session, trial),
            Clock::RealTime(time_base) => real_time::play(session, trial, time_base),
        };
        if let Some(TrialResult { link_error: Some(RigError::ConfigurationRejected(_)), .. }) = &played {
            trial::check_configuration(scenario, law)?;
        }
        // Requests 0 V now, because other workers may need longer until they end.
        if played.is_none() {
            self.close();
        }
        Ok(played)
    }

    fn replace_lost_controller(&mut self, lost: &RigError) -> Result<(), RunError> {
        error!(error = lost.cause(), "controller lost");
        if !self.settings.keeps_link {
            self.close();
        }
        // A crash fails its trial and does not show that the connection fails.
        self.losses = if is_controller_failure(lost) { 0 } else { self.losses + 1 };
        match self.settings.max_losses {
            Some(max) if self.losses >= max => Err(RunError::Lost(self.losses)),
            _ => Ok(()),
        }
    }
}

impl<L: Link> Drop for Executor<'_, L> {
    fn drop(&mut self) {
        self.close();
    }
}

fn may_come_back(error: &RunError) -> bool {
    match error {
        RunError::Connect(error) => platebench_rig::may_come_back(error),
        RunError::Rig(RigError::Link(LinkError::Disconnected(_))) => true,
        _ => false,
    }
}

fn controller_name(identity: &Identity) -> String {
    let [major, minor, patch] = identity.version;
    let [build, unique] = [&identity.build[..], &identity.unique[..]].map(platebench_model::record::to_hex);
    format!(
        "{} {major}.{minor}.{patch}, build {build}, number {unique}",
        quoted(&platebench_rig::printable_name(identity))
    )
}
