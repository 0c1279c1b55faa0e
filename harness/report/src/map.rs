//! Maps of stability: spectral radius over control period and loop delay, with measured boundaries drawn into them.
//!
//! * here: what is shown, and the drawing; a file of its own that serves light and dark.
//! * [`page()`]: maps and tables on one page that needs nothing else.
//!
//! Neighbours: whoever analysed the loops brings the numbers; none is calculated here but where a curve lies between two rows.

mod page;

pub use page::{Section, page};

use crate::error::ReportError;
use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, Pos, VPos};
use std::error::Error;
use std::fmt::Write;

/// Units of the drawing per CSS pixel at natural size: plotters puts points on whole numbers only.
const FINE: u32 = 4;
/// CSS pixels of a panel.
const PANEL: (u32, u32) = (330, 262);
/// Upper edges of the classes of spectral radius; what is above the last is a class of its own. 1 is the boundary.
const EDGES: [f64; 9] = [0.3, 0.5, 0.7, 0.8, 0.9, 1.0, 1.05, 1.2, 1.5];

const STYLE: &str = include_str!("map/map.css");

/// A loop delay that was measured on a rig, ms.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RigDelay {
    /// Its median.
    pub typical_ms: f64,
    /// The longest that was seen.
    pub longest_ms: f64,
}

/// One law in one surroundings and with one response time.
#[derive(Debug, Clone, PartialEq)]
pub struct Panel {
    /// Stands above it.
    pub title: String,
    /// Control periods of the columns, ms, rising, evenly spaced, at least two.
    pub periods_ms: Vec<f64>,
    /// Loop delays of the rows, ms, rising, evenly spaced, at least two.
    pub delays_ms: Vec<f64>,
    /// Spectral radius by column and then by row.
    pub radius: Vec<Vec<f64>>,
    /// Measured boundaries: period and delay, ms.
    pub measured: Vec<(f64, f64)>,
}

/// Panels side by side.
#[derive(Debug, Clone, PartialEq)]
pub struct Map {
    /// What the map shows.
    pub title: String,
    /// Row by row.
    pub panels: Vec<Panel>,
    /// Panels in a row, at least one.
    pub columns: usize,
    /// The rig whose delay is drawn into every panel.
    pub rig: Option<RigDelay>,
}

type Drawn = Result<(), Box<dyn Error + Send + Sync>>;
type Area<'a> = DrawingArea<SVGBackend<'a>, plotters::coord::Shift>;

impl Map {
    /// The drawing as a file of its own, with its style sheet inside.
    ///
    /// # Errors
    /// [`ReportError::Plot`].
    pub fn svg(&self) -> Result<String, ReportError> {
        let mut drawn = String::new();
        self.draw(&mut drawn).map_err(|source| ReportError::Plot { title: self.title.clone(), source })?;
        Ok(dressed(&drawn, &self.title, self.size()))
    }

    /// Width and height in units of the drawing.
    fn size(&self) -> (u32, u32) {
        let columns = self.columns.max(1);
        let rows = self.panels.len().div_ceil(columns).max(1);
        (PANEL.0 * FINE * columns as u32, PANEL.1 * FINE * rows as u32)
    }

    fn draw(&self, svg: &mut String) -> Drawn {
        let columns = self.columns.max(1);
        let rows = self.panels.len().div_ceil(columns).max(1);
        let root = SVGBackend::with_string(svg, self.size()).into_drawing_area();
        for (area, panel) in root.split_evenly((rows, columns)).iter().zip(&self.panels) {
            panel.draw(area, self.rig.as_ref())?;
        }
        root.present()?;
        Ok(())
    }
}

impl Panel {
    fn draw(&self, area: &Area<'_>, rig: Option<&RigDelay>) -> Drawn {
        let (Some(columns), Some(rows)) = (Axis::of(&self.periods_ms), Axis::of(&self.delays_ms)) else {
            return Ok(());
        };
        let mut chart = ChartBuilder::on(area)
            .margin_top(34 * FINE)
            .margin_right(16 * FINE)
            .set_label_area_size(LabelAreaPosition::Left, 40 * FINE)
            .set_label_area_size(LabelAreaPosition::Bottom, 40 * FINE)
            .build_cartesian_2d(columns.low..columns.high, rows.low..rows.high)?;
        for (period, radius) in self.periods_ms.iter().zip(&self.radius) {
            let x = columns.cell(*period);
            for (class, from, to) in runs(radius) {
                let (Some(first), Some(last)) = (self.delays_ms.get(from), self.delays_ms.get(to)) else { continue };
                let cell = [(x.0, rows.cell(*first).0), (x.1, rows.cell(*last).1)];
                chart.draw_series([Rectangle::new(cell, Ink::Class(class).colour().filled())])?;
            }
        }
        chart
            .configure_mesh()
            .disable_mesh()
            .x_labels(6)
            .y_labels(6)
            .x_label_formatter(&|value| format!("{value:.1}"))
            .y_label_formatter(&|value| format!("{value:.1}"))
            .label_style(text(Ink::Text, HPos::Center, VPos::Center))
            .axis_style(Ink::Axis.colour())
            .set_all_tick_mark_size(4 * FINE)
            .draw()?;
        for line in self.boundary() {
            chart.draw_series([PathElement::new(line, Ink::Boundary.colour())])?;
        }
        for rig in rig.into_iter().flat_map(|rig| [rig.typical_ms, rig.longest_ms]) {
            if (rows.low..=rows.high).contains(&rig) {
                chart.draw_series([PathElement::new([(columns.low, rig), (columns.high, rig)], Ink::Rig.colour())])?;
            }
        }
        let inside = self.measured.iter().filter(|(period, delay)| {
            (columns.low..=columns.high).contains(period) && (rows.low..=rows.high).contains(delay)
        });
        chart.draw_series(inside.map(|&point| Circle::new(point, 4 * FINE, Ink::Point.colour().filled())))?;
        drop(chart);
        let fine = i32::try_from(FINE)?;
        let (width, height) = (i32::try_from(PANEL.0)?, i32::try_from(PANEL.1)?);
        area.draw_text(&self.title, &text(Ink::Title, HPos::Left, VPos::Center), (76 * fine, 22 * fine))?;
        area.draw_text("delay, ms", &text(Ink::Text, HPos::Left, VPos::Center), (2 * fine, 22 * fine))?;
        let end = ((width - 16) * fine, (height - 4) * fine);
        area.draw_text("period, ms", &text(Ink::Text, HPos::Right, VPos::Bottom), end)?;
        Ok(())
    }

    /// Where the spectral radius passes 1, upwards for the first time, from column to column.
    fn boundary(&self) -> Vec<Vec<(f64, f64)>> {
        let mut lines: Vec<Vec<(f64, f64)>> = vec![Vec::new()];
        for (period, radius) in self.periods_ms.iter().zip(&self.radius) {
            let passes = |pair: &[f64]| matches!(pair, [a, b] if *a < 1.0 && *b >= 1.0);
            let passed = radius.windows(2).position(passes).and_then(|row| {
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

/// An axis of cells around evenly spaced values.
struct Axis {
    low: f64,
    high: f64,
    half: f64,
}

impl Axis {
    fn of(values: &[f64]) -> Option<Self> {
        let (first, last) = (*values.first()?, *values.last()?);
        let usable = values.len() > 1 && first.is_finite() && last.is_finite() && last > first;
        usable.then(|| Self { low: first, high: last, half: (last - first) / (values.len() - 1) as f64 / 2.0 })
    }

    /// The edges of the cell around `value`, within the axis.
    fn cell(&self, value: f64) -> (f64, f64) {
        ((value - self.half).max(self.low), (value + self.half).min(self.high))
    }
}

/// The class of a spectral radius; what is no number is unstable.
fn class(radius: f64) -> u8 {
    EDGES.iter().position(|edge| radius < *edge).unwrap_or(EDGES.len()) as u8
}

/// Neighbours of one class: the class, the first and the last row.
fn runs(radius: &[f64]) -> Vec<(u8, usize, usize)> {
    let mut runs: Vec<(u8, usize, usize)> = Vec::new();
    for (row, radius) in radius.iter().enumerate() {
        let class = class(*radius);
        match runs.last_mut() {
            Some(run) if run.0 == class => run.2 = row,
            _ => runs.push((class, row, row)),
        }
    }
    runs
}

/// A role in a drawing. The style sheet gives it a colour.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Ink {
    Class(u8),
    Text,
    Title,
    Axis,
    Boundary,
    Rig,
    Point,
}

impl Ink {
    fn all() -> impl Iterator<Item = Self> {
        let classes = (0..=EDGES.len() as u8).map(Self::Class);
        classes.chain([Self::Text, Self::Title, Self::Axis, Self::Boundary, Self::Rig, Self::Point])
    }

    fn name(self) -> String {
        match self {
            Self::Class(class) => format!("r{class}"),
            Self::Text => "text".to_owned(),
            Self::Title => "title".to_owned(),
            Self::Axis => "axis".to_owned(),
            Self::Boundary => "boundary".to_owned(),
            Self::Rig => "rig".to_owned(),
            Self::Point => "point".to_owned(),
        }
    }

    /// A colour that stands for the role until the drawing is done.
    const fn colour(self) -> RGBColor {
        match self {
            Self::Class(class) => RGBColor(1, 3, class),
            Self::Text => RGBColor(1, 4, 0),
            Self::Title => RGBColor(1, 4, 1),
            Self::Axis => RGBColor(1, 4, 2),
            Self::Boundary => RGBColor(1, 4, 3),
            Self::Rig => RGBColor(1, 4, 4),
            Self::Point => RGBColor(1, 4, 5),
        }
    }
}

fn text(ink: Ink, side: HPos, height: VPos) -> TextStyle<'static> {
    let font = ("sans-serif", f64::from(12 * FINE)).into_font();
    let style = TextStyle::from(font).pos(Pos::new(side, height));
    TextStyle { color: ink.colour().to_backend_color(), ..style }
}

/// The drawing with classes instead of colours, in an element of its own with its style sheet.
fn dressed(drawn: &str, title: &str, (width, height): (u32, u32)) -> String {
    let body = drawn.split_once('>').map_or(drawn, |(_, rest)| rest).trim_end().trim_end_matches("</svg>");
    let mut body = body.replace("opacity=\"1\" ", "").replace("stroke-width=\"1\" ", "").replace(" \"/>", "\"/>");
    body = body.replace("stroke=\"none\"", "").replace(" stroke=\"#000000\"", "");
    for ink in Ink::all() {
        let RGBColor(red, green, blue) = ink.colour();
        for (attribute, prefix) in [("stroke", 's'), ("fill", 'f')] {
            let colour = format!("{attribute}=\"#{red:02X}{green:02X}{blue:02X}\"");
            body = body.replace(&colour, &format!("class=\"{prefix}-{}\"", ink.name()));
        }
    }
    let mut svg = String::new();
    let (shown_width, shown_height) = (width / FINE, height / FINE);
    // Writing to a string cannot fail.
    let _ = writeln!(
        svg,
        "<svg xmlns=\"http://www.w3.org/2000/svg\" class=\"map\" role=\"img\" width=\"{shown_width}\" height=\"{shown_height}\" \
         viewBox=\"0 0 {width} {height}\"><title>{}</title><style>{STYLE}</style>\
         <rect class=\"f-page\" width=\"{width}\" height=\"{height}\"/>{body}</svg>",
        escaped(title)
    );
    svg
}

fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;")
}

#[cfg(test)]
mod tests;
