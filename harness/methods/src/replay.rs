//! A stretch of a trial, its drives already known, played again through any tier and any method.

use crate::method::{Failure, Method};
use crate::problem::{Carrier, Drifting, Envelope, Modal, Situation};
use platebench_plate::{Complex64, Drive, Plant, Plate, Scene, State, Tier, Time};
use std::f64::consts::TAU;

/// Which of the plate's equations a general method solves.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Frame {
    /// First order in the rotating frame.
    Envelope,
    /// Second order in the rotating frame.
    Modal,
    /// Second order on the carrier.
    Carrier,
}

impl Frame {
    /// Every one.
    pub const ALL: [Self; 3] = [Self::Envelope, Self::Modal, Self::Carrier];

    /// Its name.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Envelope => "envelope",
            Self::Modal => "modal",
            Self::Carrier => "carrier",
        }
    }

    /// The tier whose closed form solves the same equations.
    pub const fn tier(self) -> Tier {
        match self {
            Self::Envelope => Tier::Envelope,
            Self::Modal | Self::Carrier => Tier::Modal,
        }
    }
}

/// A part of a passage in which nothing jumps.
#[derive(Debug, Clone, Copy)]
struct Piece {
    end: Time,
    seconds: f64,
    situation: Situation,
    /// Phase of the excitation at the start, rad.
    theta: f64,
    /// True where it ends at a control instant.
    ends_at_control: bool,
}

impl Piece {
    fn end_theta(&self) -> f64 {
        self.theta + self.situation.drive.omega * self.seconds
    }
}

/// What a passage is made of.
#[derive(Debug, Clone, Copy)]
pub struct Course<'a> {
    /// The plate.
    pub plate: &'a Plate,
    /// What surrounds it.
    pub scene: &'a Scene,
    /// Each drive with the instant from which it acts, in order.
    pub drives: &'a [(Time, Drive)],
    /// Control period, above zero.
    pub period: Time,
    /// Where it ends.
    pub end: Time,
    /// What errors are relative to, µm.
    pub setpoint_um: f64,
}

/// A stretch of a trial, from rest, with its drives.
#[derive(Debug, Clone)]
pub struct Passage {
    plate: Plate,
    scene: Scene,
    pieces: Vec<Piece>,
    setpoint_um: f64,
    scale: f64,
}

/// How far a method came.
#[derive(Debug, Clone, PartialEq)]
pub struct Outcome {
    /// W at the control instants, µm; on the carrier the phasor of y and y'.
    pub samples: Vec<Complex64>,
    /// Seconds of the plate that were worked on.
    pub seconds: f64,
    /// Why it went no further, if it did not come to the end.
    pub failure: Option<Failure>,
}

impl Passage {
    /// Cuts a course at every control instant, every change of the drive and every point of a profile. Between two cuts σ and ω0 are taken as linear, which
    /// they are where the profile and the damping curve are.
    pub fn new(course: &Course<'_>) -> Self {
        let Course { plate, scene, drives, period, end, setpoint_um } = *course;
        let mut drives = drives.iter().copied().peekable();
        let (mut now, mut drive, mut theta) = (Time::ZERO, Drive::default(), 0.0);
        let mut pieces = Vec::new();
        while now < end {
            while let Some((_, next)) = drives.next_if(|(from, _)| *from <= now) {
                drive = next;
            }
            let control = period.next_multiple_after(now);
            let also = [drives.peek().map(|(from, _)| *from), scene.next_point_after(now)];
            let until = also.into_iter().flatten().fold(control.min(end), Time::min);
            let seconds = (until - now).seconds();
            // The last instant before a jump at `until` belongs to this piece.
            let (from, to) = (plate.mode(&scene.at(now)), plate.mode(&scene.at(now.midpoint(until))));
            let rate = |from: f64, to: f64| 2.0 * (to - from) / seconds;
            let situation = Situation {
                mode: from,
                sigma_rate: rate(from.sigma, to.sigma),
                omega0_rate: rate(from.omega0, to.omega0),
                drive,
            };
            let piece = Piece { end: until, seconds, situation, theta, ends_at_control: until == control };
            theta = piece.end_theta() % TAU;
            pieces.push(piece);
            now = until;
        }
        Self { plate: plate.clone(), scene: scene.clone(), pieces, setpoint_um, scale: plate.omega0 }
    }

    /// True where a profile moves the mode within a piece, so that the plate's own closed form has to be frozen in substeps.
    pub fn drifts(&self) -> bool {
        self.pieces.iter().any(|piece| piece.situation.drifts())
    }

    /// Its length in s.
    pub fn seconds(&self) -> f64 {
        self.pieces.iter().map(|piece| piece.seconds).sum()
    }

    /// A plate at rest where the passage begins.
    pub fn plant(&self, tier: Tier) -> Plant {
        Plant::new(self.plate.clone(), self.scene.clone(), tier)
    }

    /// Moves `plant` through the passage, as a run does; `see` is shown the state at each control instant.
    pub fn move_plant(&self, plant: &mut Plant, mut see: impl FnMut(State)) {
        let mut crossings = Vec::new();
        for piece in &self.pieces {
            plant.set_drive(piece.situation.drive);
            plant.advance(piece.end, &[], &mut crossings);
            if piece.ends_at_control {
                see(plant.state());
            }
        }
    }

    /// What the plate's own closed form says, as `frame` sees it.
    pub fn exact(&self, frame: Frame) -> Vec<Complex64> {
        self.samples_of(frame.tier(), frame)
    }

    /// What `tier` says of W.
    pub fn of_tier(&self, tier: Tier) -> Vec<Complex64> {
        self.samples_of(tier, Frame::Modal)
    }

    fn samples_of(&self, tier: Tier, frame: Frame) -> Vec<Complex64> {
        let mut states = Vec::new();
        self.move_plant(&mut self.plant(tier), |state| states.push(state));
        let ends = self.pieces.iter().filter(|piece| piece.ends_at_control);
        let seen = |(state, piece): (State, &Piece)| match frame {
            Frame::Envelope | Frame::Modal => state.w,
            Frame::Carrier => {
                let theta = piece.end_theta();
                let problem = Carrier::new(&piece.situation, theta, self.scale);
                problem.phasor(&Carrier::pack(&state, theta, self.scale))
            }
        };
        states.into_iter().zip(ends).map(seen).collect()
    }

    /// What `method` makes of the equations of `frame`; `setting` as for [`Method::advance`]. The samples go into `outcome`, whose room is used again.
    pub fn play(&self, frame: Frame, method: Method, setting: f64, outcome: &mut Outcome) {
        outcome.samples.clear();
        (outcome.seconds, outcome.failure) = (0.0, None);
        let played = match frame {
            Frame::Envelope => self.play_envelope(method, setting, outcome),
            Frame::Modal => self.play_modal(method, setting, outcome),
            Frame::Carrier => self.play_carrier(method, setting, outcome),
        };
        outcome.failure = played.err();
    }

    fn play_envelope(&self, method: Method, setting: f64, outcome: &mut Outcome) -> Result<(), Failure> {
        let mut x = [0.0; 2];
        for Piece { seconds, situation, ends_at_control, .. } in &self.pieces {
            outcome.seconds += seconds;
            let problem = Envelope::new(situation);
            x = if situation.drifts() {
                let [re, im, _] =
                    method.advance(&Drifting::new(problem, situation), [x[0], x[1], 0.0], *seconds, setting)?;
                [re, im]
            } else {
                method.advance(&problem, x, *seconds, setting)?
            };
            if *ends_at_control {
                outcome.samples.push(Envelope::unpack(&x).w);
            }
        }
        Ok(())
    }

    fn play_modal(&self, method: Method, setting: f64, outcome: &mut Outcome) -> Result<(), Failure> {
        let mut x = [0.0; 4];
        for Piece { seconds, situation, ends_at_control, .. } in &self.pieces {
            outcome.seconds += seconds;
            let problem = Modal::new(situation, self.scale);
            x = if situation.drifts() {
                let [a, b, c, d] = x;
                let [a, b, c, d, _] =
                    method.advance(&Drifting::new(problem, situation), [a, b, c, d, 0.0], *seconds, setting)?;
                [a, b, c, d]
            } else {
                method.advance(&problem, x, *seconds, setting)?
            };
            if *ends_at_control {
                outcome.samples.push(Modal::unpack(&x, self.scale).w);
            }
        }
        Ok(())
    }

    fn play_carrier(&self, method: Method, setting: f64, outcome: &mut Outcome) -> Result<(), Failure> {
        let mut x = [0.0; 3];
        for Piece { seconds, situation, theta, ends_at_control, .. } in &self.pieces {
            outcome.seconds += seconds;
            let problem = Carrier::new(situation, *theta, self.scale);
            x = method.advance(&problem, x, *seconds, setting)?;
            if *ends_at_control {
                outcome.samples.push(problem.phasor(&x));
            }
            x[2] = 0.0;
        }
        Ok(())
    }

    /// max |ΔW|/setpoint; infinite where there are fewer samples than in `truth`.
    pub fn error(&self, samples: &[Complex64], truth: &[Complex64]) -> f64 {
        if samples.len() < truth.len() {
            return f64::INFINITY;
        }
        let largest = samples.iter().zip(truth).map(|(a, b)| (a - b).norm()).fold(0.0, f64::max);
        largest / self.setpoint_um
    }
}

impl Outcome {
    /// Nothing yet.
    pub fn new() -> Self {
        Self { samples: Vec::new(), seconds: 0.0, failure: None }
    }
}

impl Default for Outcome {
    fn default() -> Self {
        Self::new()
    }
}
