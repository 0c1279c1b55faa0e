//! One trial on a real plate: no emulator in the loop. The controller drives its own plate by its own sensor and timer; the bench sends setpoints, asks a person for what
//! surrounds the plate, and writes down what the controller tells.
//!
//! `conversation` is what the bench says and hears, `rows` makes a trace of it, `cues` are the words for the person, `person` is who does it.

mod conversation;
mod cues;
mod person;
mod rows;

pub use person::{Answer, Nobody, Person};

use crate::end::End;
use crate::queue::Queue;
use crate::trial::{Order, Patience, Played};
use conversation::{Conversation, Heard};
use cues::Cues;
use platebench_plate::Time;
use platebench_rig::{Faulty, Link, RigError, Session};
use platebench_scenario::Scenario;
use platebench_trace::Row;
use platebench_verdict::Telemetry;
use platebench_verdict::real_plate::{impossible, moves, needs_person};
use platebench_verdict::record::{Asked, RealPlate};
use rtrb::Consumer;
use std::panic::resume_unwind;
use std::thread;
use std::time::{Duration, Instant};

/// Seconds that are counted down before a trial that somebody holds a finger on the plate for.
const COUNTDOWN_S: u32 = 3;
/// Between two looks at what was told.
const NAP: Duration = Duration::from_millis(20);

/// Plays a trial. `None` where it was given up.
///
/// # Errors
/// [`RigError`] where the controller is gone before it told anything.
pub(crate) fn play<L: Link>(
    session: &mut Session<Faulty<L>>,
    order: &Order<'_>,
    person: &dyn Person,
    patience: &(impl Patience + Sync),
) -> Result<Option<Played>, RigError> {
    let scenario = order.scenario;
    let Some(prepared) = prepare(scenario, person, patience) else { return Ok(None) };
    // Faults of the line are not for a plate that can break.
    session.link_mut().arm(&[]);
    let (queue, consumer) = Queue::new();
    let (rows, heard) = thread::scope(|scope| {
        let talking = scope.spawn(|| Conversation::new(session, order, queue).hold(patience));
        let rows = follow(consumer, scenario, &prepared, person);
        match talking.join() {
            Ok(heard) => (rows, heard),
            Err(panic) => resume_unwind(panic),
        }
    });
    let Heard { ended, stopped, real_plate } = heard;
    let lost = match ended {
        Some(End::GivenUp) => return Ok(None),
        Some(End::Lost(error)) if rows.is_empty() => return Err(error),
        Some(End::Lost(error)) => Some(error),
        None => None,
    };
    let Some(prepared) = confirm(scenario, prepared, person, patience, &real_plate) else { return Ok(None) };
    let real_plate = RealPlate { asked: prepared.asked, undone: prepared.undone, ..real_plate };
    let telemetry = Telemetry {
        ended: lost.as_ref().map(ToString::to_string),
        stopped: stopped.map(str::to_owned),
        real_plate: Some(real_plate),
        ..Telemetry::default()
    };
    Ok(Some(Played { rows, telemetry, lost }))
}

/// What a person did before a trial.
#[derive(Default)]
struct Prepared {
    asked: Vec<Asked>,
    undone: Option<String>,
}

impl Prepared {
    /// Asks for `what`; false where there is no use in asking on. `None` where the run is to end.
    fn ask(&mut self, what: String, person: &dyn Person, patience: &impl Patience) -> Option<bool> {
        let answer = person.ask(&what, &|| patience.is_over());
        let done = answer == Answer::Done;
        self.undone = match answer {
            Answer::Done => None,
            Answer::GivenUp => return None,
            Answer::Declined => Some(format!("a person was asked and did not do it: {what}")),
            Answer::Absent => Some(format!("nobody was there for what the scenario asks of a person: {what}")),
        };
        self.asked.push(Asked { what, done });
        Some(done)
    }
}

/// Has the plate made as the scenario starts. `None` where the run is to end.
fn prepare(scenario: &Scenario, person: &dyn Person, patience: &impl Patience) -> Option<Prepared> {
    let mut prepared = Prepared::default();
    if !needs_person(scenario) {
        return Some(prepared);
    }
    if let Some(why) = impossible(scenario) {
        prepared.undone = Some(why);
        return Some(prepared);
    }
    for what in cues::at_the_start(scenario) {
        if !prepared.ask(what, person, patience)? {
            return Some(prepared);
        }
    }
    for left in (1..=COUNTDOWN_S).rev() {
        person.cue("the trial starts", left);
        let until = Instant::now() + Duration::from_secs(1);
        while Instant::now() < until {
            if patience.is_over() {
                return None;
            }
            thread::sleep(NAP);
        }
    }
    person.cue("the trial runs", 0);
    Some(prepared)
}

/// Asks whether what had to be done within the trial was done, where no sensor tells.
fn confirm(
    scenario: &Scenario,
    mut prepared: Prepared,
    person: &dyn Person,
    patience: &impl Patience,
    told: &RealPlate,
) -> Option<Prepared> {
    person.rest();
    let warms = scenario.scene.temperature_offset_k.range();
    let is_seen = told.force_measured && warms.0 == warms.1;
    if prepared.undone.is_none() && moves(scenario) && !is_seen {
        prepared.ask("confirm that finger and heat were as told during the trial".to_owned(), person, patience)?;
    }
    Some(prepared)
}

/// Takes every row until the other end of the queue is gone, and tells the person what comes.
fn follow(mut consumer: Consumer<Row>, scenario: &Scenario, prepared: &Prepared, person: &dyn Person) -> Vec<Row> {
    let mut rows = Vec::new();
    let attended = needs_person(scenario) && prepared.undone.is_none();
    let mut cues = Cues::of(scenario);
    loop {
        // Asked before the queue is emptied: what was put in before the end is then seen.
        let is_over = consumer.is_abandoned();
        while let Ok(row) = consumer.pop() {
            rows.push(row);
        }
        if let Some(row) = rows.last().filter(|_| attended) {
            let now = Time::from_seconds(row.t_s).unwrap_or(Time::ZERO);
            while let Some((what, left)) = cues.due(now) {
                person.cue(what, left);
            }
            let force = Some(row.finger_force_n).filter(|force| !force.is_nan());
            person.bar(now, scenario.scene.at(now).finger_force_n, force);
        }
        if is_over {
            return rows;
        }
        thread::sleep(NAP);
    }
}
