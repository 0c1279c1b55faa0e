//! Records bench, rig, plan, inputs and firmware at the start of a session, and checks that a
//! resumed session has the same ones.

use crate::acceptance::config::SessionConfig;
use crate::acceptance::decision::today;
use crate::acceptance::error::AcceptError;
use crate::acceptance::session_record::{BenchRecord, ClockRecord, FORMAT, FirmwareRecord, PLAN, STEPS, SessionRecord};
use crate::acceptance::steps::step_records;
use platebench_engine::{Clock, Pacing};
use platebench_model::record::{
    self as record, Firmware, Host, InputRecord, Tool, Verdict, sha256, sha256_of_file, utc_timestamp,
};
use platebench_model::trace::AtPath;
use platebench_rig::{BUILT_IN_IMAGE, FirmwareImage, RigSpec};
use std::fs;
use std::path::Path;

pub(crate) fn new_session_record(config: &SessionConfig) -> Result<SessionRecord, AcceptError> {
    let SessionConfig { plan, rig, clock, details, .. } = config;
    let inputs = plan.scenarios.iter().flat_map(|planned| {
        let scenario = &planned.scenario;
        scenario.inputs.iter().enumerate().map(move |(number, input)| {
            let name = input.path.file_name().unwrap_or_default().to_string_lossy();
            let file = if number == 0 { scenario.file.clone() } else { format!("{}: {name}", scenario.file) };
            InputRecord { file, sha256: sha256(&input.bytes) }
        })
    });
    let (time_scale, pacing) = match clock {
        Clock::Lockstep { .. } => (1.0, "bench"),
        Clock::RealPlate => (1.0, "target"),
        Clock::RealTime(pace) => (pace.time_scale, if pace.pacing == Pacing::Target { "target" } else { "bench" }),
    };
    Ok(SessionRecord {
        format: FORMAT,
        verdict: Verdict::Inconclusive,
        complete: false,
        title: plan.title.clone(),
        details: details.clone(),
        started: utc_timestamp(),
        finished: None,
        resumed: Vec::new(),
        bench: bench_record()?,
        rig: rig.to_string(),
        clock: ClockRecord { name: clock.kind().to_string(), time_scale, pacing: pacing.to_owned() },
        firmware: None,
        plan: InputRecord { file: PLAN.to_owned(), sha256: sha256(&plan.bytes) },
        decision: plan
            .decision
            .as_ref()
            .map(|decision| decision.record(today(), &config.waived_calibrations))
            .transpose()?,
        inputs: inputs.collect(),
        steps: step_records(plan),
        requirements: Vec::new(),
        signature: None,
    })
}

fn bench_record() -> Result<BenchRecord, AcceptError> {
    // `/proc/self/exe` is the running program, even if its file was replaced after the start.
    let running = fs::read("/proc/self/exe").or_else(|_| std::env::current_exe().and_then(fs::read));
    let program = running.at(Path::new("the program of the bench"))?;
    Ok(BenchRecord { tool: Tool::running(), sha256: sha256(&program), host: Host::current() })
}

/// Returns the SHA-256 of the image that the bench loads. `None` if it loads no image.
pub(crate) fn image_sha256(rig: &RigSpec) -> Result<Option<String>, AcceptError> {
    Ok(match &rig.properties().image {
        FirmwareImage::None => None,
        FirmwareImage::BuiltIn => Some(sha256(BUILT_IN_IMAGE)),
        FirmwareImage::File(elf) => Some(sha256_of_file(elf).at(elf)?),
    })
}

pub(crate) fn check_run_hashes(folder: &Path, record: &SessionRecord) -> Result<(), AcceptError> {
    for step in record.steps.iter().filter(|step| step.done) {
        if let Some(then) = &step.run_sha256 {
            let now = run_sha256(&folder.join(STEPS).join(&step.id))?;
            if now != *then {
                return Err(changed_error(&format!("{STEPS}/{}/{}", step.id, record::RECORD_FILE), then, &now));
            }
        }
    }
    Ok(())
}

pub(crate) fn run_sha256(folder: &Path) -> Result<String, AcceptError> {
    let path = folder.join(record::RECORD_FILE);
    Ok(sha256_of_file(&path).at(&path)?)
}

pub(crate) fn changed_error(what: &str, then: &str, now: &str) -> AcceptError {
    AcceptError::Changed { what: what.to_owned(), then: then.to_owned(), now: now.to_owned() }
}

pub(crate) fn format_firmware(firmware: &Firmware) -> String {
    let Firmware { name, version, build, chip } = firmware;
    format!("{name} {version}, build {build}, chip {chip}")
}

pub(crate) fn check_unchanged(then: &SessionRecord, now: &SessionRecord) -> Result<(), AcceptError> {
    let bench = |record: &SessionRecord| format!("{} {}", record.bench.tool.version, record.bench.sha256);
    let clock = |record: &SessionRecord| {
        let ClockRecord { name, time_scale, pacing } = &record.clock;
        format!("{name}, time scale {time_scale}, paced by {pacing}")
    };
    let budget = |record: &SessionRecord| {
        record.decision.as_ref().map_or_else(|| "none".to_owned(), |decision| decision.budget.sha256.clone())
    };
    let waived = |record: &SessionRecord| {
        let instruments = record.decision.iter().flat_map(|decision| &decision.instruments);
        instruments.filter(|each| each.waived).map(|each| each.name.clone()).collect::<Vec<_>>().join(", ")
    };
    let pairs = [
        ("the bench", bench(then), bench(now)),
        ("the plan", then.plan.sha256.clone(), now.plan.sha256.clone()),
        ("the uncertainty budget", budget(then), budget(now)),
        ("the list of waived calibrations", waived(then), waived(now)),
        ("the rig", then.rig.clone(), now.rig.clone()),
        ("the clock", clock(then), clock(now)),
    ];
    for (what, then, now) in &pairs {
        if then != now {
            return Err(changed_error(what, then, now));
        }
    }
    let names = |record: &SessionRecord| record.inputs.iter().map(|input| input.file.clone()).collect::<Vec<_>>();
    if names(then) != names(now) {
        return Err(changed_error("the list of scenarios and plates", &names(then).join(", "), &names(now).join(", ")));
    }
    for (then, now) in then.inputs.iter().zip(&now.inputs) {
        if then.sha256 != now.sha256 {
            return Err(changed_error(&then.file, &then.sha256, &now.sha256));
        }
    }
    Ok(())
}

pub(crate) fn check_same_firmware(then: Option<&FirmwareRecord>, now: &FirmwareRecord) -> Result<(), AcceptError> {
    let describe = |record: &FirmwareRecord| {
        let image = record.image_sha256.as_deref().unwrap_or("none");
        format!("{}, number {}, image {image}", format_firmware(&record.firmware), record.unique)
    };
    match then {
        Some(then) if then != now => Err(changed_error("the firmware", &describe(then), &describe(now))),
        _ => Ok(()),
    }
}
