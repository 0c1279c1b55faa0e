//! Checks that verification rejects a changed record and names the changed file.

use super::{copy_folder, read_session_record, run_session, session_folder, verify};
use std::fs;
use std::os::unix::fs::symlink;
use std::path::Path;
use std::process::Command;

const TRACE: &str = "steps/05-s/traces/s/001.csv";
const SESSION: &str = "session.json";
const PASS: &str = "\"verdict\": \"pass\"";
const FAIL: &str = "\"verdict\": \"fail\"";

fn replace_text(path: &Path, from: &str, to: &str) {
    let text = fs::read_to_string(path).unwrap();
    assert!(text.contains(from), "{} has no {from}", path.display());
    fs::write(path, text.replacen(from, to, 1)).unwrap();
}

fn reseal(folder: &Path) {
    let script = "find . -type f ! -name 'manifest.sha256*' -printf '%P\\n' | LC_ALL=C sort \
                  | xargs -d '\\n' sha256sum > manifest.sha256";
    assert!(Command::new("sh").args(["-c", script]).current_dir(folder).status().unwrap().success());
}

fn flip_one_byte(path: &Path) {
    let mut bytes = fs::read(path).unwrap();
    let last = bytes.len() - 3;
    bytes[last] ^= 1;
    fs::write(path, bytes).unwrap();
}

type TamperCase = (fn(&Path), &'static str);

const CASES: [TamperCase; 13] = [
    (|folder| flip_one_byte(&folder.join(TRACE)), "steps/05-s/traces/s/001.csv: changed"),
    (|folder| replace_text(&folder.join(SESSION), PASS, FAIL), "session.json: changed"),
    (|folder| replace_text(&folder.join(SESSION), "Lab 2", "Lab 3"), "session.json: changed"),
    (|folder| fs::write(folder.join("steps/more.txt"), "").unwrap(), "steps/more.txt: added"),
    (|folder| symlink(SESSION, folder.join("link")).unwrap(), "link cannot be sealed: expected a file or a folder"),
    (|folder| fs::remove_file(folder.join(TRACE)).unwrap(), "steps/05-s/traces/s/001.csv: missing"),
    (|folder| fs::remove_file(folder.join(SESSION)).unwrap(), "session.json: missing"),
    (
        |folder| {
            let path = folder.join("manifest.sha256");
            let text = fs::read_to_string(&path).unwrap();
            let kept: String = text.split_inclusive('\n').filter(|line| !line.contains(TRACE)).collect();
            fs::write(&path, kept).unwrap();
        },
        "steps/05-s/traces/s/001.csv: added",
    ),
    (|folder| fs::remove_file(folder.join("manifest.sha256")).unwrap(), "manifest.sha256: missing"),
    (|folder| fs::remove_file(folder.join("manifest.sha256.sig")).unwrap(), "manifest.sha256.sig: missing"),
    (|folder| flip_one_byte(&folder.join("manifest.sha256.sig")), "manifest.sha256.sig: wrong"),
    (
        |folder| {
            replace_text(&folder.join(SESSION), "Lab 2", "Lab 3");
            reseal(folder);
        },
        "manifest.sha256.sig: wrong",
    ),
    // Without the signature, only the evidence contradicts the changed verdict.
    (
        |folder| {
            replace_text(&folder.join(SESSION), "\"signature\": {", "\"signature\": null, \"was\": {");
            replace_text(&folder.join(SESSION), PASS, FAIL);
            fs::remove_file(folder.join("manifest.sha256.sig")).unwrap();
            reseal(folder);
        },
        "session.json: the session has verdict fail, but its evidence gives pass",
    ),
];

#[test]
fn every_change_is_rejected_with_its_file() {
    let folder = session_folder();
    run_session(&folder, &["--yes", "--sign", "key.pem", "--place", "Lab 2"]).assert_exit(0);
    assert!(read_session_record(&folder).signature.is_some());
    for (number, (change, message)) in CASES.into_iter().enumerate() {
        let name = format!("changed-{number}");
        let copy = folder.join(&name);
        copy_folder(&folder.join("record"), &copy);
        verify(&folder, &name, &[]).assert_text(0, &["intact"]);
        change(&copy);
        verify(&folder, &name, &[]).assert_text(1, &[message, "rejected"]);
    }
}

#[test]
fn a_resealed_record_is_checked_against_its_traces() {
    let folder = session_folder();
    run_session(&folder, &["--yes", "--place", "Lab 2"]).assert_exit(0);
    let record = folder.join("record");
    let verify_resealed = || {
        reseal(&record);
        verify(&folder, "record", &[])
    };
    replace_text(&record.join(SESSION), "Lab 2", "Lab 3");
    verify_resealed().assert_text(0, &["not signed"]);
    let run = folder.read("record/steps/05-s/run.json");
    replace_text(&record.join("steps/05-s/run.json"), PASS, FAIL);
    verify_resealed().assert_text(1, &["steps/05-s/run.json: its verdicts differ from those of the traces"]);
    folder.write("record/steps/05-s/run.json", &run);
    replace_text(&record.join(SESSION), "\"text\": \"It settles.\"", "\"text\": \"It hums.\"");
    verify_resealed().assert_text(1, &["session.json: text or evidence of R-1 differs from plan and traces"]);
    replace_text(&record.join(SESSION), "\"text\": \"It hums.\"", "\"text\": \"It settles.\"");
    verify_resealed().assert_exit(0);
    flip_one_byte(&record.join(TRACE));
    verify_resealed()
        .assert_text(1, &["steps/05-s/run.json: the traces of this run cannot be judged again", "001.csv"]);
}
