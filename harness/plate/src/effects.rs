//! Holds the state of the optional effects: second mode, amplifier, self-heating, sensor latency.

use crate::flow::State;
use crate::mode::Drive;
use crate::motion::{MotionHistory, PerMode};
use crate::plate::Plate;
use crate::time::Time;
use num_complex::Complex64;
use std::collections::VecDeque;

#[derive(Debug, Clone)]
pub(crate) struct Effects {
    pub(crate) states: PerMode<State>,
    /// Last command of the controller, which may not have reached the amplifier.
    pub(crate) commanded: Drive,
    /// Commands in the dead time of the amplifier, each with its arrival time.
    pending: VecDeque<(Time, Drive)>,
    /// Output of the amplifier without its offset.
    pub(crate) output_vpp: f64,
    pub(crate) heat_k: f64,
    pub(crate) history: Option<MotionHistory>,
    gain_drift_per_s: f64,
}

impl Effects {
    pub(crate) fn new(plate: &Plate) -> Option<Box<Self>> {
        plate.first_effect()?;
        let latency = plate.sensor_latency;
        Some(Box::new(Self {
            states: PerMode { first: State::default(), second: plate.second_mode.map(|_| State::default()) },
            commanded: Drive::default(),
            pending: VecDeque::with_capacity(64),
            output_vpp: 0.0,
            heat_k: 0.0,
            history: (latency > Time::ZERO).then(|| MotionHistory::new(latency)),
            gain_drift_per_s: plate.sensor_gain_drift_per_s,
        }))
    }

    /// Returns `drive` if it acts now, else stores it for the dead time. The first one acts at
    /// once.
    pub(crate) fn command(&mut self, drive: Drive, now: Time, dead_time: Time) -> Option<Drive> {
        let is_first = self.commanded == Drive::default();
        self.commanded = drive;
        if is_first || dead_time == Time::ZERO {
            return Some(drive);
        }
        let at = now + dead_time;
        match self.pending.back_mut() {
            Some(last) if last.0 == at => last.1 = drive,
            _ => self.pending.push_back((at, drive)),
        }
        None
    }

    pub(crate) fn next_command(&self) -> Option<Time> {
        self.pending.front().map(|(at, _)| *at)
    }

    pub(crate) fn take_due_command(&mut self, now: Time) -> Option<Drive> {
        self.next_command().filter(|at| *at <= now)?;
        self.pending.pop_front().map(|(_, drive)| drive)
    }

    /// Reading at `now`. A sensor without latency and drift would read `w`.
    pub(crate) fn sensor_reading(&self, w: Complex64, now: Time) -> Complex64 {
        let w = self.history.as_ref().map_or(w, |history| history.read(now));
        w * (1.0 + self.gain_drift_per_s * now.seconds())
    }
}
