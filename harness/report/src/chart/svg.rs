//! Draws with plotters and writes SVG with classes instead of colours. Plotters supports only
//! colours, so each [`Role`] has a code colour, which is replaced by the class of the role in the
//! finished SVG.

use super::colours;
use crate::error::ReportError;
use plotters::coord::Shift;
use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, Pos, VPos};
use std::error::Error;
use std::ops::Range;
use strum::IntoEnumIterator as _;

/// Plotters rounds positions to whole units, so a unit is smaller than a pixel.
pub(crate) const UNITS_PER_PIXEL: i32 = 4;

pub(crate) type DrawArea<'a> = DrawingArea<SVGBackend<'a>, Shift>;
pub(crate) type DrawResult = Result<(), Box<dyn Error + Send + Sync>>;

/// Meaning of an element. The style sheet gives it colour, width and dashes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, strum::EnumIter, strum::IntoStaticStr)]
#[strum(serialize_all = "kebab-case")]
pub(crate) enum Role {
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
    Series(usize),
    Radius(usize),
}

/// Number of colours. Higher numbers of series and radii begin again with the first colour.
pub(crate) const COLOURS: usize = 10;

impl Role {
    /// Name of the class without its prefix, which is `s-` for a stroke and `f-` for a filling.
    pub(crate) fn name(self) -> String {
        match self {
            Self::Series(number) => format!("series-{}", number % COLOURS),
            Self::Radius(number) => format!("radius-{}", number % COLOURS),
            named => <&str>::from(named).to_owned(),
        }
    }

    pub(crate) fn colour(self) -> RGBColor {
        match self {
            Self::Series(number) => RGBColor(1, 1, (number % COLOURS) as u8),
            Self::Radius(number) => RGBColor(1, 2, (number % COLOURS) as u8),
            named => RGBColor(1, 0, Self::iter().position(|role| role == named).unwrap_or(0) as u8),
        }
    }

    /// `code` contains green and blue of a code colour, four hexadecimal digits.
    fn from_code(code: &str) -> Option<Self> {
        let number = usize::from_str_radix(code.get(2..4)?, 16).ok()?;
        match code.get(..2)? {
            "01" => Some(Self::Series(number)),
            "02" => Some(Self::Radius(number)),
            _ => Self::iter().nth(number),
        }
    }
}

/// Draws on an area in CSS pixels. Returns the content of an `svg` element with its [`view_box`].
pub(crate) fn svg_elements(
    title: &str,
    (width, height): (i32, i32),
    draw: impl FnOnce(&DrawArea<'_>) -> DrawResult,
) -> Result<String, ReportError> {
    let mut svg = String::new();
    let drawn = || {
        let size = (u32::try_from(width * UNITS_PER_PIXEL)?, u32::try_from(height * UNITS_PER_PIXEL)?);
        let root = SVGBackend::with_string(&mut svg, size).into_drawing_area();
        draw(&root)?;
        root.present()?;
        Ok(())
    };
    drawn().map_err(|source| ReportError::Plot { title: title.to_owned(), source })?;
    Ok(compact_elements(&svg))
}

/// Like [`svg_elements`], but returns a file with a background and the styles for light and dark.
pub(crate) fn svg_document(
    title: &str,
    size: (i32, i32),
    draw: impl FnOnce(&DrawArea<'_>) -> DrawResult,
) -> Result<String, ReportError> {
    let body = format!(r#"<rect class="f-card" width="100%" height="100%"/>{}"#, svg_elements(title, size, draw)?);
    let (width, height) = size;
    Ok(format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" role=\"img\" width=\"{width}\" height=\"{height}\" viewBox=\"{}\">\n\
         <title>{}</title>\n<style>{}</style>\n{body}\n</svg>\n",
        view_box(size),
        title.replace('&', "&amp;").replace('<', "&lt;"),
        colours::document_style(&body),
    ))
}

pub(crate) fn view_box((width, height): (i32, i32)) -> String {
    format!("0 0 {} {}", width * UNITS_PER_PIXEL, height * UNITS_PER_PIXEL)
}

/// Positions are in CSS pixels from the upper left corner of the area.
pub(crate) struct Canvas<'a, 'b>(pub(crate) &'a DrawArea<'b>);

impl Canvas<'_, '_> {
    pub(crate) fn text(&self, role: Role, side: HPos, at: (i32, i32), text: &str) -> DrawResult {
        Ok(self.0.draw_text(text, &text_style(role, side), units(at))?)
    }

    pub(crate) fn line(&self, role: Role, ends: [(i32, i32); 2]) -> DrawResult {
        Ok(self.0.draw(&PathElement::new(ends.map(units), role.colour()))?)
    }

    pub(crate) fn rectangle(&self, role: Role, corners: [(i32, i32); 2]) -> DrawResult {
        Ok(self.0.draw(&Rectangle::new(corners.map(units), role.colour().filled()))?)
    }

    pub(crate) fn circle(&self, role: Role, at: (i32, i32), radius: f64) -> DrawResult {
        Ok(self.0.draw(&Circle::new(units(at), length(radius), role.colour().filled()))?)
    }

    pub(crate) fn ring(&self, role: Role, at: (i32, i32), radius: f64) -> DrawResult {
        Ok(self.0.draw(&Circle::new(units(at), length(radius), role.colour()))?)
    }

    pub(crate) fn cross(&self, role: Role, at: (i32, i32), radius: f64) -> DrawResult {
        Ok(self.0.draw(&Cross::new(units(at), length(radius), role.colour()))?)
    }
}

pub(crate) fn length(pixels: f64) -> i32 {
    (pixels * f64::from(UNITS_PER_PIXEL)).round() as i32
}

fn units((x, y): (i32, i32)) -> (i32, i32) {
    (x * UNITS_PER_PIXEL, y * UNITS_PER_PIXEL)
}

/// Text of 12 px, centred vertically. `side` is the end of the text that lies at its position.
pub(crate) fn text_style(role: Role, side: HPos) -> TextStyle<'static> {
    let font = ("sans-serif", f64::from(12 * UNITS_PER_PIXEL)).into_font();
    let style = TextStyle::from(font).pos(Pos::new(side, VPos::Center));
    TextStyle { color: role.colour().to_backend_color(), ..style }
}

/// A chart with more items is not drawn to scale.
const MAX_COUNT: i32 = 20_000;

pub(crate) fn count_factor(count: usize) -> i32 {
    i32::try_from(count).map_or(MAX_COUNT, |count| count.min(MAX_COUNT))
}

pub(crate) fn extent(values: impl Iterator<Item = f64>) -> Option<(f64, f64)> {
    values.map(|value| (value, value)).reduce(|(low, high), (value, _)| (low.min(value), high.max(value)))
}

pub(crate) fn logarithmic_extent(values: impl Iterator<Item = f64>) -> Option<(f64, f64)> {
    extent(values.filter(|value| value.is_finite() && *value > 0.0))
}

pub(crate) fn decades(values: impl Iterator<Item = f64>) -> Range<f64> {
    let Some((low, high)) = logarithmic_extent(values) else { return 0.1..10.0 };
    let (from, to) = (low.log10().floor(), high.log10().ceil());
    10.0_f64.powf(from)..10.0_f64.powf(to.max(from + 1.0))
}

pub(crate) fn format_power_of_ten(value: f64) -> String {
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

fn compact_elements(svg: &str) -> String {
    let body = svg.split_once('>').map_or(svg, |(_, rest)| rest).trim_end().trim_end_matches("</svg>");
    let mut body = body.replace("opacity=\"1\" ", "").replace("stroke-width=\"1\" ", "");
    for plain in [" stroke=\"none\"", " stroke=\"#000000\"", " stroke-width=\"1\""] {
        body = body.replace(plain, "");
    }
    for (attribute, prefix) in [("stroke", 's'), ("fill", 'f')] {
        let code = format!("{attribute}=\"#01");
        let mut parts = body.split(&code);
        let first = parts.next().unwrap_or_default().to_owned();
        body = parts.fold(first, |done, part| {
            let role = part.get(..4).and_then(Role::from_code);
            let rest = part.get(4..).unwrap_or_default();
            format!("{done}class=\"{prefix}-{}{rest}", role.map(Role::name).unwrap_or_default())
        });
    }
    body.replace(" \"/>", "\"/>").lines().map(|line| compact_element(line.trim())).collect()
}

/// Writes lines and areas as relative paths, and texts without their font, which the style sheet
/// sets.
fn compact_element(element: &str) -> String {
    let outline = element.strip_prefix("<polyline fill=\"none\" ").or_else(|| element.strip_prefix("<polygon "));
    if let Some((before, points)) = outline.and_then(|outline| outline.split_once("points=\""))
        && let Some((points, _)) = points.split_once('"')
    {
        return format!("<path {before}d=\"{}\"/>", path_data(points));
    }
    match element.split_once(" font-family=").and_then(|(before, rest)| Some((before, rest.split_once(" class=")?.1))) {
        Some((before, rest)) => format!("{before} class={rest}"),
        None => element.to_owned(),
    }
}

/// Converts points `x,y x,y` to the data of a relative path.
fn path_data(points: &str) -> String {
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
    #[case("264,1023 295,1023 295,187 290,190", "m264 1023l31 0 0-836-5 3")]
    #[case("7,8", "m7 8")]
    #[case("", "")]
    fn points_become_differences(#[case] points: &str, #[case] expected: &str) {
        assert_eq!(path_data(points), expected);
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

    /// Roles that only the page's script draws need no rule.
    #[test]
    fn every_role_has_its_own_class() {
        let numbered = (0..COLOURS).flat_map(|number| [Role::Series(number), Role::Radius(number)]);
        for role in Role::iter().chain(numbered) {
            let RGBColor(_, green, blue) = role.colour();
            assert_eq!(Role::from_code(&format!("{green:02X}{blue:02X}")), Some(role));
            let name = role.name();
            let styled =
                [format!(".s-{name} "), format!(".f-{name} ")].iter().any(|rule| colours::RULES.contains(rule));
            assert!(styled || role == Role::Trial, "{name}");
        }
    }

    #[test]
    fn a_document_has_classes_and_the_rules_of_its_classes() {
        let svg = svg_document("a < b", (40, 20), |root| {
            let canvas = Canvas(root);
            canvas.text(Role::Title, HPos::Left, (2, 10), "1 < 2")?;
            canvas.line(Role::Series(11), [(0, 0), (40, 20)])?;
            canvas.ring(Role::Series(1), (20, 10), 2.5)?;
            canvas.circle(Role::Shape, (20, 10), 2.5)
        });
        insta::assert_snapshot!(svg.unwrap());
    }
}
