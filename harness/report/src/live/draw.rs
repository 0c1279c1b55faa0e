//! Draws the view in two layouts, by the size of the terminal. `draw/snapshots` contains examples.
//! Colour only repeats information of the text.

mod charts;
mod panels;

use crate::live::view_state::ViewState;
use ratatui::Frame;
use ratatui::layout::{Constraint, Layout, Rect};
use ratatui::text::Line;
use ratatui::widgets::Paragraph;

const MIN_SIZE: [u16; 2] = [80, 24];
/// From this size on, the view also has charts of drive and frequency.
const LARGE_SIZE: [u16; 2] = [140, 36];
const PANEL_WIDTH: u16 = 31;
const LARGE_PANEL_WIDTH: u16 = 44;

pub(crate) fn draw(frame: &mut Frame<'_>, state: &ViewState) {
    let area = frame.area();
    if area.width < MIN_SIZE[0] || area.height < MIN_SIZE[1] {
        draw_too_small(frame, area);
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
    panels::draw_head(frame, head, state);
    panels::draw_title(frame, title, state);
    if area.width >= LARGE_SIZE[0] && area.height >= LARGE_SIZE[1] {
        draw_large(frame, body, state);
    } else {
        draw_small(frame, body, state);
    }
    panels::draw_counts(frame, counts, state);
    panels::draw_finished(frame, ended, state);
    panels::draw_last_message(frame, message, state);
    panels::draw_key_help(frame, keys, state);
}

fn draw_small(frame: &mut Frame<'_>, body: Rect, state: &ViewState) {
    let [left, right] = Layout::horizontal([Constraint::Fill(1), Constraint::Length(PANEL_WIDTH)]).areas(body);
    let [above, below] = Layout::vertical([Constraint::Fill(5), Constraint::Fill(4)]).areas(left);
    charts::draw_amplitude(frame, above, state);
    charts::draw_components(frame, below, state);
    let [now, lateness] = Layout::vertical([Constraint::Length(11), Constraint::Fill(1)]).areas(right);
    panels::draw_newest_row(frame, now, state);
    panels::draw_lateness(frame, lateness, state);
}

fn draw_large(frame: &mut Frame<'_>, body: Rect, state: &ViewState) {
    let halves = || [Constraint::Fill(1), Constraint::Fill(1)];
    let [left, right] = Layout::horizontal([Constraint::Fill(1), Constraint::Length(LARGE_PANEL_WIDTH)]).areas(body);
    let [above, below] = Layout::vertical(halves()).areas(left);
    let [amplitude, components] = Layout::horizontal(halves()).areas(above);
    let [drive, frequency] = Layout::horizontal(halves()).areas(below);
    charts::draw_amplitude(frame, amplitude, state);
    charts::draw_components(frame, components, state);
    charts::draw_drive(frame, drive, state);
    charts::draw_frequency(frame, frequency, state);
    let [now, lateness, messages] =
        Layout::vertical([Constraint::Length(11), Constraint::Max(18), Constraint::Fill(1)]).areas(right);
    panels::draw_newest_row(frame, now, state);
    panels::draw_lateness(frame, lateness, state);
    panels::draw_messages(frame, messages, state);
}

fn draw_too_small(frame: &mut Frame<'_>, area: Rect) {
    let [width, height] = MIN_SIZE;
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
