//! All laws in all surroundings: the table of boundaries and the maps over period, delay and response time.

use crate::case::{Case, Condition};
use crate::closed_loop::{AnalysisError, ClosedLoop, Timing};
use crate::margins::{DelayBoundary, delay_boundary};
use crate::measured;
use platebench_plate::{Plate, Tier};
use platebench_wire::LawId;
use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};

/// Longest delay that the table looks at, s.
pub const LONGEST: f64 = 12e-3;
/// What a map shows: periods in µs and delays in s, both from the first to the last.
const MAP_PERIODS_US: [u32; 2] = [200, 2_000];
const MAP_DELAY: f64 = 3e-3;
const COLUMNS: u32 = 37;
const ROWS: u32 = 40;
/// Periods at which the boundary is measured for a map.
const MEASURED_PERIODS_US: [u32; 7] = [250, 500, 750, 1_000, 1_300, 1_600, 1_900];
/// Response times of a map as shares of the law's own.
const RESPONSES: [f64; 3] = [0.75, 1.0, 2.0];

/// What is to be studied.
#[derive(Debug, Clone)]
pub struct Order {
    /// The plate.
    pub plate: Plate,
    /// Which laws.
    pub laws: Vec<LawId>,
    /// The loop delay of a rig, s, at which margins are taken; 0 where none is known.
    pub delay: f64,
    /// True where maps are wanted.
    pub maps: bool,
    /// Threads.
    pub jobs: usize,
}

/// A law in its surroundings, at 1 kHz and with its own design.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Row {
    /// The law.
    pub law: LawId,
    /// Its surroundings.
    pub condition: Condition,
    /// Control period, µs.
    pub period_us: u32,
    /// Response time that the gains are designed for, s.
    pub response: f64,
    /// Of the loop at the rig's delay.
    pub spectral_radius: f64,
    /// Where the linear loop ends to be stable.
    pub predicted: DelayBoundary,
    /// Where the firmware's own code does; `None` where it comes to no steady state even without delay.
    pub measured: Option<DelayBoundary>,
    /// Up to where it gets to its setpoint from rest.
    pub from_rest: DelayBoundary,
    /// Factor by which a gain may rise, at the rig's delay.
    pub gain_margin: Option<f64>,
    /// Degrees, at the rig's delay.
    pub phase_margin_deg: Option<f64>,
    /// What is left to the predicted boundary from the rig's delay, s.
    pub delay_margin: Option<f64>,
}

impl Row {
    /// Measured against predicted boundary, percent.
    pub fn difference_percent(&self) -> Option<f64> {
        let measured = self.measured?.seconds()?;
        Some((measured / self.predicted.seconds()? - 1.0) * 100.0)
    }
}

/// Spectral radius over period and delay, for one law, surroundings and response time.
#[derive(Debug, Clone, PartialEq)]
pub struct Map {
    /// The law.
    pub law: LawId,
    /// Its surroundings.
    pub condition: Condition,
    /// Response time that the gains are designed for, s.
    pub response: f64,
    /// Periods of the columns, s.
    pub periods: Vec<f64>,
    /// Delays of the rows, s.
    pub delays: Vec<f64>,
    /// Spectral radius, by column and then by row.
    pub radius: Vec<Vec<f64>>,
    /// Measured boundaries: period and delay, s. Where there is none within the map, there is no point.
    pub measured: Vec<(f64, f64)>,
}

/// Everything.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Study {
    /// Rows by law and surroundings. What has no steady state has no row.
    pub rows: Vec<Row>,
    /// Laws and surroundings without a steady state in reach.
    pub out_of_reach: Vec<(LawId, Condition)>,
    /// Maps by law, surroundings and response time; of laws with a loop.
    pub maps: Vec<Map>,
}

enum Task {
    Row(LawId, Condition),
    Map(LawId, Condition, f64),
}

enum Done {
    Row(Option<Row>),
    Map(Option<Map>),
}

/// Studies all of it.
///
/// # Errors
/// [`AnalysisError`] of any of its loops.
pub fn study(order: &Order) -> Result<Study, AnalysisError> {
    let pairs = order.laws.iter().flat_map(|&law| Condition::ALL.map(|condition| (law, condition)));
    let rows = pairs.clone().map(|(law, condition)| Task::Row(law, condition));
    let wanted = pairs.filter(|(law, _)| order.maps && *law != LawId::OpenLoop);
    let maps = wanted.flat_map(|(law, condition)| {
        let own = Case::new(&order.plate, law, condition).response();
        RESPONSES.map(|share| Task::Map(law, condition, share * own))
    });
    let tasks: Vec<Task> = rows.chain(maps).collect();
    let mut study = Study::default();
    for (task, done) in tasks.iter().zip(all(order, &tasks)) {
        match (task, done?) {
            (_, Done::Row(Some(row))) => study.rows.push(row),
            (Task::Row(law, condition), Done::Row(None)) => study.out_of_reach.push((*law, *condition)),
            (_, Done::Map(map)) => study.maps.extend(map),
            (Task::Map(..), Done::Row(None)) => {}
        }
    }
    Ok(study)
}

/// Every task's outcome in the tasks' order, whoever did it.
fn all(order: &Order, tasks: &[Task]) -> Vec<Result<Done, AnalysisError>> {
    let next = AtomicUsize::new(0);
    let outcomes = Mutex::new(Vec::with_capacity(tasks.len()));
    std::thread::scope(|scope| {
        for _ in 0..order.jobs.max(1) {
            scope.spawn(|| {
                loop {
                    let number = next.fetch_add(1, Ordering::Relaxed);
                    let Some(task) = tasks.get(number) else { break };
                    let done = match *task {
                        Task::Row(law, condition) => row(order, law, condition).map(Done::Row),
                        Task::Map(law, condition, response) => map(order, law, condition, response).map(Done::Map),
                    };
                    if let Ok(mut outcomes) = outcomes.lock() {
                        outcomes.push((number, done));
                    }
                }
            });
        }
    });
    let mut outcomes = outcomes.into_inner().unwrap_or_default();
    outcomes.sort_by_key(|(number, _)| *number);
    outcomes.into_iter().map(|(_, done)| done).collect()
}

fn row(order: &Order, law: LawId, condition: Condition) -> Result<Option<Row>, AnalysisError> {
    let case = Case::new(&order.plate, law, condition);
    let Some((plant, controller)) = case.linear(Tier::Modal) else { return Ok(None) };
    let predicted = delay_boundary(&plant, &controller, case.period(), LONGEST)?;
    let closed = ClosedLoop::new(plant, controller, Timing { period: case.period(), delay: order.delay })?;
    let margins = closed.margins();
    Ok(Some(Row {
        law,
        condition,
        period_us: case.period_us,
        response: case.response(),
        spectral_radius: closed.spectral_radius()?,
        predicted,
        measured: measured::boundary(&case, LONGEST),
        from_rest: measured::from_rest(&case, LONGEST),
        gain_margin: margins.gain,
        phase_margin_deg: margins.phase_deg,
        delay_margin: predicted.seconds().map(|boundary| boundary - order.delay),
    }))
}

fn map(order: &Order, law: LawId, condition: Condition, response: f64) -> Result<Option<Map>, AnalysisError> {
    let case = Case { response_s: Some(response), ..Case::new(&order.plate, law, condition) };
    let [first, last] = MAP_PERIODS_US;
    let periods: Vec<u32> = (0..COLUMNS).map(|column| first + (last - first) * column / (COLUMNS - 1)).collect();
    let delays: Vec<f64> = (0..ROWS).map(|row| MAP_DELAY * f64::from(row) / f64::from(ROWS - 1)).collect();
    let mut radius = Vec::with_capacity(periods.len());
    for &period_us in &periods {
        let case = Case { period_us, ..case };
        let Some((plant, controller)) = case.linear(Tier::Modal) else { return Ok(None) };
        let of = |&delay: &f64| {
            let timing = Timing { period: case.period(), delay };
            ClosedLoop::new(plant.clone(), controller, timing)?.spectral_radius()
        };
        radius.push(delays.iter().map(of).collect::<Result<_, _>>()?);
    }
    let at = |&period_us: &u32| {
        let case = Case { period_us, ..case };
        Some((case.period(), measured::boundary(&case, MAP_DELAY)?.seconds()?))
    };
    let measured = MEASURED_PERIODS_US.iter().filter_map(at).collect();
    let periods = periods.into_iter().map(|period_us| f64::from(period_us) * 1e-6).collect();
    Ok(Some(Map { law, condition, response, periods, delays, radius, measured }))
}
