//! The control laws on the modal plate, on the hosted rig: what each is good for and where it ends, last good and first bad.

#![allow(clippy::unwrap_used, clippy::panic, reason = "helpers of tests")]

use platebench_record::Overrides;
use platebench_record::RunFolder;
use platebench_rig::RigSpec;
use platebench_runner::{RunHooks, RunPlan};
use platebench_scenario::load;
use std::fs;
use std::path::Path;

/// The paper's plate, and where its experiments start.
const PLATE: &str = "../../scenarios/plates/aluminium-198x138.toml";
const AT_RESONANCE: &str = "";
const NINE_KELVIN_OFF: &str = "start_frequency_hz = 32220.9";

/// What there is to be measured of a step to 2 µm; `None` where there is nothing.
#[derive(Debug, Clone, Copy)]
struct Response {
    settling_ms: Option<f64>,
    overshoot_percent: f64,
    static_error_percent: f64,
    peak_vpp: f64,
    frequency_error_hz: f64,
}

/// Plays 60 ms on the paper's plate. `controller` and `profile` are TOML.
fn play(law: &str, controller: &str, profile: &str) -> Response {
    play_behind_noise(law, controller, profile, 0.0)
}

/// The same behind a sensor with `noise_um` of noise on each component, and then from a rest of 3 ms in which the law sees nothing else.
fn play_behind_noise(law: &str, controller: &str, profile: &str, noise_um: f64) -> Response {
    let folder = tempfile::tempdir().unwrap();
    let plate = fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join(PLATE)).unwrap();
    let noisy = plate.replace("noise_um_rms = 0.0", &format!("noise_um_rms = {noise_um:?}"));
    fs::write(folder.path().join("plate.toml"), noisy).unwrap();
    let expectations =
        ["settling_time_ms", "overshoot_percent", "static_error_percent", "drive_peak_vpp", "frequency_error_hz"]
            .map(|metric| format!("[[expect]]\nmetric = \"{metric}\"\nat_most = 1e6\n"))
            .concat();
    let setpoint = if noise_um > 0.0 { "{ hold = [[0.0, 0.0], [3.0, 2.0]] }" } else { "2.0" };
    let text = format!(
        "title = \"step\"\nplate = \"plate.toml\"\nduration_ms = 60.0\n[controller]\nlaw = \"{law}\"\n{controller}\n[profile]\nsetpoint_um = {setpoint}\n{profile}\n{expectations}"
    );
    let path = folder.path().join("step.toml");
    fs::write(&path, text).unwrap();
    let scenario = load(&path, "step.toml").unwrap_or_else(|fault| panic!("{fault}"));
    let out = folder.path().join("run");
    let run = RunFolder::create(Some(&out)).unwrap();
    let plan = RunPlan {
        scenarios: vec![scenario],
        jobs: 1,
        clock: platebench_runner::Clock::Lockstep { wire_time: false },
        own_clock: false,
        rig: "hosted".to_owned(),
        overrides: Overrides::default(),
    };
    let record = platebench_runner::run(&plan, &run, &|| RigSpec::Hosted.connect(), RunHooks::default()).unwrap();
    let value = |number: usize| record.scenarios[0].expectations[number].value;
    Response {
        settling_ms: value(0),
        overshoot_percent: value(1).unwrap(),
        static_error_percent: value(2).unwrap(),
        peak_vpp: value(3).unwrap(),
        frequency_error_hz: value(4).unwrap(),
    }
}

fn paper_response(law: &str, controller: &str, force_n: f64) -> Response {
    play(law, controller, &format!("finger_force_n = {force_n:?}"))
}

/// Two periods, at most 800 Vpp: Fig. 13, 14 and 16, a finger alone, and fingers in between.
#[test]
fn deadbeat_needs_two_periods_and_800_vpp() {
    for start in [AT_RESONANCE, NINE_KELVIN_OFF, "start_frequency_hz = 32394.3"] {
        for force_n in [0.0, 0.2, 0.5, 1.0, 1.5, 2.0] {
            let response = paper_response("deadbeat", start, force_n);
            assert!(response.settling_ms.is_some_and(|ms| ms <= 2.0), "{start} {force_n} N: {response:?}");
            assert!(response.peak_vpp <= 800.0, "{start} {force_n} N: {response:?}");
            assert!(response.overshoot_percent < 1.0, "{start} {force_n} N: {response:?}");
            assert!(response.static_error_percent < 0.001, "{start} {force_n} N: {response:?}");
            assert!(response.frequency_error_hz < 0.01, "{start} {force_n} N: {response:?}");
        }
    }
}

/// Untouched it does not even need the second one: the first drive already ends 3 % below the setpoint.
#[test]
fn deadbeat_is_there_in_one_period_where_nothing_touches_the_plate() {
    for start in [AT_RESONANCE, NINE_KELVIN_OFF] {
        let response = paper_response("deadbeat", start, 0.0);
        assert!(response.settling_ms.is_some_and(|ms| ms < 1.0), "{response:?}");
    }
}

/// Unknown to the law. Up to 0.3 of a period a start without a finger overshoots, from there on the first sample gives the delay away; with a finger both are
/// told apart by the second.
#[test]
fn deadbeat_finds_out_how_late_its_drive_acts() {
    for (delay_ms, settling_ms, overshoot_percent) in
        [(0.1, 2.8, 19.0), (0.2, 3.1, 38.0), (0.3, 3.3, 62.0), (0.35, 1.4, 1.0), (0.5, 1.5, 1.0), (0.8, 1.9, 1.0)]
    {
        for start in [AT_RESONANCE, NINE_KELVIN_OFF] {
            let response = paper_response("deadbeat", &format!("{start}\nloop_delay_ms = {delay_ms}"), 0.0);
            assert!(response.settling_ms.is_some_and(|ms| ms < settling_ms), "{start} {delay_ms} ms: {response:?}");
            assert!(response.overshoot_percent < overshoot_percent, "{start} {delay_ms} ms: {response:?}");
        }
        let finger = paper_response("deadbeat", &format!("{NINE_KELVIN_OFF}\nloop_delay_ms = {delay_ms}"), 2.0);
        assert!(finger.settling_ms.is_some_and(|ms| ms < 3.7), "{delay_ms} ms: {finger:?}");
        assert!(finger.overshoot_percent < 3.0, "{delay_ms} ms: {finger:?}");
    }
}

/// `dq-pi` sees the plate where its drive will find it, `deadbeat` steers from there: settling in ms for Fig. 13, 14 and 16 at a delay in ms, which both are told.
#[test]
fn a_told_delay_costs_its_own_length_and_hardly_more() {
    // From 0.75 of a period on nothing that the first sample shows is believed, for deadbeat from 0.55 on.
    let expected = [
        ("dq-pi", 0.2, [2.2, 2.2, 3.7]),
        ("dq-pi", 0.5, [2.5, 2.5, 4.0]),
        ("dq-pi", 0.8, [2.8, 4.9, 5.2]),
        ("dq-pi", 1.0, [3.0, 5.2, 5.5]),
        ("deadbeat", 0.2, [1.2, 1.3, 2.0]),
        ("deadbeat", 0.5, [1.5, 1.6, 2.3]),
        ("deadbeat", 0.8, [1.8, 3.3, 3.7]),
        ("deadbeat", 1.0, [2.0, 3.5, 3.9]),
    ];
    for (law, delay_ms, at_most) in expected {
        for ((start, force_n), at_most) in
            [(AT_RESONANCE, 0.0), (NINE_KELVIN_OFF, 0.0), (NINE_KELVIN_OFF, 2.0)].into_iter().zip(at_most)
        {
            let response = paper_response(
                law,
                &format!("{start}\nloop_delay_ms = {delay_ms}\ndesign_delay_ms = {delay_ms}"),
                force_n,
            );
            let case = format!("{law} {start} {delay_ms} ms {force_n} N: {response:?}");
            assert!(response.settling_ms.is_some_and(|ms| ms < at_most), "{case}");
            assert!(response.overshoot_percent < 7.0 && response.static_error_percent < 0.01, "{case}");
            let untold = paper_response(law, &format!("{start}\nloop_delay_ms = {delay_ms}"), force_n);
            // Told nothing, deadbeat mostly guesses right at 0.5 and 0.8.
            if force_n == 0.0 && (law == "dq-pi" || delay_ms == 0.2) {
                assert!(untold.overshoot_percent > response.overshoot_percent + 2.0, "{case} instead of {untold:?}");
            }
        }
    }
}

/// A drive told to act late shows itself late: what the first sample has of it is less than the noise makes of it.
#[test]
fn noise_in_a_short_look_is_not_taken_for_the_plate() {
    for (law, delay_ms, overshoot_percent, settling_ms) in
        [("deadbeat", 0.6, 6.0, 3.6), ("deadbeat", 0.8, 6.0, 3.8), ("dq-pi", 0.8, 10.0, 5.5), ("dq-pi", 0.9, 10.0, 5.5)]
    {
        for start in [AT_RESONANCE, NINE_KELVIN_OFF] {
            let controller = format!("{start}\nloop_delay_ms = {delay_ms}\ndesign_delay_ms = {delay_ms}");
            let response = play_behind_noise(law, &controller, "[trials]\ncount = 40\nseed = 1000", 0.01);
            assert!(response.overshoot_percent < overshoot_percent, "{law} {controller}: {response:?}");
            assert!(response.settling_ms.is_some_and(|ms| ms < settling_ms), "{law} {controller}: {response:?}");
        }
    }
}

/// Told 0.5 ms, `dq-pi` still settles at any delay of up to 1.85 ms and at none of 1.9 or 2 ms; told nothing up to 1 ms. The limit cycles of the schedule
/// make the boundary ragged: the ends that were looked for are a tenth of a period apart.
#[test]
fn a_delay_told_too_short_shifts_the_end_of_stability_by_what_was_told() {
    let settles = |told: f64, delay: f64| {
        let response = paper_response("dq-pi", &format!("loop_delay_ms = {delay}\ndesign_delay_ms = {told}"), 0.0);
        response.settling_ms.is_some()
    };
    assert!(settles(0.0, 1.0) && !settles(0.0, 1.5) && !settles(0.0, 1.9));
    assert!(settles(0.5, 1.0) && settles(0.5, 1.5) && settles(0.5, 1.85) && !settles(0.5, 1.9));
    assert!(settles(1.0, 0.5) && settles(1.0, 1.5) && settles(1.0, 2.0));
}

/// Fixed gains need 9 ms under 2 N; the matched ones bear whatever delay the fixed ones bear.
#[test]
fn dq_pi_is_as_good_under_a_finger_and_no_worse_without() {
    for start in [AT_RESONANCE, NINE_KELVIN_OFF] {
        let (matched, fixed) = (paper_response("dq-pi", start, 2.0), paper_response("dq-pi-fixed", start, 2.0));
        assert!(matched.settling_ms.is_some_and(|ms| (3.0..3.5).contains(&ms)), "{start}: {matched:?}");
        assert!(fixed.settling_ms.is_some_and(|ms| (9.0..9.5).contains(&ms)), "{start}: {fixed:?}");
        assert!(matched.overshoot_percent < 0.5 && matched.peak_vpp < 720.0, "{start}: {matched:?}");
        for delay_ms in [0.0, 0.3, 0.6] {
            let controller = format!("{start}\nloop_delay_ms = {delay_ms}");
            let (matched, fixed) =
                (paper_response("dq-pi", &controller, 0.0), paper_response("dq-pi-fixed", &controller, 0.0));
            let later = matched.settling_ms.unwrap() - fixed.settling_ms.unwrap();
            assert!(later < 0.1, "{start} {delay_ms} ms: {matched:?} instead of {fixed:?}");
            assert!(matched.overshoot_percent < fixed.overshoot_percent + 0.5, "{start} {delay_ms} ms: {matched:?}");
        }
    }
}

#[test]
fn voltage_only_pays_for_what_it_does_not_tune() {
    let tuned = paper_response("voltage-only", AT_RESONANCE, 0.0);
    assert!(tuned.settling_ms.is_some_and(|ms| ms < 2.0), "{tuned:?}");
    let off = paper_response("voltage-only", NINE_KELVIN_OFF, 0.0);
    assert!(off.settling_ms.is_some_and(|ms| ms > 5.0) && off.static_error_percent < 0.01, "{off:?}");
    assert!((off.frequency_error_hz - 86.7).abs() < 0.01, "{off:?}");
}

#[test]
fn frequency_only_has_the_amplitude_without_the_resonance_and_only_while_its_voltage_lasts() {
    let untouched = paper_response("frequency-only", AT_RESONANCE, 0.0);
    assert!(untouched.settling_ms.is_some_and(|ms| ms > 5.0) && untouched.static_error_percent < 0.1, "{untouched:?}");
    // √((0.00698 · 450 / 2)² − 1) / (2π · 1.88 ms)
    assert!((untouched.frequency_error_hz - 102.5).abs() < 1.0, "{untouched:?}");
    // 450 Vpp hold 2 µm up to σ/σ0 = 1.57, 0.85 N; the amplifier's 900 Vpp would bear any of these.
    assert!(paper_response("frequency-only", AT_RESONANCE, 0.8).static_error_percent < 0.5);
    assert!(paper_response("frequency-only", AT_RESONANCE, 1.0).static_error_percent > 5.0);
}

#[test]
fn bang_bang_is_slow_from_an_unsuited_start_alone() {
    let suited = paper_response("bang-bang", AT_RESONANCE, 0.0);
    assert!(suited.settling_ms.is_some_and(|ms| ms < 2.0), "{suited:?}");
    let unsuited = paper_response("bang-bang", NINE_KELVIN_OFF, 0.0);
    assert!(unsuited.settling_ms.is_some_and(|ms| ms > 5.0), "{unsuited:?}");
    for response in [suited, unsuited] {
        // It hunts by one step of 4.2 Hz.
        assert!(response.frequency_error_hz < 4.3 && response.static_error_percent < 0.1, "{response:?}");
    }
}

#[test]
fn the_pll_finds_the_resonance_and_leaves_the_amplitude_to_the_plate() {
    let untouched = paper_response("pll", NINE_KELVIN_OFF, 0.0);
    assert!(untouched.frequency_error_hz < 0.01 && untouched.static_error_percent < 0.01, "{untouched:?}");
    assert!(untouched.settling_ms.is_some_and(|ms| ms > 5.0), "{untouched:?}");
    let finger = paper_response("pll", NINE_KELVIN_OFF, 1.5);
    assert!(finger.frequency_error_hz < 0.01 && (finger.static_error_percent - 50.0).abs() < 0.1, "{finger:?}");
}

/// Table I scatters by 5 %. N/m is what the law takes for granted, so another gain costs it a period or two, and never the setpoint.
#[test]
fn deadbeat_bears_a_plate_that_is_not_quite_the_nominal_one() {
    let spread = "[trials]\ncount = 20\nseed = 7\n[trials.spread]\ngain_percent = 5.0\ntime_constant_percent = 5.0";
    for force_n in [0.0, 2.0] {
        let profile = format!("finger_force_n = {force_n:?}\n{spread}");
        let response = play("deadbeat", NINE_KELVIN_OFF, &profile);
        assert!(response.settling_ms.is_some_and(|ms| ms < 4.5), "{force_n} N: {response:?}");
        assert!(response.static_error_percent < 0.001, "{force_n} N: {response:?}");
    }
}
