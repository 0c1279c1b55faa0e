//! Translates the faults of a scenario into faults of the rig.

use platebench_model::scenario::{
    BitFlipTarget, ChipFault, ChipFaultKind, Direction, Fault, FaultKind, Scenario, Variation,
};
use platebench_plate::Time;
use platebench_rig::chip_fault::{ChipFault as RigChipFault, ChipFaultKind as RigChipFaultKind, ChipFaultPlan};
use platebench_rig::{Direction as Way, WireFault, WireFaultKind};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng, SeedableRng};
use std::time::Duration;

pub(crate) fn wire_faults(scenario: &Scenario, index: u32) -> Vec<WireFault> {
    let seed = Variation::of_trial(scenario, index).seed;
    scenario.faults.iter().map(|fault| wire_fault(fault, seed)).collect()
}

/// The controller stops after this number of periods without a sample. After a chip fault, the
/// bench applies 0 V after this number of periods without a command.
pub(crate) const WATCHDOG_PERIODS: u64 = 5;
/// First random stream of chip faults. Noise, plate spread and faults of the line have lower ones.
const FIRST_CHIP_STREAM: u64 = 1 << 32;
/// Least time-out for an answer. A sample and its command take 0.5 ms at 1 Mbaud.
const MIN_CHIP_ANSWER_TIMEOUT: Duration = Duration::from_millis(1);

/// Draws instants and bits that the scenario does not state, from the seed of the trial.
pub(crate) fn chip_fault_plan(scenario: &Scenario, index: u32) -> ChipFaultPlan {
    let seed = Variation::of_trial(scenario, index).seed;
    let planned = (FIRST_CHIP_STREAM..).zip(&scenario.chip_faults);
    let mut faults: Vec<_> =
        planned.map(|(stream, fault)| chip_fault(fault, seed, stream, scenario.duration)).collect();
    faults.sort_by_key(|fault| fault.at);
    ChipFaultPlan { faults, answer_timeout: Duration::from(scenario.controller.period).max(MIN_CHIP_ANSWER_TIMEOUT) }
}

fn chip_fault(fault: &ChipFault, seed: u64, stream: u64, duration: Time) -> RigChipFault {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    random.set_stream(stream);
    let (instant, draw) = (random.next_u64(), random.next_u64());
    let at = fault.at.map_or_else(|| Duration::from_nanos(instant % duration.as_nanos().max(1)), Duration::from);
    let kind = match &fault.kind {
        ChipFaultKind::BitFlip { target, bit } => {
            let draw = bit.map_or(draw, u64::from);
            match target {
                BitFlipTarget::Ram { start, length } => {
                    RigChipFaultKind::FlipRam { start: *start, length: *length, draw }
                }
                BitFlipTarget::Variable(name) => RigChipFaultKind::FlipVariable { name: name.clone(), draw },
                BitFlipTarget::Register(number) => RigChipFaultKind::FlipRegister { number: *number, draw },
            }
        }
        ChipFaultKind::Reset => RigChipFaultKind::Reset,
        ChipFaultKind::PowerCut => RigChipFaultKind::PowerCut,
        ChipFaultKind::ClockDrift(ppm) => RigChipFaultKind::ClockDrift { ppm: *ppm },
        ChipFaultKind::Hang => RigChipFaultKind::Hang,
        ChipFaultKind::Stuck { address, value } => RigChipFaultKind::Stuck { address: *address, value: *value },
    };
    RigChipFault { at, kind }
}

/// Returns the instants at which the watchdog expires because of a planned silence, last one first.
pub(crate) fn planned_stops(scenario: &Scenario) -> Vec<Time> {
    let period = scenario.controller.period;
    let watchdog = period.times(WATCHDOG_PERIODS);
    let silences = scenario.faults.iter().filter(|fault| fault.exceeds_watchdog(watchdog, period));
    // The watchdog counts from the last sample, which arrives up to one period before the fault.
    let mut stops: Vec<Time> = silences.map(|fault| fault.from + period.times(WATCHDOG_PERIODS - 1)).collect();
    stops.sort_by(|one, other| other.cmp(one));
    stops
}

pub fn wire_fault_kind(kind: FaultKind) -> WireFaultKind {
    match kind {
        FaultKind::Drop => WireFaultKind::Drop,
        FaultKind::Flip => WireFaultKind::Flip,
        FaultKind::Duplicate => WireFaultKind::Duplicate,
        FaultKind::Delay(delay) => WireFaultKind::Delay(delay.into()),
        FaultKind::Truncate => WireFaultKind::Truncate,
        FaultKind::Babble => WireFaultKind::Babble,
        FaultKind::Disconnect => WireFaultKind::Disconnect,
        FaultKind::Freeze => WireFaultKind::Freeze,
        FaultKind::Scale(factor) => WireFaultKind::Scale(factor as f32),
    }
}

fn wire_fault(fault: &Fault, seed: u64) -> WireFault {
    WireFault {
        kind: wire_fault_kind(fault.kind),
        from: fault.from.into(),
        until: fault.until.map(Duration::from),
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
