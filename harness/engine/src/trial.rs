//! Describes one trial, and translates its scenario into the configuration of the controller and
//! the faults of the rig.

use crate::live_tap::TapWriter;
use crate::plan::RunError;
use platebench_model::record::Telemetry;
use platebench_model::scenario::{ChipFault, ChipFaultKind, Diagnostic, OWN_LAW, Scenario, Variation, suggestion};
use platebench_model::trace::Row;
use platebench_plate::Time;
use platebench_rig::{CancelToken, ChipFaultPlan, DatedChipFault, FaultInjector, HostedLink, Link, RigError, Session};
use platebench_wire::{Configure, Gains, Identity, LawId};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng, SeedableRng};
use std::time::Duration;

/// The controller stops after this number of periods without a sample. After a chip fault, the
/// bench applies 0 V after this number of periods without a command.
pub(crate) const WATCHDOG_PERIODS: u64 = 5;
/// First random stream of chip faults. Noise, plate spread and faults of the line have lower ones.
const FIRST_CHIP_STREAM: u64 = 1 << 32;
/// Least time-out for an answer. A sample and its command take 0.5 ms at 1 Mbaud.
const MIN_CHIP_ANSWER_TIMEOUT: Duration = Duration::from_millis(1);

/// All that a trial loop receives besides the session.
#[derive(Debug)]
pub struct Trial<'a> {
    pub scenario: &'a Scenario,
    pub law: LawId,
    pub index: u32,
    /// True if the rig's wire time and computing time act as loop delay, in lockstep.
    pub wire_time: bool,
    /// True if the controller's clock runs while the plate waits.
    pub own_clock: bool,
    /// True if the protocol check plays its long scripts also with an own clock.
    pub long_scripts: bool,
    /// True if the target continues after the trial before it without a restart.
    pub continues: bool,
    pub cancel: CancelToken,
    /// Receives the rows for a live view.
    pub tap: Option<&'a mut TapWriter>,
}

impl<'a> Trial<'a> {
    pub fn new(scenario: &'a Scenario, law: LawId, index: u32) -> Self {
        let cancel = CancelToken::never();
        Self {
            scenario,
            law,
            index,
            wire_time: false,
            own_clock: false,
            long_scripts: false,
            continues: false,
            cancel,
            tap: None,
        }
    }
}

#[derive(Debug)]
pub struct TrialResult {
    pub trace_rows: Vec<Row>,
    pub telemetry: Telemetry,
    /// Error that ended the exchange with the controller. The rest of the trial has 0 V.
    pub link_error: Option<RigError>,
    /// True if the controller confirmed 0 V at the end of the trial.
    pub safe_confirmed: bool,
}

/// Why a replay, a trial in real time or a trial on a real plate ends early.
pub(crate) enum TrialAbort {
    Cancelled,
    Lost(RigError),
}

impl From<RigError> for TrialAbort {
    fn from(error: RigError) -> Self {
        Self::Lost(error)
    }
}

/// Names of the laws that a scenario or `--law` can have.
pub fn law_names() -> impl Iterator<Item = &'static str> {
    LawId::ALL.into_iter().map(LawId::name).chain([OWN_LAW])
}

/// Returns the number of the law. For an own law it is that of `dq-pi`, which the controller may
/// lack; `law_number` then has another one.
pub fn law(scenario: &Scenario) -> Result<LawId, Diagnostic> {
    let name = if scenario.has_own_law() { LawId::DqPi.name() } else { &scenario.controller.law };
    LawId::from_name(name).ok_or_else(|| {
        let known = law_names().map(|name| format!("`{name}`")).collect::<Vec<_>>().join(", ");
        let hint = suggestion(name, law_names());
        scenario.diagnostic("controller.law", format!("unknown law `{name}`, expected one of {known}{hint}"))
    })
}

/// Number in the configuration. An own law may have any number, so it is one that the controller
/// announces: `law` if possible, otherwise the lowest. It is 0 for a controller without numbers.
pub(crate) fn law_number(scenario: &Scenario, law: LawId, identity: &Identity) -> LawId {
    if !scenario.has_own_law() || identity.has_law(law) {
        return law;
    }
    LawId::ALL.into_iter().find(|&announced| identity.has_law(announced)).unwrap_or(LawId::OpenLoop)
}

/// Uses the nominal plate, because a controller does not know how a trial varies its plate.
pub fn configure(scenario: &Scenario, law: LawId) -> Configure {
    let controller = &scenario.controller;
    let plate = scenario.design_plate();
    Configure {
        law,
        paced_by_target: false,
        drives_own_plate: false,
        watchdog_timeout_ms: 0,
        period_us: controller.period.wrapping_micros(),
        loop_delay_us: controller.design_delay.wrapping_micros(),
        start_frequency_mhz: start_frequency_mhz(scenario),
        gain_um_per_vpp: plate.gain as f32,
        time_constant_s: (1.0 / plate.sigma0) as f32,
        response_time_s: controller.response_time_ms.map_or(0.0, |ms| (ms / 1e3) as f32),
        drive_limit_vpp: plate.drive_limit_vpp as f32,
        frequency_range_hz: controller.frequency_range_hz as f32,
        frequency_slew_hz: controller.frequency_slew_hz as f32,
        gains: controller.gains.map(|gains| Gains {
            amplitude_kp: gains.amplitude_kp as f32,
            amplitude_ki: gains.amplitude_ki as f32,
            frequency_kp: gains.frequency_kp as f32,
            frequency_ki: gains.frequency_ki as f32,
        }),
    }
}

/// Fails if the hosted reference refuses the configuration of the scenario. The scenario is then an
/// invalid input. If the reference accepts it, a refusal is the controller's failure.
pub(crate) fn check_configuration(scenario: &Scenario, law: LawId) -> Result<(), RunError> {
    let accepted =
        Session::open(HostedLink::new()).and_then(|mut reference| reference.start_trial(&configure(scenario, law)));
    accepted.map(drop).map_err(|error| RunError::Refused { file: scenario.file.clone(), error })
}

pub(crate) fn start_frequency_mhz(scenario: &Scenario) -> u32 {
    (scenario.controller.start_frequency_hz * 1e3).round() as u32
}

/// Call it before the configuration of the trial.
pub(crate) fn set_line_faults<L: Link>(link: &mut FaultInjector<L>, scenario: &Scenario, index: u32) {
    link.set_faults(&scenario.faults, Variation::of_trial(scenario, index).seed);
}

/// Draws instants and bits that the scenario does not state, from the seed of the trial.
pub(crate) fn chip_fault_plan(scenario: &Scenario, index: u32) -> ChipFaultPlan {
    let seed = Variation::of_trial(scenario, index).seed;
    let planned = (FIRST_CHIP_STREAM..).zip(&scenario.chip_faults);
    let mut faults: Vec<_> =
        planned.map(|(stream, fault)| chip_fault(fault, seed, stream, scenario.duration)).collect();
    faults.sort_by_key(|fault| fault.at);
    ChipFaultPlan { faults, answer_timeout: Duration::from(scenario.controller.period).max(MIN_CHIP_ANSWER_TIMEOUT) }
}

fn chip_fault(fault: &ChipFault, seed: u64, stream: u64, duration: Time) -> DatedChipFault {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    random.set_stream(stream);
    let (instant, draw) = (random.next_u64(), random.next_u64());
    let at = fault.at.map_or_else(|| Duration::from_nanos(instant % duration.as_nanos().max(1)), Duration::from);
    let draw = match fault.kind {
        ChipFaultKind::BitFlip { bit: Some(bit), .. } => bit.into(),
        _ => draw,
    };
    DatedChipFault { at, kind: fault.kind.clone(), draw }
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

/// True if the fault that stopped the controller is over and requests a new configuration.
pub(crate) fn needs_reconfiguration(scenario: &Scenario, stopped: Time, now: Time) -> bool {
    let period = scenario.controller.period;
    scenario.faults.iter().any(|fault| {
        fault.reconfigure && fault.can_explain(stopped, period) && fault.until.is_some_and(|until| until <= now)
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::applicability::missing_capability;
    use platebench_test_kit::load_scenario;
    use platebench_wire::capabilities;
    use rstest::rstest;

    fn identity(capabilities: u8, laws: u32) -> Identity {
        Identity { version: [0; 3], capabilities, laws, build: [0; 8], chip: 0, unique: [0; 12], name: [0; 16] }
    }

    #[test]
    fn names_the_law_or_capability_that_is_missing() {
        let mut scenario = load_scenario("paper/fig13-closed-loop.toml");
        let missing = |scenario: &Scenario, identity| missing_capability(scenario, LawId::DqPi, &identity);
        assert_eq!(missing(&scenario, identity(0, u32::MAX)), None);
        let reason = missing(&scenario, identity(0, 1 << LawId::OpenLoop as u8)).unwrap();
        assert_eq!(
            reason,
            "the controller does not announce the law dq-pi; --law open-loop plays every scenario with a law that it \
             announces; --law own judges the requirements only, for any algorithm"
        );
        let reason = missing(&scenario, identity(0, 1 << LawId::Pll as u8 | 1 << LawId::OpenLoop as u8)).unwrap();
        assert!(reason.contains("; --law open-loop or --law pll plays every scenario"), "{reason}");
        let reason = missing(&scenario, identity(0, 0)).unwrap();
        assert!(reason.contains("; it announces none; --law own judges the requirements"), "{reason}");
        // `loop_delay` is the simulated delay. The controller gets only `design_delay`.
        scenario.controller.loop_delay = Time::from_nanos(700_000);
        assert_eq!(configure(&scenario, LawId::DqPi).loop_delay_us, 0);
        assert_eq!(missing(&scenario, identity(0, u32::MAX)), None);
        scenario.controller.design_delay = Time::from_nanos(400_000);
        assert_eq!(configure(&scenario, LawId::DqPi).loop_delay_us, 400);
        assert_eq!(missing(&scenario, identity(capabilities::LOOP_DELAY, u32::MAX)), None);
        let reason = missing(&scenario, identity(!capabilities::LOOP_DELAY, u32::MAX)).unwrap();
        assert!(reason.contains("design_delay_ms"), "{reason}");
        scenario.controller.design_delay = Time::ZERO;
        scenario.set_law(OWN_LAW);
        assert_eq!(missing(&scenario, identity(0, 0)), None);
    }

    #[rstest]
    #[case::named("deadbeat", 0b10, LawId::Deadbeat)]
    #[case::announces_dq_pi(OWN_LAW, 0b11, LawId::DqPi)]
    #[case::announces_others(OWN_LAW, 1 << 8 | 1 << 6, LawId::Pll)]
    #[case::announces_none(OWN_LAW, 0, LawId::OpenLoop)]
    #[case::announces_an_unknown_one(OWN_LAW, 1 << 31, LawId::OpenLoop)]
    fn configures_an_announced_number_for_an_own_law(#[case] name: &str, #[case] laws: u32, #[case] expected: LawId) {
        let mut scenario = load_scenario("paper/fig13-closed-loop.toml");
        scenario.set_law(name);
        assert_eq!(law_number(&scenario, law(&scenario).unwrap(), &identity(0, laws)), expected);
    }
}
