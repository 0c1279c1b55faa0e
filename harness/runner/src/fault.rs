//! Translates a scenario's faults into the rig's.

use platebench_plate::Time;
use platebench_rig::{Direction as Way, WireFault, WireFaultKind};
use platebench_scenario::{Direction, Fault, FaultKind, Scenario, Variation};
use std::time::Duration;

pub(crate) fn wire_faults(scenario: &Scenario, index: u32) -> Vec<WireFault> {
    let seed = Variation::of_trial(scenario, index).seed;
    scenario.faults.iter().map(|fault| wire_fault(fault, seed)).collect()
}

pub fn wire_fault_kind(kind: FaultKind) -> WireFaultKind {
    match kind {
        FaultKind::Drop => WireFaultKind::Drop,
        FaultKind::Flip => WireFaultKind::Flip,
        FaultKind::Duplicate => WireFaultKind::Duplicate,
        FaultKind::Delay(delay) => WireFaultKind::Delay(span(delay)),
        FaultKind::Truncate => WireFaultKind::Truncate,
        FaultKind::Babble => WireFaultKind::Babble,
        FaultKind::Disconnect => WireFaultKind::Disconnect,
        FaultKind::Freeze => WireFaultKind::Freeze,
        FaultKind::Scale(factor) => WireFaultKind::Scale(factor as f32),
    }
}

fn span(time: Time) -> Duration {
    Duration::from_nanos(time.as_nanos())
}

fn wire_fault(fault: &Fault, seed: u64) -> WireFault {
    WireFault {
        kind: wire_fault_kind(fault.kind),
        from: span(fault.from),
        until: fault.until.map(span),
        direction: match fault.direction {
            Direction::ToController => Way::ToController,
            Direction::FromController => Way::FromController,
            Direction::Both => Way::Both,
        },
        every: fault.every,
        seed: fault.seed.unwrap_or(seed),
    }
}

/// True if the fault that stopped the controller is over and requests a new configuration.
pub(crate) fn needs_reconfiguration(scenario: &Scenario, stopped: Time, now: Time) -> bool {
    let period = scenario.controller.period;
    scenario.faults.iter().any(|fault| {
        fault.reconfigure && fault.can_explain(stopped, period) && fault.until.is_some_and(|until| until <= now)
    })
}
