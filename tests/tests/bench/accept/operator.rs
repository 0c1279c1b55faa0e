//! A person at a terminal, a board on a pseudo-terminal, and a bench that is killed.

use super::{assert_output, copy_folder, plan_text, read_session_record, session_folder};
use crate::test_folder::{
    ChildGuard, TestFolder, bench_command, controller_rig, exit_code, run_bench, step_scenario, wait_until,
};
use platebench_record::Verdict;
use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};
use std::fs::{self, File, OpenOptions};
use std::io::{Read, Write};
use std::path::Path;
use std::process::Stdio;
use std::sync::{Arc, Mutex};
use std::thread;

/// The program in a terminal of its own.
struct OperatorTerminal {
    child: ChildGuard,
    keys: File,
    screen: Arc<Mutex<String>>,
    /// How much of the screen was waited for.
    read_to: usize,
}

impl OperatorTerminal {
    fn start(folder: &Path, arguments: &[&str]) -> Self {
        let master = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY).unwrap();
        grantpt(&master).unwrap();
        unlockpt(&master).unwrap();
        let path = ptsname(&master, Vec::new()).unwrap().into_string().unwrap();
        let terminal = || OpenOptions::new().read(true).write(true).open(&path).unwrap();
        let mut command = bench_command(folder);
        command.args(arguments).stdin(terminal()).stderr(terminal()).stdout(Stdio::from(terminal()));
        let child = ChildGuard(command.spawn().unwrap());
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
        Self { child, keys, screen, read_to: 0 }
    }

    fn screen(&self) -> String {
        self.screen.lock().unwrap().clone()
    }

    #[track_caller]
    fn wait_for_text(&mut self, text: &str) {
        let mut at = None;
        wait_until(&format!("nobody asks {text}"), || {
            at = self.screen().get(self.read_to..).and_then(|fresh| fresh.find(text));
            at.is_some()
        });
        self.read_to += at.unwrap() + text.len();
    }

    fn type_keys(&mut self, text: &str) {
        self.keys.write_all(text.as_bytes()).unwrap();
    }

    #[track_caller]
    fn wait_for_exit(mut self, exits: &[i32]) -> String {
        wait_until("it does not end", || self.child.0.try_wait().unwrap().is_some());
        let code = self.child.0.wait().unwrap().code().unwrap();
        assert!(exits.contains(&code), "{code}: {}", self.screen());
        self.screen()
    }

    fn kill(mut self) {
        self.child.0.kill().unwrap();
        self.child.0.wait().unwrap();
    }
}

/// Two scenarios; the second takes so long that the bench can be killed within it.
fn long_session_folder() -> TestFolder {
    let workshop = session_folder();
    let expect = "metric = \"settling_time_ms\"\nat_most = 100.0\nrequirement = \"R-1\"";
    let slow = step_scenario("aluminium-198x138", "", "", expect).replace("duration_ms = 60.0", "duration_ms = 900.0");
    workshop.write_scenario("slow.toml", &slow);
    fs::write(workshop.path().join("plan.toml"), plan_text(&["s.toml", "slow.toml"], 8)).unwrap();
    workshop
}

fn complete_trace_count(folder: &Path) -> usize {
    let entries = fs::read_dir(folder).into_iter().flatten().flatten();
    entries.filter(|entry| entry.path().extension().is_some_and(|extension| extension == "csv")).count()
}

#[test]
fn a_session_killed_twice_resumes_and_verifies() {
    let workshop = long_session_folder();
    let rig = controller_rig(None);
    let begin = ["accept", "--plan", "plan.toml", "--out", "record", "--rig", &rig, "--sign", "key.pem"];
    let mut first = OperatorTerminal::start(workshop.path(), &begin);
    first.wait_for_text("operator?");
    first.type_keys("A. Tester\n");
    first.wait_for_text("Where is this?");
    first.type_keys("Lab 2\n");
    first.wait_for_text("Notes?");
    first.type_keys("\n");
    first.wait_for_text("near the plate?");
    first.type_keys("perhaps\n");
    first.wait_for_text("yes or no?");
    // Killed while it waits for an answer.
    first.kill();
    let made = read_session_record(&workshop);
    assert_eq!(
        (made.operator.as_deref(), made.place.as_deref(), &made.notes),
        (Some("A. Tester"), Some("Lab 2"), &None)
    );
    assert!(made.steps[0].done && !made.steps[1].done);
    assert_eq!(made.steps[1].attempts.len(), 1);

    // What was answered is not asked again; what was begun is.
    let resume = ["accept", "--plan", "plan.toml", "--resume", "record", "--rig", &rig, "--sign", "key.pem"];
    let mut second = OperatorTerminal::start(workshop.path(), &resume);
    second.wait_for_text("near the plate?");
    second.type_keys("yes\n");
    let record_folder = workshop.path().join("record");
    let traces = record_folder.join("steps/06-slow/traces/slow");
    wait_until("no trial became whole", || complete_trace_count(&traces) >= 2);
    assert!(!second.screen().contains("operator?"));
    // Killed within a scenario.
    second.kill();
    let made = read_session_record(&workshop);
    let done: Vec<bool> = made.steps.iter().map(|step| step.done).collect();
    assert_eq!(done, [true, true, true, true, true, false]);
    assert_output(&run_bench(workshop.path(), ["accept", "verify", "record"]), 3, &["the session is not finished"]);
    // The same, had it been killed between two steps: nothing of the next one is there yet.
    let between = workshop.path().join("between");
    copy_folder(&record_folder, &between);
    let mut earlier = made.clone();
    earlier.steps[5].attempts.clear();
    fs::write(between.join("session.json"), serde_json::to_vec_pretty(&earlier).unwrap()).unwrap();
    fs::remove_dir_all(between.join("steps/06-slow")).unwrap();

    let sealed_step = fs::read(record_folder.join("steps/05-s/run.json")).unwrap();
    for name in ["record", "between"] {
        let resume = ["accept", "--plan", "plan.toml", "--out", name, "--rig", &rig, "--sign", "key.pem"];
        let told = OperatorTerminal::start(workshop.path(), &resume).wait_for_exit(&[0, 3]);
        assert!(!told.contains("near the plate?"), "{told}");
        assert_output(
            &run_bench(workshop.path(), ["accept", "verify", name, "--key", "public.pem"]),
            0,
            &["the given key"],
        );
    }
    let made = read_session_record(&workshop);
    assert_eq!(made.resumed.len(), 2);
    // On a machine with much else to do the line may lose an answer, which is a doubt and no failure.
    let evidence = &made.requirements[0].evidence;
    let excused = |reason: &Option<String>| reason.as_ref().is_some_and(|reason| reason.starts_with("rig"));
    assert!(evidence.iter().all(|found| found.verdict == Verdict::Pass || excused(&found.reason)), "{evidence:?}");
    let attempts: Vec<usize> = made.steps.iter().map(|step| step.attempts.len()).collect();
    assert_eq!(attempts, [1, 2, 1, 1, 1, 2]);
    assert!(made.steps[5].attempts[0].ended.is_none() && made.steps[5].attempts[1].ended.is_some());
    assert_eq!(complete_trace_count(&traces), 8);
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
    let resealed = run_bench(workshop.path(), resume);
    assert!([0, 3].contains(&exit_code(&resealed)));
    assert_eq!(read_session_record(&workshop).verdict, made.verdict);
    assert_output(
        &run_bench(workshop.path(), ["accept", "verify", "record", "--key", "public.pem"]),
        0,
        &["the given key"],
    );
}

#[test]
fn end_of_input_does_not_confirm() {
    let workshop = session_folder();
    let arguments = ["accept", "--plan", "plan.toml", "--operator", "A", "--place", "B", "--notes", "C", "--out"];
    let rig = controller_rig(None);
    for (name, rig, told, steps) in [
        ("real", rig.as_str(), "may drive a plate", 1),
        ("record", "hosted", "02-ask-safe  inconclusive, no answer", 5),
    ] {
        let call: Vec<&str> = arguments.iter().chain(&[name, "--rig", rig]).copied().collect();
        let mut session = OperatorTerminal::start(workshop.path(), &call);
        session.wait_for_text("near the plate?");
        // Ctrl-D.
        session.type_keys("\u{4}");
        let screen = session.wait_for_exit(&[3]);
        assert!(screen.contains(told), "{screen}");
        let made = platebench_acceptance::SessionRecord::read(&workshop.path().join(name)).unwrap();
        assert_eq!(made.steps.iter().filter(|step| step.done).count(), steps);
    }
}

#[test]
fn a_no_ends_the_session_and_ctrl_c_allows_resuming() {
    let workshop = long_session_folder();
    let arguments = ["accept", "--plan", "plan.toml", "--out", "record", "--operator", "A", "--place", "B"];
    let hosted: Vec<&str> = arguments.iter().chain(&["--notes", "C", "--rig", "hosted"]).copied().collect();
    let mut first = OperatorTerminal::start(workshop.path(), &hosted);
    first.wait_for_text("near the plate?");
    first.type_keys("no\n");
    assert!(first.wait_for_exit(&[3]).contains("the answer was no"));
    let made = read_session_record(&workshop);
    assert!(!made.steps[1].done && made.steps[1].answer.is_none());
    assert!(made.steps[1].attempts[0].broken_off.as_ref().unwrap().contains("the answer was no"));

    let mut second = OperatorTerminal::start(workshop.path(), &hosted);
    second.wait_for_text("near the plate?");
    crate::test_folder::send_signal(&second.child.0, "INT");
    second.wait_for_exit(&[130]);
    let mut third = OperatorTerminal::start(workshop.path(), &hosted);
    third.wait_for_text("near the plate?");
    third.type_keys("yes\n");
    third.wait_for_text("06-slow");
    crate::test_folder::send_signal(&third.child.0, "TERM");
    third.wait_for_exit(&[143]);
    let made = read_session_record(&workshop);
    assert!(made.steps[4].done && !made.steps[5].done && !made.complete);
    assert!(!workshop.path().join("record/manifest.sha256").exists());
    // Another firmware, and evidence that is not what was left, are refused.
    let path = workshop.path().join("record/session.json");
    let text = fs::read_to_string(&path).unwrap();
    let build = &made.firmware.as_ref().unwrap().firmware.build;
    fs::write(&path, text.replace(build.as_str(), "0123456789abcdef")).unwrap();
    assert_output(&run_bench(workshop.path(), &hosted), 2, &["the firmware is ", "never mixes the two"]);
    assert_eq!(
        read_session_record(&workshop).steps[5].attempts.len(),
        made.steps[5].attempts.len(),
        "refused before anything is played"
    );
    fs::write(&path, &text).unwrap();
    let run = workshop.path().join("record/steps/05-s/run.json");
    let whole = fs::read(&run).unwrap();
    fs::write(&run, [whole.clone(), b" ".to_vec()].concat()).unwrap();
    assert_output(&run_bench(workshop.path(), &hosted), 2, &["steps/05-s/run.json is "]);
    fs::write(&run, whole).unwrap();
    assert_output(&run_bench(workshop.path(), &hosted), 0, &["pass"]);
}
