//! Builds the course of a force or a temperature over time from steps and ramps.

use crate::explore::scene::Course;

/// If a course has ramps, it is linear between its points. A step in it then becomes a ramp of this
/// duration, µs.
const EDGE_US: u32 = 10;

pub(crate) struct CourseBuilder {
    start: i32,
    /// Start µs, end µs and final value of each move, in order of time.
    moves: Vec<(u32, u32, i32)>,
}

impl CourseBuilder {
    pub(crate) const fn new() -> Self {
        Self { start: 0, moves: Vec::new() }
    }

    pub(crate) fn last(&self) -> i32 {
        self.moves.last().map_or(self.start, |(_, _, value)| *value)
    }

    /// A step at 0 µs sets the start value.
    pub(crate) fn step(&mut self, at_us: u32, value: i32) {
        if at_us == 0 {
            self.start = value;
        } else if value != self.last() {
            self.moves.push((at_us, at_us, value));
        }
    }

    /// Returns the end of the ramp, µs.
    pub(crate) fn ramp(&mut self, at_us: u32, duration_us: u32, value: i32) -> u32 {
        if value == self.last() {
            return at_us;
        }
        self.moves.push((at_us, at_us + duration_us, value));
        at_us + duration_us
    }

    pub(crate) fn finish(self) -> Course {
        let has_ramps = self.moves.iter().any(|(from, to, _)| from < to);
        let mut points = vec![(0, self.start)];
        let mut last = self.start;
        for (from, to, value) in self.moves {
            if has_ramps {
                points.extend([(from, last), (to.max(from + EDGE_US), value)]);
            } else {
                points.push((from, value));
            }
            last = value;
        }
        if has_ramps { Course::Linear(points) } else { Course::Hold(points) }
    }
}
