//! Curves to SVG.
//!
//! Plotters draws; a drawing has no colours of its own, only classes that the page's style sheet paints, so that it
//! serves light, dark and paper. Neighbours: `figure` says what is drawn. Nothing here knows a metric.

use super::curves::{Point, Window};
use crate::error::ReportError;
use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, Pos, VPos};
use std::error::Error;

/// Units of the drawing per CSS pixel at natural size: plotters puts points on whole numbers only.
const FINE: u32 = 4;
/// Width and height of every drawing.
pub(crate) const SIZE: (u32, u32) = (560 * FINE, 306 * FINE);

/// Where the text of the first mark stands, in parts of the drawing's height, and how far above it the next one's.
const LOWEST_TEXT: f64 = 0.12;
const TEXT_HEIGHT: f64 = 0.1;

/// A role in a drawing. The style sheet gives it a colour.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Ink {
    Text,
    Grid,
    Axis,
    First,
    Second,
    Exhibit,
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
}

impl Ink {
    const ALL: [Self; 21] = [
        Self::Text,
        Self::Grid,
        Self::Axis,
        Self::First,
        Self::Second,
        Self::Exhibit,
        Self::Other,
        Self::Setpoint,
        Self::Band,
        Self::Spread,
        Self::SecondSpread,
        Self::Saturated,
        Self::Settling,
        Self::Deadline,
        Self::Golden,
        Self::Tube,
        Self::Trial,
        Self::Median,
        Self::Resonance,
        Self::Overrun,
        Self::Lost,
    ];

    /// The class, with `s-` before it for a stroke and `f-` for a filling.
    pub(crate) const fn name(self) -> &'static str {
        match self {
            Self::Text => "text",
            Self::Grid => "grid",
            Self::Axis => "axis",
            Self::First => "first",
            Self::Second => "second",
            Self::Exhibit => "exhibit",
            Self::Other => "other",
            Self::Setpoint => "setpoint",
            Self::Band => "band",
            Self::Spread => "spread",
            Self::SecondSpread => "second-spread",
            Self::Saturated => "saturated",
            Self::Settling => "settling",
            Self::Deadline => "deadline",
            Self::Golden => "golden",
            Self::Tube => "tube",
            Self::Trial => "trial",
            Self::Median => "median",
            Self::Resonance => "resonance",
            Self::Overrun => "overrun",
            Self::Lost => "lost",
        }
    }

    /// A colour that stands for the role until the drawing is done.
    const fn colour(self) -> RGBColor {
        RGBColor(1, 2, self as u8)
    }
}

/// A line at an instant, and what stands beside it.
#[derive(Debug, Clone)]
pub(crate) struct Mark {
    pub(crate) ink: Ink,
    pub(crate) at_ms: f64,
    pub(crate) text: Option<String>,
}

/// What is drawn, from the back to the front.
#[derive(Debug, Clone)]
pub(crate) struct Chart {
    pub(crate) window: Window,
    /// Lowest and highest value of the vertical axis.
    pub(crate) range: (f64, f64),
    pub(crate) unit: &'static str,
    pub(crate) spans: Vec<(Ink, Window)>,
    /// Upper and lower edge, both from left to right.
    pub(crate) areas: Vec<(Ink, [Vec<Point>; 2])>,
    pub(crate) lines: Vec<(Ink, Vec<Point>)>,
    pub(crate) marks: Vec<Mark>,
}

impl Chart {
    /// The elements of the drawing, to stand in an `svg` element of [`SIZE`].
    pub(crate) fn draw(&self, title: &str) -> Result<String, ReportError> {
        let mut svg = String::new();
        self.draw_into(&mut svg).map_err(|source| ReportError::Plot { title: title.to_owned(), source })?;
        Ok(classed(&svg))
    }

    fn draw_into(&self, svg: &mut String) -> Result<(), Box<dyn Error + Send + Sync>> {
        let (low, high) = self.range;
        let root = SVGBackend::with_string(svg, SIZE).into_drawing_area();
        let mut chart = ChartBuilder::on(&root)
            .margin_top(30 * FINE)
            .margin_right(14 * FINE)
            .set_label_area_size(LabelAreaPosition::Left, 66 * FINE)
            .set_label_area_size(LabelAreaPosition::Bottom, 50 * FINE)
            .build_cartesian_2d(self.window.from_ms..self.window.to_ms, low..high)?;
        for (ink, span) in &self.spans {
            chart.draw_series([Rectangle::new([(span.from_ms, low), (span.to_ms, high)], ink.colour().filled())])?;
        }
        let (x_decimals, y_decimals) = (decimals(self.window.span_ms()), decimals(high - low));
        chart
            .configure_mesh()
            .disable_x_mesh()
            .x_labels(7)
            .y_labels(6)
            .x_label_formatter(&|value| tick(*value, x_decimals))
            .y_label_formatter(&|value| tick(*value, y_decimals))
            .label_style(text(Ink::Text, HPos::Center, VPos::Center))
            .axis_style(Ink::Axis.colour())
            .bold_line_style(Ink::Grid.colour())
            .light_line_style(TRANSPARENT)
            .set_all_tick_mark_size(4 * FINE)
            .draw()?;
        for (ink, [upper, lower]) in &self.areas {
            let outline: Vec<Point> = upper.iter().chain(lower.iter().rev()).copied().collect();
            chart.draw_series([Polygon::new(outline, ink.colour().filled())])?;
        }
        for (ink, points) in &self.lines {
            chart.draw_series([PathElement::new(points.clone(), ink.colour())])?;
        }
        let height = high - low;
        let mut share = LOWEST_TEXT;
        for mark in &self.marks {
            chart.draw_series([PathElement::new([(mark.at_ms, low), (mark.at_ms, high)], mark.ink.colour())])?;
            let Some(words) = &mark.text else { continue };
            // Below a settled response there is room; towards the right end there is none.
            let is_left = mark.at_ms - self.window.from_ms < 0.55 * self.window.span_ms();
            let (side, shift) = if is_left { (HPos::Left, 1.0) } else { (HPos::Right, -1.0) };
            let place = (mark.at_ms + shift * 0.012 * self.window.span_ms(), low + share * height);
            share += TEXT_HEIGHT;
            chart.draw_series([Text::new(words.clone(), place, text(mark.ink, side, VPos::Center))])?;
        }
        drop(chart);
        let (width, height) = (i32::try_from(SIZE.0)?, i32::try_from(SIZE.1)?);
        let fine = i32::try_from(FINE)?;
        root.draw_text(self.unit, &text(Ink::Text, HPos::Right, VPos::Center), (58 * fine, 14 * fine))?;
        root.draw_text(
            "time, ms",
            &text(Ink::Text, HPos::Right, VPos::Bottom),
            (width - 14 * fine, height - 2 * fine),
        )?;
        root.present()?;
        Ok(())
    }
}

fn text(ink: Ink, side: HPos, height: VPos) -> TextStyle<'static> {
    let font = ("sans-serif", f64::from(13 * FINE)).into_font();
    let style = TextStyle::from(font).pos(Pos::new(side, height));
    TextStyle { color: ink.colour().to_backend_color(), ..style }
}

/// Decimals that tell the ticks of a range apart.
fn decimals(span: f64) -> usize {
    let step = span / 8.0;
    if step > 0.0 { (-step.log10().floor()).clamp(0.0, 9.0) as usize } else { 0 }
}

fn tick(value: f64, decimals: usize) -> String {
    let text = format!("{value:.decimals$}");
    let text = if text.contains('.') { text.trim_end_matches('0').trim_end_matches('.') } else { &text };
    if text == "-0" { "0".to_owned() } else { text.replace('-', "−") }
}

/// The drawing without its outer element, with classes instead of colours, and in few characters.
fn classed(svg: &str) -> String {
    let body = svg.split_once('>').map_or(svg, |(_, rest)| rest).trim_end().trim_end_matches("</svg>");
    let mut body = body.replace("opacity=\"1\" ", "").replace("stroke-width=\"1\" ", "").replace(" \"/>", "\"/>");
    for ink in Ink::ALL {
        let RGBColor(red, green, blue) = ink.colour();
        for (attribute, prefix) in [("stroke", 's'), ("fill", 'f')] {
            let colour = format!("{attribute}=\"#{red:02X}{green:02X}{blue:02X}\"");
            body = body.replace(&colour, &format!("class=\"{prefix}-{}\"", ink.name()));
        }
    }
    body.lines().map(|line| short(line.trim())).collect()
}

/// An element of a drawing: lines and areas as paths of differences, texts without the font that the style sheet gives them.
fn short(element: &str) -> String {
    let outline = element.strip_prefix("<polyline fill=\"none\" ").or_else(|| element.strip_prefix("<polygon "));
    if let Some((before, points)) = outline.and_then(|outline| outline.split_once("points=\""))
        && let Some((points, _)) = points.split_once('"')
    {
        return format!("<path {before}d=\"{}\"/>", differences(points));
    }
    match element.split_once(" font-family=").and_then(|(before, rest)| Some((before, rest.split_once(" class=")?.1))) {
        Some((before, rest)) => format!("{before} class={rest}"),
        None => element.to_owned(),
    }
}

/// `x,y x,y` as the data of a path.
fn differences(points: &str) -> String {
    let mut before = (0, 0);
    let mut data = String::new();
    let pairs = points.split_whitespace().filter_map(|pair| {
        let (x, y) = pair.split_once(',')?;
        Some((x.parse::<i64>().ok()?, y.parse::<i64>().ok()?))
    });
    for (number, (x, y)) in pairs.enumerate() {
        let step = (x - before.0, y - before.1);
        match number {
            0 => data.push('m'),
            1 => data.push('l'),
            _ if step.0 < 0 => {}
            _ => data.push(' '),
        }
        data.push_str(&step.0.to_string());
        if step.1 >= 0 {
            data.push(' ');
        }
        data.push_str(&step.1.to_string());
        before = (x, y);
    }
    data
}

#[cfg(test)]
mod tests {
    use super::*;
    use rstest::rstest;

    #[rstest]
    #[case(0.5, 60.0, "0.5")]
    #[case(-20.0, 400.0, "−20")]
    #[case(-1e-12, 2.0, "0")]
    #[case(32_307.5, 3.0, "32307.5")]
    fn ticks_are_short(#[case] value: f64, #[case] span: f64, #[case] expected: &str) {
        assert_eq!(tick(value, decimals(span).max(1)), expected);
    }

    #[rstest]
    #[case("264,1023 295,1023 295,187 290,190", "m264 1023l31 0 0-836-5 3")]
    #[case("7,8", "m7 8")]
    #[case("", "")]
    fn points_become_differences(#[case] points: &str, #[case] expected: &str) {
        assert_eq!(differences(points), expected);
    }

    #[test]
    fn no_colour_is_left_in_a_drawing() {
        let chart = Chart {
            window: Window { from_ms: 0.0, to_ms: 10.0 },
            range: (0.0, 1.0),
            unit: "µm",
            spans: vec![(Ink::Saturated, Window { from_ms: 1.0, to_ms: 2.0 })],
            areas: vec![(Ink::Band, [vec![(0.0, 1.0), (1.0, 1.0)], vec![(0.0, 0.5), (1.0, 0.5)]])],
            lines: vec![(Ink::First, vec![(0.0, 0.0), (10.0, 1.0)])],
            marks: vec![Mark { ink: Ink::Settling, at_ms: 9.0, text: Some("settled".to_owned()) }],
        };
        let svg = chart.draw("test").unwrap();
        assert!(!svg.contains('#') && !svg.contains("<svg") && !svg.contains("</svg"), "{svg}");
        for class in ["f-saturated", "f-band", "s-first", "s-settling", "f-settling", "s-grid", "s-axis", "f-text"] {
            assert!(svg.contains(class), "{class}: {svg}");
        }
    }
}
