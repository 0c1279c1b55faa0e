//! Compares the commands of a target with those of the hosted reference for the same bytes. Both
//! laws act on the same samples, so that a difference of their commands does not grow through the
//! plate.

use crate::link::{Link, LinkError};
use crate::rigs::hosted::HostedLink;
use platebench_wire::{Command, Configure, ControllerState, Message, Packet, PacketReader, StateCause};
use std::time::Duration;

#[derive(Debug)]
pub(crate) struct ComparedLink<L> {
    pub(crate) link: L,
    comparison: Option<Box<TrialComparison>>,
}

impl<L: Link> ComparedLink<L> {
    pub(crate) fn new(link: L) -> Self {
        Self { link, comparison: None }
    }

    /// Starts a new comparison or ends it. Call it before the trial's configuration.
    pub(crate) fn compare_with_reference(&mut self, is_compared: bool) {
        self.comparison = is_compared.then(Box::default);
    }

    pub(crate) fn is_comparing(&self) -> bool {
        self.comparison.is_some()
    }

    pub(crate) fn reference_difference_percent(&self) -> Option<f64> {
        self.comparison.as_ref()?.largest_percent
    }

    pub(crate) fn exchange(
        &mut self,
        now: Duration,
        bytes: &[u8],
        answer: &mut Vec<u8>,
    ) -> Result<Duration, LinkError> {
        let start = answer.len();
        let delay = self.link.exchange(now, bytes, answer)?;
        if let Some(comparison) = &mut self.comparison {
            comparison.send_to_reference(now, bytes)?;
            comparison.compare(answer.get(start..).unwrap_or_default());
        }
        Ok(delay)
    }

    pub(crate) fn advance_to(&mut self, now: Duration, received: &mut Vec<u8>) -> Result<(), LinkError> {
        let start = received.len();
        self.link.advance_to(now, received)?;
        if let Some(comparison) = &mut self.comparison {
            comparison.reference.advance_to(now, &mut Vec::new())?;
            comparison.compare(received.get(start..).unwrap_or_default());
        }
        Ok(())
    }
}

#[derive(Debug)]
struct TrialComparison {
    reference: HostedLink,
    to_target: PacketReader,
    from_target: PacketReader,
    configuration: Option<Configure>,
    /// First and last answer of the reference under each number. A repeated sample may have two answers,
    /// if noise between them stops the controller.
    expected: [Option<[Command; 2]>; 256],
    last_request: u8,
    largest_percent: Option<f64>,
}

impl Default for TrialComparison {
    fn default() -> Self {
        Self {
            reference: HostedLink::new(),
            to_target: PacketReader::new(),
            from_target: PacketReader::new(),
            configuration: None,
            expected: [None; 256],
            last_request: 0,
            largest_percent: None,
        }
    }
}

impl TrialComparison {
    fn send_to_reference(&mut self, now: Duration, bytes: &[u8]) -> Result<(), LinkError> {
        for packet in self.to_target.packets(bytes).flatten() {
            self.last_request = packet.sequence;
            if let Message::Configure(configure) = packet.message {
                self.configuration = Some(configure);
                self.expected = [None; 256];
            }
        }
        let mut answer = Vec::new();
        self.reference.exchange(now, bytes, &mut answer)?;
        let mut answered = None;
        for Packet { sequence, message } in PacketReader::new().packets(&answer).flatten() {
            if let (Message::Command(command), Some(expected)) = (message, self.expected.get_mut(usize::from(sequence)))
            {
                let first = expected.filter(|_| answered == Some(sequence)).map_or(command, |[first, _]| first);
                (*expected, answered) = (Some([first, command]), Some(sequence));
            }
        }
        Ok(())
    }

    /// The difference is 100 % if only target or only reference is in the state *running*. A stop
    /// by the watchdog does not count, because their clocks differ.
    fn compare(&mut self, answer: &[u8]) {
        let is_running = |command: &Command| command.state == ControllerState::Running;
        let is_watchdog = |command: &Command| command.cause == StateCause::SampleTimeout;
        let Some(configuration) = self.configuration else { return };
        for Packet { sequence, message } in self.from_target.packets(answer).flatten() {
            let expected = self.expected.get(usize::from(sequence)).copied().flatten();
            let (Message::Command(command), Some(expected)) = (message, expected) else { continue };
            let percents = expected.map(|expected| match (is_running(&command), is_running(&expected)) {
                (true, true) => Some(difference_percent(&command, &expected, &configuration)),
                (false, false) => None,
                // A late command has the number of an earlier sample, and its state may be old.
                _ if sequence != self.last_request => None,
                _ => (!is_watchdog(&command) && !is_watchdog(&expected)).then_some(100.0),
            });
            // The answer of the target may be either.
            if let [Some(first), Some(last)] = percents {
                let percent = first.min(last);
                self.largest_percent = Some(self.largest_percent.map_or(percent, |largest| largest.max(percent)));
            }
        }
    }
}

/// A drive that is not finite adds no difference, because it is an error of its own.
fn difference_percent(command: &Command, expected: &Command, configuration: &Configure) -> f64 {
    let [drive, frequency] = command_difference(command, expected, configuration);
    100.0 * if drive.is_finite() { drive.max(frequency) } else { frequency }
}

/// Largest difference of two reported frequencies, and of a frequency from its range and slew, that
/// counts as rounding, mHz. f32 resolves an angular frequency of 2π · 32 kHz to 2.5 mHz.
pub const FREQUENCY_TOLERANCE_MHZ: u32 = 5;

/// Returns the differences of drive and frequency, relative to drive limit and frequency range.
pub(crate) fn command_difference(one: &Command, other: &Command, configuration: &Configure) -> [f64; 2] {
    let drive = (f64::from(one.drive_vpp) - f64::from(other.drive_vpp)).abs();
    let frequency_mhz = one.frequency_mhz.abs_diff(other.frequency_mhz);
    let frequency_hz = if frequency_mhz <= FREQUENCY_TOLERANCE_MHZ { 0.0 } else { f64::from(frequency_mhz) * 1e-3 };
    [drive / f64::from(configuration.drive_limit_vpp), frequency_hz / f64::from(configuration.frequency_range_hz)]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fault_injector::FaultInjector;
    use crate::link::BoxedLink;
    use crate::scripted_link::{ScriptedLink, link_with_changed_answers, packets};
    use crate::session::Session;
    use platebench_model::scenario::{Direction, Fault, FaultKind, Time};
    use platebench_test_kit::CONFIGURE;
    use platebench_wire::Sample;
    use rstest::rstest;

    /// Added to drive and frequency of the commands from a sequence number on.
    #[derive(Clone, Copy)]
    struct Addition {
        first_sequence: u8,
        drive_vpp: f32,
        frequency_mhz: u32,
    }

    const NOTHING: Addition = Addition { first_sequence: 0, drive_vpp: 0.0, frequency_mhz: 0 };

    fn difference(added: Addition, faults: &[Fault]) -> Option<f64> {
        let link = link_with_changed_answers(move |_, _, answers| {
            for packet in answers {
                if let Message::Command(command) = &mut packet.message
                    && packet.sequence >= added.first_sequence
                {
                    command.drive_vpp += added.drive_vpp;
                    command.frequency_mhz += added.frequency_mhz;
                }
            }
        });
        let mut session = Session::open(FaultInjector::new(link)).unwrap();
        for _ in 0..2 {
            session.link_mut().set_faults(faults, 1);
            session.link_mut().compare_with_reference(true);
            session.begin_trial(&CONFIGURE, true).unwrap();
            for step in 0..20_u16 {
                let sample = Sample { time_us: 0, setpoint_um: 2.0, wd_um: f32::from(step) * 0.1, wq_um: 0.01 };
                let _ = session.send_sample(Duration::from_millis(step.into()), &sample);
            }
        }
        session.link().reference_difference_percent()
    }

    #[rstest]
    #[case(0.0, 0, 0.0)]
    #[case(-1.8, 0, 0.2)]
    #[case(0.0, 1_000, 0.4)]
    #[case(0.9, 1_000, 0.4)]
    #[case(0.0, 5, 0.0)]
    #[case(0.0, 6, 0.0024)]
    #[case(f32::NAN, 0, 0.0)]
    fn is_the_larger_of_drive_and_frequency(#[case] drive_vpp: f32, #[case] frequency_mhz: u32, #[case] percent: f64) {
        assert_eq!((CONFIGURE.drive_limit_vpp, CONFIGURE.frequency_range_hz), (900.0, 250.0));
        let found = difference(Addition { drive_vpp, frequency_mhz, ..NOTHING }, &[]).unwrap();
        assert!((found - percent).abs() < 1e-5, "{found}");
    }

    #[test]
    fn one_changed_command_is_enough() {
        let last = difference(Addition { first_sequence: 43, drive_vpp: 9.0, ..NOTHING }, &[]).unwrap();
        assert!((last - 1.0).abs() < 1e-5, "{last}");
        let none = difference(Addition { first_sequence: 44, drive_vpp: 9.0, ..NOTHING }, &[]);
        assert_eq!(none, Some(0.0));
    }

    #[rstest]
    fn the_reference_gets_what_the_fault_leaves(
        #[values(FaultKind::Drop, FaultKind::Duplicate, FaultKind::Flip)] kind: FaultKind,
        #[values(Direction::ToController, Direction::FromController)] direction: Direction,
    ) {
        let fault = Fault { kind, from: Time::ZERO, until: None, direction, every: 3, seed: None, reconfigure: false };
        assert_eq!(difference(NOTHING, &[fault]), Some(0.0));
    }

    /// Controller that replaces a Wd that is not finite by 0.
    fn link_that_ignores_nan() -> BoxedLink {
        Box::new(ScriptedLink::new(|controller, now, bytes, answer| {
            for mut packet in packets(bytes) {
                if let Message::Sample(sample) = &mut packet.message {
                    sample.wd_um = if sample.wd_um.is_finite() { sample.wd_um } else { 0.0 };
                }
                controller.exchange(now, packet.encode().as_bytes(), answer)?;
            }
            Ok(Duration::ZERO)
        }))
    }

    #[test]
    fn a_missing_stop_is_a_difference_of_100_percent() {
        let difference = |link: BoxedLink, wd_um: f32| {
            let mut session = Session::open(FaultInjector::new(link)).unwrap();
            session.link_mut().compare_with_reference(true);
            session.start_trial(&CONFIGURE).unwrap();
            for (step, wd_um) in [0.0, wd_um, 0.0].into_iter().enumerate() {
                let sample = Sample { time_us: 0, setpoint_um: 2.0, wd_um, wq_um: 0.0 };
                session.send_sample(Duration::from_millis(step as u64), &sample).unwrap();
            }
            session.link().reference_difference_percent()
        };
        assert_eq!(difference(link_that_ignores_nan(), f32::NAN), Some(100.0));
        assert_eq!(difference(link_that_ignores_nan(), 0.1), Some(0.0));
        assert_eq!(difference(Box::<HostedLink>::default(), f32::NAN), Some(0.0));
    }

    #[test]
    fn a_repeated_sample_with_noise_before_its_second_answer_is_no_difference() {
        let fault = |kind| Fault {
            kind,
            from: Time::ZERO,
            until: None,
            direction: Direction::ToController,
            every: 1,
            seed: None,
            reconfigure: false,
        };
        let faults = [fault(FaultKind::Babble), fault(FaultKind::Duplicate)];
        assert_eq!(difference(NOTHING, &faults), Some(0.0));
        let more = Addition { drive_vpp: 9.0, ..NOTHING };
        assert!(difference(more, &faults).is_some_and(|percent| percent > 0.9));
    }

    #[test]
    fn is_unknown_without_a_comparison_or_command() {
        let mut session = Session::open(FaultInjector::new(HostedLink::new())).unwrap();
        session.start_trial(&CONFIGURE).unwrap();
        session.send_sample(Duration::ZERO, &Sample { time_us: 0, setpoint_um: 2.0, wd_um: 0.0, wq_um: 0.0 }).unwrap();
        assert_eq!(session.link().reference_difference_percent(), None);
        session.link_mut().compare_with_reference(true);
        session.start_trial(&CONFIGURE).unwrap();
        assert_eq!(session.link().reference_difference_percent(), None);
    }
}
