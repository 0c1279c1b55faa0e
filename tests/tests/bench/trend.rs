//! What a control step costs beside earlier runs, and the reference for the image that comes with the bench.

use crate::test_folder::{TestFolder, exit_code, run_bench, step_scenario, workspace_root};
use platebench_record::RunFolder;
use platebench_record::RunRecord;
use platebench_record::{Overrides, RECORD_FILE};
use platebench_rig::RigSpec;
use platebench_runner::{RunHooks, RunPlan, inputs_digest, rejudge, run};
use platebench_scenario::find;
use platebench_wire::LawId;
use std::fmt::Write as _;
use std::fs;

const SETTLING: &str = "metric = \"settling_time_ms\"\nat_most = 2.0";
/// Long scenarios cost no more per step than short ones.
const LONGEST_S: f64 = 1.0;

#[test]
fn a_longer_control_step_is_reported() {
    let workshop = TestFolder::new();
    workshop.write_scenario("s.toml", &step_scenario("aluminium-198x138", "", "", SETTLING));
    let play = |out: &str| {
        let output = run_bench(workshop.path(), ["run", "--rig", "emulated", "--out", out]);
        assert_eq!(exit_code(&output), 0, "{}", String::from_utf8_lossy(&output.stderr));
        String::from_utf8(output.stdout).unwrap()
    };
    let first = play("runs/first");
    assert!(first.contains("instructions per step: 4 ") && !first.contains('↳'), "{first}");
    // What the first run would have left behind, had its firmware been quicker.
    let folder = workshop.path().join("runs/first");
    let mut quicker = RunRecord::read(&folder).unwrap();
    quicker.rig.firmware.as_mut().unwrap().build = "1a2b3c4d5e6f7081".to_owned();
    let telemetry = &mut quicker.scenarios[0].trials[0].telemetry;
    telemetry.instructions_worst = telemetry.instructions_worst.map(|worst| worst / 1.3);
    quicker.write(&folder).unwrap();
    let said = "30 % more than";
    let second = play("runs/second");
    assert!(second.contains(said) && second.contains("of build 1a2b3c4d (run first)"), "{second}");
    let page = fs::read_to_string(workshop.path().join("runs/second/report.html")).unwrap();
    assert!(page.contains(said), "the page tells it too");
    // The record keeps what was compared: the earlier run is not needed any more.
    fs::remove_file(folder.join(RECORD_FILE)).unwrap();
    let judged = run_bench(workshop.path(), ["judge", "runs/second"]);
    assert!(String::from_utf8_lossy(&judged.stdout).contains(said), "{}", String::from_utf8_lossy(&judged.stdout));
    let stored = workshop.path().join("runs/second");
    assert_eq!(rejudge(&stored, None).unwrap().cost, RunRecord::read(&stored).unwrap().cost);
}

/// One line of the reference for each trial.
fn append_reference_lines(record: &RunRecord, text: &mut String) {
    for scenario in &record.scenarios {
        let trial = &scenario.trials[0];
        let (mean, worst) = (trial.telemetry.instructions_mean.unwrap(), trial.telemetry.instructions_worst.unwrap());
        writeln!(
            text,
            "\n[[trial]] # {}\nlaw = {:?}\ninputs = {:?}\nseed = {}\nmean = {mean:?}\nworst = {worst:?}",
            scenario.file,
            scenario.law,
            inputs_digest(scenario),
            trial.seed
        )
        .unwrap();
    }
}

/// Holds `firmware-under-test/images/cost.toml` to the image, or writes it where `PLATEBENCH_COST=update` asks for that.
#[test]
fn the_cost_reference_matches_the_image() {
    let mut scenarios =
        find(&[workspace_root().join("scenarios/paper")]).unwrap_or_else(|faults| panic!("{}", faults[0])).scenarios;
    scenarios.retain(|scenario| scenario.duration.seconds() <= LONGEST_S);
    let mut text = "# Instructions per control step of platebench-stm32f4.elf: the first trial of the paper's scenarios under every law.\n\
                    # Written by `ci/cost --update` after the image has changed; a test holds it to the image.\n"
        .to_owned();
    for law in LawId::ALL {
        let overrides = Overrides { law: Some(law.name().to_owned()), trials: Some(1), ..Overrides::default() };
        let mut scenarios = scenarios.clone();
        for scenario in &mut scenarios {
            rejudge::apply_overrides(&overrides, scenario);
        }
        let clock = platebench_runner::Clock::Lockstep { wire_time: false };
        let plan = RunPlan { scenarios, jobs: 2, clock, own_clock: false, rig: "emulated".to_owned(), overrides };
        let out = tempfile::tempdir().unwrap();
        let folder = RunFolder::create(Some(&out.path().join("run"))).unwrap();
        let connect = || RigSpec::Emulated(None).connect();
        let record = run(&plan, &folder, &connect, RunHooks::default()).unwrap();
        if law == LawId::ALL[0] {
            let firmware = record.rig.firmware.as_ref().unwrap();
            writeln!(text, "firmware = {:?}\nbuild = {:?}", firmware.name, firmware.build).unwrap();
        }
        append_reference_lines(&record, &mut text);
    }
    let path = workspace_root().join("firmware-under-test/images/cost.toml");
    if std::env::var("PLATEBENCH_COST").is_ok_and(|wish| wish == "update") {
        fs::write(&path, &text).unwrap();
    }
    let committed = fs::read_to_string(&path).unwrap();
    let differs = committed.lines().zip(text.lines()).find(|(old, new)| old != new);
    assert!(
        committed == text,
        "the image takes other instructions than the reference says: ci/cost --update; {differs:?}"
    );
}
