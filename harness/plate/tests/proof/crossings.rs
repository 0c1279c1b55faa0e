//! Tests the times at which signals cross bands, to the nanosecond.

use crate::reference::{
    HOLDING_DRIVE_VPP, Random, ReferencePlate, SETPOINT, constant_conditions, driven_plant, finger_profile,
    holding_plant, line, paper_plate,
};
use platebench_plate::{BandMonitor, BandSignal, Conditions, Crossing, Drive, Flow, Model, Plant, Plate, State, Time};
use rstest::rstest;

fn band(signal: BandSignal, low: f64, high: f64) -> BandMonitor {
    BandMonitor { signal, low, high }
}

const FIVE_PERCENT: BandMonitor = BandMonitor { signal: BandSignal::Amplitude, low: 1.9, high: 2.1 };

fn crossings(plant: &mut Plant, monitors: &[BandMonitor], end_ms: f64, interval_ns: u64) -> Vec<Crossing> {
    let end = Time::from_ms(end_ms).unwrap();
    let mut found = Vec::new();
    while plant.time() < end {
        plant.advance((plant.time() + Time::from_nanos(interval_ns)).min(end), monitors, &mut found);
    }
    found
}

#[rstest]
fn the_first_order_plate_settles_after_tau_ln_20(
    #[values(1_000_000, 50_000, 10_000_000, 333_333)] interval_ns: u64,
    #[values(BandSignal::Amplitude, BandSignal::InPhase)] signal: BandSignal,
) {
    let mut plant = holding_plant(&paper_plate(), Model::Envelope, 0.0);
    let found = crossings(&mut plant, &[band(signal, 1.9, 2.1)], 10.0, interval_ns);
    let expected = 20.0_f64.ln() * 1.88e6;
    println!("{signal:?}, intervals of {interval_ns} ns: {} (τ ln 20 = {:.6} ms)", found[0].time, expected / 1e6);
    assert_eq!(found.len(), 1);
    assert_eq!(found[0].time.as_nanos(), expected.ceil() as u64);
    assert!((found[0].state.amplitude() - 1.9).abs() < 1e-7);
}

fn crossing_intervals(flow: &Flow, is_inside: impl Fn(&State) -> bool, end_ns: u64) -> Vec<u64> {
    let side = |ns: u64| is_inside(&flow.after(ns as f64 / 1e9));
    (0..end_ns / 50).map(|step| 50 * step).filter(|ns| side(*ns) != side(ns + 50)).collect()
}

/// Removes excursions of at most 1 µs, which `Plant::advance` may miss.
fn without_short_excursions(brackets: &[u64], found: &[Crossing]) -> Vec<u64> {
    let mut kept = Vec::new();
    let mut rest = brackets;
    while let [first, others @ ..] = rest {
        let is_found = found.iter().any(|crossing| (first + 1..=first + 50).contains(&crossing.time.as_nanos()));
        rest = match others {
            [second, others @ ..] if !is_found && second - first <= 1_000 => {
                println!("    an excursion of {} ns at {first} ns is missed", second - first);
                others
            }
            _ => {
                kept.push(*first);
                others
            }
        };
    }
    kept
}

#[rstest]
#[case::drive_at_resonance(HOLDING_DRIVE_VPP, 0.0, FIVE_PERCENT)]
#[case::more_drive(540.0, 0.0, FIVE_PERCENT)]
#[case::detuned_beats(900.0, 3000.0, band(BandSignal::Amplitude, 1.5, 1.6))]
#[case::quadrature(600.0, -545.0, band(BandSignal::Quadrature, 0.3, 0.9))]
#[case::ripple_decides(HOLDING_DRIVE_VPP, 0.0, band(BandSignal::Quadrature, -0.001, 0.001))]
fn modal_crossings_match_closed_form_and_reference(
    #[case] vpp: f64,
    #[case] detuning: f64,
    #[case] monitor: BandMonitor,
    #[values(1_000_000, 50_000)] interval_ns: u64,
) {
    let plate = paper_plate();
    let drive = Drive { vpp, omega: plate.omega0 + detuning };
    let mut plant = driven_plant(&plate, &constant_conditions(), Model::Modal, drive);
    let found = crossings(&mut plant, &[monitor], 8.0, interval_ns);
    let is_inside = |state: &State| (monitor.low..=monitor.high).contains(&monitor.signal.value(state));
    let flow = Flow::new(Model::Modal, &plate.mode(&Conditions::default()), &drive, &State::default());
    let brackets = crossing_intervals(&flow, is_inside, 8_000_000);
    println!("{monitor:?} at {vpp} Vpp, {detuning} rad/s off: {} crossings", found.len());
    assert!(!found.is_empty());
    let brackets = without_short_excursions(&brackets, &found);
    assert_eq!(found.len(), brackets.len());
    let mut inside = is_inside(&State::default());
    for (crossing, bracket) in found.iter().zip(brackets) {
        assert!(
            (bracket + 1..=bracket + 50).contains(&crossing.time.as_nanos()),
            "{crossing:?} not after {bracket} ns"
        );
        let mut carrier = ReferencePlate::at_rest(plate.omega0);
        let before = crossing.time - Time::from_nanos(1);
        carrier.advance(before.seconds(), plate.force_constant(), &drive, &|_| (plate.sigma0, plate.omega0));
        assert_eq!(is_inside(&carrier.state()), inside, "{crossing:?}");
        carrier.advance(1e-9, plate.force_constant(), &drive, &|_| (plate.sigma0, plate.omega0));
        inside = !inside;
        assert_eq!(is_inside(&carrier.state()), inside, "{crossing:?}");
        assert_eq!(is_inside(&crossing.state), inside, "{crossing:?}");
    }
}

#[test]
fn a_decaying_amplitude_leaves_the_band() {
    let plate = paper_plate();
    let mut plant = holding_plant(&plate, Model::Envelope, 0.0);
    let mut found = crossings(&mut plant, &[FIVE_PERCENT], 10.0, 1_000_000);
    let from = plant.state().w.re;
    plant.set_drive(Drive { vpp: 0.0, omega: plate.omega0 });
    found.extend(crossings(&mut plant, &[FIVE_PERCENT], 20.0, 1_000_000));
    let expected = 10e6 + (from / 1.9).ln() * 1.88e6;
    println!("entered at {}, left at {} (closed form {:.6} ms)", found[0].time, found[1].time, expected / 1e6);
    assert_eq!(found.len(), 2);
    assert_eq!(found[1].time.as_nanos(), expected.floor() as u64 + 1);
    assert!(found[0].state.amplitude() >= 1.9 && found[1].state.amplitude() < 1.9);
}

fn first_peak(flow: &Flow) -> (f64, f64) {
    let amplitude = |t: f64| flow.after(t).amplitude();
    let (mut low, mut high) = (0.5e-3, 1.5e-3);
    while high - low > 1e-9 {
        let (a, b) = (high - 0.618 * (high - low), low + 0.618 * (high - low));
        if amplitude(a) < amplitude(b) { low = a } else { high = b }
    }
    (low, amplitude(low))
}

#[rstest]
#[case::just_inside(1.0 - 1e-5, 2)]
#[case::just_outside(1.0 + 1e-9, 0)]
#[case::well_inside(0.999, 2)]
fn a_peak_at_the_edge_of_a_band(
    #[case] edge: f64,
    #[case] count: usize,
    #[values(1_000_000, 77_777, 5_000_000)] interval_ns: u64,
) {
    let plate = paper_plate();
    let drive = Drive { vpp: 600.0, omega: plate.omega0 + 3000.0 };
    let flow = Flow::new(Model::Envelope, &plate.mode(&Conditions::default()), &drive, &State::default());
    let (at, peak) = first_peak(&flow);
    let monitor = band(BandSignal::Amplitude, edge * peak, 10.0);
    let mut plant = driven_plant(&plate, &constant_conditions(), Model::Envelope, drive);
    let found = crossings(&mut plant, &[monitor], 5.0, interval_ns);
    assert_eq!(found.len(), count, "{found:?}");
    if let [entered, left] = found[..] {
        println!("peak at {:.6} ms, above {edge} of it from {} to {}", 1e3 * at, entered.time, left.time);
        assert!(entered.time.seconds() < at && at < left.time.seconds());
        for (crossing, sign) in [(entered, 1.0), (left, -1.0)] {
            let t = crossing.time.seconds();
            assert!(sign * (flow.after(t).amplitude() - monitor.low) >= 0.0);
            assert!(sign * (flow.after(t - 1e-9).amplitude() - monitor.low) <= 0.0);
        }
    }
}

#[test]
fn crossings_of_several_bands_are_in_order_of_time() {
    let plate = paper_plate();
    let monitors = [
        FIVE_PERCENT,
        band(BandSignal::Amplitude, 1.0, 9.0),
        band(BandSignal::Amplitude, 1.98, 2.02),
        band(BandSignal::InPhase, 0.2, 9.0),
        band(BandSignal::Amplitude, 1.5, 1.6),
        band(BandSignal::Quadrature, 5.0, 6.0),
    ];
    let mut plant = holding_plant(&plate, Model::Envelope, 0.0);
    let (time, state) = (Time::from_ms(99.0).unwrap(), State::default());
    let other = Crossing { time, state, before: state, temperature_rise_k: [0.0; 2] };
    let mut found = vec![other];
    plant.advance(Time::from_ms(12.0).unwrap(), &monitors, &mut found);
    assert_eq!(found.remove(0), other);
    let times: Vec<u64> = found.iter().map(|crossing| crossing.time.as_nanos()).collect();
    let at = |level: f64| ((SETPOINT / (SETPOINT - level)).ln() * 1.88e6).ceil() as u64;
    let expected = [0.2, 1.0, 1.5, 1.6, 1.9, 1.98].map(at);
    assert_eq!(times.len(), expected.len());
    for (time, expected) in times.iter().zip(expected) {
        // A crossing out of a band is reported up to 1 ns after its edge.
        assert!(time.abs_diff(expected) <= 1, "{times:?} instead of {expected:?}");
    }
    plant.set_drive(Drive { vpp: 0.0, omega: plate.omega0 });
    let before = found.clone();
    plant.advance(Time::from_ms(30.0).unwrap(), &monitors, &mut found);
    assert_eq!(found[..before.len()], before);
    assert!(found.is_sorted_by_key(|crossing| crossing.time));
    assert_eq!(found.len(), 2 * before.len());
}

#[test]
fn a_finger_moves_the_amplitude_out_of_its_band() {
    let plate: Plate = paper_plate();
    let scene = finger_profile(line(20.0, 0.0, 120.0, 1.0));
    let drive = Drive { vpp: HOLDING_DRIVE_VPP, omega: plate.omega0 };
    let mut random = Random::new(7);
    let mut unmonitored = driven_plant(&plate, &scene, Model::Modal, drive);
    let mut times = Vec::new();
    for interval_ns in [1_000_000, 50_000, random.in_range(1e5, 1e6) as u64] {
        let mut plant = driven_plant(&plate, &scene, Model::Modal, drive);
        let found = crossings(&mut plant, &[FIVE_PERCENT], 60.0, interval_ns);
        let left = found.last().unwrap();
        assert!(left.time > Time::from_ms(20.0).unwrap() && left.state.amplitude() < 1.9);
        times.push(left.time.as_nanos());
        if interval_ns == 1_000_000 {
            crossings(&mut unmonitored, &[], 60.0, interval_ns);
            assert_eq!(plant.state(), unmonitored.state());
        }
    }
    println!("1 N in 0.1 s moves |W| out of 5 % at {times:?} ns");
    // |W| changes by 7 µm/s, so an error of 1e-7 of the setpoint shifts a crossing by about 30 ns.
    assert!(times.iter().all(|time| time.abs_diff(times[0]) < 200), "{times:?}");
}
