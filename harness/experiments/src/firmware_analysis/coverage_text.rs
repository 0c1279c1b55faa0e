//! Formats coverage as text.

use crate::firmware_analysis::coverage::{Coverage, Ratio};
use std::fmt::{self, Write};

pub fn summary(coverage: &Coverage) -> String {
    let mut text = String::new();
    let _ = write_summary(&mut text, coverage);
    text
}

fn write_summary(text: &mut String, coverage: &Coverage) -> fmt::Result {
    writeln!(text, "{:>7}  {:>11}  {:>11}  file", "lines", "lines", "functions")?;
    for (path, file) in &coverage.files {
        let (lines, functions) = (file.line_ratio(), file.function_ratio());
        let count = |ratio: Ratio| format!("{}/{}", ratio.executed, ratio.total);
        writeln!(text, "{:>5.1} %  {:>11}  {:>11}  {path}", lines.percent(), count(lines), count(functions))?;
    }
    writeln!(text, "\nLines of the control path that never ran:")?;
    let mut complete = true;
    for (path, file) in &coverage.files {
        let missing = file.lines.iter().filter(|(_, line)| line.on_control_path && !line.executed);
        let missing: Vec<u32> = missing.map(|(&line, _)| line).collect();
        if !missing.is_empty() {
            complete = false;
            writeln!(text, "  {path}: {}", ranges(&missing))?;
        }
    }
    if complete {
        writeln!(text, "  none")?;
    }
    let (lines, instructions) = (coverage.line_ratio(), coverage.instructions);
    writeln!(
        text,
        "\nlines: {} of {}, {:.1} %; instructions of the image: {} of {}, {:.1} %",
        lines.executed,
        lines.total,
        lines.percent(),
        instructions.executed,
        instructions.total,
        instructions.percent()
    )
}

/// Formats line numbers as `3, 7-9`.
fn ranges(lines: &[u32]) -> String {
    let mut ranges: Vec<(u32, u32)> = Vec::new();
    for &line in lines {
        match ranges.last_mut() {
            Some((_, last)) if *last + 1 == line => *last = line,
            _ => ranges.push((line, line)),
        }
    }
    let range = |(first, last)| if first == last { format!("{first}") } else { format!("{first}-{last}") };
    ranges.into_iter().map(range).collect::<Vec<_>>().join(", ")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn joins_successive_lines() {
        assert_eq!(ranges(&[3, 7, 8, 9, 11]), "3, 7-9, 11");
        assert_eq!(ranges(&[]), "");
    }
}
