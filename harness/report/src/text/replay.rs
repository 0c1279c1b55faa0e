//! Describes the replay of a recording.

use crate::document::{Block, Document};
use crate::format;
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
    lines.extend(result.stopped.iter().map(|cause| format!("  the controller stopped: {}", cause)));
    lines.extend(result.ended.iter().map(|cause| format!("  the session ended: {}", cause)));
    if result.missed_replies > 0 {
        lines.push(format!("  {} without a reply", format::count(result.missed_replies, "sample")));
    }
    lines.extend(result.recording_end.iter().map(|end| format!("  {end}")));
    if !result.safe_confirmed {
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
