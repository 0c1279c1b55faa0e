//! Numbers and words.

use crate::scope::Scope;
use platebench_runner::watch::LATENESS_CLASSES;
use platebench_trace::{Flags, Row};
use ratatui::Frame;
use ratatui::layout::Rect;
use ratatui::style::{Color, Style};
use ratatui::text::{Line, Span};
use ratatui::widgets::{Block, Paragraph, Wrap};

/// What is played, and how far it is.
pub(super) fn head(frame: &mut Frame<'_>, area: Rect, scope: &Scope) {
    let reversed = Style::new().reversed().bold();
    frame.render_widget(Block::new().style(reversed), area);
    let command = scope.subject.command;
    let Some((show, trial)) = scope.playing() else {
        frame.render_widget(Line::styled(format!(" {command}"), reversed), area);
        return;
    };
    let t_s = scope.newest.map_or(0.0, |row| row.t_s);
    let (which, when) = match show.duration_s {
        // A scenario that goes on until it is decided has more of them than were planned.
        Some(duration_s) if trial > u64::from(show.trials) => {
            (format!("trial {trial}   "), format!("{t_s:.4} of {duration_s} s "))
        }
        Some(duration_s) => (format!("trial {trial} of {}   ", show.trials), format!("{t_s:.4} of {duration_s} s ")),
        None => (String::new(), format!("{t_s:.3} s ")),
    };
    let room = (when.len() as u16).min(area.width);
    let right = Rect { x: area.right() - room, width: room, ..area };
    let left = Rect { width: area.width.saturating_sub(room + 1), ..area };
    frame.render_widget(Line::styled(format!(" {command}   {which}{}", show.file), reversed), left);
    frame.render_widget(Line::styled(when, reversed), right);
}

/// What it is about, and on what.
pub(super) fn title(frame: &mut Frame<'_>, area: Rect, scope: &Scope) {
    let place = &scope.subject.place;
    let text = match scope.playing() {
        Some((show, _)) => format!(" {}   law {}   {place}", show.title, show.law),
        None => format!(" nothing played yet   {place}"),
    };
    frame.render_widget(Line::raw(text), area);
}

/// The newest row.
pub(super) fn now(frame: &mut Frame<'_>, area: Rect, scope: &Scope) {
    let block = Block::bordered().title(" now ");
    let inner = block.inner(area);
    frame.render_widget(block, area);
    let (Some((show, _)), Some(row)) = (scope.playing(), scope.newest) else { return };
    let (place, colour) = match show.band(row.setpoint_um) {
        None => ("no band", Color::Reset),
        Some([low, high]) if (low..=high).contains(&row.amplitude_um) => ("in band", Color::Green),
        Some(_) => ("OUTSIDE", Color::Red),
    };
    let share = if show.limit_vpp > 0.0 { row.drive_vpp / show.limit_vpp } else { 0.0 };
    let detuning = row.frequency_hz - row.resonance_hz;
    let value = |name: &str, value: String, unit: &str| Line::raw(format!("{name:<9} {value:>8} {unit}"));
    let mut amplitude = value("|W|", format!("{:.3}", row.amplitude_um), "µm ");
    amplitude.push_span(Span::styled(place, Style::new().fg(colour)));
    let (state, colour) = state(&row);
    let lines = vec![
        amplitude,
        value("Wd", format!("{:+.3}", row.wd_um), "µm"),
        value("Wq", format!("{:+.3}", row.wq_um), "µm"),
        value("drive", format!("{:.1}", row.drive_vpp), &format!("Vpp {:3.0}%", share * 100.0)),
        Line::raw(bar(share, inner.width.into())),
        value("frequency", format!("{:.1}", row.frequency_hz), &format!("Hz {detuning:+.1}")),
        value("resonance", format!("{:.1}", row.resonance_hz), "Hz"),
        Line::raw(format!("finger {:.2} N, plate {:+.1} K", row.finger_force_n, row.temperature_offset_k)),
        Line::styled(state, Style::new().fg(colour)),
    ];
    frame.render_widget(Paragraph::new(lines), inner);
}

/// How it goes, in words.
fn state(row: &Row) -> (&'static str, Color) {
    let cases = [
        (Flags::SAFE, "controller stopped, 0 V", Color::Red),
        (Flags::LINK_LOST, "no reply", Color::Red),
        (Flags::OVERRUN, "bench was too late", Color::Red),
        (Flags::SATURATED, "drive at its limit", Color::Yellow),
    ];
    let found = cases.into_iter().find(|(flag, ..)| row.flags.contains(*flag));
    found.map_or(("controller runs", Color::Green), |(_, words, colour)| (words, colour))
}

/// A share from 0 to 1 as a bar of `width` characters.
fn bar(share: f64, width: usize) -> String {
    let full = ((share.clamp(0.0, 1.0) * width as f64).round() as usize).min(width);
    "█".repeat(full) + &"░".repeat(width - full)
}

/// How late the bench was, as a histogram.
pub(super) fn lateness(frame: &mut Frame<'_>, area: Rect, scope: &Scope) {
    let block = Block::bordered().title(" lateness of control instants ");
    let inner = block.inner(area);
    frame.render_widget(block, area);
    if scope.subject.lockstep {
        let text = "in lockstep the plate waits, so that nobody is ever late";
        frame.render_widget(Paragraph::new(text).wrap(Wrap { trim: true }), inner);
        return;
    }
    let groups = grouped(&scope.counts.lateness, inner.height.into());
    let most = groups.iter().map(|(_, count)| *count).max().unwrap_or(0).max(1);
    let room = usize::from(inner.width).saturating_sub(10 + 10);
    let lines: Vec<Line<'_>> = groups
        .into_iter()
        .map(|(label, count)| {
            // Whatever there is of it can be seen, however little.
            let length = (count as f64 / most as f64 * room as f64).ceil() as usize;
            Line::raw(format!("{label:>9} {:<room$} {count:>9}", "█".repeat(length.min(room))))
        })
        .collect();
    frame.render_widget(Paragraph::new(lines), inner);
}

/// Classes of lateness put together until there are at most `most`, with what to call them. The last one has no end.
pub(super) fn grouped(classes: &[u64; LATENESS_CLASSES], most: usize) -> Vec<(String, u64)> {
    let size = LATENESS_CLASSES.div_ceil(most.max(1));
    let micros = |class: usize| match 1_u64 << class {
        us @ ..1_000 => format!("{us} µs"),
        us => format!("{} ms", us / 1_000),
    };
    let last = LATENESS_CLASSES.div_ceil(size) - 1;
    let groups = classes.chunks(size).enumerate();
    let named = groups.map(|(number, group)| {
        let from = number * size;
        // Below the edge that its last class ends at.
        let name = if number == last {
            format!(">={}", micros(from.max(1) - 1))
        } else {
            format!("<{}", micros(from + size - 1))
        };
        (name, group.iter().sum())
    });
    named.collect()
}

/// What was counted.
pub(super) fn counts(frame: &mut Frame<'_>, area: Rect, scope: &Scope) {
    let counts = &scope.counts;
    let bad = |name: &str, count: u64| {
        let style = if count > 0 { Style::new().fg(Color::Red) } else { Style::new() };
        Span::styled(format!("   {name} {count}"), style)
    };
    let line = Line::from(vec![
        Span::raw(format!(" rows {}, of these not shown {}", counts.rows, counts.dropped)),
        bad("overruns", counts.overruns),
        bad("misses", counts.misses),
        bad("CRC errors", counts.refused),
    ]);
    frame.render_widget(line, area);
}

/// What has come to its end.
pub(super) fn ended(frame: &mut Frame<'_>, area: Rect, scope: &Scope) {
    let (ended, subject) = (&scope.ended, &scope.subject);
    if scope.playing().is_some_and(|(show, _)| show.duration_s.is_none()) {
        return;
    }
    let judged = ended.passed + ended.failed + ended.inconclusive;
    let mut spans = vec![
        Span::raw(format!(" {judged} of {} scenarios judged: ", subject.shows.len())),
        Span::styled(format!("{} pass", ended.passed), Style::new().fg(Color::Green)),
        Span::raw(", "),
        Span::styled(format!("{} fail", ended.failed), Style::new().fg(Color::Red)),
        Span::raw(", "),
        Span::styled(format!("{} inconclusive", ended.inconclusive), Style::new().fg(Color::Yellow)),
        Span::raw(format!("   trials {}", ended.trials)),
    ];
    if subject.jobs > 1 {
        spans.push(Span::raw(format!("   one of {} at once is shown", subject.jobs)));
    }
    frame.render_widget(Line::from(spans), area);
}

/// What was said last.
pub(super) fn message(frame: &mut Frame<'_>, area: Rect, scope: &Scope) {
    let last = scope.messages.last().map_or("", String::as_str);
    frame.render_widget(Line::raw(format!(" {last}")), area);
}

/// What was said on standard error.
pub(super) fn messages(frame: &mut Frame<'_>, area: Rect, scope: &Scope) {
    let block = Block::bordered().title(" messages ");
    let inner = block.inner(area);
    frame.render_widget(block, area);
    let room = usize::from(inner.height);
    let newest = scope.messages.iter().skip(scope.messages.len().saturating_sub(room));
    frame.render_widget(Paragraph::new(newest.map(|line| Line::raw(line.as_str())).collect::<Vec<_>>()), inner);
}

/// What can be done.
pub(super) fn keys(frame: &mut Frame<'_>, area: Rect, scope: &Scope) {
    frame.render_widget(Line::styled(format!(" {}", scope.subject.keys), Style::new().reversed()), area);
}
