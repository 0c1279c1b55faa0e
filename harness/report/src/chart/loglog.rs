//! A log-log drawing that stands alone: its own colours for light and dark, its own legend.

use crate::error::ReportError;
use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, Pos, VPos};
use std::error::Error;
use std::fmt::Write as _;
use std::ops::Range;

/// Units of the drawing per CSS pixel at natural size: plotters puts points on whole numbers only.
const FINE: i32 = 4;
const SIZE: (i32, i32) = (720 * FINE, 430 * FINE);
/// Room on the right for the legend.
const LEGEND: i32 = 236 * FINE;
/// So many labels stand beside each other without touching.
const MOST_LABELS: usize = 9;
/// Colours of series, for light and for dark, from Okabe and Ito's palette for the colour-blind, darkened and lightened.
const COLOURS: [(&str, &str); 10] = [
    ("#111418", "#f4f6f8"),
    ("#b34a00", "#ff9b52"),
    ("#1f6cb0", "#6db3f2"),
    ("#0b7a5a", "#4fd0a5"),
    ("#8a3f8f", "#dd93e0"),
    ("#8a6d00", "#e8c63c"),
    ("#a3243b", "#ff8594"),
    ("#2a6f7f", "#79c9dc"),
    ("#5c5c5c", "#b5b5b5"),
    ("#4b4fb5", "#a3a7ff"),
];
const STYLE: &str = "\
svg{color-scheme:light dark;background:#fff}
text{font:48px system-ui,'Segoe UI',Roboto,'DejaVu Sans',sans-serif;fill:#4a525b}
.t{font-weight:600;fill:#111418}
.g{stroke:#e4e5e2}.a{stroke:#7b848d}.m{stroke:#7b848d;stroke-dasharray:24 16}
.g,.a,.m{fill:none;stroke-width:4}
.l{fill:none;stroke-width:8;stroke-linejoin:round}
@media screen and (prefers-color-scheme:dark){svg{background:#1a1e23}text{fill:#a7b0ba}.t{fill:#f4f6f8}.g{stroke:#2e343b}.a,.m{stroke:#8b949e}}
";

/// One method's line.
#[derive(Debug, Clone, PartialEq)]
pub struct Series {
    /// Its name in the legend.
    pub name: String,
    /// x and y of each setting, both above zero, in the order in which they are joined.
    pub points: Vec<(f64, f64)>,
    /// y of settings without a result: crosses at the right edge.
    pub failed: Vec<f64>,
    /// True for a thicker line and larger points.
    pub is_ours: bool,
}

/// A drawing.
#[derive(Debug, Clone, PartialEq)]
pub struct LogLog {
    /// What it shows.
    pub title: String,
    /// What stands below, with its unit.
    pub x_label: String,
    /// What stands at the left, with its unit.
    pub y_label: String,
    /// Lines, the first in front.
    pub series: Vec<Series>,
    /// A dashed line at an x, with its word.
    pub mark: Option<(f64, String)>,
    /// What the crosses at the right edge mean.
    pub failed_label: String,
}

type Area<'a> = DrawingArea<SVGBackend<'a>, plotters::coord::Shift>;
type Drawn<T> = Result<T, Box<dyn Error + Send + Sync>>;

impl LogLog {
    /// The drawing as an SVG document.
    ///
    /// # Errors
    /// [`ReportError::Plot`] where it cannot be drawn.
    pub fn svg(&self) -> Result<String, ReportError> {
        let mut svg = String::new();
        self.draw(&mut svg).map_err(|source| ReportError::Plot { title: self.title.clone(), source })?;
        Ok(self.classed(&svg))
    }

    fn draw(&self, svg: &mut String) -> Drawn<()> {
        let (width, height) = (u32::try_from(SIZE.0)?, u32::try_from(SIZE.1)?);
        let root = SVGBackend::with_string(svg, (width, height)).into_drawing_area();
        let marked = self.mark.iter().map(|(x, _)| *x);
        let xs = decades(self.series.iter().flat_map(|series| series.points.iter().map(|point| point.0)).chain(marked));
        let costs = |series: &Series| {
            series.points.iter().map(|point| point.1).chain(series.failed.clone()).collect::<Vec<_>>()
        };
        let ys = decades(self.series.iter().flat_map(costs));
        // A decade at the right for what has no error that could be told.
        let has_failed = self.series.iter().any(|series| !series.failed.is_empty());
        let edge = xs.end * 10.0_f64.sqrt();
        let right = if has_failed { xs.end * 10.0 } else { xs.end };
        let mut chart = ChartBuilder::on(&root)
            .margin_top(u32::try_from(60 * FINE)?)
            .margin_right(u32::try_from(LEGEND)?)
            .set_label_area_size(LabelAreaPosition::Left, u32::try_from(70 * FINE)?)
            .set_label_area_size(LabelAreaPosition::Bottom, u32::try_from(56 * FINE)?)
            .build_cartesian_2d((xs.start..right).log_scale(), (ys.start..ys.end).log_scale())?;
        let many = |range: &Range<f64>| ((range.end / range.start).log10().round() as usize + 1).min(MOST_LABELS);
        chart
            .configure_mesh()
            .x_labels(many(&(xs.start..right)))
            .y_labels(many(&ys))
            .x_label_formatter(&|value| if *value > xs.end * 1.01 { String::new() } else { power(*value) })
            .y_label_formatter(&|value| power(*value))
            .label_style(text(Role::Text, HPos::Center))
            .axis_style(Role::Axis.colour())
            .bold_line_style(Role::Grid.colour())
            .light_line_style(TRANSPARENT)
            .set_all_tick_mark_size(u32::try_from(4 * FINE)?)
            .draw()?;
        if let Some((x, _)) = &self.mark {
            chart.draw_series([PathElement::new([(*x, ys.start), (*x, ys.end)], Role::Mark.colour())])?;
        }
        for (number, series) in self.series.iter().enumerate().rev() {
            let colour = Role::Series(number).colour();
            let radius = if series.is_ours { 7 * FINE } else { 4 * FINE };
            chart.draw_series([PathElement::new(series.points.clone(), colour)])?;
            chart.draw_series(series.points.iter().map(|point| Circle::new(*point, radius, colour.filled())))?;
            chart.draw_series(series.failed.iter().map(|y| Cross::new((edge, *y), 5 * FINE, colour)))?;
        }
        drop(chart);
        self.words(&root, has_failed)?;
        root.present()?;
        Ok(())
    }

    fn words(&self, root: &Area<'_>, has_failed: bool) -> Drawn<()> {
        let at = |x: i32, y: i32| (x * FINE, y * FINE);
        let left = SIZE.0 / FINE - LEGEND / FINE + 18;
        root.draw_text(&self.title, &text(Role::Title, HPos::Left), at(14, 20))?;
        root.draw_text(&self.y_label, &text(Role::Text, HPos::Left), at(14, 44))?;
        root.draw_text(&self.x_label, &text(Role::Text, HPos::Right), (SIZE.0 - LEGEND, SIZE.1 - 10 * FINE))?;
        let mut y = 72;
        for (number, series) in self.series.iter().enumerate() {
            let colour = Role::Series(number).colour();
            root.draw(&PathElement::new([at(left, y), at(left + 22, y)], colour))?;
            let radius = if series.is_ours { 6 * FINE } else { 4 * FINE };
            root.draw(&Circle::new(at(left + 11, y), radius, colour.filled()))?;
            root.draw_text(&series.name, &text(Role::Text, HPos::Left), at(left + 30, y))?;
            y += 24;
        }
        if has_failed {
            root.draw(&Cross::new(at(left + 11, y), 5 * FINE, Role::Axis.colour()))?;
            root.draw_text(&self.failed_label, &text(Role::Text, HPos::Left), at(left + 30, y))?;
            y += 24;
        }
        if let Some((_, word)) = &self.mark {
            root.draw(&PathElement::new([at(left, y), at(left + 22, y)], Role::Mark.colour()))?;
            root.draw_text(word, &text(Role::Text, HPos::Left), at(left + 30, y))?;
        }
        Ok(())
    }

    /// The document with a style sheet of its own and classes instead of colours.
    fn classed(&self, svg: &str) -> String {
        let body = svg.split_once('>').map_or(svg, |(_, rest)| rest);
        let mut body = body.replace("opacity=\"1\" ", "").replace("stroke-width=\"1\" ", "").replace(" \"/>", "\"/>");
        let mut style = STYLE.to_owned();
        let roles = [(Role::Text, ""), (Role::Title, "t"), (Role::Grid, "g"), (Role::Axis, "a"), (Role::Mark, "m")];
        let mut classes: Vec<(Role, String)> = roles.map(|(role, class)| (role, class.to_owned())).into();
        let mut dark = String::new();
        for number in 0..self.series.len() {
            let (light, at_night) = COLOURS[number % COLOURS.len()];
            // Writing into a string does not fail.
            let _ = write!(style, ".s{number}{{stroke:{light}}}.f{number}{{fill:{light}}}");
            let _ = write!(dark, ".s{number}{{stroke:{at_night}}}.f{number}{{fill:{at_night}}}");
            classes.push((Role::Series(number), number.to_string()));
        }
        let _ = write!(style, "@media screen and (prefers-color-scheme:dark){{{dark}}}");
        for (role, class) in classes {
            let RGBColor(red, green, blue) = role.colour();
            let colour = format!("#{red:02X}{green:02X}{blue:02X}");
            let (stroke, fill) = match role {
                Role::Series(_) => (format!("class=\"l s{class}\""), format!("class=\"f{class}\"")),
                Role::Text | Role::Title | Role::Grid | Role::Axis | Role::Mark => {
                    (format!("class=\"{class}\""), format!("class=\"{class}\""))
                }
            };
            body = body.replace(&format!("stroke=\"{colour}\""), &stroke).replace(&format!("fill=\"{colour}\""), &fill);
        }
        let (width, height) = SIZE;
        format!(
            "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {width} {height}\" width=\"{}\" height=\"{}\" role=\"img\" aria-label=\"{}\">\n<style>{style}</style>{body}",
            width / FINE,
            height / FINE,
            self.title.replace('&', "&amp;").replace('"', "&quot;").replace('<', "&lt;")
        )
    }
}

/// What an element is; it has a colour of its own until the drawing is done.
#[derive(Debug, Clone, Copy)]
enum Role {
    Text,
    Title,
    Grid,
    Axis,
    Mark,
    Series(usize),
}

impl Role {
    const fn colour(self) -> RGBColor {
        RGBColor(
            1,
            2,
            match self {
                Self::Text => 0,
                Self::Title => 1,
                Self::Grid => 2,
                Self::Axis => 3,
                Self::Mark => 4,
                Self::Series(number) => 5 + number as u8,
            },
        )
    }
}

fn text(role: Role, side: HPos) -> TextStyle<'static> {
    let font = ("sans-serif", f64::from(12 * FINE)).into_font();
    let style = TextStyle::from(font).pos(Pos::new(side, VPos::Center));
    TextStyle { color: role.colour().to_backend_color(), ..style }
}

/// The whole decades around what can be drawn on a logarithmic axis.
fn decades(values: impl Iterator<Item = f64>) -> Range<f64> {
    let drawn = values.filter(|value| value.is_finite() && *value > 0.0);
    let (low, high) = drawn.fold((f64::INFINITY, 0.0_f64), |(low, high), value| (low.min(value), high.max(value)));
    if low > high {
        return 0.1..10.0;
    }
    let (from, to) = (low.log10().floor(), high.log10().ceil());
    10.0_f64.powf(from)..10.0_f64.powf(to.max(from + 1.0))
}

/// 10ⁿ.
fn power(value: f64) -> String {
    // Through a whole number: there is no −0.
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

#[cfg(test)]
mod tests {
    use super::*;

    fn chart() -> LogLog {
        LogLog {
            title: "a < b".to_owned(),
            x_label: "error".to_owned(),
            y_label: "cost".to_owned(),
            series: vec![
                Series {
                    name: "one".to_owned(),
                    points: vec![(1e-9, 30.0), (1e-3, 2.0)],
                    failed: vec![],
                    is_ours: true,
                },
                Series { name: "two".to_owned(), points: vec![], failed: vec![5.0], is_ours: false },
            ],
            mark: Some((1e-6, "here".to_owned())),
            failed_label: "without a result".to_owned(),
        }
    }

    #[test]
    fn every_element_has_a_class_and_every_class_its_colours() {
        let svg = chart().svg().unwrap();
        let (style, body) = svg.split_once("</style>").unwrap();
        assert!(!body.contains("=\"#"), "{body}");
        for class in ["l s0", "f0", "l s1", "g", "a", "m", "t"] {
            assert!(body.contains(&format!("class=\"{class}\"")), "{class}: {body}");
        }
        assert!(style.contains("prefers-color-scheme:dark") && style.contains("aria-label=\"a &lt; b\""), "{style}");
        assert!(body.contains("without a result") && body.contains("here"));
    }

    #[test]
    fn a_chart_without_points_is_still_a_chart() {
        let chart = LogLog { series: Vec::new(), mark: None, ..chart() };
        assert!(!chart.svg().unwrap().contains("without a result"));
    }

    #[test]
    fn decades_surround_what_can_be_drawn() {
        assert_eq!(decades([0.0, 3e-3, f64::INFINITY, 20.0].into_iter()), 1e-3..100.0);
        assert_eq!(decades([1.0].into_iter()), 1.0..10.0);
        assert_eq!(decades([f64::NAN].into_iter()), 0.1..10.0);
        assert_eq!(power(1e-12), "10⁻¹²");
        assert_eq!(power(1e5), "10⁵");
        assert_eq!(power(0.999), "10⁰");
    }
}
