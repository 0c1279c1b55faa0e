use super::{create_folder, load_with_change, render};
use crate::scenario::Scenario;
use crate::scenario::load::{load, load_copies};
use insta::assert_snapshot;
use platebench_plate::Time;
use rstest::rstest;
use std::fmt::Write;

const END: &str = "[trials]\ncount = 30";
const SCENE: &str = "[[between]]\nduration_ms = 20.0\nprofile = { setpoint_um = 1.0 }\n";

fn with_scene(keys: &str) -> String {
    format!("{SCENE}{keys}\n{END}")
}

#[test]
fn a_scene_between_trials_has_its_own_controller_and_plate() {
    let keys = "controller = { law = \"deadbeat\", period_ms = 0.5, design_plate = \"plates/plate.toml\" }";
    let folder = create_folder(&[(END, &with_scene(&format!("plate = \"heavy.toml\"\n{keys}")))]);
    let plate = super::PLATE.replace("limit_vpp = 900.0", "limit_vpp = 400.0");
    std::fs::write(folder.path().join("heavy.toml"), plate).unwrap();
    let scenario = load(&folder.path().join("s.toml"), "s.toml").unwrap();
    let [scene] = &scenario.between[..] else { panic!("{:?}", scenario.between) };
    assert_eq!((scene.controller.law.as_str(), scene.controller.period), ("deadbeat", Time::from_nanos(500_000)));
    assert_eq!((scene.plate.drive_limit_vpp, scene.design_plate().drive_limit_vpp), (400.0, 900.0));
    assert_eq!((scene.duration, scenario.duration), (Time::from_nanos(20_000_000), Time::from_nanos(60_000_000)));
    assert!(scene.expectations.is_empty() && scene.faults.is_empty());
    assert_eq!((scenario.keeps_controller(), scenario.design_plate() == &scenario.plate), (true, true));
    let copies: Vec<_> = scenario.inputs.iter().map(|input| input.path.clone()).collect();
    assert_eq!(copies.len(), 5);
    let again = load_copies(&copies, "s.toml").unwrap();
    assert_eq!((&again.between[0].plate, &again.between[0].controller), (&scene.plate, &scene.controller));
}

#[test]
fn messages_point_into_the_scene() {
    let mut table = String::new();
    for (good, bad) in [
        (END, with_scene("duration = 1")),
        (END, with_scene("plate = \"missing.toml\"")),
        (END, with_scene("controller = { period_ms = 30.0 }")),
        (END, with_scene("controller = { design_plate = \"force.csv\" }")),
        (END, with_scene("").replace("setpoint_um = 1.0", "setpoint_um = { hold = [[0.0, 1.0], [5.0, -1.0]] }")),
        (END, SCENE.repeat(17) + END),
        ("response_time_ms = 1.9", "design_plate = \"nowhere.toml\"".to_owned()),
    ] {
        let fault = load_with_change(good, &bad).err().unwrap_or_else(|| panic!("`{bad}` was accepted"));
        write!(table, "{}\n\n", render(&fault)).unwrap();
    }
    assert_snapshot!(table);
}

#[test]
fn a_difference_between_trials_needs_two() {
    let expect = "metric = \"settling_time_ms\"\nat_most = 2.0\nband_percent = 5.0\nfrom_ms = 1.0\n";
    let difference = "metric = \"trial_difference_um\"\nat_most = 0.001\nfrom_ms = 1.0\n";
    let with_trials = |count: &str| super::load_with_changes(&[(expect, difference), ("count = 30", count)]);
    assert!(with_trials("count = 2").unwrap().keeps_controller());
    let fault = with_trials("count = 1").err().unwrap();
    assert_eq!(fault.message, "`count`: 1 trial, expected at least 2 for trial_difference_um");
    assert!(super::load_with_changes(&[(expect, &format!("{difference}over = \"mean\"\n"))]).is_err());
}

const OTHERS: &str = "[other_trials]\nplate = \"heavy.toml\"\namplitude_factor = 0.5\nlater_ms = 0.25\n\
    controller = { law = \"deadbeat\", loop_delay_ms = 0.25 }\nprofile = { setpoint_um = 1.0 }\n";
const SETTLING: &str = "metric = \"settling_time_ms\"\nat_most = 2.0\nband_percent = 5.0\nfrom_ms = 1.0\n";
const DIFFERENCE: &str = "metric = \"trial_difference_um\"\nat_most = 0.001\nfrom_ms = 1.0\n";

#[test]
fn other_trials_have_their_own_scene_and_comparison() {
    let folder = create_folder(&[(END, &format!("{OTHERS}{END}")), (SETTLING, DIFFERENCE)]);
    std::fs::write(folder.path().join("heavy.toml"), super::PLATE.replace("limit_vpp = 900.0", "limit_vpp = 450.0"))
        .unwrap();
    let mut scenario = load(&folder.path().join("s.toml"), "s.toml").unwrap();
    let of_trial = |scenario: &Scenario, index| {
        let scene = scenario.of_trial(index);
        let comparison = scene.expectations[0].comparison;
        (scene.controller.law.clone(), scene.plate.drive_limit_vpp, comparison.amplitude_factor, comparison.later)
    };
    let first = of_trial(&scenario, 0);
    assert_eq!((first.1, first.2, first.3), (900.0, 1.0, Time::ZERO));
    let second = ("deadbeat".to_owned(), 450.0, 0.5, Time::from_nanos(250_000));
    assert_eq!([of_trial(&scenario, 1), of_trial(&scenario, 29)], [second.clone(), second]);
    let others = scenario.of_trial(1);
    assert_eq!((others.setpoint.at(Time::ZERO), others.expectations.len()), (1.0, scenario.expectations.len()));
    assert_eq!(scenario.inputs.iter().filter(|input| input.path.ends_with("heavy.toml")).count(), 1);
    scenario.set_law("pll");
    assert_eq!([of_trial(&scenario, 0).0, of_trial(&scenario, 1).0], ["pll", "deadbeat"]);
}

#[rstest]
#[case::nothing_compares(
    "",
    "no expectation of trial_difference_um, expected at least one: nothing compares these trials with the first"
)]
#[case::later_than_the_trial(
    "later_ms = 1.5\n",
    "1.5 ms, expected at most 1 ms, the time from the last control instant to the end of the trial"
)]
#[case::factor("amplitude_factor = 0.0\n", "`amplitude_factor`: 0, expected a finite number above 0")]
fn rejects_other_trials_that_cannot_be_compared(#[case] keys: &str, #[case] message: &str) {
    let others = format!("[other_trials]\n{keys}profile = {{ setpoint_um = 1.0 }}\n{END}");
    let expect = if keys.is_empty() { SETTLING } else { DIFFERENCE };
    let fault = super::load_with_changes(&[(END, &others), (SETTLING, expect)]).err().unwrap();
    assert!(fault.message.contains(message), "{}", fault.message);
}
