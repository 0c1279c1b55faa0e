//! A link in virtual time, used in real time.
//!
//! The target behind such a link has no clock but the one it is given, so it is given the wall's: what it is sent acts at the time elapsed since the trial began, and its answer is there that instant
//! plus the delay that the link itself has. While the bench waits, the target's time runs ahead in small steps to the end of the wait or to the first thing that it says of its own accord,
//! and only then the thread sleeps. Nothing can come in between, because the one who could send is the one who waits.

use crate::link::{Line, Link, LinkError};
use std::collections::VecDeque;
use std::thread;
use std::time::{Duration, Instant};

/// How finely the target's own time advances: the error of the instant at which it is heard unasked.
const STEP: Duration = Duration::from_micros(20);
/// What is on its way has room for this many frames.
const ROOM: usize = 64;

/// See the module.
#[derive(Debug)]
pub struct Paced<L> {
    link: L,
    /// The trial's time zero.
    zero: Instant,
    /// Up to here the target's time has run.
    reached: Duration,
    /// Bytes on their way, and when their last one is there.
    under_way: VecDeque<(Instant, usize)>,
    bytes: VecDeque<u8>,
    said: Vec<u8>,
}

impl<L: Link> Paced<L> {
    /// `link` in real time from now on.
    pub fn new(link: L) -> Self {
        Self {
            link,
            zero: Instant::now(),
            reached: Duration::ZERO,
            under_way: VecDeque::with_capacity(ROOM),
            bytes: VecDeque::with_capacity(ROOM * platebench_wire::MAX_ENCODED),
            said: Vec::with_capacity(ROOM * platebench_wire::MAX_ENCODED),
        }
    }

    /// The target's time on the wall's clock; never back.
    fn elapsed(&mut self) -> Duration {
        self.reached = self.reached.max(self.zero.elapsed());
        self.reached
    }

    /// What was said is there once the trial is as old as `at`.
    fn put_under_way(&mut self, at: Duration) {
        let at = self.zero + at;
        if !self.said.is_empty() {
            self.under_way.push_back((at, self.said.len()));
            self.bytes.extend(self.said.drain(..));
        }
    }

    /// Lets the target's time pass up to `until`, or to where it says something.
    fn run(&mut self, until: Duration) -> Result<(), LinkError> {
        while self.reached < until && self.under_way.is_empty() {
            self.reached = until.min(self.reached + STEP);
            self.link.pass(self.reached, &mut self.said)?;
            self.put_under_way(self.reached);
        }
        Ok(())
    }
}

/// Sleeps to `instant`, not at all where that is over.
fn sleep_until(instant: Instant) {
    thread::sleep(instant.saturating_duration_since(Instant::now()));
}

impl<L: Link> Link for Paced<L> {
    fn exchange(&mut self, _now: Duration, bytes: &[u8], answer: &mut Vec<u8>) -> Result<Duration, LinkError> {
        answer.extend(self.bytes.drain(..));
        self.under_way.clear();
        let now = self.elapsed();
        let delay = self.link.exchange(now, bytes, answer)?;
        self.reached = now + delay;
        Ok(delay)
    }

    fn pass(&mut self, _now: Duration, said: &mut Vec<u8>) -> Result<(), LinkError> {
        said.extend(self.bytes.drain(..));
        self.under_way.clear();
        let now = self.elapsed();
        self.link.pass(now, said)
    }

    fn restart(&mut self) -> Result<bool, LinkError> {
        let restarted = self.link.restart()?;
        if restarted {
            self.bytes.clear();
            self.under_way.clear();
            self.reached = Duration::ZERO;
            self.zero = Instant::now();
        }
        Ok(restarted)
    }

    fn cost(&self) -> Option<u64> {
        self.link.cost()
    }

    fn line(&mut self) -> Option<&mut dyn Line> {
        Some(self)
    }
}

impl<L: Link> Line for Paced<L> {
    fn send(&mut self, bytes: &[u8]) -> Result<(), LinkError> {
        let since = self.reached;
        let now = self.elapsed();
        if now > since {
            // What it says by itself up to now comes before its answer.
            self.link.pass(now, &mut self.said)?;
            self.put_under_way(now);
        }
        let delay = self.link.exchange(now, bytes, &mut self.said)?;
        // Its own time has come that far; what is sent before waits until it listens again.
        self.reached = now + delay;
        self.put_under_way(self.reached);
        Ok(())
    }

    fn receive(&mut self, until: Instant, bytes: &mut Vec<u8>) -> Result<Option<Instant>, LinkError> {
        // What is there already is taken even where `until` is over.
        let until = until.max(Instant::now());
        self.run(until.saturating_duration_since(self.zero))?;
        let Some(&(at, count)) = self.under_way.front().filter(|(at, _)| *at <= until) else {
            sleep_until(until);
            return Ok(None);
        };
        sleep_until(at);
        self.under_way.pop_front();
        bytes.extend(self.bytes.drain(..count));
        Ok(Some(at))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::hosted::Hosted;
    use crate::session::Session;
    use platebench_wire::{Configure, LawId, Message, Sample, Tick};

    const CONFIGURE: Configure = Configure {
        law: LawId::DqPi,
        paced_by_target: true,
        drives_own_plate: false,
        patience_ms: 1_000,
        period_us: 1_000,
        loop_delay_us: 0,
        start_frequency_mhz: 32_307_600,
        gain_um_per_vpp: 0.00698,
        time_constant_s: 1.88e-3,
        response_time_s: 0.0,
        drive_limit_vpp: 900.0,
        frequency_range_hz: 250.0,
        frequency_slew_hz: 100.0,
        gains: None,
    };

    /// Echoes what it is sent, a fixed time later on its own clock.
    struct Echo(Duration);

    impl Link for Echo {
        fn exchange(&mut self, _now: Duration, bytes: &[u8], answer: &mut Vec<u8>) -> Result<Duration, LinkError> {
            answer.extend_from_slice(bytes);
            Ok(self.0)
        }

        fn pass(&mut self, _now: Duration, _said: &mut Vec<u8>) -> Result<(), LinkError> {
            Ok(())
        }
    }

    #[test]
    fn an_answer_is_there_after_the_link_s_own_delay_and_not_before() {
        let delay = Duration::from_millis(40);
        let mut line = Paced::new(Echo(delay));
        let mut bytes = Vec::new();
        let before = Instant::now();
        line.send(b"one").unwrap();
        let after = Instant::now();
        assert_eq!(line.receive(before + delay / 2, &mut bytes).unwrap(), None);
        assert!(Instant::now() >= before + delay / 2, "the wait was not sat out");
        let at = line.receive(after + 10 * delay, &mut bytes).unwrap().unwrap();
        assert!((before + delay..=after + delay).contains(&at));
        assert!(Instant::now() >= at, "told before it was there");
        assert_eq!(bytes, b"one");
    }

    #[test]
    fn what_is_sent_before_the_answer_is_there_waits_for_the_target() {
        let delay = Duration::from_millis(20);
        let mut line = Paced::new(Echo(delay));
        let mut bytes = Vec::new();
        line.send(b"one").unwrap();
        line.send(b"two").unwrap();
        let far = Instant::now() + 100 * delay;
        let first = line.receive(far, &mut bytes).unwrap().unwrap();
        let second = line.receive(far, &mut bytes).unwrap().unwrap();
        assert_eq!((bytes.as_slice(), second - first), (&b"onetwo"[..], delay));
    }

    #[test]
    fn a_hosted_device_paces_in_real_time() {
        let mut session = Session::open(Paced::new(Hosted::new())).unwrap();
        let begun = Instant::now();
        session.begin(&CONFIGURE).unwrap();
        let mut ticks = Vec::new();
        while ticks.len() < 20 {
            let heard = session.listen(begun + Duration::from_secs(10)).unwrap().unwrap();
            assert!(heard.at <= Instant::now());
            if let Message::Tick(Tick { target_time_us }) = heard.message {
                ticks.push((heard.at, target_time_us));
                let sample = Sample { time_us: 0, setpoint_um: 2.0, wd_um: 1.9, wq_um: 0.0 };
                session.post(Message::Sample(sample)).unwrap();
            }
        }
        for pair in ticks.windows(2) {
            // The instants on both clocks are the same, to the microsecond that the wire carries.
            let (wall, target) = (pair[1].0 - pair[0].0, Duration::from_micros((pair[1].1 - pair[0].1).into()));
            assert!(wall.abs_diff(target) <= Duration::from_micros(2), "{wall:?} {target:?}");
        }
        assert!(session.safe());
    }
}
