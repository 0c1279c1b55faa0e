//! Work-precision diagrams: error against cost of the closed form and of every general method, over steps and tolerances.
//!
//! The drives come from the scenario, played once to the hosted controller; then every method gets the same ones.

use super::{ChartError, ChartFolder, ChartSection, quote_csv_field};
use platebench_plate::{Drive, Time};
use platebench_report::chart::{LogLogChart, LogLogSeries};
use platebench_report::page::PageBlock;
use platebench_report::text::Table;
use platebench_rig::{FaultInjector, RigSpec, Session};
use platebench_runner::CancelToken;
use platebench_runner::trial::{self, TrialSpec};
use platebench_scenario::{Scenario, Spread};
use platebench_study::integration::sweep::cheapest_from_a_crate;
use platebench_study::integration::{
    EquationForm, IntegrationMethod, Replay, ReplaySpec, Solver, SolverStatus, SweepConfig, SweepResult, sweep,
};
use platebench_wire::LawId;
use std::f64::consts::TAU;
use std::fmt::Write as _;
use std::time::Duration;

/// How much of a trial is played again.
const WINDOW: Time = Time::from_nanos(40_000_000);
const QUICK_WINDOW: Time = Time::from_nanos(5_000_000);
/// The error at which peers are compared.
const TARGET_ERROR: f64 = 1e-9;
/// The figures' file.
const FILE: &str = "precision.csv";
const HEADER: &str = "scenario,problem,method,setting_kind,setting,status,numerical_error,model_error,total_error,ns_per_simulated_ms,ratio_to_best_peer\n";

/// Measures every scenario and draws it.
pub(crate) fn build_chart(
    scenarios: &[Scenario],
    is_quick: bool,
    folder: &ChartFolder,
) -> Result<ChartSection, ChartError> {
    let effort = if is_quick {
        SweepConfig { rounds: 1, batch: Duration::ZERO, stride: 4 }
    } else {
        SweepConfig { rounds: 5, batch: Duration::from_millis(1), stride: 1 }
    };
    let mut csv = HEADER.to_owned();
    let mut headlines = Vec::new();
    let mut drawings = Vec::new();
    for scenario in scenarios {
        let passage = scenario_passage(scenario, if is_quick { QUICK_WINDOW } else { WINDOW })?;
        let measured = sweep(&passage, &effort);
        write_csv(&mut csv, scenario, &measured);
        headlines.extend(EquationForm::ALL.iter().filter_map(|frame| headline_row(scenario, *frame, &measured)));
        drawings.push(PageBlock::Heading(scenario.title.clone()));
        for frame in EquationForm::ALL {
            let svg = loglog_chart(scenario, frame, &measured).svg()?;
            let name = format!("precision-{}-{}.svg", scenario.name().replace('/', "-"), frame.name());
            folder.write(&name, &svg)?;
            let caption = format!("{}: {} equations, after {}", scenario.title, frame.name(), scenario.file);
            drawings.push(PageBlock::Drawings(vec![(svg, caption)]));
        }
    }
    folder.write(FILE, &csv)?;
    let table = Table { header: HEADLINE_COLUMNS.map(str::to_owned).into(), rows: headlines };
    let summary = format_console(&table);
    let mut blocks = explanation();
    blocks.push(PageBlock::Table(table));
    blocks.push(PageBlock::File(FILE.to_owned()));
    blocks.extend(drawings);
    Ok(ChartSection { blocks, summary })
}

fn explanation() -> Vec<PageBlock> {
    [
        "Every method plays the same stretch of the same trial again: the drives are those that the controller under test gave. The error is the largest |ΔW| \
         at a control instant, relative to the setpoint; the cost is processor time per simulated millisecond, the median of batches that are measured in turn.",
        "The error of a drawing is numerical: against the exact solution of the same equations. What these equations leave out of the mode is the dashed line: \
         left of it a smaller step buys nothing. The closed form is held against DOP853 at a tolerance of 1e-13. Where a profile moves the mode within a period that \
         reference serves for all, and the closed form shows what taking a moving mode in substeps costs it.",
        "On the carrier the error is that of the phasor of y and y', and no tier of the bench works there in this chart: the line is what it costs to follow the waveform step by step.",
    ]
    .map(|text| PageBlock::Text(text.to_owned()))
    .into()
}

/// The stretch of the scenario's first trial, on the nominal plate with a silent sensor.
fn scenario_passage(scenario: &Scenario, window: Time) -> Result<Replay, ChartError> {
    let failed = |why: String| ChartError::NotPlayed { file: scenario.file.clone(), why };
    let law = &scenario.controller.law;
    let law = LawId::from_name(law).ok_or_else(|| failed(format!("unknown law `{law}`")))?;
    let end = scenario.duration.min(window);
    let mut nominal = scenario.clone();
    nominal.trials.spread = Spread::default();
    nominal.plate.noise_um_rms = 0.0;
    nominal.duration = end;
    let link = RigSpec::Hosted.connect().map_err(|error| failed(error.to_string()))?;
    let mut session = Session::open(FaultInjector::new(link)).map_err(|error| failed(error.to_string()))?;
    let order = TrialSpec { scenario: &nominal, law, index: 0, wire_time: false, own_clock: false };
    let played = trial::play(&mut session, &order, &CancelToken::never(), None);
    let played = played.ok_or_else(|| failed("the trial was given up".to_owned()))?;
    if let Some(lost) = played.link_error {
        return Err(failed(lost.to_string()));
    }
    let mut drives: Vec<(Time, Drive)> = Vec::new();
    for row in &played.trace_rows {
        let drive = Drive { vpp: row.drive_vpp, omega: TAU * row.frequency_hz };
        if drives.last().is_none_or(|(_, last)| *last != drive) {
            drives.push((Time::from_seconds(row.t_s).unwrap_or_default(), drive));
        }
    }
    let setpoint_um = scenario.setpoint.range().1;
    if setpoint_um <= 0.0 {
        return Err(failed("the setpoint is never above zero, errors would have no unit".to_owned()));
    }
    let (plate, scene, period) = (&nominal.plate, &nominal.conditions, nominal.controller.period);
    Ok(Replay::new(&ReplaySpec { plate, scene, drives: &drives, period, end, setpoint_um }))
}

fn write_csv(csv: &mut String, scenario: &Scenario, measured: &[SweepResult]) {
    let number = |value: f64| if value.is_finite() { format!("{value:e}") } else { String::new() };
    for row in measured {
        let contender = &row.solver;
        let (kind, setting) = setting_columns(contender);
        let ratio = cheapest_from_a_crate(measured, contender.problem(), TARGET_ERROR)
            .map(|peer| row.ns_per_ms / peer.ns_per_ms);
        // Writing into a string does not fail.
        let _ = writeln!(
            csv,
            "{},{},{},{kind},{},{},{},{},{},{:.1},{}",
            quote_csv_field(&scenario.file),
            contender.problem(),
            quote_csv_field(contender.method()),
            setting.map_or_else(String::new, |setting| format!("{setting:e}")),
            quote_csv_field(&row.status.to_string()),
            number(row.numerical_error),
            number(row.model_error),
            number(row.total_error),
            row.ns_per_ms,
            ratio.map_or_else(String::new, |ratio| format!("{ratio:.5}")),
        );
    }
}

/// What a setting is, and it.
fn setting_columns(contender: &Solver) -> (&'static str, Option<f64>) {
    match contender {
        Solver::Exact(_) => ("none", None),
        Solver::General(_, IntegrationMethod::Fixed(_), step) => ("step_s", Some(*step)),
        Solver::General(_, IntegrationMethod::Adaptive(_), tolerance) => ("tolerance", Some(*tolerance)),
    }
}

const HEADLINE_COLUMNS: [&str; 7] = [
    "scenario",
    "problem",
    "exact, ns/ms",
    "its error",
    "best crate with an error of at most 1e-9",
    "its cost over exact",
    "the same at a tolerance of 1e-9",
];

/// The closed form beside the best published crate; `None` where no tier has the problem's closed form.
fn headline_row(scenario: &Scenario, frame: EquationForm, measured: &[SweepResult]) -> Option<Vec<String>> {
    let problem = frame.name();
    let exact = measured.iter().find(|row| matches!(row.solver, Solver::Exact(tier) if tier.name() == problem))?;
    let times = |peer: &SweepResult| {
        let ratio = peer.ns_per_ms / exact.ns_per_ms;
        if ratio < 20.0 { format!("{ratio:.1}×") } else { format!("{ratio:.0}×") }
    };
    let reached = cheapest_from_a_crate(measured, problem, TARGET_ERROR);
    let at_tolerance = measured
        .iter()
        .filter(|row| row.solver.problem() == problem && row.solver.is_from_a_crate() && row.status == SolverStatus::Ok)
        .filter(|row| {
            setting_columns(&row.solver).1.is_some_and(|tolerance| (tolerance / TARGET_ERROR - 1.0).abs() < 1e-6)
        })
        .min_by(|a, b| a.ns_per_ms.total_cmp(&b.ns_per_ms));
    let none = || "–".to_owned();
    let described = |peer: &SweepResult| {
        let tolerance = setting_columns(&peer.solver).1.unwrap_or(f64::NAN);
        format!("{} at {tolerance:.0e}: {:.0} ns/ms", peer.solver.method(), peer.ns_per_ms)
    };
    Some(vec![
        scenario.file.clone(),
        problem.to_owned(),
        format!("{:.0}", exact.ns_per_ms),
        format!("{:.1e}", exact.numerical_error),
        reached.map_or_else(none, described),
        reached.map_or_else(none, times),
        at_tolerance.map_or_else(none, |peer| format!("{}, off by {:.0e}", times(peer), peer.numerical_error)),
    ])
}

fn format_console(table: &Table) -> String {
    let mut text = String::new();
    for row in &table.rows {
        for (name, field) in table.header.iter().zip(row).skip(1) {
            let _ = writeln!(text, "  {name}: {field}");
        }
        if let Some(scenario) = row.first() {
            let _ = writeln!(text, "  ({scenario})\n");
        }
    }
    text
}

fn loglog_chart(scenario: &Scenario, frame: EquationForm, measured: &[SweepResult]) -> LogLogChart {
    let own: Vec<&SweepResult> = measured.iter().filter(|row| row.solver.problem() == frame.name()).collect();
    let mut series: Vec<LogLogSeries> = Vec::new();
    for row in &own {
        let name = row.solver.method();
        let at = series.iter().position(|series| series.name == name).unwrap_or_else(|| {
            let is_ours = matches!(row.solver, Solver::Exact(_));
            series.push(LogLogSeries {
                name: name.to_owned(),
                points: Vec::new(),
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
        y_label: format!("ns per simulated ms · {} equations", frame.name()),
        series,
        vertical_line: (model_error > 1e-12).then(|| (model_error, "left out by these equations".to_owned())),
        failed_label: "diverged or gave up".to_owned(),
    }
}
