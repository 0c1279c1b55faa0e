//! Adds interactive plots to the page. Without scripts the page shows the same figures as drawings.

use super::encode::{embed_json, encode_values};
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
