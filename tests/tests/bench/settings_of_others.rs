//! Checks that settings that another user could have written start no program, that a file whose
//! name no record can contain is refused, and that the name of a folder cannot forge a line.

use crate::boards::inventory;
use crate::test_folder::{SETTLING, TestFolder, bench_command, step_text};
use rstest::rstest;
use std::ffi::OsStr;
use std::fs::{self, Permissions};
use std::os::unix::ffi::OsStrExt;
use std::os::unix::fs::{PermissionsExt, chown};

const TRUSTED: &str = "PLATEBENCH_TRUSTED_FOLDERS";
const OTHER_USER: u32 = 12_345;

/// The folder contains the settings, and its folder `work` is the working directory.
fn folder_with_settings() -> TestFolder {
    let folder = TestFolder::with_step(SETTLING);
    fs::create_dir(folder.join("work")).unwrap();
    folder.write("platebench.toml", "rig = \"exec:touch started {port}\"\n");
    folder.write("empty.toml", "");
    folder.write("boards.toml", &inventory(&[("left", "rig = \"hosted\"".to_owned())]));
    folder
}

fn bench(folder: &TestFolder, arguments: &[&str], trusted: Option<&OsStr>) -> (i32, String) {
    let mut command = bench_command(&folder.join("work"));
    command.args(arguments).envs(trusted.map(|folder| (TRUSTED, folder)));
    let output = command.output().unwrap();
    (output.status.code().unwrap(), String::from_utf8(output.stderr).unwrap())
}

fn assert_refused(folder: &TestFolder, why: &str) {
    for (arguments, file, option) in [
        (&["run", "s.toml", "--out", "run"][..], "platebench.toml", "--config"),
        (&["board", "list", "--config", "../empty.toml"][..], "boards.toml", "--boards"),
    ] {
        let (exit, text) = bench(folder, arguments, None);
        let path = folder.join(file).canonicalize().unwrap();
        let remedy = format!("name it with {option} {}", path.display());
        assert_eq!(exit, 2, "{text}");
        assert!(text.contains(why) && text.contains(&remedy) && text.contains(TRUSTED), "{text}");
        let (_, text) = bench(folder, arguments, Some(folder.path().as_os_str()));
        assert!(!text.contains(why), "{text}");
        let (_, text) = bench(folder, arguments, Some(OsStr::new("/nowhere:*")));
        assert!(!text.contains(why), "{text}");
    }
    let started = folder.join("work/started");
    fs::remove_file(&started).unwrap();
    assert_eq!(bench(folder, &["run", "s.toml", "--rig", "hosted", "--out", "hosted"], None).0, 2);
    assert!(!started.exists());
    folder.write("mine.toml", "rig = \"hosted\"\n");
    assert_eq!(bench(folder, &["run", "s.toml", "--config=../mine.toml", "--out", "named"], None).0, 0);
    let boards = ["board", "list", "--config", "../mine.toml", "--boards", "../boards.toml"];
    assert_eq!(bench(folder, &boards, None).0, 0);
}

#[test]
fn settings_in_a_world_writable_folder_start_no_program() {
    let folder = folder_with_settings();
    fs::set_permissions(folder.path(), Permissions::from_mode(0o777)).unwrap();
    assert_refused(&folder, "its folder can be changed by every user");
}

/// Only root can give a file to another user.
#[test]
fn settings_of_another_user_start_no_program() {
    let folder = folder_with_settings();
    if ["platebench.toml", "boards.toml"].iter().any(|file| chown(folder.join(file), Some(OTHER_USER), None).is_err()) {
        return platebench_test_kit::skip_without("the right to give a file to another user");
    }
    assert_refused(&folder, &format!("the file belongs to user {OTHER_USER}, and the bench runs as user 0"));
}

#[rstest]
#[case::named(&["run", "--rig", "hosted", "--out", "run"], true)]
#[case::in_a_folder(&["run", "--rig", "hosted", "--out", "run"], false)]
#[case::checked(&["check"], true)]
#[case::judged_again(&["report", "good", "--rejudge", "--scenario"], true)]
fn a_scenario_with_a_name_that_is_not_utf8_is_refused(#[case] arguments: &[&str], #[case] is_named: bool) {
    let folder = TestFolder::with_step(SETTLING);
    folder.run_hosted("good").assert_exit(0);
    let path = folder.join("scenarios").join(OsStr::from_bytes(b"a\xff.toml"));
    fs::write(&path, step_text(SETTLING)).unwrap();
    let arguments = arguments.iter().map(OsStr::new).chain(is_named.then_some(path.as_os_str()));
    folder.bench(arguments).assert_message(2, &["the name is not UTF-8", "rename the file or its folder"]);
    assert!(!folder.exists("run"));
}

#[test]
fn the_name_of_a_run_folder_cannot_forge_a_line() {
    let folder = TestFolder::with_step(SETTLING);
    let name = "run\n\u{1b}[2Jverdict: pass";
    folder.run_hosted(name).assert_stderr(&["run folder: \"run\\n\\u{1b}[2Jverdict: pass\""]);
    let output = folder.bench(["report", name]);
    assert_eq!(output.stdout, "\"run\\n\\u{1b}[2Jverdict: pass/report.html\"\n");
    folder.bench(["report", "none\nverdict: pass"]).assert_message(2, &["\"none\\nverdict: pass\": no such folder"]);
}
