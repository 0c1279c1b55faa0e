//! Adds interactive plots to the page. Without scripts the page shows the same figures as drawings.

use super::figure::{Content, Figure};
use super::trace_data::View;
use maud::{Markup, PreEscaped, html};
use serde_json::{Value, json};

/// uPlot 1.6.32, MIT.
const LIBRARY: &str = include_str!("../../vendor/uPlot.iife.min.js");
const LIBRARY_STYLE: &str = include_str!("../../vendor/uPlot.min.css");
const LICENCE: &str = include_str!("../../vendor/uPlot-LICENSE");
const PLOTS: &str = include_str!("plots.js");
const NAVIGATION: &str = include_str!("navigation.js");
const STYLE: &str = include_str!("plots.css");

/// Prevents the page from loading files, whatever its texts contain.
const POLICY: &str = "default-src 'none'; style-src 'unsafe-inline'; script-src 'unsafe-inline'; img-src data:; \
                      base-uri 'none'; form-action 'none'";

pub(super) fn head() -> Markup {
    html! {
        meta http-equiv="Content-Security-Policy" content=(POLICY);
        style { (PreEscaped(LIBRARY_STYLE)) (PreEscaped(STYLE)) }
    }
}

pub(super) fn figure_data(title: &str, t_ms: &[f64], views: &[View], figures: &[Figure]) -> Markup {
    let views = views.iter().map(|View { name, window }| json!([name, window.from_ms, window.to_ms]));
    let views: Vec<Value> = views.collect();
    let data = json!({
        "title": title,
        "t": encode_values(t_ms.iter().copied().map(Some)),
        "views": views,
        "panels": figures.iter().map(panel).collect::<Vec<_>>(),
    });
    html! { script.curves type="application/json" { (PreEscaped(embed_json(&data))) } }
}

/// Data of a figure for `plots.js`. A layer is a group; series, bands, spans, marks and points
/// contain its number.
fn panel(figure: &Figure) -> Value {
    let (mut series, mut bands, mut spans, mut marks, mut points) = (vec![], vec![], vec![], vec![], vec![]);
    for (group, layer) in figure.layers.iter().enumerate() {
        let mut add_series = |line: &[Option<f64>], is_stepped: bool, role: &str| {
            let y = encode_values(line.iter().copied());
            let mut fields = serde_json::Map::from_iter([("g".to_owned(), json!(group)), ("y".to_owned(), y)]);
            fields.extend(is_stepped.then(|| ("step".to_owned(), json!(true))));
            fields.extend((!role.is_empty()).then(|| ("role".to_owned(), json!(role))));
            series.push(Value::Object(fields));
            series.len() - 1
        };
        match &layer.content {
            Content::Lines { is_stepped, lines } => {
                let role = if layer.is_in_drawing() { "" } else { "trial" };
                for line in lines {
                    add_series(line, *is_stepped, role);
                }
            }
            Content::Area { is_stepped, upper, lower } => {
                let [upper, lower] = [upper, lower].map(|line| add_series(line, *is_stepped, "edge"));
                bands.push(json!([upper, lower, group]));
            }
            Content::Spans(windows) => {
                spans.extend(windows.iter().map(|window| json!([group, window.from_ms, window.to_ms])));
            }
            Content::Marks(instants) => marks.extend(instants.iter().map(|(at_ms, _)| json!([group, at_ms]))),
            Content::Points(all) => {
                points.extend(all.iter().map(|(at_ms, value, text)| json!([group, at_ms, value, text])));
            }
        }
    }
    let groups = figure.layers.iter().map(|layer| {
        let mut fields = json!({ "ink": layer.role.name(), "text": layer.text });
        if layer.is_area() {
            fields["area"] = json!(true);
        }
        fields
    });
    json!({
        "title": figure.title, "unit": figure.unit, "zero": figure.from_zero, "least": figure.min_span,
        "groups": groups.collect::<Vec<_>>(), "series": series, "bands": bands, "spans": spans, "marks": marks,
        "points": points, "stimulus": figure.is_stimulus,
    })
}

pub(super) fn end() -> Markup {
    html! {
        script { (PreEscaped("/* uPlot\n")) (PreEscaped(LICENCE)) (PreEscaped("*/\n")) (PreEscaped(LIBRARY)) }
        script { (PreEscaped(PLOTS)) (PreEscaped(NAVIGATION)) }
    }
}

const DIGITS: &[u8; 64] = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
const QUANTISATION_STEPS: f64 = 65_535.0;

/// Returns the lowest value, the size of a step and the encoded differences.
pub(crate) fn encode_values(values: impl IntoIterator<Item = Option<f64>>) -> Value {
    let values: Vec<Option<f64>> = values.into_iter().map(|value| value.filter(|value| value.is_finite())).collect();
    let known = || values.iter().flatten();
    let low = known().copied().fold(f64::INFINITY, f64::min);
    let high = known().copied().fold(f64::NEG_INFINITY, f64::max);
    let step = if high > low { (high - low) / QUANTISATION_STEPS } else { 0.0 };
    let mut before = 0;
    let mut text = String::new();
    for value in &values {
        let Some(value) = value else {
            text.push('!');
            continue;
        };
        let count = if step > 0.0 { ((value - low) / step).round() as i64 } else { 0 };
        push_vlq(&mut text, count - before);
        before = count;
    }
    json!([if low.is_finite() { low } else { 0.0 }, step, text])
}

fn push_vlq(text: &mut String, difference: i64) {
    let mut rest = (difference.unsigned_abs() << 1) | u64::from(difference < 0);
    loop {
        let digit = (rest & 31) as usize;
        rest >>= 5;
        let continued = if rest > 0 { 32 } else { 0 };
        text.extend(DIGITS.get(digit | continued).map(|digit| char::from(*digit)));
        if rest == 0 {
            return;
        }
    }
}

/// Escapes `<`, `>` and `&`, so that no text ends the script element.
pub(crate) fn embed_json(value: &Value) -> String {
    let text = value.to_string();
    text.replace('<', "\\u003c").replace('>', "\\u003e").replace('&', "\\u0026")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn decode_values(packed: &Value) -> Vec<Option<f64>> {
        let (low, step) = (packed[0].as_f64().unwrap(), packed[1].as_f64().unwrap());
        let (mut count, mut values, mut rest, mut shift) = (0_i64, Vec::new(), 0_i64, 0);
        for digit in packed[2].as_str().unwrap().bytes() {
            if digit == b'!' {
                values.push(None);
                continue;
            }
            let digit = i64::try_from(DIGITS.iter().position(|known| *known == digit).unwrap()).unwrap();
            rest |= (digit & 31) << shift;
            shift += 5;
            if digit & 32 == 0 {
                count += if rest & 1 == 1 { -(rest >> 1) } else { rest >> 1 };
                values.push(Some(low + count as f64 * step));
                (rest, shift) = (0, 0);
            }
        }
        values
    }

    #[test]
    fn decodes_to_the_values_within_half_a_step() {
        let values: Vec<Option<f64>> =
            (0..500).map(|n| (n % 97 != 13).then(|| 32_307.6 + (f64::from(n) * 0.37).sin() * 40.0)).collect();
        let packed = encode_values(values.clone());
        let back = decode_values(&packed);
        assert_eq!(back.len(), values.len());
        for (one, other) in values.iter().zip(&back) {
            assert_eq!(one.is_some(), other.is_some());
            let off = one.unwrap_or(0.0) - other.unwrap_or(0.0);
            assert!(off.abs() <= 80.0 / QUANTISATION_STEPS * 0.51, "{off}");
        }
    }

    #[test]
    fn encodes_extremes_and_missing_values() {
        assert_eq!(encode_values([]), json!([0.0, 0.0, ""]));
        assert_eq!(encode_values([None, Some(f64::NAN)]), json!([0.0, 0.0, "!!"]));
        assert_eq!(encode_values([Some(2.0), Some(2.0)]), json!([2.0, 0.0, "AA"]));
        // The differences are 65 535 and −65 535, each with its lowest digit first.
        assert_eq!(encode_values([Some(0.0), Some(1.0), Some(0.0)])[2], "A+//D//D".replace("//D//D", "//D///D"));
    }

    #[test]
    fn no_text_ends_the_script_element() {
        let text = embed_json(&json!({ "title": "</script><!--<script>\"&' \u{2028}" }));
        assert!(!text.contains(['<', '>', '&']), "{text}");
        assert_eq!(serde_json::from_str::<Value>(&text).unwrap()["title"], "</script><!--<script>\"&' \u{2028}");
    }
}
