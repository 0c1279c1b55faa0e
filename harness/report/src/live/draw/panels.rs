//! Draws the text panels.

use crate::live::view_state::{ViewState, band};
use platebench_engine::live_tap::LATENESS_CLASSES;
use platebench_model::trace::{Flags, Row};
use ratatui::Frame;
use ratatui::layout::Rect;
use ratatui::style::{Color, Style};
use ratatui::text::{Line, Span};
use ratatui::widgets::{Block, Paragraph, Wrap};

pub(super) fn draw_head(frame: &mut Frame<'_>, area: Rect, state: &ViewState) {
    let reversed = Style::new().reversed().bold();
    frame.render_widget(Block::new().style(reversed), area);
    let command = state.run.command;
    let Some((scenario, trial)) = state.current_trial() else {
        frame.render_widget(Line::styled(format!(" {command}"), reversed), area);
        return;
    };
    let t_s = state.newest_row.map_or(0.0, |row| row.t_s);
    let (which, when) = match state.duration_s(scenario) {
        // Interim looks may add trials to the planned number, so no total is shown.
        Some(duration_s) if trial > u64::from(scenario.trials.count) => {
            (format!("trial {trial}   "), format!("{t_s:.4} of {duration_s} s "))
        }
        Some(duration_s) => {
            (format!("trial {trial} of {}   ", scenario.trials.count), format!("{t_s:.4} of {duration_s} s "))
        }
        None => (String::new(), format!("{t_s:.3} s ")),
    };
    let room = (when.len() as u16).min(area.width);
    let right = Rect { x: area.right() - room, width: room, ..area };
    let left = Rect { width: area.width.saturating_sub(room + 1), ..area };
    frame.render_widget(Line::styled(format!(" {command}   {which}{}", scenario.file), reversed), left);
    frame.render_widget(Line::styled(when, reversed), right);
}

pub(super) fn draw_title(frame: &mut Frame<'_>, area: Rect, state: &ViewState) {
    let place = &state.rig;
    let text = match state.current_trial() {
        Some((scenario, _)) => format!(" {}   law {}   {place}", scenario.title, scenario.controller.law),
        None => format!(" waiting for the first sample   {place}"),
    };
    frame.render_widget(Line::raw(text), area);
}

pub(super) fn draw_newest_row(frame: &mut Frame<'_>, area: Rect, state: &ViewState) {
    let inner = draw_border(frame, area, " now ");
    let (Some((scenario, _)), Some(row)) = (state.current_trial(), state.newest_row) else { return };
    let (place, colour) = match band(scenario, row.setpoint_um) {
        None => ("no band", Color::Reset),
        Some([low, high]) if (low..=high).contains(&row.amplitude_um) => ("in band", Color::Green),
        Some(_) => ("OUTSIDE", Color::Red),
    };
    let limit_vpp = scenario.plate.drive_limit_vpp;
    let share = if limit_vpp > 0.0 { row.drive_vpp / limit_vpp } else { 0.0 };
    let detuning = row.frequency_hz - row.resonance_hz;
    let value = |name: &str, value: String, unit: &str| Line::raw(format!("{name:<9} {value:>8} {unit}"));
    let mut amplitude = value("|W|", format!("{:.3}", row.amplitude_um), "µm ");
    amplitude.push_span(Span::styled(place, Style::new().fg(colour)));
    let (state, colour) = controller_state(&row);
    let lines = vec![
        amplitude,
        value("Wd", format!("{:+.3}", row.wd_um), "µm"),
        value("Wq", format!("{:+.3}", row.wq_um), "µm"),
        value("drive", format!("{:.1}", row.drive_vpp), &format!("Vpp {:3.0}%", share * 100.0)),
        Line::raw(progress_bar(share, inner.width.into())),
        value("frequency", format!("{:.1}", row.frequency_hz), &format!("Hz {detuning:+.1}")),
        value("resonance", format!("{:.1}", row.resonance_hz), "Hz"),
        Line::raw(format!("finger {:.2} N, plate {:+.1} K", row.finger_force_n, row.temperature_offset_k)),
        Line::styled(state, Style::new().fg(colour)),
    ];
    frame.render_widget(Paragraph::new(lines), inner);
}

fn draw_border(frame: &mut Frame<'_>, area: Rect, title: &str) -> Rect {
    let block = Block::bordered().title(title);
    let inner = block.inner(area);
    frame.render_widget(block, area);
    inner
}

fn controller_state(row: &Row) -> (&'static str, Color) {
    let cases = [
        (Flags::SAFE, "controller stopped, 0 V", Color::Red),
        (Flags::LINK_LOST, "no reply", Color::Red),
        (Flags::OVERRUN, "bench was too late", Color::Red),
        (Flags::SATURATED, "drive at its limit", Color::Yellow),
    ];
    let found = cases.into_iter().find(|(flag, ..)| row.flags.contains(*flag));
    found.map_or(("controller runs", Color::Green), |(_, words, colour)| (words, colour))
}

fn progress_bar(share: f64, width: usize) -> String {
    let full = ((share.clamp(0.0, 1.0) * width as f64).round() as usize).min(width);
    "█".repeat(full) + &"░".repeat(width - full)
}

pub(super) fn draw_lateness(frame: &mut Frame<'_>, area: Rect, state: &ViewState) {
    let inner = draw_border(frame, area, " lateness of control instants ");
    if state.is_lockstep() {
        let text = "in lockstep the plate waits: there is no lateness";
        frame.render_widget(Paragraph::new(text).wrap(Wrap { trim: true }), inner);
        return;
    }
    let groups = group_lateness_classes(&state.counts.lateness, inner.height.into());
    let most = groups.iter().map(|(_, count)| *count).max().unwrap_or(0).max(1);
    let room = usize::from(inner.width).saturating_sub(10 + 10);
    let lines: Vec<Line<'_>> = groups
        .into_iter()
        .map(|(label, count)| {
            // Rounds up, so that a class with one count is visible.
            let length = (count as f64 / most as f64 * room as f64).ceil() as usize;
            Line::raw(format!("{label:>9} {:<room$} {count:>9}", "█".repeat(length.min(room))))
        })
        .collect();
    frame.render_widget(Paragraph::new(lines), inner);
}

/// Merges neighbouring classes into at most `most` groups. The last class has no upper limit.
pub(super) fn group_lateness_classes(classes: &[u64; LATENESS_CLASSES], most: usize) -> Vec<(String, u64)> {
    let size = LATENESS_CLASSES.div_ceil(most.max(1));
    let micros = |class: usize| match 1_u64 << class {
        us @ ..1_000 => format!("{us} µs"),
        us => format!("{} ms", us / 1_000),
    };
    let last = LATENESS_CLASSES.div_ceil(size) - 1;
    let groups = classes.chunks(size).enumerate();
    let named = groups.map(|(number, group)| {
        let from = number * size;
        let name = if number == last {
            format!(">={}", micros(from.max(1) - 1))
        } else {
            format!("<{}", micros(from + size - 1))
        };
        (name, group.iter().sum())
    });
    named.collect()
}

pub(super) fn draw_counts(frame: &mut Frame<'_>, area: Rect, state: &ViewState) {
    let counts = &state.counts;
    let bad = |name: &str, count: u64| {
        let style = if count > 0 { Style::new().fg(Color::Red) } else { Style::new() };
        Span::styled(format!("   {name} {count}"), style)
    };
    let line = Line::from(vec![
        Span::raw(format!(" rows {}, of these not shown {}", counts.rows, counts.dropped_rows)),
        bad("overruns", counts.overruns),
        bad("misses", counts.missed_replies),
        bad("CRC errors", counts.rejected_frames),
    ]);
    frame.render_widget(line, area);
}

pub(super) fn draw_finished(frame: &mut Frame<'_>, area: Rect, state: &ViewState) {
    let (ended, run) = (&state.finished.scenarios, &state.run.plan);
    if state.current_trial().is_some_and(|(scenario, _)| state.duration_s(scenario).is_none()) {
        return;
    }
    let mut spans = vec![
        Span::raw(format!(" {} of {} scenarios judged: ", ended.total(), run.scenarios.len())),
        Span::styled(format!("{} pass", ended.passed), Style::new().fg(Color::Green)),
        Span::raw(", "),
        Span::styled(format!("{} fail", ended.failed), Style::new().fg(Color::Red)),
        Span::raw(", "),
        Span::styled(format!("{} inconclusive", ended.inconclusive), Style::new().fg(Color::Yellow)),
        Span::raw(format!("   trials {}", state.finished.trials)),
    ];
    if run.jobs > 1 {
        spans.push(Span::raw(format!("   shows 1 of {} parallel trials", run.jobs)));
    }
    frame.render_widget(Line::from(spans), area);
}

pub(super) fn draw_last_message(frame: &mut Frame<'_>, area: Rect, state: &ViewState) {
    let last = state.messages.last().map_or("", String::as_str);
    frame.render_widget(Line::raw(format!(" {last}")), area);
}

pub(super) fn draw_messages(frame: &mut Frame<'_>, area: Rect, state: &ViewState) {
    let inner = draw_border(frame, area, " messages ");
    let room = usize::from(inner.height);
    let newest = state.messages.iter().skip(state.messages.len().saturating_sub(room));
    frame.render_widget(Paragraph::new(newest.map(|line| Line::raw(line.as_str())).collect::<Vec<_>>()), inner);
}

pub(super) fn draw_key_help(frame: &mut Frame<'_>, area: Rect, state: &ViewState) {
    frame.render_widget(Line::styled(format!(" {}", state.run.key_help), Style::new().reversed()), area);
}
