//! Verifies a sealed record. It compares the files with the manifest, the manifest with the
//! signature, and the verdicts with traces that it judges again. Without a signature, a changed
//! file with a matching new manifest is found only if it contradicts the traces.

use crate::acceptance::check_controller;
use crate::acceptance::judge::judge_requirements;
use crate::acceptance::plan;
use crate::acceptance::seal::{
    FileDifference, MANIFEST_FILE, MAX_MANIFEST_BYTES, PublicKey, SIGNATURE_FILE, check_manifest,
};
use crate::acceptance::session_record::{
    AcceptError, BUDGET, FILE, PLAN, STEPS, SessionRecord, SignatureRecord, StepKind,
};
use platebench_engine::{RejudgeError, rejudge};
use platebench_model::record::{self, RunRecord, sha256};
use platebench_model::trace::{FileError, read_regular_file};
use std::io;
use std::path::Path;

/// A valid signature has 64 bytes. A longer one is wrong, and a much longer one is not read.
const MAX_SIGNATURE_BYTES: u64 = 64 << 10;
/// Largest plan, as for every TOML file that a user writes.
const MAX_PLAN_BYTES: u64 = 4 << 20;

#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum Finding {
    #[error(transparent)]
    File(FileDifference),
    #[error("{}: missing, expected the SHA-256 of every file", MANIFEST_FILE)]
    NoManifest,
    #[error("{file}: missing, {0}", file = SIGNATURE_FILE)]
    NoSignature(&'static str),
    #[error("{file}: wrong, {0}", file = SIGNATURE_FILE)]
    WrongSignature(&'static str),
    #[error("{file}: {message}")]
    Contradiction { file: String, message: String },
}

#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Signer {
    Unsigned,
    /// Fingerprint of the key in the record. It proves who signed only if the reader knows it.
    RecordKey(String),
    GivenKey,
}

#[derive(Debug, Clone)]
pub struct Verification {
    pub findings: Vec<Finding>,
    pub session: Option<SessionRecord>,
    pub signer: Signer,
    pub manifest_sha256: Option<String>,
    /// Number of files in the manifest.
    pub files: usize,
}

impl Verification {
    pub fn is_unfinished(&self) -> bool {
        self.manifest_sha256.is_none() && self.session.as_ref().is_some_and(|session| !session.complete)
    }

    /// True if only a signature is missing, and the session was conducted without a key.
    pub fn lacks_only_a_signature(&self) -> bool {
        let is_signed =
            self.session.as_ref().is_none_or(|session| session.must_be_signed || session.signature.is_some());
        !is_signed && matches!(self.findings.as_slice(), [Finding::NoSignature(_)])
    }
}

/// Verifies manifest, traces and signature. Fails if `folder` contains no record.
pub fn verify(folder: &Path, key: Option<&PublicKey>) -> Result<Verification, AcceptError> {
    let manifest = read_if_present(&folder.join(MANIFEST_FILE), MAX_MANIFEST_BYTES)?;
    let session = match (SessionRecord::read(folder), &manifest) {
        (Err(error), None) => return Err(error),
        (session, _) => session,
    };
    let mut found = Verification {
        findings: Vec::new(),
        session: None,
        signer: Signer::Unsigned,
        manifest_sha256: manifest.as_deref().map(sha256),
        files: 0,
    };
    match &manifest {
        Some(bytes) => {
            let text = String::from_utf8_lossy(bytes);
            found.files = text.lines().count();
            found.findings.extend(check_manifest(folder, &text).into_iter().map(Finding::File));
        }
        None => found.findings.push(Finding::NoManifest),
    }
    match session {
        Ok(session) => {
            if manifest.is_none() && !session.complete {
                found.findings.clear();
                found.session = Some(session);
                return Ok(found);
            }
            found.findings.extend(find_contradictions(folder, &session));
            found.session = Some(session);
        }
        Err(error) => found.findings.push(contradiction(FILE, error.to_string())),
    }
    let signature = read_if_present(&folder.join(SIGNATURE_FILE), MAX_SIGNATURE_BYTES)?;
    let named = found.session.as_ref().and_then(|session| session.signature.as_ref());
    match check_signature(manifest.as_deref().unwrap_or_default(), signature.as_deref(), named, key) {
        Ok(signer) => found.signer = signer,
        Err(finding) => found.findings.push(finding),
    }
    Ok(found)
}

/// `None` if the file does not exist. Fails if it cannot be read.
fn read_if_present(path: &Path, max_bytes: u64) -> Result<Option<Vec<u8>>, AcceptError> {
    match read_regular_file(path, max_bytes) {
        Ok(bytes) => Ok(Some(bytes)),
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(None),
        Err(source) => Err(FileError { path: path.to_owned(), source }.into()),
    }
}

/// `named` is the public key in the session record, `given` the key that the caller trusts.
fn check_signature(
    manifest: &[u8],
    signature: Option<&[u8]>,
    named: Option<&SignatureRecord>,
    given: Option<&PublicKey>,
) -> Result<Signer, Finding> {
    match (signature, given, named) {
        (None, Some(_), _) => Err(Finding::NoSignature("expected a signature with the given key")),
        (None, None, Some(_)) => {
            Err(Finding::NoSignature("but session.json contains a key, so the session was signed"))
        }
        (None, None, None) => Ok(Signer::Unsigned),
        (Some(signature), Some(given), _) if given.verifies(manifest, signature) => Ok(Signer::GivenKey),
        (Some(_), Some(_), _) => {
            Err(Finding::WrongSignature("expected a signature of this manifest with the given key"))
        }
        (Some(_), None, None) => {
            Err(Finding::WrongSignature("session.json contains no key for it; name the key with --key FILE"))
        }
        (Some(signature), None, Some(named)) => PublicKey::from_pem(&named.public_key)
            .filter(|named| named.verifies(manifest, signature))
            .map(|named| Signer::RecordKey(named.fingerprint()))
            .ok_or(Finding::WrongSignature("expected a signature of this manifest with the key in session.json")),
    }
}

fn contradiction(file: &str, message: String) -> Finding {
    Finding::Contradiction { file: file.to_owned(), message }
}

fn find_contradictions(folder: &Path, session: &SessionRecord) -> Vec<Finding> {
    let mut findings = Vec::new();
    let mut runs = Vec::new();
    for step in session.steps.iter().filter(|step| step.kind == StepKind::Scenario) {
        let file = format!("{STEPS}/{}/{}", step.id, record::RECORD_FILE);
        let run = folder.join(STEPS).join(&step.id);
        let both =
            RunRecord::read(&run).map_err(RejudgeError::from).and_then(|stored| Ok((stored, rejudge(&run, None)?)));
        match both {
            Ok((stored, again)) => {
                let differs = stored.scenarios.len() != again.scenarios.len()
                    || stored.verdict != again.verdict
                    || stored.scenarios.iter().zip(&again.scenarios).any(|(stored, again)| {
                        (stored.verdict, &stored.expectations) != (again.verdict, &again.expectations)
                    });
                if differs {
                    findings.push(contradiction(&file, "its verdicts differ from those of the traces".to_owned()));
                }
                if step.verdict != Some(again.verdict) {
                    let stored = step.verdict.map_or("nothing", platebench_model::record::Verdict::name);
                    let message =
                        format!("step {} has verdict {stored}, but its traces give {}", step.id, again.verdict);
                    findings.push(contradiction(FILE, message));
                }
                let known = session.firmware.as_ref();
                if let Some(error) = known.and_then(|known| check_controller(known, &again.rig).err()) {
                    findings.push(contradiction(&file, error.to_string()));
                }
                let used = again.scenarios.iter().flat_map(|scenario| &scenario.inputs);
                for input in used.filter(|input| session.inputs.iter().all(|known| known.sha256 != input.sha256)) {
                    let message = format!("the run used {}, which is not an input of the session", input.file);
                    findings.push(contradiction(&file, message));
                }
                runs.push((step.id.clone(), again));
            }
            Err(error) => {
                let message = format!("the traces of this run cannot be judged again: {error}");
                findings.push(contradiction(&file, message));
            }
        }
    }
    let path = folder.join(PLAN);
    let plan = read_regular_file(&path, MAX_PLAN_BYTES).ok().filter(|bytes| sha256(bytes) == session.plan.sha256);
    let read = |bytes: Vec<u8>| plan::read_recorded_plan(&path, bytes, &folder.join(BUDGET)).ok();
    let Some((requirements, decision)) = plan.and_then(read) else {
        findings.push(contradiction(PLAN, "this is not the plan of the session".to_owned()));
        return findings;
    };
    let [used, stated] = [
        decision.as_ref().map(|decision| (decision.rule, sha256(&decision.budget.bytes))),
        session.decision.as_ref().map(|decision| (decision.rule, decision.budget.sha256.clone())),
    ];
    if used != stated {
        findings.push(contradiction(FILE, "decision rule or budget differs from plan.toml and budget.toml".to_owned()));
    }
    let (decided, verdict) = judge_requirements(&requirements, &session.steps, &runs, decision.as_ref());
    for again in &decided {
        match session.requirements.iter().find(|stored| stored.id == again.id) {
            Some(stored) if stored == again => {}
            stored => {
                let verdict = stored.map_or("none", |stored| stored.verdict.name());
                let message = if verdict == again.verdict.name() {
                    format!("text or evidence of {} differs from plan and traces", again.id)
                } else {
                    format!("{} has verdict {verdict}, but its evidence gives {}", again.id, again.verdict)
                };
                findings.push(contradiction(FILE, message));
            }
        }
    }
    if session.requirements.len() > decided.len() {
        findings.push(contradiction(FILE, "the record has requirements that are not in the plan".to_owned()));
    }
    if session.verdict != verdict {
        let message = format!("the session has verdict {}, but its evidence gives {verdict}", session.verdict);
        findings.push(contradiction(FILE, message));
    }
    findings
}
