//! Draws the error of a settling time against processor time per trial: whole runs on the hosted and
//! the emulated rig, and for comparison the plate alone by its closed form, by general integration
//! methods and in a batch of numpy.

use crate::integration::{
    AdaptiveMethod, EquationForm, IntegrationMethod, MethodReplay, MethodResult, Solver, SolverStatus,
};
use crate::ladder::{Rung, RungRun, play_rungs};
use crate::loglog::{FailedEdge, LogLogChart, LogLogSeries};
use crate::measured_run::{ChartError, call_cost_us, median};
use crate::precision::scenario_replay;
use crate::scenes::applicable_models;
use platebench_document::chart::marks::AxisValue;
use platebench_document::format::with_decimals;
use platebench_document::{Block, ChartSection, Document, Table};
use platebench_model::record::{ExpectationRecord, Telemetry};
use platebench_model::scenario::{Expectation, Metric, Scenario};
use platebench_model::trace::Row;
use platebench_plate::{BandMonitor, BandSignal, Model};
use platebench_verdict::metrics::measure;
use std::hint::black_box;
use std::path::Path;
use std::process::Command;
use std::time::Duration;

/// Path below the folder of the default scenarios. `NUMPY` has its law, step and plate.
pub const SCENARIO: &str = "paper/fig14-closed-loop.toml";
const FILE: &str = "bench.csv";
const DRAWING: &str = "bench.svg";
const NUMPY: &str = include_str!("../../../ci/numpy-batch.py");
/// Smaller errors are drawn at this value, ms, because a logarithmic axis has no zero.
const SMALLEST_DRAWN_MS: f64 = 1e-9;

/// What is measured, and how often.
#[derive(Debug, Clone, Copy)]
pub struct BenchConfig<'a> {
    /// Number of measurements of a cost. The chart shows their median.
    pub rounds: u32,
    /// Trials of a whole run.
    pub trials: u32,
    /// Shortest batch of calls of a solver.
    pub batch: Duration,
    /// Relative tolerances of the general methods, and absolute ones in µm.
    pub tolerances: &'a [f64],
    /// Plates of a batch of numpy.
    pub plates: u32,
    /// Samples per control period in a batch of numpy.
    pub samples: &'a [u32],
    /// Program that runs Python with numpy.
    pub python: &'a Path,
}

impl<'a> BenchConfig<'a> {
    pub const fn new(rounds: u32, python: &'a Path) -> Self {
        Self {
            rounds,
            trials: 400,
            batch: Duration::from_millis(20),
            tolerances: &[1e-2, 1e-4, 1e-6, 1e-8, 1e-10],
            plates: 20_000,
            samples: &[1, 10, 100],
            python,
        }
    }

    pub const fn quick(python: &'a Path) -> Self {
        Self {
            trials: 4,
            batch: Duration::ZERO,
            tolerances: &[1e-4, 1e-8],
            plates: 1_000,
            samples: &[1, 10],
            ..Self::new(1, python)
        }
    }
}

#[derive(Debug, Clone, PartialEq)]
struct BenchPoint {
    /// Plate model, tolerance or samples per period.
    setting: String,
    status: SolverStatus,
    /// Processor time per trial, µs; `None` if the program did not run.
    cpu_us: Option<f64>,
    settling_ms: Option<f64>,
}

#[derive(Debug, Clone, PartialEq)]
struct BenchSeries {
    name: String,
    has_labels: bool,
    points: Vec<BenchPoint>,
}

/// The settling time of the emulated rig.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Reference {
    settling_ms: f64,
    /// Standard uncertainty that the bench adds, ms.
    uncertainty_ms: Option<f64>,
}

/// Plays `scenario`, whose first expectation of a settling time gives band, step and signal.
pub fn build_chart(scenario: &Scenario, config: &BenchConfig<'_>) -> Result<ChartSection, ChartError> {
    let no_settling = || ChartError::NoSettlingTime(scenario.file.clone());
    let expectation = settling_expectation(scenario).ok_or_else(no_settling)?;
    let models = applicable_models(scenario);
    let mut many = scenario.clone();
    (many.trials.count, many.trials.max_count) = (config.trials, config.trials);
    let rungs: Vec<Rung> = models.iter().copied().map(Rung::Model).chain([Rung::reference()]).collect();
    let runs = play_rungs(&rungs, std::slice::from_ref(&many), config.rounds)?;
    let emulated = runs.iter().find(|run| run.rung == Rung::reference()).and_then(settling_record);
    let reference = emulated
        .and_then(|record| Some(Reference { settling_ms: record.value?, uncertainty_ms: record.bench_error }))
        .ok_or_else(no_settling)?;
    let mut series = run_series(scenario, &runs);
    series.extend(plate_series(scenario, expectation, &models, config)?);
    series.push(numpy_series(scenario, config));
    Ok(section(scenario, reference, &series))
}

fn settling_expectation(scenario: &Scenario) -> Option<&Expectation> {
    scenario.expectations.iter().find(|expectation| expectation.metric == Metric::SettlingTime)
}

fn settling_record(run: &RungRun) -> Option<&ExpectationRecord> {
    let expectations = run.record.scenarios.iter().flat_map(|scene| &scene.expectations);
    expectations.into_iter().find(|expectation| expectation.metric == Metric::SettlingTime)
}

fn point(setting: String, cpu_us: f64, settled: Result<Option<f64>, SolverStatus>) -> BenchPoint {
    let (status, settling_ms) = match settled {
        Ok(Some(settling_ms)) => (SolverStatus::Ok, Some(settling_ms)),
        Ok(None) => (SolverStatus::Failed("does not settle".to_owned()), None),
        Err(status) => (status, None),
    };
    BenchPoint { setting, status, cpu_us: Some(cpu_us), settling_ms }
}

/// One series of the hosted rig, with a point per model, and one of the emulated rig.
fn run_series(scenario: &Scenario, runs: &[RungRun]) -> Vec<BenchSeries> {
    let periods = scenario.duration.seconds() / scenario.controller.period.seconds();
    let hosted = |run: &&RungRun| matches!(run.rung, Rung::Model(_));
    let run_point = |run: &RungRun| {
        let setting = match &run.rung {
            Rung::Model(model) => model.name(),
            Rung::Rig(..) => scenario.model.name(),
        };
        let settling_ms = settling_record(run).and_then(|record| record.value);
        point(setting.to_owned(), run.period_us * periods, Ok(settling_ms))
    };
    let series = |name: &str, has_labels, points| BenchSeries { name: name.to_owned(), has_labels, points };
    vec![
        series("hosted rig, whole run", true, runs.iter().filter(hosted).map(run_point).collect()),
        series("emulated rig, whole run", false, runs.iter().filter(|run| !hosted(run)).map(run_point).collect()),
    ]
}

/// The plate alone, with the drives of the hosted controller: closed forms and general methods.
fn plate_series(
    scenario: &Scenario,
    expectation: &Expectation,
    models: &[Model],
    config: &BenchConfig<'_>,
) -> Result<Vec<BenchSeries>, ChartError> {
    let replay = scenario_replay(scenario, scenario.duration)?;
    let modal = |method, tolerance| {
        let solver = Solver::General(EquationForm::Modal, IntegrationMethod::Adaptive(method), tolerance);
        (format!("{tolerance:e}"), solver)
    };
    let exact = models.iter().map(|model| (model.name().to_owned(), Solver::Exact(*model)));
    let mut groups = vec![("closed form, plate alone".to_owned(), true, exact.collect::<Vec<_>>())];
    groups.extend(AdaptiveMethod::ALL.iter().map(|method| {
        let solvers = config.tolerances.iter().map(|tolerance| modal(*method, *tolerance)).collect();
        (IntegrationMethod::Adaptive(*method).name().to_owned(), false, solvers)
    }));
    let mut costs: Vec<Vec<Vec<f64>>> = groups.iter().map(|(.., solvers)| vec![Vec::new(); solvers.len()]).collect();
    let mut result = MethodResult::default();
    // Measures the solvers in turn, so that other load affects all of them equally.
    for _ in 0..config.rounds.max(1) {
        for ((.., solvers), costs) in groups.iter().zip(&mut costs) {
            for ((_, solver), costs) in solvers.iter().zip(costs) {
                result.seconds = replay.seconds();
                let cost_us = call_cost_us(config.batch, || match black_box(*solver) {
                    Solver::Exact(_) => {
                        let _ = black_box(settling_time(scenario, expectation, &replay, solver));
                    }
                    Solver::General(form, method, setting) => {
                        replay.integrate(form, method, setting, &mut result);
                        black_box(&result);
                    }
                });
                // A method that diverges ends before the trial.
                costs.push(cost_us * replay.seconds() / result.seconds);
            }
        }
    }
    let series = groups.into_iter().zip(costs).map(|((name, has_labels, solvers), costs)| {
        let points = solvers.into_iter().zip(costs).map(|((setting, solver), costs)| {
            point(setting, median(costs), settling_time(scenario, expectation, &replay, &solver))
        });
        BenchSeries { name, has_labels, points: points.collect() }
    });
    Ok(series.collect())
}

/// By the bench's own metric, from rows at the control instants and on both sides of each crossing
/// of the band. `None` if the response does not settle.
fn settling_time(
    scenario: &Scenario,
    expectation: &Expectation,
    replay: &MethodReplay,
    solver: &Solver,
) -> Result<Option<f64>, SolverStatus> {
    let (low, high) = expectation.band(scenario.setpoint.range().1);
    let signal = BandSignal::from_column(expectation.signal).unwrap_or(BandSignal::Amplitude);
    let mut rows: Vec<Row> = Vec::new();
    replay.find_crossings(solver, &BandMonitor { signal, low, high }, |time, state| {
        rows.push(Row {
            t_s: time.seconds(),
            setpoint_um: scenario.setpoint.at(time),
            wd_um: state.w.re,
            wq_um: state.w.im,
            amplitude_um: state.amplitude(),
            ..Row::default()
        });
    })?;
    Ok(measure(expectation, &rows, &Telemetry::default()).value())
}

/// Without numpy, the series has a point without numbers.
fn numpy_series(scenario: &Scenario, config: &BenchConfig<'_>) -> BenchSeries {
    let points: Result<Vec<BenchPoint>, String> = config
        .samples
        .iter()
        .map(|samples| {
            let runs = (0..config.rounds.max(1)).map(|_| run_numpy(scenario, config, *samples));
            let runs = runs.collect::<Result<Vec<_>, _>>()?;
            let settling_ms = runs.first().map(|(_, settling_ms)| *settling_ms);
            let costs = runs.into_iter().map(|(cpu_us, _)| cpu_us).collect();
            Ok(point(samples.to_string(), median(costs), Ok(settling_ms)))
        })
        .collect();
    match points {
        Ok(points) => BenchSeries {
            name: "numpy batch with two PI loops, by samples per period".to_owned(),
            has_labels: true,
            points,
        },
        Err(reason) => {
            let status = SolverStatus::Failed(format!("not measured: {reason}"));
            let point = BenchPoint { setting: String::new(), status, cpu_us: None, settling_ms: None };
            BenchSeries { name: format!("numpy batch: not measured, {reason}"), has_labels: false, points: vec![point] }
        }
    }
}

/// Processor time per trial, µs, and settling time, ms.
fn run_numpy(scenario: &Scenario, config: &BenchConfig<'_>, samples: u32) -> Result<(f64, f64), String> {
    let python = config.python.display();
    let frequency_hz = scenario.controller.start_frequency_hz.to_string();
    let output = Command::new(config.python)
        .args(["-c", NUMPY, &config.plates.to_string(), &samples.to_string(), &frequency_hz])
        .output()
        .map_err(|error| format!("{python}: {error}"))?;
    if !output.status.success() {
        let report = String::from_utf8_lossy(&output.stderr).trim().lines().last().unwrap_or_default().to_owned();
        return Err(format!("{python}: {report}"));
    }
    let text = String::from_utf8_lossy(&output.stdout);
    let mut numbers = text.split_whitespace().map(str::parse::<f64>);
    match (numbers.next(), numbers.next()) {
        (Some(Ok(cpu_us)), Some(Ok(settling_ms))) => Ok((cpu_us, settling_ms)),
        _ => Err(format!("{python}: expected two numbers, got {text:?}")),
    }
}

impl BenchPoint {
    fn error_ms(&self, reference: Reference) -> Option<f64> {
        self.settling_ms.map(|settling_ms| (settling_ms - reference.settling_ms).abs())
    }
}

const EXPLANATION: [&str; 3] = [
    "A whole run contains controller, messages, plate, trace, verdict and files; its cost is processor time of all \
     trials divided by their number. The plate alone has the drives of the hosted controller. Its closed form includes \
     the search of the crossing. The general methods solve the modal equations from control instant to control \
     instant; their cost is without the search. The batch of numpy contains two PI loops.",
    "The settling time is that of the bench's metric: the exact crossing, searched to 1 ns, with linear interpolation \
     in this nanosecond. The batch of numpy takes the last sample outside the band.",
    "The reference is the emulated rig: the firmware's image on the modal plate, in lockstep.",
];

fn section(scenario: &Scenario, reference: Reference, series: &[BenchSeries]) -> ChartSection {
    let svg = drawing(scenario, reference, series).svg();
    let uncertainty =
        reference.uncertainty_ms.map_or_else(|| "unknown".to_owned(), |uncertainty| format!("{uncertainty:.1e} ms"));
    let reference_text = format!(
        "{}: the reference settles in {:.6} ms with a standard uncertainty of {uncertainty}.",
        scenario.file, reference.settling_ms
    );
    let mut blocks = vec![Block::Details(EXPLANATION.map(Block::paragraph).into()), Block::paragraph(reference_text)];
    blocks.push(Block::Table(point_table(reference, series)));
    blocks.push(Block::figure(svg.clone(), "Error of a settling time against processor time per trial"));
    blocks.push(Block::File(FILE.to_owned()));
    ChartSection {
        document: Document::new("Bench: error of a settling time against processor time", blocks),
        files: vec![(FILE.to_owned(), numbers(reference, series).csv()), (DRAWING.to_owned(), svg)],
    }
}

fn point_table(reference: Reference, series: &[BenchSeries]) -> Table {
    let mut table = Table::new(["method", "setting", "CPU time per trial", "settling time", "error", "status"]);
    let none = || "–".to_owned();
    table.extend(series.iter().flat_map(|series| {
        series.points.iter().map(|point| {
            vec![
                series.name.clone(),
                point.setting.clone(),
                point.cpu_us.map_or_else(none, |cpu_us| format!("{cpu_us:.3e} µs")),
                point
                    .settling_ms
                    .map_or_else(none, |settling_ms| format!("{} ms", with_decimals(Some(settling_ms), 6))),
                point.error_ms(reference).map_or_else(none, |error| format!("{error:.1e} ms")),
                point.status.to_string(),
            ]
        })
    }));
    table
}

fn numbers(reference: Reference, series: &[BenchSeries]) -> Table {
    let mut table = Table::new(["method", "setting", "status", "cpu_us_per_trial", "settling_time_ms", "error_ms"]);
    let number = |value: Option<f64>| value.map_or_else(String::new, |value| value.to_string());
    table.extend(series.iter().flat_map(|series| {
        series.points.iter().map(|point| {
            vec![
                series.name.clone(),
                point.setting.clone(),
                point.status.to_string(),
                number(point.cpu_us),
                number(point.settling_ms),
                number(point.error_ms(reference)),
            ]
        })
    }));
    table
}

fn drawing(scenario: &Scenario, reference: Reference, all: &[BenchSeries]) -> LogLogChart {
    let series = |series: &BenchSeries| {
        let drawn = |point: &BenchPoint| Some((point.cpu_us?, point.error_ms(reference)?.max(SMALLEST_DRAWN_MS)));
        let failed = series.points.iter().filter(|point| point.settling_ms.is_none());
        let labels = series.points.iter().filter(|point| series.has_labels && drawn(point).is_some());
        LogLogSeries {
            name: series.name.clone(),
            points: series.points.iter().filter_map(drawn).collect(),
            labels: labels.map(|point| point.setting.clone()).collect(),
            failed: failed.filter_map(|point| point.cpu_us).collect(),
            is_highlighted: series.name.ends_with("whole run"),
        }
    };
    let uncertainty = reference.uncertainty_ms.filter(|uncertainty| *uncertainty > 0.0);
    LogLogChart {
        title: format!("{}; errors below {SMALLEST_DRAWN_MS:e} ms are drawn there", scenario.name()),
        x_label: format!("processor time per trial of {} ms, µs", scenario.duration.ms()),
        y_label: "error of the settling time, ms".to_owned(),
        series: all.iter().map(series).collect(),
        line: uncertainty.map(|uncertainty| (AxisValue::Y(uncertainty), "uncertainty of the reference".to_owned())),
        failed_edge: FailedEdge::Top,
        failed_label: "diverged, gave up or does not settle".to_owned(),
    }
}
