//! Work against precision on a step at resonance and on one under a closed loop, without a controller: prints one line per setting.

use platebench_methods::{Course, Effort, Passage, sweep};
use platebench_plate::file::RawPlate;
use platebench_plate::{Drive, Profile, Scene, Time};
use std::time::Duration;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let file = std::env::args().nth(1).ok_or("expected a plate file")?;
    let plate = toml::from_str::<RawPlate>(&std::fs::read_to_string(file)?)?.check()?;
    let scene = Scene { temperature_offset_k: Profile::constant(0.0), finger_force_n: Profile::constant(0.0) };
    let drives: Vec<(Time, Drive)> = (0..40)
        .map(|period| {
            let share = 0.22_f64.powi(period);
            (
                Time::from_nanos(1_000_000 * period as u64),
                Drive { vpp: 286.5 * (1.0 + 0.9 * share), omega: plate.omega0 - 545.0 * share },
            )
        })
        .collect();
    let end = Time::from_nanos(40_000_000);
    let course = Course {
        plate: &plate,
        scene: &scene,
        drives: &drives,
        period: Time::from_nanos(1_000_000),
        end,
        setpoint_um: 2.0,
    };
    let passage = Passage::new(&course);
    for measured in sweep(&passage, &Effort { rounds: 5, batch: Duration::from_millis(1), every: 1 }) {
        let contender = measured.contender;
        println!(
            "{:10}{:30}{:?} {:8.1e} {:8.1e} {:12.0} ns/ms {}",
            contender.problem(),
            contender.method(),
            contender,
            measured.numerical_error,
            measured.total_error,
            measured.ns_per_ms,
            measured.status
        );
    }
    Ok(())
}
