//! Defines scenarios, traces, recordings and the record of a run, and reads and writes their files.

#![cfg_attr(not(test), warn(clippy::disallowed_methods))]

pub mod external_csv;
mod files;
pub mod input;
pub mod metrics;
pub mod printable;
mod quote;
pub mod recording;

pub use quote::{in_quotes, quoted, quoted_path};

pub mod record {
    //! Defines the record, the events and the folder of a run.

    mod assessment;
    mod event;
    mod journal;
    mod reason;
    mod run_folder;
    mod run_record;
    mod trial_record;
    mod verdict;

    pub use crate::metrics::{Metric, MissingValue, SignalPoint, UndefinedValue};
    pub use crate::scenario::Limit;
    pub use assessment::{Assessment, NotPlayed, RunOutcome, ScenarioAssessment, combine_runs};
    pub use event::{Event, PlannedScenario};
    pub use journal::TrialJournal;
    pub use reason::{
        Bounds, DivergedTrials, Divergence, Evidence, EvidenceMethod, ExpectationRecord, LoopSymptom, MetricDefinition,
        Reason, Statistic, StoppedTrial, TrialFinding, TrialReason, WideBoundsCause, WorstInstant, percent,
    };
    pub use run_folder::{
        CAMPAIGN_PLAN_FILE, FileLock, FolderError, JOURNAL_FILE, RECORD_FILE, RecordError, RunFolder, RunSummary,
        ScenarioSummary, defmt_path, is_run_folder, newest_run, sha256, sha256_of_file, to_hex, trace_path,
        utc_timestamp,
    };
    pub use run_record::{
        BoardDifference, ClockKind, FORMAT, Firmware, Host, InputRecord, JournalRecord, KeepTraces, MergeRecord,
        MergedRun, MergedScenario, MissingShard, NotApplicable, Overrides, RigRecord, RunRecord, ScenarioRecord, Tool,
    };
    pub use trial_record::{
        CostChange, CostTrend, EarlierCost, MetricValues, NonFiniteDrive, OperatorRequest, Quantiles, RealPlateRecord,
        StepCost, StepTime, Telemetry, TightestStep, TimingRecord, Transport, TrialRecord, UnmodelledInstance,
    };
    pub use verdict::{BestResponse, Cause, Exclusion, Excuse, Verdict, VerdictCounts, Violation, ViolationKind};
}

pub mod scenario {
    //! Reads and checks scenario files.

    mod definition;
    pub mod diagnostic;
    pub mod expect;
    pub mod fault;
    mod file_checker;
    pub mod find;
    pub mod load;
    mod matrix;
    mod message;
    mod own_law;
    mod parse;
    pub mod raw;
    pub mod schema;
    mod trusted_file;
    mod warnings;
    mod window;

    pub use crate::metrics::Metric;
    pub use definition::{
        AUTO_MODEL, Controller, InputFile, LoopInsertion, MAX_TIMEOUT_S, MAX_TRIALS, Scenario, ScenarioGains, Spread,
        Trials, Variation,
    };
    pub use diagnostic::{Diagnostic, suggestion};
    pub use expect::{Aggregation, Expectation, Limit};
    pub use fault::{BitFlipTarget, ChipFault, ChipFaultKind, Direction, Fault, FaultKind};
    pub use file_checker::FileChecker;
    pub use find::{FileKind, FoundScenarios, SETTINGS_FILE, find, list_files, repeated_names};
    pub use load::{REQUIREMENTS_FILE, Requirement, load, load_copies, load_with_all_errors, read_requirements};
    pub use matrix::is_scenario_path;
    pub use message::{ConfigurationChange, NonFinite, ScenarioMessage, WireNumber};
    pub use own_law::{NotApplicableExpectation, OWN_LAW, number_in_file};
    pub use parse::{parse, parse_bytes, read_text};
    pub use platebench_plate::Time;
    pub use trusted_file::{TRUSTED_FOLDERS_VARIABLE, find_trusted_file_above};
    pub use warnings::{plate_warnings, scenario_warnings};
    pub use window::{ChangingProfile, Window};
}

pub mod trace {
    //! Reads and writes traces. A trace is a CSV file with the rows of one trial.
    //!
    //! A row contains the plate state **at** `t_s`, and the drive and frequency that act **from** `t_s`
    //! until the next row. Floats have the shortest text that gives the same f64 again, so equal trials
    //! have equal bytes.

    mod trace_file;

    pub use crate::files::{
        AtPath, FileError, MAX_IMAGE_BYTES, MAX_TABLE_BYTES, OutputFile, OutputFolder, create_folder, missing_folders,
        open_regular_file, read_regular_file, read_text_file, remove_empty_folders, write_atomically,
        write_named_by_user, write_new,
    };
    pub use trace_file::{
        COLUMNS, Column, Flags, OPTIONAL_COLUMNS, Row, TraceError, TraceReader, TraceWriter, read_trace,
    };
}
