//! What all charts are drawn with: roles instead of colours, so that one file serves light and dark; logarithmic axes.

use crate::error::ReportError;
use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, Pos, VPos};
use std::error::Error;
use std::fmt::Write as _;
use std::ops::Range;

/// Units of the drawing per CSS pixel at natural size: plotters puts points on whole numbers only.
pub(super) const FINE: i32 = 4;
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
.g,.a,.m{fill:none;stroke-width:4}.k{fill:#4a525b}
.l{fill:none;stroke-width:8;stroke-linejoin:round}
@media screen and (prefers-color-scheme:dark){svg{background:#1a1e23}text,.k{fill:#a7b0ba}.t{fill:#f4f6f8}.g{stroke:#2e343b}.a,.m{stroke:#8b949e}}
";

/// More things than this are not drawn to scale any more.
const MOST: i32 = 20_000;

/// A number of things, as a factor of a length.
pub(super) fn many(count: usize) -> i32 {
    i32::try_from(count).map_or(MOST, |count| count.min(MOST))
}

pub(super) type Area<'a> = DrawingArea<SVGBackend<'a>, plotters::coord::Shift>;
pub(super) type Drawn<T> = Result<T, Box<dyn Error + Send + Sync>>;

/// What `draw` draws on an area of so many units, as an SVG document under `title` with so many series.
///
/// # Errors
/// [`ReportError::Plot`] where it cannot be drawn.
pub(super) fn document(
    title: &str,
    (width, height): (i32, i32),
    series: usize,
    draw: impl FnOnce(&Area<'_>) -> Drawn<()>,
) -> Result<String, ReportError> {
    let mut svg = String::new();
    let drawn = || {
        let root =
            SVGBackend::with_string(&mut svg, (u32::try_from(width)?, u32::try_from(height)?)).into_drawing_area();
        draw(&root)?;
        root.present()?;
        Ok(())
    };
    drawn().map_err(|source| ReportError::Plot { title: title.to_owned(), source })?;
    Ok(classed(&svg, title, (width, height), series))
}

/// The document with a style sheet of its own and classes instead of colours.
fn classed(svg: &str, title: &str, (width, height): (i32, i32), series: usize) -> String {
    let body = svg.split_once('>').map_or(svg, |(_, rest)| rest);
    let mut body = body.replace("opacity=\"1\" ", "").replace("stroke-width=\"1\" ", "").replace(" \"/>", "\"/>");
    let mut style = STYLE.to_owned();
    let roles = [
        (Role::Text, ""),
        (Role::Title, "t"),
        (Role::Grid, "g"),
        (Role::Axis, "a"),
        (Role::Mark, "m"),
        (Role::Shape, "k"),
    ];
    let mut classes: Vec<(Role, String)> = roles.map(|(role, class)| (role, class.to_owned())).into();
    let mut dark = String::new();
    for number in 0..series {
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
            Role::Text | Role::Title | Role::Grid | Role::Axis | Role::Mark | Role::Shape => {
                (format!("class=\"{class}\""), format!("class=\"{class}\""))
            }
        };
        body = body.replace(&format!("stroke=\"{colour}\""), &stroke).replace(&format!("fill=\"{colour}\""), &fill);
    }
    format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {width} {height}\" width=\"{}\" height=\"{}\" role=\"img\" aria-label=\"{}\">\n<style>{style}</style>{body}",
        width / FINE,
        height / FINE,
        title.replace('&', "&amp;").replace('"', "&quot;").replace('<', "&lt;")
    )
}

/// What an element is; it has a colour of its own until the drawing is done.
#[derive(Debug, Clone, Copy)]
pub(super) enum Role {
    Text,
    Title,
    Grid,
    Axis,
    Mark,
    /// A filled shape that belongs to no series.
    Shape,
    Series(usize),
}

impl Role {
    pub(super) const fn colour(self) -> RGBColor {
        RGBColor(
            1,
            2,
            match self {
                Self::Text => 0,
                Self::Title => 1,
                Self::Grid => 2,
                Self::Axis => 3,
                Self::Mark => 4,
                Self::Shape => 5,
                Self::Series(number) => 6 + number as u8,
            },
        )
    }
}

pub(super) fn text(role: Role, side: HPos) -> TextStyle<'static> {
    let font = ("sans-serif", f64::from(12 * FINE)).into_font();
    let style = TextStyle::from(font).pos(Pos::new(side, VPos::Center));
    TextStyle { color: role.colour().to_backend_color(), ..style }
}

/// The whole decades around what can be drawn on a logarithmic axis.
pub(super) fn decades(values: impl Iterator<Item = f64>) -> Range<f64> {
    let drawn = values.filter(|value| value.is_finite() && *value > 0.0);
    let (low, high) = drawn.fold((f64::INFINITY, 0.0_f64), |(low, high), value| (low.min(value), high.max(value)));
    if low > high {
        return 0.1..10.0;
    }
    let (from, to) = (low.log10().floor(), high.log10().ceil());
    10.0_f64.powf(from)..10.0_f64.powf(to.max(from + 1.0))
}

/// 10ⁿ.
pub(super) fn power(value: f64) -> String {
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
