//! Tests the labgrid commands of the documentation with a coordinator and one place per board.

use super::{DEAD, KILLED, WRONG_CHIP, assert_states, clear_killed, kill_first_bench, lab, start_line, write_plan};
use crate::test_folder::{ChildGuard, SETTLING, TestFolder, lock_heavy_load, wait_until};
use platebench_model::record::{ClockKind, RunRecord, Verdict};
use platebench_test_kit::{serve_board, skip_without, workspace_root};
use rstest::rstest;
use std::fs;
use std::net::{Ipv4Addr, TcpListener};
use std::process::{Command, Stdio};

const HEALTHY: [&str; 2] = [super::HEALTHY[0], super::HEALTHY[1]];
/// Boards with a place. These are not all, because a board takes a dozen commands of Python.
const PLACES: [&str; 5] = [HEALTHY[0], HEALTHY[1], KILLED, DEAD, WRONG_CHIP];

struct Labgrid {
    folder: TestFolder,
    coordinator: ChildGuard,
    address: String,
}

impl Labgrid {
    /// Starts a coordinator without places.
    fn start(folder: TestFolder) -> Option<Self> {
        let program = workspace_root().join("target/test-readers/bin/labgrid-coordinator");
        if !program.exists() {
            skip_without(&format!("{}", program.display()));
            return None;
        }
        let port = TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).unwrap().local_addr().unwrap().port();
        let address = format!("127.0.0.1:{port}");
        let mut command = Command::new(program);
        command.args(["--listen", &address]).current_dir(folder.path());
        command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null());
        let labgrid = Self { coordinator: ChildGuard(command.spawn().unwrap()), folder, address };
        wait_until("the coordinator does not listen", || std::net::TcpStream::connect(&labgrid.address).is_ok());
        Some(labgrid)
    }

    fn create_places(&self) {
        let page = fs::read_to_string(workspace_root().join("docs/several-boards.md")).unwrap();
        let create: Vec<_> = page.lines().filter(|line| line.starts_with("labgrid-client -p left")).collect();
        assert_eq!(create.len(), 2);
        for board in PLACES {
            for line in &create {
                self.line(&line.replace("left", board)).finish().assert_exit(0);
            }
        }
    }

    fn line(&self, line: &str) -> ChildGuard {
        start_line(self.folder.path(), line, &[("LG_COORDINATOR", &self.address)])
    }

    fn assert_free(&self) {
        for board in PLACES {
            self.line(&format!("labgrid-client -p {board} release")).finish().assert_message(1, &["not acquired"]);
        }
    }
}

/// Returns the documented line that uses the wrapper and contains `word`, for `board`.
fn recipe(word: &str, board: &str) -> String {
    let page = fs::read_to_string(workspace_root().join("docs/several-boards.md")).unwrap();
    let is_recipe = |line: &&str| line.starts_with("with-labgrid-place left") && line.contains(word);
    page.lines().find(is_recipe).unwrap().replace("left", board)
}

#[test]
fn the_recipe_of_the_page_uses_each_place_once_at_a_time() {
    let _guard = lock_heavy_load();
    let folder = lab(1);
    folder.write("platebench.toml", "[run]\nclock = \"lockstep\"\n");
    write_plan(&folder);
    kill_first_bench(&folder);
    let Some(mut labgrid) = Labgrid::start(folder) else { return };
    labgrid.create_places();
    let start = |board: &'static str, name: &str| {
        (board, labgrid.line(&recipe("platebench run", board).replace("runs/", &format!("runs/{name}"))))
    };
    let mut tasks: Vec<_> = PLACES.map(|board| start(board, "")).into();
    tasks.push(start(HEALTHY[0], "again-"));
    for (board, task) in tasks {
        let expected = match board {
            KILLED => 137,
            DEAD | WRONG_CHIP => 5,
            _ => 0,
        };
        let output = task.finish();
        assert_eq!(output.exit, expected, "{board}: {}", output.stderr);
    }
    assert_states(&labgrid.folder);
    clear_killed(&labgrid.folder);
    start(KILLED, "again-").1.finish().assert_exit(0);
    let usable: Vec<_> = HEALTHY.into_iter().chain([KILLED]).collect();
    let runs = HEALTHY.map(|board| format!("runs/{board}"));
    let again = format!("runs/again-{KILLED}");
    let runs = runs.iter().map(String::as_str).chain([again.as_str()]);
    labgrid.folder.bench(["report", "--out", "all", "--merge"].into_iter().chain(runs)).assert_exit(0);
    let record = labgrid.folder.record("all");
    assert_eq!((record.scenarios.len(), record.verdict), (usable.len(), Verdict::Pass));

    let sessions: Vec<_> =
        usable.iter().map(|board| labgrid.line(&recipe("platebench acceptance run", board))).collect();
    for session in sessions {
        session.finish().assert_exit(0);
    }
    for board in &usable {
        labgrid.folder.bench(["acceptance", "verify", &format!("records/{board}")]).assert_exit(0);
    }
    labgrid.assert_free();
    assert!(!labgrid.coordinator.has_ended());
}

#[test]
fn the_template_runs_scenarios_on_a_board_behind_an_exporter() {
    let Some(labgrid) = Labgrid::start(TestFolder::with_step(SETTLING)) else { return };
    let (folder, address) = (&labgrid.folder, serve_board());
    let template = |name: &str| workspace_root().join("ci/templates").join(name);
    fs::copy(template("labgrid.yaml"), folder.join("labgrid.yaml")).unwrap();
    let (host, port) = (address.ip(), address.port());
    let resource = format!("{{host: {host}, port: {port}, speed: 1000000, protocol: raw}}");
    folder.write("exporter.yaml", &format!("plate:\n  NetworkSerialPort: {resource}\n"));
    let mut exporter = labgrid.line("labgrid-exporter --name lab exporter.yaml");
    wait_until("the exporter publishes nothing", || {
        let resources = labgrid.line("labgrid-client resources | grep -q lab/plate/NetworkSerialPort");
        resources.finish().exit == 0
    });
    for line in ["create", "add-match lab/plate/NetworkSerialPort", "acquire"] {
        labgrid.line(&format!("labgrid-client -p plate {line}")).finish().assert_exit(0);
    }
    let script = template("labgrid_run.py");
    let python = workspace_root().join("target/test-readers/bin/python");
    let run = format!("run.sh '{}' '{}'", python.display(), script.display());
    folder.write("run.sh", "LG_ENV=labgrid.yaml exec \"$@\" scenarios --time-scale 0.1 --out run\n");
    let output = labgrid.line(&format!("sh {run}")).finish();
    assert!([0, 3].contains(&output.exit), "{}", output.stderr);
    let record = RunRecord::read(&folder.join("run")).unwrap();
    // A late bench or a slow line may make the verdict inconclusive, but never a failure.
    assert_ne!(record.verdict, Verdict::Fail, "{}", output.stderr);
    assert_eq!((record.clock, record.safe_confirmed), (ClockKind::RealTime, Some(true)));
    assert_eq!(record.rig.name, format!("tcp:{address}"));
    assert!(!exporter.has_ended());
}

#[test]
fn the_template_ends_with_5_without_an_acquired_place() {
    let Some(labgrid) = Labgrid::start(TestFolder::with_step(SETTLING)) else { return };
    let template = |name: &str| workspace_root().join("ci/templates").join(name);
    fs::copy(template("labgrid.yaml"), labgrid.folder.join("labgrid.yaml")).unwrap();
    labgrid.line("labgrid-client -p plate create").finish().assert_exit(0);
    let python = workspace_root().join("target/test-readers/bin/python");
    let line =
        format!("env LG_ENV=labgrid.yaml '{}' '{}' scenarios", python.display(), template("labgrid_run.py").display());
    let output =
        labgrid.line(&line).finish().assert_message(5, &["error: no board from labgrid:", "is the place acquired?"]);
    assert!(!output.stderr.contains("Traceback"), "{}", output.stderr);
}

#[rstest]
#[case::interrupt("INT")]
#[case::terminate("TERM")]
fn the_wrapper_forwards_signals_and_releases_the_place(#[case] signal: &str) {
    let Some(labgrid) = Labgrid::start(TestFolder::new()) else { return };
    for line in ["create", "set-tags place=left"] {
        labgrid.line(&format!("labgrid-client -p left {line}")).finish().assert_exit(0);
    }
    let command =
        format!("trap 'exit 7' {signal}; touch ready; i=0; while [ $i -lt 1200 ]; do sleep 0.05; i=$((i + 1)); done");
    labgrid.folder.write("command.sh", &command);
    let wrapper = labgrid.line("with-labgrid-place left sh command.sh");
    wait_until("the command does not start", || labgrid.folder.exists("ready"));
    wrapper.signal(signal);
    wrapper.finish().assert_exit(7);
    labgrid.line("labgrid-client -p left release").finish().assert_message(1, &["not acquired"]);
}
