//! Compares cost and results of a run on rungs (levels of detail), from the linear plate to a real
//! line.

use crate::loglog::{FailedEdge, LogLogChart, LogLogSeries};
use crate::measured_run::ChartError;
use crate::measured_run::median;
use crate::measured_run::{LOCKSTEP, MeasuredRun};
use crate::scenes::applicable_models;
use platebench_document::{Block, ChartSection, Document, Table};
use platebench_engine::{Clock, Pacing, TimeBase};
use platebench_model::record::RunRecord;
use platebench_model::scenario::{Metric, Scenario};
use platebench_plate::Model;
use platebench_rig::{Capability, RigSpec};

const FILE: &str = "ladder.csv";
/// Smaller differences are drawn at this value, because a logarithmic axis has no zero.
const SMALLEST_DRAWN: f64 = 1e-9;
const REAL_TIME: Clock = Clock::RealTime(TimeBase { time_scale: 1.0, pacing: Pacing::Bench });

/// Metric, file of its chart, unit.
const METRICS: [(Metric, &str, &str); 3] = [
    (Metric::SettlingTime, "ladder-settling-time.svg", "ms"),
    (Metric::Overshoot, "ladder-overshoot.svg", "percent"),
    (Metric::StaticError, "ladder-static-error.svg", "percent"),
];

#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Rung {
    Model(Model),
    Rig(RigSpec, Clock),
}

impl Rung {
    /// The most detailed rung in lockstep, so the line adds no delay.
    pub(crate) fn reference() -> Self {
        Self::Rig(RigSpec::emulated(None), LOCKSTEP)
    }

    pub(crate) fn name(&self) -> String {
        match self {
            Self::Model(model) => format!("hosted, {} plate", model.name()),
            Self::Rig(rig, Clock::Lockstep { .. }) => format!("{}, lockstep", rig.name()),
            Self::Rig(rig, _) => format!("{}, real time", rig.name()),
        }
    }

    fn question(&self) -> &'static str {
        match self {
            Self::Model(Model::Linear) => "Roughly how large and how fast, without detuning?",
            Self::Model(Model::Envelope) => "Which law, gains, period and delay work?",
            Self::Model(Model::Modal) => "Does the control law pass?",
            Self::Model(Model::Carrier) => "Does it pass with converter and demodulator?",
            Self::Rig(rig, _) if rig.has(Capability::EmulatedChip) => "Does the firmware image pass, as compiled?",
            Self::Rig(_, Clock::Lockstep { .. }) => "Does this controller program pass?",
            Self::Rig(..) => "Does it pass with the delay of its line?",
        }
    }

    fn play(&self, scenarios: &[Scenario]) -> Result<Option<MeasuredRun>, ChartError> {
        let (own, rig, clock): (Vec<Scenario>, _, _) = match self {
            Self::Model(model) => {
                let own = scenarios.iter().filter(|scenario| applicable_models(scenario).contains(model));
                (
                    own.map(|scenario| Scenario { model: *model, ..scenario.clone() }).collect(),
                    RigSpec::hosted(),
                    LOCKSTEP,
                )
            }
            Self::Rig(rig, clock) => (scenarios.to_vec(), rig.clone(), *clock),
        };
        if own.is_empty() { Ok(None) } else { MeasuredRun::play(own, &rig, clock).map(Some) }
    }
}

struct RungResult {
    rung: Rung,
    scenarios: usize,
    /// Processor time per control period, median over rounds.
    period_us: f64,
    changed_verdicts: usize,
    /// Largest difference from the reference rung, per metric of [`METRICS`].
    differences: [f64; METRICS.len()],
}

/// Plays `scenarios` on every rung. Each of `rigs` adds a rung in lockstep and one in real time.
pub fn build_chart(scenarios: &[Scenario], rounds: u32, rigs: &[RigSpec]) -> Result<ChartSection, ChartError> {
    let mut rungs: Vec<Rung> = Model::ALL.map(Rung::Model).into();
    rungs.push(Rung::reference());
    for rig in rigs {
        rungs.extend([LOCKSTEP, REAL_TIME].map(|clock| Rung::Rig(rig.clone(), clock)));
    }
    let runs = play_rungs(&rungs, scenarios, rounds)?;
    let Some(reference) = runs.iter().find(|run| run.rung == Rung::reference()).map(|run| run.record.clone()) else {
        return Ok(section(&[]));
    };
    let results: Vec<_> = runs.into_iter().map(|run| RungResult::new(run, &reference)).collect();
    Ok(section(&results))
}

pub(crate) struct RungRun {
    pub(crate) rung: Rung,
    /// Record of the last round.
    pub(crate) record: RunRecord,
    /// Processor time per control period, µs, median over rounds.
    pub(crate) period_us: f64,
}

/// Omits rungs on which no scenario applies.
pub(crate) fn play_rungs(rungs: &[Rung], scenarios: &[Scenario], rounds: u32) -> Result<Vec<RungRun>, ChartError> {
    let mut runs: Vec<(Rung, RunRecord, Vec<f64>)> = Vec::new();
    // Measures the rungs in turn, so that other load affects all of them equally.
    for _ in 0..rounds.max(1) {
        for rung in rungs {
            let Some(MeasuredRun { record, period_us }) = rung.play(scenarios)? else { continue };
            match runs.iter_mut().find(|(known, ..)| known == rung) {
                Some((_, last, costs)) => {
                    *last = record;
                    costs.push(period_us);
                }
                None => runs.push((rung.clone(), record, vec![period_us])),
            }
        }
    }
    Ok(runs.into_iter().map(|(rung, record, costs)| RungRun { rung, record, period_us: median(costs) }).collect())
}

impl RungResult {
    fn new(run: RungRun, reference: &RunRecord) -> Self {
        let RungRun { rung, record, period_us } = run;
        let mut differences = [0.0_f64; METRICS.len()];
        let mut changed_verdicts = 0;
        for own in &record.scenarios {
            let Some(detailed) = reference.scenarios.iter().find(|scene| scene.file == own.file) else { continue };
            changed_verdicts += usize::from(own.verdict != detailed.verdict);
            for (one, other) in own.expectations.iter().zip(&detailed.expectations) {
                let place = METRICS.iter().position(|(metric, ..)| *metric == one.metric);
                let Some(largest) = place.and_then(|place| differences.get_mut(place)) else { continue };
                if let (Some(one), Some(other)) = (one.value, other.value) {
                    *largest = largest.max((one - other).abs());
                }
            }
        }
        Self { rung, scenarios: record.scenarios.len(), period_us, changed_verdicts, differences }
    }
}

const EXPLANATION: [&str; 2] = [
    "Every rung plays the scenarios and judges them. The cost is processor time of the whole run per control period: \
     plate, controller, trace and judgement. The difference is that from the emulated firmware, the most detailed rung \
     whose line adds no delay: the largest one of the expectations with this metric. An expectation without a number \
     on one of the two rungs adds no difference, but may change the verdict.",
    "A rung in real time adds the delay of its line, which no other rung has. Its difference is the effect of that \
     delay.",
];

fn section(results: &[RungResult]) -> ChartSection {
    let table = rung_table(results);
    let mut files = vec![(FILE.to_owned(), numbers(results).csv())];
    let mut blocks = vec![Block::Details(EXPLANATION.map(Block::paragraph).into())];
    blocks.push(Block::Table(table));
    for (place, (metric, file, unit)) in METRICS.into_iter().enumerate() {
        let svg = drawing(results, place, metric, unit).svg();
        blocks.push(Block::figure(svg.clone(), format!("{}: difference against cost", metric.name())));
        files.push((file.to_owned(), svg));
    }
    blocks.push(Block::File(FILE.to_owned()));
    let title = "Rungs: cost of a run against its difference from the emulated firmware";
    ChartSection { document: Document::new(title, blocks), files }
}

fn rung_table(results: &[RungResult]) -> Table {
    let mut table = Table::new([
        "rung",
        "scenarios",
        "CPU time per control period",
        "settling time",
        "overshoot",
        "static error",
        "changed verdicts",
        "answers",
    ]);
    for result in results {
        let [settling, overshoot, error] = result.differences;
        table.push(vec![
            result.rung.name(),
            result.scenarios.to_string(),
            format!("{:.2} µs", result.period_us),
            format!("{settling:.2e} ms"),
            format!("{overshoot:.2e} %"),
            format!("{error:.2e} %"),
            result.changed_verdicts.to_string(),
            result.rung.question().to_owned(),
        ]);
    }
    table
}

fn numbers(results: &[RungResult]) -> Table {
    let mut table = Table::new([
        "rung",
        "scenarios",
        "cpu_us_per_period",
        "settling_time_ms",
        "overshoot_percent",
        "static_error_percent",
        "changed_verdicts",
    ]);
    for result in results {
        let mut row = vec![result.rung.name(), result.scenarios.to_string(), result.period_us.to_string()];
        row.extend(result.differences.map(|difference| difference.to_string()));
        row.push(result.changed_verdicts.to_string());
        table.push(row);
    }
    table
}

fn drawing(results: &[RungResult], place: usize, metric: Metric, unit: &str) -> LogLogChart {
    let series = |result: &RungResult| {
        let difference = result.differences.get(place).copied().unwrap_or_default();
        LogLogSeries {
            name: result.rung.name(),
            points: vec![(result.period_us, difference.max(SMALLEST_DRAWN))],
            labels: Vec::new(),
            failed: Vec::new(),
            is_highlighted: result.rung == Rung::reference(),
        }
    };
    LogLogChart {
        title: format!("{} on every rung; no difference is drawn at 1e-9", metric.name()),
        x_label: "processor time per control period, µs".to_owned(),
        y_label: format!("largest difference from the emulated firmware, {unit}"),
        series: results.iter().map(series).collect(),
        line: None,
        failed_edge: FailedEdge::Top,
        failed_label: String::new(),
    }
}
