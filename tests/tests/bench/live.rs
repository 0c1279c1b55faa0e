//! The live view, seen as its user sees it: through a terminal.

mod seen;

use crate::bench::{Guarded, Workshop, await_that, call, code, controller, signal, step_scenario};
use crate::real_time::traces;
use rstest::rstest;
use seen::{LARGE, SMALL, Seen};
use std::fs;
use std::process::Command;

const EXPECT: &str = "metric = \"overshoot_percent\"\nat_most = 100.0";
/// A plate that is so slow that a busy machine does not stop its controller: it is patient for a quarter of a second.
const SLOW: [&str; 4] = ["--clock", "real-time", "--time-scale", "0.02"];

fn workshop(duration_ms: &str) -> Workshop {
    let workshop = Workshop::new();
    let text = step_scenario("aluminium-198x138", "", "", EXPECT);
    workshop.scenario("s.toml", &text.replace("duration_ms = 60.0", &format!("duration_ms = {duration_ms}")));
    workshop
}

fn started(workshop: &Workshop, size: [u16; 2], rig: &str, more: &[&str]) -> Seen {
    let arguments = ["run", "--live", "--out", "run", "--rig", rig];
    Seen::start(workshop.path(), size, arguments.iter().chain(&SLOW).chain(more), &[])
}

#[rstest]
#[case::small(SMALL)]
#[case::large(LARGE)]
fn a_run_is_shown_while_it_goes_on_and_the_terminal_is_given_back(#[case] size: [u16; 2]) {
    let workshop = workshop("60.0");
    let mut seen = started(&workshop, size, &controller(None), &[]);
    seen.shows("trial 1 of 1");
    seen.shows("in band");
    for text in ["s.toml", "5 % band", "Wd in µm", "frequency", "resonance", "lateness", "CRC errors 0", "overruns"] {
        seen.shows(text);
    }
    println!("{}", seen.text());
    assert!(seen.is_alternate());
    seen.ends(&[0, 3]);
    let after = seen.text();
    assert!(after.contains("run folder: run"), "{after}");
    assert!(!after.contains("5 % band"), "{after}");
}

#[rstest]
#[case::hang_up("HUP", 129)]
#[case::interrupt("INT", 130)]
#[case::terminate("TERM", 143)]
fn a_polite_end_gives_the_terminal_back(#[case] name: &str, #[case] expected: i32) {
    let workshop = workshop("60000.0");
    let mut seen = started(&workshop, SMALL, &controller(None), &[]);
    seen.shows("trial 1 of 1");
    signal(&seen.child.0, name);
    seen.ends(&[expected]);
    assert!(seen.text().contains("ended early"), "{}", seen.text());
}

#[rstest]
#[case::quit("q")]
#[case::interrupt("\u{3}")]
fn keys_end_a_run_as_ctrl_c_does(#[case] key: &str) {
    let workshop = workshop("60000.0");
    let log = workshop.path().join("controller.log");
    let mut seen = started(&workshop, SMALL, &controller(Some(&log)), &[]);
    seen.shows("trial 1 of 1");
    seen.types(key);
    seen.ends(&[130]);
    let record = platebench_verdict::RunRecord::read(&workshop.path().join("run")).unwrap();
    assert_eq!(record.safe_confirmed, Some(true), "{}", fs::read_to_string(&log).unwrap());
}

#[test]
fn a_terminal_that_is_closed_ends_the_run() {
    let workshop = workshop("60000.0");
    let mut seen = started(&workshop, SMALL, &controller(None), &[]);
    seen.shows("trial 1 of 1");
    let mut child = seen.close();
    await_that("it does not end", || child.0.try_wait().unwrap().is_some());
    assert_eq!(child.0.wait().unwrap().code(), Some(129));
    let record = platebench_verdict::RunRecord::read(&workshop.path().join("run")).unwrap();
    assert_eq!(record.safe_confirmed, Some(true));
}

#[test]
fn a_run_that_cannot_go_on_gives_the_terminal_back() {
    let workshop = workshop("60.0");
    let mut seen = started(&workshop, SMALL, "exec:false {port}", &[]);
    seen.ends(&[5]);
    assert!(seen.text().contains("exit status 1"), "{}", seen.text());
}

#[test]
fn a_terminal_may_change_its_size() {
    let workshop = workshop("60000.0");
    let mut seen = started(&workshop, LARGE, &controller(None), &[]);
    seen.shows("excitation in Hz");
    for (size, shown) in [([40, 10], "40 x 10 is too small"), ([79, 24], "79 x 24 is too small"), (SMALL, "5 % band")] {
        seen.resize(size);
        seen.shows(shown);
    }
    seen.types("q");
    seen.ends(&[130]);
}

#[test]
fn what_a_controller_program_says_stays_off_the_picture_and_is_said_again_afterwards() {
    let workshop = workshop("60.0");
    let quiet = controller(None);
    let noisy = quiet.replacen("exec:", "exec:sh -c 'echo NOISE >&2; exec \"$0\" \"$@\"' ", 1);
    let mut seen = started(&workshop, SMALL, &noisy, &[]);
    seen.shows("trial 1 of 1");
    let at = seen.text().lines().position(|line| line.trim() == "NOISE");
    assert_eq!(at, Some(22), "the line above the keys:\n{}", seen.text());
    seen.ends(&[0, 3]);
    assert!(seen.text().contains("NOISE"), "{}", seen.text());
}

#[test]
fn no_color_means_no_colour() {
    let workshop = workshop("60000.0");
    for (environment, expected) in [(vec![], true), (vec![("NO_COLOR", "1")], false)] {
        let arguments = ["run", "--live", "--rig", "hosted"];
        let mut seen = Seen::start(workshop.path(), SMALL, arguments.iter().chain(&SLOW), &environment);
        seen.shows("in band");
        assert_eq!(seen.has_colour(), expected, "{environment:?}");
        seen.types("q");
        seen.ends(&[130]);
    }
}

#[test]
fn a_view_changes_no_byte_of_a_trace() {
    let folder = tempfile::tempdir().unwrap();
    let paper = crate::bench::root().join("scenarios/paper");
    let arguments = ["run", paper.to_str().unwrap(), "--rig", "hosted", "--jobs", "2", "--out"];
    assert_eq!(code(&call(folder.path(), arguments.iter().chain(&["plain"]))), 0);
    let mut seen = Seen::start(folder.path(), SMALL, arguments.iter().chain(&["watched", "--live"]), &[]);
    seen.ends(&[0]);
    let [plain, watched] = ["plain", "watched"].map(|out| traces(&folder.path().join(out)));
    assert!(plain.len() > 20 && plain == watched);
}

#[rstest]
#[case::run(&["run", "--rig", "hosted"], 0)]
#[case::emulate(&["emulate", "--port", "pty", "--scenario", "scenarios/s.toml", "--seconds", "0.1"], 0)]
fn without_a_terminal_there_is_no_view_and_everything_else(#[case] arguments: &[&str], #[case] expected: i32) {
    let workshop = workshop("60.0");
    let output = call(workshop.path(), arguments.iter().chain(&["--live"]));
    let error = String::from_utf8_lossy(&output.stderr);
    assert_eq!(code(&output), expected, "{error}");
    assert!(error.contains("no live view: standard output is no terminal"), "{error}");
    assert!(!output.stdout.is_empty() && !output.stdout.contains(&0x1b));
}

#[test]
fn a_dumb_terminal_is_left_alone() {
    let workshop = workshop("60.0");
    let arguments = ["run", "--rig", "hosted", "--live"];
    let mut seen = Seen::start(workshop.path(), SMALL, arguments, &[("TERM", "dumb")]);
    seen.ends(&[0]);
    assert!(seen.text().contains("TERM=dumb"), "{}", seen.text());
}

#[test]
fn the_plate_alone_is_shown_and_pressed() {
    let workshop = workshop("60.0");
    let arguments = ["emulate", "--live", "--port", "pty", "--scenario", "scenarios/s.toml"];
    let mut seen = Seen::start(workshop.path(), SMALL, arguments, &[]);
    seen.shows("waiting for a controller");
    seen.shows("/dev/pts/");
    let text = seen.text();
    let port = text.split_whitespace().find(|word| word.starts_with("/dev/pts/")).unwrap();
    let controller = Command::new(env!("CARGO_BIN_EXE_controller-under-test")).arg(port).spawn().unwrap();
    let _controller = Guarded(controller);
    seen.shows("emulate   scenarios/s.toml");
    for (key, shown) in [("F", "finger 0.25 N"), ("T", "plate +1.0 K"), ("r", "finger 0.00 N, plate +0.0 K")] {
        seen.types(key);
        seen.shows(shown);
    }
    println!("{}", seen.text());
    seen.types("q");
    seen.ends(&[0]);
}

#[test]
fn a_session_shows_its_scenarios_and_gives_the_terminal_back_for_its_questions() {
    let workshop = workshop("20.0");
    let plan = "title = \"A tiny acceptance\"\nrepetitions = 3\n[[requirement]]\nid = \"R-1\"\ntext = \"It settles.\"\n\
                [[ask]]\nid = \"safe\"\nquestion = \"Is nobody near the plate?\"\n[[scenario]]\nfile = \"scenarios/s.toml\"\n\
                [bench]\ntiming_trials = 1\nclean_runs = 2\n";
    fs::write(workshop.path().join("plan.toml"), plan).unwrap();
    let text = fs::read_to_string(workshop.path().join("scenarios/s.toml")).unwrap();
    workshop.scenario("s.toml", &format!("{text}requirement = \"R-1\"\n"));
    let who = ["--operator", "A. Tester", "--place", "Lab 2", "--notes", "none"];
    let arguments = ["accept", "--live", "--plan", "plan.toml", "--out", "record", "--rig", "hosted"];
    let mut seen = Seen::start(workshop.path(), SMALL, arguments.iter().chain(&who).chain(&SLOW), &[]);
    seen.asks("near the plate?");
    seen.types("yes\n");
    seen.shows("accept   trial 2 of 3   s.toml");
    seen.ends(&[0, 3]);
    let after = seen.text();
    assert!(after.contains("record: record/") && after.contains("near the plate? [yes/no] yes"), "{after}");
}
