//! Divides a campaign into shards and records the SHA-256 of inputs, firmware and bench program.

use crate::campaign::definition::{Campaign, Method};
use crate::campaign::error::CampaignError;
use crate::campaign::truncation::Truncation;
use platebench_engine::RunError;
use platebench_model::record::{
    CAMPAIGN_PLAN_FILE as PLAN_FILE, FolderError, RECORD_FILE, sha256, sha256_of_file, to_hex,
};
use platebench_model::trace::{AtPath, MAX_IMAGE_BYTES, OutputFolder, read_regular_file, read_text_file};
use platebench_rig::{BUILT_IN_IMAGE, FaultInjector, FirmwareImage, RigSpec, Session, printable_name};
use serde::{Deserialize, Serialize};
use std::io;
use std::ops::Range;
use std::path::{Component, Path, PathBuf};

pub(crate) const PARTS: &str = "parts";
const FORMAT: u32 = 1;
const MAX_PLAN_BYTES: u64 = 1 << 20;
pub const MAX_SHARDS: u32 = 1_000_000;
/// Small, because an interrupted machine repeats a whole shard.
const TRIALS_PER_SHARD: u64 = 2_000;
/// Several, because the cores of a machine play the chains of a shard at the same time.
const CHAINS_PER_SHARD: u64 = 8;
const MAX_RUN_SHARDS: u64 = 1_000;

/// Number of shards if one machine plays the whole campaign.
pub fn shards_of_run(campaign: &Campaign) -> u32 {
    let chain = campaign.chain_trials();
    let size = if chain == 1 { TRIALS_PER_SHARD } else { CHAINS_PER_SHARD * chain };
    u32::try_from(campaign.trials.div_ceil(size).min(MAX_RUN_SHARDS)).unwrap_or(1)
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CampaignPlan {
    format: u32,
    pub title: String,
    /// Campaign file, relative to the campaign folder, as the paths of the inputs.
    campaign: PathBuf,
    pub method: Method,
    pub trials: u64,
    pub shards: u32,
    pub rig: String,
    /// SHA-256 of the platebench program that wrote the plan.
    bench: String,
    /// SHA-256 of the firmware image, or of the controller's identity and program.
    firmware: String,
    inputs: Vec<PinnedInput>,
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    truncated: Vec<Truncation>,
    /// SHA-256 of `plan.json`, computed while this field is an empty text.
    pub sha256: String,
}

#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct PinnedInput {
    path: PathBuf,
    sha256: String,
}

impl CampaignPlan {
    /// SHA-256 of the firmware image, or of the controller's identity and program.
    pub fn firmware(&self) -> &str {
        &self.firmware
    }

    /// True if both campaigns have the same file, scenario and plate, so that their trials have the
    /// same values and seeds.
    pub(crate) fn has_inputs_of(&self, other: &Self) -> bool {
        self.inputs.iter().map(|input| &input.sha256).eq(other.inputs.iter().map(|input| &input.sha256))
    }

    /// `folder` is the campaign folder, which need not exist.
    pub fn new(campaign: &Campaign, folder: &Path, rig: &RigSpec, shards: u32) -> Result<Self, CampaignError> {
        let relative = |path: &Path| relative_path(path, folder).at(path);
        let own = PinnedInput { path: relative(&campaign.path)?, sha256: sha256(campaign.text.as_bytes()) };
        let of_scenario = campaign.template.inputs().iter();
        let of_scenario = of_scenario
            .map(|input| Ok(PinnedInput { path: relative(&input.path)?, sha256: sha256(&input.bytes) }))
            .collect::<Result<Vec<_>, CampaignError>>()?;
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
            truncated: campaign.truncated.clone(),
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

    /// Does nothing if the folder contains this plan. Fails if the folder contains another plan or
    /// a run.
    pub fn write(&self, folder: &Path) -> Result<(), CampaignError> {
        let path = folder.join(PLAN_FILE);
        match Self::read(folder) {
            Ok(planned) if planned == *self => return Ok(()),
            Ok(_) => return Err(CampaignError::OtherPlan(path)),
            Err(CampaignError::NoPlan(_)) => {}
            Err(error) => return Err(error),
        }
        if folder.join(RECORD_FILE).exists() {
            return Err(FolderError::AlreadyUsed(folder.to_owned()).into());
        }
        let folder = OutputFolder::open(folder)?;
        folder.create_folder(PARTS)?;
        Ok(folder.write(PLAN_FILE, self.text())?)
    }

    pub fn exists(folder: &Path) -> bool {
        folder.join(PLAN_FILE).exists()
    }

    pub fn read(folder: &Path) -> Result<Self, CampaignError> {
        let path = folder.join(PLAN_FILE);
        if !Self::exists(folder) {
            return Err(CampaignError::NoPlan(folder.to_owned()));
        }
        let text = read_text_file(&path, MAX_PLAN_BYTES).at(&path)?;
        let plan: Result<Self, _> = serde_json::from_str(&text);
        let damaged = |why| CampaignError::Damaged { path: path.clone(), why };
        let plan = plan.map_err(|_| damaged("it is not a plan of this platebench version"))?;
        if plan.digest() != plan.sha256 || plan.text() != text {
            return Err(damaged("its SHA-256 does not match its content"));
        }
        let is_known = plan.format == FORMAT && (1..=MAX_SHARDS).contains(&plan.shards);
        if is_known { Ok(plan) } else { Err(damaged("it is not a plan of this platebench version")) }
    }

    /// Fails if an input has changed since the plan was written.
    pub fn open(folder: &Path) -> Result<(Self, Campaign), CampaignError> {
        let plan = Self::read(folder)?;
        for input in &plan.inputs {
            let path = folder.join(&input.path);
            let digest = sha256_of_file(&path).at(&path)?;
            if digest != input.sha256 {
                return Err(CampaignError::ChangedInput(path));
            }
        }
        let campaign = Campaign::load(&folder.join(&plan.campaign)).map_err(CampaignError::Files)?;
        Ok((plan, campaign))
    }

    /// Fails if this program or the firmware does not have the SHA-256 in the plan.
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

    /// Numbers of the trials of a shard, in whole chains. Shards count from 1.
    pub fn trials_of(&self, shard: u32) -> Range<u64> {
        let chain = self.method.chain_trials();
        let chains = self.trials.div_ceil(chain);
        let start = |shard: u32| {
            let before = u128::from(chains) * u128::from(shard) / u128::from(self.shards);
            u64::try_from(before).unwrap_or(chains).saturating_mul(chain).min(self.trials)
        };
        start(shard.saturating_sub(1))..start(shard)
    }

    pub fn part_path(&self, folder: &Path, shard: u32) -> PathBuf {
        folder.join(part_name(shard))
    }
}

/// Path of a part, relative to the campaign folder.
pub fn part_name(shard: u32) -> String {
    format!("{PARTS}/{shard}.parquet")
}

/// `folder` need not exist. Resolves links, because `..` after a link leads to another folder.
fn relative_path(path: &Path, folder: &Path) -> io::Result<PathBuf> {
    let path = path.canonicalize()?;
    let existing = std::path::absolute(folder)?;
    let existing = existing.ancestors().find(|above| above.exists()).unwrap_or(Path::new("/"));
    let rest = std::path::absolute(folder)?.strip_prefix(existing).map(Path::to_owned).unwrap_or_default();
    let folder = existing.canonicalize()?.join(rest);
    let shared = path.components().zip(folder.components()).take_while(|(one, other)| one == other).count();
    let up = folder.components().skip(shared).map(|_| Component::ParentDir);
    Ok(up.chain(path.components().skip(shared)).collect())
}

fn bench_digest() -> Result<String, CampaignError> {
    let path = std::env::current_exe().at(Path::new("the bench's own program"))?;
    Ok(sha256_of_file(&path).at(&path)?)
}

pub(crate) fn firmware_digest(rig: &RigSpec) -> Result<String, CampaignError> {
    let read = |path: &Path| read_regular_file(path, MAX_IMAGE_BYTES).at(path);
    let content = match &rig.properties().image {
        FirmwareImage::BuiltIn if rig.is_simulated() => BUILT_IN_IMAGE.to_vec(),
        FirmwareImage::File(path) if rig.is_simulated() => read(path)?,
        _ => {
            let mut content = identity(rig)?.into_bytes();
            for path in rig.properties().command.iter().map(Path::new).filter(|path| path.is_file()) {
                content.extend(read(path)?);
            }
            content
        }
    };
    Ok(sha256(&content))
}

fn identity(rig: &RigSpec) -> Result<String, CampaignError> {
    let session = Session::open(FaultInjector::new(rig.connect()?)).map_err(RunError::from)?;
    let identity = *session.identity();
    session.close();
    let name = printable_name(&identity);
    Ok(format!("{name} {:?} {}", identity.version, to_hex(&identity.build)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs;

    fn plan(method: Method, trials: u64, shards: u32) -> CampaignPlan {
        CampaignPlan {
            format: FORMAT,
            title: String::new(),
            campaign: PathBuf::new(),
            method,
            trials,
            shards,
            rig: "hosted".to_owned(),
            bench: String::new(),
            firmware: String::new(),
            inputs: Vec::new(),
            truncated: Vec::new(),
            sha256: String::new(),
        }
    }

    #[test]
    fn a_folder_with_a_run_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        fs::write(folder.path().join(RECORD_FILE), "{}").unwrap();
        let written = plan(Method::Grid, 1, 1).write(folder.path());
        assert!(matches!(written, Err(CampaignError::Folder(FolderError::AlreadyUsed(_)))), "{written:?}");
        assert!(!CampaignPlan::exists(folder.path()));
    }

    #[test]
    fn paths_are_relative_to_the_campaign_folder() {
        let root = tempfile::tempdir().unwrap();
        let file = root.path().join("a/file.toml");
        fs::create_dir(root.path().join("a")).unwrap();
        fs::write(&file, "").unwrap();
        let relative = |folder: &str| relative_path(&file, &root.path().join(folder)).unwrap();
        assert_eq!(relative("a"), Path::new("file.toml"));
        assert_eq!(relative("a/new"), Path::new("../file.toml"));
        assert_eq!(relative("b/c"), Path::new("../../a/file.toml"));
    }

    #[test]
    fn shards_contain_every_trial_once() {
        let counts = [(10, 1), (10, 7), (3, 64), (1_000_003, 64), (10_000_000_000, 1_000)];
        let methods = [Method::Random, Method::Search, Method::Rare];
        for ((trials, shards), method) in counts.into_iter().flat_map(|counts| methods.map(|method| (counts, method))) {
            let plan = plan(method, trials, shards);
            let ends = (1..=shards).fold(0, |before, shard| {
                let range = plan.trials_of(shard);
                assert_eq!(range.start, before);
                assert!(
                    range.end == trials || range.end.is_multiple_of(method.chain_trials()),
                    "a shard has whole chains"
                );
                range.end
            });
            assert_eq!(ends, trials);
        }
    }
}
