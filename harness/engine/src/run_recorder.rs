//! Builds the record of a run, and adds the results of its trials: journal, record and events.

use crate::firmware_digest::FirmwareDigest;
use crate::plan::{RigSession, RunError, RunPlan};
use platebench_model::record::{
    Event, Firmware, FolderError, Host, InputRecord, RigRecord, RunFolder, RunRecord, ScenarioRecord, Tool,
    TrialJournal, TrialRecord, Verdict, to_hex,
};
use platebench_model::scenario::Scenario;
use platebench_model::trace::{AtPath as _, Row};
use platebench_rig::RigSpec;
use platebench_verdict::Judgement;
use platebench_wire::Identity;
use serde::Deserialize;
use std::collections::BTreeMap;

/// Workers share it. Each result is in the journal before its event is returned.
pub(crate) struct RunRecorder {
    pub(crate) record: RunRecord,
    pub(crate) journal: TrialJournal,
}

impl RunRecorder {
    /// `number` is the index of the scenario. The rows are empty unless the report draws the trial.
    pub(crate) fn add_trial(
        &mut self,
        number: usize,
        trial: TrialRecord,
        rows: Vec<Row>,
    ) -> Result<Option<Event>, RunError> {
        let Some(scenario) = self.record.scenarios.get(number) else { return Ok(None) };
        self.journal.append(number, scenario, &self.record.rig, &trial).map_err(FolderError::from)?;
        Ok(Some(Event::TrialFinished { scenario: scenario.file.clone(), trial: Box::new(trial), rows }))
    }

    /// `time_limit_s` is the limit that ended the trials.
    pub(crate) fn finish_scenario(
        &mut self,
        number: usize,
        scenario: &Scenario,
        judgement: Judgement,
        mut trials: Vec<TrialRecord>,
        time_limit_s: Option<f64>,
    ) -> Option<Event> {
        let record = self.record.scenarios.get_mut(number)?;
        let judgement = judgement.with_bench_errors(scenario);
        trials.sort_by_key(|trial| trial.index);
        (record.verdict, record.expectations) = (judgement.verdict, judgement.expectations);
        (record.trials, record.time_limit_s) = (trials, time_limit_s);
        // `--fail-fast` may leave a scenario without a trial, which has neither started nor ended.
        (!record.trials.is_empty() || time_limit_s.is_some()).then(|| Event::scenario_finished(record))
    }

    pub(crate) fn write(&self, folder: &RunFolder) -> Result<(), FolderError> {
        Ok(self.record.write(folder.path()).at(folder.path())?)
    }
}

pub(crate) fn empty_record(scenario: &Scenario, inputs: Vec<InputRecord>) -> ScenarioRecord {
    ScenarioRecord {
        file: scenario.file.clone(),
        title: scenario.title.clone(),
        source: scenario.source.clone(),
        tags: scenario.tags.clone(),
        verdict: Verdict::Inconclusive,
        law: scenario.controller.law.clone(),
        model: scenario.model.name().to_owned(),
        period_ms: Some(scenario.controller.period.seconds() * 1e3),
        inputs,
        expectations: Vec::new(),
        not_applicable: scenario.not_applicable.clone(),
        requirement_texts: scenario.requirement_texts.clone(),
        time_limit_s: None,
        planned_trials: Some(scenario.trials.count),
        trials: Vec::new(),
    }
}

/// Lists the images of the bench's own firmware. `ci/firmware --update` writes this file.
const IMAGE_MANIFEST: &str = include_str!("../../../firmware-under-test/images/manifest.toml");

#[derive(Deserialize)]
struct ImageManifest {
    source_hash: String,
    images: BTreeMap<String, ImageEntry>,
}

#[derive(Deserialize)]
struct ImageEntry {
    sha256: String,
}

/// A copy of an image with other bytes is not the bench's own, although its identity is the same.
/// For a controller without a readable image, the build in its identity decides.
fn is_bench_firmware(rig: &str, identity: &Identity, firmware: &FirmwareDigest) -> bool {
    let Ok(manifest) = toml::from_str::<ImageManifest>(IMAGE_MANIFEST) else { return false };
    if [RigSpec::hosted(), RigSpec::emulated(None)].iter().any(|own| own.to_string() == rig) {
        return true;
    }
    let has_image = rig.parse::<RigSpec>().is_ok_and(|rig| rig.image().is_some());
    if let Some(digest) = firmware.sha256().filter(|_| has_image) {
        return manifest.images.values().any(|image| image.sha256 == digest);
    }
    manifest.source_hash.starts_with(&to_hex(&identity.build)) && identity.name.starts_with(b"platebench-")
}

pub(crate) fn rig_record(plan: &RunPlan, session: &RigSession, firmware: &FirmwareDigest) -> RigRecord {
    let identity = session.identity();
    let [major, minor, patch] = identity.version;
    RigRecord {
        name: plan.rig.clone(),
        firmware: Some(Firmware {
            name: session.firmware_name(),
            version: format!("{major}.{minor}.{patch}"),
            build: to_hex(&identity.build),
            chip: format!("{:#010x}", identity.chip),
        }),
        program_sha256: firmware.sha256().map(str::to_owned),
        bench_firmware: is_bench_firmware(&plan.rig, identity, firmware),
    }
}

pub(crate) fn initial_record<'a>(
    plan: &RunPlan,
    folder: &RunFolder,
    rig: RigRecord,
    scenarios: impl Iterator<Item = (&'a Scenario, Vec<InputRecord>)>,
    journal: &TrialJournal,
) -> RunRecord {
    RunRecord {
        format: platebench_model::record::FORMAT,
        sequence: folder.sequence(),
        verdict: Verdict::Inconclusive,
        complete: false,
        tool: Tool::running(),
        started: folder.started(),
        rig,
        clock: plan.clock.kind(),
        overrides: plan.overrides.clone(),
        safe_confirmed: None,
        drive_after_safe: false,
        wall_ms: None,
        host: Host::current(),
        scenarios: scenarios.map(|(scenario, inputs)| empty_record(scenario, inputs)).collect(),
        not_applicable: Vec::new(),
        cost: Vec::new(),
        merge: None,
        journal: Some(journal.started()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rstest::rstest;

    #[rstest]
    #[case::hosted("hosted", *b"platebench-host\0", "", true)]
    #[case::built_in_image("emulated", *b"platebench-f4\0\0\0", "0000000000000000", true)]
    #[case::own_build("exec:controller {port}", *b"platebench-host\0", "", true)]
    #[case::changed_copy("emulated:a.elf", *b"platebench-f4\0\0\0", "0000000000000000", false)]
    #[case::other_name("emulated:a.elf", *b"starter-c\0\0\0\0\0\0\0", "", false)]
    fn recognises_the_firmware_of_the_bench(
        #[case] rig: &str,
        #[case] name: [u8; 16],
        #[case] build: &str,
        #[case] is_own: bool,
    ) {
        let images: ImageManifest = toml::from_str(IMAGE_MANIFEST).unwrap();
        let digits = if build.is_empty() { &images.source_hash[..16] } else { build };
        let build = u64::from_str_radix(digits, 16).unwrap().to_be_bytes();
        let identity = Identity { version: [0; 3], capabilities: 0, laws: 0, build, chip: 0, unique: [0; 12], name };
        assert_eq!(is_bench_firmware(rig, &identity, &FirmwareDigest::of_rig(rig)), is_own);
    }

    #[test]
    fn a_patched_image_is_not_the_bench_firmware() {
        let images: ImageManifest = toml::from_str(IMAGE_MANIFEST).unwrap();
        let build = u64::from_str_radix(&images.source_hash[..16], 16).unwrap().to_be_bytes();
        let name = *b"platebench-f4\0\0\0";
        let identity = Identity { version: [0; 3], capabilities: 0, laws: 0, build, chip: 0, unique: [0; 12], name };
        let folder = tempfile::tempdir().unwrap();
        let elf = folder.path().join("a.elf");
        let rig = RigSpec::emulated(Some(elf.clone())).to_string();
        let mut bytes = platebench_rig::BUILT_IN_IMAGE.to_vec();
        std::fs::write(&elf, &bytes).unwrap();
        assert!(is_bench_firmware(&rig, &identity, &FirmwareDigest::of_rig(&rig)));
        *bytes.last_mut().unwrap() ^= 1;
        std::fs::write(&elf, &bytes).unwrap();
        assert!(!is_bench_firmware(&rig, &identity, &FirmwareDigest::of_rig(&rig)));
    }
}
