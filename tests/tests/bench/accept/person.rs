//! A person at a terminal, a board on a pseudo-terminal, and a bench that is killed.

use super::{copied, expect, plan_text, record, workshop};
use crate::bench::{Guarded, Workshop, await_that, call, code, controller, program, step_scenario};
use platebench_verdict::Verdict;
use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};
use std::fs::{self, File, OpenOptions};
use std::io::{Read, Write};
use std::path::Path;
use std::process::Stdio;
use std::sync::{Arc, Mutex};
use std::thread;

/// The program in a terminal of its own.
struct AtTerminal {
    child: Guarded,
    keys: File,
    screen: Arc<Mutex<String>>,
    /// How much of the screen was waited for.
    seen: usize,
}

impl AtTerminal {
    fn start(folder: &Path, arguments: &[&str]) -> Self {
        let master = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY).unwrap();
        grantpt(&master).unwrap();
        unlockpt(&master).unwrap();
        let path = ptsname(&master, Vec::new()).unwrap().into_string().unwrap();
        let terminal = || OpenOptions::new().read(true).write(true).open(&path).unwrap();
        let mut command = program(folder);
        command.args(arguments).stdin(terminal()).stderr(terminal()).stdout(Stdio::from(terminal()));
        let child = Guarded(command.spawn().unwrap());
        let keys = File::from(master);
        let mut output = keys.try_clone().unwrap();
        let screen = Arc::new(Mutex::new(String::new()));
        let shown = Arc::clone(&screen);
        // Ends once nobody has the terminal open any more.
        thread::spawn(move || {
            let mut bytes = [0; 4096];
            while let Ok(count @ 1..) = output.read(&mut bytes) {
                shown.lock().unwrap().push_str(&String::from_utf8_lossy(&bytes[..count]));
            }
        });
        Self { child, keys, screen, seen: 0 }
    }

    fn screen(&self) -> String {
        self.screen.lock().unwrap().clone()
    }

    #[track_caller]
    fn sees(&mut self, text: &str) {
        let mut at = None;
        await_that(&format!("nobody asks {text}"), || {
            at = self.screen().get(self.seen..).and_then(|fresh| fresh.find(text));
            at.is_some()
        });
        self.seen += at.unwrap() + text.len();
    }

    fn types(&mut self, text: &str) {
        self.keys.write_all(text.as_bytes()).unwrap();
    }

    #[track_caller]
    fn ends(mut self, exits: &[i32]) -> String {
        await_that("it does not end", || self.child.0.try_wait().unwrap().is_some());
        let code = self.child.0.wait().unwrap().code().unwrap();
        assert!(exits.contains(&code), "{code}: {}", self.screen());
        self.screen()
    }

    fn killed(mut self) {
        self.child.0.kill().unwrap();
        self.child.0.wait().unwrap();
    }
}

/// Two scenarios; the second takes so long that the bench can be killed within it.
fn long() -> Workshop {
    let workshop = workshop();
    let expect = "metric = \"settling_time_ms\"\nat_most = 100.0\nrequirement = \"R-1\"";
    let slow = step_scenario("aluminium-198x138", "", "", expect).replace("duration_ms = 60.0", "duration_ms = 900.0");
    workshop.scenario("slow.toml", &slow);
    fs::write(workshop.path().join("plan.toml"), plan_text(&["s.toml", "slow.toml"], 8)).unwrap();
    workshop
}

fn whole_traces(folder: &Path) -> usize {
    let entries = fs::read_dir(folder).into_iter().flatten().flatten();
    entries.filter(|entry| entry.path().extension().is_some_and(|extension| extension == "csv")).count()
}

#[test]
fn a_session_at_a_terminal_is_killed_twice_taken_up_again_and_verified() {
    let workshop = long();
    let rig = controller(None);
    let begin = ["accept", "--plan", "plan.toml", "--out", "record", "--rig", &rig, "--sign", "key.pem"];
    let mut first = AtTerminal::start(workshop.path(), &begin);
    first.sees("operator?");
    first.types("A. Tester\n");
    first.sees("Where is this?");
    first.types("Lab 2\n");
    first.sees("Notes?");
    first.types("\n");
    first.sees("near the plate?");
    first.types("perhaps\n");
    first.sees("yes or no?");
    // Killed while it waits for an answer.
    first.killed();
    let made = record(&workshop);
    assert_eq!(
        (made.operator.as_deref(), made.place.as_deref(), &made.notes),
        (Some("A. Tester"), Some("Lab 2"), &None)
    );
    assert!(made.steps[0].done && !made.steps[1].done);
    assert_eq!(made.steps[1].attempts.len(), 1);

    // What was answered is not asked again; what was begun is.
    let resume = ["accept", "--plan", "plan.toml", "--resume", "record", "--rig", &rig, "--sign", "key.pem"];
    let mut second = AtTerminal::start(workshop.path(), &resume);
    second.sees("near the plate?");
    second.types("yes\n");
    let record_folder = workshop.path().join("record");
    let traces = record_folder.join("steps/06-slow/traces/slow");
    await_that("no trial became whole", || whole_traces(&traces) >= 2);
    assert!(!second.screen().contains("operator?"));
    // Killed within a scenario.
    second.killed();
    let made = record(&workshop);
    let done: Vec<bool> = made.steps.iter().map(|step| step.done).collect();
    assert_eq!(done, [true, true, true, true, true, false]);
    expect(&call(workshop.path(), ["accept", "verify", "record"]), 3, &["not come to its end"]);
    // The same, had it been killed between two steps: nothing of the next one is there yet.
    let between = workshop.path().join("between");
    copied(&record_folder, &between);
    let mut earlier = made.clone();
    earlier.steps[5].attempts.clear();
    fs::write(between.join("session.json"), serde_json::to_vec_pretty(&earlier).unwrap()).unwrap();
    fs::remove_dir_all(between.join("steps/06-slow")).unwrap();

    let sealed_step = fs::read(record_folder.join("steps/05-s/run.json")).unwrap();
    for name in ["record", "between"] {
        let resume = ["accept", "--plan", "plan.toml", "--out", name, "--rig", &rig, "--sign", "key.pem"];
        let told = AtTerminal::start(workshop.path(), &resume).ends(&[0, 3]);
        assert!(!told.contains("near the plate?"), "{told}");
        expect(&call(workshop.path(), ["accept", "verify", name, "--key", "public.pem"]), 0, &["the given key"]);
    }
    let made = record(&workshop);
    assert_eq!(made.resumed.len(), 2);
    // On a machine with much else to do the line may lose an answer, which is a doubt and no failure.
    let evidence = &made.requirements[0].evidence;
    let excused = |reason: &Option<String>| reason.as_ref().is_some_and(|reason| reason.starts_with("rig"));
    assert!(evidence.iter().all(|found| found.verdict == Verdict::Pass || excused(&found.reason)), "{evidence:?}");
    let attempts: Vec<usize> = made.steps.iter().map(|step| step.attempts.len()).collect();
    assert_eq!(attempts, [1, 2, 1, 1, 1, 2]);
    assert!(made.steps[5].attempts[0].ended.is_none() && made.steps[5].attempts[1].ended.is_some());
    assert_eq!(whole_traces(&traces), 8);
    assert_eq!(
        fs::read(record_folder.join("steps/05-s/run.json")).unwrap(),
        sealed_step,
        "what was done is left alone"
    );
    assert!(fs::read_to_string(record_folder.join("record.html")).unwrap().contains("begun 2 times"));

    // Killed after all was judged and before it was sealed: sealed without a rig.
    for name in ["manifest.sha256", "manifest.sha256.sig"] {
        fs::remove_file(record_folder.join(name)).unwrap();
    }
    let resume = ["accept", "--plan", "plan.toml", "--resume", "record", "--rig", &rig, "--yes", "--sign", "key.pem"];
    let resealed = call(workshop.path(), resume);
    assert!([0, 3].contains(&code(&resealed)));
    assert_eq!(record(&workshop).verdict, made.verdict);
    expect(&call(workshop.path(), ["accept", "verify", "record", "--key", "public.pem"]), 0, &["the given key"]);
}

#[test]
fn an_end_of_input_is_no_yes() {
    let workshop = workshop();
    let arguments = ["accept", "--plan", "plan.toml", "--operator", "A", "--place", "B", "--notes", "C", "--out"];
    let rig = controller(None);
    for (name, rig, told, steps) in [
        ("real", rig.as_str(), "may drive a plate", 1),
        ("record", "hosted", "02-ask-safe  inconclusive, nobody answered", 5),
    ] {
        let call: Vec<&str> = arguments.iter().chain(&[name, "--rig", rig]).copied().collect();
        let mut session = AtTerminal::start(workshop.path(), &call);
        session.sees("near the plate?");
        // Ctrl-D.
        session.types("\u{4}");
        let screen = session.ends(&[3]);
        assert!(screen.contains(told), "{screen}");
        let made = platebench_acceptance::SessionRecord::read(&workshop.path().join(name)).unwrap();
        assert_eq!(made.steps.iter().filter(|step| step.done).count(), steps);
    }
}

#[test]
fn a_no_stops_the_session_and_ctrl_c_leaves_it_to_be_taken_up_again() {
    let workshop = long();
    let arguments = ["accept", "--plan", "plan.toml", "--out", "record", "--operator", "A", "--place", "B"];
    let hosted: Vec<&str> = arguments.iter().chain(&["--notes", "C", "--rig", "hosted"]).copied().collect();
    let mut first = AtTerminal::start(workshop.path(), &hosted);
    first.sees("near the plate?");
    first.types("no\n");
    assert!(first.ends(&[3]).contains("the answer was no"));
    let made = record(&workshop);
    assert!(!made.steps[1].done && made.steps[1].answer.is_none());
    assert!(made.steps[1].attempts[0].broken_off.as_ref().unwrap().contains("the answer was no"));

    let mut second = AtTerminal::start(workshop.path(), &hosted);
    second.sees("near the plate?");
    crate::bench::signal(&second.child.0, "INT");
    second.ends(&[130]);
    let mut third = AtTerminal::start(workshop.path(), &hosted);
    third.sees("near the plate?");
    third.types("yes\n");
    third.sees("06-slow");
    crate::bench::signal(&third.child.0, "TERM");
    third.ends(&[143]);
    let made = record(&workshop);
    assert!(made.steps[4].done && !made.steps[5].done && !made.complete);
    assert!(!workshop.path().join("record/manifest.sha256").exists());
    // Another firmware, and evidence that is not what was left, are refused.
    let path = workshop.path().join("record/session.json");
    let text = fs::read_to_string(&path).unwrap();
    let build = &made.firmware.as_ref().unwrap().firmware.build;
    fs::write(&path, text.replace(build.as_str(), "0123456789abcdef")).unwrap();
    expect(&call(workshop.path(), &hosted), 2, &["the firmware is ", "never mixes the two"]);
    assert_eq!(
        record(&workshop).steps[5].attempts.len(),
        made.steps[5].attempts.len(),
        "refused before anything is played"
    );
    fs::write(&path, &text).unwrap();
    let run = workshop.path().join("record/steps/05-s/run.json");
    let whole = fs::read(&run).unwrap();
    fs::write(&run, [whole.clone(), b" ".to_vec()].concat()).unwrap();
    expect(&call(workshop.path(), &hosted), 2, &["steps/05-s/run.json is "]);
    fs::write(&run, whole).unwrap();
    expect(&call(workshop.path(), &hosted), 0, &["pass"]);
}
