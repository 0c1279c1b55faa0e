//! The bench as the tests hold it.

use platebench_record::Overrides;
use platebench_record::RunFolder;
use platebench_record::RunRecord;
use platebench_rig::RigSpec;
use platebench_runner::{RunHooks, RunPlan};
use platebench_scenario::load;
use platebench_trace::Row;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output};
use std::thread::sleep;
use std::time::{Duration, Instant};
use tempfile::TempDir;

pub(crate) use platebench_test_kit::workspace_root;

/// The program, in a folder where a run may leave its traces.
pub(crate) fn bench_command(folder: &Path) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_platebench-under-test"));
    command.current_dir(folder);
    // What surrounds the tests is not what they test.
    for variable in ["PLATEBENCH_LOG", "GITHUB_ACTIONS", "GITHUB_STEP_SUMMARY", "GITHUB_WORKSPACE"] {
        command.env_remove(variable);
    }
    command
}

/// Starts the program with `arguments` in `folder` and waits for its end.
pub(crate) fn run_bench<A: AsRef<std::ffi::OsStr>>(folder: &Path, arguments: impl IntoIterator<Item = A>) -> Output {
    bench_command(folder).args(arguments).output().unwrap()
}

/// `--rig` for the controller program that plays the board, writing down what it does where a file is named.
pub(crate) fn controller_rig(log: Option<&Path>) -> String {
    let log = log.map_or_else(String::new, |file| format!(" --log '{}'", file.display()));
    format!("exec:'{}' {{port}}{log}", env!("CARGO_BIN_EXE_controller-under-test"))
}

/// Waits for `there`, which comes soon or is missed.
#[track_caller]
pub(crate) fn wait_until(what: &str, mut there: impl FnMut() -> bool) {
    let started = Instant::now();
    while !there() {
        assert!(started.elapsed() < Duration::from_mins(1), "{what}");
        sleep(Duration::from_millis(5));
    }
}

/// A process that does not outlive its test.
pub(crate) struct ChildGuard(pub(crate) Child);

impl Drop for ChildGuard {
    fn drop(&mut self) {
        // It may have ended already.
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// The number of the process that `parent` has started.
#[track_caller]
pub(crate) fn child_process_id(parent: &Child) -> String {
    let tasks = fs::read_dir(format!("/proc/{}/task", parent.id())).unwrap();
    // One that ends meanwhile has no children.
    let children = tasks.flatten().filter_map(|task| fs::read_to_string(task.path().join("children")).ok());
    children.collect::<String>().split_whitespace().next().expect("it has a child").to_owned()
}

/// Sends `child` the signal of that name.
pub(crate) fn send_signal(child: &Child, name: &str) {
    let status = Command::new("kill").args([&format!("-{name}"), &child.id().to_string()]).status().unwrap();
    assert!(status.success());
}

/// The program's exit code.
#[track_caller]
pub(crate) fn exit_code(output: &Output) -> i32 {
    let code = output.status.code();
    code.unwrap_or_else(|| panic!("ended by a signal: {}", String::from_utf8_lossy(&output.stderr)))
}

/// A folder with the repository's plates and scenarios of the test's own.
pub(crate) struct TestFolder {
    folder: TempDir,
}

impl TestFolder {
    pub(crate) fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let plates = folder.path().join("scenarios/plates");
        fs::create_dir_all(&plates).unwrap();
        for plate in fs::read_dir(workspace_root().join("scenarios/plates")).unwrap() {
            let path = plate.unwrap().path();
            fs::copy(&path, plates.join(path.file_name().unwrap())).unwrap();
        }
        Self { folder }
    }

    pub(crate) fn path(&self) -> &Path {
        self.folder.path()
    }

    /// Writes `scenarios/<name>` and returns its path.
    pub(crate) fn write_scenario(&self, name: &str, text: &str) -> PathBuf {
        let path = self.path().join("scenarios").join(name);
        fs::write(&path, text).unwrap();
        path
    }

    /// Plays a scenario text on the hosted rig and returns its record and its first trace.
    pub(crate) fn run_scenario(&self, text: &str) -> (RunRecord, Vec<Row>) {
        let path = self.write_scenario("played.toml", text);
        let scenario = load(&path, "played.toml").unwrap_or_else(|fault| panic!("{fault}"));
        let out = tempfile::tempdir_in(self.path()).unwrap();
        let folder = RunFolder::create(Some(out.path())).unwrap();
        let plan = RunPlan {
            scenarios: vec![scenario],
            jobs: 1,
            clock: platebench_runner::Clock::Lockstep { wire_time: false },
            own_clock: false,
            rig: "hosted".to_owned(),
            overrides: Overrides::default(),
        };
        let record =
            platebench_runner::run(&plan, &folder, &|| RigSpec::Hosted.connect(), RunHooks::default()).unwrap();
        let trace = out.path().join(&record.scenarios[0].trials[0].trace);
        (record, platebench_trace::read_trace(&trace).unwrap())
    }

    /// The first expectation's value of a scenario text.
    pub(crate) fn first_value(&self, text: &str) -> Option<f64> {
        self.run_scenario(text).0.scenarios[0].expectations[0].value
    }
}

/// A scenario of the paper's plate with a step to 2 µm at the start; `controller`, `more` and `expect` are TOML.
pub(crate) fn step_scenario(plate: &str, controller: &str, profile: &str, expect: &str) -> String {
    format!(
        "title = \"step\"\nplate = \"plates/{plate}.toml\"\nduration_ms = 60.0\n\
         [controller]\n{controller}\n[profile]\nsetpoint_um = 2.0\n{profile}\n[[expect]]\n{expect}\n"
    )
}
