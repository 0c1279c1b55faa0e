//! Checks that no step of plate or sensor allocates memory.

#![allow(clippy::unwrap_used, reason = "a failed fixture fails the test")]

use allocation_counter::measure;
use platebench_plate::{
    BandMonitor, BandSignal, ConditionProfiles, Drive, Lockin, Model, Plant, Plate, Profile, RawPlate, Sensor, Time,
};
use rstest::rstest;
use std::hint::black_box;

fn plate() -> Plate {
    let text = include_str!("../../../scenarios/plates/aluminium-198x138.toml");
    let raw = toml::from_str::<RawPlate>(text).unwrap();
    Plate { lockin: Some(Lockin { converter_hz: 1e6, periods: 8, resolution: None }), ..raw.check().unwrap() }
}

#[test]
fn detects_an_allocation() {
    assert_eq!(measure(|| drop(black_box(vec![1_u8; 3]))).count_total, 1);
}

#[rstest]
fn no_control_period_allocates(#[values(Model::Linear, Model::Envelope, Model::Modal, Model::Carrier)] model: Model) {
    let ms = |ms| Time::from_ms(ms).unwrap();
    let scene = ConditionProfiles {
        temperature_offset_k: Profile::constant(3.0),
        finger_force_n: Profile::Linear(vec![(ms(0.0), 0.0), (ms(20.0), 1.0)]),
    };
    let plate = plate();
    let omega = plate.omega0;
    let mut plant = Plant::new(plate, scene, model);
    let mut sensor = Sensor::new(1.0, 0.01, 1);
    let mut crossings = Vec::with_capacity(64);
    let monitors = [BandMonitor { signal: BandSignal::Amplitude, low: 0.5, high: 1.5 }];
    let allocations = measure(|| {
        for period in 1..=40_u32 {
            plant.set_drive(Drive { vpp: 10.0 * f64::from(period), omega: omega + f64::from(period) });
            plant.advance(ms(f64::from(period)), &monitors, &mut crossings);
            black_box(sensor.measure(plant.sensor_reading()));
            black_box(plant.waveform());
        }
    });
    assert!(!crossings.is_empty() && crossings.capacity() == 64);
    assert_eq!(allocations.count_total, 0, "{}: {allocations:?}", model.name());
}
