//! A plate playing its profiles: the only thing that moves a [`State`] through time.

use crate::file::Plate;
use crate::flow::{Flow, State, Tier};
use crate::mode::{Conditions, Drive, Mode};
use crate::profile::Profile;
use crate::time::Time;

/// Bound on the error that freezing a varying mode per substep may cause, as a fraction of |W|.
///
/// Frozen at its midpoint over a substep h, a mode whose pole λ moves at the rate λ' leaves a relative error of `|λ'| h³ |λ| / 12`
/// per substep (the first commutator of the Magnus series), which the plate forgets with 1/|λ|: `|λ'| h² / 12` in all.
/// `docs/mathematics.md` derives it; the tests hold it against the reference integrator.
const FREEZING_ERROR: f64 = 1e-7;
/// A rate that would ask for more substeps than this per interval is a jump in all but name.
const MOST_SUBSTEPS: f64 = 1e4;
/// Entering and leaving a band is looked for at this spacing, some fifteen points per period of the fast pole.
const SCAN: u64 = 1_000;

/// What surrounds a plate during a trial.
#[derive(Debug, Clone, PartialEq)]
pub struct Scene {
    /// Kelvin above the reference temperature.
    pub temperature_offset_k: Profile,
    /// Normal force, N.
    pub finger_force_n: Profile,
}

impl Scene {
    /// The surroundings at `time`.
    pub fn at(&self, time: Time) -> Conditions {
        Conditions {
            temperature_offset_k: self.temperature_offset_k.at(time),
            finger_force_n: self.finger_force_n.at(time),
        }
    }

    /// The next point of either profile after `time`.
    pub fn next_point_after(&self, time: Time) -> Option<Time> {
        let points = [&self.temperature_offset_k, &self.finger_force_n].map(|profile| profile.next_point_after(time));
        points.into_iter().flatten().min()
    }

    fn varies_after(&self, time: Time) -> bool {
        self.temperature_offset_k.varies_after(time) || self.finger_force_n.varies_after(time)
    }
}

/// Which signal of the plate a [`Watch`] looks at.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Signal {
    /// |W|
    Amplitude,
    /// Wd
    InPhase,
    /// Wq
    Quadrature,
}

impl Signal {
    /// The signal's value in µm.
    pub fn of(self, state: &State) -> f64 {
        match self {
            Self::Amplitude => state.amplitude(),
            Self::InPhase => state.w.re,
            Self::Quadrature => state.w.im,
        }
    }
}

/// A band whose crossings are to be found.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Watch {
    /// What is watched.
    pub signal: Signal,
    /// Lower edge, µm, still inside.
    pub low: f64,
    /// Upper edge, µm, still inside.
    pub high: f64,
}

impl Watch {
    fn holds(&self, state: &State) -> bool {
        (self.low..=self.high).contains(&self.signal.of(state))
    }

    /// Distance in µm of `state` from the nearer edge.
    fn distance(&self, state: &State) -> f64 {
        let value = self.signal.of(state);
        (value - self.low).abs().min((value - self.high).abs())
    }
}

/// A watched signal has entered or left its band.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Crossing {
    /// The first nanosecond on the other side.
    pub time: Time,
    /// The state then.
    pub state: State,
}

/// A plate in motion.
#[derive(Debug, Clone)]
pub struct Plant {
    plate: Plate,
    scene: Scene,
    tier: Tier,
    time: Time,
    state: State,
    drive: Drive,
}

impl Plant {
    /// A plate at rest and without drive at the start of `scene`.
    pub fn new(plate: Plate, scene: Scene, tier: Tier) -> Self {
        Self { plate, scene, tier, time: Time::ZERO, state: State::default(), drive: Drive::default() }
    }

    /// Now.
    pub fn time(&self) -> Time {
        self.time
    }

    /// The state now.
    pub fn state(&self) -> State {
        self.state
    }

    /// The drive from now on.
    pub fn drive(&self) -> Drive {
        self.drive
    }

    /// The plate that moves.
    pub fn plate(&self) -> &Plate {
        &self.plate
    }

    /// The surroundings at `time`.
    pub fn conditions_at(&self, time: Time) -> Conditions {
        self.scene.at(time)
    }

    /// The mode at `time`.
    pub fn mode_at(&self, time: Time) -> Mode {
        self.plate.mode(&self.scene.at(time))
    }

    /// The next point of a profile after `time`.
    pub fn next_point_after(&self, time: Time) -> Option<Time> {
        self.scene.next_point_after(time)
    }

    /// Actuates: the drive applies from now on. W and U are continuous.
    pub fn set_drive(&mut self, drive: Drive) {
        self.drive = drive;
    }

    /// Moves on to `end`; an earlier one changes nothing. Crossings of the watched bands on the way are put into `crossings` in
    /// order of time; an excursion shorter than a microsecond may go unseen.
    pub fn advance(&mut self, end: Time, watches: &[Watch], crossings: &mut Vec<Crossing>) {
        while self.time < end {
            let piece_end = self.scene.next_point_after(self.time).map_or(end, |point| point.min(end));
            let substeps = self.substeps(piece_end);
            let (start, span) = (self.time.as_nanos(), (piece_end - self.time).as_nanos());
            for substep in 1..=substeps {
                // Rounded down, and exact at the last.
                let nanos = start + (u128::from(span) * u128::from(substep) / u128::from(substeps)) as u64;
                self.advance_frozen(Time::from_nanos(nanos), watches, crossings);
            }
        }
    }

    /// Into how many substeps the interval from now to `end` has to be cut so that freezing the mode stays within
    /// [`FREEZING_ERROR`].
    fn substeps(&self, end: Time) -> u64 {
        let span = end - self.time;
        if !self.scene.varies_after(self.time) {
            return 1;
        }
        // The largest of three slopes: the profiles are smooth between their points.
        let instants = [self.time, self.time.midpoint(end), Time::from_nanos(end.as_nanos().saturating_sub(1))];
        let modes = instants.map(|instant| self.mode_at(instant));
        let change = |a: &Mode, b: &Mode| (b.sigma - a.sigma).hypot(b.omega0 - a.omega0);
        let half = span.seconds() / 2.0;
        let rate = (change(&modes[0], &modes[1]).max(change(&modes[1], &modes[2]))) / half;
        let longest = (12.0 * FREEZING_ERROR / rate).sqrt();
        (span.seconds() / longest).ceil().clamp(1.0, MOST_SUBSTEPS).min(span.as_nanos() as f64) as u64
    }

    fn advance_frozen(&mut self, end: Time, watches: &[Watch], crossings: &mut Vec<Crossing>) {
        let start = self.time;
        let mode = self.mode_at(start.midpoint(end));
        let flow = Flow::new(self.tier, &mode, &self.drive, &self.state);
        let seconds = (end - start).seconds();
        let reach = flow.reach(seconds);
        let known = crossings.len();
        for watch in watches {
            if watch.distance(&self.state) <= reach {
                find_crossings(watch, &flow, &self.state, start, end, crossings);
            }
        }
        if watches.len() > 1
            && let Some(new) = crossings.get_mut(known..)
        {
            new.sort_by_key(|crossing| crossing.time);
        }
        self.state = flow.after(seconds);
        self.time = end;
    }
}

fn find_crossings(watch: &Watch, flow: &Flow, from: &State, start: Time, end: Time, found: &mut Vec<Crossing>) {
    let state_at = |nanos: u64| flow.after(Time::from_nanos(nanos).since(start).seconds());
    let mut low = start.as_nanos();
    let mut inside = watch.holds(from);
    while low < end.as_nanos() {
        let high = (low + SCAN).min(end.as_nanos());
        if watch.holds(&state_at(high)) != inside {
            let (mut before, mut behind) = (low, high);
            while behind - before > 1 {
                let middle = u64::midpoint(before, behind);
                if watch.holds(&state_at(middle)) == inside {
                    before = middle;
                } else {
                    behind = middle;
                }
            }
            found.push(Crossing { time: Time::from_nanos(behind), state: state_at(behind) });
            inside = !inside;
        }
        low = high;
    }
}
