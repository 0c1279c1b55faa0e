use crate::{suite, workspace_root};
use platebench_experiments::firmware_analysis::{
    CodeCoverage, CoverageConfig, FirmwareAnalysisError, lcov_tracefile, measure_coverage,
};
use platebench_rig::CancelToken;
use platebench_test_kit::skip_without;
use std::fs;
use std::process::Command;

fn coverage(scenarios: &[&str], only: &[&str]) -> Result<CodeCoverage, FirmwareAnalysisError> {
    let only = only.iter().map(|&part| part.to_owned()).collect();
    measure_coverage(&CoverageConfig { suite: suite(scenarios), jobs: 1, only, cancel: CancelToken::never() })
}

/// True if more than three lines of the file were executed.
fn executes(coverage: &CodeCoverage, file: &str) -> bool {
    let (_, file) = coverage.files.iter().find(|(path, _)| path.ends_with(file)).unwrap();
    file.lines.values().filter(|line| line.executed).count() > 3
}

#[test]
fn a_scenario_executes_its_own_law_only() {
    let coverage = coverage(&["paper/fig13-closed-loop.toml"], &["controller/src"]).unwrap();
    assert!(executes(&coverage, "dq_pi.rs"), "{coverage:?}");
    assert!(!executes(&coverage, "deadbeat.rs"), "{coverage:?}");
    let (_, law) = coverage.files.iter().find(|(path, _)| path.ends_with("dq_pi.rs")).unwrap();
    assert!(law.functions.values().any(|function| function.in_control_step), "{law:?}");
}

/// The tests run in the folder of this crate, where no name of the image is a file.
#[test]
fn names_come_from_the_image_alone() {
    let coverage = coverage(&["paper/fig13-closed-loop.toml"], &[]).unwrap();
    let files: Vec<_> = coverage.files.keys().collect();
    assert!(files.iter().any(|file| file.as_str() == "firmware-under-test/controller/src/dq_pi.rs"), "{files:?}");
    let missing: Vec<_> = files.iter().filter(|file| !workspace_root().join(file).is_file()).collect();
    assert!(missing.is_empty(), "{missing:?}");
}

#[test]
fn an_unknown_path_is_an_error() {
    let error = coverage(&["paper/fig13-closed-loop.toml"], &["no such file"]).unwrap_err();
    assert_eq!(error.to_string(), "no function or file matches `no such file`");
}

#[test]
fn genhtml_renders_the_tracefile() {
    if Command::new("genhtml").arg("--version").output().is_err() {
        return skip_without("genhtml");
    }
    let coverage = coverage(&["paper/fig13-closed-loop.toml"], &["controller/src"]).unwrap();
    let folder = tempfile::tempdir().unwrap();
    let tracefile = folder.path().join("lcov.info");
    fs::write(&tracefile, lcov_tracefile(&coverage)).unwrap();
    let mut genhtml = Command::new("genhtml");
    genhtml.arg("--output-directory").arg(folder.path().join("html")).arg(&tracefile).current_dir(workspace_root());
    let output = genhtml.output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let ratio = coverage.line_ratio();
    let expected = format!("{:.1}% ({} of {} lines)", ratio.percent(), ratio.executed, ratio.total);
    let text = String::from_utf8_lossy(&output.stdout).into_owned();
    assert!(text.contains(&expected), "expected {expected}: {text}");
}
