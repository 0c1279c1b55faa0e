//! Tests acceptance sessions: seal, interruption, resuming, verification.

mod decision;
mod operator;
mod tampering;

use crate::test_folder::{
    ProgramOutput, TestFolder, controller_rig, run_bench, step_scenario, step_text, workspace_root,
};
use ed25519_dalek::SigningKey;
use ed25519_dalek::pkcs8::spki::der::pem::LineEnding;
use ed25519_dalek::pkcs8::{EncodePrivateKey, EncodePublicKey};
use platebench_lab::acceptance::{AcceptancePlan, SessionRecord};
use platebench_model::record::Verdict;
use platebench_model::scenario::Limit;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

fn key_pair(seed: u8) -> (String, String) {
    let key = SigningKey::from_bytes(&[seed; 32]);
    let public = key.verifying_key().to_public_key_pem(LineEnding::LF).unwrap();
    (key.to_pkcs8_pem(LineEnding::LF).unwrap().as_str().to_owned(), public)
}

const GOOD: &str = "metric = \"settling_time_ms\"\nat_most = 4.0\nrequirement = \"R-1\"";

fn plan_text(scenarios: &[&str], repetitions: u32) -> String {
    let scenarios: Vec<_> =
        scenarios.iter().map(|file| format!("[[scenario]]\nfile = \"scenarios/{file}\"\n")).collect();
    format!(
        "title = \"A tiny acceptance\"\nrepetitions = {repetitions}\n\
         [[requirement]]\nid = \"R-1\"\ntext = \"It settles.\"\n\
         [[ask]]\nid = \"safe\"\nquestion = \"Is no person near the plate?\"\n\
         {}[bench]\ntiming_trials = 1\nclean_runs = 2\n",
        scenarios.concat()
    )
}

pub(crate) fn session_folder() -> TestFolder {
    let folder = TestFolder::with_scenario(&step_scenario("aluminium-198x138-noisy", "", "", GOOD));
    let (secret, public) = key_pair(1);
    folder.write("plan.toml", &plan_text(&["s.toml"], 3));
    folder.write("key.pem", &secret);
    folder.write("public.pem", &public);
    folder.write("other.pem", &key_pair(2).1);
    folder
}

const SESSION: [&str; 8] = ["acceptance", "run", "--plan", "plan.toml", "--out", "record", "--rig", "hosted"];

#[track_caller]
pub(crate) fn run_session(folder: &TestFolder, more: &[&str]) -> ProgramOutput {
    folder.bench(SESSION.iter().chain(more))
}

#[track_caller]
fn verify(folder: &TestFolder, record: &str, more: &[&str]) -> ProgramOutput {
    folder.bench(["acceptance", "verify", record].iter().chain(more))
}

fn read_session_record(folder: &TestFolder) -> SessionRecord {
    SessionRecord::read(&folder.join("record")).unwrap()
}

#[test]
fn a_session_is_sealed_signed_and_verified() {
    let folder = session_folder();
    let output = run_session(&folder, &["--yes", "--sign", "key.pem", "--operator", "A. Tester", "--place", "Lab 2"])
        .assert_text(0, &["R-1", "pass", "no board was attached", "s.toml measured in 1 trial, not judged"]);
    let all = output.text();
    let judged = all.lines().filter(|line| line.contains(" s.toml: ") && !line.starts_with('…')).count();
    assert_eq!(judged, 1, "only the controller's own runs are judged: {all}");
    let record = read_session_record(&folder);
    assert!(record.complete && record.verdict == Verdict::Pass);
    assert_eq!((record.details.operator.as_deref(), record.details.notes), (Some("A. Tester"), None));
    assert_eq!(record.requirements[0].evidence.len(), 1);
    assert_eq!(record.steps[1].answer.as_ref().unwrap().from, "command-line");
    let runs = fs::read_dir(folder.join("record/steps/05-s/traces/s")).unwrap().count();
    assert_eq!(runs, 3, "as many trials as the plan's repetitions");
    let page = folder.read("record/record.html");
    for text in ["It settles.", "A. Tester", "Reviewer", "no board was attached", "none (hosted)"] {
        assert!(page.contains(text), "{text}");
    }
    assert!(!page.contains("0x00000000, number"));
    let survived = record.steps[3].trust.clone().unwrap().survived;
    let reason = record.steps[3].reason.clone().unwrap();
    assert!(
        reason.contains("that the plan's 1 scenarios did not catch") && survived.contains(&"no-watchdog".to_owned()),
        "{reason}"
    );
    assert!(survived.iter().all(|name| page.contains(&format!("not caught: {name}, "))), "{survived:?}");

    for (key, exit, expected) in [
        (&[][..], 0, &["which the record itself names", "verdict: pass", "no board was attached"][..]),
        (&["--key", "public.pem"], 0, &["the given key"]),
        (&["--key", "other.pem"], 1, &["manifest.sha256.sig: wrong"]),
        (&["--key", "plan.toml"], 2, &["plan.toml: not the expected ed25519 key"]),
        (&["--key", "key.pem"], 2, &["key.pem: ", "this is the secret key, expected the public key", "-pubout"]),
    ] {
        verify(&folder, "record", key).assert_text(exit, expected);
    }
    verify(&folder, "scenarios", &[]).assert_text(2, &["contains no session"]);

    let mut check = Command::new("sha256sum");
    check.args(["-c", "--strict", "manifest.sha256"]).current_dir(folder.join("record"));
    if let Ok(sums) = check.output() {
        ProgramOutput::from(sums).assert_exit(0);
    }
    run_session(&folder, &["--yes"]).assert_text(2, &["contains a finished session"]);
}

#[test]
fn a_session_with_a_key_resumes_only_with_a_key() {
    let folder = session_folder();
    let session =
        ["acceptance", "run", "--plan", "plan.toml", "--out", "record", "--yes", "--rig", "exec:false {port}"];
    let signed = [&session[..], &["--sign", "key.pem"]].concat();
    folder.bench(&signed).assert_exit(5);
    assert!(read_session_record(&folder).must_be_signed);
    let refused = folder.bench(session).assert_text(2, &["started with --sign", "resume it with --sign KEYFILE"]);
    assert!(!refused.text().contains("--resume record"), "{}", refused.text());
    folder.bench(&signed).assert_exit(5);
    assert_eq!(read_session_record(&folder).resumed.len(), 1);
}

#[test]
fn missing_confirmation_or_evidence_does_not_pass() {
    let unconfirmed = session_folder();
    run_session(&unconfirmed, &[]).assert_text(3, &["inconclusive"]);
    let record = read_session_record(&unconfirmed);
    assert_eq!(record.requirements[0].verdict, Verdict::Pass);
    assert_eq!(record.steps[1].answer.as_ref().unwrap().from, "not-asked");
    verify(&unconfirmed, "record", &[]).assert_text(0, &["verdict: inconclusive", "not signed"]);
    let unsigned = verify(&unconfirmed, "record", &["--key", "public.pem"]);
    let unsigned = unsigned.assert_text(1, &["manifest.sha256.sig: missing", "rejected: the record is not signed"]);
    assert!(!unsigned.text().contains("changed"), "{}", unsigned.text());

    let without_evidence = session_folder();
    let plan = plan_text(&["s.toml"], 2) + "[[requirement]]\nid = \"R-2\"\ntext = \"No scenario shows it.\"\n";
    without_evidence.write("plan.toml", &plan);
    run_session(&without_evidence, &["--yes"]).assert_exit(3);
    let [first, second] = &read_session_record(&without_evidence).requirements[..] else { panic!("two requirements") };
    assert_eq!((first.verdict, second.verdict), (Verdict::Pass, Verdict::Inconclusive));
}

#[test]
fn a_failed_scenario_fails_the_session() {
    let folder = session_folder();
    folder.write_scenario("bad.toml", &step_text(&GOOD.replace("4.0", "1.0")));
    folder.write("plan.toml", &plan_text(&["s.toml", "bad.toml"], 2));
    run_session(&folder, &["--yes"]).assert_text(1, &["fail"]);
    let record = read_session_record(&folder);
    let verdicts: Vec<_> = record.requirements[0].evidence.iter().map(|evidence| evidence.verdict).collect();
    assert_eq!(verdicts, [Verdict::Pass, Verdict::Fail]);
    verify(&folder, "record", &[]).assert_text(0, &["verdict: fail"]);
}

#[test]
fn an_unmet_kill_rate_does_not_pass() {
    let folder = session_folder();
    // The observed kill rate is above 12 %, but its lower confidence bound is below.
    folder.write("plan.toml", &(plan_text(&["s.toml"], 1) + "least_kill_rate_percent = 12.0\n"));
    run_session(&folder, &["--yes"]).assert_text(3, &["inconclusive"]);
    let trust = read_session_record(&folder).steps[3].trust.clone().unwrap();
    assert!(0.12 < f64::from(trust.caught) / f64::from(trust.faults) && trust.clean_runs == 2, "{trust:?}");
}

#[test]
fn errors_tell_public_keys_from_invalid_keys() {
    let folder = session_folder();
    folder.write("locked.pem", &key_pair(1).0.replace("PRIVATE KEY", "ENCRYPTED PRIVATE KEY"));
    for (name, message) in
        [("public.pem", "this is the public key, expected the secret key"), ("locked.pem", "passphrase")]
    {
        run_session(&folder, &["--yes", "--sign", name]).assert_text(2, &[name, message]);
    }
    assert!(!folder.exists("record"));
}

#[test]
fn a_board_is_not_driven_without_confirmation() {
    let folder = session_folder();
    folder
        .bench(["acceptance", "run", "--plan", "plan.toml", "--out", "record", "--rig", &controller_rig(None)])
        .assert_text(3, &["no answer", "may drive a plate", "--yes", "--resume record"]);
    let record = read_session_record(&folder);
    assert!(record.steps[0].done && !record.steps[1].done && record.no_board_notice().is_none());
    assert!(record.steps[0].reason.as_ref().unwrap().contains("chip 0x"));
    assert!(record.steps[1].attempts[0].broken_off.as_ref().unwrap().contains("no answer"));
    assert!(record.steps[2..].iter().all(|step| step.attempts.is_empty()));
}

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

fn supplied_plan() -> AcceptancePlan {
    AcceptancePlan::load(&workspace_root().join("scenarios/plans/acceptance.toml")).unwrap()
}

#[test]
fn the_supplied_plan_has_every_acceptance_scenario() {
    let plan = supplied_plan();
    let planned: Vec<_> = plan.scenarios.iter().map(|planned| planned.scenario.file.as_str()).collect();
    let paper = platebench_model::scenario::find(&[workspace_root().join("scenarios/paper")]).unwrap().scenarios;
    let tagged = paper.iter().filter(|scenario| scenario.tags.iter().any(|tag| tag == "acceptance"));
    assert_eq!(planned, tagged.map(|scenario| scenario.file.as_str()).collect::<Vec<_>>());
    let expectations = plan.scenarios.iter().flat_map(|planned| &planned.scenario.expectations);
    let named: Vec<_> = expectations.filter_map(|expectation| expectation.requirement.as_deref()).collect();
    assert!(plan.requirements.iter().all(|requirement| named.contains(&requirement.id.as_str())));
}

/// If the plan required more than its scenarios reach, every session would be inconclusive.
#[test]
fn the_scenarios_of_the_supplied_plan_reach_its_kill_rate() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().to_str().unwrap();
    let arguments =
        ["suite", "trust", "scenarios/paper", "--tag", "acceptance", "--clean", "1", "--format", "json", "--out", out];
    let trust = run_bench(&workspace_root(), arguments).assert_exit(1).json();
    let lowest = trust["kill_rate"]["bounds"][0].as_f64().unwrap() * 100.0;
    let demanded = supplied_plan().bench.least_kill_rate_percent;
    assert!(demanded > 0.0 && lowest >= demanded, "{lowest} % of the demanded {demanded} %");
}

#[test]
fn the_supplied_plan_states_the_limits_of_its_scenarios() {
    let plan = supplied_plan();
    let mut checked = 0;
    for requirement in plan.requirements.iter().filter(|requirement| !requirement.text.contains("the scenario states"))
    {
        let expectations = plan.scenarios.iter().flat_map(|planned| &planned.scenario.expectations);
        for expectation in expectations.filter(|it| it.requirement.as_ref() == Some(&requirement.id)) {
            let unit = match expectation.metric.name().rsplit('_').next() {
                Some("ms") => "ms",
                Some("percent") => "%",
                Some("hz") => "Hz",
                _ => "",
            };
            let limit = match expectation.limit {
                Limit::AtMost(limit) => format!("{limit} {unit}"),
                Limit::Within(low, high) => format!("{low} to {high} {unit}"),
                other => panic!("no text of this plan states {other:?}"),
            };
            assert!(requirement.text.contains(&format!(" {}", limit.trim_end())), "{}: {limit}", requirement.id);
            checked += 1;
        }
    }
    assert!(checked > 20, "{checked}");
}
