//! Plans a campaign: pins every input, the firmware and the bench.

use crate::campaign::{Campaign, Method};
use crate::error::CampaignError;
use platebench_record::{sha256, sha256_of_file, to_hex};
use platebench_rig::{EmulatedLink, FaultInjector, RigSpec, Session, printable_name};
use platebench_trace::{read_text_file, write_atomically};
use serde::{Deserialize, Serialize};
use std::fs;
use std::ops::Range;
use std::path::{Path, PathBuf};

pub const PLAN_FILE: &str = "plan.json";
const PARTS: &str = "parts";
const FORMAT: u32 = 1;
const MAX_PLAN_BYTES: u64 = 1 << 20;
pub const MAX_SHARDS: u32 = 1_000_000;

/// `plan.json`
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Plan {
    format: u32,
    pub title: String,
    pub campaign: PathBuf,
    pub method: Method,
    /// In all.
    pub trials: u64,
    pub shards: u32,
    pub rig: String,
    /// SHA-256 of the program that planned.
    bench: String,
    /// SHA-256 of the firmware image, or of the controller's identity and program.
    firmware: String,
    inputs: Vec<PinnedInput>,
    /// SHA-256 of this file with an empty text here.
    pub sha256: String,
}

#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct PinnedInput {
    path: PathBuf,
    sha256: String,
}

impl Plan {
    pub fn new(campaign: &Campaign, rig: &RigSpec, shards: u32) -> Result<Self, CampaignError> {
        let absolute = |path: &Path| std::path::absolute(path).unwrap_or_else(|_| path.to_owned());
        let own = PinnedInput { path: absolute(&campaign.path), sha256: sha256(campaign.text.as_bytes()) };
        let of_scenario = campaign.template.inputs().iter();
        let of_scenario =
            of_scenario.map(|input| PinnedInput { path: absolute(&input.path), sha256: sha256(&input.bytes) });
        let mut plan = Self {
            format: FORMAT,
            title: campaign.title.clone(),
            campaign: own.path.clone(),
            method: campaign.method,
            trials: campaign.trials,
            shards,
            rig: rig.to_string(),
            bench: bench_digest()?,
            firmware: firmware_digest(rig)?,
            inputs: std::iter::once(own).chain(of_scenario).collect(),
            sha256: String::new(),
        };
        plan.sha256 = plan.digest();
        Ok(plan)
    }

    fn text(&self) -> String {
        format!("{}\n", serde_json::to_string_pretty(self).unwrap_or_default())
    }

    fn digest(&self) -> String {
        sha256(Self { sha256: String::new(), ..self.clone() }.text().as_bytes())
    }

    /// Writes the plan, unless the folder has it. Fails if the folder has another one.
    pub fn write(&self, folder: &Path) -> Result<(), CampaignError> {
        let path = folder.join(PLAN_FILE);
        match Self::read(folder) {
            Ok(planned) if planned == *self => return Ok(()),
            Ok(_) => return Err(CampaignError::OtherPlan(path)),
            Err(CampaignError::NoPlan(_)) => {}
            Err(error) => return Err(error),
        }
        let parts = folder.join(PARTS);
        fs::create_dir_all(&parts).map_err(CampaignError::io(&parts))?;
        write_atomically(&path, self.text().as_bytes()).map_err(CampaignError::io(&path))
    }

    pub fn exists(folder: &Path) -> bool {
        folder.join(PLAN_FILE).exists()
    }

    pub fn read(folder: &Path) -> Result<Self, CampaignError> {
        let path = folder.join(PLAN_FILE);
        if !Self::exists(folder) {
            return Err(CampaignError::NoPlan(folder.to_owned()));
        }
        let text = read_text_file(&path, MAX_PLAN_BYTES).map_err(CampaignError::io(&path))?;
        let plan: Result<Self, _> = serde_json::from_str(&text);
        let damaged = |why| CampaignError::Damaged { path: path.clone(), why };
        let plan = plan.map_err(|_| damaged("not a plan of this version"))?;
        if plan.digest() != plan.sha256 || plan.text() != text {
            return Err(damaged("its checksum does not hold"));
        }
        let is_known = plan.format == FORMAT && (1..=MAX_SHARDS).contains(&plan.shards);
        if is_known { Ok(plan) } else { Err(damaged("not a plan of this version")) }
    }

    /// Reads the plan and the campaign. Fails if an input has changed since.
    pub fn open(folder: &Path) -> Result<(Self, Campaign), CampaignError> {
        let plan = Self::read(folder)?;
        for input in &plan.inputs {
            let digest = sha256_of_file(&input.path).map_err(CampaignError::io(&input.path))?;
            if digest != input.sha256 {
                return Err(CampaignError::ChangedInput(input.path.clone()));
            }
        }
        let campaign = Campaign::load(&plan.campaign).map_err(CampaignError::Files)?;
        Ok((plan, campaign))
    }

    /// Fails if this program or the firmware is not the planned one.
    pub fn check_bench(&self, rig: &RigSpec) -> Result<(), CampaignError> {
        let bench = bench_digest()?;
        if bench != self.bench {
            return Err(CampaignError::OtherBench { found: bench, planned: self.bench.clone() });
        }
        let firmware = firmware_digest(rig)?;
        if firmware != self.firmware {
            let (rig, planned) = (rig.to_string(), self.firmware.clone());
            return Err(CampaignError::OtherFirmware { rig, found: firmware, planned });
        }
        Ok(())
    }

    /// Trials of a shard, which is counted from 1.
    pub fn trials_of(&self, shard: u32) -> Range<u64> {
        let start = |shard: u32| {
            let trials = u128::from(self.trials) * u128::from(shard) / u128::from(self.shards);
            u64::try_from(trials).unwrap_or(self.trials)
        };
        start(shard.saturating_sub(1))..start(shard)
    }

    pub fn part_path(&self, folder: &Path, shard: u32) -> PathBuf {
        folder.join(PARTS).join(format!("{shard}.parquet"))
    }
}

fn bench_digest() -> Result<String, CampaignError> {
    let path = std::env::current_exe().map_err(CampaignError::io("the bench's own program"))?;
    sha256_of_file(&path).map_err(CampaignError::io(&path))
}

fn firmware_digest(rig: &RigSpec) -> Result<String, CampaignError> {
    let read = |path: &Path| fs::read(path).map_err(CampaignError::io(path));
    let content = match rig {
        RigSpec::Emulated(None) => EmulatedLink::built_in_image().to_vec(),
        RigSpec::Emulated(Some(path)) => read(path)?,
        RigSpec::Hosted
        | RigSpec::Serial { .. }
        | RigSpec::Tcp(_)
        | RigSpec::Rfc2217 { .. }
        | RigSpec::Probe { .. } => identity(rig)?.into_bytes(),
        RigSpec::Exec(command) => {
            let mut content = identity(rig)?.into_bytes();
            for word in shlex::split(command).unwrap_or_default() {
                let path = PathBuf::from(word);
                if path.is_file() {
                    content.extend(read(&path)?);
                }
            }
            content
        }
    };
    Ok(sha256(&content))
}

fn identity(rig: &RigSpec) -> Result<String, CampaignError> {
    let session = Session::open(FaultInjector::new(rig.connect()?))?;
    let identity = *session.identity();
    session.close();
    let name = printable_name(&identity);
    Ok(format!("{name} {:?} {}", identity.version, to_hex(&identity.build)))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn plan(trials: u64, shards: u32) -> Plan {
        Plan {
            format: FORMAT,
            title: String::new(),
            campaign: PathBuf::new(),
            method: Method::Random,
            trials,
            shards,
            rig: "hosted".to_owned(),
            bench: String::new(),
            firmware: String::new(),
            inputs: Vec::new(),
            sha256: String::new(),
        }
    }

    #[test]
    fn shards_contain_every_trial_once() {
        for (trials, shards) in [(10, 1), (10, 7), (3, 64), (1_000_003, 64), (10_000_000_000, 1_000)] {
            let plan = plan(trials, shards);
            let ends = (1..=shards).fold(0, |before, shard| {
                let range = plan.trials_of(shard);
                assert_eq!(range.start, before);
                range.end
            });
            assert_eq!(ends, trials);
        }
    }
}
