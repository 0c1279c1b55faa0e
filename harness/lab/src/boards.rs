//! Manages several boards: the inventory `boards.toml`, locks, quarantine and joined runs.
//!
//! One folder next to the inventory contains a lock file and a state file per board. The kernel
//! releases the lock when the process ends that holds it. The state file survives a power cut.

mod board_differences;
mod board_lock;
mod error;
mod inventory;
mod merge;
mod reservation;
mod run_end;
mod soak;
mod soak_record;
mod state;
mod status;

pub use error::BoardError;
pub use inventory::{Board, BoardSensor, INVENTORY_FILE, Inventory, RawInventory};
pub use merge::{MergeError, merge_runs};
pub use reservation::Reservation;
pub use run_end::BoardOutcome;
pub use soak::{SoakConfig, SoakResult, soak};
pub use soak_record::{SOAK_FILE, SoakEnd, SoakRecord, SoakScenario};
pub use state::{LastRun, Quarantine};
pub use status::{BoardState, BoardStatus, clear, list, status_table};
