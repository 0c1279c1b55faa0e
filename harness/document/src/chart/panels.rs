//! Lays out panels in a grid, each with a title, two axes and marks, and one legend below them.

use super::marks::{Axes, Axis, CHARACTER_WIDTH, Drawing, Mark, Point, Role, Scale, Shape, TextEnd, Ticks};
use std::ops::Range;

const HEADING_HEIGHT: f64 = 26.0;
/// Edges of a plot in its panel, CSS pixels. The texts of the y axis widen the left edge.
const TOP: f64 = 40.0;
const BOTTOM: f64 = 44.0;
const RIGHT: f64 = 16.0;
const MIN_LEFT: f64 = 40.0;
const LEGEND_LINE_HEIGHT: f64 = 20.0;
const SYMBOL_WIDTH: f64 = 16.0;

/// Panels of equal size.
#[derive(Debug, Clone)]
pub struct PanelChart {
    pub title: String,
    /// Draws the title above the panels.
    pub has_heading: bool,
    /// Width and height, CSS pixels.
    pub panel_size: Point,
    pub columns: usize,
    pub panels: Vec<Panel>,
    pub legend: Vec<LegendEntry>,
}

#[derive(Debug, Clone)]
pub struct Panel {
    pub title: String,
    pub x: PanelAxis,
    pub y: PanelAxis,
    /// Marks behind the axes.
    pub cells: Vec<Mark>,
    pub marks: Vec<Mark>,
}

#[derive(Debug, Clone)]
pub struct PanelAxis {
    label: String,
    scale: Scale,
    values: Range<f64>,
    ticks: Ticks,
}

impl PanelAxis {
    pub fn new(label: &str, scale: Scale, values: Range<f64>, ticks: impl FnOnce(&Axis) -> Ticks) -> Self {
        let axis = Axis { scale, values: values.clone(), pixels: 0.0..1.0 };
        Self { label: label.to_owned(), scale, values, ticks: ticks(&axis) }
    }

    /// Names in the middle of intervals of length 1. At most `most` of them are written.
    pub fn names(label: &str, names: &[String], most: usize) -> Self {
        let count = names.len().max(1);
        let written = names.iter().enumerate().step_by(count.div_ceil(most).max(1));
        let texts = written.map(|(number, name)| (number as f64 + 0.5, name.clone())).collect();
        Self::new(label, Scale::Linear, 0.0..count as f64, |_| Ticks { texts, has_grid: false })
    }

    /// The first name is at the top of a y axis.
    #[must_use]
    pub fn downwards(self) -> Self {
        Self { values: self.values.end..self.values.start, ..self }
    }

    fn axis(&self, pixels: Range<f64>) -> Axis {
        Axis { scale: self.scale, values: self.values.clone(), pixels }
    }
}

#[derive(Debug, Clone)]
pub struct LegendEntry {
    symbol: Symbol,
    text: String,
}

#[derive(Debug, Clone, Copy)]
pub enum Symbol {
    None,
    Area(Role),
    Line(Role),
    Point(Role, Shape),
}

impl LegendEntry {
    pub fn new(symbol: Symbol, text: impl Into<String>) -> Self {
        Self { symbol, text: text.into() }
    }

    /// The names of series, each with a disc of its colour.
    pub fn series<'a>(names: impl IntoIterator<Item = &'a str>) -> impl Iterator<Item = Self> {
        let symbol = |number| Symbol::Point(Role::Series(number), Shape::Disc);
        names.into_iter().enumerate().map(move |(number, name)| Self::new(symbol(number), name))
    }

    fn draw(&self, drawing: &mut Drawing, (x, y): Point) {
        match self.symbol {
            Symbol::None => {}
            Symbol::Area(role) => drawing.rectangle(role, [(x, y - 5.0), (x + SYMBOL_WIDTH, y + 5.0)]),
            Symbol::Line(role) => drawing.line(role, [(x, y), (x + SYMBOL_WIDTH, y)]),
            Symbol::Point(role, shape) => drawing.shape(role, shape, (x + SYMBOL_WIDTH / 2.0, y), 4.5),
        }
        let indent = if matches!(self.symbol, Symbol::None) { 0.0 } else { SYMBOL_WIDTH + 5.0 };
        drawing.text(Role::Text, TextEnd::Left, (x + indent, y), &self.text);
    }
}

impl PanelChart {
    fn heading_height(&self) -> f64 {
        if self.has_heading { HEADING_HEIGHT } else { 0.0 }
    }

    fn left_edge(&self) -> f64 {
        let texts = self.panels.iter().flat_map(|panel| &panel.y.ticks.texts);
        let longest = texts.map(|(_, text)| text.chars().count()).max().unwrap_or(0);
        (CHARACTER_WIDTH * longest as f64 + 14.0).max(MIN_LEFT)
    }

    /// Width of the drawing, and the lower edge of the panels.
    fn panels_size(&self) -> Point {
        let (columns, (width, height)) = (self.columns.max(1), self.panel_size);
        let rows = self.panels.len().div_ceil(columns).max(1);
        (width * columns as f64, self.heading_height() + height * rows as f64)
    }

    fn axes(&self, number: usize) -> Option<Axes> {
        let (panel, columns, (width, height)) = (self.panels.get(number)?, self.columns.max(1), self.panel_size);
        let left = width * (number % columns) as f64;
        let top = self.heading_height() + height * (number / columns) as f64;
        let x = panel.x.axis(left + self.left_edge()..left + width - RIGHT);
        Some(Axes { x, y: panel.y.axis(top + height - BOTTOM..top + TOP) })
    }

    /// Left, top, width and height of the rectangle between two corners, as shares of the drawing.
    pub fn area(&self, number: usize, [from, to]: [Point; 2]) -> Option<[f64; 4]> {
        let Axes { x, y } = self.axes(number)?;
        let (width, height) = self.size();
        let ([left, right], [bottom, top]) =
            ([from.0, to.0].map(|x0| x.pixel(x0)), [from.1, to.1].map(|y0| y.pixel(y0)));
        Some([left / width, top / height, (right - left) / width, (bottom - top) / height])
    }

    /// Entries of the legend with their positions, in lines as wide as the drawing.
    fn legend_places(&self) -> Vec<(&LegendEntry, Point)> {
        let (width, bottom) = self.panels_size();
        let (mut x, mut y) = (8.0, bottom + LEGEND_LINE_HEIGHT / 2.0);
        let mut place = |text: &str| {
            let entry_width = SYMBOL_WIDTH + 24.0 + CHARACTER_WIDTH * text.chars().count() as f64;
            if x > 8.0 && x + entry_width > width {
                (x, y) = (8.0, y + LEGEND_LINE_HEIGHT);
            }
            let at = (x, y);
            x += entry_width;
            at
        };
        self.legend.iter().map(|entry| (entry, place(&entry.text))).collect()
    }

    fn size(&self) -> Point {
        let (width, bottom) = self.panels_size();
        (width, self.legend_places().last().map_or(bottom, |(_, (_, y))| y + LEGEND_LINE_HEIGHT / 2.0 + 4.0))
    }

    pub fn svg(&self) -> String {
        let mut drawing = Drawing::default();
        if self.has_heading {
            drawing.text(Role::Title, TextEnd::Left, (8.0, HEADING_HEIGHT / 2.0), &self.title);
        }
        for (panel, axes) in
            self.panels.iter().enumerate().filter_map(|(number, panel)| Some((panel, self.axes(number)?)))
        {
            let ((left, right), (bottom, top)) =
                ((axes.x.pixels.start, axes.x.pixels.end), (axes.y.pixels.start, axes.y.pixels.end));
            drawing.marks(&axes, &panel.cells);
            drawing.frame(&axes, &panel.x.ticks, &panel.y.ticks);
            drawing.marks(&axes, &panel.marks);
            drawing.text(Role::Title, TextEnd::Left, (left, top - TOP + 10.0), &panel.title);
            drawing.text(Role::Text, TextEnd::Left, (left - self.left_edge() + 8.0, top - 12.0), &panel.y.label);
            drawing.text(Role::Text, TextEnd::Right, (right, bottom + 33.0), &panel.x.label);
        }
        for (entry, at) in self.legend_places() {
            entry.draw(&mut drawing, at);
        }
        drawing.into_document(&self.title, self.size())
    }
}
