//! Points by colour and shape in panels above each other, with limit lines: two logarithmic axes, the left to right one shared.

use super::ink::{Area, Drawn, FINE, Role, decades, document, many, power, text};
use crate::error::ReportError;
use plotters::prelude::*;
use plotters::style::text_anchor::HPos;
use std::ops::Range;

/// CSS pixels: width, height of a panel's plot, what stands above each and below the last, and the room for axis and legend at its sides.
const WIDTH: i32 = 900;
const PLOT: i32 = 250;
const ABOVE: i32 = 84;
const BELOW: i32 = 56;
const LEFT: i32 = 70;
const RIGHT: i32 = 330;
const TITLE: i32 = 30;
/// CSS pixels from one line of the legend to the next.
const LINE: i32 = 19;
/// Corners of a shape in units of its radius; the first is all but a circle.
const SHAPES: [&[(f64, f64)]; 5] = [
    &[
        (1.0, 0.0),
        (0.87, 0.5),
        (0.5, 0.87),
        (0.0, 1.0),
        (-0.5, 0.87),
        (-0.87, 0.5),
        (-1.0, 0.0),
        (-0.87, -0.5),
        (-0.5, -0.87),
        (0.0, -1.0),
        (0.5, -0.87),
        (0.87, -0.5),
    ],
    &[(0.9, 0.9), (-0.9, 0.9), (-0.9, -0.9), (0.9, -0.9)],
    &[(0.0, -1.25), (1.1, 0.75), (-1.1, 0.75)],
    &[(0.0, -1.35), (1.0, 0.0), (0.0, 1.35), (-1.0, 0.0)],
    &[(0.0, 1.25), (1.1, -0.75), (-1.1, -0.75)],
];

/// A point.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Point {
    /// Whose it is: a colour of the drawing.
    pub colour: usize,
    /// In what it was found: a shape of its panel.
    pub shape: usize,
    /// Left to right; none where there is no such number, and the point stands at the right edge.
    pub x: Option<f64>,
    /// Bottom to top.
    pub y: f64,
}

/// A part of the drawing with an upward axis of its own.
#[derive(Debug, Clone, PartialEq)]
pub struct Panel {
    /// What goes upwards, with its unit.
    pub y_label: String,
    /// Smallest y that is told apart: what lies below stands on the lower edge.
    pub least: f64,
    /// Names of shapes.
    pub shapes: Vec<String>,
    /// Points.
    pub points: Vec<Point>,
    /// Limits of x and their names.
    pub across: Vec<(f64, String)>,
    /// Limits of y and their names.
    pub up: Vec<(f64, String)>,
}

/// A drawing.
#[derive(Debug, Clone, PartialEq)]
pub struct Scatter {
    /// What it shows.
    pub title: String,
    /// What goes from left to right, with its unit.
    pub x_label: String,
    /// Names of colours.
    pub colours: Vec<String>,
    /// What a point at the right edge means.
    pub edge_label: String,
    /// From the top.
    pub panels: Vec<Panel>,
}

impl Scatter {
    /// The drawing as an SVG document.
    ///
    /// # Errors
    /// [`ReportError::Plot`] where it cannot be drawn.
    pub fn svg(&self) -> Result<String, ReportError> {
        let (width, height) = self.size();
        document(&self.title, (width * FINE, height * FINE), self.colours.len(), |root| self.draw(root))
    }

    /// CSS pixels.
    fn size(&self) -> (i32, i32) {
        (WIDTH, TITLE + (ABOVE + PLOT + BELOW) * many(self.panels.len()))
    }

    fn draw(&self, root: &Area<'_>) -> Drawn<()> {
        root.draw_text(&self.title, &text(Role::Title, HPos::Left), (14 * FINE, 20 * FINE))?;
        let points = || self.panels.iter().flat_map(|panel| &panel.points);
        let limits = self.panels.iter().flat_map(|panel| panel.across.iter().map(|(x, _)| *x));
        let xs = around(points().filter_map(|point| point.x).chain(limits));
        let (_, rest) = root.split_vertically(TITLE * FINE);
        for (number, (panel, area)) in self.panels.iter().zip(rest.split_evenly((self.panels.len(), 1))).enumerate() {
            self.panel(panel, &area, &xs)?;
            if number == 0 {
                self.legend(&area)?;
            }
        }
        Ok(())
    }

    fn panel(&self, panel: &Panel, area: &Area<'_>, xs: &Range<f64>) -> Drawn<()> {
        let values = panel.points.iter().map(|point| point.y).chain(panel.up.iter().map(|(y, _)| *y));
        let ys = decades(values.map(|y| if y.is_finite() { y.max(panel.least) } else { y }));
        // Room at the right for what has no x.
        let (edge, right) = (xs.end * 1.35, xs.end * 1.8);
        let mut chart = ChartBuilder::on(area)
            .margin_top(u32::try_from(ABOVE * FINE)?)
            .margin_right(u32::try_from(RIGHT * FINE)?)
            .set_label_area_size(LabelAreaPosition::Left, u32::try_from(LEFT * FINE)?)
            .set_label_area_size(LabelAreaPosition::Bottom, u32::try_from(BELOW * FINE)?)
            .build_cartesian_2d((xs.start..right).log_scale(), (ys.start..ys.end).log_scale())?;
        let labels = (ys.end / ys.start).log10().round() as usize + 1;
        chart
            .configure_mesh()
            .disable_x_mesh()
            .x_labels(0)
            .y_labels(labels)
            .x_label_formatter(&|_| String::new())
            .y_label_formatter(&|value| power(*value))
            .label_style(text(Role::Text, HPos::Center))
            .axis_style(Role::Axis.colour())
            .bold_line_style(Role::Grid.colour())
            .light_line_style(TRANSPARENT)
            .set_all_tick_mark_size(u32::try_from(4 * FINE)?)
            .draw()?;
        let log = |x: f64, range: &Range<f64>, end: f64| (x / range.start).log10() / (end / range.start).log10();
        let column = |x: f64| LEFT + (log(x, xs, right) * f64::from(WIDTH - LEFT - RIGHT)).round() as i32;
        let row = |y: f64| ABOVE + PLOT - (log(y, &ys, ys.end) * f64::from(PLOT)).round() as i32;
        for x in ticks(xs) {
            chart.draw_series([PathElement::new([(x, ys.start), (x, ys.end)], Role::Grid.colour())])?;
            let at = (column(x) * FINE, (ABOVE + PLOT + 14) * FINE);
            area.draw_text(&x.to_string(), &text(Role::Text, HPos::Center), at)?;
        }
        if ys.start <= panel.least * 1.01 {
            let at = ((LEFT - 8) * FINE, (ABOVE + PLOT) * FINE);
            area.draw_text(&format!("≤ {}", power(panel.least)), &text(Role::Text, HPos::Right), at)?;
        }
        // Names of neighbours stand at different heights.
        let mut across = panel.across.clone();
        across.sort_by(|a, b| a.0.total_cmp(&b.0));
        for (number, (x, name)) in across.iter().enumerate() {
            chart.draw_series([PathElement::new([(*x, ys.start), (*x, ys.end)], Role::Mark.colour())])?;
            let height = ABOVE - 10 - 16 * many(number % 3);
            area.draw_text(name, &text(Role::Text, HPos::Left), ((column(*x) - 3) * FINE, height * FINE))?;
        }
        for (y, name) in panel.up.iter().filter(|(y, _)| ys.contains(y)) {
            chart.draw_series([PathElement::new([(xs.start, *y), (right, *y)], Role::Mark.colour())])?;
            let at = ((LEFT + 6) * FINE, (row(*y) - 8) * FINE);
            area.draw_text(name, &text(Role::Text, HPos::Left), at)?;
        }
        let drawn = panel.points.iter().filter(|point| point.y.is_finite() && point.x.is_none_or(f64::is_finite));
        chart.draw_series(drawn.map(|point| {
            let at = (point.x.unwrap_or(edge), point.y.max(panel.least));
            EmptyElement::at(at) + shape(point.shape, (0, 0), Role::Series(point.colour))
        }))?;
        drop(chart);
        area.draw_text(&panel.y_label, &text(Role::Title, HPos::Left), (14 * FINE, (ABOVE - 62) * FINE))?;
        let below = (ABOVE + PLOT + BELOW - 14) * FINE;
        area.draw_text(&self.x_label, &text(Role::Text, HPos::Right), ((WIDTH - RIGHT) * FINE, below))?;
        self.words(panel, area)
    }

    /// Colours, beside the first panel.
    fn legend(&self, area: &Area<'_>) -> Drawn<()> {
        for (number, name) in self.colours.iter().enumerate() {
            let (column, line) = (many(number % 2), many(number / 2));
            let (x, y) = (WIDTH - RIGHT + 24 + 150 * column, ABOVE - 62 + LINE * line);
            area.draw(&shape(0, (x * FINE, y * FINE), Role::Series(number)))?;
            area.draw_text(name, &text(Role::Text, HPos::Left), ((x + 12) * FINE, y * FINE))?;
        }
        Ok(())
    }

    /// Shapes, and what stands at the right edge by name, beside their panel.
    fn words(&self, panel: &Panel, area: &Area<'_>) -> Drawn<()> {
        let x = WIDTH - RIGHT + 24;
        let mut y = ABOVE - 62 + LINE * (many(self.colours.len().div_ceil(2)) + 1);
        for (number, name) in panel.shapes.iter().enumerate() {
            area.draw(&shape(number, (x * FINE, y * FINE), Role::Shape))?;
            area.draw_text(name, &text(Role::Text, HPos::Left), ((x + 12) * FINE, y * FINE))?;
            y += LINE;
        }
        if panel.points.iter().any(|point| point.x.is_none()) {
            y += LINE / 2;
            let head = format!("at the right edge, {}:", self.edge_label);
            area.draw_text(&head, &text(Role::Text, HPos::Left), ((x - 6) * FINE, y * FINE))?;
        }
        for (colour, name) in self.colours.iter().enumerate() {
            let shapes = panel.at_the_edge(colour);
            if shapes.is_empty() {
                continue;
            }
            y += LINE - 2;
            area.draw_text(name, &text(Role::Text, HPos::Left), ((x + 12) * FINE, y * FINE))?;
            for (number, own) in shapes.into_iter().enumerate() {
                let at = ((x + 130 + 18 * many(number)) * FINE, y * FINE);
                area.draw(&shape(own, at, Role::Series(colour)))?;
            }
        }
        Ok(())
    }
}

impl Panel {
    /// With which shapes a colour stands at the right edge.
    fn at_the_edge(&self, colour: usize) -> Vec<usize> {
        let own = self.points.iter().filter(|point| point.colour == colour && point.x.is_none());
        own.map(|point| point.shape).collect()
    }
}

/// A shape around a point in units of the drawing.
fn shape(number: usize, at: (i32, i32), role: Role) -> Polygon<(i32, i32)> {
    let radius = f64::from(5 * FINE);
    let corner = |&(x, y): &(f64, f64)| (at.0 + (x * radius).round() as i32, at.1 + (y * radius).round() as i32);
    let corners: Vec<_> = SHAPES[number % SHAPES.len()].iter().map(corner).collect();
    Polygon::new(corners, role.colour().filled())
}

/// A range with some room at both ends.
fn around(values: impl Iterator<Item = f64>) -> Range<f64> {
    let drawn = values.filter(|value| value.is_finite() && *value > 0.0);
    let (low, high) = drawn.fold((f64::INFINITY, 0.0_f64), |(low, high), value| (low.min(value), high.max(value)));
    if low > high { 0.5..20.0 } else { low / 1.4..high * 1.4 }
}

/// 1, 2 and 5 times the decades within a range.
fn ticks(range: &Range<f64>) -> Vec<f64> {
    let decades = range.start.log10().floor() as i32..=range.end.log10().ceil() as i32;
    let of_decade = |decade: i32| {
        let power = 10.0_f64.powi(decade.abs());
        [1.0, 2.0, 5.0].map(|digit| if decade < 0 { digit / power } else { digit * power })
    };
    decades.flat_map(of_decade).filter(|tick| range.contains(tick)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn point(colour: usize, shape: usize, x: Option<f64>, y: f64) -> Point {
        Point { colour, shape, x, y }
    }

    fn scatter(points: Vec<Point>) -> Scatter {
        let panel = Panel {
            y_label: "error, %".to_owned(),
            least: 1e-4,
            shapes: vec!["scene one".to_owned(), "scene two".to_owned()],
            points,
            across: vec![(2.0, "two periods".to_owned())],
            up: vec![(0.1, "noise floor".to_owned())],
        };
        Scatter {
            title: "a < b".to_owned(),
            x_label: "time, ms".to_owned(),
            colours: vec!["first".to_owned(), "second".to_owned()],
            edge_label: "never settles".to_owned(),
            panels: vec![panel.clone(), panel],
        }
    }

    /// Centres of the shapes of a colour, in panels' order: the legend's comes first.
    fn centres(svg: &str, colour: usize) -> Vec<(f64, f64)> {
        let own = svg.split("<polygon ").filter(|part| part.contains(&format!("class=\"f{colour}\"")));
        own.map(|part| {
            let corners: Vec<f64> = part
                .split("points=\"")
                .nth(1)
                .and_then(|rest| rest.split('"').next())
                .into_iter()
                .flat_map(|list| list.split([' ', ',']).filter(|field| !field.is_empty()))
                .map(|field| field.parse().unwrap())
                .collect();
            let middle = |offset: usize| {
                let own: Vec<f64> = corners.iter().skip(offset).step_by(2).copied().collect();
                own.iter().sum::<f64>() / own.len() as f64
            };
            (middle(0), middle(1))
        })
        .collect()
    }

    #[test]
    fn everything_has_a_role_and_limits_their_names() {
        let svg = scatter(vec![point(0, 0, Some(3.0), 0.5), point(1, 1, None, 30.0)]).svg().unwrap();
        let (_, body) = svg.split_once("</style>").unwrap();
        assert!(!body.contains("=\"#"), "{body}");
        for text in ["two periods", "noise floor", "at the right edge, never settles:", "time, ms"] {
            assert_eq!(body.matches(text).count(), 2, "{text}: {body}");
        }
        // In the first panel's legend; and again in both panels who stands at the edge.
        assert_eq!((body.matches("\nfirst\n").count(), body.matches("\nsecond\n").count()), (1, 3), "{body}");
    }

    #[test]
    fn what_never_settles_stands_right_of_all_that_does_and_what_is_below_the_least_on_the_edge() {
        let all = vec![
            point(0, 0, Some(9.9), 1e-9),
            point(0, 0, Some(9.9), 1e-4),
            point(1, 1, None, 1e-2),
            point(1, 1, Some(0.2), 1.0),
        ];
        let svg = scatter(all).svg().unwrap();
        let (left, right) = (centres(&svg, 0), centres(&svg, 1));
        // In the legend, and in two panels; one of the right ones also by name.
        assert_eq!((left.len(), right.len()), (5, 7), "{svg}");
        let in_panels = |found: &[(f64, f64)], x: f64| found.iter().filter(|point| (point.0 - x).abs() < 1.0).count();
        let settled = left.iter().map(|point| point.0).filter(|x| in_panels(&left, *x) > 1).fold(0.0, f64::max);
        // Left of the words.
        let plot = f64::from((WIDTH - RIGHT) * FINE);
        let never = right.iter().map(|point| point.0).filter(|x| *x < plot).fold(0.0, f64::max);
        assert!(never > settled, "{left:?} {right:?}");
        let low = |height: f64| left.iter().filter(|point| (point.1 - height).abs() < 4.0).count();
        let lowest = left.iter().map(|point| point.1).fold(0.0, f64::max);
        assert_eq!(low(lowest), 2, "what lies below the least and what is the least: {left:?}");
    }

    #[test]
    fn ticks_are_round_and_within() {
        assert_eq!(ticks(&(0.48..21.0)), [0.5, 1.0, 2.0, 5.0, 10.0, 20.0]);
        assert_eq!(ticks(&(0.02..0.0499)), [0.02]);
        assert_eq!(around([f64::NAN, 0.0, 2.8].into_iter()), 2.8 / 1.4..2.8 * 1.4);
        assert_eq!(around(std::iter::empty()), 0.5..20.0);
    }

    #[test]
    fn a_drawing_without_points_is_still_one() {
        assert!(scatter(Vec::new()).svg().unwrap().contains("noise floor"));
    }
}
