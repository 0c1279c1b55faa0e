//! Whether a record is still what it was.
//!
//! Three looks, each of which can refuse: the files against the manifest, the manifest against its signature, and the verdicts against the traces, which are
//! judged again. Without a signature, whoever changes a file can write a manifest that fits; what then still shows are verdicts that the traces do not bear out.

use crate::error::AcceptError;
use crate::judge::judge_requirements;
use crate::manifest::{self, Difference};
use crate::plan;
use crate::session_record::{FILE, PLAN, STEPS, SessionRecord, SignatureRecord, StepKind};
use crate::signature::{self, PublicKey};
use platebench_record::sha256;
use platebench_record::{self as record, RunRecord};
use platebench_runner::{RejudgeError, rejudge};
use std::fs;
use std::path::Path;

/// Something that is not as it was when the record was sealed. Each names its file.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum Finding {
    /// A file, against the manifest.
    #[error(transparent)]
    File(Difference),
    /// There is no manifest.
    #[error("{}: missing, nothing says what the files were", manifest::FILE)]
    NoManifest,
    /// There should be a signature.
    #[error("{file}: missing, {0}", file = signature::FILE)]
    NoSignature(&'static str),
    /// There should be none, or it is another's.
    #[error("{file}: wrong, {0}", file = signature::FILE)]
    WrongSignature(&'static str),
    /// What stands in a file is not what the traces show.
    #[error("{file}: {message}")]
    Contradiction {
        /// The file.
        file: String,
        /// What does not fit.
        message: String,
    },
}

/// Who vouches for the manifest.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Signer {
    /// Nobody.
    Unsigned,
    /// Whoever has the key that is named in the record itself; its fingerprint.
    RecordKey(String),
    /// The owner of the key that was given.
    GivenKey,
}

/// What came of it.
#[derive(Debug, Clone)]
pub struct Verification {
    /// Everything that is wrong; empty for a record that is what it was.
    pub findings: Vec<Finding>,
    /// The session, where it can be read.
    pub session: Option<SessionRecord>,
    /// Who vouches for it.
    pub signer: Signer,
    /// SHA-256 of the manifest, hexadecimal, where there is one.
    pub manifest_sha256: Option<String>,
    /// How many files the manifest names.
    pub files: usize,
}

impl Verification {
    /// True where the session has not come to its end, so that there is nothing to verify yet.
    pub fn is_unfinished(&self) -> bool {
        self.manifest_sha256.is_none() && self.session.as_ref().is_some_and(|session| !session.complete)
    }
}

/// Holds the record in `folder` against its manifest, its signature, which has to be that of `key` where one is given, and its own traces.
///
/// # Errors
/// [`AcceptError::NoSession`] where there is no record at all.
pub fn verify(folder: &Path, key: Option<&PublicKey>) -> Result<Verification, AcceptError> {
    let manifest = fs::read(folder.join(manifest::FILE)).ok();
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
            // What is no text is no line either.
            let text = String::from_utf8_lossy(bytes);
            found.files = text.lines().count();
            found.findings.extend(manifest::check(folder, &text).into_iter().map(Finding::File));
        }
        None => found.findings.push(Finding::NoManifest),
    }
    match session {
        Ok(session) => {
            if manifest.is_none() && !session.complete {
                // Not sealed yet.
                found.findings.clear();
                found.session = Some(session);
                return Ok(found);
            }
            found.findings.extend(find_contradictions(folder, &session));
            found.session = Some(session);
        }
        Err(error) => found.findings.push(contradiction(FILE, error.to_string())),
    }
    let signature = fs::read(folder.join(signature::FILE)).ok();
    let named = found.session.as_ref().and_then(|session| session.signature.as_ref());
    match check_signature(manifest.as_deref().unwrap_or_default(), signature.as_deref(), named, key) {
        Ok(signer) => found.signer = signer,
        Err(finding) => found.findings.push(finding),
    }
    Ok(found)
}

/// Who signed `manifest`. `named` is the key that the session names, if it does.
fn check_signature(
    manifest: &[u8],
    signature: Option<&[u8]>,
    named: Option<&SignatureRecord>,
    given: Option<&PublicKey>,
) -> Result<Signer, Finding> {
    match (signature, given, named) {
        (None, Some(_), _) => Err(Finding::NoSignature("the record should be signed with the key that was given")),
        (None, None, Some(_)) => Err(Finding::NoSignature("session.json says that there is one")),
        (None, None, None) => Ok(Signer::Unsigned),
        (Some(signature), Some(given), _) if given.verifies(manifest, signature) => Ok(Signer::GivenKey),
        (Some(_), Some(_), _) => Err(Finding::WrongSignature("it is not that of the given key over this manifest")),
        (Some(_), None, None) => Err(Finding::WrongSignature("session.json knows of none")),
        (Some(signature), None, Some(named)) => PublicKey::from_pem(&named.public_key)
            .filter(|named| named.verifies(manifest, signature))
            .map(|named| Signer::RecordKey(named.fingerprint()))
            .ok_or(Finding::WrongSignature("it is not that of the key in session.json over this manifest")),
    }
}

fn contradiction(file: &str, message: String) -> Finding {
    Finding::Contradiction { file: file.to_owned(), message }
}

/// Where what is written in the record is not what its traces show.
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
                    findings.push(contradiction(&file, "the traces, judged again, do not bear it out".to_owned()));
                }
                if step.verdict != Some(again.verdict) {
                    let says = step.verdict.map_or("nothing", platebench_record::Verdict::name);
                    let message = format!("step {} says {says}, its traces say {}", step.id, again.verdict);
                    findings.push(contradiction(FILE, message));
                }
                let used = again.scenarios.iter().flat_map(|scenario| &scenario.inputs);
                for input in used.filter(|input| session.inputs.iter().all(|known| known.sha256 != input.sha256)) {
                    let message = format!("{} is none of the session's inputs", input.file);
                    findings.push(contradiction(&file, message));
                }
                runs.push((step.id.clone(), again));
            }
            Err(error) => {
                let message = format!("its traces cannot be judged again: {error}");
                findings.push(contradiction(&file, message));
            }
        }
    }
    let path = folder.join(PLAN);
    let plan = fs::read(&path).ok().filter(|bytes| sha256(bytes) == session.plan.sha256);
    let Some(requirements) = plan.and_then(|bytes| plan::read_requirements(&path, &bytes).ok()) else {
        findings.push(contradiction(PLAN, "not the plan that the session was made with".to_owned()));
        return findings;
    };
    let (decided, verdict) = judge_requirements(&requirements, &session.steps, &runs);
    for again in &decided {
        match session.requirements.iter().find(|stored| stored.id == again.id) {
            Some(stored) if stored == again => {}
            stored => {
                let says = stored.map_or("nothing", |stored| stored.verdict.name());
                let message = format!("{} says {says}, its evidence says {}", again.id, again.verdict);
                let message = if says == again.verdict.name() {
                    format!("{}: text or evidence is not what plan and traces say", again.id)
                } else {
                    message
                };
                findings.push(contradiction(FILE, message));
            }
        }
    }
    if session.requirements.len() > decided.len() {
        findings.push(contradiction(FILE, "requirements that are not in the plan".to_owned()));
    }
    if session.verdict != verdict {
        let message = format!("the session says {}, its evidence says {verdict}", session.verdict);
        findings.push(contradiction(FILE, message));
    }
    findings
}
