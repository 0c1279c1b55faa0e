//! Appends one sealed line per trial to `trials.jsonl`, and reads the lines of a stored run.
//!
//! A line is `{"seal": HEX, "entry": ENTRY}`. The seal is the SHA-256 of the seal before it and of
//! the text of the entry; the first line follows the number of the run. A line that was changed,
//! cut out or taken from another run therefore has a wrong seal. A line without an end is a trial
//! that was interrupted, and it does not count. One write(2) appends a line, before the event of
//! the trial is sent and after its trace has its final name.

use crate::record::run_folder::{JOURNAL_FILE, RecordError, sha256};
use crate::record::run_record::{Firmware, JournalRecord, KeepTraces, RigRecord, RunRecord, ScenarioRecord};
use crate::record::trial_record::TrialRecord;
use crate::trace::{AtPath, FileError, OutputFolder, read_regular_file};
use serde::{Deserialize, Serialize};
use std::borrow::Cow;
use std::collections::BTreeMap;
use std::fs::File;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::time::{SystemTime, UNIX_EPOCH};

/// A journal of 10⁶ trials has about 1 GB.
const MAX_JOURNAL_BYTES: u64 = 4 << 30;
const SEAL_KEY: &str = "{\"seal\":\"";
const ENTRY_KEY: &str = "\",\"entry\":";
const SEAL_DIGITS: usize = 64;

/// All by which one trial can be judged again, with its trace.
#[derive(Debug, Serialize, Deserialize)]
struct JournalEntry<'a> {
    /// Index of the scenario in `run.json`.
    scenario: usize,
    file: Cow<'a, str>,
    /// SHA-256 over the digests of all input files of the scenario.
    inputs: Cow<'a, str>,
    /// Identity of the controller that answered.
    firmware: Option<Cow<'a, Firmware>>,
    /// SHA-256 of its program or image.
    program_sha256: Option<Cow<'a, str>>,
    trial: Cow<'a, TrialRecord>,
}

#[derive(Debug)]
pub struct TrialJournal {
    file: File,
    path: PathBuf,
    run: String,
    seal: String,
}

impl TrialJournal {
    /// Creates the journal in a new run folder.
    pub fn create(folder: &OutputFolder) -> Result<Self, FileError> {
        let path = folder.path().join(JOURNAL_FILE);
        let file = folder.append(JOURNAL_FILE)?;
        let since = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
        let run = sha256(format!("{} {} {}", path.display(), since.as_nanos(), std::process::id()).as_bytes());
        Ok(Self { file, path, seal: run.clone(), run })
    }

    /// The journal before its end.
    pub fn started(&self) -> JournalRecord {
        JournalRecord { run: self.run.clone(), seal: None }
    }

    /// Waits until the lines are on the disk, because the complete record refers to the last seal.
    pub fn finished(&self) -> Result<JournalRecord, FileError> {
        self.file.sync_all().at(&self.path)?;
        Ok(JournalRecord { run: self.run.clone(), seal: Some(self.seal.clone()) })
    }

    /// Appends a trial of `scenario`, which has index `number` in the record.
    pub fn append(
        &mut self,
        number: usize,
        scenario: &ScenarioRecord,
        rig: &RigRecord,
        trial: &TrialRecord,
    ) -> Result<(), FileError> {
        let entry = JournalEntry {
            scenario: number,
            file: Cow::Borrowed(&scenario.file),
            inputs: Cow::Owned(scenario.inputs_digest()),
            firmware: rig.firmware.as_ref().map(Cow::Borrowed),
            program_sha256: rig.program_sha256.as_deref().map(Cow::Borrowed),
            trial: Cow::Borrowed(trial),
        };
        let text = serde_json::to_string(&entry).map_err(std::io::Error::from).at(&self.path)?;
        let seal = seal_of(&self.seal, text.as_bytes());
        let line = format!("{SEAL_KEY}{seal}{ENTRY_KEY}{text}}}\n");
        self.file.write_all(line.as_bytes()).at(&self.path)?;
        self.seal = seal;
        Ok(())
    }
}

fn seal_of(before: &str, entry: &[u8]) -> String {
    sha256(&[before.as_bytes(), entry].concat())
}

/// Returns seal and entry of a line without its end.
fn split_line(line: &[u8]) -> Option<(&str, &[u8])> {
    let (seal, rest) = line.strip_prefix(SEAL_KEY.as_bytes())?.split_at_checked(SEAL_DIGITS)?;
    let entry = rest.strip_prefix(ENTRY_KEY.as_bytes())?.strip_suffix(b"}")?;
    Some((str::from_utf8(seal).ok()?, entry))
}

impl ScenarioRecord {
    /// SHA-256 over the digests of all input files.
    pub fn inputs_digest(&self) -> String {
        let digests: Vec<&str> = self.inputs.iter().map(|input| input.sha256.as_str()).collect();
        sha256(digests.join("\n").as_bytes())
    }
}

impl RunRecord {
    /// Takes the trials of an unfinished run from its journal. For a complete run, checks that the
    /// trials of the record are those of the journal.
    pub(super) fn read_journal(&mut self, folder: &Path) -> Result<(), RecordError> {
        let Some(journal) = self.journal.clone() else { return Ok(()) };
        let path = folder.join(JOURNAL_FILE);
        let changed = |line, what| RecordError::Journal { path: path.clone(), line, what };
        let bytes = read_regular_file(&path, MAX_JOURNAL_BYTES).at(&path)?;
        let whole = bytes.iter().rposition(|byte| *byte == b'\n').and_then(|end| bytes.get(..end));
        let mut trials: Vec<BTreeMap<u32, TrialRecord>> = vec![BTreeMap::new(); self.scenarios.len()];
        let (mut seal, mut last) = (journal.run, 0);
        for (number, line) in (1..).zip(whole.into_iter().flat_map(|whole| whole.split(|byte| *byte == b'\n'))) {
            let (stated, text) = split_line(line).ok_or_else(|| changed(number, "not a sealed trial"))?;
            if seal_of(&seal, text) != stated {
                return Err(changed(number, "the seal differs from the content and the line before"));
            }
            stated.clone_into(&mut seal);
            let entry: JournalEntry<'_> =
                serde_json::from_slice(text).map_err(|_| changed(number, "the trial has a wrong type"))?;
            let scenario = self.scenarios.get(entry.scenario).filter(|scenario| {
                let rig = self.rig_of(&scenario.file);
                scenario.file == entry.file
                    && scenario.inputs_digest() == entry.inputs
                    && rig.firmware.as_ref() == entry.firmware.as_deref()
                    && rig.program_sha256.as_deref() == entry.program_sha256.as_deref()
            });
            let of_scenario = trials.get_mut(entry.scenario).filter(|_| scenario.is_some());
            let of_scenario =
                of_scenario.ok_or_else(|| changed(number, "run.json has another scenario or firmware"))?;
            if of_scenario.insert(entry.trial.index, entry.trial.into_owned()).is_some() {
                return Err(changed(number, "the trial occurs twice"));
            }
            last = number;
        }
        if self.complete && journal.seal != Some(seal) {
            return Err(changed(last, "expected the last seal of run.json; lines are missing or were added"));
        }
        let (complete, keep) = (self.complete, self.overrides.keep_traces);
        for (scenario, sealed) in self.scenarios.iter_mut().zip(trials) {
            let sealed: Vec<_> = sealed.into_values().collect();
            if complete && !are_same_trials(&scenario.trials, &sealed, keep) {
                return Err(changed(last, "the trials of run.json differ from the sealed trials"));
            }
            if !complete {
                scenario.trials = sealed;
            }
        }
        Ok(())
    }
}

/// `--keep-traces worst` removes traces of sealed trials.
fn are_same_trials(recorded: &[TrialRecord], sealed: &[TrialRecord], keep: KeepTraces) -> bool {
    let is_removed = |trial: &TrialRecord| trial.sha256.is_none() && matches!(keep, KeepTraces::Worst(_));
    let is_same = |(recorded, sealed): (&TrialRecord, &TrialRecord)| {
        recorded == sealed || (is_removed(recorded) && *recorded == TrialRecord { sha256: None, ..sealed.clone() })
    };
    recorded.len() == sealed.len() && recorded.iter().zip(sealed).all(is_same)
}
