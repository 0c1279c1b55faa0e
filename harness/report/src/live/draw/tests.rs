use super::*;
use crate::live::events::RunDescription;
use crate::live::view_state::FinishedCounts;
use insta::assert_snapshot;
use platebench_engine::live_tap::{TapCounts, TapRow};
use platebench_engine::{Clock, Pacing, RunPlan, TimeBase};
use platebench_model::record::{Overrides, VerdictCounts};
use platebench_model::trace::{Flags, Row};
use platebench_test_kit::load_scenario;
use ratatui::Terminal;
use ratatui::backend::TestBackend;
use ratatui::buffer::Buffer;
use ratatui::style::Color;
use std::sync::Arc;

fn run_description() -> RunDescription {
    let mut scenario = load_scenario("paper/fig13-closed-loop.toml");
    scenario.title = "Step to 2 µm with both loops closed".to_owned();
    scenario.trials.count = 30;
    let clock = Clock::RealTime(TimeBase { time_scale: 1.0, pacing: Pacing::Bench });
    let (rig, scenarios) = ("exec:controller {port}".parse().unwrap(), vec![scenario.clone(), scenario]);
    let plan = RunPlan::new(&rig, clock, 1, scenarios, Overrides::default());
    let key_help = "q or Ctrl-C ends the run, with the plate at 0 V";
    RunDescription { command: "run", key_help, plan: Arc::new(plan), has_end: true }
}

fn change_plan(state: &mut ViewState, change: impl FnOnce(&mut RunPlan)) {
    change(Arc::make_mut(&mut state.run.plan));
}

/// First-order step: the amplitude has a time constant of 0.65 ms, the frequency one of 4 ms.
fn row(t_s: f64) -> Row {
    let left = (-t_s / 0.65e-3).exp();
    let [wd_um, wq_um] = [2.0 * (1.0 - left), -0.4 * left * (t_s * 2e3).sin()];
    Row {
        t_s,
        setpoint_um: 2.0,
        wd_um,
        wq_um,
        amplitude_um: wd_um.hypot(wq_um),
        drive_vpp: 287.0 * (1.0 + 1.5 * left),
        frequency_hz: 32_307.6 - 86.7 * (-t_s / 4e-3).exp(),
        resonance_hz: 32_307.6,
        lateness_us: 3.0,
        flags: Flags::CONTROL,
        ..Row::default()
    }
}

fn view_state() -> ViewState {
    let mut state = ViewState::new(run_description());
    (0..900).for_each(|number| state.add_row(&TapRow { scenario: 0, trial: 3, row: row(f64::from(number) * 5e-5) }));
    state.counts = TapCounts {
        rows: 123_456,
        dropped_rows: 7,
        overruns: 2,
        missed_replies: 1,
        rejected_frames: 0,
        lateness: [9_000, 2_500, 700, 120, 40, 9, 0, 0, 3, 0, 0, 1, 0, 0, 0, 0],
    };
    state.finished = FinishedCounts { trials: 1, scenarios: VerdictCounts { passed: 1, ..VerdictCounts::default() } };
    state.messages = (1..=4).map(|number| format!("note {number}")).collect();
    state
}

fn draw_on(state: &ViewState, width: u16, height: u16) -> Terminal<TestBackend> {
    let mut terminal = Terminal::new(TestBackend::new(width, height)).unwrap();
    terminal.draw(|frame| draw(frame, state)).unwrap();
    terminal
}

fn screen_lines(buffer: &Buffer) -> Vec<String> {
    let rows = buffer.content.chunks(buffer.area.width.into());
    rows.map(|row| row.iter().map(ratatui::buffer::Cell::symbol).collect()).collect()
}

#[test]
fn the_smallest_screen() {
    assert_snapshot!(draw_on(&view_state(), 80, 24).backend());
}

#[test]
fn a_large_screen() {
    assert_snapshot!(draw_on(&view_state(), 200, 50).backend());
}

#[test]
fn reports_a_screen_that_is_too_small() {
    assert_snapshot!(draw_on(&view_state(), 40, 10).backend());
}

#[test]
fn lockstep_with_parallel_trials() {
    let mut state = view_state();
    change_plan(&mut state, |plan| (plan.clock, plan.jobs) = (Clock::Lockstep { wire_time: false }, 2));
    assert_snapshot!(draw_on(&state, 80, 24).backend());
}

#[test]
fn before_the_first_row() {
    assert_snapshot!(draw_on(&ViewState::new(run_description()), 80, 24).backend());
}

const EXPECTED_WORDS: [&str; 14] = [
    "run   trial 4 of 30   paper/fig13-closed-loop.toml",
    "0.0450 of 0.06 s",
    "Step to 2 µm with both loops closed",
    "|W| in µm, dots; 5 % band 1.90 to 2.10, ---",
    "Wd in µm, dots; Wq in µm, ooo",
    "in band",
    "287.0 Vpp  32%",
    "32307.6 Hz",
    "lateness of control instants",
    "rows 123456, of these not shown 7   overruns 2   misses 1   CRC errors 0",
    "1 of 2 scenarios judged: 1 pass, 0 fail, 0 inconclusive   trials 1",
    "note 4",
    "q or Ctrl-C ends the run",
    "finger 0.00 N, plate +0.0 K",
];

#[test]
fn all_texts_fit_on_every_large_enough_screen() {
    let state = view_state();
    for (width, height) in [(80, 24), (81, 25), (100, 30), (139, 60), (140, 35), (140, 36), (200, 50), (300, 100)] {
        let terminal = draw_on(&state, width, height);
        let lines = screen_lines(terminal.backend().buffer());
        for word in EXPECTED_WORDS {
            assert!(
                lines.iter().any(|line| line.contains(word)),
                "{width}x{height} lacks `{word}`:\n{}",
                lines.join("\n")
            );
        }
    }
}

#[test]
fn draws_on_a_screen_of_any_size() {
    let state = view_state();
    for (width, height) in (1..82).flat_map(|width| [1, 2, 3, 10, 23, 24, 25].map(|height| (width, height))) {
        let terminal = draw_on(&state, width, height);
        let is_small = width < MIN_SIZE[0] || height < MIN_SIZE[1];
        let is_reported = screen_lines(terminal.backend().buffer()).iter().any(|line| line.contains("is too small"));
        let has_room = usize::from(width) >= format!("{width} x {height} is too small").len();
        assert_eq!(is_reported, is_small && has_room, "{width}x{height}");
    }
}

#[test]
fn red_states_also_appear_as_words() {
    let mut outside = view_state();
    outside.add_row(&TapRow {
        scenario: 0,
        trial: 3,
        row: Row { amplitude_um: 1.0, flags: Flags::LINK_LOST | Flags::SATURATED, ..row(0.05) },
    });
    let terminal = draw_on(&outside, 200, 50);
    let buffer = terminal.backend().buffer();
    assert!(buffer.content.iter().any(|cell| cell.fg == Color::Red));
    let words = screen_lines(buffer).join("\n");
    assert!(words.contains("OUTSIDE") && words.contains("no reply"), "{words}");
}

#[test]
fn the_edges_of_the_band_are_inside_it() {
    for (amplitude_um, expected) in [(1.9, true), (1.899, false), (2.1, true), (2.101, false)] {
        let mut state = view_state();
        state.add_row(&TapRow { scenario: 0, trial: 3, row: Row { amplitude_um, ..row(0.05) } });
        let lines = screen_lines(draw_on(&state, 80, 24).backend().buffer()).join("\n");
        assert_eq!((lines.contains("in band"), lines.contains("OUTSIDE")), (expected, !expected), "{amplitude_um} µm");
    }
}

#[test]
fn setpoint_zero_has_no_band() {
    let mut state = view_state();
    state.add_row(&TapRow { scenario: 0, trial: 3, row: Row { setpoint_um: 0.0, ..row(0.05) } });
    let lines = screen_lines(draw_on(&state, 80, 24).backend().buffer()).join("\n");
    assert!(lines.contains("2.000 µm no band") && !lines.contains("5 % band"), "{lines}");
}

#[test]
fn another_trial_or_restarted_time_clears_the_history() {
    let mut state = view_state();
    let peak = |state: &ViewState| state.history.range(&[platebench_model::trace::Column::Wq]).unwrap()[0];
    assert!(peak(&state) < -0.1);
    let settled = |t_s: f64| Row { t_s, ..row(1.0) };
    state.add_row(&TapRow { scenario: 0, trial: 4, row: settled(0.05) });
    assert!(peak(&state).abs() < 1e-6, "another trial");
    state.add_row(&TapRow { scenario: 0, trial: 4, row: Row { wq_um: -1.0, ..settled(0.06) } });
    state.add_row(&TapRow { scenario: 0, trial: 4, row: settled(0.0) });
    assert!(peak(&state).abs() < 1e-6, "the same trial again");
}

#[test]
fn a_trial_without_end_shows_its_last_seconds() {
    let mut state = view_state();
    state.run.has_end = false;
    (0..40_000).for_each(|ms| {
        let at = f64::from(ms) / 1e3;
        state.add_row(&TapRow { scenario: 0, trial: 0, row: Row { t_s: at, ..row(1.0) } });
    });
    let [from, to] = state.history.span_s();
    assert!((to - from - 10.0).abs() < 1e-9 && (to - 40.0).abs() < 0.05, "{from} {to}");
    let lines = screen_lines(draw_on(&state, 80, 24).backend().buffer()).join("\n");
    assert!(lines.contains("39.999 s") && !lines.contains("trial 1 of"), "{lines}");
}

#[test]
fn draws_non_finite_values() {
    for odd in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY, 1e300, -1e300, 0.0] {
        let mut state = view_state();
        let row = Row { amplitude_um: odd, drive_vpp: odd, frequency_hz: odd, setpoint_um: odd, ..row(0.05) };
        state.add_row(&TapRow { scenario: 0, trial: 3, row });
        draw_on(&state, 200, 50);
    }
    let mut unknown = view_state();
    unknown.add_row(&TapRow { scenario: 99, trial: 0, row: row(0.0) });
    draw_on(&unknown, 80, 24);
}

#[test]
fn merged_lateness_classes_keep_all_counts() {
    let classes = std::array::from_fn(|class| 1 << class);
    for most in 1..20 {
        let groups = panels::group_lateness_classes(&classes, most);
        assert!(groups.len() <= most, "{most}: {groups:?}");
        assert_eq!(groups.iter().map(|(_, count)| count).sum::<u64>(), (1 << 16) - 1, "{most}");
    }
    let names =
        |most| panels::group_lateness_classes(&classes, most).into_iter().map(|(name, _)| name).collect::<Vec<_>>();
    assert_eq!(names(4), ["<8 µs", "<128 µs", "<2 ms", ">=2 ms"]);
    assert_eq!(names(16)[..2], ["<1 µs", "<2 µs"]);
    assert_eq!(names(16)[14..], ["<16 ms", ">=16 ms"]);
}

#[test]
fn trials_beyond_the_plan_have_no_total() {
    for (trial, expected) in [(29, "trial 30 of 30 "), (30, "trial 31   paper")] {
        let mut state = view_state();
        state.add_row(&TapRow { scenario: 0, trial, row: row(0.0) });
        let lines = screen_lines(draw_on(&state, 80, 24).backend().buffer());
        assert!(lines[0].contains(expected), "{}", lines[0]);
    }
}

#[test]
fn a_long_name_is_cut_before_the_time() {
    let mut state = view_state();
    change_plan(&mut state, |plan| plan.scenarios[0].file = "long/".repeat(40));
    let lines = screen_lines(draw_on(&state, 80, 24).backend().buffer());
    assert!(lines[0].contains("trial 4 of 30   long/") && lines[0].ends_with("long 0.0450 of 0.06 s "), "{}", lines[0]);
}
