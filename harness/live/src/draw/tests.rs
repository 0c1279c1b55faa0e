use super::*;
use crate::subject::{Show, Subject};
use crate::view::Told;
use insta::assert_snapshot;
use platebench_runner::watch::{Counts, Sight};
use platebench_trace::{Flags, Row};
use platebench_verdict::Verdict;
use ratatui::Terminal;
use ratatui::backend::TestBackend;
use ratatui::buffer::Buffer;
use ratatui::style::Color;

fn subject() -> Subject {
    let show = Show {
        file: "paper/fig13-closed-loop.toml".to_owned(),
        title: "Step to 2 µm with both loops closed".to_owned(),
        law: "dq-pi".to_owned(),
        duration_s: Some(0.06),
        trials: 30,
        spacing_s: 5e-5,
        band_percent: 5.0,
        limit_vpp: 900.0,
    };
    let other = Show { file: "paper/force-ramp.toml".to_owned(), duration_s: None, ..show.clone() };
    Subject {
        command: "run",
        place: "exec:controller {port}".to_owned(),
        lockstep: false,
        jobs: 1,
        keys: "q or Ctrl-C ends the run, with the plate at 0 V",
        shows: vec![show, other],
    }
}

/// The paper's step as it looks from outside: first order with 0.65 ms, the frequency found meanwhile.
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

fn scope() -> Scope {
    let mut scope = Scope::new(subject());
    (0..900).for_each(|number| scope.see(&Sight { scenario: 0, trial: 3, row: row(f64::from(number) * 5e-5) }));
    scope.counts = Counts {
        rows: 123_456,
        dropped: 7,
        overruns: 2,
        misses: 1,
        refused: 0,
        lateness: [9_000, 2_500, 700, 120, 40, 9, 0, 0, 3, 0, 0, 1, 0, 0, 0, 0],
    };
    scope.hear(Told::TrialEnded);
    scope.hear(Told::Judged(Verdict::Pass));
    scope.messages = (1..=4).map(|number| format!("note {number}")).collect();
    scope
}

fn drawn(scope: &Scope, width: u16, height: u16) -> Terminal<TestBackend> {
    let mut terminal = Terminal::new(TestBackend::new(width, height)).unwrap();
    terminal.draw(|frame| draw(frame, scope)).unwrap();
    terminal
}

fn text(buffer: &Buffer) -> Vec<String> {
    let rows = buffer.content.chunks(buffer.area.width.into());
    rows.map(|row| row.iter().map(ratatui::buffer::Cell::symbol).collect()).collect()
}

#[test]
fn the_smallest_screen() {
    assert_snapshot!(drawn(&scope(), 80, 24).backend());
}

#[test]
fn a_large_screen() {
    assert_snapshot!(drawn(&scope(), 200, 50).backend());
}

#[test]
fn a_screen_that_is_too_small_says_so() {
    assert_snapshot!(drawn(&scope(), 40, 10).backend());
}

#[test]
fn in_lockstep_nobody_is_late_and_one_of_several_trials_is_shown() {
    let mut scope = scope();
    scope.subject.lockstep = true;
    scope.subject.jobs = 2;
    assert_snapshot!(drawn(&scope, 80, 24).backend());
}

#[test]
fn before_anything_is_played_the_screen_waits() {
    assert_snapshot!(drawn(&Scope::new(subject()), 80, 24).backend());
}

/// What has to be on every screen that has room for it, as a whole.
const WORDS: [&str; 14] = [
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
fn nothing_is_cut_or_overlaps_on_any_screen_that_is_large_enough() {
    let scope = scope();
    for (width, height) in [(80, 24), (81, 25), (100, 30), (139, 60), (140, 35), (140, 36), (200, 50), (300, 100)] {
        let terminal = drawn(&scope, width, height);
        let lines = text(terminal.backend().buffer());
        for word in WORDS {
            assert!(
                lines.iter().any(|line| line.contains(word)),
                "{width}x{height} lacks `{word}`:\n{}",
                lines.join("\n")
            );
        }
    }
}

#[test]
fn a_screen_of_any_size_is_drawn() {
    let scope = scope();
    for (width, height) in (1..82).flat_map(|width| [1, 2, 3, 10, 23, 24, 25].map(|height| (width, height))) {
        let terminal = drawn(&scope, width, height);
        let is_small = width < SMALLEST[0] || height < SMALLEST[1];
        let says_so = text(terminal.backend().buffer()).iter().any(|line| line.contains("is too small"));
        let has_room = usize::from(width) >= format!("{width} x {height} is too small").len();
        assert_eq!(says_so, is_small && has_room, "{width}x{height}");
    }
}

#[test]
fn what_is_red_is_said_in_words_as_well() {
    let mut outside = scope();
    outside.see(&Sight {
        scenario: 0,
        trial: 3,
        row: Row { amplitude_um: 1.0, flags: Flags::LINK_LOST | Flags::SATURATED, ..row(0.05) },
    });
    let terminal = drawn(&outside, 200, 50);
    let buffer = terminal.backend().buffer();
    assert!(buffer.content.iter().any(|cell| cell.fg == Color::Red));
    let words = text(buffer).join("\n");
    assert!(words.contains("OUTSIDE") && words.contains("no reply"), "{words}");
}

#[test]
fn the_edges_of_the_band_are_inside_it() {
    for (amplitude_um, expected) in [(1.9, true), (1.899, false), (2.1, true), (2.101, false)] {
        let mut scope = scope();
        scope.see(&Sight { scenario: 0, trial: 3, row: Row { amplitude_um, ..row(0.05) } });
        let lines = text(drawn(&scope, 80, 24).backend().buffer()).join("\n");
        assert_eq!((lines.contains("in band"), lines.contains("OUTSIDE")), (expected, !expected), "{amplitude_um} µm");
    }
}

#[test]
fn where_nothing_is_wished_for_there_is_no_band_to_be_outside_of() {
    let mut scope = scope();
    scope.see(&Sight { scenario: 0, trial: 3, row: Row { setpoint_um: 0.0, ..row(0.05) } });
    let lines = text(drawn(&scope, 80, 24).backend().buffer()).join("\n");
    assert!(lines.contains("2.000 µm no band") && !lines.contains("5 % band"), "{lines}");
}

#[test]
fn another_trial_and_time_that_begins_anew_start_a_new_picture() {
    let mut scope = scope();
    let peak = |scope: &Scope| scope.history.range(&[crate::history::Signal::Wq]).unwrap()[0];
    assert!(peak(&scope) < -0.1);
    let settled = |t_s: f64| Row { t_s, ..row(1.0) };
    scope.see(&Sight { scenario: 0, trial: 4, row: settled(0.05) });
    assert!(peak(&scope).abs() < 1e-6, "another trial");
    scope.see(&Sight { scenario: 0, trial: 4, row: Row { wq_um: -1.0, ..settled(0.06) } });
    scope.see(&Sight { scenario: 0, trial: 4, row: settled(0.0) });
    assert!(peak(&scope).abs() < 1e-6, "the same trial again");
}

#[test]
fn a_trial_without_end_shows_its_last_seconds() {
    let mut scope = scope();
    (0..40_000).for_each(|ms| {
        let at = f64::from(ms) / 1e3;
        scope.see(&Sight { scenario: 1, trial: 0, row: Row { t_s: at, ..row(1.0) } });
    });
    let [from, to] = scope.history.span_s();
    assert!((to - from - 10.0).abs() < 1e-9 && (to - 40.0).abs() < 0.05, "{from} {to}");
    let lines = text(drawn(&scope, 80, 24).backend().buffer()).join("\n");
    assert!(lines.contains("39.999 s") && !lines.contains("trial 1 of"), "{lines}");
}

#[test]
fn odd_values_break_no_picture() {
    for odd in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY, 1e300, -1e300, 0.0] {
        let mut scope = scope();
        let row = Row { amplitude_um: odd, drive_vpp: odd, frequency_hz: odd, setpoint_um: odd, ..row(0.05) };
        scope.see(&Sight { scenario: 0, trial: 3, row });
        drawn(&scope, 200, 50);
    }
    let mut unknown = scope();
    unknown.see(&Sight { scenario: 99, trial: 0, row: row(0.0) });
    drawn(&unknown, 80, 24);
}

#[test]
fn classes_of_lateness_are_put_together_without_losing_any() {
    let classes = std::array::from_fn(|class| 1 << class);
    for most in 1..20 {
        let groups = panels::grouped(&classes, most);
        assert!(groups.len() <= most, "{most}: {groups:?}");
        assert_eq!(groups.iter().map(|(_, count)| count).sum::<u64>(), (1 << 16) - 1, "{most}");
    }
    let names = |most| panels::grouped(&classes, most).into_iter().map(|(name, _)| name).collect::<Vec<_>>();
    assert_eq!(names(4), ["<8 µs", "<128 µs", "<2 ms", ">=2 ms"]);
    assert_eq!(names(16)[..2], ["<1 µs", "<2 µs"]);
    assert_eq!(names(16)[14..], ["<16 ms", ">=16 ms"]);
}

#[test]
fn trials_beyond_the_planned_ones_are_not_counted_against_them() {
    for (trial, expected) in [(29, "trial 30 of 30 "), (30, "trial 31   paper")] {
        let mut scope = scope();
        scope.see(&Sight { scenario: 0, trial, row: row(0.0) });
        let lines = text(drawn(&scope, 80, 24).backend().buffer());
        assert!(lines[0].contains(expected), "{}", lines[0]);
    }
}

#[test]
fn a_long_name_is_cut_before_the_time() {
    let mut scope = scope();
    scope.subject.shows[0].file = "long/".repeat(40);
    let lines = text(drawn(&scope, 80, 24).backend().buffer());
    assert!(lines[0].contains("trial 4 of 30   long/") && lines[0].ends_with("long 0.0450 of 0.06 s "), "{}", lines[0]);
}
