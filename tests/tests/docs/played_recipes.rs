//! Plays the recipes for continuous integration as the services do: each step or job in order, if
//! the earlier ones let it run.

use crate::page::workspace_root;
use rstest::rstest;
use std::fs;
use std::process::{Command, Stdio};
use tempfile::TempDir;
use yaml_serde::Value;

#[derive(Debug, Clone, Copy, PartialEq)]
enum Baselines {
    Equal,
    Changed,
    /// A second scenario has none.
    New,
    Absent,
}

impl Baselines {
    fn compare_passes(self) -> bool {
        self == Self::Equal
    }
}

/// A project with one scenario that every law passes, and its firmware's law.
struct Project {
    folder: TempDir,
    law: &'static str,
}

impl Project {
    fn new(baselines: Baselines) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        for name in ["bin", "scenarios/plates"] {
            fs::create_dir_all(at(name)).unwrap();
        }
        std::os::unix::fs::symlink(env!("CARGO_BIN_EXE_platebench-under-test"), at("bin/platebench")).unwrap();
        let source = workspace_root().join("scenarios");
        fs::copy(source.join("plates/aluminium-198x138.toml"), at("scenarios/plates/aluminium-198x138.toml")).unwrap();
        let paper = fs::read_to_string(source.join("paper/fig13-closed-loop.toml")).unwrap();
        let (scene, _) = paper.split_once("[[expect]]").unwrap();
        let scene = scene.replace("../plates", "plates");
        let scenario = format!("{scene}[[expect]]\nmetric = \"drive_peak_vpp\"\nat_most = 5000.0\n");
        fs::write(at("scenarios/step.toml"), &scenario).unwrap();
        let project = Self { folder, law: if baselines == Baselines::Changed { "dq-pi-euler" } else { "dq-pi" } };
        if baselines != Baselines::Absent {
            let accept =
                "platebench run scenarios --rig hosted --law dq-pi --out first && platebench baseline accept first";
            assert!(project.shell(accept, &Value::Null));
        }
        if baselines == Baselines::New {
            fs::write(project.folder.path().join("scenarios/other.toml"), scenario).unwrap();
        }
        project
    }

    /// Runs a script as both services do: it ends with the first command that fails.
    fn shell(&self, script: &str, variables: &Value) -> bool {
        let path = format!("{}:{}", self.folder.path().join("bin").display(), std::env::var("PATH").unwrap());
        let mut bash = Command::new("bash");
        bash.args(["--noprofile", "--norc", "-eo", "pipefail", "-c", script]).current_dir(self.folder.path());
        for (name, _) in variables.as_mapping().into_iter().flatten().filter(|(name, _)| name.as_str() == Some("ELF")) {
            let image = workspace_root().join("firmware-under-test/images/platebench-stm32f4.elf");
            bash.env(name.as_str().unwrap(), image);
        }
        for variable in ["GITHUB_ACTIONS", "GITHUB_STEP_SUMMARY"] {
            bash.env_remove(variable);
        }
        bash.env("PATH", path).env("PLATEBENCH_LAW", self.law).stdout(Stdio::null()).stderr(Stdio::null());
        bash.status().unwrap().success()
    }

    fn exists(&self, name: &str) -> bool {
        self.folder.path().join(name).exists()
    }

    #[track_caller]
    fn assert_accepted(&self) {
        assert!(self.shell("platebench compare run baseline", &Value::Null), "the baselines are not those of the run");
    }
}

/// A step of a GitHub job.
struct Step {
    name: String,
    id: String,
    runs: bool,
    passes: bool,
}

/// Evaluates a condition of a step. Without a function of the status, GitHub adds `success()`.
fn is_met(condition: &str, event: &str, is_job_green: bool, earlier: &[Step]) -> bool {
    let condition = condition.trim().trim_start_matches("${{").trim_end_matches("}}");
    let has_status = ["always()", "!cancelled()", "success()", "failure()"].iter().any(|word| condition.contains(word));
    let is_true = |term: &str| match term.trim() {
        "" | "always()" | "!cancelled()" => true,
        "github.event_name == 'workflow_dispatch'" => event == "workflow_dispatch",
        term => {
            let id = term.strip_prefix("steps.").and_then(|term| term.strip_suffix(".outcome == 'success'"));
            let id = id.unwrap_or_else(|| panic!("`{term}` is not known to this test"));
            let step = earlier.iter().find(|step| step.id == id).unwrap_or_else(|| panic!("no step {id}"));
            step.runs && step.passes
        }
    };
    (has_status || is_job_green) && condition.split("&&").all(is_true)
}

/// Returns whether the job is green, and its steps.
fn play_github(project: &Project, recipe: &Value, event: &str) -> (bool, Vec<Step>) {
    let job = &recipe["jobs"]["bench"];
    let (mut is_green, mut steps) = (true, Vec::new());
    for step in job["steps"].as_sequence().unwrap() {
        let text = |key: &str| step[key].as_str().unwrap_or_default();
        let runs = is_met(text("if"), event, is_green, &steps);
        let script = text("run");
        let script_of_service =
            format!("export GITHUB_ACTIONS=true GITHUB_STEP_SUMMARY=\"$PWD/step-summary.md\"\n{script}");
        let is_skipped = !runs || script.is_empty() || script.starts_with("cargo ");
        let passes = is_skipped || project.shell(&script_of_service, &job["env"]);
        is_green &=
            passes || is_met(text("continue-on-error"), event, true, &steps) && !text("continue-on-error").is_empty();
        steps.push(Step { name: text("name").to_owned(), id: text("id").to_owned(), runs, passes });
    }
    (is_green, steps)
}

fn recipe(name: &str) -> Value {
    let path = workspace_root().join("docs/examples/ci").join(name);
    yaml_serde::from_str(&fs::read_to_string(path).unwrap()).unwrap()
}

#[rstest]
fn the_github_job_compares_and_accepts(
    #[values(Baselines::Equal, Baselines::Changed, Baselines::New, Baselines::Absent)] baselines: Baselines,
    #[values("pull_request", "workflow_dispatch")] event: &str,
) {
    let project = Project::new(baselines);
    let (is_green, steps) = play_github(&project, &recipe("github.yml"), event);
    let step = |name: &str| steps.iter().find(|step| step.name.starts_with(name)).unwrap();
    let is_dispatched = event == "workflow_dispatch";
    assert!(step("Run and judge").passes);
    assert_eq!(step("Compare").passes, baselines.compare_passes());
    assert_eq!(project.exists("run/comparison"), baselines == Baselines::Changed);
    let summary = fs::read_to_string(project.folder.path().join("step-summary.md")).unwrap();
    let (run, comparison) = summary.split_once(" platebench compare: ").unwrap();
    assert!(run.contains("platebench: pass"), "{run}");
    assert_eq!(comparison.contains("platebench baseline accept run"), !baselines.compare_passes(), "{comparison}");
    let changed = "| ✗ | step.toml | drive\\_peak\\_vpp | 551.4 | ";
    assert_eq!(comparison.contains(changed), baselines == Baselines::Changed);
    assert!(step("Keep the run").runs);
    for name in ["Accept", "Keep the new baselines"] {
        assert_eq!(step(name).runs, is_dispatched, "{name}");
        assert!(step(name).passes, "{name}");
    }
    assert_eq!(is_green, is_dispatched || baselines.compare_passes());
    if is_dispatched {
        project.assert_accepted();
    }
}

#[rstest]
fn the_gitlab_jobs_compare_and_accept(
    #[values(Baselines::Equal, Baselines::Changed, Baselines::New, Baselines::Absent)] baselines: Baselines,
) {
    let project = Project::new(baselines);
    let recipe = recipe("gitlab.yml");
    let play = |job: &str| {
        let lines = recipe[job]["script"].as_sequence().unwrap().iter().map(|line| line.as_str().unwrap());
        project.shell(&lines.collect::<Vec<_>>().join("\n"), &recipe["variables"])
    };
    let kept = |job: &str, passed: bool| {
        let artifacts = &recipe[job]["artifacts"];
        let paths = artifacts["paths"].as_sequence().map(Vec::as_slice).unwrap_or_default();
        let is_kept = passed || artifacts["when"].as_str() == Some("always");
        paths.iter().filter_map(Value::as_str).filter(|path| is_kept && project.exists(path)).collect::<Vec<_>>()
    };
    assert!(play("bench"));
    assert_eq!(kept("bench", true), ["run/"]);
    let passed = play("baseline");
    assert_eq!(passed, baselines.compare_passes());
    let drawings: &[&str] = if baselines == Baselines::Changed { &["run/comparison/"] } else { &[] };
    assert_eq!(kept("baseline", passed), [&["changes.md"], drawings].concat());
    let changes = fs::read_to_string(project.folder.path().join("changes.md")).unwrap();
    assert_eq!(changes.contains("platebench baseline accept run"), !baselines.compare_passes(), "{changes}");
    // The job that accepts needs no comparison that passes.
    let needed = recipe["accept"]["needs"].as_sequence().unwrap();
    assert!(needed.iter().all(|needed| needed["job"].as_str() == Some("bench")));
    assert!(play("accept"));
    assert_eq!(kept("accept", true), ["scenarios/baselines/"]);
    project.assert_accepted();
}
