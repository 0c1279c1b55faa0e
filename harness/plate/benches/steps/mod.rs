//! Lists the steps that `cost` and `counts` measure.

#![allow(clippy::expect_used, reason = "the repository's plate file is valid")]

use platebench_plate::{
    ConditionProfiles, Conditions, Drive, Flow, Lockin, Model, Plant, Plate, Profile, RawPlate, State, Time,
};
use std::fmt;
use std::hint::black_box;

const PERIOD: Time = Time::from_nanos(1_000_000);
pub(crate) struct Step {
    pub(crate) name: &'static str,
    /// Number of control periods or samples per step.
    pub(crate) items: usize,
    make: fn() -> Box<dyn FnMut()>,
}

impl Step {
    pub(crate) fn prepare(&self) -> Box<dyn FnMut()> {
        (self.make)()
    }
}

impl fmt::Display for Step {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str(self.name)
    }
}

pub(crate) static STEPS: &[Step] = &[
    Step { name: "flow-linear", items: 1, make: || flow(Model::Linear) },
    Step { name: "flow-envelope", items: 1, make: || flow(Model::Envelope) },
    Step { name: "flow-modal", items: 1, make: || flow(Model::Modal) },
    Step { name: "plant-envelope", items: 1, make: || plant(Model::Envelope) },
    Step { name: "plant-modal", items: 1, make: || plant(Model::Modal) },
    Step { name: "ramp-envelope", items: 1, make: || ramp(Model::Envelope) },
    Step { name: "ramp-modal", items: 1, make: || ramp(Model::Modal) },
    Step { name: "carrier-sample", items: 1_000, make: || plant(Model::Carrier) },
    Step { name: "lock-in-read", items: 1, make: read },
];

fn plate() -> Plate {
    let text = include_str!("../../../../scenarios/plates/aluminium-198x138.toml");
    let lockin = Some(Lockin { converter_hz: 1e6, periods: 8, resolution: None });
    let raw = toml::from_str::<RawPlate>(text).expect("a plate file of this repository");
    Plate { lockin, ..raw.check().expect("a plate file of this repository") }
}

fn drive(plate: &Plate, period: u64) -> Drive {
    let turn = (period % 64) as f64;
    Drive { vpp: 200.0 + turn, omega: plate.omega0 + 10.0 * turn }
}

fn flow(model: Model) -> Box<dyn FnMut()> {
    let plate = plate();
    let mode = plate.mode(&Conditions::default());
    let (mut state, mut period) = (State::default(), 0);
    Box::new(move || {
        period += 1;
        let flow = Flow::new(model, black_box(&mode), &drive(&plate, period), &state);
        state = black_box(flow.after(black_box(1e-3)));
    })
}

fn moving_plant(model: Model) -> Plant {
    let scene =
        ConditionProfiles { temperature_offset_k: Profile::constant(3.0), finger_force_n: Profile::constant(0.5) };
    Plant::new(plate(), scene, model)
}

fn plant(model: Model) -> Box<dyn FnMut()> {
    let (mut plant, mut period, mut crossings) = (moving_plant(model), 0, Vec::new());
    Box::new(move || {
        period += 1;
        plant.set_drive(drive(plant.plate(), period));
        plant.advance(plant.time() + PERIOD, &[], &mut crossings);
        black_box(plant.state());
    })
}

/// The finger force rises for 0.1 s and falls for 0.1 s, at 10 N/s.
fn ramp(model: Model) -> Box<dyn FnMut()> {
    let points = (0..=100).map(|turn| (PERIOD.times(100 * turn), f64::from(turn % 2 == 1)));
    let scene = ConditionProfiles {
        temperature_offset_k: Profile::constant(3.0),
        finger_force_n: Profile::Linear(points.collect()),
    };
    let fresh = Plant::new(plate(), scene, model);
    let (mut plant, mut period, mut crossings) = (fresh.clone(), 0, Vec::new());
    Box::new(move || {
        if period == 10_000 {
            (plant, period) = (fresh.clone(), 0);
        }
        period += 1;
        plant.set_drive(drive(plant.plate(), period));
        plant.advance(plant.time() + PERIOD, &[], &mut crossings);
        black_box(plant.state());
    })
}

fn read() -> Box<dyn FnMut()> {
    let mut plant = moving_plant(Model::Carrier);
    plant.set_drive(drive(plant.plate(), 1));
    plant.advance(PERIOD, &[], &mut Vec::new());
    Box::new(move || {
        black_box(black_box(&plant).sensor_reading());
    })
}
