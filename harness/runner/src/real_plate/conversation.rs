//! What the bench says to a controller that drives its own plate, and what it hears.
//!
//! One thread, without allocation from the first setpoint on. Setpoints go out where the profile moves, on the clock of the controller as far as it has told, and again in
//! between to keep it alive. However the trial ends, 0 V is asked for before anything else.

use super::rows::{Rows, Told};
use crate::accounting::{Drift, Spans};
use crate::configure::configure;
use crate::end::End;
use crate::observed::stop_reason;
use crate::queue::Queue;
use crate::stage::Rows as _;
use crate::trial::{Order, Patience, is_the_controllers_doing};
use platebench_plate::Time;
use platebench_rig::{Faulty, Link, RigError, Session};
use platebench_scenario::Scenario;
use platebench_trace::Flags;
use platebench_verdict::record::RealPlate;
use platebench_wire::{Command, Configure, LawId, Message, Setpoint, State, StateCause};
use std::time::{Duration, Instant};

/// A controller without a setpoint for this long goes to 0 V.
const PATIENCE_MS: u16 = 250;
/// A setpoint that rests is sent again after this long.
const KEEP_ALIVE: Duration = Duration::from_millis(50);
/// A bench that was this late with one may have been too late.
const TOO_LATE: Duration = Duration::from_millis(200);
/// A setpoint without an acknowledgement for so long has none.
const ACKNOWLEDGED_WITHIN: Duration = Duration::from_millis(100);
/// A controller that tells nothing for this long is gone.
const SILENT: Duration = Duration::from_millis(500);
/// Somebody may want the end.
const LOOK_UP: Duration = Duration::from_millis(20);

/// What came of a conversation.
pub(super) struct Heard {
    pub(super) ended: Option<End>,
    /// Why the controller stopped, by its own account.
    pub(super) stopped: Option<&'static str>,
    pub(super) real_plate: RealPlate,
}

/// A setpoint on its way.
#[derive(Clone, Copy)]
struct Open {
    sent: Instant,
    /// How far the controller had told by then.
    told: Time,
}

pub(super) struct Conversation<'a, L: Link> {
    session: &'a mut Session<Faulty<L>>,
    scenario: &'a Scenario,
    law: LawId,
    rows: Rows,
    queue: Queue,
    /// What the next row is to be flagged with.
    flags: Flags,
    last_told: Instant,
    /// The setpoint that was sent last, and when.
    sent: Option<(f32, Instant)>,
    /// By sequence number: the setpoints that are not acknowledged yet.
    open: [Option<Open>; 256],
    acknowledged: Spans,
    setpoints: u64,
    unacknowledged: u64,
    /// Since its first telemetry.
    drift: Drift,
    first_told: Option<Instant>,
    stopped: Option<&'static str>,
}

impl<'a, L: Link> Conversation<'a, L> {
    pub(super) fn new(session: &'a mut Session<Faulty<L>>, order: &Order<'a>, queue: Queue) -> Self {
        let scenario = order.scenario;
        Self {
            session,
            scenario,
            law: order.law,
            rows: Rows::new(scenario.controller.period.wrapping_micros(), scenario.plate.drive_limit_vpp),
            queue,
            flags: Flags::empty(),
            last_told: Instant::now(),
            sent: None,
            open: [None; 256],
            acknowledged: Spans::new(),
            setpoints: 0,
            unacknowledged: 0,
            drift: Drift::default(),
            first_told: None,
            stopped: None,
        }
    }

    /// From the configuration to 0 V.
    pub(super) fn hold(mut self, patience: &impl Patience) -> Heard {
        let ended = self.play(patience).err();
        let safe_confirmed = self.session.safe();
        let controllers_doing = matches!(&ended, Some(End::Lost(error)) if is_the_controllers_doing(error));
        if (self.stopped.is_some() || controllers_doing)
            && let Some(row) = self.rows.stopped()
        {
            self.queue.push(row);
        }
        let real_plate = RealPlate {
            periods: self.rows.heard,
            missing: self.rows.missing,
            setpoints: self.setpoints,
            unacknowledged: self.unacknowledged,
            acknowledged_us: self.acknowledged.quantiles_us(),
            refused_frames: self.session.refused(),
            lost_rows: self.queue.lost(),
            clock_ppm: self.drift.ppm().map(|(ppm, error)| [ppm, error]),
            force_measured: self.rows.force_measured,
            safe_confirmed,
            ..RealPlate::default()
        };
        Heard { ended, stopped: self.stopped, real_plate }
    }

    fn play(&mut self, patience: &impl Patience) -> Result<(), End> {
        let configure = configure(self.scenario, self.law);
        self.session.begin(&Configure { drives_own_plate: true, patience_ms: PATIENCE_MS, ..configure })?;
        self.last_told = Instant::now();
        loop {
            if patience.is_over() {
                return Err(End::GivenUp);
            }
            let now = Instant::now();
            self.note_unacknowledged(now);
            self.speak(now)?;
            let heard = self.session.listen(self.next_instant(now))?;
            if let Some(heard) = &heard {
                self.hear(heard.sequence, &heard.message, heard.at)?;
            }
            if self.rows.time().is_some_and(|time| time >= self.scenario.duration) {
                return Ok(());
            }
            // What has not been read yet is no silence.
            if heard.is_none() && self.last_told.elapsed() > SILENT {
                // One that has stopped may have nothing more to tell.
                let silent = RigError::NoAnswer { expected: "telemetry" };
                return if self.stopped.is_some() { Ok(()) } else { Err(silent.into()) };
            }
        }
    }

    /// Where the trial is at `now`, on the controller's clock as far as it has told.
    fn trial_time(&self, now: Instant) -> Time {
        let since = now.saturating_duration_since(self.last_told).as_nanos();
        self.rows.time().map_or(Time::ZERO, |told| told + Time::from_nanos(since as u64))
    }

    /// When there is something to say or to look after.
    fn next_instant(&self, now: Instant) -> Instant {
        let trial = self.trial_time(now);
        let point = self.scenario.setpoint.next_point_after(trial).filter(|_| self.rows.time().is_some());
        let to_point = point.map_or(LOOK_UP, |point| Duration::from_nanos(point.since(trial).as_nanos()));
        now + to_point.min(LOOK_UP)
    }

    /// A setpoint where it moved, or where it is time for another one.
    fn speak(&mut self, now: Instant) -> Result<(), End> {
        let setpoint_um = self.scenario.setpoint.at(self.trial_time(now)) as f32;
        let since = self.sent.map(|(_, sent)| now.saturating_duration_since(sent));
        let has_moved = self.sent.is_none_or(|(last, _)| last != setpoint_um);
        if !has_moved && since.is_some_and(|since| since < KEEP_ALIVE) {
            return Ok(());
        }
        if since.is_some_and(|since| since > TOO_LATE) {
            self.flags |= Flags::OVERRUN;
        }
        let sequence = self.session.post(Message::Setpoint(Setpoint { setpoint_um }))?;
        self.setpoints += 1;
        self.sent = Some((setpoint_um, now));
        if let Some(open) = self.open.get_mut(usize::from(sequence)) {
            *open = Some(Open { sent: now, told: self.rows.time().unwrap_or(Time::ZERO) });
        }
        Ok(())
    }

    /// An acknowledgement comes before the telemetry that is said after it: where that was heard, it is no late bench that has not read it yet.
    fn note_unacknowledged(&mut self, now: Instant) {
        let within = Time::from_nanos(ACKNOWLEDGED_WITHIN.as_nanos() as u64);
        let told = self.rows.time().unwrap_or(Time::ZERO);
        let is_missed = |open: &mut Open| {
            now.saturating_duration_since(open.sent) > ACKNOWLEDGED_WITHIN && told.since(open.told) > within
        };
        for open in &mut self.open {
            if open.take_if(is_missed).is_some() {
                self.unacknowledged += 1;
                self.flags |= Flags::LINK_LOST;
            }
        }
    }

    fn hear(&mut self, sequence: u8, message: &Message, at: Instant) -> Result<(), End> {
        match message {
            Message::Telemetry(told) => {
                let Told::Row(row) = self.rows.take(told) else { return Ok(()) };
                self.last_told = at;
                let since = at.saturating_duration_since(*self.first_told.get_or_insert(at));
                self.drift.take(since, told.target_time_us);
                if told.state != State::Running {
                    self.stopped.get_or_insert(why(told.cause));
                }
                let flags = row.flags | std::mem::take(&mut self.flags);
                self.queue.push(platebench_trace::Row { flags, ..row });
                Ok(())
            }
            Message::Command(command) => self.acknowledge(sequence, command, at),
            _ => Ok(()),
        }
    }

    fn acknowledge(&mut self, sequence: u8, command: &Command, at: Instant) -> Result<(), End> {
        let sent = self.open.get_mut(usize::from(sequence)).and_then(Option::take);
        if let Some(sent) = sent {
            self.acknowledged.take(at.saturating_duration_since(sent.sent));
        }
        match command.state {
            // It was configured: a board that knows nothing of that was restarted.
            State::Idle if sent.is_some() => Err(RigError::Restarted.into()),
            State::Fault | State::Safe => {
                self.stopped.get_or_insert(why(command.cause));
                Ok(())
            }
            State::Idle | State::Running => Ok(()),
        }
    }
}

/// Why a controller that is given setpoints has stopped.
const fn why(cause: StateCause) -> &'static str {
    match cause {
        StateCause::SampleTimeout => "no setpoint for as long as it was to wait for one",
        StateCause::LineNoise | StateCause::NonFinite | StateCause::None => stop_reason(cause),
    }
}
