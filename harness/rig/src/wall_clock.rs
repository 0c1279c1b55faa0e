//! Runs a link with virtual time in real time. The `now` of the inner link is the wall time since
//! the start of the trial. An answer arrives after the inner link's delay. While the bench waits,
//! the target's time advances in small steps to the end of the wait or to the target's next
//! message. Then the thread sleeps until this instant. In simulated time it does not sleep, so that
//! a test does not depend on the load of the machine.

use crate::link::{Link, LinkError, LinkKind, RealTimeLine};
use std::collections::VecDeque;
use std::thread;
use std::time::{Duration, Instant};

/// Step of the target's time: the largest error of the arrival of an unsolicited message.
const TIME_STEP: Duration = Duration::from_micros(20);
const MAX_FRAMES_IN_FLIGHT: usize = 64;

#[derive(Debug)]
pub struct WallClockLink<L> {
    link: L,
    /// Time of the simulated clock, which only waits advance. `None` if the link uses wall time.
    simulated_now: Option<Instant>,
    trial_start: Instant,
    target_time: Duration,
    /// Arrival and length of each frame in `bytes`.
    in_flight: VecDeque<(Instant, usize)>,
    bytes: VecDeque<u8>,
    received: Vec<u8>,
}

impl<L: Link> WallClockLink<L> {
    pub fn new(link: L) -> Self {
        Self {
            link,
            simulated_now: None,
            trial_start: Instant::now(),
            target_time: Duration::ZERO,
            in_flight: VecDeque::with_capacity(MAX_FRAMES_IN_FLIGHT),
            bytes: VecDeque::with_capacity(MAX_FRAMES_IN_FLIGHT * platebench_wire::MAX_ENCODED),
            received: Vec::with_capacity(MAX_FRAMES_IN_FLIGHT * platebench_wire::MAX_ENCODED),
        }
    }

    /// A wait ends at once and advances the time. A poll without an answer takes `TIME_STEP`.
    pub fn in_simulated_time(link: L) -> Self {
        let link = Self::new(link);
        Self { simulated_now: Some(link.trial_start), ..link }
    }

    fn current_time(&self) -> Instant {
        self.simulated_now.unwrap_or_else(Instant::now)
    }

    fn wait_until(&mut self, instant: Instant) {
        match &mut self.simulated_now {
            Some(now) if instant <= *now => *now += TIME_STEP,
            Some(now) => *now = instant,
            None => thread::sleep(instant.saturating_duration_since(Instant::now())),
        }
    }

    fn elapsed(&mut self) -> Duration {
        self.target_time = self.target_time.max(self.current_time().saturating_duration_since(self.trial_start));
        self.target_time
    }

    fn queue_received(&mut self, at: Duration) {
        let at = self.trial_start + at;
        if !self.received.is_empty() {
            self.in_flight.push_back((at, self.received.len()));
            self.bytes.extend(self.received.drain(..));
        }
    }

    fn advance_target(&mut self, until: Duration) -> Result<(), LinkError> {
        while self.target_time < until && self.in_flight.is_empty() {
            self.target_time = until.min(self.target_time + TIME_STEP);
            self.link.advance_to(self.target_time, &mut self.received)?;
            self.queue_received(self.target_time);
        }
        Ok(())
    }
}

impl<L: Link> Link for WallClockLink<L> {
    fn exchange(&mut self, _now: Duration, bytes: &[u8], answer: &mut Vec<u8>) -> Result<Duration, LinkError> {
        answer.extend(self.bytes.drain(..));
        self.in_flight.clear();
        let now = self.elapsed();
        let delay = self.link.exchange(now, bytes, answer)?;
        self.target_time = now + delay;
        Ok(delay)
    }

    fn advance_to(&mut self, _now: Duration, received: &mut Vec<u8>) -> Result<(), LinkError> {
        received.extend(self.bytes.drain(..));
        self.in_flight.clear();
        let now = self.elapsed();
        self.link.advance_to(now, received)
    }

    fn kind(&self) -> LinkKind {
        LinkKind::Lossless
    }

    fn restart(&mut self) -> Result<bool, LinkError> {
        let restarted = self.link.restart()?;
        if restarted {
            self.bytes.clear();
            self.in_flight.clear();
            self.target_time = Duration::ZERO;
            self.trial_start = self.current_time();
        }
        Ok(restarted)
    }

    fn real_time_line(&mut self) -> Option<&mut dyn RealTimeLine> {
        Some(self)
    }
}

impl<L: Link> RealTimeLine for WallClockLink<L> {
    fn now(&mut self) -> Instant {
        self.current_time()
    }

    fn send(&mut self, bytes: &[u8]) -> Result<(), LinkError> {
        let since = self.target_time;
        let now = self.elapsed();
        if now > since {
            // Unsolicited messages of the target up to now arrive before its answer.
            self.link.advance_to(now, &mut self.received)?;
            self.queue_received(now);
        }
        let delay = self.link.exchange(now, bytes, &mut self.received)?;
        // The next message reaches the target only after this answer.
        self.target_time = now + delay;
        self.queue_received(self.target_time);
        Ok(())
    }

    fn receive(&mut self, until: Instant, bytes: &mut Vec<u8>) -> Result<Option<Instant>, LinkError> {
        let until = until.max(self.current_time());
        self.advance_target(until.saturating_duration_since(self.trial_start))?;
        let Some(&(at, count)) = self.in_flight.front().filter(|(at, _)| *at <= until) else {
            self.wait_until(until);
            return Ok(None);
        };
        if at > self.current_time() {
            self.wait_until(at);
        }
        self.in_flight.pop_front();
        bytes.extend(self.bytes.drain(..count));
        Ok(Some(at))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rigs::hosted::HostedLink;
    use crate::scripted_link::ScriptedLink;
    use crate::session::Session;
    use platebench_test_kit::CONFIGURE;
    use platebench_wire::{Configure, Message, Sample, Tick};

    fn echo_link(delay: Duration) -> impl Link {
        ScriptedLink::new(move |_, _, bytes, answer| {
            answer.extend_from_slice(bytes);
            Ok(delay)
        })
    }

    #[test]
    fn delivers_an_answer_after_the_links_delay() {
        let delay = Duration::from_millis(40);
        let mut line = WallClockLink::in_simulated_time(echo_link(delay));
        let mut bytes = Vec::new();
        let start = line.now();
        line.send(b"one").unwrap();
        assert_eq!(line.now(), start, "sending takes no time");
        assert_eq!(line.receive(start + delay / 2, &mut bytes).unwrap(), None);
        assert_eq!(line.now(), start + delay / 2);
        assert_eq!(line.receive(start + 10 * delay, &mut bytes).unwrap(), Some(start + delay));
        assert_eq!((line.now(), bytes.as_slice()), (start + delay, &b"one"[..]));
        assert_eq!(line.receive(start, &mut bytes).unwrap(), None);
        assert_eq!(line.now(), start + delay + TIME_STEP, "a poll takes time");
    }

    #[test]
    fn waits_in_wall_time_for_an_answer() {
        let delay = Duration::from_millis(20);
        let mut line = WallClockLink::new(echo_link(delay));
        let before = Instant::now();
        line.send(b"one").unwrap();
        let after = Instant::now();
        let at = line.receive(after + 10 * delay, &mut Vec::new()).unwrap().unwrap();
        assert!((before + delay..=after + delay).contains(&at));
        assert!(Instant::now() >= at, "delivered before its arrival");
    }

    #[test]
    fn queues_a_message_while_the_target_is_busy() {
        let delay = Duration::from_millis(20);
        let mut line = WallClockLink::in_simulated_time(echo_link(delay));
        let mut bytes = Vec::new();
        line.send(b"one").unwrap();
        line.send(b"two").unwrap();
        let far = line.now() + 100 * delay;
        let first = line.receive(far, &mut bytes).unwrap().unwrap();
        let second = line.receive(far, &mut bytes).unwrap().unwrap();
        assert_eq!((bytes.as_slice(), second - first), (&b"onetwo"[..], delay));
    }

    #[test]
    fn runs_a_target_paced_device_in_real_time() {
        let mut session = Session::open(WallClockLink::new(HostedLink::new())).unwrap();
        let start = Instant::now();
        let configure = Configure { paced_by_target: true, watchdog_timeout_ms: 1_000, ..CONFIGURE };
        session.start_trial(&configure).unwrap();
        let mut ticks = Vec::new();
        while ticks.len() < 20 {
            let received = session.receive(start + Duration::from_secs(10)).unwrap().unwrap();
            assert!(received.received_at <= Instant::now());
            if let Message::Tick(Tick { target_time_us }) = received.message {
                ticks.push((received.received_at, target_time_us));
                let sample = Sample { time_us: 0, setpoint_um: 2.0, wd_um: 1.9, wq_um: 0.0 };
                session.send(Message::Sample(sample)).unwrap();
            }
        }
        for pair in ticks.windows(2) {
            // The time stamps have a resolution of 1 µs.
            let (wall, target) = (pair[1].0 - pair[0].0, Duration::from_micros((pair[1].1 - pair[0].1).into()));
            assert!(wall.abs_diff(target) <= Duration::from_micros(2), "{wall:?} {target:?}");
        }
        assert!(session.request_safe_state());
    }
}
