//! Draws the place where a response leaves its tolerance tube, in characters.

use crate::chart::marks::extent;
use crate::document::{Block, Document};
use crate::format;
use platebench_model::trace::Row;
use platebench_verdict::tube::{Exceedance, Tube, TubeSignal, signal_response};

const COLUMNS: usize = 64;
const ROWS: usize = 12;
const MARGIN_MS: f64 = 5.0;

/// Draws the tube as `.`, the golden curve as `-` and the response as `#`.
pub fn document(tube: &Tube, rows: &[Row], trial: u32, worst: &Exceedance) -> Document {
    let place = format!("  {}", format::exceedance(trial, worst));
    let lines = std::iter::once(place).chain(lines(tube, rows, worst));
    Document::new("Response outside its tolerance tube", vec![Block::lines(lines)])
}

fn lines(tube: &Tube, rows: &[Row], worst: &Exceedance) -> Vec<String> {
    let (first, last) = tube.span_ms();
    let (from, to) = ((worst.t_ms - MARGIN_MS).max(first), (worst.t_ms + MARGIN_MS).min(last));
    let response = TubeSignal::from_name(&tube.signal).map(|signal| signal_response(signal, rows)).unwrap_or_default();
    let at = |column: usize| from + (to - from) * column as f64 / (COLUMNS - 1) as f64;
    let held = |t_ms: f64| {
        let next = response.partition_point(|point| point.0 <= t_ms);
        next.checked_sub(1).and_then(|index| response.get(index)).map(|point| point.1)
    };
    let columns: Vec<([f64; 2], f64, Option<f64>)> =
        (0..COLUMNS).map(at).map(|t_ms| (tube.edges(t_ms), tube.point_at(t_ms).value, held(t_ms))).collect();
    let values = columns.iter().flat_map(|(edges, _, value)| edges.iter().copied().chain(*value)).chain([worst.value]);
    let (low, high) = extent(values).unwrap_or_default();
    let span = (high - low).max(f64::MIN_POSITIVE);
    let row = |value: f64| ((high - value) / span * (ROWS - 1) as f64).round().clamp(0.0, (ROWS - 1) as f64) as usize;
    let mark = |line: usize, (edges, golden, value): &([f64; 2], f64, Option<f64>)| match value {
        Some(value) if row(*value) == line => '#',
        _ if row(*golden) == line => '-',
        _ if (row(edges[1])..=row(edges[0])).contains(&line) => '.',
        _ => ' ',
    };
    let label = |line: usize| match line {
        0 => format::number(high),
        line if line == ROWS - 1 => format::number(low),
        _ => String::new(),
    };
    let drawn = |line: usize| {
        let text: String = columns.iter().map(|column| mark(line, column)).collect();
        format!("  {:>9} |{}", label(line), text.trim_end())
    };
    let unit = TubeSignal::from_name(&tube.signal).map_or("", |signal| signal.unit);
    let title = format!("  {}, {unit}   # this run   - golden   . tolerance tube", tube.signal);
    let axis = format!("  {:>9} {:<32}{:>32} ms", "", format::number(from), format::number(to));
    std::iter::once(title).chain((0..ROWS).map(drawn)).chain([axis]).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use platebench_verdict::golden::GoldenTubes;

    #[test]
    fn draws_tube_golden_curve_and_response() {
        let rows = |height: f64| -> Vec<Row> {
            let amplitude = |index: u32| if index >= 100 { height } else { 0.0 };
            let row =
                |index: u32| Row { t_s: f64::from(index) * 1e-4, amplitude_um: amplitude(index), ..Row::default() };
            (0..=300).map(row).collect()
        };
        let golden = GoldenTubes::from_rows(&rows(2.0)).unwrap();
        let bad = rows(2.5);
        let worst = golden.exceedances(&bad);
        assert_eq!(worst.iter().map(|found| found.signal.as_str()).collect::<Vec<_>>(), ["amplitude_um"]);
        insta::assert_snapshot!(lines(&golden.tubes[0], &bad, &worst[0]).join("\n"));
    }
}
