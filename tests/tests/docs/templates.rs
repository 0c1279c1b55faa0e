//! Checks the CI templates for other projects: the schemas of the services, and the steps of the
//! composite action.

use crate::page::workspace_root;
use platebench_test_kit::skip_without;
use std::fs;
use std::path::Path;
use std::process::Command;
use yaml_serde::Value;

const VALIDATOR: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../target/test-readers/bin/check-jsonschema");
const ACTION: &str = "ci/templates/action/action.yml";

#[test]
fn yaml_follows_the_schemas_of_the_services() {
    if !Path::new(VALIDATOR).exists() {
        return skip_without(&format!("check-jsonschema at {VALIDATOR}"));
    }
    let check = |schema: &str, file: &Path| {
        let schema = format!("vendor.{schema}");
        let output = Command::new(VALIDATOR).args(["--builtin-schema", &schema]).arg(file).output().unwrap();
        (output.status.success(), String::from_utf8_lossy(&output.stdout).into_owned())
    };
    for (schema, file) in [
        ("github-actions", ACTION),
        ("github-workflows", "docs/examples/ci/github.yml"),
        ("gitlab-ci", "ci/templates/gitlab.yml"),
        ("gitlab-ci", "docs/examples/ci/gitlab.yml"),
        ("github-issue-forms", ".github/ISSUE_TEMPLATE/defect.yml"),
        ("github-issue-forms", ".github/ISSUE_TEMPLATE/proposal.yml"),
    ] {
        let (is_valid, text) = check(schema, &workspace_root().join(file));
        assert!(is_valid, "{file}: {text}");
    }
    let folder = tempfile::tempdir().unwrap();
    let broken = folder.path().join("action.yml");
    let text = fs::read_to_string(workspace_root().join(ACTION)).unwrap();
    fs::write(&broken, text.replacen("shell: bash", "shel: bash", 1)).unwrap();
    assert!(!check("github-actions", &broken).0, "the schema is checked");
}

/// The input `rig` has no default.
fn with_defaults(text: &str, inputs: &Value, rig: &str) -> String {
    match text.strip_prefix("${{ inputs.").and_then(|rest| rest.strip_suffix(" }}")) {
        Some("rig") => rig.to_owned(),
        Some(name) => inputs[name]["default"].as_str().unwrap().to_owned(),
        None => text.to_owned(),
    }
}

#[test]
fn the_steps_of_the_composite_action_run() {
    let action: Value = yaml_serde::from_str(&fs::read_to_string(workspace_root().join(ACTION)).unwrap()).unwrap();
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    fs::create_dir_all(at("bin")).unwrap();
    std::os::unix::fs::symlink(env!("CARGO_BIN_EXE_platebench-under-test"), at("bin/platebench")).unwrap();
    fs::create_dir_all(at("scenarios/plates")).unwrap();
    for (from, to) in [
        ("paper/fig13-closed-loop.toml", "scenarios/paper/fig13-closed-loop.toml"),
        ("plates/aluminium-198x138.toml", "scenarios/plates/aluminium-198x138.toml"),
    ] {
        fs::create_dir_all(at(to).parent().unwrap()).unwrap();
        fs::copy(workspace_root().join("scenarios").join(from), at(to)).unwrap();
    }
    let path = format!("{}:{}", at("bin").display(), std::env::var("PATH").unwrap());
    let run_script = |step: &Value, rig: &str| {
        let script = step["run"].as_str()?;
        let mut command = Command::new("bash");
        command.args(["--noprofile", "--norc", "-eo", "pipefail", "-c", script]).current_dir(folder.path());
        command.env("PATH", &path).env("GITHUB_OUTPUT", at("output")).env("GITHUB_ACTION_PATH", at("absent"));
        for (name, value) in step["env"].as_mapping().into_iter().flatten() {
            command.env(name.as_str().unwrap(), with_defaults(value.as_str().unwrap(), &action["inputs"], rig));
        }
        Some(command.output().unwrap())
    };
    let steps = action["runs"]["steps"].as_sequence().unwrap();
    let without_rig: Vec<_> = steps.iter().take(1).filter_map(|step| run_script(step, "")).collect();
    assert_eq!(without_rig.iter().map(|output| output.status.code()).collect::<Vec<_>>(), [Some(2)]);
    assert!(String::from_utf8_lossy(&without_rig[0].stdout).starts_with("::error::the input rig is empty"));
    let image = workspace_root().join("firmware-under-test/images/platebench-stm32f4.elf");
    let rig = format!("emulated:{}", image.display());
    let outputs: Vec<_> = steps.iter().filter_map(|step| run_script(step, &rig)).collect();
    for output in &outputs {
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    }
    assert_eq!(outputs.len(), 4);
    let out = fs::read_to_string(at("output")).unwrap();
    let out = out.trim().strip_prefix("run-folder=").unwrap();
    for file in ["report.html", "junit.xml", "run.json"] {
        assert!(at(out).join(file).is_file(), "{file}");
    }
}

#[test]
fn the_hook_of_pre_commit_checks_changed_scenarios() {
    let program = workspace_root().join("target/test-readers/bin/pre-commit");
    if !program.exists() {
        return skip_without(&format!("{}", program.display()));
    }
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let git = |folder: &Path, arguments: &[&str]| {
        let identity = ["-c", "user.name=t", "-c", "user.email=t@example.org"];
        let output = Command::new("git").args(identity).args(arguments).current_dir(folder).output().unwrap();
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    };
    for folder in ["hooks", "project/scenarios/plates", "bin"] {
        fs::create_dir_all(at(folder)).unwrap();
    }
    std::os::unix::fs::symlink(env!("CARGO_BIN_EXE_platebench-under-test"), at("bin/platebench")).unwrap();
    fs::copy(workspace_root().join(".pre-commit-hooks.yaml"), at("hooks/.pre-commit-hooks.yaml")).unwrap();
    let plate = "plates/aluminium-198x138.toml";
    fs::copy(workspace_root().join("scenarios").join(plate), at("project/scenarios").join(plate)).unwrap();
    let scenario = fs::read_to_string(workspace_root().join("scenarios/paper/fig13-closed-loop.toml")).unwrap();
    let scenario = scenario.replace("../plates", "plates");
    fs::write(at("project/scenarios/good.toml"), &scenario).unwrap();
    fs::write(at("project/scenarios/bad.toml"), scenario.replacen("plate = ", "plat = ", 1)).unwrap();
    for repository in ["hooks", "project"] {
        git(&at(repository), &["init", "--quiet"]);
        git(&at(repository), &["add", "."]);
        git(&at(repository), &["commit", "--quiet", "-m", "content"]);
    }
    let path = format!("{}:{}", at("bin").display(), std::env::var("PATH").unwrap());
    for (file, expected) in [("good.toml", true), ("bad.toml", false)] {
        let mut hook = Command::new(&program);
        hook.args(["try-repo", "../hooks", "platebench-check", "--files", &format!("scenarios/{file}")]);
        hook.current_dir(at("project")).env("PATH", &path).env("PRE_COMMIT_HOME", at("home"));
        let output = hook.output().unwrap();
        let text = String::from_utf8_lossy(&output.stdout);
        assert_eq!(output.status.success(), expected, "{text}{}", String::from_utf8_lossy(&output.stderr));
        assert_eq!(text.contains("plat = "), !expected, "{text}");
    }
}
