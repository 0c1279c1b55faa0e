//! Tests the live view through a terminal.

use crate::terminal::{LARGE, SMALL, TestTerminal};
use crate::test_folder::{
    ChildGuard, SLOW_REAL_TIME, TestFolder, assert_same_traces, controller_rig, run_bench, step_text, workspace_root,
};
use rstest::rstest;
use std::process::Command;

const EXPECT: &str = "metric = \"overshoot_percent\"\nat_most = 100.0";

fn run_folder(duration_ms: &str) -> TestFolder {
    let duration = format!("duration_ms = {duration_ms}");
    TestFolder::with_scenario(&step_text(EXPECT).replace("duration_ms = 60.0", &duration))
}

fn start_live_run(folder: &TestFolder, size: [u16; 2], rig: &str, more: &[&str]) -> TestTerminal {
    let arguments = ["run", "--live", "--out", "run", "--rig", rig];
    TestTerminal::start(folder.path(), size, arguments.iter().chain(&SLOW_REAL_TIME).chain(more), &[])
}

#[rstest]
#[case::small(SMALL)]
#[case::large(LARGE)]
fn a_live_run_is_shown_and_the_terminal_restored(#[case] size: [u16; 2]) {
    let folder = run_folder("60.0");
    let mut terminal = start_live_run(&folder, size, &controller_rig(None), &[]);
    terminal.wait_for_view_text("trial 1 of 1");
    terminal.wait_for_view_text("in band");
    for text in ["s.toml", "5 % band", "Wd in µm", "frequency", "resonance", "lateness", "CRC errors 0", "overruns"] {
        terminal.wait_for_view_text(text);
    }
    println!("{}", terminal.text());
    assert!(terminal.is_alternate());
    terminal.wait_for_exit(&[0, 3]);
    terminal.assert_text("run folder: run");
    assert!(!terminal.text().contains("5 % band"), "{}", terminal.text());
}

#[rstest]
#[case::hang_up("HUP", 129)]
#[case::interrupt("INT", 130)]
#[case::terminate("TERM", 143)]
fn a_signal_restores_the_terminal(#[case] name: &str, #[case] expected: i32) {
    let folder = run_folder("60000.0");
    let mut terminal = start_live_run(&folder, SMALL, &controller_rig(None), &[]);
    terminal.wait_for_view_text("trial 1 of 1");
    terminal.child.signal(name);
    terminal.wait_for_exit(&[expected]);
    terminal.assert_text("the run was cancelled");
}

#[rstest]
#[case::quit("q")]
#[case::interrupt("\u{3}")]
fn keys_end_a_run_as_ctrl_c_does(#[case] key: &str) {
    let folder = run_folder("60000.0");
    let log = folder.join("controller.log");
    let mut terminal = start_live_run(&folder, SMALL, &controller_rig(Some(&log)), &[]);
    terminal.wait_for_view_text("trial 1 of 1");
    terminal.type_keys(key);
    terminal.wait_for_exit(&[130]);
    assert_eq!(folder.record("run").safe_confirmed, Some(true), "{}", folder.read("controller.log"));
}

#[test]
fn a_closed_terminal_ends_the_run() {
    let folder = run_folder("60000.0");
    let mut terminal = start_live_run(&folder, SMALL, &controller_rig(None), &[]);
    terminal.wait_for_view_text("trial 1 of 1");
    let mut child = terminal.close();
    child.wait_for_exit(&[129]);
    assert_eq!(folder.record("run").safe_confirmed, Some(true));
}

#[test]
fn a_failed_run_restores_the_terminal() {
    let folder = run_folder("60.0");
    let mut terminal = start_live_run(&folder, SMALL, "exec:false {port}", &[]);
    terminal.wait_for_exit(&[5]);
    terminal.assert_text("exit status 1");
}

#[test]
fn a_terminal_may_change_its_size() {
    let folder = run_folder("60000.0");
    let mut terminal = start_live_run(&folder, LARGE, &controller_rig(None), &[]);
    terminal.wait_for_view_text("excitation in Hz");
    for (size, text) in [([40, 10], "40 x 10 is too small"), ([79, 24], "79 x 24 is too small"), (SMALL, "5 % band")] {
        terminal.resize(size);
        terminal.wait_for_view_text(text);
    }
    terminal.type_keys("q");
    terminal.wait_for_exit(&[130]);
}

#[test]
fn stderr_of_a_controller_is_printed_after_the_view() {
    let folder = run_folder("60.0");
    let quiet = controller_rig(None);
    let noisy = quiet.replacen("exec:", "exec:sh -c 'echo NOISE >&2; exec \"$0\" \"$@\"' ", 1);
    let mut terminal = start_live_run(&folder, SMALL, &noisy, &[]);
    terminal.wait_for_view_text("trial 1 of 1");
    let at = terminal.text().lines().position(|line| line.trim_end().ends_with("NOISE"));
    assert_eq!(at, Some(22), "the line above the keys:\n{}", terminal.text());
    terminal.wait_for_exit(&[0, 3]);
    terminal.assert_text("NOISE");
}

#[test]
fn no_color_disables_colours() {
    let folder = run_folder("60000.0");
    for (environment, expected) in [(vec![], true), (vec![("NO_COLOR", "1")], false)] {
        let arguments = ["run", "--live", "--rig", "hosted"];
        let mut terminal =
            TestTerminal::start(folder.path(), SMALL, arguments.iter().chain(&SLOW_REAL_TIME), &environment);
        terminal.wait_for_view_text("in band");
        assert_eq!(terminal.has_colour(), expected, "{environment:?}");
        terminal.type_keys("q");
        terminal.wait_for_exit(&[130]);
    }
}

#[test]
fn the_live_view_does_not_change_traces() {
    let folder = tempfile::tempdir().unwrap();
    let paper = workspace_root().join("scenarios/paper");
    let arguments = ["run", paper.to_str().unwrap(), "--rig", "hosted", "--jobs", "2", "--out"];
    run_bench(folder.path(), arguments.iter().chain(&["plain"])).assert_exit(0);
    let mut terminal = TestTerminal::start(folder.path(), SMALL, arguments.iter().chain(&["watched", "--live"]), &[]);
    terminal.wait_for_exit(&[0]);
    assert_same_traces(folder.path(), ["plain", "watched"]);
}

#[rstest]
#[case::auto(&[], &[], true)]
#[case::variable(&[], &[("NO_COLOR", "1")], false)]
#[case::never(&["--color", "never"], &[], false)]
#[case::always(&["--color", "always"], &[("NO_COLOR", "1")], true)]
fn a_terminal_has_colours_unless_they_are_off(
    #[case] more: &[&str],
    #[case] environment: &[(&str, &str)],
    #[case] expected: bool,
) {
    let folder = run_folder("60.0");
    let arguments = ["run", "--rig", "hosted", "--out", "run"];
    let mut terminal = TestTerminal::start(folder.path(), SMALL, arguments.iter().chain(more), environment);
    terminal.wait_for_exit(&[0]);
    terminal.assert_text("verdict: ✓ pass");
    assert_eq!(terminal.has_colour(), expected);
}

#[test]
fn progress_is_one_line_that_disappears() {
    let folder = run_folder("60.0");
    folder.write_scenario("t.toml", &folder.read("scenarios/s.toml"));
    let arguments = ["run", "--out", "run", "--rig", &controller_rig(None)];
    let mut terminal = TestTerminal::start(folder.path(), SMALL, arguments.iter().chain(&SLOW_REAL_TIME), &[]);
    terminal.wait_for_terminal_text("1/2 trials");
    assert_eq!(terminal.text().matches("trials").count(), 1, "{}", terminal.text());
    terminal.wait_for_exit(&[0, 3]);
    assert!(!terminal.text().contains("/2 trials"), "{}", terminal.text());
}

#[test]
fn a_dumb_terminal_shows_no_view() {
    let folder = run_folder("60.0");
    let arguments = ["run", "--rig", "hosted", "--live"];
    let mut terminal = TestTerminal::start(folder.path(), SMALL, arguments, &[("TERM", "dumb")]);
    terminal.wait_for_exit(&[0]);
    terminal.assert_text("TERM=dumb");
}

#[test]
fn plate_serve_shows_the_plate_and_takes_keys() {
    let folder = run_folder("60.0");
    let arguments = ["plate", "serve", "--live", "--port", "pty", "--scenario", "scenarios/s.toml"];
    let mut terminal = TestTerminal::start(folder.path(), SMALL, arguments, &[]);
    terminal.wait_for_view_text("waiting for a controller");
    terminal.wait_for_view_text("/dev/pts/");
    let text = terminal.text();
    let port = text.split_whitespace().find(|word| word.starts_with("/dev/pts/")).unwrap();
    let controller = Command::new(env!("CARGO_BIN_EXE_controller-under-test")).arg(port).spawn().unwrap();
    let _controller = ChildGuard(controller);
    terminal.wait_for_view_text("plate serve   scenarios/s.toml");
    for (key, text) in [("F", "finger 0.25 N"), ("T", "plate +1.0 K"), ("r", "finger 0.00 N, plate +0.0 K")] {
        terminal.type_keys(key);
        terminal.wait_for_view_text(text);
    }
    println!("{}", terminal.text());
    terminal.type_keys("q");
    terminal.wait_for_exit(&[0]);
}

#[test]
fn a_session_restores_the_terminal_for_its_questions() {
    let folder = run_folder("20.0");
    let plan = "title = \"A tiny acceptance\"\nrepetitions = 3\n\
                [[requirement]]\nid = \"R-1\"\ntext = \"It settles.\"\n\
                [[ask]]\nid = \"safe\"\nquestion = \"Is no person near the plate?\"\n\
                [[scenario]]\nfile = \"scenarios/s.toml\"\n[bench]\ntiming_trials = 1\nclean_runs = 2\n";
    folder.write("plan.toml", plan);
    folder.write_scenario("s.toml", &format!("{}requirement = \"R-1\"\n", folder.read("scenarios/s.toml")));
    let answers = ["--operator", "A. Tester", "--place", "Lab 2", "--notes", "none"];
    let arguments = ["acceptance", "run", "--live", "--plan", "plan.toml", "--out", "record", "--rig", "hosted"];
    // Every line of the session fits, so that the question is still on the screen at the end.
    let mut terminal =
        TestTerminal::start(folder.path(), LARGE, arguments.iter().chain(&answers).chain(&SLOW_REAL_TIME), &[]);
    terminal.answer("near the plate?", "yes\n");
    terminal.wait_for_view_text("acceptance run   trial 2 of 3   s.toml");
    terminal.wait_for_exit(&[0, 3]);
    terminal.assert_text("record: record/");
    terminal.assert_text("near the plate? [yes/no] yes");
}
