//! Formats a study as text and CSV.

use crate::loops::case::OperatingCondition;
use crate::loops::plain_loops::StartResult;
use crate::loops::study::{Study, StudyRow};
use platebench_engine::delay_boundary::DelayBoundary;
use platebench_wire::LawId;
use std::fmt::Write;

/// `delay` is the loop delay of the margins, s. The table shows delays in µs.
pub fn boundary_table(study: &Study, delay: f64) -> String {
    let mut text = String::new();
    let _ = writeln!(
        text,
        "Loops: longest stable loop delay of each law at 1 kHz, µs; margins at a loop delay of {:.0} µs\n\n\
         law             condition   predicted   measured  difference   from rest   radius   gain   phase   \
         delay margin",
        delay * 1e6
    );
    for row in &study.rows {
        let difference = row.difference_percent().map_or_else(|| "–".to_owned(), |percent| format!("{percent:+.2} %"));
        let measured =
            row.measured.map_or_else(|| "unsteady".to_owned(), |boundary| format_microseconds(boundary, "none"));
        let _ = writeln!(
            text,
            "{:<15} {:<10} {:>10} {:>10}  {:>10}  {:>10}  {:>7.3}  {:>5}  {:>6}  {:>13}",
            row.law.name(),
            row.condition.name(),
            format_microseconds(row.predicted, "unstable"),
            measured,
            difference,
            format_microseconds(row.from_rest, "never"),
            row.spectral_radius,
            format_optional(row.gain_margin, |gain| format!("{gain:.2}")),
            format_optional(row.phase_margin_deg, |degrees| format!("{degrees:.1}°")),
            format_optional(row.delay_margin, |seconds| format!("{:.0}", seconds * 1e6)),
        );
    }
    for (law, condition) in &study.out_of_reach {
        let _ = writeln!(text, "{:<15} {:<10} no steady state within the drive's limit", law.name(), condition.name());
    }
    let mut laws: Vec<LawId> = study.rows.iter().map(|row| row.law).collect();
    laws.dedup();
    for law in laws {
        if let Some(note) = law_note(law) {
            let _ = writeln!(text, "\n{}: {note}", law.name());
        }
    }
    text
}

pub const fn law_note(law: LawId) -> Option<&'static str> {
    Some(match law {
        LawId::OpenLoop => "without feedback no delay makes it unstable; its poles are the plate's",
        LawId::DqPi => {
            "in steady state it equals dq-pi-fixed matched to the plate's damping; \
             from rest its boundary is lower, because it interprets a delay as damping"
        }
        LawId::BangBang => {
            "the frequency relay has no linear form and always hunts; \
             predicted is the boundary of the amplitude loop, measured is the delay at which |W| leaves the 5 % band"
        }
        LawId::Deadbeat => {
            "predicted and measured are the boundaries of the holding loops, which do not compensate the delay; \
             from rest the law identifies a delay of up to 0.9 periods"
        }
        LawId::FrequencyOnly => "the drive is half of the limit; it reaches the setpoint of 1 µm under the finger",
        LawId::VoltageOnly | LawId::Pll | LawId::DqPiEuler | LawId::DqPiFixed => return None,
    })
}

pub fn format_plain_loop_starts(starts: &[(OperatingCondition, f64, StartResult)]) -> String {
    let mut text = String::from(
        "Known limit: equation 24 with a backward-Euler integral, no delay, no limits, from rest to 2 µm\n",
    );
    for (condition, radius, found) in starts {
        let outcome = match found.settled {
            Some(seconds) => format!("within 5 % from {:.0} ms on", seconds * 1e3),
            None if found.diverged => "never settles: Wq/Wd is not linear, and the excitation diverges".to_owned(),
            None => format!("never settles: |W| between {:.2} and {:.2} setpoints", found.range[0], found.range[1]),
        };
        let _ = writeln!(text, "  {:<10} spectral radius {radius:.2}: {outcome}", condition.name());
    }
    text
}

fn format_microseconds(boundary: DelayBoundary, never: &str) -> String {
    match boundary {
        DelayBoundary::Unstable => never.to_owned(),
        DelayBoundary::At(seconds) => format!("{:.0}", seconds * 1e6),
        DelayBoundary::Beyond(seconds) => format!("> {:.0}", seconds * 1e6),
    }
}

fn format_optional(value: Option<f64>, format: impl Fn(f64) -> String) -> String {
    value.map_or_else(|| "–".to_owned(), format)
}

/// A boundary is empty without a steady state, `inf` beyond the search, 0 if never stable.
pub fn boundaries_csv(study: &Study) -> String {
    let mut text = String::from(
        "law,condition,period_us,response_ms,predicted_us,measured_us,difference_percent,from_rest_us,\
         spectral_radius,gain_margin,phase_margin_deg,delay_margin_us\n",
    );
    for row in &study.rows {
        let StudyRow { law, condition, period_us, response, .. } = row;
        let cells = [
            Some(boundary_us(row.predicted)),
            row.measured.map(boundary_us),
            row.difference_percent(),
            Some(boundary_us(row.from_rest)),
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

fn boundary_us(boundary: DelayBoundary) -> f64 {
    match boundary {
        DelayBoundary::Unstable => 0.0,
        DelayBoundary::At(seconds) => seconds * 1e6,
        DelayBoundary::Beyond(_) => f64::INFINITY,
    }
}

/// Writes a row per point. `kind` is `predicted` for the map and `measured` for a boundary.
pub fn maps_csv(study: &Study) -> String {
    let mut text = String::from("law,condition,response_ms,kind,period_us,delay_us,spectral_radius,settling_ms\n");
    for map in &study.maps {
        let head = format!("{},{},{}", map.law.name(), map.condition.name(), map.response * 1e3);
        let columns = map.spectral_radius.iter().zip(&map.settling);
        for (period, (radii, settling)) in map.periods.iter().zip(columns) {
            for ((delay, radius), settling) in map.delays.iter().zip(radii).zip(settling) {
                let settling = settling.map_or_else(String::new, |seconds| format!("{:.3}", seconds * 1e3));
                let _ = writeln!(text, "{head},predicted,{:.0},{:.1},{radius},{settling}", period * 1e6, delay * 1e6);
            }
        }
        for (period, delay) in &map.measured {
            let _ = writeln!(text, "{head},measured,{:.0},{:.1},1,", period * 1e6, delay * 1e6);
        }
    }
    text
}
