//! Compares the control steps in the example of `docs/wire-protocol.md` with the controller.

#![allow(clippy::unwrap_used, clippy::panic, reason = "a panic fails the test")]

use platebench_controller::StateMachine;
use platebench_wire::{Configure, Message, Packet, Sample};

const PAGE: &str = include_str!("../../../docs/wire-protocol.md");
const VECTORS: &str = include_str!("../../../docs/examples/test-vectors.txt");
const COLUMNS: usize = 12;

fn configuration() -> Configure {
    let body = VECTORS.lines().find_map(|line| line.strip_prefix("body  13 02 ")).unwrap();
    let mut bytes = vec![0x13, 0x02];
    bytes.extend(body.split(' ').map(|byte| u8::from_str_radix(byte, 16).unwrap()));
    match Packet::decode(&bytes).unwrap().message {
        Message::Configure(configure) => configure,
        other => panic!("{other:?}"),
    }
}

/// Number after the last name of `names`. The names follow each other in the debug text of
/// `machine`.
fn value(machine: &StateMachine, names: &[&str]) -> f64 {
    let text = format!("{machine:?}");
    let rest = names.iter().fold(text.as_str(), |rest, name| rest.split_once(&format!("{name}: ")).unwrap().1);
    let end = rest.find([',', ' ', '}']).unwrap();
    rest.split_at(end).0.parse().unwrap()
}

/// The law stores only σ and the pending change. This function inverts its update of σ.
fn identified_sigma(before: f64, after: f64, pending: f64) -> f64 {
    let step = after - before;
    if pending != 0.0 {
        before + pending
    } else if step.abs() > before / 4.0 {
        after
    } else {
        before + 8.0 * step
    }
}

#[test]
fn every_row_is_a_step_of_dq_pi() {
    let configure = configuration();
    let mut machine = StateMachine::new();
    machine.configure(&configure).outcome.unwrap();
    let table = PAGE.split_once("\n setpoint ").unwrap().1.split_once("\n```").unwrap().0;
    let mut sigma = f64::from(1.0 / configure.time_constant_s);
    let mut rows = 0;
    for (row, time_us) in table.lines().skip(1).zip((0..).step_by(1_000)) {
        let cells: Vec<&str> = row.split_whitespace().collect();
        let cells: &[&str; COLUMNS] = cells.as_slice().try_into().unwrap_or_else(|_| panic!("{row}"));
        let [setpoint_um, wd_um, wq_um] = [cells[0], cells[1], cells[2]].map(|cell| cell.parse().unwrap());
        let command = machine.sample(&Sample { time_us, setpoint_um, wd_um, wq_um }, time_us);
        let after = value(&machine, &["sigma", "sigma"]);
        let pending = value(&machine, &["suspected_change"]);
        let expected = [
            (cells[3] != "-").then(|| identified_sigma(sigma, after, pending)),
            Some(after),
            Some(value(&machine, &["amplitude", "proportional"])),
            Some(value(&machine, &["amplitude", "integral_per_period"])),
            Some(f64::from(command.drive_vpp)),
            Some(value(&machine, &["amplitude", "integral"])),
            Some((f64::from(command.frequency_mhz) - f64::from(configure.start_frequency_mhz)) / 1e3),
            Some(value(&machine, &["frequency", "integral"])),
            Some(f64::from(command.flags)),
        ];
        for (cell, expected) in cells[3..].iter().zip(expected) {
            let Some(expected) = expected else { continue };
            let decimals = cell.split_once('.').map_or(0, |(_, digits)| digits.len());
            assert_eq!(*cell, format!("{expected:.decimals$}"), "{row}");
        }
        sigma = after;
        rows += 1;
    }
    assert_eq!(rows, 7);
}
