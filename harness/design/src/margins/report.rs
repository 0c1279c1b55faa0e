//! Renders measured margins: tables, maps over operating points, and speed against accuracy.

use crate::margins::result::{CaseMargins, Edge, Margin, MarginReport};
use crate::margins::scenes::{OperatingPoint, Quantity, STABILITY_RULE};
use platebench_document::chart::{
    HeatAxis, HeatFigure, HeatPanel, HeatScale, ScatterChart, ScatterPanel, ScatterPoint,
};
use platebench_document::format::with_decimals;
use platebench_document::{Block, ChartSection, Column, Document, NOTHING, Table};

const TITLE: &str = "Measured margins";
const CSV_FILE: &str = "margins.csv";
const JSON_FILE: &str = "margins.json";
const CHART_FILE: &str = "speed-accuracy.svg";
/// Smaller static errors are at the lower edge of the chart, percent.
const ERROR_FLOOR: f64 = 1e-4;
const AXES: [&str; 4] = ["period, ms", "setpoint, µm", "detuning, Hz", "force, N"];

pub fn build_section(report: &MarginReport) -> ChartSection {
    let json = serde_json::to_string_pretty(report).unwrap_or_default();
    let mut files = vec![(CSV_FILE.to_owned(), csv(report)), (JSON_FILE.to_owned(), json)];
    let mut blocks = vec![Block::paragraph(format!(
        "Scenario {}. An interval contains the limit: the last value that holds, and the first one that fails. \
         Requirements: every expectation holds, with the change from the start; a gain then acts on the plate. \
         {STABILITY_RULE}",
        report.scenario
    ))];
    for case in &report.cases {
        blocks.push(Block::heading(format!("{} at {}", name(case), point_text(&case.point))));
        blocks.push(Block::Table(margin_table(case)));
        let state = match &case.failing {
            Some(failing) => format!("at the operating point {failing} fails"),
            None => format!("at the operating point these hold: {}", case.expectations.join(", ")),
        };
        blocks.push(Block::Paragraph(format!("{state}; {} trials", case.trials)));
    }
    blocks.push(Block::heading("Speed against accuracy"));
    blocks.push(Block::Table(cost_table(report)));
    blocks.extend(report.not_applicable.iter().map(|reason| Block::Paragraph(format!("not applicable: {reason}"))));
    let chart = scatter_chart(report).svg();
    blocks.push(Block::figure(chart.clone(), "Cost of a control step against speed, accuracy and robustness"));
    files.push((CHART_FILE.to_owned(), chart));
    for (file, quantity) in [("map-gain.svg", Quantity::DriveGain), ("map-delay.svg", Quantity::Delay)] {
        if let Some(figure) = map(report, quantity) {
            let svg = figure.svg();
            files.push((file.to_owned(), svg.clone()));
            blocks.push(Block::figure(svg, figure.title));
        }
    }
    ChartSection { document: Document::new(TITLE, blocks), files }
}

fn name(case: &CaseMargins) -> String {
    format!("{} on {}", case.law, case.rig)
}

/// Name in the chart, whose legend is narrow.
fn short_name(case: &CaseMargins) -> String {
    let kind = case.rig.split(':').next().unwrap_or_default();
    if case.is_reference { case.law.clone() } else { format!("{} ({kind})", case.law) }
}

fn point_text(point: &OperatingPoint) -> String {
    let OperatingPoint { period_ms, setpoint_um, detuning_hz, force_n } = point;
    format!("{period_ms} ms, {setpoint_um} µm, {detuning_hz} Hz, {force_n} N")
}

fn margin_table(case: &CaseMargins) -> Table {
    let mut table = Table::new([
        Column::from("limit"),
        Column::number("requirements hold to", ""),
        Column::from("fails first"),
        Column::number("stable to", ""),
        Column::number("bench's law", ""),
        Column::number("difference", "%"),
        Column::number("trials", ""),
    ]);
    table.extend(case.margins.iter().map(|margin| {
        let Margin { quantity, requirement, stability, predicted } = margin;
        [
            quantity.name().to_owned(),
            edge_text(*quantity, requirement),
            requirement.failing.clone().unwrap_or_default(),
            edge_text(*quantity, stability),
            with_decimals(*predicted, 3),
            margin.difference_percent().map_or_else(|| NOTHING.to_owned(), |percent| format!("{percent:+.2}")),
            (requirement.trials + stability.trials).to_string(),
        ]
    }));
    table
}

fn edge_text(quantity: Quantity, edge: &Edge) -> String {
    let number = |value: f64| match quantity {
        Quantity::DetuningUp | Quantity::DetuningDown => format!("{value:.1}"),
        Quantity::DriveGain | Quantity::FrequencyGain | Quantity::Delay | Quantity::Force => format!("{value:.4}"),
    };
    let beyond = if quantity == Quantity::DetuningDown { '<' } else { '>' };
    match (edge.holds_to, edge.fails_from) {
        (Some(low), Some(high)) => format!("{} … {}", number(low), number(high)),
        (Some(low), None) => format!("{beyond} {}", number(low)),
        (None, _) => "none".to_owned(),
    }
}

fn cost_table(report: &MarginReport) -> Table {
    let mut table = Table::new([
        Column::from("controller"),
        Column::from("operating point"),
        Column::number("cost of a step", ""),
        Column::number("settling", "ms"),
        Column::number("static error", "%"),
        Column::number("noise gain", ""),
        Column::number("gain margin", ""),
        Column::number("delay margin", "periods"),
    ]);
    table.extend(report.cases.iter().map(|case| {
        let noise = case.noise_gain.map_or_else(
            || NOTHING.to_owned(),
            |gain| match gain.interval {
                Some([low, high]) => format!("{low:.3} … {high:.3}"),
                None => format!("{:.3}", gain.value),
            },
        );
        let stable_to = |quantity: Quantity| {
            case.margin(quantity).map_or_else(String::new, |margin| edge_text(quantity, &margin.stability))
        };
        [
            name(case),
            point_text(&case.point),
            cost_text(case),
            with_decimals(case.settling_ms, 3),
            with_decimals(case.static_error_percent, 4),
            noise,
            stable_to(Quantity::DriveGain),
            stable_to(Quantity::Delay),
        ]
    }));
    table
}

/// Instructions, or the time with bench and line on rigs that do not count them.
fn cost_text(case: &CaseMargins) -> String {
    match (case.instructions_per_step, case.time_per_step_us) {
        (Some(count), _) => format!("{count:.0} instructions"),
        (None, Some(us)) => format!("{us:.1} µs with the bench"),
        (None, None) => NOTHING.to_owned(),
    }
}

fn csv(report: &MarginReport) -> String {
    let mut table = Table::new([
        "rig",
        "law",
        "reference",
        "period_ms",
        "setpoint_um",
        "detuning_hz",
        "force_n",
        "limit",
        "requirement_holds_to",
        "requirement_fails_from",
        "failing",
        "stable_to",
        "unstable_from",
        "predicted",
        "difference_percent",
        "trials",
    ]);
    for case in &report.cases {
        for margin in &case.margins {
            let Margin { quantity, requirement, stability, predicted } = margin;
            let number = |value: Option<f64>| value.map_or_else(String::new, |value| value.to_string());
            let mut cells = vec![case.rig.clone(), case.law.clone(), case.is_reference.to_string()];
            cells.extend(case.point.coordinates().map(|value| value.to_string()));
            cells.push(quantity.name().to_owned());
            cells.extend([requirement.holds_to, requirement.fails_from].map(number));
            cells.push(requirement.failing.clone().unwrap_or_default());
            cells.extend(
                [stability.holds_to, stability.fails_from, *predicted, margin.difference_percent()].map(number),
            );
            cells.push((requirement.trials + stability.trials).to_string());
            table.push(cells);
        }
    }
    table.csv()
}

fn scatter_chart(report: &MarginReport) -> ScatterChart {
    let counts = report.cases.iter().all(|case| case.instructions_per_step.is_some());
    let (mut names, mut points) = (Vec::new(), Vec::new());
    let index = |list: &mut Vec<String>, text: String| {
        list.iter().position(|known| *known == text).unwrap_or_else(|| {
            list.push(text);
            list.len() - 1
        })
    };
    let places: Vec<(usize, usize)> = report
        .cases
        .iter()
        .map(|case| (index(&mut names, short_name(case)), index(&mut points, point_text(&case.point))))
        .collect();
    let panel = |label: &str, floor: f64, of: &dyn Fn(&CaseMargins) -> Option<f64>| ScatterPanel {
        y_label: label.to_owned(),
        floor,
        shapes: points.clone(),
        points: report
            .cases
            .iter()
            .zip(&places)
            .filter_map(|(case, (colour, shape))| {
                let cost = if counts { case.instructions_per_step } else { case.time_per_step_us };
                Some(ScatterPoint { colour: *colour, shape: *shape, x: cost, y: of(case)? })
            })
            .collect(),
        x_limits: Vec::new(),
        y_limits: Vec::new(),
    };
    ScatterChart {
        title: "Cost against speed, accuracy and robustness".to_owned(),
        x_label: if counts { "instructions per control step" } else { "time per control step with the bench, µs" }
            .to_owned(),
        edge_label: "cost not measured".to_owned(),
        panels: vec![
            panel("settling time, ms", 0.01, &|case| case.settling_ms),
            panel("static error, %", ERROR_FLOOR, &|case| case.static_error_percent),
            panel("gain margin of the drive", 0.1, &|case| stable_to(case, Quantity::DriveGain)),
            panel("delay margin, periods", 0.01, &|case| stable_to(case, Quantity::Delay)),
        ],
        colours: names,
    }
}

/// The middle of the interval, or the largest played value if none fails.
fn stable_to(case: &CaseMargins, quantity: Quantity) -> Option<f64> {
    let edge = &case.margin(quantity)?.stability;
    edge.middle().or(edge.holds_to)
}

/// Stability limit over the two coordinates of the operating point that vary first. The edge
/// separates points at which the requirements hold. `None` for one operating point.
fn map(report: &MarginReport, quantity: Quantity) -> Option<HeatFigure> {
    let values = |axis: usize| {
        let mut values: Vec<f64> = report.cases.iter().map(|case| case.point.coordinates()[axis]).collect();
        values.sort_by(f64::total_cmp);
        values.dedup();
        values
    };
    let mut varied = (0..AXES.len()).rev().filter(|axis| values(*axis).len() > 1);
    let (x, y) = (varied.next()?, varied.next());
    let axis = |axis: usize| HeatAxis {
        label: AXES.get(axis).copied().unwrap_or_default().to_owned(),
        values: values(axis).iter().map(f64::to_string).collect(),
    };
    let y_axis = y.map_or_else(|| HeatAxis { label: String::new(), values: vec![String::new()] }, axis);
    let mut panels: Vec<HeatPanel> = Vec::new();
    for case in &report.cases {
        let at = case.point.coordinates();
        let place = |axis: usize| values(axis).iter().position(|value| *value == at[axis]).unwrap_or_default();
        let others = (0..AXES.len()).filter(|axis| *axis != x && Some(*axis) != y && values(*axis).len() > 1);
        let others = others.map(|axis| format!("{} {}", AXES[axis], at[axis]));
        let title = std::iter::once(name(case)).chain(others).collect::<Vec<_>>().join(", ");
        let number = panels.iter().position(|panel| panel.title == title).unwrap_or_else(|| {
            let (columns, rows) = (values(x).len(), y_axis.values.len());
            let (values, passes) = (vec![vec![None; columns]; rows], vec![vec![None; columns]; rows]);
            panels.push(HeatPanel { title, x: axis(x), y: y_axis.clone(), values, passes });
            panels.len() - 1
        });
        let (column, row) = (place(x), y.map_or(0, place));
        let Some(panel) = panels.get_mut(number) else { continue };
        if let Some(cell) = panel.values.get_mut(row).and_then(|cells| cells.get_mut(column)) {
            *cell = stable_to(case, quantity);
        }
        if let Some(cell) = panel.passes.get_mut(row).and_then(|cells| cells.get_mut(column)) {
            *cell = Some(case.failing.is_none());
        }
    }
    Some(HeatFigure { title: format!("Stable to: {}", quantity.name()), panels, scale: HeatScale::Range })
}
