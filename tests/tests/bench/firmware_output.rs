//! Tests the text that a firmware writes by RTT (a buffer in memory), with a changed C starter.

use crate::starter_c::has_cross_compiler;
use crate::test_folder::{TestFolder, run_bench, workspace_root};
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

#[test]
fn text_by_rtt_is_in_the_record_of_its_trial() {
    if !has_cross_compiler() {
        return skip_without("make, arm-none-eabi-gcc or newlib");
    }
    let folder = TestFolder::new();
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
    let made = Command::new("make").arg("-C").arg(folder.join("starter")).output().unwrap();
    assert!(made.status.success(), "{}", String::from_utf8_lossy(&made.stderr));
    let rig = format!("emulated:{}", folder.join("starter/build/starter.elf").display());
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
