//! Checks that results do not depend on the length of intervals while the mode varies.

use crate::reference::{
    HOLDING_DRIVE_VPP, ReferencePlate, SETPOINT, constant_conditions, distance, driven_plant, finger_profile, line,
    paper_plate, state_at,
};
use platebench_plate::{
    BandMonitor, BandSignal, ConditionProfiles, Conditions, Drive, Flow, Lockin, Model, Plant, Plate, Profile, State,
    Time,
};
use rstest::rstest;
use std::f64::consts::TAU;

fn ms(value: f64) -> Time {
    Time::from_ms(value).unwrap()
}

fn moving_conditions(start_ms: f64, warm_up_ms: f64) -> ConditionProfiles {
    ConditionProfiles {
        temperature_offset_k: line(0.0, 0.0, warm_up_ms, 9.0),
        ..finger_profile(line(start_ms, 0.0, start_ms + 100.0, 1.0))
    }
}

fn largest_error(plate: &Plate, model: Model, short_ns: u64, error: impl Fn(&Plant, &Plant) -> f64) -> f64 {
    let drive = Drive { vpp: HOLDING_DRIVE_VPP, omega: plate.omega0 + 50.0 };
    let [mut long, mut short] = [(); 2].map(|()| driven_plant(plate, &moving_conditions(3.0, 500.0), model, drive));
    let mut worst = 0.0_f64;
    for period in 1..=30_u64 {
        let end = Time::from_nanos(period * 1_000_000);
        long.advance(end, &[], &mut Vec::new());
        while short.time() < end {
            short.advance(short.time() + Time::from_nanos(short_ns), &[], &mut Vec::new());
        }
        worst = worst.max(error(&long, &short));
    }
    worst
}

/// The reference uses intervals of 1 µs; their error (first commutator) is below 1e-9.
#[rstest]
fn every_model_is_accurate_in_long_intervals(#[values(Model::Linear, Model::Envelope, Model::Modal)] model: Model) {
    let plate = Plate { omega0_per_n: 50.0, ..paper_plate() };
    let worst =
        largest_error(&plate, model, 1_000, |long, short| distance(&long.state(), &short.state(), plate.omega0));
    println!("{}, 1 ms against 1 µs: {worst:.1e}", model.name());
    assert!(worst <= 1e-7, "{worst:e}");
}

#[test]
fn the_lock_in_does_not_depend_on_the_interval() {
    let lockin = Some(Lockin { converter_hz: 1e6, periods: 8, resolution: None });
    let plate = Plate { lockin, ..paper_plate() };
    let worst = largest_error(&plate, Model::Carrier, 500, |long, short| {
        (long.sensor_reading() - short.sensor_reading()).norm() / SETPOINT
    });
    println!("output of the lock-in, 1 ms against 0.5 µs: {worst:.1e}");
    assert!(worst <= 3e-7, "{worst:e}");
}

#[rstest]
fn intervals_of_nanoseconds_add_up(#[values(Model::Linear, Model::Envelope, Model::Modal)] model: Model) {
    let plate = paper_plate();
    let drive = Drive { vpp: HOLDING_DRIVE_VPP, omega: plate.omega0 };
    let [mut once, mut often] = [(); 2].map(|()| {
        let mut plant = driven_plant(&plate, &moving_conditions(0.0, 50.0), model, drive);
        state_at(&mut plant, 5.0);
        plant
    });
    for nanos in [1, 2, 3, 4, 1, 5, 2] {
        often.advance(often.time() + Time::from_nanos(nanos), &[], &mut Vec::new());
    }
    once.advance(often.time(), &[], &mut Vec::new());
    let error = distance(&once.state(), &often.state(), plate.omega0);
    assert!(error < 1e-13, "{}: {error:e}", model.name());
}

#[rstest]
fn held_conditions_replace_the_profiles(#[values(0.0, 50.0)] newtons_per_second: f64) {
    let plate = paper_plate();
    let scene = finger_profile(line(0.0, 0.1, 100.0, 0.1 + newtons_per_second / 10.0));
    let mut plant = driven_plant(&plate, &scene, Model::Modal, Drive { vpp: HOLDING_DRIVE_VPP, omega: plate.omega0 });
    let state: State = state_at(&mut plant, 5.0);
    let held = Conditions { temperature_offset_k: 3.0, finger_force_n: 1.0 };
    plant.hold_conditions(held);
    let expected = Flow::new(Model::Modal, &plate.mode(&held), &plant.drive(), &state).after(2e-3);
    assert!(distance(&state_at(&mut plant, 7.0), &expected, plate.omega0) < 1e-14);
}

#[test]
fn a_jump_within_an_interval_acts_at_its_time() {
    let plate = paper_plate();
    let jumps = [3.333_7, 7.123_456, 11.9];
    let force = Profile::Hold(vec![(ms(0.0), 0.0), (ms(jumps[0]), 1.5), (ms(jumps[2]), 0.5)]);
    let offset = Profile::Hold(vec![(ms(0.0), 0.0), (ms(jumps[1]), 9.0)]);
    let scene = ConditionProfiles { finger_force_n: force, temperature_offset_k: offset };
    let drive = Drive { vpp: HOLDING_DRIVE_VPP, omega: plate.omega0 };
    let mut carrier = ReferencePlate::at_rest(plate.omega0);
    let modes = [(1.0, 0.0), (2.0, 0.0), (2.0, 9.0), (1.0 + 0.5 / 1.5, 9.0)];
    let mut from = 0.0;
    for ((ratio, offset), to) in modes.into_iter().zip([jumps[0], jumps[1], jumps[2], 15.0]) {
        let mode = (plate.sigma0 * ratio, plate.omega0 - 9.638 * TAU * offset);
        carrier.advance((to - from) / 1e3, plate.force_constant(), &drive, &|_| mode);
        from = to;
    }
    for interval in [15_000_000, 1_000_000, 70_000] {
        let mut plant = driven_plant(&plate, &scene, Model::Modal, drive);
        while plant.time() < ms(15.0) {
            plant.advance((plant.time() + Time::from_nanos(interval)).min(ms(15.0)), &[], &mut Vec::new());
        }
        let error = distance(&plant.state(), &carrier.state(), plate.omega0);
        println!("three jumps, intervals of {} ms: {error:.1e}", interval as f64 / 1e6);
        assert!(error <= 1e-10, "{error:e}");
    }
}

/// Drives, finger and bands that end every kind of pause: a command, a point of the profile, a
/// crossing. All steps together give the states, crossings and phase of single ones, bit for bit.
#[rstest]
fn steps_on_a_grid_equal_single_steps(#[values(Model::Linear, Model::Envelope, Model::Modal)] model: Model) {
    let plate = paper_plate();
    let force = Profile::Hold(vec![(ms(0.0), 0.0), (ms(12.34), 1.0)]);
    let scene = ConditionProfiles { finger_force_n: force, ..constant_conditions() };
    let monitors = [(BandSignal::Amplitude, 1.9, 2.1), (BandSignal::Quadrature, -0.2, 0.3)];
    let monitors = monitors.map(|(signal, low, high)| BandMonitor { signal, low, high });
    let step = Time::from_nanos(50_000);
    let [mut single, mut grid] = [(); 2].map(|()| Plant::new(plate.clone(), scene.clone(), model));
    let [mut expected, mut found] = [(); 2].map(|()| Vec::new());
    let mut on_grid = 0;
    for period in 0..30_u64 {
        let start = Time::from_nanos(period * 1_000_000);
        let vpp = if period % 10 < 5 { HOLDING_DRIVE_VPP } else { 1.3 * HOLDING_DRIVE_VPP };
        let drive = Drive { vpp, omega: plate.omega0 + 300.0 * (period % 3) as f64 };
        single.set_drive(drive);
        grid.set_drive(drive);
        let end = start + ms(1.0);
        while single.time() < end {
            let next = step.next_multiple_after(single.time()).min(end);
            single.advance(next, &monitors, &mut expected);
            if grid.time() < next {
                grid.advance_in_steps(step, end, &monitors, |time, _| {
                    assert!(time < end, "{time}");
                    on_grid += 1;
                });
            }
            if grid.time() < next {
                grid.advance(next, &monitors, &mut found);
            }
            if grid.time() == next {
                assert_eq!((grid.state(), grid.phase()), (single.state(), single.phase()), "{next}");
            }
        }
        assert_eq!((grid.time(), grid.state(), grid.phase()), (end, single.state(), single.phase()));
    }
    assert_eq!(found, expected);
    println!("{}: {on_grid} of 600 steps, {} crossings", model.name(), found.len());
    assert!(found.len() >= 4 && (200..590).contains(&on_grid), "{} crossings, {on_grid} steps", found.len());
}
