//! What makes the page better where scripts run: the plotting library, the script that uses it, and its data. All of it stands in the page itself.
//!
//! Neighbours: `interactive` makes the data. Without scripts the page loses nothing but the plots' movement: the drawings stay.

use super::pack::embedded;
use maud::{Markup, PreEscaped, html};
use serde_json::Value;

/// uPlot 1.6.32, MIT.
const LIBRARY: &str = include_str!("../../vendor/uPlot.iife.min.js");
const LIBRARY_STYLE: &str = include_str!("../../vendor/uPlot.min.css");
const LICENCE: &str = include_str!("../../vendor/uPlot-LICENSE");
const PLOTS: &str = include_str!("plots.js");
const STYLE: &str = include_str!("plots.css");

/// Nothing is fetched from anywhere, whatever stands in the page.
const POLICY: &str = "default-src 'none'; style-src 'unsafe-inline'; script-src 'unsafe-inline'; img-src data:; base-uri 'none'; form-action 'none'";

/// For the page's head.
pub(super) fn head() -> Markup {
    html! {
        meta http-equiv="Content-Security-Policy" content=(POLICY);
        style { (PreEscaped(LIBRARY_STYLE)) (PreEscaped(STYLE)) }
    }
}

/// The data of a scenario, to stand in its section.
pub(super) fn data(curves: &Value) -> Markup {
    html! { script.curves type="application/json" { (PreEscaped(embedded(curves))) } }
}

/// For the page's end.
pub(super) fn end() -> Markup {
    html! {
        script { (PreEscaped("/* uPlot\n")) (PreEscaped(LICENCE)) (PreEscaped("*/\n")) (PreEscaped(LIBRARY)) }
        script { (PreEscaped(PLOTS)) }
    }
}
