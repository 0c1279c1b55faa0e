//! Tests the text that a firmware writes by RTT (a buffer in memory), with a changed C starter.

use crate::starter_c::has_cross_compiler;
use crate::test_folder::{TestFolder, run_bench, step_text, workspace_root};
use platebench_engine::rejudge;
use platebench_model::record::RunRecord;
use platebench_test_kit::skip_without;
use std::fs;
use std::process::Command;

/// C code with an RTT buffer that is smaller than the text of a trial, so that it wraps.
const RTT: &str = r#"
#include <string.h>
struct channel { const char *name; char *buffer; uint32_t size; volatile uint32_t written, read; uint32_t flags; };
struct { char identifier[16]; int32_t up, down; struct channel channel; } _SEGGER_RTT;
static char ring[16];

static void rtt_start(void)
{
    memset(&_SEGGER_RTT, 0, sizeof _SEGGER_RTT);
    _SEGGER_RTT.channel = (struct channel){"Terminal", ring, sizeof ring, 0, 0, 0};
    _SEGGER_RTT.up = 1;
    memcpy(_SEGGER_RTT.identifier, "SEGGER RTT", 10);
}

static void rtt_write(const char *text)
{
    for (; *text != 0; text++) {
        uint32_t next = (_SEGGER_RTT.channel.written + 1) % sizeof ring;
        if (next == _SEGGER_RTT.channel.read)
            return;
        ring[_SEGGER_RTT.channel.written] = *text;
        _SEGGER_RTT.channel.written = next;
    }
}
"#;

/// Builds the starter with a text at its start and at each sample, and returns its rig. `None`
/// without a cross compiler.
fn build_talking_starter(folder: &TestFolder) -> Option<String> {
    if !has_cross_compiler() {
        skip_without("make, arm-none-eabi-gcc or newlib");
        return None;
    }
    let source = workspace_root().join("firmware-under-test/starter-c");
    let copied = Command::new("cp").arg("-r").arg(source).arg(folder.join("starter")).status().unwrap();
    assert!(copied.success());
    for (old, new) in [
        ("static struct controller controller;", &*format!("{RTT}\nstatic struct controller controller;")),
        ("    amplifier_start();", "    rtt_start();\n    rtt_write(\"started\\n\");\n    amplifier_start();"),
        ("message.kind == SAMPLE) {\n", "message.kind == SAMPLE) {\n        rtt_write(\"step\\n\");\n"),
    ] {
        folder.replace("starter/main.c", old, new);
    }
    make_starter(folder);
    Some(format!("emulated:{}", folder.join("starter/build/starter.elf").display()))
}

fn make_starter(folder: &TestFolder) {
    let made = Command::new("make").arg("-C").arg(folder.join("starter")).output().unwrap();
    assert!(made.status.success(), "{}", String::from_utf8_lossy(&made.stderr));
}

#[test]
fn text_by_rtt_is_in_the_record_of_its_trial() {
    let folder = TestFolder::new();
    let Some(rig) = build_talking_starter(&folder) else { return };
    let play = |scenario: &str, trials: &str, out: &str| {
        let out = folder.join(out);
        let arguments = ["run", scenario, "--trials", trials, "--rig", &rig, "--out", out.to_str().unwrap()];
        run_bench(&workspace_root(), arguments).assert_exit(0);
        let trials = RunRecord::read(&out).unwrap().scenarios.remove(0).trials;
        let page = fs::read_to_string(out.join("report.html")).unwrap();
        (trials.into_iter().map(|trial| trial.telemetry.firmware_output.unwrap()).collect::<Vec<_>>(), page)
    };
    // 60 periods have 61 samples, because there is one at each end of a period.
    let expected = format!("started\n{}", "step\n".repeat(61));
    let (texts, page) = play("scenarios/paper/fig13-closed-loop.toml", "2", "short");
    assert_eq!(texts, [expected.clone(), expected.clone()]);
    assert!(page.contains(&expected));
    let (texts, _) = play("scenarios/paper/temperature-ramp.toml", "1", "long");
    assert_eq!(texts[0].split_once("\n(cut after ").unwrap().0.len(), 16 * 1024);
}

/// Expectation of a text, and a reset of the chip at 40.4 ms if `has_reset`.
fn text_scenario(text: &str, rest: &str, has_reset: bool) -> String {
    let fault = if has_reset { "[[fault]]\nkind = \"reset\"\nat_ms = 40.4\n" } else { "" };
    step_text(&format!("metric = \"text_ms\"\ntext = \"{text}\"\n{rest}\n{fault}"))
}

#[test]
fn an_expected_text_is_judged_from_its_instant() {
    let folder = TestFolder::new();
    let Some(rig) = build_talking_starter(&folder) else { return };
    let play = |scenario: &str, rig: &[&str], exit: i32| {
        folder.write_scenario("s.toml", scenario);
        let out = tempfile::tempdir_in(folder.path()).unwrap();
        folder.bench(["run", "--out", out.path().to_str().unwrap(), "--rig"].iter().chain(rig)).assert_exit(exit);
        let record = RunRecord::read(out.path()).unwrap();
        if let Some(scenario) = record.scenarios.first() {
            let judged_again = rejudge(out.path(), None).unwrap().scenarios.remove(0);
            assert_eq!((judged_again.verdict, &judged_again.expectations), (scenario.verdict, &scenario.expectations));
        }
        record
    };
    let value = |record: &RunRecord| record.scenarios[0].expectations[0].value.unwrap();
    let rig: &[&str] = &[&rig];
    // Each answer contains the text of its step. The read of the answer is the end of the interval.
    let passed = play(&text_scenario("step", "from_ms = 40.0\nat_most = 0.9", false), rig, 0);
    assert!((0.4..0.6).contains(&value(&passed)), "{passed:?}");
    play(&text_scenario("step", "from_ms = 40.0\nat_least = 0.6", false), rig, 1);
    assert_eq!(value(&play(&text_scenario("started", "from_ms = 0.0\nat_most = 0.1", false), rig, 0)), 0.0);
    let missing = play(&text_scenario("started", "from_ms = 40.0\nat_most = 9.0", false), rig, 1);
    let reason = missing.scenarios[0].expectations[0].reason.as_ref().unwrap().to_string();
    assert!(reason.contains("the firmware did not write the text"), "{reason}");
    let restarted = play(&text_scenario("started", "from_ms = 40.4\nat_most = 5.0", true), rig, 0);
    assert!((0.0..5.0).contains(&value(&restarted)), "{restarted:?}");
    for (rig, message) in [
        (&["hosted"][..], "text_ms needs the emulated chip"),
        (&["emulated"][..], "text_ms needs firmware that writes text by RTT"),
        (&["emulated", "--clock", "real-time"][..], "text_ms needs the emulated chip"),
    ] {
        let elsewhere = play(&text_scenario("step", "from_ms = 40.0\nat_most = 1.0", false), rig, 4);
        assert!(elsewhere.not_applicable[0].reason.contains(message), "{rig:?}");
    }
}

#[test]
fn frames_of_defmt_are_in_a_file_that_defmt_print_reads() {
    let folder = TestFolder::new();
    let Some(rig) = build_talking_starter(&folder) else { return };
    folder.replace(
        "starter/main.c",
        "static char ring[16];",
        "static char ring[16];\n\
         __attribute__((section(\".defmt\"), used)) static const char defmt[] = \"_defmt_version_ = 4\";",
    );
    folder.replace(
        "starter/stm32f4.ld",
        "    /DISCARD/ :",
        "    .defmt 0 (INFO) : { KEEP(*(.defmt)) }\n    /DISCARD/ :",
    );
    make_starter(&folder);
    folder.write_scenario("s.toml", &step_text(crate::test_folder::SETTLING));
    let command = format!("defmt-print -e {} < out/traces/s/000.defmt", &rig["emulated:".len()..]);
    let output = folder.bench(["run", "--out", "out", "--rig", &rig]).assert_exit(0).text();
    // The console breaks a long line between words.
    let text = output.split_whitespace().collect::<Vec<_>>().join(" ");
    assert!(text.contains(&command), "{command} is not in {output}");
    let record = RunRecord::read(&folder.join("out")).unwrap();
    let trial = &record.scenarios[0].trials[0];
    let frames = fs::read_to_string(folder.join("out").join(trial.trace.replace(".csv", ".defmt"))).unwrap();
    assert!(frames.starts_with("started\nstep\n"), "{frames}");
    assert_eq!((trial.telemetry.defmt_bytes, &trial.telemetry.firmware_output), (Some(frames.len()), &None));
}
