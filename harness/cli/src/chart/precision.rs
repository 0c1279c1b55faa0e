//! Work-precision diagrams: error against cost of the closed form and of every general method, over steps and tolerances.
//!
//! The drives come from the scenario, played once to the hosted controller; then every method gets the same ones.

use super::{ChartError, Charted, Folder, quoted};
use platebench_methods::sweep::best_peer;
use platebench_methods::{Contender, Course, Effort, Frame, Measured, Method, Passage, Status, sweep};
use platebench_plate::{Drive, Time};
use platebench_report::chart::{Block, LogLog, Series, Table};
use platebench_rig::{Faulty, RigSpec, Session};
use platebench_runner::Cancel;
use platebench_runner::trial::{self, Order};
use platebench_scenario::{Scenario, Spread};
use platebench_wire::LawId;
use std::f64::consts::TAU;
use std::fmt::Write as _;
use std::time::Duration;

/// How much of a trial is played again.
const WINDOW: Time = Time::from_nanos(40_000_000);
const QUICK_WINDOW: Time = Time::from_nanos(5_000_000);
/// The error at which peers are compared.
const AIM: f64 = 1e-9;
/// The figures' file.
const FILE: &str = "precision.csv";
const HEADER: &str = "scenario,problem,method,setting_kind,setting,status,numerical_error,model_error,total_error,ns_per_simulated_ms,ratio_to_best_peer\n";

/// Measures every scenario and draws it.
pub(crate) fn chart(scenarios: &[Scenario], is_quick: bool, folder: &Folder) -> Result<Charted, ChartError> {
    let effort = if is_quick {
        Effort { rounds: 1, batch: Duration::ZERO, every: 4 }
    } else {
        Effort { rounds: 5, batch: Duration::from_millis(1), every: 1 }
    };
    let mut csv = HEADER.to_owned();
    let mut headlines = Vec::new();
    let mut drawings = Vec::new();
    for scenario in scenarios {
        let passage = passage(scenario, if is_quick { QUICK_WINDOW } else { WINDOW })?;
        let measured = sweep(&passage, &effort);
        write_csv(&mut csv, scenario, &measured);
        headlines.extend(Frame::ALL.iter().filter_map(|frame| headline(scenario, *frame, &measured)));
        drawings.push(Block::Heading(scenario.title.clone()));
        for frame in Frame::ALL {
            let svg = drawing(scenario, frame, &measured).svg()?;
            let name = format!("precision-{}-{}.svg", scenario.name().replace('/', "-"), frame.name());
            folder.write(&name, &svg)?;
            drawings.push(Block::Drawing(
                svg,
                format!("{}: {} equations, after {}", scenario.title, frame.name(), scenario.file),
            ));
        }
    }
    folder.write(FILE, &csv)?;
    let table = Table { head: HEADLINE.map(str::to_owned).into(), rows: headlines };
    let summary = console(&table);
    let mut blocks = explanation();
    blocks.push(Block::Table(table));
    blocks.push(Block::File(FILE.to_owned()));
    blocks.extend(drawings);
    Ok(Charted { blocks, summary })
}

fn explanation() -> Vec<Block> {
    [
        "Every method plays the same stretch of the same trial again: the drives are those that the controller under test gave. The error is the largest |ΔW| \
         at a control instant, relative to the setpoint; the cost is processor time per simulated millisecond, the median of batches that are measured in turn.",
        "The error of a drawing is numerical: against the exact solution of the same equations. What these equations leave out of the mode is the dashed line: \
         left of it a smaller step buys nothing. The closed form is held against DOP853 at a tolerance of 1e-13. Where a profile moves the mode within a period that \
         reference serves for all, and the closed form shows what taking a moving mode in substeps costs it.",
        "On the carrier the error is that of the phasor of y and y', and no tier of the bench works there in this chart: the line is what it costs to follow the waveform step by step.",
    ]
    .map(|text| Block::Text(text.to_owned()))
    .into()
}

/// The stretch of the scenario's first trial, on the nominal plate with a silent sensor.
fn passage(scenario: &Scenario, window: Time) -> Result<Passage, ChartError> {
    let failed = |why: String| ChartError::NotPlayed { file: scenario.file.clone(), why };
    let law = &scenario.controller.law;
    let law = LawId::from_name(law).ok_or_else(|| failed(format!("unknown law `{law}`")))?;
    let end = scenario.duration.min(window);
    let mut nominal = scenario.clone();
    nominal.trials.spread = Spread::default();
    nominal.plate.noise_um_rms = 0.0;
    nominal.duration = end;
    let link = RigSpec::Hosted.connect().map_err(|error| failed(error.to_string()))?;
    let mut session = Session::open(Faulty::new(link)).map_err(|error| failed(error.to_string()))?;
    let order = Order { scenario: &nominal, law, index: 0, wire_time: false, own_clock: false };
    let played = trial::play(&mut session, &order, &Cancel::default());
    let played = played.ok_or_else(|| failed("the trial was given up".to_owned()))?;
    if let Some(lost) = played.lost {
        return Err(failed(lost.to_string()));
    }
    let mut drives: Vec<(Time, Drive)> = Vec::new();
    for row in &played.rows {
        let drive = Drive { vpp: row.drive_vpp, omega: TAU * row.frequency_hz };
        if drives.last().is_none_or(|(_, last)| *last != drive) {
            drives.push((Time::from_seconds(row.t_s).unwrap_or_default(), drive));
        }
    }
    let setpoint_um = scenario.setpoint.range().1;
    if setpoint_um <= 0.0 {
        return Err(failed("the setpoint is never above zero, errors would have no unit".to_owned()));
    }
    let (plate, scene, period) = (&nominal.plate, &nominal.scene, nominal.controller.period);
    Ok(Passage::new(&Course { plate, scene, drives: &drives, period, end, setpoint_um }))
}

fn write_csv(csv: &mut String, scenario: &Scenario, measured: &[Measured]) {
    let number = |value: f64| if value.is_finite() { format!("{value:e}") } else { String::new() };
    for row in measured {
        let contender = &row.contender;
        let (kind, setting) = setting(contender);
        let ratio = best_peer(measured, contender.problem(), AIM).map(|peer| row.ns_per_ms / peer.ns_per_ms);
        // Writing into a string does not fail.
        let _ = writeln!(
            csv,
            "{},{},{},{kind},{},{},{},{},{},{:.1},{}",
            quoted(&scenario.file),
            contender.problem(),
            quoted(contender.method()),
            setting.map_or_else(String::new, |setting| format!("{setting:e}")),
            quoted(&row.status.to_string()),
            number(row.numerical_error),
            number(row.model_error),
            number(row.total_error),
            row.ns_per_ms,
            ratio.map_or_else(String::new, |ratio| format!("{ratio:.5}")),
        );
    }
}

/// What a setting is, and it.
fn setting(contender: &Contender) -> (&'static str, Option<f64>) {
    match contender {
        Contender::Exact(_) => ("none", None),
        Contender::General(_, Method::Fixed(_), step) => ("step_s", Some(*step)),
        Contender::General(_, Method::Adaptive(_), tolerance) => ("tolerance", Some(*tolerance)),
    }
}

const HEADLINE: [&str; 7] = [
    "scenario",
    "problem",
    "exact, ns/ms",
    "its error",
    "best crate with an error of at most 1e-9",
    "its cost over exact",
    "the same at a tolerance of 1e-9",
];

/// The closed form beside the best published crate; `None` where no tier has the problem's closed form.
fn headline(scenario: &Scenario, frame: Frame, measured: &[Measured]) -> Option<Vec<String>> {
    let problem = frame.name();
    let exact =
        measured.iter().find(|row| matches!(row.contender, Contender::Exact(tier) if tier.name() == problem))?;
    let times = |peer: &Measured| {
        let ratio = peer.ns_per_ms / exact.ns_per_ms;
        if ratio < 20.0 { format!("{ratio:.1}×") } else { format!("{ratio:.0}×") }
    };
    let reached = best_peer(measured, problem, AIM);
    let at_tolerance = measured
        .iter()
        .filter(|row| row.contender.problem() == problem && row.contender.is_peer() && row.status == Status::Ok)
        .filter(|row| setting(&row.contender).1.is_some_and(|tolerance| (tolerance / AIM - 1.0).abs() < 1e-6))
        .min_by(|a, b| a.ns_per_ms.total_cmp(&b.ns_per_ms));
    let none = || "–".to_owned();
    let described = |peer: &Measured| {
        let tolerance = setting(&peer.contender).1.unwrap_or(f64::NAN);
        format!("{} at {tolerance:.0e}: {:.0} ns/ms", peer.contender.method(), peer.ns_per_ms)
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

fn console(table: &Table) -> String {
    let mut text = String::new();
    for row in &table.rows {
        for (name, field) in table.head.iter().zip(row).skip(1) {
            let _ = writeln!(text, "  {name}: {field}");
        }
        if let Some(scenario) = row.first() {
            let _ = writeln!(text, "  ({scenario})\n");
        }
    }
    text
}

fn drawing(scenario: &Scenario, frame: Frame, measured: &[Measured]) -> LogLog {
    let own: Vec<&Measured> = measured.iter().filter(|row| row.contender.problem() == frame.name()).collect();
    let mut series: Vec<Series> = Vec::new();
    for row in &own {
        let name = row.contender.method();
        let at = series.iter().position(|series| series.name == name).unwrap_or_else(|| {
            let is_ours = matches!(row.contender, Contender::Exact(_));
            series.push(Series { name: name.to_owned(), points: Vec::new(), failed: Vec::new(), is_ours });
            series.len() - 1
        });
        let Some(series) = series.get_mut(at) else { continue };
        match row.status {
            Status::Ok => series.points.push((row.numerical_error.max(f64::MIN_POSITIVE), row.ns_per_ms)),
            Status::Diverged | Status::Failed(_) => series.failed.push(row.ns_per_ms),
        }
    }
    let model_error = own.iter().map(|row| row.model_error).fold(0.0, f64::max);
    LogLog {
        title: scenario.title.clone(),
        x_label: "largest |ΔW| at a control instant / setpoint".to_owned(),
        y_label: format!("ns per simulated ms · {} equations", frame.name()),
        series,
        mark: (model_error > 1e-12).then(|| (model_error, "left out by these equations".to_owned())),
        failed_label: "diverged or gave up".to_owned(),
    }
}
