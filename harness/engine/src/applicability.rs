//! Decides whether a controller and its rig can play a scenario. Every command uses these rules.

use crate::trial::{self, chip_fault_plan};
use platebench_model::scenario::{Diagnostic, Metric, OWN_LAW, Scenario};
use platebench_plate::Time;
use platebench_rig::{ChipFaultError, FaultInjector, Link, LinkKind, Session, is_defined_law};
use platebench_wire::{Identity, LawId, capabilities};

/// Returns why the scenario is not applicable; `None` if the controller can play it with `law`. Fails
/// if the firmware lacks the target of a chip fault.
pub fn why_not_applicable<L: Link>(
    scenario: &Scenario,
    law: LawId,
    is_lockstep: bool,
    session: &mut Session<FaultInjector<L>>,
) -> Result<Option<String>, Box<Diagnostic>> {
    let identity = *session.identity();
    let others = scenario.between.iter().chain(scenario.other_trials.as_deref());
    let mut others = others.filter_map(|scene| Some((scene, trial::law(scene).ok()?)));
    let is_compared = scenario.expects(Metric::ReferenceDifference) || scenario.expects(Metric::ProtocolDifferences);
    Ok((is_compared && !is_lockstep)
        .then(|| "the metrics that compare the controller with the reference need the clock lockstep".to_owned())
        .or_else(|| missing_new_controller(scenario, session.link().kind()))
        .or(missing_chip_faults(scenario, is_lockstep, session)?)
        .or_else(|| missing_chip(scenario, is_lockstep, session))
        .or_else(|| only_describes_bench_law(scenario))
        .or_else(|| undefined_commands(scenario, law))
        .or_else(|| missing_capability(scenario, law, &identity))
        .or_else(|| others.find_map(|(scene, law)| missing_capability(scene, law, &identity))))
}

/// Returns why the rig cannot start a new controller, if the scenario needs one.
fn missing_new_controller(scenario: &Scenario, kind: LinkKind) -> Option<String> {
    (scenario.needs_new_controller() && kind.loses_bytes())
        .then(|| "messages before the first configuration need a rig that can start a new controller".to_owned())
}

/// Returns why the rig cannot apply the chip faults. Fails if the firmware lacks a fault's target.
fn missing_chip_faults<L: Link>(
    scenario: &Scenario,
    is_lockstep: bool,
    session: &mut Session<FaultInjector<L>>,
) -> Result<Option<String>, Box<Diagnostic>> {
    let faults = chip_fault_plan(scenario, 0);
    if faults.faults.is_empty() {
        return Ok(None);
    }
    let checked =
        if is_lockstep { session.link_mut().set_chip_faults(&faults) } else { Err(ChipFaultError::Unsupported) };
    match checked {
        Ok(()) => Ok(None),
        Err(error @ ChipFaultError::Unsupported) => Ok(Some(error.to_string())),
        Err(error) => Err(Box::new(scenario.diagnostic("fault", error.to_string()))),
    }
}

/// Metrics that only an emulated chip reports.
const OF_THE_CHIP: [Metric; 3] = [Metric::StepTime, Metric::EnableOff, Metric::Text];

/// Returns why the rig cannot measure a metric of the chip, if the scenario expects it.
fn missing_chip<L: Link>(
    scenario: &Scenario,
    is_lockstep: bool,
    session: &mut Session<FaultInjector<L>>,
) -> Option<String> {
    // The handshake was an exchange, so a rig that measures has a value.
    let mut measures = || session.link_mut().chip().is_some_and(|chip| chip.computing_time().is_some());
    let is_measured = is_lockstep && measures();
    let expected = OF_THE_CHIP.into_iter().find(|metric| scenario.expects(*metric));
    if let Some(metric) = expected.filter(|_| !is_measured) {
        return Some(format!("{metric} needs the emulated chip and the clock lockstep"));
    }
    let mut has_text = || session.link_mut().chip().is_some_and(|chip| chip.firmware_output_reads().is_some());
    let is_missing = scenario.expects(Metric::Text) && !has_text();
    is_missing.then(|| {
        format!("{} needs firmware that writes text by RTT: the variable _SEGGER_RTT, without defmt", Metric::Text)
    })
}

/// Returns why no expectation of the scenario applies to the controller's own law.
pub(crate) fn only_describes_bench_law(scenario: &Scenario) -> Option<String> {
    let first = scenario.not_applicable.first().filter(|_| scenario.expectations.is_empty())?;
    Some(first.reason.clone())
}

/// Returns why the commands of the law cannot be compared, if the scenario compares them.
fn undefined_commands(scenario: &Scenario, law: LawId) -> Option<String> {
    let is_compared = scenario.expects(Metric::ReferenceDifference) && !scenario.has_own_law();
    (is_compared && !is_defined_law(law))
        .then(|| format!("the page of the wire protocol does not define the commands of {}", law.name()))
}

pub(crate) fn missing_capability(scenario: &Scenario, law: LawId, identity: &Identity) -> Option<String> {
    if !scenario.has_own_law() && !identity.has_law(law) {
        return Some(missing_law(law, identity));
    }
    let needs_delay = scenario.controller.design_delay != Time::ZERO;
    (needs_delay && !identity.has_capability(capabilities::LOOP_DELAY))
        .then(|| "the controller does not announce that it accepts a loop delay (design_delay_ms)".to_owned())
}

/// Names the option or the change that makes the scenario applicable.
fn missing_law(law: LawId, identity: &Identity) -> String {
    let announced: Vec<_> = LawId::ALL
        .into_iter()
        .filter(|&law| identity.has_law(law))
        .map(|law| format!("--law {}", law.name()))
        .collect();
    let (missing, options) = (law.name(), announced.join(" or "));
    let own = format!("--law {OWN_LAW} judges the requirements only, for any algorithm");
    let remedy = if announced.is_empty() {
        format!("it announces none; {own}")
    } else {
        format!("{options} plays every scenario with a law that it announces; {own}")
    };
    format!("the controller does not announce the law {missing}; {remedy}")
}
