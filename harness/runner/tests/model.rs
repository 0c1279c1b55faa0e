//! The tier that the bench chooses against the exact one: over every scenario there is and over 200 random ones, played by the laws themselves.
//!
//! `cargo test -p platebench-runner --test model -- --nocapture` prints what was chosen and how often a cheaper tier would have served.

#![allow(clippy::unwrap_used, clippy::panic, reason = "helpers of tests")]

use platebench_plate::Tier;
use platebench_rig::RigSpec;
use platebench_runner::fidelity::{self, TierError};
use platebench_runner::trial::Patience;
use platebench_runner::{Cancel, Clock, Plan, RejudgeError, RunFolder, rejudge};
use platebench_scenario::{Scenario, load};
use platebench_trace::{Flags, Row};
use platebench_verdict::RunRecord;
use platebench_verdict::record::Overrides;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng, SeedableRng};
use std::collections::BTreeMap;
use std::fmt::Write;
use std::path::{Path, PathBuf};

struct Patient;

impl Patience for Patient {
    fn is_over(&self) -> bool {
        false
    }
}

fn scenarios() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../scenarios")
}

fn rows(scenario: &Scenario, tier: Tier) -> Vec<Row> {
    fidelity::rows(scenario, tier, &Patient).unwrap()
}

/// The largest |ΔW| over all rows that both traces have, relative to the smallest setpoint above 0.
fn apart(left: &[Row], right: &[Row]) -> f64 {
    let (error, compared) = fidelity::apart(left, right, &|_| true);
    assert!(compared > 10);
    error
}

/// What was found of one scenario.
struct Found {
    chosen: Tier,
    /// Of every tier, cheapest first.
    errors: Vec<TierError>,
}

/// Tier and error where it is looked at.
fn told(error: &TierError) -> String {
    format!("{} {:.1e}", error.tier.name(), error.watched)
}

/// Plays a trial of `scenario` on every tier.
fn examine(scenario: &Scenario) -> Found {
    let errors = fidelity::tier_errors(scenario, &Patient).unwrap();
    assert!(errors.iter().all(|error| error.compared > 10), "{errors:?}");
    Found { chosen: scenario.tier, errors }
}

/// How often which tier was chosen, and how often a cheaper one would have served.
#[derive(Default)]
struct Tally {
    chosen: BTreeMap<Tier, u32>,
    cheaper_served: BTreeMap<Tier, u32>,
    /// Scenarios for whose loop no bound on the envelope is claimed.
    unclaimed: u32,
    /// The largest share of a bound that was used.
    closest: f64,
}

impl Tally {
    /// A pick must never be wrong: what was measured stays within the budget. Nor must a bound, whether anything was picked on it or not.
    fn note(&mut self, name: &str, scenario: &Scenario, found: &Found) {
        let budget = scenario.model.budget;
        let exact = if scenario.plate.lockin.is_some() { Tier::Carrier } else { Tier::Modal };
        for error in found.errors.iter().filter(|error| error.tier < exact) {
            let (bound, tier) = (scenario.bound(error.tier, true), error.tier.name());
            assert!(
                error.anywhere <= bound,
                "{name}: {tier} is off by {:e} somewhere, bound {bound:e}",
                error.anywhere
            );
            self.closest = self.closest.max(error.anywhere / bound);
        }
        let picked = found.errors.iter().find(|error| error.tier == found.chosen).unwrap();
        if found.chosen < exact {
            assert!(scenario.model.bound <= budget, "{name}: {} is over budget", told(picked));
            assert!(picked.watched <= budget, "{name}: {}, budget {budget:e}", told(picked));
        } else {
            assert_eq!(picked.anywhere, 0.0, "{name}: the exact tiers move alike");
        }
        self.unclaimed += u32::from(scenario.bound(Tier::Envelope, true).is_infinite());
        *self.chosen.entry(found.chosen).or_default() += 1;
        if found.errors.iter().any(|error| error.tier < found.chosen && error.watched <= budget) {
            *self.cheaper_served.entry(found.chosen).or_default() += 1;
        }
    }

    fn print(&self, what: &str) {
        let mut line = String::new();
        for (tier, count) in &self.chosen {
            let served = self.cheaper_served.get(tier).copied().unwrap_or_default();
            write!(line, ", {} {count} (a cheaper one would have served: {served})", tier.name()).unwrap();
        }
        println!("{what}{line}; no bound claimed: {}; at most {:.2} of a bound is used", self.unclaimed, self.closest);
    }
}

#[test]
fn every_scenario_is_played_on_a_plate_that_is_good_enough() {
    let mut tally = Tally::default();
    for folder in ["paper", "laws", "guards", "faults", "limits"] {
        let mut files: Vec<_> =
            std::fs::read_dir(scenarios().join(folder)).unwrap().map(|entry| entry.unwrap().path()).collect();
        files.sort();
        for path in files.iter().filter(|path| path.extension().is_some_and(|ending| ending == "toml")) {
            let name = format!("{folder}/{}", path.file_name().unwrap().to_string_lossy());
            let scenario = load(path, &name).unwrap_or_else(|fault| panic!("{fault}"));
            // A minute of a temperature that creeps says nothing that three seconds of it do not.
            let duration = scenario.duration.min(platebench_plate::Time::from_ms(3_000.0).unwrap());
            let found = examine(&Scenario { duration, ..scenario.clone() });
            let errors: Vec<String> = found.errors.iter().map(told).collect();
            println!(
                "{name}: {} for a budget of {:.1e}; {}",
                found.chosen.name(),
                scenario.model.budget,
                errors.join(", ")
            );
            tally.note(&name, &scenario, &found);
        }
    }
    tally.print("all scenarios");
    assert!(tally.chosen.values().sum::<u32>() > 50);
}

struct Random(ChaCha8Rng);

impl Random {
    fn unit(&mut self) -> f64 {
        f64::from(self.0.next_u32()) / f64::from(u32::MAX)
    }

    fn between(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * self.unit()
    }

    fn often(&mut self, share: f64) -> bool {
        self.unit() < share
    }

    fn one_of<'a>(&mut self, from: &[&'a str]) -> &'a str {
        from[self.0.next_u32() as usize % from.len()]
    }
}

/// A scenario as somebody might write it, with tolerances from a thousandth of what is measured to as much again.
fn random_scenario(random: &mut Random) -> String {
    let law = random.one_of(&[
        "open-loop",
        "open-loop",
        "dq-pi",
        "dq-pi",
        "dq-pi-fixed",
        "dq-pi-fixed",
        "dq-pi-euler",
        "voltage-only",
        "deadbeat",
        "bang-bang",
        "pll",
    ]);
    let mut text =
        format!("title = \"random\"\nplate = \"plate.toml\"\nduration_ms = 30.0\n[controller]\nlaw = \"{law}\"\n");
    writeln!(text, "period_ms = {:?}", (random.between(0.25, 2.0) * 1e3).round() / 1e3).unwrap();
    if random.often(0.5) {
        let off = random.between(-90.0, 90.0) * if random.often(0.5) { 0.01 } else { 1.0 };
        writeln!(text, "start_frequency_hz = {:?}", 32_307.6 + off).unwrap();
    }
    if random.often(0.25) {
        writeln!(text, "loop_delay_ms = {:?}", random.between(0.0, 0.3)).unwrap();
    }
    let setpoint = random.between(0.3, 2.2);
    if random.often(0.4) {
        let second = setpoint * random.between(0.4, 1.2);
        writeln!(text, "[profile]\nsetpoint_um = {{ hold = [[0.0, 0.0], [1.0, {setpoint:?}], [15.0, {second:?}]] }}")
            .unwrap();
    } else {
        writeln!(text, "[profile]\nsetpoint_um = {setpoint:?}").unwrap();
    }
    match random.0.next_u32() % 6 {
        0 => writeln!(text, "finger_force_n = {:?}", random.between(0.0, 0.6)).unwrap(),
        1 => writeln!(text, "finger_force_n = {{ linear = [[5.0, 0.0], [25.0, {:?}]] }}", random.between(0.0, 0.5))
            .unwrap(),
        2 => {
            writeln!(text, "finger_force_n = {{ hold = [[0.0, 0.0], [8.0, {:?}]] }}", random.between(0.0, 0.3))
                .unwrap();
        }
        _ => {}
    }
    if random.often(0.3) {
        writeln!(text, "temperature_offset_k = {:?}", random.between(-2.0, 2.0)).unwrap();
    }
    if random.often(0.2) {
        text += "[trials.spread]\ngain_percent = 2.0\ntime_constant_percent = 2.0\nsensor_gain_percent = 1.0\n";
    }
    // Relative, over three decades.
    let tolerance = 10f64.powf(random.between(-3.0, 0.0));
    for _ in 0..=random.0.next_u32() % 2 {
        let (metric, middle) = match random.0.next_u32() % 5 {
            0 => ("final_amplitude_um", setpoint),
            1 => ("static_error_percent", 100.0),
            2 => ("peak_deviation_percent", 100.0),
            3 => ("overshoot_percent", 100.0),
            _ => ("settling_time_ms", 5.0),
        };
        let (low, high) = (middle * (1.0 - 0.99 * tolerance), middle * (1.0 + 0.99 * tolerance));
        let window = if metric == "static_error_percent" { "window_ms = [20.0, 30.0]\n" } else { "" };
        writeln!(text, "[[expect]]\nmetric = \"{metric}\"\n{window}within = [{low:?}, {high:?}]").unwrap();
    }
    text
}

#[test]
fn two_hundred_random_scenarios_are_played_on_plates_that_are_good_enough() {
    let folder = tempfile::tempdir().unwrap();
    let plate = std::fs::read_to_string(scenarios().join("plates/aluminium-198x138.toml")).unwrap();
    std::fs::write(folder.path().join("plate.toml"), &plate).unwrap();
    let path = folder.path().join("random.toml");
    let mut random = Random(ChaCha8Rng::seed_from_u64(2016));
    let mut tally = Tally::default();
    for number in 0..200 {
        let text = random_scenario(&mut random);
        // Every seventh sensor has electronics: some coarse, most not.
        let lockin = format!(
            "[sensor]\ndemodulator_periods = {}\nconverter_hz = 1e6\nconverter_bits = {}\nconverter_range_um = 6.0\n",
            1 + number % 3,
            if number % 2 == 0 { 14 } else { 8 },
        );
        let plate = if number % 7 == 0 { plate.replacen("[sensor]\n", &lockin, 1) } else { plate.clone() };
        std::fs::write(folder.path().join("plate.toml"), plate).unwrap();
        std::fs::write(&path, &text).unwrap();
        let scenario = load(&path, "random.toml").unwrap_or_else(|fault| panic!("{fault}\n{text}"));
        let found = examine(&scenario);
        tally.note(&format!("random scenario {number}\n{text}"), &scenario, &found);
    }
    tally.print("200 random scenarios");
    let chosen = |tier| tally.chosen.get(&tier).copied().unwrap_or_default();
    assert!(chosen(Tier::Envelope) >= 5 && chosen(Tier::Linear) >= 5, "a pick that is always the dearest is none");
}

#[test]
fn no_row_is_without_its_instant() {
    let scenario = load(&scenarios().join("paper/fig13-closed-loop.toml"), "fig13.toml").unwrap();
    let [exact, cheap] = [Tier::Modal, Tier::Envelope].map(|tier| rows(&scenario, tier));
    let controls = |rows: &[Row]| rows.iter().filter(|row| row.flags.contains(Flags::CONTROL)).count();
    assert_eq!(controls(&exact), controls(&cheap));
    // Closed, at resonance: 4.8e-3 at any time.
    let error = apart(&exact, &cheap);
    assert!((4e-3..6e-3).contains(&error), "{error:e}");
}

/// Delays that the matched loops just bear, where a difference between plates is made more of than anywhere else.
#[test]
fn a_loop_that_rings_amplifies_no_more_than_it_is_allowed() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::copy(scenarios().join("plates/aluminium-198x138.toml"), folder.path().join("plate.toml")).unwrap();
    let path = folder.path().join("rings.toml");
    let (mut claimed, mut amplified) = (0, 0.0_f64);
    for law in ["dq-pi-fixed", "dq-pi-euler", "voltage-only"] {
        for start_hz in [32_307.6, 32_280.0] {
            for delay_ms in [0.0, 0.2, 0.4, 0.6, 0.7, 0.8, 0.9] {
                let text = COARSE.replace(
                    "law = \"open-loop\"",
                    &format!("law = \"{law}\"\nstart_frequency_hz = {start_hz}\nloop_delay_ms = {delay_ms}"),
                );
                std::fs::write(&path, text.replace("setpoint_um = 2.0", "setpoint_um = 1.0")).unwrap();
                let scenario = load(&path, "rings.toml").unwrap_or_else(|fault| panic!("{fault}"));
                let bound = scenario.bound(Tier::Envelope, true);
                let [exact, cheap] = [Tier::Modal, Tier::Envelope].map(|tier| rows(&scenario, tier));
                let error = apart(&exact, &cheap);
                println!("{law} from {start_hz} Hz, delay {delay_ms} ms: {error:.1e}, bound {bound:.1e}");
                assert!(error <= bound, "{law} from {start_hz} Hz, delay {delay_ms} ms: {error:e}, bound {bound:e}");
                if bound.is_finite() {
                    claimed += 1;
                    amplified = amplified.max(error / 4.83e-3);
                }
            }
        }
    }
    assert!(
        claimed > 25 && amplified > 2.0,
        "{claimed} loops claimed, {amplified} times what a loop without delay shows"
    );
}

/// Open loop, and so coarse that the cheapest tier will do: half a percent of bound for ten of tolerance.
const COARSE: &str = "title = \"coarse\"\nplate = \"plate.toml\"\nduration_ms = 30.0\n[controller]\nlaw = \"open-loop\"\n\
    [profile]\nsetpoint_um = 2.0\n[[expect]]\nmetric = \"final_amplitude_um\"\nwithin = [1.8, 2.2]\n";

/// Plays [`COARSE`] as a user would with `--model`.
fn run_coarse(folder: &Path, model: Option<&str>) -> RunRecord {
    std::fs::copy(scenarios().join("plates/aluminium-198x138.toml"), folder.join("plate.toml")).unwrap();
    let path = folder.join("coarse.toml");
    std::fs::write(&path, COARSE).unwrap();
    let mut scenario = load(&path, "coarse.toml").unwrap_or_else(|fault| panic!("{fault}"));
    let overrides = Overrides { model: model.map(ToOwned::to_owned), ..Overrides::default() };
    platebench_runner::rejudge::apply(&overrides, &mut scenario);
    let plan = Plan {
        scenarios: vec![scenario],
        jobs: 1,
        clock: Clock::Lockstep { wire_time: false },
        own_clock: false,
        rig: "hosted".to_owned(),
        overrides,
    };
    let run = RunFolder::create(Some(&folder.join("run"))).unwrap();
    platebench_runner::run(&plan, &run, &|| RigSpec::Hosted.connect(), &Cancel::default(), &mut |_| {}).unwrap()
}

#[test]
fn the_record_says_what_was_chosen_and_why() {
    for (asked, model) in
        [(None, "linear"), (Some("auto"), "linear"), (Some("modal"), "modal"), (Some("envelope"), "envelope")]
    {
        let folder = tempfile::tempdir().unwrap();
        let record = run_coarse(folder.path(), asked);
        assert_eq!(record.scenarios[0].model, model);
        let choice = record.scenarios[0].model_choice.clone().unwrap();
        assert_eq!(choice.asked, asked.unwrap_or("auto"));
        // 0.2 of 2 µm, a tenth of it.
        assert!((choice.budget - 0.01).abs() < 1e-12, "{choice:?}");
        assert!(
            choice.bound.is_some_and(|bound| bound < choice.budget && (bound < 1e-8) == (model == "modal")),
            "{choice:?}"
        );
        // Judged again it is the same run.
        assert_eq!(rejudge(&folder.path().join("run"), None).unwrap().scenarios[0].model_choice, Some(choice));
    }
}

/// Runs of a bench that did not choose are judged on the plate that they were played on.
#[test]
fn a_record_from_before_the_choice_is_judged_as_it_was_played() {
    let folder = tempfile::tempdir().unwrap();
    let played = run_coarse(folder.path(), Some("modal"));
    let path = folder.path().join("run/run.json");
    let mut old: serde_json::Value = serde_json::from_str(&std::fs::read_to_string(&path).unwrap()).unwrap();
    assert!(old["scenarios"][0].as_object_mut().unwrap().remove("model_choice").is_some());
    assert!(old["overrides"].as_object_mut().unwrap().remove("model").is_some());
    std::fs::write(&path, old.to_string()).unwrap();
    let judged = rejudge(&folder.path().join("run"), None).unwrap();
    let (judged, played) = (&judged.scenarios[0], &played.scenarios[0]);
    assert_eq!((&*judged.model, &judged.model_choice), ("modal", &None));
    assert_eq!((judged.verdict, &judged.expectations), (played.verdict, &played.expectations));
}

/// What was good enough for a tenth is not for a thousandth; traces cannot become more exact.
#[test]
fn expectations_that_need_a_better_plate_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    assert_eq!(run_coarse(folder.path(), None).scenarios[0].model, "linear");
    let path = folder.path().join("coarse.toml");
    for (within, good) in [("[1.85, 2.25]", true), ("[1.998, 2.002]", false)] {
        std::fs::write(&path, COARSE.replace("[1.8, 2.2]", within)).unwrap();
        let judged = rejudge(&folder.path().join("run"), Some(&path));
        match judged {
            Ok(_) => assert!(good, "{within}"),
            Err(RejudgeError::OtherExperiment { what, .. }) => assert!(!good && what.contains("model"), "{what}"),
            Err(other) => panic!("{other}"),
        }
    }
}
