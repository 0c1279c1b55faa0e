//! Draws the settling time over control period and loop delay, with predicted and measured
//! boundaries of stability.

use super::svg::{Canvas, DrawArea, DrawResult, Role, UNITS_PER_PIXEL, count_factor, length, svg_document, text_style};
use crate::error::ReportError;
use plotters::prelude::*;
use plotters::style::text_anchor::HPos;

/// Width and height, CSS pixels.
const PANEL_SIZE: (i32, i32) = (330, 262);
const LEGEND_LINE_HEIGHT: i32 = 22;
/// Upper edges of the classes of settling time, ms. A further class has longer times and responses
/// that never settle.
const CLASS_EDGES: [f64; 9] = [1.5, 2.0, 3.0, 4.0, 6.0, 10.0, 15.0, 25.0, 40.0];

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RigDelay {
    pub typical_ms: f64,
    pub longest_ms: f64,
}

/// Results of one law, operating condition and response time. Periods and delays are ascending and
/// evenly spaced, at least two of each.
#[derive(Debug, Clone, PartialEq)]
pub struct MapPanel {
    pub title: String,
    pub periods_ms: Vec<f64>,
    pub delays_ms: Vec<f64>,
    /// Spectral radius of the loop by period and then by delay. The loop is unstable from 1 on.
    pub radius: Vec<Vec<f64>>,
    /// Settling time by period and then by delay; `None` if the response does not settle.
    pub settling_ms: Vec<Vec<Option<f64>>>,
    /// Period and delay of the measured boundary of stability, ms.
    pub measured: Vec<(f64, f64)>,
}

#[derive(Debug, Clone, PartialEq)]
pub struct MapFigure {
    pub title: String,
    pub panels: Vec<MapPanel>,
    pub columns: usize,
    pub rig: Option<RigDelay>,
}

impl MapFigure {
    pub fn svg(&self) -> Result<String, ReportError> {
        let columns = self.columns.max(1);
        let rows = self.panels.len().div_ceil(columns).max(1);
        let (width, height) = (PANEL_SIZE.0 * count_factor(columns), PANEL_SIZE.1 * count_factor(rows));
        let legend = legend_places(self.rig.is_some(), width);
        let legend_height = legend.last().map_or(0, |(_, (_, y))| y + LEGEND_LINE_HEIGHT);
        svg_document(&self.title, (width, height + legend_height), |root| {
            let (maps, below) = root.split_vertically(height * UNITS_PER_PIXEL);
            for (area, panel) in maps.split_evenly((rows, columns)).iter().zip(&self.panels) {
                panel.draw(area, self.rig.as_ref())?;
            }
            let canvas = Canvas(&below);
            legend.iter().try_for_each(|(entry, at)| entry.draw(&canvas, *at))
        })
    }
}

impl MapPanel {
    fn draw(&self, area: &DrawArea<'_>, rig: Option<&RigDelay>) -> DrawResult {
        let (Some(columns), Some(rows)) =
            (MapAxis::from_values(&self.periods_ms), MapAxis::from_values(&self.delays_ms))
        else {
            return Ok(());
        };
        let mut chart = ChartBuilder::on(area)
            .margin_top(34 * UNITS_PER_PIXEL)
            .margin_right(16 * UNITS_PER_PIXEL)
            .set_label_area_size(LabelAreaPosition::Left, 40 * UNITS_PER_PIXEL)
            .set_label_area_size(LabelAreaPosition::Bottom, 40 * UNITS_PER_PIXEL)
            .build_cartesian_2d(columns.low..columns.high, rows.low..rows.high)?;
        for (period, settling) in self.periods_ms.iter().zip(&self.settling_ms) {
            let x = columns.cell(*period);
            for (class, from, to) in class_runs(settling) {
                let (Some(first), Some(last)) = (self.delays_ms.get(from), self.delays_ms.get(to)) else { continue };
                let cell = [(x.0, rows.cell(*first).0), (x.1, rows.cell(*last).1)];
                chart.draw_series([Rectangle::new(cell, Role::Radius(class).colour().filled())])?;
            }
        }
        chart
            .configure_mesh()
            .disable_mesh()
            .x_labels(6)
            .y_labels(6)
            .x_label_formatter(&|value| format!("{value:.1}"))
            .y_label_formatter(&|value| format!("{value:.1}"))
            .label_style(text_style(Role::Text, HPos::Center))
            .axis_style(Role::Axis.colour())
            .set_all_tick_mark_size(length(4.0))
            .draw()?;
        for line in self.stability_boundary() {
            chart.draw_series([PathElement::new(line, Role::Boundary.colour())])?;
        }
        for delay in rig.into_iter().flat_map(|rig| [rig.typical_ms, rig.longest_ms]) {
            if (rows.low..=rows.high).contains(&delay) {
                let ends = [(columns.low, delay), (columns.high, delay)];
                chart.draw_series([PathElement::new(ends, Role::Delay.colour())])?;
            }
        }
        let inside = self.measured.iter().filter(|(period, delay)| {
            (columns.low..=columns.high).contains(period) && (rows.low..=rows.high).contains(delay)
        });
        chart.draw_series(inside.map(|&point| Circle::new(point, length(4.0), Role::Measured.colour().filled())))?;
        drop(chart);
        let canvas = Canvas(area);
        canvas.text(Role::Title, HPos::Left, (76, 22), &self.title)?;
        canvas.text(Role::Text, HPos::Left, (2, 22), "delay, ms")?;
        canvas.text(Role::Text, HPos::Right, (PANEL_SIZE.0 - 16, PANEL_SIZE.1 - 10), "period, ms")
    }

    /// Interpolates for each period the smallest delay with a spectral radius of 1.
    fn stability_boundary(&self) -> Vec<Vec<(f64, f64)>> {
        let mut lines: Vec<Vec<(f64, f64)>> = vec![Vec::new()];
        for (period, radius) in self.periods_ms.iter().zip(&self.radius) {
            let passes = |[a, b]: &[f64; 2]| *a < 1.0 && *b >= 1.0;
            let passed = radius.array_windows().position(passes).and_then(|row| {
                let (a, b) = (radius.get(row)?, radius.get(row + 1)?);
                let (from, to) = (self.delays_ms.get(row)?, self.delays_ms.get(row + 1)?);
                Some(from + (to - from) * (1.0 - a) / (b - a))
            });
            match (passed, lines.last_mut()) {
                (Some(delay), Some(line)) => line.push((*period, delay)),
                (None, Some(line)) if !line.is_empty() => lines.push(Vec::new()),
                _ => {}
            }
        }
        lines.retain(|line| line.len() > 1);
        lines
    }
}

struct MapAxis {
    low: f64,
    high: f64,
    half: f64,
}

impl MapAxis {
    fn from_values(values: &[f64]) -> Option<Self> {
        let (first, last) = (*values.first()?, *values.last()?);
        let usable = values.len() > 1 && first.is_finite() && last.is_finite() && last > first;
        usable.then(|| Self { low: first, high: last, half: (last - first) / (values.len() - 1) as f64 / 2.0 })
    }

    fn cell(&self, value: f64) -> (f64, f64) {
        ((value - self.half).max(self.low), (value + self.half).min(self.high))
    }
}

fn settling_class(settling_ms: Option<f64>) -> usize {
    let edge = settling_ms.and_then(|ms| CLASS_EDGES.iter().position(|edge| ms < *edge));
    edge.unwrap_or(CLASS_EDGES.len())
}

/// Joins neighbouring rows of the same class to (class, first row, last row).
fn class_runs(settling_ms: &[Option<f64>]) -> Vec<(usize, usize, usize)> {
    let mut runs: Vec<(usize, usize, usize)> = Vec::new();
    for (row, settling) in settling_ms.iter().enumerate() {
        let class = settling_class(*settling);
        match runs.last_mut() {
            Some(run) if run.0 == class => run.2 = row,
            _ => runs.push((class, row, row)),
        }
    }
    runs
}

enum LegendEntry {
    Heading,
    Class(usize),
    Boundary,
    Measured,
    Delay,
}

impl LegendEntry {
    fn text(&self) -> String {
        let edge = |class: usize| CLASS_EDGES.get(class).copied();
        match *self {
            Self::Heading => "settling time, ms:".to_owned(),
            Self::Class(class) => match (class.checked_sub(1).and_then(edge), edge(class)) {
                (Some(low), Some(high)) => format!("{low} to {high}"),
                (Some(low), None) => format!("longer than {low}, or never"),
                (None, high) => format!("below {}", high.unwrap_or(f64::INFINITY)),
            },
            Self::Boundary => "predicted boundary of stability".to_owned(),
            Self::Measured => "measured boundary".to_owned(),
            Self::Delay => "measured loop delay of the rig: median and maximum".to_owned(),
        }
    }

    fn draw(&self, canvas: &Canvas<'_, '_>, (x, y): (i32, i32)) -> DrawResult {
        match *self {
            Self::Heading => return canvas.text(Role::Text, HPos::Left, (x, y), &self.text()),
            Self::Class(class) => canvas.rectangle(Role::Radius(class), [(x, y - 4), (x + 16, y + 4)])?,
            Self::Boundary => canvas.line(Role::Boundary, [(x, y), (x + 16, y)])?,
            Self::Measured => canvas.circle(Role::Measured, (x + 8, y), 4.0)?,
            Self::Delay => canvas.line(Role::Delay, [(x, y), (x + 16, y)])?,
        }
        canvas.text(Role::Text, HPos::Left, (x + 22, y), &self.text())
    }
}

fn legend_places(has_rig: bool, width: i32) -> Vec<(LegendEntry, (i32, i32))> {
    let classes = (0..=CLASS_EDGES.len()).map(LegendEntry::Class);
    let lines = [LegendEntry::Boundary, LegendEntry::Measured].into_iter().chain(has_rig.then_some(LegendEntry::Delay));
    let (mut x, mut y) = (4, LEGEND_LINE_HEIGHT / 2);
    let place = |entry: LegendEntry| {
        // Characters are about 6.5 px wide.
        let entry_width = 40 + count_factor(entry.text().chars().count()) * 13 / 2;
        if x > 4 && x + entry_width > width {
            (x, y) = (4, y + LEGEND_LINE_HEIGHT);
        }
        let at = (x, y);
        x += entry_width;
        (entry, at)
    };
    std::iter::once(LegendEntry::Heading).chain(classes).chain(lines).map(place).collect()
}

#[cfg(test)]
mod tests;
