//! A picture of what was seen. Colour only repeats what characters and words say, and crossterm leaves it out where `NO_COLOR` is set.
//!
//! ```text
//!   80 × 24 and up                       140 × 36 and up
//!   command, scenario, trial, time       command, scenario, trial, time
//!   title, rig, how it goes              title, rig, how it goes
//!   ┌ |W|, band ─────────┐┌ now ────┐    ┌ |W|, band ┐┌ Wd, Wq ───┐┌ now ────┐
//!   └────────────────────┘│         │    └───────────┘└───────────┘├ lateness┤
//!   ┌ Wd, Wq ────────────┐├ lateness┤    ┌ drive ────┐┌ frequency ┐├ messages┤
//!   └────────────────────┘└─────────┘    └───────────┘└───────────┘└─────────┘
//!   counts, scenarios, last message, keys
//! ```

mod charts;
mod panels;

use crate::scope::Scope;
use ratatui::Frame;
use ratatui::layout::{Constraint, Layout, Rect};
use ratatui::text::Line;
use ratatui::widgets::Paragraph;

/// The smallest screen that has room for everything, columns and rows.
const SMALLEST: [u16; 2] = [80, 24];
/// From here on every signal has a chart of its own.
const LARGE: [u16; 2] = [140, 36];
const PANEL_WIDTH: u16 = 31;
const LARGE_PANEL_WIDTH: u16 = 44;

/// Draws everything that was seen.
pub(crate) fn draw(frame: &mut Frame<'_>, scope: &Scope) {
    let area = frame.area();
    if area.width < SMALLEST[0] || area.height < SMALLEST[1] {
        too_small(frame, area);
        return;
    }
    let [head, title, body, counts, ended, message, keys] = Layout::vertical([
        Constraint::Length(1),
        Constraint::Length(1),
        Constraint::Fill(1),
        Constraint::Length(1),
        Constraint::Length(1),
        Constraint::Length(1),
        Constraint::Length(1),
    ])
    .areas(area);
    panels::head(frame, head, scope);
    panels::title(frame, title, scope);
    if area.width >= LARGE[0] && area.height >= LARGE[1] {
        large(frame, body, scope);
    } else {
        small(frame, body, scope);
    }
    panels::counts(frame, counts, scope);
    panels::ended(frame, ended, scope);
    panels::message(frame, message, scope);
    panels::keys(frame, keys, scope);
}

fn small(frame: &mut Frame<'_>, body: Rect, scope: &Scope) {
    let [left, right] = Layout::horizontal([Constraint::Fill(1), Constraint::Length(PANEL_WIDTH)]).areas(body);
    let [above, below] = Layout::vertical([Constraint::Fill(5), Constraint::Fill(4)]).areas(left);
    charts::amplitude(frame, above, scope);
    charts::components(frame, below, scope);
    let [now, lateness] = Layout::vertical([Constraint::Length(11), Constraint::Fill(1)]).areas(right);
    panels::now(frame, now, scope);
    panels::lateness(frame, lateness, scope);
}

fn large(frame: &mut Frame<'_>, body: Rect, scope: &Scope) {
    let halves = || [Constraint::Fill(1), Constraint::Fill(1)];
    let [left, right] = Layout::horizontal([Constraint::Fill(1), Constraint::Length(LARGE_PANEL_WIDTH)]).areas(body);
    let [above, below] = Layout::vertical(halves()).areas(left);
    let [amplitude, components] = Layout::horizontal(halves()).areas(above);
    let [drive, frequency] = Layout::horizontal(halves()).areas(below);
    charts::amplitude(frame, amplitude, scope);
    charts::components(frame, components, scope);
    charts::drive(frame, drive, scope);
    charts::frequency(frame, frequency, scope);
    let [now, lateness, messages] =
        Layout::vertical([Constraint::Length(11), Constraint::Max(18), Constraint::Fill(1)]).areas(right);
    panels::now(frame, now, scope);
    panels::lateness(frame, lateness, scope);
    panels::messages(frame, messages, scope);
}

/// Says so instead of breaking.
fn too_small(frame: &mut Frame<'_>, area: Rect) {
    let [width, height] = SMALLEST;
    let lines = vec![
        Line::raw(format!("{} x {} is too small", area.width, area.height)),
        Line::raw(format!("the live view needs {width} x {height}")),
        Line::raw("the run goes on, q ends it"),
    ];
    let height = area.height.min(lines.len() as u16);
    let middle = Rect { y: area.y + (area.height - height) / 2, height, ..area };
    frame.render_widget(Paragraph::new(lines).centered(), middle);
}

#[cfg(test)]
mod tests;
