//! Draws work-precision diagrams: error against cost. Every method replays the drives of one trial,
//! which the hosted controller has played.

use crate::integration::sweep::{cheapest_from_a_crate, cheapest_method};
use crate::integration::{
    EquationForm, IntegrationMethod, MethodReplay, ReplaySpec, Solver, SolverStatus, SweepConfig, SweepResult, sweep,
};
use crate::loglog::{FailedEdge, LogLogChart, LogLogSeries};
use crate::measured_run::ChartError;
use crate::measured_run::play_hosted;
use platebench_document::chart::marks::AxisValue;
use platebench_document::{Block, ChartSection, Document, Table};
use platebench_engine::law;
use platebench_model::scenario::{Scenario, Spread};
use platebench_plate::{Drive, Time};
use std::f64::consts::TAU;
use std::time::Duration;

const WINDOW: Time = Time::from_nanos(40_000_000);
const QUICK_WINDOW: Time = Time::from_nanos(5_000_000);
const TARGET_ERROR: f64 = 1e-9;
const FILE: &str = "precision.csv";
const COLUMNS: [&str; 11] = [
    "scenario",
    "problem",
    "method",
    "setting_kind",
    "setting",
    "status",
    "numerical_error",
    "model_error",
    "total_error",
    "ns_per_simulated_ms",
    "ratio_to_best_peer",
];

pub fn build_chart(scenarios: &[Scenario], is_quick: bool) -> Result<ChartSection, ChartError> {
    let config = if is_quick {
        SweepConfig { rounds: 1, batch: Duration::ZERO, setting_stride: 4 }
    } else {
        SweepConfig { rounds: 5, batch: Duration::from_millis(1), setting_stride: 1 }
    };
    let mut numbers = Table::new(COLUMNS);
    let mut headlines = Table::new(HEADLINE_COLUMNS);
    let (mut drawings, mut files) = (Vec::new(), Vec::new());
    for scenario in scenarios {
        let replay = scenario_replay(scenario, if is_quick { QUICK_WINDOW } else { WINDOW })?;
        let results = sweep(&replay, &config);
        numbers.extend(results.iter().map(|result| result_row(scenario, result, &results)));
        headlines.extend(EquationForm::ALL.iter().filter_map(|form| headline_row(scenario, *form, &results)));
        drawings.push(Block::Details(vec![Block::heading(&scenario.title)]));
        for form in EquationForm::ALL {
            let svg = loglog_chart(scenario, form, &results).svg();
            files.push((format!("precision-{}-{}.svg", scenario.name().replace('/', "-"), form.name()), svg.clone()));
            let caption = format!("{}: {} equations, after {}", scenario.title, form.name(), scenario.file);
            drawings.push(Block::figure(svg, caption));
        }
    }
    files.push((FILE.to_owned(), numbers.csv()));
    let mut blocks = vec![Block::Details(EXPLANATION.map(Block::paragraph).into())];
    blocks.push(Block::Table(headlines));
    blocks.push(Block::File(FILE.to_owned()));
    blocks.extend(drawings);
    Ok(ChartSection { document: Document::new("Methods: error against cost", blocks), files })
}

const EXPLANATION: [&str; 3] = [
    "Every method integrates the same part of the same trial, with the drives of the controller under test. The error \
     is the largest |ΔW| at a control instant, relative to the setpoint. The cost is processor time per simulated \
     millisecond, the median of batches that are measured in turn.",
    "The error in a drawing is numerical: against the exact solution of the same equations. The dashed line is the \
     part of the mode that these equations neglect: left of it a smaller step gains nothing. The closed form is \
     compared with DOP853 at a tolerance of 1e-13. If a profile changes the mode within a period, that solution is the \
     reference for all, and the closed form shows the error of its substeps.",
    "On the carrier the error of a general method is that of the phasor of y and y'. Its cost is that of following the \
     waveform step by step, which no model of the bench does.",
];

/// Plays the first trial with the hosted controller on the nominal plate without noise. The replay
/// has its drives, from its start for `window`.
pub(crate) fn scenario_replay(scenario: &Scenario, window: Time) -> Result<MethodReplay, ChartError> {
    let setpoint_um = scenario.setpoint.range().1;
    if setpoint_um <= 0.0 {
        return Err(ChartError::NoSetpoint(scenario.file.clone()));
    }
    let end = scenario.duration.min(window);
    let mut nominal = scenario.clone();
    nominal.trials.spread = Spread::default();
    nominal.plate.noise_um_rms = 0.0;
    nominal.duration = end;
    let played = play_hosted(&scenario.file, &nominal, law(scenario)?, 0)?;
    let mut drives: Vec<(Time, Drive)> = Vec::new();
    for row in &played.trace_rows {
        let drive = Drive { vpp: row.drive_vpp, omega: TAU * row.frequency_hz };
        if drives.last().is_none_or(|(_, last)| *last != drive) {
            drives.push((Time::from_seconds(row.t_s).unwrap_or_default(), drive));
        }
    }
    let (plate, scene, period) = (&nominal.plate, &nominal.conditions, nominal.controller.period);
    Ok(MethodReplay::new(&ReplaySpec { plate, scene, drives: &drives, period, end, setpoint_um }))
}

fn result_row(scenario: &Scenario, result: &SweepResult, all: &[SweepResult]) -> Vec<String> {
    let number = |value: f64| if value.is_finite() { format!("{value:e}") } else { String::new() };
    let solver = &result.solver;
    let (kind, setting) = setting_columns(solver);
    let ratio =
        cheapest_from_a_crate(all, solver.problem(), TARGET_ERROR).map(|peer| result.ns_per_ms / peer.ns_per_ms);
    vec![
        scenario.file.clone(),
        solver.problem().to_owned(),
        solver.method().to_owned(),
        kind.to_owned(),
        setting.map_or_else(String::new, |setting| format!("{setting:e}")),
        result.status.to_string(),
        number(result.numerical_error),
        number(result.model_error),
        number(result.total_error),
        format!("{:.1}", result.ns_per_ms),
        ratio.map_or_else(String::new, |ratio| format!("{ratio:.5}")),
    ]
}

fn setting_columns(solver: &Solver) -> (&'static str, Option<f64>) {
    match solver {
        Solver::Exact(_) => ("none", None),
        Solver::General(_, IntegrationMethod::Fixed(_), step) => ("step_s", Some(*step)),
        Solver::General(_, IntegrationMethod::Adaptive(_), tolerance) => ("tolerance", Some(*tolerance)),
    }
}

const HEADLINE_COLUMNS: [&str; 9] = [
    "scenario",
    "problem",
    "exact, ns/ms",
    "its error",
    "best method with an error of at most 1e-9",
    "its cost over exact",
    "best crate with an error of at most 1e-9",
    "its cost over exact",
    "the same at a tolerance of 1e-9",
];

/// `None` if no model has a closed form for the equations `form`.
fn headline_row(scenario: &Scenario, form: EquationForm, results: &[SweepResult]) -> Option<Vec<String>> {
    let problem = form.name();
    let exact = results.iter().find(|row| matches!(row.solver, Solver::Exact(model) if model.name() == problem))?;
    let times = |peer: &SweepResult| {
        let ratio = peer.ns_per_ms / exact.ns_per_ms;
        if ratio < 20.0 { format!("{ratio:.1}×") } else { format!("{ratio:.0}×") }
    };
    let best = cheapest_method(results, problem, TARGET_ERROR);
    let reached = cheapest_from_a_crate(results, problem, TARGET_ERROR);
    let at_tolerance = results
        .iter()
        .filter(|row| row.solver.problem() == problem && row.solver.is_from_a_crate() && row.status == SolverStatus::Ok)
        .filter(|row| {
            setting_columns(&row.solver).1.is_some_and(|tolerance| (tolerance / TARGET_ERROR - 1.0).abs() < 1e-6)
        })
        .min_by(|a, b| a.ns_per_ms.total_cmp(&b.ns_per_ms));
    let none = || "–".to_owned();
    let described = |peer: &SweepResult| {
        let setting = setting_columns(&peer.solver).1.unwrap_or(f64::NAN);
        format!("{} at {setting:.0e}: {:.0} ns/ms", peer.solver.method(), peer.ns_per_ms)
    };
    Some(vec![
        scenario.file.clone(),
        problem.to_owned(),
        format!("{:.0}", exact.ns_per_ms),
        format!("{:.1e}", exact.numerical_error),
        best.map_or_else(none, described),
        best.map_or_else(none, times),
        reached.map_or_else(none, described),
        reached.map_or_else(none, times),
        at_tolerance.map_or_else(none, |peer| format!("{}, off by {:.0e}", times(peer), peer.numerical_error)),
    ])
}

fn loglog_chart(scenario: &Scenario, form: EquationForm, results: &[SweepResult]) -> LogLogChart {
    let own: Vec<&SweepResult> = results.iter().filter(|row| row.solver.problem() == form.name()).collect();
    let mut series: Vec<LogLogSeries> = Vec::new();
    for row in &own {
        let name = row.solver.method();
        let at = series.iter().position(|series| series.name == name).unwrap_or_else(|| {
            let is_ours = matches!(row.solver, Solver::Exact(_));
            series.push(LogLogSeries {
                name: name.to_owned(),
                points: Vec::new(),
                labels: Vec::new(),
                failed: Vec::new(),
                is_highlighted: is_ours,
            });
            series.len() - 1
        });
        let Some(series) = series.get_mut(at) else { continue };
        match row.status {
            SolverStatus::Ok => series.points.push((row.numerical_error.max(f64::MIN_POSITIVE), row.ns_per_ms)),
            SolverStatus::Diverged | SolverStatus::Failed(_) => series.failed.push(row.ns_per_ms),
        }
    }
    let model_error = own.iter().map(|row| row.model_error).fold(0.0, f64::max);
    LogLogChart {
        title: scenario.title.clone(),
        x_label: "largest |ΔW| at a control instant / setpoint".to_owned(),
        y_label: format!("ns per simulated ms · {} equations", form.name()),
        series,
        line: (model_error > 1e-12).then(|| (AxisValue::X(model_error), "neglected by these equations".to_owned())),
        failed_edge: FailedEdge::Right,
        failed_label: "diverged or gave up".to_owned(),
    }
}
