//! Acceptance sessions: conducted, cut off, taken up again, verified, doctored.

mod doctored;
mod person;

use crate::bench::{Workshop, call, code, controller, root, step_scenario};
use ed25519_dalek::SigningKey;
use ed25519_dalek::pkcs8::spki::der::pem::LineEnding;
use ed25519_dalek::pkcs8::{EncodePrivateKey, EncodePublicKey};
use platebench_acceptance::{Plan, SessionRecord};
use platebench_scenario::Limit;
use platebench_verdict::Verdict;
use rstest::rstest;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

/// Both keys of a pair in PEM, made of `seed`; what they sign is tests.
fn keys(seed: u8) -> (String, String) {
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
fn workshop() -> Workshop {
    let workshop = Workshop::new();
    workshop.scenario("s.toml", &step_scenario("aluminium-198x138-noisy", "", "", GOOD));
    let (secret, public) = keys(1);
    for (name, text) in [
        ("plan.toml", plan_text(&["s.toml"], 3)),
        ("key.pem", secret),
        ("public.pem", public),
        ("other.pem", keys(2).1),
    ] {
        fs::write(workshop.path().join(name), text).unwrap();
    }
    workshop
}

const SESSION: [&str; 7] = ["accept", "--plan", "plan.toml", "--out", "record", "--rig", "hosted"];

fn session(workshop: &Workshop, more: &[&str]) -> Output {
    call(workshop.path(), SESSION.iter().chain(more))
}

fn record(workshop: &Workshop) -> SessionRecord {
    SessionRecord::read(&workshop.path().join("record")).unwrap()
}

#[track_caller]
fn told(output: &Output) -> String {
    String::from_utf8_lossy(&[output.stdout.clone(), output.stderr.clone()].concat()).into_owned()
}

#[track_caller]
fn expect(output: &Output, exit: i32, words: &[&str]) {
    let told = told(output);
    assert_eq!(code(output), exit, "{told}");
    for word in words {
        assert!(told.contains(word), "{word:?} is not in: {told}");
    }
}

#[test]
fn a_session_is_sealed_signed_and_verified() {
    let workshop = workshop();
    let said = ["--yes", "--sign", "key.pem", "--operator", "A. Tester", "--place", "Lab 2"];
    let output = session(&workshop, &said);
    expect(&output, 0, &["R-1", "pass", "no board was attached", "1 trial of s.toml measured"]);
    let all = told(&output);
    let judged = all.lines().filter(|line| line.contains(" s.toml: ") && !line.starts_with('…')).count();
    assert_eq!(judged, 1, "only the controller's own runs are judged: {all}");
    let made = record(&workshop);
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
        reason.contains("not caught by the plan's own scenarios (1)") && survived.contains(&"no-watchdog".to_owned()),
        "{reason}"
    );
    assert!(survived.iter().all(|name| page.contains(&format!("not caught: {name}, "))), "{survived:?}");

    expect(
        &call(workshop.path(), ["accept", "verify", "record"]),
        0,
        &["which the record itself names", "verdict: pass", "no board was attached"],
    );
    expect(&call(workshop.path(), ["accept", "verify", "record", "--key", "public.pem"]), 0, &["the given key"]);
    let other = call(workshop.path(), ["accept", "verify", "record", "--key", "other.pem"]);
    expect(&other, 1, &["manifest.sha256.sig: wrong"]);
    expect(
        &call(workshop.path(), ["accept", "verify", "record", "--key", "plan.toml"]),
        2,
        &["plan.toml: not the ed25519 key"],
    );
    let secret = call(workshop.path(), ["accept", "verify", "record", "--key", "key.pem"]);
    expect(&secret, 2, &["key.pem: ", "this is the secret key, expected the public one", "-pubout"]);
    expect(&call(workshop.path(), ["accept", "verify", "scenarios"]), 2, &["no session"]);

    // What `sha256sum` says, where there is one.
    if let Ok(sums) =
        Command::new("sha256sum").args(["-c", "--strict", "manifest.sha256"]).current_dir(&folder).output()
    {
        assert!(sums.status.success(), "{}", told(&sums));
    }
    expect(&session(&workshop, &["--yes"]), 2, &["holds a finished session"]);
}

#[test]
fn what_nobody_confirmed_or_nothing_shows_does_not_pass() {
    let unasked = workshop();
    expect(&session(&unasked, &[]), 3, &["inconclusive"]);
    let made = record(&unasked);
    assert_eq!(made.requirements[0].verdict, Verdict::Pass);
    assert_eq!(made.steps[1].answer.as_ref().unwrap().from, "not-asked");
    expect(&call(unasked.path(), ["accept", "verify", "record"]), 0, &["verdict: inconclusive", "not signed"]);
    expect(
        &call(unasked.path(), ["accept", "verify", "record", "--key", "public.pem"]),
        1,
        &["manifest.sha256.sig: missing"],
    );

    let unshown = workshop();
    let plan = plan_text(&["s.toml"], 2) + "[[requirement]]\nid = \"R-2\"\ntext = \"Nobody looks.\"\n";
    fs::write(unshown.path().join("plan.toml"), plan).unwrap();
    expect(&session(&unshown, &["--yes"]), 3, &[]);
    let [first, second] = &record(&unshown).requirements[..] else { panic!("two requirements") };
    assert_eq!((first.verdict, second.verdict), (Verdict::Pass, Verdict::Inconclusive));
}

#[test]
fn one_that_fails_fails_the_session() {
    let workshop = workshop();
    let bad = GOOD.replace("4.0", "1.0");
    workshop.scenario("bad.toml", &step_scenario("aluminium-198x138", "", "", &bad));
    fs::write(workshop.path().join("plan.toml"), plan_text(&["s.toml", "bad.toml"], 2)).unwrap();
    expect(&session(&workshop, &["--yes"]), 1, &["fail"]);
    let made = record(&workshop);
    let verdicts: Vec<_> = made.requirements[0].evidence.iter().map(|evidence| evidence.verdict).collect();
    assert_eq!(verdicts, [Verdict::Pass, Verdict::Fail]);
    expect(&call(workshop.path(), ["accept", "verify", "record"]), 0, &["verdict: fail"]);
}

#[test]
fn a_plan_that_asks_too_much_of_the_bench_is_not_passed() {
    let workshop = workshop();
    // As a share it was seen, but so few of so many do not show it.
    let plan = plan_text(&["s.toml"], 1) + "least_kill_rate_percent = 12.0\n";
    fs::write(workshop.path().join("plan.toml"), plan).unwrap();
    expect(&session(&workshop, &["--yes"]), 3, &["inconclusive"]);
    let trust = record(&workshop).steps[3].trust.clone().unwrap();
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
fn a_wrong_plan_is_pointed_at(#[case] good: &str, #[case] bad: &str, #[case] told: &str) {
    let workshop = workshop();
    fs::write(workshop.path().join("plan.toml"), plan_text(&["s.toml"], 3).replace(good, bad)).unwrap();
    let output = session(&workshop, &["--yes"]);
    expect(&output, 2, &[told]);
    assert!(!self::told(&output).contains(NO_PLAN));
    assert!(!workshop.path().join("record").exists());
}

const NO_PLAN: &str = "--plan FILE names the plan";

#[test]
fn where_there_is_no_plan_it_is_said_how_one_is_named() {
    let elsewhere = call(workshop().path(), ["accept", "--rig", "hosted", "--yes"]);
    expect(&elsewhere, 2, &["scenarios/plans/acceptance.toml: cannot be read", NO_PLAN]);
}

#[test]
fn a_key_that_cannot_sign_is_told_from_one_that_is_none() {
    let workshop = workshop();
    let locked = keys(1).0.replace("PRIVATE KEY", "ENCRYPTED PRIVATE KEY");
    fs::write(workshop.path().join("locked.pem"), locked).unwrap();
    for (name, told) in
        [("public.pem", "this is the public key, expected the secret one"), ("locked.pem", "passphrase")]
    {
        expect(&session(&workshop, &["--yes", "--sign", name]), 2, &[name, told]);
    }
    assert!(!workshop.path().join("record").exists());
}

#[test]
fn no_plate_is_driven_that_nobody_said_is_safe_to_drive() {
    let workshop = workshop();
    let rig = controller(None);
    let unasked = ["accept", "--plan", "plan.toml", "--out", "record", "--rig", &rig];
    expect(&call(workshop.path(), unasked), 3, &["nobody answered", "may drive a plate", "--yes", "--resume record"]);
    let made = record(&workshop);
    assert!(made.steps[0].done && !made.steps[1].done && made.without_a_board().is_none());
    assert!(made.steps[0].reason.as_ref().unwrap().contains("chip 0x"));
    assert!(made.steps[1].attempts[0].broken_off.as_ref().unwrap().contains("nobody answered"));
    assert!(made.steps[2..].iter().all(|step| step.attempts.is_empty()));
}

/// A session that has begun, and whose rig was not to be reached.
fn begun() -> Workshop {
    let workshop = workshop();
    let unreachable = ["accept", "--plan", "plan.toml", "--out", "record", "--yes", "--rig", "exec:false {port}"];
    expect(&call(workshop.path(), unreachable), 5, &["goes on from here"]);
    let made = record(&workshop);
    assert!(!made.complete && made.steps.iter().all(|step| !step.done));
    assert!(made.steps[0].attempts[0].broken_off.is_some());
    workshop
}

fn appended(path: &Path) {
    fs::write(path, fs::read_to_string(path).unwrap() + "\n# another\n").unwrap();
}

#[rstest]
#[case::plan("plan.toml", "the plan is ")]
#[case::scenario("scenarios/s.toml", "s.toml is ")]
#[case::plate("scenarios/plates/aluminium-198x138-noisy.toml", "s.toml: aluminium-198x138-noisy.toml is ")]
fn a_session_does_not_go_on_with_another_input(#[case] file: &str, #[case] told: &str) {
    let workshop = begun();
    appended(&workshop.path().join(file));
    let again = ["accept", "--plan", "plan.toml", "--resume", "record", "--yes", "--rig", "exec:false {port}"];
    expect(&call(workshop.path(), again), 2, &[told, "never mixes the two"]);
}

#[test]
fn a_session_does_not_go_on_with_another_rig_clock_or_bench() {
    let workshop = begun();
    let again = ["accept", "--plan", "plan.toml", "--resume", "record", "--yes", "--rig"];
    expect(&call(workshop.path(), again.iter().chain(&["hosted"])), 2, &["the rig is hosted"]);
    let real_time = again.iter().chain(&["exec:false {port}", "--clock", "real-time"]);
    expect(&call(workshop.path(), real_time), 2, &["the clock is real-time"]);
    let path = workshop.path().join("record/session.json");
    let text = fs::read_to_string(&path).unwrap();
    let version = format!("\"version\": \"{}\"", env!("CARGO_PKG_VERSION"));
    assert!(text.contains(&version));
    fs::write(&path, text.replace(&version, "\"version\": \"0.0.1\"")).unwrap();
    expect(&call(workshop.path(), again.iter().chain(&["exec:false {port}"])), 2, &["the bench is "]);
}

#[test]
fn nobody_is_told_to_go_on_with_what_is_no_session_any_more() {
    let workshop = begun();
    let again = ["accept", "--plan", "plan.toml", "--resume", "record", "--yes", "--rig", "exec:false {port}"];
    let goes_on = |output: &Output| String::from_utf8_lossy(&output.stderr).contains("goes on from here");
    assert!(goes_on(&call(workshop.path(), again)), "a rig that is not there may come back");
    let session = workshop.path().join("record/session.json");
    fs::write(&session, "{ \"format\": ").unwrap();
    let output = call(workshop.path(), again);
    expect(&output, 2, &["session.json"]);
    assert!(!goes_on(&output));
}

#[test]
fn only_a_session_s_own_folder_is_written_into() {
    let workshop = begun();
    expect(&call(workshop.path(), ["accept", "verify", "record"]), 3, &["not come to its end"]);
    let elsewhere = ["accept", "--plan", "plan.toml", "--rig", "hosted", "--yes"];
    let taken = call(workshop.path(), elsewhere.iter().chain(&["--out", "scenarios"]));
    expect(&taken, 2, &["something else than an acceptance session"]);
    expect(&call(workshop.path(), elsewhere.iter().chain(&["--resume", "scenarios"])), 2, &["no session"]);
    assert!(!workshop.path().join("scenarios/session.json").exists());
}

/// Every file below `folder` is copied to `copy`.
fn copied(folder: &Path, copy: &Path) {
    fs::create_dir_all(copy).unwrap();
    for entry in fs::read_dir(folder).unwrap() {
        let path: PathBuf = entry.unwrap().path();
        let target = copy.join(path.file_name().unwrap());
        if path.is_dir() {
            copied(&path, &target);
        } else {
            fs::copy(&path, &target).unwrap();
        }
    }
}

#[test]
fn the_plan_that_comes_with_the_bench_plays_every_acceptance_scenario_of_the_paper() {
    let plan = Plan::load(&root().join("scenarios/plans/acceptance.toml")).unwrap();
    let planned: Vec<_> = plan.scenarios.iter().map(|planned| planned.scenario.file.as_str()).collect();
    let found = platebench_scenario::find(&[root().join("scenarios/paper")]).unwrap().scenarios;
    let tagged = found.iter().filter(|scenario| scenario.tags.iter().any(|tag| tag == "acceptance"));
    assert_eq!(planned, tagged.map(|scenario| scenario.file.as_str()).collect::<Vec<_>>());
    let named = plan.scenarios.iter().flat_map(|planned| &planned.scenario.expectations);
    let named: Vec<_> = named.filter_map(|expectation| expectation.requirement.as_deref()).collect();
    assert!(plan.requirements.iter().all(|requirement| named.contains(&requirement.id.as_str())));
}

/// What a requirement says and what is demanded for it are one: the times and shares that its evidence is held against stand in it, unless it leaves them to the scenario.
#[test]
fn the_plan_that_comes_with_the_bench_says_what_is_demanded() {
    let plan = Plan::load(&root().join("scenarios/plans/acceptance.toml")).unwrap();
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
