//! Holds what a run leaves: its record, its events and its folder.

mod bounds;
mod cost;
mod event;
mod exclusion;
mod excuse;
mod expectation_record;
mod merge_record;
mod missing_value;
mod provenance;
mod real_plate;
mod reason;
mod run_folder;
mod run_record;
mod store;
mod timing;
mod trial_record;
mod verdict;
mod violation;

pub use bounds::Bounds;
pub use cost::{CostChange, CostTrend, EarlierCost, StepCost};
pub use event::Event;
pub use exclusion::Exclusion;
pub use excuse::{BestResponse, Excuse};
pub use expectation_record::{Evidence, EvidenceMethod, ExpectationRecord, MetricDefinition, Statistic};
pub use merge_record::{BoardDifference, MergeRecord, MergedRun, MergedScenario, MissingShard};
pub use missing_value::{MissingValue, UndefinedValue};
pub use platebench_scenario::{Limit, Metric};
pub use provenance::{Host, Tool};
pub use real_plate::{OperatorRequest, RealPlateRecord};
pub use reason::{DivergedTrials, Divergence, Reason, TrialFinding, TrialReason, WideBoundsCause, percent};
pub use run_folder::{FolderError, RunFolder, sha256, sha256_of_file, to_hex, trace_path};
pub use run_record::{
    ClockKind, FORMAT, Firmware, InputRecord, KeepTraces, NotApplicable, Overrides, RigRecord, RunRecord,
    ScenarioRecord,
};
pub use store::{RECORD_FILE, RecordError, RunSummary, ScenarioSummary};
pub use timing::{Quantiles, TimingRecord};
pub use trial_record::{NonFiniteDrive, Telemetry, TrialRecord};
pub use verdict::{Cause, Verdict};
pub use violation::{Violation, ViolationKind};
