//! One trial in real time: every microsecond that bench, line and controller take acts on the plate.
//!
//! One thread owns the loop. It neither allocates nor logs; rows leave it through a bounded queue. The plate is moved exactly to the instant of every event:
//! it is sampled at the deadline, however late the sample leaves, and driven anew when a command is there. So lateness is loop delay, as it would be on the
//! line, and nothing else.

use crate::accounting::Accounts;
use crate::configure::configure;
use crate::fault::{reconfigures, wire_faults};
use crate::observed::stop_reason;
use crate::queue::{Queue, collect};
use crate::scheduling::Granted;
use crate::stage::{Held, Stage, expected_rows};
use crate::trial::{Order, Patience, Played, is_the_controllers_doing};
use platebench_plate::Time;
use platebench_rig::{Faulty, Heard, Link, RigError, Session};
use platebench_scenario::Scenario;
use platebench_trace::{Flags, Row};
use platebench_verdict::Telemetry;
use platebench_wire::{Command, Configure, LawId, Message, State};
pub use rtrb::Consumer;
use std::panic::resume_unwind;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Mutex, PoisonError};
use std::thread;
use std::time::{Duration, Instant};

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

/// Whose timer makes the control instants.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Pacing {
    /// The bench's: a sample triggers a control step.
    #[default]
    Bench,
    /// The target's: its tick asks for a sample.
    Target,
}

impl Pacing {
    /// The name in records.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Bench => "bench",
            Self::Target => "target",
        }
    }
}

/// How plate time passes on the wall's clock.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pace {
    /// Plate seconds per wall second, above 0.
    pub time_scale: f64,
    /// Whose timer makes the control instants.
    pub pacing: Pacing,
}

impl Pace {
    /// How long `span` of plate time takes on the wall.
    pub fn wall(&self, span: Time) -> Duration {
        Duration::from_nanos((span.as_nanos() as f64 / self.time_scale).round() as u64)
    }

    /// How much plate time passes in `span`.
    pub fn plate(&self, span: Duration) -> Time {
        Time::from_nanos((span.as_nanos() as f64 * self.time_scale).round() as u64)
    }

    /// What the controller is told of its own clock.
    fn of_target(&self, configure: Configure) -> Configure {
        let period = Duration::from_micros(u64::from(configure.period_us)).as_secs_f64();
        // Five periods are the controller's own choice where plate and wall agree.
        let patience_ms = if self.time_scale == 1.0 { 0.0 } else { (5.0 * period * 1e3 / self.time_scale).ceil() };
        let paced_by_target = self.pacing == Pacing::Target;
        Configure { patience_ms: patience_ms as u16, paced_by_target, ..configure }
    }
}

/// Plays a trial. `None` where it was given up. The rig has to be one that can be used in real time.
///
/// Blocks the calling thread, which only collects rows: the loop has a thread of its own.
pub fn play<L: Link>(
    session: &mut Session<Faulty<L>>,
    order: &Order<'_>,
    pace: Pace,
    patience: &(impl Patience + Sync),
) -> Option<Played> {
    let (rows, ended) =
        drive(session, order, pace, patience, None, |rows| collect(rows, expected_rows(order.scenario)));
    ended.map(|(telemetry, lost)| Played { rows, telemetry, lost })
}

/// Plays the plate to whatever controller is there until `patience` is over or the controller is gone; `hand` takes over from the scenario's
/// profiles once it is used, and `show` is given the rows. Returns why nobody drives the plate any more.
pub fn emulate<L: Link>(
    session: &mut Session<Faulty<L>>,
    order: &Order<'_>,
    pace: Pace,
    patience: &(impl Patience + Sync),
    hand: &Hand,
    show: impl FnOnce(Consumer<Row>),
) -> Emulated {
    let ((), ended) = drive(session, order, pace, patience, Some(hand), show);
    match ended {
        None => Emulated::GivenUp,
        Some((_, Some(error))) => Emulated::Lost(error),
        Some((_, None)) => Emulated::Stopped,
    }
}

/// Why nobody drives an emulated plate any more.
#[derive(Debug)]
pub enum Emulated {
    /// Somebody asked for the end.
    GivenUp,
    /// The controller is no longer there.
    Lost(RigError),
    /// The controller has stopped and waits to be configured.
    Stopped,
}

/// Somebody's hand at the plate, while the loop looks at it once per period.
#[derive(Debug, Default)]
pub struct Hand {
    moves: AtomicU64,
    held: Mutex<Held>,
}

impl Hand {
    /// Takes over: from now on the plate is as `held` says.
    pub fn hold(&self, held: Held) {
        *self.held.lock().unwrap_or_else(PoisonError::into_inner) = held;
        self.moves.fetch_add(1, Ordering::Release);
    }

    /// What it holds, if it has moved since it had done so `seen` times. Does not wait: one that is moving is seen in the next period.
    fn moved(&self, seen: &mut u64) -> Option<Held> {
        let moves = self.moves.load(Ordering::Acquire);
        if moves == *seen {
            return None;
        }
        let held = *self.held.try_lock().ok()?;
        *seen = moves;
        Some(held)
    }
}

/// The loop on a thread of its own; its rows go to `take`.
fn drive<L: Link, T>(
    session: &mut Session<Faulty<L>>,
    order: &Order<'_>,
    pace: Pace,
    patience: &(impl Patience + Sync),
    hand: Option<&Hand>,
    take: impl FnOnce(Consumer<Row>) -> T,
) -> (T, Option<(Telemetry, Option<RigError>)>) {
    let (queue, consumer) = Queue::new();
    let stage = Stage::new(order.scenario, order.index, queue);
    session.link_mut().arm(&wire_faults(order.scenario, order.index));
    let begun = session.begin(&pace.of_target(configure(order.scenario, order.law)));
    thread::scope(|scope| {
        let live = scope.spawn(move || {
            let granted = Granted::ask();
            let mut live = Live::new(session, order, pace, stage, hand);
            let ended = begun.map_err(End::Lost).and_then(|_| live.play(patience)).err();
            live.finish(ended, &granted)
        });
        let taken = take(consumer);
        match live.join() {
            Ok(ended) => (taken, ended),
            Err(panic) => resume_unwind(panic),
        }
    })
}

/// Why a trial did not come to its end.
enum End {
    /// Somebody asked for it.
    GivenUp,
    /// The controller is no longer there.
    Lost(RigError),
}

impl From<RigError> for End {
    fn from(error: RigError) -> Self {
        Self::Lost(error)
    }
}

struct Live<'a, L: Link> {
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
    stop_reason: Option<&'static str>,
    accounts: Accounts,
}

impl<'a, L: Link> Live<'a, L> {
    fn new(
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
            stop_reason: None,
            accounts: Accounts::new(),
        }
    }

    fn play(&mut self, patience: &impl Patience) -> Result<(), End> {
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
            let until = deadline.checked_sub(SPIN).map_or(now, |until| until.max(now));
            if let Some(heard) = self.session.listen(until)? {
                // Commands that came while this thread was not awake for its deadline act after the sample.
                while self.next_control < self.duration && self.at(self.next_control) <= heard.at {
                    self.control_at_deadline(heard.at)?;
                }
                self.hear(&heard);
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
        self.control(lateness)
    }

    /// Control instants are when the target's tick arrives; the first one is the start.
    fn play_by_target(&mut self, patience: &impl Patience) -> Result<(), End> {
        let mut ticks = Ticks::default();
        let first = Instant::now() + SILENT_TIME;
        while !self.is_over() {
            if self.waits_in_vain() {
                return Ok(());
            }
            if patience.is_over() {
                return Err(End::GivenUp);
            }
            // Where no tick comes any more, somebody has to look at the clock.
            let until = Instant::now() + self.pace.wall(self.period);
            let until = if ticks.any() { until.min(self.at(self.duration)) } else { until };
            let Some(heard) = self.session.listen(until)? else {
                if Instant::now() >= if ticks.any() { self.last_heard + SILENT_TIME } else { first } {
                    return Err(RigError::NoAnswer { expected: "tick" }.into());
                }
                continue;
            };
            let Message::Tick(tick) = heard.message else {
                self.hear(&heard);
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
            let lateness = ticks.lateness(heard.at, tick.target_time_us);
            self.control(lateness)?;
        }
        self.listen_until_the_end(patience)
    }

    fn is_over(&self) -> bool {
        Instant::now() >= self.at(self.duration)
    }

    /// Samples the plate, which has got to the control instant, and sends what is seen.
    fn control(&mut self, lateness: Duration) -> Result<(), End> {
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
            self.stage.given(given.map(f64::from));
        }
        let overrun = lateness.as_secs_f64() > OVERRUN_SHARE * self.pace.wall(self.period).as_secs_f64();
        let missed = self.last_sent.is_some_and(|last| self.open.get(usize::from(last)).is_some_and(Option::is_some));
        self.accounts.periods += 1;
        self.accounts.overruns += u64::from(overrun);
        self.accounts.missed_replies += u64::from(missed);
        self.accounts.lateness.take(lateness);
        self.silent_periods += 1;
        let also = [(overrun, Flags::OVERRUN), (missed, Flags::LINK_LOST)];
        let flags = also.into_iter().filter(|(holds, _)| *holds).fold(Flags::CONTROL, |flags, (_, flag)| flags | flag);
        self.stage.push_row(micros(lateness), flags);
        let sequence = outcome?;
        if let Some(open) = self.open.get_mut(usize::from(sequence)) {
            *open = Some(now);
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

    fn hear(&mut self, heard: &Heard) {
        let Message::Command(command) = heard.message else { return };
        self.last_heard = heard.at;
        self.silent_periods = 0;
        let sampled = self.open.get_mut(usize::from(heard.sequence)).and_then(Option::take);
        // What was answered already is a frame that the line doubled, unless the controller says that it has stopped.
        if sampled.is_none() && command.state == State::Running {
            return;
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
            self.stop_reason.get_or_insert(stop_reason(&command));
        }
        self.actuate(&command);
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
                self.hear(&heard);
            }
        }
        self.stage.advance_through(self.duration);
        self.stage.push_row(0.0, Flags::empty());
        Ok(())
    }

    /// 0 V, and the books closed. `None` where the trial was given up.
    fn finish(mut self, ended: Option<End>, granted: &Granted) -> Option<(Telemetry, Option<RigError>)> {
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
        let mut timing = self.accounts.timing();
        timing.time_scale = self.pace.time_scale;
        self.pace.pacing.name().clone_into(&mut timing.pacing);
        granted.scheduling.clone_into(&mut timing.scheduling);
        timing.memory_locked = granted.memory_locked;
        timing.refused_frames = self.session.refused();
        timing.safe_confirmed = safe_confirmed;
        timing.lost_rows = self.stage.into_rows().lost();
        let faults = self.session.link().counts().map(|(kind, count)| (kind.to_owned(), count)).collect();
        let telemetry = Telemetry {
            faults,
            stopped: self.stop_reason.map(str::to_owned),
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

/// The target's ticks beside their arrivals: the earliest of late is taken for punctual.
#[derive(Debug, Default)]
struct Ticks {
    first: Option<(Instant, u32)>,
    /// Arrival minus the target's time, µs, smallest of this stretch of time and of the one before: clocks drift.
    earliest: [Option<f64>; 2],
    stretch: u64,
}

impl Ticks {
    /// How long a stretch is; two clocks drift by some 0.1 µs in a millisecond at most.
    const STRETCH: Duration = Duration::from_millis(500);

    fn any(&self) -> bool {
        self.first.is_some()
    }

    /// How much later than usual after its own instant this tick was heard.
    fn lateness(&mut self, at: Instant, target_us: u32) -> Duration {
        let (first_at, first_us) = *self.first.get_or_insert((at, target_us));
        let since = at.saturating_duration_since(first_at);
        // Wraps after 71 minutes together with the target's counter.
        let bench_us = (since.as_micros() as u32).wrapping_sub(target_us.wrapping_sub(first_us)).cast_signed();
        let behind = f64::from(bench_us);
        let stretch = (since.as_nanos() / Self::STRETCH.as_nanos()) as u64;
        if stretch != self.stretch {
            self.stretch = stretch;
            self.earliest = [None, self.earliest[0]];
        }
        let earliest = self.earliest.iter().flatten().fold(behind, |least, &other| least.min(other));
        self.earliest[0] = Some(self.earliest[0].map_or(behind, |least| least.min(behind)));
        Duration::from_secs_f64((behind - earliest).max(0.0) / 1e6)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn plate_and_wall_are_the_same_at_a_scale_of_one_and_apart_otherwise() {
        let pace = |time_scale| Pace { time_scale, pacing: Pacing::Bench };
        let period = Time::from_nanos(1_000_000);
        assert_eq!(pace(1.0).wall(period), Duration::from_millis(1));
        assert_eq!(pace(0.1).wall(period), Duration::from_millis(10));
        assert_eq!(pace(0.1).plate(Duration::from_millis(10)), period);
        // Three hours, to the nanosecond.
        let long = Time::from_nanos(3 * 3_600_000_000_000 + 1);
        assert_eq!(pace(1.0).plate(pace(1.0).wall(long)), long);
    }

    #[test]
    fn a_controller_is_given_patience_in_wall_time() {
        let configure = Configure {
            law: platebench_wire::LawId::DqPi,
            paced_by_target: false,
            patience_ms: 0,
            period_us: 1_000,
            start_frequency_mhz: 32_307_600,
            gain_um_per_vpp: 0.00698,
            time_constant_s: 1.88e-3,
            response_time_s: 0.0,
            drive_limit_vpp: 900.0,
            frequency_range_hz: 250.0,
            frequency_slew_hz: 100.0,
            gains: None,
        };
        let told = |time_scale, pacing| Pace { time_scale, pacing }.of_target(configure);
        assert_eq!(told(1.0, Pacing::Bench).patience_ms, 0);
        assert_eq!(told(0.1, Pacing::Bench).patience_ms, 50);
        assert_eq!(told(0.3, Pacing::Bench).patience_ms, 17);
        assert!(!told(1.0, Pacing::Bench).paced_by_target && told(1.0, Pacing::Target).paced_by_target);
    }

    #[test]
    fn a_tick_is_late_against_the_punctual_ones_before_it() {
        let start = Instant::now();
        let mut ticks = Ticks::default();
        // The target's counter wraps in between and runs 50 ppm slow.
        let mut hear = |number: u32, late_us: u64| {
            let at = start + Duration::from_micros(u64::from(number) * 1_000 + 100 + late_us);
            let target = (f64::from(number) * 1_000.0 * (1.0 - 50e-6)) as u32;
            ticks.lateness(at, 0xFFFF_0000_u32.wrapping_add(target)).as_micros()
        };
        assert_eq!(hear(0, 0), 0);
        // The target counts whole microseconds.
        assert!((299..=301).contains(&hear(1, 300)));
        assert!(hear(2, 0) <= 1);
        for number in 3..5_000 {
            let lateness = hear(number, 0);
            assert!(lateness <= 60, "tick {number}: drift of two stretches at most, not {lateness}");
        }
        let lateness = hear(5_000, 400);
        assert!((400..=460).contains(&lateness), "{lateness}");
    }

    #[test]
    fn a_hand_is_seen_once_per_move() {
        let hand = Hand::default();
        let mut seen = 0;
        assert_eq!(hand.moved(&mut seen), None);
        let held = Held { finger_force_n: 1.5, ..Held::default() };
        hand.hold(held);
        assert_eq!(hand.moved(&mut seen), Some(held));
        assert_eq!(hand.moved(&mut seen), None);
    }
}
