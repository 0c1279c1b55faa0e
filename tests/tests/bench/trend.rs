//! Compares the instructions of a control step with earlier runs and with the shipped image.

use crate::test_folder::{SETTLING, TestFolder, workspace_root};
use platebench_engine::{Clock, RunHooks, RunPlan, rejudge, run};
use platebench_model::record::{Overrides, RECORD_FILE, RunFolder, RunRecord};
use platebench_model::scenario::find;
use platebench_rig::RigSpec;
use platebench_wire::LawId;
use std::fmt::Write as _;
use std::fs;

/// Longer scenarios are skipped: their control steps cost no more than those of short ones.
const LONGEST_S: f64 = 1.0;

#[test]
fn a_longer_control_step_is_reported() {
    const MORE: &str = "30 % more than";
    let folder = TestFolder::with_step(SETTLING);
    let run = |out: &str| folder.bench(["run", "--rig", "emulated", "--out", out]).assert_exit(0);
    let first = run("runs/first").stdout;
    assert!(first.contains("instructions per step: 3 ") && !first.contains('↳'), "{first}");
    let mut faster = folder.record("runs/first");
    faster.rig.firmware.as_mut().unwrap().build = "1a2b3c4d5e6f7081".to_owned();
    let telemetry = &mut faster.scenarios[0].trials[0].telemetry;
    telemetry.instructions_worst = telemetry.instructions_worst.map(|worst| worst / 1.3);
    faster.write(&folder.join("runs/first")).unwrap();
    run("runs/second").assert_stdout(&[MORE, "of build 1a2b3c4d (run first)"]);
    assert!(folder.read("runs/second/report.html").contains(MORE));
    // The record stores the result of the comparison, so the earlier run is no longer needed.
    fs::remove_file(folder.join("runs/first").join(RECORD_FILE)).unwrap();
    folder.bench(["report", "runs/second", "--rejudge"]).assert_stdout(&[MORE]);
    assert_eq!(rejudge(&folder.join("runs/second"), None).unwrap().cost, folder.record("runs/second").cost);
}

fn append_reference_lines(record: &RunRecord, text: &mut String) {
    for scenario in &record.scenarios {
        let trial = &scenario.trials[0];
        let (mean, worst) = (trial.telemetry.instructions_mean.unwrap(), trial.telemetry.instructions_worst.unwrap());
        writeln!(
            text,
            "\n[[trial]] # {}\nlaw = {:?}\ninputs = {:?}\nseed = {}\nmean = {mean:?}\nworst = {worst:?}",
            scenario.file,
            scenario.law,
            scenario.inputs_digest(),
            trial.seed
        )
        .unwrap();
    }
}

/// With `PLATEBENCH_COST=update` the test writes `firmware-under-test/images/cost.toml`.
#[test]
fn the_cost_reference_matches_the_image() {
    let mut scenarios =
        find(&[workspace_root().join("scenarios/paper")]).unwrap_or_else(|faults| panic!("{}", faults[0])).scenarios;
    scenarios.retain(|scenario| scenario.duration.seconds() <= LONGEST_S);
    let mut text = "# Instructions per control step of platebench-stm32f4.elf: the first trial of the paper's \
                    scenarios under every law.\n\
                    # Written by `ci/cost --update` after the image has changed; a test holds it to the image.\n"
        .to_owned();
    for law in LawId::ALL {
        let overrides = Overrides { law: Some(law.name().to_owned()), trials: Some(1), ..Overrides::default() };
        let mut scenarios = scenarios.clone();
        for scenario in &mut scenarios {
            rejudge::apply_overrides(&overrides, scenario);
        }
        let (rig, clock) = (RigSpec::emulated(None), Clock::Lockstep { wire_time: false });
        let plan = RunPlan::new(&rig, clock, 2, scenarios, overrides);
        let out = tempfile::tempdir().unwrap();
        let folder = RunFolder::create(Some(&out.path().join("run"))).unwrap();
        let record = run(&plan, &folder, &|| rig.connect(), RunHooks::default()).unwrap();
        if law == LawId::ALL[0] {
            let firmware = record.rig.firmware.as_ref().unwrap();
            let baud = record.scenarios[0].trials[0].telemetry.baud.unwrap();
            writeln!(text, "firmware = {:?}\nbuild = {:?}\nbaud = {baud}", firmware.name, firmware.build).unwrap();
        }
        append_reference_lines(&record, &mut text);
    }
    let path = workspace_root().join("firmware-under-test/images/cost.toml");
    if std::env::var("PLATEBENCH_COST").is_ok_and(|mode| mode == "update") {
        fs::write(&path, &text).unwrap();
    }
    let committed = fs::read_to_string(&path).unwrap();
    let differs = committed.lines().zip(text.lines()).find(|(old, new)| old != new);
    assert!(committed == text, "the instruction counts differ from the reference: ci/cost --update; {differs:?}");
}
