//! The study in words: a table for people, tables for machines.

use crate::case::Condition;
use crate::margins::DelayBoundary;
use crate::plain::Found;
use crate::study::{Row, Study};
use platebench_wire::LawId;
use std::fmt::Write;

/// The table of boundaries, for a terminal. Delays are µs.
pub fn table(study: &Study, delay: f64) -> String {
    let mut text = String::new();
    // Writing to a string cannot fail.
    let _ = writeln!(
        text,
        "Loops: the longest loop delay that each law bears at 1 kHz, µs; margins at a loop delay of {:.0} µs\n\n\
         law             condition   predicted   measured  difference   from rest   radius   gain   phase   delay margin",
        delay * 1e6
    );
    for row in &study.rows {
        let difference = row.difference_percent().map_or_else(|| "–".to_owned(), |percent| format!("{percent:+.2} %"));
        let measured = row.measured.map_or_else(|| "no rest".to_owned(), |boundary| micros(boundary, "none"));
        let _ = writeln!(
            text,
            "{:<15} {:<10} {:>10} {:>10}  {:>10}  {:>10}  {:>7.3}  {:>5}  {:>6}  {:>13}",
            row.law.name(),
            row.condition.name(),
            micros(row.predicted, "unstable"),
            measured,
            difference,
            micros(row.from_rest, "never"),
            row.spectral_radius,
            optional(row.gain_margin, |gain| format!("{gain:.2}")),
            optional(row.phase_margin_deg, |degrees| format!("{degrees:.1}°")),
            optional(row.delay_margin, |seconds| format!("{:.0}", seconds * 1e6)),
        );
    }
    for (law, condition) in &study.out_of_reach {
        let _ = writeln!(text, "{:<15} {:<10} no steady state within the drive's limit", law.name(), condition.name());
    }
    let mut laws: Vec<LawId> = study.rows.iter().map(|row| row.law).collect();
    laws.dedup();
    for law in laws {
        if let Some(note) = note(law) {
            let _ = writeln!(text, "\n{}: {note}", law.name());
        }
    }
    text
}

/// What has to be known of a law to read its row.
pub const fn note(law: LawId) -> Option<&'static str> {
    Some(match law {
        LawId::OpenLoop => "nothing is fed back, so no delay makes it unstable; its poles are the plate's",
        LawId::DqPi => {
            "around its steady state it is dq-pi-fixed matched to the plate's damping; from rest it bears less, because a delay looks like damping to it"
        }
        LawId::BangBang => {
            "the relay on the frequency has no linear form and always hunts; predicted is the amplitude loop, measured where its |W| leaves 5 %"
        }
        LawId::Deadbeat => {
            "predicted and measured are its holding loops that know of no delay; from rest it looks for the delay and reckons with it, up to nine tenths of a period"
        }
        LawId::FrequencyOnly => {
            "the drive is half of the limit and the setpoint 1 µm, so that the finger leaves it in reach"
        }
        LawId::VoltageOnly | LawId::Pll | LawId::DqPiEuler | LawId::DqPiFixed => return None,
    })
}

/// The surprise, in a few lines: how two plain loops with a backward integral start, at resonance and detuned.
pub fn surprise(starts: &[(Condition, f64, Found)]) -> String {
    let mut text = String::from(
        "Known surprise: equation 24 with a backward-Euler integral, no delay, no limits, from rest to 2 µm\n",
    );
    for (condition, radius, found) in starts {
        let outcome = match found.settled {
            Some(seconds) => format!("within 5 % from {:.0} ms on", seconds * 1e3),
            None if found.diverged => "never settles: Wq/Wd is not linear, and the excitation runs away".to_owned(),
            None => format!("never settles: |W| between {:.2} and {:.2} setpoints", found.range[0], found.range[1]),
        };
        let _ = writeln!(text, "  {:<10} spectral radius {radius:.2}: {outcome}", condition.name());
    }
    text
}

fn micros(boundary: DelayBoundary, never: &str) -> String {
    match boundary {
        DelayBoundary::Never => never.to_owned(),
        DelayBoundary::At(seconds) => format!("{:.0}", seconds * 1e6),
        DelayBoundary::Beyond(seconds) => format!("> {:.0}", seconds * 1e6),
    }
}

fn optional(value: Option<f64>, shown: impl Fn(f64) -> String) -> String {
    value.map_or_else(|| "–".to_owned(), shown)
}

/// The rows as CSV; a boundary that there is not is empty, one beyond what was looked at `inf`, unstable without delay 0.
pub fn boundaries_csv(study: &Study) -> String {
    let mut text = String::from(
        "law,condition,period_us,response_ms,predicted_us,measured_us,difference_percent,from_rest_us,spectral_radius,gain_margin,phase_margin_deg,delay_margin_us\n",
    );
    for row in &study.rows {
        let Row { law, condition, period_us, response, .. } = row;
        let cells = [
            Some(number(row.predicted)),
            row.measured.map(number),
            row.difference_percent(),
            Some(number(row.from_rest)),
            Some(row.spectral_radius),
            row.gain_margin,
            row.phase_margin_deg,
            row.delay_margin.map(|seconds| seconds * 1e6),
        ];
        let cells = cells.map(|cell| cell.map_or_else(String::new, |value| value.to_string())).join(",");
        let _ = writeln!(text, "{},{},{period_us},{},{cells}", law.name(), condition.name(), response * 1e3);
    }
    text
}

fn number(boundary: DelayBoundary) -> f64 {
    match boundary {
        DelayBoundary::Never => 0.0,
        DelayBoundary::At(seconds) => seconds * 1e6,
        DelayBoundary::Beyond(_) => f64::INFINITY,
    }
}

/// Every point of every map as CSV: `kind` is `predicted`, with its spectral radius, or `measured`, a boundary.
pub fn maps_csv(study: &Study) -> String {
    let mut text = String::from("law,condition,response_ms,kind,period_us,delay_us,spectral_radius\n");
    for map in &study.maps {
        let head = format!("{},{},{}", map.law.name(), map.condition.name(), map.response * 1e3);
        for (period, column) in map.periods.iter().zip(&map.radius) {
            for (delay, radius) in map.delays.iter().zip(column) {
                let _ = writeln!(text, "{head},predicted,{:.0},{:.1},{radius}", period * 1e6, delay * 1e6);
            }
        }
        for (period, delay) in &map.measured {
            let _ = writeln!(text, "{head},measured,{:.0},{:.1},1", period * 1e6, delay * 1e6);
        }
    }
    text
}
