//! The loop: what happens at a control instant, when something is heard, and at the end.

use super::hand::Hand;
use super::pace::{Pace, Pacing};
use super::ticks::Ticks;
use crate::accounting::Accounts;
use crate::configure::configure;
use crate::end::End;
use crate::fault::reconfigures;
use crate::observed::stop_reason;
use crate::queue::Queue;
use crate::scheduling::Granted;
use crate::stage::Stage;
use crate::trial::{Order, Patience, is_the_controllers_doing};
use platebench_plate::Time;
use platebench_rig::{Faulty, Heard, Link, RigError, Session};
use platebench_scenario::Scenario;
use platebench_trace::Flags;
use platebench_verdict::Telemetry;
use platebench_wire::{Command, Configure, LawId, Message, State, StateCause};
use std::time::{Duration, Instant};

/// Somebody may want the end while the next instant is far away.
const LOOK_UP: Duration = Duration::from_millis(20);
/// From here on the thread looks for answers without sleeping: a timer wakes it some tens of microseconds late.
const SPIN: Duration = Duration::from_micros(80);
/// A sample that leaves later than this share of the period is an overrun of the bench.
const OVERRUN_SHARE: f64 = 0.25;
/// The controller is lost for good after this many periods without a word from it ...
const SILENT_PERIODS: u32 = 20;
/// ... that also lasted this long: a computer that two programs share stalls for some ten milliseconds now and then.
const SILENT_TIME: Duration = Duration::from_millis(250);
/// Between the configuration and the first control instant.
const LEAD: Duration = Duration::from_millis(2);

pub(super) struct Live<'a, L: Link> {
    session: &'a mut Session<Faulty<L>>,
    scenario: &'a Scenario,
    law: LawId,
    stage: Stage<'a, Queue>,
    /// With the moves of it that were seen.
    hand: Option<(&'a Hand, u64)>,
    pace: Pace,
    period: Time,
    duration: Time,
    start: Instant,
    next_control: Time,
    /// By sequence number: the control instants whose samples have no answer yet.
    open: [Option<Time>; 256],
    /// The last sample, and whether it is still without an answer.
    last_sent: Option<u8>,
    last_heard: Instant,
    silent_periods: u32,
    /// When the controller said that it does not run, while it does not, and why it first did.
    stopped: Option<Time>,
    stop_cause: Option<StateCause>,
    accounts: Accounts,
}

impl<'a, L: Link> Live<'a, L> {
    pub(super) fn new(
        session: &'a mut Session<Faulty<L>>,
        order: &Order<'a>,
        pace: Pace,
        stage: Stage<'a, Queue>,
        hand: Option<&'a Hand>,
    ) -> Self {
        let now = Instant::now();
        Self {
            session,
            scenario: order.scenario,
            law: order.law,
            stage,
            hand: hand.map(|hand| (hand, 0)),
            pace,
            period: order.scenario.controller.period,
            duration: order.scenario.duration,
            start: now + LEAD,
            next_control: Time::ZERO,
            open: [None; 256],
            last_sent: None,
            last_heard: now,
            silent_periods: 0,
            stopped: None,
            stop_cause: None,
            accounts: Accounts::new(),
        }
    }

    pub(super) fn play(&mut self, patience: &impl Patience) -> Result<(), End> {
        match self.pace.pacing {
            Pacing::Bench => self.play_by_own_timer(patience),
            Pacing::Target => self.play_by_target(patience),
        }
    }

    fn at(&self, plate: Time) -> Instant {
        self.start + self.pace.wall(plate)
    }

    fn since_start(&self, at: Instant) -> Time {
        self.pace.plate(at.saturating_duration_since(self.start))
    }

    /// Control instants are multiples of the period.
    fn play_by_own_timer(&mut self, patience: &impl Patience) -> Result<(), End> {
        self.session.link_mut().run_from(self.start, self.pace.time_scale);
        while self.next_control < self.duration {
            if self.waits_in_vain() {
                return Ok(());
            }
            if patience.is_over() {
                return Err(End::GivenUp);
            }
            let deadline = self.at(self.next_control);
            let now = Instant::now();
            if now >= deadline {
                self.control_at_deadline(now)?;
                continue;
            }
            // Asleep while there is time, then awake.
            let until = deadline.checked_sub(SPIN).map_or(now, |until| until.max(now)).min(now + LOOK_UP);
            if let Some(heard) = self.session.listen(until)? {
                // Commands that came while this thread was not awake for its deadline act after the sample.
                while self.next_control < self.duration && self.at(self.next_control) <= heard.at {
                    self.control_at_deadline(heard.at)?;
                }
                self.hear(&heard)?;
            }
        }
        self.listen_until_the_end(patience)
    }

    /// A control instant has come, at `now` at the latest.
    fn control_at_deadline(&mut self, now: Instant) -> Result<(), End> {
        let due = self.next_control;
        self.next_control = due + self.period;
        let lateness = now.saturating_duration_since(self.at(due));
        self.stage.advance_through(due);
        if now >= self.at(self.next_control) {
            // Too late to be of use to anybody.
            self.accounts.periods += 1;
            self.accounts.overruns += 1;
            self.accounts.skipped += 1;
            self.accounts.lateness.take(lateness);
            self.stage.push_row(micros(lateness), Flags::OVERRUN);
            return Ok(());
        }
        self.control(lateness, 0)
    }

    /// Control instants are when the target's tick arrives; the first one is the start.
    fn play_by_target(&mut self, patience: &impl Patience) -> Result<(), End> {
        let mut ticks = Ticks::default();
        let first = Instant::now() + SILENT_TIME;
        let mut last_tick = Time::ZERO;
        while !self.is_over() {
            if self.waits_in_vain() {
                return Ok(());
            }
            if patience.is_over() {
                return Err(End::GivenUp);
            }
            // Where no tick comes any more, somebody has to look at the clock.
            let until = Instant::now() + self.pace.wall(self.period).min(LOOK_UP);
            let until = if ticks.any() { until.min(self.at(self.duration)) } else { until };
            let Some(heard) = self.session.listen(until)? else {
                if Instant::now() >= if ticks.any() { self.last_heard + SILENT_TIME } else { first } {
                    return Err(RigError::NoAnswer { expected: "tick" }.into());
                }
                continue;
            };
            let Message::Tick(tick) = heard.message else {
                self.hear(&heard)?;
                continue;
            };
            if !ticks.any() {
                self.start = heard.at;
                self.session.link_mut().run_from(self.start, self.pace.time_scale);
            }
            self.last_heard = heard.at;
            let instant = self.since_start(heard.at);
            if instant >= self.duration {
                break;
            }
            self.stage.advance_through(instant);
            last_tick = instant;
            // Whether the target skipped those that are missing or the line lost them cannot be told from here.
            let (lateness, missing) = ticks.hear(heard.at, tick.target_time_us, self.period);
            self.control(lateness, missing)?;
        }
        self.listen_until_the_end(patience)?;
        self.note_silence_since(last_tick);
        Ok(())
    }

    /// A target that ticks no more controls no more. Whether it has stopped by itself or was not heard cannot be told, unless it says so.
    fn note_silence_since(&mut self, last_tick: Time) {
        let periods = (self.duration - last_tick).as_nanos() / self.period.as_nanos().max(1);
        let said = self.stop_cause.is_some_and(|cause| cause != StateCause::SampleTimeout);
        let missing = periods.saturating_sub(2);
        if missing > 0 && !said {
            self.accounts.missed_replies += missing;
            self.stage.tell(missing, self.session.refused());
            self.stage.push_row(0.0, Flags::LINK_LOST);
        }
    }

    fn is_over(&self) -> bool {
        Instant::now() >= self.at(self.duration)
    }

    /// Samples the plate, which has got to the control instant, and sends what is seen. Before it were `missing` instants at which nobody controlled.
    fn control(&mut self, lateness: Duration, missing: u64) -> Result<(), End> {
        let now = self.stage.time();
        if let Some(held) = self.hand.as_mut().and_then(|(hand, seen)| hand.moved(seen)) {
            self.stage.hold(&held);
        }
        let sample = self.stage.sense();
        let sent = Instant::now();
        if let Some(configure) = self.new_configuration(now) {
            self.session.post(Message::Configure(configure))?;
            self.stopped = None;
        }
        let outcome = self.session.post(Message::Sample(sample));
        if let Some(given) = self.session.link().given() {
            self.stage.given(given);
        }
        let overrun = lateness.as_secs_f64() > OVERRUN_SHARE * self.pace.wall(self.period).as_secs_f64();
        let missed = self.last_sent.is_some_and(|last| self.open.get(usize::from(last)).is_some_and(Option::is_some));
        self.accounts.periods += 1;
        self.accounts.overruns += u64::from(overrun);
        let misses = u64::from(missed) + missing;
        self.accounts.missed_replies += misses;
        self.stage.tell(misses, self.session.refused());
        self.accounts.lateness.take(lateness);
        self.silent_periods += 1;
        let also = [(overrun, Flags::OVERRUN), (missed || missing > 0, Flags::LINK_LOST)];
        let flags = also.into_iter().filter(|(holds, _)| *holds).fold(Flags::CONTROL, |flags, (_, flag)| flags | flag);
        self.stage.push_row(micros(lateness), flags);
        let sequence = outcome?;
        if let Some(open) = self.open.get_mut(usize::from(sequence)) {
            // An answer that is 256 samples late would be taken for another one's.
            self.accounts.lost_replies += u64::from(open.replace(now).is_some());
        }
        self.last_sent = Some(sequence);
        if self.scenario.explains(now) {
            // A line that is planned to come back is waited for.
            self.last_heard = sent;
            self.silent_periods = 0;
        }
        let silent = sent.saturating_duration_since(self.last_heard);
        if self.silent_periods > SILENT_PERIODS && silent > SILENT_TIME {
            return Err(RigError::NoAnswer { expected: "command" }.into());
        }
        Ok(())
    }

    /// What a line operator says once a fault is over that stopped the controller. Its answer is not waited for.
    fn new_configuration(&self, now: Time) -> Option<Configure> {
        let stopped = self.stopped?;
        let is_over = reconfigures(self.scenario, stopped, now);
        is_over.then(|| self.pace.of_target(configure(self.scenario, self.law)))
    }

    fn hear(&mut self, heard: &Heard) -> Result<(), End> {
        let Message::Command(command) = heard.message else { return Ok(()) };
        self.last_heard = heard.at;
        self.silent_periods = 0;
        let sampled = self.open.get_mut(usize::from(heard.sequence)).and_then(Option::take);
        // What was answered already is a frame that the line doubled, unless the controller says that it has stopped.
        if sampled.is_none() && command.state == State::Running {
            return Ok(());
        }
        // Idle after its configuration: it has forgotten it.
        if sampled.is_some() && command.state == State::Idle {
            return Err(RigError::Restarted.into());
        }
        let instant = self.since_start(heard.at).min(self.duration);
        self.stage.advance_through(instant);
        if let Some(sampled) = sampled {
            let delay = instant.since(sampled);
            self.accounts.loop_delay.take(Duration::from_nanos(delay.as_nanos()));
            let on_the_wall = heard.at.saturating_duration_since(self.at(sampled));
            self.accounts.longest_rig_delay = self.accounts.longest_rig_delay.max(on_the_wall);
            let bench = self.at(sampled).saturating_duration_since(self.start);
            self.accounts.drift.take(bench, command.target_time_us);
        }
        if command.state == State::Running {
            self.stopped = None;
        } else {
            self.stopped.get_or_insert(instant);
            self.stop_cause.get_or_insert(command.cause);
        }
        self.actuate(&command);
        Ok(())
    }

    /// True where somebody waits for the controller to go on, and it does not.
    fn waits_in_vain(&self) -> bool {
        self.stopped.is_some() && self.hand.is_some()
    }

    fn actuate(&mut self, command: &Command) {
        self.stage.actuate(command);
        if !self.stage.is_over() {
            self.stage.push_row(0.0, Flags::empty());
        }
    }

    /// What the last samples are answered with still acts.
    fn listen_until_the_end(&mut self, patience: &impl Patience) -> Result<(), End> {
        let end = self.at(self.duration);
        while Instant::now() < end {
            if patience.is_over() {
                return Err(End::GivenUp);
            }
            let soon = Instant::now() + Duration::from_millis(50);
            if let Some(heard) = self.session.listen(soon.min(end))? {
                self.hear(&heard)?;
            }
        }
        // What came in time may not have been read yet; a controller that does not stop talking is not listened to for ever.
        for _ in 0..self.open.len() {
            let Some(heard) = self.session.listen(Instant::now())? else { break };
            self.hear(&heard)?;
        }
        self.stage.advance_through(self.duration);
        let missed = u64::from(self.misses_last());
        self.accounts.missed_replies += missed;
        self.stage.tell(missed, self.session.refused());
        self.stage.push_row(0.0, if missed > 0 { Flags::LINK_LOST } else { Flags::empty() });
        Ok(())
    }

    /// True where the last sample had a whole period for its answer and has none: no further control instant would notice.
    fn misses_last(&self) -> bool {
        let sampled = self.last_sent.and_then(|last| self.open.get(usize::from(last)).copied().flatten());
        sampled.is_some_and(|sampled| self.duration.since(sampled) >= self.period)
    }

    /// 0 V, and the books closed. `None` where the trial was given up.
    pub(super) fn finish(mut self, ended: Option<End>, granted: &Granted) -> Option<(Telemetry, Option<RigError>)> {
        let safe_confirmed = self.session.safe();
        let lost = match ended {
            None => None,
            Some(End::GivenUp) => return None,
            Some(End::Lost(error)) => Some(error),
        };
        if let Some(error) = &lost {
            // What is left of the trial is played at 0 V, in no time.
            let flags = if is_the_controllers_doing(error) { Flags::empty() } else { Flags::LINK_LOST };
            self.stage.rest();
            self.stage.push_row(0.0, flags);
            self.stage.advance_through(self.duration);
            self.stage.push_row(0.0, flags);
        }
        self.accounts.lost_replies += self.open.iter().flatten().count() as u64;
        self.stage.tell(0, self.session.refused());
        let mut timing = self.accounts.timing();
        timing.time_scale = self.pace.time_scale;
        self.pace.pacing.name().clone_into(&mut timing.pacing);
        granted.scheduling.clone_into(&mut timing.scheduling);
        timing.memory_locked = granted.memory_locked;
        timing.refused_frames = self.session.refused();
        timing.safe_confirmed = safe_confirmed;
        let not_finite = self.stage.not_finite();
        timing.lost_rows = self.stage.into_rows().lost();
        let faults = self.session.link().counts().map(|(kind, count)| (kind.to_owned(), count)).collect();
        let telemetry = Telemetry {
            faults,
            not_finite,
            contradictions: self.session.contradictions(),
            stopped: self.stop_cause.map(|cause| stop_reason(cause).to_owned()),
            loop_delay_us: timing.loop_delay_us.map(|quantiles| quantiles.max),
            rig_delay_us: timing.loop_delay_us.map(|_| self.accounts.longest_rig_delay.as_secs_f64() * 1e6),
            ended: lost.as_ref().map(ToString::to_string),
            timing: Some(timing),
            ..Telemetry::default()
        };
        Some((telemetry, lost))
    }
}

fn micros(span: Duration) -> f64 {
    span.as_secs_f64() * 1e6
}

#[cfg(test)]
mod tests;
