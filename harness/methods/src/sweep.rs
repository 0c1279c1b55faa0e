//! Work against precision: every method over its steps or tolerances on one passage, timed in turn.

use crate::adaptive::Adaptive;
use crate::fixed::Fixed;
use crate::method::Method;
use crate::replay::{Frame, Outcome, Passage};
use platebench_plate::{Complex64, Plant, Tier};
use rustix::time::{ClockId, clock_gettime};
use std::hint::black_box;
use std::time::Duration;

/// Beyond this many setpoints of error a motion has nothing to do with the plate's any more: rest would be nearer.
const LOST: f64 = 2.0;
/// What the closed form is held against, and what stands in for it where a profile moves the mode.
const REFERENCE: (Method, f64) = (Method::Adaptive(Adaptive::Dop853), 1e-13);
/// A passage that takes longer is not measured again.
const SLOW: Duration = Duration::from_millis(20);
/// Plates that are set up before the clock runs, at most.
const MOST_PLANTS: u32 = 4_096;

/// How much is measured.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Effort {
    /// Times that everything is measured in turn; the median counts.
    pub rounds: u32,
    /// A measurement is repeated until it takes this long.
    pub batch: Duration,
    /// Every how manieth setting is taken.
    pub every: usize,
}

/// How a setting ended.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Status {
    /// With a result.
    Ok,
    /// Beyond all bounds.
    Diverged,
    /// Without a result, and why.
    Failed(String),
}

impl std::fmt::Display for Status {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Ok => formatter.write_str("ok"),
            Self::Diverged => formatter.write_str("diverged"),
            Self::Failed(why) => write!(formatter, "failed: {why}"),
        }
    }
}

/// Who is measured.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Contender {
    /// The bench's own closed form.
    Exact(Tier),
    /// A general method on a frame, with its step in s or its tolerance.
    General(Frame, Method, f64),
}

impl Contender {
    /// Its method's name.
    pub const fn method(&self) -> &'static str {
        match self {
            Self::Exact(_) => "exact",
            Self::General(_, method, _) => method.name(),
        }
    }

    /// The name of the equations that it solves.
    pub const fn problem(&self) -> &'static str {
        match self {
            Self::Exact(tier) => tier.name(),
            Self::General(frame, ..) => frame.name(),
        }
    }

    /// True where it is a method of a published crate.
    pub const fn is_peer(&self) -> bool {
        match self {
            Self::Exact(_) => false,
            Self::General(_, method, _) => method.is_published(),
        }
    }
}

/// What came of one setting.
#[derive(Debug, Clone, PartialEq)]
pub struct Measured {
    /// Who.
    pub contender: Contender,
    /// How it ended.
    pub status: Status,
    /// max |ΔW|/setpoint at the control instants against the exact solution of the same equations; infinite without a result.
    pub numerical_error: f64,
    /// The same of those equations' exact solution against the mode's: what no step makes better.
    pub model_error: f64,
    /// Both together: against the mode's exact solution.
    pub total_error: f64,
    /// Cost in ns of processor time per simulated ms, as far as it came.
    pub ns_per_ms: f64,
}

/// A contender at work.
struct Runner<'a> {
    passage: &'a Passage,
    contender: Contender,
    repeats: u32,
    /// True where one passage takes longer than [`SLOW`].
    is_slow: bool,
    costs: Vec<f64>,
    outcome: Outcome,
}

impl Runner<'_> {
    /// ns per simulated ms over `repeats` passages.
    fn time(&mut self) -> f64 {
        let repeats = self.repeats;
        let (elapsed, seconds) = match self.contender {
            Contender::Exact(tier) => {
                // Set up before the clock runs.
                let mut plants: Vec<Plant> = (0..repeats).map(|_| self.passage.plant(tier)).collect();
                let started = worked();
                for plant in &mut plants {
                    self.passage.move_plant(plant, |state| {
                        black_box(state);
                    });
                }
                (worked().saturating_sub(started), self.passage.seconds())
            }
            Contender::General(frame, method, setting) => {
                let started = worked();
                for _ in 0..repeats {
                    self.passage.play(frame, method, black_box(setting), &mut self.outcome);
                    black_box(&self.outcome);
                }
                (worked().saturating_sub(started), self.outcome.seconds)
            }
        };
        elapsed.as_nanos() as f64 / (f64::from(repeats) * seconds * 1e3)
    }

    /// Finds how many passages make a batch; this is the warm-up as well.
    fn calibrate(&mut self, batch: Duration) {
        self.repeats = 1;
        let once = self.time();
        let simulated = self.passage.seconds() * 1e3;
        self.is_slow = once * simulated > SLOW.as_nanos() as f64;
        self.repeats = (batch.as_nanos() as f64 / (once * simulated)).ceil().clamp(1.0, f64::from(MOST_PLANTS)) as u32;
    }
}

/// Measures every tier's closed form and every method on `passage`.
pub fn sweep(passage: &Passage, effort: &Effort) -> Vec<Measured> {
    let truths = Truths::new(passage);
    let exact = Tier::ALL.map(Contender::Exact);
    let general = Frame::ALL.into_iter().flat_map(|frame| {
        Method::all().flat_map(move |method| {
            settings(frame, method)
                .into_iter()
                .step_by(effort.every.max(1))
                .map(move |setting| Contender::General(frame, method, setting))
        })
    });
    let mut runners: Vec<Runner<'_>> = exact
        .into_iter()
        .chain(general)
        .map(|contender| Runner {
            passage,
            contender,
            repeats: 1,
            is_slow: false,
            costs: Vec::new(),
            outcome: Outcome::new(),
        })
        .collect();
    for runner in &mut runners {
        runner.calibrate(effort.batch);
    }
    // In turn, so that whatever else the machine does meets all alike.
    for round in 0..effort.rounds.max(1) {
        // What takes longer than it may is measured once: a long measurement averages by itself.
        for runner in runners.iter_mut().filter(|runner| round == 0 || !runner.is_slow) {
            let cost = runner.time();
            runner.costs.push(cost);
        }
    }
    runners.into_iter().map(|runner| truths.measured(runner)).collect()
}

/// What each contender is held against.
struct Truths<'a> {
    passage: &'a Passage,
    /// By [`Frame::ALL`]: the closed form, and an integrator at its tightest.
    of_frames: Vec<(Frame, [Vec<Complex64>; 2])>,
}

impl<'a> Truths<'a> {
    fn new(passage: &'a Passage) -> Self {
        let of_frame = |frame: Frame| {
            let mut tight = Outcome::new();
            let (method, tolerance) = REFERENCE;
            passage.play(frame, method, tolerance, &mut tight);
            (frame, [passage.exact(frame), tight.samples])
        };
        Self { passage, of_frames: Frame::ALL.map(of_frame).into() }
    }

    fn of(&self, frame: Frame) -> [&[Complex64]; 2] {
        let found = self.of_frames.iter().find(|(known, _)| *known == frame);
        found.map_or([&[], &[]], |(_, [exact, tight])| [exact, tight])
    }

    /// The closed form; an integrator's word where a moving mode has to be frozen in substeps for it.
    fn best(&self, frame: Frame) -> &[Complex64] {
        let [exact, tight] = self.of(frame);
        if self.passage.drifts() { tight } else { exact }
    }

    fn measured(&self, runner: Runner<'_>) -> Measured {
        let passage = self.passage;
        let (samples, frame, failure) = match runner.contender {
            Contender::Exact(tier) => (passage.of_tier(tier), frame_of(tier), None),
            Contender::General(frame, ..) => (runner.outcome.samples, frame, runner.outcome.failure),
        };
        let own = match runner.contender {
            // No general method solves the decoupled pair; what it is off by is its model.
            Contender::Exact(Tier::Linear) => &samples,
            // Not against itself.
            Contender::Exact(_) => self.of(frame)[1],
            Contender::General(..) => self.best(frame),
        };
        // What is seen of the carrier is not W alone; its truth is the same motion.
        let truth = match frame {
            Frame::Envelope | Frame::Modal => Frame::Modal,
            Frame::Carrier => Frame::Carrier,
        };
        let error = |truth| if failure.is_some() { f64::INFINITY } else { passage.error(&samples, truth) };
        let numerical_error = error(own);
        let status = match failure {
            Some(crate::Failure::Diverged) => Status::Diverged,
            Some(failure) => Status::Failed(failure.to_string()),
            None if numerical_error < LOST => Status::Ok,
            None => Status::Diverged,
        };
        Measured {
            contender: runner.contender,
            status,
            numerical_error,
            model_error: match runner.contender {
                Contender::Exact(Tier::Linear) => error(self.best(truth)),
                _ => passage.error(self.best(frame), self.best(truth)),
            },
            total_error: error(self.best(truth)),
            ns_per_ms: median(runner.costs),
        }
    }
}

/// The equations that a tier solves: of the linear tier those that it simplifies, of the carrier those of its W.
const fn frame_of(tier: Tier) -> Frame {
    match tier {
        Tier::Linear | Tier::Envelope => Frame::Envelope,
        Tier::Modal | Tier::Carrier => Frame::Modal,
    }
}

/// Steps in s or tolerances, from the coarse to the fine; none where the method is not made for the frame.
fn settings(frame: Frame, method: Method) -> Vec<f64> {
    let halved = |powers: &[i32]| powers.iter().map(|power| 1e-3 * 0.5_f64.powi(*power)).collect();
    let decades = |from: i32, to: i32| (from..=to).map(|decade| 10.0_f64.powi(-decade)).collect();
    match (method, frame) {
        (Method::Fixed(Fixed::Verlet), Frame::Envelope | Frame::Modal) => Vec::new(),
        (Method::Fixed(_), Frame::Envelope) => halved(&[0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 12]),
        // Stable only from 155 000 steps per ms on; 39 000 on the carrier.
        (Method::Fixed(Fixed::Euler), Frame::Modal) => halved(&[8, 12, 16, 17, 18, 19]),
        (Method::Fixed(Fixed::Euler), Frame::Carrier) => halved(&[8, 12, 15, 16, 17, 18]),
        (Method::Fixed(Fixed::RungeKutta4 | Fixed::Midpoint), Frame::Modal)
        | (Method::Fixed(Fixed::RungeKutta4 | Fixed::Midpoint | Fixed::Verlet), Frame::Carrier) => {
            halved(&[5, 6, 7, 8, 9, 10, 11, 12, 13, 14])
        }
        (Method::Adaptive(Adaptive::Dopri5), Frame::Envelope | Frame::Modal | Frame::Carrier) => decades(2, 11),
        (
            Method::Adaptive(Adaptive::Dop853 | Adaptive::DeDop853 | Adaptive::DeVerner98),
            Frame::Envelope | Frame::Modal | Frame::Carrier,
        ) => decades(2, 12),
    }
}

/// What this thread has cost so far: whoever else wants the core does not count.
fn worked() -> Duration {
    let now = clock_gettime(ClockId::ThreadCPUTime);
    Duration::new(now.tv_sec.unsigned_abs(), now.tv_nsec.unsigned_abs() as u32)
}

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    let middle = values.len() / 2;
    let upper = values.get(middle).copied().unwrap_or(f64::NAN);
    let lower = if values.len().is_multiple_of(2) { values.get(middle.wrapping_sub(1)).copied() } else { None };
    lower.map_or(upper, |lower| 0.5 * (lower + upper))
}

/// The cheapest method of a published crate on `frame` whose numerical error is at most `error`.
pub fn best_peer<'a>(measured: &'a [Measured], problem: &str, error: f64) -> Option<&'a Measured> {
    let fits = |candidate: &&Measured| {
        candidate.contender.is_peer()
            && candidate.contender.problem() == problem
            && candidate.status == Status::Ok
            && candidate.numerical_error <= error
    };
    measured.iter().filter(fits).min_by(|a, b| a.ns_per_ms.total_cmp(&b.ns_per_ms))
}
