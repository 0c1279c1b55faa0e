//! Draws figures as SVG from marks on two axes, with classes instead of colours.
//!
//! A mark has values of the axes as position. The axes convert values to CSS pixels; the writer
//! rounds pixels to a quarter. Titles and legends have positions in pixels.
//!
//! Every colour is defined once, for light and dark. Pages use CSS variables. SVG files contain
//! values, because not every viewer of SVG supports variables.

use maud::{Markup, PreEscaped, html};
use platebench_model::record::Verdict;
use std::fmt::Write as _;
use std::ops::Range;

/// The view box counts quarters of a pixel, so that a position is a short whole number.
const UNITS_PER_PIXEL: f64 = 4.0;
const TICK_LENGTH: f64 = 4.0;

pub type Point = (f64, f64);

/// Meaning of a mark. The style sheet gives it colour, width and dashes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, strum::EnumIter, strum::IntoStaticStr)]
#[strum(serialize_all = "kebab-case")]
pub enum Role {
    Text,
    Title,
    Grid,
    Axis,
    Mark,
    Shape,
    First,
    Second,
    DecidingTrial,
    Other,
    Setpoint,
    Band,
    Spread,
    SecondSpread,
    Saturated,
    Settling,
    Deadline,
    Golden,
    Tube,
    Trial,
    Median,
    Resonance,
    Overrun,
    Lost,
    Boundary,
    Delay,
    Measured,
    Limit,
    #[strum(serialize = "window")]
    JudgedWindow,
    Worst,
    OpenLoop,
    Pass,
    Fail,
    Inconclusive,
    Series(usize),
    Radius(usize),
}

impl From<Verdict> for Role {
    fn from(verdict: Verdict) -> Self {
        match verdict {
            Verdict::Pass => Self::Pass,
            Verdict::Fail => Self::Fail,
            Verdict::Inconclusive => Self::Inconclusive,
        }
    }
}

/// Number of colours. Higher numbers of series and radii begin again with the first colour.
pub const COLOURS: usize = 10;

impl Role {
    /// Name of the class without its prefix, which is `s-` for a stroke and `f-` for a filling.
    pub fn name(self) -> String {
        match self {
            Self::Series(number) => format!("series-{}", number % COLOURS),
            Self::Radius(number) => format!("radius-{}", number % COLOURS),
            named => <&str>::from(named).to_owned(),
        }
    }
}

#[derive(Debug, Clone, PartialEq)]
pub enum Mark {
    Line(Role, Vec<Point>),
    /// Area between an upper and a lower edge, both from left to right.
    Band(Role, [Vec<Point>; 2]),
    Point {
        role: Role,
        at: Point,
        shape: Shape,
        /// CSS pixels.
        radius: f64,
        text: Option<String>,
    },
    /// Rectangle between two corners. The part outside the axes is not drawn.
    Cell(Role, [Point; 2]),
    /// Line across the plot at a value of one axis.
    Limit {
        role: Role,
        at: AxisValue,
        text: Option<String>,
    },
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub enum AxisValue {
    X(f64),
    Y(f64),
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Shape {
    Disc,
    Ring,
    Cross,
    Square,
    Triangle,
    Diamond,
    InvertedTriangle,
}

impl Mark {
    /// A point without a text. The radius is in CSS pixels.
    pub const fn point(role: Role, at: Point, shape: Shape, radius: f64) -> Self {
        Self::Point { role, at, shape, radius, text: None }
    }
}

/// Corners in units of the radius. Empty for a shape that is no polygon.
const fn corners(shape: Shape) -> &'static [Point] {
    match shape {
        Shape::Disc | Shape::Ring | Shape::Cross => &[],
        Shape::Square => &[(0.9, 0.9), (-0.9, 0.9), (-0.9, -0.9), (0.9, -0.9)],
        Shape::Triangle => &[(0.0, -1.25), (1.1, 0.75), (-1.1, 0.75)],
        Shape::Diamond => &[(0.0, -1.35), (1.0, 0.0), (0.0, 1.35), (-1.0, 0.0)],
        Shape::InvertedTriangle => &[(0.0, 1.25), (1.1, -0.75), (-1.1, -0.75)],
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Scale {
    Linear,
    Logarithmic,
}

/// Values and the pixels at which the first and the last of them lie.
#[derive(Debug, Clone, PartialEq)]
pub struct Axis {
    pub scale: Scale,
    pub values: Range<f64>,
    pub pixels: Range<f64>,
}

impl Axis {
    pub const fn linear(values: Range<f64>, pixels: Range<f64>) -> Self {
        Self { scale: Scale::Linear, values, pixels }
    }

    /// Pixel of a value. A value outside the axis lies at its nearest end.
    pub fn pixel(&self, value: f64) -> f64 {
        let Range { start, end } = self.values;
        let share = match self.scale {
            Scale::Linear => (value - start) / (end - start),
            Scale::Logarithmic => (value / start).ln() / (end / start).ln(),
        };
        self.pixels.start + share.clamp(0.0, 1.0) * (self.pixels.end - self.pixels.start)
    }

    /// At most `most` round values: 1, 2 or 5 times a power of ten apart, or powers of ten.
    pub fn ticks(&self, most: usize) -> Vec<f64> {
        let Range { start, end } = self.values;
        let most = most.max(2) as f64;
        if self.scale == Scale::Logarithmic {
            let (first, last) = ((start.log10() - 1e-9).ceil() as i32, (end.log10() + 1e-9).floor() as i32);
            let step = (f64::from(last - first + 1) / most).ceil().max(1.0) as usize;
            return (first..=last).step_by(step).map(|exponent| 10.0_f64.powi(exponent)).collect();
        }
        let smallest = (end - start) / (most - 1.0);
        if smallest.is_nan() || smallest <= 0.0 {
            return Vec::new();
        }
        let power = 10.0_f64.powf(smallest.log10().floor());
        let fits = |step: &f64| *step >= smallest * (1.0 - 1e-9);
        let Some(step) = [1.0, 2.0, 5.0, 10.0].map(|digit| digit * power).into_iter().find(fits) else {
            return Vec::new();
        };
        let (first, last) = ((start / step - 1e-9).ceil(), (end / step + 1e-9).floor());
        (0..=(last - first).max(0.0) as usize).map(|index| (first + index as f64) * step).collect()
    }
}

#[derive(Debug, Clone, PartialEq)]
pub struct Axes {
    pub x: Axis,
    pub y: Axis,
}

impl Axes {
    fn place(&self, (x, y): Point) -> Point {
        (self.x.pixel(x), self.y.pixel(y))
    }
}

/// Values of an axis with their texts. A line of the grid lies at each value if `has_grid`.
#[derive(Debug, Clone, PartialEq)]
pub struct Ticks {
    pub texts: Vec<(f64, String)>,
    pub has_grid: bool,
}

impl Ticks {
    pub fn new(values: Vec<f64>, has_grid: bool, text: impl Fn(f64) -> String) -> Self {
        Self { texts: values.into_iter().map(|value| (value, text(value))).collect(), has_grid }
    }
}

/// End of a text that lies at its position.
#[derive(Debug, Clone, Copy, PartialEq, Eq, strum::IntoStaticStr)]
pub enum TextEnd {
    #[strum(serialize = "start")]
    Left,
    #[strum(serialize = "middle")]
    Centre,
    #[strum(serialize = "end")]
    Right,
}

/// The elements of an SVG drawing, in drawing order.
#[derive(Debug, Clone, Default)]
pub struct Drawing {
    elements: String,
    /// Lines and edges of areas. The text of a worst value avoids them.
    segments: Vec<[Point; 2]>,
    /// Upper left and lower right corners of the texts beside marks.
    texts: Vec<[Point; 2]>,
}

impl Drawing {
    fn push(&mut self, element: &Markup) {
        self.elements.push_str(&element.0);
    }

    pub fn into_markup(self) -> Markup {
        PreEscaped(self.elements)
    }

    /// Text of 12 px, centred vertically.
    pub fn text(&mut self, role: Role, end: TextEnd, at: Point, text: &str) {
        let ((x, y), anchor) = (units(at), <&str>::from(end));
        self.push(&html! {
            text x=(x) y=(y) dy="0.5ex" text-anchor=(anchor) class={ "f-" (role.name()) } { (text) }
        });
    }

    pub fn line(&mut self, role: Role, points: impl IntoIterator<Item = Point>) {
        self.path('s', role, points);
    }

    fn path(&mut self, prefix: char, role: Role, points: impl IntoIterator<Item = Point>) {
        let data = path_data(points.into_iter().map(units));
        if !data.is_empty() {
            self.push(&html! { path class={ (prefix) "-" (role.name()) } d=(data) {} });
        }
    }

    /// Rectangle between two opposite corners.
    pub(crate) fn rectangle(&mut self, role: Role, corners: [Point; 2]) {
        let [(x0, y0), (x1, y1)] = corners.map(units);
        let (x, y, width, height) = (x0.min(x1), y0.min(y1), (x1 - x0).abs(), (y1 - y0).abs());
        self.push(&html! { rect x=(x) y=(y) width=(width) height=(height) class={ "f-" (role.name()) } {} });
    }

    pub fn shape(&mut self, role: Role, shape: Shape, at: Point, radius: f64) {
        let corner = |&(dx, dy): &Point| (at.0 + dx * radius, at.1 + dy * radius);
        match shape {
            Shape::Disc | Shape::Ring => {
                let ((x, y), prefix) = (units(at), if shape == Shape::Ring { "s-" } else { "f-" });
                let radius = (radius * UNITS_PER_PIXEL).round();
                self.push(&html! { circle cx=(x) cy=(y) r=(radius) class={ (prefix) (role.name()) } {} });
            }
            Shape::Cross => {
                for ends in [[(-1.0, -1.0), (1.0, 1.0)], [(-1.0, 1.0), (1.0, -1.0)]] {
                    self.line(role, ends.iter().map(corner));
                }
            }
            polygon => self.path('f', role, corners(polygon).iter().map(corner)),
        }
    }

    /// Draws the grid, both axes and their ticks.
    pub fn frame(&mut self, axes: &Axes, x_ticks: &Ticks, y_ticks: &Ticks) {
        let [left, right] = [axes.x.pixels.start, axes.x.pixels.end];
        let [bottom, top] = [axes.y.pixels.start, axes.y.pixels.end];
        let [columns, rows] = [(x_ticks, &axes.x), (y_ticks, &axes.y)].map(|(ticks, axis)| {
            ticks.texts.iter().map(|(value, text)| (axis.pixel(*value), text)).collect::<Vec<_>>()
        });
        for (x, _) in columns.iter().filter(|_| x_ticks.has_grid) {
            self.line(Role::Grid, [(*x, bottom), (*x, top)]);
        }
        for (y, _) in rows.iter().filter(|_| y_ticks.has_grid) {
            self.line(Role::Grid, [(left, *y), (right, *y)]);
        }
        self.line(Role::Axis, [(left, top), (left, bottom), (right, bottom)]);
        for (x, text) in columns {
            self.text(Role::Text, TextEnd::Centre, (x, bottom + 14.0), text);
            self.line(Role::Axis, [(x, bottom), (x, bottom + TICK_LENGTH)]);
        }
        for (y, text) in rows {
            self.text(Role::Text, TextEnd::Right, (left - 8.0, y), text);
            self.line(Role::Axis, [(left - TICK_LENGTH, y), (left, y)]);
        }
    }

    /// Draws marks and their texts. The texts of limits of the x axis have different heights.
    pub fn marks<'a>(&mut self, axes: &Axes, marks: impl IntoIterator<Item = &'a Mark>) {
        let mut height = LOWEST_TEXT;
        for mark in marks {
            match mark {
                Mark::Line(role, points) => {
                    let known = points.iter().filter(|(x, y)| !x.is_nan() && !y.is_nan());
                    let places: Vec<Point> = known.map(|point| axes.place(*point)).collect();
                    self.segments.extend(places.array_windows());
                    self.line(*role, places);
                }
                Mark::Band(role, [upper, lower]) => {
                    for edge in [upper, lower] {
                        let places: Vec<Point> = edge.iter().map(|point| axes.place(*point)).collect();
                        self.segments.extend(places.array_windows());
                    }
                    let outline = upper.iter().chain(lower.iter().rev());
                    self.path('f', *role, outline.map(|point| axes.place(*point)));
                }
                Mark::Point { role, at, shape, radius, text } => {
                    let place = axes.place(*at);
                    self.shape(*role, *shape, place, *radius);
                    if let Some(text) = text {
                        let rise = if *role == Role::Worst { self.free_rise(axes, place, text) } else { 0.0 };
                        self.text_beside(axes, *role, (place.0, place.1 - rise), POINT_TEXT_DISTANCE, text);
                    }
                }
                Mark::Cell(role, corners) => self.rectangle(*role, corners.map(|corner| axes.place(corner))),
                Mark::Limit { role, at: AxisValue::X(value), text } => {
                    let (x, Range { start: bottom, end: top }) = (axes.x.pixel(*value), axes.y.pixels.clone());
                    self.line(*role, [(x, bottom), (x, top)]);
                    if let Some(text) = text {
                        self.text_beside(axes, *role, (x, bottom + height * (top - bottom)), 0.012, text);
                        height += TEXT_HEIGHT;
                    }
                }
                Mark::Limit { role, at: AxisValue::Y(value), text } => {
                    let (y, Range { start: left, end: right }) = (axes.y.pixel(*value), axes.x.pixels.clone());
                    self.line(*role, [(left, y), (right, y)]);
                    if let Some(text) = text {
                        self.text(Role::Text, TextEnd::Left, (left + 6.0, y - 8.0), text);
                    }
                }
            }
        }
    }

    /// `distance` is a share of the plot's width.
    fn text_beside(&mut self, axes: &Axes, role: Role, place: Point, distance: f64, text: &str) {
        let (end, x, corners) = text_place(axes, place, distance, text);
        self.texts.push(corners);
        self.text(role, end, (x, place.1), text);
    }

    /// Distance of the text of a worst value above its point, px: the first one at which the text is
    /// inside the plot, covers no other text and crosses the fewest lines.
    fn free_rise(&self, axes: &Axes, (x, y): Point, text: &str) -> f64 {
        let Range { start: bottom, end: top } = axes.y.pixels;
        let cost = |rise: &f64| {
            let (.., corners) = text_place(axes, (x, y - rise), POINT_TEXT_DISTANCE, text);
            let [(left, upper), (right, lower)] = corners;
            let covers = |other: &[Point; 2]| {
                other[0].0 < right && left < other[1].0 && other[0].1 < lower && upper < other[1].1
            };
            let is_taken = upper < top || bottom < lower || self.texts.iter().any(covers);
            (is_taken, self.segments.iter().filter(|segment| crosses(**segment, corners)).count())
        };
        WORST_TEXT_RISES.into_iter().min_by_key(cost).unwrap_or_default()
    }

    /// An SVG file with a background and the styles for light and dark. `size` is in CSS pixels.
    pub fn into_document(self, title: &str, size: Point) -> String {
        let body = html! { rect class="f-card" width="100%" height="100%" {} (self.into_markup()) };
        let style = PreEscaped(document_style(&body.0));
        let (width, height) = size;
        let document = html! {
            svg xmlns="http://www.w3.org/2000/svg" role="img" width=(width) height=(height) viewBox=(view_box(size)) {
                title { (title) }
                style { (style) }
                (body)
            }
        };
        document.into_string() + "\n"
    }
}

/// Distances of a worst value's text above its point, px. Each is more than half of the text's
/// height, because the point may lie on the line of its limit.
const WORST_TEXT_RISES: [f64; 8] = [12.0, -12.0, 26.0, -26.0, 40.0, -40.0, 54.0, -54.0];
/// Share of the plot's width between a point and its text.
const POINT_TEXT_DISTANCE: f64 = 0.015;
/// Mean width of a character and height of a text of 12 px.
pub const CHARACTER_WIDTH: f64 = 6.7;
const LETTER_HEIGHT: f64 = 14.0;

/// End of the text at the mark, its x, and the corners of the text. Right of an early mark and left
/// of a late one, a settled response leaves room for text.
fn text_place(axes: &Axes, (x, y): Point, distance: f64, text: &str) -> (TextEnd, f64, [Point; 2]) {
    let Range { start: left, end: right } = axes.x.pixels;
    let distance = distance * (right - left);
    let (width, half) = (CHARACTER_WIDTH * text.chars().count() as f64, LETTER_HEIGHT / 2.0);
    let (end, at, from) = if x - left < 0.55 * (right - left) {
        (TextEnd::Left, x + distance, x + distance)
    } else {
        (TextEnd::Right, x - distance, x - distance - width)
    };
    (end, at, [(from, y - half), (from + width, y + half)])
}

/// True if a part of the segment is between the corners. Clips the segment at each side
/// (Liang and Barsky).
fn crosses([start, end]: [Point; 2], [upper_left, lower_right]: [Point; 2]) -> bool {
    let axes = [(start.0, end.0, upper_left.0, lower_right.0), (start.1, end.1, upper_left.1, lower_right.1)];
    let (from, to) = axes.into_iter().fold((0.0_f64, 1.0_f64), |(from, to), (start, end, low, high)| {
        // A quotient by 0 is infinite, or NaN on the side itself, which `max` and `min` ignore.
        let [one, other] = [low, high].map(|side| (side - start) / (end - start));
        (from.max(one.min(other)), to.min(one.max(other)))
    });
    from <= to
}

/// Height of the text of the first limit and distance to the text of the next one, as shares of the
/// plot.
const LOWEST_TEXT: f64 = 0.12;
const TEXT_HEIGHT: f64 = 0.1;

pub fn view_box(size: Point) -> String {
    let (width, height) = units(size);
    format!("0 0 {width} {height}")
}

fn units((x, y): Point) -> (i64, i64) {
    let unit = |pixels: f64| (pixels * UNITS_PER_PIXEL).round() as i64;
    (unit(x), unit(y))
}

/// Data of a relative path, which is shorter than one with absolute positions.
fn path_data(points: impl IntoIterator<Item = (i64, i64)>) -> String {
    let mut before = (0, 0);
    let mut data = String::new();
    for (number, (x, y)) in points.into_iter().enumerate() {
        let step = (x - before.0, y - before.1);
        match number {
            0 => data.push('m'),
            1 => data.push('l'),
            _ if step.0 < 0 => {}
            _ => data.push(' '),
        }
        let separator = if step.1 >= 0 { " " } else { "" };
        let _ = write!(data, "{}{separator}{}", step.0, step.1);
        before = (x, y);
    }
    data
}

pub fn extent(values: impl Iterator<Item = f64>) -> Option<(f64, f64)> {
    values.map(|value| (value, value)).reduce(|(low, high), (value, _)| (low.min(value), high.max(value)))
}

pub fn logarithmic_extent(values: impl Iterator<Item = f64>) -> Option<(f64, f64)> {
    extent(values.filter(|value| value.is_finite() && *value > 0.0))
}

pub fn decades(values: impl Iterator<Item = f64>) -> Range<f64> {
    let Some((low, high)) = logarithmic_extent(values) else { return 0.1..10.0 };
    let (from, to) = (low.log10().floor(), high.log10().ceil());
    10.0_f64.powf(from)..10.0_f64.powf(to.max(from + 1.0))
}

/// 1, 2 and 5 times the powers of ten in the range.
pub fn round_ticks(range: &Range<f64>) -> Vec<f64> {
    let decades = range.start.log10().floor() as i32..=range.end.log10().ceil() as i32;
    let of_decade = |decade: i32| {
        let power = 10.0_f64.powi(decade.abs());
        [1.0, 2.0, 5.0].map(|digit| if decade < 0 { digit / power } else { digit * power })
    };
    decades.flat_map(of_decade).filter(|tick| range.contains(tick)).collect()
}

pub fn format_power_of_ten(value: f64) -> String {
    // The conversion to a whole number removes the sign of −0.
    let digits = (value.log10().round() as i64).to_string();
    let raised = |digit| match digit {
        '-' => '⁻',
        '1' => '¹',
        '2' => '²',
        '3' => '³',
        '0' | '4'..='9' => char::from_u32(0x2070 + u32::from(digit) - u32::from('0')).unwrap_or(digit),
        other => other,
    };
    format!("10{}", digits.chars().map(raised).collect::<String>())
}

/// One rule per line, because `document_style` selects lines.
pub const RULES: &str = include_str!("roles.css");

/// Name, light value and dark value. The series have the palette of Okabe and Ito for colour-blind
/// readers, darkened for light and lightened for dark.
const VALUES: [(&str, &str, &str); 39] = [
    ("page", "#f6f6f3", "#121518"),
    ("card", "#fff", "#1a1e23"),
    ("ink", "#1b1f24", "#e7e9ec"),
    ("muted", "#5b646e", "#9ca6b0"),
    ("hair", "#e2e3df", "#2e343b"),
    ("pass", "#1a7040", "#5bc686"),
    ("fail", "#c0271f", "#ff8177"),
    ("inconclusive", "#855700", "#e5b64c"),
    ("pass-soft", "#e3f2e8", "#16301f"),
    ("fail-soft", "#fbe6e3", "#3b1c1a"),
    ("inconclusive-soft", "#faeed3", "#352a12"),
    ("verdict", "#c0271f", "#ff8177"),
    ("first", "#1f6cb0", "#6db3f2"),
    ("second", "#b4531a", "#f2a06a"),
    ("other", "#767f88", "#98a2ac"),
    ("settling", "#1a7040", "#5bc686"),
    ("golden", "#7a4fb5", "#bd9bf0"),
    ("amber", "#e0a72e", "#c08c1f"),
    ("band", "0.2", "0.3"),
    ("series-0", "#111418", "#f4f6f8"),
    ("series-1", "#b34a00", "#ff9b52"),
    ("series-2", "#1f6cb0", "#6db3f2"),
    ("series-3", "#0b7a5a", "#4fd0a5"),
    ("series-4", "#8a3f8f", "#dd93e0"),
    ("series-5", "#8a6d00", "#e8c63c"),
    ("series-6", "#a3243b", "#ff8594"),
    ("series-7", "#2a6f7f", "#79c9dc"),
    ("series-8", "#5c5c5c", "#b5b5b5"),
    ("series-9", "#4b4fb5", "#a3a7ff"),
    ("radius-0", "#2c6fb5", "#6fb0ee"),
    ("radius-1", "#4f8bc6", "#568fcb"),
    ("radius-2", "#78a8d6", "#4274a8"),
    ("radius-3", "#a0c4e4", "#335b85"),
    ("radius-4", "#c5dcf0", "#284664"),
    ("radius-5", "#e4eef8", "#1f3347"),
    ("radius-6", "#fbe0cf", "#48291d"),
    ("radius-7", "#f4b48f", "#6f3a24"),
    ("radius-8", "#e48256", "#a14f2c"),
    ("radius-9", "#c4502c", "#dd7243"),
];

pub fn variables() -> String {
    let list = |value: fn(&(&str, &'static str, &'static str)) -> &'static str| {
        VALUES.iter().map(|colour| ["--", colour.0, ":", value(colour), ";"].concat()).collect::<String>()
    };
    format!(
        ":root{{{}color-scheme:light dark}}@media screen and (prefers-color-scheme:dark){{:root{{{}}}}}",
        list(|colour| colour.1),
        list(|colour| colour.2)
    )
}

/// Rules for the classes that occur in `body`, with values in place of variables.
fn document_style(body: &str) -> String {
    let is_needed = |rule: &&str| {
        let class = rule.strip_prefix('.').and_then(|rule| rule.split_whitespace().next());
        class.is_none_or(|class| body.contains(&format!("class=\"{class}\"")))
    };
    let needed: String = RULES.lines().filter(is_needed).collect::<Vec<_>>().join("\n");
    let resolve = |value: fn(&(&str, &'static str, &'static str)) -> &'static str| {
        VALUES
            .iter()
            .fold(needed.clone(), |rules, colour| rules.replace(&format!("var(--{})", colour.0), value(colour)))
    };
    let (light, dark) = (resolve(|colour| colour.1), resolve(|colour| colour.2));
    format!("svg{{color-scheme:light dark}}\n{light}\n@media screen and (prefers-color-scheme:dark){{\n{dark}\n}}")
}

#[cfg(test)]
mod tests {
    use super::*;
    use rstest::rstest;
    use strum::IntoEnumIterator as _;

    #[rstest]
    #[case(&[(264, 1023), (295, 1023), (295, 187), (290, 190)], "m264 1023l31 0 0-836-5 3")]
    #[case(&[(7, 8)], "m7 8")]
    #[case(&[], "")]
    fn points_become_differences(#[case] points: &[(i64, i64)], #[case] expected: &str) {
        assert_eq!(path_data(points.iter().copied()), expected);
    }

    #[test]
    fn decades_surround_the_positive_values() {
        assert_eq!(decades([0.0, 3e-3, f64::INFINITY, 20.0].into_iter()), 1e-3..100.0);
        assert_eq!(decades([1.0].into_iter()), 1.0..10.0);
        assert_eq!(decades([f64::NAN].into_iter()), 0.1..10.0);
    }

    #[rstest]
    #[case(1e-12, "10⁻¹²")]
    #[case(1e5, "10⁵")]
    #[case(0.999, "10⁰")]
    fn writes_powers_of_ten(#[case] value: f64, #[case] expected: &str) {
        assert_eq!(format_power_of_ten(value), expected);
    }

    #[rstest]
    #[case(0.0..10.0, 7, &[0.0, 2.0, 4.0, 6.0, 8.0, 10.0])]
    #[case(0.0..1.0, 6, &[0.0, 0.2, 0.4, 0.6, 0.8, 1.0])]
    #[case(-0.7..33.0, 6, &[0.0, 10.0, 20.0, 30.0])]
    #[case(32_306.9..32_308.2, 6, &[32_307.0, 32_307.5, 32_308.0])]
    fn linear_ticks_are_round(#[case] values: Range<f64>, #[case] most: usize, #[case] expected: &[f64]) {
        let found = Axis::linear(values, 0.0..1.0).ticks(most);
        assert_eq!(found.len(), expected.len(), "{found:?}");
        assert!(found.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-9), "{found:?}");
    }

    fn logarithmic(values: Range<f64>, pixels: Range<f64>) -> Axis {
        Axis { scale: Scale::Logarithmic, values, pixels }
    }

    #[test]
    fn logarithmic_ticks_are_decades() {
        assert_eq!(logarithmic(1e-2..1e2, 0.0..1.0).ticks(9), [1e-2, 1e-1, 1.0, 1e1, 1e2]);
        assert_eq!(logarithmic(1.0..1e4, 0.0..1.0).ticks(3), [1.0, 1e2, 1e4]);
    }

    #[test]
    fn an_axis_ends_at_its_range() {
        let axis = logarithmic(1.0..100.0, 10.0..30.0);
        assert_eq!(
            [0.0, 0.1, 1.0, 10.0, 100.0, 1e9].map(|value| axis.pixel(value)),
            [10.0, 10.0, 10.0, 20.0, 30.0, 30.0]
        );
        let axis = Axis::linear(0.0..4.0, 100.0..0.0);
        assert_eq!([f64::NEG_INFINITY, 1.0, f64::INFINITY].map(|value| axis.pixel(value)), [100.0, 75.0, 0.0]);
    }

    /// Roles that only the page's script draws need no rule.
    #[test]
    fn every_role_has_its_own_class() {
        let numbered = (0..COLOURS).flat_map(|number| [Role::Series(number), Role::Radius(number)]);
        for role in Role::iter().chain(numbered) {
            let name = role.name();
            let styled = [format!(".s-{name} "), format!(".f-{name} ")].iter().any(|rule| RULES.contains(rule));
            assert!(styled || role == Role::Trial, "{name}");
        }
    }

    #[rstest]
    #[case::free(&[], &[], 12.0)]
    #[case::a_line_above(&[[(0.0, 88.0), (200.0, 88.0)]], &[], -12.0)]
    #[case::lines_on_both_sides(&[[(0.0, 88.0), (200.0, 88.0)], [(70.0, 0.0), (70.0, 200.0)]], &[], -12.0)]
    #[case::a_line_elsewhere(&[[(0.0, 88.0), (50.0, 88.0)], [(0.0, 0.0), (200.0, 20.0)]], &[], 12.0)]
    #[case::a_text_above(&[], &[[(60.0, 80.0), (90.0, 94.0)]], -12.0)]
    #[case::text_and_line(&[[(0.0, 110.0), (200.0, 110.0)]], &[[(60.0, 80.0), (90.0, 94.0)]], -26.0)]
    fn the_text_of_a_worst_value_is_at_a_free_place(
        #[case] segments: &[[Point; 2]],
        #[case] texts: &[[Point; 2]],
        #[case] expected: f64,
    ) {
        let axes = Axes { x: Axis::linear(0.0..1.0, 0.0..200.0), y: Axis::linear(0.0..1.0, 200.0..0.0) };
        let drawing = Drawing { segments: segments.to_vec(), texts: texts.to_vec(), ..Drawing::default() };
        assert_eq!(drawing.free_rise(&axes, (50.0, 100.0), "0.4 µm"), expected);
        let low = Drawing::default().free_rise(&axes, (50.0, 5.0), "0.4 µm");
        assert_eq!(low, -12.0, "the text is inside the plot");
    }

    #[test]
    fn a_document_has_classes_and_the_rules_of_its_classes() {
        let mut drawing = Drawing::default();
        drawing.text(Role::Title, TextEnd::Left, (2.0, 10.0), "1 < 2");
        drawing.line(Role::Series(11), [(0.0, 0.0), (40.0, 20.0)]);
        drawing.shape(Role::Series(1), Shape::Ring, (20.0, 10.0), 2.5);
        drawing.shape(Role::Shape, Shape::Disc, (20.0, 10.0), 2.5);
        insta::assert_snapshot!(drawing.into_document("a < b", (40.0, 20.0)).replace("><", ">\n<"));
    }
}
