//! Compares the hosted rig with the emulated one, and tests features of the emulated rig.

use crate::test_folder::{
    SETTLING, TestFolder, assert_same_traces, run_bench, step_scenario, step_text, workspace_root,
};
use platebench_engine::rejudge;
use platebench_model::record::{Cause, RunRecord, Verdict};
use platebench_rig::Symbols;
use rstest::rstest;
use std::fs;

#[rstest]
#[case::own_laws(&[])]
#[case::dq_pi(&["--law", "dq-pi"])]
#[case::dq_pi_euler(&["--law", "dq-pi-euler"])]
#[case::open_loop(&["--law", "open-loop"])]
fn hosted_and_emulated_traces_are_identical(#[case] law: &[&str]) {
    let folder = tempfile::tempdir().unwrap();
    let scenarios =
        ["paper", "limits"].map(|part| workspace_root().join("scenarios").join(part).to_str().unwrap().to_owned());
    for rig in ["hosted", "emulated"] {
        let arguments = ["run", &scenarios[0], &scenarios[1], "--rig", rig, "--out", rig, "--trials", "2"];
        run_bench(folder.path(), arguments.iter().chain(law));
    }
    assert_same_traces(folder.path(), ["hosted", "emulated"]);
}

#[track_caller]
fn run_and_read(folder: &TestFolder, arguments: &[&str], expected: i32) -> RunRecord {
    let out = tempfile::tempdir_in(folder.path()).unwrap();
    folder.bench(["run", "--out", out.path().to_str().unwrap()].iter().chain(arguments)).assert_exit(expected);
    RunRecord::read(out.path()).unwrap()
}

#[test]
fn wire_and_computing_time_are_optional() {
    // The longest control step of this law depends only slightly on the samples.
    let folder = TestFolder::with_scenario(&step_scenario("aluminium-198x138", "law = \"dq-pi-fixed\"", "", SETTLING));
    let transparent = run_and_read(&folder, &["--rig", "emulated"], 0);
    let wired = run_and_read(&folder, &["--rig", "emulated", "--wire-time"], 1);
    assert_eq!([&transparent, &wired].map(|record| record.overrides.wire_time), [false, true]);
    let telemetry = |record: &RunRecord| record.scenarios[0].trials[0].telemetry.clone();
    assert_eq!(telemetry(&transparent).loop_delay_us, Some(0.0));
    // 24 bytes each way at 1 Mbaud take 480 µs, plus idle time of the line and the control step.
    let delay = telemetry(&wired).loop_delay_us.unwrap();
    assert!((480.0..560.0).contains(&delay), "{delay} µs");
    // Other samples take other branches of the law: up to 36 instructions, 0.21 µs at 168 MHz.
    let without = telemetry(&transparent).rig_delay_us.unwrap();
    assert!((without - telemetry(&wired).rig_delay_us.unwrap()).abs() < 0.25, "{without} µs");
    assert!(wired.scenarios[0].expectations[0].value.unwrap() > 4.0);
}

#[test]
fn instruction_limits_need_a_counting_rig() {
    let folder = TestFolder::new();
    let limit = |at_most: u32| {
        let expect = format!("metric = \"instructions_per_step\"\nat_most = {at_most}.0");
        folder.write_scenario("s.toml", &step_text(&expect));
    };
    limit(168_000);
    let counted = run_and_read(&folder, &["--rig", "emulated"], 0).scenarios[0].expectations[0].value.unwrap();
    assert!((500.0..20_000.0).contains(&counted), "{counted}");
    limit(counted as u32 - 1);
    run_and_read(&folder, &["--rig", "emulated"], 1);
    let hosted = run_and_read(&folder, &["--rig", "hosted"], 3);
    assert_eq!(hosted.scenarios[0].expectations[0].cause, Some(Cause::Evidence));
}

#[test]
fn the_share_of_a_step_belongs_to_its_control_period() {
    let folder = TestFolder::new();
    let laws = [("slow", "law = \"dq-pi\""), ("fast", "law = \"dq-pi\"\nperiod_ms = 0.25")];
    for (name, controller) in laws {
        folder.write_scenario(
            &format!("{name}.toml"),
            &step_scenario("aluminium-198x138", controller, "", "metric = \"drive_peak_vpp\"\nat_most = 2000.0"),
        );
    }
    let record = run_and_read(&folder, &["--rig", "emulated"], 0);
    let tightest = record.cost[0].tightest.unwrap();
    let fast = record.scenarios.iter().find(|scenario| scenario.file == "fast.toml").unwrap();
    assert_eq!(tightest.period_ms, 0.25);
    assert_eq!(Some(tightest.instructions), fast.trials[0].telemetry.instructions_worst);
    assert!((tightest.share() - tightest.instructions / 42_000.0).abs() < 1e-12, "{}", tightest.share());
}

/// The shipped image with `rounds` of a loop of two instructions in each answer. The loop replaces
/// code of the panic handler, which never runs here.
fn slow_image(rounds: u16) -> Vec<u8> {
    let mut elf = fs::read(workspace_root().join("firmware-under-test/images/platebench-stm32f4.elf")).unwrap();
    let symbols = Symbols::read(&elf);
    let find = |name: &str| {
        let function = symbols.functions().iter().find(|function| function.name.ends_with(name)).unwrap();
        function.address as u32
    };
    let (encode, handler) = (find("::Packet::encode"), find("rust_begin_unwind"));
    // The first instruction of the handler has a breakpoint of the bench.
    let detour = handler + 4;
    let word = |elf: &[u8], at: usize| u32::from_le_bytes(*elf[at..].first_chunk().unwrap()) as usize;
    let headers = word(&elf, 28);
    let segments = (headers..).step_by(32).map(|at| [4, 8, 16].map(|field| word(&elf, at + field)));
    let offset = |address: u32| {
        let holds = |[_, start, bytes]: &[usize; 3]| (*start..start + bytes).contains(&(address as usize));
        let [at, start, _] = segments.clone().find(holds).unwrap();
        at + address as usize - start
    };
    let (at_encode, at_detour) = (offset(encode), offset(detour));
    let start: [u8; 4] = *elf[at_encode..].first_chunk().unwrap();
    let movw = [0xf240 | rounds >> 1 & 0x400 | rounds >> 12, rounds << 4 & 0x7000 | rounds & 0xff];
    let code = [0xb401, movw[0], movw[1], 0x3801, 0xd1fd, 0xbc01]; // push r0; movw r0; subs; bne; pop r0
    let code = code.into_iter().flat_map(u16::to_le_bytes).chain(start);
    let code: Vec<u8> = code.chain(branch(detour + 16, encode + 4)).collect();
    elf[at_detour..at_detour + code.len()].copy_from_slice(&code);
    elf[at_encode..at_encode + 4].copy_from_slice(&branch(encode, detour).collect::<Vec<_>>());
    elf
}

/// B.W (A7.7.12, T4).
fn branch(at: u32, target: u32) -> impl Iterator<Item = u8> {
    let offset = target.wrapping_sub(at + 4);
    let sign = offset >> 24 & 1;
    let bit = |index: u32| (offset >> index & 1 ^ 1) ^ sign;
    let high = 0xf000 | sign << 10 | offset >> 12 & 0x3ff;
    let low = 0x9000 | bit(23) << 13 | bit(22) << 11 | offset >> 1 & 0x7ff;
    [high as u16, low as u16].into_iter().flat_map(u16::to_le_bytes)
}

/// 42 000 instructions fit into the period. A step of the shipped image has some 2 300 of them.
fn step_time_scenario(expect: &str) -> String {
    let expect = format!("metric = \"drive_peak_vpp\"\nat_most = 2000.0\n{expect}");
    step_scenario("aluminium-198x138", "law = \"open-loop\"\nperiod_ms = 0.25", "", &expect)
}

fn step_time_limit(percent: f64) -> String {
    format!("[[expect]]\nmetric = \"step_time_percent\"\nat_most = {percent:?}")
}

fn step_time(record: &RunRecord) -> f64 {
    record.scenarios[0].trials[0].telemetry.step_time.unwrap().longest_percent
}

#[test]
fn a_step_longer_than_its_period_fails_any_scenario() {
    let folder = TestFolder::with_scenario(&step_time_scenario(""));
    fs::write(folder.join("slow.elf"), slow_image(22_000)).unwrap();
    let message = "of the control period on the emulated chip, limit 100 %";
    folder.bench(["run", "--rig", "emulated:slow.elf", "--out", "slow"]).assert_exit(1);
    let record = folder.record("slow");
    assert!((105.0..115.0).contains(&step_time(&record)), "{}", step_time(&record));
    let reason = record.scenarios[0].expectations[0].reason.as_ref().unwrap().to_string();
    assert!(reason.contains(&format!("takes {:.1} % {message}", step_time(&record))), "{reason}");
    for file in ["report.html", "junit.xml"] {
        assert!(folder.read(&format!("slow/{file}")).contains(message), "{file}");
    }
    folder.bench(["report", "slow", "--rejudge"]).assert_exit(1);
    assert_eq!(
        rejudge(&folder.join("slow"), None).unwrap().scenarios[0].expectations,
        record.scenarios[0].expectations
    );

    // A judgement with another limit needs no other run.
    folder.write_scenario("other.toml", &step_time_scenario(&step_time_limit(150.0)));
    folder.bench(["report", "slow", "--rejudge", "--scenario", "scenarios/other.toml"]).assert_exit(0);
}

#[test]
fn a_step_close_to_its_period_is_a_warning() {
    let folder = TestFolder::with_scenario(&step_time_scenario(""));
    fs::write(folder.join("tight.elf"), slow_image(17_000)).unwrap();
    for (rig, warns) in [("emulated:tight.elf", true), ("emulated", false)] {
        let out = format!("warns-{warns}");
        let text = folder.bench(["run", "--rig", rig, "--out", &out]).assert_exit(0).stdout;
        assert_eq!(text.contains("warning: s.toml: the longest control step takes 8"), warns, "{text}");
        assert_eq!(folder.read(&format!("{out}/report.html")).contains("Warning: "), warns, "{rig}");
    }
}

#[test]
fn a_scenario_can_limit_the_time_of_a_step() {
    let folder = TestFolder::with_scenario(&step_time_scenario(&step_time_limit(150.0)));
    fs::write(folder.join("slow.elf"), slow_image(22_000)).unwrap();
    let allowed = run_and_read(&folder, &["--rig", "emulated:slow.elf"], 0);
    assert_eq!(allowed.scenarios[0].expectations[1].value, Some(step_time(&allowed)));
    folder.write_scenario("s.toml", &step_time_scenario(&step_time_limit(1.0)));
    let missed = run_and_read(&folder, &["--rig", "emulated"], 1);
    let verdicts: Vec<_> = missed.scenarios[0].expectations.iter().map(|expectation| expectation.verdict).collect();
    assert_eq!(verdicts, [Verdict::Pass, Verdict::Fail]);
    for arguments in [&["--rig", "hosted"][..], &["--rig", "emulated", "--clock", "real-time"]] {
        let elsewhere = run_and_read(&folder, arguments, 4);
        assert!(elsewhere.scenarios.is_empty(), "{arguments:?}");
        assert!(elsewhere.not_applicable[0].reason.contains("step_time_percent needs the emulated chip"));
    }
    run_and_read(&folder, &["--rig", "hosted", "--require-all"], 1);
}

/// Five periods after the last sample, at 39 ms, the controller disables the amplifier.
fn enable_pin_scenario(limit: &str) -> String {
    let fault = "[[fault]]\nkind = \"drop\"\ndirection = \"to-controller\"\nfrom_ms = 40.0\nuntil_ms = 60.0\n";
    step_text(&format!("metric = \"enable_off_ms\"\nfrom_ms = 40.0\n{limit}\n{fault}"))
}

#[test]
fn the_enable_pin_of_the_chip_is_judged() {
    let folder = TestFolder::with_scenario(&enable_pin_scenario("within = [3.9, 5.6]"));
    let passed = run_and_read(&folder, &["--rig", "emulated"], 0);
    let pin = passed.scenarios[0].trials[0].telemetry.enable_pin.unwrap();
    assert!(pin.was_high && pin.low_from_s.is_some_and(|at| (0.0439..0.0456).contains(&at)), "{pin:?}");
    folder.write_scenario("s.toml", &enable_pin_scenario("at_most = 3.0"));
    let record = run_and_read(&folder, &["--rig", "emulated"], 1);
    assert_eq!(record.verdict, Verdict::Fail);
    for arguments in [&["--rig", "hosted"][..], &["--rig", "emulated", "--clock", "real-time"]] {
        let elsewhere = run_and_read(&folder, arguments, 4);
        assert!(elsewhere.not_applicable[0].reason.contains("enable_off_ms needs the emulated chip"), "{arguments:?}");
    }
}

#[test]
fn an_amplifier_that_stays_enabled_fails() {
    let text = step_text("metric = \"enable_off_ms\"\nfrom_ms = 40.0\nat_most = 19.0");
    let folder = TestFolder::with_scenario(&text);
    let record = run_and_read(&folder, &["--rig", "emulated"], 1);
    let trial = &record.scenarios[0].trials[0];
    assert_eq!(trial.telemetry.enable_pin.unwrap().low_from_s, None);
}

/// A setpoint of 900 + n µm triggers fault n of `stm32f4/src/planted_faults.rs`: here a trap and a
/// watchdog reset. Tests of `rig` cover all faults.
#[rstest]
#[case::division_by_zero(2, "planted_faults::division_by_zero")]
#[case::endless_loop(3, "planted_faults::endless_loop")]
fn a_trap_is_reported_with_function_and_address(#[case] number: u32, #[case] function: &str) {
    // A plate at 0 V meets this expectation, so the verdict must fail because of the trap.
    let text = step_text("metric = \"overshoot_percent\"\nat_most = 1000.0");
    let setpoint = format!("{{ hold = [[0.0, 2.0], [10.0, {}.0], [11.0, 2.0]] }}", 900 + number);
    let text = text.replace("setpoint_um = 2.0", &format!("setpoint_um = {setpoint}"));
    let folder = TestFolder::with_scenario(&text);
    let rig = format!("emulated:{}", workspace_root().join("firmware-under-test/images/planted-faults.elf").display());
    let record = run_and_read(&folder, &["--rig", &rig], 1);
    assert_eq!(record.verdict, Verdict::Fail);
    let reason = record.scenarios[0].expectations[0].reason.as_ref().unwrap().to_string();
    assert!(reason.contains(function) && reason.contains("0x"), "{reason}");
    assert_eq!(record.scenarios[0].trials[0].cause, None, "a failure of the firmware");
}

#[test]
fn a_run_that_crashed_is_no_reference() {
    let text = step_text(SETTLING).replace("setpoint_um = 2.0", "setpoint_um = { hold = [[0.0, 2.0], [10.0, 902.0]] }");
    let folder = TestFolder::with_scenario(&text);
    let image = workspace_root().join("firmware-under-test/images/planted-faults.elf");
    let crash = |out: &str| {
        let rig = format!("emulated:{}", image.display());
        folder.bench(["run", "--rig", &rig, "--out", out]).assert_exit(1);
    };
    crash("runs/first");
    crash("runs/second");
    let compared = folder.bench(["compare", "runs/second", "runs/first"]).assert_exit(4);
    compared.assert_output(&["nothing was compared: the reference has no complete trial 0"]);
}
