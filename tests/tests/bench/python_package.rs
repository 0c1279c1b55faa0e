//! Tests the Python package: builds its wheel with maturin, installs the wheel into a new
//! environment, and uses it from scripts and pytest.

use crate::test_folder::{TestFolder, step_text, workspace_root};
use platebench_test_kit::skip_without;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

const PROGRAM: &str = env!("CARGO_BIN_EXE_platebench-under-test");
const READERS: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../target/test-readers");
const FILES: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/bench/python");

#[track_caller]
fn call(command: &mut Command) -> String {
    let (status, text) = output(command.output().unwrap());
    assert_eq!(status, 0, "{command:?}: {text}");
    text
}

fn output(output: Output) -> (i32, String) {
    let text = [output.stdout, output.stderr].concat();
    (output.status.code().unwrap_or(-1), String::from_utf8_lossy(&text).into_owned())
}

/// Builds the wheel from the compiled program, so that it is not compiled again.
fn build_wheel(folder: &Path) -> PathBuf {
    let dist = folder.join("dist");
    call(Command::new(workspace_root().join("ci/wheel")).arg(PROGRAM).arg(&dist));
    let wheels: Vec<_> = fs::read_dir(dist).unwrap().map(|entry| entry.unwrap().path()).collect();
    let [wheel] = &wheels[..] else { panic!("{wheels:?}") };
    wheel.clone()
}

/// Creates an environment with the wheel, and pandas, polars and pytest of `target/test-readers`.
fn environment(folder: &Path) -> PathBuf {
    let venv = folder.join("venv");
    call(Command::new(format!("{READERS}/bin/python")).args(["-m", "venv", "--without-pip"]).arg(&venv));
    let python = venv.join("bin/python");
    let print = |python: &Path| {
        let code = "import sysconfig; print(sysconfig.get_path('purelib'))";
        call(Command::new(python).args(["-c", code])).trim().to_owned()
    };
    let readers = print(Path::new(&format!("{READERS}/bin/python")));
    fs::write(Path::new(&print(&python)).join("readers.pth"), readers).unwrap();
    let wheel = build_wheel(folder);
    call(
        Command::new(format!("{READERS}/bin/pip"))
            .arg("--python")
            .arg(&python)
            .args(["install", "--no-deps", "--no-index", "--disable-pip-version-check"])
            .arg(wheel),
    );
    python
}

#[test]
fn the_wheel_plays_scenarios_and_pytest_collects_them() {
    if !Path::new(READERS).join("bin/maturin").exists() {
        return skip_without(&format!("maturin in {READERS}"));
    }
    let folder = TestFolder::new();
    let limit = |value: f64| step_text(&format!("metric = \"settling_time_ms\"\nat_most = {value}"));
    folder.write_scenario("good.toml", &limit(2.0));
    folder.write_scenario("bad.toml", &limit(0.5));
    folder.write_scenario("limit.toml", &limit(0.5).replacen("title", "expected_exit = 1\ntitle", 1));
    let python = environment(&folder.join(""));

    let script = Path::new(FILES).join("use_package.py");
    let text = call(Command::new(&python).arg(script).current_dir(folder.join("")));
    assert!(text.ends_with("pandas and polars agree\n"), "{text}");

    let options = ["-m", "pytest", "-n", "2", "-rs", "scenarios", "--platebench-rig", "hosted", "--durations", "1"];
    let (status, text) = output(Command::new(&python).args(options).current_dir(folder.join("")).output().unwrap());
    assert_eq!(status, 1, "{text}");
    for part in [
        "bad.toml: step",
        "settling_time_ms: fail",
        "report.html",
        "1 failed",
        "2 passed",
        "s call ",
        ".toml::scenario",
    ] {
        assert!(text.contains(part), "{part} is not in {text}");
    }
    assert!(!text.contains("Traceback"), "{text}");
    // Their hooks read attributes of every test.
    for plugin in ["embedded-", "labgrid-", "timeout-"] {
        assert!(text.contains(plugin), "{plugin} is not in {text}");
    }

    // Folders that pytest skips by default contain scenarios too.
    for name in ["build", "dist/deep", "venv", "node_modules"] {
        fs::create_dir_all(folder.join("more").join(name)).unwrap();
        folder.write(&format!("more/{name}/good.toml"), &limit(2.0));
        folder.write(&format!("more/{name}/test_no_scenario.py"), "def test(): assert False\n");
    }
    let pytest = |arguments: &[&str]| {
        let options = ["-m", "pytest", "--platebench-rig", "hosted", "--rootdir", "."];
        output(Command::new(&python).args(options).args(arguments).current_dir(folder.join("")).output().unwrap())
    };
    let (_, text) = pytest(&["more", "--collect-only", "-q"]);
    assert_eq!(text.matches("good.toml::scenario").count(), 4, "{text}");
    assert!(!text.contains("test_no_scenario"), "{text}");

    // The hosted rig measures no time of a step, as `run` says with 4.
    folder.write_scenario("timed.toml", &step_text("metric = \"step_time_percent\"\nat_most = 50.0"));
    for (arguments, status) in [
        (&["scenarios/timed.toml"][..], 4),
        (&["-n", "2", "scenarios/timed.toml"], 4),
        (&["scenarios/timed.toml", "scenarios/good.toml"], 0),
    ] {
        let (ended, text) = pytest(arguments);
        assert_eq!(ended, status, "{text}");
    }
}
