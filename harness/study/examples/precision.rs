//! Prints work against precision without a controller: a step whose drive and detuning decay as
//! under a closed loop, untouched and while a finger comes down with 10 N/s.

use platebench_plate::RawPlate;
use platebench_plate::RawProfile;
use platebench_plate::{ConditionProfiles, Drive, Profile, Time};
use platebench_study::integration::{Replay, ReplaySpec, Solver, SweepConfig, SweepResult, sweep};
use std::path::Path;
use std::time::Duration;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let file = std::env::args().nth(1).ok_or("expected a plate file")?;
    let plate = toml::from_str::<RawPlate>(&std::fs::read_to_string(file)?)?.check()?;
    let drives: Vec<(Time, Drive)> = (0..40)
        .map(|period| {
            let share = 0.22_f64.powi(period);
            (
                Time::from_nanos(1_000_000 * period as u64),
                Drive { vpp: 286.5 * (1.0 + 0.9 * share), omega: plate.omega0 - 545.0 * share },
            )
        })
        .collect();
    let (period, end) = (Time::from_nanos(1_000_000), Time::from_nanos(40_000_000));
    for finger in ["0.0", "{ linear = [[0.0, 0.0], [100.0, 1.0]] }"] {
        let finger_force_n = toml::from_str::<Finger>(&format!("force_n = {finger}"))?.force_n.check(Path::new("."))?;
        let scene = ConditionProfiles { temperature_offset_k: Profile::constant(0.0), finger_force_n };
        let course = ReplaySpec { plate: &plate, scene: &scene, drives: &drives, period, end, setpoint_um: 2.0 };
        println!("finger force in N: {finger}");
        for measured in
            sweep(&Replay::new(&course), &SweepConfig { rounds: 5, batch: Duration::from_millis(1), stride: 1 })
        {
            let SweepResult { solver: contender, numerical_error, ns_per_ms, status, .. } = measured;
            let setting = match contender {
                Solver::Exact(_) => String::new(),
                Solver::General(_, _, setting) => format!("{setting:.1e}"),
            };
            let (problem, method) = (contender.problem(), contender.method());
            println!("{problem:9} {method:29} {setting:>8} {numerical_error:8.1e} {ns_per_ms:12.0} ns/ms {status}");
        }
    }
    Ok(())
}

#[derive(serde::Deserialize)]
struct Finger {
    force_n: RawProfile,
}
