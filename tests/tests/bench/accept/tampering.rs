//! A record that somebody changed is refused, and the file is named.

use super::{assert_output, copy_folder, read_session_record, run_session, session_folder};
use crate::test_folder::{TestFolder, run_bench};
use std::fs;
use std::os::unix::fs::symlink;
use std::path::Path;
use std::process::Command;

const TRACE: &str = "steps/05-s/traces/s/001.csv";

fn replace_text(path: &Path, from: &str, to: &str) {
    let text = fs::read_to_string(path).unwrap();
    assert!(text.contains(from), "{} has no {from}", path.display());
    fs::write(path, text.replacen(from, to, 1)).unwrap();
}

/// Seals the folder again, as somebody without the key would.
fn reseal(folder: &Path) {
    let script = "find . -type f ! -name 'manifest.sha256*' -printf '%P\\n' | LC_ALL=C sort | xargs -d '\\n' sha256sum > manifest.sha256";
    assert!(Command::new("sh").args(["-c", script]).current_dir(folder).status().unwrap().success());
}

fn flip_one_byte(path: &Path) {
    let mut bytes = fs::read(path).unwrap();
    let last = bytes.len() - 3;
    bytes[last] ^= 1;
    fs::write(path, bytes).unwrap();
}

/// What somebody does to a record, and what is said of it.
type TamperCase = (fn(&Path), &'static str);

const CASES: [TamperCase; 13] = [
    (|folder| flip_one_byte(&folder.join(TRACE)), "steps/05-s/traces/s/001.csv: changed"),
    (
        |folder| replace_text(&folder.join("session.json"), "\"verdict\": \"pass\"", "\"verdict\": \"fail\""),
        "session.json: changed",
    ),
    (|folder| replace_text(&folder.join("session.json"), "Lab 2", "Lab 3"), "session.json: changed"),
    (|folder| fs::write(folder.join("steps/more.txt"), "").unwrap(), "steps/more.txt: added"),
    (|folder| symlink("session.json", folder.join("link")).unwrap(), "link: neither a file nor a folder"),
    (|folder| fs::remove_file(folder.join(TRACE)).unwrap(), "steps/05-s/traces/s/001.csv: missing"),
    (|folder| fs::remove_file(folder.join("session.json")).unwrap(), "session.json: missing"),
    (
        |folder| {
            let path = folder.join("manifest.sha256");
            let text = fs::read_to_string(&path).unwrap();
            fs::write(&path, text.split_inclusive('\n').filter(|line| !line.contains(TRACE)).collect::<String>())
                .unwrap();
        },
        "steps/05-s/traces/s/001.csv: added",
    ),
    (|folder| fs::remove_file(folder.join("manifest.sha256")).unwrap(), "manifest.sha256: missing"),
    (|folder| fs::remove_file(folder.join("manifest.sha256.sig")).unwrap(), "manifest.sha256.sig: missing"),
    (|folder| flip_one_byte(&folder.join("manifest.sha256.sig")), "manifest.sha256.sig: wrong"),
    // Sealed again, its signature does not fit; what its traces do not bear out is seen even so.
    (
        |folder| {
            replace_text(&folder.join("session.json"), "Lab 2", "Lab 3");
            reseal(folder);
        },
        "manifest.sha256.sig: wrong",
    ),
    (
        |folder| {
            replace_text(&folder.join("session.json"), "\"signature\": {", "\"signature\": null, \"was\": {");
            replace_text(&folder.join("session.json"), "\"verdict\": \"pass\"", "\"verdict\": \"fail\"");
            fs::remove_file(folder.join("manifest.sha256.sig")).unwrap();
            reseal(folder);
        },
        "session.json: the session says fail, its evidence says pass",
    ),
];

fn sealed_session() -> TestFolder {
    let workshop = session_folder();
    assert_output(&run_session(&workshop, &["--yes", "--sign", "key.pem", "--place", "Lab 2"]), 0, &[]);
    assert!(read_session_record(&workshop).signature.is_some());
    workshop
}

#[test]
fn every_change_is_rejected_with_its_file() {
    let workshop = sealed_session();
    for (number, (change, named)) in CASES.into_iter().enumerate() {
        let name = format!("doctored-{number}");
        let copy = workshop.path().join(&name);
        copy_folder(&workshop.path().join("record"), &copy);
        assert_output(&run_bench(workshop.path(), ["accept", "verify", &name]), 0, &["intact"]);
        change(&copy);
        assert_output(&run_bench(workshop.path(), ["accept", "verify", &name]), 1, &[named, "rejected"]);
    }
}

#[test]
fn a_resealed_record_is_checked_against_its_traces() {
    let workshop = session_folder();
    assert_output(&run_session(&workshop, &["--yes", "--place", "Lab 2"]), 0, &[]);
    let folder = workshop.path().join("record");
    let verify = || run_bench(workshop.path(), ["accept", "verify", "record"]);
    // Nothing in the traces knows where the lab is: this is what a signature is for.
    replace_text(&folder.join("session.json"), "Lab 2", "Lab 3");
    reseal(&folder);
    assert_output(&verify(), 0, &["not signed"]);
    // A verdict it is not.
    let run = folder.join("steps/05-s/run.json");
    let before = fs::read_to_string(&run).unwrap();
    replace_text(&run, "\"verdict\": \"pass\"", "\"verdict\": \"fail\"");
    reseal(&folder);
    assert_output(&verify(), 1, &["steps/05-s/run.json: the traces, judged again, do not bear it out"]);
    fs::write(&run, before).unwrap();
    // Nor what a requirement says.
    replace_text(&folder.join("session.json"), "\"text\": \"It settles.\"", "\"text\": \"It hums.\"");
    reseal(&folder);
    assert_output(&verify(), 1, &["session.json: R-1: text or evidence is not what plan and traces say"]);
    replace_text(&folder.join("session.json"), "\"text\": \"It hums.\"", "\"text\": \"It settles.\"");
    reseal(&folder);
    assert_output(&verify(), 0, &[]);
    // Nor a trace.
    flip_one_byte(&folder.join(TRACE));
    reseal(&folder);
    assert_output(&verify(), 1, &["steps/05-s/run.json: its traces cannot be judged again", "001.csv"]);
}
