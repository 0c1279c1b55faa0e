//! Tests eight boards at once: a killed worker, a dead board and a wrong chip do not affect the
//! other boards.
//!
//! Each controller also holds a kernel lock that is independent of the bench's locks. If two
//! commands used one board at once, the second controller would not start and its run would end
//! with exit code 5.

mod hyperqueue;
mod labgrid;

use crate::boards::{inventory, state_of};
use crate::test_folder::{
    ChildGuard, PROGRAM, SETTLING, TestFolder, lock_heavy_load, start_bench, step_text, wait_until,
};
use platebench_model::record::Verdict;
use platebench_test_kit::{command_with_default_signals, workspace_root};
use std::fs;
use std::os::unix::fs::symlink;
use std::path::Path;
use std::process::{Command, Stdio};

const HEALTHY: [&str; 5] = ["b1", "b2", "b3", "b4", "b5"];
/// A healthy board whose first worker is killed.
const KILLED: &str = "b6";
/// A board whose program runs but never answers.
const DEAD: &str = "dead";
const WRONG_CHIP: &str = "wrong";
const SHARDS: [&str; 2] = ["1/2", "2/2"];
const LOCKSTEP: [&str; 2] = ["--clock", "lockstep"];

fn boards() -> impl Iterator<Item = &'static str> {
    HEALTHY.into_iter().chain([KILLED, DEAD, WRONG_CHIP])
}

fn lab(count: usize) -> TestFolder {
    let folder = TestFolder::new();
    for number in 1..=count {
        folder.write_scenario(&format!("s{number}.toml"), &step_text(SETTLING));
    }
    let controller = env!("CARGO_BIN_EXE_controller-under-test");
    let boards: Vec<_> = boards()
        .enumerate()
        .map(|(number, name)| {
            let chip = format!("{number:024x}");
            let unique = if name == WRONG_CHIP { "f".repeat(24) } else { chip.clone() };
            let exclusive = folder.join(&format!("{name}.use"));
            let rig = if name == DEAD {
                "exec:sh -c 'exec sleep 600' {port}".to_owned()
            } else {
                let exclusive = exclusive.display();
                format!("exec:flock --nonblock --no-fork '{exclusive}' '{controller}' {{port}} --unique {unique}")
            };
            (name, format!("rig = \"{rig}\"\nchip_id = \"{chip}\""))
        })
        .collect();
    folder.write("boards.toml", &inventory(&boards));
    folder
}

fn write_plan(folder: &TestFolder) {
    folder.replace("scenarios/s1.toml", "at_most = 2.0", "at_most = 2.0\nrequirement = \"R-1\"");
    folder.write(
        "plan.toml",
        "title = \"Eight boards\"\nrepetitions = 2\n[[requirement]]\nid = \"R-1\"\ntext = \"It settles.\"\n\
         [[scenario]]\nfile = \"scenarios/s1.toml\"\n[bench]\ntiming_trials = 1\nclean_runs = 1\n",
    );
}

fn start_shard(folder: &TestFolder, board: &str, shard: &str) -> ChildGuard {
    let out = format!("{board}-{}", &shard[..1]);
    // 16 controllers share the processors, so a reply may take longer than the default 500 ms.
    let run = ["run", "--board", board, "--shard", shard, "--wait", "500", "--reply-timeout", "5000", "--out", &out];
    start_bench(folder.path(), run.into_iter().chain(LOCKSTEP))
}

fn start_session(folder: &TestFolder, board: &str) -> ChildGuard {
    let out = format!("record-{board}");
    let session =
        ["acceptance", "run", "--plan", "plan.toml", "--board", board, "--yes", "--wait", "500", "--out", &out];
    start_bench(folder.path(), session.into_iter().chain(LOCKSTEP))
}

/// Runs `line` in a shell. `PATH` contains the programs that the documentation uses.
pub(crate) fn start_line(folder: &Path, line: &str, variables: &[(&str, &str)]) -> ChildGuard {
    let programs = folder.join("bin");
    if !programs.exists() {
        fs::create_dir(&programs).unwrap();
        symlink(env!("CARGO_BIN_EXE_platebench-under-test"), programs.join("platebench")).unwrap();
        let wrapper = "with-labgrid-place";
        symlink(workspace_root().join("ci/templates").join(wrapper), programs.join(wrapper)).unwrap();
    }
    let readers = workspace_root().join("target/test-readers/bin");
    let path = format!("{}:{}:{}", programs.display(), std::env::var("PATH").unwrap(), readers.display());
    let mut shell = command_with_default_signals("sh");
    shell.args(["-c", &format!("exec {line}")]).current_dir(folder).env("PATH", path);
    shell.envs(variables.iter().copied());
    ChildGuard(shell.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap())
}

/// Makes the program of the board kill the first bench that plays a run on it. The program then
/// starts no controller, because another bench may already use the same pseudo-terminal.
fn kill_first_bench(folder: &TestFolder) {
    let script = format!(
        "if grep -q '\"process\"' boards.state/{KILLED}.json && mkdir killed; \
         then kill -KILL $PPID; exit 1; fi 2>/dev/null\nexec \"$@\"\n"
    );
    folder.write("kill.sh", &script);
    let controller = format!("flock --nonblock --no-fork '{}'", folder.join(&format!("{KILLED}.use")).display());
    folder.replace("boards.toml", &controller, &format!("sh kill.sh {controller}"));
}

#[track_caller]
fn assert_states(folder: &TestFolder) {
    let is_quarantined = |board: &str| [KILLED, WRONG_CHIP].contains(&board);
    for (number, board) in boards().enumerate() {
        let state = state_of(folder, number);
        let expected = if is_quarantined(board) { "quarantined" } else { "free" };
        assert_eq!((&state["name"], &state["state"]), (&board.into(), &expected.into()), "{state}");
    }
}

/// Ends the quarantine and waits until the controller of the killed bench has ended.
fn clear_killed(folder: &TestFolder) {
    folder.bench(["run", "--board", KILLED]).assert_message(5, &["quarantine"]);
    folder.bench(["board", "clear", KILLED, "--reason", "0 V measured"]).assert_exit(0);
    let exclusive = folder.join(&format!("{KILLED}.use"));
    wait_until("the controller of the killed bench does not end", || {
        Command::new("flock").arg("--nonblock").arg(&exclusive).arg("true").status().unwrap().success()
    });
}

#[test]
fn two_controllers_on_one_board_would_be_noticed() {
    let folder = lab(1);
    let mut command = Command::new("flock");
    let exclusive = folder.join("b1.use");
    command.arg(exclusive).arg(PROGRAM).args(["run", "--board", "b1"]).current_dir(folder.path());
    assert_eq!(command.output().unwrap().status.code(), Some(5));
}

#[test]
fn eight_boards_share_a_regression() {
    let _guard = lock_heavy_load();
    let folder = lab(2);
    let minute = TestFolder::with_minute();
    folder.write("minute.toml", &minute.read("scenarios/s.toml").replace("\"plates/", "\"scenarios/plates/"));
    let worker = ["run", "minute.toml", "--board", KILLED, "--shard", "1/2", "--out", "killed"];
    let mut worker = start_bench(folder.path(), worker.into_iter().chain(LOCKSTEP));
    wait_until("the run never began", || folder.exists("killed/run.json"));
    let tasks: Vec<_> =
        boards().flat_map(|board| SHARDS.map(|shard| (board, start_shard(&folder, board, shard)))).collect();
    assert!(!worker.has_ended());
    worker.kill();
    for (board, task) in tasks {
        let expected = if HEALTHY.contains(&board) { 0 } else { 5 };
        let output = task.finish();
        assert_eq!(output.exit, expected, "{board}: {}", output.stderr);
    }
    assert_states(&folder);

    let runs = |boards: &[&str]| {
        let runs = boards.iter().flat_map(|board| ["1", "2"].map(|shard| format!("{board}-{shard}")));
        runs.collect::<Vec<_>>()
    };
    let merge = |runs: Vec<String>, out: &str| {
        folder.bench(
            ["report".to_owned(), "--merge".to_owned()]
                .into_iter()
                .chain(runs)
                .chain(["--out".to_owned(), out.to_owned()]),
        )
    };
    let mut present = runs(&HEALTHY);
    present.pop();
    merge(present.clone(), "part").assert_text(3, &["shard 2/2 of b5 is missing"]);
    present.push("killed".to_owned());
    merge(present, "mixed").assert_message(2, &["killed: the selection of scenarios (SHA-256) is "]);
    clear_killed(&folder);
    for shard in SHARDS {
        start_shard(&folder, KILLED, shard).finish().assert_exit(0);
    }
    let boards: Vec<_> = HEALTHY.into_iter().chain([KILLED]).collect();
    merge(runs(&boards), "all").assert_exit(0).assert_stdout(&["scenario  b1      b2      b3      b4      b5      b6"]);
    let record = folder.record("all");
    assert_eq!((record.scenarios.len(), record.verdict), (12, Verdict::Pass));
    assert!(record.scenarios.iter().all(|scenario| scenario.trials.len() == 1));
}

#[test]
fn eight_boards_share_an_acceptance() {
    let _guard = lock_heavy_load();
    let folder = lab(1);
    write_plan(&folder);
    let mut worker = start_session(&folder, KILLED);
    let is_marked = |state: &serde_json::Value| state["state"] == "held" && !state["since"].is_null();
    wait_until("the session never began", || is_marked(&state_of(&folder, HEALTHY.len())));
    let sessions: Vec<_> =
        HEALTHY.into_iter().chain([DEAD, WRONG_CHIP]).map(|board| (board, start_session(&folder, board))).collect();
    assert!(!worker.has_ended());
    worker.kill();
    for (board, session) in sessions {
        let expected = if HEALTHY.contains(&board) { 0 } else { 5 };
        let output = session.finish();
        assert_eq!(output.exit, expected, "{board}: {}", output.stderr);
    }
    assert_states(&folder);
    clear_killed(&folder);
    let record = format!("record-{KILLED}");
    let again = if folder.exists(&format!("{record}/session.json")) { "--resume" } else { "--out" };
    folder
        .bench(
            ["acceptance", "run", "--plan", "plan.toml", "--board", KILLED, "--yes", again, &record]
                .into_iter()
                .chain(LOCKSTEP),
        )
        .assert_exit(0);
    for (number, board) in HEALTHY.into_iter().chain([KILLED]).enumerate() {
        folder.bench(["acceptance", "verify", &format!("record-{board}")]).assert_exit(0);
        let last = state_of(&folder, number)["last_run"]["folder"].clone();
        assert!(last.as_str().is_some_and(|last| last.ends_with("-s1")), "the last step: {last}");
    }
}
