//! Acceptance sessions: conducted, cut off, taken up again, verified, doctored.

mod operator;
mod tampering;

use crate::test_folder::{TestFolder, controller_rig, exit_code, run_bench, step_scenario, workspace_root};
use ed25519_dalek::SigningKey;
use ed25519_dalek::pkcs8::spki::der::pem::LineEnding;
use ed25519_dalek::pkcs8::{EncodePrivateKey, EncodePublicKey};
use platebench_acceptance::{Plan, SessionRecord};
use platebench_record::Verdict;
use platebench_scenario::Limit;
use rstest::rstest;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

/// Both keys of a pair in PEM, made of `seed`; what they sign is tests.
fn key_pair(seed: u8) -> (String, String) {
    let key = SigningKey::from_bytes(&[seed; 32]);
    let public = key.verifying_key().to_public_key_pem(LineEnding::LF).unwrap();
    (key.to_pkcs8_pem(LineEnding::LF).unwrap().as_str().to_owned(), public)
}

const GOOD: &str = "metric = \"settling_time_ms\"\nat_most = 4.0\nrequirement = \"R-1\"";

fn plan_text(scenarios: &[&str], repetitions: u32) -> String {
    let scenarios: String = scenarios
        .iter()
        .map(|file| format!("[[scenario]]\nfile = \"scenarios/{file}\"\n"))
        .collect::<Vec<_>>()
        .concat();
    format!(
        "title = \"A tiny acceptance\"\nrepetitions = {repetitions}\n\
         [[requirement]]\nid = \"R-1\"\ntext = \"It settles.\"\n\
         [[ask]]\nid = \"safe\"\nquestion = \"Is nobody near the plate?\"\n\
         {scenarios}[bench]\ntiming_trials = 1\nclean_runs = 2\n"
    )
}

/// A workshop with a plan of one scenario, and keys.
fn session_folder() -> TestFolder {
    let workshop = TestFolder::new();
    workshop.write_scenario("s.toml", &step_scenario("aluminium-198x138-noisy", "", "", GOOD));
    let (secret, public) = key_pair(1);
    for (name, text) in [
        ("plan.toml", plan_text(&["s.toml"], 3)),
        ("key.pem", secret),
        ("public.pem", public),
        ("other.pem", key_pair(2).1),
    ] {
        fs::write(workshop.path().join(name), text).unwrap();
    }
    workshop
}

const SESSION: [&str; 7] = ["accept", "--plan", "plan.toml", "--out", "record", "--rig", "hosted"];

fn run_session(workshop: &TestFolder, more: &[&str]) -> Output {
    run_bench(workshop.path(), SESSION.iter().chain(more))
}

fn read_session_record(workshop: &TestFolder) -> SessionRecord {
    SessionRecord::read(&workshop.path().join("record")).unwrap()
}

#[track_caller]
fn output_text(output: &Output) -> String {
    String::from_utf8_lossy(&[output.stdout.clone(), output.stderr.clone()].concat()).into_owned()
}

#[track_caller]
fn assert_output(output: &Output, exit: i32, words: &[&str]) {
    let told = output_text(output);
    assert_eq!(exit_code(output), exit, "{told}");
    for word in words {
        assert!(told.contains(word), "{word:?} is not in: {told}");
    }
}

#[test]
fn a_session_is_sealed_signed_and_verified() {
    let workshop = session_folder();
    let said = ["--yes", "--sign", "key.pem", "--operator", "A. Tester", "--place", "Lab 2"];
    let output = run_session(&workshop, &said);
    assert_output(&output, 0, &["R-1", "pass", "no board was attached", "s.toml measured in 1 trial, not judged"]);
    let all = output_text(&output);
    let judged = all.lines().filter(|line| line.contains(" s.toml: ") && !line.starts_with('…')).count();
    assert_eq!(judged, 1, "only the controller's own runs are judged: {all}");
    let made = read_session_record(&workshop);
    assert!(made.complete && made.verdict == Verdict::Pass);
    assert_eq!((made.operator.as_deref(), made.notes), (Some("A. Tester"), None));
    assert_eq!(made.requirements[0].evidence.len(), 1);
    assert_eq!(made.steps[1].answer.as_ref().unwrap().from, "command-line");
    let folder = workshop.path().join("record");
    let runs = fs::read_dir(folder.join("steps/05-s/traces/s")).unwrap().count();
    assert_eq!(runs, 3, "as many trials as the plan's repetitions");
    let page = fs::read_to_string(folder.join("record.html")).unwrap();
    assert!(page.contains("It settles.") && page.contains("A. Tester") && page.contains("Reviewer"));
    assert!(
        page.contains("no board was attached")
            && page.contains("none (hosted)")
            && !page.contains("0x00000000, number")
    );
    let survived = made.steps[3].trust.clone().unwrap().survived;
    let reason = made.steps[3].reason.clone().unwrap();
    assert!(
        reason.contains("that the plan's 1 scenarios did not catch") && survived.contains(&"no-watchdog".to_owned()),
        "{reason}"
    );
    assert!(survived.iter().all(|name| page.contains(&format!("not caught: {name}, "))), "{survived:?}");

    assert_output(
        &run_bench(workshop.path(), ["accept", "verify", "record"]),
        0,
        &["which the record itself names", "verdict: pass", "no board was attached"],
    );
    assert_output(
        &run_bench(workshop.path(), ["accept", "verify", "record", "--key", "public.pem"]),
        0,
        &["the given key"],
    );
    let other = run_bench(workshop.path(), ["accept", "verify", "record", "--key", "other.pem"]);
    assert_output(&other, 1, &["manifest.sha256.sig: wrong"]);
    assert_output(
        &run_bench(workshop.path(), ["accept", "verify", "record", "--key", "plan.toml"]),
        2,
        &["plan.toml: not the ed25519 key"],
    );
    let secret = run_bench(workshop.path(), ["accept", "verify", "record", "--key", "key.pem"]);
    assert_output(&secret, 2, &["key.pem: ", "this is the secret key, expected the public one", "-pubout"]);
    assert_output(&run_bench(workshop.path(), ["accept", "verify", "scenarios"]), 2, &["no session"]);

    // What `sha256sum` says, where there is one.
    if let Ok(sums) =
        Command::new("sha256sum").args(["-c", "--strict", "manifest.sha256"]).current_dir(&folder).output()
    {
        assert!(sums.status.success(), "{}", output_text(&sums));
    }
    assert_output(&run_session(&workshop, &["--yes"]), 2, &["holds a finished session"]);
}

#[test]
fn missing_confirmation_or_evidence_does_not_pass() {
    let unasked = session_folder();
    assert_output(&run_session(&unasked, &[]), 3, &["inconclusive"]);
    let made = read_session_record(&unasked);
    assert_eq!(made.requirements[0].verdict, Verdict::Pass);
    assert_eq!(made.steps[1].answer.as_ref().unwrap().from, "not-asked");
    assert_output(
        &run_bench(unasked.path(), ["accept", "verify", "record"]),
        0,
        &["verdict: inconclusive", "not signed"],
    );
    assert_output(
        &run_bench(unasked.path(), ["accept", "verify", "record", "--key", "public.pem"]),
        1,
        &["manifest.sha256.sig: missing"],
    );

    let unshown = session_folder();
    let plan = plan_text(&["s.toml"], 2) + "[[requirement]]\nid = \"R-2\"\ntext = \"Nobody looks.\"\n";
    fs::write(unshown.path().join("plan.toml"), plan).unwrap();
    assert_output(&run_session(&unshown, &["--yes"]), 3, &[]);
    let [first, second] = &read_session_record(&unshown).requirements[..] else { panic!("two requirements") };
    assert_eq!((first.verdict, second.verdict), (Verdict::Pass, Verdict::Inconclusive));
}

#[test]
fn a_failed_scenario_fails_the_session() {
    let workshop = session_folder();
    let bad = GOOD.replace("4.0", "1.0");
    workshop.write_scenario("bad.toml", &step_scenario("aluminium-198x138", "", "", &bad));
    fs::write(workshop.path().join("plan.toml"), plan_text(&["s.toml", "bad.toml"], 2)).unwrap();
    assert_output(&run_session(&workshop, &["--yes"]), 1, &["fail"]);
    let made = read_session_record(&workshop);
    let verdicts: Vec<_> = made.requirements[0].evidence.iter().map(|evidence| evidence.verdict).collect();
    assert_eq!(verdicts, [Verdict::Pass, Verdict::Fail]);
    assert_output(&run_bench(workshop.path(), ["accept", "verify", "record"]), 0, &["verdict: fail"]);
}

#[test]
fn an_unmet_kill_rate_does_not_pass() {
    let workshop = session_folder();
    // As a share it was seen, but so few of so many do not show it.
    let plan = plan_text(&["s.toml"], 1) + "least_kill_rate_percent = 12.0\n";
    fs::write(workshop.path().join("plan.toml"), plan).unwrap();
    assert_output(&run_session(&workshop, &["--yes"]), 3, &["inconclusive"]);
    let trust = read_session_record(&workshop).steps[3].trust.clone().unwrap();
    assert!(0.12 < f64::from(trust.caught) / f64::from(trust.faults) && trust.clean_runs == 2, "{trust:?}");
}

#[rstest]
#[case::unknown_key("title =", "titel =", "plan.toml:1:1")]
#[case::no_repetition("repetitions = 3", "repetitions = 0", "expected 1 to 100000")]
#[case::twice("[[ask]]", "[[requirement]]\nid = \"R-1\"\ntext = \"Again.\"\n[[ask]]", "each identifier once")]
#[case::nothing_said("It settles.", " ", "expected what has to hold")]
#[case::unsaid("\"R-1\"", "\"R-9\"", "the plan does not say what `R-1` is")]
#[case::missing("s.toml", "no.toml", "no.toml")]
#[case::clean_runs("clean_runs = 2", "clean_runs = 0", "expected 1 to 1000000")]
fn an_invalid_plan_is_reported_with_its_line(#[case] good: &str, #[case] bad: &str, #[case] told: &str) {
    let workshop = session_folder();
    fs::write(workshop.path().join("plan.toml"), plan_text(&["s.toml"], 3).replace(good, bad)).unwrap();
    let output = run_session(&workshop, &["--yes"]);
    assert_output(&output, 2, &[told]);
    assert!(!self::output_text(&output).contains(NO_PLAN));
    assert!(!workshop.path().join("record").exists());
}

const NO_PLAN: &str = "--plan FILE names the plan";

#[test]
fn a_missing_plan_error_names_the_option() {
    let elsewhere = run_bench(session_folder().path(), ["accept", "--rig", "hosted", "--yes"]);
    assert_output(&elsewhere, 2, &["scenarios/plans/acceptance.toml: cannot be read", NO_PLAN]);
}

#[test]
fn errors_tell_public_keys_from_invalid_keys() {
    let workshop = session_folder();
    let locked = key_pair(1).0.replace("PRIVATE KEY", "ENCRYPTED PRIVATE KEY");
    fs::write(workshop.path().join("locked.pem"), locked).unwrap();
    for (name, told) in
        [("public.pem", "this is the public key, expected the secret one"), ("locked.pem", "passphrase")]
    {
        assert_output(&run_session(&workshop, &["--yes", "--sign", name]), 2, &[name, told]);
    }
    assert!(!workshop.path().join("record").exists());
}

#[test]
fn a_board_is_not_driven_without_confirmation() {
    let workshop = session_folder();
    let rig = controller_rig(None);
    let unasked = ["accept", "--plan", "plan.toml", "--out", "record", "--rig", &rig];
    assert_output(
        &run_bench(workshop.path(), unasked),
        3,
        &["nobody answered", "may drive a plate", "--yes", "--resume record"],
    );
    let made = read_session_record(&workshop);
    assert!(made.steps[0].done && !made.steps[1].done && made.no_board_notice().is_none());
    assert!(made.steps[0].reason.as_ref().unwrap().contains("chip 0x"));
    assert!(made.steps[1].attempts[0].broken_off.as_ref().unwrap().contains("nobody answered"));
    assert!(made.steps[2..].iter().all(|step| step.attempts.is_empty()));
}

/// A session that has begun, and whose rig was not to be reached.
fn interrupted_session() -> TestFolder {
    let workshop = session_folder();
    let unreachable = ["accept", "--plan", "plan.toml", "--out", "record", "--yes", "--rig", "exec:false {port}"];
    assert_output(&run_bench(workshop.path(), unreachable), 5, &["continue with the same command and --resume record"]);
    let made = read_session_record(&workshop);
    assert!(!made.complete && made.steps.iter().all(|step| !step.done));
    assert!(made.steps[0].attempts[0].broken_off.is_some());
    workshop
}

fn append_line(path: &Path) {
    fs::write(path, fs::read_to_string(path).unwrap() + "\n# another\n").unwrap();
}

#[rstest]
#[case::plan("plan.toml", "the plan is ")]
#[case::scenario("scenarios/s.toml", "s.toml is ")]
#[case::plate("scenarios/plates/aluminium-198x138-noisy.toml", "s.toml: aluminium-198x138-noisy.toml is ")]
fn a_session_does_not_resume_with_another_input(#[case] file: &str, #[case] told: &str) {
    let workshop = interrupted_session();
    append_line(&workshop.path().join(file));
    let again = ["accept", "--plan", "plan.toml", "--resume", "record", "--yes", "--rig", "exec:false {port}"];
    assert_output(&run_bench(workshop.path(), again), 2, &[told, "never mixes the two"]);
}

#[test]
fn a_session_does_not_resume_with_another_rig_or_clock() {
    let workshop = interrupted_session();
    let again = ["accept", "--plan", "plan.toml", "--resume", "record", "--yes", "--rig"];
    assert_output(&run_bench(workshop.path(), again.iter().chain(&["hosted"])), 2, &["the rig is hosted"]);
    let real_time = again.iter().chain(&["exec:false {port}", "--clock", "real-time"]);
    assert_output(&run_bench(workshop.path(), real_time), 2, &["the clock is real-time"]);
    let path = workshop.path().join("record/session.json");
    let text = fs::read_to_string(&path).unwrap();
    let version = format!("\"version\": \"{}\"", env!("CARGO_PKG_VERSION"));
    assert!(text.contains(&version));
    fs::write(&path, text.replace(&version, "\"version\": \"0.0.1\"")).unwrap();
    assert_output(&run_bench(workshop.path(), again.iter().chain(&["exec:false {port}"])), 2, &["the bench is "]);
}

#[test]
fn a_broken_session_file_gives_no_hint_to_resume() {
    let workshop = interrupted_session();
    let again = ["accept", "--plan", "plan.toml", "--resume", "record", "--yes", "--rig", "exec:false {port}"];
    let goes_on = |output: &Output| String::from_utf8_lossy(&output.stderr).contains("continue with the same command");
    assert!(goes_on(&run_bench(workshop.path(), again)), "a rig that is not there may come back");
    let session = workshop.path().join("record/session.json");
    fs::write(&session, "{ \"format\": ").unwrap();
    let output = run_bench(workshop.path(), again);
    assert_output(&output, 2, &["session.json"]);
    assert!(!goes_on(&output));
}

#[test]
fn rejects_a_folder_with_other_content() {
    let workshop = interrupted_session();
    assert_output(&run_bench(workshop.path(), ["accept", "verify", "record"]), 3, &["the session is not finished"]);
    let elsewhere = ["accept", "--plan", "plan.toml", "--rig", "hosted", "--yes"];
    let taken = run_bench(workshop.path(), elsewhere.iter().chain(&["--out", "scenarios"]));
    assert_output(&taken, 2, &["something else than an acceptance session"]);
    assert_output(&run_bench(workshop.path(), elsewhere.iter().chain(&["--resume", "scenarios"])), 2, &["no session"]);
    assert!(!workshop.path().join("scenarios/session.json").exists());
}

/// Every file below `folder` is copied to `copy`.
fn copy_folder(folder: &Path, copy: &Path) {
    fs::create_dir_all(copy).unwrap();
    for entry in fs::read_dir(folder).unwrap() {
        let path: PathBuf = entry.unwrap().path();
        let target = copy.join(path.file_name().unwrap());
        if path.is_dir() {
            copy_folder(&path, &target);
        } else {
            fs::copy(&path, &target).unwrap();
        }
    }
}

#[test]
fn the_supplied_plan_has_every_acceptance_scenario() {
    let plan = Plan::load(&workspace_root().join("scenarios/plans/acceptance.toml")).unwrap();
    let planned: Vec<_> = plan.scenarios.iter().map(|planned| planned.scenario.file.as_str()).collect();
    let found = platebench_scenario::find(&[workspace_root().join("scenarios/paper")]).unwrap().scenarios;
    let tagged = found.iter().filter(|scenario| scenario.tags.iter().any(|tag| tag == "acceptance"));
    assert_eq!(planned, tagged.map(|scenario| scenario.file.as_str()).collect::<Vec<_>>());
    let named = plan.scenarios.iter().flat_map(|planned| &planned.scenario.expectations);
    let named: Vec<_> = named.filter_map(|expectation| expectation.requirement.as_deref()).collect();
    assert!(plan.requirements.iter().all(|requirement| named.contains(&requirement.id.as_str())));
}

/// What a requirement says and what is demanded for it are one: the times and shares that its evidence is held against stand in it, unless it leaves them to the scenario.
#[test]
fn the_supplied_plan_states_the_limits_of_its_scenarios() {
    let plan = Plan::load(&workspace_root().join("scenarios/plans/acceptance.toml")).unwrap();
    let mut held = 0;
    for requirement in plan.requirements.iter().filter(|requirement| !requirement.text.contains("the scenario states"))
    {
        let of_it = plan.scenarios.iter().flat_map(|planned| &planned.scenario.expectations);
        for expectation in of_it.filter(|expectation| expectation.requirement.as_ref() == Some(&requirement.id)) {
            let unit = match expectation.metric.name().rsplit('_').next() {
                Some("ms") => "ms",
                Some("percent") => "%",
                Some("hz") => "Hz",
                _ => "",
            };
            let said = match expectation.limit {
                Limit::AtMost(limit) => format!("{limit} {unit}"),
                Limit::Within(low, high) => format!("{low} to {high} {unit}"),
                other => panic!("{other:?} is nothing that a text of this plan says"),
            };
            assert!(requirement.text.contains(&format!(" {}", said.trim_end())), "{}: {said}", requirement.id);
            held += 1;
        }
    }
    assert!(held > 20, "{held}");
}
