//! Describes the replay of a recording.

use crate::document::{Block, Document};
use crate::format;
use platebench_model::record::ViolationKind;
use platebench_verdict::replay::{CommandDifference, ReplayResult};

pub const OPEN_LOOP: &str =
    "open loop: the samples are recorded and do not react to the commands; this judges commands, not control";

pub fn document(result: &ReplayResult) -> Document {
    let ReplayResult { verdict, compared, samples, identical, .. } = result;
    let mut lines = vec![
        format!("  rig {}, firmware {}, law {}", result.rig, result.firmware, result.law),
        format!("  {OPEN_LOOP}"),
        format!(
            "  {} sent, {compared} commands compared, {identical} equal bit for bit",
            format::count(*samples, "sample")
        ),
    ];
    lines.extend(result.differences.iter().map(difference));
    let outside = result.differences.iter().filter_map(|difference| difference.exceedance.as_ref());
    lines.extend(outside.map(|worst| format!("  {}", format::outside_tube(worst))));
    lines.extend(result.violations.iter().map(|violation| format!("  {violation}")));
    lines.extend(result.stopped.iter().map(|cause| format!("  the controller stopped: {cause}")));
    lines.extend(result.ended.iter().map(|cause| format!("  the session ended: {cause}")));
    if result.missed_replies > 0 {
        lines.push(format!("  {} without a reply", format::count(result.missed_replies, "sample")));
    }
    lines.extend(result.recording_end.iter().map(|end| format!("  {end}")));
    // A drive after confirmed 0 V is among the violations.
    if !result.safe_confirmed && !result.violations.iter().any(|one| one.kind == ViolationKind::DriveAfterSafe) {
        lines.push("  the controller did not confirm 0 V".to_owned());
    }
    let blocks = vec![Block::Verdict(*verdict, result.recording.clone()), Block::lines(lines)];
    Document::new(format!("Replay of {}", result.recording), blocks)
}

fn difference(difference: &CommandDifference) -> String {
    let CommandDifference { signal, unit, largest, at_ms, .. } = difference;
    if !largest.is_finite() {
        return format!("  {signal}: a command at {} ms is not a number", format::number(*at_ms));
    }
    let place = if *largest > 0.0 { format!(" at {} ms", format::number(*at_ms)) } else { String::new() };
    format!("  {signal}: largest difference {} {unit}{place}", format::number(*largest))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::document::Style;
    use platebench_model::record::{Verdict, Violation};

    #[test]
    fn a_drive_after_0_v_is_no_missing_confirmation() {
        let kind = ViolationKind::DriveAfterSafe;
        let mut result = ReplayResult {
            verdict: Verdict::Fail,
            open_loop: true,
            recording: "000.csv".to_owned(),
            rig: "hosted".to_owned(),
            firmware: "test".to_owned(),
            law: "dq-pi".to_owned(),
            samples: 5,
            compared: 5,
            identical: 5,
            differences: Vec::new(),
            missed_replies: 0,
            violations: vec![Violation { kind, at_s: 5e-3, count: 1, worst: Some(12.0), limit: None }],
            stopped: None,
            ended: None,
            rig_lost: false,
            recording_end: None,
            safe_confirmed: false,
        };
        let text = |result: &ReplayResult| document(result).to_console(None, Style::default());
        assert!(!text(&result).contains("did not confirm 0 V"), "{}", text(&result));
        result.violations.clear();
        assert!(text(&result).ends_with("  the controller did not confirm 0 V\n"), "{}", text(&result));
    }
}
