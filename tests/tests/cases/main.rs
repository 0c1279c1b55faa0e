//! Runs the commands of `tests/cases/*.trycmd` and compares exit code and output.
//!
//! A case file has a folder of its own, which starts with the content of `NAME.in`. The commands
//! run in order. `TRYCMD=overwrite` writes the actual output, `-- cases trycmd=NAME` selects files.

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    reason = "a test that cannot go on ends by panicking"
)]

use std::collections::BTreeMap;
use std::os::unix::fs::symlink;
use std::path::{Path, PathBuf};
use std::time::Duration;
use std::{env, fs};

const CASES: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/cases");
const TOOLS: [&str; 14] =
    ["cat", "cmp", "cp", "env", "grep", "ln", "ls", "mkdir", "mkfifo", "mv", "rm", "sh", "test", "touch"];
/// A command that waits for input would otherwise never end.
const TIMEOUT: Duration = Duration::from_mins(2);

fn find_tool(name: &str) -> PathBuf {
    let path = env::var_os("PATH").unwrap();
    env::split_paths(&path).map(|folder| folder.join(name)).find(|file| file.is_file()).expect(name)
}

/// Creates a folder with the programs of the project for the search path of `sh`.
fn program_folder() -> BTreeMap<String, PathBuf> {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join("cases");
    fs::create_dir_all(&folder).unwrap();
    let programs = [
        ("platebench", env!("CARGO_BIN_EXE_platebench-under-test").to_owned()),
        ("controller", env!("CARGO_BIN_EXE_controller-under-test").to_owned()),
        ("suite", env!("CARGO_BIN_EXE_suite-under-test").to_owned()),
        ("step", format!("{CASES}/step")),
        ("edit", format!("{CASES}/edit")),
    ];
    let link = |(name, program): (&str, String)| {
        let link = folder.join(name);
        let _ = fs::remove_file(&link);
        symlink(program, &link).unwrap();
        (name.to_owned(), link)
    };
    programs.into_iter().map(link).collect()
}

fn case_files() -> Vec<PathBuf> {
    let entries = fs::read_dir(CASES).unwrap().map(|entry| entry.unwrap().path());
    entries.filter(|path| path.extension().is_some_and(|extension| extension == "trycmd")).collect()
}

/// `trycmd` ignores a command whose program is unknown, and shares the folder of a file without
/// `NAME.out`.
fn check_case_files(programs: &BTreeMap<String, PathBuf>) {
    let files = case_files();
    assert!(!files.is_empty(), "no case files in {CASES}");
    for file in files {
        assert!(file.with_extension("out").is_dir(), "{}: expected the folder NAME.out", file.display());
        let text = fs::read_to_string(&file).unwrap();
        for (number, line) in text.lines().enumerate() {
            let Some(command) = line.strip_prefix("$ ") else { continue };
            let program = command.split_whitespace().next().unwrap_or_default();
            assert!(programs.contains_key(program), "{}:{}: unknown program {program}", file.display(), number + 1);
        }
    }
}

#[test]
fn cases() {
    let mut programs = program_folder();
    let mut path = programs["platebench"].parent().unwrap().as_os_str().to_owned();
    programs.extend(TOOLS.map(|name| (name.to_owned(), find_tool(name))));
    check_case_files(&programs);
    path.push(":");
    path.push(env::var_os("PATH").unwrap());
    let cases = trycmd::TestCases::new();
    cases.case(format!("{CASES}/*.trycmd")).timeout(TIMEOUT);
    cases.register_bins(programs.into_iter().map(|(name, path)| (name, trycmd::schema::Bin::Path(path))));
    cases.env("PATH", path.into_string().unwrap());
    cases.env("REPOSITORY", platebench_test_kit::workspace_root().display().to_string());
    // The output is the same everywhere. An empty filter of the log would have an effect.
    assert!(env::var_os("PLATEBENCH_LOG").is_none(), "PLATEBENCH_LOG is set");
    cases.env("LC_ALL", "C");
    for variable in ["NO_COLOR", "GITHUB_ACTIONS", "GITHUB_STEP_SUMMARY", "GITHUB_WORKSPACE"] {
        cases.env(variable, "");
    }
    cases.run();
}
