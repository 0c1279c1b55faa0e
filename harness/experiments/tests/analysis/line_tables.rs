//! Tests images without line tables: their coverage is an error, not 100 %.

use crate::suite_of;
use platebench_experiments::firmware_analysis::{
    CodeCoverage, CoverageConfig, FirmwareAnalysisError, measure_coverage,
};
use platebench_rig::{BUILT_IN_IMAGE, CancelToken};
use platebench_test_kit::{skip_without, workspace_root};
use std::path::{Path, PathBuf};
use std::process::Command;

const TARGET: &str = "-mcpu=cortex-m4 -mthumb -mfpu=fpv4-sp-d16 -mfloat-abi=hard -DBUILD_ID=1ull -std=c11 -O2";

fn coverage(elf: &Path, only: &[&str]) -> Result<CodeCoverage, FirmwareAnalysisError> {
    let suite = suite_of(Some(elf), &["paper/fig13-closed-loop.toml"]);
    let only = only.iter().map(|&part| part.to_owned()).collect();
    measure_coverage(&CoverageConfig { suite, jobs: 1, only, cancel: CancelToken::never() })
}

fn run(command: &mut Command) {
    let output = command.output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
}

/// Returns the shipped image after `arm-none-eabi-objcopy` with this option, or `None` without the program.
fn converted_image(folder: &Path, option: &str) -> Option<PathBuf> {
    let objcopy = || Command::new("arm-none-eabi-objcopy");
    if objcopy().arg("--version").output().is_err() {
        skip_without("arm-none-eabi-objcopy");
        return None;
    }
    let (from, to) = (folder.join("shipped.elf"), folder.join("converted.elf"));
    std::fs::write(&from, BUILT_IN_IMAGE).unwrap();
    run(objcopy().arg(option).args([&from, &to]));
    Some(to)
}

/// Builds the C starter with these compiler options, or returns `None` without a compiler.
fn starter(folder: &Path, options: &str) -> Option<PathBuf> {
    let libraries = Command::new("arm-none-eabi-gcc").arg("--print-file-name=nano.specs").output();
    if !libraries.is_ok_and(|output| String::from_utf8_lossy(&output.stdout).contains('/')) {
        skip_without("arm-none-eabi-gcc or newlib");
        return None;
    }
    let mut make = Command::new("make");
    make.arg("-C").arg(workspace_root().join("firmware-under-test/starter-c"));
    run(make.arg(format!("BUILD={}", folder.display())).arg(format!("CFLAGS={TARGET} {options}")));
    Some(folder.join("starter.elf"))
}

fn error_of(result: Result<CodeCoverage, FirmwareAnalysisError>) -> String {
    match result {
        Err(error @ FirmwareAnalysisError::NoLines { .. }) => {
            assert!(error.is_invalid_input());
            error.to_string()
        }
        other => panic!("{other:?}"),
    }
}

#[test]
fn an_image_without_line_tables_is_an_error() {
    let folder = tempfile::tempdir().unwrap();
    let Some(elf) = converted_image(folder.path(), "--strip-debug") else { return };
    let message = error_of(coverage(&elf, &[]));
    assert!(message.contains("functions in flash have no line table: "), "{message}");
    assert!(message.contains("compile with -g, and do not strip the ELF"), "{message}");
    assert_eq!(error_of(coverage(&elf, &["controller/src"])), message);
}

#[test]
fn compressed_line_tables_are_an_error() {
    let folder = tempfile::tempdir().unwrap();
    let Some(elf) = converted_image(folder.path(), "--compress-debug-sections") else { return };
    let message = error_of(coverage(&elf, &[]));
    assert!(message.contains("link with -gz=none"), "{message}");
}

#[test]
fn code_compiled_without_g_is_an_error() {
    let folder = tempfile::tempdir().unwrap();
    let Some(elf) = starter(folder.path(), "-g0") else { return };
    let message = error_of(coverage(&elf, &[]));
    assert!(message.contains("compile with -g"), "{message}");
}

#[test]
fn one_file_without_line_table_is_an_error_unless_others_are_selected() {
    let [folder, other] = [(); 2].map(|()| tempfile::tempdir().unwrap());
    let Some(_) = starter(folder.path(), "-g") else { return };
    starter(other.path(), "-g0").unwrap();
    std::fs::copy(other.path().join("damping.o"), folder.path().join("damping.o")).unwrap();
    let elf = starter(folder.path(), "-g").unwrap();
    let message = error_of(coverage(&elf, &[]));
    assert!(message.contains("have no line table: damping_start, damping_follow, damping_remember;"), "{message}");
    let selected = coverage(&elf, &["/law.c"]).unwrap();
    assert!(selected.files.keys().all(|file| file.ends_with("/law.c")) && selected.line_ratio().executed > 20);
}

#[test]
fn files_of_the_c_library_are_left_out() {
    let folder = tempfile::tempdir().unwrap();
    let sources = workspace_root().join("firmware-under-test/starter-c").canonicalize().unwrap();
    let options = format!("-g -fdebug-prefix-map={}=/nowhere/starter-c", sources.display());
    let Some(elf) = starter(folder.path(), &options) else { return };
    let coverage = coverage(&elf, &[]).unwrap();
    // No source exists, so files are not left out for that.
    let others: Vec<_> = coverage.files.keys().filter(|file| !file.contains("starter-c/")).collect();
    assert!(others.is_empty(), "{others:?}");
    assert!(coverage.line_ratio().executed > 200, "{:?}", coverage.line_ratio());
}

#[test]
fn split_debug_information_keeps_functions_apart() {
    let folder = tempfile::tempdir().unwrap();
    let Some(elf) = starter(folder.path(), "-g -gsplit-dwarf") else { return };
    let coverage = coverage(&elf, &[]).unwrap();
    let (_, law) = coverage.files.iter().find(|(file, _)| file.ends_with("/law.c")).unwrap();
    let names: Vec<_> = law.functions.keys().map(String::as_str).collect();
    assert_eq!(names, ["design_both", "law_configure", "law_step", "pi_step"]);
}
