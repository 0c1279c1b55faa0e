//! Tests sessions with an operator at a terminal, a board on a pseudo-terminal, and a killed bench.

use super::{copy_folder, plan_text, read_session_record, run_session, session_folder, verify};
use crate::terminal::TestTerminal;
use crate::test_folder::{TestFolder, controller_rig, step_text, wait_until};
use platebench_lab::acceptance::SessionRecord;
use platebench_model::record::Verdict;
use std::fs;
use std::path::Path;

/// Starts the program in a terminal that is large enough for its whole output.
fn start(folder: &TestFolder, arguments: &[&str]) -> TestTerminal {
    TestTerminal::start(folder.path(), [200, 500], arguments, &[])
}

/// The second scenario takes long enough for a kill of the bench while it runs.
fn long_session_folder() -> TestFolder {
    let folder = session_folder();
    let expect = "metric = \"settling_time_ms\"\nat_most = 100.0\nrequirement = \"R-1\"";
    folder.write_scenario("slow.toml", &step_text(expect).replace("duration_ms = 60.0", "duration_ms = 6000.0"));
    folder.write("plan.toml", &plan_text(&["s.toml", "slow.toml"], 5));
    folder
}

fn complete_trace_count(folder: &Path) -> usize {
    let entries = fs::read_dir(folder).into_iter().flatten().flatten();
    entries.filter(|entry| entry.path().extension().is_some_and(|extension| extension == "csv")).count()
}

#[test]
fn a_session_killed_twice_resumes_and_verifies() {
    let folder = long_session_folder();
    let rig = controller_rig(None);
    let session = ["acceptance", "run", "--plan", "plan.toml", "--rig", &rig, "--sign", "key.pem"];
    let mut first = start(&folder, &[&session[..], &["--out", "record"]].concat());
    first.answer("operator?", "A. Tester\n");
    first.answer("Where does the session take place?", "Lab 2\n");
    first.answer("Notes?", "\n");
    first.answer("near the plate?", "perhaps\n");
    first.wait_for_terminal_text("yes or no?");
    first.child.kill();
    let record = read_session_record(&folder);
    assert_eq!(
        (record.details.operator.as_deref(), record.details.place.as_deref(), &record.details.notes),
        (Some("A. Tester"), Some("Lab 2"), &None)
    );
    assert!(record.steps[0].done && !record.steps[1].done);
    assert_eq!(record.steps[1].attempts.len(), 1);

    let mut second = start(&folder, &[&session[..], &["--resume", "record"]].concat());
    second.answer("near the plate?", "yes\n");
    let record_folder = folder.join("record");
    let traces = record_folder.join("steps/06-slow/traces/slow");
    wait_until("no complete trial", || complete_trace_count(&traces) >= 1);
    assert!(!second.text().contains("operator?"));
    second.child.kill();
    let record = read_session_record(&folder);
    let done: Vec<bool> = record.steps.iter().map(|step| step.done).collect();
    assert_eq!(done, [true, true, true, true, true, false]);
    verify(&folder, "record", &[]).assert_text(3, &["the session is not finished"]);
    // Copies the state after a kill between two steps, when the next step has no files yet.
    copy_folder(&record_folder, &folder.join("between"));
    let mut earlier = record.clone();
    earlier.steps[5].attempts.clear();
    folder.write("between/session.json", &serde_json::to_string_pretty(&earlier).unwrap());
    fs::remove_dir_all(folder.join("between/steps/06-slow")).unwrap();

    let sealed_step = folder.read("record/steps/05-s/run.json");
    for name in ["record", "between"] {
        let mut again = start(&folder, &[&session[..], &["--out", name]].concat());
        again.wait_for_exit(&[0, 3]);
        assert!(!again.text().contains("near the plate?"), "{}", again.text());
        verify(&folder, name, &["--key", "public.pem"]).assert_text(0, &["the given key"]);
    }
    let record = read_session_record(&folder);
    assert_eq!(record.resumed.len(), 2);
    // On a busy machine, an answer may be lost, which makes the evidence inconclusive.
    let evidence = &record.requirements[0].evidence;
    let excused = |reason: &Option<String>| reason.as_ref().is_some_and(|reason| reason.starts_with("rig"));
    assert!(evidence.iter().all(|it| it.verdict == Verdict::Pass || excused(&it.reason)), "{evidence:?}");
    let attempts: Vec<usize> = record.steps.iter().map(|step| step.attempts.len()).collect();
    assert_eq!(attempts, [1, 2, 1, 1, 1, 2]);
    assert!(record.steps[5].attempts[0].ended.is_none() && record.steps[5].attempts[1].ended.is_some());
    assert_eq!(complete_trace_count(&traces), 5);
    assert_eq!(folder.read("record/steps/05-s/run.json"), sealed_step, "a finished step is not changed");
    assert!(folder.read("record/record.html").contains("started 2 times"));

    // After a kill between verdict and seal, resuming seals the session without a rig.
    for name in ["manifest.sha256", "manifest.sha256.sig"] {
        fs::remove_file(record_folder.join(name)).unwrap();
    }
    folder.bench([&session[..], &["--resume", "record", "--yes"]].concat()).assert_exit_in(&[0, 3]);
    assert_eq!(read_session_record(&folder).verdict, record.verdict);
    verify(&folder, "record", &["--key", "public.pem"]).assert_text(0, &["the given key"]);
}

#[test]
fn end_of_input_does_not_confirm() {
    let folder = session_folder();
    let arguments =
        ["acceptance", "run", "--plan", "plan.toml", "--operator", "A", "--place", "B", "--notes", "C", "--out"];
    let rig = controller_rig(None);
    for (name, rig, message, steps) in [
        ("real", rig.as_str(), "may drive a plate", 1),
        ("record", "hosted", "02-ask-safe  inconclusive, no answer", 5),
    ] {
        let call: Vec<&str> = arguments.iter().chain(&[name, "--rig", rig]).copied().collect();
        let mut session = start(&folder, &call);
        session.answer("near the plate?", "\u{4}");
        session.wait_for_exit(&[3]);
        session.assert_text(message);
        let record = SessionRecord::read(&folder.join(name)).unwrap();
        assert_eq!(record.steps.iter().filter(|step| step.done).count(), steps);
    }
}

#[test]
fn a_question_without_an_answer_is_not_called_done() {
    let folder = session_folder();
    let number = "[[ask]]\nid = \"degrees\"\nquestion = \"Which temperature?\"\nanswer = \"number\"\n";
    folder.write("plan.toml", &folder.read("plan.toml").replace("[[scenario]]", &format!("{number}[[scenario]]")));
    let session = run_session(&folder, &["--yes"]);
    session.assert_output(&["02-ask-safe  pass", "03-ask-degrees  no answer"]);
}

#[test]
fn a_no_ends_the_session_and_ctrl_c_allows_resuming() {
    let folder = long_session_folder();
    let arguments = ["acceptance", "run", "--plan", "plan.toml", "--out", "record", "--operator", "A", "--place", "B"];
    let hosted: Vec<&str> = arguments.iter().chain(&["--notes", "C", "--rig", "hosted"]).copied().collect();
    let mut first = start(&folder, &hosted);
    first.answer("near the plate?", "no\n");
    first.wait_for_exit(&[3]);
    first.assert_text("the answer was no");
    let record = read_session_record(&folder);
    assert!(!record.steps[1].done && record.steps[1].answer.is_none());
    assert!(record.steps[1].attempts[0].broken_off.as_ref().unwrap().contains("the answer was no"));

    let mut second = start(&folder, &hosted);
    second.wait_for_terminal_text("near the plate?");
    second.child.signal("INT");
    second.wait_for_exit(&[130]);
    let mut third = start(&folder, &hosted);
    third.answer("near the plate?", "yes\n");
    third.wait_for_terminal_text("06-slow");
    third.child.signal("TERM");
    third.wait_for_exit(&[143]);
    let record = read_session_record(&folder);
    assert!(record.steps[4].done && !record.steps[5].done && !record.complete);
    assert!(!folder.exists("record/manifest.sha256"));
    let text = folder.read("record/session.json");
    let build = &record.firmware.as_ref().unwrap().firmware.build;
    folder.write("record/session.json", &text.replace(build.as_str(), "0123456789abcdef"));
    folder.bench(&hosted).assert_text(2, &["the firmware is ", "start a new session"]);
    assert_eq!(read_session_record(&folder).steps[5].attempts.len(), record.steps[5].attempts.len());
    folder.write("record/session.json", &text);
    let run = folder.read("record/steps/05-s/run.json");
    folder.write("record/steps/05-s/run.json", &format!("{run} "));
    folder.bench(&hosted).assert_text(2, &["steps/05-s/run.json is "]);
    folder.write("record/steps/05-s/run.json", &run);
    folder.bench(&hosted).assert_text(0, &["pass"]);
}
